"""One round of bilateral normal integration on the pixels of a mask: weights, their energy, and the linear system.

Pixels are numbered row by row; `Places.near` ``[N, 4]`` has the numbers of those above, left, right and below, or -1.
A row of the matrix has the same order, with the pixel itself in the middle. See `polsep.geometry.integration` for
the equations; tests/test_geometry.py has them in NumPy.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import compiled, entry

#: Neighbours, in the order of their numbers.
UP, LEFT, RIGHT, DOWN = range(4)

Floats = NDArray[np.float64]


class Places(NamedTuple):
    """Neighbours ``near [N, 4]``, and the start of each row of the matrix ``starts [N + 1]``."""

    near: NDArray[np.int32]
    starts: NDArray[np.int32]


class Wanted(NamedTuple):
    """Per pixel q ``cosine [N]`` and q times the slope along u and v, ``value [2, N]``."""

    cosine: Floats
    value: Floats


@compiled
def _weigh(rises: tuple[float, float], there: tuple[bool, bool], cosine: float, sharpness: float) -> float:
    """The weight of the side ahead, of rises behind and ahead."""
    behind, ahead = rises
    if not (there[0] and there[1]):
        return 1.0 if there[1] else 0.0
    return 0.5 * (1 + math.tanh(0.5 * sharpness * cosine * cosine * (behind * behind - ahead * ahead)))


@entry
def fill_weights(depth: Floats, places: Places, wanted: Wanted, sharpness: float, weights: Floats) -> float:
    """Fill ``weights [2, N]`` of the sides ahead along u and v; the weighted sum of squared residuals."""
    near, energy = places.near, 0.0
    for pixel in range(depth.size):
        here, cosine = depth[pixel], wanted.cosine[pixel]
        for axis, behind, ahead in ((0, LEFT, RIGHT), (1, UP, DOWN)):
            first, last = near[pixel, behind], near[pixel, ahead]
            down = here - depth[first] if first >= 0 else 0.0
            up = depth[last] - here if last >= 0 else 0.0
            weight = _weigh((down, up), (first >= 0, last >= 0), cosine, sharpness)
            weights[axis, pixel] = weight
            value = wanted.value[axis, pixel]
            if last >= 0:
                energy += weight * (cosine * up - value) ** 2
            if first >= 0:
                energy += (1 - weight) * (cosine * down - value) ** 2
    return energy


@entry
def fill_system(places: Places, wanted: Wanted, weights: Floats, entries: Floats, right: Floats) -> None:
    """Fill the matrix's ``entries``, row by row, and the right side ``[N]``, whose solution has the least energy."""
    near, cosine, value = places.near, wanted.cosine, wanted.value
    for pixel in range(right.size):
        at = places.starts[pixel]
        own = at + (near[pixel, UP] >= 0) + (near[pixel, LEFT] >= 0)
        total, goal = 0.0, 0.0
        for side in range(4):
            other = near[pixel, side]
            if other < 0:
                continue
            axis = 0 if side in (LEFT, RIGHT) else 1
            ahead = side >= RIGHT
            first, second = (pixel, other) if ahead else (other, pixel)
            one, rest = weights[axis, first] * cosine[first], (1 - weights[axis, second]) * cosine[second]
            strength = one * cosine[first] + rest * cosine[second]
            target = one * value[axis, first] + rest * value[axis, second]
            goal += -target if ahead else target
            total += strength
            at += at == own
            entries[at] = -strength
            at += 1
        entries[own] = total
        right[pixel] = goal
