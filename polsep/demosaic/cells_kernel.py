"""Rows of polarizer cells for guided demosaicking: four planes a row, one per place in the cell.

A row of cells is ``[4, n]``: plane 2 i + j holds the samples of sensor row i and column j of every cell. Rows are
continued by mirrored cells, `EDGE` or more, on each side. No function computes the outermost `GUARD` values at both
ends, so that filters need no borders: the errors there never reach the frame. Colours alternate along a row: ``other
[n]`` is 1 where a cell is red or blue (whichever the row has) and 0 where it is green. Loops multiply by it, exactly,
because conditions keep them from being vectorised.

Rows live in rings, the row r at r modulo the ring's length; rows count from the first one that a stream loads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, QUARTER, ZERO, compiled
from polsep.compute.rows_kernel import fill
from polsep.demosaic import guided as twin
from polsep.demosaic.bilinear_kernel import Pattern
from polsep.sensor.unpack_kernel import Samples, read_row

#: Values at both ends of a row that are not computed, and mirrored cells at both ends: the twin's margin inside them.
GUARD = 8
EDGE = twin.MARGIN + 12

_OWN, _FAR, _BACK, _NEAR = np.float32(7 / 8), np.float32(1 / 8), np.float32(3 / 8), np.float32(5 / 8)
_HERE, _THERE = np.float32(3 / 4), np.float32(1 / 4)
_GREEN_OWN, _GREEN_FAR, _GREEN_BACK, _GREEN_NEAR = (np.float32(k / 16) for k in (13, 1, 3, 7))


class Grid(NamedTuple):
    """Constants of all rows of a frame. ``n``: length of a row, ``w`` cells and ``edge`` more on each side.

    ``others [2, n]``: 1 where a cell of an even, an odd row is red or blue. ``colors [2]``: which of both (0 or 2).
    ``gains [2, n]``: of the samples. ``sources [2 edge]``: column of the frame behind each mirrored one.
    ``cosines``, ``sines [4]``: of twice the analyser's angle, by place. ``inverse [3, 4]``: Stokes vector of analysers
    in the order of the places.
    """

    n: int
    edge: int
    others: NDArray[np.float32]
    colors: NDArray[np.int64]
    gains: NDArray[np.float32]
    sources: NDArray[np.int64]
    cosines: NDArray[np.float32]
    sines: NDArray[np.float32]
    inverse: NDArray[np.float32]


class Source(NamedTuple):
    """A frame of samples, how its filters lie, and what all its rows share."""

    samples: Samples
    pattern: Pattern
    grid: Grid


def read_grid(pattern: Pattern, angles: tuple[float, ...], inverse: NDArray[np.float32], edge: int = EDGE) -> Grid:
    """The grid of frames of a colour ``pattern`` whose analysers have ``angles`` [rad] and that ``inverse [3, 4]``.

    ``edge``: mirrored cells on each side.
    """
    columns = np.arange(-edge, pattern.w + edge)
    place = [2 * row + col for row, col in pattern.places]
    by_place = np.argsort(place)
    doubled = 2 * np.array(angles)[by_place]
    return Grid(
        columns.size,
        edge,
        np.ascontiguousarray(pattern.bayer[:, columns % 2] != 1, np.float32),
        np.array([min(row, key=lambda channel: channel == 1) for row in pattern.bayer.tolist()], np.int64),
        np.ascontiguousarray(pattern.gains[:, columns % 2]),
        reflect(np.concatenate([columns[:edge], columns[-edge:]]), pattern.w),
        np.where(np.abs(np.cos(doubled)) < 1e-9, 0, np.cos(doubled)).astype(np.float32),
        np.where(np.abs(np.sin(doubled)) < 1e-9, 0, np.sin(doubled)).astype(np.float32),
        np.ascontiguousarray(inverse[:, by_place]),
    )


def reflect(places: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Places of ``count`` cells mirrored about the outermost one, as often as needed."""
    mirrored: NDArray[np.int64] = count - 1 - np.abs(np.mod(places, 2 * count - 2) - (count - 1))
    return mirrored


