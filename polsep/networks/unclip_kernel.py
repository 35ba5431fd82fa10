"""Packed pixels with clipped samples, one by one: twin of what `joint.Joint.guess` makes of those.

Colours that clip say nothing about slopes (`leave_clipped_out`); what they lack follows from the samples that are left
(`unclip`, twin of `joint.Joint.unclip`). ``bits``: which samples clip, as in `joint.Maps`. Cells are in reading order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, QUARTER, THIRD, TWO, ZERO, compiled
from polsep.compute.rows import fill
from polsep.networks.channels import PERIOD
from polsep.sensor.camera import Layout
from polsep.separation.color_affine import MIN_EIGENVALUE

#: Places of a cell's four samples, and the colour of every cell of a colour frame.
_PLACES = np.array([[PERIOD * row + col for row in (r, r + 1) for col in (c, c + 1)] for r in (0, 2) for c in (0, 2)])
_COLORS = np.array([Layout().filter_at(r, c)[1] for r in (0, 2) for c in (0, 2)])
_TURNS = [2 * math.radians(angle) for row in Layout().polarizer for angle in row]
_COSINES, _SINES = np.cos(_TURNS).astype(np.float32), np.sin(_TURNS).astype(np.float32)
_MIN_EIGENVALUE, _SINGULAR = np.float32(MIN_EIGENVALUE), np.float32(1e-6)


@compiled
def _clips(bits: Any, cell: int, k: int) -> bool:
    return bool((bits >> _PLACES[cell, k]) & 1)


@compiled
def leave_clipped_out(bits: Any, s0: Any, polarized: Any, moments: Any) -> None:
    """The ``moments [4, w]`` of packed pixels with clipped samples again, of the colours that do not clip.

    ``s0 [4 C, w]``, ``polarized [8 C, w]``. Twin: `joint.find_moments`.
    """
    if s0.shape[0] == 4:  # one colour does not vary
        return
    whole = np.empty(3, np.float32)
    for j in range(bits.size):
        if bits[j] != 0:
            _find_whole(bits[j], whole)
            fill(ZERO, moments[:, j])
            for cell in range(4):
                s1, s2 = polarized[cell:12:4, j], polarized[12 + cell :: 4, j]
                _add_moments(whole, (s0[cell::4, j], s1, s2), moments[:, j])


@compiled
def _find_whole(bits: Any, whole: Any) -> None:
    """1 for each of the three colours of which no sample clips."""
    fill(ONE, whole)
    for cell in range(4):
        for k in range(4):
            if _clips(bits, cell, k):
                whole[_COLORS[cell]] = ZERO


@compiled
def _add_moments(whole: Any, stokes: tuple[Any, Any, Any], moments: Any) -> None:
    """A quarter of the moments ``[4]`` of whole colours' Stokes vectors, ``[3]`` each."""
    s0, s1, s2 = stokes
    count = max(whole[0] + whole[1] + whole[2], ONE)
    mean0, mean1, mean2 = ZERO, ZERO, ZERO
    for c in range(3):
        mean0 += whole[c] * s0[c] / count
        mean1 += whole[c] * s1[c] / count
        mean2 += whole[c] * s2[c] / count
    for c in range(3):
        share = whole[c] * QUARTER * THIRD
        x, y, z = s0[c] - mean0, s1[c] - mean1, s2[c] - mean2
        moments[0] += x * x * share
        moments[1] += x * y * share
        moments[2] += x * z * share
        moments[3] += (y * y + z * z) * share


@compiled
def _fit(samples: Any, bits: Any, slope: tuple[Any, Any], found: Any) -> Any:
    """Offset and s0 of four cells to ``found [6]``, by the samples ``[16]`` that ``bits`` leave, for a given slope.

    The least eigenvalue of the equations comes back. Twin: `color_affine.fit_unclipped`.
    """
    a1, a2 = slope
    m00, m01, m11, r0, r1 = ZERO, ZERO, ZERO, ZERO, ZERO
    sums = np.zeros((4, 4), np.float32)
    for cell in range(4):
        gg, gy, gu, gv = ZERO, ZERO, ZERO, ZERO
        for k in range(4):
            if not _clips(bits, cell, k):
                g, y = ONE + _COSINES[k] * a1 + _SINES[k] * a2, TWO * samples[_PLACES[cell, k]]
                gg += g * g
                gy += g * y
                gu += g * _COSINES[k]
                gv += g * _SINES[k]
        gg = gg if gg > _SINGULAR else _SINGULAR
        for k in range(4):
            if not _clips(bits, cell, k):
                g, y = ONE + _COSINES[k] * a1 + _SINES[k] * a2, TWO * samples[_PLACES[cell, k]]
                p, q = _COSINES[k] - g * gu / gg, _SINES[k] - g * gv / gg
                m00 += p * p
                m01 += p * q
                m11 += q * q
                r0 += p * y
                r1 += q * y
        sums[cell, 0], sums[cell, 1], sums[cell, 2], sums[cell, 3] = gg, gy, gu, gv
    det = m00 * m11 - m01 * m01
    det = det if det > _SINGULAR else _SINGULAR
    b1, b2 = (m11 * r0 - m01 * r1) / det, (m00 * r1 - m01 * r0) / det
    found[0], found[1] = b1, b2
    for cell in range(4):
        found[2 + cell] = (sums[cell, 1] - sums[cell, 2] * b1 - sums[cell, 3] * b2) / sums[cell, 0]
    return HALF * (m00 + m11) - np.sqrt(QUARTER * (m00 - m11) * (m00 - m11) + m01 * m01)


@compiled
def unclip(planes: Any, bits: Any, slopes: Any, lacking: Any) -> bool:
    """What clipping hid of a row of packed pixels, ``lacking [5, w]``: of the offset, and of three colours' s0.

    ``planes [16, w]``: samples, ``slopes [2, w]``. False, and nothing in ``lacking``, of rows where nothing clips.
    """
    some = False
    for j in range(bits.size):
        some |= bits[j] != 0
    if some:
        for k in range(lacking.shape[0]):
            fill(ZERO, lacking[k])
        room = np.empty((2, 6), np.float32)
        for j in range(bits.size):
            if bits[j] != 0:
                _unclip_one(planes[:, j], bits[j], (slopes[0, j], slopes[1, j]), (room, lacking[:, j]))
    return some


@compiled
def _unclip_one(samples: Any, bits: Any, slope: tuple[Any, Any], results: tuple[Any, Any]) -> None:
    """What one packed pixel is ``lacking [5]``; nothing where too few samples are left."""
    room, lacking = results
    left, seen = room[0], room[1]
    if _fit(samples, bits, slope, left) <= _MIN_EIGENVALUE:
        return
    _fit(samples, np.uint16(0), slope, seen)
    lacking[0], lacking[1] = left[0] - seen[0], left[1] - seen[1]
    for cell in range(4):
        some_left, c = False, _COLORS[cell]
        for k in range(4):
            some_left |= not _clips(bits, cell, k)
        if some_left and left[2 + cell] > seen[2 + cell]:
            lacking[2 + c] += (left[2 + cell] - seen[2 + cell]) * (HALF if c == 1 else ONE)
