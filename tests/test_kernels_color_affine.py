"""The colour-affine kernel computes what its torch twin computes, on every layout, size and clipped frame."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.kernels import ColorAffineImages, ColorAffineOptions, get_threads, separate_color_affine_half, set_threads
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import BAYER_ORDERS, IDEAL, IMX250, Layout, Mosaic, Sensor, expose
from polsep.separation.analytic import Separation
from polsep.separation.color_affine import SCALES, separate_color_affine
from polsep.separation.moments_kernel import MIDDLE, NARROW, WIDEST

#: Of white: the largest and the median difference that float32 sums of another order may leave.
LARGEST, MEDIAN = 1e-4, 1e-6
#: Largest difference where clipping leaves a badly conditioned system of equations.
SOLVED = 1e-3
LIGHT = (0.6, 1.0, 0.8)


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


def twin_of(mosaic: Mosaic) -> Separation:
    return separate_color_affine(demosaic_bilinear_half(mosaic))


def as_raw(mosaic: Mosaic) -> NDArray[np.generic]:
    """Integer codes as uint16, others as float32."""
    data = mosaic.data.numpy()
    return data.astype(np.uint16) if mosaic.white_level > 1 else data


def assert_twins(found: ColorAffineImages, expected: Separation, solved: float = LARGEST) -> None:
    """Equal images and the same valid pixels; ``solved`` bounds the difference where samples are clipped."""
    np.testing.assert_array_equal(found.valid, expected.valid.numpy())
    for image, tensor in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        wrong = np.abs(image - tensor.movedim(-3, -1).numpy())
        assert image.dtype == np.float32
        assert wrong.max() <= solved
        assert np.median(wrong) <= MEDIAN


@pytest.mark.parametrize("bayer", BAYER_ORDERS)
@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_agrees_on_every_layout(bayer: str, origin: tuple[int, int], generator: torch.Generator) -> None:
    """Bayer orders, origins, an odd size, another polarizer cell, noise, and a light colour to divide out."""
    layout = Layout(((0, 45), (135, 90)), bayer, origin)
    mosaic = random_frame((75, 94), layout, IMX250, 0.5, generator)
    mosaic = Mosaic(mosaic.data, layout, 20, mosaic.white_level, LIGHT)
    assert not bool(mosaic.clipped().any())
    found = separate_color_affine_half(as_raw(mosaic), layout, 20, 4095, ColorAffineOptions(LIGHT))
    assert_twins(found, twin_of(mosaic))


@pytest.mark.parametrize("shape", [(4, 4), (5, 7), (6, 40), (50, 4), (27, 30), (700, 12), (12, 301)])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
def test_agrees_on_every_size(shape: tuple[int, int], sensor: Sensor, generator: torch.Generator) -> None:
    """Frames smaller than a window and frames of several strips, with noise and without."""
    mosaic = random_frame(shape, Layout(), sensor, 0.5, generator)
    found = separate_color_affine_half(as_raw(mosaic), Layout(), 0, mosaic.white_level)
    assert_twins(found, twin_of(mosaic))


@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
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


@pytest.mark.parametrize("brightness", [1.2, 1.8, 5.0])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250], ids=["exact", "noisy"])
def test_agrees_where_samples_clip(brightness: float, sensor: Sensor, generator: torch.Generator) -> None:
    """A few clipped samples, highlights, and a frame that is mostly clipped."""
    mosaic = random_frame((310, 220), Layout(), sensor, brightness, generator)
    assert bool(mosaic.clipped().any())
    found = separate_color_affine_half(as_raw(mosaic), Layout(), 0, mosaic.white_level)
    assert_twins(found, twin_of(mosaic), SOLVED)


def test_agrees_on_a_white_frame() -> None:
    """Everything clips: nothing is known, and what is filled in is the same."""
    found = separate_color_affine_half(np.full((40, 44), 255, np.uint8), Layout(), 0, 255)
    assert_twins(found, twin_of(Mosaic(torch.full((40, 44), 255.0), Layout(), 0, 255)))
    assert not found.valid.any()


@pytest.mark.parametrize("brightness", [0.5, 1.5])
def test_threads_change_nothing(brightness: float, generator: torch.Generator) -> None:
    """The same bits from one thread and from several."""
    raw = as_raw(random_frame((620, 90), Layout(), IMX250, brightness, generator))
    before, found = get_threads(), []
    try:
        for threads in (1, 2, 3, 7):
            set_threads(threads)
            found.append(separate_color_affine_half(raw, Layout(), 0, 4095))
    finally:
        set_threads(before)
    for other in found[1:]:
        for name, image in vars(found[0]).items():
            np.testing.assert_array_equal(getattr(other, name), image)


@pytest.mark.parametrize("brightness", [0.5, 1.5])
def test_light_color_comes_back(brightness: float, generator: torch.Generator) -> None:
    """``in_light`` multiplies the light's colour back, and ``out`` is filled and returned."""
    raw = as_raw(random_frame((80, 60), Layout(), IMX250, brightness, generator))
    out = ColorAffineImages.empty((80, 60), Layout())
    white = separate_color_affine_half(raw, Layout(), 0, 4095, ColorAffineOptions(LIGHT))
    lit = separate_color_affine_half(raw, Layout(), 0, 4095, ColorAffineOptions(LIGHT, True, out))
    assert lit is out
    gains = np.array(LIGHT, np.float32)
    np.testing.assert_allclose(lit.diffuse, white.diffuse * gains, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(lit.specular, white.specular * gains, rtol=1e-6, atol=1e-7)


def test_scales_are_the_kernels() -> None:
    """The kernel is written for these windows; their spreads it takes from the twin."""
    assert [radius for radius, _ in SCALES] == [WIDEST, MIDDLE, NARROW, 0]


def test_refuses_what_it_cannot_separate() -> None:
    """Mono layouts, and images that do not fit."""
    raw = np.zeros((8, 8), np.uint8)
    with pytest.raises(ValueError, match="expected a colour layout"):
        separate_color_affine_half(raw, Layout(bayer=None), 0, 255)
    wrong = ColorAffineImages.empty((8, 12), Layout())
    with pytest.raises(ValueError, match="expected diffuse to be"):
        separate_color_affine_half(raw, Layout(), 0, 255, ColorAffineOptions(out=wrong))
