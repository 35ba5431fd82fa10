"""Random samples of materials: reliefs and their slopes, metals and their light."""

from __future__ import annotations

import cmath
import math

import pytest
import torch

from polsep.material.heights import KINDS, random_place, random_relief
from polsep.material.procedural import METAL_SHARE, REFLECTANCES, SLOPES, TARNISH, halve, random_svbrdf, rms_slope
from polsep.material.shots import (
    AROUND,
    FLASH,
    HEIGHTS,
    photograph,
    random_flash,
    random_light,
    separated_images,
    shade_metal,
    shade_plane,
)
from polsep.material.svbrdf import CAMERA_HEIGHT, Svbrdf
from polsep.physics.fresnel import conductor
from polsep.physics.gltf import DIELECTRICS, METALS, metalness
from polsep.physics.optics import Geometry, metal_stokes, normalize, specular_stokes
from polsep.render.sphere_tracing import PointLight

COUNT = 60


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def samples() -> list[Svbrdf]:
    """Random materials, of few pixels."""
    return [random_svbrdf(64, seeded(seed)) for seed in range(COUNT)]


def plate(reflectance: tuple[float, float, float], roughness: float, size: int = 96) -> Svbrdf:
    """A flat plate of metal."""
    normal = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1).expand(3, size, size)
    specular = torch.tensor(reflectance).view(3, 1, 1).expand(3, size, size)
    return Svbrdf(normal, torch.zeros(3, size, size), torch.full((1, size, size), roughness), specular)


@pytest.mark.parametrize("kind", KINDS)
def test_reliefs_have_structure(kind: object) -> None:
    """Heights of every kind are finite, not flat, and those of one seed are the same; weights are shares."""
    assert callable(kind)
    for seed in range(3):
        found, again = (kind(random_place(48, seeded(seed))) for _ in range(2))
        assert torch.equal(found.height, again.height) and torch.equal(found.weight, again.weight)
        assert bool(torch.isfinite(found.height).all()) and float(found.height.std()) > 1e-4
    relief = random_relief(48, seeded(1))
    assert relief.height.shape == relief.weight.shape == (1, 48, 48)
    assert float(relief.weight.min()) >= 0 and float(relief.weight.max()) <= 1


def test_normals_are_of_a_height(samples: list[Svbrdf]) -> None:
    """Gentle slopes have no curl: how those to the right change upward is how those upward change to the right."""
    gentle = [maps.normal for maps in samples if 0.01 < rms_slope(maps.normal) < 0.3]
    assert len(gentle) > COUNT / 4
    for normal in gentle:
        right, upward = -normal[:2] / normal[2]
        bent = (right[:-2, 1:-1] - right[2:, 1:-1], upward[1:-1, 2:] - upward[1:-1, :-2])
        assert float(torch.corrcoef(torch.stack([x.flatten() for x in bent]))[0, 1]) > 0.9


def test_slopes_are_as_wide_as_said(samples: list[Svbrdf]) -> None:
    """No sample is steeper than the range; they fill it, from nearly flat ones to ones as steep as published maps."""
    slopes = torch.tensor([rms_slope(maps.normal) for maps in samples])
    assert float(slopes.max()) <= 1.1 * SLOPES[1]
    for low, high in ((0.0, 0.08), (0.08, 0.2), (0.2, 0.4), (0.4, SLOPES[1] * 1.1)):
        share = float(((slopes >= low) & (slopes < high)).float().mean())
        assert 0.06 < share < 0.6, (low, high, share)
    assert 0.2 < float(slopes.square().mean().sqrt()) < 0.45


def test_slopes_count_at_the_size_of_maps() -> None:
    """Finer frames are averaged first: halved, a material has the same slopes."""
    for seed in (0, 3, 6):
        maps = random_svbrdf(256, seeded(seed))
        assert rms_slope(halve(maps).normal) == pytest.approx(rms_slope(maps.normal), rel=1e-3)


