"""Frames as layers of napari: data, how they are shown, and their kind, as plain values.

A raw frame's sample is one unit of the world wide; a pixel of half resolution covers its 2x2 cell, so that both lie on
each other. Images keep their linear values; contrast limits and gamma only show them brighter.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.frames import Frame, ReadOptions, read_frames
from polsep.io.results.previews import aolp_wheel, exposure_of
from polsep.io.results.separation_reader import holds_separated, read_separated
from polsep.io.results.sidecars import read_report
from polsep.io.store.samples import DEMO, DEMO_WHITE
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.report import SeparatedFrame

#: Data, arguments of the layer, and its kind, as napari takes them.
LayerData = tuple[NDArray[Any], dict[str, Any], str]
#: What shows linear light about as sRGB does.
GAMMA = 1 / 2.2
#: The key of polsep's facts in the metadata of layers.
FACTS = "polsep"


def find_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """The function that reads a file, or several as one stack; None unless they are EXR files, or NPZ files."""
    paths = _as_paths(path)
    return read_layers if all(p.suffix.lower() in (".exr", ".npz") for p in paths) else None


def read_layers(path: str | Sequence[str]) -> list[LayerData]:
    """Layers of a separated frame, several such files stacked, or of the raw frames of an NPZ file.

    The report beside a file says its resolution and its warnings; without it a pixel is one unit wide. Raises
    InputError on other files, and ValueError on images that do not stack.
    """
    paths = _as_paths(path)
    if paths[0].suffix.lower() == ".npz" and not holds_separated(paths[0]):
        return [layer for p in paths for layer in (raw_layer(frame) for frame in read_frames(p, ReadOptions()))]
    stacks = [frame_layers(_read_frame(p), paths[0].stem) for p in paths]
    if len(stacks) == 1:
        return stacks[0]
    names = [{shown["name"] for _, shown, _ in layers} for layers in stacks]
    shared = set.intersection(*names)  # a black frame has no polarization
    kept = [[layer for layer in layers if layer[1]["name"] in shared] for layers in stacks]
    return [_stacked(layers) for layers in zip(*kept, strict=True)]


def read_demo() -> list[LayerData]:
    """The raw frame that comes with polsep, with its levels."""
    return [raw_layer(next(read_frames(DEMO, ReadOptions(white_level=DEMO_WHITE))))]


def raw_layer(frame: Frame) -> LayerData:
    """A mosaic in the units of its samples, grey, with layout and levels as facts. Raises ValueError on others."""
    mosaic = frame.data
    if not isinstance(mosaic, Mosaic):
        raise ValueError("expected a raw mosaic, found angle images: `polsep separate` takes them")
    levels = {"black": float(mosaic.black_level), "white": float(mosaic.white_level)}
    facts = {"layout": mosaic.layout.spec, **levels, "warnings": list(frame.notes)}
    shown = {"name": frame.stem, "contrast_limits": tuple(levels.values()), "gamma": GAMMA, "metadata": {FACTS: facts}}
    return np.asarray(mosaic.data), shown, "image"


def frame_layers(frame: SeparatedFrame, name: str) -> list[LayerData]:
    """Layers ``NAME diffuse``, ``specular`` (one exposure), ``DoLP``, ``AoLP`` [degrees] and ``not valid`` of a frame.

    AoLP has the cyclic colours of the preview. Those of a file without polarization are left out.
    """
    images = {"diffuse": frame.diffuse, "specular": frame.specular}
    white = 1 / exposure_of(frame.diffuse + frame.specular)
    lit = {"contrast_limits": (0.0, white), "gamma": GAMMA}
    found: list[tuple[str, NDArray[Any], dict[str, Any], str]] = []
    if frame.dolp.any():
        wheel = aolp_wheel(np.linspace(0, np.pi, 181)) / 255
        found.append(("not valid", (~frame.valid).astype(np.uint8), {"visible": False, "opacity": 0.6}, "labels"))
        angles = {"contrast_limits": (0.0, 180.0), "colormap": {"name": "AoLP", "colors": wheel}}
        found.append(("AoLP", np.degrees(frame.aolp), angles, "image"))
        found.append(("DoLP", frame.dolp, {"contrast_limits": (0.0, 1.0), "colormap": "inferno"}, "image"))
    for image, data in reversed(images.items()):  # the last layer lies on top
        color = data.shape[-1] == 3
        found.append((image, data if color else data[..., 0], {**lit, "rgb": color}, "image"))
    place = _place(frame.report)
    facts = {key: frame.report[key] for key in ("method", "layout", "warnings") if key in frame.report}
    return [
        (data, {"name": f"{name} {what}", **place, **shown, "metadata": {FACTS: facts}}, kind)
        for what, data, shown, kind in found
    ]


def _place(report: Mapping[str, Any]) -> dict[str, Any]:
    """Scale and translation on the raw frame: of cells of 2x2 samples, where the report says half resolution."""
    if report.get("full_resolution") is not False:
        return {}
    try:
        origin = Layout.parse(report["layout"]).origin
    except (KeyError, ValueError):  # angle images keep their resolution
        return {}
    return {"scale": (2.0, 2.0), "translate": tuple(start + 0.5 for start in origin)}


def _read_frame(path: Path) -> SeparatedFrame:
    """The frame of a file with the report beside it."""
    frame = read_separated(path)
    frame.report.update(read_report(path))
    return frame


def _stacked(layers: Sequence[LayerData]) -> LayerData:
    """Layers of one kind as one, along a new first axis."""
    data, (_, shown, kind) = [layer[0] for layer in layers], layers[0]
    if len({image.shape for image in data}) > 1:
        raise ValueError(f"expected images of one size to stack, found {sorted({image.shape for image in data})}")
    more = {key: (start, *shown[key]) for key, start in (("scale", 1.0), ("translate", 0.0)) if key in shown}
    return np.stack(data), {**shown, **more, "name": re.sub(r"_\d+(?= )", "", shown["name"])}, kind


def _as_paths(path: str | Sequence[str]) -> list[Path]:
    return [Path(path)] if isinstance(path, str) else [Path(p) for p in path]
