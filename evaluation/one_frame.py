"""Scores of shape from one frame on the objects of selection set (b): by what a network sees, and without a network.

Every object of `six_lights.load_subjects` is photographed as `KINDS` say, each time by one lamp within `LARGEST_DEG` of
the camera, behind a polarizer at any angle, in 512 x 512 raw pixels with noise; the mask is given, the lamp's direction
where a row says so. Frames of a usual rig are those of glossy objects, in room light, by a lamp that is not white to
the sensor, behind an imperfect polarizer, with a sensor's errors, and nothing stated. "separated" is what ships.
Networks of equal size and training, less than that of what ships, see the separated images and their polarization
(`EQUAL`), the measured Stokes images, or s0 alone; "perfect" sees true images. Needs the extra ``bench``.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import flip_evaluator
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from evaluation.six_lights import SEED, Subject, cast_bands, load_subjects, pool_band
from evaluation.testsets.casting import LENS_BLUR, random_light_near
from polsep.bench.rows import Row
from polsep.datasets.reality import RIG
from polsep.demosaic.measured_stokes import measured_stokes
from polsep.geometry.lamp import Vector, seen_under
from polsep.geometry.one_frame import SIDE, UNKNOWN, gather, images_of, load_estimator, square_around
from polsep.geometry.polarization import Polarized, choose_outward, find_diffuse_polarization, normals_from_polarization
from polsep.geometry.shape_maps import Seen, Surface, relight
from polsep.io.store.weights import shipped_weights
from polsep.physics.stokes import Stokes
from polsep.pipeline import separate_capture
from polsep.render.disturbances import LAMPS, add_scenes, as_color, depolarize_lamp, scale_light
from polsep.render.raycast import Hits, is_lit
from polsep.render.room import Around, as_room, even_directions, light_from_around
from polsep.render.sensor_errors import record
from polsep.render.simulate import blur, capture, expose_to_clip, half_resolution
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, camera_axes, shade
from polsep.sensor.camera import IMX250, Layout
from polsep.separation.report import SeparatedFrame
from polsep.train.shape_losses import gained, random_lamps

Floats = NDArray[np.float32]

#: Strength of specular reflections of matte objects; share of samples that clip.
MATTE, CLIPPED = 0.05, 0.005
#: Of a usual rig: room light over the lamp's; its lights' number, distance in radii, and colour over the lamp's; the
#: lamp's degree of polarization and raw colour.
ROOM, ROOM_LIGHTS, ROOM_DISTANCE, ROOM_COLOR = 0.1, 6, 30.0, (1.15, 1.0, 0.85)
DEGREE, RIG_COLOR = 0.98, LAMPS["daylight"]
#: Largest angle of the lamp from the camera, and its distance relative to the camera's.
LARGEST_DEG, DISTANCES = 45.0, (0.7, 1.4)
#: A distant lamp for objects whose camera is many radii away, in radii.
LAMP_DISTANCE = 8.0
#: Networks of all inputs, of equal training; the method of the one that sees separated images; and what a method's name
#: ends with where the lamp's direction is given.
EQUAL, GIVEN = "separated, equal training", ", lamp told"
WEIGHTS = Path(__file__).parent / "weights" / "shape"
#: Lamps of relit pictures, and their seed; zenith [degrees] from which on an azimuth turned by more than 90 is a flip.
COUNT, LAMP_SEED, STEEP_DEG = 20, 77, 30.0


class Kind(NamedTuple):
    """A way to photograph objects: the ``strength`` of their specular reflections, and whether in a usual ``rig``."""

    strength: float
    rig: bool = False


#: Kinds of photographs; those of an object in the dark and in a rig have the same lamp.
KINDS = {"glossy": Kind(1.0), "matte": Kind(MATTE), "glossy, in a usual rig": Kind(1.0, rig=True)}


class Truth(NamedTuple):
    """A frame's true surface at half resolution, and the direction toward its lamp."""

    surface: Surface
    mask: NDArray[np.bool_]
    light: NDArray[np.float64]


class Photograph(NamedTuple):
    """A subject's frame, separated and as measured, the same without errors, and the truth."""

    name: str
    frame: SeparatedFrame
    stokes: Floats
    perfect: SeparatedFrame
    truth: Truth


