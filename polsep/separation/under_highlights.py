"""Diffuse light under clipped highlights, from the diffuse light around them.

Where a highlight clips, samples hardly tell diffuse from specular light, and what a network guesses there shows as grey
or coloured spots. Most bodies go on under a highlight as they do around it. So every *hole*, a connected set of pixels
with a clipped sample among the 3x3 cells around, is filled from its border without sources (Laplace's equation), and
this fill and the network's guess are averaged by their variances:

* The network expects its own error, which under highlights is too small by `SURPRISE`.
* The fill is off by the body's texture, colour by colour: `TEXTURE` times what a plane leaves of the ring around the
  hole. Where both guesses differ by more than the network's error explains, the rest is counted as the fill's error.
* Highlights of a polarized lamp are polarized: what the samples of a hole have beyond its fill differs from analyser to
  analyser. Bodies that are bright enough to clip by themselves look alike through all of them and stay as they are.

The specular image stays as it is. Constants are of validation frames (docs/experiments.md, "Diffuse light under
highlights"). Source: this project's; filling by Laplace's equation as in Perez et al. 2003, doi:10.1145/882262.882269.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import Array, namespace, of_kind, to_numpy, to_numpy_together
from polsep.compute.warm_up import make_ready
from polsep.sensor.camera import Mosaic
from polsep.separation import highlights_kernel
from polsep.separation.highlights_kernel import find_parts, find_rings, solve_laplace
from polsep.separation.images import FrameImages

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

#: Cells on each side of a clipped one that it may spoil, and cells around a hole that make its ring.
SPOILED, RING = 1, 3
#: Polarized share of what lies beyond the fill from which on a hole may be a highlight, and is one for sure.
CONTRASTS = (0.3, 0.5)
#: Errors of networks' guesses in holes, over those that they expect.
SURPRISE = 1.4
#: Standard deviations of the fill per standard deviation of the ring from its plane.
TEXTURE = 2.0
#: Largest deviation of the ring from its plane that is filled over, relative to the ring's light, and at white = 1.
MAX_TEXTURE, MAX_NOISE = 0.3, 0.01
#: Cells of the largest hole and of the least ring, and the share of clipped cells from which on nothing is filled.
MAX_HOLE, MIN_RING, MAX_CLIPPED = 4000, 6, 0.05
#: Where the solution of Laplace's equation ends: largest residual at white = 1, and most steps.
TOLERANCE, STEPS = 1e-4, 200


class _Holes(NamedTuple):
    """Pixels of holes in an image of a ``shape``, ``scale`` pixels along a cell's side.

    ``flat [N]``: places of the pixels in the image, row by row; ``of [N]``: the hole of each, of ``total`` ones.
    """

    flat: Indices
    of: Indices
    total: int
    shape: tuple[int, int]
    scale: int


def fill_under_highlights(images: FrameImages, mosaic: Mosaic, light: tuple[float, ...]) -> tuple[FrameImages, float]:
    """Images of one frame ``[H, W]`` with the holes of the diffuse image filled, and the share of its pixels that was.

    ``images``: at half or full resolution, with expected errors, in a ``light`` (camera RGB); their arrays are written
    to. Expected errors shrink as those of weighed means do, and pixels count in the share by the fill's weight.
    """
    error, (height, width, colors) = images.error, images.diffuse.shape
    if error is None or mosaic.data.ndim != 2:
        return images, 0.0
    scale = 2 if 2 * height > mosaic.data.shape[0] else 1
    clipped = _clipped_cells(mosaic)
    if not 0 < len(clipped) <= MAX_CLIPPED * height * width / scale**2:
        return images, 0.0
    make_ready(highlights_kernel.warm_up)
    holes = _find_holes(clipped, (height, width), scale)
    gain = np.array(light[:colors], np.float64)
    diffuse, expected = images.diffuse.reshape(-1, colors), error.reshape(-1, 2)[:, 0]
    plane, texture, usable = _fit_planes(holes, diffuse, gain)
    sure = ((_contrast(holes, mosaic, plane, gain) - CONTRASTS[0]) / (CONTRASTS[1] - CONTRASTS[0])).clip(0, 1)
    chosen = (usable & (sure > 0))[holes.of]
    if not chosen.any():
        return images, 0.0
    holes = _Holes(holes.flat[chosen], holes.of[chosen], holes.total, holes.shape, scale)
    own, deviation = to_numpy_together(_take(diffuse, holes.flat), _take(expected, holes.flat))
    own, deviation = own / gain, deviation / gain.mean()
    fill = _solve_laplace(holes, diffuse, gain, plane[chosen])
    weights = sure[holes.of, None] * _weigh(holes, fill - own, deviation, texture)
    weight = weights.mean(axis=1)
    _put(diffuse, holes.flat, gain * (own + weights * (fill - own)))
    _put(expected, holes.flat, gain.mean() * deviation * np.sqrt(1 - weight))
    tally = images.tally
    if tally is not None:
        tally = replace(tally, s0=tally.s0 + float((weights * (fill - own)).mean(axis=1).sum()))
    if tally is not None and tally.diffuse_variance is not None:
        less = float((weight * deviation**2).sum())
        tally = replace(tally, diffuse_variance=max(tally.diffuse_variance - less, 0.0))
    return replace(images, tally=tally), float(weight.sum()) / (height * width)


def _weigh(holes: _Holes, change: Floats, deviation: Floats, texture: Floats) -> Floats:
    """Weights ``[N, C]`` of a fill that differs by ``change [N, C]`` from guesses of an expected ``deviation [N]``.

    ``texture [total, C]``: of rings. Colours of a body have textures of their own; both guesses disagree as wholes.
    """
    guessed, apart = (_means(holes, x)[:, None] for x in ((SURPRISE * deviation) ** 2, (change**2).mean(axis=1)))
    off = np.maximum((TEXTURE * texture) ** 2, apart - guessed)
    weights: Floats = (guessed / np.maximum(guessed + off, 1e-12))[holes.of]
    return weights


def _contrast(holes: _Holes, mosaic: Mosaic, fill: Floats, gain: Floats) -> Floats:
    """Polarized share of what holes ``[total]`` have beyond a fill, by the analysers of their cells.

    (most - least) / (most + least - fill) of samples under white light, in sums over a hole: unpolarized light of a
    fill, which is s0, is half of it in each sample. Highlights of the lamp have 0.7 to 1, less where all clip.
    """
    (row, col), width = mosaic.layout.origin, mosaic.data.shape[1]
    cells = np.stack(np.divmod(holes.flat, holes.shape[1])) // holes.scale
    first = (row + 2 * cells[0]) * width + col + 2 * cells[1]
    data = mosaic.data.reshape(-1)
    samples = to_numpy(_take(data, np.stack([first, first + 1, first + width, first + width + 1]))).astype(np.float64)
    channels = [[mosaic.layout.filter_at(row + 2 * a, col + 2 * b).channel for b in range(2)] for a in range(2)]
    channel = np.array(channels)[cells[0] % 2, cells[1] % 2]
    samples = (samples - mosaic.black_level) / (mosaic.white_level - mosaic.black_level) / gain[channel]
    most, least = samples.max(axis=0), samples.min(axis=0)
    beyond = np.maximum(most + least - fill[np.arange(len(fill)), channel], 0)
    return _sums(holes.of, most - least, holes.total) / np.maximum(_sums(holes.of, beyond, holes.total), 1e-9)


def _clipped_cells(mosaic: Mosaic) -> Indices:
    """Row and column ``[N, 2]`` of the 2x2 cells with a clipped sample."""
    width = mosaic.data.shape[1]
    level, data = mosaic.clip_level, mosaic.data.reshape(-1)
    at = to_numpy(namespace(data).nonzero(data >= level)[0]).astype(np.int64)
    places = np.stack(np.divmod(at, width), axis=1) - np.array(mosaic.layout.origin)
    return _distinct(places // 2, mosaic.layout.cells(mosaic.data.shape))


def _find_holes(clipped: Indices, shape: tuple[int, int], scale: int) -> _Holes:
    """Connected pixels, also over corners, of what clipped cells spoil in an image of that shape."""
    size = (shape[0] // scale, shape[1] // scale)
    cells = _distinct(_around(clipped, SPOILED), size)
    flat = cells[:, 0] * size[1] + cells[:, 1]
    of, total = find_parts(flat, _numbers(flat, size), size[1])
    within = np.stack(np.divmod(np.arange(scale**2), scale), axis=1)
    pixels = (scale * cells[:, None] + within).reshape(-1, 2)
    flat = pixels[:, 0] * shape[1] + pixels[:, 1]
    order = np.argsort(flat)
    return _Holes(flat[order], np.repeat(of, scale**2)[order], total, shape, scale)


def _fit_planes(holes: _Holes, diffuse: Array, gain: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Planes through the rings of holes: their values in the holes ``[N, C]``, and the rms of rings from them.

    The rms ``[total, C]``, and whether a hole may be filled, ``[total]``.
    """
    width, reach = holes.shape[1], RING * holes.scale
    number = _numbers(holes.flat, holes.shape)
    edge = np.zeros(len(holes.flat), np.bool_)
    for step in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        edge |= _neighbors(number, holes.flat, holes.shape, step) < 0
    flat, of = find_rings(holes.flat[edge], holes.of[edge], holes.shape, reach)
    free = number[flat] == 0
    of, flat = of[free], flat[free]
    values = to_numpy(_take(diffuse, flat)) / gain
    count = np.bincount(of, minlength=holes.total)
    center = (
        np.stack([_sums(of, x, holes.total) for x in np.divmod(flat, width)], axis=1) / np.maximum(count, 1)[:, None]
    )

    def shapes(flat: Indices, of: Indices) -> Floats:
        offsets = np.stack(np.divmod(flat, width), axis=1) - center[of]
        return np.concatenate([np.ones((len(flat), 1)), offsets / reach], axis=1)

    ring = shapes(flat, of)
    products = np.stack([[_sums(of, a * b, holes.total) for a in ring.T] for b in ring.T]).transpose(2, 0, 1)
    totals = np.stack([[_sums(of, a * b, holes.total) for b in values.T] for a in ring.T]).transpose(2, 0, 1)
    factors = np.linalg.pinv(products, hermitian=True) @ totals
    rest = values - (ring[:, None] @ factors[of])[:, 0]
    texture = np.stack([_sums(of, x, holes.total) for x in (rest**2).T], axis=1)
    texture = np.sqrt(texture / np.maximum(count, 1)[:, None])
    light = _sums(of, values.mean(axis=1), holes.total) / np.maximum(count, 1)
    size = np.bincount(holes.of, minlength=holes.total)
    usable = (np.sqrt((texture**2).mean(axis=1)) <= MAX_TEXTURE * light + MAX_NOISE) & (
        count >= MIN_RING * holes.scale**2
    )
    usable &= size <= MAX_HOLE * holes.scale**2
    return (shapes(holes.flat, holes.of)[:, None] @ factors[holes.of])[:, 0], texture, usable


