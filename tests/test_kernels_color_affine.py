"""The colour-affine kernels compute what their torch twins compute: both resolutions, bilinear and guided."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half
from polsep.kernels import (
    ColorAffineImages,
    ColorAffineOptions,
    get_threads,
    separate_color_affine_full,
    separate_color_affine_half,
    set_threads,
)
from polsep.methods import compose
from polsep.physics.stokes import Measurements, Stokes, aolp, dolp
from polsep.sensor.camera import BAYER_ORDERS, IDEAL, IMX250, Layout, Mosaic, Sensor, expose
from polsep.separation.analytic import Separation
from polsep.separation.color_affine import SCALES, separate_color_affine
from polsep.separation.moments_kernel import MIDDLE, NARROW, WIDEST
from polsep.separation.report import describe, grey, tally
from polsep.separation.strips_full_kernel import CHUNK as FULL_CHUNK
from polsep.separation.strips_kernel import CHUNK

#: Of white: the largest and the median difference that float32 sums of another order may leave.
LARGEST, MEDIAN = 1e-4, 1e-6
#: Largest difference where clipping leaves a badly conditioned system of equations.
SOLVED = 1e-3
#: What float32 sums leave of a frame's statistics, relative.
SUMMED = 1e-4
LIGHT = (0.6, 1.0, 0.8)
#: Demosaickers by the options ``full`` and ``guided``.
DEMOSAICKERS: dict[tuple[bool, bool], Callable[[Mosaic], Measurements]] = {
    (False, False): demosaic_bilinear_half,
    (False, True): demosaic_guided_half,
    (True, False): demosaic_bilinear,
    (True, True): demosaic_guided,
}
EVERY = pytest.mark.parametrize(("full", "guided"), DEMOSAICKERS, ids=["half", "half guided", "full", "full guided"])
FULL = pytest.mark.parametrize("full", [False, True], ids=["half", "full"])
SENSORS = pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])


def random_frame(
    shape: tuple[int, int], layout: Layout, sensor: Sensor, brightness: float, generator: torch.Generator
) -> Mosaic:
    """One exposure of coloured texture, flat grey patches and highlights, all of smoothly varying polarization."""
    h, w = shape

    def smooth(channels: int, period: int) -> torch.Tensor:
        coarse = torch.rand(1, channels, h // period + 2, w // period + 2, generator=generator)
        return torch.nn.functional.interpolate(coarse, size=shape, mode="bilinear")[0]

    albedo = torch.where(smooth(1, 24) > 0.5, smooth(3, 3), smooth(1, 40).expand(3, h, w))
    diffuse, specular = albedo * smooth(1, 30), smooth(1, 12) ** 4
    angle, size = 7 * smooth(1, 40), 0.3 * smooth(1, 40)
    s1 = diffuse * size * torch.cos(angle) + specular * 0.6
    s2 = diffuse * size * torch.sin(angle) + specular * 0.8
    return expose(Stokes(diffuse + specular, s1, s2) * brightness, layout, sensor, generator)


def twin_of(mosaic: Mosaic, full: bool = False, guided: bool = False) -> Separation:
    return compose(DEMOSAICKERS[full, guided], separate_color_affine)(mosaic)


def as_raw(mosaic: Mosaic) -> NDArray[np.generic]:
    """Integer codes as uint16, others as float32."""
    data = mosaic.data.numpy()
    return data.astype(np.uint16) if mosaic.white_level > 1 else data


def separate(mosaic: Mosaic, full: bool, **options: Any) -> ColorAffineImages:
    """What the kernel of a resolution makes of a frame in its light."""
    kernel = separate_color_affine_full if full else separate_color_affine_half
    given = ColorAffineOptions(mosaic.light_color, **options)
    return kernel(as_raw(mosaic), mosaic.layout, mosaic.black_level, mosaic.white_level, given)


def assert_twins(found: ColorAffineImages, expected: Separation, solved: float = LARGEST) -> None:
    """Equal images and the same valid pixels; ``solved`` bounds the difference where samples are clipped."""
    np.testing.assert_array_equal(found.valid, expected.valid.numpy())
    for image, tensor in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        wrong = np.abs(image - tensor.movedim(-3, -1).numpy())
        assert image.dtype == np.float32
        assert wrong.max() <= solved
        assert np.median(wrong) <= MEDIAN


def assert_agrees(mosaic: Mosaic, full: bool, guided: bool, solved: float = LARGEST) -> None:
    assert_twins(separate(mosaic, full, guided=guided), twin_of(mosaic, full, guided), solved)


@EVERY
@pytest.mark.parametrize("bayer", BAYER_ORDERS)
@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_agrees_on_every_layout(
    bayer: str, origin: tuple[int, int], full: bool, guided: bool, generator: torch.Generator
) -> None:
    """Bayer orders, origins, an odd size, another polarizer cell, noise, and a light colour to divide out."""
    layout = Layout(((0, 45), (135, 90)), bayer, origin)
    mosaic = random_frame((75, 94), layout, IMX250, 0.5, generator)
    mosaic = Mosaic(mosaic.data, layout, 20, mosaic.white_level, LIGHT)
    assert not bool(mosaic.clipped().any())
    assert_agrees(mosaic, full, guided)


@EVERY
def test_agrees_on_analysers_of_any_angle(full: bool, guided: bool, generator: torch.Generator) -> None:
    """Angles between those of Sony's cell, where every analyser sees s1 and s2."""
    assert_agrees(random_frame((64, 80), Layout(((10, 60), (110, 160))), IMX250, 0.5, generator), full, guided)


