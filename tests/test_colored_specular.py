"""Specular light in another colour than the lamp's: found where the diffuse image is polarized like highlights."""

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
from polsep.separation.colored_specular import Colored, _measure_periods, color_specular, period_stokes
from polsep.separation.images import FrameImages, Tally

SIZE = 96
#: Polarization of all specular light.
ANGLE = math.radians(25)
LIGHT = (0.3, 1.0, 0.5)
#: A sensor without noise whose analysers are perfect; codes remain.
IDEAL = replace(IMX250, diattenuation=(1.0,) * 3, full_well=math.inf)
GREEN = torch.tensor([0.1, 0.4, 0.2]).view(3, 1, 1)
TURNED = Layout().transposed()
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


def separated(diffuse: Tensor, specular: Tensor, side: int = 2) -> FrameImages:
    """Images of a pixel per ``side`` raw ones as a method gives them that knows them."""
    half = [x[:, ::side, ::side].movedim(0, -1).contiguous().numpy() for x in (diffuse, specular)]
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
        torch.testing.assert_close(image, truth[:, ::4, ::4], rtol=0, atol=1 / 4095)


@pytest.mark.parametrize("metal", ["gold", "copper"])
@pytest.mark.parametrize(("side", "layout"), [(2, Layout()), (1, Layout()), (2, Layout().rolled(-1, -1)), (2, TURNED)])
def test_metal_keeps_its_color(metal: str, side: int, layout: Layout) -> None:
    """A method with white specular light leaves the rest of a metal's in the diffuse image: it is moved, none else.

    At half and at full resolution, and in frames that are cropped inside of a cell or transposed.
    """
    color = torch.tensor(METALS[metal]).view(3, 1, 1)
    place = patch(0.5)
    diffuse, specular = BODY * (1 - place), 0.6 * color * place
    mosaic = expose(scene(diffuse, specular), layout, IDEAL)
    white = specular.amin(dim=0, keepdim=True).expand(3, SIZE, SIZE)
    found, share = color_specular(separated(diffuse + specular - white, white, side), mosaic, (1.0, 1.0, 1.0))
    assert share.share == pytest.approx(0.5, abs=0.08)
    half, edge = SIZE // 2 // side, 8 // side
    before = float((diffuse + specular)[:, ::side, ::side].mean(dim=0).sum())
    gained = float(np.mean(found.diffuse + found.specular, axis=-1).sum()) - before
    assert found.tally is not None and found.tally.s0 == pytest.approx(gained, abs=1e-2)
    more = float(np.mean(found.specular, axis=-1).sum()) - float(white[0, ::side, ::side].sum())
    assert found.tally.specular == pytest.approx(more, abs=1e-2)  # of a tally that began at 0
    inside, outside = slice(edge, half - 2 * edge), slice(half + 2 * edge, None)
    truth = specular[:, ::side, ::side].movedim(0, -1).numpy()
    np.testing.assert_allclose(found.specular[inside], truth[inside], rtol=0.01)
    assert found.diffuse[inside].max() < 1e-6
    assert not found.valid[inside].any() and found.valid[outside].all()
    body = BODY.expand(3, SIZE, SIZE)[:, ::side, ::side].movedim(0, -1).numpy()
    np.testing.assert_allclose(found.diffuse[outside], body[outside], rtol=1e-5)


def test_of_metal_only_what_is_polarized_is_specular() -> None:
    """Where four fifths of a metal's light are polarized, they are its specular light; tensors give the same."""
    color = torch.tensor(METALS["gold"]).view(3, 1, 1).expand(3, SIZE, SIZE)
    mosaic = expose(scene(0.12 * color, 0.48 * color), Layout(), IDEAL)
    white = (0.48 * color).amin(dim=0, keepdim=True).expand(3, SIZE, SIZE)
    images = separated(0.6 * color - white, white)
    found, colored = color_specular(images, mosaic, (1.0, 1.0, 1.0))
    assert colored.share > 0.9
    np.testing.assert_allclose(
        found.specular[8:-8, 8:-8], 0.48 * color[:, 16:-16:2, 16:-16:2].movedim(0, -1), rtol=0.01
    )
    tensors = replace(images, **{name: torch.from_numpy(image) for name, image in images.arrays().items()})
    again, same = color_specular(tensors, mosaic, (1.0, 1.0, 1.0))
    assert same == colored
    for name, image in images.arrays().items():
        np.testing.assert_allclose(np.asarray(getattr(again, name)), getattr(found, name), rtol=1e-5, atol=1e-6)
        assert isinstance(getattr(again, name), torch.Tensor), image.shape