def _solve_laplace(holes: _Holes, diffuse: Array, gain: Floats, start: Floats) -> Floats:
    """Values ``[N, C]`` of the holes' pixels, each the mean of its four neighbours, in white light.

    By conjugate gradients from a ``start``. Beyond the image's border there are no neighbours.
    """
    number, width, size = _numbers(holes.flat, holes.shape), holes.shape[1], len(holes.flat)
    count, known = np.zeros(size), np.zeros_like(start)
    links = np.empty((4, size), np.uint32)
    for link, (down, across) in zip(links, ((0, 1), (0, -1), (1, 0), (-1, 0)), strict=True):
        other = _neighbors(number, holes.flat, holes.shape, (down, across))
        link[:] = np.where(other >= 0, other, size)
        beside = np.flatnonzero(other == _OUTSIDE)
        known[beside] += to_numpy(_take(diffuse, holes.flat[beside] + down * width + across)) / gain
        count += other != _BEYOND
    return np.maximum(solve_laplace(links, count, known, start, (TOLERANCE, STEPS)), 0)


#: Numbers of neighbours that are not pixels of holes: other pixels, and none.
_OUTSIDE, _BEYOND = -1, -2


def _numbers(flat: Indices, shape: tuple[int, int]) -> NDArray[np.int32]:
    """The number of each pixel of a hole, from 1 on, at its place in an image; elsewhere 0, in memory never touched."""
    number = np.zeros(shape[0] * shape[1], np.int32)
    number[flat] = np.arange(1, len(flat) + 1)
    return number