@EVERY
@pytest.mark.parametrize(
    "shape", [(16, 16), (17, 51), (20, 301), (4 * FULL_CHUNK + 6, 18), (4 * CHUNK + 6, 18), (8 * CHUNK + 40, 20)]
)
@SENSORS
def test_agrees_on_every_size(
    shape: tuple[int, int], sensor: Sensor, full: bool, guided: bool, generator: torch.Generator
) -> None:
    """Frames smaller than the filters' reach, mirrored again and again, and frames of several strips."""
    assert_agrees(random_frame(shape, Layout(), sensor, 0.5, generator), full, guided)


@FULL
@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (6, 40), (50, 4), (27, 30), (700, 12), (12, 301)])
@SENSORS
def test_agrees_on_tiny_frames(shape: tuple[int, int], sensor: Sensor, full: bool, generator: torch.Generator) -> None:
    """From one period on, bilinear, and in strips of that; guided demosaicking needs more."""
    assert_agrees(random_frame(shape, Layout(), sensor, 0.5, generator), full, False)


@SENSORS
def test_agrees_beside_a_bright_edge(sensor: Sensor, generator: torch.Generator) -> None:
    """A bright colourful half leaves no rounding in the sums over the dark half below it."""
    mosaic = random_frame((500, 60), Layout(), sensor, 0.5, generator)
    data = mosaic.data.clone()
    data[100:] *= 1e-3
    mosaic = Mosaic(data, Layout(), 0, mosaic.white_level)
    found = separate_color_affine_half(data.numpy(), Layout(), 0, mosaic.white_level)
    expected = twin_of(mosaic)
    assert_twins(found, expected)
    dark = np.abs(found.specular[60:] - expected.specular.movedim(-3, -1).numpy()[60:])
    assert dark.max() <= 1e-7


@EVERY
@pytest.mark.parametrize("brightness", [1.2, 1.8, 5.0])
@SENSORS
def test_agrees_where_samples_clip(
    brightness: float, sensor: Sensor, full: bool, guided: bool, generator: torch.Generator
) -> None:
    """A few clipped samples, highlights, and a frame that is mostly clipped."""
    mosaic = random_frame((210, 150) if full else (310, 220), Layout(), sensor, brightness, generator)
    assert bool(mosaic.clipped().any())
    assert_agrees(mosaic, full, guided, SOLVED)


@EVERY
def test_agrees_on_a_white_frame(full: bool, guided: bool) -> None:
    """Everything clips: nothing is known, and what is filled in is the same."""
    for white in (1, 255):
        mosaic = Mosaic(torch.full((40, 44), float(white)), Layout(), 0, white)
        assert not separate(mosaic, full, guided=guided).valid.any()
        assert_agrees(mosaic, full, guided)


