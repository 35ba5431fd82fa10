"""Diffuse polarization from rows of weighted moments: window sums of three radii, then each pixel's own.

Windows are summed first along the row, then down it by suffix and prefix sums of blocks (van Herk 1992, Gil and Werman
1993): they only ever add, so that a bright edge leaves no rounding behind in the dark beside it, as running sums would.
Where edges are kept, the middle window is that of `separation.edges_kernel`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import ONE, ZERO, compiled
from polsep.compute.rows_kernel import add_product
from polsep.demosaic.bilinear_kernel import PAD, Pattern
from polsep.separation import color_affine as twin
from polsep.separation.closed_form_kernel import limit_dolp_row
from polsep.separation.edges_kernel import sum_alike
from polsep.separation.moments_kernel import KEPT, MIDDLE, NARROW, WIDEST, Rings, Rows, rows_around

_FLOOR = np.float32(np.finfo(np.float32).eps * 1e-2)
_MARGIN = np.float32(twin.CONTRAST_MARGIN)
_SPREAD_WIDEST, _SPREAD_MIDDLE, _SPREAD_NARROW, _SPREAD_PIXEL = (np.float32(s) for _, s in twin.SCALES)
_MIN_WEIGHT, _MIN_SQUARE = np.float32(1e-12), np.float32(1e-20)


@compiled
def _sum_fours(x: Any, out: Any) -> None:
    a, b, c, d = x[0:], x[1:], x[2:], x[3:]
    for j in range(x.size - 3):
        out[j] = (a[j] + b[j]) + (c[j] + d[j])


@compiled
def _sum_window(x: Any, fours: Any, radius: int, row: Any, block: Any) -> None:
    """Sums along rows over windows, from sums of four; to a ``row`` of a block and onto the sum of the ``block``."""
    out, total = row[PAD:], block[PAD:]
    start, n = PAD - radius, row.size - 2 * PAD
    last = x[PAD + radius :]
    a, b, c = fours[start:], fours[start + 4 :], fours[start + 8 :]
    d, e, f = fours[start + 12 :], fours[start + 16 :], fours[start + 20 :]
    if radius == WIDEST:
        for j in range(n):
            s = ((a[j] + b[j]) + (c[j] + d[j])) + ((e[j] + f[j]) + last[j])
            out[j] = s
            total[j] += s
    elif radius == MIDDLE:
        for j in range(n):
            s = (a[j] + b[j]) + (c[j] + last[j])
            out[j] = s
            total[j] += s
    else:
        for j in range(n):
            s = a[j] + last[j]
            out[j] = s
            total[j] += s


@compiled
def _push(weighted: Any, radius: int, r: int, fours: Any, block: Any) -> int:
    """Put row ``r`` of weighted moments into a block of window sums.

    Returns the row of the block which, with the sum behind the block, makes the sums of the window that ends here.
    Blocks begin at multiples of their length, so that sums do not depend on where a strip starts.
    """
    length = 2 * radius + 1
    place = r % length
    x, total = weighted.reshape(-1), block[length].reshape(-1)
    _sum_fours(x, fours)
    _sum_window(x, fours, radius, block[place].reshape(-1), total)
    if place + 1 < length:
        return place + 1
    for k in range(length - 2, -1, -1):
        add_product(block[k + 1].reshape(-1), ONE, block[k].reshape(-1))
    total[:] = ZERO
    return 0


@compiled
def _steady(u: Any, v: Any, counts: Any, per_window: Any, spread: Any, w: int, a: Any) -> None:
    """One scale of `fit_diffuse_polarization`, in place of the wider one's ``a``, from sums over windows ``u + v``.

    ``counts``, ``per_window``: shares of a window's inverse number of independent pixels, by column and by row.
    """
    u0, u1, u2, u3, u4, u5 = u[0, PAD:], u[1, PAD:], u[2, PAD:], u[3, PAD:], u[4, PAD:], u[5, PAD:]
    v0, v1, v2, v3, v4, v5 = v[0, PAD:], v[1, PAD:], v[2, PAD:], v[3, PAD:], v[4, PAD:], v[5, PAD:]
    columns = counts[PAD:]
    a1, a2 = a[0, PAD:], a[1, PAD:]
    scale = ONE / (_MARGIN * spread * spread)
    for j in range(w):
        contrast, noise = u0[j] + v0[j], u3[j] + v3[j]
        total, squares = u4[j] + v4[j], u5[j] + v5[j]
        total = total if total > _MIN_WEIGHT else _MIN_WEIGHT
        squares = squares if squares > _MIN_SQUARE else _MIN_SQUARE
        floor = _FLOOR * total
        share = per_window * columns[j] * squares / (total * total)
        share = share if share < ONE else ONE
        held = noise * scale * share + floor
        surplus = contrast - noise if contrast > noise else ZERO
        counted = surplus / (contrast + floor)
        below = ONE / (contrast + held)
        a1[j] = ((u1[j] + v1[j]) * counted + held * a1[j]) * below
        a2[j] = ((u2[j] + v2[j]) * counted + held * a2[j]) * below


@compiled
def _own_pixel(x: Any, w: int, a: Any) -> None:
    """The last scale, the pixel itself, and the limit of DoLP."""
    x0, x1, x2, x3, x4 = x[0, PAD:], x[1, PAD:], x[2, PAD:], x[3, PAD:], x[4, PAD:]
    a1, a2 = a[0, PAD:], a[1, PAD:]
    scale = ONE / (_MARGIN * _SPREAD_PIXEL * _SPREAD_PIXEL)
    for j in range(w):
        floor = _FLOOR * (x4[j] if x4[j] > _MIN_WEIGHT else _MIN_WEIGHT)
        held = x3[j] * scale + floor
        surplus = x0[j] - x3[j] if x0[j] > x3[j] else ZERO
        counted = surplus / (x0[j] + floor)
        below = ONE / (x0[j] + held)
        first, second = (x1[j] * counted + held * a1[j]) * below, (x2[j] * counted + held * a2[j]) * below
        a1[j], a2[j] = first, second
    limit_dolp_row(a1[:w], a2[:w])


@compiled
def _first_of_block(start: int, radius: int) -> int:
    """The first row of the block that holds the first row of the window about row ``start``."""
    length = 2 * radius + 1
    return (start - radius) // length * length


@compiled
def first_weighed(start: int) -> int:
    """The first row whose weighted moments `fit_diffuse_polarization` reads for row ``start``."""
    return min(_first_of_block(start, WIDEST), _first_of_block(start, MIDDLE), _first_of_block(start, NARROW))


@compiled
def fit_diffuse_polarization(pattern: Pattern, t: int, start: int, rows: Rows, rings: Rings) -> None:
    """Write the diffuse polarization of row ``t`` to ``rows``; before row ``start`` only fill blocks.

    Twin: `color_affine.fit_diffuse_polarization`.
    """
    a = rows.diffuse_polarization
    a[:] = ZERO
    blocks = (rings.wide, rings.middle, rings.narrow)
    spreads = (_SPREAD_WIDEST, _SPREAD_MIDDLE, _SPREAD_NARROW)
    radii = (WIDEST, MIDDLE, NARROW)
    for i in range(3):
        radius, block = radii[i], blocks[i]
        if t + radius < _first_of_block(start, radius):
            continue
        if radius == MIDDLE and rings.edges.size:
            if t >= start:
                sum_alike(pattern, t, rows, rings)
                _steady(rows.sums, rows.nothing, rows.ones, ONE, spreads[i], pattern.w, a)
            continue
        row = _push(rings.weighted[(t + radius) % KEPT], radius, t + radius, rows.fours, block)
        if t >= start:
            per_window = 4 * rows_around(t, radius, pattern.h) / np.float32((2 * radius + 1) ** 2)
            total = block[2 * radius + 1]
            _steady(block[row], total, rows.counts[i], np.float32(per_window), spreads[i], pattern.w, a)
    if t >= start:
        _own_pixel(rings.weighted[t % KEPT], pattern.w, a)
