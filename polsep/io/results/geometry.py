"""What `polsep geometry` writes, all of it or nothing.

DIR/STEM.exr (normal.X/Y/Z, albedo.R/G/B, depth.Z, mask.Y, float32), DIR/STEM_normals.png (16 bit, n = 2 c / 65535 - 1),
DIR/STEM.glb or .ply, DIR/STEM.png to look at, DIR/STEM.mp4 if a film is asked for, and the sidecar DIR/STEM.json.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.exr import encode_exr
from polsep.io.results.outputs import (
    OutputError,
    encode_png,
    planned_outputs,
    require_finite,
    version_text,
    write_all,
    write_with_sidecar,
)

#: Mesh files by name.
MESHES = ("glb", "ply")
#: What the numbers in the files mean.
UNITS = {
    "normal": "unit vectors: x right, y up, z to the camera; 0 outside the mask",
    "albedo": "linear light of a surface that faces light and camera, relative",
    "depth": "away from the camera: in pixels around a mean of 0, or relative to a mean of 1 with a field of view;"
    " 0 outside the mask",
    "mask": "1 on the object, else 0",
}


@dataclass(frozen=True)
class ShapeFiles:
    """Maps ``normals [h, w, 3]``, ``albedo [h, w, C]``, ``depth`` and ``mask [h, w]``; the rest is encoded already."""

    normals: NDArray[np.float64]
    albedo: NDArray[np.float64]
    depth: NDArray[np.float64]
    mask: NDArray[np.bool_]
    mesh: bytes
    preview: NDArray[np.uint8]
    film: bytes | None
    said: Mapping[str, Any]


def shape_targets(directory: Path, stem: str, mesh: str, film: bool) -> list[Path]:
    """The files of one shape, with a ``film`` or without.

    Raises OutputError where ``stem`` is no plain name or ``mesh`` is not of `MESHES`.
    """
    if mesh not in MESHES:
        raise OutputError(f"expected a mesh of {' or '.join(MESHES)}, found {mesh!r}")
    planned_outputs(directory, stem, "exr")
    ends = (".exr", "_normals.png", f".{mesh}", ".png", *((".mp4",) if film else ()), ".json")
    return [directory / f"{stem}{end}" for end in ends]


def write_shape(shape: ShapeFiles, targets: list[Path], stem: str) -> None:
    """Write the files of `shape_targets`. Raises OutputError."""
    write_all(targets, stem, lambda folder: _stage(shape, folder, targets, stem))


def _stage(shape: ShapeFiles, folder: Path, targets: list[Path], stem: str) -> None:
    """Every file, the sidecar last."""
    planes: dict[str, NDArray[Any]] = {f"normal.{axis}": shape.normals[..., k] for k, axis in enumerate("XYZ")}
    colors = "RGB" if shape.albedo.shape[2] == 3 else "Y"
    planes |= {f"albedo.{color}": shape.albedo[..., k] for k, color in enumerate(colors)}
    planes |= {"depth.Z": np.where(shape.mask, shape.depth, 0), "mask.Y": shape.mask.astype(np.float64)}
    require_finite(planes)
    notes = {"polsepVersion": version_text(), **{f"{layer}Units": unit for layer, unit in UNITS.items()}}
    floats = {name: plane.astype(np.float32) for name, plane in planes.items()}
    codes = np.rint((shape.normals + 1) / 2 * 65535).astype(np.uint16)
    data: list[bytes | memoryview] = [
        encode_exr(floats, notes),
        encode_png(codes),
        shape.mesh,
        encode_png(shape.preview),
        *(() if shape.film is None else (shape.film,)),
    ]
    names = [path.name for path in targets]
    said = {**shape.said, "shape": list(shape.mask.shape), "units": UNITS}
    write_with_sidecar(folder, stem, zip(names[:-1], data, strict=True), said)
