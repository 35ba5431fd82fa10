"""The compiled twin of `temporal.filter_samples`: raw rows and running means in, new means out, in one pass.

A strip of block rows runs through a ring: differences of a row to the means, in standard deviations, summed along the
row; `REACH` rows later the sums over windows, what moves, and the new means. Bits do not depend on how strips are cut.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows
from polsep.sensor.unpack_kernel import Samples, as_samples, read_row

#: Samples along the side of a block; block rows on either side that a row depends on, and rows of the ring.
BLOCK, REACH = 4, 2
SLOTS = 2 * REACH + 1
#: Least number of block rows of a task.
STEP = 16

_SIXTEENTH = np.float32(1 / 16)


class Rules(NamedTuple):
    """Numbers of `temporal.Rules` and of a frame's noise and levels, float32: see there."""

    gain: np.float32
    floor: np.float32
    black: np.float32
    clip: np.float32
    most: np.float32
    sudden: np.float32
    slow: np.float32
    rough: np.float32
    lag: np.float32


class Frames(NamedTuple):
    """``mean [H, W]`` and its ``number [H/4, W/4]`` of frames, before and after a frame, and that filtered ``[H, W]``.

    H and W are multiples of 4.
    """

    mean: NDArray[np.float32]
    number: NDArray[np.float32]
    new_mean: NDArray[np.float32]
    new_number: NDArray[np.float32]
    filtered: NDArray[np.float32]


class Ring(NamedTuple):
    """Statistics of `SLOTS` block rows: sums of differences over five blocks ``signed [., 4, W]``; others ``[., W/4]``.

    ``square``: sums over three blocks of mean squares; ``few`` and ``many``: how many of three and of five blocks
    are counted; ``sudden``: 1 in blocks that changed by themselves.
    """

    signed: NDArray[np.float32]
    square: NDArray[np.float32]
    few: NDArray[np.float32]
    many: NDArray[np.float32]
    sudden: NDArray[np.float32]


def filter_samples(raw: NDArray[Any], before: tuple[Any, Any], rules: Rules) -> tuple[Any, Any, Any]:
    """Samples ``[H, W]`` (uint8, uint16, float32) filtered, and the new means and counts, from those ``before``."""
    mean, count = before
    new = np.empty_like(mean), np.empty_like(count), np.empty_like(mean)
    frames = Frames(read_only(mean), read_only(count), *new)
    run_over_rows(partial(_filter_strip, as_samples(raw), frames, rules), count.shape[0], STEP)
    return frames.filtered, frames.new_mean, frames.new_number


def blend_images(images: tuple[Any, Any], weight: NDArray[Any], side: int) -> NDArray[np.float32]:
    """The second of two images ``[h, w, C]``, moved toward the first by the ``weight`` of each block.

    Blocks have ``side`` pixels. See `temporal.steady_images`.
    """
    shape = images[0].shape
    now, old = (read_only(np.ascontiguousarray(x, np.float32).reshape(shape[0], -1)) for x in images)
    new, sides = np.empty_like(now), (side, side * shape[2])
    run_over_rows(partial(_blend_rows, (now, old), read_only(weight), sides, new), shape[0], STEP)
    return new.reshape(shape)


def warm_up() -> None:
    """Load the kernels of a stream, or compile them."""
    raw, count = np.zeros((8, 8)), np.ones((2, 2), np.float32)
    rules = Rules(*(np.float32(1) for _ in Rules._fields))
    for dtype in (np.uint16, np.float32):
        filter_samples(raw.astype(dtype), (raw.astype(np.float32), count), rules)
    blend_images((np.zeros((4, 4, 3)), np.zeros((4, 4, 3))), count, 2)


@compiled
def _make_ring(cols: int) -> Any:
    signed = np.zeros((SLOTS, BLOCK, BLOCK * cols), np.float32)
    square, few = np.zeros((SLOTS, cols), np.float32), np.zeros((SLOTS, cols), np.float32)
    many, sudden = np.zeros((SLOTS, cols), np.float32), np.zeros((SLOTS, cols), np.float32)
    return Ring(signed, square, few, many, sudden)


