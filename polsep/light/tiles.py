"""Second moments of Stokes samples over small tiles of a frame: all that the estimates of the light need.

A tile holds `SIDE` x `SIDE` points, one per 4x4 period of the filters, in large frames every second one. At each point
s0, s1 and s2 of every colour are measured with one and the same blur around the period's centre, so that edges and
highlights tint nothing: three taps per filter and axis whose weights have the same mean place and the same variance
(`taps`). Points near clipped samples are left out: next to them the blur mixes what clips.

Conventions: a sample vector is ``[1, s0 (C), s1 (C), s2 (C)]``; white = 1. `tiles_kernel` is the twin for mosaics.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.physics.stokes import Measurements, analyser_residual, complete_pair, fit_stokes, is_pair, stokes_inverse
from polsep.sensor.camera import Layout, Mosaic, first_frame

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Points along the side of a tile, and fewest usable points of one.
SIDE, MIN_POINTS = 8, 12
#: Variance of the blur along each axis, in squared raw pixels: the least at which all weights are positive.
BLUR = 4.0
#: Longest side, in periods, of frames of which every point counts.
EVERY_POINT = 256
#: Largest sample of a usable point's neighbourhood, and least mean s0, white = 1.
LARGEST, DARKEST = 0.96, 0.004
#: Variance of a point that weights assume: photons of `camera.IMX250` after the blur, its read noise, and errors that
#: grow with the light (demosaicking, gains). Tiles that scatter more are weighed down by what they show.
PHOTONS, FLOOR, GAIN_ERROR = 2e-5, 5e-8, 0.005
#: Longest side of co-sited measurements, in points; larger ones are averaged.
LARGEST_SIDE = 640


class Tiles(NamedTuple):
    """Weighted sums over the usable points of T tiles of ``C`` colours.

    ``moments [T, 1 + 3 C, 1 + 3 C]``: of products of the sample vector, in units of the assumed variance. ``noise
    [T, C]``: of squared contradictions of the analysers, which have the variance of s0. ``counts [T]``. ``place
    [T, 2]``: row and column of each tile.
    """

    moments: Doubles
    noise: Doubles
    counts: Doubles
    place: NDArray[np.int64]

    @property
    def colors(self) -> int:
        """C: 3, or 1 for mono."""
        return int(self.noise.shape[1])

    def select(self, chosen: NDArray[np.bool_ | np.int64]) -> Tiles:
        """Return the ``chosen`` tiles: a mask ``[T]``, or their numbers."""
        return Tiles(self.moments[chosen], self.noise[chosen], self.counts[chosen], self.place[chosen])


def taps(offset: int) -> tuple[float, float, float]:
    """Return the weights of the samples one period before, at and one after a period, of the filter at ``offset``."""
    shift = 1.5 - offset
    spread, lean = (BLUR + shift * shift) / 16, shift / 4
    return (spread - lean) / 2, 1 - spread, (spread + lean) / 2


def tile_mosaic(mosaic: Mosaic) -> Tiles:
    """Return the tiles of one frame, in its own light, in NumPy: the readable twin of `tiles_kernel`."""
    data = to_numpy(first_frame(mosaic)).astype(np.float32, copy=False)
    samples = (data - np.float32(mosaic.black_level)) / np.float32(mosaic.white_level - mosaic.black_level)
    h, w = (n // 4 for n in samples.shape)
    samples, step = samples[: 4 * h, : 4 * w], point_step(h, w)
    brightest = samples.reshape(h, 4, w, 4).max((1, 3))
    near = np.max([brightest[i : h - 2 + i, j : w - 2 + j] for i in range(3) for j in range(3)], axis=0)
    stokes = np.zeros((4, mosaic.layout.channels, h - 2, w - 2), np.float32)
    for (r, c), weights in filter_weights(mosaic.layout).items():
        plane = samples[r::4, c::4]
        a, b, d = (np.float32(t) for t in taps(r))
        rows = a * plane[:-2] + b * plane[1:-1] + d * plane[2:]
        a, b, d = (np.float32(t) for t in taps(c))
        blurred = a * rows[:, :-2] + b * rows[:, 1:-1] + d * rows[:, 2:]
        stokes[:, mosaic.layout.filter_at(r, c).channel] += weights[:, None, None] * blurred
    return _sum_tiles(stokes[..., ::step, ::step], near[::step, ::step] < LARGEST)


def point_step(h: int, w: int) -> int:
    """Return the distance of points, in periods, in a frame of so many periods."""
    return 1 if max(h, w) <= EVERY_POINT else 2


def filter_weights(layout: Layout) -> dict[tuple[int, int], Floats]:
    """Return, for each filter of a period, its part ``[4]`` in s0, s1, s2 and the analysers' contradiction."""
    filters = {(r, c): layout.filter_at(r, c) for r in range(4) for c in range(4)}
    matrix = _analysis(layout.angles)
    found = {}
    for place, own in filters.items():
        same = sum(other == own for other in filters.values())
        found[place] = (matrix[:, layout.angles_deg.index(own.angle_deg)] / same).astype(np.float32)
    return found


