"""Kernels before and after a cast of rays against a mesh: camera rays, interpolation at hits, shadow rays; in float32.

The camera's rays are those of `polsep.render.sphere_tracing.camera_rays`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry

#: Least cosine between an interpolated normal and the direction to the camera: at a silhouette triangles are visible
#: whose interpolated normals face away.
MIN_COSINE = 1e-3

_MIN_COSINE = np.float32(MIN_COSINE)

Floats = NDArray[np.float32]


class Triangles(NamedTuple):
    """A mesh in single precision: ``vertices``, ``normals [V, 3]``, ``faces [F, 3]``, ``slots [F]``; contiguous."""

    vertices: Floats
    normals: Floats
    faces: NDArray[np.int32]
    slots: NDArray[np.int32]


class Pinhole(NamedTuple):
    """A pinhole camera: ``eye [3]``; ``axes [3, 3]``: right, up and forward; ``size``: height and width in pixels.

    ``scale``: side of a pixel at distance 1.
    """

    eye: Floats
    axes: Floats
    size: tuple[int, int]
    scale: np.float32


class Found(NamedTuple):
    """First intersections of N rays: ``triangle`` or -1, its normal ``facing [N, 3]`` of any length, ``distance``.

    ``u``, ``v``: barycentric weights of corners 1 and 2.
    """

    triangle: NDArray[np.int32]
    facing: Floats
    u: Floats
    v: Floats
    distance: Floats


class Surface(NamedTuple):
    """M hits, as in `raycast.Hits`: ``ray``, ``slot [M]``, ``position``, ``normal [3, M]``, ``above [M, 3]``."""

    ray: NDArray[np.int64]
    slot: NDArray[np.int64]
    position: Floats
    normal: Floats
    above: Floats


class Shadows(NamedTuple):
    """Rays toward a light: index of the ``hit``, ``origin``, unit ``direction [N, 3]``, ``distance`` to the light."""

    hit: NDArray[np.int64]
    origin: Floats
    direction: Floats
    distance: Floats


@entry
def aim_rays(rows: Any, cols: Any, view: Pinhole, directions: Any) -> None:
    """Fill in the unit ``directions [N, 3]`` of rays through image points: `sphere_tracing.camera_rays`."""
    axes, scale = view.axes, view.scale
    middle_row, middle_col = np.float32(HALF * view.size[0]), np.float32(HALF * view.size[1])
    for n in range(rows.size):
        x, y = (cols[n] - middle_col) * scale, (middle_row - rows[n]) * scale
        dx = axes[2, 0] + axes[0, 0] * x + axes[1, 0] * y
        dy = axes[2, 1] + axes[0, 1] * x + axes[1, 1] * y
        dz = axes[2, 2] + axes[0, 2] * x + axes[1, 2] * y
        inverse = ONE / math.sqrt(dx * dx + dy * dy + dz * dz)
        directions[n, 0], directions[n, 1], directions[n, 2] = dx * inverse, dy * inverse, dz * inverse


@compiled
def _unit(x: Any, y: Any, z: Any) -> Any:
    inverse = ONE / math.sqrt(max(x * x + y * y + z * z, np.float32(1e-30)))
    return x * inverse, y * inverse, z * inverse


@compiled
def _smooth_offset(mesh: Triangles, corner: Any, weight: Any, p: Any) -> Any:
    """Offset of a point from the tangent plane of a corner, where it lies below, times the corner's weight.

    Source: Hanika 2021, Hacking the shadow terminator.
    """
    n = mesh.normals[corner]
    v = mesh.vertices[corner]
    below = min((p[0] - v[0]) * n[0] + (p[1] - v[1]) * n[1] + (p[2] - v[2]) * n[2], ZERO) * weight
    return below * n[0], below * n[1], below * n[2]


@entry
def interpolate_hits(mesh: Triangles, found: Found, eye: Any, directions: Any, offset: Any, out: Surface) -> None:
    """Fill ``out`` with the hits of rays from ``eye [3]`` along ``directions [N, 3]``, in the order of the rays.

    ``offset``: distance between shadow rays' origins and the surface.
    """
    m = 0
    for ray in range(found.triangle.size):
        triangle = found.triangle[ray]
        if triangle < 0:
            continue
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        t, u, v = found.distance[ray], found.u[ray], found.v[ray]
        w = ONE - u - v
        a, b, c = mesh.faces[triangle, 0], mesh.faces[triangle, 1], mesh.faces[triangle, 2]
        px, py, pz = eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz
        na, nb, nc = mesh.normals[a], mesh.normals[b], mesh.normals[c]
        nx, ny, nz = _unit(
            w * na[0] + u * nb[0] + v * nc[0], w * na[1] + u * nb[1] + v * nc[1], w * na[2] + u * nb[2] + v * nc[2]
        )
        missing = max(_MIN_COSINE + (nx * dx + ny * dy + nz * dz), ZERO)
        nx, ny, nz = _unit(nx - missing * dx, ny - missing * dy, nz - missing * dz)
        fx, fy, fz = _unit(found.facing[ray, 0], found.facing[ray, 1], found.facing[ray, 2])
        side = -offset if fx * dx + fy * dy + fz * dz > ZERO else offset
        ax, ay, az = _smooth_offset(mesh, a, w, (px, py, pz))
        bx, by, bz = _smooth_offset(mesh, b, u, (px, py, pz))
        cx, cy, cz = _smooth_offset(mesh, c, v, (px, py, pz))
        out.ray[m], out.slot[m] = ray, mesh.slots[triangle]
        out.position[0, m], out.position[1, m], out.position[2, m] = px, py, pz
        out.normal[0, m], out.normal[1, m], out.normal[2, m] = nx, ny, nz
        out.above[m, 0] = px - (ax + bx + cx) + side * fx
        out.above[m, 1] = py - (ay + by + cy) + side * fy
        out.above[m, 2] = pz - (az + bz + cz) + side * fz
        m += 1


@entry
def aim_at_light(position: Any, normal: Any, above: Any, light: Any, toward: Shadows) -> int:
    """Fill the first rows of ``toward`` with a ray to a point ``light [3]`` per hit that faces it; return their number.

    ``position``, ``normal [3, M]`` of hits; ``above [M, 3]``: where their shadow rays start.
    """
    count = 0
    for m in range(position.shape[1]):
        x, y, z = light[0] - position[0, m], light[1] - position[1, m], light[2] - position[2, m]
        if normal[0, m] * x + normal[1, m] * y + normal[2, m] * z <= ZERO:
            continue
        ax, ay, az = above[m, 0], above[m, 1], above[m, 2]
        x, y, z = light[0] - ax, light[1] - ay, light[2] - az
        distance = math.sqrt(x * x + y * y + z * z)
        inverse = ONE / distance
        toward.hit[count], toward.distance[count] = m, distance
        toward.origin[count, 0], toward.origin[count, 1], toward.origin[count, 2] = ax, ay, az
        toward.direction[count, 0] = x * inverse
        toward.direction[count, 1] = y * inverse
        toward.direction[count, 2] = z * inverse
        count += 1
    return count
