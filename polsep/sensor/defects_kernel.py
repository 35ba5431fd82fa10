"""Twins of `defects.find_defects_reference` and `defects.repair_reference`: a few milliseconds per frame.

Words: the ``residual`` of a pixel is its sample minus its prediction from the other samples of a window of 9x9 pixels;
``coefficient`` is the factor of one sample in the residual of another pixel, 1 for the pixel itself.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows

#: Pixels of a window's side, and on each side of its middle; the filters' period that all layouts share.
SIDE, REACH, PERIOD = 9, 4, 4
#: Pixels on each side of a pixel whose residuals are compared with its own.
RING = 2
#: Neighbours out of line above which a pixel lies in texture, and no cluster is looked for; most defects of a cluster.
MAX_UNEVEN, MOST = 12, 4
#: Clipped samples in a window from which on only samples of one kind are compared.
MIN_CLIPPED = 3
#: Squared deviation from which on the light of neighbours is no accident, beside one pixel and beside several.
SIGNIFICANT, SIGNIFICANT_CLUSTER = np.float32(9), np.float32(2)
#: Cycles in which predictions from each other converge: of a cluster that is looked for, and of all defects at most.
CYCLES, SWEEPS = 12, 200
#: Least rows of a strip, and least candidates of a task.
STRIP, STEP = 32, 256

_TOLERANCE = np.float32(1e-6)  # change of a sweep, relative to the largest one, that ends them


class Rules(NamedTuple):
    """Numbers of `defects` in the unit of the samples, float32.

    ``gain``, ``floor``: variance of a sample above ``black``. ``clip``: the least clipped sample. ``candidate``,
    ``confirmed``: deviations from which a sample stands out of its kind and from its prediction. ``ratio``,
    ``cluster_ratio``: least residual of a defect, or of each in a cluster, over the largest residual around.
    ``spread``: share of its light around it from which on it is a point of light under a lens; half for a cluster.
    ``period``: distance to the next pixel of its kind.
    """

    gain: np.float32
    floor: np.float32
    black: np.float32
    clip: np.float32
    candidate: np.float32
    confirmed: np.float32
    ratio: np.float32
    cluster_ratio: np.float32
    spread: np.float32
    period: int


class Predictor(NamedTuple):
    """Coefficients of residuals ``[2, 12, 12, 81]`` by table, case of row and column; ``spread [2, 12, 12]`` of noise.

    Table 0 predicts from samples of all kinds, table 1 from those of the pixel's own kind.
    Cases 0 to 3: the first rows; 4 to 7: rows inside, by their number modulo 4; 8 to 11: the last rows.
    """

    coefficients: NDArray[np.float32]
    spread: NDArray[np.float32]


def find_candidates(x: NDArray[np.float32], rules: Rules) -> NDArray[np.int64]:
    """Row and column ``[N, 2]`` of samples of ``x [H, W]`` that stand out of their own kind, in reading order."""
    marks = pages.empty((x.shape[0], -(-x.shape[1] // 8) * 8), np.uint8)
    marks[:, x.shape[1] :] = 0
    run_over_rows(partial(_mark_rows, read_only(x), rules, marks), x.shape[0], STRIP)
    # Few samples are marked: eight are looked at together.
    at = np.flatnonzero(marks.view(np.uint64) != 0)
    which, inside = np.nonzero(marks.reshape(-1, 8)[at])
    return np.stack(np.divmod(8 * at[which] + inside, marks.shape[1]), axis=1)


def confirm(
    x: NDArray[np.float32], predictor: Predictor, rules: Rules, candidates: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Places ``[M, 2]`` of the candidates that are defects, alone or in a cluster, with the clusters' other pixels."""
    found = np.full((len(candidates), MOST, 2), -1, np.int64)
    run_over_rows(partial(_confirm_some, read_only(x), predictor, rules, candidates, found), len(candidates), STEP)
    return found[found[..., 0] >= 0]


def fill(x: NDArray[np.float32], predictor: Predictor, clip: float, places: NDArray[np.int64]) -> None:
    """Replace the samples of ``x`` at ``places [N, 2]`` by their predictions from each other and from all others."""
    _fill_places(x, predictor, np.float32(clip), np.ascontiguousarray(places))


