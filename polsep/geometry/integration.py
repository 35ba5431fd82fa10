"""Depth from normals: bilateral normal integration, which keeps jumps, and plain least squares for comparison.

Normals ``[H, W, 3]`` have x right, y up, z to the camera, as in `polsep.render.sphere_tracing`. Depth counts away from
the camera along its axis: in pixels around a mean of 0 for an orthographic camera, relative to a mean of 1 for a
pinhole. Unlinked parts of a mask have the same mean each (of the logarithm, for a pinhole): where they are to each
other, normals do not tell. In either case q dz/du = a and q dz/dv = b (u right, v down) with

* orthographic: z = depth, q = n_z, a = n_x, b = -n_y;
* pinhole: z = log(depth), q = -f_u n.r, a = n_x, b = -n_y f_u / f_v, r = ((u - c_u) / f_u, (c_v - v) / f_v, -1) the
  pixel's ray.

Every pixel has such an equation toward each of its four neighbours. Bilateral weights prefer, along u and along v, the
smooth one of the two sides: w = sigmoid(k ((q dz-)^2 - (q dz+)^2)) of the forward side and 1 - w of the other.
Source: Cao, Santo, Shi, Okura, Matsushita 2022, Bilateral normal integration, ECCV, Eqs. 12-18, arXiv:2207.05063.
Note: where a pixel has only one neighbour along an axis, its equation has weight 1. The paper sets the missing
difference to 0, so that slopes at the outline lose weight.
Needs the extra ``mesh``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import NDArray

from polsep.geometry.integration_kernel import DOWN, LEFT, RIGHT, UP, Places, Wanted, fill_system, fill_weights
from polsep.geometry.multigrid import Multigrid, solve

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Steepness k of the bilateral weights. Source: Cao et al. 2022, Sec. 5.
SHARPNESS = 2.0
#: Largest number of rounds, and the relative change of the energy that ends them. Source: the same, with 150 and 1e-4.
MAX_ROUNDS, MIN_CHANGE = 100, 1e-4
#: Residual of each round's linear system relative to that at its start, and the largest number of its steps.
TOLERANCE, MAX_STEPS = 0.2, 60
#: A multigrid for the weights of an earlier round is rebuilt after more steps than this.
STALE = 6
#: Least cosine q; more grazing normals are limited to it.
MIN_COSINE = 0.02


@dataclass(frozen=True)
class Slopes:
    """The equations q dz/du = ``right`` and q dz/dv = ``down`` of the pixels in ``mask``, all ``[H, W]``."""

    cosine: Floats
    right: Floats
    down: Floats
    mask: Mask


def find_slopes(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Slopes:
    """The equations of normals; ``intrinsics [3, 3]`` in pixels, None for an orthographic camera."""
    x, y, z = np.moveaxis(normals, -1, 0)
    if intrinsics is None:
        cosine, ratio, scale = z, 1.0, 1.0
    else:
        scale, ratio = float(intrinsics[0, 0]), float(intrinsics[0, 0] / intrinsics[1, 1])
        across, upward = pixel_rays(mask.shape, intrinsics)
        cosine = -scale * (x * across + y * upward - z)
    return Slopes(np.maximum(cosine, MIN_COSINE * scale), x, -y * ratio, mask)


def pixel_rays(size: tuple[int, ...], intrinsics: Floats) -> tuple[Floats, Floats]:
    """The rays (x, y, -1) of pixels: x and y ``[H, W]``, to the right and up; ``intrinsics [3, 3]`` in pixels."""
    rows, cols = np.mgrid[: size[0], : size[1]]
    return (cols - intrinsics[0, 2]) / intrinsics[0, 0], (intrinsics[1, 2] - rows) / intrinsics[1, 1]


def integrate_bilateral(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Floats:
    """Depth ``[H, W]`` of a surface with jumps, NaN outside the mask. Raises ValueError on an empty mask."""
    slopes = find_slopes(normals, mask, intrinsics)
    system = Equations(slopes)
    weights = system.even_weights()
    depth = np.zeros(system.count)
    energy = np.inf
    for _ in range(MAX_ROUNDS):
        depth = system.solve(weights, depth, TOLERANCE)
        before = energy
        weights, energy = system.weigh(depth)
        if abs(before - energy) <= MIN_CHANGE * energy or energy <= 1e-12 * system.count:
            break
    return system.as_image(depth, intrinsics is not None)


def integrate_smooth(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Floats:
    """Depth of a surface without jumps: the same equations, each of weight 1/2, or 1 beside a border."""
    system = Equations(find_slopes(normals, mask, intrinsics))
    depth = system.solve(system.even_weights(), np.zeros(system.count), 1e-8)
    return system.as_image(depth, intrinsics is not None)


class Equations:
    """The equations between neighbours along both axes, and their weighted Laplacian."""

    def __init__(self, slopes: Slopes) -> None:
        if not slopes.mask.any():
            raise ValueError("expected a mask that holds pixels, found none")
        self.mask, self.count = slopes.mask, int(slopes.mask.sum())
        self.pixels = np.nonzero(slopes.mask)
        number = np.full(tuple(side + 2 for side in slopes.mask.shape), -1, np.int32)
        number[1:-1, 1:-1][slopes.mask] = np.arange(self.count)
        rows, cols = (index + 1 for index in self.pixels)
        # The order of a matrix's row: above, left, the pixel itself, right, below.
        around = np.stack([number[rows + y, cols + x] for y, x in ((-1, 0), (0, -1), (0, 0), (0, 1), (1, 0))], axis=1)
        self.indices = around[around >= 0]
        starts = np.concatenate([[0], np.cumsum((around >= 0).sum(axis=1))]).astype(np.int32)
        self.places = Places(np.ascontiguousarray(around[:, [0, 1, 3, 4]]), starts)
        inside = [values[slopes.mask] for values in (slopes.cosine, slopes.right, slopes.down)]
        self.wanted = Wanted(inside[0], np.stack(inside[1:]))
        self.multigrid: Multigrid | None = None

    def even_weights(self) -> Floats:
        """The first weights ``[2, N]``: 1/2 for each of two sides, 1 for a single one."""
        there = self.places.near >= 0
        behind, ahead = there[:, [LEFT, UP]].T, there[:, [RIGHT, DOWN]].T
        return np.where(behind & ahead, 0.5, ahead.astype(float))

    def weigh(self, depth: Floats) -> tuple[Floats, float]:
        """The weights ``[2, N]`` of the forward sides along both axes, and the weighted sum of squared residuals."""
        weights = np.empty((2, self.count))
        return weights, float(fill_weights(depth, self.places, self.wanted, SHARPNESS, weights))

    def solve(self, weights: Floats, start: Floats, tolerance: float) -> Floats:
        """The depth of least energy for fixed weights."""
        matrix, right = self.assemble(weights)
        if self.multigrid is None:
            self.multigrid = Multigrid(matrix, *self.pixels)
        depth, steps = solve(matrix, right, start, self.multigrid, (tolerance, MAX_STEPS))
        if steps > STALE:
            self.multigrid = None
        return depth

    def assemble(self, weights: Floats) -> tuple[Any, Floats]:
        """The symmetric matrix and the right side of that depth."""
        entries, right = np.empty(self.indices.size), np.empty(self.count)
        fill_system(self.places, self.wanted, weights, entries, right)
        return scipy.sparse.csr_array((entries, self.indices, self.places.starts), (self.count, self.count)), right

    def as_image(self, depth: Floats, logarithmic: bool) -> Floats:
        """The solution as a depth image."""
        image = np.full(self.mask.shape, np.nan)
        part = scipy.ndimage.label(self.mask)[0][self.mask] - 1  # of unlinked parts each has a constant of its own
        centred = depth - (np.bincount(part, depth) / np.bincount(part))[part]
        if logarithmic:
            centred = np.exp(centred)
            centred = centred / centred.mean()
        image[self.mask] = centred
        return image
