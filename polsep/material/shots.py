"""Photographs of flat materials by a polarization camera with a polarized flash, and the networks' inputs from them.

The camera looks straight down at the plane of `polsep.material.svbrdf`, whose sides fill the frame; a point light
behind a polarizer is near the lens, as a flash is, or anywhere above. Light follows `optics`, the frame the camera
model with noise, and the frame is separated by `METHOD`. Images are divided by the level of white paper in the
middle, as measured in a photograph of white paper under the same light: 1 is white.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.demosaic.measured_stokes import measured_stokes
from polsep.material.procedural import halve, random_svbrdf
from polsep.material.svbrdf import CAMERA_HEIGHT, MAP_SIZE, Svbrdf, plane_points
from polsep.physics.fresnel import fresnel
from polsep.physics.gltf import GLASS, metalness
from polsep.physics.optics import metal_stokes
from polsep.physics.stokes import Stokes
from polsep.pipeline import separate_capture
from polsep.render.simulate import blur, capture, expose_to_clip, expose_to_level, half_resolution
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, Vector, beams_at, shade
from polsep.render.views import BLURS, scene_seed
from polsep.sensor.camera import IMX250, Layout, Mosaic

#: The camera, whose frame the plane fills.
CAMERA = PinholeCamera((0.0, 0.0, CAMERA_HEIGHT), (0.0, 0.0, 0.0), 2 * math.degrees(math.atan(1 / CAMERA_HEIGHT)))
#: Largest distance of a flash from the lens along each axis, and the range of other lights: sides, heights.
FLASH, AROUND, HEIGHTS = 0.15, 1.4, (1.8, 3.2)
#: Largest share of clipped samples, and the least level of the median sample, white at 1.
LARGEST_CLIPPED, MIN_LEVEL = 0.03, 0.06
#: Method that separates the frames: the best that polsep ships.
METHOD = "joint"
#: Standard deviation of the logarithm of the error of the level of white paper.
WHITE_ERROR = 0.05
#: Raw pixels along the side of a frame; images are averaged to `MAP_SIZE` pixels, as frames of real cameras are.
RAW_SIZE = 512
#: Raw pixels of every other example of training: large maps and parts of frames have as few for a pixel.
SMALL_SIZE = 2 * MAP_SIZE
#: The colour of a white lamp.
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Example:
    """Views ``[V, 15, h, w]`` of one material (see `svbrdf.INPUTS`) and its ``maps [9, h, w]`` (see `Svbrdf.stack`)."""

    views: Tensor
    maps: Tensor


def random_flash(generator: torch.Generator) -> PointLight:
    """A flash beside the lens, behind a random polarizer."""
    x, y, z = ((2 * torch.rand(3, generator=generator, dtype=torch.float64) - 1) * FLASH).tolist()
    return _light((x, y, CAMERA_HEIGHT + z), generator)


def random_light(generator: torch.Generator) -> PointLight:
    """A light somewhere above the plane, behind a random polarizer."""
    a, b, c = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
    height = HEIGHTS[0] + (HEIGHTS[1] - HEIGHTS[0]) * c
    return _light(((2 * a - 1) * AROUND, (2 * b - 1) * AROUND, height), generator)


def _light(position: Vector, generator: torch.Generator) -> PointLight:
    turn = math.pi * float(torch.rand(1, generator=generator, dtype=torch.float64))
    return PointLight(position, 1.0, turn)


def shade_metal(maps: Svbrdf, light: PointLight) -> Stokes:
    """The light ``[3, H, W]`` that a plane of metal mirrors to the camera, as `sphere_tracing.shade` of dielectrics."""
    geometry, irradiance = beams_at(plane_points(*maps.roughness.shape[-2:]), maps.normal, CAMERA, light)
    return metal_stokes(geometry, torch.tensor(light.polarizer), irradiance, maps.roughness, maps.specular)


def shade_plane(maps: Svbrdf, light: PointLight) -> tuple[Stokes, Stokes]:
    """Diffuse and specular light ``[3, H, W]`` of a plane, for the camera.

    Which pixels are of metal the specular map says, by `gltf.metalness`.
    """
    height, width = maps.roughness.shape[-2:]
    albedo = maps.diffuse * (1 - maps.specular) / fresnel(torch.ones(1)).t_plus ** 2
    everywhere = torch.ones(1, height, width, dtype=torch.bool)
    metal: Tensor = metalness(maps.specular)
    strength = (1 - metal) * maps.specular / GLASS
    buffer = GBuffer(plane_points(height, width), maps.normal, albedo, maps.roughness, strength, everywhere)
    diffuse, specular = shade(buffer, CAMERA, light, everywhere)
    if bool((metal > 0).any()):
        specular = specular + shade_metal(maps, light) * metal
    return diffuse, specular


def photograph(maps: Svbrdf, light: PointLight, generator: torch.Generator) -> tuple[Mosaic, Scene, float]:
    """A raw frame of a plane, the exposed light behind it, and s0 of white paper in the plane's middle."""
    diffuse, specular = shade_plane(maps, light)
    everywhere = torch.ones(maps.roughness.shape[-2:], dtype=torch.bool)
    low, high = BLURS
    place, share = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    scene = blur(Scene(diffuse, specular, everywhere), low + (high - low) * place)
    exposed = expose_to_clip(scene, LARGEST_CLIPPED * share, Layout(), IMX250)
    exposed = expose_to_level(exposed, MIN_LEVEL, Layout(), IMX250)
    gain = float((exposed.diffuse + exposed.specular).s0.mean() / (scene.diffuse + scene.specular).s0.mean())
    distance = math.dist(light.position, (0, 0, 0))
    white = gain * light.intensity / distance**2 * light.position[2] / distance / math.pi
    mosaic = capture(exposed, Layout(), IMX250, generator).mosaic
    return replace(mosaic, data=mosaic.data.numpy().astype(np.float32)), exposed, white


