"""The sealed set: scenes that no choice has seen, scored when a version is released and at no other time.

Shapes are swept curves and superquadrics, textures are photographs and scanned maps that nothing else here uses, half
of the scenes stand before a wall, and the lamp is 20 to 65 degrees from the camera. None of the other sets has any of
it. `SEALED` is not to be looked at, scored or trained on between releases; `PRACTICE`, of the same make but with
textures and seeds of its own, is for trying the command. Real crossed-polarizer photographs are not in it: all there
are were used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from evaluation.testsets.cases import Recipe
from evaluation.testsets.casting import look_at, random_light_near, render_covered
from evaluation.testsets.statues import random_albedo
from polsep.io.assets.maps import read_map
from polsep.render.distances import Field
from polsep.render.raycast import Hits, MeshScene
from polsep.render.shapes import Floats, Mesh, join
from polsep.render.sphere_tracing import GBuffer, Scene
from polsep.render.triangles import area_vectors, smooth_normals

#: Raw pixels per side, rows and columns of a shape's grid.
SIDE, GRID = 512, (240, 120)
#: Where the lamp is: degrees from the camera, distance relative to the camera's.
ANGLES_DEG, DISTANCES = (20.0, 65.0), (1.0, 2.5)
#: Roughness where no map says it, of the wall, and what a roughness map spans; specular strength; albedo.
ROUGHNESSES, WALL_ROUGHNESS, MAPPED, STRENGTHS, ALBEDOS = (0.12, 0.6), 0.45, (0.15, 0.75), (0.4, 1.4), (0.02, 0.95)
#: Widths of a texture's image in scene units, on the object and on the wall; half the wall's side and its place.
TEXTURE_SIZES, WALL_SIZE, WALL = (0.8, 2.0), 5.0, (9.0, -1.3)

_PHOTOS = "svbrdf/deschaintre_examples/inputExamples"
_GDQUEST = "svbrdf/gdquest/godot/Demos"
#: Files of every texture: its colours, and its roughness if there is a map of it.
TEXTURES = (
    (f"{_PHOTOS}/IMG_20180104_210434.png",),
    (
        "svbrdf/echartsgl/test/asset/leather/leather_albedo.jpg",
        "svbrdf/echartsgl/test/asset/leather/leather_roughness.jpg",
    ),
    (f"{_PHOTOS}/IMG_20180104_230238.png",),
    (f"{_PHOTOS}/IMG_20180105_091814.png",),
    (
        f"{_GDQUEST}/InteractiveSnow/Textures/Ground039_1K_Color.jpg",
        f"{_GDQUEST}/InteractiveSnow/Textures/Ground039_1K_Roughness.jpg",
    ),
    (f"{_PHOTOS}/IMG_20180105_114506.png",),
    (f"{_PHOTOS}/IMG_20180114_222743_1.png",),
    (
        f"{_GDQUEST}/InteractiveSnow/Textures/Snow004_1K_Color.jpg",
        f"{_GDQUEST}/InteractiveSnow/Textures/Snow004_1K_Roughness.jpg",
    ),
    (f"{_PHOTOS}/IMG_20180115_135508.png",),
    (f"{_PHOTOS}/IMG_20180115_143924.png",),
    (f"{_GDQUEST}/TextureMix/textures/Moss003_1K_Color.jpg",),
    (f"{_PHOTOS}/IMG_6966.png",),
)


def tube(center: Floats, radius: Floats | float, sides: int) -> Floats:
    """Points ``[n, sides, 3]`` around a closed curve ``[n, 3]``, in planes across it."""
    tangent = np.roll(center, -1, axis=0) - np.roll(center, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(tangent, [0.0, 0.0, 1.0]) + 1e-9
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(tangent, across)
    turn = 2 * math.pi * np.arange(sides) / sides
    ring = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * other[:, None]
    return center[:, None] + np.broadcast_to(np.asarray(radius), len(center))[:, None, None] * ring


def knot(size: tuple[int, int], share: Floats) -> Floats:
    """A torus knot; ``share``: three numbers in [0, 1] that choose among shapes of a kind."""
    t, (p, q) = 2 * math.pi * np.arange(size[0]) / size[0], ((2, 3), (3, 2), (2, 5))[int(2.99 * share[0])]
    radius = 1 + (0.35 + 0.1 * share[1]) * np.cos(q * t)
    center = np.stack([radius * np.cos(p * t), radius * np.sin(p * t), 0.45 * np.sin(q * t)], axis=1)
    return tube(center, 0.14 + 0.06 * share[2], size[1])


def ring(size: tuple[int, int], share: Floats) -> Floats:
    """A ring whose thickness swells and shrinks."""
    t = 2 * math.pi * np.arange(size[0]) / size[0]
    center = np.stack([np.cos(t), np.sin(t), 0.3 * np.cos(2 * t + 3 * share[0])], axis=1)
    return tube(center, 0.3 + (0.1 + 0.08 * share[1]) * np.cos(int(3 + 4 * share[2]) * t), size[1])


def turned(profile: Callable[[Floats], tuple[Floats, Floats]], size: tuple[int, int], flutes: int = 0) -> Floats:
    """A surface of revolution about y; ``profile``: radius and height along [0, 1], ``flutes`` cut into its side."""
    radius, height = profile(np.linspace(0, 1, size[1]))
    angle = 2 * math.pi * np.arange(size[0])[:, None] / size[0]
    around = radius * (1 - 0.07 * np.abs(np.sin(0.5 * flutes * angle)) * (flutes > 0))
    return np.stack([around * np.sin(angle), np.broadcast_to(height, around.shape), around * np.cos(angle)], axis=2)


def column(size: tuple[int, int], share: Floats) -> Floats:
    """A fluted baluster."""

    def profile(v: Floats) -> tuple[Floats, Floats]:
        ends = np.sqrt(np.clip(1 - (2 * v - 1) ** 16, 0, 1))
        return ends * (0.42 + 0.16 * np.sin(2 * math.pi * (1 + share[0]) * v + 6 * share[1])), 2.4 * v - 1.2

    return turned(profile, size, int(8 + 12 * share[2]))


def bowl(size: tuple[int, int], share: Floats) -> Floats:
    """A thick bowl: along its outside to the rim, and down inside."""

    def profile(v: Floats) -> tuple[Floats, Floats]:
        turn = math.pi / 2 * (1 - np.abs(2 * v - 1))
        reach = np.where(v < 0.5, 1.0, 0.82 + 0.08 * share[0])
        return reach * np.sin(turn), -(0.7 + 0.3 * share[1]) * reach * np.cos(turn)

    return turned(profile, size)


def sphere_angles(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Longitudes ``[n, 1]`` around, and latitudes ``[m]`` from pole to pole [rad]."""
    return 2 * math.pi * np.arange(size[0])[:, None] / size[0], np.linspace(-math.pi / 2, math.pi / 2, size[1])


