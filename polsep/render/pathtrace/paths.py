"""Paths from the camera over surfaces to lights, and the images that they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from numpy.typing import NDArray

from polsep.physics.stokes import Stokes
from polsep.render.pathtrace.lights import LEAST, AreaLight, Lamp, build_lamp, meet_lamp, random_point
from polsep.render.pathtrace.mueller import Matrix, Row, add, apply, identity_matrix, multiply, scale
from polsep.render.pathtrace.surfaces import (
    Finish,
    PathModel,
    Vertex,
    build_path_model,
    build_ray,
    find_vertex,
    finish_vertex,
    look_up_finish,
    read_finish,
    reflection,
    scatter,
    scatter_density,
    smoothed,
    white_lobes,
)
from polsep.render.pathtrace.variants import find_variant, fixed_vector, in_variant, is_fast, is_over
from polsep.render.raycast import Model
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Scene, camera_axes, pixel_side

#: Share of paths that leave the first surface by its specular lobe, and later ones; any share gives the same mean.
FIRST_SPECULAR, LATER_SPECULAR = 0.5, 0.2
#: Shadow rays end this share of their length before the light.
SHORT = 1e-4
#: Paths that are followed together, to bound memory.
PATHS_AT_ONCE = 2**20
#: What `_follow` finds of a path: s0, s1, s2 of three colours each of the diffuse, then of the specular, and the hit.
OUTPUTS = 19


@dataclass(frozen=True)
class PathOptions:
    """``samples`` x ``samples`` points per pixel, as in `raycast`; through each, ``paths`` of up to ``depth`` surfaces.

    Depth 1 is direct light alone, of which one path sees all if the light is a point. Raises ValueError when any of
    them is not positive.
    """

    samples: int = 4
    paths: int = 4
    depth: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.samples, self.paths, self.depth) < 1:
            found = f"{self.samples}, {self.paths} and {self.depth}"
            raise ValueError(f"expected samples, paths and depth of at least 1, found {found}")


@dataclass(frozen=True)
class _Task:
    """All that the paths of an image share; ``axes``: one pixel right, one up, and to the corner, from ``eye``."""

    model: PathModel
    lamp: Lamp
    eye: Any
    axes: tuple[Any, Any, Any]
    width: int
    options: PathOptions


class _Way(NamedTuple):
    """The next direction of a path, its probability per solid angle, and whether the path continues."""

    origin: Any
    direction: Any
    density: Any
    active: Any


def path_trace(
    model: Model, camera: PinholeCamera, light: PointLight | AreaLight, size: tuple[int, int], options: PathOptions
) -> Scene:
    """Diffuse and specular Stokes images ``[3, H, W]`` of the first surfaces, with inter-reflections; see the module.

    The mask holds the pixels whose paths all hit the mesh. With a point light and depth 1 it is what `raycast` gives,
    without noise; else noise falls with the square root of the number of paths. Surfaces that the light reaches over
    others are smoothed (`surfaces.LATER_ROUGHNESS`). Much slower where `find_variant` finds no LLVM.
    """
    return trace_paths(build_path_model(model, find_variant()), camera, light, size, options)


def trace_paths(
    model: PathModel,
    camera: PinholeCamera,
    light: PointLight | AreaLight,
    size: tuple[int, int],
    options: PathOptions,
) -> Scene:
    """`path_trace` of a model that is already built."""
    height, width = size
    pixels, paths = height * width, options.samples**2 * options.paths
    right, up, forward = camera_axes(camera).double().numpy()
    side = pixel_side(camera, height)
    corner = forward + side * (height / 2 * up - width / 2 * right)
    with in_variant(model.variant):
        right, up, corner, eye = (fixed_vector(v) for v in (side * right, side * up, corner, camera.position))
        task = _Task(model, build_lamp(light), eye, (right, up, corner), width, options)
        follow: Callable[..., NDArray[np.float32]] = _follow_together if is_fast() else _follow_one_by_one
        bands = [follow(task, first, min(PATHS_AT_ONCE, pixels - first)) for first in range(0, pixels, PATHS_AT_ONCE)]
    images = torch.from_numpy(np.concatenate(bands, axis=1)).view(OUTPUTS, height, width) / paths
    diffuse, specular = images[:-1].view(2, 3, 3, height, width)
    return Scene(Stokes(*diffuse), Stokes(*specular), images[-1] > 1 - 0.5 / paths)


def _follow_together(task: _Task, first: int, count: int) -> NDArray[np.float32]:
    """Sums over all paths of so many pixels, ``[OUTPUTS, count]``."""
    pixel = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, first)
    total = [dr.zeros(mi.Float, count) for _ in range(OUTPUTS)]
    for sample in range(task.options.samples**2):
        number = dr.opaque(mi.UInt32, sample)
        finish = _first_finish(task, pixel, number)
        for key in _keys(task.options, sample):
            found = _follow(task, pixel, number, dr.opaque(mi.UInt32, key), finish)
            total = [a + b for a, b in zip(total, found, strict=True)]
            dr.eval(total)
    return np.stack([x.numpy() for x in total])


def _follow_one_by_one(task: _Task, first: int, count: int) -> NDArray[np.float32]:
    total = np.zeros((OUTPUTS, count), np.float32)
    for k in range(count):
        for sample in range(task.options.samples**2):
            finish = _first_finish(task, first + k, sample)
            for key in _keys(task.options, sample):
                total[:, k] += _follow(task, first + k, sample, key, finish)
    return total


def _keys(options: PathOptions, sample: int) -> list[int]:
    """32 bits for each path through a point, which no two paths of all seeds share while numbers are moderate."""
    first = sample * options.paths
    return [(options.seed * 0x9E3779B9 + path * 0x85EBCA6B) % 2**32 for path in range(first, first + options.paths)]


def _camera_ray(task: _Task, pixel: Any, sample: Any) -> Any:
    n, (right, up, corner) = task.options.samples, task.axes
    row = mi.Float(pixel // task.width) + (mi.Float(sample // n) + 0.5) / n
    col = mi.Float(pixel % task.width) + (mi.Float(sample % n) + 0.5) / n
    return build_ray(task.eye, dr.normalize(corner + right * col - up * row))


def _first_finish(task: _Task, pixel: Any, sample: Any) -> Finish | None:
    """The materials of what cameras' rays meet, where the vertices do not tell them: apart, as all paths share them."""
    if task.model.materials.textures is None:
        return None
    return look_up_finish(task.model, _camera_ray(task, pixel, sample))