def photograph(subject: Subject, number: int, kind: Kind) -> Photograph:
    """One frame of subject ``number`` under one lamp."""
    seed = SEED + 5000 + 2 * number + (kind.strength == MATTE)
    generator = torch.Generator().manual_seed(seed)
    lamp = _lamp(subject, generator)
    hits = list(cast_bands(subject))
    scene, planes = _render(subject, hits, lamp, kind.strength)
    exposed = expose_to_clip(blur(scene, LENS_BLUR), CLIPPED, Layout(), IMX250)
    if kind.rig:
        gain = float(exposed.diffuse.s0.double().sum() / scene.diffuse.s0.double().sum())
        around = scale_light(blur(_in_rig(subject, hits, lamp, scene), LENS_BLUR), gain / (1 + ROOM))
        lit = scale_light(around, as_color(RIG_COLOR))
        mosaic = record(lit.diffuse + lit.specular, Layout(), IMX250, replace(RIG, specimen=seed % 1000), seed)
    else:
        mosaic = capture(exposed, Layout(), IMX250, generator).mosaic
    mosaic = replace(mosaic, data=mosaic.data.numpy().astype(np.float32))
    frame = separate_capture(mosaic, "joint", "auto" if kind.rig else "white")
    color = tuple(frame.report["light_color"])
    stokes = np.moveaxis(measured_stokes(mosaic, color), -1, 1) / np.array(color, np.float32)[:, None, None]
    stokes = stokes.reshape(9, *frame.dolp.shape)
    mask, normal, albedo, rough, strong = np.split(avg_pool2d(planes, 2).numpy(), [1, 4, 7, 8])
    whole = mask[0] > 0.999
    normal = normal / np.maximum(np.linalg.norm(normal, axis=0), 1e-9)
    none = np.zeros_like(rough)
    surface = Surface(normal, albedo, rough, strong, none, none, none)
    way = _axes(subject) @ (np.array(lamp.position) / np.linalg.norm(lamp.position))
    return Photograph(subject.name, frame, stokes, _perfect(exposed), Truth(surface, whole, way))


def _in_rig(subject: Subject, hits: list[Hits], lamp: PointLight, scene: Scene) -> Scene:
    """A scene behind an imperfect polarizer, with light of the room."""

    def light_by(light: PointLight) -> Scene:
        return _render(subject, hits, light, 1.0)[0]

    crossed = light_by(replace(lamp, polarizer=lamp.polarizer + math.pi / 2))
    around = Around(even_directions(ROOM_LIGHTS), torch.ones(ROOM_LIGHTS), ROOM_DISTANCE)
    room = as_room(light_from_around(light_by, around), scene, ROOM, as_color(ROOM_COLOR))
    return add_scenes(depolarize_lamp(scene, DEGREE, crossed), room)


def _axes(subject: Subject) -> NDArray[np.float64]:
    axes = camera_axes(subject.camera).double().numpy()
    return np.stack([axes[0], axes[1], -axes[2]])


def _lamp(subject: Subject, generator: torch.Generator) -> PointLight:
    """A lamp near the camera; where the camera is far away, at `LAMP_DISTANCE` in its direction."""
    camera = subject.camera
    away = float(np.linalg.norm(camera.position))
    if away > LAMP_DISTANCE:
        x, y, z = (LAMP_DISTANCE / away * c for c in camera.position)
        camera = PinholeCamera((x, y, z), camera.target)
    return random_light_near(camera, generator, (0.0, LARGEST_DEG), DISTANCES)


def _render(subject: Subject, hits: list[Hits], lamp: PointLight, strength: float) -> tuple[Scene, torch.Tensor]:
    """The exact scene, and planes of mask, normals in the camera's frame, albedo, roughness and strength."""
    toward = torch.from_numpy(_axes(subject)).float()
    bands = []
    for band in hits:
        one = torch.ones_like(band.position[:1])
        albedo = subject.albedo(band.position)
        buffer = GBuffer(band.position, band.normal, albedo, subject.roughness * one, strength * one, one > 0)
        diffuse, specular = shade(buffer, subject.camera, lamp, is_lit(subject.mesh, band, lamp))
        values = [one, (toward @ band.normal[..., 0])[..., None], albedo, subject.roughness * one, strength * one]
        values += [s for lobe in (diffuse, specular) for s in (lobe.s0, lobe.s1, lobe.s2)]
        bands.append(pool_band(torch.cat(values), band))
    whole = torch.cat(bands, dim=1)
    lobes = [Stokes(*torch.split(whole[9 + 9 * k : 18 + 9 * k], 3)) for k in range(2)]
    return Scene(lobes[0], lobes[1], whole[0] == 1), whole[:9]


def _perfect(scene: Scene) -> SeparatedFrame:
    """The true images of a scene as a separated frame."""
    diffuse, specular, _ = half_resolution(scene)
    total = scene.diffuse + scene.specular
    s0, s1, s2 = (avg_pool2d(s.mean(dim=0, keepdim=True), 2)[0].numpy() for s in (total.s0, total.s1, total.s2))
    dolp = np.hypot(s1, s2) / np.maximum(s0, 1e-9)
    images = [np.ascontiguousarray(x.permute(1, 2, 0).numpy()) for x in (diffuse, specular)]
    aolp = np.mod(np.arctan2(s2, s1) / 2, np.pi)
    return SeparatedFrame(images[0], images[1], s0 > 0, dolp, aolp, {"warnings": []})