def warm_up() -> None:
    """Load the kernels, or compile them."""
    x = np.zeros((16, 16), np.float32)
    predictor = Predictor(np.zeros((2, 12, 12, SIDE * SIDE), np.float32), np.ones((2, 12, 12), np.float32))
    rules = Rules._make([ONE] * 9 + [PERIOD])
    find_candidates(x, rules)
    confirm(x, predictor, rules, np.full((1, 2), 8))
    fill(x, predictor, 1.0, np.full((1, 2), 8))


@compiled
def _max(a: Any, b: Any) -> Any:
    return a if a > b else b


@compiled
def _min(a: Any, b: Any) -> Any:
    return a if a < b else b


@compiled
def _outside(x: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any, rules: Any) -> Any:
    """True if x stands out of its 8 neighbours of one kind, of which one may be a defect too."""
    a, b, c, d = _max(a, b), _min(a, b), _max(c, d), _min(c, d)
    e, f, g, h = _max(e, f), _min(e, f), _max(g, h), _min(g, h)
    second, other = _max(_min(a, c), _max(b, d)), _max(_min(e, g), _max(f, h))
    high = _max(_min(_max(a, c), _max(e, g)), _max(second, other))
    second, other = _min(_max(b, d), _min(a, c)), _min(_max(f, h), _min(e, g))
    low = _min(_max(_min(b, d), _min(f, h)), _min(second, other))
    excess = _max(x - high, low - x)
    variance = rules.gain * _max(high - rules.black, ZERO) + rules.floor
    return (excess > ZERO) & (excess * excess > rules.candidate * rules.candidate * variance)


@entry
def _mark_rows(x: Any, rules: Rules, marks: Any, row_range: RowRange) -> None:
    """Mark the candidates of some rows; beyond the border, the neighbour on the other side counts twice."""
    height, width = x.shape
    p = rules.period
    for i in range(row_range[0], row_range[1]):
        up = x[i - p] if i >= p else x[i + p]
        down = x[i + p] if i + p < height else x[i - p]
        here, row = x[i], marks[i]
        n = width - 2 * p
        middle, out = here[p : p + n], row[p : p + n]
        up_a, up_b, up_c = up[:n], up[p : p + n], up[2 * p : 2 * p + n]
        down_a, down_b, down_c = down[:n], down[p : p + n], down[2 * p : 2 * p + n]
        before, after = here[:n], here[2 * p : 2 * p + n]
        for j in range(n):
            out[j] = _outside(
                middle[j], up_a[j], up_b[j], up_c[j], before[j], after[j], down_a[j], down_b[j], down_c[j], rules
            )
        for k in range(2 * p):
            j = k if k < p else width - 2 * p + k
            a = j - p if j >= p else j + p
            b = j + p if j + p < width else j - p
            row[j] = _outside(here[j], up[a], up[j], up[b], here[a], here[b], down[a], down[j], down[b], rules)


@compiled
def _case(i: int, n: int) -> int:
    """Case of row or column ``i`` of ``n``."""
    if i < PERIOD:
        return i
    return 2 * PERIOD + i - (n - PERIOD) if i >= n - PERIOD else PERIOD + i % PERIOD


@compiled
def _start(i: int, n: int) -> int:
    """First row or column of the window around ``i``, inside of ``n``."""
    return min(max(i - REACH, 0), n - SIDE)


@compiled
def _choose_tables(x: Any, clip: Any, i: int, first: int, tables: Any) -> None:
    """Tables of the coefficients of pixels (i, first), (i, first + 1) ...: 1, own kind only, where their windows clip.

    A clipped sample tells nothing of other kinds. Fewer than `MIN_CLIPPED` may be defects themselves.
    """
    height, width = x.shape
    top, left = _start(i, height), _start(first, width)
    windows = x[top : top + SIDE, left : _start(first + tables.size - 1, width) + SIDE]
    whole = 0
    for a in range(SIDE):
        row = windows[a]
        for b in range(row.size):
            whole += row[b] >= clip
    for k in range(tables.size):
        count = whole
        if whole >= MIN_CLIPPED and tables.size > 1:
            own, count = _start(first + k, width) - left, 0
            for a in range(SIDE):
                row = windows[a, own : own + SIDE]
                for b in range(SIDE):
                    count += row[b] >= clip
        tables[k] = 1 if count >= MIN_CLIPPED else 0


