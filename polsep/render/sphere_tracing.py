"""Exact diffuse and specular Stokes images of a scene: sphere tracing, shadows, shading by `optics`.

Conventions: world axes are x right, y up, z toward the viewer; lengths are in scene units. Pixel (row, col) of an
H x W image looks through the centre of its square. Shading is exact per point: the diffuse and the specular lobe are
never mixed, so their sum is the mixed Stokes image of the paper's Eq. 9.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.physics.optics import Geometry, diffuse_stokes, dot, normalize, specular_stokes
from polsep.physics.stokes import Stokes

Vector = tuple[float, float, float]

#: Sphere tracing (Hart 1996): largest number of steps, and distance in scene units that counts as a hit.
MAX_STEPS = 160
HIT_DISTANCE = 2e-4
#: Length of rays, relative to the camera's distance from its target; longer ones miss.
FAR = 4.0
#: Rays traced together, which bounds memory.
RAYS_AT_ONCE = 250_000


@dataclass(frozen=True)
class Part:
    """One object: a signed distance in its own coordinates, a pose, a material.

    ``distance`` maps local points ``[3, N, 1]`` to ``[1, N, 1]``; ``albedo`` maps them to linear RGB ``[3, N, 1]``.
    ``rotation``: angles about x, y, z [rad]. ``roughness`` is GGX sqrt(alpha), ``specular`` scales the Fresnel lobe.
    """

    distance: Callable[[Tensor], Tensor]
    albedo: Callable[[Tensor], Tensor]
    center: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    roughness: float = 0.3
    specular: float = 1.0


@dataclass(frozen=True)
class PinholeCamera:
    """A pinhole camera: position, the point it looks at, vertical field of view [degrees]; up is world +y."""

    position: Vector = (0.0, 0.0, 8.0)
    target: Vector = (0.0, 0.0, 0.0)
    fov_deg: float = 28.0


@dataclass(frozen=True)
class PointLight:
    """A fully linearly polarized point light; ``polarizer`` [rad] is in its beam's frame with up = world +y."""

    position: Vector = (1.0, 2.0, 8.0)
    intensity: float = 100.0
    polarizer: float = 0.0


@dataclass(frozen=True)
class GBuffer:
    """First hits of rays: position and normal ``[3, H, W]``, material maps and the mask of hits ``[1, H, W]``."""

    position: Tensor
    normal: Tensor
    albedo: Tensor
    roughness: Tensor
    specular: Tensor
    mask: Tensor


@dataclass(frozen=True)
class Scene:
    """Exact lobes on the sensor: ``diffuse``, ``specular`` ``[C, H, W]`` and the object ``mask [H, W]``.

    The mask holds the pixels that objects cover completely. Lobes are in the light's units until an exposure scales
    them so that 1 is the white level of one measurement; then their s0 are the truth of a separation.
    """

    diffuse: Stokes
    specular: Stokes
    mask: Tensor


