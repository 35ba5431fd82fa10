"""Twins of ideal frames: the same scene and noise, disturbed in one way each, with known truth.

A `Stage` is a scene that can be lit again: with another lamp, another polarizer, in a room. `DISTURBANCES` names what
can differ; each makes a `Frame` of a stage. The undisturbed twin of all of them is `ideal_frame`: a lamp that the
camera sees as white and a polarizer that is perfect, in a dark room, by a sensor without errors.

Truth is that of `render.disturbances`: specular is the light of the lamps mirrored at surfaces, diffuse is all else.
A frame's ``unit`` brings its images to the ideal twin's white light and exposure; scores are of images over it. Seeds
are of `render.views.scene_seed` with number `SEED`, which nothing else uses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.physics.stokes import Stokes
from polsep.render.disturbances import (
    LAMPS,
    METALS,
    add_scenes,
    add_veiling_glare,
    as_color,
    depolarize_lamp,
    random_field,
    retain_polarization,
    scale_light,
    shift_colors,
)
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import MeshScene, View, find_lit, find_view, shade_view
from polsep.render.room import Around, as_room, even_directions, light_from_around, roughen
from polsep.render.sensor_errors import SensorErrors, encode_gamma, record
from polsep.render.simulate import blur, expose_to_clip, expose_to_level, half_resolution
from polsep.render.sphere_tracing import PointLight, Scene
from polsep.render.views import random_light, random_shot, scene_seed, seeded_shape
from polsep.sensor.camera import IMX250, Layout, Mosaic, Sensor

#: Seed of all stages; the split is of `views.SPLITS`.
SEED = 27
#: Rays along a pixel's side.
SAMPLES = 2
#: Exposure of ideal frames: share of clipped samples, and least median of the lit ones (white = 1).
CLIPPED, LEVEL = 0.001, 0.05
#: Least specular over diffuse light of a stage, and most draws of one: without highlights methods hardly differ.
LEAST_SPECULAR, MAX_DRAWS = 0.02, 20
#: Directions of a room's light, least roughness of its reflections, which blurs single directions, and how much
#: brighter its bright side is than its mean.
ROOM_LIGHTS, ROOM_ROUGHNESS, ROOM_CONTRAST = 16, 0.5, 0.8
#: Range of a room light's red and blue over the lamp's, green = 1.
ROOM_COLORS = (0.75, 1.25)
#: Share of an object that is to be metal at most, and least roughness of metal.
METAL_SHARE, METAL_ROUGHNESS = 0.4, 0.35
#: Raw colour of the lamp of `SHEENS`, a bluish LED, and tint of their highlights.
SHEEN_LAMP, SHEEN_TINT = (0.6, 1.0, 1.15), (1.0, 0.94, 0.88)
#: A sensor with less extinction, and its errors; frames that calibrate it; `RIG` is a good camera as it comes.
WORN = Sensor(10_500.0, 2.4, 12, (49 / 51, 79 / 81, 59 / 61))
BAD = SensorErrors(angles_deg=1.5, gains=0.03, period_gains=0.02, cross_talk=0.02, defects=3e-4)
FLATS, TURNS = 6, 8
RIG = SensorErrors(angles_deg=1.0, gains=0.01, cross_talk=0.02)
#: Raw colour of a saturated lamp, an amber LED.
AMBER = (1.70, 1.0, 0.08)


@dataclass(frozen=True, eq=False)
class Stage:
    """A view of surfaces with materials under a lamp, all that a frame needs but the disturbance.

    ``gain``: exposure of its ideal frame. ``softness``: of the lens. ``seed``: of its noise and of what it draws.
    ``layout``: of the sensor; one without colour filters records the green light.
    """

    shape: MeshScene
    view: View
    materials: Materials
    light: PointLight
    softness: float
    gain: float
    seed: int
    layout: Layout = field(default_factory=Layout)

    def draw(self, use: int) -> torch.Generator:
        """Return a generator for one ``use`` of random numbers."""
        return torch.Generator().manual_seed(self.seed + 7919 * use)


@dataclass(frozen=True)
class Frame:
    """A raw frame and its truth at half resolution: ``diffuse``, ``specular [C, h, w]``, ``mask [h, w]``.

    ``unit [C, 1, 1]``: see the module. ``options``: of `polsep.separate`, stating what differs; None: there is
    nothing to state.
    """

    raw: NDArray[Any]
    white_level: float
    diffuse: Tensor
    specular: Tensor
    mask: Tensor
    unit: Tensor
    layout: Layout
    options: dict[str, Any] | None = None


@dataclass(frozen=True)
class Capture:
    """Arguments of `expose_frame` beyond the scene: ``color`` and ``exposure`` make the frame's unit."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure: float = 1.0
    sensor: Sensor = IMX250
    errors: SensorErrors = field(default_factory=SensorErrors)


