"""Normals from the polarization of diffuse light: azimuth up to half a turn, and zenith.

Diffuse light that leaves a dielectric has its AoLP along the projected normal and the DoLP `diffuse_dolp` of the
zenith under any light. So (s1, s2) of the diffuse image is the same multiple of its s0 in every frame: the diffuse
polarization. Its estimate is robust: samples under specular light, which is polarized by itself, have less weight.
Angles count from image-right toward image-up.
Source: Atkinson and Hancock 2006, Recovery of surface orientation from diffuse polarization, TIP 15(6); Eqs. 4-6 of
Dave et al. 2022.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter

from polsep.physics.fresnel import diffuse_dolp

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Standard deviation of polarized light [white level] from noise and demosaicking.
NOISE = 0.01
#: Error of the polarized part of a specular image, relative to the image.
SPECULAR_ERROR = 2.0
#: Pixels (sigma) over which the polarization is averaged, and rounds of reweighting.
REACH, ROUNDS = 1.0, 5
#: Standard deviation of the estimate; measured on four test objects: 0.004 to 0.017 (docs/experiments.md).
POLARIZATION_DEVIATION = 0.015
#: Pixels (sigma) over which neighbours choose between a cue's normals, rounds of that, and the weight of pointing away
#: from the object's middle.
NEIGHBOURS, CHOICES, OUTWARD = 2.0, 40, 0.05
#: Least standard deviation of a normal from polarization [rad].
MIN_DEVIATION = 0.04


@dataclass(frozen=True)
class Polarized:
    """Frames under different lights, all ``[L, H, W]``: grey ``diffuse`` and ``specular``, and their sum's ``s1, s2``.

    ``valid``: 1 where the separation is valid, else 0.
    """

    diffuse: Floats
    specular: Floats
    s1: Floats
    s2: Floats
    valid: Floats


@dataclass(frozen=True)
class Cue:
    """Two normals ``first`` and ``second`` ``[H, W, 3]``, half a turn apart, with ``deviation [H, W]`` [rad]."""

    first: Floats
    second: Floats
    deviation: Floats


def find_diffuse_polarization(frames: Polarized, mask: Mask) -> NDArray[np.complex128]:
    """DoLP exp(2 i AoLP) of the diffuse light ``[H, W]``, by robust least squares over all frames."""
    certainty = frames.valid / (NOISE**2 + (SPECULAR_ERROR * frames.specular) ** 2) * mask
    polarized = frames.s1 + 1j * frames.s2
    weight = certainty
    polarization = np.zeros(mask.shape, np.complex128)
    for _ in range(ROUNDS):
        product = (weight * frames.diffuse * polarized).sum(axis=0)
        power = gaussian_filter((weight * frames.diffuse**2).sum(axis=0), REACH)
        smooth = gaussian_filter(product.real, REACH) + 1j * gaussian_filter(product.imag, REACH)
        polarization = np.where(power > 0, smooth / np.where(power > 0, power, 1), 0)
        weight = certainty / (1 + (np.abs(polarized - polarization * frames.diffuse) / NOISE) ** 2)
    return polarization


def normals_from_polarization(polarization: NDArray[np.complex128]) -> Cue:
    """The two normals of a diffuse polarization, and their standard deviation.

    Values beyond the end of the curve, at 89.5 degrees, are limited to it.
    """
    zeniths = np.linspace(0, math.radians(89.5), 500)
    curve = diffuse_dolp(np.cos(zeniths))
    strength = np.minimum(np.abs(polarization), curve[-1])
    zenith, azimuth = np.interp(strength, curve, zeniths), np.angle(polarization) / 2
    first = np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)],
        axis=-1,
    )
    steepness = np.interp(zenith, zeniths, np.gradient(curve, zeniths))
    along = np.minimum(POLARIZATION_DEVIATION / np.maximum(steepness, 1e-6), 1)
    across = np.minimum(np.sin(zenith) * POLARIZATION_DEVIATION / np.maximum(2 * strength, 1e-6), 1)
    deviation = np.sqrt((along**2 + across**2) / 2 + MIN_DEVIATION**2)
    return Cue(first, first * np.array([-1.0, -1.0, 1.0]), deviation)


def choose_outward(cue: Cue, mask: Mask) -> Floats:
    """The normals ``[H, W, 3]`` of a cue that point away from the object's middle and agree with their neighbours.

    From the outline, where azimuths are known, inward: a classical way to solve what polarization leaves open. Source:
    Atkinson and Hancock 2006, Sec. IV, propagation from the boundary; here by rounds of weighted votes.
    """
    depth = gaussian_filter(distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1], NEIGHBOURS)
    down, right = np.gradient(depth)
    away = np.stack([-right, down], axis=-1)
    toward = np.stack([cue.first[..., 0], cue.first[..., 1]], axis=-1)
    certain = mask / cue.deviation**2
    prior = OUTWARD * (toward * away).sum(axis=-1)
    sign = np.where(prior >= 0, 1.0, -1.0)
    for _ in range(CHOICES):
        votes = (
            np.stack([gaussian_filter(certain * sign * toward[..., k], NEIGHBOURS) for k in range(2)], axis=-1)
            / np.maximum(gaussian_filter(certain, NEIGHBOURS), 1e-12)[..., None]
        )
        sign = np.where((toward * votes).sum(axis=-1) + prior >= 0, 1.0, -1.0)
    chosen: Floats = np.where((sign > 0)[..., None], cue.first, cue.second) * mask[..., None]
    return chosen
