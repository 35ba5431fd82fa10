"""Triangle meshes in NumPy, without torch: ``faces [F, 3]`` of ``vertices [V, 3]``, their normals and loose parts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Connected parts of a mesh with less than this share of its triangles are loose fragments.
SMALLEST_PART = 0.01


def area_vectors(vertices: Floats, faces: Integers) -> Floats:
    """Vectors ``[F, 3]`` along the triangles' normals, of twice their areas."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def smooth_normals(vertices: Floats, faces: Integers, point: Integers | None = None) -> Floats:
    """Unit normals ``[V, 3]``: means over a vertex's triangles by area; +z where it has none.

    ``point [V]``: vertices of one number from 0 on count as one, as over a seam; None: every vertex is its own.
    """
    point = np.arange(len(vertices)) if point is None else point
    weighted = area_vectors(vertices, faces)
    total = np.zeros((point.max() + 1, 3))
    for k in range(3):
        np.add.at(total, point[faces[:, k]], weighted)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])[point]


def without_fragments(faces: Integers) -> Integers:
    """The triangles without loose fragments (`SMALLEST_PART`)."""
    if not len(faces):
        return faces
    start, end = np.concatenate([faces[:, :2], faces[:, 1:]]).T  # two edges connect the corners of a triangle
    count = int(faces.max()) + 1
    edges = coo_array((np.ones(len(start), np.bool_), (start, end)), (count, count))
    owner = connected_components(edges, directed=False)[1][faces[:, 0]]
    kept: Integers = faces[np.bincount(owner)[owner] / len(faces) >= SMALLEST_PART]
    return kept
