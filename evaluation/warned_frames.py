"""Frames of known condition, by which warnings are judged: what each deserves, from own renders and from real frames.

Own renders are stages of `datasets.reality` with the looks of `LOOKS`, from seeds of `views.scene_seed` with number
`SEED`. `CONDITIONS` makes frames of a stage: clean ones, which deserve no warning, and others that deserve one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from evaluation.testsets.cases import build_cases
from evaluation.testsets.photographs import PHOTOGRAPHS
from polsep.datasets import reality
from polsep.datasets.reality import Capture, Frame, Stage, expose_frame, expose_stage, light_stage
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.store.image_codecs import through_jpeg
from polsep.physics.stokes import Measurements
from polsep.render.disturbances import LAMPS, add_scenes, depolarize_lamp, scale_light
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import find_view
from polsep.render.sensor_errors import SensorErrors, encode_gamma, record
from polsep.render.simulate import expose_to_clip, expose_to_level
from polsep.render.sphere_tracing import PointLight, Scene
from polsep.render.views import random_shot, scene_seed, seeded_shape
from polsep.sensor.camera import IMX250, Layout, Mosaic

#: Seed of all stages, which nothing else uses.
SEED = 2707
#: What a frame may deserve to be warned of.
KINDS = ("light", "lamps", "layout", "black level", "encoding", "defects", "exposure")
#: Windows and lamps of a room, beside its even light, and the share of the even light.
WINDOWS, EVEN = (1, 5), 0.3
#: Distance of the camera from small objects, relative to that of others.
FARTHER = 4.0
#: Quality of JPEG files.
JPEG_QUALITY = 95
MONO = Layout(bayer=None)


@dataclass(frozen=True)
class Known:
    """A frame and its condition: ``look`` and ``condition`` name it, ``deserves`` is one of `KINDS`, None if clean."""

    look: str
    condition: str
    deserves: str | None
    mosaic: Mosaic


Change = Callable[[Materials, torch.Generator], Materials]


def _painted(albedo: tuple[float, float], rough: tuple[float, float], strength: float, color: float) -> Change:
    """Materials with largest albedo, roughness and strength of the specular lobe in ranges; ``color``: saturation."""

    def paint(materials: Materials, generator: torch.Generator) -> Materials:
        def spread(values: torch.Tensor, low: float, high: float) -> torch.Tensor:
            return low + (high - low) * values

        def tone(colors: torch.Tensor) -> torch.Tensor:
            grey = colors.amax(dim=1, keepdim=True)
            return (grey + color * (colors - grey)) / grey.clamp(min=1e-6) * spread(grey.clamp(0, 1), *albedo)

        textures = materials.textures
        if textures is not None:
            textures = replace(textures, albedo=tone(textures.albedo), roughness=spread(textures.roughness, *rough))
        lobes = torch.full_like(materials.specular, strength)
        return Materials(tone(materials.albedo), spread(materials.roughness, *rough), lobes, textures)

    return paint


def _one_paint(materials: Materials, generator: torch.Generator) -> Materials:
    """One colour on all, without textures."""
    return Materials(
        materials.albedo[:1].expand_as(materials.albedo).contiguous(), materials.roughness, materials.specular
    )


#: Looks of stages: as the reality sets have them, and extremes that must not be warned of.
LOOKS: dict[str, Change] = {
    "usual": lambda materials, generator: materials,
    "matte": _painted((0.1, 0.9), (0.6, 0.9), 0.3, 1.0),
    "white": _painted((0.8, 0.95), (0.2, 0.7), 1.0, 0.05),
    "black": _painted((0.01, 0.05), (0.2, 0.6), 1.0, 0.3),
    "glossy": _painted((0.1, 0.8), (0.08, 0.25), 1.0, 1.0),
    "small": lambda materials, generator: materials,
    "sheen": _painted((0.4, 0.8), (0.45, 0.7), 1.0, 0.5),
    "one colour": _one_paint,
}


def build_look(split: str, look: str, number: int, size: int) -> Stage:
    """Return random surfaces of a look, number ``number`` of a split; as many highlights as there happen to be."""
    place = len(LOOKS) * number + list(LOOKS).index(look)
    shape = seeded_shape(split, SEED, place)
    generator = torch.Generator().manual_seed(scene_seed(split, SEED, place, 0))
    shot = random_shot(shape, generator)
    materials = LOOKS[look](random_materials(shape.mesh.slot_count, generator, shape.size), generator)
    camera = shot.camera
    if look == "small":
        x, y, z = (t + FARTHER * (p - t) for p, t in zip(camera.position, camera.target, strict=True))
        camera = replace(camera, position=(x, y, z))
    view = find_view(shape, camera, (size, size), reality.SAMPLES)
    seed = scene_seed(split, SEED, place, 1)
    return expose_stage(Stage(shape, view, materials, shot.light, shot.blur, 1.0, seed))


def _mosaic(frame: Frame) -> Mosaic:
    data = torch.from_numpy(frame.raw.astype(np.float32))
    return Mosaic(data, Layout(), 0.0, frame.white_level)


def _exposed(stage: Stage, scene: Scene, share: float = 0.001) -> Mosaic:
    """A frame exposed until ``share`` of the object's samples clips, more if that leaves it dark."""
    exposed = expose_to_clip(scene, share, Layout(), IMX250)
    return _mosaic(expose_frame(stage, expose_to_level(exposed, reality.LEVEL, Layout(), IMX250)))


