"""Materials that vary over a plane, as maps, and their differentiable renderer.

Conventions: the plane is x, y in [-1, 1] at z = 0, x right, y up, z toward the camera; maps are ``[..., C, H, W]``,
row 0 at y = 1. ``diffuse`` and ``specular`` are linear RGB in [0, 1], the latter the reflectance at normal incidence,
0.04 for glass; roughness r is GGX alpha = r^2. The shading is that of Deschaintre et al. 2018, which game engines and
glTF share (`physics.gltf`). No polarization.

Source: Deschaintre, Aittala, Durand, Drettakis, Bousseau 2018, doi:10.1145/3197517.3201378; Karis 2013.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from polsep.physics import gltf
from polsep.physics.optics import dot, normalize

#: Channels of stacked maps: normal x and y, diffuse, roughness, specular.
STACKED = 9
#: Pixels along the side of maps.
MAP_SIZE = 128
#: Height of the camera, which looks straight down, above the plane.
CAMERA_HEIGHT = 2.75
#: Channels of each network's input, by name, among the 15 of a view in `shots`.
INPUTS: dict[str, slice] = {"unseparated": slice(0, 3), "separated": slice(3, 9), "perfect": slice(9, 15)}


@dataclass(frozen=True)
class Svbrdf:
    """Maps ``[..., C, H, W]``: unit ``normal``, ``diffuse`` and ``specular`` of C = 3, ``roughness`` of C = 1."""

    normal: Tensor
    diffuse: Tensor
    roughness: Tensor
    specular: Tensor

    def stack(self) -> Tensor:
        """All maps as ``[..., 9, H, W]``: x and y of the normal, diffuse, roughness, specular."""
        return torch.cat([self.normal[..., :2, :, :], self.diffuse, self.roughness, self.specular], dim=-3)

    def at(self, rows: slice, cols: slice) -> Svbrdf:
        """The maps at some rows and columns."""
        maps = (self.normal, self.diffuse, self.roughness, self.specular)
        return Svbrdf(*(x[..., rows, cols] for x in maps))


def unstack(maps: Tensor) -> Svbrdf:
    """The twin of `Svbrdf.stack`; normals look up."""
    xy = maps[..., :2, :, :]
    z = torch.sqrt((1 - dot(xy, xy)).clamp(min=1e-6))
    normal = normalize(torch.cat([xy, z], dim=-3))
    return Svbrdf(normal, maps[..., 2:5, :, :], maps[..., 5:6, :, :], maps[..., 6:9, :, :])


def plane_points(height: int, width: int) -> Tensor:
    """Pixel centres of the plane, ``[3, H, W]``."""
    rows, cols = 1 - (torch.arange(height) + 0.5) * (2 / height), (torch.arange(width) + 0.5) * (2 / width) - 1
    y, x = torch.meshgrid(rows, cols, indexing="ij")
    return torch.stack([x, y, torch.zeros_like(x)])


def reflect(maps: Svbrdf, to_camera: Tensor, to_light: Tensor) -> Tensor:
    """`gltf.reflect` of maps for unit directions, all ``[..., 3, H, W]``."""
    found: Tensor = gltf.reflect(
        gltf.Coat(maps.normal, maps.diffuse, maps.roughness, maps.specular), to_camera, to_light
    )
    return found


def relight(maps: Svbrdf, points: Tensor, camera: Tensor, light: Tensor) -> Tensor:
    """The image of the plane for a camera at ``camera`` and a light at ``light``, both ``[..., 3, 1, 1]``.

    The light is equally strong at every point: white paper that faces it shows 1.
    """
    return math.pi * reflect(maps, normalize(camera - points), normalize(light - points))
