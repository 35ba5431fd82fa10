"""Twin of `guided.demosaic_guided_half` as a stream of cell rows, on the CPU: raw rows in, Stokes rows out.

A row passes through a line of rings: bilinear polarization and its smoothing, the mosaic of s0, green
(`demosaic.green_kernel`), red and blue (`demosaic.colors_kernel`), the guide, the residual and its polarization. The
result of a row is ready `REACH` rows after it was loaded. Every step is a filter of finite reach, so rows do not depend
on where a stream began.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, QUARTER, THIRD, TWO, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_product, add_rows, copy, fill, subtract
from polsep.compute.threads import RowRange
from polsep.demosaic import guided as twin
from polsep.demosaic.cells_kernel import (
    GUARD,
    Grid,
    Source,
    blur_gently,
    blur_gently_down,
    blur_pixels_along,
    blur_pixels_down,
    choose,
    detail_cells,
    load_cells,
    mean_cells,
    polarize_row,
    reciprocal,
)
from polsep.demosaic.colors_kernel import FILLED, Colors, fill_colors_row, make_colors
from polsep.demosaic.green_kernel import GREEN, Green, fill_green_row, make_green

#: Rows back from the newest one: bilinear polarization, its smoothing, the mosaic of s0, green, all colours, the
#: guide's tent, the residual, its polarization, and the result.
_POLARIZED = 2
SMOOTHED = _POLARIZED + twin.SMOOTH_RADIUS
INTENSITY = SMOOTHED + 1
_GREEN = INTENSITY + GREEN
COLORED = _GREEN + FILLED
_TENT = COLORED + 1
RESIDUAL = _TENT + 1
_REPOLARIZED = RESIDUAL + 2
REACH = _REPOLARIZED + 1

_WINDOW = reciprocal((2 * twin.SMOOTH_RADIUS + 1) ** 2)
_GAIN = np.float32(twin.DETAIL_GAIN)
_THREE_QUARTERS = np.float32(3 / 4)


class Stream(NamedTuple):
    """Rings of one stream of rows ``[length, k, n]``; every thread needs its own.

    ``raw``: samples. ``sums``: s1 and s2 of three colours, over the cells of a row's window; ``smooth``: over all.
    ``mosaic``: s0 of each pixel's colour. ``means [length, n]``: its cells'. ``green``, ``filled``: s0. ``total``: cell
    means of red, green, blue, and the details of all three where asked for. ``tent``, ``detail``: of the guide.
    ``residual``: samples minus half the guide. ``polarized``: s1 and s2, means over colours or of each.
    ``sensor_row``, ``rows``: buffers. ``first``: row of the frame that the stream begins with, an even one. ``pushed
    [1]``: rows so far.
    """

    raw: NDArray[np.float32]
    sums: NDArray[np.float32]
    smooth: NDArray[np.float32]
    mosaic: NDArray[np.float32]
    means: NDArray[np.float32]
    green: NDArray[np.float32]
    filled: NDArray[np.float32]
    total: NDArray[np.float32]
    tent: NDArray[np.float32]
    detail: NDArray[np.float32]
    residual: NDArray[np.float32]
    polarized: NDArray[np.float32]
    sensor_row: NDArray[np.float32]
    rows: NDArray[np.float32]
    for_green: Green
    for_colors: Colors
    first: int
    pushed: NDArray[np.int64]


def open_stream(source: Source, start: int, apart: bool = False, details: bool = False) -> Stream:
    """A stream whose results begin with the frame's row ``start``, an even one.

    ``apart``: with s1, s2 of every colour; ``details``, then only: and with those of s0.
    """
    n = source.grid.n
    return Stream(
        np.zeros((RESIDUAL + 1, 4, n), np.float32),
        np.zeros((9, 6, n), np.float32),
        np.zeros((3, 6, n), np.float32),
        np.zeros((_TENT - INTENSITY + 1, 4, n), np.float32),
        np.zeros((_GREEN - INTENSITY + 2, n), np.float32),
        np.zeros((RESIDUAL - _GREEN + 1, 4, n), np.float32),
        np.zeros((3, 8, n), np.float32),
        np.zeros((REACH - COLORED + 1, 12 if details else 3, n), np.float32),
        np.zeros((2, 4, n), np.float32),
        np.zeros((3, 4, n), np.float32),
        np.zeros((5, 4, n), np.float32),
        np.zeros((3, 6 if apart else 2, n), np.float32),
        np.empty(2 * source.pattern.w, np.float32),
        np.zeros((16, n), np.float32),
        make_green(n),
        make_colors(n),
        start - REACH - REACH % 2,
        np.zeros(1, np.int64),
    )


@compiled
def sum_nine(x: Any, out: Any) -> None:
    """Sums of nine neighbours along a row, or along rows that lie one behind the other."""
    a, b, c, d = x[GUARD - 4 :], x[GUARD - 3 :], x[GUARD - 2 :], x[GUARD - 1 :]
    e, f, g, h, i = x[GUARD:], x[GUARD + 1 :], x[GUARD + 2 :], x[GUARD + 3 :], x[GUARD + 4 :]
    total = out[GUARD:]
    for j in range(x.size - 2 * GUARD):
        total[j] = (((a[j] + b[j]) + (c[j] + d[j])) + ((e[j] + f[j]) + (g[j] + h[j]))) + i[j]


@compiled
def mean_nine(ring: Any, r: int, out: Any) -> None:
    """The means over the nine rows of sums about row ``r``, always added in the same order; ``out``: as a row of it."""
    a, b, c = ring[(r - 4) % 9].reshape(-1), ring[(r - 3) % 9].reshape(-1), ring[(r - 2) % 9].reshape(-1)
    d, e, f = ring[(r - 1) % 9].reshape(-1), ring[r % 9].reshape(-1), ring[(r + 1) % 9].reshape(-1)
    g, h, i = ring[(r + 2) % 9].reshape(-1), ring[(r + 3) % 9].reshape(-1), ring[(r + 4) % 9].reshape(-1)
    means = out.reshape(-1)
    for j in range(means.size):
        total = (((a[j] + b[j]) + (c[j] + d[j])) + ((e[j] + f[j]) + (g[j] + h[j]))) + i[j]
        means[j] = _WINDOW * total


@compiled
def _enlarge_own(here: Any, beside: Any, out: Any) -> None:
    """Cells of this row and of the next one above or below to a row of pixels' height."""
    for j in range(out.size):
        out[j] = _THREE_QUARTERS * here[j] + QUARTER * beside[j]


