"""Disturbances of light and samples: neutral ones change nothing, energy is kept, truth is what the module says."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch

from polsep.physics.stokes import Stokes, aolp, dolp
from polsep.render.disturbances import (
    METALS,
    IndirectLight,
    add_indirect_light,
    add_scenes,
    add_veiling_glare,
    as_color,
    depolarize_lamp,
    make_metal,
    random_field,
    retain_polarization,
    scale_light,
    shift_colors,
    specular_angle,
)
from polsep.render.room import Around, as_room, even_directions, light_from_around
from polsep.render.sphere_tracing import PointLight, Scene

SIZE = (24, 32)


def lit_scene(batch: tuple[int, ...] = (), seed: int = 0) -> Scene:
    """Smooth coloured diffuse light, a white specular lobe at one AoLP per crop, a mask."""
    generator = torch.Generator().manual_seed(seed)
    d = random_field((*batch, 3, *SIZE), 5, 0.8, generator)
    lobe = random_field((*batch, 1, *SIZE), 4, 0.9, generator).clamp(min=0) ** 3
    s = lobe.expand_as(d)
    angle = 2 * math.pi * torch.rand(*batch, 1, 1, 1, generator=generator)
    mask = torch.zeros(*batch, *SIZE, dtype=torch.bool)
    mask[..., 4:20, 4:28] = True
    return Scene(Stokes(d, 0.1 * d, -0.05 * d), Stokes(s, s * angle.cos(), s * angle.sin()), mask)


def assert_same(found: Scene, expected: Scene) -> None:
    for a, b in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        for name in ("s0", "s1", "s2"):
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-5, atol=1e-6)
    assert torch.equal(found.mask, expected.mask)


NEUTRAL: dict[str, Callable[[Scene], Scene]] = {
    "exposure": lambda scene: scale_light(scene, 1.0),
    "polarizer": lambda scene: depolarize_lamp(scene, 1.0),
    "polarizer, crossed": lambda scene: depolarize_lamp(scene, 1.0, lit_scene(scene.mask.shape[:-2], 5)),
    "retention": lambda scene: retain_polarization(scene, 0.0),
    "indirect": lambda scene: add_indirect_light(scene, IndirectLight(0.0, 0.0, as_color((1, 0, 0)))),
    "metal": lambda scene: make_metal(scene, torch.zeros(1, *SIZE), as_color(METALS["gold"])),
    "glare": lambda scene: add_veiling_glare(scene, 0.0),
    "chromatic aberration": lambda scene: shift_colors(scene, 0.0, 0.0),
}

#: The same disturbances at work, with one number per crop where they accept one.
ACTIVE: dict[str, Callable[[Scene, torch.Tensor], Scene]] = {
    "exposure": scale_light,
    "polarizer": depolarize_lamp,
    "retention": lambda scene, x: retain_polarization(scene, 0.1 * x, 0.5),
    "indirect": lambda scene, x: add_indirect_light(scene, IndirectLight(x, 0.2 * x, as_color((1, 0.2, 0)), lamp=0.3)),
    "metal": lambda scene, x: make_metal(scene, (x > 0.5).float(), as_color(METALS["copper"])),
    "glare": lambda scene, x: add_veiling_glare(scene, 0.1 * x),
    "chromatic aberration": lambda scene, _: shift_colors(scene, 0.01, -0.01),
}


@pytest.mark.parametrize("name", NEUTRAL)
def test_neutral_arguments_change_nothing(name: str) -> None:
    """Of a frame and of a batch of crops."""
    for batch in ((), (2,)):
        scene = lit_scene(batch)
        assert_same(NEUTRAL[name](scene), scene)


@pytest.mark.parametrize("name", ACTIVE)
def test_crops_of_a_batch_do_not_know_each_other(name: str) -> None:
    """Each comes out as alone, with its own number."""
    scene, numbers = lit_scene((2,)), torch.tensor([0.3, 0.9]).view(2, 1, 1, 1)
    whole = ACTIVE[name](scene, numbers)
    for k in range(2):
        one = Scene(scene.diffuse.map(lambda s, k=k: s[k]), scene.specular.map(lambda s, k=k: s[k]), scene.mask[k])
        found = Scene(whole.diffuse.map(lambda s, k=k: s[k]), whole.specular.map(lambda s, k=k: s[k]), whole.mask[k])
        assert_same(found, ACTIVE[name](one, numbers[k]))


@pytest.mark.parametrize("name", ACTIVE)
def test_disturbances_scale_with_the_exposure(name: str) -> None:
    """Light is linear: twice the light gives twice the disturbed light."""
    scene, number = lit_scene(), torch.tensor(0.7).view(1, 1, 1)
    assert_same(ACTIVE[name](scale_light(scene, 2.0), number), scale_light(ACTIVE[name](scene, number), 2.0))


@pytest.mark.parametrize("name", ACTIVE)
def test_light_stays_physical(name: str) -> None:
    """No light is more than fully polarized or negative."""
    found = ACTIVE[name](lit_scene(), torch.tensor(0.7).view(1, 1, 1))
    for light in (found.diffuse, found.specular):
        inside = light.map(lambda s: s[:, 4:20, 4:28])
        assert float(inside.s0.min()) >= 0
        assert float(dolp(inside).max()) <= 1 + 1e-4


def test_retention_moves_light() -> None:
    """Diffuse plus specular stays, and what moved is fully polarized along the highlights."""
    scene = lit_scene()
    found = retain_polarization(scene, 0.05)
    torch.testing.assert_close((found.diffuse + found.specular).s0, (scene.diffuse + scene.specular).s0)
    moved = Stokes(*(getattr(found.specular, s) - getattr(scene.specular, s) for s in ("s0", "s1", "s2")))
    torch.testing.assert_close(moved.s0, 0.05 * scene.diffuse.s0, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(dolp(moved), torch.ones_like(moved.s0), rtol=1e-3, atol=1e-3)
    expected = torch.remainder(specular_angle(scene), math.pi).expand_as(moved.s0)
    assert float(torch.sin(aolp(moved) - expected).abs().max()) < 1e-2


def test_room_light_has_its_share_and_is_all_diffuse() -> None:
    """The diffusely reflected part has its share of the lamp's on the mask; the specular part stays polarized."""
    lamp, around = lit_scene(), lit_scene(seed=3)
    room = as_room(around, lamp, 0.3, 1.0)
    gain = 0.3 * lamp.diffuse.s0[:, lamp.mask].mean() / around.diffuse.s0[:, lamp.mask].mean()
    assert_same(room, Scene((around.diffuse + around.specular) * gain, around.specular * 0.0, lamp.mask))
    tinted = as_room(around, lamp, 0.3, as_color((0.8, 1.0, 1.2)))
    assert_same(tinted, scale_light(room, as_color((0.8, 1.0, 1.2))))


