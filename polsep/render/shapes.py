"""Random meshes after Xu et al. 2018 (Deep image-based relighting from optimal sparse samples): overlapping solids.

A shape is the union of 1 to 9 ellipsoids, boxes and cylinders in random poses, each displaced by random height fields
that vanish at the borders of its faces, so that every primitive stays closed. The faces of every primitive are material
slots of their own. Meshes interpenetrate; nothing is cut.

Conventions: lengths in scene units, shapes are centred on their bounding box; triangles wind counter-clockwise seen
from outside; (u, v) in [0, 1]^2 per slot. Random draws take a generator and are the same on every machine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample, interpolate, pad

from polsep.render.triangles import area_vectors, smooth_normals

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: Probabilities of 1 to 9 primitives.
COUNT_WEIGHTS = (1, 2, 3, 7, 10, 7, 3, 2, 1)
#: Semi-axes of primitives, and the largest height relative to twice the smallest of them.
SMALLEST_AXIS, LARGEST_AXIS, LARGEST_HEIGHT = 0.25, 2.0, 0.2
#: Share of flat faces.
FLAT_SHARE = 0.1
#: Sides of the height field's random grid, of its smooth version, and of its table.
COARSE, SMOOTH, FINE = 5, 30, 36
#: Cells of the grids of an ellipsoid, of one face of a box, of a cylinder's side and of its caps; a cap's rim has as
#: many cells as the side has columns.
ELLIPSOID_GRID, FACE_GRID, SIDE_GRID, CAP_GRID = (50, 100), (50, 50), (50, 200), (50, 50)


@dataclass(frozen=True)
class Mesh:
    """Triangles ``faces [F, 3]`` of ``vertices [V, 3]`` with unit ``normals [V, 3]`` and ``uv [V, 2]``.

    ``slots [F]``: material slot of every triangle, from 0 on. Vertices are not shared between slots.
    """

    vertices: Floats
    normals: Floats
    uv: Floats
    faces: Integers
    slots: Integers

    @property
    def slot_count(self) -> int:
        """Number of material slots."""
        return int(self.slots.max()) + 1


def random_mesh(generator: torch.Generator) -> Mesh:
    """Return a random centred shape. Source: Xu et al. 2018, with the order of draws of this project."""
    weights = torch.tensor(COUNT_WEIGHTS, dtype=torch.float64)
    count = 1 + int(torch.multinomial(weights, 1, generator=generator))
    shape: Mesh | None = None
    for _ in range(count):
        axes = random_axes(generator)
        reach = float(axes.max())  # half of the longest axis, which is 2 x the largest semi-axis
        added = _random_pose(random_primitive(axes, generator), reach, generator)
        shape = added if shape is None else join(_random_pose(shape, reach, generator), added)
    assert shape is not None
    center = (shape.vertices.min(axis=0) + shape.vertices.max(axis=0)) / 2
    return replace(shape, vertices=shape.vertices - center)


def random_axes(generator: torch.Generator) -> Floats:
    """Return three semi-axes, uniform between `SMALLEST_AXIS` and `LARGEST_AXIS`."""
    return _uniform(3, SMALLEST_AXIS, LARGEST_AXIS, generator)


def random_primitive(axes: Floats, generator: torch.Generator) -> Mesh:
    """Return an ellipsoid, box or cylinder of these semi-axes with random height fields."""
    build = (ellipsoid, box, cylinder)[int(torch.randint(3, (1,), generator=generator))]
    largest = 2 * LARGEST_HEIGHT * float(axes.min())
    heights = [random_heights(h, generator) for h in _uniform(6, 0.0, largest, generator)]
    return build(axes, heights)


def random_heights(largest: float, generator: torch.Generator) -> Floats:
    """Return a random height field ``[36, 36]`` over (u, v): at most about ``largest``, 0 at the border; or flat."""
    flat = float(torch.rand(1, generator=generator, dtype=torch.float64)) < FLAT_SHARE
    coarse = torch.from_numpy(_uniform(COARSE * COARSE, -largest, largest, generator)).view(1, 1, COARSE, COARSE)
    if flat:
        return np.zeros((FINE, FINE))
    smooth = interpolate(pad(coarse, (1, 1, 1, 1)), size=(SMOOTH, SMOOTH), mode="bicubic", align_corners=True)
    smooth = pad(smooth[..., 1:-1, 1:-1], (1, 1, 1, 1))
    heights: Floats = interpolate(smooth, size=(FINE, FINE), mode="bilinear", align_corners=True)[0, 0].numpy()
    return heights


def look_up(heights: Floats, uv: Floats) -> Floats:
    """Return a height field at points ``uv [..., 2]``, bilinear; u runs along its rows."""
    points = torch.from_numpy(2 * uv.reshape(1, -1, 1, 2)[..., ::-1] - 1)
    table = torch.from_numpy(heights)[None, None]
    return grid_sample(table, points, align_corners=True, padding_mode="border")[0, 0].numpy().reshape(uv.shape[:-1])


def ellipsoid(axes: Floats, heights: list[Floats]) -> Mesh:
    """Return an ellipsoid, one slot; u is the polar angle from +y, v the azimuth."""
    uv = uv_grid(*ELLIPSOID_GRID)
    polar, azimuth = math.pi * uv[..., 0], 2 * math.pi * uv[..., 1]
    sine = np.sin(polar)
    direction = np.stack([sine * np.cos(azimuth), np.cos(polar), -sine * np.sin(azimuth)], axis=-1)
    return _patch(direction * axes, direction / axes, uv, heights[0])


def box(axes: Floats, heights: list[Floats]) -> Mesh:
    """Return a box of half sizes ``axes``, one slot per face in the order +x, -x, +y, -y, +z, -z."""
    uv = uv_grid(*FACE_GRID)
    patches = []
    for face, height in enumerate(heights[:6]):
        axis, sign = face // 2, 1 - 2 * (face % 2)
        normal = np.zeros(3)
        normal[axis] = sign
        first = np.roll(np.eye(3)[axis], 1)
        second = np.cross(normal, first)
        points = (2 * uv[..., :1] - 1) * first + (2 * uv[..., 1:] - 1) * second + normal
        patches.append(_patch(points * axes, np.broadcast_to(normal, points.shape), uv, height))
    return join(*patches)


def cylinder(axes: Floats, heights: list[Floats]) -> Mesh:
    """Return an elliptic cylinder about y, three slots: side, upper and lower cap. u of the side runs downward."""
    uv = uv_grid(*SIDE_GRID)
    azimuth = 2 * math.pi * uv[..., 1]
    around = np.stack([np.cos(azimuth), np.zeros_like(azimuth), -np.sin(azimuth)], axis=-1)
    side = around + (1 - 2 * uv[..., :1]) * np.array([0.0, 1.0, 0.0])
    patches = [_patch(side * axes, around / axes, uv, heights[0])]
    uv = uv_grid(*CAP_GRID)
    disk = _square_to_disk(2 * uv - 1)
    for sign, height in ((1.0, heights[1]), (-1.0, heights[2])):
        points = np.stack([disk[..., 1], np.full(disk.shape[:-1], sign), sign * disk[..., 0]], axis=-1)
        normal = np.broadcast_to(np.array([0.0, sign, 0.0]), points.shape)
        patches.append(_patch(points * axes, normal, uv, height))
    return join(*patches)


def join(*meshes: Mesh) -> Mesh:
    """Return all meshes as one, with consecutive slots."""
    first_vertex = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    first_slot = np.cumsum([0, *(mesh.slot_count for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.uv for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first_vertex, strict=False)]),
        np.concatenate([mesh.slots + start for mesh, start in zip(meshes, first_slot, strict=False)]),
    )


def moved(mesh: Mesh, rotation: Floats, translation: Floats) -> Mesh:
    """Return the mesh rotated by a matrix ``[3, 3]`` about the origin, then moved."""
    return replace(mesh, vertices=mesh.vertices @ rotation.T + translation, normals=mesh.normals @ rotation.T)


def rotation_about(axis: int, angle: float) -> Floats:
    """Return the matrix ``[3, 3]`` that rotates about x, y or z (0, 1, 2), counter-clockwise seen from its end."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    turn = np.eye(3)
    turn[first, first] = turn[second, second] = math.cos(angle)
    turn[second, first] = math.sin(angle)
    turn[first, second] = -turn[second, first]
    return turn


