"""A room that is not dark: unpolarized light from many directions, rendered, on the surfaces of a scene.

Light of a room is not polarized when it arrives, but when it leaves: specular light as Fresnel's equations reflect
it, diffuse light as they transmit it. Both follow the relief of surfaces as the lamp's do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.render.disturbances import Number, add_scenes, scale_light
from polsep.render.materials import Materials
from polsep.render.sphere_tracing import PointLight, Scene

#: Renders a scene under one lamp.
LightBy = Callable[[PointLight], Scene]


class Around(NamedTuple):
    """Lights around a scene's middle: unit vectors to them ``[N, 3]``, ``strengths [N]`` and their ``distance``."""

    directions: Tensor
    strengths: Tensor
    distance: float


def light_from_around(light_by: LightBy, around: Around) -> Scene:
    """Return a scene under unpolarized lights: under two lamps with crossed polarizers in each direction."""
    scenes = []
    for direction, strength in zip(around.directions, around.strengths.tolist(), strict=True):
        x, y, z = (around.distance * direction).tolist()
        for polarizer in (0.0, math.pi / 2):
            scenes.append(light_by(PointLight((x, y, z), strength * around.distance**2, polarizer)))
    return reduce(add_scenes, scenes)


def as_room(room: Scene, lamp: Scene, share: Number, color: Number) -> Scene:
    """Return the light of a ``room`` alone, all of it diffuse, also what surfaces mirror.

    ``share``: mean of the light that they reflect diffusely over that of the ``lamp``, on the mask. ``color``: of the
    room's light over the lamp's.
    """
    mask = room.mask
    gain = share * lamp.diffuse.s0[:, mask].mean() / room.diffuse.s0[:, mask].mean().clamp(min=1e-12)
    lit = scale_light(room, gain * color)
    return Scene(lit.diffuse + lit.specular, lit.specular * 0.0, mask)


def even_directions(count: int) -> Tensor:
    """Return unit vectors ``[count, 3]`` evenly over the sphere (Fibonacci's spiral)."""
    k = torch.arange(count) + 0.5
    height, turn = 1 - 2 * k / count, math.pi * (1 + 5**0.5) * k
    around = (1 - height**2).sqrt()
    return torch.stack([around * turn.cos(), height, around * turn.sin()], dim=1)


def roughen(materials: Materials, least: float) -> Materials:
    """Return the materials with at least this roughness, whose reflections blur single lights."""
    rough = replace(materials, roughness=materials.roughness.clamp(min=least))
    if materials.textures is None:
        return rough
    return replace(rough, textures=replace(materials.textures, roughness=materials.textures.roughness.clamp(min=least)))
