"""Demosaicking with an intensity guide, to half resolution: sharper than interpolating each analyser on its own.

A 2x2 cell holds all four analysers of one colour, so s0 of that colour is measured there. What misses is the Bayer
problem of s0 over cells, and the polarization, which the four places of the samples would falsify wherever s0 varies.

1. s0 of the other colours (`fill_colors`). Green first: along rows and columns, the mean of two neighbours plus the
   second difference of the cell's own colour, times the slope at which green follows that colour around (1 would be
   Hamilton and Adams 1997; textures of unlike colours need other slopes). Then red and blue as local linear functions
   of green with the residual interpolated (residual interpolation, Kiku et al. 2013).
2. Polarization (`_polarization`). The guide is s0 of each pixel's own colour at that very pixel; what the samples
   differ from it is interpolated as `demosaic_bilinear_half` would interpolate the samples. The guide is the cubic
   interpolation of 1 plus the detail that the residuals of all analysers and colours around a pixel have in common.

The idea of an intensity guide for polarization mosaics is Morimatsu et al. 2020 (EARI, doi
10.1109/ICIP40778.2020.9191062); the steps are this project's, see docs/experiments.md.

Estimates of different colours are no longer blurred alike, which invents relations between them. Those who relate
colours find the bilinear samples in `Measurements.uniform`. Pixels touched by clipping keep the bilinear samples.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polsep.camera import Layout, Mosaic
from polsep.demosaic import colors_of, correlate, demosaic_bilinear_half, split_analysers, to_center
from polsep.separation import box_mean
from polsep.stokes import Measurements, Stokes, fit_stokes, measure

#: Smallest number of cells per side for the guided filters; smaller frames stay bilinear.
LEAST_CELLS = 8
#: How strongly the common residual sharpens the guide, and how often; chosen on tuning scenes and real pictures.
DETAIL_GAIN, DETAIL_ROUNDS = 1.6, 2
#: Regularisation of slopes: variances of s0 below these are noise.
SLOPE_FLOOR, GUIDE_FLOOR = 1e-3, 1e-4
#: Catmull-Rom weights of the samples at -2, -1, 0, 1 for a point a quarter of a cell before sample 0.
_QUARTER_BEFORE = (-0.0234375, 0.2265625, 0.8671875, -0.0703125)


def demosaic_guided_half(mosaic: Mosaic) -> Measurements:
    """Co-registered analysers ``[..., 4, C, H/2, W/2]`` with an intensity guide, as the module says.

    Exact on uniform fields to the border. ``clipped`` and ``variance`` are those of `demosaic_bilinear_half`.
    """
    plain = demosaic_bilinear_half(mosaic)
    if min(plain.data.shape[-2:]) < LEAST_CELLS:
        return plain
    layout = mosaic.layout
    planes, places = split_analysers(mosaic.linear(), layout)
    own = fit_stokes(Measurements(planes[..., None, :, :], layout.angles)).s0
    s0 = fill_colors(own[..., 0, :, :], layout) if layout.bayer else own
    polarization = _polarization(planes, s0, layout, places)
    data = measure(Stokes(s0, polarization.s1, polarization.s2), layout.angles).data
    if plain.clipped is not None:
        touched = plain.clipped.any(dim=-4, keepdim=True).any(dim=-3, keepdim=True)
        data = torch.where(touched, plain.data, data)
    return Measurements(data, layout.angles, plain.clipped, plain.variance, plain)


def _masks(like: Tensor, bayer: str) -> Tensor:
    """Where the cells of ``[..., h, w]`` are red, green, blue: ``[3, h, w]`` of 0 and 1."""
    masks = torch.zeros(3, *like.shape[-2:], dtype=like.dtype, device=like.device)
    for place, color in enumerate(bayer):
        masks["RGB".index(color), place // 2 :: 2, place % 2 :: 2] = 1
    return masks


def fill_colors(cells: Tensor, layout: Layout) -> Tensor:
    """All colours ``[..., 3, h, w]`` of cells ``[..., h, w]`` that hold one each, in the layout's Bayer order."""
    assert layout.bayer is not None
    masks = _masks(cells, layout.bayer)
    green = _fill_green(cells, masks[1])
    red, blue = (_fill_from_green(cells, green, masks[c]) for c in (0, 2))
    return torch.stack([red, green, blue], dim=-3)


