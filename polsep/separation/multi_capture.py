"""Separations from several captures or few analysers, with which the paper compares itself.

Conventions are those of `polsep.separation.analytic`; behind an analyser is a measurement m, half of
unpolarized light. Negative outputs, from clipping, noise or wrong polarizer angles, are cut at 0.
"""

from __future__ import annotations

import operator
from functools import reduce

from polsep.compute.arrays import Array, namespace
from polsep.physics.stokes import Measurements, Stokes, fit_stokes
from polsep.separation.analytic import Separation, all_pixels, clipped_pixels


def _as_separation(diffuse: Array, specular: Array, clipped: Array | None) -> Separation:
    """Both cut at 0, with s0 their sum and nothing known of s1 and s2; ``clipped [..., h, w]``."""
    xp = namespace(diffuse)
    diffuse, specular = diffuse.clip(0, None), specular.clip(0, None)
    nothing, valid = xp.zeros_like(diffuse), all_pixels(diffuse)
    if clipped is not None:
        valid = valid & ~clipped
    return Separation(diffuse, specular, valid, Stokes(diffuse + specular, nothing, nothing))


def _clipped_in(*captures: Measurements) -> Array | None:
    """Pixels ``[..., h, w]`` of which any capture has a clipped sample."""
    masks = [mask for mask in map(clipped_pixels, captures) if mask is not None]
    return reduce(operator.or_, masks) if masks else None


def separate_debevec2000(parallel: Array, crossed: Array) -> Separation:
    """Two photographs ``[..., C, h, w]`` behind an analyser parallel to the specular light and crossed with it.

    tau_d = 2 I_crossed, tau_s = I_parallel - I_crossed: exact for unpolarized diffuse light and an angle that is known.
    Source: Debevec et al. 2000, Acquiring the reflectance field of a human face, Sec. 3.
    """
    return _as_separation(2 * crossed, parallel - crossed, None)


def separate_ding2021(first: Measurements, second: Measurements) -> Separation:
    """Two captures ``[..., 4, C, h, w]`` under lights polarized at right angles to each other.

    Their difference D is specular but for small terms of the light's entry into the material, so tau_s = |D| / 2 and
    tau_d is what of the mean s0 it leaves; both are means over the two captures. Source: Ding et al., ICCV 2021,
    Polarimetric Helmholtz stereopsis. Note: their formulas are not public; this is derived from the polarimetric BRDF.
    """
    one, other = fit_stokes(first), fit_stokes(second)
    specular = namespace(one.s1).hypot(one.s1 - other.s1, one.s2 - other.s2) / 2
    return _as_separation((one.s0 + other.s0) / 2 - specular, specular, _clipped_in(first, second))


def separate_extremes(measurements: Measurements) -> Separation:
    """tau_d = 2 min, tau_s = max - min over the four analysers, as many tools have it.

    `separate_analytic` in steps of 45 degrees: short of it by a factor cos 45 degrees between two analysers.
    """
    xp = namespace(measurements.data)
    least, most = xp.min(measurements.data, axis=-4), xp.max(measurements.data, axis=-4)
    return _as_separation(2 * least, most - least, _clipped_in(measurements))
