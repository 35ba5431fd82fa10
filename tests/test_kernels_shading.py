"""The compiled renderer against its twins: ray by ray in torch, and light by light in double precision."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep.physics.optics import dot, normalize
from polsep.render import shading_kernel as shading
from polsep.render.materials import Materials, look_up, random_materials
from polsep.render.shading_kernel import (
    BLOCK,
    CHANNELS,
    Points,
    build_beams,
    material_table,
    shade_pixels,
    spread_pixels,
)
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, shade

CAMERA, LIGHT = PinholeCamera((0.4, 0.8, 6.0)), PointLight((2.0, 1.0, 5.0), 30.0, 0.7)
SLOTS, HITS = 30, 6000
AGREEMENT = 1e-5  # of the peak of either lobe


def directions(hits: int, generator: torch.Generator) -> Tensor:
    return normalize(torch.randn(3, hits, 1, generator=generator))


def toward(position: Tensor, target: tuple[float, float, float]) -> Tensor:
    return normalize(torch.tensor(target).view(3, 1, 1) - position)


def edge_on(normal: Tensor, direction: Tensor, generator: torch.Generator) -> Tensor:
    """Normals at most 0.6 degrees from perpendicular to a direction."""
    cosine = 0.01 * torch.rand(1, normal.shape[1], 1, generator=generator)
    return normalize(normal - dot(normal, direction) * direction + cosine * direction)


def as_points(position: Tensor, normal: Tensor, slot: Tensor, pixel: NDArray[np.int64], lit: Tensor) -> Points:
    return Points(position[..., 0].numpy(), normal[..., 0].numpy(), slot.numpy(), pixel, lit.numpy())


def by_torch(hits: Points, materials: Materials, light: PointLight, dtype: torch.dtype) -> Tensor:
    """Twelve numbers of every hit, ``[M, 12]``, by the readable twin."""
    position, normal = (torch.from_numpy(x)[..., None] for x in (hits.position, hits.normal))
    maps = [x.to(dtype) for x in look_up(materials, torch.from_numpy(hits.slot), position)]
    lit = torch.from_numpy(hits.lit)[None, :, None]
    diffuse, specular = shade(GBuffer(position.to(dtype), normal.to(dtype), *maps, lit), CAMERA, light, lit)
    colors = torch.cat([diffuse.s0, diffuse.s1, diffuse.s2])
    return torch.cat([colors, specular.s0[:1], specular.s1[:1], specular.s2[:1]])[..., 0].T.double()


def assert_agrees(hits: Points, materials: Materials, light: PointLight) -> None:
    """As exact as the twin in float32 is, or to `AGREEMENT`, against the twin in float64."""
    image = np.zeros((hits.slot.size, CHANNELS), np.float32)
    shade_pixels(replace_pixels(hits), material_table(materials), build_beams(CAMERA, light), image)
    exact, single = by_torch(hits, materials, light, torch.float64), by_torch(hits, materials, light, torch.float32)
    for lobe in (slice(0, 9), slice(9, 12)):
        peak = float(exact[:, lobe].abs().max())
        assert peak > 0
        wrong = float((torch.from_numpy(image)[:, lobe] - exact[:, lobe]).abs().max()) / peak
        assert wrong < max(AGREEMENT, 1.5 * float((single - exact)[:, lobe].abs().max()) / peak)


def replace_pixels(hits: Points) -> Points:
    """Every hit a pixel of its own."""
    return hits._replace(pixel=np.arange(hits.slot.size))


@pytest.mark.parametrize("where", ["anywhere", "highlight", "camera edge-on", "light edge-on", "facing the camera"])
@pytest.mark.parametrize("roughness", [None, 0.1, 0.4])
def test_hits_are_shaded_like_the_twin(where: str, roughness: float | None, generator: torch.Generator) -> None:
    """Both lobes at random points, textured and of one roughness, in highlights and at grazing angles."""
    position = 0.7 * torch.randn(3, HITS, 1, generator=generator)
    to_camera, to_light = toward(position, CAMERA.position), toward(position, LIGHT.position)
    normal = directions(HITS, generator)
    normal = {
        "anywhere": normal,
        "highlight": normalize(normalize(to_camera + to_light) + 0.05 * normal),
        "camera edge-on": edge_on(normal, to_camera, generator),
        "light edge-on": edge_on(normal, to_light, generator),
        "facing the camera": to_camera,
    }[where]
    materials = random_materials(SLOTS, generator)
    if roughness is not None:
        materials = replace(materials, roughness=torch.full((SLOTS,), roughness), textures=None)
    slot, lit = torch.randint(SLOTS, (HITS,), generator=generator), torch.rand(HITS, generator=generator) < 0.8
    assert_agrees(as_points(position, normal, slot, np.arange(HITS), lit), materials, LIGHT)


@pytest.mark.parametrize("position", [CAMERA.position, (0.4, 9.0, 6.0), (0.8, 1.6, 12.0), (0.0, 7.0, 0.0)])
def test_light_at_special_places(position: tuple[float, float, float], generator: torch.Generator) -> None:
    """At the camera, above it, in line with it, and straight above the object, where the light's frame degenerates."""
    at = 0.3 * torch.randn(3, HITS, 1, generator=generator)
    at[:, :100] = 0
    materials, light = random_materials(SLOTS, generator), PointLight(position, 30.0, 1.9)
    slot = torch.randint(SLOTS, (HITS,), generator=generator)
    hits = as_points(at, directions(HITS, generator), slot, np.arange(HITS), torch.ones(HITS, dtype=torch.bool))
    assert_agrees(hits, materials, light)


