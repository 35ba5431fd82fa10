"""Red and blue at every pixel from green, rows of cells in and out: twin of `guided._fill_from_green`.

The rows, counted back from the newest one of green: linear functions 4 (`LINES`), smoothed over 3x3 cells 5, estimates
and their residual 6 (`ESTIMATE`), red and blue 8 (`FILLED`). Index 0 is red and 1 is blue wherever there are two.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, QUARTER, ZERO, compiled
from polsep.compute.rows_kernel import add_rows, subtract
from polsep.demosaic import guided as twin
from polsep.demosaic.cells_kernel import (
    GUARD,
    Grid,
    enlarge_down,
    mean_cells,
    reciprocal,
    sum_three,
)
from polsep.demosaic.green_kernel import prior_slope

LINES, ESTIMATE, FILLED = 4, 6, 8

# Binomial (1, 8, 28, 56, 70, 56, 28, 8, 1) where only every second cell has the colour: its own ones, or the others.
_B0, _B2, _B4 = (np.float32(k / 128) for k in (70, 28, 1))
_B1, _B3 = (np.float32(k / 128) for k in (56, 8))
# Pairs of samples every fourth pixel, (1, 2, 3, 4, 3, 2, 1) / 8.
_P1, _P2, _P3, _P4 = (np.float32(k / 8) for k in (1, 2, 3, 4))
_FLOOR, _MIN_SHARE, _NINTH = np.float32(twin.GUIDE_FLOOR), np.float32(twin.MIN_SHARE), reciprocal(9)
_THREE_QUARTERS = np.float32(3 / 4)


class Colors(NamedTuple):
    """Rings on the way to red and blue ``[length, k, n]``, and single ``rows``,
    the last of them zero.

    ``moments``: means along a row of green, the row's other colour, their product and green's square. ``lines``: slope
    and offset of red and of blue, over 3 cells; ``smooth``: over 3x3. ``estimates``: four planes of red, four of blue.
    ``residual``: of the row's other colour, interpolated along the row, and behind it that colour itself.
    """

    moments: NDArray[np.float32]
    lines: NDArray[np.float32]
    smooth: NDArray[np.float32]
    estimates: NDArray[np.float32]
    residual: NDArray[np.float32]
    rows: NDArray[np.float32]


def make_colors(n: int) -> Colors:
    """Empty rings for rows of length ``n``."""
    return Colors(
        np.zeros((9, 4, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((3, 8, n), np.float32),
        np.zeros((5, 8, n), np.float32),
        np.zeros((9, n), np.float32),
    )


@compiled
def _products(green: Any, mosaic: Any, rows: Any) -> None:
    """Means over each cell of green, its product with the cells' own colour, and its square."""
    g0, g1, g2, g3 = green[0], green[1], green[2], green[3]
    x0, x1, x2, x3 = mosaic[0], mosaic[1], mosaic[2], mosaic[3]
    mean, product, square = rows[0], rows[2], rows[3]
    for j in range(mean.size):
        mean[j] = QUARTER * ((g0[j] + g1[j]) + (g2[j] + g3[j]))
        product[j] = QUARTER * ((g0[j] * x0[j] + g1[j] * x1[j]) + (g2[j] * x2[j] + g3[j] * x3[j]))
        square[j] = QUARTER * ((g0[j] * g0[j] + g1[j] * g1[j]) + (g2[j] * g2[j] + g3[j] * g3[j]))


@compiled
def _mean_along(x: Any, other: Any, out: Any) -> None:
    """Binomial mean along a row over the cells that are ``other``."""
    a4, a3, a2, a1 = x[GUARD - 4 :], x[GUARD - 3 :], x[GUARD - 2 :], x[GUARD - 1 :]
    b0, b1, b2, b3, b4 = x[GUARD:], x[GUARD + 1 :], x[GUARD + 2 :], x[GUARD + 3 :], x[GUARD + 4 :]
    here, mean = other[GUARD:], out[GUARD:]
    for j in range(x.size - 2 * GUARD):
        own = _B0 * b0[j] + _B2 * (a2[j] + b2[j]) + _B4 * (a4[j] + b4[j])
        between = _B1 * (a1[j] + b1[j]) + _B3 * (a3[j] + b3[j])
        mean[j] = here[j] * own + (ONE - here[j]) * between


