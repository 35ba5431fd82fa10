"""Shadows of a mesh by an irregular z-buffer: exact per point, faster than shadow rays (see `raycast`).

Points are projected toward the light and sorted into the cells of a grid. Every triangle is compared with the points in
the cells that it overlaps: a point is in its shadow when it projects into it and is farther away. Source: Johnson et
al. 2005, The irregular z-buffer; Aila and Laine 2004, Alias-free shadow maps.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.render.rays_kernel import Floats, Pinhole, Triangles

#: Mean number of points per cell of the grid.
POINTS_PER_CELL = 4

_OUTSIDE = np.float32(-1e-5)  # of a triangle's area: neighbours overlap a little, or light would leak through edges
_TINY = np.float32(1e-30)


class Facing(NamedTuple):
    """Points that face a light, projected toward it: ``x``, ``y``, inverse depth ``w``, index of the ``hit [N]``."""

    x: Floats
    y: Floats
    w: Floats
    hit: NDArray[np.int64]

    @classmethod
    def empty(cls, count: int) -> Facing:
        """Uninitialized arrays for ``count`` points."""
        x, y, w = np.empty((3, count), np.float32)
        return cls(x, y, w, np.empty(count, np.int64))

    def first(self, count: int) -> Facing:
        """The first ``count`` points."""
        return Facing(self.x[:count], self.y[:count], self.w[:count], self.hit[:count])


class Cells(NamedTuple):
    """Points sorted by grid cell: index of each cell's first point (``start``) and its least w (``farthest``).

    ``shape``: rows and columns of cells; ``corner``: (x, y) of the grid's origin; ``density``: columns and rows per
    unit.
    """

    points: Facing
    start: NDArray[np.int64]
    farthest: Floats
    corner: tuple[np.float32, np.float32]
    density: tuple[np.float32, np.float32]
    shape: tuple[int, int]


@entry
def select_facing(view: Pinhole, position: Any, normal: Any, above: Any, out: Facing) -> int:
    """Fill the first rows of ``out`` with the hits that face a light at the eye of ``view``; return their number.

    ``position``, ``normal [3, M]`` of hits; ``above [M, 3]``: where their shadow rays start.
    """
    eye, axes = view.eye, view.axes
    count = 0
    for m in range(position.shape[1]):
        x, y, z = eye[0] - position[0, m], eye[1] - position[1, m], eye[2] - position[2, m]
        if normal[0, m] * x + normal[1, m] * y + normal[2, m] * z <= ZERO:
            continue
        x, y, z = above[m, 0] - eye[0], above[m, 1] - eye[1], above[m, 2] - eye[2]
        w = ONE / (axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z)
        out.x[count] = (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) * w
        out.y[count] = -(axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) * w
        out.w[count], out.hit[count] = w, m
        count += 1
    return count


@compiled
def _cell(value: Any, corner: Any, inverse: Any, count: int) -> int:
    """Index of the cell along one axis, limited to the grid."""
    return int(min(max((value - corner) * inverse, ZERO), np.float32(count - 1)))


@entry
def sort_points(points: Facing, out: Facing) -> Cells:
    """Sort points by cell into ``out``."""
    count = points.x.size
    left, right, low, high = points.x[0], points.x[0], points.y[0], points.y[0]
    for n in range(count):
        left, right = min(left, points.x[n]), max(right, points.x[n])
        low, high = min(low, points.y[n]), max(high, points.y[n])
    width, height = max(right - left, _TINY), max(high - low, _TINY)
    side = max(math.sqrt(width * height * np.float32(POINTS_PER_CELL) / np.float32(count)), _TINY)
    cols = int(min(max(math.ceil(width / side), 1), 2048))
    rows = int(min(max(math.ceil(height / side), 1), 2048))
    per_col, per_row = np.float32(cols) / width, np.float32(rows) / height
    start, cell = np.zeros(rows * cols + 1, np.int64), np.empty(count, np.int64)
    farthest = np.full(rows * cols, np.float32(np.inf))
    for n in range(count):
        c = _cell(points.y[n], low, per_row, rows) * cols + _cell(points.x[n], left, per_col, cols)
        cell[n] = c
        start[c + 1] += 1
        farthest[c] = min(farthest[c], points.w[n])
    for c in range(rows * cols):
        start[c + 1] += start[c]
    for n in range(count):
        at = start[cell[n]]
        start[cell[n]] = at + 1
        out.x[at], out.y[at], out.w[at], out.hit[at] = points.x[n], points.y[n], points.w[n], points.hit[n]
    for c in range(rows * cols, 0, -1):
        start[c] = start[c - 1]
    start[0] = 0
    return Cells(out, start, farthest, (left, low), (per_col, per_row), (rows, cols))


@compiled
def _hide(points: Facing, first: int, stop: int, plane: Any, hidden: Any) -> None:
    """Mark the points ``range(first, stop)`` that a triangle covers and that are farther from the light.

    ``plane``: (x, y) of its corner a; gradients along x and y of the barycentric weights of corners b and c; its
    inverse depth at a, and the differences to b and c.
    """
    ax, ay, bx, by, cx, cy, wa, wb, wc = plane
    x, y, w, to = points.x[first:stop], points.y[first:stop], points.w[first:stop], hidden[first:stop]
    for n in range(x.size):
        dx, dy = x[n] - ax, y[n] - ay
        b, c = bx * dx + by * dy, cx * dx + cy * dy
        inside = (b >= _OUTSIDE) & (c >= _OUTSIDE) & (b + c <= ONE - _OUTSIDE)
        to[n] |= inside & (wa + b * wb + c * wc > w[n])


@entry
def hide_points(mesh: Triangles, projected: Any, cells: Cells, hidden: Any) -> None:
    """Set ``hidden [N]`` for the sorted points that any triangle hides; ``projected [3, V]``: vertices."""
    rows, cols = cells.shape
    left, low = cells.corner
    per_col, per_row = cells.density
    right, high = left + np.float32(cols) / per_col, low + np.float32(rows) / per_row
    for f in range(mesh.faces.shape[0]):
        a, b, c = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        ax, ay, wa = projected[0, a], projected[1, a], projected[2, a]
        bx, by, cx, cy = projected[0, b], projected[1, b], projected[0, c], projected[1, c]
        x0, x1, y0, y1 = min(ax, bx, cx), max(ax, bx, cx), min(ay, by, cy), max(ay, by, cy)
        if x1 < left or x0 > right or y1 < low or y0 > high:
            continue
        bx, by, cx, cy = bx - ax, by - ay, cx - ax, cy - ay
        area = bx * cy - by * cx
        if abs(area) < _TINY:
            continue
        inverse = ONE / area
        growth = (ax, ay, cy * inverse, -cx * inverse, -by * inverse, bx * inverse)
        plane = (*growth, wa, projected[2, b] - wa, projected[2, c] - wa)
        nearest = max(wa, projected[2, b], projected[2, c])
        first_col, last_col = _cell(x0, left, per_col, cols), _cell(x1, left, per_col, cols)
        for row in range(_cell(y0, low, per_row, rows), _cell(y1, low, per_row, rows) + 1):
            # Cells whose points are all nearer than the triangle are skipped: half of a solid's triangles hide nothing.
            left_cell, right_cell = row * cols + first_col, row * cols + last_col
            while left_cell <= right_cell and cells.farthest[left_cell] >= nearest:
                left_cell += 1
            while left_cell <= right_cell and cells.farthest[right_cell] >= nearest:
                right_cell -= 1
            if left_cell <= right_cell:
                _hide(cells.points, cells.start[left_cell], cells.start[right_cell + 1], plane, hidden)


@entry
def mark_lit(points: Facing, hidden: Any, lit: Any) -> None:
    """Set ``lit [M]`` for the hits of points that are not hidden."""
    for n in range(points.hit.size):
        lit[points.hit[n]] = not hidden[n]
