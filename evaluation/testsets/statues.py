"""Set (b): photographed statues and scanned objects with random albedo and roughness.

Five DiLiGenT objects, each a surface spanned by its depth map that carries the map's normals, seen from where its own
camera was; and the meshes of the data folder. Surfaces cast shadows, of the DiLiGenT objects the visible side only.
Albedo is patches or veins in space or one colour, of random colours, near-grey in a quarter of the scenes; roughness is
uniform in [0.2, 0.5] and specular strength is 1. Source: Dave et al. 2022, Sec. 5 and its reference 44, Li et al. 2020,
DiLiGenT-MV, arXiv:2001.06659.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from evaluation.testsets.cases import Recipe
from evaluation.testsets.casting import FILLED, look_at, random_light_near, render_covered
from polsep.geometry.integration import pixel_rays
from polsep.io.assets.objects import read_depth, read_intrinsics, read_mask, read_mesh, read_normal_map
from polsep.render.distances import Field, cells, marble, plain
from polsep.render.materials import rgb_from_hsv
from polsep.render.raycast import Hits, MeshScene
from polsep.render.shapes import Floats, Integers, Mesh
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, Vector

#: Roughness of the paper's 3D scenes.
ROUGHNESSES = (0.2, 0.5)
#: Textures of scenes in turn: patches are half of them.
TEXTURES = ("patches", "veins", "patches", "plain")
#: One scene in so many is near-grey, each time of the next texture.
GREY_EVERY = 4
#: Saturation of near-grey scenes and of the others, and the largest channel of any colour.
GREY_SATURATIONS, SATURATIONS, VALUES = (0.0, 0.08), (0.2, 1.0), (0.15, 0.95)
#: Sizes of patches and of veins in scene units.
PATCH_SIZES, VEIN_SIZES = (0.12, 0.3), (0.25, 0.6)
#: Raw pixels per side of the DiLiGenT objects, whose maps have about 250 pixels, and of the meshes.
STATUE_SIDE, SCAN_SIDE = 512, 640
#: The light's distance from a DiLiGenT object in radii; its camera is some 25 of them away.
STATUE_LIGHT_DISTANCE = 8.0

DILIGENT = ("bear", "buddha", "cow", "pot2", "reading")
DILIGENT_FILES = ("normal_map.png", "mask.png", "depth_gt.npz", "K.txt")


@dataclass(frozen=True)
class Pose:
    """Pose of a scan: which of its axes points up, the camera's azimuth and elevation [degrees]."""

    up: str
    azimuth_deg: float
    elevation_deg: float


SCANS = {
    "Banana.obj": Pose("z", 20, 50),
    "MustardBottle.obj": Pose("z", 25, 15),
    "PottedMeatCan.obj": Pose("z", 30, 30),
    "PowerDrill.obj": Pose("z", 20, 15),
    "Vase.stl": Pose("z", 0, 20),
    "birdBath_decimated.ply": Pose("z", 0, 35),
    "blackVase_decimated.ply": Pose("z", 0, 15),
    "boat.obj": Pose("y", 60, 30),
    "cat-low-resolution.obj": Pose("y", 20, 15),
    "fish.obj": Pose("y", 65, 10),
    "hand_closed.obj": Pose("y", 20, 10),
    "human_neutral.obj": Pose("y", 25, 5),
    "penguin_hr.obj": Pose("y", 25, 10),
    "pizza.obj": Pose("y", 15, 50),
    "plasticVase_decimated.ply": Pose("z", 0, 20),
    "seaVase_decimated.ply": Pose("z", 0, 15),
    "spot.obj": Pose("y", 140, 15),
}


def make_statue(scene: int, paths: list[Path], generator: torch.Generator) -> Scene:
    """A DiLiGenT object under a random light with a random texture."""
    mesh, viewpoint = read_statue(paths)
    camera = _look_from(mesh, viewpoint)
    back = tuple(STATUE_LIGHT_DISTANCE * x / math.hypot(*viewpoint) for x in viewpoint)
    light = random_light_near(PinholeCamera((back[0], back[1], back[2]), camera.target), generator)
    return _render(mesh, (camera, light), random_albedo(scene, generator), generator, STATUE_SIDE)


def make_scan(scene: int, pose: Pose, paths: list[Path], generator: torch.Generator) -> Scene:
    """A scanned mesh in a fixed pose under a random light with a random texture."""
    mesh, camera = read_scan(paths[0], pose)
    light = random_light_near(camera, generator)
    return _render(mesh, (camera, light), random_albedo(scene, generator), generator, SCAN_SIDE)


def read_statue(paths: list[Path]) -> tuple[Mesh, Vector]:
    """The visible surface of a DiLiGenT object, of radius 1 around the origin, and where its camera was."""
    normals, mask, depth = read_normal_map(paths[0]), read_mask(paths[1]), read_depth(paths[2])
    points = unproject(depth, read_intrinsics(paths[3]))
    return _centred(span_surface(points, normals, mask & np.isfinite(depth)))


