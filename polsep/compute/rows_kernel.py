"""Arithmetic on rows of float32 for kernels; every loop is over so few arrays that LLVM vectorises it."""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import ONE, ZERO, compiled

#: Samples that `filter_rows` reads at once.
AT_ONCE = 6

#: Sums that `add_up` makes side by side.
_SUMS = 64

_ROUND, _ODD, _SIXTEEN = np.uint32(0x7FFF), np.uint32(1), np.uint32(16)
_SHIFTS = (np.uint64(16), np.uint64(32), np.uint64(48))
_UPPER = np.uint32(0xFFFF0000)


@compiled
def fill(value: Any, row: Any) -> None:
    """Set every number of a row to a value."""
    for j in range(row.size):
        row[j] = value


@compiled
def copy(x: Any, row: Any) -> None:
    """Copy the first numbers of ``x`` to a row."""
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
def add_rows(x: Any, y: Any, z: Any, factor: Any, total: Any) -> None:
    """``total = factor (x + y + z)``."""
    for j in range(total.size):
        total[j] = factor * (x[j] + y[j] + z[j])


@compiled
def add_up(row: Any) -> float:
    """Return the sum of a row: sums in single precision side by side, and of these in double precision."""
    sums = np.zeros(_SUMS, np.float32)
    whole = row.size - row.size % _SUMS
    for first in range(0, whole, _SUMS):
        x = row[first:]
        for j in range(_SUMS):
            sums[j] += x[j]
    total = 0.0
    for j in range(_SUMS):
        total += sums[j]
    for j in range(whole, row.size):
        total += row[j]
    return total


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
def filter_rows(weight: Any, rows: Any, places: Any, x: Any, start: Any, first: Any, second: Any, third: Any) -> None:
    """Three correlations ``first``, ``second``, ``third`` with the same samples, each of which is read once.

    ``weight [3, K]``; ``rows``, ``places [K]``: the row of each weighted sample and its place in it. ``x``: all
    samples; ``start``: the index at which each row begins.
    """
    u, v, w, n = weight[0], weight[1], weight[2], first.size
    fill(ZERO, first)
    fill(ZERO, second)
    fill(ZERO, third)
    for k in range(0, places.size, AT_ONCE):
        p0, p1 = start[rows[k]] + places[k], start[rows[k + 1]] + places[k + 1]
        p2, p3 = start[rows[k + 2]] + places[k + 2], start[rows[k + 3]] + places[k + 3]
        p4, p5 = start[rows[k + 4]] + places[k + 4], start[rows[k + 5]] + places[k + 5]
        x0, x1, x2, x3, x4, x5 = x[p0:], x[p1:], x[p2:], x[p3:], x[p4:], x[p5:]
        u0, u1, u2, u3, u4, u5 = u[k], u[k + 1], u[k + 2], u[k + 3], u[k + 4], u[k + 5]
        v0, v1, v2, v3, v4, v5 = v[k], v[k + 1], v[k + 2], v[k + 3], v[k + 4], v[k + 5]
        w0, w1, w2, w3, w4, w5 = w[k], w[k + 1], w[k + 2], w[k + 3], w[k + 4], w[k + 5]
        for j in range(n):
            a, b, c, d, e, f = x0[j], x1[j], x2[j], x3[j], x4[j], x5[j]
            first[j] += u0 * a + u1 * b + u2 * c + u3 * d + u4 * e + u5 * f
            second[j] += v0 * a + v1 * b + v2 * c + v3 * d + v4 * e + v5 * f
            third[j] += w0 * a + w1 * b + w2 * c + w3 * d + w4 * e + w5 * f


@compiled
def emit(row: Any, floats: Any, halves: Any, channel: int, t: int) -> None:
    """Write a row to a channel of ``floats [h, w, channels]``, row ``t``.

    Where these are empty, as bfloat16 to ``halves [channels, w]``, which `weave` puts in order.
    """
    if floats.size:
        out = floats[t, :, channel]
        for j in range(row.size):
            out[j] = row[j]
    else:
        bits, half = row.view(np.uint32), halves[channel]
        for j in range(row.size):
            half[j] = np.uint16((bits[j] + _ROUND + ((bits[j] >> _SIXTEEN) & _ODD)) >> _SIXTEEN)


@compiled
def weave(planes: Any, row: Any) -> None:
    """Write ``planes [n, w]`` of 16 bits to a row with channels last, ``[w, n]``; four at once where they fit."""
    n, w = planes.shape
    if n % 4:
        for k in range(n):
            plane, out = planes[k], row[:, k]
            for j in range(w):
                out[j] = plane[j]
        return
    fours = row.reshape(-1).view(np.uint64)
    for k in range(0, n, 4):
        a, b, c, d, out = planes[k], planes[k + 1], planes[k + 2], planes[k + 3], fours[k // 4 :: n // 4]
        for j in range(w):
            low = np.uint64(a[j]) | np.uint64(b[j]) << _SHIFTS[0]
            out[j] = low | np.uint64(c[j]) << _SHIFTS[1] | np.uint64(d[j]) << _SHIFTS[2]


@compiled
def unweave(floats: Any, halves: Any, t: int, planes: Any) -> None:
    """Write row ``t`` of ``floats [h, w, n]`` to ``planes [n, w]``; where these are empty, of ``halves``, bfloat16.

    n is a multiple of 4.
    """
    n, w = planes.shape
    if floats.size:
        for k in range(n):
            plane, x = planes[k], floats[t, :, k]
            for j in range(w):
                plane[j] = x[j]
        return
    fours, bits = halves[t].reshape(-1).view(np.uint64), planes.view(np.uint32)
    for k in range(0, n, 4):
        a, b, c, d, x = bits[k], bits[k + 1], bits[k + 2], bits[k + 3], fours[k // 4 :: n // 4]
        for j in range(w):
            a[j] = np.uint32(x[j] << _SHIFTS[0])
            b[j] = np.uint32(x[j]) & _UPPER
            c[j] = np.uint32(x[j] >> _SHIFTS[0]) & _UPPER
            d[j] = np.uint32(x[j] >> _SHIFTS[1]) & _UPPER


@compiled
def emit_product(x: Any, factor: Any, floats: Any, halves: Any, channel: int, t: int, spare: Any) -> None:
    """`emit` for ``x factor``; ``spare``: a buffer."""
    for j in range(spare.size):
        spare[j] = x[j] * factor[j]
    emit(spare, floats, halves, channel, t)


@compiled
def emit_bits(bits: Any, k: int, floats: Any, halves: Any, channel: int, t: int, spare: Any) -> None:
    """`emit` for 1 where bit ``k`` is set, else 0; ``spare``: a buffer."""
    for j in range(spare.size):
        spare[j] = ONE if bits[j] >> k & 1 else ZERO
    emit(spare, floats, halves, channel, t)
