"""Twin of `guided.demosaic_guided` as a stream of cell rows, on the CPU: raw rows in, two Stokes rows of pixels out.

A row passes through two streams of `guided_kernel`, one behind the other. The first takes smooth polarization out of
the samples and guides each colour by its own; what polarization it finds is smoothed as far as it is not reliable, and
is what the second one, which fills in the colours, takes out. The result of a row is ready `REACH` rows after it was
loaded.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, QUARTER, THIRD, ZERO, compiled, entry
from polsep.compute.rows_kernel import copy, subtract
from polsep.compute.threads import RowRange
from polsep.demosaic import guided as twin
from polsep.demosaic.cells_kernel import (
    GUARD,
    Grid,
    Source,
    blur_pixels_along,
    blur_pixels_down,
    polarize_row,
    reciprocal,
    sum_three,
)
from polsep.demosaic.guided_kernel import (
    COLORED,
    INTENSITY,
    RESIDUAL,
    SMOOTHED,
    Stream,
    guide_row,
    intensity_row,
    load_row,
    mean_nine,
    open_stream,
    residual_row,
    sum_nine,
)

#: Mirrored cells on each side of a row, beyond which errors do not reach the frame.
FULL_EDGE = twin.FULL_MARGIN + 12

#: Rows back from the newest one: the first stream's guide, its residual, the polarization of that, smooth and reliable.
_AROUND = INTENSITY + 2
_FIRST = _AROUND + 1
_POLARIZED = _FIRST + 2
_SMOOTH = _POLARIZED + twin.SMOOTH_RADIUS
_RELIABLE = _SMOOTH + 1
#: Rows by which the second stream is behind; its residual's mean over colours, polarization at pixels, and the result.
_BEHIND = _RELIABLE - SMOOTHED
_MEANS = _BEHIND + RESIDUAL + 1
_PIXELS = _MEANS + 1
REACH = _PIXELS + 1

_A0, _A1, _A3, _A4 = (np.float32(twin.AROUND[k]) for k in (4, 5, 1, 0))
_NOISE_MARGIN, _NOISE_FLOOR = np.float32(twin.NOISE_MARGIN), np.float32(twin.NOISE_FLOOR)
_NINTH = reciprocal(9)


class Between(NamedTuple):
    """Rings between the two streams and behind the second one, all ``[length, k, n]``.

    ``polarized``: s1 and s2 of three colours, of the first stream's residual; ``sums``, ``smooth``: over windows along
    the row, and all over. ``contradiction``: mean squared `analyser_residual`, ``detail``: mean squared detail of
    polarization, both over 3 cells. ``s0``: of the pixels of a cell, green, red and blue. ``means``: analysers, over
    colours. ``pixels``: s1, then s2. ``null [2, 4]``: vector of `analyser_residual`, by place. ``rows``: buffers.
    """

    polarized: NDArray[np.float32]
    sums: NDArray[np.float32]
    smooth: NDArray[np.float32]
    contradiction: NDArray[np.float32]
    detail: NDArray[np.float32]
    s0: NDArray[np.float32]
    means: NDArray[np.float32]
    pixels: NDArray[np.float32]
    null: NDArray[np.float32]
    rows: NDArray[np.float32]


class FullStream(NamedTuple):
    """Two streams, with rings in between; kernels take no more of it than they need, which compiles faster."""

    first: Stream
    second: Stream
    between: Between


def open_full_stream(source: Source, null: NDArray[np.float32], start: int) -> FullStream:
    """A stream whose results begin with the frame's row ``start``, an even one.

    ``source``: with a grid of edge `FULL_EDGE`. ``null [4]``: the vector of `analyser_residual`, by place.
    """
    n = source.grid.n
    raw = np.zeros((_BEHIND + RESIDUAL + 1, 4, n), np.float32)
    first, second = (open_stream(source, start)._replace(raw=raw, first=start - REACH) for _ in range(2))
    between = Between(
        np.zeros((_RELIABLE - _POLARIZED + 1, 6, n), np.float32),
        np.zeros((9, 6, n), np.float32),
        np.zeros((2, 6, n), np.float32),
        np.zeros((_RELIABLE - _POLARIZED + 2, n), np.float32),
        np.zeros((3, n), np.float32),
        np.zeros((REACH - _BEHIND - COLORED + 1, 12, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((3, 8, n), np.float32),
        np.stack([null, np.zeros_like(null)]),
        np.zeros((16, n), np.float32),
    )
    return FullStream(first, second, between)


@compiled
def _around_down(above: Any, here: Any, below: Any, out: Any) -> None:
    """`guided._surroundings` down the columns, from every second row of cells ``[4, n]``."""
    for j in range(2):
        x0, x1, up0, up1 = here[j], here[2 + j], above[j], above[2 + j]
        down0, down1, upper, lower = below[j], below[2 + j], out[j], out[2 + j]
        for x in range(upper.size):
            upper[x] = _A0 * x0[x] + _A1 * x1[x] + _A3 * up1[x] + _A4 * (up0[x] + down0[x])
            lower[x] = _A0 * x1[x] + _A1 * x0[x] + _A3 * down0[x] + _A4 * (up1[x] + down1[x])


@compiled
def _around_along(planes: Any, out: Any) -> None:
    """`guided._surroundings` along a row of cells ``[4, n]``."""
    for i in range(2):
        x0, x1, first, second = (
            planes[2 * i, GUARD:],
            planes[2 * i + 1, GUARD:],
            out[2 * i, GUARD:],
            out[2 * i + 1, GUARD:],
        )
        before0, before1 = planes[2 * i, GUARD - 2 :], planes[2 * i + 1, GUARD - 2 :]
        after0, after1 = planes[2 * i, GUARD + 2 :], planes[2 * i + 1, GUARD + 2 :]
        for j in range(planes.shape[1] - 2 * GUARD):
            first[j] = _A0 * x0[j] + _A1 * x1[j] + _A3 * before1[j] + _A4 * (before0[j] + after0[j])
            second[j] = _A0 * x1[j] + _A1 * x0[j] + _A3 * after0[j] + _A4 * (before1[j] + after1[j])


@compiled
def _around_row(stream: Stream, r: int) -> None:
    """Each colour's surroundings in the mosaic of s0, and the detail beyond them, of row ``r``."""
    mosaic, tent, detail = stream.mosaic, stream.tent[r % 2], stream.detail[r % 3]
    length, down = mosaic.shape[0], stream.rows[0:4]
    here = mosaic[r % length]
    _around_down(mosaic[(r - 2) % length], here, mosaic[(r + 2) % length], down)
    _around_along(down, tent)
    for k in range(4):
        subtract(here[k], tent[k], detail[k])


