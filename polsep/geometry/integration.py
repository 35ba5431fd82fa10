"""From normals to depth: bilateral normal integration, which keeps jumps, and plain least squares to compare with.

Normals ``[H, W, 3]`` have x right, y up, z to the camera, as in `polsep.render`. Depth counts away from the camera
along its axis: in pixels around a mean of 0 for an orthographic camera, relative to a mean of 1 for a pinhole. In
either case q dz/du = a and q dz/dv = b (u right, v down) with

* orthographic: z = depth, q = n_z, a = n_x, b = -n_y;
* pinhole: z = log(depth), q = -f_u n.r, a = n_x, b = -n_y f_u / f_v, r = ((u - c_u) / f_u, (c_v - v) / f_v, -1) the
  pixel's ray.

Every pixel has such an equation toward each of its four neighbours. Bilateral weights ask, along u and along v, which
of the two sides is smooth: w = sigmoid(k ((q dz-)^2 - (q dz+)^2)) of the forward side and 1 - w of the other.
Source: Cao, Santo, Shi, Okura, Matsushita 2022, Bilateral normal integration, ECCV, Eqs. 12-18, arXiv:2207.05063.
Note: where a pixel has one neighbour only along an axis its equation has weight 1. The paper takes the absent
difference for 0, so that slopes at the outline lose weight.
Needs the extra ``render``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from polsep.geometry.multigrid import Multigrid, solve

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Steepness k of the bilateral weights. Source: Cao et al. 2022, Sec. 5.
SHARPNESS = 2.0
#: Rounds at most, and the relative change of the energy that ends them. Source: the same, with 150 and 1e-4.
MOST_ROUNDS, LEAST_CHANGE = 100, 1e-4
#: Residual of each round's linear system relative to where it starts, and its steps at most.
TOLERANCE, MOST_STEPS = 0.2, 60
#: Steps after which a multigrid made for the weights of an earlier round is made anew.
STALE = 6
#: Normals that are seen at a more grazing angle are taken for this one: q >= this cosine.
LEAST_COSINE = 0.02


@dataclass(frozen=True)
class Slopes:
    """The equations q dz/du = ``right`` and q dz/dv = ``down`` of the pixels in ``mask``, all ``[H, W]``."""

    cosine: Floats
    right: Floats
    down: Floats
    mask: Mask


def find_slopes(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Slopes:
    """What normals say of the depth; ``intrinsics [3, 3]`` in pixels, None for an orthographic camera."""
    x, y, z = np.moveaxis(normals, -1, 0)
    if intrinsics is None:
        cosine, ratio, scale = z, 1.0, 1.0
    else:
        rows, cols = np.mgrid[: mask.shape[0], : mask.shape[1]]
        scale, ratio = float(intrinsics[0, 0]), float(intrinsics[0, 0] / intrinsics[1, 1])
        across = (cols - intrinsics[0, 2]) / intrinsics[0, 0]
        upward = (intrinsics[1, 2] - rows) / intrinsics[1, 1]
        cosine = -scale * (x * across + y * upward - z)
    return Slopes(np.maximum(cosine, LEAST_COSINE * scale), x, -y * ratio, mask)


def integrate_bilateral(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Floats:
    """Depth ``[H, W]`` of a surface with jumps, NaN outside the mask. Raises ValueError on an empty mask."""
    slopes = find_slopes(normals, mask, intrinsics)
    system = Equations(slopes)
    weights = system.even_weights()
    depth = np.zeros(system.count)
    energy = np.inf
    for _ in range(MOST_ROUNDS):
        depth = system.solve(weights, depth, TOLERANCE)
        weights = system.bilateral_weights(depth)
        before, energy = energy, system.energy(weights, depth)
        if abs(before - energy) <= LEAST_CHANGE * energy or energy <= 1e-12 * system.count:
            break
    return system.as_image(depth, intrinsics is not None)


def integrate_smooth(normals: Floats, mask: Mask, intrinsics: Floats | None = None) -> Floats:
    """Depth of a surface without jumps: the same equations, all of weight 1/2, which is Poisson's equation."""
    system = Equations(find_slopes(normals, mask, intrinsics))
    depth = system.solve(system.even_weights(), np.zeros(system.count), 1e-8)
    return system.as_image(depth, intrinsics is not None)


