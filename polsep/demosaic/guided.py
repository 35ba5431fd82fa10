"""Demosaicking with an intensity guide, to full or half resolution: sharper than interpolating each analyser alone.

One sample behind the analyser at angle t says 2 m - (s1 cos 2t + s2 sin 2t) = s0. Polarization is smooth where
intensity is not, so a smoothed one turns the mosaic of analysers into a mosaic of s0 at the sensor's full resolution,
whose colours come in 2x2 blocks (`_intensity_mosaic`). Demosaicking has two halves from there. Full resolution takes
both twice, the second time with polarization as sharp as the first time's found to be reliable (`_reliable`), without
which thin polarized highlights would keep the pattern of the analysers; in cell means that pattern cancels.

1. s0 of all colours (`fill_colors`). Green first: along rows and columns, the interpolation of the other colour plus
   what the pixel's own colour differs from its interpolation, times the slope at which green follows that colour
   around (slope 1 is Hamilton and Adams 1997; textures of unlike colours need other slopes). What green then differs
   from the pixel's colour is smoothed where it is no larger than the error of such an interpolation: on grey things,
   that is everywhere. Then red and blue as local linear functions of green, with the residual interpolated (residual
   interpolation, Kiku et al. 2013).
2. Polarization (`_residual_mosaic`). The guide is s0 of each pixel's own colour, from pixels around it; what the
   samples differ from it is interpolated bilinearly per analyser. A 3x3 tent holds all four analysers in balance, so
   the guide is the tent of s0 plus the detail that the analysers and colours around a pixel have in common.

The idea of an intensity guide for polarization mosaics is Morimatsu et al. 2020 (EARI, doi
10.1109/ICIP40778.2020.9191062); the steps are this project's, see docs/experiments.md.

Exact on uniform fields to the border, which is continued by mirroring whole cells, and on linear fields inside.
Estimates of different colours are no longer blurred alike, which invents relations between them. Methods that relate
colours use the bilinear samples in `Measurements.uniform`. Pixels touched by clipping keep the bilinear samples.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from polsep.compute.filters import box_mean
from polsep.demosaic.bilinear import (
    aligned,
    correlate,
    demosaic_bilinear,
    demosaic_bilinear_half,
    interpolate_analysers,
    interpolate_analysers_half,
    mean_cells,
    repeat_tile,
)
from polsep.physics.stokes import Measurements, Stokes, analyser_residual, fit_stokes, measure
from polsep.sensor.camera import Layout, Mosaic

#: Smallest number of cells per side for the guided filters; smaller frames stay bilinear.
MIN_CELLS = 8
#: Cells by which a frame is continued beyond its border: the reach of all filters together.
MARGIN = 36
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


def demosaic_guided(mosaic: Mosaic) -> Measurements:
    """Analysers at every pixel ``[..., 4, C, H, W]`` with an intensity guide, as the module says.

    ``clipped`` and ``variance`` are those of `demosaic_bilinear`, whose samples are ``uniform``.
    """
    if not _is_large_enough(mosaic):
        return demosaic_bilinear(mosaic)
    values, layout = _padded(mosaic)
    _, residual = _guide(values, _smooth_polarization(values, layout), layout)
    first = Measurements(interpolate_analysers_half(residual, layout), layout.angles)
    s0, residual = _guide(values, _reliable(first), layout)
    polarization = _blur_stokes(fit_stokes(Measurements(interpolate_analysers(residual, layout), layout.angles)), _TENT)
    found = Stokes(s0, polarization.s1, polarization.s2).map(lambda x: _crop(x, 2 * MARGIN))
    return _complete(found, demosaic_bilinear(mosaic))


def demosaic_guided_half(mosaic: Mosaic) -> Measurements:
    """Co-registered analysers ``[..., 4, C, H/2, W/2]`` with an intensity guide: means over 2x2 cells, in one round.

    ``clipped`` and ``variance`` are those of `demosaic_bilinear_half`, whose samples are ``uniform``.
    """
    if not _is_large_enough(mosaic):
        return demosaic_bilinear_half(mosaic)
    found, _ = guide_once(mosaic)
    return _complete(found, demosaic_bilinear_half(mosaic))


def guide_once(mosaic: Mosaic, margin: int = MARGIN) -> tuple[Stokes, Tensor]:
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


def _is_large_enough(mosaic: Mosaic) -> bool:
    return min(aligned(mosaic.data, mosaic.layout).shape[-2:]) >= 2 * MIN_CELLS


def _padded(mosaic: Mosaic, margin: int = MARGIN) -> tuple[Tensor, Layout]:
    """Linear samples from the first whole cell on with ``margin`` more cells around, and the layout they have."""
    values = _mirror_cells(aligned(mosaic.linear(), mosaic.layout), margin)
    return values, replace(mosaic.layout, origin=(0, 0))


def _complete(stokes: Stokes, plain: Measurements) -> Measurements:
    """The analysers that see ``stokes``, with the bilinear samples of ``plain`` wherever clipping touches a pixel."""
    data = measure(stokes, plain.angles).data
    if plain.clipped is not None:
        touched = plain.clipped.any(dim=-4, keepdim=True).any(dim=-3, keepdim=True)
        data = torch.where(touched, plain.data, data)
    return Measurements(data, plain.angles, plain.clipped, plain.variance, plain)


def _guide(values: Tensor, polarization: Stokes, layout: Layout) -> tuple[Tensor, Tensor]:
    """s0 ``[..., C, H, W]`` of aligned samples ``[..., H, W]``, and the samples minus half their guide.

    ``polarization [..., C, H/2, W/2]`` is what is taken for known.
    """
    intensity = _intensity_mosaic(values, polarization, layout)
    s0 = fill_colors(intensity, layout) if layout.bayer else intensity[..., None, :, :]
    return s0, _residual_mosaic(values, intensity, s0, layout)


def _smooth_polarization(values: Tensor, layout: Layout) -> Stokes:
    """Stokes images at half resolution, bilinear and then smoothed by `SMOOTH_RADIUS`."""
    found = fit_stokes(Measurements(interpolate_analysers_half(values, layout), layout.angles))
    return found.map(lambda image: box_mean(image, SMOOTH_RADIUS))


def _reliable(found: Measurements) -> Stokes:
    """Stokes images at half resolution, smoothed as far as the analysers contradict each other.

    A Wiener filter: detail counts by the share of its variance that exceeds `NOISE_MARGIN` times what noise and
    misregistration explain, which shows in `analyser_residual`.
    """
    stokes = fit_stokes(found)
    smooth = stokes.map(lambda image: box_mean(image, SMOOTH_RADIUS))
    d1, d2 = stokes.s1 - smooth.s1, stokes.s2 - smooth.s2
    detail = box_mean((d1 * d1 + d2 * d2).mean(dim=-3, keepdim=True), 1)
    noise = NOISE_MARGIN * box_mean((analyser_residual(found) ** 2).mean(dim=-3, keepdim=True), 1) + NOISE_FLOOR
    share = ((detail - noise) / (detail + NOISE_FLOOR)).clamp(min=0)
    return Stokes(smooth.s0, smooth.s1 + share * d1, smooth.s2 + share * d2)


def _intensity_mosaic(values: Tensor, polarization: Stokes, layout: Layout) -> Tensor:
    """s0 of its own colour at every pixel ``[..., H, W]``: twice the sample minus the polarization that it passed."""
    doubled = torch.deg2rad(2 * torch.tensor(layout.polarizer, dtype=torch.float64))
    intensity = 2 * values
    for weights, image in ((doubled.cos(), polarization.s1), (doubled.sin(), polarization.s2)):
        weights = torch.where(weights.abs() < 1e-9, 0.0, weights).to(values)
        intensity = intensity - repeat_tile(weights, values, 1) * _own(_enlarge(image), layout)
    return intensity


def _residual_mosaic(values: Tensor, intensity: Tensor, s0: Tensor, layout: Layout) -> Tensor:
    """Samples minus half the guide ``[..., H, W]``: polarization, the smoother the better the guide."""
    tent = _own(_blur(s0, _TENT), layout)
    guide = tent + DETAIL_GAIN * _blur(intensity - tent, _TENT)
    return values - 0.5 * guide


def fill_colors(mosaic: Tensor, layout: Layout) -> Tensor:
    """All colours ``[..., 3, H, W]`` of a mosaic ``[..., H, W]`` of 2x2 blocks of one colour each (a quad Bayer one).

    The pixels' own values stay.
    """
    masks, cells = color_masks(mosaic, layout, 2), color_masks(mosaic, layout, 1)
    green = _fill_green(mosaic, masks, cells)
    red, blue = (_fill_from_green(mosaic, green, masks[c], cells[c]) for c in (0, 2))
    return torch.stack([red, green, blue], dim=-3)


def color_masks(mosaic: Tensor, layout: Layout, block: int) -> Tensor:
    """Masks of the colours: ``[C, n, m]`` of 0 and 1 per pixel of a mosaic (``block`` 2) or per cell (``block`` 1)."""
    colors = torch.tensor(["RGB".index(color) for color in layout.bayer or "RRRR"], device=mosaic.device).view(2, 2)
    own = (colors == torch.arange(layout.channels, device=mosaic.device)[:, None, None]).to(mosaic.dtype)
    return repeat_tile(own, mosaic if block == 2 else mosaic[..., ::2, ::2], block)


def _fill_green(mosaic: Tensor, masks: Tensor, mask_cells: Tensor) -> Tensor:
    """Green everywhere: estimates along both directions, weighed by how smooth green minus the other colour is."""
    is_green, cells = masks[1] > 0, mean_cells(mosaic)
    total, weights, precision = (torch.zeros_like(image) for image in (mosaic, cells, cells))
    for dim in (-1, -2):
        around, second = _across_pairs(mosaic, dim)
        other = around + _repeat(_slope_of_other(cells, mask_cells[1], dim)) * second
        difference = correlate(torch.where(is_green, mosaic - other, other - mosaic), _GENTLE, dim)
        weight = 1 / (box_mean(mean_cells(correlate(difference, (-1.0, 0.0, 1.0), dim) ** 2), 1) + 1e-6)
        total, weights = total + _repeat(weight) * difference, weights + weight
        precision = precision + 1 / (box_mean(mean_cells(second) ** 2, 1) + 1e-12)
    difference = _without_error(total / _repeat(weights), 1 / precision, mask_cells)
    beside = 0.5 * (correlate(cells, (0.5, 0.0, 0.5), -1) + correlate(cells, (0.5, 0.0, 0.5), -2))
    return torch.where(is_green, mosaic, _at_least(mosaic + difference, _repeat(beside)))


def _without_error(difference: Tensor, error: Tensor, mask_cells: Tensor) -> Tensor:
    """The ``difference [..., H, W]`` of green at red and at blue cells, smoothed where the ``error [..., h, w]``
    explains it: the variance within a window counts by the share that exceeds `DIFFERENCE_MARGIN` times the error.
    """
    found = torch.zeros_like(difference)
    for mask in (mask_cells[0], mask_cells[2]):
        share = box_mean(mask, DIFFERENCE_RADIUS)
        smooth = _repeat(box_mean(mean_cells(difference) * mask, DIFFERENCE_RADIUS) / share)
        detail = difference - smooth
        variance, noise = (box_mean(x * mask, DIFFERENCE_RADIUS) / share for x in (mean_cells(detail**2), error))
        kept = ((variance - DIFFERENCE_MARGIN * noise) / (variance + 1e-12)).clamp(min=0)
        found = found + _repeat(mask) * (smooth + _repeat(kept) * detail)
    return found


def _across_pairs(mosaic: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Along rows or columns A A B B: the other colour interpolated, and what the own one differs from the same of it.

    At the first of a pair the nearest samples of the other colour are 1 before and 2 after, so they weigh 2/3 and 1/3;
    the own colour is interpolated at those two places, and from there at the pixel. At the second it is mirrored.
    """
    around = ((0, 0, 0, 0, 6, 0, 0, 3, 0, 0, 0), (0, 0, 0, 3, 0, 0, 6, 0, 0, 0, 0))
    second = ((0, 0, -2, 0, 0, 5, -2, 0, 0, -1, 0), (0, -1, 0, 0, -2, 5, 0, 0, -2, 0, 0))
    place = torch.arange(mosaic.shape[dim], device=mosaic.device) % 2 == 0
    is_first = place if dim == -1 else place[:, None]
    found = []
    for first, last in (around, second):
        ninths = [tuple(weight / 9 for weight in taps) for taps in (first, last)]
        found.append(torch.where(is_first, correlate(mosaic, ninths[0], dim), correlate(mosaic, ninths[1], dim)))
    return found[0], found[1]


