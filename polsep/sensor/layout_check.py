"""Check that a frame agrees with its layout, by the identity m0 + m90 = m45 + m135.

Four analysers 45 degrees apart obey the identity whatever the light. In a 2x2 cell it fixes which samples are crossed
pairs: those on the diagonals (Sony's order and all its shifts, mirrors and rotations), in the rows, or in the columns.
Colour sensors show more: the colour changes from cell to cell, which gives the cells' alignment, and the two greens lie
on one diagonal of the Bayer block.

The identity does not show these: 0 and 90 swapped, 45 and 135 swapped, or the two pairs swapped obey it too, and so do
red and blue. A mirrored, rotated or transposed MONO frame therefore looks in order. Of those only whole frames of known
sensors are seen, which stand upright when they were transposed or turned. A transposed COLOUR frame, or one turned by
180 degrees, has AoLP wrong by 90 degrees: that shows where objects are round and coloured (`slope_check`).

All statistics are means over blocks of 16x16 pixels, first-order corrected for the brightness gradient, without blocks
that hold a clipped sample, in units of the mean brightness. The light's colour is left in: what is compared are the
filters, whatever the light.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.compute.warm_up import make_ready
from polsep.sensor import periods_kernel
from polsep.sensor.camera import CLIP_MARGIN, Layout, Mosaic, first_frame
from polsep.sensor.periods_kernel import sum_periods
from polsep.sensor.slope_check import lies_across, turned_across

Floats = NDArray[np.float32]

#: Mean contradiction of a layout, relative to brightness, below which it is never called wrong.
MIN_CONTRADICTION = 0.006
#: Analysers' gains may differ: a contradiction that is this share of the brightness everywhere is not counted. Real
#: IMX250MZR frames show 2 %.
GAIN_TOLERANCE = 0.03
#: A layout is only called wrong when it contradicts the data this many times more than another one.
MIN_RATIO = 2.0
#: Median difference between neighbouring cells, relative to brightness, from which on a sensor may show colour, and
#: below which cells are alike, whatever their texture; below the third they are alike whatever they agree on. Real mono
#: frames show up to 0.024, real colour frames 0.10 and more.
MIN_COLOR, MAX_MONO, EVEN = 0.03, 0.02, 0.007
#: Differences are those of filters where blocks agree: with their neighbours, or all of them. Rendered and real mono
#: frames, where texture makes the differences: up to 0.36 with neighbours, and 0.09 of all; colour frames 0.45 or more
#: of either, but for grey and small objects, which are not judged.
MIN_AGREEMENT, MIN_COMMON, MAX_DISAGREEMENT, MAX_COMMON = 0.4, 0.25, 0.25, 0.1
#: Fewest blocks whose disagreement says something, and how much more than at any other alignment cells must differ.
MIN_BLOCKS, MIN_EXCESS = 60, 1.15
#: Ratio to the alignment where cells differ least: above the first it shows colour without agreement, below the second
#: it may be mono. Mono frames: mostly 1 to 5, up to 7.1; colour frames 5.4 to 90.
CLEAR, VAGUE = 6.0, 5.2
#: Median difference of all blocks that chance may give, times the root of their number.
CHANCE = 1.6
#: Ratio to all other alignments that shows colour without agreement. Mono frames: up to 2.1.
FAR = 2.2

#: Quantile of brightness that may be a black level nobody stated, and the largest share of the mean taken for it.
DARK, MAX_DARK = 0.01, 0.8

#: Strips of a large frame, rows of one, a multiple of the blocks' 16, and how many times that a frame has to have.
STRIPS, STRIP, LARGE = 4, 64, 16

#: Width and height of whole frames of Sony's polarization sensors: IMX250, IMX264 and IMX253, without and with borders.
SENSOR_SIZES = {(2448, 2048), (2464, 2056), (4096, 3000), (4112, 3008)}

_PAIRINGS = {
    "diagonals": np.array([1.0, -1.0, -1.0, 1.0], np.float32),
    "rows": np.array([1.0, 1.0, -1.0, -1.0], np.float32),
    "columns": np.array([1.0, -1.0, 1.0, -1.0], np.float32),
}
#: Orders tried when the crossed pairs lie elsewhere than the layout says.
_ORDERS = {"diagonals": ((90, 45), (135, 0)), "rows": ((0, 90), (45, 135)), "columns": ((0, 45), (90, 135))}


@dataclass(frozen=True)
class LayoutCheck:
    """Result of the check. ``warning`` is one line, or None when nothing contradicts the layout.

    ``pairs``: which samples of a cell are crossed ("diagonals", "rows", "columns"), None if the light is too little
    polarized. ``color``: True, False, or None if grey. ``fits``: layouts that agree with the frame.
    """

    warning: str | None
    pairs: str | None
    color: bool | None
    fits: tuple[Layout, ...]


def crossed_pairs(layout: Layout) -> str | None:
    """Position of a layout's crossed analysers in the cell; None when its angles are not 45 degrees apart."""
    (a, b), (c, d) = layout.polarizer
    for name, (first, second) in {
        "diagonals": (a - d, b - c),
        "rows": (a - b, c - d),
        "columns": (a - c, b - d),
    }.items():
        if abs(first % 180 - 90) < 1e-6 and abs(second % 180 - 90) < 1e-6:
            return name
    return None