def test_light_from_around_is_unpolarized_and_falls_evenly() -> None:
    """Every direction is lit from its distance with its strength, by light of all polarizations in equal parts."""
    lights: list[PointLight] = []

    def light_by(light: PointLight) -> Scene:
        lights.append(light)
        one = torch.full((1, 2, 2), light.intensity)
        angle = 2 * light.polarizer
        arriving = Stokes(one, one * math.cos(angle), one * math.sin(angle))
        return Scene(arriving, arriving * 0.04, one[0] > 0)

    directions, strengths = even_directions(64), 1 + torch.arange(64) / 64
    found = light_from_around(light_by, Around(directions, strengths, 5.0))
    torch.testing.assert_close(found.diffuse.s0, torch.full((1, 2, 2), 2 * 25 * float(strengths.sum())))
    torch.testing.assert_close(dolp(found.diffuse), torch.zeros(1, 2, 2), rtol=0, atol=1e-6)
    places = torch.tensor([light.position for light in lights])
    torch.testing.assert_close(places.norm(dim=1), torch.full((128,), 5.0), rtol=1e-5, atol=0)
    assert float(directions.mean(dim=0).norm()) < 0.01


def test_unpolarized_lamp_is_the_mean_of_two() -> None:
    """Degree 0 is half the light of each of two lamps with crossed polarizers; both lamps at once is their sum."""
    scene, crossed = lit_scene(), lit_scene(seed=3)
    assert_same(depolarize_lamp(scene, 0.0, crossed), scale_light(add_scenes(scene, crossed), 0.5))
    shrunk = depolarize_lamp(scene, 0.8)
    assert torch.equal(shrunk.specular.s0, scene.specular.s0)
    lit = scene.specular.s0 > 1e-3
    torch.testing.assert_close(dolp(shrunk.specular)[lit], torch.full_like(dolp(shrunk.specular)[lit], 0.8))


