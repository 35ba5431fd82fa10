"""Cameras, lights and the casting that rendered test scenes share.

Scene units: objects have a radius of about 1. Random draws take a generator and are the same on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from polsep.physics.stokes import Stokes
from polsep.render.raycast import Hits, MeshScene, find_hits, is_lit
from polsep.render.shapes import Mesh
from polsep.render.simulate import blur
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, Vector, render_points, shade

#: Vertical field of view [degrees], and how much of the frame an object fills.
FOV_DEG, FILLED = 28.0, 0.85
#: Largest angle between light and camera, seen from the object [degrees].
LARGEST_ANGLE_DEG = 45.0
#: Distance of the light relative to the camera's.
LIGHT_DISTANCES = (0.7, 1.4)
#: Rays per pixel and axis; standard deviation of the lens blur in raw pixels: the Airy disk of green light at about f/8
#: on pixels of 3.45 micrometres, 0.42 lambda N = 1.8 micrometres.
SAMPLES, LENS_BLUR = 2, 0.5


def look_at(mesh: Mesh, azimuth_deg: float, elevation_deg: float) -> PinholeCamera:
    """The camera that sees a mesh around the origin from that direction, so near that it fills `FILLED` of the frame.

    Azimuth 0 is from +z, 90 from +x; elevation counts up.
    """
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    back = torch.tensor(
        [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)],
        dtype=torch.float64,
    )
    right = torch.tensor([math.cos(azimuth), 0.0, -math.sin(azimuth)], dtype=torch.float64)
    up = torch.linalg.cross(back, right)
    vertices = torch.from_numpy(mesh.vertices)
    x, y, z = vertices @ right, vertices @ up, vertices @ back
    slope = FILLED * math.tan(math.radians(FOV_DEG) / 2)
    distance = float((z + torch.maximum(x.abs(), y.abs()) / slope).max())
    return PinholeCamera(_vector(distance * back), (0.0, 0.0, 0.0), FOV_DEG)


def random_light_near(
    camera: PinholeCamera,
    generator: torch.Generator,
    angles_deg: tuple[float, float] = (0.0, LARGEST_ANGLE_DEG),
    distances: tuple[float, float] = LIGHT_DISTANCES,
) -> PointLight:
    """A light so many degrees from the camera as its target sees it, with a random polarizer angle.

    ``distances``: relative to the camera's.
    """
    draws = torch.rand(4, generator=generator, dtype=torch.float64)
    most, least = (math.cos(math.radians(angle)) for angle in angles_deg)
    cosine, around = least + (most - least) * float(draws[0]), 2 * math.pi * float(draws[1])
    target = torch.tensor(camera.target, dtype=torch.float64)
    way = torch.tensor(camera.position, dtype=torch.float64) - target
    back = way / way.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), back)
    right = right / right.norm()
    sideways = math.cos(around) * right + math.sin(around) * torch.linalg.cross(back, right)
    low, high = distances
    distance = float(way.norm()) * (low + (high - low) * float(draws[2]))
    position = target + distance * (cosine * back + math.sqrt(1 - cosine**2) * sideways)
    return PointLight(_vector(position), 1.0, math.pi * float(draws[3]))


def render_covered(
    model: MeshScene, cover: Callable[[Hits], GBuffer], camera: PinholeCamera, light: PointLight, side: int
) -> Scene:
    """The scene ``side`` x ``side`` of a mesh whose hits ``cover`` gives materials, behind the lens.

    The mask holds the pixels all of whose rays hit, lit or in a shadow.
    """
    size = (side, side)

    def shade_points(rows: Tensor, cols: Tensor) -> tuple[Stokes, Stokes]:
        hits = find_hits(model, camera, (rows, cols), size)
        diffuse, specular = shade(cover(hits), camera, light, is_lit(model, hits, light))
        return diffuse.map(lambda s: _spread(s, hits)), specular.map(lambda s: _spread(s, hits))

    def find_covered(rows: Tensor, cols: Tensor) -> tuple[Stokes, Stokes]:
        hits = find_hits(model, camera, (rows, cols), size)
        covered = _spread(torch.ones_like(hits.position), hits)
        return Stokes(covered, covered, covered), Stokes(covered, covered, covered)

    diffuse, specular = render_points(shade_points, size, SAMPLES)
    covered, _ = render_points(find_covered, size, SAMPLES)
    return blur(Scene(diffuse, specular, covered.s0[0] == 1), LENS_BLUR)


def _spread(values: Tensor, hits: Hits) -> Tensor:
    """Values ``[3, M, 1]`` of hits at their rays ``[3, N, 1]``, 0 elsewhere."""
    image = torch.zeros(3, hits.rays, 1)
    image[:, hits.ray] = values
    return image


def _vector(v: Tensor) -> Vector:
    x, y, z = (float(c) for c in v)
    return x, y, z
