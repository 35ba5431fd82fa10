"""Colour-affine separation at full resolution in one pass: the same as its twins, bilinear and guided, and reports."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from test_kernels_color_affine import LIGHT, SOLVED, as_raw, assert_twins, random_frame
from test_kernels_guided import SUMMED

from polsep.compute.threads import get_threads, set_threads
from polsep.demosaic.bilinear import demosaic_bilinear
from polsep.demosaic.guided import demosaic_guided
from polsep.kernels import ColorAffineImages, ColorAffineOptions, separate_color_affine_full
from polsep.methods import compose
from polsep.physics.stokes import Measurements, Stokes, aolp, dolp
from polsep.sensor.camera import BAYER_ORDERS, IDEAL, IMX250, Layout, Mosaic, Sensor, expose
from polsep.separation.analytic import Separation
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.report import describe, grey, tally
from polsep.separation.strips_full_kernel import CHUNK

#: Demosaickers by the option ``guided``.
DEMOSAICKERS: dict[bool, Callable[[Mosaic], Measurements]] = {False: demosaic_bilinear, True: demosaic_guided}
DEMOSAICKED = pytest.mark.parametrize("guided", DEMOSAICKERS, ids=["bilinear", "guided"])


def twins_of(mosaic: Mosaic, guided: bool) -> Separation:
    return compose(DEMOSAICKERS[guided], separate_color_affine)(mosaic)


def assert_agrees(mosaic: Mosaic, guided: bool, solved: float = 1e-4) -> None:
    options = ColorAffineOptions(guided=guided)
    found = separate_color_affine_full(as_raw(mosaic), mosaic.layout, 0, mosaic.white_level, options)
    assert_twins(found, twins_of(mosaic, guided), solved)


@DEMOSAICKED
@pytest.mark.parametrize("bayer", BAYER_ORDERS)
@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_agrees_on_every_layout(bayer: str, origin: tuple[int, int], guided: bool, generator: torch.Generator) -> None:
    """Bayer orders, origins, an odd size, another polarizer cell, noise, and a light colour to divide out."""
    layout = Layout(((0, 45), (135, 90)), bayer, origin)
    mosaic = random_frame((75, 94), layout, IMX250, 0.5, generator)
    mosaic = Mosaic(mosaic.data, layout, 20, mosaic.white_level, LIGHT)
    options = ColorAffineOptions(LIGHT, guided=guided)
    found = separate_color_affine_full(as_raw(mosaic), layout, 20, 4095, options)
    assert_twins(found, twins_of(mosaic, guided))


@DEMOSAICKED
def test_agrees_on_analysers_of_any_angle(guided: bool, generator: torch.Generator) -> None:
    """Angles between those of Sony's cell, where every analyser sees s1 and s2."""
    assert_agrees(random_frame((64, 80), Layout(((10, 60), (110, 160))), IMX250, 0.5, generator), guided)


@DEMOSAICKED
@pytest.mark.parametrize("shape", [(16, 16), (17, 51), (20, 301), (4 * CHUNK + 6, 18), (390, 20)])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
def test_agrees_on_every_size(shape: tuple[int, int], sensor: Sensor, guided: bool, generator: torch.Generator) -> None:
    """Frames smaller than the filters' reach, mirrored again and again, and frames of several strips."""
    assert_agrees(random_frame(shape, Layout(), sensor, 0.5, generator), guided)


@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (6, 40), (50, 4)])
def test_agrees_on_tiny_frames(shape: tuple[int, int], generator: torch.Generator) -> None:
    """From one period on, bilinear; guided demosaicking needs more."""
    assert_agrees(random_frame(shape, Layout(), IMX250, 0.5, generator), False)


@DEMOSAICKED
@pytest.mark.parametrize("brightness", [1.2, 5.0])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
def test_agrees_where_samples_clip(brightness: float, sensor: Sensor, guided: bool, generator: torch.Generator) -> None:
    """A few clipped samples, and a frame that is mostly clipped."""
    mosaic = random_frame((210, 150), Layout(), sensor, brightness, generator)
    assert bool(mosaic.clipped().any())
    assert_agrees(mosaic, guided, SOLVED)


@DEMOSAICKED
def test_agrees_on_a_white_frame(guided: bool) -> None:
    """Everything clips: nothing is known, and what is filled in is the same."""
    mosaic = Mosaic(torch.full((40, 44), 1.0), Layout(), 0, 1)
    assert not twins_of(mosaic, guided).valid.any()
    assert_agrees(mosaic, guided)