@compiled
def _mean_square(x: Any, out: Any) -> None:
    """Mean square over three rows."""
    a, b, c = x[0], x[1], x[2]
    for j in range(out.size):
        out[j] = THIRD * (a[j] * a[j] + b[j] * b[j] + c[j] * c[j])


@compiled
def _add_square(x: Any, smooth: Any, out: Any) -> None:
    """Add a third of the squared detail."""
    for j in range(out.size):
        detail = x[j] - smooth[j]
        out[j] += THIRD * (detail * detail)


@compiled
def _polarize_first(residual: Any, stream: Between, r: int, grid: Grid) -> None:
    """Polarization of row ``r`` of the first ``residual``, its sums along the row, and the analysers' contradiction."""
    rows, polarized = stream.rows, stream.polarized[r % stream.polarized.shape[0]]
    polarize_row(residual, r, grid, stream.null, rows[6:9], rows[0:6].reshape(2, 3, grid.n))
    _mean_square(rows, rows[9])
    sum_three(rows[9], stream.contradiction[r % stream.contradiction.shape[0]])
    polarize_row(residual, r, grid, grid.inverse[1:3], rows[6:9], polarized.reshape(2, 3, grid.n))
    sum_nine(polarized.reshape(-1), stream.sums[r % 9].reshape(-1))