@compiled
def _score_row(row: Any, mean: Any, spread: Any, rules: Any, scores: tuple[Any, Any]) -> None:
    """Differences of a sensor row to its means in standard deviations, and the sums of their squares so far."""
    score, total = scores
    for x in range(row.size):
        light = mean[x] - rules.black
        light = light if light > ZERO else ZERO
        deviation = np.sqrt((rules.gain * light + rules.floor) * spread[x])
        found = (row[x] - mean[x]) / deviation
        score[x] = found
        total[x] += found * found


@compiled
def _gather(total: Any, blocks: Any) -> None:
    """Sums over four columns, over 16."""
    for j in range(blocks.size):
        k = BLOCK * j
        blocks[j] = (total[k] + total[k + 1] + total[k + 2] + total[k + 3]) * _SIXTEENTH


@compiled
def _spread_out(blocks: Any, row: Any) -> None:
    for j in range(blocks.size):
        for k in range(BLOCK):
            row[BLOCK * j + k] = blocks[j]


@compiled
def _sum_along(x: Any, reach: int, step: int, total: Any) -> None:
    """Sums over 2 ``reach`` + 1 numbers ``step`` apart, fewer at the ends."""
    n = total.size
    for j in range(n):
        total[j] = x[j]
    for k in range(1, reach + 1):
        shift = min(k * step, n)
        for j in range(n - shift):
            total[j] += x[j + shift]
        for j in range(shift, n):
            total[j] += x[j - shift]


@compiled
def _sum_periods(x: Any, total: Any) -> None:
    """`_sum_along` of `REACH` on either side, a block apart."""
    n, one, two = total.size, BLOCK, 2 * BLOCK
    if n < 2 * two:
        _sum_along(x, REACH, BLOCK, total)
        return
    for j in range(one):
        total[j] = x[j] + x[j + one] + x[j + two]
        total[n - 1 - j] = x[n - 1 - j] + x[n - 1 - j - one] + x[n - 1 - j - two]
    for j in range(one, two):
        total[j] = (x[j] + x[j + one] + x[j - one]) + x[j + two]
        total[n - 1 - j] = (x[n - 1 - j] + x[n - 1 - j - one] + x[n - 1 - j + one]) + x[n - 1 - j - two]
    a, b, c, d, e, inside = x, x[one:], x[two:], x[one + two :], x[two + two :], total[two : n - two]
    for j in range(inside.size):
        inside[j] = (c[j] + d[j] + b[j]) + (e[j] + a[j])


@compiled
def _enter(source: tuple[Samples, Any], rules: Any, at: tuple[int, int], ring: Any, spare: tuple[Any, ...]) -> None:
    """Fill the slot of a block row; with zeros beyond the frame."""
    (samples, frames), (r, slot) = source, at
    rows, cols = frames.number.shape
    if r < 0 or r >= rows:
        ring.signed[slot, :, :] = ZERO
        ring.square[slot, :] = ZERO
        ring.few[slot, :] = ZERO
        ring.many[slot, :] = ZERO
        ring.sudden[slot, :] = ZERO
        return
    row, total, spread, scores, blocks, kept = spare
    for j in range(cols):
        blocks[j] = ONE + ONE / frames.number[r, j]
    _spread_out(blocks, spread)
    for x in range(total.size):
        total[x] = ZERO
    for k in range(BLOCK):
        read_row(samples, BLOCK * r + k, 0, row)
        _score_row(row, frames.mean[BLOCK * r + k], spread, rules, (scores[k], total))
    _gather(total, blocks)
    calm = ZERO
    for j in range(cols):
        kept[j] = ONE if blocks[j] <= rules.sudden else ZERO
        calm += kept[j]
        ring.sudden[slot, j] = ONE - kept[j]
        blocks[j] = blocks[j] if blocks[j] <= rules.sudden else ZERO
    _sum_along(blocks, 1, 1, ring.square[slot])
    _sum_along(kept, 1, 1, ring.few[slot])
    _sum_along(kept, REACH, 1, ring.many[slot])
    if calm < np.float32(cols):
        _spread_out(kept, spread)
        for k in range(BLOCK):
            score = scores[k]
            for x in range(score.size):
                score[x] = score[x] if spread[x] > ZERO else ZERO
    for k in range(BLOCK):
        _sum_periods(scores[k], ring.signed[slot, k])


