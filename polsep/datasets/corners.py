"""Corners of coloured walls with objects in them, whose inter-reflections are traced by Mitsuba (extra ``mitsuba``).

The truth is that behind crossed polarizers: of light that came over another surface first, what still oscillates along
the lamp's highlights counts as specular, and all the rest as diffuse, specular reflection or not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from polsep.datasets.reality import SAMPLES, SEED, Frame, Stage, expose_frame, expose_stage, light_stage
from polsep.physics.stokes import Stokes
from polsep.render.disturbances import add_scenes, scale_light, specular_angle
from polsep.render.materials import Materials, rgb_from_hsv
from polsep.render.raycast import MeshScene, find_lit, find_view, shade_view
from polsep.render.shapes import FINE, Floats, box, join, moved, random_primitive
from polsep.render.simulate import blur
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Scene
from polsep.render.views import scene_seed

#: Paths through each of the rays of a pixel, and their surfaces at most.
PATHS, DEPTH = 24, 4
#: Blur of indirect light alone [pixels], which is smooth but for the noise of its paths.
SOFTNESS = 2.0
#: Range of the colours of walls and objects: saturation, largest channel; of their roughness; number of objects.
SATURATIONS, VALUES, ROUGHNESS, OBJECTS = (0.5, 0.95), (0.5, 0.95), (0.25, 0.6), 4


def build_corner(split: str, number: int, size: int) -> Stage:
    """Return a floor, two walls and `OBJECTS` objects, coloured and evenly painted, number ``number`` of a split."""
    seed = scene_seed(split, SEED, number, 2)
    generator = torch.Generator().manual_seed(seed)
    flat: list[Floats] = [np.zeros((FINE, FINE))] * 6
    parts = [
        moved(box(np.array(half), flat), np.eye(3), np.array(middle))
        for half, middle in (
            ([3.0, 0.1, 3.0], [0.0, -0.1, 0.0]),
            ([3.0, 2.0, 0.1], [0.0, 2.0, -2.2]),
            ([0.1, 2.0, 3.0], [-2.2, 2.0, 0.0]),
        )
    ]
    for _ in range(OBJECTS):
        x, z, a, b, c, turn = torch.rand(6, generator=generator, dtype=torch.float64).tolist()
        axes = 0.3 + 0.4 * np.array([a, b, c])
        turned = np.array([[math.cos(turn), 0, math.sin(turn)], [0, 1, 0], [-math.sin(turn), 0, math.cos(turn)]])
        place = np.array([-1.5 + 2.8 * x, float(axes[1]), -1.5 + 2.8 * z])
        parts.append(moved(random_primitive(axes, generator), turned, place))
    shape = MeshScene(join(*parts))
    hue, saturation, value, rough = torch.rand(4, shape.mesh.slot_count, generator=generator)
    spans = ((SATURATIONS, saturation), (VALUES, value), (ROUGHNESS, rough))
    saturation, value, rough = (low + (high - low) * x for (low, high), x in spans)
    materials = Materials(rgb_from_hsv(hue, saturation, value), rough, torch.ones_like(rough))
    x, y, polarizer = torch.rand(3, generator=generator).tolist()
    light = PointLight((1.0 + 3 * x, 2.0 + 2 * y, 6.0), 100.0, math.pi * polarizer)
    camera = PinholeCamera((2.5, 2.6, 6.5), (-0.4, 0.8, -0.4), 28.0)
    view = find_view(shape, camera, (size, size), SAMPLES)
    return expose_stage(Stage(shape, view, materials, light, 0.5, 1.0, seed))


def trace_indirect(stage: Stage) -> Scene:
    """Return the indirect light of a stage, its lobes told apart as `pathtrace.path_trace` does."""
    from polsep.render.pathtrace import PathOptions, path_trace

    options = PathOptions(SAMPLES, PATHS, DEPTH)
    traced = path_trace((stage.shape, stage.materials), stage.view.camera, stage.light, stage.view.size, options)
    direct = shade_view(stage.view, stage.materials, stage.light, find_lit(stage.shape, stage.view, stage.light))
    return scale_light(blur(add_scenes(traced, scale_light(direct, -1.0)), SOFTNESS), stage.gain)


def add_traced(direct: Scene, indirect: Scene) -> Scene:
    """Return direct and indirect light together, with the truth of the module."""
    angle, specular = 2 * specular_angle(direct), indirect.specular
    along = (specular.s1 * angle.cos() + specular.s2 * angle.sin()).clamp(min=0)
    along = torch.minimum(along, specular.s0.clamp(min=0))
    kept = Stokes(along, along * angle.cos(), along * angle.sin())
    rest = specular + kept * -1.0
    return replace(direct, diffuse=direct.diffuse + indirect.diffuse + rest, specular=direct.specular + kept)


def corner_frame(stage: Stage) -> Frame:
    """Return the frame with inter-reflections of a corner, exposed as its ideal twin."""
    return expose_frame(stage, add_traced(light_stage(stage), trace_indirect(stage)))