def _fill_green(cells: Tensor, is_green: Tensor) -> Tensor:
    """Green everywhere: estimates along both directions, weighed by how smooth green minus the other colour is."""
    total, weights = torch.zeros_like(cells), torch.zeros_like(cells)
    for dim in (-1, -2):
        around, second = correlate(cells, (0.5, 0.0, 0.5), dim), correlate(cells, (-0.25, 0.0, 0.5, 0.0, -0.25), dim)
        other = around + _slope_of_other(cells, is_green, dim) * second
        difference = torch.where(is_green > 0, cells - other, other - cells)
        weight = 1 / (box_mean(correlate(difference, (-1.0, 0.0, 1.0), dim) ** 2, 1) + 1e-6)
        total, weights = total + weight * difference, weights + weight
    return torch.where(is_green > 0, cells, cells + total / weights)


def _slope_of_other(cells: Tensor, is_green: Tensor, dim: int) -> Tensor:
    """The slope at which the other colour of a row (or column) follows the cell's own: regression of differences."""
    other, own = correlate(cells, (-0.5, 0.0, 0.5), dim), correlate(cells, (-0.25, 0.0, 0.0, 0.0, 0.25), dim)
    slopes = []
    for sites in (is_green, 1 - is_green):
        share = box_mean(sites, 2)
        slopes.append(box_mean(other * own * sites, 2) / (box_mean(own * own * sites, 2) + SLOPE_FLOOR * share))
    return torch.where(is_green > 0, slopes[0], slopes[1]).clamp(-0.5, 4)


def _fill_from_green(cells: Tensor, green: Tensor, mask: Tensor) -> Tensor:
    """Red or blue everywhere: a local linear function of green (guided filter), plus its interpolated residual."""
    share = box_mean(mask, 2)
    mean_g, mean_x = box_mean(green * mask, 2) / share, box_mean(cells * mask, 2) / share
    covariance = box_mean(green * cells * mask, 2) / share - mean_g * mean_x
    variance = box_mean(green * green * mask, 2) / share - mean_g * mean_g
    slope = covariance / (variance.clamp(min=0) + GUIDE_FLOOR)
    guess = box_mean(slope, 1) * green + box_mean(mean_x - slope * mean_g, 1)
    residual = (cells - guess) * mask
    for dim in (-1, -2):
        residual = correlate(residual, (0.5, 1.0, 0.5), dim)
    return guess + residual


def _at_sample(image: Tensor, place: tuple[int, int]) -> Tensor:
    """A half-resolution image ``[..., h, w]`` at the places of one analyser's samples, a quarter off the centres."""
    for dim in (-2, -1):
        taps = (*_QUARTER_BEFORE, 0.0) if place[dim] == 0 else (0.0, *_QUARTER_BEFORE[::-1])
        image = correlate(image, taps, dim)
    return image


def _interleave(samples: list[Tensor], places: list[tuple[int, int]]) -> Tensor:
    """Full-resolution ``[..., H, W]`` of one plane ``[..., h, w]`` per analyser."""
    first = samples[0]
    full = first.new_empty(*first.shape[:-2], 2 * first.shape[-2], 2 * first.shape[-1])
    for plane, (row, col) in zip(samples, places, strict=True):
        full[..., row::2, col::2] = plane
    return full


def _polarization(planes: Tensor, s0: Tensor, layout: Layout, places: list[tuple[int, int]]) -> Stokes:
    """s1 and s2 ``[..., C, h, w]`` of analyser planes ``[..., 4, h, w]``, given s0; its s0 is what s0 leaves over."""
    masks = _masks(planes, layout.bayer) if layout.bayer else torch.ones_like(planes[..., :1, :, :])
    guide = [(_at_sample(s0, place) * masks).sum(dim=-3) for place in places]
    found = _fit_residual(planes, guide, layout, places)
    for _ in range(DETAIL_ROUNDS):
        s1, s2 = box_mean(found.s1, 2), box_mean(found.s2, 2)
        left = []
        for k, (place, t) in enumerate(zip(places, layout.angles, strict=True)):
            expected = _at_sample(s1 * math.cos(2 * t) + s2 * math.sin(2 * t), place)
            left.append(2 * planes[..., k, :, :] - guide[k] - (expected * masks).sum(dim=-3))
        detail = _interleave(left, places)
        for dim in (-1, -2):
            detail = correlate(detail, (0.25, 0.5, 0.25), dim)
        sharper = [g + DETAIL_GAIN * detail[..., row::2, col::2] for g, (row, col) in zip(guide, places, strict=True)]
        found = _fit_residual(planes, sharper, layout, places)
    return found


def _fit_residual(planes: Tensor, guide: list[Tensor], layout: Layout, places: list[tuple[int, int]]) -> Stokes:
    """Stokes images ``[..., C, h, w]`` of what the samples differ from half the guide, interpolated bilinearly."""
    residual = [
        to_center(colors_of(planes[..., k, :, :] - 0.5 * guide[k], layout), place) for k, place in enumerate(places)
    ]
    return fit_stokes(Measurements(torch.stack(residual, dim=-4), layout.angles))
