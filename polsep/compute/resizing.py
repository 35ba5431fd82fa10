"""Images ``[..., h, w]`` at other resolutions, of either kind of array, as torch's pooling and `interpolate` have them.

Pixels are areas: the first and the last one end where the image does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import Array, constant, namespace, of_kind


def halve(x: Array) -> Array:
    """Means of 2x2 pixels; of what there is at the border of an odd size."""
    for ends in ((), (slice(None),)):
        first, second = x[(..., slice(0, None, 2), *ends)], x[(..., slice(1, None, 2), *ends)]
        if first.shape != second.shape:
            second = namespace(x).concat([second, x[(..., slice(-1, None), *ends)]], axis=-1 - len(ends))
        x = (first + second) / 2
    return x


def blocks_of(x: Array, side: int) -> Array:
    """The whole blocks ``[..., h/side, side, w/side, side]`` of that many pixels along each side."""
    rows, cols = (n // side for n in x.shape[-2:])
    return x[..., : rows * side, : cols * side].reshape(*x.shape[:-2], rows, side, cols, side)


def block_means(x: Array, side: int) -> Array:
    """Means over `blocks_of` an image."""
    xp = namespace(x)
    return xp.mean(xp.mean(blocks_of(x, side), axis=-3), axis=-1)


def repeat_pixels(x: Array, times: int) -> Array:
    """Every pixel so many times in both directions, ``[..., h, w]`` to ``[..., times h, times w]``."""
    xp = namespace(x)
    return x if times == 1 else xp.repeat(xp.repeat(x, times, axis=-1), times, axis=-2)


def resize_bilinear(x: Array, size: tuple[int, int]) -> Array:
    """The image at ``size`` (height, width), linear between the middles of its pixels and constant beyond them."""
    for axis, count in zip((-1, -2), size[::-1], strict=True):
        n = x.shape[axis]
        place = np.maximum((np.arange(count) + 0.5) * n / count - 0.5, 0)
        first = np.floor(place).astype(np.int64)
        x = _mix(x, axis, [first, np.minimum(first + 1, n - 1)], [1 - (place - first), place - first])
    return x


def resize_area(x: Array, size: tuple[int, int]) -> Array:
    """The image at ``size`` (height, width), at most its own: means of the pixels that a new one covers or touches."""
    for axis, count in zip((-2, -1), size, strict=True):
        n, k = x.shape[axis], np.arange(count)
        start, stop = k * n // count, -(-(k + 1) * n // count)
        places = [start + step for step in range(int((stop - start).max()))]
        weights = [(place < stop) / (stop - start) for place in places]
        x = _mix(x, axis, [np.minimum(place, n - 1) for place in places], weights)
    return x


def _mix(x: Array, axis: int, places: list[NDArray[np.int64]], weights: list[NDArray[np.float64]]) -> Array:
    """Sum of the pixels at several ``places [n]`` along an axis times their ``weights [n]``."""
    xp, mixed = namespace(x), 0.0
    for place, weight in zip(places, weights, strict=True):
        weight = weight if axis == -1 else weight[:, None]
        mixed = mixed + xp.take(x, of_kind(place, x), axis=axis) * constant(weight, x)
    return mixed
