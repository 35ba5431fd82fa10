"""Specular light in another colour than the lamp's: found where the diffuse image is polarized like mirror images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from polsep.physics.stokes import Stokes
from polsep.pipeline import separate_capture
from polsep.render.disturbances import METALS
from polsep.sensor.camera import IMX250, Layout, Mosaic, expose
from polsep.separation.colored_specular import color_specular, period_stokes
from polsep.separation.images import FrameImages, Tally

SIZE = 96
#: Polarization of all specular light.
ANGLE = math.radians(25)
LIGHT = (0.7, 1.0, 0.8)
#: A sensor with noise whose analysers are perfect.
IDEAL = replace(IMX250, diattenuation=(1.0,) * 3)
BODY = torch.tensor([0.5, 0.2, 0.1]).view(3, 1, 1)


def patch(share: float) -> Tensor:
    """1 in the first rows of a frame."""
    mask = torch.zeros(1, SIZE, SIZE)
    mask[:, : int(share * SIZE)] = 1
    return mask


def scene(diffuse: Tensor, specular: Tensor, kept: float = 0.0) -> Stokes:
    """Light of images ``[3, H, W]``; ``kept``: part of the diffuse light with the polarization of the specular one."""
    polarized = specular + kept * diffuse
    return Stokes(diffuse + specular, polarized * math.cos(2 * ANGLE), polarized * math.sin(2 * ANGLE))


def separated(diffuse: Tensor, specular: Tensor) -> FrameImages:
    """Images at half resolution as a method gives them that knows them."""
    half = [x[:, ::2, ::2].movedim(0, -1).contiguous().numpy() for x in (diffuse, specular)]
    length = float(specular.sum()) + 1
    tally = Tally(power=length, along=length * math.cos(2 * ANGLE), across=length * math.sin(2 * ANGLE))
    valid = np.ones(half[0].shape[:2], np.bool_)
    return FrameImages(half[0], half[1], valid, tally=tally)


@pytest.mark.parametrize("layout", [Layout(), Layout().rolled(0, 2), Layout().transposed()])
def test_stokes_of_periods_are_right_in_even_light(layout: Layout) -> None:
    """In even light periods show all Stokes images of all colours, in any order of filters."""
    light = scene(BODY.expand(3, SIZE, SIZE), 0.3 * BODY.expand(3, SIZE, SIZE))
    found = period_stokes(Mosaic(expose(light, layout, IDEAL).data, layout, 0.0, 4095.0))
    for image, truth in zip((found.s0, found.s1, found.s2), (light.s0, light.s1, light.s2), strict=True):
        torch.testing.assert_close(image.mean(dim=(1, 2)), truth[:, 0, 0], rtol=3e-3, atol=1e-3)


@pytest.mark.parametrize("metal", ["gold", "copper"])
def test_metal_keeps_its_color(metal: str) -> None:
    """A method with white specular light leaves the rest of a metal's in the diffuse image: it is moved, none else."""
    color = torch.tensor(METALS[metal]).view(3, 1, 1)
    place = patch(0.5)
    diffuse, specular = BODY * (1 - place), 0.6 * color * place
    mosaic = expose(scene(diffuse, specular), Layout(), IDEAL)
    white = specular.amin(dim=0, keepdim=True).expand(3, SIZE, SIZE)
    found, share = color_specular(separated(diffuse + specular - white, white), mosaic, (1.0, 1.0, 1.0))
    assert share == pytest.approx(0.5, abs=0.08)
    inside = slice(2, SIZE // 4 - 4)
    truth = specular[:, ::2, ::2].movedim(0, -1).numpy()
    np.testing.assert_allclose(found.specular[inside], truth[inside], rtol=0.06)  # noise of single periods
    assert found.diffuse[inside].mean() < 1e-3
    body = BODY.expand(3, SIZE, SIZE)[:, ::2, ::2].movedim(0, -1).numpy()
    np.testing.assert_allclose(found.diffuse[SIZE // 4 + 4 :], body[SIZE // 4 + 4 :], rtol=1e-5)


@pytest.mark.parametrize("kept", [0.0, 0.15, 0.3])
def test_bodies_are_left_alone(kept: float) -> None:
    """White highlights on coloured bodies are no metal, nor are bodies that keep some of the lamp's polarization."""
    diffuse, specular = BODY.expand(3, SIZE, SIZE), 0.2 * patch(0.3).expand(3, SIZE, SIZE)
    mosaic = expose(scene(diffuse, specular, kept), Layout(), IDEAL)
    images = separated(diffuse, specular)
    found, share = color_specular(images, mosaic, (1.0, 1.0, 1.0))
    assert found is images and share == 0


def test_edges_of_color_are_no_metal() -> None:
    """Cells show one colour each, so edges look coloured in single periods; thin evidence does not count."""
    stripes = (torch.arange(SIZE) // 12 % 2).float().view(1, 1, SIZE).expand(3, SIZE, SIZE)
    diffuse, specular = BODY * stripes + 0.02, 0.3 * (1 - stripes)
    images = separated(diffuse, specular)
    found, share = color_specular(images, expose(scene(diffuse, specular), Layout(), IDEAL), (1.0, 1.0, 1.0))
    assert found is images and share == 0


def test_the_lamp_is_divided_out() -> None:
    """White specular light of a coloured lamp is no metal; reports say the share."""
    lamp = torch.tensor(LIGHT).view(3, 1, 1)
    diffuse, specular = lamp * BODY.expand(3, SIZE, SIZE), lamp * 0.2 * patch(0.3)
    mosaic = expose(scene(diffuse, specular), Layout(), IDEAL)
    images = separated(diffuse, specular)
    assert color_specular(images, mosaic, LIGHT)[0] is images
    assert separate_capture(mosaic, light_color=LIGHT).report["colored_specular"] == 0


def test_mono_and_small_frames_are_returned() -> None:
    """Frames without colours, and frames without windows, show nothing."""
    images = separated(BODY.expand(3, SIZE, SIZE), BODY.expand(3, SIZE, SIZE))
    for mosaic in (
        Mosaic(torch.ones(SIZE, SIZE), Layout(bayer=None), 0.0, 1.0),
        Mosaic(torch.ones(16, 16), Layout(), 0.0, 1.0),
    ):
        assert color_specular(images, mosaic, (1.0, 1.0, 1.0)) == (images, 0.0)
