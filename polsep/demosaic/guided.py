"""Demosaicking with an intensity guide, to full or half resolution: sharper than interpolating each analyser alone.

One sample behind the analyser at angle t says 2 m - (s1 cos 2t + s2 sin 2t) = s0. Polarization is smooth where
intensity is not, so a smoothed one turns the mosaic of analysers into a mosaic of s0 at the sensor's full resolution,
whose colours come in 2x2 blocks (`_intensity_mosaic`). Demosaicking has two halves from there.

1. s0 of all colours (`fill_colors`). Green first: along rows and columns, the interpolation of the other colour plus
   what the pixel's own colour differs from its interpolation, times the slope at which green follows that colour
   around (slope 1 is Hamilton and Adams 1997; textures of unlike colours need other slopes). What green then differs
   from the pixel's colour is smoothed where it is no larger than the error of such an interpolation: on grey objects,
   that is everywhere. Then red and blue as local linear functions of green, with the residual interpolated (residual
   interpolation, Kiku et al. 2013).
2. Polarization (`_residual_mosaic`). The guide is s0 of each pixel's own colour, from pixels around it; what the
   samples differ from it is interpolated bilinearly per analyser. A 3x3 tent holds all four analysers in balance, so
   the guide is the tent of s0 plus the detail that the analysers and colours around a pixel have in common.

Full resolution takes polarization out of the mosaic as sharp as it is known to be (`_reliable`), without which thin
polarized highlights would keep the pattern of the analysers; in cell means that pattern cancels. It is known from the
second half alone, with a guide of each colour's own samples (`_surroundings`): filling in the colours before gains
nothing (docs/experiments.md).

The idea of an intensity guide for polarization mosaics is Morimatsu et al. 2020 (EARI, doi
10.1109/ICIP40778.2020.9191062); the steps are this project's, see docs/experiments.md.

Exact on uniform fields to the border, which is continued by mirroring whole cells, and on linear fields inside.
Estimates of different colours are no longer blurred alike, which invents relations between them. Methods that relate
colours use the bilinear samples in `Measurements.uniform`. Pixels touched by clipping keep the bilinear samples.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from array_api_compat import device

from polsep.compute.arrays import Array, constant, namespace
from polsep.compute.filters import box_mean
from polsep.compute.resizing import repeat_pixels
from polsep.demosaic.bilinear import (
    aligned,
    correlate,
    demosaic_bilinear,
    demosaic_bilinear_half,
    interleave,
    interpolate_analysers,
    interpolate_analysers_half,
    mean_cells,
    repeat_tile,
)
from polsep.physics.stokes import Measurements, Stokes, analyser_residual, fit_stokes, measure
from polsep.sensor.camera import Layout, Mosaic

#: Smallest number of cells per side for the guided filters; smaller frames stay bilinear.
MIN_CELLS = 8
#: Cells by which a frame is continued beyond its border, to half and to full resolution: the reach of all filters.
MARGIN, FULL_MARGIN = 36, 48
#: How strongly the detail that all analysers share sharpens the guide; chosen on tuning scenes and real pictures.
DETAIL_GAIN = 1.8
#: Radius, in cells, over which polarization counts as smooth when it is taken out of the samples.
SMOOTH_RADIUS = 4
#: Detail of polarization counts where its variance exceeds this many times the analysers' contradiction (s1 and s2
#: together have four times its variance), and this variance at least.
NOISE_MARGIN, NOISE_FLOOR = 16.0, 1e-5
#: Regularisation of slopes: where the variance of s0 is below these, a slope falls back to `PRIOR_SHARE` of the ratio
#: of the colours, the slope of a uniform albedo under varying light. All of the ratio doubles noise, none of it blurs.
SLOPE_FLOOR, GUIDE_FLOOR, PRIOR_SHARE = 2e-4, 2e-5, 0.5
#: Radius in cells, and how many times the squared detail along the better direction counts as error, where the
#: difference of green from red and blue is smoothed.
DIFFERENCE_RADIUS, DIFFERENCE_MARGIN = 4, 0.7
#: s0 of a colour is at least this share of its bilinear interpolation, so that extrapolation never ends at zero.
MIN_SHARE = 0.25
_TENT = (0.25, 0.5, 0.25)
_GENTLE = (0.125, 0.75, 0.125)
_BINOMIAL = tuple(math.comb(8, k) / 256 for k in range(9))
#: Bilinear interpolation of samples that come in pairs, every fourth pixel.
_PAIRS = (0.125, 0.25, 0.375, 0.5, 0.375, 0.25, 0.125)
#: Mean over the samples of one colour around the first of a pair, mirrored at the second; holds both analysers in
#: balance and keeps linear images.
AROUND = tuple(k / 16 for k in (1, 2, 0, 0, 6, 6, 0, 0, 1))


def demosaic_guided(mosaic: Mosaic) -> Measurements:
    """Analysers at every pixel ``[..., 4, C, H, W]`` with an intensity guide, as the module says.

    ``clipped`` and ``variance`` are those of `demosaic_bilinear`, whose samples are ``uniform``.
    """
    if not is_large_enough(mosaic):
        return demosaic_bilinear(mosaic)
    values, layout = _padded(mosaic, FULL_MARGIN)
    intensity = _intensity_mosaic(values, _smooth_polarization(values, layout), layout)
    residual = _residual_mosaic(values, intensity, _surroundings(intensity, layout))
    first = Measurements(interpolate_analysers_half(residual, layout), layout.angles)
    s0, residual = _guide(values, _reliable(first), layout)
    polarization = _blur_stokes(fit_stokes(Measurements(interpolate_analysers(residual, layout), layout.angles)), _TENT)
    found = Stokes(s0, polarization.s1, polarization.s2).map(lambda x: _crop(x, 2 * FULL_MARGIN))
    return _complete(found, demosaic_bilinear(mosaic))


def demosaic_guided_half(mosaic: Mosaic) -> Measurements:
    """Co-registered analysers ``[..., 4, C, H/2, W/2]`` with an intensity guide: means over 2x2 cells, in one round.

    ``clipped`` and ``variance`` are those of `demosaic_bilinear_half`, whose samples are ``uniform``.
    """
    if not is_large_enough(mosaic):
        return demosaic_bilinear_half(mosaic)
    found, _ = guide_once(mosaic)
    return _complete(found, demosaic_bilinear_half(mosaic))


def guide_once(mosaic: Mosaic, margin: int = MARGIN) -> tuple[Stokes, Array]:
    """Stokes images ``[..., C, H/2, W/2]`` with an intensity guide in one round, and s0 at every pixel.

    Clipped samples count as they are. ``mosaic``: of at least 2x2 cells. ``margin``: cells by which it is continued;
    with fewer than `MARGIN` its border changes a little, and crops take half as long.
    """
    values, layout = _padded(mosaic, margin)
    s0, residual = _guide(values, _smooth_polarization(values, layout), layout)
    samples = Measurements(interpolate_analysers_half(residual, layout), layout.angles)
    polarization = _blur_stokes(fit_stokes(samples), _GENTLE).map(lambda x: _crop(x, margin))
    s0 = _crop(s0, 2 * margin)
    return Stokes(mean_cells(s0), polarization.s1, polarization.s2), s0


def is_large_enough(mosaic: Mosaic) -> bool:
    """True for frames that the guided filters take; smaller ones stay bilinear."""
    return min(mosaic.layout.cells(mosaic.data.shape)) >= MIN_CELLS


def _padded(mosaic: Mosaic, margin: int = MARGIN) -> tuple[Array, Layout]:
    """Linear samples from the first whole cell on with ``margin`` more cells around, and the layout they have."""
    values = _mirror_cells(aligned(mosaic.linear(), mosaic.layout), margin)
    return values, replace(mosaic.layout, origin=(0, 0))


def _complete(stokes: Stokes, plain: Measurements) -> Measurements:
    """The analysers that see ``stokes``, with the bilinear samples of ``plain`` wherever clipping touches a pixel."""
    data = measure(stokes, plain.angles).data
    if plain.clipped is not None:
        xp = namespace(data)
        touched = xp.any(xp.any(plain.clipped, axis=-4, keepdims=True), axis=-3, keepdims=True)
        data = xp.where(touched, plain.data, data)
    return Measurements(data, plain.angles, plain.clipped, plain.variance, plain)


def _guide(values: Array, polarization: Stokes, layout: Layout) -> tuple[Array, Array]:
    """s0 ``[..., C, H, W]`` of aligned samples ``[..., H, W]``, and the samples minus half their guide.

    ``polarization [..., C, H/2, W/2]`` is what is taken for known.
    """
    intensity = _intensity_mosaic(values, polarization, layout)
    s0 = fill_colors(intensity, layout) if layout.bayer else intensity[..., None, :, :]
    return s0, _residual_mosaic(values, intensity, _own(_blur(s0, _TENT), layout))


def _smooth_polarization(values: Array, layout: Layout) -> Stokes:
    """Stokes images at half resolution, bilinear and then smoothed by `SMOOTH_RADIUS`."""
    found = fit_stokes(Measurements(interpolate_analysers_half(values, layout), layout.angles))
    return found.map(lambda image: box_mean(image, SMOOTH_RADIUS))


def _reliable(found: Measurements) -> Stokes:
    """Stokes images at half resolution, smoothed as far as the analysers contradict each other.

    A Wiener filter: detail counts by the share of its variance that exceeds `NOISE_MARGIN` times what noise and
    misregistration explain, which shows in `analyser_residual`.
    """
    stokes, xp = fit_stokes(found), namespace(found.data)
    smooth = stokes.map(lambda image: box_mean(image, SMOOTH_RADIUS))
    d1, d2 = stokes.s1 - smooth.s1, stokes.s2 - smooth.s2
    detail = box_mean(xp.mean(d1 * d1 + d2 * d2, axis=-3, keepdims=True), 1)
    contradiction = box_mean(xp.mean(analyser_residual(found) ** 2, axis=-3, keepdims=True), 1)
    noise = NOISE_MARGIN * contradiction + NOISE_FLOOR
    share = ((detail - noise) / (detail + NOISE_FLOOR)).clip(0.0, None)
    return Stokes(smooth.s0, smooth.s1 + share * d1, smooth.s2 + share * d2)


def _intensity_mosaic(values: Array, polarization: Stokes, layout: Layout) -> Array:
    """s0 of its own colour at every pixel ``[..., H, W]``: twice the sample minus the polarization that it passed."""
    doubled = np.deg2rad(2 * np.array(layout.polarizer, np.float64))
    intensity = 2 * values
    for weights, image in ((np.cos(doubled), polarization.s1), (np.sin(doubled), polarization.s2)):
        exact = constant(np.where(np.abs(weights) < 1e-9, 0.0, weights), values)
        intensity = intensity - repeat_tile(exact, values, 1) * _own(_enlarge(image), layout)
    return intensity


def _surroundings(intensity: Array, layout: Layout) -> Array:
    """Means ``[..., H, W]`` of a mosaic of s0 over the pixels around, of the pixel's own colour alone."""
    if not layout.bayer:
        return _blur(intensity, _TENT)
    for axis in (-1, -2):
        before, after = correlate(intensity, AROUND, axis), correlate(intensity, AROUND[::-1], axis)
        intensity = namespace(intensity).where(_is_first(intensity, axis), before, after)
    return intensity


