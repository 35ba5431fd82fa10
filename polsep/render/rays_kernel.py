"""What surrounds a cast of rays against a mesh: rays through image points, what lies where they hit, rays to a light.

Twins, in `polsep.render.raycast` and `polsep.render.sphere_tracing`, say what is computed; here it takes one pass and
float32 throughout.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry

#: Cosine to the camera that a visible interpolated normal has at least: triangles at a silhouette are seen, though the
#: smooth surface they stand for would be turned away.
MIN_COSINE = 1e-3

_MIN_COSINE = np.float32(MIN_COSINE)

Floats = NDArray[np.float32]


class Triangles(NamedTuple):
    """A mesh in single precision: ``vertices``, ``normals [V, 3]``, ``faces [F, 3]``, ``slots [F]``; rows together."""

    vertices: Floats
    normals: Floats
    faces: NDArray[np.int32]
    slots: NDArray[np.int32]


class Pinhole(NamedTuple):
    """A pinhole: ``eye [3]``; ``axes [3, 3]``, right, up and forward; (height, width); a pixel's side at distance 1."""

    eye: Floats
    axes: Floats
    size: tuple[int, int]
    scale: np.float32


class Found(NamedTuple):
    """Embree's answer for N rays: triangle or -1, its normal of any length, weights of corners 1 and 2, distance."""

    triangle: NDArray[np.int32]
    facing: Floats
    u: Floats
    v: Floats
    distance: Floats


class Surface(NamedTuple):
    """M hits: ``ray``, ``slot [M]``, ``position``, ``normal [3, M]``, ``above [M, 3]``, as in `raycast.Hits`."""

    ray: NDArray[np.int64]
    slot: NDArray[np.int64]
    position: Floats
    normal: Floats
    above: Floats


class Shadows(NamedTuple):
    """Rays toward a light: of which ``hit``, ``origin``, unit ``direction [N, 3]``, and ``distance`` to the light."""

    hit: NDArray[np.int64]
    origin: Floats
    direction: Floats
    distance: Floats


@entry
def aim_rays(rows: Any, cols: Any, view: Pinhole, directions: Any) -> None:
    """`render.camera_rays`: unit ``directions [N, 3]`` through image points."""
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
    """How far the surface that a corner stands for lies above a point, times its weight. Source: Hanika 2021."""
    n = mesh.normals[corner]
    v = mesh.vertices[corner]
    below = min((p[0] - v[0]) * n[0] + (p[1] - v[1]) * n[1] + (p[2] - v[2]) * n[2], ZERO) * weight
    return below * n[0], below * n[1], below * n[2]


@entry
def interpolate_hits(mesh: Triangles, found: Found, rays: tuple[Any, Any], lift: Any, out: Surface) -> None:
    """Fill ``out`` with the hits of ``rays``, an origin ``[3]`` and directions ``[N, 3]``, in their order."""
    eye, directions = rays
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
        side = -lift if fx * dx + fy * dy + fz * dz > ZERO else lift
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
def aim_at_light(points: tuple[Any, Any, Any], light: Any, toward: Shadows) -> int:
    """Fill ``toward`` from the front with a ray to a point ``light [3]`` per hit that faces it; how many.

    ``points``: position and normal ``[3, M]`` of hits, and where their shadow rays start, ``[M, 3]``.
    """
    position, normal, above = points
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