def _follow(task: _Task, pixel: Any, sample: Any, key: Any, finish: Finish | None) -> list[Any]:
    """One path per pixel: see `OUTPUTS`."""
    model, lamp = task.model, task.lamp
    generator: Any = mi.PCG32
    random = generator(initstate=mi.sample_tea_64(pixel, key), initseq=pixel)
    ray = _camera_ray(task, pixel, sample)
    found = model.scene.ray_intersect_preliminary(ray, True)
    hit = found.is_valid()
    if is_over(hit):
        return [0.0] * OUTPUTS
    vertex = find_vertex(model, ray, found, hit)
    vertex = finish_vertex(vertex, finish or read_finish(model, vertex, hit))
    direction, irradiance = _reach_light(task, vertex, random, FIRST_SPECULAR, hit)
    light = [scale(apply(lobe, lamp.stokes), irradiance) for lobe in white_lobes(model, vertex, direction)]
    if task.options.depth > 1 or lamp.area is not None:
        direction, density = scatter(vertex, random, FIRST_SPECULAR)
        arriving = _gather(task, _Way(vertex.above, direction, density, hit & (density > 0)), random)
        arriving = scale(arriving, dr.rcp(dr.maximum(density, LEAST)))
        lobes = white_lobes(model, vertex, direction)
        light = [add(direct, apply(lobe, arriving)) for direct, lobe in zip(light, lobes, strict=True)]
    colors = (vertex.finish.albedo, mi.Color3f(vertex.finish.strength))
    images = [s * color for stokes, color in zip(light, colors, strict=True) for s in stokes]
    return [dr.select(hit, image[c], 0.0) for image in images for c in range(3)] + [dr.select(hit, mi.Float(1), 0.0)]


