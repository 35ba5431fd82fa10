"""Distances of images of other programs from those of `polsep separate`: exported graphs, and the browser page.

Graphs are written by `polsep export` and run in ONNX Runtime; the page runs in Chromium. All see a part of the demo
capture with clipped highlights; a mono frame is its cells behind one green filter of each period. Layers are in float32
on both sides. Differences are in units of white, over every pixel and both images. Graphs repair nothing, so what
polsep takes for defects, single bright rays of the rendering, is repaired before.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import imagecodecs
import numpy as np
from numpy.typing import NDArray

import polsep
from evaluation.install import run_program
from evaluation.web import opened, served_page
from polsep.bench.rows import Row
from polsep.io.results.exr import read_exr_layers
from polsep.sensor.camera import Layout
from polsep.sensor.checks import check_mosaic
from polsep.sensor.levels import as_mosaic
from tools.web_page import DEMO, fetch, send

Floats = NDArray[np.float32]
Images = tuple[Floats, Floats]

#: Method, layout and resolution of the graphs.
GRAPHS = (
    ("joint-fast", "color", False),
    ("joint-fast", "color", True),
    ("joint-fast", "mono", False),
    ("joint", "mono", False),
    ("joint", "color", False),
    ("joint-large", "color", False),
)
#: Methods of the page.
PAGE = ("analytic", "joint-fast")
#: The part of the demo capture: sides that are multiples of 4, a torus and a ball with clipped highlights.
PART, WHITE = (slice(512, 1536), slice(612, 1836)), 4095.0
#: What graphs are promised to differ by at most.
PROMISED = 0.002


def bench_agreement(graphs: tuple[tuple[str, str, bool], ...] = GRAPHS) -> Iterator[Row]:
    """Largest differences of graphs and of the page, and seconds and memory of exports. Raises ValueError."""
    with patch.dict(os.environ, POLSEP_LAYERS="f32"), TemporaryDirectory() as folder:
        for method, layout, full in graphs:
            yield from _compare_graph(method, layout, full, Path(folder) / "graph.onnx")
        yield from _compare_page(Path(folder))


def _compare_graph(method: str, layout: str, full: bool, path: Path) -> Iterator[Row]:
    """Rows of one graph."""
    case = f"{method}, {'colour' if layout == 'color' else layout}, {'full' if full else 'half'} resolution"
    words = ["--mono"] * (layout == "mono") + ["--full"] * full
    command = (sys.executable, "-m", "polsep", "export", method, *words, "-o", str(path), "--overwrite")
    seconds, peak = run_program(*command)
    yield Row("agreement/export", case, "polsep export", "time", seconds, "s")
    yield Row("agreement/export", case, "polsep export", "peak memory", peak, "MiB")
    yield Row("agreement/export", case, "polsep export", "size of the file", path.stat().st_size / 1e6, "MB")
    raw = _part(layout)
    out = _separate(raw, method, layout, full)
    light = tuple(out.report["light_color"])
    found = _run_graph(path, raw, light)
    yield from _from_the_command(case, "ONNX Runtime", found, out)


def _part(layout: str) -> NDArray[np.uint16]:
    """The raw frame of a layout."""
    raw = np.ascontiguousarray(imagecodecs.imread(DEMO)[PART])
    if layout == "mono":
        height, width = raw.shape
        cells = raw.reshape(height // 4, 2, 2, width // 4, 2, 2)[:, 0, :, :, 1]
        raw = np.ascontiguousarray(cells.reshape(height // 2, width // 2))
    repaired = check_mosaic(as_mosaic(raw, Layout.parse(layout), 0, WHITE)[0]).mosaic.data
    codes: NDArray[np.uint16] = np.rint(repaired.clip(0, WHITE)).astype(np.uint16)
    return codes


def _separate(raw: NDArray[np.uint16], method: str, layout: str, full: bool) -> polsep.SeparatedFrame:
    """A frame by the library, the light found in it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", polsep.PolsepWarning)
        return polsep.separate(raw, method, layout, white_level=WHITE, full=full, device="cpu")


def _run_graph(path: Path, raw: NDArray[np.uint16], light: tuple[float, ...]) -> Images:
    """Diffuse and specular images of a graph in ONNX Runtime."""
    import onnxruntime  # type: ignore[import-untyped]  # it has no stubs

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    given: dict[str, Any] = {"raw": raw[None], "black_level": np.zeros(1, np.float32)}
    given["white_level"] = np.full(1, WHITE, np.float32)
    if len(light) == 3:
        given["light_color"] = np.array(light, np.float32)
    diffuse, specular = session.run(["diffuse", "specular"], given)
    return diffuse[0], specular[0]


def _compare_page(folder: Path) -> Iterator[Row]:
    """Rows of the browser page."""
    raw = _part("color")
    with served_page(folder) as (_, driver, address):
        for method in PAGE:
            with opened(driver, folder / method, f"{address}?threads=2", method) as page:
                send(page, "part.png", bytes(imagecodecs.png_encode(raw)))
                layers = read_exr_layers(fetch(page, "exr", folder))
            diffuse, specular = (
                np.stack([layers[f"{name}.{c}"] for c in "RGB"], -1) for name in ("diffuse", "specular")
            )
            case = f"{method}, colour, half resolution"
            yield from _from_the_command(
                case, "browser page", (diffuse, specular), _separate(raw, method, "color", False)
            )


def _from_the_command(case: str, program: str, found: Images, out: polsep.SeparatedFrame) -> Iterator[Row]:
    """Rows of differences from `polsep separate`."""
    truth = (out.diffuse, out.specular)
    yield Row("agreement", case, program, "from polsep separate", _largest(found, truth), "white")
    beyond = np.any([np.abs(a - b).max(axis=-1) > PROMISED for a, b in zip(found, truth, strict=True)], axis=0)
    yield Row("agreement", case, program, "pixels beyond 0.002 of it", 100 * float(beyond.mean()), "%")
    filled = 100 * out.report["filled_under_highlights"]
    yield Row("agreement", case, program, "pixels filled under highlights", filled, "%")


def _largest(found: Images, truth: Images) -> float:
    """The largest difference of both images."""
    return max(float(np.abs(a - b).max()) for a, b in zip(found, truth, strict=True))