def fitted(vertices: Floats, size: float) -> Floats:
    """Return vertices ``[V, 3]`` centred on their bounding box, whose longest side becomes ``size``."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    found: Floats = (vertices - (low + high) / 2) * (size / float((high - low).max()))
    return found


def _uniform(count: int, low: float, high: float, generator: torch.Generator) -> Floats:
    drawn: Floats = (low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)).numpy()
    return drawn


def _random_pose(mesh: Mesh, reach: float, generator: torch.Generator) -> Mesh:
    """Rotated by 0 to 180 degrees about x, y and z, then moved by up to ``reach`` along each."""
    rotation = np.eye(3)
    for axis, angle in enumerate(_uniform(3, 0.0, math.pi, generator)):
        rotation = rotation_about(axis, angle) @ rotation
    return moved(mesh, rotation, _uniform(3, 0.0, reach, generator))


def uv_grid(rows: int, cols: int) -> Floats:
    """Return (u, v) of the corners of rows x cols cells, ``[rows + 1, cols + 1, 2]``."""
    return np.stack(np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, cols + 1), indexing="ij"), axis=-1)


def _square_to_disk(square: Floats) -> Floats:
    """The disk's point of a point of [-1, 1]^2; squares become circles (Shirley and Chiu 1997)."""
    x, y = square[..., 0], square[..., 1]
    wide = np.abs(x) > np.abs(y)
    radius = np.where(wide, x, y)
    ratio = np.divide(np.where(wide, y, x), radius, out=np.zeros_like(radius), where=radius != 0)
    angle = np.where(wide, math.pi / 4 * ratio, math.pi / 2 - math.pi / 4 * ratio)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _patch(points: Floats, normals: Floats, uv: Floats, heights: Floats) -> Mesh:
    """One slot: a grid of points ``[n, m, 3]``, displaced along its normals by a height field, in triangles."""
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return smooth_patch(points + look_up(heights, uv)[..., None] * unit, uv)


def smooth_patch(points: Floats, uv: Floats) -> Mesh:
    """Return one slot of a grid of points ``[n, m, 3]``: down and right along it run counter-clockwise from outside."""
    vertices = points.reshape(-1, 3)
    rows, cols = uv.shape[0] - 1, uv.shape[1] - 1
    corner = (np.arange(rows)[:, None] * (cols + 1) + np.arange(cols)).reshape(-1)
    right, below = corner + 1, corner + cols + 1
    faces = np.concatenate([np.stack([corner, below, right], 1), np.stack([right, below, below + 1], 1)])
    faces = faces[np.linalg.norm(area_vectors(vertices, faces), axis=1) > 2e-12]  # but at the poles of a grid
    _, point = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)  # one on both sides of a seam
    smooth = smooth_normals(vertices, faces, point.reshape(-1))
    return Mesh(vertices, smooth, uv.reshape(-1, 2), faces, np.zeros(len(faces), np.int64))
