"""Filters of images that know nothing of light."""

from __future__ import annotations

from functools import reduce

from array_api_compat import device

from polsep.compute.arrays import Array, is_exporting, namespace, pad_repeat, window


def box_mean(x: Array, radius: int) -> Array:
    """Mean over (2 radius + 1)^2 windows of ``[..., h, w]``; windows shrink at the border instead of padding."""
    if is_exporting():  # two nodes instead of dozens; three times slower in torch itself
        from torch.nn import functional

        images = x.reshape(-1, 1, *x.shape[-2:])
        for size, margin in (((1, 2 * radius + 1), (0, radius)), ((2 * radius + 1, 1), (radius, 0))):
            images = functional.avg_pool2d(images, size, 1, margin, count_include_pad=False)
        return images.reshape(x.shape)
    if radius == 0:
        return x
    xp = namespace(x)
    for axis in (-1, -2):
        n = x.shape[axis]
        border = (*x.shape[:-1], radius) if axis == -1 else (*x.shape[:-2], radius, x.shape[-1])
        zeros = xp.zeros(border, dtype=x.dtype, device=device(x))
        padded = xp.concat([zeros, x, zeros], axis=axis)
        total = window(padded, 0, n, axis) + window(padded, 1, n, axis)
        for k in range(2, 2 * radius + 1):
            total += window(padded, k, n, axis)
        place = xp.arange(n, device=device(x))
        count = 1 + place.clip(None, radius) + (n - 1 - place).clip(None, radius)
        total /= xp.astype(count if axis == -1 else count[:, None], x.dtype)
        x = total
    return x


def largest_around(x: Array, radius: int) -> Array:
    """The largest of the (2 radius + 1)^2 pixels around each of ``[..., h, w]``, of those that there are."""
    for axis in (-1, -2):
        padded, n = pad_repeat(x, radius, axis), x.shape[axis]
        x = reduce(namespace(x).maximum, [window(padded, first, n, axis) for first in range(2 * radius + 1)])
    return x
