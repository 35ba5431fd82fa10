"""Guided colour-affine separation in one pass: the same as its torch twins, with the same report."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from test_kernels_color_affine import LIGHT, SOLVED, as_raw, assert_twins, random_frame

from polsep.demosaic.guided import demosaic_guided_half
from polsep.kernels import ColorAffineOptions, get_threads, separate_color_affine_half, set_threads
from polsep.methods import compose
from polsep.physics.stokes import aolp, dolp
from polsep.sensor.camera import BAYER_ORDERS, IDEAL, IMX250, Layout, Mosaic, Sensor
from polsep.separation.analytic import Separation
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.report import describe, grey, tally
from polsep.separation.strips_kernel import CHUNK

GUIDED = ColorAffineOptions(guided=True)
#: What float32 sums leave of a frame's statistics, relative.
SUMMED = 1e-4


def twins_of(mosaic: Mosaic) -> Separation:
    return compose(demosaic_guided_half, separate_color_affine)(mosaic)


@pytest.mark.parametrize("bayer", BAYER_ORDERS)
@pytest.mark.parametrize("origin", [(0, 0), (1, 1)])
def test_agrees_on_every_layout(bayer: str, origin: tuple[int, int], generator: torch.Generator) -> None:
    """Bayer orders, origins, an odd size, another polarizer cell, noise, and a light colour to divide out."""
    layout = Layout(((0, 45), (135, 90)), bayer, origin)
    mosaic = random_frame((75, 94), layout, IMX250, 0.5, generator)
    mosaic = Mosaic(mosaic.data, layout, 20, mosaic.white_level, LIGHT)
    options = ColorAffineOptions(LIGHT, guided=True)
    assert_twins(separate_color_affine_half(as_raw(mosaic), layout, 20, 4095, options), twins_of(mosaic))


def test_agrees_on_analysers_of_any_angle(generator: torch.Generator) -> None:
    """Angles between those of Sony's cell, where every analyser sees s1 and s2."""
    layout = Layout(((10, 60), (110, 160)))
    mosaic = random_frame((64, 80), layout, IMX250, 0.5, generator)
    assert_twins(separate_color_affine_half(as_raw(mosaic), layout, 0, 4095, GUIDED), twins_of(mosaic))


@pytest.mark.parametrize("shape", [(16, 16), (17, 51), (8 * CHUNK + 40, 20), (20, 301), (4 * CHUNK + 6, 18)])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
def test_agrees_on_every_size(shape: tuple[int, int], sensor: Sensor, generator: torch.Generator) -> None:
    """Frames smaller than the filters' reach, mirrored again and again, and frames of several pieces."""
    mosaic = random_frame(shape, Layout(), sensor, 0.5, generator)
    found = separate_color_affine_half(as_raw(mosaic), Layout(), 0, mosaic.white_level, GUIDED)
    assert_twins(found, twins_of(mosaic))


@pytest.mark.parametrize("brightness", [1.2, 5.0])
def test_agrees_where_samples_clip(brightness: float, generator: torch.Generator) -> None:
    """A few clipped samples, and a frame that is mostly clipped."""
    mosaic = random_frame((310, 220), Layout(), IMX250, brightness, generator)
    assert bool(mosaic.clipped().any())
    assert_twins(separate_color_affine_half(as_raw(mosaic), Layout(), 0, 4095, GUIDED), twins_of(mosaic), SOLVED)


def test_threads_change_nothing(generator: torch.Generator) -> None:
    """The same bits from one thread and from several."""
    raw = as_raw(random_frame((20 * CHUNK, 40), Layout(), IMX250, 1.3, generator))
    before, found = get_threads(), []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            options = ColorAffineOptions(guided=True, report=True)
            found.append(separate_color_affine_half(raw, Layout(), 0, 4095, options))
    finally:
        set_threads(before)
    for other in found[1:]:
        np.testing.assert_array_equal(other.diffuse, found[0].diffuse)
        np.testing.assert_array_equal(other.specular, found[0].specular)
        np.testing.assert_array_equal(other.dolp, found[0].dolp)
        assert other.tally == found[0].tally


@pytest.mark.parametrize("brightness", [0.5, 1.2])
def test_reports_as_the_twins_do(brightness: float, generator: torch.Generator) -> None:
    """Statistics of a whole frame, DoLP and AoLP, with and without clipped samples."""
    mosaic = random_frame((310, 220), Layout(), IMX250, brightness, generator)
    options = ColorAffineOptions(guided=True, report=True)
    images = separate_color_affine_half(as_raw(mosaic), Layout(), 0, 4095, options)
    found = twins_of(mosaic)
    assert images.tally is not None
    expected = describe(tally(found), expects_errors=False)
    assert describe(images.tally, expects_errors=False)["statistics"] == pytest.approx(
        expected["statistics"], rel=SUMMED, abs=1e-7
    )
    mean = grey(found.stokes)
    bright = mean.s0[0].numpy() > 0.05
    assert images.dolp is not None
    assert images.aolp is not None
    np.testing.assert_allclose(images.dolp[bright], dolp(mean)[0].numpy()[bright], atol=SOLVED)
    apart = images.aolp - aolp(mean)[0].numpy()
    apart = np.abs((apart + np.pi / 2) % np.pi - np.pi / 2) * images.dolp
    assert apart[bright].max() <= SOLVED
