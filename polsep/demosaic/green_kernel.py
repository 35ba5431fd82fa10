"""Green at every pixel of a mosaic of s0, rows of cells in and out: twin of the green half of `guided.fill_colors`.

The rows, counted back from the mosaic's newest one: products of derivatives 2 (`GRADIENTS`), slopes and both directions
4 (`DIRECTIONS`), the weighted difference 7 (`DIFFERENCE`), its window's mean 11 (`SMOOTH`), green 15 (`GREEN`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, QUARTER, THIRD, TWO, ZERO, compiled
from polsep.compute.rows_kernel import add_rows
from polsep.demosaic import guided as twin
from polsep.demosaic.cells_kernel import GUARD, Grid, blur_pixels_down, mean_cells, reciprocal, sum_three

GRADIENTS, DIRECTIONS, DIFFERENCE, SMOOTH, GREEN = 2, 4, 7, 11, 15

_PRIOR, _TINY = np.float32(twin.PRIOR_SHARE), np.float32(1e-3)
_MIN_RATIO, _MAX_RATIO = np.float32(0.2), np.float32(5)
_FLOOR = np.float32(13 * twin.SLOPE_FLOOR)  # 13 of the 25 cells of a window are green, or 13 are not
_MIN_SLOPE, _MAX_SLOPE = np.float32(-0.5), np.float32(4)
_THIRTEENTH, _TWELFTH, _NINTH, _TWENTY_FIFTH = (reciprocal(k) for k in (13, 12, 9, 25))
_TWO_THIRDS, _FIVE_NINTHS, _TWO_NINTHS = np.float32(2 / 3), np.float32(5 / 9), np.float32(2 / 9)
_EIGHTH, _THREE_QUARTERS = np.float32(1 / 8), np.float32(3 / 4)
_ROUGH_FLOOR, _ERROR_FLOOR = np.float32(1e-6), np.float32(1e-12)
_MARGIN, _MIN_SHARE = np.float32(twin.DIFFERENCE_MARGIN), np.float32(twin.MIN_SHARE)


class Green(NamedTuple):
    """Rings of the steps to green, as long as later steps need; all ``[length, k, n]`` but the single ``rows``.

    ``sums``: of products and s0 over 3 and over 2 cells of a row. ``raw``: differences down the columns, ``along`` and
    ``down``: smoothed ones. ``rough``: squared derivatives of both and squared detail of both, over 3 cells.
    ``differences``: the weighted ones. ``means``: it, its error and its variance, over 5 cells. ``smooth``.
    """

    sums: NDArray[np.float32]
    raw: NDArray[np.float32]
    along: NDArray[np.float32]
    down: NDArray[np.float32]
    rough: NDArray[np.float32]
    differences: NDArray[np.float32]
    means: NDArray[np.float32]
    smooth: NDArray[np.float32]
    rows: NDArray[np.float32]


class Samples(NamedTuple):
    """Six rows of samples along a row or column A A B B of the mosaic, about one pixel of a pair.

    ``own``: the pixel, and the other one of its pair, ``partner``. ``near``: the other colour's nearest sample, next to
    the pixel; ``near2``: the sample of its own colour behind that. ``far``, ``far2``: the same on the other side, 2 and
    4 away.
    """

    own: NDArray[np.float32]
    partner: NDArray[np.float32]
    near: NDArray[np.float32]
    near2: NDArray[np.float32]
    far: NDArray[np.float32]
    far2: NDArray[np.float32]


def make_green(n: int) -> Green:
    """Empty rings for rows of length ``n``."""
    return Green(
        np.zeros((5, 10, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((4, 4, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((5, 4, n), np.float32),
        np.zeros((9, 4, n), np.float32),
        np.zeros((13, 3, n), np.float32),
        np.zeros((5, 1, n), np.float32),
        np.zeros((10, n), np.float32),
    )


@compiled
def _multiply_derivatives(above2: Any, above: Any, here: Any, below: Any, below2: Any, products: Any) -> None:
    """Products of the derivatives of the other colour and of the cells' own: along the row, then down the columns."""
    left2, left = here[GUARD - 2 :], here[GUARD - 1 :]
    right, right2 = here[GUARD + 1 :], here[GUARD + 2 :]
    up2, up, down, down2 = above2[GUARD:], above[GUARD:], below[GUARD:], below2[GUARD:]
    p0, p1, p2, p3 = products[0, GUARD:], products[1, GUARD:], products[2, GUARD:], products[3, GUARD:]
    for j in range(here.size - 2 * GUARD):
        own = QUARTER * (right2[j] - left2[j])
        p0[j] = own * (HALF * (right[j] - left[j]))
        p1[j] = own * own
        own = QUARTER * (down2[j] - up2[j])
        p2[j] = own * (HALF * (down[j] - up[j]))
        p3[j] = own * own


