"""Rays against triangle meshes: what each ray of a camera hits, whether a light reaches it, how that looks.

A `View` holds geometry alone, so that many materials and lights share one cast: `find_view` once, `light_view` per
light, `shade_view` per light and materials; `render_scene` is all three. The same by hand, with torch for the shading:
`find_hits`, `is_lit`, `dress` and `render.shade`. Conventions are those of `polsep.render.sphere_tracing`; normals are
interpolated from the mesh's vertices and face the camera. Results do not depend on the number of threads.

Cameras and lights with all of the mesh in front of them need no rays: triangles are filled in (`render.raster_kernel`)
and compared with the points behind them (`render.shadows_kernel`). Others, and `find_hits`, ask Embree. Needs the extra
``render``.
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

from polsep.compute.threads import Piece, share
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

#: How far above its surface a shadow ray starts, relative to the mesh's size.
LIFT = 2e-4
#: Rays that are cast together: enough to be worth a call, few enough to stay in a processor's cache.
RAYS_AT_ONCE = 131_072
#: Held while Embree builds.
_BUILDING = threading.Lock()


@dataclass(frozen=True)
class MeshScene:
    """A mesh that rays can be cast against; ``size``: its largest extent along an axis; ``middle`` of its box."""

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
        """Embree's hierarchy of the mesh, built when first needed: that takes longer than a cast of a small image."""
        with _BUILDING:
            if "tracer" in vars(self):  # built by another thread in the meantime: since Python 3.12 nothing else waits
                return vars(self)["tracer"]
            tracer = EmbreeScene()
            TriangleMesh(tracer, self.triangles.vertices, self.triangles.faces)
            # Embree builds at the first ray, which must not happen in two threads at once.
            tracer.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))
            vars(self)["tracer"] = tracer
            return tracer


@dataclass(frozen=True)
class Hits:
    """What those M of N rays hit that hit anything: ``ray [M]``, which of the N they are, and ``rays``, N.

    ``position`` and unit ``normal``, toward the camera; ``above``, where shadow rays start, just out of the smooth
    surface that the triangles stand for; all ``[3, M, 1]``. The material ``slot [M]``.
    """

    rays: int
    ray: Tensor
    position: Tensor
    normal: Tensor
    above: Tensor
    slot: Tensor


@dataclass(frozen=True)
class Band:
    """Some rows of a view: which of its ``pixels`` they are, their ``hits``, and the ``pixel [M]`` of each, ascending.

    Pixels count in reading order, ``pixels`` from the image's first one, ``pixel`` from the band's. ``whole``: the
    band's pixels of which every ray hits.
    """

    pixels: Piece
    hits: Hits
    pixel: Tensor
    whole: Tensor


@dataclass(frozen=True)
class View:
    """What a camera sees of a mesh in an H x W image, ``samples`` x ``samples`` rays per pixel, band by band."""

    camera: PinholeCamera
    size: tuple[int, int]
    samples: int
    bands: tuple[Band, ...]


#: Position and normal of hits ``[3, M]``, and where their shadow rays start, ``[M, 3]``.
Points = tuple[Floats, Floats, Floats]
#: What is rendered: a mesh, and a material for each of its slots.
Model = tuple[MeshScene, Materials]


def find_hits(scene: MeshScene, camera: PinholeCamera, points: tuple[Tensor, Tensor], size: tuple[int, int]) -> Hits:
    """The first triangles behind any image points (rows, cols) ``[N]`` of an H x W image, by Embree."""
    view = _pinhole(camera, size)
    rows, cols = (np.ascontiguousarray(x.numpy(), np.float32) for x in points)
    directions = np.empty((rows.size, 3), np.float32)
    rays.aim_rays(rows, cols, view, directions)
    return _cast(scene, view, directions)


def _pinhole(camera: PinholeCamera, size: tuple[int, int]) -> rays.Pinhole:
    eye, scale = np.array(camera.position, np.float32), np.float32(pixel_side(camera, size[0]))
    return rays.Pinhole(eye, np.ascontiguousarray(camera_axes(camera).numpy()), size, scale)