def _is_first(mosaic: Array, axis: int) -> Array:
    """True at the first of each pair of pixels along rows or columns, which broadcasts."""
    place = namespace(mosaic).arange(mosaic.shape[axis], device=device(mosaic)) % 2 == 0
    return place if axis == -1 else place[:, None]


def _residual_mosaic(values: Array, intensity: Array, tent: Array) -> Array:
    """Samples minus half the guide ``[..., H, W]``: polarization, the smoother the better the guide.

    ``tent``: s0 of each pixel's own colour, from pixels around it.
    """
    guide = tent + DETAIL_GAIN * _blur(intensity - tent, _TENT)
    return values - 0.5 * guide


def fill_colors(mosaic: Array, layout: Layout) -> Array:
    """All colours ``[..., 3, H, W]`` of a mosaic ``[..., H, W]`` of 2x2 blocks of one colour each (a quad Bayer one).

    The pixels' own values stay.
    """
    masks, cells = color_masks(mosaic, layout, 2), color_masks(mosaic, layout, 1)
    green = _fill_green(mosaic, masks, cells)
    red, blue = (_fill_from_green(mosaic, green, masks[c], cells[c]) for c in (0, 2))
    return namespace(mosaic).stack([red, green, blue], axis=-3)


def color_masks(mosaic: Array, layout: Layout, block: int) -> Array:
    """Masks of the colours: ``[C, n, m]`` of 0 and 1 per pixel of a mosaic (``block`` 2) or per cell (``block`` 1)."""
    colors = np.array(["RGB".index(color) for color in layout.bayer or "RRRR"]).reshape(2, 2)
    own = constant(colors == np.arange(layout.channels)[:, None, None], mosaic)
    return repeat_tile(own, mosaic if block == 2 else mosaic[..., ::2, ::2], block)