@compiled
def _mean_down(ring: Any, r: int, k: int, own: bool, out: Any) -> None:
    """Binomial mean down the columns over the rows of a colour, of which ``r`` is one or not."""
    if own:
        a, b, c = ring[(r - 4) % 9, k], ring[(r - 2) % 9, k], ring[r % 9, k]
        d, e = ring[(r + 2) % 9, k], ring[(r + 4) % 9, k]
        for j in range(out.size):
            out[j] = _B0 * c[j] + _B2 * (b[j] + d[j]) + _B4 * (a[j] + e[j])
    else:
        a, b, d, e = ring[(r - 3) % 9, k], ring[(r - 1) % 9, k], ring[(r + 1) % 9, k], ring[(r + 3) % 9, k]
        for j in range(out.size):
            out[j] = _B1 * (b[j] + d[j]) + _B3 * (a[j] + e[j])


@compiled
def _find_line(rows: Any) -> None:
    """Slope and offset, to rows 0 and 1, from means of green, colour, product and square."""
    green, color, product, square = rows[0], rows[1], rows[2], rows[3]
    for j in range(green.size):
        g, x = green[j], color[j]
        covariance, variance = product[j] - g * x, square[j] - g * g
        variance = variance if variance > ZERO else ZERO
        slope = (covariance + _FLOOR * prior_slope(x, g)) / (variance + _FLOOR)
        green[j] = slope
        color[j] = x - slope * g


@compiled
def _estimate(slope: Any, offset: Any, green: Any, out: Any) -> None:
    """``slope green + offset`` for one row of pixels ``[2, n]``; both are of cells, interpolated along the row."""
    a_before, a, a_after = slope[GUARD - 1 :], slope[GUARD:], slope[GUARD + 1 :]
    b_before, b, b_after = offset[GUARD - 1 :], offset[GUARD:], offset[GUARD + 1 :]
    g0, g1, x0, x1 = green[0, GUARD:], green[1, GUARD:], out[0, GUARD:], out[1, GUARD:]
    for j in range(slope.size - 2 * GUARD):
        a_here, b_here = _THREE_QUARTERS * a[j], _THREE_QUARTERS * b[j]
        x0[j] = (a_here + QUARTER * a_before[j]) * g0[j] + (b_here + QUARTER * b_before[j])
        x1[j] = (a_here + QUARTER * a_after[j]) * g1[j] + (b_here + QUARTER * b_after[j])


@compiled
def _interpolate_along(pair: Any, other: Any, out: Any) -> None:
    """Both planes ``[2, n]`` of a row of pixels, from the cells that are ``other``."""
    x0, x1, here = pair[0, GUARD:], pair[1, GUARD:], other[GUARD:]
    x0_before, x1_before, x1_before2 = pair[0, GUARD - 1 :], pair[1, GUARD - 1 :], pair[1, GUARD - 2 :]
    x0_after, x1_after, x0_after2 = pair[0, GUARD + 1 :], pair[1, GUARD + 1 :], pair[0, GUARD + 2 :]
    y0, y1 = out[0, GUARD:], out[1, GUARD:]
    for j in range(other.size - 2 * GUARD):
        own0 = _P4 * x0[j] + _P3 * x1[j] + _P1 * x1_before2[j]
        own1 = _P4 * x1[j] + _P3 * x0[j] + _P1 * x0_after2[j]
        between0 = _P3 * x1_before[j] + _P2 * (x0_before[j] + x0_after[j]) + _P1 * x1_after[j]
        between1 = _P3 * x0_after[j] + _P2 * (x1_before[j] + x1_after[j]) + _P1 * x0_before[j]
        y0[j] = here[j] * own0 + (ONE - here[j]) * between0
        y1[j] = here[j] * own1 + (ONE - here[j]) * between1


@compiled
def _interpolate_down(ring: Any, r: int, k: int, own: bool, out: Any) -> None:
    """Both pixels ``out [2, n]`` of column ``k % 2`` of the cells, from the rows of a colour; ``ring [5, 8, n]``."""
    upper, lower = out[0], out[1]
    if own:
        here0, here1 = ring[r % 5, k], ring[r % 5, k + 2]
        before1, after0 = ring[(r - 2) % 5, k + 2], ring[(r + 2) % 5, k]
        for j in range(upper.size):
            upper[j] = _P4 * here0[j] + _P3 * here1[j] + _P1 * before1[j]
            lower[j] = _P4 * here1[j] + _P3 * here0[j] + _P1 * after0[j]
    else:
        before0, before1 = ring[(r - 1) % 5, k], ring[(r - 1) % 5, k + 2]
        after0, after1 = ring[(r + 1) % 5, k], ring[(r + 1) % 5, k + 2]
        for j in range(upper.size):
            upper[j] = _P3 * before1[j] + _P2 * (before0[j] + after0[j]) + _P1 * after1[j]
            lower[j] = _P3 * after0[j] + _P2 * (before1[j] + after1[j]) + _P1 * before0[j]