def _cast(scene: MeshScene, view: rays.Pinhole, directions: Floats) -> Hits:
    """What rays from the eye hit; ``directions [N, 3]``."""
    found = scene.tracer.run(np.broadcast_to(view.eye, directions.shape), directions, output=1)
    found = rays.Found(*(found[name] for name in ("primID", "Ng", "u", "v", "tfar")))
    return _interpolate(scene, view, found, directions)


def _interpolate(scene: MeshScene, view: rays.Pinhole, found: rays.Found, directions: Floats) -> Hits:
    """Hits from what was found along ``directions [N, 3]``."""
    count = int(np.count_nonzero(found.triangle >= 0))
    numbers = (np.empty(shape, np.float32) for shape in ((3, count), (3, count), (count, 3)))
    surface = rays.Surface(np.empty(count, np.int64), np.empty(count, np.int64), *numbers)
    rays.interpolate_hits(scene.triangles, found, (view.eye, directions), np.float32(LIFT * scene.size), surface)
    position, normal = (torch.from_numpy(x)[..., None] for x in (surface.position, surface.normal))
    above, ray = torch.from_numpy(surface.above).T[..., None], torch.from_numpy(surface.ray)
    return Hits(len(directions), ray, position, normal, above, torch.from_numpy(surface.slot))


def dress(hits: Hits, materials: Materials) -> GBuffer:
    """The G-buffer ``[*, M, 1]`` of hits with materials."""
    albedo, roughness, specular = look_up(materials, hits.slot, hits.position)
    mask = torch.ones_like(roughness, dtype=torch.bool)
    return GBuffer(hits.position, hits.normal, albedo, roughness, specular, mask)


def is_lit(scene: MeshScene, hits: Hits, light: PointLight) -> Tensor:
    """Whether hits face the light and see it, ``[1, M, 1]``."""
    return _lamp(scene, light)(hits)


def _lamp(scene: MeshScene, light: PointLight) -> Callable[[Hits], Tensor]:
    """`is_lit` of a light: by the triangles in front of it, or by Embree where some reach behind it."""
    eye = np.array(light.position, np.float32)
    view = rays.Pinhole(eye, _axes_along(scene.middle - eye), (0, 0), np.float32(1))
    seen = np.empty((3, len(scene.mesh.vertices)), np.float32)
    in_front = raster.project_vertices(scene.triangles, view, 1, seen)

    def light_hits(hits: Hits) -> Tensor:
        position, normal, above = (x[..., 0].numpy() for x in (hits.position, hits.normal, hits.above))
        points, lit = (position, normal, above.T), np.zeros(hits.ray.numel(), np.bool_)
        if in_front:
            _sort_and_hide(scene, view, seen, points, lit)
        else:
            _trace_to_light(scene, eye, points, lit)
        return torch.from_numpy(lit)[None, :, None]

    return light_hits


def _axes_along(forward: Floats) -> Floats:
    """Some unit vectors right and up of a direction, and that itself, ``[3, 3]``; of any, for a zero vector."""
    forward = forward if forward.any() else np.array([0.0, 0.0, -1.0])
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(right, forward), forward]).astype(np.float32)


def _sort_and_hide(scene: MeshScene, view: rays.Pinhole, seen: Floats, points: Points, lit: NDArray[np.bool_]) -> None:
    """Set which points are lit; ``seen``: the mesh's vertices from the light."""
    facing, ordered = (shadows.Facing.empty(lit.size) for _ in range(2))
    count = shadows.face_light(view, points, facing)
    if count:
        cells = shadows.sort_points(facing.first(count), ordered.first(count))
        hidden = np.zeros(count, np.bool_)
        shadows.hide_points(scene.triangles, seen, cells, hidden)
        shadows.mark_lit(cells.points, hidden, lit)