def _analysis(angles: tuple[float, ...]) -> Doubles:
    """Rows ``[4, K]`` that give s0, s1, s2 and the contradiction of K analysers; zeros where none is defined."""
    inverse = stokes_inverse(angles)
    if len(angles) != 4:
        return np.vstack([inverse, np.zeros((1, len(angles)))])
    unit = np.eye(4).reshape(4, 1, 1, 4)
    return np.vstack([inverse, analyser_residual(Measurements(unit, angles)).reshape(1, 4)])


def tile_measurements(measurements: Measurements) -> Tiles:
    """Return the tiles of co-sited samples ``[..., K, C, H, W]``, the first frame of a batch; large ones averaged."""
    data = to_numpy(measurements.data.reshape(-1, *measurements.data.shape[-4:])[0]).astype(np.float32, copy=False)
    single = Measurements(data, measurements.angles)
    single = complete_pair(single) if is_pair(single) else single
    stokes = fit_stokes(single)
    residual = analyser_residual(single) if len(single.angles) == 4 else 0 * stokes.s0
    images = np.stack([stokes.s0, stokes.s1, stokes.s2, residual])
    bright = data.max(axis=(0, 1))
    if measurements.clipped is not None:
        clipped = to_numpy(measurements.clipped.reshape(-1, *measurements.data.shape[-4:])[0]).any(axis=(0, 1))
        bright = np.where(clipped, np.inf, bright)
    times = -(-max(bright.shape) // LARGEST_SIDE)
    h, w = (n // times for n in bright.shape)
    images = images[..., : h * times, : w * times].reshape(*images.shape[:2], h, times, w, times).mean((3, 5))
    bright = bright[: h * times, : w * times].reshape(h, times, w, times).max((1, 3))
    return _sum_tiles(images, bright < LARGEST)


def _sum_tiles(stokes: Floats, usable: NDArray[np.bool_]) -> Tiles:
    """Sums over tiles of points ``[4, C, h, w]``: s0, s1, s2 and contradiction."""
    channels, (h, w) = stokes.shape[1], usable.shape
    rows, cols = -(-h // SIDE), -(-w // SIDE)
    brightness = stokes[0].mean(0)
    usable = usable & (brightness > DARKEST)
    variance = PHOTONS * brightness + FLOOR + (GAIN_ERROR * brightness) ** 2
    weight = np.where(usable, 1 / np.where(usable, variance, 1), 0)
    vector = np.concatenate([np.ones((1, h, w), np.float32), stokes[:3].reshape(3 * channels, h, w)])

    def tiled(x: NDArray[np.generic]) -> Doubles:
        padded = np.zeros((*x.shape[:-2], rows * SIDE, cols * SIDE))
        padded[..., :h, :w] = x
        blocks = padded.reshape(*x.shape[:-2], rows, SIDE, cols, SIDE).swapaxes(-3, -2)
        return np.moveaxis(blocks.reshape(*x.shape[:-2], rows * cols, SIDE * SIDE), -2, 0)

    points, weights, residuals = tiled(vector), tiled(weight), tiled(stokes[3])
    moments = (points * weights[:, None]) @ points.swapaxes(1, 2)
    noise = (weights[:, None] * residuals**2).sum(-1)
    place = np.stack(np.divmod(np.arange(rows * cols), cols), axis=1)
    return keep_tiles(moments, noise, tiled(usable.astype(np.float32)).sum(-1), place)


def keep_tiles(moments: Doubles, noise: Doubles, count: Doubles, place: NDArray[np.int64]) -> Tiles:
    """Return the tiles of enough points, weighed down where their noise exceeds what their weights assume."""
    kept = count >= MIN_POINTS
    moments, noise, count, place = moments[kept], noise[kept], count[kept], place[kept]
    excess = np.maximum(1, noise.mean(1) / np.maximum(count, 1))
    return Tiles(moments / excess[:, None, None], noise / excess[:, None], count, place)
