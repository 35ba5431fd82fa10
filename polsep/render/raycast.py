"""Rendering of triangle meshes: first hits of camera rays, shadows of a point light, shading.

A `View` holds geometry alone, so that many materials and lights share one cast: `find_view` once, `find_lit` per light,
`shade_view` per light and materials. `render_scene` does all three band by band. `find_hits`, `is_lit`, `build_gbuffer`
and `sphere_tracing.shade` are the same steps in torch for any image points. Conventions are those of
`polsep.render.sphere_tracing`; normals are interpolated from the mesh's vertices and face the camera. Results do not
depend on the number of threads.

If all vertices are in front of the camera, its triangles are rasterized (`render.raster_kernel`); if all are in front
of the light, shadows come from an irregular z-buffer (`render.shadows_kernel`). Otherwise, and in `find_hits`, Embree
casts rays. Both ways differ in the last bits and at single samples on edges. Rays take 2.8 times as long for hits and
shadows and 1.7 times for a whole exposed frame of 1024 x 1024 pixels (0.76 s and 1.07 s against 0.27 s and 0.63 s on
one core; ``python -m evaluation.rays``). Needs the extra ``render``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from torch import Tensor

from polsep.compute.threads import RowRange, run_over_rows
from polsep.physics.stokes import Stokes
from polsep.render import raster_kernel as raster
from polsep.render import rays_kernel as rays
from polsep.render import shading_kernel as shading
from polsep.render import shadows_kernel as shadows
from polsep.render.materials import Materials, look_up
from polsep.render.shapes import Mesh
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, Scene, camera_axes, pixel_side

Item = TypeVar("Item")
Result = TypeVar("Result")

Floats = NDArray[np.float32]

#: Distance between a shadow ray's origin and the surface, relative to the mesh's size.
SHADOW_OFFSET = 2e-4
#: Rays per band: enough to outweigh the overhead of a call, few enough to stay in a processor's cache.
RAYS_PER_BAND = 131_072
#: Held while Embree builds.
_BUILDING = threading.Lock()


@dataclass(frozen=True)
class MeshScene:
    """A mesh for ray casting; ``size``: its largest extent along an axis; ``middle``: of its bounding box."""

    mesh: Mesh
    size: float = field(init=False)
    middle: Floats = field(init=False, repr=False, compare=False)
    triangles: rays.Triangles = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        mesh = self.mesh
        vertices, normals = (np.ascontiguousarray(x, np.float32) for x in (mesh.vertices, mesh.normals))
        faces, slots = (np.ascontiguousarray(x, np.int32) for x in (mesh.faces, mesh.slots))
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        object.__setattr__(self, "size", float((high - low).max()))
        object.__setattr__(self, "middle", (low + high) / 2)
        object.__setattr__(self, "triangles", rays.Triangles(vertices, normals, faces, slots))

    @cached_property
    def tracer(self) -> Any:
        """Embree's hierarchy of the mesh, built on first use: that takes longer than a cast of a small image."""
        with _BUILDING:
            if "tracer" in vars(self):  # built by another thread: cached_property has no lock since Python 3.12
                return vars(self)["tracer"]
            tracer = EmbreeScene()
            TriangleMesh(tracer, self.triangles.vertices, self.triangles.faces)
            # Embree builds at the first ray, which must not happen in two threads at once.
            tracer.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
            vars(self)["tracer"] = tracer
            return tracer


#: A mesh, and a material for each of its slots.
Model = tuple[MeshScene, Materials]


@dataclass(frozen=True)
class Hits:
    """First hits of N rays (``rays``), of which M hit the mesh: ``ray [M]`` holds their indices.

    ``position`` and unit ``normal``, toward the camera; ``above``: origins of shadow rays, just above the smooth
    surface that the triangles approximate; all ``[3, M, 1]``. ``slot [M]``: material slot.
    """

    rays: int
    ray: Tensor
    position: Tensor
    normal: Tensor
    above: Tensor
    slot: Tensor