def test_metals_are_a_class(samples: list[Svbrdf]) -> None:
    """As many samples as said hold metal; it has no diffuse light, and what it reflects is in the stated range."""
    metals = [maps for maps in samples if bool((metalness(maps.specular) == 1).any())]
    assert abs(len(metals) / COUNT - METAL_SHARE) < 4 * math.sqrt(METAL_SHARE * (1 - METAL_SHARE) / COUNT)
    whole = [maps for maps in metals if float(maps.diffuse.max()) == 0]
    assert 0 < len(whole) < len(metals)
    for maps in whole:
        assert float(maps.specular.max()) <= REFLECTANCES[1]
        assert float(maps.specular.mean(dim=0).min()) >= min(METALS, REFLECTANCES[0] * TARNISH[0])
    colors = [maps.specular.mean(dim=(1, 2)) for maps in whole]
    spreads = [float((color.amax() - color.amin()) / color.mean()) for color in colors]
    assert min(spreads) < 0.1 and max(spreads) > 0.2
    dielectrics = [maps for maps in samples if not bool((metalness(maps.specular) > 0).any())]
    assert all(float(maps.specular.max()) < DIELECTRICS for maps in dielectrics)


@pytest.mark.parametrize("reflectance", [0.4, 0.7, 0.95])
def test_metals_reflect_by_the_complex_index(reflectance: float) -> None:
    """At normal incidence as much as said, at grazing everything, between them as Snell's law in complex numbers."""
    k = 2 * math.sqrt(reflectance / (1 - reflectance))
    index = complex(1, k)
    for degrees in (0.0, 20.0, 45.0, 70.0, 85.0):
        angle = math.radians(degrees)
        c, ct = math.cos(angle), cmath.cos(cmath.asin(math.sin(angle) / index))
        rs, rp = (c - index * ct) / (c + index * ct), (index * c - ct) / (index * c + ct)
        found = conductor(torch.tensor(c, dtype=torch.float64), torch.tensor(reflectance, dtype=torch.float64))
        expected = ((abs(rs) ** 2 + abs(rp) ** 2) / 2, (abs(rs) ** 2 - abs(rp) ** 2) / 2, (rs * rp.conjugate()).real)
        torch.testing.assert_close(
            torch.stack(found[:3]), torch.tensor(expected, dtype=torch.float64), rtol=1e-9, atol=1e-12
        )
        assert float(found.t_plus) == float(found.t_minus) == 0
    ends = conductor(torch.tensor([1.0, 0.0]), torch.tensor(reflectance))
    torch.testing.assert_close(ends.r_plus, torch.tensor([reflectance, 1.0]))
    torch.testing.assert_close(ends.r_cross[:1], -ends.r_plus[:1])


def test_metals_mirror_as_glass_does_but_more() -> None:
    """Straight back a metal's light is glass's times the reflectances' ratio; nothing comes from behind."""
    z, up = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1), torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1)
    turn, one, rough = torch.tensor(0.7), torch.ones(1, 1, 1), torch.full((1, 1, 1), 0.4)
    color = torch.tensor([0.9, 0.7, 0.4]).view(3, 1, 1)
    g = Geometry(z, z, z, up, up)
    metal, glass = metal_stokes(g, turn, one, rough, color), specular_stokes(g, turn, one, rough)
    for of_metal, of_glass in zip((metal.s0, metal.s1, metal.s2), (glass.s0, glass.s1, glass.s2), strict=True):
        torch.testing.assert_close(of_metal, of_glass * color / 0.04)
    behind = metal_stokes(Geometry(-z, z, z, up, up), turn, one, rough, color)
    assert float(behind.s0.abs().max()) == 0


def test_metals_keep_the_lamps_polarization() -> None:
    """Up to 25 degrees 99 % of a reflection stays linear, and never more than all."""
    generator = seeded(2)
    light, camera = (torch.randn(3, 400, 1, generator=generator) for _ in range(2))
    light, camera = (normalize(torch.cat([0.35 * x[:2], x[2:].abs() + 0.5])) for x in (light, camera))
    z, up = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1), torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1)
    turn = 3 * torch.rand(1, 400, 1, generator=generator)
    found = metal_stokes(
        Geometry(z, camera, light, up, up), turn, torch.ones(1), torch.full((1, 1, 1), 0.5), 0.6 + 0 * z
    )
    dolp = torch.sqrt(found.s1**2 + found.s2**2) / found.s0.clamp(min=1e-9)
    cosine = (normalize(light + camera) * light).sum(dim=0)
    assert float(dolp.max()) <= 1 + 1e-5
    assert float(dolp[:, cosine > math.cos(math.radians(25))].min()) > 0.99


