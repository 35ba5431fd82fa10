"""Photometric stereo: normals and albedo from photographs under lights of roughly known direction.

Images ``[L, H, W, C]`` are linear light, one camera, one light each; ``directions [L, 3]`` are unit vectors toward the
lights, with x right, y up, z to the camera, and lights are far and equally bright. Normals ``[H, W, 3]`` are in the
same frame and face the camera; albedo ``[H, W, C]`` is relative: the light of a surface that faces light and camera.
Outside the mask both are 0. `fit_lambertian` is plain least squares (Woodham 1980, doi:10.1117/12.7972479).
`fit_robust` also models shadows, highlights, the Fresnel transmission that dims grazing diffuse light, lights that are
off by degrees, and, if given, the polarization of the diffuse light.

Note: five of the six lights of `lights.NAMED` lie in one plane, and the sixth, above, leaves half of an object dark.
There only the shadow itself and polarization show how far a normal is tilted up or down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from polsep.geometry.polarization import Cue
from polsep.physics.fresnel import fresnel

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A sample below this share of its pixel's brightest, or below this share of the white level, is in shadow.
SHADOW, DARK = 0.03, 0.004
#: Deviation of a sample from the model, relative to it and to the albedo: lights off by degrees, near and uneven.
RELATIVE, ABSOLUTE = 0.08, 0.03
#: Deviation from 0 of the cosine toward a light that leaves a pixel dark: cast shadows make it positive.
SHADOW_DEVIATION = 0.5
#: Weight of b = 0, which only fixes what the samples leave open.
RIDGE = 1e-4
#: Rounds of reweighting, and the residual, in deviations, that has half weight.
ROUNDS, OUTLYING = 12, 2.0
#: Pixels (sigma) over which the choice between a cue's normals is averaged.
NEIGHBOURS = 2.0
#: Least cosine toward the camera: surfaces beyond 84 degrees are a pixel wide and mixed with the background.
MIN_COSINE = 0.1


@dataclass(frozen=True)
class Appearance:
    """Unit ``normals [H, W, 3]`` and relative ``albedo [H, W, C]``, 0 outside the ``mask [H, W]``."""

    normals: Floats
    albedo: Floats
    mask: Mask


def fit_lambertian(images: Floats, directions: Floats, mask: Mask) -> Appearance:
    """Least squares over all lights: albedo times normal = pseudoinverse of the directions times light.

    Source: Woodham 1980. Raises ValueError unless the lights span three dimensions.
    """
    _check(images, directions, mask)
    light = images.mean(axis=-1)[:, mask]
    vectors = (np.linalg.pinv(directions) @ light).T
    normals = _facing(vectors)
    return _appearance(images, mask, normals, (np.maximum(normals @ directions.T, 0).T, np.ones_like(light)))


def fit_robust(images: Floats, directions: Floats, mask: Mask, cue: Cue | None = None) -> Appearance:
    """Reweighted least squares with shadows, highlights, Fresnel transmission and a ``cue`` of polarization.

    The cue's two normals are told apart by the light they predict. Raises ValueError unless the lights span three
    dimensions.
    """
    _check(images, directions, mask)
    light = images.mean(axis=-1)[:, mask]
    lit = _lit(light)
    frames = _Frames(light, lit, directions, mask)
    choices = None if cue is None else (cue.first[mask], cue.second[mask], cue.deviation[mask])
    weight = lit.astype(np.float64)
    albedo: Floats = np.maximum(light.max(axis=0), 1e-6)
    normals = _facing(frames.solve(light, weight, albedo, np.ones_like(lit), None))
    even: Floats = light
    for _ in range(ROUNDS):
        even = light / _transmission(normals, directions)
        albedo = _albedo(even, weight, frames.cosines(normals))
        prior = None if choices is None else _choose(frames, even, weight, choices)
        shaded = ~lit & (frames.cosines(normals) > 0)
        normals = _facing(frames.solve(even, weight, albedo, shaded, prior))
        cosines = frames.cosines(normals)
        albedo = _albedo(even, weight, cosines)
        deviation = np.hypot(RELATIVE * even / albedo, ABSOLUTE)
        weight = lit / (1 + frames.around(((even / albedo - cosines) / (OUTLYING * deviation)) ** 2))
    shading = np.maximum(frames.cosines(normals), 0) * _transmission(normals, directions)
    return _appearance(images, mask, normals, (shading, weight))


@dataclass(frozen=True)
class _Frames:
    """Grey ``light`` and which of it is ``lit`` ``[L, P]``, of the pixels of ``mask``, under ``directions [L, 3]``."""

    light: Floats
    lit: Mask
    directions: Floats
    mask: Mask

    def cosines(self, normals: Floats) -> Floats:
        """Toward every light, ``[L, P]``."""
        cosines: Floats = self.directions @ normals.T
        return cosines

    def around(self, values: Floats) -> Floats:
        """Means ``[L, P]`` over the lit samples around each one: neighbours have similar errors."""
        means = np.zeros_like(values)
        for number, (row, lit) in enumerate(zip(values, self.lit, strict=True)):
            image, share = np.zeros(self.mask.shape), np.zeros(self.mask.shape)
            image[self.mask], share[self.mask] = row * lit, lit
            total, count = (gaussian_filter(x, NEIGHBOURS)[self.mask] for x in (image, share))
            means[number] = total / np.maximum(count, 1e-6)
        return means

    def solve(
        self, even: Floats, weight: Floats, albedo: Floats, shaded: Mask, prior: tuple[Floats, Floats] | None
    ) -> Floats:
        """The vectors ``[P, 3]`` that explain ``even / albedo``; near 0 toward lights of ``shaded``, near ``prior``."""
        relative = even / albedo
        certainty = weight / ((RELATIVE * relative) ** 2 + ABSOLUTE**2)
        dark = (shaded & ~self.lit) / SHADOW_DEVIATION**2
        outer = self.directions[:, :, None] * self.directions[:, None, :]
        matrix: Floats = np.tensordot((certainty + dark).T, outer, axes=1) + RIDGE * np.eye(3)
        right: Floats = (certainty * relative).T @ self.directions
        if prior is not None:
            normals, deviation = prior
            matrix = np.asarray(matrix + np.eye(3) / deviation[:, None, None] ** 2)
            right = np.asarray(right + normals / deviation[:, None] ** 2)
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])


def _choose(
    frames: _Frames, even: Floats, weight: Floats, choices: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats]:
    """The one of the cue's two normals with the more likely light and shadows, and its deviation."""
    first, second, deviation = choices
    costs = []
    for normals in (first, second):
        cosines = frames.cosines(normals)
        shading = np.maximum(cosines, 0)
        relative = even / _albedo(even, weight, shading)
        spread = (RELATIVE * relative) ** 2 + ABSOLUTE**2 + 0.1**2  # 0.1: the cue's own error in a cosine
        wrong = np.minimum((relative - shading) ** 2 / spread, 9) * frames.lit
        dark = np.minimum((shading / 0.2) ** 2, 2) * ~frames.lit
        costs.append((wrong + dark).sum(axis=0))
    return np.where((_vote(costs[1] - costs[0], first, frames.mask) >= 0)[:, None], first, second), deviation