@dataclass(frozen=True)
class Band:
    """Some rows of a view: the range of their ``pixels`` in the image, their ``hits``, and the ``pixel [M]`` of each.

    Pixels count in reading order; ``pixel`` counts from the band's first one and ascends. ``covered``: bool, the band's
    pixels of which every ray hits.
    """

    pixels: RowRange
    hits: Hits
    pixel: Tensor
    covered: Tensor


@dataclass(frozen=True)
class View:
    """The hits of a camera's rays in an H x W image, ``samples`` x ``samples`` rays per pixel, band by band."""

    camera: PinholeCamera
    size: tuple[int, int]
    samples: int
    bands: tuple[Band, ...]


def find_hits(scene: MeshScene, camera: PinholeCamera, points: tuple[Tensor, Tensor], size: tuple[int, int]) -> Hits:
    """Return the first hits behind image points (rows, cols) ``[N]`` of an H x W image, by Embree."""
    rows, cols = (np.ascontiguousarray(x.numpy(), np.float32) for x in points)
    return _trace(scene, _pinhole(camera, size), rows, cols)


def _pinhole(camera: PinholeCamera, size: tuple[int, int]) -> rays.Pinhole:
    eye, scale = np.array(camera.position, np.float32), np.float32(pixel_side(camera, size[0]))
    return rays.Pinhole(eye, np.ascontiguousarray(camera_axes(camera).numpy()), size, scale)


def _trace(scene: MeshScene, view: rays.Pinhole, rows: Floats, cols: Floats) -> Hits:
    """Hits of the rays through image points ``[N]``, by Embree."""
    directions = np.empty((rows.size, 3), np.float32)
    rays.aim_rays(rows, cols, view, directions)
    found = scene.tracer.run(np.broadcast_to(view.eye, directions.shape), directions, output=1)
    found = rays.Found(*(found[name] for name in ("primID", "Ng", "u", "v", "tfar")))
    return _interpolate(scene, view, found, directions)


def _interpolate(scene: MeshScene, view: rays.Pinhole, found: rays.Found, directions: Floats) -> Hits:
    """Hits at the intersections of rays along ``directions [N, 3]``."""
    count = int(np.count_nonzero(found.triangle >= 0))
    numbers = (np.empty(shape, np.float32) for shape in ((3, count), (3, count), (count, 3)))
    surface = rays.Surface(np.empty(count, np.int64), np.empty(count, np.int64), *numbers)
    offset = np.float32(SHADOW_OFFSET * scene.size)
    rays.interpolate_hits(scene.triangles, found, view.eye, directions, offset, surface)
    position, normal = (torch.from_numpy(x)[..., None] for x in (surface.position, surface.normal))
    above, ray = torch.from_numpy(surface.above).T[..., None], torch.from_numpy(surface.ray)
    return Hits(len(directions), ray, position, normal, above, torch.from_numpy(surface.slot))


def build_gbuffer(hits: Hits, materials: Materials) -> GBuffer:
    """Return the G-buffer ``[*, M, 1]`` of hits with materials."""
    albedo, roughness, specular = look_up(materials, hits.slot, hits.position)
    mask = torch.ones_like(roughness, dtype=torch.bool)
    return GBuffer(hits.position, hits.normal, albedo, roughness, specular, mask)


def is_lit(scene: MeshScene, hits: Hits, light: PointLight) -> Tensor:
    """Return True for hits that face the light and are not in shadow, ``[1, M, 1]``."""
    return _shadow_test(scene, light)(hits)


