"""Rows of `joint.Joint.closed_form`: the diffuse polarization from windows, and the residual of the fit.

Its other equations are in `polsep.separation.closed_form_kernel`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, TWO, ZERO, compiled
from polsep.compute.rows_kernel import add_product, average, copy, fill, sum_three
from polsep.separation.closed_form_kernel import limit_dolp_row

#: Rows of moments that a ring keeps: twice the widest window.
SUMMED = 16

_TINY = np.float32(1e-12)


@compiled
def pool(t: int, h: int, window: int, sums: Any, pooled: Any) -> None:
    """Means of the three moments over (2 ``window`` + 1)^2 pixels, ``window`` 1 or 4, to ``pooled [3, w]``.

    ``sums [SUMMED, 3, w]``: the moments of rows up to ``t + window``, a ring; the frame has ``h`` rows.
    """
    w = pooled.shape[1]
    padded, threes = np.zeros(w + 8, np.float32), np.zeros(w + 8, np.float32)
    first, last = max(t - window, 0), min(t + window, h - 1)
    for k in range(3):
        inner, mean = padded[4 : w + 4], pooled[k]
        fill(ZERO, inner)
        for row in range(first, last + 1):
            add_product(sums[row % SUMMED, k], ONE, inner)
        sum_three(padded, padded[1:], padded[2:], threes[: w + 6])
        if window == 1:
            copy(threes[3:], mean)
        else:
            sum_three(threes, threes[3:], threes[6:], mean)
        average(mean, window, np.float32(last - first + 1))


@compiled
def steady_diffuse_polarization(pooled: Any, trust: Any, a1: Any, a2: Any) -> None:
    """One window of `joint.fit_diffuse_polarization` from ``pooled [3, w]``, drawn to the wider one's ``a1, a2``."""
    p1, p2, p0 = pooled[0], pooled[1], pooled[2]
    for j in range(a1.size):
        a1[j] = (p1[j] + trust * a1[j]) / (p0[j] + trust)
    for j in range(a2.size):
        a2[j] = (p2[j] + trust * a2[j]) / (p0[j] + trust)
    limit_dolp_row(a1, a2)


@compiled
def fit_residual(moments: Any, a1: Any, a2: Any, residual: Any) -> None:
    """The rms distance of s1 and s2 of the colours from p = a s0 + b; ``moments [4, w]``."""
    own, first, second, total = moments[0], moments[1], moments[2], moments[3]
    for j in range(residual.size):
        residual[j] = total[j] - TWO * (a1[j] * first[j] + a2[j] * second[j])
    for j in range(residual.size):
        left = residual[j] + (a1[j] * a1[j] + a2[j] * a2[j]) * own[j]
        residual[j] = np.sqrt((HALF * left if left > ZERO else ZERO) + _TINY)