def seen_by(name: str, shot: Photograph, given: bool) -> tuple[Seen, Surface]:
    """Images that an input sees of a photograph in the network's square, and the truth there."""
    mask = shot.truth.mask
    window = square_around(mask)
    truth = np.concatenate([np.asarray(x, np.float32) for x in shot.truth.surface[:4]] + [mask[None]])
    small = gather(truth * mask, window, SIDE)
    inside = (small[-1:] > 0.99).astype(np.float32)
    surface = _as_surface(small)
    light = np.array(shot.truth.light if given else np.zeros(3), np.float32)
    lamp = np.broadcast_to(light[:, None, None], (3, SIDE, SIDE))
    if name in ("separated", "perfect"):
        images = gather(images_of(shot.frame if name == "separated" else shot.perfect, mask), window, SIDE)
        return Seen(images[:3], images[3:4], images[4:6], images[6:7], inside, lamp), surface
    images = gather(shot.stokes, window, SIDE)
    return Seen(images[:3], None, images[3:], None, inside, lamp), surface


def _as_surface(planes: Floats) -> Surface:
    normal = planes[:3] / np.maximum(np.linalg.norm(planes[:3], axis=0), 1e-9)
    none = np.zeros_like(planes[6:7])
    share = np.maximum(planes[-1:], 1e-6)
    return Surface(normal, planes[3:6] / share, planes[6:7] / share, planes[7:8] / share, none, none, none)


def estimate(method: str, shot: Photograph, lamp: Vector | None = None) -> tuple[Surface, Surface, Floats]:
    """The surface by a network of `list_methods`, the truth and the mask, in the network's square.

    ``lamp``: what `find_lamp` found for the method before, which takes longer than the rest.
    """
    name, given = method.split(",")[0], method.endswith(GIVEN)
    seen, truth = seen_by(name, shot, given)
    seen = seen if lamp is None else seen_under(seen, lamp)
    ships = name == "separated" and method != EQUAL
    path = shipped_weights("shape/separated") if ships else WEIGHTS / f"{name}.safetensors"
    return load_estimator(path).find(seen), truth, seen.mask


def find_lamp(shot: Photograph) -> Vector:
    """The direction toward the lamp of a photograph, by the network that ships."""
    return load_estimator().find_lamp(seen_by("separated", shot, False)[0])


def lamp_error(lamp: Vector, shot: Photograph) -> float:
    """The angle [degrees] between a direction and the true one toward the lamp of a photograph."""
    return math.degrees(math.acos(max(-1.0, min(float(np.dot(lamp, shot.truth.light)), 1.0))))


def list_methods() -> list[str]:
    """Return what ships, with and without the lamp's direction, and the networks of equal training that are there."""
    equal = [
        name
        for name in (EQUAL, "stokes", "rgb", "perfect")
        if (WEIGHTS / f"{name.split(',')[0]}.safetensors").is_file()
    ]
    return ["separated", f"separated{GIVEN}", *equal]


def classical(shot: Photograph) -> tuple[Surface, Surface, Floats]:
    """Normals from the diffuse light's polarization, chosen outward from the outline; albedo is the diffuse image."""
    seen, truth = seen_by("separated", shot, False)
    assert seen.specular is not None and seen.polarized is not None
    inside = seen.mask[0] > 0
    planes = (seen.image.mean(axis=0), seen.specular[0], seen.polarized[0], seen.polarized[1], np.ones(inside.shape))
    polarized = Polarized(*(np.asarray(x, np.float64)[None] for x in planes))
    cue = normals_from_polarization(find_diffuse_polarization(polarized, inside))
    normal = np.moveaxis(choose_outward(cue, inside), -1, 0).astype(np.float32)
    return truth._replace(normal=normal, albedo=np.maximum(seen.image, 1e-6)), truth, seen.mask