def _strips(mosaic: Mosaic) -> list[Floats]:
    """The first frame's samples; of a large one `STRIPS` of them: as reliable, in an eighth of the time."""
    frame = first_frame(mosaic)
    height = frame.shape[0]
    step = height // STRIPS // STRIP * STRIP
    tops, size = (range(0, STRIPS * step, step), STRIP) if height >= LARGE * STRIP else (range(1), height)
    return [to_numpy(frame[top : top + size]).astype(np.float32, copy=False) for top in tops]


def _strip_means(mosaic: Mosaic, data: Floats) -> Floats:
    """Means ``[4, 4, blocks]`` of each pixel of the 4x4 period over 16x16 blocks, gradients removed.

    ``data [H, W]``: samples of the mosaic. Blocks with clipped samples are left out. Codes are pooled and their means
    made linear: no copy of the frame.
    """
    side = 16 if min(data.shape) >= 64 else 4
    sums, brightest = sum_periods(data, side, side)
    means = _linear(mosaic, sums / np.float32((side // 4) ** 2))
    brightness = means.mean((0, 1))
    slope_y, slope_x = _gradient(brightness, 0) / side, _gradient(brightness, 1) / side
    average = float(brightness.mean())
    share = means.mean((2, 3), keepdims=True) / (average if average > 1e-9 else 1.0)
    place = np.arange(4, dtype=np.float32) - 1.5
    shift = place[:, None, None, None] * slope_y + place[None, :, None, None] * slope_x
    usable = _linear(mosaic, brightest) < 1 - CLIP_MARGIN
    corrected: Floats = (means - share * shift)[..., usable]
    return corrected


def _linear(mosaic: Mosaic, codes: Floats) -> Floats:
    """Means of codes with black at 0 and white at 1, in the light they are in."""
    span = np.float32(mosaic.white_level - mosaic.black_level)
    linear: Floats = (codes - np.float32(mosaic.black_level)) / span
    return linear


def _gradient(x: Floats, axis: int) -> Floats:
    """Central differences per block, one-sided at the ends."""
    return np.zeros_like(x) if x.shape[axis] < 2 else np.gradient(x, axis=axis)


def phase_cells(phases: Floats, origin: tuple[int, int]) -> Floats:
    """The four cells of a Bayer block and their four pixels, ``[4 cells, 4 pixels, blocks]``, for an alignment."""
    turned = np.roll(phases, (-origin[0], -origin[1]), (0, 1))
    blocks = phases.shape[-1]
    return np.stack([turned[r : r + 2, c : c + 2].reshape(4, blocks) for r in (0, 2) for c in (0, 2)])


def _contradictions(cells: Floats) -> dict[str, float]:
    """Mean contradiction of every pairing relative to s0, beyond a gain error common to the frame."""
    s0 = 0.5 * cells.sum(1)
    found = {}
    for name, signs in _PAIRINGS.items():
        missed = np.einsum("k,ckn->cn", signs, cells)
        gain = float(np.median(missed / np.maximum(s0, 1e-6)))
        missed = missed - max(-GAIN_TOLERANCE, min(GAIN_TOLERANCE, gain)) * s0
        found[name] = float(np.abs(missed).mean()) / max(float(s0.mean()), 1e-9)
    return found


class ColorPattern(NamedTuple):
    """Difference of neighbouring cells at one alignment.

    ``contrast``: its median relative to light. ``agreement``: correlation of the differences of neighbouring blocks, in
    [-1, 1]. ``common``: median difference over the mean size, in [0, 3]. ``greens``: +1 for greens on the
    antidiagonal, -1 on the other. ``blocks``: their number.
    """

    contrast: float
    agreement: float
    common: float
    greens: float
    blocks: int


def _color_pattern(cells: Floats, dark: float) -> ColorPattern:
    """Difference of the cells of one alignment; ``dark``: brightness of all samples, as of a black level not stated."""
    brightness = cells.mean(1)
    differences = np.stack(list(_PAIRINGS.values())) @ brightness / 4
    _, rows, columns = differences
    parts = differences / np.maximum(brightness.mean(0) - dark, 1e-9)
    size = np.abs(parts).sum(0)
    contrast = float(np.median(size)) if size.size else 0.0
    # Edges differ most, and are few: they count no more than the median.
    limited = parts / np.maximum(np.maximum(size, contrast), 1e-9)
    agreement = float((limited[:, 1:] * limited[:, :-1]).sum()) / max(float((limited**2).sum()), 1e-9)
    common = float(np.abs(np.median(limited, axis=1)).sum()) if size.size else 0.0
    power = float(np.sqrt((rows**2).sum() * (columns**2).sum()))
    return ColorPattern(contrast, agreement, common, float((rows * columns).sum()) / max(power, 1e-12), size.size)


def phase_means(mosaic: Mosaic) -> Floats:
    """Means ``[4, 4, blocks]`` of each pixel of the 4x4 period, linear: of the first frame, of a large one some strips.

    All checks of filters compare them. See `_strip_means`; frames of less than 16 pixels have no blocks.
    """
    if min(mosaic.data.shape[-2:]) < 16:
        return np.zeros((4, 4, 0), np.float32)
    make_ready(periods_kernel.warm_up)
    return np.concatenate([_strip_means(mosaic, strip) for strip in _strips(mosaic)], -1)


def check_layout(mosaic: Mosaic, phases: Floats | None = None) -> LayoutCheck:
    """Compare a frame (the first of a batch) with its own layout; never raises, and stays silent when in doubt.

    ``phases``: its `phase_means`, where they are known.
    """
    phases = phase_means(mosaic) if phases is None else phases
    if phases.shape[-1] < 16 or float(phases.mean()) <= 1e-4:
        return LayoutCheck(None, None, None, (mosaic.layout,))
    color, origin, greens = _find_color(phases, mosaic.layout)
    contradiction = _contradictions(phase_cells(phases, origin))
    pairs = _find_pairs(contradiction, mosaic.layout)
    fits = _fitting(mosaic.layout, color, origin, greens, pairs)
    layouts = tuple(fits)
    if mosaic.layout in fits:
        return LayoutCheck(_upright(mosaic) or (_across(mosaic) if color else None), pairs, color, layouts)
    likely, reason = next(iter(fits.items()))
    if _stands_upright(mosaic):
        whole = _turned(mosaic.layout)
    elif color and mosaic.layout == Layout() and mosaic.data.shape[:-3:-1] in SENSOR_SIZES:  # whole: no crop
        whole = _reversed(mosaic.layout)
    else:
        whole = likely, reason
    if whole[0] in fits:
        likely, reason = whole
    option = f"--layout {'mono' if likely == Layout(bayer=None) else likely.spec} ({reason})"
    if color is False and mosaic.layout.bayer is not None:
        warning = f"the frame shows no colour pattern: unless all it shows is grey, say {option}"
        return LayoutCheck(warning, pairs, color, layouts)
    return LayoutCheck(
        f"the frame contradicts layout {mosaic.layout.spec}: it fits {option}, the likeliest", pairs, color, layouts
    )


def _stands_upright(mosaic: Mosaic) -> bool:
    """True for a whole frame of a known sensor that was turned or transposed, under a layout that sensors have."""
    return mosaic.data.shape[-2:] in SENSOR_SIZES and mosaic.layout == Layout.sony(mosaic.layout.channels)


def _upright(mosaic: Mosaic) -> str | None:
    """A warning of a frame that stands upright although nothing in it contradicts its layout."""
    if not _stands_upright(mosaic):
        return None
    height, width = mosaic.data.shape[-2:]
    seen = f"the frame is {width}x{height}, a sensor's {height}x{width} turned or transposed"
    return (
        f"{seen}: say --layout {mosaic.layout.transposed().spec} (transposed), the likeliest, or save it as it was read"
    )


def _across(mosaic: Mosaic) -> str | None:
    """A warning of a colour frame whose AoLP is 90 degrees off; whole frames that stand are `_upright`'s."""
    layout = mosaic.layout
    if mosaic.data.shape[-2:] in SENSOR_SIZES or not lies_across(mosaic):
        return None
    around = layout.flipped_horizontal(4).flipped_vertical(4)
    return (
        f"surfaces are polarized across their slopes under layout {layout.spec}: say --layout "
        f"{turned_across(layout).spec} (transposed, the likeliest; if turned by 180 degrees, {around.spec})"
    )


def _turned(layout: Layout) -> tuple[Layout, str]:
    """The layout of frames turned by a right angle, which swap red and blue: the reason names the other one too."""
    left, right = layout.transposed().flipped_vertical(4), layout.transposed().flipped_horizontal(4)
    return left, f"turned to the left; if to the right, {right.spec}"


def _reversed(layout: Layout) -> tuple[Layout, str]:
    """The layout of mirrored whole frames, which differ in red and blue: the reason names the other one too."""
    left_right, top_bottom = layout.flipped_horizontal(4), layout.flipped_vertical(4)
    return left_right, f"mirrored left-right; if top-bottom, {top_bottom.spec}"


def _find_color(phases: Floats, layout: Layout) -> tuple[bool | None, tuple[int, int], float]:
    """Return if cells differ in colour, the alignment where they differ most, and the greens' diagonal (0: unknown)."""
    brightness = phases.mean((0, 1))
    dark = max(float(np.quantile(brightness, DARK)), 0.0) if float(brightness.min()) > 0 else 0.0
    dark = dark if dark < MAX_DARK * float(brightness.mean()) else 0.0
    phases = phases[..., brightness - dark > 0.1 * (brightness.mean() - dark)]
    origins = [(0, 0), (0, 1), (1, 0), (1, 1)]
    found = {origin: _color_pattern(phase_cells(phases, origin), dark) for origin in origins}
    best = max(origins, key=lambda origin: found[origin].contrast)
    pattern = found[best]
    others = [found[origin].contrast for origin in origins if origin != best]
    sharp = pattern.contrast > MIN_EXCESS * max(others)
    agreed = pattern.agreement > MIN_AGREEMENT or pattern.common > MIN_COMMON + CHANCE / max(pattern.blocks, 1) ** 0.5
    clear = pattern.contrast > max(CLEAR * min(others), FAR * max(others))
    if sharp and pattern.contrast > MIN_COLOR and (agreed or clear):
        return True, best, pattern.greens
    plain = pattern.agreement < MAX_DISAGREEMENT and pattern.common < MAX_COMMON
    plain = plain and pattern.contrast < VAGUE * min(others)
    mono = plain and (pattern.contrast < MAX_MONO or (sharp and pattern.blocks > MIN_BLOCKS))
    return (False if mono or pattern.contrast < EVEN else None), layout.origin, 0.0


def _find_pairs(contradiction: dict[str, float], layout: Layout) -> str | None:
    """The pairing the identity singles out, the layout's own one if that does not contradict, None if undecided."""
    claimed = crossed_pairs(layout)
    best = min(contradiction, key=lambda name: contradiction[name])
    runner_up = sorted(contradiction.values())[1]
    if claimed is None or runner_up < MIN_CONTRADICTION:
        return None
    if contradiction[claimed] > MIN_CONTRADICTION and contradiction[claimed] > MIN_RATIO * contradiction[best]:
        return best
    return claimed if claimed == best and runner_up > MIN_RATIO * contradiction[best] else None


def _fitting(
    layout: Layout, color: bool | None, origin: tuple[int, int], greens: float, pairs: str | None
) -> dict[Layout, str]:
    """Layouts that agree with what was found and the mistakes they stand for, the likeliest first; never empty."""

    def agrees(candidate: Layout) -> bool:
        if color is not None and (candidate.bayer is not None) != color:
            return False
        if color and candidate.origin != origin:
            return False
        if color and abs(greens) > 0.5 and (candidate.bayer in ("RGGB", "BGGR")) != (greens > 0):
            return False
        return pairs is None or crossed_pairs(candidate) in (pairs, None)

    found: dict[Layout, str] = {}
    for candidate, reason in _candidates(layout):
        if agrees(candidate):
            found.setdefault(candidate, reason)
    return found or {layout: "as given"}


@lru_cache(maxsize=8)
def _candidates(layout: Layout) -> tuple[tuple[Layout, str], ...]:
    """The layout and what common mistakes make of it; then other orders of the analysers and mono for colour."""
    sony = Layout.sony(layout.channels)
    mistakes = [
        (layout, "as given"),
        (sony, "Sony's order"),
        *_cropped(layout)[:3],
        *_mirrored(layout),
        *_cropped(layout)[3:],
    ]
    for order in _ORDERS.values():
        other = Layout(order, layout.bayer)
        mistakes += [(other, "another order of analysers")]
        mistakes += [(crop, f"another order of analysers, {reason}") for crop, reason in _cropped(other)]
    bayer, swapped = (None, "mono read as colour") if layout.bayer else ("RGGB", "colour read as mono")
    for other in (Layout(layout.polarizer, bayer), *(Layout(order, bayer) for order in _ORDERS.values())):
        mistakes += [(other, swapped), *((crop, f"{swapped}, {reason}") for crop, reason in _cropped(other))]
    return (*mistakes, _turned(layout))


def _cropped(layout: Layout) -> list[tuple[Layout, str]]:
    """The layout of frames whose crop starts a few rows and columns inside the sensor's, the smallest crops first.

    In colour the reason names the crop two rows and columns farther too, which differs in red and blue.
    """
    starts = sorted(((row, col) for row in range(4) for col in range(4) if row or col), key=lambda start: sum(start))
    return [(layout.rolled(-row, -col), _crop_reason(layout, row, col)) for row, col in starts]


def _crop_reason(layout: Layout, row: int, col: int) -> str:
    reason, (other_row, other_col) = f"cropped from row {row}, column {col} on", ((row + 2) % 4, (col + 2) % 4)
    if layout.bayer is None:
        return reason
    return f"{reason}; if from row {other_row}, column {other_col}, {layout.rolled(-other_row, -other_col).spec}"


def _mirrored(layout: Layout) -> list[tuple[Layout, str]]:
    """The layout of mirrored and transposed frames whose sides are multiples of 4."""
    left_right, top_bottom = layout.flipped_horizontal(4), layout.flipped_vertical(4)
    return [
        (left_right, "mirrored left-right"),
        (top_bottom, "mirrored top-bottom"),
        (layout.transposed(), "transposed"),
    ]
