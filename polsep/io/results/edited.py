"""What editing reads and writes as files: recipes, and one edited frame, whole or not at all.

An edited frame is DIR/STEM.exr with the layers diffuse, specular and combined (float32, ZIP), DIR/STEM.png, the edited
picture in sRGB, and the sidecar DIR/STEM.json.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.exr import encode_exr
from polsep.io.results.outputs import (
    UNITS,
    encode_png,
    planned_outputs,
    refuse_targets,
    require_finite,
    version_text,
    write_all,
    write_with_sidecar,
)
from polsep.io.store.errors import naming
from polsep.io.store.whole import replace_bytes, replace_text


class EditedFrame(NamedTuple):
    """Linear float32 ``layers [h, w, C]`` by name, ``preview`` as sRGB ``uint8 [h, w, 3]``, and what is ``said``."""

    layers: Mapping[str, NDArray[np.float32]]
    preview: NDArray[np.uint8]
    said: Mapping[str, Any]


def read_recipe_text(path: Path) -> str:
    """The text of a recipe. Raises InputError."""
    with naming(path):
        return path.read_text(encoding="utf-8")


def write_recipe_text(path: Path, text: str, overwrite: bool) -> None:
    """Write a recipe as a whole. Raises OutputError where one is there and ``overwrite`` is False."""
    refuse_targets(path.parent, [path], overwrite)
    replace_text(path, text)


def write_recipe(folder: Path, stem: str, text: str, images: Mapping[str, Path]) -> Path:
    """Write a recipe into a new folder, with the images that it names beside it; a ZIP archive of all if there are any.

    Unpacked anywhere, `polsep edit --recipe` finds them.
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


def edited_targets(directory: Path, stem: str) -> list[Path]:
    """The files of one edited frame. Raises OutputError where ``stem`` is no plain file name."""
    exr, *_ = planned_outputs(directory, stem, "exr")
    return [exr, exr.with_name(f"{stem}.png"), exr.with_name(f"{stem}.json")]


def write_edited(frame: EditedFrame, directory: Path, stem: str, overwrite: bool) -> list[Path]:
    """Write a frame's files; their paths. All or nothing. Raises OutputError."""
    targets = edited_targets(directory, stem)
    refuse_targets(directory, targets, overwrite)
    require_finite(frame.layers)
    write_all(targets, stem, lambda folder: _stage(frame, folder, stem))
    return targets


def _stage(frame: EditedFrame, folder: Path, stem: str) -> None:
    """Every file of a frame, the sidecar last."""
    units = {layer: UNITS[layer] for layer in frame.layers}
    notes = {"polsepVersion": version_text(), **{f"{layer}Units": unit for layer, unit in units.items()}}
    planes = {
        f"{layer}.{color}": image[..., k]
        for layer, image in frame.layers.items()
        for k, color in enumerate("RGB" if image.shape[2] == 3 else "Y")
    }
    encoded: list[tuple[str, bytes | memoryview]] = [
        (f"{stem}.exr", encode_exr(planes, notes)),
        (f"{stem}.png", encode_png(frame.preview)),
    ]
    shape = list(next(iter(frame.layers.values())).shape)
    write_with_sidecar(folder, stem, encoded, {**frame.said, "shape": shape, "units": units})


def write_preview(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write sRGB ``uint8 [h, w, 3]`` as PNG, replaced as a whole."""
    replace_bytes(path, encode_png(pixels))
