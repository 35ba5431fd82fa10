"""Kernels of `clipped_pattern`: the filter's weights, and what it changes where they are not zero."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, QUARTER, ZERO, compiled, entry
from polsep.compute.threads import RowRange, run_over_rows

Floats = NDArray[np.float32]

#: Rows, and cells, per task of a thread.
_ROWS, _CELLS = 16, 1024


def weigh_cells(clipped: NDArray[np.bool_], taps: tuple[float, ...], shares: tuple[float, ...], reach: int) -> Floats:
    """Twin of `clipped_pattern.weigh_clipped` for one frame ``[2h, 2w]``; ``shares``: both pairs, in one."""
    rows, cols = clipped.shape[0] // 2, clipped.shape[1] // 2
    counts, across, share, weight = (np.empty((rows, cols), np.float32) for _ in range(4))
    factors, limits = np.array(taps, np.float32), np.array(shares, np.float32)
    run_over_rows(lambda row_range: count_clipped(clipped, counts, row_range), rows, _ROWS)
    if not counts.any():
        return counts
    run_over_rows(lambda row_range: add_across(counts, factors, across, row_range), rows, _ROWS)
    run_over_rows(lambda row_range: add_down(across, factors, share, row_range), rows, _ROWS)
    run_over_rows(lambda row_range: weigh_shares(share, limits, reach, weight, row_range), rows, _ROWS)
    return weight


def change_cells(image: Floats, weight: Floats, cells: NDArray[np.int64], taps: tuple[float, ...]) -> Floats:
    """Filter an image ``[h, w, C]`` in ``cells``, in place; return the changes ``[N, scale^2, C]``.

    ``weight [h, w]``: of every cell; ``cells [N]``: the places, row by row, where it is not 0. Twin of
    `clipped_pattern.smooth_planes`.
    """
    scale = image.shape[0] // weight.shape[0]
    changes, factors = np.empty((cells.size, scale**2, image.shape[2]), np.float32), np.array(taps, np.float32)
    run_over_rows(lambda some: find_changes(image, cells, weight, factors, changes, some), cells.size, _CELLS)
    run_over_rows(lambda some: add_changes(image, cells, weight.shape[1], changes, some), cells.size, _CELLS)
    return changes


def warm_up() -> None:
    """Load the kernels, or compile them."""
    taps = (0.25, 0.5, 0.25)
    weight = weigh_cells(np.ones((2, 2), np.bool_), taps, (0.4, 0.5, 0.2, 0.25), 2)
    change_cells(np.zeros((1, 1, 3), np.float32), weight, np.flatnonzero(weight), taps)


@entry
def count_clipped(clipped: Any, counts: Any, row_range: RowRange) -> None:
    """Fill rows of ``counts [h, w]``: the share of each cell's samples that clip."""
    for r in range(row_range[0], row_range[1]):
        for c in range(counts.shape[1]):
            count = ZERO
            for i in range(2):
                for j in range(2):
                    if clipped[2 * r + i, 2 * c + j]:
                        count += QUARTER
            counts[r, c] = count


@entry
def add_across(image: Any, taps: Any, sums: Any, row_range: RowRange) -> None:
    """Fill rows of ``sums [h, w]``: pixels to the left and right times ``taps``, beyond the border the last ones."""
    half, last = taps.size // 2, image.shape[1] - 1
    for r in range(row_range[0], row_range[1]):
        for c in range(image.shape[1]):
            total = ZERO
            for k in range(taps.size):
                total += taps[k] * image[r, min(max(c + k - half, 0), last)]
            sums[r, c] = total


@entry
def add_down(image: Any, taps: Any, sums: Any, row_range: RowRange) -> None:
    """The same of pixels above and below."""
    half, last = taps.size // 2, image.shape[0] - 1
    for r in range(row_range[0], row_range[1]):
        for c in range(image.shape[1]):
            sums[r, c] = ZERO
        for k in range(taps.size):
            row = min(max(r + k - half, 0), last)
            for c in range(image.shape[1]):
                sums[r, c] += taps[k] * image[row, c]


@entry
def weigh_shares(share: Any, limits: Any, reach: int, weight: Any, row_range: RowRange) -> None:
    """Fill rows of ``weight [h, w]`` by the shares of clipped samples; ``limits``: both pairs, in one."""
    height, width = share.shape
    for r in range(row_range[0], row_range[1]):
        for c in range(width):
            if share[r, c] <= limits[2]:
                weight[r, c] = ZERO
                continue
            least = share[r, c]
            for y in range(max(r - reach, 0), min(r + reach + 1, height)):
                for x in range(max(c - reach, 0), min(c + reach + 1, width)):
                    least = min(least, share[y, x])
            near, wide = _rise(share[r, c], limits[0], limits[1]), _rise(least, limits[2], limits[3])
            weight[r, c] = max(near, wide)


@entry
def find_changes(image: Any, cells: Any, weight: Any, taps: Any, changes: Any, some: RowRange) -> None:
    """Fill ``changes [N, scale^2, C]`` of some cells: the filtered image less the image, times the weight."""
    scale, half = image.shape[0] // weight.shape[0], taps.size // 2
    for n in range(some[0], some[1]):
        row, col = cells[n] // weight.shape[1], cells[n] % weight.shape[1]
        for k in range(scale * scale):
            y, x = scale * row + k // scale, scale * col + k % scale
            for channel in range(image.shape[2]):
                total = ZERO
                for i in range(taps.size):
                    down = min(max(y + i - half, 0), image.shape[0] - 1)
                    line = ZERO
                    for j in range(taps.size):
                        across = min(max(x + j - half, 0), image.shape[1] - 1)
                        line += taps[j] * image[down, across, channel]
                    total += taps[i] * line
                changes[n, k, channel] = weight[row, col] * (total - image[y, x, channel])


@entry
def add_changes(image: Any, cells: Any, width: int, changes: Any, some: RowRange) -> None:
    """Add the changes of some cells, in lines of ``width``, to an image."""
    scale = 1 if changes.shape[1] == 1 else 2
    for n in range(some[0], some[1]):
        row, col = scale * (cells[n] // width), scale * (cells[n] % width)
        for k in range(scale * scale):
            for channel in range(image.shape[2]):
                image[row + k // scale, col + k % scale, channel] += changes[n, k, channel]


@compiled
def _rise(value: Any, low: Any, high: Any) -> Any:
    """0 at ``low``, 1 at ``high``, linear between, constant beyond."""
    return min(max((value - low) / (high - low), ZERO), ONE)