def score(found: Surface, truth: Surface, mask: Floats) -> dict[str, float]:
    """Scores of one frame; see `measure`."""
    inside = mask[0] > 0
    cosine = (found.normal * truth.normal).sum(axis=0)[inside]
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    steep = truth.normal[2][inside] < math.cos(math.radians(STEEP_DEG))
    across = (found.normal[:2] * truth.normal[:2]).sum(axis=0)[inside][steep]
    rough = np.abs(np.log(found.roughness[0][inside] / truth.roughness[0][inside]))
    known = found.roughness_error[0][inside] < UNKNOWN
    pairs = [torch.from_numpy(np.stack([np.asarray(x, np.float32)])) for x in (*found, *truth, mask)]
    first, second = Surface(*pairs[:7]), Surface(*pairs[7:14])
    first = gained(first, second, pairs[14])
    logs, flips = [], []
    for lamp in random_lamps(COUNT, torch.Generator().manual_seed(LAMP_SEED)):
        pictures = [relight(x, lamp)[0].numpy() * mask for x in (first, second)]
        level = 0.1 * float(pictures[1][:, inside].mean())
        logs.append(float(np.abs(np.log(pictures[0] + level) - np.log(pictures[1] + level))[:, inside].mean()))
        shown = [np.clip(0.5 / (10 * level) * x, 0, 1) ** (1 / 2.2) for x in pictures]
        flips.append(_flip(shown[0], shown[1], inside))
    return {
        "mean angular error": float(angle.mean()),
        "median angular error": float(np.median(angle)),
        "azimuth flips": 100 * float((across < 0).mean()) if steep.any() else 0.0,
        "relit, log-L1": statistics.fmean(logs),
        "relit, FLIP": statistics.fmean(flips),
        "roughness known": 100 * float(known.mean()),
        **({"roughness, median error": 100 * float(np.expm1(np.median(rough[known])))} if known.any() else {}),
    }


def _flip(found: Floats, truth: Floats, inside: NDArray[np.bool_]) -> float:
    images = [np.ascontiguousarray(np.moveaxis(x, 0, -1), np.float32) for x in (truth, found)]
    error, _, _ = flip_evaluator.evaluate(*images, "LDR", applyMagma=False, inputsRGB=True)
    return float(np.asarray(error)[..., 0][inside].mean())


#: Units of the scores.
UNITS = {"relit, log-L1": "1", "relit, FLIP": "1"}
UNITS |= dict.fromkeys(("azimuth flips", "roughness known", "roughness, median error"), "%")


def measure(data: Path, names: Sequence[str] | None = None) -> Iterator[Row]:
    """Rows of scores per method, over glossy and matte objects and per kind, and of expected errors."""
    found: dict[tuple[str, str], list[dict[str, float]]] = {}
    tenths: list[tuple[Floats, Floats]] = []
    methods = list_methods()
    for number, subject in enumerate(load_subjects(data, names)):
        for kind, how in KINDS.items():
            shot = photograph(subject, number, how)
            lamp = find_lamp(shot)
            for method in (*methods, "classical"):
                known = lamp if method == "separated" else None
                results = classical(shot) if method == "classical" else estimate(method, shot, known)
                scores = score(*results)
                if method == "separated":
                    scores["lamp, angular error"] = lamp_error(lamp, shot)
                found.setdefault((kind, method), []).append(scores)
                case, metric = f"{subject.name}, {kind}", "mean angular error"
                yield Row("shape/things", case, method, metric, scores[metric], "deg")
                if method == "separated" and not how.rig:
                    surface, truth, mask = results
                    inside = mask[0] > 0
                    cosine = np.clip((surface.normal * truth.normal).sum(axis=0)[inside], -1, 1)
                    tenths.append((np.degrees(np.arccos(cosine)), np.degrees(surface.normal_error[0][inside])))
    for kind in KINDS:
        for method in (*methods, "classical"):
            rows = found[kind, method]
            for metric in dict.fromkeys(name for row in rows for name in row):
                if method == "classical" and metric.startswith("roughness"):
                    continue
                value = statistics.fmean(row[metric] for row in rows if metric in row)
                look, *rig = kind.split(", ")
                case, unit = ", ".join([f"{len(rows)} {look} things", *rig]), UNITS.get(metric, "deg")
                yield Row("shape/normals", case, method, metric, value, unit)
    yield from _expected(tenths)


def _expected(pairs: Sequence[tuple[Floats, Floats]]) -> Iterator[Row]:
    """Rows by tenths of the expected error: its rms, that of the angles, and how far both are apart in octaves."""
    angle, expected = (np.concatenate(x) for x in zip(*pairs, strict=True))
    order = np.argsort(expected)
    octaves = []
    for k, part in enumerate(np.array_split(order, 10)):
        wanted, real = (float(np.sqrt(np.mean(x[part] ** 2))) for x in (math.sqrt(2) * expected, angle))
        octaves.append(math.log2(wanted / real))
        yield Row("shape/expected", f"tenth {k + 1}", "separated", "expected", wanted, "deg")
        yield Row("shape/expected", f"tenth {k + 1}", "separated", "found", real, "deg")
    rms = math.sqrt(statistics.fmean(x * x for x in octaves))
    yield Row("shape/expected", "all", "separated", "rms distance", rms, "octaves")