def _trace_to_light(scene: MeshScene, eye: Floats, points: Points, lit: NDArray[np.bool_]) -> None:
    """The same by rays to the light at ``eye``."""
    origins, directions = (np.empty((lit.size, 3), np.float32) for _ in range(2))
    toward = rays.Shadows(np.empty(lit.size, np.int64), origins, directions, np.empty(lit.size, np.float32))
    count = rays.aim_at_light(points, eye, toward)
    origins, directions, distances = origins[:count], directions[:count], toward.distance[:count]
    blocker = scene.tracer.run(origins, directions, query="OCCLUDED", dists=distances)
    lit[toward.hit[:count]] = blocker < 0


def find_view(scene: MeshScene, camera: PinholeCamera, size: tuple[int, int], samples: int = 1) -> View:
    """Everything that a camera sees, before materials and lights. Raises ValueError on a wrong number of samples."""
    cast = _prepare(scene, camera, size, samples)
    return View(camera, size, samples, tuple(_each(cast, _cut(size, samples))))


def light_view(scene: MeshScene, view: View, light: PointLight) -> tuple[Tensor, ...]:
    """Which hits of every band face the light and see it, each ``[1, M, 1]``."""
    lamp = _lamp(scene, light)
    return tuple(_each(lambda band: lamp(band.hits), view.bands))


def shade_view(view: View, materials: Materials, light: PointLight, lit: tuple[Tensor, ...]) -> Scene:
    """The scene of a view with these materials, under a light that reaches ``lit``, as `light_view` found.

    The specular is white: its three colours share memory. Twin of `render.shade`.
    """
    target = _Target.empty(view.size, view.samples)
    table = shading.material_table(materials)
    _each(
        lambda pair: target.shade(pair[0], (table, view.camera, light), pair[1]),
        list(zip(view.bands, lit, strict=True)),
    )
    return target.scene()


def render_scene(
    model: Model, camera: PinholeCamera, light: PointLight, size: tuple[int, int], samples: int = 1
) -> Scene:
    """A mesh under one light; a pixel is the mean over ``samples`` x ``samples`` rays, black where they hit nothing.

    The mask holds the pixels that all rays hit. Band by band, so that memory does not grow with the samples. The
    specular is white: its three colours share memory. Raises ValueError on a wrong number of samples.
    """
    scene, materials = model
    cast, lamp, target = _prepare(scene, camera, size, samples), _lamp(scene, light), _Target.empty(size, samples)
    table = shading.material_table(materials)

    def render_band(pixels: Piece) -> None:
        band = cast(pixels)
        target.shade(band, (table, camera, light), lamp(band.hits))

    _each(render_band, _cut(size, samples))
    return target.scene()


def render_mesh(
    model: Model, camera: PinholeCamera, light: PointLight, size: tuple[int, int], samples: int = 1
) -> tuple[Stokes, Stokes]:
    """`render.render` of a mesh: diffuse and specular Stokes images ``[3, H, W]``, black where rays hit nothing."""
    scene = render_scene(model, camera, light, size, samples)
    return scene.diffuse, scene.specular.map(torch.Tensor.contiguous)


@dataclass(frozen=True)
class _Target:
    """Room for a scene: ``light [12, H, W]``, in the order of `shading.CHANNELS`, and the ``mask [H, W]``."""

    light: Floats
    mask: NDArray[np.bool_]
    samples: int

    @classmethod
    def empty(cls, size: tuple[int, int], samples: int) -> _Target:
        return cls(np.empty((shading.CHANNELS, *size), np.float32), np.empty(size, np.bool_), samples)

    def shade(self, band: Band, look: tuple[shading.Table, PinholeCamera, PointLight], lit: Tensor) -> None:
        """Fill in a band."""
        hits, (first, stop) = band.hits, band.pixels
        image = np.zeros((stop - first, shading.CHANNELS), np.float32)
        position, normal = (x[..., 0].numpy() for x in (hits.position, hits.normal))
        points = shading.Points(position, normal, hits.slot.numpy(), band.pixel.numpy(), lit[0, :, 0].numpy())
        shading.shade_pixels(points, *look, image)
        pixels = self.light.reshape(shading.CHANNELS, -1)[:, first:stop]
        shading.spread_pixels(image, np.float32(1 / self.samples**2), pixels)
        self.mask.reshape(-1)[first:stop] = band.whole.numpy()

    def scene(self) -> Scene:
        light = torch.from_numpy(self.light)
        diffuse = Stokes(light[0:3], light[3:6], light[6:9])
        specular = Stokes(*(light[k : k + 1].expand(3, -1, -1) for k in (9, 10, 11)))
        return Scene(diffuse, specular, torch.from_numpy(self.mask))


