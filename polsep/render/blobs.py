"""Random smooth bodies: ellipsoids that grow out of each other and melt together, with bumps, as a closed mesh.

Unions of solids (`render.shapes`) meet in creases; animals, figures and fruits do not. A body is the zero level of the
smooth minimum of distances to ellipsoids (Quilez 2013), displaced by random waves and folds, and is meshed by marching
cubes. Half of them stand, +y up, on a foot that is cut flat, as figures do.

Conventions are those of `render.shapes`: centred, about as large as an average random shape. Slots are the patches of a
random Voronoi diagram, so that a body has several materials. Needs the extra ``train``.
"""

from __future__ import annotations

import numpy as np
import torch

from polsep.render.materials import USUAL_SIZE, rotation_rows
from polsep.render.shapes import Floats, Mesh, fitted
from polsep.render.waves import Draw, bumps, draw_one, draw_way, drawn_from, folds

#: Number of ellipsoids, and semi-axes of the first and, relative to the one that they grow out of, of the others.
PARTS, FIRST_AXES, OTHER_AXES = (1, 10), (0.5, 1.1), (0.2, 1.0)
#: Width over which parts melt together, relative to the first one's mean axis; small ones leave creases.
MELTING = (0.02, 0.35)
#: Shares of bodies with folds, and of those that stand; share of the height that is cut off below these.
FOLDED_SHARE, STANDING_SHARE, CUT_OFF = 0.35, 0.5, (0.03, 0.35)
#: Cells along the longest side of the grid, and its margin around the parts.
CELLS, MARGIN = 96, 0.35
#: Number of patches.
PATCHES = (1, 7)


def random_blob(generator: torch.Generator) -> Mesh:
    """Return a random body. Source of the smooth minimum: Quilez 2013, "smooth minimum", exponential form."""
    from skimage.measure import marching_cubes

    draw = drawn_from(generator)
    count = int(torch.randint(PARTS[0], PARTS[1] + 1, (1,), generator=generator))
    axes, turns, centers = [draw(*FIRST_AXES, 3)], [_turn(draw(-1, 1, 4))], [np.zeros(3)]
    for _ in range(count - 1):
        root = int(torch.randint(len(axes), (1,), generator=generator))
        way = draw_way(draw)
        axes.append(draw(*OTHER_AXES, 3) * axes[root].mean())
        turns.append(_turn(draw(-1, 1, 4)))
        centers.append(centers[root] + turns[root] @ (axes[root] * way) + 0.4 * axes[-1].mean() * way)
    reach = np.array([a.max() for a in axes])[:, None] + MARGIN
    low, high = (np.array(centers) - reach).min(axis=0), (np.array(centers) + reach).max(axis=0)
    step = float((high - low).max()) / CELLS
    grid = np.stack(np.meshgrid(*(np.arange(a, b, step) for a, b in zip(low, high, strict=True)), indexing="ij"), -1)
    width = float(draw(*MELTING)[0]) * axes[0].mean()
    near = np.zeros(grid.shape[:3])
    for size, turn, center in zip(axes, turns, centers, strict=True):
        scaled = ((grid - center) @ turn) / size
        length = np.sqrt((scaled**2).sum(-1))
        slope = np.sqrt(((scaled / size) ** 2).sum(-1))  # the distance to first order: length (length - 1) / |gradient|
        near += np.exp(-np.clip(length * (length - 1) / np.maximum(slope, 1e-6) / width, -30, 30))
    field = _relieved(-width * np.log(near), grid, float((high - low).max()), draw)
    field = np.pad(field, 1, constant_values=step)  # what reaches beyond the grid ends there, closed
    meshed = marching_cubes(field, 0.0, spacing=(step,) * 3, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    vertices, faces, normals, _ = meshed
    placed = fitted(vertices, USUAL_SIZE).astype(np.float64)
    outward, faces = -normals.astype(np.float64), np.ascontiguousarray(faces[:, ::-1], np.int64)
    return patched(Mesh(placed, outward, np.zeros((len(placed), 2)), faces, np.zeros(len(faces), np.int64)), draw)


def _relieved(field: Floats, grid: Floats, size: float, draw: Draw) -> Floats:
    """The field of a body of a ``size`` with bumps, folds and a flat foot."""
    field = field + size * bumps(grid / size, draw)
    if draw_one(draw) < FOLDED_SHARE:
        field += size * folds(grid / size, draw)
    share, stands = draw_one(draw, CUT_OFF), draw_one(draw) < STANDING_SHARE
    inside = grid[..., 1][field < 0]
    if not stands or not inside.size:
        return field
    foot = inside.min() + share * (inside.max() - inside.min())
    found: Floats = np.maximum(field, foot - grid[..., 1])
    return found


def patched(mesh: Mesh, draw: Draw) -> Mesh:
    """The mesh with a slot per patch, unit normals and no (u, v); vertices are not shared between slots."""
    count = round(float(draw(PATCHES[0] - 0.49, PATCHES[1] + 0.49)[0]))
    seeds = mesh.vertices[(draw(0, 1, count) * (len(mesh.vertices) - 1)).astype(np.int64)]
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    owner = np.linalg.norm(middles[:, None] - seeds, axis=-1).argmin(axis=1)
    _, owner = np.unique(owner, return_inverse=True)
    corners = mesh.faces + owner[:, None] * len(mesh.vertices)
    used, numbered = np.unique(corners, return_inverse=True)
    origin = used % len(mesh.vertices)
    length = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    unit = (mesh.normals / np.where(length > 0, length, 1))[origin]
    return Mesh(mesh.vertices[origin], unit, np.zeros((len(used), 2)), numbered.reshape(-1, 3), owner.astype(np.int64))


def _turn(quaternion: Floats) -> Floats:
    """The rotation matrix of a quaternion of any length."""
    return np.array(rotation_rows(*(quaternion / max(float(np.linalg.norm(quaternion)), 1e-6))))
