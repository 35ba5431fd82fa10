"""One shape as files: maps, a mesh with colours, a preview; written atomically by `polsep geometry` and `polsep shape`.

DIR/STEM.exr (normal.X/Y/Z, albedo.R/G/B, depth.Z, mask.Y and further maps, float32), DIR/STEM_normals.png (16 bit,
n = 2 c / 65535 - 1), DIR/STEM.glb or .ply if there is a mesh, the preview DIR/STEM.png, DIR/STEM.mp4 if a film is asked
for, DIR/STEM.html of `relight_page` from one frame, and the sidecar DIR/STEM.json.

Meshes have positions, unit normals and colours per vertex; x right, y up, z to the viewer, which is glTF's frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.ply import export_ply
from trimesh.visual import ColorVisuals

from polsep.io.results.exr import as_planes, encode_exr
from polsep.io.results.sidecars import exr_notes, require_finite, require_stem, write_with_sidecar
from polsep.io.store.atomic import OutputError
from polsep.io.store.image_codecs import encode_png
from polsep.physics.srgb import srgb_bytes

#: Mesh files by name; "none" writes no mesh.
MESHES = ("glb", "ply", "none")
#: Meaning of the numbers in the files.
UNITS = {
    "normal": "unit vectors: x right, y up, z to the camera; 0 outside the mask",
    "albedo": "linear light of a surface that faces light and camera, relative",
    "depth": "away from the camera: in pixels around a mean of 0, or relative to a mean of 1 with a field of view;"
    " 0 outside the mask",
    "mask": "1 on the object, else 0",
    "normal_error": "expected deviation of the normals along each of two axes [degrees]",
    "roughness": "GGX sqrt(alpha); see roughness_error",
    "roughness_error": "expected deviation of ln(roughness); from 0.5 on it is unknown",
    "specular": "strength of specular reflections, 1 = a dielectric of index 1.5; see specular_error",
    "specular_error": "expected deviation of ln(specular); from 0.5 on it is unknown",
}


@dataclass(frozen=True)
class ShapeFiles:
    """Maps ``normals [h, w, 3]``, ``albedo [h, w, C]``, ``depth`` and ``mask [h, w]``; ``facts`` for the sidecar.

    ``mesh``, ``film`` and ``page`` are encoded already; they and ``depth`` may be None. ``more``: further maps
    ``[h, w]`` by their names in `UNITS`.
    """

    normals: NDArray[np.float64]
    albedo: NDArray[np.float64]
    depth: NDArray[np.float64] | None
    mask: NDArray[np.bool_]
    mesh: bytes | None
    preview: NDArray[np.uint8]
    film: bytes | None
    facts: Mapping[str, Any]
    more: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    page: bytes | None = None


def shape_targets(directory: Path, stem: str, mesh: str, film: bool, page: bool = False) -> list[Path]:
    """The files of one shape, with a ``film`` and a ``page`` or without.

    Raises OutputError where ``stem`` is no plain name or ``mesh`` is not of `MESHES`.
    """
    if mesh not in MESHES:
        raise OutputError(f"expected a mesh of {' or '.join(MESHES)}, found {mesh!r}")
    require_stem(stem)
    meshes = () if mesh == "none" else (f".{mesh}",)
    ends = (
        ".exr",
        "_normals.png",
        *meshes,
        ".png",
        *((".mp4",) if film else ()),
        *((".html",) if page else ()),
        ".json",
    )
    return [directory / f"{stem}{end}" for end in ends]


def write_shape(shape: ShapeFiles, targets: Sequence[Path]) -> None:
    """Write the files of `shape_targets` atomically. Raises OutputError."""
    names = [path.name for path in targets[:-1]]
    files = zip(names, _encoded_files(shape), strict=True)
    units = {name: text for name, text in UNITS.items() if name in _map_names(shape)}
    write_with_sidecar(targets, files, {**shape.facts, "shape": list(shape.mask.shape), "units": units})


def _map_names(shape: ShapeFiles) -> list[str]:
    """Names of the maps that there are."""
    return ["normal", "albedo", *(["depth"] if shape.depth is not None else []), "mask", *shape.more]


def _encoded_files(shape: ShapeFiles) -> Iterator[bytes | memoryview]:
    """Contents of the files in the order of `shape_targets`."""
    planes: dict[str, NDArray[Any]] = {f"normal.{axis}": shape.normals[..., k] for k, axis in enumerate("XYZ")}
    planes |= as_planes({"albedo": shape.albedo})
    if shape.depth is not None:
        planes["depth.Z"] = np.where(shape.mask, shape.depth, 0)
    planes |= {"mask.Y": shape.mask.astype(np.float64)} | {f"{name}.Y": plane for name, plane in shape.more.items()}
    require_finite(planes)
    notes = exr_notes({name: UNITS[name] for name in _map_names(shape)})
    yield encode_exr({name: plane.astype(np.float32) for name, plane in planes.items()}, notes)
    yield encode_png(np.rint((shape.normals + 1) / 2 * 65535).astype(np.uint16))
    if shape.mesh is not None:
        yield shape.mesh
    yield encode_png(shape.preview)
    yield from (part for part in (shape.film, shape.page) if part is not None)


def encode_glb(
    vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike, roughness: float = 1.0
) -> bytes:
    """A GLB file of one non-metallic mesh; ``[V, 3]`` thrice, and triangles ``[F, 3]``. Raises ValueError.

    Colours are linear light in [0, 1] as float32, as glTF's COLOR_0 may be.
    Note: trimesh writes vertex colours in 8 bits only, which is too coarse for linear light, so they are given to it as
    an attribute of their own and renamed.
    """
    mesh, light = _mesh(vertices, normals, colors, faces)
    mesh.vertex_attributes["COLOR_0"] = light

    def finish(tree: dict[str, Any]) -> None:
        (primitive,) = tree["meshes"][0]["primitives"]
        primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_COLOR_0")
        primitive["material"] = 0
        matte = {"metallicFactor": 0.0, "roughnessFactor": roughness}
        tree["materials"] = [{"pbrMetallicRoughness": matte, "doubleSided": True}]

    data: bytes = export_glb(mesh, include_normals=True, unitize_normals=False, tree_postprocessor=finish)
    return data


def encode_ply(vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike) -> bytes:
    """A binary little-endian PLY file of the same; colours become 8-bit sRGB, as viewers expect. Raises ValueError."""
    mesh, light = _mesh(vertices, normals, colors, faces)
    mesh.visual = ColorVisuals(mesh, vertex_colors=srgb_bytes(light))
    data: bytes = export_ply(mesh, vertex_normal=True)
    return data


def _mesh(
    vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike
) -> tuple[trimesh.Trimesh, NDArray[np.float32]]:
    """A mesh without colours as trimesh has it, and the colours limited to [0, 1]."""
    points, directions, light = (np.asarray(x, np.float32) for x in (vertices, normals, colors))
    triangles = np.asarray(faces, np.int64)
    shape = (len(points), 3)
    if not len(points) or not all(x.shape == shape and np.isfinite(x).all() for x in (points, directions, light)):
        raise ValueError("expected finite vertices, normals and colours [V, 3], found others")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles) or int(triangles.max()) >= len(points):
        raise ValueError(f"expected triangles of {len(points)} vertices, found {list(triangles.shape)} others")
    return trimesh.Trimesh(points, triangles, vertex_normals=directions, process=False), np.clip(light, 0, 1)
