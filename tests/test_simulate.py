"""Lens, exposure and sensor: what they keep, what they clip, and that the fast path is the sensor of `camera`."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.ndimage import gaussian_filter

from polsep.physics.stokes import Stokes
from polsep.render.simulate import (
    HEADROOM,
    blur,
    capture,
    expose_to_clip,
    expose_to_level,
    filter_light,
    half_resolution,
)
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import IDEAL, IMX250, Layout, Sensor, expose, measure_with_analysers, sample_mosaic

SIZE = (48, 72)


def smooth(generator: torch.Generator, channels: int = 3) -> torch.Tensor:
    coarse = torch.rand(1, channels, 5, 7, generator=generator)
    return torch.nn.functional.interpolate(coarse, size=SIZE, mode="bicubic", align_corners=True)[0].clamp(min=0)


def lit_scene(seed: int = 0, channels: int = 3) -> Scene:
    """A partly polarized diffuse and a fully polarized specular lobe, masked to an inner block."""
    generator = torch.Generator().manual_seed(seed)
    d, s, angle = (smooth(generator, channels) for _ in range(3))
    s = s**4
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[6:40, 10:60] = True
    two = 2 * math.pi * angle
    specular = Stokes(s, s * torch.cos(two), s * torch.sin(two))
    return Scene(Stokes(d, 0.2 * d * torch.sin(two), 0.2 * d * torch.cos(two)), specular, mask)


@pytest.mark.parametrize("sigma", [0.3, 0.8, 2.0])
def test_blur_keeps_a_constant_field_to_the_border(sigma: float) -> None:
    """The weights sum to 1, also where the border mirrors."""
    field = Stokes(*(torch.full((3, *SIZE), level) for level in (1.0, 0.4, -0.3)))
    found = blur(Scene(field, field, torch.ones(SIZE, dtype=torch.bool)), sigma)
    for lobe in (found.diffuse, found.specular):
        for name in ("s0", "s1", "s2"):
            torch.testing.assert_close(getattr(lobe, name), getattr(field, name), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("sigma", [0.3, 0.8, 1.6])
def test_blur_keeps_the_energy(sigma: float) -> None:
    """Light that is away from the border only moves."""
    scene = lit_scene()
    inside = scene.mask.float()
    found = blur(Scene(scene.diffuse * inside, scene.specular * inside, scene.mask), sigma)
    for before, after in ((scene.diffuse, found.diffuse), (scene.specular, found.specular)):
        for name in ("s0", "s1", "s2"):
            total = (getattr(before, name) * inside).double().sum(dim=(1, 2))
            torch.testing.assert_close(getattr(after, name).double().sum(dim=(1, 2)), total, rtol=1e-5, atol=1e-4)
    assert torch.equal(found.mask, scene.mask)


@pytest.mark.parametrize("sigma", [0.3, 0.55, 0.8, 2.0])
def test_blur_is_scipys_gaussian(sigma: float) -> None:
    """The same weights, cut at the same three sigma, over the same mirrored border."""
    scene = lit_scene()
    reach = math.ceil(3 * sigma)
    expected = gaussian_filter(scene.diffuse.s1.double().numpy(), sigma, mode="mirror", radius=reach, axes=(1, 2))
    torch.testing.assert_close(blur(scene, sigma).diffuse.s1.double(), torch.from_numpy(expected), rtol=0, atol=1e-6)
    assert blur(scene, 0.0) is scene


def test_half_resolution_is_the_box_mean() -> None:
    """Each pixel is the mean of its four, and inside the mask where all four are."""
    scene = lit_scene()
    diffuse, specular, mask = half_resolution(scene)
    for half, whole in ((diffuse, scene.diffuse.s0), (specular, scene.specular.s0)):
        mean = sum(whole[:, row::2, col::2] for row in (0, 1) for col in (0, 1)) / 4
        torch.testing.assert_close(half, mean, rtol=1e-6, atol=1e-7)
    assert int(mask.sum()) == 17 * 25
    odd = scene.mask.clone()
    odd[6] = False
    assert int(half_resolution(Scene(scene.diffuse, scene.specular, odd))[2].sum()) == 16 * 25


@pytest.mark.parametrize("layout", [Layout(), Layout(bayer="GBRG", origin=(1, 0)), Layout(bayer=None)])
@pytest.mark.parametrize("sensor", [IDEAL, IMX250])
def test_the_fast_path_is_the_camera(layout: Layout, sensor: Sensor) -> None:
    """Bit for bit what `camera` makes of all twelve measurements of a pixel, noise included."""
    scene = lit_scene(channels=layout.channels)
    light = scene.diffuse + scene.specular
    every = sample_mosaic(measure_with_analysers(light, layout.angles, sensor.diattenuation), layout)
    assert torch.equal(filter_light(light, layout, sensor), every)
    expected = expose(light, layout, sensor, torch.Generator().manual_seed(3))
    found = capture(scene, layout, sensor, torch.Generator().manual_seed(3)).mosaic
    assert torch.equal(found.data, expected.data)
    assert (found.black_level, found.white_level, found.layout) == (0.0, expected.white_level, layout)


@pytest.mark.parametrize("share", [0.002, 0.013, 0.05])
def test_as_many_samples_clip_as_asked(share: float) -> None:
    """Of the object's noise-free samples, up to one; noise and the margin of `Mosaic.clipped` change little."""
    scene = expose_to_clip(lit_scene(), share, Layout(), IMX250)
    signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask]
    assert abs(int((signal > 1).sum()) - share * signal.numel()) <= 1
    noisy = capture(scene, Layout(), IMX250, torch.Generator().manual_seed(0)).mosaic.clipped()[scene.mask]
    assert abs(float(noisy.float().mean()) - share) < 0.005