def build_stage(split: str, number: int, size: int, layout: Layout | None = None) -> Stage:
    """Return random textured surfaces, number ``number`` of a split, before a sensor in Sony's order or another one."""
    shape = seeded_shape(split, SEED, number)
    generator = torch.Generator().manual_seed(scene_seed(split, SEED, number, 0))
    for _ in range(MAX_DRAWS):
        shot = random_shot(shape, generator)
        materials = random_materials(shape.mesh.slot_count, generator, shape.size)
        view = find_view(shape, shot.camera, (size, size), SAMPLES)
        seed = scene_seed(split, SEED, number, 1)
        stage = Stage(shape, view, materials, shot.light, shot.blur, 1.0, seed, layout or Layout())
        scene = light_stage(stage)
        if float(scene.specular.s0.mean()) > LEAST_SPECULAR * float(scene.diffuse.s0.mean()):
            break
    return expose_stage(stage)


def build_mannequin(split: str, number: int, size: int) -> Stage:
    """Return the same shapes in skin-coloured paint of a broad sheen."""
    stage = build_stage(split, number, size)
    generator, slots = stage.draw(1), stage.materials.roughness.numel()
    shade, rough = torch.rand(2, slots, generator=generator)
    albedo = torch.tensor([0.75, 0.55, 0.45]) * (0.8 + 0.4 * shade[:, None])
    return expose_stage(replace(stage, materials=Materials(albedo, 0.45 + 0.3 * rough, torch.ones(slots)), gain=1.0))


def expose_stage(stage: Stage) -> Stage:
    """Return the stage with the gain of its ideal frame; that of ``stage`` must be 1."""
    scene = as_recorded(light_stage(stage), stage.layout)
    exposed = expose_to_level(expose_to_clip(scene, CLIPPED, stage.layout, IMX250), LEVEL, stage.layout, IMX250)
    return replace(stage, gain=float(exposed.diffuse.s0.double().sum() / scene.diffuse.s0.double().sum()))


def light_stage(stage: Stage, light: PointLight | None = None, materials: Materials | None = None) -> Scene:
    """Return the stage under its own lamp or another ``light``, with its own or other ``materials``."""
    light, materials = light or stage.light, materials or stage.materials
    scene = shade_view(stage.view, materials, light, find_lit(stage.shape, stage.view, light))
    return scale_light(blur(scene, stage.softness), stage.gain)


def as_recorded(scene: Scene, layout: Layout) -> Scene:
    """Return the colours of a scene that a sensor tells apart: all, or without filters the green light alone."""
    if layout.channels > 1:
        return scene
    diffuse, specular = (light.map(lambda s: s[1:2]) for light in (scene.diffuse, scene.specular))
    return replace(scene, diffuse=diffuse, specular=specular)


def _turned(light: PointLight) -> PointLight:
    """The lamp with its polarizer turned by 90 degrees."""
    return replace(light, polarizer=light.polarizer + math.pi / 2)


def _with_polarizer(stage: Stage, degree: float) -> Scene:
    return depolarize_lamp(light_stage(stage), degree, light_stage(stage, _turned(stage.light)))


def _through_polarizer(degree: float) -> Callable[[Stage], Frame]:
    return lambda stage: expose_frame(stage, _with_polarizer(stage, degree), options={"lamp_dolp": degree})


def light_room(stage: Stage, share: float) -> Scene:
    """Return the stage in unpolarized room light alone: all of it diffuse, polarized as Fresnel's equations have it.

    `ROOM_LIGHTS` distant lights all around, brighter on one side, of one colour. ``share``: mean of the light that
    they reflect diffusely over that of the lamp, on the mask.
    """
    low, high = ROOM_COLORS
    red, blue = (low + (high - low) * torch.rand(2, generator=stage.draw(2))).tolist()
    return as_room(_light_around(stage), light_stage(stage), share, as_color((red, 1.0, blue)))


