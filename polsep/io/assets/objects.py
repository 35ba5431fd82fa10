"""Readers of the files of test scenes: triangle meshes, normal maps, depths, masks and linear photographs.

Every reader takes a path and returns arrays in the frame of `polsep.render.sphere_tracing`: x right, y up, z toward the
viewer. Rows of images grow downward. All raise ValueError, in one line, on what they cannot read. Needs the extra
``render``.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import trimesh
from numpy.typing import NDArray

from polsep.io.raw.png import read_png
from polsep.io.store.errors import decoding
from polsep.render.shapes import Floats, Mesh
from polsep.render.triangles import smooth_normals, without_fragments

#: Endings of files of meshes.
MESHES = (".glb", ".obj", ".off", ".ply", ".stl")
#: Vertices closer than this share of the mesh's radius are one vertex.
SAME_VERTEX = 1e-6


def hash_files(paths: list[Path]) -> str:
    """The sha256 of the bytes of some files, one after the other. Raises ValueError that names the absent ones."""
    absent = [str(path) for path in paths if not path.is_file()]
    if absent:
        raise ValueError(f"expected the files of a test scene, found none at {', '.join(absent)}")
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def read_mesh(path: Path) -> Mesh:
    """A mesh file as one material slot, centred on its bounding box and scaled into the unit sphere; no (u, v).

    Vertices at one place are one vertex, so that normals are smooth over the seams of a texture; normals are means over
    triangles by area. Loose fragments (`triangles.SMALLEST_PART`) are dropped. The file's axes are kept.
    """
    with decoding(path.suffix.lstrip(".").upper()):
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    vertices, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    if not len(faces):
        raise ValueError(f"expected triangles in {path}, found none")
    vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    vertices = vertices / np.linalg.norm(vertices, axis=1).max()
    _, first, same = np.unique(np.round(vertices / SAME_VERTEX), axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[first], same.reshape(-1)[faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces = without_fragments(faces)
    if not len(faces):
        raise ValueError(f"expected connected triangles in {path}, found loose fragments only")
    normals = smooth_normals(vertices, faces)
    return Mesh(vertices, normals, np.zeros((len(vertices), 2)), faces, np.zeros(len(faces), np.int64))


def list_meshes(folder: Path) -> list[Path]:
    """The files of `MESHES` in a folder, in the order of their names. Raises ValueError where there are none."""
    found = folder.iterdir() if folder.is_dir() else ()
    paths = sorted(path for path in found if path.suffix.lower() in MESHES)
    if not paths:
        raise ValueError(f"expected meshes ({', '.join(MESHES)}) in {folder}, found none")
    return paths


def read_photograph(path: Path) -> NDArray[np.float32]:
    """A linear PNG of 8 or 16 bits as ``[3, H, W]`` in [0, 1]."""
    codes = next(iter(read_png(path))).array
    if codes.ndim != 3:
        raise ValueError(f"expected an RGB picture in {path}, found shape {codes.shape}")
    return np.ascontiguousarray(codes.transpose(2, 0, 1), dtype=np.float32) / np.float32(np.iinfo(codes.dtype).max)


def read_mask(path: Path) -> NDArray[np.bool_]:
    """A PNG mask as bool ``[H, W]``, True where it is not black."""
    codes = next(iter(read_png(path))).array
    return np.asarray(codes > 0 if codes.ndim == 2 else codes.max(axis=-1) > 0)


def read_normal_map(path: Path) -> Floats:
    """Unit normals ``[H, W, 3]`` of a 16-bit RGB PNG of codes c, n = 2 c / 65535 - 1; any unit vector outside the mask.

    x right, y up, z to the camera: that is the frame of the DiLiGenT maps, as their depths confirm.
    """
    codes = next(iter(read_png(path))).array
    if codes.dtype != np.uint16 or codes.ndim != 3:
        raise ValueError(f"expected a 16-bit RGB normal map in {path}, found {codes.dtype} {codes.shape}")
    normals = 2 * codes.astype(np.float64) / 65535 - 1
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def read_depth(path: Path) -> Floats:
    """The only image ``[H, W]`` of an NPZ or MATLAB file, NaN where there is none."""
    with decoding(path.suffix.lstrip(".").upper()):
        if path.suffix == ".mat":
            arrays = {name: array for name, array in scipy.io.loadmat(path).items() if not name.startswith("__")}
        else:
            with np.load(path, allow_pickle=False) as archive:
                arrays = dict(archive)
    images = [np.asarray(array) for array in arrays.values() if np.ndim(array) == 2]
    if len(images) != 1:
        raise ValueError(f"expected one image in {path}, found {len(images)}")
    return images[0].astype(np.float64)


def read_intrinsics(path: Path) -> Floats:
    """The 3x3 camera matrix of a text file, in pixels, columns to the right and rows down."""
    with decoding("camera matrix"):
        matrix = np.loadtxt(path)
    if matrix.shape != (3, 3):
        raise ValueError(f"expected a 3x3 camera matrix in {path}, found shape {matrix.shape}")
    return matrix
