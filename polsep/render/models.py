"""Random objects from triangle meshes, such as scans and models: stretched, turned, tilted, with patches of materials.

Normals are smooth but for creases. Neighbouring triangles of models are often wound against each other, so that sides
are not told apart: normals face the camera when they are looked up (`render.raycast`).

Conventions are those of `render.shapes`: centred, about as large as an average random shape. Meshes stand, +y up.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch

from polsep.render.blobs import patched
from polsep.render.materials import USUAL_SIZE
from polsep.render.shapes import Floats, Integers, Mesh, fitted, rotation_about
from polsep.render.triangles import area_vectors
from polsep.render.waves import draw_one, drawn_from

#: Triangles that meet at a larger angle meet in a crease.
CREASE_DEG = 40.0
#: Largest stretch or shrinking along an axis, and largest tilt.
STRETCH, TILT_DEG = 1.28, 10.0


def random_model(meshes: Sequence[Mesh], generator: torch.Generator) -> Mesh:
    """Return one of some meshes as another object: other proportions, any turn about +y, a small tilt about x."""
    draw = drawn_from(generator)
    mesh = meshes[int(draw_one(draw, (0, len(meshes))))]
    stretch = np.exp(draw(-math.log(STRETCH), math.log(STRETCH), 3))
    turn, tilt = math.radians(draw_one(draw, (0, 360))), math.radians(draw_one(draw, (-TILT_DEG, TILT_DEG)))
    turned = rotation_about(0, tilt) @ rotation_about(1, turn)
    placed = fitted((mesh.vertices * stretch) @ turned.T, USUAL_SIZE)
    return patched(replace(mesh, vertices=placed, normals=(mesh.normals / stretch) @ turned.T), draw)


def creased(mesh: Mesh) -> Mesh:
    """A mesh whose normals are means by area over those triangles at a vertex that meet at less than `CREASE_DEG`.

    Triangles that are wound against each other count as if they were not; corners share no
    vertices, and triangles without area are left out.
    """
    weighted = area_vectors(mesh.vertices, mesh.faces)
    area = np.linalg.norm(weighted, axis=1)
    kept = area > 0
    weighted, corners = weighted[kept], mesh.faces[kept].reshape(-1)
    unit = weighted / area[kept, None]
    total = np.zeros((len(corners), 3))
    for mine, other in _corner_pairs(corners):
        cosine = (unit[mine // 3] * unit[other // 3]).sum(axis=1)
        near = np.abs(cosine) > math.cos(math.radians(CREASE_DEG))
        total[mine[near]] += weighted[other[near] // 3] * np.sign(cosine[near])[:, None]
    normals: Floats = total / np.linalg.norm(total, axis=1, keepdims=True)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return Mesh(mesh.vertices[corners], normals, mesh.uv[corners], faces, mesh.slots[kept])


def _corner_pairs(corners: Integers) -> Iterator[tuple[Integers, Integers]]:
    """Yield all pairs of corners at one vertex, and each with itself, as arrays that hold no first one twice."""
    order = np.argsort(corners, kind="stable")
    _, first, place, count = np.unique(corners[order], return_index=True, return_inverse=True, return_counts=True)
    first, count = first[place], count[place]
    number = np.arange(len(corners)) - first
    for step in range(int(count.max())):
        some = count > step
        other = first[some] + (number[some] + step) % count[some]
        yield order[some], order[other]
