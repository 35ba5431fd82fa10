"""Twin of `bilinear.demosaic_bilinear`, rows of cells in and rows of pixels out, on the CPU.

Two steps, as in the twin. `interpolate_cells` makes all colours of every analyser where that analyser sits, a row of
cells at a time, from the window of `bilinear_kernel`; three such rows are kept in a ring. `interpolate_pixels` makes a
row of pixels of them: an analyser's own samples stay, the others are means of two or four.

Even and odd columns of cells lie apart, as the phases of the window do, so that loops vectorise: ``x[0, PAD + t]`` is
cell 2t, ``x[1, PAD + t]`` cell 2t + 1, and a row of pixels interleaves four columns. On mono sensors they lie together.
Mirroring at the border and repeating the edge both become: repeat the last cell (see `bilinear_kernel`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, QUARTER, compiled
from polsep.demosaic.bilinear_kernel import PAD, SLOTS, Pattern, Window, advance_window, make_window, open_window
from polsep.sensor.unpack_kernel import Samples

#: Rows of cells that a row of pixels needs, and one more for `_mean_rows`.
_RING = 3


class Cells(NamedTuple):
    """Rows of cells around one: of all analysers and colours, ``values [3, 4, C, 2, n]`` by row number modulo 3.

    ``flags`` like it: the weight of clipped samples, only kept for rows with ``flagged [3]``. ``q``, ``mean [2, n]``:
    buffers.
    """

    window: Window
    values: NDArray[np.float32]
    flags: NDArray[np.float32]
    flagged: NDArray[np.bool_]
    q: NDArray[np.float32]
    mean: NDArray[np.float32]


@compiled
def make_cells(pattern: Pattern) -> Cells:
    """An empty ring for frames of that pattern; each thread needs its own."""
    window = make_window(pattern)
    columns, n = 1 if pattern.channels == 1 else 2, window.q.shape[1]
    shape = (_RING, 4, pattern.channels, columns, n)
    return Cells(
        window,
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(_RING, np.bool_),
        np.zeros((2, n), np.float32),
        np.zeros((columns, n), np.float32),
    )


@compiled
def make_pixels(pattern: Pattern, channels: int) -> Any:
    """A buffer ``[4, channels, n]`` float32 for one row of pixels of all analysers; n >= 2 w, the rest is undefined."""
    return np.zeros((4, channels, 2 * (pattern.w + -pattern.w % PAD)), np.float32)


@compiled
def _mean(x: Any, y: Any, out: Any) -> None:
    for t in range(out.size):
        out[t] = HALF * (x[t] + y[t])


@compiled
def _present(x: Any, first: int, own: Any, between: Any) -> None:
    """A colour along a row: ``x`` at its own columns of cells, means at the others, each of x[t + first] and the next.

    """
    a, b = x[PAD + first :], x[PAD + first + 1 :]
    here, there, there_own = own[PAD:], between[PAD:], x[PAD:]
    for t in range(own.size - 2 * PAD):
        here[t] = there_own[t]
        there[t] = HALF * (a[t] + b[t])


@compiled
def _green(g: Any, up: Any, down: Any, first: int, own: Any, between: Any) -> None:
    """Green along a row: ``g`` at its own columns; at the others the mean of four, two from the rows ``up``, ``down``."""
    a, b, c, d = g[PAD + first :], g[PAD + first + 1 :], up[PAD:], down[PAD:]
    here, there, there_own = own[PAD:], between[PAD:], g[PAD:]
    for t in range(own.size - 2 * PAD):
        here[t] = there_own[t]
        there[t] = QUARTER * ((a[t] + b[t]) + (c[t] + d[t]))


@compiled
def _repeat_edges(x: Any, cols: int) -> None:
    """Continue a row of ``cols`` cells by its first and last one."""
    if x.shape[0] == 1:
        x[0, PAD - 1], x[0, PAD + cols] = x[0, PAD], x[0, PAD + cols - 1]
    else:
        x[1, PAD - 1] = x[0, PAD]
        x[cols % 2, PAD + cols // 2] = x[1 - cols % 2, PAD + (cols - 1) // 2]


@compiled
def _interpolate_colors(pattern: Pattern, rows: Any, q: Any, r: int, out: Any) -> None:
    """`interpolate_cells` on colour sensors. Twin: `bilinear._bayer_bilinear`."""
    own = r % SLOTS
    up, down = (r - 1 if r > 0 else 1) % SLOTS, (r + 1 if r + 1 < pattern.h else r - 1) % SLOTS
    green = 0 if pattern.bayer[r % 2, 0] == 1 else 1  # the column of the row's green, and where it is from there
    other, before, before_other = 1 - green, -green, green - 1
    color, far_color = pattern.bayer[r % 2, other], pattern.bayer[(r + 1) % 2, green]
    for k in range(4):
        half, place = pattern.places[k]
        here, above, below = rows[half, own], rows[half, up], rows[half, down]
        g, x = 2 * green + place, 2 * other + place
        _present(here[x], before_other, out[k, color, other], out[k, color, green])
        _mean(above[g], below[g], q[0])
        _present(q[0], before, out[k, far_color, green], out[k, far_color, other])
        _green(here[g], above[x], below[x], before, out[k, 1, green], out[k, 1, other])
        for c in range(3):
            _repeat_edges(out[k, c], pattern.w)


@compiled
def _copy_mono(pattern: Pattern, rows: Any, r: int, out: Any) -> None:
    """`interpolate_cells` on mono sensors: the samples themselves."""
    for k in range(4):
        half, place = pattern.places[k]
        x, cells = rows[half, r % SLOTS, place], out[k, 0, 0]
        for t in range(cells.size):
            cells[t] = x[t]
        _repeat_edges(out[k, 0], pattern.w)


@compiled
def _interpolate_cells(pattern: Pattern, rows: Any, q: Any, r: int, out: Any) -> None:
    """All analysers and colours of cell row ``r``, each where it sits, to ``out [4, C, 2, n]``."""
    if pattern.channels == 1:
        _copy_mono(pattern, rows, r, out)
    else:
        _interpolate_colors(pattern, rows, q, r, out)


@compiled
def _enter_row(samples: Samples, pattern: Pattern, cells: Cells, r: int) -> None:
    """Bring cell row ``r`` into the ring, if the frame has it."""
    if not 0 <= r < pattern.h:
        return
    flagged, slot = advance_window(samples, pattern, cells.window, r), r % _RING
    _interpolate_cells(pattern, cells.window.values, cells.q, r, cells.values[slot])
    if flagged:
        _interpolate_cells(pattern, cells.window.flags, cells.q, r, cells.flags[slot])
    elif cells.flagged[slot]:
        flat = cells.flags[slot].reshape(-1)
        for t in range(flat.size):
            flat[t] = 0
    cells.flagged[slot] = flagged


@compiled
def open_cells(samples: Samples, pattern: Pattern, cells: Cells, r: int) -> None:
    """Load what cell row ``r`` shares with the one before it; `advance_cells` continues from ``r``."""
    open_window(samples, pattern, cells.window, max(r - 1, 0))
    _enter_row(samples, pattern, cells, r - 1)
    _enter_row(samples, pattern, cells, r)


@compiled
def advance_cells(samples: Samples, pattern: Pattern, cells: Cells, r: int) -> bool:
    """Load the last row that cell row ``r`` needs; call it for every row in order. True if any sample is clipped."""
    _enter_row(samples, pattern, cells, r + 1)
    return cells.flagged[0] or cells.flagged[1] or cells.flagged[2]


@compiled
def _widen(x0: Any, x1: Any, place: int, out: Any) -> None:
    """A row of cells to a row of pixels: four columns of pixels from even and odd cells."""
    if place == 0:
        a, b, c = x0[PAD:], x1[PAD:], x0[PAD + 1 :]
        for t in range(out.size // 4):
            out[4 * t] = a[t]
            out[4 * t + 1] = HALF * (a[t] + b[t])
            out[4 * t + 2] = b[t]
            out[4 * t + 3] = HALF * (b[t] + c[t])
    else:
        a, b, c = x1[PAD - 1 :], x0[PAD:], x1[PAD:]
        for t in range(out.size // 4):
            out[4 * t] = HALF * (a[t] + b[t])
            out[4 * t + 1] = b[t]
            out[4 * t + 2] = HALF * (b[t] + c[t])
            out[4 * t + 3] = c[t]


@compiled
def _widen_mono(x: Any, place: int, out: Any) -> None:
    """`_widen` of cells that lie together."""
    if place == 0:
        a, b = x[PAD:], x[PAD + 1 :]
        for t in range(out.size // 2):
            out[2 * t] = a[t]
            out[2 * t + 1] = HALF * (a[t] + b[t])
    else:
        a, b = x[PAD - 1 :], x[PAD:]
        for t in range(out.size // 2):
            out[2 * t] = HALF * (a[t] + b[t])
            out[2 * t + 1] = b[t]


@compiled
def _interpolate_row(pattern: Pattern, ring: Any, mean: Any, y: int, c: int, out: Any) -> None:
    """All analysers of channel ``c`` in row ``y`` of pixels, to ``out [4, n]``. Twin: `bilinear._to_full`."""
    r = y // 2
    for k in range(4):
        half, place = pattern.places[k]
        beside = r + 1 - 2 * half
        row = ring[r % _RING, k, c]
        if half != y % 2 and 0 <= beside < pattern.h:
            _mean(row.reshape(-1), ring[beside % _RING, k, c].reshape(-1), mean.reshape(-1))
            row = mean
        if pattern.channels == 1:
            _widen_mono(row[0], place, out[k, 0])
        else:
            _widen(row[0], row[1], place, out[k, c % out.shape[1]])


@compiled
def interpolate_pixels(pattern: Pattern, cells: Cells, y: int, c: int, out: Any) -> None:
    """Fill ``out [4, n]`` with all analysers of channel ``c`` in row ``y`` of pixels, from row y // 2 of cells.

    Analysers in the order of `Layout.angles_deg`, black 0, white 1, the light's colour divided out.
    """
    _interpolate_row(pattern, cells.values, cells.mean, y, c, out)


@compiled
def flag_pixels(pattern: Pattern, cells: Cells, y: int, c: int, out: Any) -> None:
    """The weight of clipped samples in each value of `interpolate_pixels`: above 0 where any contributed."""
    _interpolate_row(pattern, cells.flags, cells.mean, y, c, out)
