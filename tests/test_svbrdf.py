"""The renderer for materials: laws of reflection, agreement with NumPy and with `polsep.physics.optics`, gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep.material.svbrdf import Svbrdf, plane_points, reflect, relight, unstack
from polsep.physics.fresnel import fresnel
from polsep.physics.optics import Geometry, diffuse_stokes, specular_stokes

Doubles = NDArray[np.float64]


def uniform_maps(diffuse: float, roughness: float, specular: float, shape: tuple[int, int] = (1, 1)) -> Svbrdf:
    """A flat material of one kind."""
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(3, 1, 1).expand(3, *shape)
    values = [torch.full((c, *shape), x, dtype=torch.float64) for c, x in ((3, diffuse), (1, roughness), (3, specular))]
    return Svbrdf(normal, *values)


def direction(zenith: Tensor, azimuth: Tensor) -> Tensor:
    """Unit vectors ``[3, 1, N]``."""
    sine = zenith.sin()
    return torch.stack([sine * azimuth.cos(), sine * azimuth.sin(), zenith.cos()])[:, None]


def random_stack(seed: int, size: int) -> Tensor:
    maps = torch.rand(9, size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    maps[:2] = maps[:2] - 0.5
    return maps


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.9])
def test_no_more_light_leaves_than_came(roughness: float) -> None:
    """Albedo of white paper under gloss, by quadrature over the hemisphere, is 1 but for what Schlick adds."""
    steps = 400
    cosine = (torch.arange(steps, dtype=torch.float64) + 0.5) / steps
    zenith, azimuth = torch.meshgrid(torch.acos(cosine), 2 * math.pi * cosine, indexing="ij")
    to_light = direction(zenith.flatten(), azimuth.flatten())
    for tilt in (0.0, 0.6, 1.0):
        to_camera = direction(torch.tensor([tilt]).double(), torch.tensor([0.3]).double()).expand_as(to_light)
        reflected = reflect(uniform_maps(1.0, roughness, 0.04), to_camera, to_light)
        albedo = 2 * math.pi * float(reflected.mean(dim=-1)[0, 0])
        assert 0.9 < albedo < 1.05


def test_light_may_go_either_way() -> None:
    """The BRDF is the same with camera and light exchanged (Helmholtz)."""
    generator = torch.Generator().manual_seed(3)
    zenith, azimuth = torch.rand(2, 2, 500, generator=generator, dtype=torch.float64)
    one, other = direction(1.4 * zenith[0], 6.28 * azimuth[0]), direction(1.4 * zenith[1], 6.28 * azimuth[1])
    maps = uniform_maps(0.4, 0.35, 0.2)
    there, back = reflect(maps, one, other) / other[2], reflect(maps, other, one) / one[2]
    torch.testing.assert_close(there, back, rtol=1e-9, atol=1e-12)


def test_nothing_is_seen_from_behind() -> None:
    """Light or camera below the surface: black."""
    up, down = (torch.tensor([0.1, 0.2, z], dtype=torch.float64).view(3, 1, 1) for z in (0.97, -0.97))
    maps = uniform_maps(0.5, 0.4, 0.04)
    assert float(reflect(maps, up, down).abs().max()) == 0
    assert float(reflect(maps, down, up).abs().max()) == 0


def test_white_paper_shows_one() -> None:
    """A matte white plane that faces a far light."""
    far = torch.tensor([0.0, 0.0, 1e6], dtype=torch.float64).view(3, 1, 1)
    maps = uniform_maps(1.0, 1.0, 0.0, (4, 4))
    picture = relight(maps, plane_points(4, 4).double(), far, far)
    assert float((picture - 1).abs().max()) < 0.1  # Schlick's term is not 0 even where the reflectance is
    assert float(picture.min()) >= 1


def shade_in_numpy(maps: Doubles, camera: Doubles, light: Doubles) -> Doubles:
    """The same pictures, pixel by pixel, from the formulas of Deschaintre et al. 2018, in other forms of them."""
    size = maps.shape[-1]
    out = np.zeros((3, size, size))
    for row in range(size):
        for col in range(size):
            point = np.array([(2 * col + 1) / size - 1, 1 - (2 * row + 1) / size, 0.0])
            nx, ny = maps[:2, row, col]
            n = np.array([nx, ny, math.sqrt(max(1 - nx * nx - ny * ny, 1e-6))])
            n /= np.linalg.norm(n)
            v, lamp = camera - point, light - point
            v, lamp = v / np.linalg.norm(v), lamp / np.linalg.norm(lamp)
            h = (v + lamp) / np.linalg.norm(v + lamp)
            nl, nv, nh, vh = n @ lamp, n @ v, n @ h, v @ h
            if min(nl, nv) <= 0:
                continue
            rho, r, ks = maps[2:5, row, col], maps[5, row, col], maps[6:9, row, col]
            a2 = r**4
            d = a2 / (math.pi * (nh**2 * (a2 - 1) + 1) ** 2)
            k = r**2 / 2
            g = nl / (nl * (1 - k) + k) * nv / (nv * (1 - k) + k)
            f = ks + (1 - ks) * 2 ** ((-5.55473 * vh - 6.98316) * vh)
            out[:, row, col] = math.pi * nl * ((1 - ks) * rho / math.pi + d * g * f / (4 * nl * nv))
    return out


def test_agrees_with_numpy() -> None:
    """To 1e-6 of the largest value, for random maps, camera and light."""
    maps = random_stack(5, 9)
    maps[5] = 0.15 + 0.8 * maps[5]
    camera, light = np.array([0.2, -0.3, 2.4]), np.array([-0.8, 1.1, 1.3])
    expected = shade_in_numpy(maps.numpy(), camera, light)
    rows = 1 - (2 * torch.arange(9).double() + 1) / 9
    y, x = torch.meshgrid(rows, -rows, indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)])
    place = [torch.from_numpy(p).view(3, 1, 1) for p in (camera, light)]
    found = relight(unstack(maps), points, place[0], place[1]).numpy()
    assert np.abs(found - expected).max() < 1e-6 * expected.max()


@pytest.mark.parametrize("roughness", [0.15, 0.4, 0.8])
def test_agrees_with_the_optics_straight_down(roughness: float) -> None:
    """Light and camera above: the lobes of `physics.optics` for index 1.5, unpolarized light, and albedo as made."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(3, 1, 1)
    side = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).view(3, 1, 1)
    geometry, one = Geometry(up, up, up, side, side), torch.ones(1, 1, 1, dtype=torch.float64)
    light = torch.tensor(0.4, dtype=torch.float64)
    albedo = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64).view(3, 1, 1)
    total = diffuse_stokes(geometry, light, one, albedo).s0
    total = total + specular_stokes(geometry, light, one, roughness * one).s0
    passed = fresnel(one).t_plus ** 2
    maps = Svbrdf(up, albedo * passed / (1 - 0.04), roughness * one, torch.full_like(albedo, 0.04))
    # Schlick's power of two leaves 2^-12.5 of the other 0.96 at normal incidence.
    torch.testing.assert_close(reflect(maps, up, up), total, rtol=5e-3, atol=1e-9)


