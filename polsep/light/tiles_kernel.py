"""Second moments over tiles of a raw mosaic in one pass: the fast twin of `tiles.tile_mosaic`.

A strip goes down the frame period by period. Three periods of sensor rows are in a ring; from them a row of points is
blurred vertically, then horizontally, and its products are added to sums per column, which a finished tile row adds up.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.compute.threads import RowRange, run_over_rows
from polsep.light import tiles as twin
from polsep.light.tiles import DARKEST, FLOOR, GAIN_ERROR, LARGEST, PHOTONS, SIDE, Tiles
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples, read_row

_PHOTONS, _FLOOR, _GAIN = np.float32(PHOTONS), np.float32(FLOOR), np.float32(GAIN_ERROR**2)
_DARKEST, _LARGEST = np.float32(DARKEST), np.float32(LARGEST)


class Period(NamedTuple):
    """Constants of all rows. ``h, w``: points, every ``step`` periods; ``channels``; ``black``, ``scale`` of the codes.

    ``taps [4, 3]``: blur by place in the period. ``weights [4, 4, 4]``: part of each filter (row, column) in s0, s1,
    s2 and contradiction. ``colors [4, 4]``: channel of each filter.
    """

    h: int
    w: int
    step: int
    channels: int
    black: np.float32
    scale: np.float32
    taps: NDArray[np.float32]
    weights: NDArray[np.float32]
    colors: NDArray[np.int64]


class Buffers(NamedTuple):
    """Buffers of a strip: ``ring [3, 4, W]`` of sensor rows, ``peaks [4, W]``, sums ``columns [products, points]``.

    ``work``: images of one row of points and what is computed from them.
    """

    ring: NDArray[np.float32]
    peaks: NDArray[np.float32]
    columns: NDArray[np.float32]
    work: NDArray[np.float32]


def tile_raw(raw: RawFrame, layout: Layout, black_level: float, white_level: float) -> Tiles:
    """Return the tiles of a raw mosaic ``[H, W]`` (uint8, uint16, float32 or packed) in its own light."""
    periods = raw.shape[0] // 4, raw.shape[1] // 4
    step = twin.point_step(*periods)
    h, w = (-(-(n - 2) // step) for n in periods)
    weights, colors = np.zeros((4, 4, 4), np.float32), np.zeros((4, 4), np.int64)
    for (r, c), part in twin.filter_weights(layout).items():
        weights[r, c], colors[r, c] = part, layout.filter_at(r, c).channel
    taps = np.array([twin.taps(k) for k in range(4)], np.float32)
    scale = np.float32(1 / (white_level - black_level))
    period = Period(h, w, step, layout.channels, np.float32(black_level), scale, taps, weights, colors)
    rows, cols, size = -(-h // SIDE), -(-w // SIDE), 1 + 3 * layout.channels
    sums = np.zeros((rows, cols, size * size + layout.channels + 1), np.float32)
    run_over_rows(partial(_sum_rows, as_samples(raw), period, sums), rows, 2)
    flat = sums.reshape(rows * cols, -1).astype(np.float64)
    place = np.stack(np.divmod(np.arange(rows * cols), cols), axis=1)
    one, other = np.indices((size, size))
    upper = size * np.minimum(one, other) + np.maximum(one, other)  # the kernel makes one half of these matrices
    return twin.keep_tiles(flat[:, upper], flat[:, size * size : -1], flat[:, -1], place)


def warm_up() -> None:
    """Load the kernel, or compile it. One compilation serves all dtypes and layouts."""
    tile_raw(np.eye(16, dtype=np.uint8), Layout(), 0, 1)


def _sum_rows(samples: Samples, period: Period, sums: NDArray[np.float32], rows: RowRange) -> None:
    """Sums of a range of tile rows, with buffers of their own."""
    periods = period.step * (period.w - 1) + 3
    ring, peaks = np.empty((3, 4, 4 * periods), np.float32), np.empty((4, 4 * periods), np.float32)
    columns = np.empty((sums.shape[2], period.w), np.float32)
    work = np.empty((4 * period.channels + 3, 4 * periods), np.float32)
    sum_tile_rows(samples, period, (rows[0], rows[1]), Buffers(ring, peaks, columns, work), sums)


@entry
def sum_tile_rows(samples: Samples, period: Period, rows: Any, buffers: Buffers, sums: Any) -> None:
    """Sum the tile rows of a range into ``sums [rows, cols, products, contradictions and count]``."""
    ring, peaks, columns, _ = buffers
    first, last = rows[0] * SIDE, min(rows[1] * SIDE, period.h)
    loaded = first * period.step
    for y in range(first, last):
        if y % SIDE == 0:
            for p in range(columns.shape[0]):
                for x in range(columns.shape[1]):
                    columns[p, x] = ZERO
        while loaded < y * period.step + 3:
            _load_period(samples, period, loaded, ring[loaded % 3], peaks[3], peaks[loaded % 3])
            loaded += 1
        _measure_points(period, y * period.step, buffers)
        _weigh_points(period, buffers)
        _add_products(period, buffers)
        if y % SIDE == SIDE - 1 or y == last - 1:
            for p in range(columns.shape[0]):
                for x in range(columns.shape[1]):
                    sums[y // SIDE, x // SIDE, p] += columns[p, x]


@compiled
def _load_period(samples: Samples, period: Period, y: int, rows: Any, largest: Any, peak: Any) -> None:
    """Four sensor rows of a period as linear samples, and the largest sample of every period along them."""
    for r in range(4):
        row = rows[r]
        read_row(samples, 4 * y + r, 0, row)
        for x in range(row.size):
            row[x] = (row[x] - period.black) * period.scale
    a, b, c, d = rows[0], rows[1], rows[2], rows[3]
    for x in range(largest.size):
        largest[x] = max(max(a[x], b[x]), max(c[x], d[x]))
    for x in range(largest.size // 4):
        peak[x] = max(max(largest[4 * x], largest[4 * x + 1]), max(largest[4 * x + 2], largest[4 * x + 3]))


@compiled
def _measure_points(period: Period, y: int, buffers: Buffers) -> None:
    """s0, s1, s2 and contradiction of every colour at a row of points, their weights, and the blurred row's buffer.

    ``work``: ``4 C`` images as (kind, colour), then weight, blurred row, plane.
    """
    ring, _, _, work = buffers
    channels, points, step = period.channels, period.w, 4 * period.step
    before, here, after = ring[y % 3], ring[(y + 1) % 3], ring[(y + 2) % 3]
    blurred, plane = work[4 * channels + 1], work[4 * channels + 2]
    for k in range(4 * channels):
        for x in range(points):
            work[k, x] = ZERO
    for r in range(4):
        a, b, d = period.taps[r]
        one, two, three = before[r], here[r], after[r]
        for x in range(one.size):
            blurred[x] = a * one[x] + b * two[x] + d * three[x]
        for c in range(4):
            e, f, g = period.taps[c]
            for x in range(points):
                at = step * x + c
                plane[x] = e * blurred[at] + f * blurred[at + 4] + g * blurred[at + 8]
            for kind in range(4):
                part, image = period.weights[r, c, kind], work[kind * channels + period.colors[r, c]]
                for x in range(points):
                    image[x] += part * plane[x]


@compiled
def _weigh_points(period: Period, buffers: Buffers) -> None:
    """Weight of every point of a row: 0 near clipped samples and in the dark."""
    _, peaks, _, work = buffers
    channels, weight, largest = period.channels, work[4 * period.channels], work[4 * period.channels + 1]
    share = ONE / np.float32(channels)
    for x in range(peaks.shape[1] // 4):
        largest[x] = max(peaks[0, x], max(peaks[1, x], peaks[2, x]))
    for x in range(period.w):
        at = period.step * x
        brightness = work[0, x]
        for k in range(1, channels):
            brightness += work[k, x]
        brightness *= share
        near = max(largest[at], max(largest[at + 1], largest[at + 2]))
        usable = (near < _LARGEST) & (brightness > _DARKEST)
        weight[x] = ONE / (_PHOTONS * brightness + _FLOOR + _GAIN * brightness * brightness) if usable else ZERO


@compiled
def _add_products(period: Period, buffers: Buffers) -> None:
    """Weighted products of a row of points to the sums per column, the upper triangle of the matrix only."""
    _, _, columns, work = buffers
    channels, points = period.channels, period.w
    size = 1 + 3 * channels
    weight, product = work[4 * channels], work[4 * channels + 1]
    last = columns.shape[0] - 1
    for x in range(points):
        columns[0, x] += weight[x]
        columns[last, x] += ONE if weight[x] > ZERO else ZERO
    for i in range(1, size):
        one, target = work[i - 1], columns[i]
        for x in range(points):
            product[x] = weight[x] * one[x]
            target[x] += product[x]
        for j in range(i, size):
            other, target = work[j - 1], columns[i * size + j]
            for x in range(points):
                target[x] += product[x] * other[x]
    for c in range(channels):
        residual, target = work[3 * channels + c], columns[size * size + c]
        for x in range(points):
            target[x] += weight[x] * residual[x] * residual[x]