@compiled
def _residuals_of(x: Any, coefficients: Any, tables: Any, i: int, first: int, residuals: Any) -> None:
    """Write sample minus prediction of pixels (i, first), (i, first + 1) ... with their ``tables``.

    Row after row of their windows, so that the processor adds up several pixels at once.
    """
    height, width = x.shape
    top, case = _start(i, height), _case(i, height)
    for k in range(residuals.size):
        residuals[k] = ZERO
    for a in range(SIDE):
        for k in range(residuals.size):
            own, left = coefficients[tables[k], case, _case(first + k, width)], _start(first + k, width)
            row, factor = x[top + a, left : left + SIDE], own[SIDE * a : SIDE * a + SIDE]
            total = residuals[k]
            for b in range(SIDE):
                total += row[b] * factor[b]
            residuals[k] = total


@compiled
def _coefficient(x: Any, coefficients: Any, table: int, i: int, j: int, place: Any) -> Any:
    """Factor of the sample at ``place`` in the residual of pixel (i, j)."""
    height, width = x.shape
    a, b = place[0] - _start(i, height), place[1] - _start(j, width)
    if a < 0 or a >= SIDE or b < 0 or b >= SIDE:
        return ZERO
    return coefficients[table, _case(i, height), _case(j, width), SIDE * a + b]


@entry
def _confirm_some(x: Any, predictor: Predictor, rules: Rules, candidates: Any, found: Any, some: RowRange) -> None:
    """Write to ``found [N, MOST, 2]`` the places of the defects that some candidates are or belong to."""
    places, residuals = np.empty((MOST, 2), np.int64), np.empty(MOST, np.float32)
    tables, excess = np.empty(MOST, np.int64), np.empty(MOST, np.float32)
    for n in range(some[0], some[1]):
        i, j = candidates[n, 0], candidates[n, 1]
        for size in range(1, MOST + 1):
            last = size - 1
            places[last, 0], places[last, 1] = i, j
            _choose_tables(x, rules.clip, i, j, tables[last:size])
            _residuals_of(x, predictor.coefficients, tables[last:size], i, j, residuals[last:size])
            _solve(x, predictor.coefficients, places[:size], tables, residuals, excess)
            least = _least_excess(x, predictor, rules, places[:size], tables, excess)
            if least == ZERO:
                break
            limit = least / (rules.ratio if size == 1 else rules.cluster_ratio)
            count, i, j, spread = _search_ring(x, predictor.coefficients, rules.clip, places[:size], excess, limit)
            if (
                count == 0
                and spread < (rules.spread if size == 1 else HALF * rules.spread)
                and not _is_square(places[:size])
            ):
                for k in range(size):
                    found[n, k, 0], found[n, k, 1] = places[k, 0], places[k, 1]
            if count == 0 or count > MAX_UNEVEN:
                break


@compiled
def _is_square(places: Any) -> bool:
    """True for three or four pixels of one square of 2x2: a point of light on their corner shines on no other."""
    if places.shape[0] < 3:
        return False
    for k in range(1, places.shape[0]):
        for axis in range(2):
            if abs(places[k, axis] - places[0, axis]) > 1:
                return False
            for m in range(1, k):
                if abs(places[k, axis] - places[m, axis]) > 1:
                    return False
    return True


@compiled
def _solve(x: Any, coefficients: Any, places: Any, tables: Any, residuals: Any, excess: Any) -> None:
    """Write the differences of all places to their predictions from the samples of all others."""
    size = places.shape[0]
    for k in range(size):
        excess[k] = residuals[k]
    for _ in range(CYCLES if size > 1 else 0):
        for k in range(size):
            total = residuals[k]
            for m in range(size):
                if m != k:
                    own = _coefficient(x, coefficients, tables[k], places[k, 0], places[k, 1], places[m])
                    total -= own * excess[m]
            excess[k] = total


