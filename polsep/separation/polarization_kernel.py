"""Degree and angle of linear polarization of rows, and the sums over them that a report takes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry
from polsep.physics.stokes import MAX_DOLP

_PI, _HALF_PI, _MAX_DOLP = np.float32(math.pi), np.float32(math.pi / 2), np.float32(MAX_DOLP)

# atan(x) / x on [0, 1] as a polynomial in x^2: own minimax fit (iteratively reweighted least squares), 2.5e-7 rad.
_A0, _A1, _A2, _A3, _A4, _A5, _A6 = (
    np.float32(c)
    for c in (0.999996112, -0.333173682, 0.198078157, -0.132333405, 0.079623623, -0.0336041677, 0.00681177381)
)


@compiled
def half_angle(s1: Any, s2: Any) -> Any:
    """AoLP in [0, pi) without branches: atan2(s2, s1) / 2."""
    x, y = abs(s1), abs(s2)
    steep = y > x
    long, short = (y, x) if steep else (x, y)
    ratio = short / (long if long > ZERO else ONE)
    z = ratio * ratio
    angle = ratio * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * (_A5 + z * _A6))))))
    angle = _HALF_PI - angle if steep else angle
    angle = HALF * (_PI - angle if s1 < ZERO else angle)
    angle = _PI - angle if s2 < ZERO else angle
    return angle if angle < _PI else ZERO


@compiled
def polarize(s0: Any, s1: Any, s2: Any, dolp: Any, aolp: Any) -> None:
    """DoLP, 0 where s0 is not positive, and AoLP of rows of Stokes vectors. DoLP is at most `MAX_DOLP`."""
    for j in range(dolp.size):
        degree = np.sqrt(s1[j] * s1[j] + s2[j] * s2[j]) / (s0[j] if s0[j] > ZERO else ONE)
        dolp[j] = min(degree, _MAX_DOLP) if s0[j] > ZERO else ZERO
        aolp[j] = half_angle(s1[j], s2[j])


@compiled
def add_polarization(p1: Any, p2: Any, skipped: Any, sums: Any) -> None:
    """Add power, and power along and across, of the specular polarization to ``sums [3]``; not of ``skipped`` pixels.

    ``skipped``: a row that is not 0 there, or an empty one.
    """
    power, along, across = 0.0, 0.0, 0.0
    for j in range(p1.size):
        if skipped.size and skipped[j]:
            continue
        square = p1[j] * p1[j] + p2[j] * p2[j]
        size = np.sqrt(square)
        power += square
        along += size * p1[j]
        across += size * p2[j]
    sums[0] += power
    sums[1] += along
    sums[2] += across


@compiled
def sum_row(x: Any, skipped: Any) -> float:
    """The sum of a row in double precision, without ``skipped`` pixels."""
    total = 0.0
    for j in range(x.size):
        if not (skipped.size and skipped[j]):
            total += x[j]
    return total


@entry
def polarize_pixels(stokes: Any, dolp: Any, aolp: Any) -> None:
    """`polarize` for single pixels, ``stokes [3, N]``."""
    polarize(stokes[0], stokes[1], stokes[2], dolp, aolp)