@lru_cache(maxsize=1)
def _light_around(stage: Stage) -> Scene:
    """The stage under white lights all around, without a lamp."""
    bright = torch.nn.functional.normalize(torch.randn(3, generator=stage.draw(6)), dim=0)
    directions = even_directions(ROOM_LIGHTS)
    around = Around(directions, 1 + ROOM_CONTRAST * (directions @ bright), 50 * stage.shape.size)
    rough = roughen(stage.materials, ROOM_ROUGHNESS)
    return light_from_around(lambda light: light_stage(stage, light, rough), around)


def expose_frame(
    stage: Stage, scene: Scene, capture: Capture | None = None, options: dict[str, Any] | None = None
) -> Frame:
    """Return the frame that a sensor records of a scene, after its colour and exposure. ``options``: of the frame."""
    capture = capture or Capture()
    unit = capture.exposure * as_color(capture.color)
    lit = as_recorded(scale_light(scene, unit), stage.layout)
    mosaic = record(lit.diffuse + lit.specular, stage.layout, capture.sensor, capture.errors, stage.seed)
    if stage.layout.channels == 1:  # one colour of unknown light, which is not stated
        unit, options = unit[1:2], {k: v for k, v in (options or {}).items() if k != "light_color"} or None
    return _as_frame(mosaic, lit, unit, options)


def _as_frame(mosaic: Mosaic, scene: Scene, unit: Tensor, options: dict[str, Any] | None) -> Frame:
    diffuse, specular, mask = half_resolution(scene)
    kind = np.uint8 if mosaic.white_level < 256 else np.uint16
    raw = mosaic.data.numpy().astype(kind)
    return Frame(raw, mosaic.white_level, diffuse, specular, mask, unit, mosaic.layout, options)


def ideal_frame(stage: Stage) -> Frame:
    """Return the undisturbed twin; its options state that the light is white."""
    return expose_frame(stage, light_stage(stage), options={"light_color": (1.0, 1.0, 1.0)})


def _in_color(color: tuple[float, float, float]) -> Callable[[Stage], Frame]:
    return lambda stage: expose_frame(stage, light_stage(stage), Capture(color), {"light_color": color})


def _in_room(share: float) -> Callable[[Stage], Frame]:
    shorter = Capture(exposure=1 / (1 + share))
    return lambda stage: expose_frame(stage, add_scenes(light_stage(stage), light_room(stage, share)), shorter)


def _less_dark_frame(share: float) -> Callable[[Stage], Frame]:
    """In a room, with a frame without the lamp; the truth is that of the lamp alone."""

    def make(stage: Stage) -> Frame:
        lamp, room = light_stage(stage), light_room(stage, share)
        shorter = Capture(exposure=1 / (1 + share))
        dark = expose_frame(replace(stage, seed=stage.seed + 1), room, shorter)
        frame = expose_frame(stage, add_scenes(lamp, room), shorter, {"ambient": dark.raw})
        diffuse, specular, _ = half_resolution(scale_light(as_recorded(lamp, stage.layout), shorter.exposure))
        return replace(frame, diffuse=diffuse, specular=specular)

    return make


def _by_sensor(options: dict[str, Any] | None = None, **errors: float) -> Callable[[Stage], Frame]:
    def make(stage: Stage) -> Frame:
        found = SensorErrors(**errors, specimen=stage.seed % 1000)
        return expose_frame(stage, light_stage(stage), Capture(errors=found), options)

    return make


def _changed(change: Callable[[Scene], Scene]) -> Callable[[Stage], Frame]:
    return lambda stage: expose_frame(stage, change(light_stage(stage)))


def light_by_two(stage: Stage, degrees: float) -> Scene:
    """Return the stage under its lamp and as much light from another one, polarizers so many ``degrees`` apart."""
    second = random_light(stage.view.camera, stage.shape.size / 2, stage.draw(3))
    second = replace(second, polarizer=stage.light.polarizer + math.radians(degrees))
    first, other = light_stage(stage), light_stage(stage, second)
    even = first.diffuse.s0.mean() / other.diffuse.s0.mean().clamp(min=1e-9)
    return add_scenes(first, scale_light(other, even))


