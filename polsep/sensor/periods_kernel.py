"""Sums over the 4x4 period of all filters, and over blocks of one period: what checks of a raw frame look at."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ZERO, compiled, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows

Floats = NDArray[np.float32]

#: Samples along the sides of a period, and rows of blocks that are worth a thread.
PERIOD, STEP = 4, 16


class Blocks(NamedTuple):
    """Statistics of blocks of 4x4 samples, ``[K, N]`` each.

    ``mean``, ``least``, ``most``: of the samples. ``square``, ``variance``: of the difference of a block to the mean of
    its neighbours on both sides, sample by sample, over that of one sample; 0 in the first and the last column.
    """

    mean: Floats
    least: Floats
    most: Floats
    square: Floats
    variance: Floats


def sum_periods(x: NDArray[Any], side: int, lines: int) -> tuple[Floats, Floats]:
    """Sums ``[4, 4, rows, cols]`` of each sample of the period over blocks of ``side`` samples, and their largest one.

    ``x [H, W]``. Of every block the first ``lines`` rows are read, a multiple of 4 as ``side`` is.
    """
    rows, cols = (n // side for n in x.shape)
    sums, largest = np.empty((PERIOD, PERIOD, rows, cols), np.float32), np.empty((rows, cols), np.float32)
    samples = read_only(np.ascontiguousarray(x, np.float32))
    run_over_rows(partial(_add_periods, samples, side, lines, sums, largest), rows, STEP)
    return sums, largest


def measure_blocks(x: Floats) -> Blocks:
    """Statistics of the blocks of samples ``x [H, W]``."""
    found = Blocks._make(np.zeros((5, *(n // PERIOD for n in x.shape)), np.float32))
    _measure_blocks(read_only(np.ascontiguousarray(x)), found)
    return found


def warm_up() -> None:
    """Load the kernels, or compile them."""
    sum_periods(np.zeros((4, 4), np.float32), 4, 4)
    measure_blocks(np.zeros((4, 4), np.float32))


@entry
def _add_periods(x: Any, side: int, lines: int, sums: Any, largest: Any, row_range: RowRange) -> None:
    """Fill some rows of ``sums`` and ``largest``: sums over rows first, in which columns stay apart."""
    width = sums.shape[3] * side
    columns, highest = np.empty((PERIOD, width), np.float32), np.empty(width, np.float32)
    for r in range(row_range[0], row_range[1]):
        for k in range(lines):
            row, total = x[r * side + k], columns[k % PERIOD]
            for j in range(width):
                total[j] = row[j] + (total[j] if k >= PERIOD else ZERO)
            for j in range(width):
                highest[j] = row[j] if k == 0 or row[j] > highest[j] else highest[j]
        for c in range(sums.shape[3]):
            for k in range(PERIOD):
                for m in range(PERIOD):
                    total_of_one = ZERO
                    for j in range(c * side + m, (c + 1) * side, PERIOD):
                        total_of_one += columns[k, j]
                    sums[k, m, r, c] = total_of_one
            most = highest[c * side]
            for j in range(c * side + 1, (c + 1) * side):
                most = max(most, highest[j])
            largest[r, c] = most


@compiled
def _add_lines(x: Any, first: int, lines: Any, columns: Any) -> None:
    """Over the four rows of a row of blocks, column by column: sums, least, most, sums of differences.

    ``lines [2, 4, W]``: differences to both neighbours, and their squares. ``columns [6, W]``: last, their sums, and of
    every other row the sums of their squares.
    """
    n = columns.shape[1] - 2 * PERIOD
    for k in range(PERIOD):
        row, change, square = x[first + k], lines[0, k], lines[1, k]
        before, here, after, changes = row[:n], row[PERIOD:], row[2 * PERIOD :], change[PERIOD:]
        for j in range(n):
            changes[j] = here[j] - HALF * (before[j] + after[j])
        for j in range(square.size):
            square[j] = change[j] * change[j]
    a, b, c, d = x[first], x[first + 1], x[first + 2], x[first + 3]
    for j in range(columns.shape[1]):
        columns[0, j] = (a[j] + b[j]) + (c[j] + d[j])
        columns[1, j] = min(min(a[j], b[j]), min(c[j], d[j]))
        columns[2, j] = max(max(a[j], b[j]), max(c[j], d[j]))
    a, b, c, d = lines[0, 0], lines[0, 1], lines[0, 2], lines[0, 3]
    for j in range(columns.shape[1]):
        columns[3, j] = (a[j] + b[j]) + (c[j] + d[j])
    a, b, c, d = lines[1, 0], lines[1, 1], lines[1, 2], lines[1, 3]
    for j in range(columns.shape[1]):
        columns[4, j], columns[5, j] = a[j] + c[j], b[j] + d[j]


@entry
def _measure_blocks(x: Any, blocks: Blocks) -> None:
    """Fill the statistics. Squares are added up in NumPy's order, to the same bits."""
    rows, cols = blocks.mean.shape
    lines, columns = np.zeros((2, PERIOD, cols * PERIOD), np.float32), np.zeros((6, cols * PERIOD), np.float32)
    share, other = np.float32(1 / PERIOD**2), np.float32(1.5)
    total, least, most, across, even, odd = columns[0], columns[1], columns[2], columns[3], columns[4], columns[5]
    for r in range(rows):
        _add_lines(x, r * PERIOD, lines, columns)
        for c in range(cols):
            i, j, k, m = PERIOD * c, PERIOD * c + 1, PERIOD * c + 2, PERIOD * c + 3
            blocks.mean[r, c] = share * ((total[i] + total[j]) + (total[k] + total[m]))
            blocks.least[r, c] = min(min(least[i], least[j]), min(least[k], least[m]))
            blocks.most[r, c] = max(max(most[i], most[j]), max(most[k], most[m]))
            mean = share * ((across[i] + across[j]) + (across[k] + across[m]))
            square = share * (((even[i] + even[j]) + (even[k] + even[m])) + ((odd[i] + odd[j]) + (odd[k] + odd[m])))
            blocks.square[r, c] = square / other
            blocks.variance[r, c] = max(square - mean * mean, ZERO) / other
