"""Packed pixels with clipped samples, one by one: twin of what `joint.Joint.closed_form` makes of those.

Colours that clip say nothing about the diffuse polarization (`leave_clipped_out`); what they are missing follows from
the samples that are left (`unclip`, twin of `joint.Joint.unclip`). ``bits``: which samples clip, as in `joint.Maps`.
Cells are in reading order.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, QUARTER, THIRD, TWO, ZERO, compiled
from polsep.compute.rows_kernel import fill
from polsep.networks.channels import PERIOD
from polsep.sensor.camera import Layout
from polsep.separation.closed_form import MIN_EIGENVALUE
from polsep.separation.closed_form_kernel import fit_unclipped

#: Places of a cell's four samples, and the colour of every cell of a colour frame.
_PLACES = np.array([[PERIOD * row + col for row in (r, r + 1) for col in (c, c + 1)] for r in (0, 2) for c in (0, 2)])
_COLORS = np.array([Layout().filter_at(r, c)[1] for r in (0, 2) for c in (0, 2)])
_TURNS = [2 * math.radians(angle) for row in Layout().polarizer for angle in row]
_COSINES, _SINES = np.cos(_TURNS).astype(np.float32), np.sin(_TURNS).astype(np.float32)
_MIN_EIGENVALUE = np.float32(MIN_EIGENVALUE)


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
def unclip(planes: Any, bits: Any, a: Any, missing: Any) -> bool:
    """Light that clipping hid in a row of packed pixels, ``missing [5, w]``: of the offset, and of three colours' s0.

    ``planes [16, w]``: samples, ``a [2, w]``: the diffuse polarization. False, and nothing in ``missing``, of rows
    where nothing clips.
    """
    some = False
    for j in range(bits.size):
        some |= bits[j] != 0
    if some:
        for k in range(missing.shape[0]):
            fill(ZERO, missing[k])
        y, kept, s0 = np.empty((4, 4), np.float32), np.empty((4, 4), np.bool_), np.empty((2, 4), np.float32)
        for j in range(bits.size):
            if bits[j] != 0:
                for cell in range(4):
                    for k in range(4):
                        y[cell, k], kept[cell, k] = TWO * planes[_PLACES[cell, k], j], not _clips(bits[j], cell, k)
                _unclip_one(y, kept, a[0, j], a[1, j], s0, missing[:, j])
    return some


@compiled
def _unclip_one(y: Any, kept: Any, a1: Any, a2: Any, s0: Any, missing: Any) -> None:
    """Light that one packed pixel is ``missing [5]``; nothing where too few samples are ``kept [4, 4]``."""
    left, as_is = s0[0], s0[1]
    b1, b2, eigenvalue = fit_unclipped(y, kept, _COSINES, _SINES, a1, a2, left)
    if eigenvalue <= _MIN_EIGENVALUE:
        return
    c1, c2, _ = fit_unclipped(y, np.ones((4, 4), np.bool_), _COSINES, _SINES, a1, a2, as_is)
    missing[0], missing[1] = b1 - c1, b2 - c2
    for cell in range(4):
        c = _COLORS[cell]
        if kept[cell].any() and left[cell] > as_is[cell]:
            missing[2 + c] += (left[cell] - as_is[cell]) * (HALF if c == 1 else ONE)
