"""Kernel that weighs images of several networks, or of one that sees a frame in several ways: twin of `run.combine`.

They come one after the other, so that no more than two of them are read at once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_up
from polsep.compute.threads import RowRange
from polsep.networks.strips import LEAST_ERROR
from polsep.physics.stokes_kernel import aolp, polarized_components
from polsep.separation.tally_kernel import count_above_one

Floats = NDArray[np.float32]

#: Columns of ``sums``: diffuse and specular light, expected variance of both, DoLP above 1, valid pixels.
SUMS = 6
_LEAST_ERROR = np.float32(LEAST_ERROR)


class Rows(NamedTuple):
    """Images of a frame by rows: colours ``[h, w C]``, ``error [h, 2 w]``, others ``[h, w]``."""

    diffuse: Floats
    specular: Floats
    error: Floats
    valid: NDArray[np.bool_]
    dolp: Floats
    aolp: Floats


@compiled
def _weigh(error: Any, other: Any, factors: Any, count: int, weight: Any, part: Any) -> None:
    """The share ``part`` of the other images among all, and the sum of all ``weight``; errors become their mean."""
    for j in range(part.size):
        mine, theirs = max(error[j], _LEAST_ERROR), max(other[j], _LEAST_ERROR)
        before = factors[0] / (mine * mine) if count == 1 else weight[j]
        added = factors[1] / (theirs * theirs)
        weight[j] = before + added
        part[j] = added / (before + added)
        error[j] += part[j] * (other[j] - error[j])


@compiled
def _mix(image: Any, other: Any, part: Any, gains: Any) -> float:
    """Mix a row of colours; return the sum over its pixels of the mean of the colours, of white light."""
    colors, total = gains.size, 0.0
    for c in range(colors):
        own, others = image[c::colors], other[c::colors]
        for j in range(part.size):
            own[j] += part[j] * (others[j] - own[j])
        total += add_up(own) / (gains[c] * colors)
    return total


@compiled
def _mix_polarization(dolp: Any, angle: Any, other_dolp: Any, other_angle: Any, part: Any) -> None:
    """Mean of two rows of polarization, of which the second one has a share ``part``."""
    for j in range(dolp.size):
        x, y = polarized_components(dolp[j], angle[j])
        x_other, y_other = polarized_components(other_dolp[j], other_angle[j])
        x, y = x + part * (x_other - x), y + part * (y_other - y)
        dolp[j], angle[j] = np.sqrt(x * x + y * y), aolp(x, y)


@compiled
def _sum_squares(row: Any, gain: Any, buffer: Any) -> float:
    for j in range(buffer.size):
        buffer[j] = row[j] / gain * (row[j] / gain)
    return add_up(buffer)


@entry
def add_images(
    images: Rows,
    other: Rows,
    factors: Floats,
    count: int,
    weights: Floats,
    gains: Floats,
    sums: NDArray[np.float64],
    row_range: RowRange,
) -> None:
    """Make ``images``, the mean of ``count``, that of these and one ``other``, in a range of rows.

    ``weights [h, 2 w]``: the sum of the weights of diffuse and of specular so far, filled at a count of 1; a weight is
    one of the ``factors [2]``, of the first images and of the others, over the expected variance. ``gains [C]``: the
    light's colour. ``sums [h, 6]`` are overwritten.
    """
    w, mean_gain = images.dolp.shape[1], ZERO
    for c in range(gains.size):
        mean_gain += gains[c] / np.float32(gains.size)
    part, buffer = np.empty(2 * w, np.float32), np.empty(w, np.float32)
    for y in range(row_range[0], row_range[1]):
        error, row = images.error[y], sums[y]
        _weigh(error, other.error[y], factors, count, weights[y], part)
        row[0] = _mix(images.diffuse[y], other.diffuse[y], part[::2], gains)
        row[1] = _mix(images.specular[y], other.specular[y], part[1::2], gains)
        row[2] = _sum_squares(error[::2], mean_gain, buffer)
        row[3] = _sum_squares(error[1::2], mean_gain, buffer)
        dolp = images.dolp[y]
        _mix_polarization(dolp, images.aolp[y], other.dolp[y], other.aolp[y], ONE / np.float32(count + 1))
        row[4] = count_above_one(dolp, buffer)
        valid, others, kept = images.valid[y], other.valid[y], 0
        for j in range(w):
            valid[j] = valid[j] and others[j]
            kept += valid[j]
        row[5] = kept


def warm_up() -> None:
    """Load the kernel, or compile it."""
    for colors in (3, 1):
        diffuse, specular, error, dolp, aolp = (np.ones((1, n), np.float32) for n in (colors, colors, 2, 1, 1))
        rows, gains = Rows(diffuse, specular, error, np.ones((1, 1), np.bool_), dolp, aolp), np.ones(colors, np.float32)
        add_images(rows, rows, np.ones(2, np.float32), 1, error.copy(), gains, np.zeros((1, SUMS)), (0, 1))