@compiled
def load_cells(source: Source, r: int, row: Any, planes: Any) -> None:
    """The samples of the frame's cell row ``r`` to ``planes [4, n]``, linear; ``row``: a buffer for a sensor row."""
    samples, pattern, grid = source
    edge, gains = grid.edge, grid.gains[r % 2, grid.edge :]
    for i in range(2):
        read_row(samples, pattern.top + 2 * r + i, pattern.left, row)
        left, right = planes[2 * i, edge:], planes[2 * i + 1, edge:]
        for j in range(row.size // 2):
            left[j] = (row[2 * j] - pattern.black) * gains[j]
            right[j] = (row[2 * j + 1] - pattern.black) * gains[j]
    last = grid.n - edge
    for k in range(4):
        plane = planes[k]
        for j in range(edge):
            plane[j] = plane[edge + grid.sources[j]]
            plane[last + j] = plane[edge + grid.sources[edge + j]]


@compiled
def mean_cells(planes: Any, mean: Any) -> None:
    """Mean over each cell of ``planes [4, n]``."""
    a, b, c, d = planes[0], planes[1], planes[2], planes[3]
    for j in range(mean.size):
        mean[j] = QUARTER * ((a[j] + b[j]) + (c[j] + d[j]))


@compiled
def detail_cells(planes: Any, details: Any) -> None:
    """Left minus right, top minus bottom and the diagonal of each cell of ``planes [4, n]``; see `networks.details`."""
    a, b, c, d = planes[0], planes[1], planes[2], planes[3]
    across, down, diagonal = details[0], details[1], details[2]
    for j in range(across.size):
        across[j] = QUARTER * ((a[j] - b[j]) + (c[j] - d[j]))
        down[j] = QUARTER * ((a[j] + b[j]) - (c[j] + d[j]))
        diagonal[j] = QUARTER * ((a[j] - b[j]) - (c[j] - d[j]))


@compiled
def _interpolate_down(own_row: Any, near_row: Any, back_row: Any, far_row: Any, other: Any, out: Any) -> None:
    """Vertical part of `demosaic_bilinear_half` for one analyser, ``out [3, n]``.

    The row's own red or blue, the next row's, and green, from the row itself, the one that the analyser is nearest to,
    the one on the other side, and the one behind the nearest.
    """
    own, near, back, far = own_row[GUARD:], near_row[GUARD:], back_row[GUARD:], far_row[GUARD:]
    own_left, own_right = own_row[GUARD - 1 :], own_row[GUARD + 1 :]
    near_left, near_right = near_row[GUARD - 1 :], near_row[GUARD + 1 :]
    first, second, green, here = out[0, GUARD:], out[1, GUARD:], out[2, GUARD:], other[GUARD:]
    for j in range(other.size - 2 * GUARD):
        first[j] = _OWN * own[j] + _FAR * far[j]
        second[j] = _BACK * back[j] + _NEAR * near[j]
        at_green = _GREEN_OWN * own[j] + _GREEN_FAR * (far[j] + (near_left[j] + near_right[j]))
        at_other = _GREEN_BACK * (back[j] + (own_left[j] + own_right[j])) + _GREEN_NEAR * near[j]
        green[j] = here[j] * at_other + (ONE - here[j]) * at_green


@compiled
def _add_red_or_blue(q: Any, present: Any, step: int, w1: Any, w2: Any, s1_row: Any, s2_row: Any) -> None:
    """Horizontal part for red or blue, ``present`` where that colour is; times ``w1``, ``w2`` onto s1 and s2."""
    own, far = q[GUARD:], q[GUARD + 2 * step :]
    back, near, here = q[GUARD - step :], q[GUARD + step :], present[GUARD:]
    s1, s2 = s1_row[GUARD:], s2_row[GUARD:]
    for j in range(q.size - 2 * GUARD):
        at_own, between = _OWN * own[j] + _FAR * far[j], _BACK * back[j] + _NEAR * near[j]
        value = here[j] * at_own + (ONE - here[j]) * between
        s1[j] += w1 * value
        s2[j] += w2 * value


@compiled
def _add_green(q: Any, step: int, w1: Any, w2: Any, s1_row: Any, s2_row: Any) -> None:
    """Horizontal part for green."""
    own, near, s1, s2 = q[GUARD:], q[GUARD + step :], s1_row[GUARD:], s2_row[GUARD:]
    for j in range(q.size - 2 * GUARD):
        value = _HERE * own[j] + _THERE * near[j]
        s1[j] += w1 * value
        s2[j] += w2 * value


@compiled
def polarize_row(ring: Any, r: int, grid: Grid, weights: Any, buffer: Any, sums: Any) -> None:
    """s1 and s2 of row ``r`` to ``sums [2, 3, n]``, bilinear, from a ring of planes with rows r - 2 to r + 2.

    ``weights [2, 4]``: of the analysers, by place; ``buffer [3, n]``. Twin: `interpolate_analysers_half`, `fit_stokes`.
    """
    length, parity = ring.shape[0], r % 2
    other, green = grid.others[parity], grid.others[1 - parity]
    for i in range(2):
        for c in range(3):
            fill(ZERO, sums[i, c])
    for place in range(4):
        d, step = 1 - 2 * (place // 2), 1 - 2 * (place % 2)
        own, near = ring[r % length, place], ring[(r + d) % length, place]
        back, far = ring[(r - d) % length, place], ring[(r + 2 * d) % length, place]
        _interpolate_down(own, near, back, far, other, buffer)
        w1, w2 = weights[0, place], weights[1, place]
        first, second = grid.colors[parity], grid.colors[1 - parity]
        _add_red_or_blue(buffer[0], other, step, w1, w2, sums[0, first], sums[1, first])
        _add_red_or_blue(buffer[1], green, step, w1, w2, sums[0, second], sums[1, second])
        _add_green(buffer[2], step, w1, w2, sums[0, 1], sums[1, 1])


@compiled
def blur_pixels_down(above: Any, here: Any, below: Any, side: Any, out: Any) -> None:
    """(``side``, 1 - 2 ``side``, ``side``) along the columns of pixels: rows ``[4, n]`` of cells to a row."""
    middle = ONE - side - side
    for j in range(2):
        before, first, second, after = above[2 + j], here[j], here[2 + j], below[j]
        upper, lower = out[j], out[2 + j]
        for x in range(first.size):
            upper[x] = middle * first[x] + side * (before[x] + second[x])
            lower[x] = middle * second[x] + side * (first[x] + after[x])


@compiled
def blur_pixels_along(planes: Any, out: Any) -> None:
    """(1/4, 1/2, 1/4) along the rows of pixels of a row of cells ``[4, n]``."""
    for i in range(2):
        left, right = planes[2 * i, GUARD:], planes[2 * i + 1, GUARD:]
        before, after = planes[2 * i + 1, GUARD - 1 :], planes[2 * i, GUARD + 1 :]
        first, second = out[2 * i, GUARD:], out[2 * i + 1, GUARD:]
        for j in range(planes.shape[1] - 2 * GUARD):
            first[j] = QUARTER * (before[j] + right[j]) + HALF * left[j]
            second[j] = QUARTER * (left[j] + after[j]) + HALF * right[j]


@compiled
def enlarge_down(above: Any, here: Any, below: Any, out: Any) -> None:
    """Linear interpolation down a column, from cells ``[n]`` to both rows of pixels ``out [2, n]``."""
    upper, lower = out[0], out[1]
    for j in range(here.size):
        upper[j] = _HERE * here[j] + _THERE * above[j]
        lower[j] = _HERE * here[j] + _THERE * below[j]


@compiled
def sum_three(x: Any, out: Any) -> None:
    """Sums of three neighbours along a row."""
    a, b, c, total = x[GUARD - 1 :], x[GUARD:], x[GUARD + 1 :], out[GUARD:]
    for j in range(x.size - 2 * GUARD):
        total[j] = a[j] + b[j] + c[j]


@compiled
def blur_gently(x: Any, out: Any) -> None:
    """(1/8, 3/4, 1/8) along a row of cells."""
    a, b, c, blurred = x[GUARD - 1 :], x[GUARD:], x[GUARD + 1 :], out[GUARD:]
    eighth = QUARTER * HALF
    for j in range(x.size - 2 * GUARD):
        blurred[j] = _HERE * b[j] + eighth * (a[j] + c[j])


@compiled
def blur_gently_down(above: Any, here: Any, below: Any, out: Any) -> None:
    """(1/8, 3/4, 1/8) down the rows of cells."""
    eighth = QUARTER * HALF
    for j in range(out.size):
        out[j] = _HERE * here[j] + eighth * (above[j] + below[j])


@compiled
def choose(other: Any, yes: Any, no: Any, out: Any) -> None:
    """``yes`` where a cell is red or blue, ``no`` where it is green."""
    for j in range(out.size):
        out[j] = other[j] * yes[j] + (ONE - other[j]) * no[j]


def reciprocal(count: float) -> np.float32:
    """1 / ``count``, a constant of kernels."""
    return np.float32(ONE / np.float32(count))