def _shadow_test(scene: MeshScene, light: PointLight) -> Callable[[Hits], Tensor]:
    """`is_lit` for one light: by projected triangles, or by Embree if some vertices are not in front of the light."""
    eye = np.array(light.position, np.float32)
    view = rays.Pinhole(eye, _axes_along(scene.middle - eye), (0, 0), np.float32(1))
    projected = np.empty((3, len(scene.mesh.vertices)), np.float32)
    in_front = raster.project_vertices(scene.triangles, view, 1, projected)

    def test_by_triangles(position: Floats, normal: Floats, above: Floats, lit: NDArray[np.bool_]) -> None:
        facing, ordered = (shadows.Facing.empty(lit.size) for _ in range(2))
        count = shadows.select_facing(view, position, normal, above, facing)
        if count:
            cells = shadows.sort_points(facing.first(count), ordered.first(count))
            hidden = np.zeros(count, np.bool_)
            shadows.hide_points(scene.triangles, projected, cells, hidden)
            shadows.mark_lit(cells.points, hidden, lit)

    def test_by_rays(position: Floats, normal: Floats, above: Floats, lit: NDArray[np.bool_]) -> None:
        origins, directions = (np.empty((lit.size, 3), np.float32) for _ in range(2))
        toward = rays.Shadows(np.empty(lit.size, np.int64), origins, directions, np.empty(lit.size, np.float32))
        count = rays.aim_at_light(position, normal, above, eye, toward)
        blocker = scene.tracer.run(origins[:count], directions[:count], query="OCCLUDED", dists=toward.distance[:count])
        lit[toward.hit[:count]] = blocker < 0

    def test(hits: Hits) -> Tensor:
        position, normal, above = (x[..., 0].numpy() for x in (hits.position, hits.normal, hits.above))
        lit = np.zeros(hits.ray.numel(), np.bool_)
        (test_by_triangles if in_front else test_by_rays)(position, normal, above.T, lit)
        return torch.from_numpy(lit)[None, :, None]

    return test


def _axes_along(forward: Floats) -> Floats:
    """Unit vectors right, up and forward ``[3, 3]`` of a view in a direction, or in any for a zero vector."""
    forward = forward if forward.any() else np.array([0.0, 0.0, -1.0])
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward]).astype(np.float32)


def find_view(scene: MeshScene, camera: PinholeCamera, size: tuple[int, int], samples: int = 1) -> View:
    """Return the hits of a camera's rays, before materials and lights. Raises ValueError on a bad number of samples."""
    cast = _band_caster(scene, camera, size, samples)
    return View(camera, size, samples, tuple(_map_in_threads(cast, _split_rows(size, samples))))


def find_lit(scene: MeshScene, view: View, light: PointLight) -> tuple[Tensor, ...]:
    """Return `is_lit` for the hits of every band, each ``[1, M, 1]``."""
    test = _shadow_test(scene, light)
    return tuple(_map_in_threads(lambda band: test(band.hits), view.bands))


def shade_view(view: View, materials: Materials, light: PointLight, lit: tuple[Tensor, ...]) -> Scene:
    """Return the scene of a view with these materials under a light; ``lit``: from `find_lit`.

    The specular is white: its three colours share memory. Twin of `sphere_tracing.shade`.
    """
    images = _Images(materials, view.camera, light, view.size, view.samples)
    _map_in_threads(lambda pair: images.shade(*pair), list(zip(view.bands, lit, strict=True)))
    return images.scene()


def render_scene(
    model: Model, camera: PinholeCamera, light: PointLight, size: tuple[int, int], samples: int = 1
) -> Scene:
    """Return a mesh under one light; a pixel is the mean over ``samples`` x ``samples`` rays, black where none hits.

    The mask holds the pixels that all rays hit. Works band by band, so that memory does not grow with the samples. The
    specular is white: its three colours share memory. Raises ValueError on a bad number of samples.
    """
    scene, materials = model
    cast, test = _band_caster(scene, camera, size, samples), _shadow_test(scene, light)
    images = _Images(materials, camera, light, size, samples)

    def render_band(pixels: RowRange) -> None:
        band = cast(pixels)
        images.shade(band, test(band.hits))

    _map_in_threads(render_band, _split_rows(size, samples))
    return images.scene()