@compiled
def _fill(mosaic: Any, estimate: Any, residual: Any, plain: Any, present: Any, out: Any) -> None:
    """One plane: the mosaic's own values where ``present``, else the estimate and its residual, not below its floor."""
    for j in range(out.size):
        value, least = estimate[j] + residual[j], _MIN_SHARE * plain[j]
        value = value if value >= least else least
        out[j] = present[j] * mosaic[j] + (ONE - present[j]) * value


@compiled
def _find_lines(p: int, grid: Grid, state: Colors) -> None:
    """Linear functions of row ``p``, and their means over 3x3 cells of the row above."""
    rows = state.rows
    for color in range(2):
        own = grid.colors[p % 2] == 2 * color
        for k in range(4):
            _mean_down(state.moments, p, k, own, rows[k])
        _find_line(rows)
        for k in range(2):
            sum_three(rows[k], state.lines[p % 3, 2 * color + k])
    above, middle, below = state.lines[(p - 2) % 3], state.lines[(p - 1) % 3], state.lines[p % 3]
    for k in range(4):
        add_rows(above[k], middle[k], below[k], _NINTH, state.smooth[(p - 1) % 3, k])


@compiled
def _estimate_row(here: Any, green: Any, p: int, grid: Grid, state: Colors) -> None:
    """Estimates of row ``p`` from its green; what its mosaic ``here`` differs from them, along the row."""
    rows, estimates = state.rows, state.estimates[p % 3]
    above, middle, below = state.smooth[(p - 1) % 3], state.smooth[p % 3], state.smooth[(p + 1) % 3]
    for color in range(2):
        for k in range(2):
            line = 2 * color + k
            enlarge_down(above[line], middle[line], below[line], rows[2 * k : 2 * k + 2])
        for i in range(2):
            first = 4 * color + 2 * i
            _estimate(rows[i], rows[2 + i], green[2 * i : 2 * i + 2], estimates[first : first + 2])
    first = 4 * (grid.colors[p % 2] // 2)
    for k in range(4):
        subtract(here[k], estimates[first + k], rows[4 + k])
    other, residual = grid.others[p % 2], state.residual[p % 5]
    for i in range(2):
        _interpolate_along(rows[4 + 2 * i : 6 + 2 * i], other, residual[2 * i : 2 * i + 2])
        _interpolate_along(here[2 * i : 2 * i + 2], other, residual[4 + 2 * i : 6 + 2 * i])


@compiled
def _fill_row(here: Any, p: int, grid: Grid, state: Colors, out: Any) -> None:
    """Red and blue of row ``p``, to ``out [8, n]``."""
    rows = state.rows
    for color in range(2):
        own = grid.colors[p % 2] == 2 * color
        present = grid.others[p % 2] if own else rows[8]
        for j in range(2):
            _interpolate_down(state.residual, p, j, own, rows[0:2])
            _interpolate_down(state.residual, p, 4 + j, own, rows[2:4])
            for i in range(2):
                k = 2 * i + j
                estimate = state.estimates[p % 3, 4 * color + k]
                _fill(here[k], estimate, rows[i], rows[2 + i], present, out[4 * color + k])


@compiled
def fill_colors_row(mosaic: Any, green: Any, r: int, grid: Grid, state: Colors, filled: Any) -> None:
    """Read row ``r`` of green and of the mosaic; fill row ``r - FILLED`` of red and blue.

    Rings: ``mosaic``, ``green [length, 4, n]``, and ``filled [length, 8, n]``, four planes of red and four of blue.
    """
    rows, length = state.rows, mosaic.shape[0]
    here = mosaic[r % length]
    _products(green[r % green.shape[0]], here, rows)
    mean_cells(here, rows[1])
    for k in range(4):
        _mean_along(rows[k], grid.others[r % 2], state.moments[r % 9, k])
    _find_lines(r - LINES, grid, state)
    p = r - ESTIMATE
    _estimate_row(mosaic[p % length], green[p % green.shape[0]], p, grid, state)
    p = r - FILLED
    _fill_row(mosaic[p % length], p, grid, state, filled[p % filled.shape[0]])