def _neighbors(number: NDArray[np.int32], flat: Indices, shape: tuple[int, int], step: tuple[int, int]) -> Indices:
    """The numbers of the pixels one ``step`` (rows, columns) on; `_BEYOND` the image's border."""
    rows, cols = np.divmod(flat, shape[1])
    rows, cols = rows + step[0], cols + step[1]
    inside = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
    found: Indices = np.where(inside, number[np.where(inside, rows * shape[1] + cols, 0)] - 1, _BEYOND)
    return found


def _around(places: Indices, reach: int) -> Indices:
    """All places ``[N, K, 2]`` up to ``reach`` rows and columns from some."""
    side = 2 * reach + 1
    near: Indices = places[:, None] + np.stack(np.divmod(np.arange(side**2), side), axis=1) - reach
    return near


def _distinct(places: Indices, shape: tuple[int, int]) -> Indices:
    """Indices ``[..., 2]`` inside of an image of that shape, each once and in reading order."""
    rows, cols = places[..., 0], places[..., 1]
    inside = (rows >= 0) & (rows < shape[0]) & (cols >= 0) & (cols < shape[1])
    found = np.zeros(shape[0] * shape[1], np.bool_)
    found[(rows * shape[1] + cols)[inside]] = True
    return np.stack(np.divmod(np.flatnonzero(found), shape[1]), axis=1)


def _sums(of: Indices, values: NDArray[Any], count: int) -> Floats:
    """Sums of values by hole."""
    return np.bincount(of, values, count).astype(np.float64)


def _means(holes: _Holes, values: Floats) -> Floats:
    """Means of values of the holes' pixels by hole."""
    return _sums(holes.of, values, holes.total) / np.maximum(np.bincount(holes.of, minlength=holes.total), 1)


def _take(image: Array, flat: Indices) -> Array:
    """Pixels of an image whose rows are joined, ``[N, ...]``."""
    return image[of_kind(flat, image)]


def _put(image: Array, flat: Indices, values: Floats) -> None:
    """The twin of `_take`: write pixels."""
    image[of_kind(flat, image)] = of_kind(values.astype(np.float32), image)