def rotation_matrix(angles: Vector) -> Tensor:
    """Return Rz Ry Rx ``[3, 3]`` for angles about x, y, z [rad]."""
    (sx, cx), (sy, cy), (sz, cz) = ((math.sin(a), math.cos(a)) for a in angles)
    rx = torch.tensor([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = torch.tensor([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = torch.tensor([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])
    return rz @ ry @ rx


def _local(part: Part, points: Tensor) -> Tensor:
    center = torch.tensor(part.center, dtype=torch.float32).to(points).view(3, 1, 1)
    return torch.einsum("ji,jnw->inw", rotation_matrix(part.rotation).to(points), points - center)


def scene_distance(parts: tuple[Part, ...], points: Tensor) -> Tensor:
    """Return the signed distance ``[1, N, 1]`` of world points ``[3, N, 1]`` to the union of the parts."""
    return torch.stack([part.distance(_local(part, points)) for part in parts]).amin(dim=0)


def trace(parts: tuple[Part, ...], origin: Tensor, direction: Tensor, limit: Tensor) -> tuple[Tensor, Tensor]:
    """March rays ``[3, N, 1]`` to the first surface or ``limit``; return distance and hit mask ``[1, N, 1]``."""
    travelled = torch.full_like(direction[:1], 2e-3)
    hit = torch.zeros_like(travelled, dtype=torch.bool)
    active = torch.arange(travelled.numel(), device=travelled.device)
    for _ in range(MAX_STEPS):
        t = travelled[:, active]
        d = scene_distance(parts, origin[:, active] + t * direction[:, active])
        close = d < HIT_DISTANCE
        hit[:, active] = close
        travelled[:, active] = torch.where(close, t, t + 0.8 * d)
        active = active[(~close & (travelled[:, active] < limit[:, active])).flatten()]
        if active.numel() == 0:
            break
    return travelled, hit


def surface_normal(parts: tuple[Part, ...], points: Tensor) -> Tensor:
    """Return unit normals ``[3, N, 1]`` by central differences of the signed distance."""
    step = 1e-3
    axes = torch.eye(3, dtype=points.dtype, device=points.device)
    gradient = [
        scene_distance(parts, points + step * e.view(3, 1, 1)) - scene_distance(parts, points - step * e.view(3, 1, 1))
        for e in axes
    ]
    return normalize(torch.cat(gradient))


def camera_axes(camera: PinholeCamera) -> Tensor:
    """Return unit vectors right, up and forward ``[3, 3]``. Raises ValueError for a vertical direction of view."""
    if math.hypot(camera.position[0] - camera.target[0], camera.position[2] - camera.target[2]) < 1e-6:
        raise ValueError("expected a camera that does not look straight up or down, its up vector is world +y")
    eye, target = torch.tensor(camera.position, dtype=torch.float32), torch.tensor(camera.target, dtype=torch.float32)
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 1.0, 0.0])), dim=0)
    return torch.stack([right, torch.linalg.cross(right, forward), forward])


def pixel_side(camera: PinholeCamera, height: int) -> float:
    """Return the side of a pixel of an image of that height, at distance 1 from the camera."""
    return 2 * math.tan(math.radians(camera.fov_deg) / 2) / height


