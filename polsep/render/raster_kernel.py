"""Rasterization of a mesh: the visible triangle at every sample of an image, faster than rays (see `raycast`).

Vertices are projected once and rounded to float32. Edge functions are evaluated in double precision, so neighbouring
triangles agree on which side of their edge a sample lies, and leave no gaps. The nearest triangle has the largest
inverse depth, which is linear in the image. Source: Pineda 1988, A parallel algorithm for polygon rasterization.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry
from polsep.render.rays_kernel import Found, Pinhole, Triangles

_NEAR = np.float32(1e-3)  # of its distance: the least depth of a vertex; perspective has no meaning behind the eye
_OUTSIDE = -1e-7  # square samples: bound on the rounding error of an edge function on an edge


@entry
def project_vertices(mesh: Triangles, view: Pinhole, samples: int, projected: Any) -> bool:
    """Fill in column, row (in samples) and inverse depth ``[3, V]`` of the vertices.

    Return False, with ``projected`` incomplete, if any vertex is not in front of the camera.
    """
    eye, axes, scale = view.eye, view.axes, np.float32(samples) / view.scale
    middle_row, middle_col = np.float32(HALF * view.size[0] * samples), np.float32(HALF * view.size[1] * samples)
    for n in range(mesh.vertices.shape[0]):
        x, y, z = mesh.vertices[n, 0] - eye[0], mesh.vertices[n, 1] - eye[1], mesh.vertices[n, 2] - eye[2]
        depth = axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z
        if not depth > _NEAR * math.sqrt(x * x + y * y + z * z):
            return False
        inverse = ONE / depth
        projected[0, n] = middle_col + (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z) * inverse * scale
        projected[1, n] = middle_row - (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z) * inverse * scale
        projected[2, n] = inverse
    return True


@compiled
def _first(a: Any, b: Any, c: Any) -> Any:
    """The first sample, at a half, that is not below the least of three coordinates."""
    return np.int32(math.ceil(max(min(a, b, c), ZERO) - HALF))


@compiled
def _last(a: Any, b: Any, c: Any, most: int) -> Any:
    """The last sample, at a half, that is not above the largest of three coordinates, at most ``most``; or -1."""
    return np.int32(min(math.floor(max(min(max(a, b, c), np.float32(most + 1)), -ONE) - HALF), most))


@entry
def span_rows(mesh: Triangles, projected: Any, rows: int, spans: Any) -> None:
    """Fill in the first and last row of samples ``[F, 2]`` that each triangle may cover, of ``rows`` in all."""
    for f in range(mesh.faces.shape[0]):
        a, b, c = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        spans[f, 0] = _first(projected[1, a], projected[1, b], projected[1, c])
        spans[f, 1] = _last(projected[1, a], projected[1, b], projected[1, c], rows - 1)


@entry
def fill_triangles(mesh: Triangles, projected: Any, spans: Any, first_row: int, nearest: Any, triangle: Any) -> None:
    """Set the index and inverse depth of the visible ``triangle [rows, columns]`` for samples from ``first_row`` on.

    ``projected``, ``spans``: from `project_vertices` and `span_rows`. ``nearest`` must start at 0, ``triangle`` at -1.
    """
    rows, cols = triangle.shape
    for f in range(mesh.faces.shape[0]):
        top, bottom = max(spans[f, 0], first_row), min(spans[f, 1], first_row + rows - 1)
        if top > bottom:
            continue
        a, b, c = mesh.faces[f, 0], mesh.faces[f, 1], mesh.faces[f, 2]
        left = _first(projected[0, a], projected[0, b], projected[0, c])
        right = _last(projected[0, a], projected[0, b], projected[0, c], cols - 1)
        if left > right:
            continue
        ax, ay = np.float64(projected[0, a]), np.float64(projected[1, a])
        bx, by = np.float64(projected[0, b]), np.float64(projected[1, b])
        cx, cy = np.float64(projected[0, c]), np.float64(projected[1, c])
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        if area < 0.0:
            b, c, bx, by, cx, cy, area = c, b, cx, cy, bx, by, -area
        x = left + 0.5
        da, db, dc = (by - cy), (cy - ay), (ay - by)  # how the three edge functions grow from column to column
        inverse = 1.0 / area
        za, zb, zc = projected[2, a] * inverse, projected[2, b] * inverse, projected[2, c] * inverse
        slope = da * za + db * zb + dc * zc
        for row in range(top, bottom + 1):
            y = row + 0.5
            ea = (cx - bx) * (y - by) - (cy - by) * (x - bx)
            eb = (ax - cx) * (y - cy) - (ay - cy) * (x - cx)
            ec = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
            depth = ea * za + eb * zb + ec * zc
            near, which = nearest[row - first_row], triangle[row - first_row]
            for col in range(left, right + 1):
                if min(ea, eb, ec) >= _OUTSIDE and depth > near[col]:
                    near[col], which[col] = depth, f
                ea, eb, ec, depth = ea + da, eb + db, ec + dc, depth + slope


@compiled
def _corner(mesh: Triangles, corner: Any) -> Any:
    v = mesh.vertices[corner]
    return np.float64(v[0]), np.float64(v[1]), np.float64(v[2])


@compiled
def _clamp_weights(u: Any, v: Any) -> Any:
    """Barycentric weights of corners 1 and 2, limited to the triangle, outside of which rounding may put a point."""
    u, v = max(u, 0.0), max(v, 0.0)
    total = max(u + v, 1.0)
    return u / total, v / total


@entry
def intersect_triangles(
    mesh: Triangles,
    view: Pinhole,
    triangle: Any,
    first_row: int,
    samples: int,
    which: Any,
    directions: Any,
    found: Found,
) -> None:
    """Intersect the rays through the samples of some rows with the ``triangle [rows, columns]`` visible at each.

    ``first_row``: of pixels; ``samples``: along a pixel's side; the samples of a pixel are consecutive. Fills
    ``found``, the index ``which [M]`` of the ray and its ``directions [M, 3]`` for the M samples that show a triangle.
    Source: Moeller and Trumbore 1997.
    """
    eye, axes, scale = view.eye, view.axes, np.float64(view.scale)
    middle_row, middle_col = 0.5 * view.size[0], 0.5 * view.size[1]
    count = 0
    for pixel in range(triangle.shape[0] // samples * view.size[1]):
        row, col = pixel // view.size[1], pixel % view.size[1]
        for i in range(samples):
            for j in range(samples):
                face = triangle[row * samples + i, col * samples + j]
                if face < 0:
                    continue
                y = (middle_row - (first_row + row + (i + 0.5) / samples)) * scale
                x = (col + (j + 0.5) / samples - middle_col) * scale
                dx = axes[2, 0] + axes[0, 0] * x + axes[1, 0] * y
                dy = axes[2, 1] + axes[0, 1] * x + axes[1, 1] * y
                dz = axes[2, 2] + axes[0, 2] * x + axes[1, 2] * y
                inverse = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
                dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
                ax, ay, az = _corner(mesh, mesh.faces[face, 0])
                bx, by, bz = _corner(mesh, mesh.faces[face, 1])
                cx, cy, cz = _corner(mesh, mesh.faces[face, 2])
                bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
                ax, ay, az = eye[0] - ax, eye[1] - ay, eye[2] - az
                nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
                px, py, pz = ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx
                inverse = -1.0 / (dx * nx + dy * ny + dz * nz)
                u = (cx * px + cy * py + cz * pz) * inverse
                v = -(bx * px + by * py + bz * pz) * inverse
                found.u[count], found.v[count] = _clamp_weights(u, v)
                found.distance[count] = (ax * nx + ay * ny + az * nz) * inverse
                found.triangle[count], which[count] = face, (pixel * samples + i) * samples + j
                found.facing[count, 0], found.facing[count, 1], found.facing[count, 2] = nx, ny, nz
                directions[count, 0], directions[count, 1], directions[count, 2] = dx, dy, dz
                count += 1