@compiled
def _smooth_first(stream: Between, r: int) -> None:
    """Smooth polarization of row ``r``, and what the row differs from it."""
    polarized, smooth, square = stream.polarized[r % stream.polarized.shape[0]], stream.smooth[r % 2], stream.rows[0]
    for j in range(square.size):
        square[j] = ZERO
    mean_nine(stream.sums, r, smooth)
    for k in range(6):
        _add_square(polarized[k], smooth[k], square)
    sum_three(square, stream.detail[r % 3])


@compiled
def _share(stream: Between, r: int, share: Any) -> None:
    """Share of the detail of polarization that counts. Twin: `guided._reliable`."""
    c = stream.contradiction
    n0, n1, n2 = c[(r - 1) % c.shape[0]], c[r % c.shape[0]], c[(r + 1) % c.shape[0]]
    d0, d1, d2 = stream.detail[(r - 1) % 3], stream.detail[r % 3], stream.detail[(r + 1) % 3]
    for j in range(share.size):
        detail = _NINTH * (d0[j] + d1[j] + d2[j])
        noise = _NOISE_MARGIN * (_NINTH * (n0[j] + n1[j] + n2[j])) + _NOISE_FLOOR
        counted = (detail - noise) / (detail + _NOISE_FLOOR)
        share[j] = counted if counted > ZERO else ZERO


@compiled
def _mix(x: Any, smooth: Any, share: Any, out: Any) -> None:
    """Smooth polarization and a share of the detail."""
    for j in range(out.size):
        out[j] = smooth[j] + share[j] * (x[j] - smooth[j])


@compiled
def _trust_row(stream: Between, r: int, out: Any) -> None:
    """Polarization of row ``r`` for the second stream to take out, to ``out [6, n]``."""
    share = stream.rows[0]
    polarized, smooth = stream.polarized[r % stream.polarized.shape[0]], stream.smooth[r % 2]
    _share(stream, r, share)
    for k in range(6):
        _mix(polarized[k], smooth[k], share, out[k])


@compiled
def _mean_of_colors(above: Any, here: Any, below: Any, other: Any, out: Any) -> None:
    """Mean over the colours of one analyser, bilinear between its samples. Twin: `bilinear.colors_of`."""
    x, up, down, is_other, mean = here[GUARD:], above[GUARD:], below[GUARD:], other[GUARD:], out[GUARD:]
    left, up_left, down_left = here[GUARD - 1 :], above[GUARD - 1 :], below[GUARD - 1 :]
    right, up_right, down_right = here[GUARD + 1 :], above[GUARD + 1 :], below[GUARD + 1 :]
    for j in range(out.size - 2 * GUARD):
        beside = (left[j] + right[j]) + (up[j] + down[j])
        across = (up_left[j] + up_right[j]) + (down_left[j] + down_right[j])
        mean[j] = THIRD * (x[j] + HALF * beside + QUARTER * is_other[j] * (across - beside))


@compiled
def _mean_colors(residual: Any, r: int, grid: Grid, means: Any) -> None:
    """Means over the colours of all analysers of row ``r``, to a ring ``means``."""
    for k in range(4):
        above, here, below = residual[(r - 1) % 5, k], residual[r % 5, k], residual[(r + 1) % 5, k]
        _mean_of_colors(above, here, below, grid.others[r % 2], means[r % 3, k])


@compiled
def _combine(x: Any, y: Any, z: Any, wx: Any, wy: Any, out: Any) -> None:
    """``out = wx x + wy (y + z) / 2``."""
    half = HALF * wy
    for j in range(out.size):
        out[j] = wx * x[j] + half * (y[j] + z[j])


@compiled
def _between(left: Any, right: Any, even: Any, odd: Any) -> None:
    """Sums over the left and the right analysers to even and odd pixels of a row."""
    a, a_next, b_last, b = left[GUARD:], left[GUARD + 1 :], right[GUARD - 1 :], right[GUARD:]
    x, y = even[GUARD:], odd[GUARD:]
    for j in range(left.size - 2 * GUARD):
        x[j] = a[j] + HALF * (b_last[j] + b[j])
        y[j] = b[j] + HALF * (a[j] + a_next[j])


