"""Diffuse light that keeps the lamp's polarization: found from what all places of a frame have in common."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from test_colored_specular import IDEAL, separated
from tolerances import assert_close
from torch import Tensor

from polsep.compute.averages import weighted_median
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import Layout, expose
from polsep.separation.colored_specular import Colored, color_specular
from polsep.separation.retained_polarization import CAUTION, MIN_SPECULAR, find_densest, find_missing, find_retained

SIDE = 96


def ball(side: int) -> tuple[Tensor, Tensor, Tensor]:
    """Colours ``[3, side, side]`` in patches; polarization of transmitted light on a ball, in two directions."""
    x, y = torch.meshgrid(*[torch.linspace(-0.95, 0.95, side)] * 2, indexing="xy")
    radius = torch.sqrt(x * x + y * y).clamp(max=1)
    degree = 0.25 * radius**4  # like Fresnel transmission: hardly any near the middle
    patches = torch.rand(3, side // 8, side // 8, generator=torch.Generator().manual_seed(1)).mul(0.5).add(0.1)
    colors = patches.repeat_interleave(8, dim=1).repeat_interleave(8, dim=2)
    angle = 2 * torch.atan2(y, x)
    return colors, degree * torch.cos(angle), degree * torch.sin(angle)


def found_in(along: Tensor, across: Tensor, diffuse: Tensor) -> float:
    return find_retained(along.numpy(), across.numpy(), diffuse.numpy())


@pytest.mark.parametrize("share", [0.05, 0.08, 0.12])
@pytest.mark.parametrize("mirrored", [0.0, 0.3])
def test_the_share_is_what_all_places_have_in_common(share: float, mirrored: float) -> None:
    """Whatever the normals, and whatever white light is mirrored."""
    colors, a1, a2 = ball(SIDE)
    found = found_in((a1 + share) * colors + mirrored, a2 * colors, colors)
    assert found == pytest.approx(share - CAUTION, abs=0.01)


def test_transmitted_light_alone_retains_nothing() -> None:
    colors, a1, a2 = ball(SIDE)
    assert found_in(a1 * colors, a2 * colors, colors) == 0


@pytest.mark.parametrize(("first", "second"), [(0.1, 0.0), (0.02, 0.0), (0.06, 0.06)])
def test_one_plane_shows_nothing(first: float, second: float) -> None:
    """A plane's polarization is the same everywhere, so nothing tells its own from the lamp's; nor does a little."""
    colors, _, _ = ball(SIDE)
    assert found_in(first * colors, second * colors, colors) == 0


def test_grey_bodies_show_nothing() -> None:
    _, a1, a2 = ball(SIDE)
    grey = torch.full((3, SIDE, SIDE), 0.4)
    assert found_in((a1 + 0.1) * grey, a2 * grey, grey) == 0


def test_bodies_of_one_hue_show_nothing() -> None:
    """Highlights that are not white, on bodies of their hue, look like retained light."""
    colors, a1, a2 = ball(SIDE)
    skin = torch.tensor([0.6, 0.4, 0.2]).view(3, 1, 1) * colors.mean(dim=0, keepdim=True)
    assert found_in((a1 + 0.1) * skin, a2 * skin, skin) == 0


def test_retained_light_moves_to_the_specular_image() -> None:
    """From the raw frame: diffuse and specular keep their sum, and their ratio is that of the scene."""
    colors, a1, a2 = (x.repeat_interleave(4, dim=-1).repeat_interleave(4, dim=-2) for x in ball(SIDE))
    share, turn = 0.08, 2 * math.radians(25)
    white = torch.full_like(colors, 0.02)
    along, across = (a1 + share) * colors + white, a2 * colors
    s1, s2 = along * math.cos(turn) - across * math.sin(turn), along * math.sin(turn) + across * math.cos(turn)
    images = separated(colors, white)
    mosaic = expose(Stokes(colors + white, s1, s2), Layout(), IDEAL)
    moved, found = color_specular(images, mosaic, (1.0, 1.0, 1.0))
    assert found.retained == pytest.approx(share - CAUTION, abs=0.01) and found.share == 0
    before = torch.from_numpy(images.diffuse), torch.from_numpy(images.specular)
    assert_close(torch.from_numpy(moved.diffuse + moved.specular), before[0] + before[1])
    assert_close(torch.from_numpy(moved.specular), before[1] + found.retained * before[0])
    clean, nothing = color_specular(
        images, expose(Stokes(colors + white, a1 * colors + white, across), Layout(), IDEAL), (1.0, 1.0, 1.0)
    )
    assert clean is images and nothing == Colored()


@pytest.mark.parametrize("taken", [0.0, 0.5, 1.0, 1.5])
def test_no_more_moves_than_the_specular_image_lacks(taken: float) -> None:
    """A method may find a part of retained light itself; together they have the polarized light, not more."""
    colors, _, _ = ball(SIDE)
    share, white = 0.06, 0.3
    light = share * colors.mean(dim=0, keepdim=True)
    along = (share * colors + white).numpy()
    missing = find_missing(along, (taken * light + white).expand_as(colors).numpy(), colors.numpy())
    assert missing == pytest.approx(max(1 - taken, 0) * share, abs=1e-6)


def test_nothing_moves_without_highlights() -> None:
    """The lamp's polarization is that of highlights; of none, it is that of walls which lean one way."""
    colors, _, _ = ball(SIDE)
    dark = 0.5 * MIN_SPECULAR * colors
    assert find_missing((0.05 * colors).numpy(), dark.numpy(), colors.numpy()) == 0


def test_the_densest_point_is_where_most_values_lie() -> None:
    """A cluster of a third of the weight beside a wide cloud, to within the cluster's width over root N."""
    generator = torch.Generator().manual_seed(2)
    cluster = torch.tensor([[0.05], [-0.02]]) + 0.004 * torch.randn(2, 60, generator=generator)
    cloud = 0.15 * torch.randn(2, 120, generator=generator)
    (x, y), part = find_densest(torch.cat([cluster, cloud], dim=1).numpy(), np.ones(180, np.float32))
    assert x == pytest.approx(0.05, abs=0.004) and y == pytest.approx(-0.02, abs=0.004)
    assert 0.2 < part < 0.5


def test_medians_count_weights() -> None:
    values = np.array([3.0, 1.0, 2.0])
    assert weighted_median(values, np.array([1.0, 1.0, 3.0])) == 2
    assert weighted_median(values, np.array([5.0, 1.0, 1.0])) == 3
