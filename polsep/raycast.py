"""Rays against triangle meshes by Embree: what each ray of a camera hits, and whether a light reaches it.

`Hits` hold geometry alone, so that many materials (`dress`) and lights (`is_lit`) share one cast. Conventions are those
of `polsep.render`; normals are interpolated from the mesh's vertices and face the camera. Needs the extra ``render``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from torch import Tensor

from polsep.materials import Materials
from polsep.optics import dot, normalize
from polsep.render import GBuffer, PinholeCamera, PointLight, camera_rays, render_points, shade
from polsep.shapes import Mesh
from polsep.stokes import Stokes

#: Cosine to the camera that a visible interpolated normal has at least: triangles at a silhouette are seen, though the
#: smooth surface they stand for would be turned away.
LEAST_COSINE = 1e-3
#: How far above its surface a shadow ray starts, relative to the mesh's size.
LIFT = 2e-4


@dataclass(frozen=True)
class MeshScene:
    """A mesh that rays can be cast against; building it takes longer than a cast."""

    mesh: Mesh
    tracer: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        tracer = EmbreeScene()
        TriangleMesh(tracer, self.mesh.vertices.astype(np.float32), self.mesh.faces.astype(np.int32))
        object.__setattr__(self, "tracer", tracer)

    @property
    def size(self) -> float:
        """The largest extent along an axis, in scene units."""
        return float(np.ptp(self.mesh.vertices, axis=0).max())


@dataclass(frozen=True)
class Hits:
    """What those M of N rays hit that hit anything: ``ray [M]``, which of the N they are, and ``rays``, N.

    ``position`` and unit ``normal``, toward the camera; ``above``, where shadow rays start, just out of the smooth
    surface that the triangles stand for; all ``[3, M, 1]``. ``uv [2, M, 1]``; the material ``slot [M]``.
    """

    rays: int
    ray: Tensor
    position: Tensor
    normal: Tensor
    above: Tensor
    uv: Tensor
    slot: Tensor


#: What `render_mesh` renders: a mesh, and a material for each of its slots.
Model = tuple[MeshScene, Materials]


def find_hits(scene: MeshScene, camera: PinholeCamera, points: tuple[Tensor, Tensor], size: tuple[int, int]) -> Hits:
    """The first triangles behind image points (rows, cols) ``[N]`` of an H x W image."""
    origin, direction = camera_rays(camera, *points, size)
    found = _run(scene, origin.expand_as(direction), direction, output=1)
    ray = torch.from_numpy(np.flatnonzero(found["primID"] >= 0))
    triangle, u, v, distance = (torch.from_numpy(found[name])[ray] for name in ("primID", "u", "v", "tfar"))
    triangle = triangle.long()
    weights, corners = torch.stack([1 - u - v, u, v]), torch.from_numpy(scene.mesh.faces)[triangle]
    direction = direction[:, ray]
    position = origin + distance[None, :, None] * direction
    facing = normalize(torch.from_numpy(found["Ng"])[ray].T[..., None])
    facing = torch.where(dot(facing, direction) > 0, -facing, facing)
    return Hits(
        points[0].numel(),
        ray,
        position,
        _toward(_interpolate(scene.mesh.normals, corners, weights), -direction),
        _above(scene.mesh, position, corners, weights) + LIFT * scene.size * facing,
        _interpolate(scene.mesh.uv, corners, weights),
        torch.from_numpy(scene.mesh.slots)[triangle],
    )


def dress(hits: Hits, materials: Materials) -> GBuffer:
    """The G-buffer ``[*, M, 1]`` of hits with materials."""
    albedo = materials.albedo[hits.slot].T[..., None]
    roughness, specular = (x[hits.slot][None, :, None] for x in (materials.roughness, materials.specular))
    return GBuffer(
        hits.position, hits.normal, albedo, roughness, specular, torch.ones_like(roughness, dtype=torch.bool)
    )


def is_lit(scene: MeshScene, hits: Hits, light: PointLight) -> Tensor:
    """Whether hits see the light, ``[1, M, 1]``."""
    way = torch.tensor(light.position, dtype=torch.float32).view(3, 1, 1) - hits.above
    distance = torch.sqrt(dot(way, way))
    blocker = _run(scene, hits.above, way / distance, query="OCCLUDED", dists=distance.flatten().numpy())
    return (torch.from_numpy(blocker) < 0)[None, :, None]


def render_mesh(
    model: tuple[MeshScene, Materials],
    camera: PinholeCamera,
    light: PointLight,
    size: tuple[int, int],
    samples: int = 1,
) -> tuple[Stokes, Stokes]:
    """`render.render` of a mesh: diffuse and specular Stokes images ``[3, H, W]``, black where rays hit nothing."""
    scene, materials = model

    def shade_points(rows: Tensor, cols: Tensor) -> tuple[Stokes, Stokes]:
        hits = find_hits(scene, camera, (rows, cols), size)
        diffuse, specular = shade(dress(hits, materials), camera, light, is_lit(scene, hits, light))
        return diffuse.map(lambda s: _scatter(s, hits)), specular.map(lambda s: _scatter(s, hits))

    return render_points(shade_points, size, samples)


def _scatter(values: Tensor, hits: Hits) -> Tensor:
    """Values ``[3, M, 1]`` of hits at their rays ``[3, N, 1]``, 0 elsewhere."""
    image = torch.zeros(3, hits.rays, 1)
    image[:, hits.ray] = values
    return image


def _run(scene: MeshScene, origin: Tensor, direction: Tensor, **options: Any) -> Any:
    """Embree's answer for rays ``[3, N, 1]``."""
    origins, directions = (np.ascontiguousarray(x[..., 0].T.numpy(), np.float32) for x in (origin, direction))
    return scene.tracer.run(origins, directions, **options)


def _interpolate(values: NDArray[np.float64], corners: Tensor, weights: Tensor) -> Tensor:
    """Vertex values ``[V, K]`` at points of triangles, ``[K, N, 1]``."""
    at_corners = torch.from_numpy(values).float()[corners]
    return torch.einsum("nck,cn->kn", at_corners, weights)[..., None]


def _above(mesh: Mesh, position: Tensor, corners: Tensor, weights: Tensor) -> Tensor:
    """Points of triangles moved out onto the smooth surface, without which flat triangles shade themselves near the
    terminator. Source: Hanika 2021, Hacking the shadow terminator (Ray Tracing Gems II, chapter 4).
    """
    total = position.clone()
    for k in range(3):
        normal = torch.from_numpy(mesh.normals).float()[corners[:, k]].T[..., None]
        vertex = torch.from_numpy(mesh.vertices).float()[corners[:, k]].T[..., None]
        total -= weights[k][None, :, None] * dot(position - vertex, normal).clamp(max=0) * normal
    return total


def _toward(normal: Tensor, viewer: Tensor) -> Tensor:
    """Unit normals, turned just toward the viewer where they look away."""
    normal = normalize(normal)
    missing = (LEAST_COSINE - dot(normal, viewer)).clamp(min=0)
    return normalize(normal + missing * viewer)