@compiled
def _sum_alternate(x: Any, three: Any, two: Any) -> None:
    """Sums of cells 2 apart along a row of 5: of the middle one's kind, and of the other."""
    a, b, c, d, e = x[GUARD - 2 :], x[GUARD - 1 :], x[GUARD:], x[GUARD + 1 :], x[GUARD + 2 :]
    s3, s2 = three[GUARD:], two[GUARD:]
    for j in range(x.size - 2 * GUARD):
        s3[j] = a[j] + c[j] + e[j]
        s2[j] = b[j] + d[j]


@compiled
def _sum_kind(sums: Any, r: int, own: int, other: int, out: Any) -> None:
    """The sum over the cells of one kind in a 5x5 window: rows ``own`` of sums in even steps, ``other`` in odd ones."""
    a, b, c = sums[(r - 2) % 5, own], sums[(r - 1) % 5, other], sums[r % 5, own]
    d, e = sums[(r + 1) % 5, other], sums[(r + 2) % 5, own]
    for j in range(out.size):
        out[j] = ((a[j] + b[j]) + c[j]) + (d[j] + e[j])


@compiled
def prior_slope(mean: Any, guide: Any) -> Any:
    """Twin of `guided._prior_slope`."""
    ratio = (mean + _TINY) / ((guide if guide > ZERO else ZERO) + _TINY)
    ratio = ratio if ratio > _MIN_RATIO else _MIN_RATIO
    return _PRIOR * (ratio if ratio < _MAX_RATIO else _MAX_RATIO)


@compiled
def _find_slopes(rows: Any, slopes: Any) -> None:
    """Twin of `guided._slope_of_other` for both directions, from sums of products and of s0 of both kinds of cells."""
    x0, x1, x2, x3, own, others = rows[0], rows[1], rows[2], rows[3], rows[4], rows[5]
    along, down = slopes[0], slopes[1]
    for j in range(own.size):
        prior = _FLOOR * prior_slope(_TWELFTH * others[j], _THIRTEENTH * own[j])
        slope = (x0[j] + prior) / (x1[j] + _FLOOR)
        slope = slope if slope > _MIN_SLOPE else _MIN_SLOPE
        along[j] = slope if slope < _MAX_SLOPE else _MAX_SLOPE
        slope = (x2[j] + prior) / (x3[j] + _FLOOR)
        slope = slope if slope > _MIN_SLOPE else _MIN_SLOPE
        down[j] = slope if slope < _MAX_SLOPE else _MAX_SLOPE


@compiled
def _difference(samples: Samples, other: Any, slope: Any, difference: Any, detail: Any) -> None:
    """Green minus the other colour of a row or column at one pixel of a pair, and onto ``detail`` a quarter of its own.

    ``other``: 1 at red and blue; ``slope``: at which the other colour follows the pixel's own.
    """
    x, partner, near, near2, far, far2 = samples
    for j in range(x.size):
        second = _FIVE_NINTHS * x[j] - _TWO_NINTHS * (near2[j] + partner[j]) - HALF * _TWO_NINTHS * far2[j]
        value = (_TWO_THIRDS * near[j] + THIRD * far[j]) + slope[j] * second - x[j]
        difference[j] = (TWO * other[j] - ONE) * value
        detail[j] += QUARTER * second


