"""Twin of `bilinear.demosaic_bilinear_half`, one row of polarizer cells at a time, from sensor rows kept in a window.

Words: a cell row r holds sensor rows 2r and 2r + 1 (from the layout's origin); an analyser sits in one of them, its
``half`` 0 or 1, and in one column of the cell. On colour sensors the samples of one analyser and one Bayer column are
a ``phase`` of the sensor row, every fourth sample; a window keeps each phase contiguous so that loops vectorise.

Why the taps are what they are. Bayer interpolation (1/2, 1, 1/2) followed by the quarter step to the cell's centre
(3/4, 1/4, toward the ``near`` neighbour at +d) is one filter per direction: 7/8 and 1/8 (at 0, +2d) where the colour is
present, 3/8 and 5/8 (at -d, +d) where it is not. With q the samples of one column under that vertical filter and
a = 3/4 or 1/4 of the sample itself or the one below, green is the quarter step of (1/4, 1/2, 1/4) * a + q / 2.
Mirroring at the border and repeating the edge sample in the quarter step both become: repeat the last sample of the
phase. Only the quarter step of q / 2 and of a at the edge itself is not covered by that rule.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, QUARTER, ZERO, compiled
from polsep.sensor.camera import CLIP_MARGIN, Layout, check_frame
from polsep.sensor.unpack_kernel import Samples, read_row

#: Elements on each side of a phase for its repeated border sample; a cache line, so that phases stay aligned.
PAD = 16

#: Rows of each half that one cell row needs, by row number modulo 4.
SLOTS = 4

_OWN, _FAR = np.float32(0.875), np.float32(0.125)
_BACK, _NEAR = np.float32(0.375), np.float32(0.625)
_THREE_QUARTERS = np.float32(0.75)


class Pattern(NamedTuple):
    """Filters and levels of a mosaic, as kernels read them.

    ``h``, ``w``: rows and columns of cells. ``top``, ``left``: sensor row and column of the first one. ``channels``: 3
    or 1. ``places [4, 2]``: row and column in the cell of each analyser, in the order of `Layout.angles_deg`.
    ``bayer [2, 2]``: channels of a Bayer block. ``gains [2, 2]``: factor of each of them. ``clip_at``: smallest code
    that counts as clipped.
    """

    h: int
    w: int
    top: int
    left: int
    channels: int
    places: NDArray[np.int64]
    bayer: NDArray[np.int64]
    gains: NDArray[np.float32]
    black: np.float32
    clip_at: np.float32


class Window(NamedTuple):
    """The sensor rows around one cell row, linear and by phase: ``values`` and ``flags [2, 4, 4, n]``, float32.

    Axes: half of the cell, slot (cell row modulo 4), phase. ``flags`` is 1 on clipped samples and only kept for slots
    with ``flagged [2, 4]``. ``row``: one sensor row of codes. ``q [3, n]``: vertically filtered samples.
    """

    values: NDArray[np.float32]
    flags: NDArray[np.float32]
    flagged: NDArray[np.bool_]
    row: NDArray[np.float32]
    q: NDArray[np.float32]


def read_pattern(
    shape: tuple[int, int], layout: Layout, black_level: float, white_level: float, light_color: tuple[float, ...]
) -> Pattern:
    """Return the `Pattern` of a frame of that shape; gains divide the light's colour out, as `Mosaic.linear` does.

    Raises ValueError as `Mosaic` does, when white is not above black or the frame is smaller than one period.
    """
    check_frame(shape, layout, black_level, white_level)
    if len(light_color) < layout.channels or not all(gain > 0 for gain in light_color):
        raise ValueError(f"expected a light colour of {layout.channels} positive numbers, found {light_color!r}")
    cell = {float(layout.polarizer[row][col]): (row, col) for row in (0, 1) for col in (0, 1)}
    colors = [0] * 4 if layout.bayer is None else ["RGB".index(color) for color in layout.bayer]
    gains = [1 / ((white_level - black_level) * light_color[channel]) for channel in colors]
    return Pattern(
        (shape[0] - layout.origin[0]) // 2,
        (shape[1] - layout.origin[1]) // 2,
        layout.origin[0],
        layout.origin[1],
        layout.channels,
        np.array([cell[angle] for angle in layout.angles_deg], np.int64),
        np.array(colors, np.int64).reshape(2, 2),
        np.array(gains, np.float32).reshape(2, 2),
        np.float32(black_level),
        clip_code(black_level, white_level),
    )


def clip_code(black_level: float, white_level: float) -> np.float32:
    """The smallest float32 sample for which `Mosaic.clipped` is true, by bisection over all of them.

    A threshold on codes costs one comparison and agrees with the twin's rounding, which is monotonic, to the last bit.
    """
    black, scale = np.float32(black_level), np.float32(white_level - black_level)
    limit = np.float32(1 - CLIP_MARGIN)

    def ordered(key: int) -> np.float32:
        bits = np.uint32(key if key >= 0 else 0x80000000 - key - 1)
        return np.float32(bits.view(np.float32))

    low, high = -0x7F800000, 0x7F7FFFFF  # from the most negative to the largest finite number
    with np.errstate(over="ignore"):
        while low < high:
            middle = (low + high) // 2
            if (ordered(middle) - black) / scale >= limit:
                high = middle
            else:
                low = middle + 1
    return ordered(low)


@compiled
def make_window(pattern: Pattern) -> Window:
    """An empty window for frames of that pattern; each thread needs its own."""
    cols = pattern.w
    n = (cols if pattern.channels == 1 else (cols + 1) // 2) + 2 * PAD
    n += -n % PAD
    phases = 2 if pattern.channels == 1 else 4
    shape = (2, SLOTS, phases, n)
    return Window(
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros((2, SLOTS), np.bool_),
        np.empty(2 * cols, np.float32),
        np.zeros((3, n), np.float32),
    )


@compiled
def make_analysers(pattern: Pattern) -> Any:
    """A buffer ``[4, C, n]`` float32 for one cell row of all analysers and colours; n >= w, the rest is undefined."""
    return np.empty((4, pattern.channels, pattern.w + -pattern.w % PAD), np.float32)


@compiled
def _spread_phases(row: Any, black: Any, g0: Any, g1: Any, phases: Any) -> None:
    """A sensor row of codes as linear phases ``[4, n]``; ``g0``, ``g1``: gains of even and odd Bayer columns."""
    p0, p1, p2, p3 = phases[0, PAD:], phases[1, PAD:], phases[2, PAD:], phases[3, PAD:]
    for t in range(row.size // 4):
        p0[t] = (row[4 * t] - black) * g0
        p1[t] = (row[4 * t + 1] - black) * g0
        p2[t] = (row[4 * t + 2] - black) * g1
        p3[t] = (row[4 * t + 3] - black) * g1
    if row.size % 4:  # an odd number of cells: two samples of an even Bayer column are left
        t = row.size // 4
        p0[t] = (row[4 * t] - black) * g0
        p1[t] = (row[4 * t + 1] - black) * g0


@compiled
def _spread_halves(row: Any, black: Any, gain: Any, phases: Any) -> None:
    """`_spread_phases` on mono sensors: the two analysers of a sensor row, ``[2, n]``."""
    p0, p1 = phases[0, PAD:], phases[1, PAD:]
    for t in range(row.size // 2):
        p0[t] = (row[2 * t] - black) * gain
        p1[t] = (row[2 * t + 1] - black) * gain


@compiled
def _repeat_borders(phases: Any, cols: int) -> None:
    """Continue every phase by its first and last sample."""
    for phase in range(phases.shape[0]):
        count = cols if phases.shape[0] == 2 else (cols + 1 - phase // 2) // 2
        phases[phase, PAD - 1] = phases[phase, PAD]
        phases[phase, PAD + count] = phases[phase, PAD + count - 1]
        phases[phase, PAD + count + 1] = phases[phase, PAD + count - 1]


@compiled
def _spread(pattern: Pattern, row: Any, black: Any, g0: Any, g1: Any, phases: Any) -> None:
    """``(row - black) gain`` by phase, borders repeated."""
    if pattern.channels == 1:
        _spread_halves(row, black, g0, phases)
    else:
        _spread_phases(row, black, g0, g1, phases)
    _repeat_borders(phases, pattern.w)


@compiled
def any_clipped(row: Any, clip_at: Any) -> bool:
    """True if a row of codes has a clipped one."""
    clipped = False
    for x in range(row.size):
        clipped |= row[x] >= clip_at
    return clipped


@compiled
def _load(samples: Samples, pattern: Pattern, window: Window, r: int, half: int) -> None:
    """Bring one sensor row of cell row ``r`` into the window."""
    slot, row = r % SLOTS, window.row
    read_row(samples, pattern.top + 2 * r + half, pattern.left, row)
    gains = pattern.gains[r % 2]
    _spread(pattern, row, pattern.black, gains[0], gains[1], window.values[half, slot])
    clipped = any_clipped(row, pattern.clip_at)
    if clipped or window.flagged[half, slot]:
        for x in range(row.size):
            row[x] = ONE if row[x] >= pattern.clip_at else ZERO
        _spread(pattern, row, ZERO, ONE, ONE, window.flags[half, slot])
    window.flagged[half, slot] = clipped


@compiled
def open_window(samples: Samples, pattern: Pattern, window: Window, r: int) -> None:
    """Load what cell row ``r`` shares with the one before it; `advance_window` continues from ``r``."""
    for half in range(2):
        for k in range(r - 1 - half, r + 2 - half):
            if 0 <= k < pattern.h:
                _load(samples, pattern, window, k, half)


@compiled
def advance_window(samples: Samples, pattern: Pattern, window: Window, r: int) -> bool:
    """Load the last rows that cell row ``r`` needs; call it for every row in order. True if any sample is clipped."""
    clipped = False
    for half in range(2):
        if r + 2 - half < pattern.h:
            _load(samples, pattern, window, r + 2 - half, half)
        for slot in range(SLOTS):
            clipped |= window.flagged[half, slot]
    return clipped


@compiled
def _filter_column(own: Any, far: Any, w_own: Any, w_far: Any, q: Any) -> None:
    """Vertical filter of one phase: ``q = w_own own + w_far far``, borders included."""
    for t in range(q.size):
        q[t] = w_own * own[t] + w_far * far[t]


@compiled
def _interpolate_color(q: Any, p: int, step: int, out: Any) -> None:
    """Horizontal filter of red or blue: one phase, of Bayer column ``p``, to all columns of cells."""
    own, far = q[PAD:], q[PAD + step :]
    back, near = q[PAD - p + (step < 0) :], q[PAD - p + (step > 0) :]
    if p == 0:
        for t in range(out.size // 2):
            out[2 * t] = _OWN * own[t] + _FAR * far[t]
            out[2 * t + 1] = _BACK * back[t] + _NEAR * near[t]
    else:
        for t in range(out.size // 2):
            out[2 * t] = _BACK * back[t] + _NEAR * near[t]
            out[2 * t + 1] = _OWN * own[t] + _FAR * far[t]


@compiled
def _interpolate_green(even_a: Any, odd_a: Any, q: Any, w: Any, v: Any, step: int, out: Any) -> None:
    """Quarter step of (1/4, 1/2, 1/4) * a + q / 2 along a row.

    Even and odd Bayer columns of green are two phases, with weights ``w`` and ``v``.
    """
    a0, a0_far = even_a[PAD:], even_a[PAD + step :]
    a1, a1_far = odd_a[PAD:], odd_a[PAD + step :]
    a1_back, a1_near = odd_a[PAD - (step > 0) :], odd_a[PAD - (step < 0) :]
    a0_back, a0_near = even_a[PAD + (step < 0) :], even_a[PAD + (step > 0) :]
    q0, q0_near, q1, q1_near = q[0, PAD:], q[0, PAD + (step > 0) :], q[1, PAD:], q[1, PAD - (step < 0) :]
    w_own, w_far, w_back, w_near = w * HALF * _OWN, w * HALF * _FAR, w * HALF * _BACK, w * HALF * _NEAR
    v_own, v_far, v_back, v_near = v * HALF * _OWN, v * HALF * _FAR, v * HALF * _BACK, v * HALF * _NEAR
    for t in range(out.size // 2):
        even = w_own * a0[t] + w_far * a0_far[t] + v_back * a1_back[t] + v_near * a1_near[t]
        odd = v_own * a1[t] + v_far * a1_far[t] + w_back * a0_back[t] + w_near * a0_near[t]
        out[2 * t] = even + _BACK * q0[t] + _FAR * q1_near[t]
        out[2 * t + 1] = odd + _BACK * q1[t] + _FAR * q0_near[t]


@compiled
def _interpolate_colors(pattern: Pattern, rows: Any, q: Any, r: int, out: Any) -> None:
    """`interpolate_row` on colour sensors."""
    rows_of_cells, cols = pattern.h, pattern.w
    green_first = pattern.bayer[r % 2, 0] == 1
    for k in range(4):
        half, place = pattern.places[k]
        d, step = 1 - 2 * half, 1 - 2 * place
        edge = not 0 <= r + d < rows_of_cells
        own = r % SLOTS
        near = (r - d if edge else r + d) % SLOTS
        back = (r - d if 0 <= r - d < rows_of_cells else r + d) % SLOTS
        far = (r + 2 * d if 0 <= r + 2 * d < rows_of_cells else r) % SLOTS
        w_own, w_near = (ONE, ZERO) if edge else (_THREE_QUARTERS, QUARTER)
        for p in range(2):
            phase = 2 * p + place
            in_own_row = (p == 0) == green_first
            q_present, q_absent = (q[p], q[2]) if in_own_row else (q[2], q[p])
            _filter_column(rows[half, own, phase], rows[half, far, phase], _OWN, _FAR, q_present)
            _filter_column(rows[half, back, phase], rows[half, near, phase], _BACK, _NEAR, q_absent)
            channel = pattern.bayer[(r + 1) % 2 if in_own_row else r % 2, p]
            _interpolate_color(q[2], p, step, out[k, channel])
        even, odd = (own, near) if green_first else (near, own)
        w, v = (w_own, w_near) if green_first else (w_near, w_own)
        even_a, odd_a = rows[half, even, place], rows[half, odd, 2 + place]
        _interpolate_green(even_a, odd_a, q, w, v, step, out[k, 1])
        j = cols - 1 if step > 0 else 0  # the quarter step repeats the edge: green is a mean over two columns
        i = (j if j % 2 == 0 else j - step) // 2
        both = w * even_a[PAD + i] + v * odd_a[PAD + (j if j % 2 else j - step) // 2]
        out[k, 1, j] = HALF * (both + q[j % 2, PAD + j // 2])


@compiled
def _center(upper: Any, lower: Any, w: Any, step: int, out: Any) -> None:
    """The quarter step in both directions."""
    v, n = ONE - w, out.size
    own, own_next = upper[PAD : PAD + n], upper[PAD + step : PAD + step + n]
    near, near_next = lower[PAD : PAD + n], lower[PAD + step : PAD + step + n]
    for j in range(n):
        here, there = w * own[j] + v * near[j], w * own_next[j] + v * near_next[j]
        out[j] = _THREE_QUARTERS * here + QUARTER * there


@compiled
def _interpolate_mono(pattern: Pattern, rows: Any, r: int, out: Any) -> None:
    """`interpolate_row` on mono sensors."""
    for k in range(4):
        half, place = pattern.places[k]
        near = r + 1 - 2 * half
        near = near if 0 <= near < pattern.h else r
        _center(
            rows[half, r % SLOTS, place], rows[half, near % SLOTS, place], _THREE_QUARTERS, 1 - 2 * place, out[k, 0]
        )


@compiled
def interpolate_row(pattern: Pattern, window: Window, r: int, out: Any) -> None:
    """Fill ``out [4, C, n]`` (of `make_analysers`) with all analysers and colours at the centres of cell row ``r``.

    Analysers in the order of `Layout.angles_deg`, black 0, white 1, the light's colour divided out.
    """
    if pattern.channels == 1:
        _interpolate_mono(pattern, window.values, r, out)
    else:
        _interpolate_colors(pattern, window.values, window.q, r, out)


@compiled
def flag_row(pattern: Pattern, window: Window, r: int, out: Any) -> None:
    """The weight of clipped samples in each value of `interpolate_row`: above 0 where any contributed."""
    if pattern.channels == 1:
        _interpolate_mono(pattern, window.flags, r, out)
    else:
        _interpolate_colors(pattern, window.flags, window.q, r, out)
