"""A mesh with colours from depth, and its pictures under another light and from other sides.

Meshes have x right, y up, z to the camera, are centred and have a largest extent of 1. Where the depth jumps by more
than the normals explain, triangles are left out: the surface there is not known. Needs the extra ``mesh``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polsep.geometry.integration import Slopes, find_slopes, pixel_rays
from polsep.geometry.lights import direction_at
from polsep.geometry.photometric import Appearance
from polsep.render.tracer import Tracer
from polsep.render.triangles import without_fragments

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

#: A rise between neighbours is a jump if it differs from that of their normals by this many pixels and this share.
JUMP, JUMP_SHARE = 1.5, 1.5
#: Larger rises [pixels] count as jumps.
MAX_RISE = 8.0
#: Field of view [degrees] of pictures of a mesh, and the distance of their camera in extents.
FOV_DEG, DISTANCE = 24.0, 2.9
#: Direction toward the light of pictures, in the camera's frame.
PICTURE_LIGHT = (-0.45, 0.55, 0.7)
#: Light that reaches surfaces that face away.
AMBIENT = 0.06


@dataclass(frozen=True)
class Surface:
    """Triangles ``faces [F, 3]`` of ``vertices [V, 3]`` with unit ``normals [V, 3]`` and linear ``colors [V, 3]``."""

    vertices: Floats
    normals: Floats
    colors: Floats
    faces: Integers


def span_surface(appearance: Appearance, depth: Floats, intrinsics: Floats | None = None) -> Surface:
    """The surface of a depth map of `integration`, with the normals and albedo of its pixels. Raises ValueError."""
    mask = appearance.mask & np.isfinite(depth)
    if intrinsics is None:
        rows, cols = np.mgrid[: mask.shape[0], : mask.shape[1]].astype(np.float64)
        points, focal, flat = np.stack([cols, -rows, -depth], axis=-1), 1.0, depth
    else:
        across, upward = pixel_rays(mask.shape, intrinsics)
        points = np.stack([across, upward, -np.ones_like(depth)], axis=-1) * depth[..., None]
        focal = float(intrinsics[0, 0])
        flat = focal * np.log(np.where(mask, depth, 1.0))  # rises in pixels, whatever the distance
    slopes = find_slopes(appearance.normals, mask, intrinsics)
    faces = without_fragments(_triangles(mask, _steady_links(slopes, focal, flat)))
    if not len(faces):
        raise ValueError("expected a surface of three pixels or more, found none")
    kept, faces = np.unique(faces, return_inverse=True)
    vertices = points[mask][kept]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / max(float((high - low).max()), float(np.finfo(np.float64).tiny))
    colors = np.broadcast_to(appearance.albedo, (*mask.shape, 3))[mask][kept]
    return Surface(vertices, appearance.normals[mask][kept], colors, faces.reshape(-1, 3))


def _steady_links(slopes: Slopes, focal: float, depth: Floats) -> tuple[NDArray[np.bool_], ...]:
    """Links to the right ``[H, W-1]`` and down ``[H-1, W]`` across which the depth [pixels] is continuous.

    ``focal``: of the slopes, in pixels; 1 of an orthographic camera.
    """
    mask, cosine, steady = slopes.mask, slopes.cosine / focal, []
    for slope, first, second in (
        (slopes.right / cosine, np.s_[:, :-1], np.s_[:, 1:]),
        (slopes.down / cosine, np.s_[:-1], np.s_[1:]),
    ):
        expected = (slope[first] + slope[second]) / 2
        largest = np.maximum(np.abs(slope[first]), np.abs(slope[second]))
        with np.errstate(invalid="ignore"):
            rise = depth[second] - depth[first]
            continuous = (np.abs(rise - expected) <= JUMP + JUMP_SHARE * largest) & (np.abs(rise) <= MAX_RISE)
        steady.append(mask[first] & mask[second] & continuous)
    return tuple(steady)


def _triangles(mask: NDArray[np.bool_], links: tuple[NDArray[np.bool_], ...]) -> Integers:
    """Two triangles per square of four pixels, counter-clockwise, of numbers of pixels in the mask."""
    right, down = links
    number = np.cumsum(mask.reshape(-1)).reshape(mask.shape) - 1
    corner, beside, below, across = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    upper, lower = right[:-1] & down[:, :-1] & mask[:-1, 1:], right[1:] & down[:, 1:]
    first, second = upper & mask[1:, :-1], lower & mask[1:, :-1] & mask[:-1, 1:]
    return np.concatenate(
        [
            np.stack([corner, below, beside], axis=-1)[first],
            np.stack([beside, below, across], axis=-1)[second],
        ]
    )


def relight(appearance: Appearance, direction: tuple[float, float, float] = PICTURE_LIGHT) -> Floats:
    """The image ``[H, W, C]`` under a far light in a ``direction``, without cast shadows."""
    toward = np.array(direction) / math.hypot(*direction)
    shading = np.maximum(appearance.normals @ toward, 0) + AMBIENT
    image: Floats = appearance.albedo * shading[..., None]
    return image


def draw_views(surface: Surface, size: int, views: Sequence[tuple[float, float]]) -> Iterator[Floats]:
    """Linear pictures ``[size, size, 3]`` of a mesh from (azimuth, elevation) [degrees]; the light moves along.

    They are 0 outside the mesh. Back faces are drawn too.
    """
    tracer = Tracer(surface.vertices, surface.faces)
    colors = surface.colors[surface.faces].mean(axis=1)
    reach = math.tan(math.radians(FOV_DEG / 2))
    ticks = reach * ((np.arange(2 * size) + 0.5) / size - 1)  # of four rays per pixel, on a plane at distance 1
    down, across = (grid.reshape(-1, 1) for grid in np.meshgrid(ticks, ticks, indexing="ij"))
    light = np.array(PICTURE_LIGHT) / math.hypot(*PICTURE_LIGHT)
    for azimuth_deg, elevation_deg in views:
        azimuth, back = math.radians(azimuth_deg), np.array(direction_at(azimuth_deg, elevation_deg))
        right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
        up = np.cross(back, right)
        directions = across * right - down * up - back
        ray, face, weights = tracer.look(DISTANCE * back, directions)
        normals = (weights[..., None] * surface.normals[surface.faces[face]]).sum(axis=1)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
        normals *= np.where((normals * directions[ray]).sum(axis=-1, keepdims=True) > 0, -1, 1)  # toward the camera
        toward = light[0] * right + light[1] * up + light[2] * back
        fine = np.zeros((len(directions), 3))
        fine[ray] = colors[face] * (np.maximum(normals @ toward, 0) + AMBIENT)[:, None]
        cells = fine.reshape(size, 2, size, 2, 3)
        picture: Floats = 0.25 * (cells[:, 0, :, 0] + cells[:, 0, :, 1] + cells[:, 1, :, 0] + cells[:, 1, :, 1])
        yield picture