@compiled
def _compare_along(planes: Any, other: Any, slope: Any, out: Any, detail: Any) -> None:
    """`_difference` at the pixels of two planes ``[2, n]`` of a row."""
    inner = planes.shape[1] - GUARD
    x0, x1 = planes[0, GUARD:inner], planes[1, GUARD:inner]
    x0_after, x0_after2 = planes[0, GUARD + 1 : inner + 1], planes[0, GUARD + 2 : inner + 2]
    x1_before, x1_before2 = planes[1, GUARD - 1 : inner - 1], planes[1, GUARD - 2 : inner - 2]
    first, second = Samples(x0, x1, x1_before, x1_before2, x0_after, x0_after2), (x1, x0, x0_after, x0_after2)
    at, a, mean = other[GUARD:inner], slope[GUARD:inner], detail[GUARD:inner]
    _difference(first, at, a, out[0, GUARD:inner], mean)
    _difference(Samples(*second, x1_before, x1_before2), at, a, out[1, GUARD:inner], mean)


@compiled
def _compare_down(mosaic: Any, r: int, j: int, other: Any, slope: Any, out: Any, detail: Any) -> None:
    """The same down column ``j`` of the cells of row ``r``; ``mosaic``, ``out``: four planes."""
    n = mosaic.shape[0]
    here, below, below2 = mosaic[r % n], mosaic[(r + 1) % n, j], mosaic[(r + 2) % n, j]
    above, above2 = mosaic[(r - 1) % n, 2 + j], mosaic[(r - 2) % n, 2 + j]
    _difference(Samples(here[j], here[2 + j], above, above2, below, below2), other, slope, out[j], detail)
    _difference(Samples(here[2 + j], here[j], below, below2, above, above2), other, slope, out[2 + j], detail)


@compiled
def _smooth_along(raw: Any, out: Any, rough: Any) -> None:
    """(1/8, 3/4, 1/8) along a row of pixels ``[2, n]``; onto ``rough`` a quarter of its squared derivatives' sum."""
    x0, x1, x1_before, x0_after = raw[0, GUARD:], raw[1, GUARD:], raw[1, GUARD - 1 :], raw[0, GUARD + 1 :]
    d0, d1 = out[0, GUARD:], out[1, GUARD:]
    for j in range(raw.shape[1] - 2 * GUARD):
        d0[j] = _THREE_QUARTERS * x0[j] + _EIGHTH * (x1_before[j] + x1[j])
        d1[j] = _THREE_QUARTERS * x1[j] + _EIGHTH * (x0[j] + x0_after[j])
    before, after, total = out[1, GUARD - 1 :], out[0, GUARD + 1 :], rough[GUARD:]
    for j in range(raw.shape[1] - 2 * GUARD):
        first, second = d1[j] - before[j], after[j] - d0[j]
        total[j] += QUARTER * (first * first + second * second)


@compiled
def _roughness_down(above: Any, here: Any, below: Any, rough: Any) -> None:
    """Mean squares of the derivatives down the columns of pixels."""
    a0, a1, b0, b1, c0, c1 = above[2], above[3], here[0], here[1], here[2], here[3]
    d0, d1 = below[0], below[1]
    for x in range(rough.size):
        e0, e1, f0, f1 = c0[x] - a0[x], c1[x] - a1[x], d0[x] - b0[x], d1[x] - b1[x]
        rough[x] = QUARTER * ((e0 * e0 + e1 * e1) + (f0 * f0 + f1 * f1))


@compiled
def _square(x: Any) -> None:
    for j in range(x.size):
        x[j] = x[j] * x[j]


