"""Statues and scans as a polarization camera records them under six lights, with their true normals.

The six lights stand where `geometry.lights.NAMED` says, but for the errors that a hand makes: each is a point at
`LIGHT_DISTANCE` radii of the object, turned by up to `LARGEST_TURN_DEG`, brighter or darker by up to `LARGEST_GAIN`,
behind a polarizer at any angle. Methods know the named directions alone. Shapes, poses, textures and roughness are
those of the selection set `statues`; shadows are cast. One exposure serves all six frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from evaluation.testsets.casting import LENS_BLUR, SAMPLES
from evaluation.testsets.statues import (
    DILIGENT,
    DILIGENT_FILES,
    ROUGHNESSES,
    SCANS,
    random_albedo,
    read_scan,
    read_statue,
)
from polsep.geometry.lights import NAMED
from polsep.physics.stokes import Stokes
from polsep.render.distances import Field
from polsep.render.raycast import Hits, MeshScene, find_hits, is_lit
from polsep.render.shapes import Mesh
from polsep.render.simulate import blur, capture, filter_light, half_resolution
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, camera_axes, shade
from polsep.sensor.camera import IMX250, Layout, Mosaic

#: Distance of the lights in radii of the object, and what they are off by.
LIGHT_DISTANCE, LARGEST_TURN_DEG, LARGEST_GAIN = 8.0, 6.0, 0.1
#: Share of the brightest frame's samples on the object that clip.
CLIPPED = 0.01
#: Raw pixels per side; rows that are shaded together.
SIDE, ROWS_AT_ONCE = 512, 64
#: Rows and columns of rays of these.
BAND = (ROWS_AT_ONCE * SAMPLES, SIDE * SAMPLES)
#: Seed of the first object.
SEED = 9000


@dataclass(frozen=True)
class Subject:
    """A subject of photographs: a mesh around the origin, its camera, the colours and the roughness of its surface."""

    name: str
    mesh: MeshScene
    camera: PinholeCamera
    albedo: Field
    roughness: float


@dataclass(frozen=True)
class Shoot:
    """Six frames of a subject and their truth at half resolution.

    ``mosaics``; exposed exact ``scenes`` at raw resolution; ``normals [h, w, 3]`` with x right, y up, z to the camera;
    the object's ``mask [h, w]``.
    """

    mosaics: tuple[Mosaic, ...]
    scenes: tuple[Scene, ...]
    normals: NDArray[np.float64]
    mask: NDArray[np.bool_]


def load_subjects(data: Path, names: Sequence[str] | None = None) -> list[Subject]:
    """The objects of the selection set `statues`, or those of ``names`` (bear, spot, ...). Raises ValueError."""
    found = []
    for number, name in enumerate((*DILIGENT, *SCANS)):
        stem = name.split(".")[0].split("-")[0].split("_")[0]
        if names is not None and stem not in names:
            continue
        generator = torch.Generator().manual_seed(SEED + number)
        albedo = random_albedo(number, generator)
        low, high = ROUGHNESSES
        roughness = low + (high - low) * torch.rand(1, generator=generator).item()
        mesh, camera = (
            _statue(data / "diligent_normals" / name)
            if name in DILIGENT
            else read_scan(data / "meshes" / name, SCANS[name])
        )
        found.append(Subject(stem, MeshScene(mesh), camera, albedo, roughness))
    return found


def _statue(folder: Path) -> tuple[Mesh, PinholeCamera]:
    """A DiLiGenT object from where its camera was."""
    mesh, viewpoint = read_statue([folder / file for file in DILIGENT_FILES])
    fov = math.degrees(2 * math.atan(1.02 * float(np.abs(mesh.vertices[:, :2]).max()) / viewpoint[2]))
    return mesh, PinholeCamera(viewpoint, (0.0, 0.0, 0.0), fov)


def photograph(subject: Subject, seed: int) -> Shoot:
    """Six noisy frames of a subject. Raises ValueError where a light reaches nothing."""
    generator = torch.Generator().manual_seed(seed)
    axes = camera_axes(subject.camera).double()
    to_world = torch.stack([axes[0], axes[1], -axes[2]]).T
    ways = [_turned(torch.tensor(direction, dtype=torch.float64), generator) for direction in NAMED.values()]
    scenes, normals, mask = _render(subject, [_light(to_world @ way, generator) for way in ways])
    brightest = max(_level(scene) for scene in scenes)
    scenes = [Scene(s.diffuse * (1 / brightest), s.specular * (1 / brightest), mask) for s in scenes]
    mosaics = tuple(capture(scene, Layout(), IMX250, generator).mosaic for scene in scenes)
    seen = (to_world.T.float() @ normals.reshape(3, -1)).reshape(3, SIDE, SIDE)
    mean = avg_pool2d(seen, 2).permute(1, 2, 0).double().numpy()
    whole = half_resolution(scenes[0])[2].numpy()
    length = np.linalg.norm(mean, axis=-1, keepdims=True)
    return Shoot(mosaics, tuple(scenes), mean / np.where(length > 0, length, 1), whole)


def _turned(direction: Tensor, generator: torch.Generator) -> Tensor:
    """A unit vector within `LARGEST_TURN_DEG` of another."""
    draws = 2 * torch.rand(3, generator=generator, dtype=torch.float64) - 1
    sideways = draws - (draws @ direction) * direction
    angle = math.radians(LARGEST_TURN_DEG) * torch.rand(1, generator=generator, dtype=torch.float64)
    way: Tensor = torch.cos(angle) * direction + torch.sin(angle) * sideways / sideways.norm()
    return way


def _light(way: Tensor, generator: torch.Generator) -> PointLight:
    """A light in that direction, of random strength and polarizer."""
    gain, turn = torch.rand(2, generator=generator, dtype=torch.float64).tolist()
    x, y, z = (LIGHT_DISTANCE * way).tolist()
    return PointLight((x, y, z), LIGHT_DISTANCE**2 * (1 + LARGEST_GAIN * (2 * gain - 1)), math.pi * turn)


def _render(subject: Subject, lights: list[PointLight]) -> tuple[list[Scene], Tensor, Tensor]:
    """Exact scenes behind the lens, and the normals ``[3, SIDE, SIDE]`` in the world's frame."""
    bands: list[list[Tensor]] = []
    for hits in cast_bands(subject):
        planes = [pool_band(torch.ones_like(hits.position[:1]), hits), pool_band(hits.normal, hits)]
        for light in lights:
            lobes = shade(_cover(subject, hits), subject.camera, light, is_lit(subject.mesh, hits, light))
            planes += [pool_band(s, hits) for lobe in lobes for s in (lobe.s0, lobe.s1, lobe.s2)]
        bands.append(planes)
    covered, normals, *images = (torch.cat(planes, dim=1) for planes in zip(*bands, strict=True))
    mask = covered[0] == 1
    scenes = []
    for k in range(0, len(images), 6):
        scenes.append(blur(Scene(Stokes(*images[k : k + 3]), Stokes(*images[k + 3 : k + 6]), mask), LENS_BLUR))
    return scenes, normals, mask


