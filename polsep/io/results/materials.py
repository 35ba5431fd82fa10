"""One estimated material as files, all of them or none.

NAME.exr holds normal.X/Y/Z, diffuse.R/G/B, roughness.Y and specular.R/G/B (float32, ZIP); NAME_normal.png (y up),
NAME_diffuse.png and NAME_specular.png (sRGB) and NAME_roughness.png (linear, gray) are textures of 8 bits; NAME.glb and
NAME.mtlx are the material for renderers, the latter beside its textures; NAME.png is a preview and NAME.json a sidecar.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.io.assets.gltf import TEXTURES, encode_glb, encode_materialx, specular_scale, texture_pixels
from polsep.io.results.exr import encode_exr
from polsep.io.results.outputs import (
    encode_png,
    planned_outputs,
    refuse_targets,
    require_finite,
    version_text,
    write_all,
    write_with_sidecar,
)

Floats = NDArray[np.float32]

#: Channels of the maps in the EXR file.
CHANNELS = {"normal": "XYZ", "diffuse": "RGB", "roughness": "Y", "specular": "RGB"}
UNITS = {
    "normal": "unit vectors, x right, y up, z toward the camera; PNG: 0 to 255 for -1 to 1",
    "diffuse": "linear reflectance, 0 to 1; PNG: sRGB",
    "roughness": "GGX alpha = roughness^2; PNG: linear",
    "specular": "linear reflectance at normal incidence, 0.04 for glass; PNG: sRGB, over specular_scale",
}


class MaterialFiles(NamedTuple):
    """Maps float32 ``[h, w, C]`` by name, a ``preview`` in sRGB ``uint8 [h, w, 3]``, and what is ``said`` of them."""

    maps: Mapping[str, Floats]
    preview: NDArray[np.uint8]
    said: Mapping[str, Any]


def material_targets(directory: Path, name: str) -> list[Path]:
    """The files of a material. Raises OutputError where ``name`` is no plain file name."""
    exr, *_ = planned_outputs(directory, name, "exr")
    textures = [exr.with_name(f"{name}_{texture}.png") for texture in TEXTURES]
    return [exr, *textures, *(exr.with_name(f"{name}.{kind}") for kind in ("glb", "mtlx", "png", "json"))]


def write_material(files: MaterialFiles, directory: Path, name: str, overwrite: bool) -> list[Path]:
    """Write a material's files; their paths. All or nothing. Raises OutputError."""
    targets = material_targets(directory, name)
    refuse_targets(directory, targets, overwrite)
    require_finite(files.maps)
    write_all(targets, name, lambda folder: _stage(files, folder, name))
    return targets


def _stage(files: MaterialFiles, folder: Path, name: str) -> None:
    """Every file of a material, the sidecar last."""
    planes = {f"{kind}.{c}": files.maps[kind][..., k] for kind, names in CHANNELS.items() for k, c in enumerate(names)}
    notes = {"polsepVersion": version_text(), **{f"{kind}Units": unit for kind, unit in UNITS.items()}}
    textures, scale = texture_pixels(files.maps), specular_scale(files.maps["specular"])
    plain = re.sub(r"\W", "_", name)
    named = {texture: f"{name}_{texture}.png" for texture in TEXTURES}
    encoded: list[tuple[str, bytes | memoryview]] = [(f"{name}.exr", encode_exr(planes, notes))]
    for texture, pixels in textures.items():
        encoded.append((named[texture], encode_png(pixels[..., 0] if texture == "roughness" else pixels)))
    encoded.append((f"{name}.glb", encode_glb(textures, scale, plain)))
    encoded.append((f"{name}.mtlx", encode_materialx(named, scale, plain).encode()))
    encoded.append((f"{name}.png", encode_png(files.preview)))
    shape = list(files.maps["normal"].shape[:2])
    write_with_sidecar(folder, name, encoded, {**files.said, "shape": shape, "specular_scale": scale, "units": UNITS})