def test_photographs_of_metal_are_specular_alone() -> None:
    """The scene of a plate of metal is specular alone, polarized and coloured; separated, most of it is specular."""
    maps = plate((0.9, 0.7, 0.45), 0.5)
    diffuse, specular = shade_plane(maps, PointLight((0.1, 0.0, 2.75), 1.0, 0.4))
    assert float(diffuse.s0.abs().max()) == 0
    dolp = torch.sqrt(specular.s1**2 + specular.s2**2) / specular.s0
    assert float(dolp.min()) > 0.99
    ratio = specular.s0.mean(dim=(1, 2)) / specular.s0[0].mean()
    torch.testing.assert_close(ratio, torch.tensor([1, 0.7 / 0.9, 0.5]), rtol=0.01, atol=0)
    mosaic, scene, white = photograph(maps, random_flash(seeded(1)), seeded(2))
    assert math.isfinite(white) and white > 0
    found = separated_images(mosaic)
    assert float(found[3:].sum() / found.sum()) > 0.8
    assert float(scene.diffuse.s0.sum()) == 0


def test_pixels_between_hold_both() -> None:
    """The light of a pixel that is half metal has a metal's and a dielectric's part; dielectrics have no metal's."""
    light = PointLight((0.2, 0.1, 2.7), 1.0, 0.2)
    glass, metal, half = (plate((x, x, x), 0.5) for x in (0.04, METALS, (METALS + DIELECTRICS) / 2))
    parts = [float(shade_plane(maps, light)[1].s0.sum()) for maps in (glass, metal, half)]
    assert parts[0] < parts[2] < parts[1]
    assert parts[1] == pytest.approx(parts[0] * METALS / 0.04, rel=0.05)


def test_lights_fill_their_ranges() -> None:
    """Flashes lie beside the lens and others above the plane, to the ends of what is stated, behind any polarizer."""
    generator = seeded(5)
    for draw, sides, (low, high) in (
        (random_flash, FLASH, (CAMERA_HEIGHT - FLASH, CAMERA_HEIGHT + FLASH)),
        (random_light, AROUND, HEIGHTS),
    ):
        lights = [draw(generator) for _ in range(400)]
        across = torch.tensor([light.position[:2] for light in lights])
        heights, turns = (torch.tensor(x) for x in ([y.position[2] for y in lights], [y.polarizer for y in lights]))
        for values, least, most in ((across, -sides, sides), (heights, low, high), (turns, 0.0, math.pi)):
            margin = 0.03 * (most - least)
            assert least <= float(values.min()) < least + margin and most - margin < float(values.max()) <= most


@pytest.mark.parametrize("place", [(0.0, 0.0, CAMERA_HEIGHT), (0.2, -0.1, 2.0), (-0.3, 0.2, 4.0)])
def test_metal_near_the_normal_is_a_stronger_dielectric(place: tuple[float, float, float]) -> None:
    """Of the same lobe, polarized alike: in the ratio of both reflectances, wherever the light is."""
    light = PointLight(place, 1.0, 0.3)
    metal = shade_metal(plate((0.9, 0.6, 0.5), 0.5, 24), light)
    glass = shade_plane(plate((0.04, 0.04, 0.04), 0.5, 24), light)[1]
    ratio = torch.tensor([0.9, 0.6, 0.5]).view(3, 1, 1) / 0.04
    for found, expected in zip((metal.s0, metal.s1, metal.s2), (glass.s0, glass.s1, glass.s2), strict=True):
        off = (found / ratio - expected).abs() / glass.s0
        assert float(off[:, 9:15, 9:15].max()) < 0.02
