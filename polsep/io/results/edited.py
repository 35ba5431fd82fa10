"""Files of `polsep edit`: recipes, and one edited frame, written atomically.

An edited frame is DIR/STEM.exr with the layers diffuse, specular and combined (float32, ZIP), and combined once more as
R, G, B, DIR/STEM.png, the edited picture in sRGB, and the sidecar DIR/STEM.json.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.exr import as_planes, encode_exr
from polsep.io.results.separation_writer import TOTAL, UNITS, as_halves, planned_outputs
from polsep.io.results.sidecars import EncodedFile, exr_notes, require_finite, write_with_sidecar
from polsep.io.store.atomic import refuse_existing, replace_bytes, replace_text
from polsep.io.store.errors import naming
from polsep.io.store.image_codecs import encode_png
from polsep.io.store.json_text import read_text


class EditedFrame(NamedTuple):
    """Linear float32 ``layers [h, w, C]``, ``preview`` ``uint8 [h, w, 3]`` in sRGB, ``facts`` of the sidecar."""

    layers: Mapping[str, NDArray[np.float32]]
    preview: NDArray[np.uint8]
    facts: Mapping[str, Any]


def read_recipe_text(path: Path) -> str:
    """The text of a recipe. Raises InputError."""
    with naming(path):
        return read_text(path)


def write_recipe_text(path: Path, text: str, overwrite: bool) -> None:
    """Write a recipe atomically. Raises OutputError where the file exists and ``overwrite`` is False."""
    refuse_existing(path.parent, [path], overwrite)
    replace_text(path, text)


def write_recipe(folder: Path, stem: str, text: str, images: Mapping[str, Path]) -> Path:
    """Write a recipe into a new folder: a JSON file, or a ZIP archive of it and the images that it names.

    `polsep edit --recipe` finds the images beside the unpacked recipe.
    """
    if not images:
        replace_text(folder / f"{stem}.json", text)
        return folder / f"{stem}.json"
    path = folder / f"{stem}.zip"
    with zipfile.ZipFile(path, "x", zipfile.ZIP_STORED) as archive:
        archive.writestr(f"{stem}.json", text)
        for name, image in images.items():
            archive.write(image, name)
    return path


def write_edited(frame: EditedFrame, directory: Path, stem: str, overwrite: bool) -> list[Path]:
    """Write a frame's files, which are `planned_outputs` of EXR, atomically; return their paths. Raises OutputError."""
    targets = planned_outputs(directory, stem, "exr")
    refuse_existing(directory, targets, overwrite)
    require_finite(frame.layers)
    shape = list(next(iter(frame.layers.values())).shape)
    units = {layer: UNITS[layer] for layer in frame.layers}
    write_with_sidecar(targets, _encoded_files(frame, stem, units), {**frame.facts, "shape": shape, "units": units})
    return targets


def _encoded_files(frame: EditedFrame, stem: str, units: Mapping[str, str]) -> Iterator[EncodedFile]:
    """The EXR file and the preview."""
    planes: dict[str, NDArray[Any]] = as_planes(frame.layers)
    planes |= {name: as_halves(plane) for name, plane in as_planes({TOTAL: frame.layers["combined"]}).items()}
    yield f"{stem}.exr", encode_exr(planes, exr_notes(units))
    yield f"{stem}.png", encode_png(frame.preview)


def write_preview(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write sRGB ``uint8 [h, w, 3]`` as PNG, atomically."""
    replace_bytes(path, encode_png(pixels))
