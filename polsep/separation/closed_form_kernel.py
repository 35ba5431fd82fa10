"""Twins of `closed_form` for one pixel or a row of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, QUARTER, ZERO, compiled
from polsep.separation.closed_form import MAX_DIFFUSE_DOLP

_MAX_DOLP, _SINGULAR = np.float32(MAX_DIFFUSE_DOLP), np.float32(1e-6)


@compiled
def white_specular(b1: Any, b2: Any, a1: Any, a2: Any, epsilon: Any) -> Any:
    """Twin of `closed_form.white_specular`, not below 0."""
    real = b1 * a1 + b2 * a2
    free = ONE - a1 * a1 - a2 * a2
    tau = (real + np.sqrt(real * real + free * (b1 * b1 + b2 * b2) + epsilon)) / free
    return tau if tau > ZERO else ZERO


@compiled
def white_specular_row(b1: Any, b2: Any, a1: Any, a2: Any, epsilon: Any, tau: Any) -> None:
    """`white_specular` of a row."""
    for j in range(tau.size):
        tau[j] = white_specular(b1[j], b2[j], a1[j], a2[j], epsilon)


@compiled
def offset_row(p: Any, a: Any, s0: Any, b: Any) -> None:
    """One component of b = p - a s0."""
    for j in range(b.size):
        b[j] = p[j] - a[j] * s0[j]


@compiled
def limit_specular_row(s0: Any, tau: Any) -> None:
    """No more specular light than a colour has light."""
    for j in range(tau.size):
        most = s0[j] if s0[j] > ZERO else ZERO
        tau[j] = tau[j] if tau[j] < most else most


@compiled
def limit_dolp_row(a1: Any, a2: Any) -> None:
    """Twin of `closed_form.limit_dolp`, in place."""
    for j in range(a1.size):
        size = np.sqrt(a1[j] * a1[j] + a2[j] * a2[j])
        limit = _MAX_DOLP / (size if size > _MAX_DOLP else _MAX_DOLP)
        a1[j] *= limit
        a2[j] *= limit


@compiled
def fit_unclipped(y: Any, kept: Any, cosines: Any, sines: Any, a1: Any, a2: Any, s0: Any) -> Any:
    """Twin of `closed_form.fit_unclipped` for one pixel: b1, b2 and the least eigenvalue; ``s0 [C]`` is written.

    ``y``, twice the samples, and ``kept [C, 4]``; ``cosines``, ``sines [4]`` of twice the analysers' angles.
    """
    m00, m01, m11, r0, r1 = ZERO, ZERO, ZERO, ZERO, ZERO
    sums = np.zeros((s0.size, 4), np.float32)
    for c in range(s0.size):
        gg, gy, gu, gv = ZERO, ZERO, ZERO, ZERO
        for k in range(4):
            if kept[c, k]:
                g = ONE + cosines[k] * a1 + sines[k] * a2
                gg += g * g
                gy += g * y[c, k]
                gu += g * cosines[k]
                gv += g * sines[k]
        gg = gg if gg > _SINGULAR else _SINGULAR
        for k in range(4):
            if kept[c, k]:
                g = ONE + cosines[k] * a1 + sines[k] * a2
                p, q = cosines[k] - g * gu / gg, sines[k] - g * gv / gg
                m00 += p * p
                m01 += p * q
                m11 += q * q
                r0 += p * y[c, k]
                r1 += q * y[c, k]
        sums[c, 0], sums[c, 1], sums[c, 2], sums[c, 3] = gg, gy, gu, gv
    det = m00 * m11 - m01 * m01
    det = det if det > _SINGULAR else _SINGULAR
    b1, b2 = (m11 * r0 - m01 * r1) / det, (m00 * r1 - m01 * r0) / det
    for c in range(s0.size):
        s0[c] = (sums[c, 1] - sums[c, 2] * b1 - sums[c, 3] * b2) / sums[c, 0]
    return b1, b2, HALF * (m00 + m11) - np.sqrt(QUARTER * (m00 - m11) * (m00 - m11) + m01 * m01)