@pytest.mark.parametrize("size", [(4, 4), (2, 6), (5, 3)])
def test_points_are_centres_of_pixels(size: tuple[int, int]) -> None:
    """Half a pixel inside the plane's borders, x to the right and y up, symmetric about its middle."""
    points = plane_points(*size)
    assert points.shape == (3, *size)
    torch.testing.assert_close(points[:2, 0, 0], torch.tensor([1 / size[1] - 1, 1 - 1 / size[0]]))
    torch.testing.assert_close(points.flip(-1, -2), -points)


def test_mirrors_stay_finite() -> None:
    """Of no roughness at all, seen and lit from where they mirror."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(3, 1, 1)
    assert bool(torch.isfinite(reflect(uniform_maps(0.2, 0.0, 0.04), up, up)).all())


def test_stacking_has_a_twin() -> None:
    """Maps go through `Svbrdf.stack` and back."""
    maps = unstack(random_stack(7, 5))
    again = unstack(maps.stack())
    for one, other in zip(vars(maps).values(), vars(again).values(), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(maps.normal.square().sum(dim=0), torch.ones(5, 5, dtype=torch.float64))


def test_gradients_are_right() -> None:
    """Automatic ones agree with differences, also for normals."""
    points = plane_points(2, 2).double()
    camera, light = (torch.tensor(p, dtype=torch.float64).view(3, 1, 1) for p in ((0.1, 0.2, 2.0), (0.5, -0.4, 1.5)))
    maps = (0.2 + 0.5 * random_stack(2, 2)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: relight(unstack(x), points, camera, light), (maps,))