def cast_bands(subject: Subject) -> Iterator[Hits]:
    """Hits of all rays of a frame, in bands of `ROWS_AT_ONCE` rows."""
    rows, cols = ((torch.arange(count) + 0.5) / SAMPLES for count in BAND)
    for first in range(0, SIDE, ROWS_AT_ONCE):
        points = tuple(g.flatten() for g in torch.meshgrid(first + rows, cols, indexing="ij"))
        yield find_hits(subject.mesh, subject.camera, (points[0], points[1]), (SIDE, SIDE))


def _cover(subject: Subject, hits: Hits) -> GBuffer:
    one = torch.ones_like(hits.position[:1])
    return GBuffer(hits.position, hits.normal, subject.albedo(hits.position), subject.roughness * one, one, one > 0)


def pool_band(values: Tensor, hits: Hits) -> Tensor:
    """Values ``[C, M, 1]`` of hits as an image, the mean over each pixel's samples."""
    image = torch.zeros(values.shape[0], BAND[0] * BAND[1])
    image[:, hits.ray] = values[..., 0]
    return avg_pool2d(image.reshape(1, -1, *BAND), SAMPLES)[0]


def _level(scene: Scene) -> float:
    """The level that `CLIPPED` of the object's samples exceed."""
    samples = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask]
    if not samples.numel():
        raise ValueError("expected an object that light reaches, found none in the mask")
    return float(samples.kthvalue(max(1, samples.numel() - round(CLIPPED * samples.numel()))).values)