@compiled
def _subtract_polarization(color: Any, green: Any, other: Any, weight: Any, place: int, mosaic: Any) -> None:
    """Subtract ``weight`` times one of two rows of cells, interpolated along the row, from one plane of the mosaic.

    ``color`` where ``other`` is 1, at red and blue, else ``green``.
    """
    step = 1 if place % 2 else -1
    yes, yes_beside = color[GUARD:], color[GUARD + step :]
    no, no_beside = green[GUARD:], green[GUARD + step :]
    here, plane = other[GUARD:], mosaic[GUARD:]
    for j in range(mosaic.size - 2 * GUARD):
        at_other = _THREE_QUARTERS * yes[j] + QUARTER * yes_beside[j]
        at_green = _THREE_QUARTERS * no[j] + QUARTER * no_beside[j]
        plane[j] -= weight * (here[j] * at_other + (ONE - here[j]) * at_green)


@compiled
def intensity_row(stream: Stream, r: int, grid: Grid) -> None:
    """Row ``r`` of the mosaic of s0. Twin: `guided._intensity_mosaic`."""
    rows, raw, mosaic = stream.rows, stream.raw[r % stream.raw.shape[0]], stream.mosaic[r % stream.mosaic.shape[0]]
    other = grid.others[r % 2]
    for k in range(4):
        fill(ZERO, mosaic[k])
        add_product(raw[k], TWO, mosaic[k])
        cells, beside = stream.smooth[r % 3], stream.smooth[(r + (1 if k // 2 else -1)) % 3]
        for s, weight in enumerate((grid.cosines[k], grid.sines[k])):
            if weight != ZERO:
                color, green = 3 * s + grid.colors[r % 2], 3 * s + 1
                _enlarge_own(cells[color], beside[color], rows[0])
                _enlarge_own(cells[green], beside[green], rows[1])
                _subtract_polarization(rows[0], rows[1], other, weight, k, mosaic[k])
    mean_cells(mosaic, stream.means[r % stream.means.shape[0]])


@compiled
def _tent_row(stream: Stream, r: int, grid: Grid) -> None:
    """The tent of s0 in each cell's own colour, and the detail that the mosaic has beyond it, of row ``r``."""
    rows, tent, detail = stream.rows, stream.tent[r % 2], stream.detail[r % 3]
    length, first = stream.green.shape[0], 4 * (grid.colors[r % 2] // 2)
    above, here, below = stream.green[(r - 1) % length], stream.green[r % length], stream.green[(r + 1) % length]
    blur_pixels_down(above, here, below, QUARTER, rows[0:4])
    above, here, below = stream.filled[(r - 1) % 3], stream.filled[r % 3], stream.filled[(r + 1) % 3]
    blur_pixels_down(above[first:], here[first:], below[first:], QUARTER, rows[4:8])
    blur_pixels_along(rows[0:4], rows[8:12])
    blur_pixels_along(rows[4:8], rows[12:16])
    mosaic = stream.mosaic[r % stream.mosaic.shape[0]]
    for k in range(4):
        choose(grid.others[r % 2], rows[12 + k], rows[8 + k], tent[k])
        subtract(mosaic[k], tent[k], detail[k])


@compiled
def residual_row(stream: Stream, r: int) -> None:
    """Row ``r`` of the samples minus half their guide. Twin: `guided._residual_mosaic`."""
    rows, tent, residual = stream.rows, stream.tent[r % 2], stream.residual[r % 5]
    above, here, below = stream.detail[(r - 1) % 3], stream.detail[r % 3], stream.detail[(r + 1) % 3]
    blur_pixels_down(above, here, below, QUARTER, rows[0:4])
    blur_pixels_along(rows[0:4], rows[4:8])
    raw = stream.raw[r % stream.raw.shape[0]]
    for k in range(4):
        x, base, detail, out = raw[k], tent[k], rows[4 + k], residual[k]
        for j in range(x.size):
            out[j] = x[j] - HALF * (base[j] + _GAIN * detail[j])


@compiled
def _repolarize_row(stream: Stream, r: int, grid: Grid) -> None:
    """Polarization of the residual of row ``r``, mean over colours or of each."""
    rows = stream.rows
    sums = rows[0:6].reshape(2, 3, grid.n)
    polarize_row(stream.residual, r, grid, grid.inverse[1:3], rows[6:9], sums)
    if stream.polarized.shape[1] == 6:
        for k in range(6):
            blur_gently(rows[k], stream.polarized[r % 3, k])
        return
    for s in range(2):
        add_rows(sums[s, 0], sums[s, 1], sums[s, 2], THIRD, rows[9])
        blur_gently(rows[9], stream.polarized[r % 3, s])


@compiled
def load_row(source: Source, u: int, stream: Stream) -> None:
    """Read a row as the stream's ``u``-th, mirrored into the frame; smooth polarization of the row `SMOOTHED` above."""
    rows, grid, last = stream.rows, source.grid, source.pattern.h - 1
    mirrored = last - abs((stream.first + u) % (2 * last) - last)
    load_cells(source, mirrored, stream.sensor_row, stream.raw[u % stream.raw.shape[0]])
    r = u - _POLARIZED
    polarize_row(stream.raw, r, grid, grid.inverse[1:3], rows[6:9], rows[0:6].reshape(2, 3, grid.n))
    sum_nine(rows[0:6].reshape(-1), stream.sums[r % 9].reshape(-1))
    r = u - SMOOTHED
    mean_nine(stream.sums, r, stream.smooth[r % 3])


@compiled
def guide_row(stream: Stream, u: int, grid: Grid) -> None:
    """From smooth polarization of row ``u - SMOOTHED`` on to s0 of row ``u - COLORED``, residual of ``u - RESIDUAL``.

    Twin: `guided._guide`.
    """
    r = u - INTENSITY
    intensity_row(stream, r, grid)
    fill_green_row(stream.mosaic, stream.means, r, grid, stream.for_green, stream.green)
    fill_colors_row(stream.mosaic, stream.green, u - _GREEN, grid, stream.for_colors, stream.filled)
    _tent_row(stream, u - _TENT, grid)
    residual_row(stream, u - RESIDUAL)


@compiled
def _push_row(source: Source, u: int, stream: Stream, out: Any) -> None:
    """Read a row as the stream's ``u``-th, and write the row `REACH` above it."""
    rows, grid = stream.rows, source.grid
    load_row(source, u, stream)
    guide_row(stream, u, grid)
    r = u - COLORED
    total = stream.total[r % stream.total.shape[0]]
    mean_cells(stream.filled[r % 3], total[0])
    mean_cells(stream.green[r % stream.green.shape[0]], total[1])
    mean_cells(stream.filled[r % 3, 4:], total[2])
    if total.shape[0] > 3:
        detail_cells(stream.filled[r % 3], total[3:6])
        detail_cells(stream.green[r % stream.green.shape[0]], total[6:9])
        detail_cells(stream.filled[r % 3, 4:], total[9:12])
    _repolarize_row(stream, u - _REPOLARIZED, grid)

    r = u - REACH
    total = stream.total[r % stream.total.shape[0]]
    for c in range(3):
        copy(total[c][grid.edge :], out[c])
    above, here, below = stream.polarized[(r - 1) % 3], stream.polarized[r % 3], stream.polarized[(r + 1) % 3]
    for s in range(above.shape[0]):
        blur_gently_down(above[s], here[s], below[s], rows[0])
        copy(rows[0][grid.edge :], out[3 + s])
    for k in range(3, total.shape[0]):
        copy(total[k][grid.edge :], out[above.shape[0] + k])


@entry
def demosaic_rows(source: Source, stream: Stream, row_range: RowRange, out: Any) -> None:
    """The frame's cell rows of a range, which continues the one before, to ``out [rows, 5, w]``.

    A row is s0 of three colours and the means over colours of s1 and s2; of a stream ``apart``, each colour's s1, then
    s2, ``[rows, 9, w]``, and with details those of each colour, ``[rows, 18, w]``.
    """
    for t in range(row_range[0], row_range[1]):
        while stream.first + stream.pushed[0] <= t + REACH:
            _push_row(source, stream.pushed[0], stream, out[t - row_range[0]])
            stream.pushed[0] += 1
