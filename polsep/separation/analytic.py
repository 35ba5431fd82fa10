"""Diffuse and specular images from co-registered analysers: the training-free methods, one function each.

Every function maps `Measurements` ``[..., 4, C, h, w]`` to a `Separation`. Conventions: linear light, 1.0 = one
measurement at the white level, so s0 reaches 2. The light is white; divide another light's colour out before.

Energy: diffuse + specular = s0 of the method's own `stokes`, wherever no sample clips and s0 >= 0 (a negative s0 is
noise around black and counts as 0). Both outputs are non-negative: where noise makes DoLP exceed 1, the specular stops
at s0. ``valid`` is False where clipping left something to assumption instead of measurement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from polsep.compute.arrays import Array, namespace, short_repr
from polsep.physics.stokes import (
    Measurements,
    Stokes,
    complete_pair,
    fit_stokes,
    fit_stokes_unclipped,
    is_pair,
    polarized_intensity,
)


@dataclass(frozen=True, eq=False, repr=False)
class Separation:
    """A diffuse and a specular image ``[..., C, h, w]`` with ``valid [..., h, w]`` and the `stokes` they came from.

    ``diffuse_polarization [..., 2, h, w]``: (beta_d cos 2 phi_d, beta_d sin 2 phi_d) that the method
    estimated, or None. ``residual``, ``[..., 1, h, w]``: rms distance of the polarization over colours from its model,
    or None. ``noise``, ``[..., 1, h, w]``: standard deviation of one sample as the analysers' own contradiction shows
    it. ``clipped [..., h, w]``: pixels to which a clipped sample contributed, None if not determined.
    ``expected_error``, ``[..., 2, h, w]``: standard deviation of the error of diffuse and specular as the method
    expects it, or None.
    """

    diffuse: Array
    specular: Array
    valid: Array
    stokes: Stokes
    diffuse_polarization: Array | None = None
    residual: Array | None = None
    noise: Array | None = None
    clipped: Array | None = None
    expected_error: Array | None = None

    __repr__ = short_repr


def _split(stokes: Stokes, specular: Array, valid: Array) -> Separation:
    """Diffuse is s0 minus specular; both stay non-negative."""
    xp = namespace(specular)
    total = stokes.s0.clip(0, None)
    specular = xp.minimum(specular, total)
    return Separation(total - specular, specular, valid, stokes)


def separate_analytic(measurements: Measurements) -> Separation:
    """The paper's initial split: tau_s = sqrt(s1^2 + s2^2), tau_d = s0 - tau_s, clipped samples at face value.

    Exact if the diffuse light is unpolarized and nothing clips. Per pixel and colour; no parameters. A highlight that
    clips all analysers becomes a hole in the specular image. Of a crossed pair tau_s is the polarization along it, and
    tau_d twice what the darker one sees. Source: Dave et al. 2022, Eqs. 15-18; of pairs, Debevec et al. 2000, Sec. 3.
    """
    measurements = complete_pair(measurements) if is_pair(measurements) else measurements
    stokes = fit_stokes(measurements)
    clipped = clipped_pixels(measurements)
    return _split(stokes, polarized_intensity(stokes), all_pixels(stokes.s0) if clipped is None else ~clipped)


def separate_analytic_unclipped(measurements: Measurements) -> Separation:
    """`separate_analytic` from the unclipped analysers: exact with any three of them, bounds where fewer are left."""
    stokes, determined = fit_stokes_unclipped(measurements)
    return _split(stokes, polarized_intensity(stokes), namespace(determined).all(determined, axis=-3))


def all_pixels(image: Array) -> Array:
    """A mask ``[..., h, w]`` of all pixels of an image ``[..., C, h, w]``."""
    xp = namespace(image)
    return xp.ones_like(image[..., 0, :, :], dtype=xp.bool)


def clipped_pixels(measurements: Measurements) -> Array | None:
    """Pixels ``[..., h, w]`` with a clipped sample; None if not determined."""
    clipped = measurements.clipped
    if clipped is None:
        return None
    xp = namespace(clipped)
    return xp.any(xp.any(clipped, axis=-4), axis=-3)


def light_polarizer_angle(specular_angle: float) -> float:
    """Polarizer angle of a light near the camera's axis, in its own beam's frame: a mirror turns nu into -nu [rad].

    Exact for light and camera in line with one up vector; farther off it holds for the facets that face both.
    """
    return -specular_angle % math.pi % math.pi  # twice: rounding takes tiny negative angles to pi