@compiled
def _weigh(rough: Any, r: int, rows: Any) -> None:
    """Weights of both directions, and the error of the better one: rows 0, 1 and 2 of ``rows``."""
    for k in range(4):
        add_rows(rough[(r - 1) % 5, k], rough[r % 5, k], rough[(r + 1) % 5, k], _NINTH, rows[k])
    a, b, c, d = rows[0], rows[1], rows[2], rows[3]
    for j in range(a.size):
        along, down = ONE / (a[j] + _ROUGH_FLOOR), ONE / (b[j] + _ROUGH_FLOOR)
        c[j] = ONE / (ONE / (c[j] + _ERROR_FLOOR) + ONE / (d[j] + _ERROR_FLOOR))
        share = ONE / (along + down)
        a[j] = along * share
        b[j] = down * share


@compiled
def _combine(along: Any, down: Any, rows: Any, out: Any) -> None:
    """The weighted difference, planes ``[4, n]``."""
    a, b = rows[0], rows[1]
    for k in range(4):
        x, y, both = along[k], down[k], out[k]
        for j in range(a.size):
            both[j] = a[j] * x[j] + b[j] * y[j]


@compiled
def _sum_five(x: Any, out: Any) -> None:
    """Sums of five cells of one colour along a row."""
    a, b, c, d, e = x[GUARD - 4 :], x[GUARD - 2 :], x[GUARD:], x[GUARD + 2 :], x[GUARD + 4 :]
    total = out[GUARD:]
    for j in range(x.size - 2 * GUARD):
        total[j] = ((a[j] + b[j]) + c[j]) + (d[j] + e[j])


@compiled
def _mean_of_window(means: Any, r: int, k: int, out: Any) -> None:
    """The mean over the 25 cells of one colour of a 9x9 window."""
    a, b, c, d, e = (
        means[(r - 4) % 13, k],
        means[(r - 2) % 13, k],
        means[r % 13, k],
        means[(r + 2) % 13, k],
        means[(r + 4) % 13, k],
    )
    for j in range(out.size):
        out[j] = _TWENTY_FIFTH * (((a[j] + b[j]) + c[j]) + (d[j] + e[j]))


@compiled
def _variance(x: Any, smooth: Any, out: Any) -> None:
    """Mean squared deviation of a cell's differences ``[4, n]`` from the smooth one."""
    a, b, c, d = x[0], x[1], x[2], x[3]
    for j in range(out.size):
        e, f, g, h = a[j] - smooth[j], b[j] - smooth[j], c[j] - smooth[j], d[j] - smooth[j]
        out[j] = QUARTER * ((e * e + f * f) + (g * g + h * h))


@compiled
def _kept_share(variance: Any, error: Any) -> None:
    """Share of the detail of the difference that counts, into ``variance``. Twin: `guided._without_error`."""
    for j in range(variance.size):
        share = (variance[j] - _MARGIN * error[j]) / (variance[j] + _ERROR_FLOOR)
        variance[j] = share if share > ZERO else ZERO


@compiled
def _least_green(above: Any, here: Any, below: Any, out: Any) -> None:
    """`MIN_SHARE` of the mean of the four cells next to each."""
    up, down = above[GUARD:], below[GUARD:]
    left, right, least = here[GUARD - 1 :], here[GUARD + 1 :], out[GUARD:]
    for j in range(out.size - 2 * GUARD):
        least[j] = QUARTER * _MIN_SHARE * ((up[j] + down[j]) + (left[j] + right[j]))


@compiled
def _add_difference(mosaic: Any, difference: Any, smooth: Any, kept: Any, other: Any, least: Any, green: Any) -> None:
    """One plane of green; ``kept``: the share of the detail that the ``difference`` has beyond the ``smooth`` one."""
    for j in range(green.size):
        value = mosaic[j] + (smooth[j] + kept[j] * (difference[j] - smooth[j]))
        value = value if value > least[j] else least[j]
        green[j] = other[j] * value + (ONE - other[j]) * mosaic[j]


