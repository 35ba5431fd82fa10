"""Laws of demosaicking with an intensity guide."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half, fill_colors, guide_once
from polsep.physics.stokes import Measurements, Stokes, fit_stokes, flip_horizontal, flip_vertical, transpose
from polsep.render.distances import random_light, random_parts
from polsep.render.sphere_tracing import PinholeCamera, render
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, expose
from polsep.separation.analytic import separate_analytic

LAYOUTS = [
    Layout(),
    Layout(((0, 45), (90, 135)), "GBRG"),
    Layout(((45, 0), (90, 135)), "BGGR"),
    Layout(bayer=None),
    Layout(origin=(1, 1)),
]


#: Both resolutions, each with what it makes of an image of the scene.
DEMOSAICKERS = [
    pytest.param(demosaic_guided_half, lambda x: avg_pool2d(x, 2), id="half"),
    pytest.param(demosaic_guided, lambda x: x, id="full"),
]
Demosaicker = Callable[[Mosaic], Measurements]
#: Away from the border of a frame of 108 cells.
INSIDE = (..., slice(40, -40), slice(40, -40))
Reduced = Callable[[Tensor], Tensor]


def textured(channels: int, seed: int = 0, size: int = 64) -> Stokes:
    """A smooth random s0 of each colour with some polarization, ``[C, size, size]``."""
    generator = torch.Generator().manual_seed(seed)

    def smooth(low: float, high: float) -> Tensor:
        coarse = torch.rand(1, channels, size // 8, size // 8, generator=generator)
        fine = torch.nn.functional.interpolate(coarse, size=(size, size), mode="bicubic", align_corners=False)[0]
        return low + (high - low) * fine

    return Stokes(smooth(0.5, 1.4), smooth(-0.2, 0.2), smooth(-0.2, 0.2))


@pytest.mark.parametrize(("demosaic", "reduced"), DEMOSAICKERS)
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
def test_uniform_field_is_exact_to_the_border(layout: Layout, demosaic: Demosaicker, reduced: Reduced) -> None:
    """One polarized state everywhere comes out exactly, in every pixel and colour."""
    level = torch.tensor([1.0, 0.7, 0.5])[: layout.channels, None, None]
    truth = Stokes(*((level * k).expand(-1, 34, 38) for k in (1.0, 0.3, -0.2)))
    found = fit_stokes(demosaic(expose(truth, layout, IDEAL)))
    for name in ("s0", "s1", "s2"):
        expected = getattr(truth, name)[:, :1, :1].expand_as(getattr(found, name))
        torch.testing.assert_close(getattr(found, name), expected, rtol=0, atol=2e-6)


@pytest.mark.parametrize(("demosaic", "reduced"), DEMOSAICKERS)
@pytest.mark.parametrize("layout", [Layout(), Layout(bayer=None)], ids=lambda layout: layout.spec)
def test_linear_fields_are_exact_inside(layout: Layout, demosaic: Demosaicker, reduced: Reduced) -> None:
    """s0, s1 and s2 that grow linearly, each colour with its own slope, come out exactly away from the border."""
    rows, cols = torch.meshgrid(torch.arange(224.0), torch.arange(224.0), indexing="ij")
    level = torch.tensor([1.0, 0.8, 0.6])[: layout.channels, None, None]
    ramp = (rows + 0.5 * cols).double() * level.double()
    truth = Stokes(0.3 + 0.004 * ramp, 0.1 + 0.0005 * ramp, -0.05 + 0.0003 * ramp)
    found = fit_stokes(demosaic(expose(truth, layout, IDEAL)))
    reach = 88 * found.s0.shape[-1] // 224  # of both rounds together
    inside = (slice(None), slice(reach, -reach), slice(reach, -reach))
    for name in ("s0", "s1", "s2"):
        expected = reduced(getattr(truth, name))
        torch.testing.assert_close(getattr(found, name)[inside], expected[inside], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("flip", "turned"),
    [
        (flip_horizontal, lambda layout: layout.flipped_horizontal(64)),
        (flip_vertical, lambda layout: layout.flipped_vertical(64)),
        (transpose, lambda layout: layout.transposed()),
    ],
)
@pytest.mark.parametrize(("demosaic", "reduced"), DEMOSAICKERS)
@pytest.mark.parametrize("layout", [Layout(), Layout(bayer=None)], ids=lambda layout: layout.spec)
def test_mirrored_scenes_give_mirrored_images(flip, turned, layout: Layout, demosaic, reduced) -> None:  # type: ignore[no-untyped-def]
    """Mirroring the scene and the layout mirrors the result, with the sign rules of s1 and s2."""
    scene = textured(layout.channels).map(Tensor.double)
    straight = flip(fit_stokes(demosaic(expose(scene, layout, IDEAL))))
    mirrored = fit_stokes(demosaic(expose(flip(scene), turned(layout), IDEAL)))
    for name in ("s0", "s1", "s2"):
        torch.testing.assert_close(getattr(mirrored, name), getattr(straight, name), rtol=0, atol=1e-9)


@pytest.mark.parametrize("along", [-1, -2])
@pytest.mark.parametrize("ninths", [2, 3, 4, 5, 6])
def test_false_polarization_of_texture_is_that_of_a_guide_of_gain_1_8(ninths: int, along: int) -> None:
    """A grating of unpolarized light, w = k pi / 9 per pixel: the tent (1, 2, 1) / 4 passes T = (1 + cos w) / 2 of it.

    The guide is T + 1.8 T (1 - T), so the samples minus the guide keep (1 - T)(1 - 1.8 T) of the texture, and with it
    the same share of the false polarization that bilinear interpolation shows. Windows of nine cells hold whole waves.
    """
    frequency = math.pi * ninths / 9
    wave = 0.5 + 0.3 * torch.cos(frequency * torch.arange(216.0) + 0.4)
    samples = (wave if along == -1 else wave[:, None]).expand(216, 216) / 2
    mosaic = Mosaic(samples.contiguous(), Layout(bayer=None), 0, 1)
    found = guide_once(mosaic)[0]
    plain = fit_stokes(demosaic_bilinear_half(mosaic)).map(gently_blurred)
    passed = (1 + math.cos(frequency)) / 2
    share = (1 - passed) * (1 - 1.8 * passed)
    for guided, bilinear in ((found.s1, plain.s1), (found.s2, plain.s2)):
        assert float(bilinear[INSIDE].abs().max()) > 5e-3
        torch.testing.assert_close(guided[INSIDE], share * bilinear[INSIDE], rtol=0, atol=1e-5)


def gently_blurred(image: Tensor) -> Tensor:
    """Behind (1, 6, 1) / 8 along rows and columns of cells, the last filter of the guided demosaicker."""
    for dim in (-1, -2):
        image = 0.75 * image + 0.125 * (image.roll(1, dim) + image.roll(-1, dim))
    return image


def test_samples_of_a_colour_stay() -> None:
    """s0 of its own colour is never changed at a pixel, whatever its neighbours say."""
    mosaic = torch.rand(32, 32, generator=torch.Generator().manual_seed(1))
    filled = fill_colors(mosaic, Layout())
    for place, color in enumerate((0, 1, 1, 2)):
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            at = (slice(place // 2 * 2 + i, None, 4), slice(place % 2 * 2 + j, None, 4))
            torch.testing.assert_close(filled[color][at], mosaic[at], rtol=0, atol=0)


def test_grey_texture_is_filled_from_every_pixel() -> None:
    """Where all colours are equal, each one is known at every pixel: far closer to the truth than bilinear."""
    truth = textured(1, seed=3).s0.expand(3, -1, -1) + 0.1 * torch.sin(torch.arange(64) * 0.65)
    colors = torch.tensor([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 2, 2], [1, 1, 2, 2]]).repeat(16, 16)
    filled = fill_colors(torch.gather(truth, 0, colors[None])[0], Layout())
    assert float((filled - truth)[:, 8:-8, 8:-8].abs().mean()) < 0.01


def test_a_colour_never_ends_at_zero() -> None:
    """Beside a black edge the linear function of green would leave red at or below zero; it keeps a share instead."""
    step = torch.zeros(64, 64)
    step[:, 32:] = 1
    truth = torch.stack([0.02 + 0.9 * step, 0.3 + 0.6 * step, 0.02 + 0.1 * (1 - step)])
    colors = torch.tensor([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 2, 2], [1, 1, 2, 2]]).repeat(16, 16)
    assert float(fill_colors(torch.gather(truth, 0, colors[None])[0], Layout())[[0, 2]].min()) > 0


def test_colors_of_any_order_are_permuted_alike() -> None:
    """Red and blue are treated alike: swapping them in the scene and in the layout swaps them in the result."""
    scene = textured(3, seed=5)
    swapped = Stokes(scene.s0.flip(0), scene.s1.flip(0), scene.s2.flip(0))
    one = demosaic_guided_half(expose(scene, Layout(), IDEAL)).data
    other = demosaic_guided_half(expose(swapped, Layout(bayer="BGGR"), IDEAL)).data
    torch.testing.assert_close(other.flip(-3), one, rtol=0, atol=2e-5)


def test_frames_of_a_batch_are_independent() -> None:
    """A batch gives what its frames give alone."""
    frames = torch.stack([expose(textured(3, seed=k), Layout(), IDEAL).data for k in (6, 7)])
    both = demosaic_guided_half(Mosaic(frames, Layout(), 0, 1)).data
    for k in (0, 1):
        torch.testing.assert_close(
            both[k], demosaic_guided_half(Mosaic(frames[k], Layout(), 0, 1)).data, rtol=0, atol=1e-6
        )


@pytest.mark.parametrize("size", [(4, 4), (8, 12), (16, 16), (18, 22)])
def test_small_frames(size: tuple[int, int]) -> None:
    """Every size that a mosaic may have gives finite images of half the size."""
    data = torch.rand(*size, generator=torch.Generator().manual_seed(8))
    found = demosaic_guided_half(Mosaic(data, Layout(), 0, 1)).data
    assert found.shape == (4, 3, size[0] // 2, size[1] // 2)
    assert bool(found.isfinite().all())


def test_clipped_pixels_keep_the_bilinear_samples() -> None:
    """Masks are those of the bilinear demosaicker, and so are the samples under them."""
    scene = textured(3, seed=9) * 1.6
    mosaic = expose(scene, Layout(), IDEAL)
    plain, guided = demosaic_bilinear_half(mosaic), demosaic_guided_half(mosaic)
    assert plain.clipped is not None and guided.clipped is not None
    assert 0.01 < float(plain.clipped.float().mean()) < 0.9
    torch.testing.assert_close(guided.clipped, plain.clipped)
    touched = plain.clipped.any(dim=0).any(dim=0)
    torch.testing.assert_close(guided.data[:, :, touched], plain.data[:, :, touched])


@pytest.mark.parametrize("seed", [11, 12])
def test_sharper_than_bilinear_on_noisy_captures(seed: int) -> None:
    """On rendered objects with sensor noise, s0 gains 3 dB and polarization 0.5 dB at least on bilinear."""
    generator = torch.Generator().manual_seed(seed)
    diffuse, specular = render(
        random_parts(generator, 3, 0.6), PinholeCamera((0, 0, 8), (0, 0, 0), 24), random_light(generator), (192, 192), 2
    )
    scene = (diffuse + specular) * (0.5 / float((diffuse + specular).s0.mean()))
    mosaic = expose(scene, Layout(), IMX250, generator)
    plain, guided = demosaic_bilinear_half(mosaic), demosaic_guided_half(mosaic)
    assert plain.clipped is not None
    lit = (avg_pool2d(scene.s0, 2).amax(0) > 0.05) & ~plain.clipped.any(dim=0).any(dim=0)

    def decibels(name: str) -> float:
        truth = avg_pool2d(getattr(scene, name), 2)
        errors = [((getattr(fit_stokes(m), name) - truth) ** 2).mean(0)[lit].mean() for m in (plain, guided)]
        return float(10 * torch.log10(errors[0] / errors[1]))

    assert decibels("s0") > 3
    assert decibels("s1") > 0.5 and decibels("s2") > 0.5
    assert separate_analytic(guided).diffuse.shape == plain.data.shape[1:]