def camera_rays(camera: PinholeCamera, rows: Tensor, cols: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Return origin ``[3, 1, 1]`` and unit directions ``[3, N, 1]`` of rays through points of an H x W image."""
    height, width = size
    right, up, forward = camera_axes(camera)
    scale = pixel_side(camera, height)
    x, y = (cols - width / 2) * scale, (height / 2 - rows) * scale
    rays = forward[:, None] + right[:, None] * x + up[:, None] * y
    return torch.tensor(camera.position, dtype=torch.float32).view(3, 1, 1), normalize(rays[..., None])


def cast(parts: tuple[Part, ...], camera: PinholeCamera, rows: Tensor, cols: Tensor, size: tuple[int, int]) -> GBuffer:
    """Return the G-buffer ``[*, N, 1]`` of the image points (rows, cols), one ray each."""
    origin, direction = camera_rays(camera, rows, cols, size)
    origin = origin.expand_as(direction)
    far = FAR * math.dist(camera.position, camera.target)
    travelled, hit = trace(parts, origin, direction, torch.full_like(direction[:1], far))
    position = origin + travelled * direction
    nearest = torch.stack([part.distance(_local(part, position)) for part in parts]).argmin(dim=0)
    albedo, roughness, specular = torch.zeros_like(position), torch.ones_like(travelled), torch.zeros_like(travelled)
    for index, part in enumerate(parts):
        here = (nearest == index)[0, :, 0]
        albedo[:, here] = part.albedo(_local(part, position[:, here]))
        roughness[:, here], specular[:, here] = part.roughness, part.specular
    return GBuffer(position, surface_normal(parts, position), albedo, roughness, specular, hit)


def is_lit(parts: tuple[Part, ...], buffer: GBuffer, light: PointLight) -> Tensor:
    """Return True for points of a G-buffer that are not in shadow, ``[1, N, 1]``; False without a hit."""
    to_light = torch.tensor(light.position, dtype=torch.float32).to(buffer.position).view(3, 1, 1) - buffer.position
    distance = torch.sqrt(dot(to_light, to_light))
    _, shadowed = trace(parts, buffer.position + 4e-3 * buffer.normal, to_light / distance, distance)
    return buffer.mask & ~shadowed


def beams_at(position: Tensor, normal: Tensor, camera: PinholeCamera, light: PointLight) -> tuple[Geometry, Tensor]:
    """Return the beams at points ``[3, *]`` from a light and to a camera, and the irradiance without the cosine."""
    eye, lamp, up = (
        torch.tensor(v, dtype=torch.float32).to(position).view(3, 1, 1)
        for v in (camera.position, light.position, (0.0, 1.0, 0.0))
    )
    to_light = lamp - position
    distance = torch.sqrt(dot(to_light, to_light))
    geometry = Geometry(normal, normalize(eye - position), to_light / distance, up, up)
    return geometry, light.intensity / distance**2


def shade(buffer: GBuffer, camera: PinholeCamera, light: PointLight, lit: Tensor) -> tuple[Stokes, Stokes]:
    """Return diffuse and specular Stokes images ``[3, N, 1]`` of a G-buffer, black where not ``lit``."""
    geometry, irradiance = beams_at(buffer.position, buffer.normal, camera, light)
    irradiance = irradiance * lit
    polarizer = torch.tensor(light.polarizer, dtype=torch.float32).to(buffer.position)
    diffuse = diffuse_stokes(geometry, polarizer, irradiance, buffer.albedo)
    specular = specular_stokes(geometry, polarizer, irradiance, buffer.roughness) * buffer.specular
    return diffuse, specular.map(lambda s: s.expand_as(diffuse.s0))


def render(
    parts: tuple[Part, ...], camera: PinholeCamera, light: PointLight, size: tuple[int, int], samples: int = 1
) -> tuple[Stokes, Stokes]:
    """Return diffuse and specular Stokes images ``[3, H, W]``, means of ``samples`` x ``samples`` rays."""

    def shade_points(rows: Tensor, cols: Tensor) -> tuple[Stokes, Stokes]:
        buffer = cast(parts, camera, rows, cols, size)
        return shade(buffer, camera, light, is_lit(parts, buffer, light))

    return render_points(shade_points, size, samples)


def render_points(
    shade_points: Callable[[Tensor, Tensor], tuple[Stokes, Stokes]], size: tuple[int, int], samples: int
) -> tuple[Stokes, Stokes]:
    """Return images ``[3, H, W]`` of a function that shades image points (rows, cols) ``[N]`` to ``[3, N, 1]``.

    A pixel is the mean over ``samples`` x ``samples`` points. Works band by band.
    """
    height, width = size
    rows_at_once = max(1, RAYS_AT_ONCE // (width * samples**2))
    cols = (torch.arange(width * samples) + 0.5) / samples
    lobes: tuple[list[Stokes], list[Stokes]] = ([], [])
    for first in range(0, height, rows_at_once):
        count = min(rows_at_once, height - first) * samples
        rows = first + (torch.arange(count) + 0.5) / samples
        grid_rows, grid_cols = (g.flatten() for g in torch.meshgrid(rows, cols, indexing="ij"))
        for lobe, band in zip(lobes, shade_points(grid_rows, grid_cols), strict=True):
            lobe.append(band.map(lambda s, n=count: avg_pool2d(s.view(1, 3, n, -1), samples)[0]))  # type: ignore[misc]
    diffuse, specular = (
        Stokes(*(torch.cat([getattr(band, name) for band in lobe], dim=1) for name in ("s0", "s1", "s2")))
        for lobe in lobes
    )
    return diffuse, specular