@DEMOSAICKED
@pytest.mark.parametrize("layout", [Layout(), Layout(((0, 45), (90, 135)), "GBRG", (1, 1))], ids=lambda x: x.spec)
def test_uniform_polarized_field_is_exact_to_the_border(layout: Layout, guided: bool) -> None:
    """White specular light on a coloured body, the same everywhere, is told apart from border to border."""
    body, light, a = torch.tensor([0.5, 0.3, 0.2])[:, None, None], 0.25, (0.1, -0.05)
    tau_d, tau_s = body.expand(3, 33, 37), torch.full((1, 33, 37), light)
    stokes = Stokes(tau_d + tau_s, a[0] * tau_d + 0.6 * tau_s, a[1] * tau_d + 0.8 * tau_s)
    mosaic = expose(stokes, layout, IDEAL)
    options = ColorAffineOptions(guided=guided, report=True)
    found = separate_color_affine_full(as_raw(mosaic), layout, 0, 1, options)
    np.testing.assert_allclose(found.specular, light, atol=1e-5)
    np.testing.assert_allclose(found.diffuse, np.broadcast_to(body[:, 0, 0], found.diffuse.shape), atol=1e-5)
    assert found.dolp is not None
    assert float(np.ptp(found.dolp)) < 1e-5


@DEMOSAICKED
def test_threads_change_nothing(guided: bool, generator: torch.Generator) -> None:
    """The same bits from one thread and from several, with clipped samples and a report."""
    raw = as_raw(random_frame((620, 40), Layout(), IMX250, 1.3, generator))
    before, found = get_threads(), []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            options = ColorAffineOptions(guided=guided, report=True)
            found.append(separate_color_affine_full(raw, Layout(), 0, 4095, options))
    finally:
        set_threads(before)
    for other in found[1:]:
        for name, image in found[0].arrays().items():
            np.testing.assert_array_equal(getattr(other, name), image)
        assert other.tally == found[0].tally


@pytest.mark.parametrize("brightness", [0.5, 1.5])
def test_light_color_comes_back(brightness: float, generator: torch.Generator) -> None:
    """``in_light`` multiplies the light's colour back, and ``out`` is filled and returned."""
    raw = as_raw(random_frame((80, 60), Layout(), IMX250, brightness, generator))
    out = ColorAffineImages.empty((80, 60), Layout(), full=True)
    white = separate_color_affine_full(raw, Layout(), 0, 4095, ColorAffineOptions(LIGHT))
    lit = separate_color_affine_full(raw, Layout(), 0, 4095, ColorAffineOptions(LIGHT, True, out))
    assert lit is out
    gains = np.array(LIGHT, np.float32)
    np.testing.assert_allclose(lit.diffuse, white.diffuse * gains, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(lit.specular, white.specular * gains, rtol=1e-6, atol=1e-7)


@DEMOSAICKED
@pytest.mark.parametrize("brightness", [0.5, 1.2])
def test_reports_as_the_twins_do(brightness: float, guided: bool, generator: torch.Generator) -> None:
    """Statistics of a whole frame, DoLP and AoLP, with and without clipped samples."""
    mosaic = random_frame((210, 150), Layout(), IMX250, brightness, generator)
    options = ColorAffineOptions(guided=guided, report=True)
    images = separate_color_affine_full(as_raw(mosaic), Layout(), 0, 4095, options)
    found = twins_of(mosaic, guided)
    assert images.tally is not None and images.dolp is not None and images.aolp is not None
    expected = describe(tally(found), expects_errors=False)
    assert describe(images.tally, expects_errors=False)["statistics"] == pytest.approx(
        expected["statistics"], rel=SUMMED, abs=1e-7
    )
    mean = grey(found.stokes)
    bright = mean.s0[0].numpy() > 0.05
    np.testing.assert_allclose(images.dolp[bright], dolp(mean)[0].numpy()[bright], atol=SOLVED)
    apart = images.aolp - aolp(mean)[0].numpy()
    apart = np.abs((apart + np.pi / 2) % np.pi - np.pi / 2) * images.dolp
    assert apart[bright].max() <= SOLVED


def test_refuses_what_it_cannot_separate() -> None:
    """Mono layouts, and images of half the size."""
    raw = np.zeros((8, 8), np.uint8)
    with pytest.raises(ValueError, match="expected a colour layout"):
        separate_color_affine_full(raw, Layout(bayer=None), 0, 255)
    half = ColorAffineImages.empty((8, 8), Layout())
    with pytest.raises(ValueError, match="expected diffuse to be"):
        separate_color_affine_full(raw, Layout(), 0, 255, ColorAffineOptions(out=half))