@compiled
def _polarize_pixels(stream: Between, r: int, grid: Grid) -> None:
    """s1 and s2, means over colours, at the pixels of row ``r``. Twin: `fit_stokes` of `interpolate_analysers`."""
    left, right, pixels = stream.rows[0], stream.rows[1], stream.pixels[r % 3]
    here = stream.means[r % 3]
    for s in range(2):
        w = grid.inverse[1 + s]
        for i in range(2):
            own, others, beside = 2 * i, 2 - 2 * i, stream.means[(r - 1 + 2 * i) % 3]
            _combine(here[own], here[others], beside[others], w[own], w[others], left)
            _combine(here[own + 1], here[others + 1], beside[others + 1], w[own + 1], w[others + 1], right)
            _between(left, right, pixels[4 * s + own], pixels[4 * s + own + 1])


@compiled
def _keep_colors(green: Any, filled: Any, s0: Any) -> None:
    """s0 of a row, ``[12, n]``: of green, red and blue."""
    copy(green.reshape(-1), s0[0:4].reshape(-1))
    copy(filled.reshape(-1), s0[4:12].reshape(-1))


@compiled
def _join(even: Any, odd: Any, out: Any) -> None:
    for j in range(out.size // 2):
        out[2 * j] = even[j]
        out[2 * j + 1] = odd[j]


@compiled
def _write_row(stream: Between, r: int, edge: int, out: Any) -> None:
    """Both rows of pixels of row ``r`` to ``out [2, 5, 2 w]``."""
    rows, s0 = stream.rows, stream.s0[r % stream.s0.shape[0]]
    above, here, below = stream.pixels[(r - 1) % 3], stream.pixels[r % 3], stream.pixels[(r + 1) % 3]
    for s in range(2):
        blur_pixels_down(above[4 * s :], here[4 * s :], below[4 * s :], QUARTER, rows[0:4])
        blur_pixels_along(rows[0:4], rows[4 + 4 * s : 8 + 4 * s])
    for i in range(2):
        for c in range(3):
            plane = 4 * (c if c == 2 else 1 - c) + 2 * i  # green comes first, then red and blue
            _join(s0[plane, edge:], s0[plane + 1, edge:], out[i, c])
        for s in range(2):
            plane = 4 + 4 * s + 2 * i
            _join(rows[plane, edge:], rows[plane + 1, edge:], out[i, 3 + s])


@compiled
def _push_row(source: Source, u: int, stream: FullStream, out: Any) -> None:
    """Read a row as the stream's ``u``-th, and write the row `REACH` above it."""
    grid, first, second, between = source.grid, stream.first, stream.second, stream.between
    load_row(source, u, first)
    intensity_row(first, u - INTENSITY, grid)
    _around_row(first, u - _AROUND)
    residual_row(first, u - _FIRST)
    _polarize_first(first.residual, between, u - _POLARIZED, grid)
    _smooth_first(between, u - _SMOOTH)
    _trust_row(between, u - _RELIABLE, second.smooth[(u - _RELIABLE) % 3])

    guide_row(second, u - _BEHIND, grid)
    r = u - _BEHIND - COLORED
    _keep_colors(second.green[r % second.green.shape[0]], second.filled[r % 3], between.s0[r % between.s0.shape[0]])
    _mean_colors(second.residual, u - _MEANS, grid, between.means)
    _polarize_pixels(between, u - _PIXELS, grid)
    _write_row(between, u - REACH, grid.edge, out)


@entry
def demosaic_pixels(source: Source, stream: FullStream, row_range: RowRange, out: Any) -> None:
    """The pixels of the frame's cell rows of a range, which continues the one before, to ``out [2 rows, 5, 2 w]``.

    A row is s0 of three colours and the means over colours of s1 and s2.
    """
    pushed, begin = stream.first.pushed, stream.first.first
    for t in range(row_range[0], row_range[1]):
        row = 2 * (t - row_range[0])
        while begin + pushed[0] <= t + REACH:
            _push_row(source, pushed[0], stream, out[row : row + 2])
            pushed[0] += 1
