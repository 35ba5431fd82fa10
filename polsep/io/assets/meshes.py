"""Meshes with colours as files: GLB (glTF 2.0 in one binary) and PLY, encoded in memory.

Positions, unit normals and colours per vertex. Colours are linear light in [0, 1], as glTF's COLOR_0 is; PLY has 8-bit
sRGB, as viewers expect. Axes are x right, y up, z to the viewer, which is glTF's frame.
Source: Khronos Group, glTF 2.0 specification, sections 3.7 and 4; Turk 1994, The PLY polygon file format.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polsep.io.results.previews import srgb

#: glTF's codes: 32-bit floats and unsigned integers, vertex attributes and indices, triangles.
_FLOAT, _UINT, _ATTRIBUTES, _INDICES, _TRIANGLES = 5126, 5125, 34962, 34963, 4
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942


def encode_glb(vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike) -> bytes:
    """A GLB file of one rough, non-metallic mesh; ``[V, 3]`` thrice, and triangles ``[F, 3]``. Raises ValueError."""
    arrays = _checked(vertices, normals, colors, faces)
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    blob = b""
    for array in arrays:
        index = array.dtype == np.uint32
        accessor: dict[str, Any] = {
            "bufferView": len(views),
            "componentType": _UINT if index else _FLOAT,
            "count": len(array),
        }
        if index:
            accessor |= {"count": int(array.size), "type": "SCALAR"}
        else:
            accessor |= {"type": "VEC3", "min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        target = _INDICES if index else _ATTRIBUTES
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes, "target": target})
        accessors.append(accessor)
        blob += array.tobytes()
    matte = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    primitive = {
        "attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2},
        "indices": 3,
        "material": 0,
        "mode": _TRIANGLES,
    }
    scene = {
        "asset": {"version": "2.0", "generator": "polsep"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [{"pbrMetallicRoughness": matte, "doubleSided": True}],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(scene, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(blob)
    head = struct.pack("<3I", _MAGIC, 2, total) + struct.pack("<2I", len(text), _JSON)
    return head + text + struct.pack("<2I", len(blob), _BINARY) + blob


def encode_ply(vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike) -> bytes:
    """A binary little-endian PLY file of the same. Raises ValueError."""
    points, directions, light, triangles = _checked(vertices, normals, colors, faces)
    names = ("x", "y", "z", "nx", "ny", "nz")
    rows = np.empty(len(points), [(name, "<f4") for name in names] + [(c, "u1") for c in ("red", "green", "blue")])
    codes = np.rint(255 * srgb(light)).astype(np.uint8)
    for k, name in enumerate("xyz"):
        rows[name], rows[f"n{name}"] = points[:, k], directions[:, k]
        rows[("red", "green", "blue")[k]] = codes[:, k]
    corners = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, triangles
    header = ["ply", "format binary_little_endian 1.0", "comment polsep", f"element vertex {len(rows)}"]
    header += [f"property float {name}" for name in names]
    header += [f"property uchar {name}" for name in ("red", "green", "blue")]
    header += [f"element face {len(corners)}", "property list uchar int vertex_indices", "end_header"]
    return "\n".join(header).encode() + b"\n" + rows.tobytes() + corners.tobytes()


def _checked(
    vertices: ArrayLike, normals: ArrayLike, colors: ArrayLike, faces: ArrayLike
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Arrays as they are written: float32, colours limited to [0, 1], and uint32."""
    points, directions, light = (np.ascontiguousarray(x, "<f4") for x in (vertices, normals, colors))
    triangles = np.ascontiguousarray(faces, "<u4")
    shape = (len(points), 3)
    if not len(points) or not all(x.shape == shape and np.isfinite(x).all() for x in (points, directions, light)):
        raise ValueError("expected finite vertices, normals and colours [V, 3], found others")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not len(triangles) or int(triangles.max()) >= len(points):
        raise ValueError(f"expected triangles of {len(points)} vertices, found {list(triangles.shape)} others")
    return points, directions, np.clip(light, 0, 1), triangles