@compiled
def _sum_windows(ring: Any, spare: tuple[Any, ...]) -> None:
    """Mean squares of the windows' signed sums to the fifth spare row."""
    _, total, _, _, blocks, _ = spare
    for x in range(total.size):
        total[x] = ZERO
    for k in range(BLOCK):
        a, b, c = ring.signed[0, k], ring.signed[1, k], ring.signed[2, k]
        d, e = ring.signed[3, k], ring.signed[4, k]
        for x in range(total.size):
            found = (a[x] + b[x]) + (c[x] + d[x]) + e[x]
            total[x] += found * found
    _gather(total, blocks)


@compiled
def _decide(ring: Any, at: tuple[int, int], rules: Any, blocks: Any, counts: tuple[Any, Any]) -> None:
    """New counts of a block row from its windows; ``at``: the slots of the rows above and below it."""
    count, new = counts
    above, below = at
    middle = (above + 1) % SLOTS
    last = count.size - 1
    for j in range(count.size):
        square = ring.square[above, j] + ring.square[middle, j] + ring.square[below, j]
        few = ring.few[above, j] + ring.few[middle, j] + ring.few[below, j]
        many = ZERO
        for slot in range(SLOTS):
            many += ring.many[slot, j]
        many = many if many > ONE else ONE
        drift = (blocks[j] / many - rules.slow) / many
        stir = square / (few if few > ONE else ONE) - rules.rough
        most = drift if drift > stir else stir
        lag = (most if most > ZERO else ZERO) * (ONE + ONE / count[j])
        grown = ONE + ONE / (ONE / count[j] + lag)
        left, right = max(j - 1, 0), min(j + 1, last)
        near = ZERO
        for slot in (above, middle, below):
            near += ring.sudden[slot, left] + ring.sudden[slot, j] + ring.sudden[slot, right]
        new[j] = ONE if near > ZERO or lag > rules.lag else min(grown, rules.most)


@compiled
def _average(row: Any, mean: Any, weight: Any, clip: Any, new: tuple[Any, Any]) -> None:
    """A row's new means, and the same with clipped samples as they are."""
    means, filtered = new
    for x in range(row.size):
        mixed = mean[x] + (row[x] - mean[x]) * weight[x]
        mixed = row[x] if weight[x] == ONE else mixed
        means[x] = mixed
        filtered[x] = row[x] if row[x] >= clip else mixed


@entry
def _filter_strip(samples: Samples, frames: Any, rules: Any, row_range: RowRange) -> None:
    cols = frames.number.shape[1]
    width = BLOCK * cols
    ring = _make_ring(cols)
    row, total, spread = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    scores = np.empty((BLOCK, width), np.float32)
    blocks, kept = np.empty(cols, np.float32), np.empty(cols, np.float32)
    spare = (row, total, spread, scores, blocks, kept)
    for r in range(row_range[0] - REACH, row_range[1] + REACH):
        _enter((samples, frames), rules, (r, (r + SLOTS) % SLOTS), ring, spare)
        here = r - REACH
        if here < row_range[0]:
            continue
        _sum_windows(ring, spare)
        near = ((here - 1 + SLOTS) % SLOTS, (here + 1) % SLOTS)
        _decide(ring, near, rules, blocks, (frames.number[here], frames.new_number[here]))
        for j in range(cols):
            blocks[j] = ONE / frames.new_number[here, j]
        _spread_out(blocks, spread)
        for k in range(BLOCK * here, BLOCK * here + BLOCK):
            read_row(samples, k, 0, row)
            _average(row, frames.mean[k], spread, rules.clip, (frames.new_mean[k], frames.filtered[k]))


@compiled
def _blend(row: Any, old: Any, part: Any, out: Any) -> None:
    for j in range(out.size):
        mixed = old[j] + (row[j] - old[j]) * part[j]
        out[j] = row[j] if part[j] == ONE else mixed


@entry
def _blend_rows(images: tuple[Any, Any], weight: Any, sides: tuple[int, int], new: Any, row_range: RowRange) -> None:
    """``sides``: rows, and numbers of a row, that share a weight."""
    (image, before), (down, along) = images, sides
    part = np.empty(new.shape[1], np.float32)
    for y in range(row_range[0], row_range[1]):
        if y == row_range[0] or y % down == 0:
            for block in range(weight.shape[1]):
                own = weight[y // down, block]
                for j in range(along * block, min(along * (block + 1), part.size)):
                    part[j] = own
        _blend(image[y], before[y], part, new[y])