def _vote(preference: Floats, first: Floats, mask: Mask) -> Floats:
    """The preference ``[P]`` of a pixel and those around it for the side to which ``first`` leans."""
    votes = np.zeros(mask.shape)
    total = np.zeros(len(first))
    for axis in (0, 1):
        votes[mask] = preference * first[:, axis]
        total += gaussian_filter(votes, NEIGHBOURS)[mask] * first[:, axis]
    return total


def _albedo(even: Floats, weight: Floats, cosines: Floats) -> Floats:
    """The factor ``[P]`` between cosines and light, by weighted least squares."""
    shading = np.maximum(cosines, 0)
    power = (weight * shading**2).sum(axis=0)
    albedo: Floats = np.maximum((weight * even * shading).sum(axis=0) / np.maximum(power, 1e-6), 1e-6)
    return albedo


def _transmission(normals: Floats, directions: Floats) -> Floats:
    """Fresnel transmission into and out of the surface ``[L, P]``, relative to normal incidence.

    Note: the angle of a polarized light, which is unknown, changes this by a few percent; that is left out.
    """
    inward = _through(np.clip(directions @ normals.T, 0.05, 1))
    outward = _through(np.clip(normals[:, 2], 0.05, 1))
    relative: Floats = inward * outward / _through(np.ones(1)) ** 2
    return relative


def _through(cosines: Floats) -> Floats:
    through: Floats = fresnel(cosines).t_plus.astype(np.float64)
    return through


def _facing(vectors: Floats) -> Floats:
    """Unit normals along ``vectors [P, 3]`` that face the camera; (0, 0, 1) where a vector is 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit = np.where(length > 0, vectors / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    unit[:, 2] = np.maximum(unit[:, 2], MIN_COSINE)
    facing: Floats = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    return facing


def _appearance(images: Floats, mask: Mask, normals: Floats, model: tuple[Floats, Floats]) -> Appearance:
    """Normals and the albedo that fits them, as images; ``model``: shading and weight of every sample."""
    shading, weight = model
    power = np.maximum((weight * shading**2).sum(axis=0), 1e-6)
    colors = np.einsum("lp,lp,lpc->pc", weight, shading, images[:, mask]) / power[:, None]
    size = mask.shape
    normal_map, albedo = np.zeros((*size, 3)), np.zeros((*size, images.shape[-1]))
    normal_map[mask], albedo[mask] = normals, np.maximum(colors, 0)
    return Appearance(normal_map, albedo, mask)


def _check(images: Floats, directions: Floats, mask: Mask) -> None:
    if images.ndim != 4 or len(images) != len(directions) or images.shape[1:3] != mask.shape:
        found = f"{list(images.shape)}, {list(directions.shape)} and {list(mask.shape)}"
        raise ValueError(f"expected images [L, H, W, C], directions [L, 3] and a mask [H, W], found {found}")
    if np.linalg.matrix_rank(directions, tol=0.05) < 3:
        raise ValueError("expected three lights or more, in directions that are not in one plane, found fewer")
    if not mask.any():
        raise ValueError("expected a mask that holds pixels, found none")


def unexplained_share(images: Floats, directions: Floats, found: Appearance) -> float:
    """Share of the lit samples that lie farther from what the normals explain than lights off by degrees make them.

    It grows with highlights, clipped samples and lights of unequal brightness.
    """
    light, normals = images.mean(axis=-1)[:, found.mask], found.normals[found.mask]
    lit = _lit(light)
    even, cosines = light / _transmission(normals, directions), directions @ normals.T
    relative = even / _albedo(even, lit.astype(np.float64), cosines)
    off = np.abs(relative - cosines) > OUTLYING * np.hypot(RELATIVE * relative, ABSOLUTE)
    return float((off & lit).sum() / max(int(lit.sum()), 1))


def _lit(light: Floats) -> Mask:
    """A mask of the samples ``[L, P]`` that are in no shadow."""
    lit: Mask = light > np.maximum(SHADOW * light.max(axis=0), DARK)
    return lit
