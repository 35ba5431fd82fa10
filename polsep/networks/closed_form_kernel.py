"""The closed form of `joint.Joint.guess` on rows of packed pixels: slopes from windows, specular light, misfit."""

from __future__ import annotations

from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, TWO, ZERO, compiled
from polsep.compute.rows import add_product, average, copy, fill, sum_three
from polsep.separation.color_affine import MAX_DIFFUSE_DOLP

#: Rows of moments that a ring keeps: twice the widest window.
SUMMED = 16

_MOST, _TINY = np.float32(MAX_DIFFUSE_DOLP), np.float32(1e-12)


@compiled
def pool(t: int, h: int, window: int, sums: Any, spare: Any) -> None:
    """Means of the three moments over (2 ``window`` + 1)^2 around row ``t``, to ``spare [3, w]``."""
    w = spare.shape[1]
    padded, threes = np.zeros(w + 8, np.float32), np.zeros(w + 8, np.float32)
    first, last = max(t - window, 0), min(t + window, h - 1)
    for k in range(3):
        inner, found = padded[4 : w + 4], spare[k]
        fill(ZERO, inner)
        for row in range(first, last + 1):
            add_product(sums[row % SUMMED, k], ONE, inner)
        sum_three(padded, padded[1:], padded[2:], threes[: w + 6])
        if window == 1:
            copy(threes[3:], found)
        else:
            sum_three(threes, threes[3:], threes[6:], found)
        average(found, window, np.float32(last - first + 1))


@compiled
def find_slope(pooled: Any, trust: Any, a1: Any, a2: Any) -> None:
    """The slope from pooled moments ``[3, w]``, drawn toward the one before, to ``a1``, ``a2``."""
    p1, p2, p0 = pooled[0], pooled[1], pooled[2]
    for j in range(a1.size):
        a1[j] = (p1[j] + trust * a1[j]) / (p0[j] + trust)
    for j in range(a2.size):
        a2[j] = (p2[j] + trust * a2[j]) / (p0[j] + trust)
    for j in range(a1.size):
        size = np.sqrt(a1[j] * a1[j] + a2[j] * a2[j] + _TINY)
        limit = _MOST / (size if size > _MOST else _MOST)
        a1[j] *= limit
        a2[j] *= limit


@compiled
def white_specular(b1: Any, b2: Any, a1: Any, a2: Any, tau: Any) -> None:
    """`joint.white_specular` of a row, not below 0; ``tau`` is ``b1``'s place as well as its own."""
    for j in range(tau.size):
        real = b1[j] * a1[j] + b2[j] * a2[j]
        free = ONE - a1[j] * a1[j] - a2[j] * a2[j]
        root = (real + np.sqrt(real * real + free * (b1[j] * b1[j] + b2[j] * b2[j]) + _TINY)) / free
        tau[j] = root if root > ZERO else ZERO


@compiled
def offset(means: Any, a: Any, mean: Any, b: Any) -> None:
    """What the slope leaves of the polarization: ``b = means - a mean``."""
    for j in range(b.size):
        b[j] = means[j] - a[j] * mean[j]


@compiled
def limit(s0: Any, tau: Any) -> None:
    """No more specular light than a colour has."""
    for j in range(tau.size):
        most = s0[j] if s0[j] > ZERO else ZERO
        tau[j] = tau[j] if tau[j] < most else most


@compiled
def misfit(moments: Any, a: tuple[Any, Any], distance: Any) -> None:
    """Distance of the polarization from the line; ``moments [4, w]``."""
    a1, a2 = a
    own, first, second, total = moments[0], moments[1], moments[2], moments[3]
    for j in range(distance.size):
        distance[j] = total[j] - TWO * (a1[j] * first[j] + a2[j] * second[j])
    for j in range(distance.size):
        left = distance[j] + (a1[j] * a1[j] + a2[j] * a2[j]) * own[j]
        distance[j] = np.sqrt((HALF * left if left > ZERO else ZERO) + _TINY)
