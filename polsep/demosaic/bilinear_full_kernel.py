"""Twin of `bilinear.demosaic_bilinear`, rows of cells in and rows of pixels out, on the CPU.

Two steps, as in the twin. Rows of cells, kept in a ring, hold all colours of every analyser where that analyser sits
(`advance_cells`), interpolated from the window of `bilinear_kernel`. A row of pixels is made of them: an analyser's own
samples stay, the others are means of two or four. Since both are linear, what is wanted of the analysers, Stokes
vectors say, is summed before the last step (`interpolate_pixels`).

Even columns of cells lie before odd ones, so that loops vectorise: cell 2t of a row ``x [2 n]`` is ``x[PAD + t]`` and
cell 2t + 1 is ``x[n + PAD + t]``; a row of pixels interleaves four columns. Mirroring at the border and repeating the
edge both become: repeat the last cell (see `bilinear_kernel`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, QUARTER, THIRD, ZERO, compiled
from polsep.compute.rows_kernel import add_rows, fill
from polsep.demosaic.bilinear_kernel import PAD, SLOTS, Pattern, Window, advance_window, make_window, open_window
from polsep.sensor.unpack_kernel import Samples

#: Rows of cells that two rows of pixels need.
_RING = 3


class Cells(NamedTuple):
    """Rows of cells around one: of all analysers and colours, ``values [3, 4, C, 2 n]`` by row number modulo 3.

    ``flags`` like it: the weight of clipped samples, only kept for rows with ``flagged [3]``. ``means [3, 4, 2 n]``:
    over the colours. ``analysers [2, 2]``: at every place of the cell. ``q [n]``, ``sums [2, 2 n]``: buffers.
    """

    window: Window
    values: NDArray[np.float32]
    flags: NDArray[np.float32]
    flagged: NDArray[np.bool_]
    means: NDArray[np.float32]
    analysers: NDArray[np.int64]
    q: NDArray[np.float32]
    sums: NDArray[np.float32]


class Sources(NamedTuple):
    """Six rows of cells ``[2 n]`` of one colour from which a row of pixels is made.

    ``left``, ``right``: of the two analysers in that row. ``left_near``, ``left_far``, ``right_near``, ``right_far``:
    of the two others, their rows next to it.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    left_near: NDArray[np.float32]
    left_far: NDArray[np.float32]
    right_near: NDArray[np.float32]
    right_far: NDArray[np.float32]


@compiled
def make_cells(pattern: Pattern) -> Cells:
    """An empty ring for frames of that pattern; each thread needs its own."""
    n = (pattern.w + 1) // 2 + 2 * PAD
    n += -n % PAD
    shape, analysers = (_RING, 4, pattern.channels, 2 * n), np.empty((2, 2), np.int64)
    for k in range(4):
        analysers[pattern.places[k, 0], pattern.places[k, 1]] = k
    return Cells(
        make_window(pattern),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(_RING, np.bool_),
        np.zeros((_RING, 4, 1, 2 * n), np.float32),
        analysers,
        np.zeros(n, np.float32),
        np.zeros((2, 2 * n), np.float32),
    )