def unseparated_image(mosaic: Mosaic) -> Tensor:
    """The image of a camera without analysers, ``[3, h, w]``: s0, with clipped samples as they are."""
    return torch.from_numpy(measured_stokes(mosaic, WHITE)[0]).movedim(-1, 0)


def separated_images(mosaic: Mosaic) -> Tensor:
    """Diffuse and specular image of `METHOD`, ``[6, h, w]``, as users get them who say that the lamp is white."""
    frame = separate_capture(mosaic, METHOD, WHITE, "cpu")
    planes = (torch.from_numpy(x).movedim(-1, 0) for x in (frame.diffuse, frame.specular))
    return torch.cat([x.expand(3, -1, -1) for x in planes])


def random_view(maps: Svbrdf, light: PointLight, generator: torch.Generator) -> Tensor:
    """All inputs of networks from one photograph, ``[15, h, w]``; see `svbrdf.INPUTS`."""
    mosaic, scene, white = photograph(maps, light, generator)
    diffuse, specular, _ = half_resolution(scene)
    off = math.exp(WHITE_ERROR * float(torch.randn(1, generator=generator, dtype=torch.float64)))
    return torch.cat([unseparated_image(mosaic), separated_images(mosaic), diffuse, specular]) / (white * off)


def make_example(maps: Svbrdf, views: int, generator: torch.Generator) -> Example:
    """Photographs of a material ``[., H, W]``: the first by a flash beside the lens, the others by lights that move.

    Half-resolution images and maps are averaged further until their sides are `MAP_SIZE`; H and W are twice that, or
    twice that times a power of 2.
    """
    place: list[Callable[[torch.Generator], PointLight]] = [random_flash, *[random_light] * (views - 1)]
    seen = torch.stack([random_view(maps, draw(generator), generator) for draw in place])
    while maps.roughness.shape[-1] > MAP_SIZE:
        maps = halve(maps)
    return Example(avg_pool2d(seen, seen.shape[-1] // MAP_SIZE), maps.stack())


def random_example(split: str, seed: int, number: int, views: int, size: int = RAW_SIZE) -> Example:
    """Example ``number`` of a split, in frames of ``size`` raw pixels along a side; depends only on these numbers.

    Raises ValueError on a split not in `views.SPLITS`.
    """
    generator = torch.Generator().manual_seed(scene_seed(split, seed, number))
    return make_example(random_svbrdf(size, generator), views, generator)
