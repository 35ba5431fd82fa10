"""Twins of `stokes` for rows of pixels: Stokes vectors of four analysers, DoLP and AoLP."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, ZERO, compiled
from polsep.physics.stokes import MAX_DOLP

_PI, _HALF_PI, _MAX_DOLP = np.float32(math.pi), np.float32(math.pi / 2), np.float32(MAX_DOLP)

# atan(x) / x on [0, 1] as a polynomial in x^2: own minimax fit (iteratively reweighted least squares), 2.5e-7 rad.
_A0, _A1, _A2, _A3, _A4, _A5, _A6 = (
    np.float32(c)
    for c in (0.999996112, -0.333173682, 0.198078157, -0.132333405, 0.079623623, -0.0336041677, 0.00681177381)
)

# sin(x) / x and cos(x) on [-pi / 2, pi / 2] as Taylor's polynomials in x^2, 6e-8.
_S1, _S2, _S3, _S4, _S5 = (np.float32((-1) ** k / math.factorial(2 * k + 1)) for k in range(1, 6))
_C1, _C2, _C3, _C4, _C5, _C6 = (np.float32((-1) ** k / math.factorial(2 * k)) for k in range(1, 7))


@compiled
def fit_stokes_row(m: Any, c: int, inverse: Any, s0: Any, s1: Any, s2: Any) -> None:
    """Twin of `stokes.fit_stokes` for colour ``c`` of a row of analysers ``m [4, C, n]``; ``inverse [3, 4]``."""
    i00, i01, i02, i03 = inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[0, 3]
    i10, i11, i12, i13 = inverse[1, 0], inverse[1, 1], inverse[1, 2], inverse[1, 3]
    i20, i21, i22, i23 = inverse[2, 0], inverse[2, 1], inverse[2, 2], inverse[2, 3]
    m0, m1, m2, m3 = m[0, c], m[1, c], m[2, c], m[3, c]
    for j in range(s0.size):
        s0[j] = i00 * m0[j] + i01 * m1[j] + i02 * m2[j] + i03 * m3[j]
        s1[j] = i10 * m0[j] + i11 * m1[j] + i12 * m2[j] + i13 * m3[j]
        s2[j] = i20 * m0[j] + i21 * m1[j] + i22 * m2[j] + i23 * m3[j]


@compiled
def fit_stokes_unclipped(m: Any, clipped: Any, inverses: Any, c: int, s: Any) -> int:
    """Twin of `stokes.fit_stokes_unclipped` for colour ``c`` of one pixel, to ``s [3, C]``; ``m [4, C]``.

    ``clipped``: bits 1 << (3 k + c) of the clipped analysers k and colours c. ``inverses [16, 3, 4]`` by which of the
    four are clipped: a code with a bit per analyser, which is returned.
    """
    code = 0
    for k in range(4):
        code |= (clipped >> (3 * k + c) & 1) << k
    for i in range(3):
        value = ZERO
        for k in range(4):
            value += inverses[code, i, k] * m[k, c]
        s[i, c] = value
    return code


@compiled
def aolp(s1: Any, s2: Any) -> Any:
    """AoLP in [0, pi) without branches: atan2(s2, s1) / 2. Twin of `stokes.aolp`."""
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
def polarize(s0: Any, s1: Any, s2: Any, dolp: Any, angle: Any) -> None:
    """DoLP, 0 where s0 is not positive and at most `MAX_DOLP`, and AoLP of a row."""
    for j in range(dolp.size):
        degree = np.sqrt(s1[j] * s1[j] + s2[j] * s2[j]) / (s0[j] if s0[j] > ZERO else ONE)
        dolp[j] = min(degree, _MAX_DOLP) if s0[j] > ZERO else ZERO
        angle[j] = aolp(s1[j], s2[j])


@compiled
def polarized_components(dolp: Any, angle: Any) -> Any:
    """The inverse of `polarize` for light of s0 = 1: s1 and s2 of an AoLP in [0, pi], without branches."""
    x = angle - _HALF_PI
    z = x * x
    sine = x * (ONE + z * (_S1 + z * (_S2 + z * (_S3 + z * (_S4 + z * _S5)))))
    cosine = ONE + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6)))))
    return dolp * (sine * sine - cosine * cosine), -(dolp + dolp) * sine * cosine
