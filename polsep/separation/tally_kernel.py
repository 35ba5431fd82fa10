"""Sums over rows of a separated frame, as `report.Tally` has them: twin of `report.tally`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled
from polsep.compute.rows_kernel import add_up
from polsep.separation.images import Tally

#: Columns of ``sums [rows, 8]``.
S0, SPECULAR, ABOVE_ONE, POWER, ALONG, ACROSS, RESIDUAL, NOISE = range(8)


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
