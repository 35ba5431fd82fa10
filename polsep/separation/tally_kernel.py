"""Sums over rows of a separated frame, as `report.Tally` has them: twin of `report.tally`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled
from polsep.compute.rows_kernel import add_up, fill
from polsep.separation.images import Tally

#: Columns of ``sums [rows, 8]``.
S0, SPECULAR, ABOVE_ONE, POWER, ALONG, ACROSS, RESIDUAL, NOISE = range(8)

#: Sums that `tally_pixels` adds up side by side, in float32, over a row.
LANES = 128


def make_tally(pixels: int, clipped: int, valid: int, sums: NDArray[np.float64]) -> Tally:
    """The tally of ``pixels`` from the first columns of their ``sums [rows, 6 to 8]``, added in one fixed order."""
    s0, specular, above_one, *others = sums.sum(axis=0).tolist()
    return Tally(pixels, clipped, valid, int(above_one), s0, specular, *others)


@compiled
def clear_where(mask: Any, row: Any) -> None:
    """0 where the ``mask`` is not 0; an empty mask clears nothing."""
    for j in range(mask.size):
        row[j] = row[j] if mask[j] == 0 else ZERO


@compiled
def add_polarization(weight: Any, p1: Any, p2: Any, buffer: Any, sums: Any) -> None:
    """Add w |p|, w p1 and w p2 to ``sums [3]``, for a row of polarization p and its ``weight`` w."""
    for j in range(buffer.size):
        buffer[j] = weight[j] * np.sqrt(p1[j] * p1[j] + p2[j] * p2[j])
    sums[0] += add_up(buffer)
    for j in range(buffer.size):
        buffer[j] = weight[j] * p1[j]
    sums[1] += add_up(buffer)
    for j in range(buffer.size):
        buffer[j] = weight[j] * p2[j]
    sums[2] += add_up(buffer)


@compiled
def count_above_one(dolp: Any, buffer: Any) -> float:
    """Return the number of pixels of a row with DoLP above 1."""
    for j in range(buffer.size):
        buffer[j] = ONE if dolp[j] > ONE else ZERO
    return add_up(buffer)


@compiled
def tally_row(specular: Any, diffuse: Any, p1: Any, p2: Any, dolp: Any, skipped: Any, sums: Any) -> None:
    """Sums over a row of the closed forms, without ``skipped`` pixels (not 0; empty if none), to the first six columns.

    Of means over colours: ``specular`` and ``diffuse`` light, and the specular polarization ``p1``, ``p2``, which is
    weighted by its own size. Every row is overwritten.
    """
    clear_where(skipped, specular)
    clear_where(skipped, diffuse)
    clear_where(skipped, p1)
    clear_where(skipped, p2)
    sums[SPECULAR] = add_up(specular)
    sums[S0] = sums[SPECULAR] + add_up(diffuse)
    for j in range(p1.size):
        diffuse[j] = np.sqrt(p1[j] * p1[j] + p2[j] * p2[j])
    add_polarization(diffuse, p1, p2, specular, sums[POWER:RESIDUAL])
    for j in range(dolp.size):
        diffuse[j] = dolp[j]
    clear_where(skipped, diffuse)
    sums[ABOVE_ONE] = count_above_one(diffuse, specular)


@compiled
def _clear_rest(planes: Any, size: int) -> None:
    """0 in all ``planes [K, n]`` behind the first ``size`` numbers."""
    for k in range(planes.shape[0]):
        for j in range(size, planes.shape[1]):
            planes[k, j] = ZERO


@compiled
def _add_products(gray: Any, sums: Any) -> None:
    """Add what `tally_kernel` sums of a row of Stokes vectors ``gray [3, n]`` to ``sums [4, L]``."""
    above, power, along, across = sums[0], sums[1], sums[2], sums[3]
    for first in range(0, gray.shape[1], sums.shape[1]):
        s0, s1, s2 = gray[0, first:], gray[1, first:], gray[2, first:]
        for j in range(min(above.size, s0.size)):
            squared = s1[j] * s1[j] + s2[j] * s2[j]
            size = np.sqrt(squared)
            above[j] += ONE if size > s0[j] and s0[j] > ZERO else ZERO
            power[j] += squared
            along[j] += size * s1[j]
            across[j] += size * s2[j]


@compiled
def _add_colors(planes: Any, sums: Any) -> None:
    """Add the mean over ``planes [C, n]`` to ``sums [L]``."""
    share, last = ONE / np.float32(planes.shape[0]), planes.shape[0] - 1
    for first in range(0, planes.shape[1], sums.size):
        x, y, z = planes[0, first:], planes[last // 2, first:], planes[last, first:]
        for j in range(min(sums.size, x.size)):
            sums[j] += share * (x[j] + (y[j] + z[j] if last else ZERO))


@compiled
def tally_pixels(split: Any, gray: Any, size: int, lanes: Any, sums: Any) -> None:
    """`tally_row` of the analytic split of a row of ``size`` pixels, where the specular light is what is polarized.

    ``split [2, C, n]``: specular light and s0, ``gray [3, n]``: Stokes vectors of the mean over colours; what is behind
    ``size`` is cleared. ``lanes [6, LANES]``: a buffer.
    """
    for k in range(2):
        _clear_rest(split[k], size)
    _clear_rest(gray, size)
    for k in range(6):
        fill(ZERO, lanes[k])
    _add_colors(split[0], lanes[SPECULAR])
    _add_colors(split[1], lanes[S0])
    _add_products(gray, lanes[ABOVE_ONE:])
    for k in range(6):
        sums[k] = add_up(lanes[k])