def test_indirect_light_is_of_the_lamp_only_where_it_kept_its_polarization() -> None:
    """The specular gains the kept share alone, turned by the angle given."""
    scene = lit_scene()
    light = IndirectLight(0.2, 0.1, as_color((1.0, 0.3, 0.1)), lamp=0.4, turn=0.3)
    found = add_indirect_light(scene, light)
    mean = scene.diffuse.s0[:, scene.mask].mean()
    more = found.specular.s0 - scene.specular.s0
    assert float(more[:, scene.mask].mean() / mean) == pytest.approx(0.04, rel=1e-3)
    assert float((found.diffuse.s0 - scene.diffuse.s0)[:, scene.mask].mean() / mean) == pytest.approx(0.26, rel=1e-3)
    gained = Stokes(*(getattr(found.specular, s) - getattr(scene.specular, s) for s in ("s0", "s1", "s2")))
    angle = aolp(gained)[:, scene.mask] - specular_angle(scene)[:, 0] - 0.3
    assert float(torch.sin(angle).abs().max()) < 1e-2


def test_metal_has_no_diffuse_light_and_its_colour() -> None:
    """The ratio of its colours is that of the reflectance; elsewhere nothing changes."""
    scene, metal = lit_scene(), torch.zeros(1, *SIZE)
    metal[:, :, 16:] = 1
    found = make_metal(scene, metal, as_color(METALS["gold"]))
    assert float(found.diffuse.s0[..., 16:].abs().max()) == 0
    expected = 25 * torch.tensor(METALS["gold"])[:, None, None] * scene.specular.s0[..., 16:]
    torch.testing.assert_close(found.specular.s0[..., 16:], expected)
    assert torch.equal(found.diffuse.s0[..., :16], scene.diffuse.s0[..., :16])


def test_glare_keeps_the_light_of_a_frame() -> None:
    """It only spreads."""
    scene = lit_scene()
    found = add_veiling_glare(scene, 0.1)
    torch.testing.assert_close(found.diffuse.s1.mean(), scene.diffuse.s1.mean())
    assert float(found.specular.s0.min()) > float(scene.specular.s0.min())


def test_chromatic_aberration_magnifies_red_and_leaves_green() -> None:
    """A dot off the middle moves outward by its share of the distance."""
    dot = torch.zeros(3, *SIZE)
    rows, cols = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    dot[:] = torch.exp(-((rows - 11.5) ** 2 + (cols - 25.5) ** 2) / 8)
    light = Stokes(dot, 0 * dot, 0 * dot)
    found = shift_colors(Scene(light, light, torch.ones(SIZE, dtype=torch.bool)), 0.05, 0.0).diffuse.s0
    middle = (found * cols).sum(dim=(1, 2)) / found.sum(dim=(1, 2))
    assert float(middle[0] - middle[1]) == pytest.approx(0.05 * 10, abs=0.05)
    assert torch.equal(found[1:], dot[1:])


def test_random_fields_are_in_range() -> None:
    """Fields have the mean 1 and their contrast."""
    field = random_field((2, 1, *SIZE), 4, 0.5, torch.Generator().manual_seed(1))
    torch.testing.assert_close(field.mean(dim=(-2, -1)), torch.ones(2, 1))
    torch.testing.assert_close((field - 1).abs().amax(dim=(-2, -1)), torch.full((2, 1), 0.5))
