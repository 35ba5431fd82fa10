"""Both lobes as Mueller matrices: with camera and light exchanged they are each other's transposes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from test_optics import random_geometry, scalar
from tolerances import assert_close
from torch import Tensor

from polsep.physics.optics import Geometry, diffuse_stokes, dot, specular_stokes
from polsep.physics.stokes import Stokes

DIRECTIONS = 400
Lobe = Callable[..., Stokes]


def mueller(lobe: Lobe, g: Geometry, extra: Tensor) -> Tensor:
    """The matrix ``[3, 3, N]`` from linear light to linear light, per irradiance perpendicular to the surface.

    Its columns come from light behind polarizers at 0, 45 and 90 degrees: (1, 1, 0), (1, 0, 1) and (1, -1, 0).
    """
    along, diagonal, across = (
        torch.stack([s.s0, s.s1, s.s2])[:, 0, :, 0] / dot(g.normal, g.to_light)[0, :, 0]
        for s in (lobe(g, scalar(t), scalar(1.0), extra) for t in (0.0, math.pi / 4, math.pi / 2))
    )
    unpolarized = (along + across) / 2
    return torch.stack([unpolarized, (along - across) / 2, diagonal - unpolarized], dim=1)


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_exchanged_camera_and_light_transpose_the_matrix(lobe: Lobe, generator: torch.Generator) -> None:
    """M back = F M^T F: the x axis of a beam's frame turns round with the beam, so F = diag(1, 1, -1).

    Source: van de Hulst 1957, Light Scattering by Small Particles, 5.22; de Hoop 1960.
    """
    g = random_geometry(DIRECTIONS, generator)
    back = Geometry(g.normal, g.to_light, g.to_camera, g.light_up, g.camera_up)
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    there, again = mueller(lobe, g, scalar(0.6)), mueller(lobe, back, scalar(0.6))
    expected = torch.einsum("ij,kjn,kl->iln", flip, there, flip)
    assert float((there - there.transpose(0, 1)).abs().max()) > 1e-3
    assert_close(again, expected, scale=float(there.abs().max()))


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_no_light_is_polarized_beyond_its_power(lobe: Lobe, generator: torch.Generator) -> None:
    """Every linear state goes in, and what comes out has a DoLP of at most 1 and a power not below 0."""
    matrix = mueller(lobe, random_geometry(DIRECTIONS, generator), scalar(0.6))
    angles = torch.linspace(0, 2 * math.pi, 13, dtype=torch.float64)
    for degree in (0.0, 0.5, 1.0):
        light = torch.stack([torch.ones_like(angles), degree * angles.cos(), degree * angles.sin()])
        s0, s1, s2 = torch.einsum("ijn,jk->ikn", matrix, light)
        assert float(s0.min()) >= -1e-12
        assert bool((torch.hypot(s1, s2) <= s0 + 1e-12 * float(s0.max())).all())