@pytest.mark.parametrize("guided", [False, True], ids=["bilinear", "guided"])
@pytest.mark.parametrize("layout", [Layout(), Layout(((0, 45), (90, 135)), "GBRG", (1, 1))], ids=lambda x: x.spec)
def test_uniform_polarized_field_is_exact_to_the_border(layout: Layout, guided: bool) -> None:
    """White specular light on a coloured body, the same everywhere, is told apart from border to border."""
    body, light, a = torch.tensor([0.5, 0.3, 0.2])[:, None, None], 0.25, (0.1, -0.05)
    tau_d, tau_s = body.expand(3, 33, 37), torch.full((1, 33, 37), light)
    stokes = Stokes(tau_d + tau_s, a[0] * tau_d + 0.6 * tau_s, a[1] * tau_d + 0.8 * tau_s)
    mosaic = expose(stokes, layout, IDEAL)
    found = separate(mosaic, True, guided=guided, report=True)
    np.testing.assert_allclose(found.specular, light, atol=1e-5)
    np.testing.assert_allclose(found.diffuse, np.broadcast_to(body[:, 0, 0], found.diffuse.shape), atol=1e-5)
    assert found.dolp is not None
    assert float(np.ptp(found.dolp)) < 1e-5


@EVERY
@pytest.mark.parametrize(("brightness", "report"), [(0.5, False), (1.3, True)])
def test_threads_change_nothing(
    brightness: float, report: bool, full: bool, guided: bool, generator: torch.Generator
) -> None:
    """The same bits from one thread and from several, with clipped samples and a report too."""
    mosaic = random_frame((20 * CHUNK, 40), Layout(), IMX250, brightness, generator)
    before, found = get_threads(), []
    try:
        for threads in (1, 2, 3, 7):
            set_threads(threads)
            found.append(separate(mosaic, full, guided=guided, report=report))
    finally:
        set_threads(before)
    for other in found[1:]:
        for name, image in found[0].arrays().items():
            np.testing.assert_array_equal(getattr(other, name), image)
        assert other.tally == found[0].tally


@FULL
@pytest.mark.parametrize("brightness", [0.5, 1.5])
def test_light_color_comes_back(brightness: float, full: bool, generator: torch.Generator) -> None:
    """``in_light`` multiplies the light's colour back, and ``out`` is filled and returned."""
    mosaic = random_frame((80, 60), Layout(), IMX250, brightness, generator)
    mosaic = Mosaic(mosaic.data, Layout(), 0, mosaic.white_level, LIGHT)
    out = ColorAffineImages.empty((80, 60), Layout(), full=full)
    white, lit = separate(mosaic, full), separate(mosaic, full, in_light=True, out=out)
    assert lit is out
    gains = np.array(LIGHT, np.float32)
    np.testing.assert_allclose(lit.diffuse, white.diffuse * gains, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(lit.specular, white.specular * gains, rtol=1e-6, atol=1e-7)


@EVERY
@pytest.mark.parametrize("brightness", [0.5, 1.2])
def test_reports_as_the_twins_do(brightness: float, full: bool, guided: bool, generator: torch.Generator) -> None:
    """Statistics of a whole frame, DoLP and AoLP, with and without clipped samples."""
    mosaic = random_frame((210, 150) if full else (310, 220), Layout(), IMX250, brightness, generator)
    images, found = separate(mosaic, full, guided=guided, report=True), twin_of(mosaic, full, guided)
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


def test_scales_are_the_kernels() -> None:
    """The kernel is written for these windows; their spreads it takes from the twin."""
    assert [radius for radius, _ in SCALES] == [WIDEST, MIDDLE, NARROW, 0]


@FULL
def test_refuses_what_it_cannot_separate(full: bool) -> None:
    """Mono layouts, and images of another width or resolution."""
    frame = torch.zeros(8, 8)
    with pytest.raises(ValueError, match="expected a colour layout"):
        separate(Mosaic(frame, Layout(bayer=None), 0, 255), full)
    for wrong in (ColorAffineImages.empty((8, 12), Layout()), ColorAffineImages.empty((8, 8), Layout(), full=not full)):
        with pytest.raises(ValueError, match="expected diffuse to be"):
            separate(Mosaic(frame, Layout(), 0, 255), full, out=wrong)
