"""The window of `color_affine` that ends at edges: pixels count as far as their polarization is alike.

Two rows after a row has entered its ring, ratios of mean Stokes values in 3x3 pixels are made of it (twin:
`polarization_edges`); the window about a row then sums every third pixel by itself (twin: `_pool_to_edges`).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import ONE, THIRD, ZERO, compiled
from polsep.demosaic.bilinear_kernel import PAD, Pattern
from polsep.separation import color_affine as twin
from polsep.separation.moments_kernel import KEPT, MIDDLE, Rings, Rows, rows_around

_EDGE_FLOOR = np.float32(twin.EDGE_FLOOR)
_PER_REACH = np.float32(1 / twin.EDGE_REACH**2)
_STEP = twin.EDGE_STEP
_TAPS = 2 * MIDDLE // _STEP + 1


@compiled
def _light_of(stokes: Any, w: int, light: Any) -> None:
    """Means of s0, s1 and s2 over the colours of a row."""
    r, g, b, m1, m2 = stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], stokes[3, PAD:], stokes[4, PAD:]
    s0, s1, s2 = light[0, PAD:], light[1, PAD:], light[2, PAD:]
    for j in range(w):
        s0[j] = THIRD * (r[j] + g[j] + b[j])
        s1[j] = m1[j]
        s2[j] = m2[j]


@compiled
def enter_light(pattern: Pattern, flagged: bool, t: int, rows: Rows, rings: Rings) -> None:
    """Mean Stokes values of row ``t``, which has just entered the rings; zero where samples are clipped."""
    light = rings.light[t % 4]
    _light_of(rings.stokes[t % 16], pattern.w, light)
    if flagged:
        for j in range(pattern.w):
            if rows.clipped[j] != 0:
                light[:, PAD + j] = ZERO


@compiled
def _sum_columns(above: Any, here: Any, below: Any, out: Any) -> None:
    for j in range(out.size):
        out[j] = above[j] + here[j] + below[j]


@compiled
def _ratios(sums: Any, per_column: Any, counts: Any, edges: Any) -> None:
    """s1 / s0 and s2 / s0 of 3x3 pixels from sums over three rows."""
    s0, s1, s2 = sums[0, PAD - 1 :], sums[1, PAD - 1 :], sums[2, PAD - 1 :]
    columns, first, second = counts[PAD:], edges[0, PAD:], edges[1, PAD:]
    least = _EDGE_FLOOR * per_column
    for j in range(counts.size - 2 * PAD):
        total = s0[j] + s0[j + 1] + s0[j + 2] + least * columns[j]
        first[j] = (s1[j] + s1[j + 1] + s1[j + 2]) / total
        second[j] = (s2[j] + s2[j + 1] + s2[j + 2]) / total


@compiled
def measure_edges(pattern: Pattern, t: int, rows: Rows, rings: Rings) -> None:
    """Ratios of mean Stokes values about row ``t`` of the frame. Twin: `polarization_edges`."""
    if not 0 <= t < pattern.h:
        return
    outside = rows.nothing
    above = rings.light[(t - 1) % 4] if t > 0 else outside
    below = rings.light[(t + 1) % 4] if t + 1 < pattern.h else outside
    for i in range(3):
        _sum_columns(above[i], rings.light[t % 4, i], below[i], rows.sums[i])
    _ratios(rows.sums, rows_around(t, 1, pattern.h), rows.counts[3], rings.edges[t % KEPT])


@compiled
def _likeness(there: Any, here: Any, w: int, near: Any) -> None:
    """Likeness of the pixels of two rows of edges, ``near [5, w]``: one row for every step along the window."""
    first, second = here[0, PAD:], here[1, PAD:]
    for i in range(_TAPS):
        other1, other2, out = there[0, PAD - MIDDLE + _STEP * i :], there[1, PAD - MIDDLE + _STEP * i :], near[i]
        for j in range(w):
            d1, d2 = other1[j] - first[j], other2[j] - second[j]
            alike = ONE - _PER_REACH * (d1 * d1 + d2 * d2)
            alike = alike if alike > ZERO else ZERO
            out[j] = alike * alike


@compiled
def _add_alike(x: Any, y: Any, near: Any, w: int, x_sums: Any, y_sums: Any) -> None:
    """Add the steps of a row about each pixel, of two moments."""
    n0, n1, n2, n3, n4 = near[0], near[1], near[2], near[3], near[4]
    for j in range(w):
        a, b, c, d, e = n0[j], n1[j], n2[j], n3[j], n4[j]
        left, right = a * x[j] + b * x[j + _STEP], d * x[j + 3 * _STEP] + e * x[j + 4 * _STEP]
        x_sums[j] += left + c * x[j + 2 * _STEP] + right
        left, right = a * y[j] + b * y[j + _STEP], d * y[j + 3 * _STEP] + e * y[j + 4 * _STEP]
        y_sums[j] += left + c * y[j + 2 * _STEP] + right


@compiled
def _add_last(x: Any, y: Any, near: Any, w: int, x_sums: Any, y_sums: Any) -> None:
    """`_add_alike` of the weight and of its square, which counts by the square of the likeness."""
    n0, n1, n2, n3, n4 = near[0], near[1], near[2], near[3], near[4]
    for j in range(w):
        a, b, c, d, e = n0[j], n1[j], n2[j], n3[j], n4[j]
        left, right = a * x[j] + b * x[j + _STEP], d * x[j + 3 * _STEP] + e * x[j + 4 * _STEP]
        x_sums[j] += left + c * x[j + 2 * _STEP] + right
        left, right = a * a * y[j] + b * b * y[j + _STEP], d * d * y[j + 3 * _STEP] + e * e * y[j + 4 * _STEP]
        y_sums[j] += left + c * c * y[j + 2 * _STEP] + right


@compiled
def sum_alike(pattern: Pattern, t: int, rows: Rows, rings: Rings) -> None:
    """Sums over the middle window about row ``t`` as far as edges allow, into ``rows.sums``. Twin: `_pool_to_edges`."""
    rows.sums[:] = ZERO
    here, w, at = rings.edges[t % KEPT], pattern.w, PAD - MIDDLE
    for row in range(t - MIDDLE, t + MIDDLE + 1, _STEP):
        if 0 <= row < pattern.h:
            x, sums = rings.weighted[row % KEPT], rows.sums
            _likeness(rings.edges[row % KEPT], here, w, rows.near)
            for k in (0, 2):
                _add_alike(x[k, at:], x[k + 1, at:], rows.near, w, sums[k, PAD:], sums[k + 1, PAD:])
            _add_last(x[4, at:], x[5, at:], rows.near, w, sums[4, PAD:], sums[5, PAD:])
