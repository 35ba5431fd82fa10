"""Lights of path tracing: `render.PointLight`, and a disk that is polarized in the same way."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from polsep.render.pathtrace.mueller import Row
from polsep.render.pathtrace.variants import fixed, fixed_vector
from polsep.render.sphere_tracing import PointLight, Vector

#: Cosines that are divided by are at least this.
LEAST = 1e-20


@dataclass(frozen=True)
class AreaLight:
    """A fully linearly polarized disk of ``radius`` that faces ``target`` and is equally bright from all of that side.

    ``intensity`` is that of the `PointLight` that lights the target as strongly from far; off the axis it falls with
    the cosine. ``polarizer`` [rad] counts in each beam's frame with up = world +y, as if every beam passed its own
    polarizer. Cameras do not see the disk and it casts no shadow. Raises ValueError for a radius that is not positive
    or a target in the disk's centre.
    """

    position: Vector = (1.0, 2.0, 8.0)
    target: Vector = (0.0, 0.0, 0.0)
    radius: float = 1.0
    intensity: float = 100.0
    polarizer: float = 0.0

    def __post_init__(self) -> None:
        if not self.radius > 0:
            raise ValueError(f"expected an area light of a positive radius, found {self.radius}")
        if math.dist(self.position, self.target) == 0:
            raise ValueError(f"expected an area light away from its target, found both at {self.position}")


@dataclass(frozen=True)
class Lamp:
    """A light in Mitsuba's numbers, ``stokes`` of unit intensity; ``axis``, ``radius``, ``area`` only of a disk."""

    position: Any
    intensity: Any
    stokes: Row
    axis: Any = None
    radius: Any = None
    area: Any = None


def build_lamp(light: PointLight | AreaLight) -> Lamp:
    """The light in the current variant."""
    angle = 2 * light.polarizer
    stokes = (mi.Float(1.0), fixed(math.cos(angle)), fixed(math.sin(angle)))
    position, intensity = fixed_vector(light.position), fixed(light.intensity)
    if isinstance(light, PointLight):
        return Lamp(position, intensity, stokes)
    axis = np.subtract(light.target, light.position)
    area = math.pi * light.radius**2
    return Lamp(
        position, intensity, stokes, fixed_vector(axis / np.linalg.norm(axis)), fixed(light.radius), fixed(area)
    )


def random_point(lamp: Lamp, random: Any) -> Any:
    """A point of the light, even over its area."""
    if lamp.area is None:
        return lamp.position
    offset = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(random.next_float32(), random.next_float32()))
    return lamp.position + mi.Frame3f(lamp.axis).to_world(mi.Vector3f(offset.x, offset.y, 0) * lamp.radius)


def meet_lamp(lamp: Lamp, origin: Any, direction: Any) -> tuple[Any, Any]:
    """Distance to a disk along a ray, infinite where it is missed, and the density of `random_point`'s directions."""
    cosine = dr.maximum(-dr.dot(lamp.axis, direction), LEAST)
    distance = dr.dot(lamp.axis, origin - lamp.position) / cosine
    offset = origin + distance * direction - lamp.position
    met = (distance > 0) & (dr.squared_norm(offset) < lamp.radius * lamp.radius)
    return dr.select(met, distance, dr.inf), distance * distance / (lamp.area * cosine)