class Equations:
    """The equations between neighbours along both axes, and the Laplacian that weights make of them."""

    def __init__(self, slopes: Slopes) -> None:
        if not slopes.mask.any():
            raise ValueError("expected a mask that holds pixels, found none")
        self.mask, self.count = slopes.mask, int(slopes.mask.sum())
        self.places = np.nonzero(slopes.mask)
        number = np.full(slopes.mask.shape, -1)
        number[slopes.mask] = np.arange(self.count)
        cosine = slopes.cosine[slopes.mask]
        self.cosine = cosine
        self.multigrid: Multigrid | None = None
        self.axes = tuple(
            _Axis.of(number, cosine, value[slopes.mask], step)
            for value, step in ((slopes.right, (0, 1)), (slopes.down, (1, 0)))
        )

    def even_weights(self) -> list[Floats]:
        """The first guess: half of each side, all of the only one."""
        return [np.where(axis.both, 0.5, axis.forward.astype(float)) for axis in self.axes]

    def bilateral_weights(self, depth: Floats) -> list[Floats]:
        """The weight of the forward side per axis and pixel."""
        weights = []
        for axis in self.axes:
            ahead, behind = axis.differences(depth)
            rise = SHARPNESS * ((self.cosine * behind) ** 2 - (self.cosine * ahead) ** 2)
            smooth = 0.5 * (1 + np.tanh(0.5 * rise))
            weights.append(np.where(axis.both, smooth, axis.forward.astype(float)))
        return weights

    def energy(self, weights: list[Floats], depth: Floats) -> float:
        """The weighted sum of squared residuals."""
        total = 0.0
        for axis, weight in zip(self.axes, weights, strict=True):
            ahead, behind = axis.differences(depth)
            total += float((weight * axis.forward * (self.cosine * ahead - axis.value) ** 2).sum())
            total += float(((1 - weight) * axis.backward * (self.cosine * behind - axis.value) ** 2).sum())
        return total

    def solve(self, weights: list[Floats], start: Floats, tolerance: float) -> Floats:
        """The depth of least energy for fixed weights."""
        matrix, right = self.assemble(weights)
        if self.multigrid is None:
            self.multigrid = Multigrid(matrix, *self.places)
        found, steps = solve(matrix, right, start, self.multigrid, (tolerance, MOST_STEPS))
        if steps > STALE:
            self.multigrid = None
        return found

    def assemble(self, weights: list[Floats]) -> tuple[Any, Floats]:
        """The symmetric matrix and the right side whose solution that is."""
        diagonal, right = np.zeros(self.count), np.zeros(self.count)
        links = []
        for axis, weight in zip(self.axes, weights, strict=True):  # no pixel comes twice at one end of an axis's links
            strength, target = axis.links(weight)
            diagonal[axis.first] += strength
            diagonal[axis.second] += strength
            right[axis.first] -= target
            right[axis.second] += target
            links.append(-strength)
        entries = np.concatenate([*links, *links, diagonal])
        order, indices, starts = self.pattern
        return scipy.sparse.csr_array((entries[order], indices, starts), (self.count, self.count)), right

    @cached_property
    def pattern(self) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]:
        """Where links there, back, and the diagonal stand in the matrix: their order, columns and starts of rows."""
        first, second = (np.concatenate(ends) for ends in zip(*((a.first, a.second) for a in self.axes), strict=True))
        pixels = np.arange(self.count)
        at = (np.concatenate([first, second, pixels]), np.concatenate([second, first, pixels]))
        numbered = scipy.sparse.coo_array((np.arange(at[0].size) + 1.0, at), (self.count, self.count)).tocsr()
        numbered.sort_indices()
        return numbered.data.astype(np.int64) - 1, numbered.indices, numbered.indptr

    def as_image(self, depth: Floats, logarithmic: bool) -> Floats:
        """The solution as depth in an image."""
        image = np.full(self.mask.shape, np.nan)
        centred = depth - depth.mean()
        if logarithmic:
            centred = np.exp(centred)
            centred = centred / centred.mean()
        image[self.mask] = centred
        return image


@dataclass(frozen=True)
class _Axis:
    """Links between neighbours along one axis: from pixel ``first`` to ``second``; ``value [N]``: q times the slope.

    ``forward``, ``backward``, ``both`` ``[N]``: which neighbours a pixel has.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    cosine: Floats
    value: Floats
    forward: Mask
    backward: Mask

    @classmethod
    def of(cls, number: NDArray[np.int64], cosine: Floats, value: Floats, step: tuple[int, int]) -> _Axis:
        height, width = number.shape
        here, there = number[: height - step[0], : width - step[1]], number[step[0] :, step[1] :]
        linked = (here >= 0) & (there >= 0)
        first, second = here[linked], there[linked]
        forward, backward = (np.bincount(end, minlength=cosine.size) > 0 for end in (first, second))
        return cls(first, second, cosine, value, forward, backward)

    @property
    def both(self) -> Mask:
        return self.forward & self.backward

    def differences(self, depth: Floats) -> tuple[Floats, Floats]:
        """The rise to the next and from the last pixel, 0 where there is none."""
        ahead, behind = np.zeros_like(depth), np.zeros_like(depth)
        rise = depth[self.second] - depth[self.first]
        ahead[self.first], behind[self.second] = rise, rise
        return ahead, behind

    def links(self, weight: Floats) -> tuple[Floats, Floats]:
        """Per link the strength, which weights the squared rise, and the strength times the rise that is wanted."""
        one, other = weight[self.first], (1 - weight)[self.second]
        near, far = self.cosine[self.first], self.cosine[self.second]
        strength = one * near**2 + other * far**2
        return strength, one * near * self.value[self.first] + other * far * self.value[self.second]