@pytest.mark.parametrize("kept", [0.0, 0.15, 0.3])
def test_bodies_are_left_alone(kept: float) -> None:
    """White highlights on coloured bodies are no metal, nor are bodies that keep some of the lamp's polarization."""
    diffuse, specular = BODY.expand(3, SIZE, SIZE), 0.2 * patch(0.3).expand(3, SIZE, SIZE)
    mosaic = expose(scene(diffuse, specular, kept), Layout(), IDEAL)
    images = separated(diffuse, specular)
    found, share = color_specular(images, mosaic, (1.0, 1.0, 1.0))
    assert found is images and share == Colored()


def test_edges_of_color_are_no_metal() -> None:
    """Cells show one colour each, so edges look coloured in single periods; thin evidence does not count."""
    stripes = (torch.arange(SIZE) // 12 % 2).float().view(1, 1, SIZE).expand(3, SIZE, SIZE)
    diffuse, specular = BODY * stripes + 0.02, 0.3 * (1 - stripes)
    images = separated(diffuse, specular)
    found, share = color_specular(images, expose(scene(diffuse, specular), Layout(), IDEAL), (1.0, 1.0, 1.0))
    assert found is images and share == Colored()


def test_demosaicking_tints_of_highlights_are_no_metal() -> None:
    """A strong white highlight on a dark body, tinted by a twentieth as edges tint, as the diffuse one is."""
    tint = torch.tensor([-0.02, 0.005, 0.015]).view(3, 1, 1)
    diffuse, specular = (0.05 + tint).expand(3, SIZE, SIZE), 0.4 + tint * patch(0.5)
    white = torch.full((3, SIZE, SIZE), 0.4)
    images = separated(diffuse, white)
    found, share = color_specular(images, expose(scene(diffuse, specular), Layout(), IDEAL), (1.0, 1.0, 1.0))
    assert found is images and share == Colored()


def test_the_lamp_is_divided_out() -> None:
    """White specular light of a coloured lamp on green bodies is no metal; reports say the share."""
    lamp = torch.tensor(LIGHT).view(3, 1, 1)
    diffuse, specular = (GREEN * lamp).expand(3, SIZE, SIZE), (0.4 * lamp).expand(3, SIZE, SIZE)
    mosaic = expose(scene(diffuse, specular), Layout(), IDEAL)
    images = separated(diffuse, specular)
    assert color_specular(images, mosaic, LIGHT)[0] is images
    assert color_specular(images, mosaic, (1.0, 1.0, 1.0))[1].share > 0.5
    assert separate_capture(mosaic, light_color=LIGHT).report["colored_specular"] == 0


def test_mono_and_small_frames_are_returned() -> None:
    """Frames without colours, and too small ones, show nothing."""
    images = separated(BODY.expand(3, SIZE, SIZE), BODY.expand(3, SIZE, SIZE))
    for mosaic in (
        Mosaic(torch.ones(SIZE, SIZE), Layout(bayer=None), 0.0, 1.0),
        Mosaic(torch.ones(16, 16), Layout(), 0.0, 1.0),
    ):
        assert color_specular(images, mosaic, (1.0, 1.0, 1.0)) == (images, Colored())


def test_images_stay_over_their_periods_where_a_row_of_cells_is_left() -> None:
    """Of an odd number of cells the last is of no whole period: the others stay where they are."""
    size, kind = 514, torch.float32
    cells = torch.arange(size // 2, dtype=kind).expand(3, size // 2, size // 2)
    mosaic = Mosaic(torch.ones(size, size), Layout(), 0.0, 1.0)
    seen = _measure_periods(mosaic, cells, 0 * cells, Tally(power=1.0, along=1.0))
    expected = 2 * torch.arange(size // 4, dtype=kind) + 0.5
    torch.testing.assert_close(seen.diffuse[0, 0], expected, rtol=0, atol=1e-3)
