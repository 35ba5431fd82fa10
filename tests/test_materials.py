"""Random materials: in range, of the shares that are promised, the same on every machine."""

from __future__ import annotations

import colorsys
import math

import pytest
import torch

from polsep.materials import (
    DARK_SHARE,
    DARK_VALUES,
    GLOSSY_ROUGHNESS,
    GLOSSY_SHARE,
    GREY_SATURATION,
    GREY_SHARE,
    ROUGHNESS,
    STRENGTH,
    Materials,
    random_materials,
    rgb_from_hsv,
)

COUNT = 4000


def test_shares_and_ranges(generator: torch.Generator) -> None:
    """Near-grey, dark and glossy slots come as often as said, within five standard errors; nothing leaves its range."""
    found = random_materials(COUNT, generator)
    value, least = found.albedo.amax(dim=1), found.albedo.amin(dim=1)
    assert float(least.min()) >= 0 and float(value.max()) <= 1
    for share, special in (
        (GREY_SHARE, (value - least) / value <= GREY_SATURATION + 1e-6),
        (DARK_SHARE, value <= DARK_VALUES[1] + 1e-6),
        (GLOSSY_SHARE, found.roughness < GLOSSY_ROUGHNESS[1]),
    ):
        assert abs(float(special.float().mean()) - share) < 5 * math.sqrt(share * (1 - share) / COUNT)
    assert float(found.roughness.min()) >= GLOSSY_ROUGHNESS[0] and float(found.roughness.max()) <= ROUGHNESS[1]
    assert float(found.specular.min()) >= STRENGTH[0] and float(found.specular.max()) <= STRENGTH[1]


def test_materials_repeat() -> None:
    """One seed, one set of materials."""
    first, again, other = (random_materials(5, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    torch.testing.assert_close(first.albedo, again.albedo, rtol=0, atol=0)
    torch.testing.assert_close(first.roughness, again.roughness, rtol=0, atol=0)
    assert not torch.equal(first.albedo, other.albedo)


def test_colours_are_those_of_colorsys(generator: torch.Generator) -> None:
    """Hue, saturation and value as in the standard library."""
    hsv = torch.rand(50, 3, generator=generator)
    expected = torch.tensor([colorsys.hsv_to_rgb(*color) for color in hsv.tolist()])
    torch.testing.assert_close(rgb_from_hsv(*hsv.T), expected, rtol=0, atol=1e-6)


def test_counts_must_agree() -> None:
    """One roughness and one strength per albedo."""
    with pytest.raises(ValueError, match=r"expected albedo \[S, 3\]"):
        Materials(torch.ones(2, 3), torch.ones(3), torch.ones(3))