@compiled
def make_pixels(pattern: Pattern, planes: int, rows: int) -> Any:
    """A buffer ``[planes, rows, n]`` float32 for rows of pixels; n is 2 w or a little more, a multiple of 2 PAD.

    It begins at a cache line: stores of a line's length take twice as long across two of them.
    """
    n = 2 * (pattern.w + -pattern.w % PAD)
    size = planes * rows * n
    numbers = np.zeros(size + PAD, np.float32)
    first = -(numbers.ctypes.data // 4) % PAD
    return numbers[first : first + size].reshape(planes, rows, n)


@compiled
def _mean(x: Any, y: Any, out: Any) -> None:
    for t in range(out.size):
        out[t] = HALF * (x[t] + y[t])


@compiled
def _present(x: Any, first: int, own: Any, between: Any) -> None:
    """A colour along a row: ``x`` at its own columns of cells, at the others the mean of x[t + first] and the next."""
    a, b, c, here, there = x[PAD + first :], x[PAD + first + 1 :], x[PAD:], own[PAD:], between[PAD:]
    for t in range(x.size - 2 * PAD):
        here[t] = c[t]
        there[t] = HALF * (a[t] + b[t])


@compiled
def _green(x: Any, up: Any, down: Any, first: int, own: Any, between: Any) -> None:
    """Green along a row: as `_present`, but the mean of four, two of them from the rows ``up`` and ``down``."""
    a, b, c, here, there = x[PAD + first :], x[PAD + first + 1 :], x[PAD:], own[PAD:], between[PAD:]
    above, below = up[PAD:], down[PAD:]
    for t in range(x.size - 2 * PAD):
        here[t] = c[t]
        there[t] = QUARTER * ((a[t] + b[t]) + (above[t] + below[t]))


@compiled
def _part(x: Any, even: Any, odd: Any) -> None:
    """Even and odd columns of cells of a row that holds them together."""
    a, b, c = x[PAD:], even[PAD:], odd[PAD:]
    for t in range((x.size - 2 * PAD) // 2):
        b[t] = a[2 * t]
        c[t] = a[2 * t + 1]


@compiled
def _repeat_edges(even: Any, odd: Any, cols: int) -> None:
    """Continue a row of ``cols`` cells by its first and last one."""
    odd[PAD - 1] = even[PAD]
    if cols % 2 == 0:
        even[PAD + cols // 2] = odd[PAD + cols // 2 - 1]
    else:
        odd[PAD + cols // 2] = even[PAD + cols // 2]


@compiled
def _interpolate_colors(pattern: Pattern, rows: Any, q: Any, r: int, out: Any) -> None:
    """`_interpolate_cells` on colour sensors. Twin: `bilinear._bayer_bilinear`."""
    own = r % SLOTS
    up, down = (r - 1 if r > 0 else 1) % SLOTS, (r + 1 if r + 1 < pattern.h else r - 1) % SLOTS
    green = 0 if pattern.bayer[r % 2, 0] == 1 else 1  # the columns of the row's green, and of its other colour
    other, n = 1 - green, q.size
    color, far_color = pattern.bayer[r % 2, other], pattern.bayer[(r + 1) % 2, green]
    for k in range(4):
        half, place = pattern.places[k]
        here, above, below = rows[half, own], rows[half, up], rows[half, down]
        g, x = 2 * green + place, 2 * other + place
        _present(here[x], green - 1, out[k, color, other * n :], out[k, color, green * n :])
        _mean(above[g], below[g], q)
        _present(q, -green, out[k, far_color, green * n :], out[k, far_color, other * n :])
        _green(here[g], above[x], below[x], -green, out[k, 1, green * n :], out[k, 1, other * n :])


@compiled
def _interpolate_cells(pattern: Pattern, rows: Any, q: Any, r: int, out: Any) -> None:
    """All analysers and colours of cell row ``r``, each where it sits, to ``out [4, C, 2 n]``."""
    if pattern.channels == 3:
        _interpolate_colors(pattern, rows, q, r, out)
    else:
        for k in range(4):
            half, place = pattern.places[k]
            _part(rows[half, r % SLOTS, place], out[k, 0], out[k, 0, q.size :])
    for k in range(4):
        for c in range(pattern.channels):
            _repeat_edges(out[k, c], out[k, c, q.size :], pattern.w)


@compiled
def _enter_row(samples: Samples, pattern: Pattern, cells: Cells, r: int) -> None:
    """Bring cell row ``r`` into the ring, if the frame has it."""
    if not 0 <= r < pattern.h:
        return
    flagged, slot = advance_window(samples, pattern, cells.window, r), r % _RING
    values, flags, means = cells.values[slot], cells.flags[slot], cells.means[slot]
    _interpolate_cells(pattern, cells.window.values, cells.q, r, values)
    if flagged:
        _interpolate_cells(pattern, cells.window.flags, cells.q, r, flags)
    elif cells.flagged[slot]:
        fill(ZERO, flags.reshape(-1))
    cells.flagged[slot] = flagged
    for k in range(4 if pattern.channels == 3 else 0):
        add_rows(values[k, 0], values[k, 1], values[k, 2], THIRD, means[k, 0])


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
    return any_flagged(cells)


@compiled
def any_flagged(cells: Cells) -> bool:
    """True if any sample in the ring is clipped."""
    return bool(cells.flagged[0] or cells.flagged[1] or cells.flagged[2])


@compiled
def sources_of(pattern: Pattern, analysers: Any, ring: Any, y: int, c: int) -> Sources:
    """The rows of a ``ring [3, 4, C, 2 n]`` for channel ``c`` of row ``y`` of pixels. Twin: `bilinear._to_full`."""
    half, here = y % 2, ring[y // 2 % _RING]
    beside = ring[min(max(y // 2 + 2 * half - 1, 0), pattern.h - 1) % _RING]
    left, right = analysers[1 - half, 0], analysers[1 - half, 1]
    return Sources(
        here[analysers[half, 0], c],
        here[analysers[half, 1], c],
        here[left, c],
        beside[left, c],
        here[right, c],
        beside[right, c],
    )


@compiled
def weights_of(analysers: Any, matrix: Any, y: int) -> Any:
    """Columns of a ``matrix [K, 4]`` for `Sources` in row ``y`` of pixels: left, right, and halves of the others."""
    half, weights = y % 2, np.empty((4, matrix.shape[0]), np.float32)
    for k in range(matrix.shape[0]):
        for place in range(2):
            weights[place, k] = matrix[k, analysers[half, place]]
            weights[2 + place, k] = HALF * matrix[k, analysers[1 - half, place]]
    return weights


@compiled
def _combine(x: Any, y: Any, z: Any, wx: Any, wy: Any, out: Any) -> None:
    """``out = wx x + wy (y + z)``."""
    for t in range(out.size):
        out[t] = wx * x[t] + wy * (y[t] + z[t])


@compiled
def _widen(p: Any, q: Any, out: Any) -> None:
    """A row of cells to a row of pixels, from sums over the left and over the right analysers ``p``, ``q [2 n]``."""
    n = p.size // 2
    left, left_odd, left_next = p[PAD:], p[n + PAD :], p[PAD + 1 :]
    right_last, right, right_odd = q[n + PAD - 1 :], q[PAD:], q[n + PAD :]
    for t in range(out.size // 4):
        a, b, c, d = left[t], left_odd[t], right[t], right_odd[t]
        out[4 * t] = a + HALF * (right_last[t] + c)
        out[4 * t + 1] = HALF * (a + b) + c
        out[4 * t + 2] = b + HALF * (c + d)
        out[4 * t + 3] = HALF * (b + left_next[t]) + d


@compiled
def interpolate_pixels(pattern: Pattern, cells: Cells, ring: Any, matrix: Any, y: int, out: Any) -> None:
    """Fill ``out [C, K, n]`` with sums of the analysers, weighted by a ``matrix [K, 4]``, of row ``y`` of pixels.

    ``ring``: of ``cells``. Analysers in the order of `Layout.angles_deg`, black 0, white 1, the light's colour divided
    out. Of flags, sums are above 0 where a clipped sample contributed.
    """
    weights, p, q = weights_of(cells.analysers, matrix, y), cells.sums[0], cells.sums[1]
    for c in range(out.shape[0]):
        x = sources_of(pattern, cells.analysers, ring, y, c)
        for k in range(out.shape[1]):
            _combine(x.left, x.left_near, x.left_far, weights[0, k], weights[2, k], p)
            _combine(x.right, x.right_near, x.right_far, weights[1, k], weights[3, k], q)
            _widen(p, q, out[c, k])


@compiled
def _widen_left(x: Any, out: Any) -> None:
    """A row of cells ``[2 n]`` of a left analyser to a row of pixels."""
    even, odd, after = x[PAD:], x[x.size // 2 + PAD :], x[PAD + 1 :]
    for t in range(out.size // 4):
        out[4 * t] = even[t]
        out[4 * t + 1] = HALF * (even[t] + odd[t])
        out[4 * t + 2] = odd[t]
        out[4 * t + 3] = HALF * (odd[t] + after[t])


@compiled
def _widen_right(x: Any, out: Any) -> None:
    """A row of cells ``[2 n]`` of a right analyser to a row of pixels."""
    before, even, odd = x[x.size // 2 + PAD - 1 :], x[PAD:], x[x.size // 2 + PAD :]
    for t in range(out.size // 4):
        out[4 * t] = HALF * (before[t] + even[t])
        out[4 * t + 1] = even[t]
        out[4 * t + 2] = HALF * (even[t] + odd[t])
        out[4 * t + 3] = odd[t]


@compiled
def interpolate_analysers(pattern: Pattern, cells: Cells, ring: Any, y: int, out: Any) -> None:
    """Fill ``out [4, C, n]`` with all analysers and colours in row ``y`` of pixels; ``ring``: of ``cells``."""
    mean = cells.sums[0]
    for c in range(out.shape[1]):
        x = sources_of(pattern, cells.analysers, ring, y, c)
        own, others = cells.analysers[y % 2], cells.analysers[1 - y % 2]
        _widen_left(x.left, out[own[0], c])
        _widen_right(x.right, out[own[1], c])
        _mean(x.left_near, x.left_far, mean)
        _widen_left(mean, out[others[0], c])
        _mean(x.right_near, x.right_far, mean)
        _widen_right(mean, out[others[1], c])
