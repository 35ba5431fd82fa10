"""Films of known truth: an object that turns, a light that moves, an object that crosses a textured one.

100 frames of 50 per second each, made one by one as they are asked for; shapes, materials and views are drawn from the
split that training never sees. Every frame has its own noise, the exact diffuse and specular image behind it, and the
pixels whose truth is that of the frame before. Conventions are those of `polsep.render.sphere_tracing`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from evaluation.testsets.cases import NOISE_SEED, TOLERANCE, UNIT, weigh_scene
from evaluation.testsets.casting import LENS_BLUR, SAMPLES
from evaluation.testsets.expected import EXPECTED_FRAMES
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import MeshScene, Model, render_scene
from polsep.render.shapes import Floats, Mesh, box, join, moved, random_heights
from polsep.render.simulate import blur, capture, expose_to_clip
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Scene, Vector
from polsep.render.textures import PLAIN, Textures
from polsep.render.views import scene_seed, seeded_shape
from polsep.sensor.camera import IMX250, Layout, Mosaic

#: Frames of a film, frames per second, raw pixels per side.
FRAMES, RATE, FILM_SIDE = 100, 50.0, 384
#: Turns per minute; through which angle the light goes [degrees], and the share of the film for which it rests before.
TURNS_PER_MINUTE, LIGHT_ARC_DEG, REST = 30.0, 90.0, 0.2
#: Half the way of the crossing object, in scene units: from one side of the frame to the other.
HALF_WAY = 2.2
#: Share of the middle frame's samples that clips.
CLIPPED = 0.01
#: Largest extent of what moves and of what does not, in scene units, and how far the latter is behind.
OBJECT_SIZE, WALL_SIZE, WALL_DEPTH = 3.0, 9.0, -2.2
#: The wall's front is drawn anew until it has a texture whose two colours differ by this.
MIN_CONTRAST = 0.25
#: A pixel is still where no Stokes component of either lobe has changed by more than this, 1 being the white level.
MIN_CHANGE = 1e-6

#: What is to be seen in a frame: a model under a light; the camera never moves.
Look = tuple[Model, PointLight]


@dataclass(frozen=True)
class Film:
    """Recipe of a film: ``stage`` takes a generator of the ``seed`` and gives the look of every frame."""

    name: str
    seed: int
    stage: Callable[[torch.Generator], Callable[[int], Look]]


@dataclass(frozen=True)
class FilmFrame:
    """Frame ``number`` of a film: noisy 12 bits of `camera.IMX250`, the exposed scene, and its ``still`` pixels.

    ``still [H, W]``: covered by objects, with the truth of the frame before; False everywhere in the first frame.
    """

    number: int
    mosaic: Mosaic
    scene: Scene
    still: Tensor


_FRONT = 4  # the slot of a box's face toward +z
CAMERA = PinholeCamera((0.0, 0.6, 9.0), (0.0, 0.0, 0.0), 24.0)


def play(film: Film, numbers: range = range(FRAMES)) -> Iterator[FilmFrame]:
    """The frames of a film, of one exposure; before the first one another is rendered for its ``still``."""
    shoot = _shoot(film)
    before = shoot(numbers.start - 1) if numbers.start > 0 else None
    for number in numbers:
        scene = shoot(number)
        still = find_still(before, scene) if before is not None else torch.zeros_like(scene.mask)
        noise = torch.Generator().manual_seed(NOISE_SEED + film.seed + number)
        yield FilmFrame(number, capture(scene, Layout(), IMX250, noise).mosaic, scene, still)
        before = scene


def find_still(before: Scene, now: Scene) -> Tensor:
    """The pixels of both masks ``[H, W]`` whose light is the same, to `MIN_CHANGE`."""
    same = before.mask & now.mask
    for lobe in ("diffuse", "specular"):
        old, new = getattr(before, lobe), getattr(now, lobe)
        for a, b in ((old.s0, new.s0), (old.s1, new.s1), (old.s2, new.s2)):
            same = same & ((a - b).abs().amax(dim=0) <= MIN_CHANGE)
    return same


def fingerprint_frame(frame: FilmFrame) -> tuple[int, ...]:
    """Seven weighted means as of `cases.fingerprint`: both lobes and the noisy samples."""
    return tuple(round(mean / UNIT) for mean in weigh_scene(frame.scene, (frame.mosaic,)))


def check_frame(film: Film, frame: FilmFrame) -> None:
    """Raise ValueError unless the frame is the recorded one, if that is on record, as `cases.check_case` does."""
    recorded = EXPECTED_FRAMES.get((film.name, frame.number))
    found = fingerprint_frame(frame) if recorded is not None else ()
    if recorded is not None and max(abs(a - b) for a, b in zip(found, recorded, strict=True)) > TOLERANCE:
        raise ValueError(f"expected {film.name}, frame {frame.number}, of fingerprint {recorded}, found {found}")


def _shoot(film: Film) -> Callable[[int], Scene]:
    """Function that makes the exposed scene of a frame; the exposure is that of the middle one."""
    look, size = film.stage(torch.Generator().manual_seed(film.seed)), (FILM_SIDE, FILM_SIDE)

    def render_frame(number: int) -> Scene:
        model, light = look(number)
        return blur(render_scene(model, CAMERA, light, size, SAMPLES), LENS_BLUR)

    middle = render_frame(FRAMES // 2)
    exposed = expose_to_clip(middle, CLIPPED, Layout(), IMX250)
    gain = float(exposed.diffuse.s0.double().sum() / middle.diffuse.s0.double().sum())

    def expose_frame(number: int) -> Scene:
        scene = render_frame(number)
        return Scene(scene.diffuse * gain, scene.specular * gain, scene.mask)

    return expose_frame


# What is filmed


@dataclass(frozen=True)
class Prop:
    """A mesh about the origin with its materials."""

    mesh: Mesh
    materials: Materials


def _object(shape: int, generator: torch.Generator) -> Prop:
    """A random shape of the test split of `OBJECT_SIZE`."""
    mesh = seeded_shape("test", 0, shape).mesh
    return _dressed(_scaled(mesh, OBJECT_SIZE), OBJECT_SIZE, generator)


def _wall(generator: torch.Generator) -> Prop:
    """A bumpy wall behind the object."""
    half = WALL_SIZE / 2
    mesh = box(np.array([half, half, 0.2]), [random_heights(0.3, generator) for _ in range(6)])
    mesh = moved(mesh, np.eye(3), np.array([0.0, 0.0, WALL_DEPTH]))
    while True:
        prop = _dressed(mesh, WALL_SIZE / 2, generator)
        textures = prop.materials.textures
        assert textures is not None
        contrast = float((textures.albedo[_FRONT] - prop.materials.albedo[_FRONT]).abs().max())
        if int(textures.pattern[_FRONT]) != PLAIN and contrast >= MIN_CONTRAST:
            return prop


def _scaled(mesh: Mesh, size: float) -> Mesh:
    extent = float((mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)).max())
    return Mesh(mesh.vertices * (size / extent), mesh.normals, mesh.uv, mesh.faces, mesh.slots)


def _dressed(mesh: Mesh, size: float, generator: torch.Generator) -> Prop:
    return Prop(mesh, random_materials(mesh.slot_count, generator, size))


def turn(prop: Prop, angle: float) -> Prop:
    """The prop, its solid textures with it, turned about the vertical by an angle [rad]."""
    s, c = math.sin(angle), math.cos(angle)
    return move(prop, np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]), np.zeros(3))


def move(prop: Prop, rotation: Floats, translation: Floats) -> Prop:
    """A prop in another place: patterns are of p where the surface is at R p + t."""
    assert prop.materials.textures is not None
    transform = prop.materials.textures.transform.double()
    turn, way = torch.from_numpy(rotation), torch.from_numpy(translation)
    linear = transform[:, :, :3] @ turn.T
    offset = transform[:, :, 3:] - linear @ way[:, None]
    textures = replace(prop.materials.textures, transform=torch.cat([linear, offset], dim=2).float())
    return Prop(moved(prop.mesh, rotation, translation), replace(prop.materials, textures=textures))


def _together(*props: Prop) -> Model:
    """Props as one model: what stands still first, so that it is computed alike in every frame."""
    materials = [prop.materials for prop in props]
    textures = [m.textures for m in materials if m.textures is not None]
    joined = Textures(*(torch.cat(values) for values in zip(*(_values(t) for t in textures), strict=True)))
    albedo, roughness, specular = (
        torch.cat([getattr(m, name) for m in materials]) for name in ("albedo", "roughness", "specular")
    )
    mesh = join(*(prop.mesh for prop in props))
    return MeshScene(mesh), Materials(albedo, roughness, specular, joined)


def _values(textures: Textures) -> tuple[Tensor, ...]:
    return tuple(vars(textures).values())


def _light(azimuth_deg: float, polarizer: float = 0.4) -> PointLight:
    """A light above the camera's height at distance 9, to the right for a positive azimuth."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(30)
    flat = 9 * math.cos(elevation)
    position: Vector = (flat * math.sin(azimuth), 9 * math.sin(elevation), flat * math.cos(azimuth))
    return PointLight(position, 81.0, polarizer)