def _unpolarized(stage: Stage, light: PointLight | None = None) -> Scene:
    """The stage under a lamp without a polarizer."""
    light = light or stage.light
    crossed = replace(light, polarizer=light.polarizer + math.pi / 2)
    return depolarize_lamp(light_stage(stage, light), 0.0, light_stage(stage, crossed))


def _in_room(stage: Stage) -> Scene:
    """The stage in a room: a few unpolarized windows or lamps of different strength, and even light all around."""
    generator = stage.draw(11)
    count = int(torch.randint(WINDOWS[0], WINDOWS[1] + 1, (1,), generator=generator))
    scene = reality.light_room(stage, EVEN)
    even = float(light_stage(stage).diffuse.s0.mean())
    for _ in range(count):
        x, y, z = torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0).tolist()
        far = 20 * stage.shape.size
        lit = _unpolarized(stage, PointLight((far * x, far * abs(y), far * z), far**2, 0.0))
        strength = float(torch.rand(1, generator=generator)) / count
        scene = add_scenes(scene, scale_light(lit, strength * even / max(float(lit.diffuse.s0.mean()), 1e-9)))
    return scene


def _two_lamps(degrees: float) -> Callable[[Stage], Mosaic]:
    return lambda stage: _exposed(stage, reality.light_by_two(stage, degrees))


def _by_reality(name: str) -> Callable[[Stage], Mosaic]:
    return lambda stage: _mosaic(reality.DISTURBANCES[name](stage))


def _by_sensor(layout: Layout, errors: SensorErrors | None = None) -> Callable[[Stage], Mosaic]:
    """Recorded behind a layout; what is shown is that the frame is read as Sony's colour order."""

    def make(stage: Stage) -> Mosaic:
        light = light_stage(stage)
        total = light.diffuse + light.specular
        if layout.bayer is None:
            total = total.map(lambda s: s.mean(dim=-3, keepdim=True))
        return record(total, layout, IMX250, errors or SensorErrors(specimen=stage.seed % 1000), stage.seed)

    return make


def _read_as(make: Callable[[Stage], Mosaic], layout: Layout) -> Callable[[Stage], Mosaic]:
    return lambda stage: replace(make(stage), layout=layout)


def _moved(rows: int, cols: int, layout: Layout) -> Callable[[Stage], Mosaic]:
    """A crop that starts so many rows and columns inside the sensor's frame, read as if it did not."""

    def make(stage: Stage) -> Mosaic:
        frame = _by_sensor(layout)(stage)
        return replace(frame, data=frame.data[rows:, cols:].contiguous())

    return make


def _transposed(stage: Stage) -> Mosaic:
    """Rows and columns exchanged, read as if they were not."""
    frame = _by_sensor(Layout())(stage)
    return replace(frame, data=frame.data.mT.contiguous())


def _in_color(stage: Stage) -> Mosaic:
    names = list(LAMPS)
    return _mosaic(expose_frame(stage, light_stage(stage), Capture(LAMPS[names[stage.seed % len(names)]])))


def _clipped(share: float) -> Callable[[Stage], Mosaic]:
    return lambda stage: _exposed(stage, light_stage(stage), share)


def _compressed(stage: Stage) -> Mosaic:
    frame = reality.DISTURBANCES["8 bits"](stage)
    return _mosaic(replace(frame, raw=through_jpeg(frame.raw.astype(np.uint8), JPEG_QUALITY)))


def _encoded(stage: Stage) -> Mosaic:
    return encode_gamma(_by_sensor(Layout())(stage))