def test_pixels_sum_their_hits(generator: torch.Generator) -> None:
    """Pixels get the sum of the light of their hits, over the borders of blocks, empty pixels and unlit hits too."""
    counts = torch.randint(0, 10, (900,), generator=generator)
    pixel = torch.repeat_interleave(torch.arange(900), counts)
    hits = pixel.numel()
    assert hits > 3 * BLOCK
    position, normal = 0.7 * torch.randn(3, hits, 1, generator=generator), directions(hits, generator)
    slot, lit = torch.randint(SLOTS, (hits,), generator=generator), torch.rand(hits, generator=generator) < 0.7
    materials = random_materials(SLOTS, generator)
    points = as_points(position, normal, slot, pixel.numpy(), lit)
    image = np.zeros((900, CHANNELS), np.float32)
    shade_pixels(points, material_table(materials), build_beams(CAMERA, LIGHT), image)
    expected = torch.zeros(900, CHANNELS, dtype=torch.float64)
    expected.index_add_(0, pixel, by_torch(points, materials, LIGHT, torch.float64))
    for lobe in (slice(0, 9), slice(9, 12)):
        peak = float(expected[:, lobe].abs().max())
        wrong = (torch.from_numpy(image)[:, lobe] - expected[:, lobe]).abs().max()
        assert float(wrong) < 3 * AGREEMENT * peak
    assert float(np.abs(image[counts.numpy() == 0]).max()) == 0


def test_a_pixel_may_fill_a_block(generator: torch.Generator) -> None:
    """As many hits in one pixel as a block holds, and an image without any."""
    hits = BLOCK
    position = 0.3 * torch.randn(3, hits, 1, generator=generator)
    normal, slot = toward(position, CAMERA.position), torch.randint(SLOTS, (hits,), generator=generator)
    materials = random_materials(SLOTS, generator)
    points = as_points(position, normal, slot, np.full(hits, 1), torch.ones(hits, dtype=torch.bool))
    image = np.zeros((3, CHANNELS), np.float32)
    shade_pixels(points, material_table(materials), build_beams(CAMERA, LIGHT), image)
    expected = by_torch(points, materials, LIGHT, torch.float64).sum(dim=0)
    np.testing.assert_allclose(image[1], expected.numpy(), rtol=0, atol=AGREEMENT * float(expected.max()))
    none = Points(*(x[..., :0] for x in points))
    empty = np.zeros((3, CHANNELS), np.float32)
    shade_pixels(none, material_table(materials), build_beams(CAMERA, LIGHT), empty)
    assert float(np.abs(empty).max()) == float(np.abs(image[[0, 2]]).max()) == 0


def test_the_specular_is_fully_polarized_and_the_diffuse_by_fresnel(generator: torch.Generator) -> None:
    """s1² + s2² = s0² of single hits in the specular lobe; the diffuse has one Stokes vector for all colours."""
    position, normal = 0.7 * torch.randn(3, HITS, 1, generator=generator), directions(HITS, generator)
    materials = random_materials(SLOTS, generator)
    slot = torch.randint(SLOTS, (HITS,), generator=generator)
    points = as_points(position, normal, slot, np.arange(HITS), torch.ones(HITS, dtype=torch.bool))
    image = np.zeros((HITS, CHANNELS), np.float32)
    shade_pixels(points, material_table(materials), build_beams(CAMERA, LIGHT), image)
    specular = image[:, 9:]
    polarized, peak = np.hypot(specular[:, 1], specular[:, 2]), float(specular[:, 0].max())
    np.testing.assert_allclose(polarized, specular[:, 0], rtol=1e-3, atol=AGREEMENT * peak)
    diffuse = image[:, :9].reshape(HITS, 3, 3)
    assert bool((np.hypot(diffuse[:, 1], diffuse[:, 2]) <= 0.386 * diffuse[:, 0] + 1e-6).all())
    bright = diffuse[:, 0].min(axis=1) > 1e-3
    ratio = diffuse[bright, 1:] / diffuse[bright, :1]
    np.testing.assert_allclose(ratio, np.broadcast_to(ratio[..., :1], ratio.shape), rtol=0, atol=1e-5)


def test_planes_are_the_image_turned(generator: torch.Generator) -> None:
    """Channels first, scaled, for sizes that fill no whole run."""
    for pixels in (1, shading.RUN, 3 * shading.RUN + 7):
        image = torch.rand(pixels, CHANNELS, generator=generator).numpy()
        planes = np.empty((CHANNELS, pixels), np.float32)
        spread_pixels(image, np.float32(0.25), planes)
        np.testing.assert_array_equal(planes, 0.25 * image.T)