def _cut(size: tuple[int, int], samples: int) -> list[Piece]:
    """The pixels of the bands, the same whatever the number of threads."""
    height, width = size
    rows = max(1, RAYS_AT_ONCE // (width * samples**2))
    return [(row * width, min(row + rows, height) * width) for row in range(0, height, rows)]


def _each(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Results of a function for all items, in their order, computed in threads."""
    results: dict[int, Result] = {}

    def work(piece: Piece) -> None:
        results.update((index, function(items[index])) for index in range(*piece))

    share(work, len(items), 1)
    return [results[index] for index in range(len(items))]


def _prepare(scene: MeshScene, camera: PinholeCamera, size: tuple[int, int], samples: int) -> Callable[[Piece], Band]:
    """What casts the rays of a band: by filling triangles in, or by Embree where some reach behind the camera."""
    if samples < 1 or samples**2 > shading.BLOCK:
        raise ValueError(f"expected 1 to {int(shading.BLOCK**0.5)} samples along a pixel's side, found {samples}")
    width, view, image = size[1], _pinhole(camera, size), _project(scene, _pinhole(camera, size), samples)

    def cast_band(pixels: Piece) -> Band:
        rows = (pixels[0] // width, pixels[1] // width)
        hits = _trace(scene, view, rows, samples) if image is None else _fill(scene, view, image, rows, samples)
        pixel = hits.ray // samples**2
        whole = torch.bincount(pixel, minlength=pixels[1] - pixels[0]) == samples**2
        return Band(pixels, hits, pixel, whole)

    return cast_band


def _trace(scene: MeshScene, view: rays.Pinhole, band: Piece, samples: int) -> Hits:
    """What the samples of the pixels of some rows hit, by Embree; a pixel's samples follow each other."""
    sides = (np.arange(first * samples, stop * samples) for first, stop in (band, (0, view.size[1])))
    rows, cols = ((np.float32(side) + np.float32(0.5)).reshape(-1, samples) / np.float32(samples) for side in sides)
    grid_rows, grid_cols = np.broadcast_arrays(rows[:, None, :, None], cols[None, :, None, :])
    directions = np.empty((grid_rows.size, 3), np.float32)
    rays.aim_rays(grid_rows.flatten(), grid_cols.flatten(), view, directions)
    return _cast(scene, view, directions)


def _project(scene: MeshScene, view: rays.Pinhole, samples: int) -> raster.Image | None:
    """The mesh in the image, or None if some of it is not in front of the camera."""
    projected = np.empty((3, len(scene.mesh.vertices)), np.float32)
    if not raster.project_vertices(scene.triangles, view, samples, projected):
        return None
    spans = np.empty((len(scene.mesh.faces), 2), np.int32)
    raster.span_rows(scene.triangles, projected, view.size[0] * samples, spans)
    return projected, spans


def _fill(scene: MeshScene, view: rays.Pinhole, image: raster.Image, band: Piece, samples: int) -> Hits:
    """The same by filling triangles in."""
    shape = ((band[1] - band[0]) * samples, view.size[1] * samples)
    triangle = np.full(shape, -1, np.int32)
    raster.fill_triangles(scene.triangles, image, band[0] * samples, np.zeros(shape, np.float32), triangle)
    count = int(np.count_nonzero(triangle >= 0))
    directions, facing = (np.empty((count, 3), np.float32) for _ in range(2))
    found = rays.Found(np.empty(count, np.int32), facing, *(np.empty(count, np.float32) for _ in range(3)))
    ray = np.empty(count, np.int64)
    raster.meet_triangles(scene.triangles, view, triangle, (band[0], samples, ray, directions), found)
    return replace(_interpolate(scene, view, found, directions), rays=triangle.size, ray=torch.from_numpy(ray))