@compiled
def _compare(mosaic: Any, r: int, other: Any, state: Green) -> None:
    """Differences of row ``r`` along both directions, and their detail."""
    rows = state.rows
    for k in range(5):
        _sum_kind(state.sums, r, k, 5 + k, rows[k])  # 13 cells of the middle one's kind
    _sum_kind(state.sums, r, 9, 4, rows[5])  # the 12 others
    _find_slopes(rows, rows[6:8])
    rough = state.rough[r % 5]
    for j in range(rough.shape[1]):
        rows[0, j], rows[1, j], rows[2, j] = ZERO, ZERO, ZERO
    here, along, raw = mosaic[r % mosaic.shape[0]], state.along[r % 4], state.raw[r % 3]
    for i in range(2):
        _compare_along(here[2 * i : 2 * i + 2], other, rows[6], rows[8:10], rows[1])
        _smooth_along(rows[8:10], along[2 * i : 2 * i + 2], rows[0])
    sum_three(rows[0], rough[0])
    _square(rows[1])
    sum_three(rows[1], rough[2])
    for j in range(2):
        _compare_down(mosaic, r, j, other, rows[7], raw, rows[2])
    _square(rows[2])
    sum_three(rows[2], rough[3])


@compiled
def fill_green_row(mosaic: Any, cells: Any, r: int, grid: Grid, state: Green, green: Any) -> None:
    """Read row ``r`` of a mosaic and of its cells' means; fill row ``r - GREEN`` of green.

    Rings: ``mosaic``, ``green [length, 4, n]``, ``cells [length, n]``.
    """
    rows, length = state.rows, cells.shape[0]
    p = r - GRADIENTS
    above2, above, middle = cells[(p - 2) % length], cells[(p - 1) % length], cells[p % length]
    _multiply_derivatives(above2, above, middle, cells[(p + 1) % length], cells[(p + 2) % length], rows)
    sums = state.sums[p % 5]
    for k in range(4):
        _sum_alternate(rows[k], sums[k], sums[5 + k])
    _sum_alternate(middle, sums[4], sums[9])

    p = r - DIRECTIONS
    _compare(mosaic, p, grid.others[p % 2], state)
    above, middle, below = state.raw[(p - 2) % 3], state.raw[(p - 1) % 3], state.raw[p % 3]
    blur_pixels_down(above, middle, below, _EIGHTH, state.down[(p - 1) % 3])
    _roughness_down(state.down[p % 3], state.down[(p - 2) % 3], state.down[(p - 1) % 3], rows[0])
    sum_three(rows[0], state.rough[(p - 2) % 5, 1])

    p = r - DIFFERENCE
    _weigh(state.rough, p, rows)
    differences, means = state.differences[p % 9], state.means[p % 13]
    _combine(state.along[p % 4], state.down[p % 3], rows, differences)
    _sum_five(rows[2], means[1])
    mean_cells(differences, rows[3])
    _sum_five(rows[3], means[0])

    p = r - SMOOTH
    smooth = state.smooth[p % 5, 0]
    _mean_of_window(state.means, p, 0, smooth)
    _variance(state.differences[p % 9], smooth, rows[0])
    _sum_five(rows[0], state.means[p % 13, 2])

    p = r - GREEN
    _mean_of_window(state.means, p, 2, rows[0])
    _mean_of_window(state.means, p, 1, rows[1])
    _kept_share(rows[0], rows[1])
    _least_green(cells[(p - 1) % length], cells[p % length], cells[(p + 1) % length], rows[2])
    here, out = mosaic[p % mosaic.shape[0]], green[p % green.shape[0]]
    smooth, other = state.smooth[p % 5, 0], grid.others[p % 2]
    for k in range(4):
        _add_difference(here[k], state.differences[p % 9, k], smooth, rows[0], other, rows[2], out[k])