def _metals(only_dielectrics: bool) -> Callable[[Stage], Frame]:
    """Gold, copper or aluminium in some slots; scored on all, or on the other slots."""

    def make(stage: Stage) -> Frame:
        chosen, generator = _choose_slots(stage), stage.draw(4)
        color = as_color(METALS[("gold", "copper", "aluminium")[int(torch.randint(3, (1,), generator=generator))]])
        m, kept = stage.materials, (~chosen).float()
        textures = m.textures and replace(m.textures, albedo=m.textures.albedo * kept[:, None])
        bodies = replace(m, albedo=m.albedo * kept[:, None], specular=m.specular * kept, textures=textures)
        mirror = Materials(0 * m.albedo, m.roughness.clamp(min=METAL_ROUGHNESS), (1 - kept) / 0.04)
        scene = add_scenes(
            light_stage(stage, materials=bodies), scale_light(light_stage(stage, materials=mirror), color)
        )
        frame = expose_frame(stage, scene)
        return replace(frame, mask=frame.mask & ~_cells_of(stage, chosen)) if only_dielectrics else frame

    return make


def _choose_slots(stage: Stage) -> Tensor:
    """Slots ``[S]``, bool, the largest ones that together cover at most `METAL_SHARE` of the hits, at least one."""
    slots = torch.cat([band.hits.slot for band in stage.view.bands])
    counts = torch.bincount(slots, minlength=stage.materials.roughness.numel())
    chosen, covered = torch.zeros(len(counts), dtype=torch.bool), 0
    for slot in counts.argsort(descending=True).tolist():
        if covered + counts[slot] <= METAL_SHARE * len(slots):
            chosen[slot], covered = True, covered + int(counts[slot])
    if not bool((counts[chosen] > 0).any()):
        chosen[int(torch.where(counts > 0, counts, counts.max() + 1).argmin())] = True
    return chosen


def _cells_of(stage: Stage, chosen: Tensor) -> Tensor:
    """Cells ``[h, w]`` of which any ray hits a chosen slot, and those beside them, where the lens blurs."""
    pixels = torch.zeros(stage.view.size[0] * stage.view.size[1])
    for band in stage.view.bands:
        pixels[band.pixels[0] + band.pixel[chosen[band.hits.slot]]] = 1
    image = pixels.view(1, 1, *stage.view.size)
    return avg_pool2d(torch.nn.functional.max_pool2d(image, 5, 1, 2), 2)[0, 0] > 0


def _clipped(share: float) -> Callable[[Stage], Frame]:
    def make(stage: Stage) -> Frame:
        scene = light_stage(stage)
        recorded = as_recorded(scene, stage.layout)
        exposed = expose_to_clip(recorded, share, stage.layout, IMX250)
        exposure = float(exposed.diffuse.s0.double().sum() / recorded.diffuse.s0.double().sum())
        return expose_frame(stage, scene, Capture(exposure=exposure))

    return make


def _with_gamma(stage: Stage) -> Frame:
    scene = light_stage(stage)
    mosaic = record((scene.diffuse + scene.specular), Layout(), IMX250, SensorErrors(), stage.seed)
    return _as_frame(encode_gamma(mosaic), scene, torch.ones(3, 1, 1), None)


def _in_8_bits(stage: Stage) -> Frame:
    frame = expose_frame(stage, light_stage(stage))
    return replace(frame, raw=np.rint(frame.raw * (255 / frame.white_level)).astype(np.uint8), white_level=255.0)


def _usual_rig(stage: Stage) -> Frame:
    """IMX250, its usual errors, a polarizer of 0.98, 5 % room light, daylight before the sensor's filters."""
    degree, color = 0.98, LAMPS["daylight"]
    scene = add_scenes(_with_polarizer(stage, degree), light_room(stage, 0.05))
    errors = replace(RIG, specimen=stage.seed % 1000)
    return expose_frame(stage, scene, Capture(color, errors=errors), {"light_color": color, "lamp_dolp": degree})


def ideal_mannequin(stage: Stage) -> Frame:
    """Return the undisturbed twin of `SHEENS`: white highlights and unpolarized diffuse light under a white lamp."""
    return expose_frame(stage, _unpolarized(light_stage(stage)), options={"light_color": (1.0, 1.0, 1.0)})


def _unpolarized(scene: Scene) -> Scene:
    return replace(scene, diffuse=Stokes(scene.diffuse.s0, 0 * scene.diffuse.s1, 0 * scene.diffuse.s2))