def _slope_of_other(cells: Tensor, green_cells: Tensor, dim: int) -> Tensor:
    """The slope ``[..., h, w]`` at which the other colour of a row (or column) follows a cell's own: a regression.

    Regressed are central differences over 5x5 cells, green and other cells apart.
    """
    other, own = correlate(cells, (-0.5, 0.0, 0.5), dim), correlate(cells, (-0.25, 0.0, 0.0, 0.0, 0.25), dim)
    means = [box_mean(cells * sites, 2) / box_mean(sites, 2) for sites in (green_cells, 1 - green_cells)]
    slopes = []
    for sites, mean_own, mean_other in ((green_cells, *means), (1 - green_cells, *means[::-1])):
        floor = SLOPE_FLOOR * box_mean(sites, 2)
        follows = box_mean(other * own * sites, 2) + floor * _prior_slope(mean_other, mean_own)
        slopes.append(follows / (box_mean(own * own * sites, 2) + floor))
    return torch.where(green_cells > 0, slopes[0], slopes[1]).clamp(-0.5, 4.0)


def _prior_slope(mean: Tensor, mean_guide: Tensor) -> Tensor:
    """The slope where nothing can be regressed, from the means of both colours."""
    return PRIOR_SHARE * ((mean + 1e-3) / (mean_guide.clamp(min=0) + 1e-3)).clamp(0.2, 5.0)