def superquadric(size: tuple[int, int], share: Floats) -> Floats:
    """A rounded box or a spindle, by exponents from 0.35 to 1.8. Source: Barr 1981, doi:10.1109/MCG.1981.1673799."""

    def power(x: Floats, exponent: float) -> Floats:
        found: Floats = np.sign(x) * np.abs(x) ** exponent
        return found

    around, up = (0.35 + 1.45 * share[k] for k in (0, 1))
    u, v = sphere_angles(size)
    flat = power(np.cos(v), up)
    parts = (
        power(np.cos(u), around) * flat,
        power(np.sin(v), up) * (0.7 + 0.5 * share[2]),
        power(np.sin(u), around) * flat,
    )
    return np.stack(np.broadcast_arrays(*parts), axis=2)


def shell(size: tuple[int, int], share: Floats) -> Floats:
    """A lobed gourd: radius over the sphere by two waves."""
    u, v = sphere_angles(size)
    radius = (
        1 + (0.1 + 0.12 * share[0]) * np.cos(int(3 + 5 * share[1]) * u) * np.cos(v) + 0.15 * np.sin(3 * v + share[2])
    )
    return np.stack(
        [radius * np.cos(v) * np.sin(u), radius * np.sin(v) * np.ones_like(u), radius * np.cos(v) * np.cos(u)], 2
    )


#: Kinds of shapes, whether their second direction closes too.
SHAPES = ((knot, True), (column, False), (superquadric, False), (ring, True), (bowl, False), (shell, False))