def turning(shape: int, generator: torch.Generator) -> Callable[[int], Look]:
    """An object turns before a wall: 3.6 degrees a frame."""
    wall, prop = _wall(generator), _object(shape, generator)
    step = 2 * math.pi * TURNS_PER_MINUTE / 60 / RATE

    def look(number: int) -> Look:
        return _together(wall, turn(prop, step * number)), _light(20.0)

    return look


def lighting(shape: int, generator: torch.Generator) -> Callable[[int], Look]:
    """The light goes around what stands still, 1.5 degrees a frame, after a fifth of the film and until the last."""
    model = _together(_wall(generator), _object(shape, generator))

    def look(number: int) -> Look:
        gone = (number / FRAMES - REST) / (1 - 2 * REST)
        return model, _light(LIGHT_ARC_DEG * (min(max(gone, 0.0), 1.0) - 0.5))

    return look


def crossing(shapes: tuple[int, int], generator: torch.Generator) -> Callable[[int], Look]:
    """An object goes from left to right in front of another one and a wall."""
    wall, still, prop = _wall(generator), _object(shapes[0], generator), _object(shapes[1], generator)
    behind = move(still, np.eye(3), np.array([0.0, 0.0, -0.8]))
    small = Prop(_scaled(prop.mesh, OBJECT_SIZE / 2.5), prop.materials)

    def look(number: int) -> Look:
        way = np.array([HALF_WAY * (2 * number / FRAMES - 1), -0.2, 1.6])
        return _together(wall, behind, move(small, np.eye(3), way)), _light(20.0)

    return look


#: The films by name.
FILMS = {
    film.name: film
    for film in (
        Film("turning", scene_seed("test", 0, 200, 0), partial(turning, 200)),
        Film("light", scene_seed("test", 0, 201, 0), partial(lighting, 201)),
        Film("crossing", scene_seed("test", 0, 202, 0), partial(crossing, (202, 203))),
    )
}