def _at_least(image: Tensor, plain: Tensor) -> Tensor:
    """Raise to at least `MIN_SHARE` of its interpolation, which may be negative."""
    return torch.where(image < MIN_SHARE * plain, MIN_SHARE * plain, image)


def _fill_from_green(mosaic: Tensor, green: Tensor, mask: Tensor, mask_cells: Tensor) -> Tensor:
    """Red or blue everywhere: a local linear function of green, plus its interpolated residual.

    Note: a binomial window, because it gives every phase of the Bayer pattern the same second moments; a box does not,
    which would make linear fields inexact.
    """
    share = _blur(mask_cells, _BINOMIAL)

    def mean(image: Tensor) -> Tensor:
        return _blur(mean_cells(image) * mask_cells, _BINOMIAL) / share

    mean_g, mean_x = mean(green), mean(mosaic)
    covariance, variance = mean(green * mosaic) - mean_g * mean_x, mean(green * green) - mean_g * mean_g
    slope = (covariance + GUIDE_FLOOR * _prior_slope(mean_x, mean_g)) / (variance.clamp(min=0) + GUIDE_FLOOR)
    offset = mean_x - slope * mean_g
    guess = _enlarge(box_mean(slope, 1)) * green + _enlarge(box_mean(offset, 1))
    plain, residual = (_blur(image * mask, _PAIRS) for image in (mosaic, mosaic - guess))
    return torch.where(mask > 0, mosaic, _at_least(guess + residual, plain))


