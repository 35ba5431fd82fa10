"""Loops over rows of float32 that `kernels.joint` is made of, each over so few arrays that LLVM vectorises it."""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.kernels.compiling import ONE, ZERO, compiled

#: Samples that a filter takes at a time.
AT_ONCE = 6

_ROUND, _ODD, _SIXTEEN = np.uint32(0x7FFF), np.uint32(1), np.uint32(16)


@compiled
def fill(value: Any, row: Any) -> None:
    """Every number of a row is set to a value."""
    for j in range(row.size):
        row[j] = value


@compiled
def copy(x: Any, row: Any) -> None:
    """The first numbers of ``x``."""
    for j in range(row.size):
        row[j] = x[j]


@compiled
def add_product(x: Any, factor: Any, total: Any) -> None:
    """``total += x factor``."""
    for j in range(total.size):
        total[j] += x[j] * factor


@compiled
def subtract(x: Any, y: Any, difference: Any) -> None:
    """``difference = x - y``."""
    for j in range(difference.size):
        difference[j] = x[j] - y[j]


@compiled
def multiply(x: Any, y: Any, factor: Any, total: Any) -> None:
    """``total += x y factor``."""
    for j in range(total.size):
        total[j] += x[j] * y[j] * factor


@compiled
def sum_three(x: Any, y: Any, z: Any, total: Any) -> None:
    """``total = x + y + z``."""
    for j in range(total.size):
        total[j] = x[j] + y[j] + z[j]


@compiled
def average(row: Any, window: int, rows: Any) -> None:
    """Divide sums over 2 ``window`` + 1 columns, fewer at the borders, and ``rows`` rows by their number."""
    w = row.size
    whole = ONE / (rows * np.float32(2 * window + 1))
    for j in range(window, w - window):
        row[j] *= whole
    edge = min(window, w)
    for j in range(edge):
        row[j] /= rows * np.float32(min(j + window, w - 1) + 1)
    for j in range(max(edge, w - window), w):
        row[j] /= rows * np.float32(w - 1 - max(j - window, 0) + 1)


@compiled
def filter_row(weight: Any, taps: tuple[Any, Any], near: tuple[Any, Any], found: Any) -> None:
    """A correlation with samples around: ``taps``: the row, 0 to 2, and the place in it, of what ``weight [K]`` weighs.

    ``near``: all samples, and where each of the three rows begins.
    """
    w, (rows, places), (x, start) = found.size, taps, near
    for j in range(w):
        found[j] = ZERO
    for k in range(0, weight.size, AT_ONCE):
        p0, p1 = start[rows[k]] + places[k], start[rows[k + 1]] + places[k + 1]
        p2, p3 = start[rows[k + 2]] + places[k + 2], start[rows[k + 3]] + places[k + 3]
        p4, p5 = start[rows[k + 4]] + places[k + 4], start[rows[k + 5]] + places[k + 5]
        x0, x1, x2, x3, x4, x5 = x[p0:], x[p1:], x[p2:], x[p3:], x[p4:], x[p5:]
        w0, w1, w2, w3, w4, w5 = weight[k], weight[k + 1], weight[k + 2], weight[k + 3], weight[k + 4], weight[k + 5]
        for j in range(w):
            found[j] += w0 * x0[j] + w1 * x1[j] + w2 * x2[j] + w3 * x3[j] + w4 * x4[j] + w5 * x5[j]


@compiled
def emit(row: Any, target: tuple[Any, Any, int, int]) -> None:
    """A row to a channel of float32 or bfloat16 maps, ``(floats, halves, channel, row)``; see `joint.Maps`."""
    floats, halves, channel, t = target
    if floats.size:
        out = floats[t, :, channel]
        for j in range(row.size):
            out[j] = row[j]
    else:
        bits, half = row.view(np.uint32), halves[t, :, channel]
        for j in range(row.size):
            half[j] = np.uint16((bits[j] + _ROUND + ((bits[j] >> _SIXTEEN) & _ODD)) >> _SIXTEEN)


@compiled
def emit_product(x: Any, factor: Any, target: tuple[Any, Any, int, int], spare: Any) -> None:
    """``x factor`` to a channel."""
    for j in range(spare.size):
        spare[j] = x[j] * factor[j]
    emit(spare, target)


@compiled
def emit_bits(bits: Any, k: int, target: tuple[Any, Any, int, int], spare: Any) -> None:
    """Whether bit ``k`` is set to a channel, 1 or 0."""
    for j in range(spare.size):
        spare[j] = ONE if bits[j] >> k & 1 else ZERO
    emit(spare, target)
