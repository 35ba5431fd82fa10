"""Random materials: in range, of the shares that are promised, the same on every machine."""

from __future__ import annotations

import colorsys
import math

import pytest
import torch

from polsep.render.materials import (
    CELL_SIZES,
    DARK_SHARE,
    DARK_VALUES,
    GLOSSY_ROUGHNESS,
    GLOSSY_SHARE,
    GREY_SATURATION,
    GREY_SHARE,
    LONGEST,
    PATTERN_WEIGHTS,
    ROUGHNESS,
    STRENGTH,
    VALUES,
    Materials,
    look_up,
    random_materials,
    rgb_from_hsv,
)
from polsep.render.room import roughen
from polsep.render.textures import pattern_weight

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


def test_second_materials_keep_what_the_first_ones_are(generator: torch.Generator) -> None:
    """Everywhere near-grey slots are near-grey, dark ones dark, glossy ones glossy, and all in range."""
    found = random_materials(COUNT, generator)
    slot = torch.arange(COUNT).repeat_interleave(4)
    albedo, roughness, specular = look_up(found, slot, 5 * torch.randn(3, 4 * COUNT, 1, generator=generator))
    value, least = albedo.amax(dim=0)[:, 0], albedo.amin(dim=0)[:, 0]
    first, first_least = found.albedo.amax(dim=1)[slot], found.albedo.amin(dim=1)[slot]
    assert float(least.min()) >= 0 and float(value.max()) <= VALUES[1] + 1e-6
    grey = (first - first_least) / first <= GREY_SATURATION
    assert float(((value - least) / value)[grey].max()) <= 1.2 * GREY_SATURATION
    assert float(value[first <= DARK_VALUES[1]].max()) <= DARK_VALUES[1] + 1e-6
    glossy = found.roughness[slot] < GLOSSY_ROUGHNESS[1]
    assert float(roughness[0, glossy].max()) <= GLOSSY_ROUGHNESS[1] + 1e-6
    assert float(roughness.min()) >= GLOSSY_ROUGHNESS[0] - 1e-6 and float(roughness.max()) <= ROUGHNESS[1] + 1e-6
    torch.testing.assert_close(specular[0, :, 0], found.specular[slot], rtol=0, atol=0)


def test_looked_up_materials_lie_between_the_two(generator: torch.Generator) -> None:
    """Weight 0 is the first material and weight 1 the second, in albedo and roughness alike."""
    found = random_materials(50, generator)
    assert found.textures is not None
    slot, position = torch.randint(50, (2000,), generator=generator), torch.randn(3, 2000, 1, generator=generator)
    weight = pattern_weight(found.textures, slot, position)
    albedo, roughness, _ = look_up(found, slot, position)
    first, second = found.albedo[slot].T[..., None], found.textures.albedo[slot].T[..., None]
    torch.testing.assert_close(albedo, (1 - weight) * first + weight * second, rtol=0, atol=1e-6)
    first, second = found.roughness[slot][None, :, None], found.textures.roughness[slot][None, :, None]
    torch.testing.assert_close(roughness, (1 - weight) * first + weight * second, rtol=0, atol=1e-6)


def test_plain_materials_are_the_same_everywhere(generator: torch.Generator) -> None:
    """Without textures positions do not matter."""
    materials = Materials(torch.rand(3, 3), torch.tensor([0.2, 0.3, 0.4]), torch.tensor([0.5, 0.6, 0.7]))
    albedo, roughness, specular = look_up(materials, torch.tensor([2, 0]), torch.randn(3, 2, 1, generator=generator))
    assert albedo.shape == (3, 2, 1)
    torch.testing.assert_close(albedo[..., 0].T, materials.albedo[[2, 0]])
    torch.testing.assert_close(roughness.flatten(), torch.tensor([0.4, 0.2]))
    torch.testing.assert_close(specular.flatten(), torch.tensor([0.7, 0.5]))


def test_patterns_come_as_often_as_said_and_scale_with_the_object(generator: torch.Generator) -> None:
    """Shares within five standard errors; a cell is between a share of the object and that times its elongation."""
    size = 0.2
    textures = random_materials(COUNT, generator, size).textures
    assert textures is not None
    for pattern, weight in enumerate(PATTERN_WEIGHTS):
        share = weight / sum(PATTERN_WEIGHTS)
        found = float((textures.pattern == pattern).float().mean())
        assert abs(found - share) < 5 * math.sqrt(share * (1 - share) / COUNT)
    cells = 1 / textures.transform[:, :, :3].norm(dim=2)
    assert float(cells.min()) >= CELL_SIZES[0] * size * 0.999
    assert float(cells.max()) <= CELL_SIZES[1] * LONGEST * size * 1.001
    axes = textures.transform[:, :, :3] * cells[..., None]
    torch.testing.assert_close(axes @ axes.mT, torch.eye(3).expand_as(axes), rtol=0, atol=1e-5)
    torch.testing.assert_close(torch.linalg.det(axes), torch.ones(COUNT), rtol=0, atol=1e-5)


def test_counts_must_agree() -> None:
    """One roughness and one strength per albedo."""
    with pytest.raises(ValueError, match=r"expected albedo \[S, 3\]"):
        Materials(torch.ones(2, 3), torch.ones(3), torch.ones(3))
    textured = random_materials(2, torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match="expected textures of 3 slots, found 2"):
        Materials(torch.ones(3, 3), torch.ones(3), torch.ones(3), textured.textures)


def test_roughened_materials_are_rough_everywhere() -> None:
    """Also where a texture mixes in its second material; those that were rougher stay."""
    before = random_materials(40, torch.Generator().manual_seed(2))
    after = roughen(before, 0.5)
    assert before.textures is not None and after.textures is not None
    for old, new in ((before, after), (before.textures, after.textures)):
        assert torch.equal(new.roughness, torch.where(old.roughness < 0.5, 0.5, old.roughness))
        assert torch.equal(new.albedo, old.albedo)