def _own(image: Tensor, layout: Layout) -> Tensor:
    """The colour of each pixel's own filter ``[..., H, W]``, of an image ``[..., C, H, W]``."""
    return (image * color_masks(image, layout, 2)).sum(dim=-3)


def _blur(image: Tensor, taps: tuple[float, ...]) -> Tensor:
    return correlate(correlate(image, taps, -1), taps, -2)


def _blur_stokes(stokes: Stokes, taps: tuple[float, ...]) -> Stokes:
    return stokes.map(lambda image: _blur(image, taps))


def _repeat(cells: Tensor) -> Tensor:
    """Every cell's value at its four pixels."""
    return cells.repeat_interleave(2, -1).repeat_interleave(2, -2)


def _enlarge(image: Tensor) -> Tensor:
    """Enlarge cells ``[..., h, w]`` to pixels ``[..., 2h, 2w]``, linearly between the cells' centres."""
    for dim in (-2, -1):
        before, after = correlate(image, (0.25, 0.75, 0.0), dim), correlate(image, (0.0, 0.75, 0.25), dim)
        image = torch.stack((before, after), dim=dim).flatten(dim - 1, dim)
    return image


def _mirror_cells(values: Tensor, margin: int) -> Tensor:
    """Samples continued by ``margin`` cells on all sides: whole cells mirror about the outermost one.

    Colours and analysers keep their phase, and so uniform fields stay uniform.
    """
    for dim in (-2, -1):
        cells = values.shape[dim] // 2
        place = torch.arange(-margin, cells + margin, device=values.device)
        period = torch.full_like(place[:1], 2 * cells - 2)  # a tensor: a graph's sizes are no numbers
        place = cells - 1 - (place.remainder(period) - (cells - 1)).abs()
        values = values.index_select(dim, (2 * place[:, None] + torch.arange(2, device=values.device)).flatten())
    return values


def _crop(image: Tensor, margin: int) -> Tensor:
    return image[..., margin:-margin, margin:-margin]