class _Images:
    """Images of a scene, which bands are shaded into. State: ``light [12, H, W]`` (`shading.CHANNELS`), ``mask``."""

    def __init__(
        self, materials: Materials, camera: PinholeCamera, light: PointLight, size: tuple[int, int], samples: int
    ) -> None:
        self.table, self.beams = shading.material_table(materials), shading.build_beams(camera, light)
        self.light, self.mask = np.empty((shading.CHANNELS, *size), np.float32), np.empty(size, np.bool_)
        self.scale = np.float32(1 / samples**2)

    def shade(self, band: Band, lit: Tensor) -> None:
        hits, (first, stop) = band.hits, band.pixels
        image = np.zeros((stop - first, shading.CHANNELS), np.float32)
        position, normal = (x[..., 0].numpy() for x in (hits.position, hits.normal))
        points = shading.Points(position, normal, hits.slot.numpy(), band.pixel.numpy(), lit[0, :, 0].numpy())
        shading.shade_pixels(points, self.table, self.beams, image)
        shading.spread_pixels(image, self.scale, self.light.reshape(shading.CHANNELS, -1)[:, first:stop])
        self.mask.reshape(-1)[first:stop] = band.covered.numpy()

    def scene(self) -> Scene:
        light = torch.from_numpy(self.light)
        diffuse = Stokes(light[0:3], light[3:6], light[6:9])
        specular = Stokes(*(light[k : k + 1].expand(3, -1, -1) for k in (9, 10, 11)))
        return Scene(diffuse, specular, torch.from_numpy(self.mask))


def _split_rows(size: tuple[int, int], samples: int) -> list[RowRange]:
    """Ranges of pixels of the bands; they do not depend on the number of threads."""
    height, width = size
    rows = max(1, RAYS_PER_BAND // (width * samples**2))
    return [(row * width, min(row + rows, height) * width) for row in range(0, height, rows)]


def _map_in_threads(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Results of a function for all items, in their order."""
    results: dict[int, Result] = {}

    def work(row_range: RowRange) -> None:
        results.update((index, function(items[index])) for index in range(*row_range))

    run_over_rows(work, len(items), 1)
    return [results[index] for index in range(len(items))]


def _band_caster(
    scene: MeshScene, camera: PinholeCamera, size: tuple[int, int], samples: int
) -> Callable[[RowRange], Band]:
    """Function that finds the hits of a band: by rasterization, or by Embree if some vertices are behind the camera."""
    if samples < 1 or samples**2 > shading.BLOCK:
        raise ValueError(f"expected 1 to {int(shading.BLOCK**0.5)} samples along a pixel's side, found {samples}")
    (height, width), view = size, _pinhole(camera, size)
    projected, spans = (
        np.empty((3, len(scene.mesh.vertices)), np.float32),
        np.empty((len(scene.mesh.faces), 2), np.int32),
    )
    in_front = raster.project_vertices(scene.triangles, view, samples, projected)
    if in_front:
        raster.span_rows(scene.triangles, projected, height * samples, spans)

    def trace(rows: RowRange) -> Hits:
        sides = (np.arange(first * samples, stop * samples) for first, stop in (rows, (0, width)))
        y, x = ((np.float32(side) + np.float32(0.5)).reshape(-1, samples) / np.float32(samples) for side in sides)
        grid_y, grid_x = np.broadcast_arrays(y[:, None, :, None], x[None, :, None, :])
        return _trace(scene, view, grid_y.flatten(), grid_x.flatten())

    def rasterize(rows: RowRange) -> Hits:
        shape = ((rows[1] - rows[0]) * samples, width * samples)
        triangle, nearest = np.full(shape, -1, np.int32), np.zeros(shape, np.float32)
        raster.fill_triangles(scene.triangles, projected, spans, rows[0] * samples, nearest, triangle)
        count = int(np.count_nonzero(triangle >= 0))
        directions, facing = (np.empty((count, 3), np.float32) for _ in range(2))
        weights = (np.empty(count, np.float32) for _ in range(3))
        found, ray = rays.Found(np.empty(count, np.int32), facing, *weights), np.empty(count, np.int64)
        raster.intersect_triangles(scene.triangles, view, triangle, rows[0], samples, ray, directions, found)
        hits = _interpolate(scene, view, found, directions)
        return replace(hits, rays=triangle.size, ray=torch.from_numpy(ray))

    def cast_band(pixels: RowRange) -> Band:
        hits = (rasterize if in_front else trace)((pixels[0] // width, pixels[1] // width))
        pixel = hits.ray // samples**2
        covered = torch.bincount(pixel, minlength=pixels[1] - pixels[0]) == samples**2
        return Band(pixels, hits, pixel, covered)

    return cast_band
