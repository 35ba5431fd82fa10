"""Losses of a material's maps: of pictures rendered from them, and of the maps themselves.

The rendering loss compares pictures of both under random lights and cameras. Mirror configurations show highlights,
which random ones rarely do. Source: Deschaintre et al. 2018, Secs. 4.2 and 5 (losses and configurations); constants as
in their public code. Note: pictures show every third pixel along both axes, from a random offset, so that nine cost as
much as one full picture; the expected loss is the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.material.svbrdf import Svbrdf, plane_points, relight, unstack

#: Number of random configurations, and of mirror configurations.
RANDOM, MIRRORED = 3, 6
#: Range of squared sines of the zenith angle in random configurations.
SINES = (0.001, 0.9)
#: Mean and standard deviation of the logarithm of distances in mirror configurations; largest shift of the centre.
DISTANCE, SHIFT = (0.5, 0.75), 1.0
#: Distance of lights and cameras in random configurations.
FAR = 4.0
#: Added to pictures, and to albedos, before their logarithms are compared.
PICTURE_FLOOR, ALBEDO_FLOOR = 0.1, 0.01
#: Weight of the loss of the maps.
MAPS = 0.1
#: Weight of the squared error of slopes in `slopes_loss`: with an absolute error, flat normals are best as long as
#: their direction is uncertain.
SLOPES = 3.0
#: Step between the pixels that a picture shows.
LATTICE = 3


class Configurations(NamedTuple):
    """Positions of camera and light, ``[K, 3, 1, 1]`` each."""

    camera: Tensor
    light: Tensor


def random_configurations(random: int, mirrored: int, generator: torch.Generator) -> Configurations:
    """Draw ``random`` cameras and lights above the plane, and ``mirrored`` pairs of mirror images."""
    count = random + mirrored
    camera, light = _hemisphere(count, generator), _hemisphere(count, generator)
    mirror = camera * torch.tensor([-1.0, -1.0, 1.0])
    distances = torch.exp(DISTANCE[0] + DISTANCE[1] * torch.randn(2, count, 1, generator=generator))
    shift = SHIFT * (2 * torch.rand(count, 3, generator=generator) - 1) * torch.tensor([1.0, 1.0, 0.0])
    is_mirrored = (torch.arange(count) >= random)[:, None]
    camera = torch.where(is_mirrored, camera * distances[0] + shift, camera * FAR)
    light = torch.where(is_mirrored, mirror * distances[1] + shift, light * FAR)
    return Configurations(camera[..., None, None], light[..., None, None])


def _hemisphere(count: int, generator: torch.Generator) -> Tensor:
    """Directions ``[count, 3]`` with a density proportional to the cosine."""
    squared, turn = torch.rand(2, count, generator=generator)
    squared = SINES[0] + (SINES[1] - SINES[0]) * squared
    sine, turn = squared.sqrt(), 2 * math.pi * turn
    return torch.stack([sine * turn.cos(), sine * turn.sin(), (1 - squared).sqrt()], dim=-1)


def rendering_loss(
    estimate: Svbrdf, truth: Svbrdf, configurations: Configurations, offset: tuple[int, int] = (0, 0)
) -> Tensor:
    """Return the mean difference of the logarithms of pictures of maps ``[B, C, H, W]``, from pixel ``offset`` on."""
    height, width = truth.roughness.shape[-2:]
    rows, cols = (slice(start, None, LATTICE) for start in offset)
    points = plane_points(height, width).to(truth.roughness)[:, rows, cols]
    pictures = []
    for maps in (estimate, truth):
        few = Svbrdf(*(x[:, None] for x in vars(maps.at(rows, cols)).values()))
        picture = relight(few, points, configurations.camera.to(points), configurations.light.to(points))
        pictures.append(torch.log(picture + PICTURE_FLOOR))
    return (pictures[0] - pictures[1]).abs().mean()


def maps_loss(estimate: Svbrdf, truth: Svbrdf) -> Tensor:
    """Return the sum of the mean differences of normals, roughness, and the logarithms of diffuse and specular."""
    plain = (estimate.normal - truth.normal).abs().mean() + (estimate.roughness - truth.roughness).abs().mean()
    pairs = ((estimate.diffuse, truth.diffuse), (estimate.specular, truth.specular))
    return plain + sum(
        ((torch.log(a + ALBEDO_FLOOR) - torch.log(b + ALBEDO_FLOOR)).abs().mean() for a, b in pairs),
        torch.zeros_like(plain),
    )


def slopes_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the mean squared error of the normals' x and y of stacked maps ``[B, 9, H, W]``, times `SLOPES`."""
    return SLOPES * (estimate[:, :2] - truth[:, :2]).square().mean()


def material_loss(estimate: Tensor, truth: Tensor, generator: torch.Generator) -> Tensor:
    """Return both losses of stacked maps ``[B, 9, H, W]`` with random configurations and offset."""
    row, col = torch.randint(LATTICE, (2,), generator=generator).tolist()
    configurations = random_configurations(RANDOM, MIRRORED, generator)
    maps, true = unstack(estimate.float()), unstack(truth.float())
    return rendering_loss(maps, true, configurations, (row, col)) + MAPS * maps_loss(maps, true)