@compiled
def _least_excess(x: Any, predictor: Any, rules: Any, places: Any, tables: Any, excess: Any) -> Any:
    """The smallest difference to a prediction, without sign; 0 if noise may be one of them."""
    least = abs(excess[0])
    for k in range(places.shape[0]):
        i, j, own = places[k, 0], places[k, 1], abs(excess[k])
        light = x[i, j] - excess[k] - rules.black
        variance = rules.gain * (light if light > ZERO else ZERO) + rules.floor
        limit = rules.confirmed * predictor.spread[tables[k], _case(i, x.shape[0]), _case(j, x.shape[1])]
        if own * own <= limit * limit * variance:
            return ZERO
        least = min(least, own)
    return least


@compiled
def _search_ring(x: Any, coefficients: Any, clip: Any, places: Any, excess: Any, limit: Any) -> Any:
    """Number of pixels around whose residuals exceed ``limit`` once ``places`` are repaired, and the worst of them.

    Last, the share of the places' excess that their next pixels have too, as under a lens; 0 where noise and texture,
    as the other pixels show them, may be that share.
    """
    top, stop = _ring_range(places[:, 0], x.shape[0])
    left, end = _ring_range(places[:, 1], x.shape[1])
    count, worst, row, col = 0, ZERO, top, left
    light, power, near, far = ZERO, ZERO, 0, 0
    tables, residuals = np.empty(end - left, np.int64), np.empty(end - left, np.float32)
    for a in range(top, stop):
        _choose_tables(x, clip, a, left, tables)
        _residuals_of(x, coefficients, tables, a, left, residuals)
        for b in range(left, end):
            distance, nearest = _distance(places, a, b)
            if distance == 0:
                continue
            rest = _rest(x, coefficients, tables[b - left], (a, b), residuals[b - left], places, excess)
            if distance == 1:
                light += rest if excess[nearest] > ZERO else -rest
                near += 1
            elif distance > 2:
                power += rest * rest
                far += 1
            count += abs(rest) > limit
            if abs(rest) > worst:
                worst, row, col = abs(rest), a, b
        if count > MAX_UNEVEN:
            break
    significant = SIGNIFICANT if places.shape[0] == 1 else SIGNIFICANT_CLUSTER
    if far == 0 or light * light <= significant * power * np.float32(near) / np.float32(far):
        return count, row, col, ZERO
    total = ZERO
    for k in range(places.shape[0]):
        total += abs(excess[k])
    return count, row, col, light / total


@compiled
def _ring_range(numbers: Any, size: int) -> tuple[int, int]:
    """First row or column of the ring around some, and the one behind the last."""
    first, last = numbers[0], numbers[0]
    for k in range(1, numbers.size):
        first, last = min(first, numbers[k]), max(last, numbers[k])
    return max(first - RING, 0), min(last + RING + 1, size)


@compiled
def _distance(places: Any, a: int, b: int) -> tuple[int, int]:
    """Steps along rows and columns to the nearest place, and its number."""
    distance, nearest = 2 * SIDE, 0
    for k in range(places.shape[0]):
        own = abs(places[k, 0] - a) + abs(places[k, 1] - b)
        if own < distance:
            distance, nearest = own, k
    return distance, nearest


@compiled
def _rest(x: Any, coefficients: Any, table: int, place: Any, residual: Any, places: Any, excess: Any) -> Any:
    """Residual of a pixel once ``places`` are repaired."""
    for k in range(places.shape[0]):
        residual -= _coefficient(x, coefficients, table, place[0], place[1], places[k]) * excess[k]
    return residual


@entry
def _fill_places(x: Any, predictor: Predictor, clip: Any, places: Any) -> None:
    """Gauss-Seidel rounds: every place at its prediction, given all others."""
    largest, table, residual = ZERO, np.empty(1, np.int64), np.empty(1, np.float32)
    for _ in range(SWEEPS):
        change = ZERO
        for n in range(places.shape[0]):
            i, j = places[n, 0], places[n, 1]
            _choose_tables(x, clip, i, j, table)
            _residuals_of(x, predictor.coefficients, table, i, j, residual)
            x[i, j] -= residual[0]
            change = max(change, abs(residual[0]))
        largest = max(largest, change)
        if change <= _TOLERANCE * largest:
            break