def _gather(task: _Task, way: _Way, random: Any) -> Row:
    """Stokes vector in three colours of the light that comes back along a way; a point light itself is never met."""
    model, lamp, depth = task.model, task.lamp, task.options.depth

    def step(surfaces: Any, fields: Any, transport: Matrix, light: Row, random: Any) -> Any:
        way = _Way(*fields)
        ray = build_ray(way.origin, way.direction)
        found = model.scene.ray_intersect_preliminary(ray, False, way.active)
        active = way.active & found.is_valid() & (surfaces < depth)
        if lamp.area is not None:
            radiance, met = _meet_light(lamp, way, found.t)
            light = add(light, scale(apply(transport, lamp.stokes), radiance))
            active &= ~met if is_fast() else not met
        if is_over(active):
            return surfaces, (*way[:3], active), transport, light, random
        vertex = find_vertex(model, ray, found, active)
        vertex = finish_vertex(vertex, smoothed(read_finish(model, vertex, active)))
        direction, irradiance = _reach_light(task, vertex, random, LATER_SPECULAR, active)
        seen = apply(transport, apply(reflection(model, vertex, direction), lamp.stokes))
        light = add(light, _where(active, scale(seen, irradiance)))
        direction, density = scatter(vertex, random, LATER_SPECULAR)
        transport = multiply(transport, reflection(model, vertex, direction))
        rarity = dr.rcp(dr.maximum(density, LEAST))
        transport = (scale(transport[0], rarity), scale(transport[1], rarity), scale(transport[2], rarity))
        # After the last surface only an area light can be met.
        active &= (density > 0) & (surfaces + 1 < depth if lamp.area is None else surfaces < depth)
        return surfaces + 1, (vertex.above, direction, density, active), transport, light, random

    black = mi.Color3f(0.0)
    state = (mi.UInt32(1), tuple(way), identity_matrix(), (black, black, black), random)
    light: Row = dr.while_loop(state, lambda _surfaces, fields, *_: fields[3], step)[3]
    return light


def _where(active: Any, stokes: Row) -> Row:
    """0 elsewhere, whatever is there."""
    zero = mi.Color3f(0.0)
    return dr.select(active, stokes[0], zero), dr.select(active, stokes[1], zero), dr.select(active, stokes[2], zero)


def _reach_light(task: _Task, vertex: Vertex, random: Any, share: float, active: Any) -> tuple[Any, Any]:
    """Direction to a point of the light and the irradiance from there, without the cosine; 0 where hidden.

    An area light's is weighed against directions of `scatter` with this ``share`` that meet it: balance heuristic of
    Veach and Guibas 1995.
    """
    lamp, position = task.lamp, vertex.interaction.p
    target = random_point(lamp, random)
    squared = dr.squared_norm(target - position)
    direction = (target - position) * dr.rsqrt(squared)
    irradiance = lamp.intensity / squared
    if lamp.area is not None:
        cosine = dr.maximum(-dr.dot(lamp.axis, direction), 0)
        scattered = scatter_density(vertex, direction, share)
        irradiance *= cosine / (1 + scattered * lamp.area * cosine / squared)
    way = target - vertex.above
    distance = dr.norm(way)
    ray = build_ray(vertex.above, way / distance)
    ray.maxt = distance * (1 - SHORT)
    return direction, dr.select(task.model.scene.ray_test(ray, active), 0.0, irradiance)


def _meet_light(lamp: Lamp, way: _Way, limit: Any) -> tuple[Any, Any]:
    """Radiance that comes back along a way from an area light before ``limit``, weighed as `_reach_light`'s; if met."""
    distance, density = meet_lamp(lamp, way.origin, way.direction)
    met = way.active & (distance < limit)
    weight = way.density / (way.density + density)
    return dr.select(met, lamp.intensity / lamp.area * weight, 0.0), met
