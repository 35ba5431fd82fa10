"""Patterns of the mosaic's period in images of networks, smoothed out where samples clip.

Networks have weights of their own for each of the `PERIOD` squared places of a colour mosaic, those for mono too. Where
all samples of an analyser clip, they see the same numbers in every period, and what they make of them repeats
with it: dots, stripes. Little detail is lost with them: each analyser that is left is measured once in a 2x2 cell. So
images are averaged there by a filter whose response is zero at the period's frequencies. It has its full weight where
half of the samples around a cell clip. In mono frames a quarter is enough if that goes on for `REACH` cells to all
sides, where no edges of small highlights are; in colour frames a quarter may be one colour, and others keep the detail.
All other pixels keep every bit.

Constants are of validation frames (docs/experiments.md, "Patterns where samples clip"). Source: this project's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from polsep.compute.arrays import Array, namespace, pad_repeat, to_numpy, window
from polsep.compute.filters import largest_around
from polsep.compute.resizing import block_means, repeat_pixels
from polsep.compute.warm_up import make_ready
from polsep.sensor.camera import PERIOD, Mosaic
from polsep.separation import clipped_pattern_kernel
from polsep.separation.analytic import Separation
from polsep.separation.clipped_pattern_kernel import change_cells, weigh_cells
from polsep.separation.images import FrameImages

#: Shares of clipped samples around a cell between which the filter's weight rises; the same where they go on, in mono.
SHARES, WIDE_SHARES = (0.4, 0.5), (0.2, 0.25)
#: Cells to each side over which the smaller share goes on.
REACH = 2


def smooth_separation(separation: Separation, mosaic: Mosaic) -> Separation:
    """A separation of a mosaic ``[..., H, W]`` at half or full resolution, without patterns where samples clip.

    Expected errors and Stokes images stay.
    """
    scale, rows, cols = _cells(mosaic, separation.diffuse.shape[-2:])
    images = (separation.diffuse, separation.specular)
    xp, clipped = namespace(images[0]), mosaic.clipped()[..., None, rows, cols]
    weight = weigh_clipped(xp.astype(clipped, images[0].dtype), taps_of(PERIOD), shares_of(mosaic.layout.channels))
    weight = repeat_pixels(weight, scale)
    diffuse, specular = (smooth_planes(image, weight, taps_of(PERIOD * scale // 2)) for image in images)
    return replace(separation, diffuse=diffuse, specular=specular)


def smooth_clipped(images: FrameImages, mosaic: Mosaic, light: tuple[float, ...]) -> FrameImages:
    """`smooth_separation` of one frame by kernels, in a ``light`` (camera RGB); arrays of images are written to."""
    scale, rows, cols = _cells(mosaic, images.diffuse.shape[:2])
    clipped = np.ascontiguousarray(to_numpy(mosaic.data)[rows, cols] >= mosaic.clip_level)
    if not clipped.any():
        return images
    make_ready(clipped_pattern_kernel.warm_up)
    colors, tally, along = images.diffuse.shape[2], images.tally, taps_of(PERIOD * scale // 2)
    gain = np.array(light[:colors], np.float32)
    weight = weigh_cells(clipped, taps_of(PERIOD), shares_of(colors), REACH)
    cells = np.flatnonzero(weight)
    changes = [change_cells(image, weight, cells, along) for image in (images.diffuse, images.specular)]
    if tally is not None:
        diffuse, specular = (float((change / gain).sum()) / colors for change in changes)
        tally = replace(tally, s0=tally.s0 + diffuse + specular, specular=tally.specular + specular)
    return replace(images, tally=tally)


def _cells(mosaic: Mosaic, size: tuple[int, int]) -> tuple[int, slice, slice]:
    """Pixels along a cell's side in images of that ``size``, and the rows and columns of samples that they show."""
    row, col = mosaic.layout.origin
    scale = 2 if 2 * size[0] > mosaic.data.shape[-2] else 1
    rows, cols = (2 * n // scale for n in size)
    return scale, slice(row, row + rows), slice(col, col + cols)


def weigh_clipped(clipped: Array, taps: tuple[float, ...], shares: tuple[float, ...]) -> Array:
    """The filter's weight ``[..., h, w]`` at every cell of frames ``[..., 2h, 2w]``, 1 where a sample ``clipped``.

    ``shares``: of `shares_of`.
    """
    share = add_taps(block_means(clipped, 2), taps)
    near, wide = (((share - low) / (high - low)).clip(0, 1) for low, high in (shares[:2], shares[2:]))
    return namespace(share).maximum(near, -largest_around(-wide, REACH))


def smooth_planes(image: Array, weight: Array, taps: tuple[float, ...]) -> Array:
    """An image ``[..., h, w]`` filtered, where pixels have a ``weight``."""
    return image + weight * (add_taps(image, taps) - image)


def shares_of(colors: int) -> tuple[float, ...]:
    """Both pairs of shares of frames with so many colours; the second one says nothing new of colour frames."""
    return (*SHARES, *(WIDE_SHARES if colors == 1 else SHARES))


def taps_of(period: int) -> tuple[float, ...]:
    """The filter along an axis: the mean of two means over a ``period``, a pixel apart; zero at its frequencies."""
    return (0.5 / period, *[1 / period] * (period - 1), 0.5 / period)


def add_taps(image: Array, taps: tuple[float, ...]) -> Array:
    """Sums of pixels around each of ``[..., h, w]`` times ``taps`` along both axes; beyond the border the last ones."""
    for axis in (-1, -2):
        n, padded = image.shape[axis], pad_repeat(image, len(taps) // 2, axis)
        image = sum(tap * window(padded, first, n, axis) for first, tap in enumerate(taps))
    return image