def test_nothing_clips_where_nothing_is_to() -> None:
    """The brightest sample is at `HEADROOM`, and noise does not lift it to the white level."""
    scene = expose_to_clip(lit_scene(), 0.0, Layout(), IMX250)
    assert float(filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask].max()) == pytest.approx(
        HEADROOM, rel=1e-6
    )
    assert not bool(
        capture(scene, Layout(), IMX250, torch.Generator().manual_seed(0)).mosaic.clipped()[scene.mask].any()
    )


def test_dark_exposures_are_lifted() -> None:
    """The median of the lit samples comes to the level; brighter scenes stay as they are."""
    scene = lit_scene()
    signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask]
    level = 2 * float(signal.median())
    lifted = expose_to_level(scene, level, Layout(), IMX250)
    found = filter_light(lifted.diffuse + lifted.specular, Layout(), IMX250)[lifted.mask]
    assert float(found.median()) == pytest.approx(level, rel=1e-5)
    torch.testing.assert_close(lifted.diffuse.s1, 2 * scene.diffuse.s1, rtol=1e-5, atol=1e-6)
    assert expose_to_level(scene, level / 4, Layout(), IMX250) is scene


def test_exposure_needs_light_on_an_object() -> None:
    """An empty mask and a black object are refused."""
    scene = lit_scene()
    for wrong in (
        Scene(scene.diffuse, scene.specular, scene.mask & False),
        Scene(*[scene.diffuse * 0] * 2, scene.mask),
    ):
        with pytest.raises(ValueError, match="expected an object that light reaches"):
            expose_to_clip(wrong, 0.01, Layout(), IMX250)


def test_codes_are_the_rounded_truth_plus_the_noise_promised() -> None:
    """Codes are whole numbers up to 4095; their error has mean 0 and the variance of `Sensor.noise_variance`."""
    scene = expose_to_clip(lit_scene(), 0.01, Layout(), IMX250)
    signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)
    codes = capture(scene, Layout(), IMX250, torch.Generator().manual_seed(1)).mosaic.data
    assert torch.equal(codes, codes.round())
    assert 0 <= float(codes.min()) <= float(codes.max()) <= 4095
    usual = (signal > 0.01) & (signal < 0.9)
    error = (codes / 4095 - signal)[usual] / torch.sqrt(IMX250.noise_variance(signal[usual]))
    count = error.numel()
    assert count > 1500
    assert abs(float(error.mean())) < 4 / count**0.5
    assert abs(float(error.var()) - 1) < 4 * (2 / count) ** 0.5