#: What is done to a stage, and what its frame deserves to be warned of.
CONDITIONS: dict[str, tuple[str | None, Callable[[Stage], Mosaic]]] = {
    "white lamp": (None, _by_reality("white lamp")),
    "coloured lamp": (None, _in_color),
    "mono": (None, _by_sensor(MONO)),
    "usual rig": (None, _by_reality("usual rig")),
    "room light 10 %": (None, _by_reality("room light 10 %")),
    "retained 5 %": (None, _by_reality("retained 5 %")),
    "polarizer 0.9": (None, _by_reality("polarizer 0.9")),
    "a tenth of the exposure": (None, _by_reality("a tenth of the exposure")),
    "clipped 1 %": (None, _clipped(0.01)),
    "8 bits": (None, _by_reality("8 bits")),
    "no polarizer": ("light", lambda stage: _exposed(stage, _unpolarized(stage))),
    "room without a lamp": ("light", lambda stage: _exposed(stage, _in_room(stage))),
    "two lamps, 90 degrees": ("lamps", _two_lamps(90)),
    "two lamps, 45 degrees": ("lamps", _two_lamps(45)),
    "mono read as colour": ("layout", _read_as(_by_sensor(MONO), Layout())),
    "colour read as mono": ("layout", _read_as(_by_sensor(Layout()), MONO)),
    "cropped by 1 row": ("layout", _moved(1, 0, Layout())),
    "cropped by 2 columns": ("layout", _moved(0, 2, Layout())),
    "transposed": ("layout", _transposed),
    "black level 16": ("black level", _by_reality("black level 16")),
    "black level 240": ("black level", _by_reality("black level 240")),
    "gamma": ("encoding", _encoded),
    "JPEG": ("encoding", _compressed),
    "defects 0.1 %": ("defects", _by_reality("defects 0.1 %")),
    "clipped 5 %": ("exposure", _clipped(0.05)),
    "clipped 20 %": ("exposure", _clipped(0.2)),
}


def own_frames(split: str, numbers: range, size: int, conditions: tuple[str, ...] = ()) -> Iterator[Known]:
    """Yield frames of all looks and conditions, stage after stage."""
    for number in numbers:
        for look in LOOKS:
            stage = build_look(split, look, number, size)
            for name, (deserves, make) in CONDITIONS.items():
                if not conditions or name in conditions:
                    yield Known(look, name, deserves, make(stage))


def real_frames(data: Path) -> Iterator[Known]:
    """Yield the real frames of the data folder: what ordinary light, a lamp behind a polarizer, and photographs give.

    Photographs behind crossed polarizers are clean: their specular light gets one AoLP. Frames that need to be read in
    a wrong way to deserve a warning are those of a known layout.
    """
    for path in sorted((data / "raw").glob("*.png")):
        true = Layout() if "quadbayer" in path.stem else MONO
        frame = next(read_frames(path, ReadOptions(true))).data
        assert isinstance(frame, Mosaic)
        yield from _real(path.stem, "encoding" if path.stem.startswith("polarizer") else "light", frame)
    for folder in sorted((data / "four_angle").iterdir()):
        yield from _real(folder.name, "light", sample_angles(folder, "{angle}.png", Layout(), None))
    for folder in sorted((data / "polarized_light").iterdir()):
        yield from _real(folder.name, None, sample_angles(folder, "nir_{angle}.png", MONO, 65520.0))
    for case in build_cases(PHOTOGRAPHS, data):
        yield from _real(case.name, None, case.noisy)


def sample_angles(folder: Path, name: str, layout: Layout, white: float | None) -> Mosaic:
    """The mosaic whose samples are those of four angle images at the same pixels."""
    images = next(read_frames(folder / name, ReadOptions(layout, white_level=white))).data
    assert isinstance(images, Measurements)
    degrees = [round(math.degrees(angle)) for angle in images.angles]
    height, width = (n // 4 * 4 for n in images.data.shape[-2:])
    samples = np.zeros((height, width), np.float32)
    for row in range(4):
        for col in range(4):
            own = layout.filter_at(row, col)
            plane = images.data[degrees.index(round(own.angle_deg)), own.channel]
            samples[row::4, col::4] = plane[row:height:4, col:width:4]
    span = 255.0 if white is None else white
    return Mosaic((samples * span).round(), layout, 0.0, span)


def _real(name: str, deserves: str | None, frame: Mosaic) -> Iterator[Known]:
    """A real frame as it is, and read in a wrong way."""
    condition = "real, " + ("one lamp" if deserves is None else "ordinary light" if deserves == "light" else deserves)
    yield Known(name, condition, deserves, frame)
    if frame.layout.bayer is None:
        yield Known(name, "real, mono read as colour", "layout", replace(frame, layout=Layout()))
    else:
        yield Known(name, "real, colour read as mono", "layout", replace(frame, layout=MONO))
        yield Known(name, "real, cropped by 1 row", "layout", replace(frame, data=frame.data[1:]))