def _fill_green(mosaic: Array, masks: Array, mask_cells: Array) -> Array:
    """Green everywhere: estimates along both directions, weighed by how smooth green minus the other colour is."""
    xp, is_green, cells = namespace(mosaic), masks[1] > 0, mean_cells(mosaic)
    total, weights, precision = 0.0, 0.0, 0.0
    for axis in (-1, -2):
        around, second = _across_pairs(mosaic, axis)
        other = around + repeat_pixels(_slope_of_other(cells, mask_cells[1], axis), 2) * second
        difference = correlate(xp.where(is_green, mosaic - other, other - mosaic), _GENTLE, axis)
        weight = 1 / (box_mean(mean_cells(correlate(difference, (-1.0, 0.0, 1.0), axis) ** 2), 1) + 1e-6)
        total, weights = total + repeat_pixels(weight, 2) * difference, weights + weight
        precision = precision + 1 / (box_mean(mean_cells(second) ** 2, 1) + 1e-12)
    difference = _without_error(total / repeat_pixels(weights, 2), 1 / precision, mask_cells)
    beside = 0.5 * (correlate(cells, (0.5, 0.0, 0.5), -1) + correlate(cells, (0.5, 0.0, 0.5), -2))
    return xp.where(is_green, mosaic, _at_least(mosaic + difference, repeat_pixels(beside, 2)))