def _mannequin(contrast: float) -> Callable[[Stage], Frame]:
    """Tinted highlights under a bluish lamp; their tint varies over the surface."""

    def make(stage: Stage) -> Frame:
        scene = _unpolarized(light_stage(stage))
        places = random_field((3, *stage.view.size), 6, contrast, stage.draw(5))
        tinted = replace(scene, specular=scene.specular * (as_color(SHEEN_TINT) * places))
        r, g, b = (lamp * tint for lamp, tint in zip(SHEEN_LAMP, SHEEN_TINT, strict=True))
        return expose_frame(stage, tinted, Capture(SHEEN_LAMP), {"light_color": (r, g, b)})

    return make


def _bad_sensor(stage: Stage) -> Frame:
    errors = replace(BAD, specimen=stage.seed % 1000)
    return expose_frame(stage, light_stage(stage), Capture(sensor=WORN, errors=errors))


def calibration_frames(stage: Stage) -> tuple[list[Mosaic], list[Mosaic]]:
    """Return frames of the stage's bad sensor: of even unpolarized light, and behind a polarizer turned in `TURNS`."""
    errors, one = replace(BAD, specimen=stage.seed % 1000), torch.ones(3, *stage.view.size)
    lights = [Stokes(one, 0 * one, 0 * one)] * FLATS
    for turn in range(TURNS):
        angle = 2 * math.pi * turn / TURNS
        lights.append(Stokes(one, math.cos(angle) * one, math.sin(angle) * one))
    # An analyser along the polarizer is near the white level.
    found = [record(light * 0.9, Layout(), WORN, errors, stage.seed + 100 + k) for k, light in enumerate(lights)]
    return found[:FLATS], found[FLATS:]


#: What can differ from the ideal twin, by name.
DISTURBANCES: dict[str, Callable[[Stage], Frame]] = {
    "white lamp": ideal_frame,
    "daylight balance": _in_color(LAMPS["daylight"]),
    "tungsten": _in_color(LAMPS["tungsten"]),
    "amber LED": _in_color(AMBER),
    "room light 10 %": _in_room(0.1),
    "room light 30 %": _in_room(0.3),
    "room light 30 %, lamp-off frame": _less_dark_frame(0.3),
    "defects 0.01 %": _by_sensor(defects=1e-4),
    "defects 0.1 %": _by_sensor(defects=1e-3),
    "black level 16": _by_sensor({"black_level": 16}, black=16 / 4095),
    "black level 64": _by_sensor({"black_level": 64}, black=64 / 4095),
    "black level 240": _by_sensor({"black_level": 240}, black=240 / 4095),
    "retained 5 %": _changed(lambda scene: retain_polarization(scene, 0.05)),
    "polarizer 0.9": _through_polarizer(0.9),
    "polarizer 0.8": _through_polarizer(0.8),
    "two lamps": lambda stage: expose_frame(stage, scale_light(light_by_two(stage, 90), 0.5)),
    "metals": _metals(False),
    "dielectrics beside metals": _metals(True),
    "clipped 1 %": _clipped(0.01),
    "clipped 5 %": _clipped(0.05),
    "a tenth of the exposure": lambda stage: expose_frame(stage, light_stage(stage), Capture(exposure=0.1)),
    "veiling glare 3 %": _changed(lambda scene: add_veiling_glare(scene, 0.03)),
    "chromatic aberration 0.1 %": _changed(lambda scene: shift_colors(scene, 0.001, -0.001)),
    "8 bits": _in_8_bits,
    "8 bits, gamma": _with_gamma,
    "bad sensor": _bad_sensor,
    "usual rig": _usual_rig,
}
#: Those of mono frames, which have no colour to be wrong about.
MONO: dict[str, Callable[[Stage], Frame]] = {
    name: DISTURBANCES[name]
    for name in (
        "room light 10 %",
        "room light 30 %",
        "room light 30 %, lamp-off frame",
        "defects 0.1 %",
        "black level 240",
        "retained 5 %",
        "polarizer 0.9",
        "polarizer 0.8",
        "two lamps",
        "metals",
        "dielectrics beside metals",
        "clipped 1 %",
        "clipped 5 %",
        "a tenth of the exposure",
        "bad sensor",
        "usual rig",
    )
}
#: The same for stages of `build_mannequin`.
SHEENS: dict[str, Callable[[Stage], Frame]] = {
    "mannequin, even tint": _mannequin(0.0),
    "mannequin, uneven tint": _mannequin(0.1),
}