def span_grid(points: Floats, closed: bool) -> Mesh:
    """The triangles between neighbours of a grid ``[n, m, 3]`` that closes along n, and along m if ``closed``."""
    n, m = points.shape[:2]
    number = np.arange(n * m).reshape(n, m)
    number = np.concatenate([number, number[:1]])
    number = np.concatenate([number, number[:, :1]], axis=1) if closed else number
    corner, right, below, across = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(c, -1).reshape(-1, 3) for c in ((corner, below, right), (right, below, across))])
    vertices = points.reshape(-1, 3) - (points.max((0, 1)) + points.min((0, 1))) / 2
    vertices = vertices / np.linalg.norm(vertices, axis=1).max()
    normals = area_vectors(vertices, faces)
    if float((vertices[faces[:, 0]] * normals).sum()) < 0:  # the volume six times
        faces = faces[:, ::-1]
    faces = np.ascontiguousarray(faces[np.linalg.norm(normals, axis=1) > 1e-10])
    return Mesh(vertices, smooth_normals(vertices, faces), np.zeros((n * m, 2)), faces, np.zeros(len(faces), np.int64))


def wall() -> Mesh:
    """A large square behind the object, which faces +z."""
    half, depth = WALL
    corners = np.array([[-half, -half, depth], [half, -half, depth], [half, half, depth], [-half, half, depth]])
    normals, faces = np.tile([0.0, 0.0, 1.0], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]])
    return Mesh(corners, normals, np.zeros((4, 2)), faces, np.zeros(2, np.int64))


def wrap(image: Tensor, size: float) -> Field:
    """An image ``[C, h, w]`` laid through space along an oblique direction, mirrored every ``size``."""

    def look_up(position: Tensor) -> Tensor:
        x, y, z = position
        places = []
        for along, pixels in ((x + 0.5 * z, image.shape[2]), (-y + 0.3 * z, image.shape[1])):
            phase = (along / size).remainder(2)
            places.append((torch.minimum(phase, 2 - phase) * (pixels - 1)).clamp(0, pixels - 1 - 1e-3))
        (u, v), (left, top) = places, (p.long() for p in places)
        du, dv = u - left, v - top
        upper = image[:, top, left] * (1 - du) + image[:, top, left + 1] * du
        lower = image[:, top + 1, left] * (1 - du) + image[:, top + 1, left + 1] * du
        return upper * (1 - dv) + lower * dv

    return look_up


def make_sealed(number: int, side: int, paths: list[Path], generator: torch.Generator) -> Scene:
    """Scene ``number``, with the texture of ``paths``, or a random one without; every second one before a wall."""
    build, closed = SHAPES[number % len(SHAPES)]
    share = torch.rand(8, generator=generator, dtype=torch.float64).numpy()
    mesh = span_grid(build(GRID, share[:3]), closed)
    camera = look_at(mesh, 360 * share[3] - 180 if number % 2 else 40 * share[3] - 20, 10 + 30 * share[4])
    light = random_light_near(camera, generator, ANGLES_DEG, DISTANCES)
    roughness, strength, size = (
        low + (high - low) * share[5 + k] for k, (low, high) in enumerate((ROUGHNESSES, STRENGTHS, TEXTURE_SIZES))
    )
    images = [
        torch.from_numpy(np.array(read_map(path, kind))) for path, kind in zip(paths, ("texture", "mask"), strict=False)
    ]
    colors = wrap(images[0].permute(2, 0, 1), size) if images else random_albedo(number, generator)
    behind = wrap(images[0].permute(2, 0, 1), WALL_SIZE) if images else colors
    rough = wrap(MAPPED[0] + (MAPPED[1] - MAPPED[0]) * images[1][None], size) if len(images) > 1 else None

    def cover(hits: Hits) -> GBuffer:
        one, at_wall = torch.ones_like(hits.position[:1]), (hits.slot == 1)[None, :, None]
        albedo = torch.where(at_wall, behind(hits.position), colors(hits.position)).clamp(*ALBEDOS)
        own = roughness * one if rough is None else rough(hits.position)
        return GBuffer(
            hits.position, hits.normal, albedo, torch.where(at_wall, WALL_ROUGHNESS, own), strength * one, one > 0
        )

    model = MeshScene(mesh if number % 2 else join(mesh, wall()))
    return render_covered(model, cover, camera, light, side)


SEALED = tuple(
    Recipe(f"sealed-{k:02d}", 52_000 + k, files, partial(make_sealed, k, SIDE)) for k, files in enumerate(TEXTURES)
)
#: Of the same make, for trying the command: nothing of the sealed scenes is in it.
PRACTICE = tuple(Recipe(f"practice-{k}", 51_000 + k, (), partial(make_sealed, k, 128)) for k in range(2))