def _without_error(difference: Array, error: Array, mask_cells: Array) -> Array:
    """The ``difference [..., H, W]`` of green at red and at blue cells, smoothed where the ``error [..., h, w]``
    explains it: the variance within a window counts by the share that exceeds `DIFFERENCE_MARGIN` times the error.
    """
    found = 0.0
    for mask in (mask_cells[0], mask_cells[2]):
        share = box_mean(mask, DIFFERENCE_RADIUS)
        smooth = repeat_pixels(box_mean(mean_cells(difference) * mask, DIFFERENCE_RADIUS) / share, 2)
        detail = difference - smooth
        variance, noise = (box_mean(x * mask, DIFFERENCE_RADIUS) / share for x in (mean_cells(detail**2), error))
        kept = ((variance - DIFFERENCE_MARGIN * noise) / (variance + 1e-12)).clip(0.0, None)
        found = found + repeat_pixels(mask, 2) * (smooth + repeat_pixels(kept, 2) * detail)
    return found


def _across_pairs(mosaic: Array, axis: int) -> tuple[Array, Array]:
    """Along rows or columns A A B B: the other colour interpolated, and what the own one differs from the same of it.

    At the first of a pair the nearest samples of the other colour are 1 before and 2 after, so they weigh 2/3 and 1/3;
    the own colour is interpolated at those two places, and from there at the pixel. At the second it is mirrored.
    """
    around = ((0, 0, 0, 0, 6, 0, 0, 3, 0, 0, 0), (0, 0, 0, 3, 0, 0, 6, 0, 0, 0, 0))
    second = ((0, 0, -2, 0, 0, 5, -2, 0, 0, -1, 0), (0, -1, 0, 0, -2, 5, 0, 0, -2, 0, 0))
    xp, is_first, found = namespace(mosaic), _is_first(mosaic, axis), []
    for first, last in (around, second):
        ninths = [tuple(weight / 9 for weight in taps) for taps in (first, last)]
        found.append(xp.where(is_first, correlate(mosaic, ninths[0], axis), correlate(mosaic, ninths[1], axis)))
    return found[0], found[1]


