"""How far maps of a material are from the true ones: by what they look like, and by themselves.

The rendering loss compares pictures of both under lights and cameras drawn anew; mirror configurations show highlights,
which lights drawn anywhere rarely do. Source: Deschaintre et al. 2018, Secs. 4.2 and 5 (losses and configurations);
their numbers as in their public code. Note: every picture is of other pixels of a lattice of every third one, so that
nine of them cost as one: the mean of the loss is the same.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.material.svbrdf import Svbrdf, plane_points, relight, unstack

#: Pictures under lights from anywhere, and with light and camera as in a mirror.
RANDOM, MIRRORED = 3, 6
#: Of the cosine's hemisphere: squared sines at least and at most.
SINES = (0.001, 0.9)
#: Logarithm of distances in mirror configurations: mean and standard deviation; how far the mirror's centre may lie.
DISTANCE, SHIFT = (0.5, 0.75), 1.0
#: Distance of lights and cameras that are anywhere.
FAR = 4.0
#: What is added to pictures, and to albedos, before their logarithms are compared.
PICTURE_FLOOR, ALBEDO_FLOOR = 0.1, 0.01
#: Weight of the maps themselves.
MAPS = 0.1
#: Weight of the squares of errors of slopes, where asked for: absolute ones are least for flat normals, while their
#: direction is in doubt.
SLOPES = 3.0
#: Pixels between those that a picture shows.
LATTICE = 3


class Configurations(NamedTuple):
    """Where camera and light are, ``[K, 3, 1, 1]`` each."""

    camera: Tensor
    light: Tensor


def random_configurations(random: int, mirrored: int, generator: torch.Generator) -> Configurations:
    """So many cameras and lights anywhere above the plane, and so many of which one is the other's mirror image."""
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
    """Directions ``[count, 3]`` whose density goes with the cosine."""
    squared, turn = torch.rand(2, count, generator=generator)
    squared = SINES[0] + (SINES[1] - SINES[0]) * squared
    sine, turn = squared.sqrt(), 2 * math.pi * turn
    return torch.stack([sine * turn.cos(), sine * turn.sin(), (1 - squared).sqrt()], dim=-1)


def rendering_loss(found: Svbrdf, truth: Svbrdf, seen: Configurations, offset: tuple[int, int] = (0, 0)) -> Tensor:
    """Mean difference of the logarithms of pictures of maps ``[B, C, H, W]`` on a lattice that starts at ``offset``."""
    height, width = truth.roughness.shape[-2:]
    rows, cols = (slice(start, None, LATTICE) for start in offset)
    points = plane_points(height, width).to(truth.roughness)[:, rows, cols]
    pictures = []
    for maps in (found, truth):
        few = Svbrdf(*(x[:, None] for x in vars(maps.at(rows, cols)).values()))
        picture = relight(few, points, seen.camera.to(points), seen.light.to(points))
        pictures.append(torch.log(picture + PICTURE_FLOOR))
    return (pictures[0] - pictures[1]).abs().mean()


def maps_loss(found: Svbrdf, truth: Svbrdf) -> Tensor:
    """Mean differences of normals and roughness, and of the logarithms of diffuse and specular, added."""
    plain = (found.normal - truth.normal).abs().mean() + (found.roughness - truth.roughness).abs().mean()
    pairs = ((found.diffuse, truth.diffuse), (found.specular, truth.specular))
    return plain + sum(
        ((torch.log(a + ALBEDO_FLOOR) - torch.log(b + ALBEDO_FLOOR)).abs().mean() for a, b in pairs),
        torch.zeros_like(plain),
    )


def slopes_loss(found: Tensor, truth: Tensor) -> Tensor:
    """Mean square error of the normals' x and y of stacked maps ``[B, 9, H, W]``, times `SLOPES`."""
    return SLOPES * (found[:, :2] - truth[:, :2]).square().mean()


def material_loss(found: Tensor, truth: Tensor, generator: torch.Generator) -> Tensor:
    """Both losses of stacked maps ``[B, 9, H, W]``, configurations and lattice drawn from ``generator``."""
    row, col = torch.randint(LATTICE, (2,), generator=generator).tolist()
    seen = random_configurations(RANDOM, MIRRORED, generator)
    maps, true = unstack(found.float()), unstack(truth.float())
    return rendering_loss(maps, true, seen, (row, col)) + MAPS * maps_loss(maps, true)
