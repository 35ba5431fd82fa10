"""Lamps that are not fully polarized: separation where the degree is known, and the degree where it is not.

Methods take highlights of the lamp for fully polarized. Behind an imperfect polarizer of degree p they find p of
them; (1 - p) / p of the specular image is left in the diffuse image, in white.

Where p is known (`Mosaic.lamp_dolp`), that part is subtracted from the samples and they are separated again: then they
are those of a fully polarized lamp, whose specular light is p of the true one (`separate_by_known_lamp`).

Where it is not, the frame may show it (`find_unpolarized`). In a place, the diffuse image less the
body's colour is regressed on the specular image. The median of the places counts where it is clear: more than its
standard error, and along white rather than beside it, where wrong colours of the lamp lead. Grey bodies show
nothing, nor do bodies of one hue: there a wrong colour of the lamp may look white.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import Array, as_floats, constant, namespace, of_kind, to_numpy_together
from polsep.compute.resizing import block_means, blocks_of, resize_bilinear
from polsep.sensor.camera import Mosaic
from polsep.separation.images import FrameImages
from polsep.separation.report import tally_again

Floats = NDArray[np.float32]

#: Side of a place in pixels at half resolution, and fewest places.
SIDE, MIN_PLACES = 8, 12
#: Least variance of the specular image in a place [white^2], and least squared share of white beside the body's colour.
MIN_VARIANCE, MIN_WHITE = 5e-4, 0.15
#: Least deviation of the places' colours, as unit vectors: skin has 0.01, bodies of two hues 0.06.
MIN_HUES = 0.03
#: Largest sample of a place: s0 of light along an analyser, half of it across.
MAX_SAMPLE = 0.9
#: Range of parts that are believed, the least one in standard errors of the median too, and the largest slope beside
#: white over it. Chosen on 16 validation stages of `datasets.reality` in 15 conditions (docs/experiments.md).
MIN_PART, MAX_PART, ERRORS, MAX_BESIDE = 0.04, 0.5, 3.0, 0.5
#: Standard error of a median over the median deviation, times the root of the count, for normal errors.
MEDIAN_ERROR = 1.4826 * 1.25


class Places(NamedTuple):
    """Means over places: ``color [3, N]`` of the diffuse image, ``light [1, N]`` of the specular one, and products.

    ``square [1, N]``: specular light squared; ``product [3, N]``: times the diffuse light; ``largest [N]`` sample.
    """

    color: Floats
    light: Floats
    square: Floats
    product: Floats
    largest: Floats


def separate_by_known_lamp(
    run: Callable[[Mosaic], FrameImages], mosaic: Mosaic, light: tuple[float, ...]
) -> FrameImages:
    """Images of one frame ``[H, W]`` by a method, under a lamp of the degree of polarization ``mosaic.lamp_dolp``.

    ``light``: camera RGB of the lamp. DoLP and AoLP are those of the frame as it is. Twice the method's time.
    """
    images, degree = run(mosaic), mosaic.lamp_dolp
    if degree is None or degree == 1:
        return images
    xp = namespace(images.specular)
    less = run(less_unpolarized(mosaic, (1 - degree) / degree * images.specular))
    error = less.error
    if error is not None:
        error = error * constant([1.0, 1 / degree], error)
    known = replace(less, specular=less.specular / degree, error=error, dolp=images.dolp, aolp=images.aolp)
    return tally_again(replace(known, valid=xp.logical_and(images.valid, less.valid)), light)


def less_unpolarized(mosaic: Mosaic, part: Array) -> Mosaic:
    """One frame less unpolarized light ``part [h, w, C]`` of its unit, of which analysers pass half.

    ``part`` has half or full resolution, without pixels that are no whole cell. Clipped samples stay.
    """
    data, layout = as_floats(mosaic.data), mosaic.layout
    if isinstance(part, np.ndarray):
        part = of_kind(part, data)
    xp = namespace(data)
    (row, col), (rows, cols) = layout.origin, (2 * n for n in layout.cells(tuple(data.shape)))
    full = resize_bilinear(xp.moveaxis(part, -1, 0), (rows, cols)) * (
        float(mosaic.white_level - mosaic.black_level) / 2
    )
    left = xp.zeros_like(data)
    for y in range(layout.period):
        for x in range(layout.period):
            channel = layout.filter_at(row + y, col + x).channel
            left[row + y : row + rows : layout.period, col + x : col + cols : layout.period] = full[
                channel, y :: layout.period, x :: layout.period
            ]
    return replace(mosaic, data=xp.where(mosaic.clipped(), data, data - left))


def measure_places(diffuse: Array, specular: Array) -> Places:
    """The places of a method's images ``[3, h, w]`` and ``[1, h, w]`` at half resolution, in white light.

    Images may be on any device. Twin: `places_kernel.measure_places_fast`.
    """
    xp, products = namespace(diffuse), (diffuse, specular, specular * specular, specular * diffuse)
    brightest = xp.max(blocks_of(specular[0] + xp.max(diffuse, axis=0) / 2, SIDE), axis=(-3, -1))
    largest, *means = to_numpy_together(brightest, *(block_means(x, SIDE) for x in products))
    color, light, square, product = (x.reshape(x.shape[0], -1) for x in means)
    return Places(color, light, square, product, largest.reshape(-1))


def find_unpolarized(places: Places, gain: float = 1.0) -> float:
    """The part of the specular image that is left in the diffuse one, (1 - p) / p; 0 where none is proven.

    ``gain``: the lamp's largest, of a colour that clips at 1 / gain in its light.
    """
    color, light, square, product, largest = places
    variance, covariance = (square - light**2)[0], product - light * color
    body = color / np.linalg.norm(color, axis=0).clip(1e-9)
    white = 1 - body * body.sum(axis=0)
    power = (white**2).sum(axis=0)
    shown = (variance > MIN_VARIANCE) & (power > MIN_WHITE) & (largest * max(gain, 1.0) < MAX_SAMPLE)
    body, white, power, covariance = (x[..., shown] for x in (body, white, power, covariance))
    if len(power) < MIN_PLACES or not has_hues(body):
        return 0.0
    slopes = covariance / variance[shown]
    along = (slopes * white).sum(axis=0) / power
    beside = (slopes * np.cross(body, white, axis=0)).sum(axis=0) / power
    part = _median(along)
    error = MEDIAN_ERROR * _median(np.abs(along - part)) / len(power) ** 0.5
    proven = max(MIN_PART, ERRORS * error) < part < MAX_PART and abs(_median(beside)) < MAX_BESIDE * part
    return part if proven else 0.0


def has_hues(body: Floats) -> bool:
    """True if colours ``[3, N]`` of two places or more, as unit vectors, are of several hues or saturations."""
    return float(np.linalg.norm(body.std(axis=1, ddof=1))) >= MIN_HUES


def _median(values: Floats) -> float:
    """The middle value, the lower one of two."""
    return float(np.quantile(values, 0.5, method="lower"))