def read_scan(path: Path, pose: Pose) -> tuple[Mesh, PinholeCamera]:
    """A scanned mesh, +y up, and the camera of its pose."""
    mesh = read_mesh(path)
    if pose.up == "z":
        turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
        mesh = Mesh(mesh.vertices @ turn.T, mesh.normals @ turn.T, mesh.uv, mesh.faces, mesh.slots)
    return mesh, look_at(mesh, pose.azimuth_deg, pose.elevation_deg)


def _render(
    mesh: Mesh, view: tuple[PinholeCamera, PointLight], albedo: Field, generator: torch.Generator, side: int
) -> Scene:
    roughness = _within(ROUGHNESSES, torch.rand(1, generator=generator)).item()

    def cover(hits: Hits) -> GBuffer:
        one = torch.ones_like(hits.position[:1])
        return GBuffer(hits.position, hits.normal, albedo(hits.position), roughness * one, one, one > 0)

    return render_covered(MeshScene(mesh), cover, *view, side)


def random_albedo(scene: int, generator: torch.Generator) -> Field:
    """Random colours in space, of the texture that is this scene's turn."""
    texture, grey = TEXTURES[scene % len(TEXTURES)], scene % GREY_EVERY == scene // GREY_EVERY % GREY_EVERY
    hue, saturation, value = torch.rand(3, 5, generator=generator)
    colors = rgb_from_hsv(hue, _within(GREY_SATURATIONS if grey else SATURATIONS, saturation), _within(VALUES, value))
    palette: tuple[Vector, ...] = tuple((r, g, b) for r, g, b in colors.tolist())
    share = torch.rand(1, generator=generator)
    if texture == "plain":
        return plain(palette[0])
    if texture == "veins":
        return marble(palette[0], palette[1], _within(VEIN_SIZES, share).item())
    return cells(palette, _within(PATCH_SIZES, share).item(), generator)


def _within(interval: tuple[float, float], share: Tensor) -> Tensor:
    low, high = interval
    return low + (high - low) * share


def unproject(depth: Floats, intrinsics: Floats) -> Floats:
    """Points ``[H, W, 3]`` in the camera's frame (x right, y up, z toward it) of depths along its axis."""
    x, y = pixel_rays(depth.shape, intrinsics)
    return np.stack([x * depth, y * depth, -depth], axis=-1)


def span_surface(points: Floats, normals: Floats, mask: NDArray[np.bool_]) -> Mesh:
    """The surface through points of a grid ``[H, W, 3]``: triangles between neighbours that are in the mask.

    Triangles also bridge the jumps of depth, so that no cracks open between near and far.
    """
    number = np.cumsum(mask.reshape(-1)).reshape(mask.shape) - 1
    number[~mask] = -1
    corner, right, below, across = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    first, second = (np.stack(c, -1) for c in ((corner, below, right), (right, below, across)))
    # Cells that lack the corner on this diagonal have a triangle on the other one.
    others = ((right, (corner, below, across)), (below, (corner, across, right)))
    lonely = [np.where((absent < 0)[..., None], np.stack(rest, -1), -1) for absent, rest in others]
    faces: Integers = np.concatenate([t[(t >= 0).all(axis=-1)] for t in (first, second, *lonely)])
    return Mesh(points[mask], normals[mask], np.zeros((int(mask.sum()), 2)), faces, np.zeros(len(faces), np.int64))


def _centred(mesh: Mesh) -> tuple[Mesh, Vector]:
    """The mesh moved to the origin and scaled to radius 1, and where the camera, once the origin, is now."""
    center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    vertices = mesh.vertices - center
    radius = float(np.linalg.norm(vertices, axis=1).max())
    x, y, z = (float(c) for c in -center / radius)
    return Mesh(vertices / radius, mesh.normals, mesh.uv, mesh.faces, mesh.slots), (x, y, z)


def _look_from(mesh: Mesh, viewpoint: Vector) -> PinholeCamera:
    """The camera at a fixed place whose field of view the mesh fills as in `look_at`."""
    back = np.array(viewpoint) / math.hypot(*viewpoint)
    right = np.cross([0.0, 1.0, 0.0], back)
    right = right / np.linalg.norm(right)
    ways = mesh.vertices - np.array(viewpoint)
    across = np.maximum(np.abs(ways @ right), np.abs(ways @ np.cross(back, right)))
    slope = float((across / -(ways @ back)).max()) / FILLED
    return PinholeCamera(viewpoint, (0.0, 0.0, 0.0), math.degrees(2 * math.atan(slope)))


STATUES = (
    *(
        Recipe(
            f"statue-{name}",
            2200 + k,
            tuple(f"diligent_normals/{name}/{file}" for file in DILIGENT_FILES),
            partial(make_statue, k),
        )
        for k, name in enumerate(DILIGENT)
    ),
    *(
        Recipe(f"scan-{re.split('[-_.]', name)[0]}", 2200 + k, (f"meshes/{name}",), partial(make_scan, k, pose))
        for k, (name, pose) in enumerate(SCANS.items(), start=len(DILIGENT))
    ),
)