def _slope_of_other(cells: Array, green_cells: Array, axis: int) -> Array:
    """The slope ``[..., h, w]`` at which the other colour of a row (or column) follows a cell's own: a regression.

    Regressed are central differences over 5x5 cells, green and other cells apart.
    """
    other, own = correlate(cells, (-0.5, 0.0, 0.5), axis), correlate(cells, (-0.25, 0.0, 0.0, 0.0, 0.25), axis)
    means = [box_mean(cells * sites, 2) / box_mean(sites, 2) for sites in (green_cells, 1 - green_cells)]
    slopes = []
    for sites, mean_own, mean_other in ((green_cells, *means), (1 - green_cells, *means[::-1])):
        floor = SLOPE_FLOOR * box_mean(sites, 2)
        follows = box_mean(other * own * sites, 2) + floor * _prior_slope(mean_other, mean_own)
        slopes.append(follows / (box_mean(own * own * sites, 2) + floor))
    return namespace(cells).where(green_cells > 0, slopes[0], slopes[1]).clip(-0.5, 4.0)


def _prior_slope(mean: Array, mean_guide: Array) -> Array:
    """The slope where nothing can be regressed, from the means of both colours."""
    return PRIOR_SHARE * ((mean + 1e-3) / (mean_guide.clip(0.0, None) + 1e-3)).clip(0.2, 5.0)


def _at_least(image: Array, plain: Array) -> Array:
    """Raise to at least `MIN_SHARE` of its interpolation, which may be negative."""
    return namespace(image).where(image < MIN_SHARE * plain, MIN_SHARE * plain, image)


def _fill_from_green(mosaic: Array, green: Array, mask: Array, mask_cells: Array) -> Array:
    """Red or blue everywhere: a local linear function of green, plus its interpolated residual.

    Note: a binomial window, because it gives every phase of the Bayer pattern the same second moments; a box does not,
    which would make linear fields inexact.
    """
    share = _blur(mask_cells, _BINOMIAL)

    def mean(image: Array) -> Array:
        return _blur(mean_cells(image) * mask_cells, _BINOMIAL) / share

    mean_g, mean_x = mean(green), mean(mosaic)
    covariance, variance = mean(green * mosaic) - mean_g * mean_x, mean(green * green) - mean_g * mean_g
    slope = (covariance + GUIDE_FLOOR * _prior_slope(mean_x, mean_g)) / (variance.clip(0.0, None) + GUIDE_FLOOR)
    offset = mean_x - slope * mean_g
    guess = _enlarge(box_mean(slope, 1)) * green + _enlarge(box_mean(offset, 1))
    plain, residual = (_blur(image * mask, _PAIRS) for image in (mosaic, mosaic - guess))
    return namespace(mosaic).where(mask > 0, mosaic, _at_least(guess + residual, plain))


def _own(image: Array, layout: Layout) -> Array:
    """The colour of each pixel's own filter ``[..., H, W]``, of an image ``[..., C, H, W]``."""
    return namespace(image).sum(image * color_masks(image, layout, 2), axis=-3)


def _blur(image: Array, taps: tuple[float, ...]) -> Array:
    return correlate(correlate(image, taps, -1), taps, -2)


def _blur_stokes(stokes: Stokes, taps: tuple[float, ...]) -> Stokes:
    return stokes.map(lambda image: _blur(image, taps))


def _enlarge(image: Array) -> Array:
    """Enlarge cells ``[..., h, w]`` to pixels ``[..., 2h, 2w]``, linearly between the cells' centres."""
    for axis in (-2, -1):
        before, after = correlate(image, (0.25, 0.75, 0.0), axis), correlate(image, (0.0, 0.75, 0.25), axis)
        image = interleave(before, after, axis)
    return image


def _mirror_cells(values: Array, margin: int) -> Array:
    """Samples continued by ``margin`` cells on all sides: whole cells mirror about the outermost one.

    Colours and analysers keep their phase, and so uniform fields stay uniform.
    """
    xp = namespace(values)
    for axis in (-2, -1):
        cells = values.shape[axis] // 2
        place = xp.arange(-margin, cells + margin, device=device(values))
        period = xp.full_like(place[:1], 2 * cells - 2)  # an array: a graph's sizes are no numbers
        place = cells - 1 - xp.abs(place % period - (cells - 1))
        pairs = 2 * place[:, None] + xp.arange(2, device=device(values))
        values = xp.take(values, xp.reshape(pairs, (-1,)), axis=axis)
    return values


def _crop(image: Array, margin: int) -> Array:
    return image[..., margin:-margin, margin:-margin]
