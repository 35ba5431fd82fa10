"""Separations from several captures or few analysers, with which the paper compares itself.

Conventions are those of `polsep.separation.analytic`; behind an analyser is a measurement m, half of
unpolarized light. Negative outputs, from clipping, noise or wrong polarizer angles, are cut at 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from polsep.physics.stokes import Measurements, Stokes, fit_stokes
from polsep.separation.analytic import Separation


def _as_separation(diffuse: Tensor, specular: Tensor, clipped: Tensor | None) -> Separation:
    """Both cut at 0, with s0 their sum and nothing known of s1 and s2; ``clipped [..., h, w]``."""
    diffuse, specular = diffuse.clamp(min=0), specular.clamp(min=0)
    nothing = torch.zeros_like(diffuse)
    valid = torch.ones_like(diffuse[..., 0, :, :], dtype=torch.bool)
    if clipped is not None:
        valid = valid & ~clipped
    return Separation(diffuse, specular, valid, Stokes(diffuse + specular, nothing, nothing))


def _clipped_pixels(*captures: Measurements) -> Tensor | None:
    """Pixels ``[..., h, w]`` of which any capture has a clipped sample."""
    masks = [c.clipped.any(dim=-4).any(dim=-3) for c in captures if c.clipped is not None]
    return torch.stack(masks).any(dim=0) if masks else None


def separate_debevec2000(parallel: Tensor, crossed: Tensor) -> Separation:
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
    specular = torch.hypot(one.s1 - other.s1, one.s2 - other.s2) / 2
    return _as_separation((one.s0 + other.s0) / 2 - specular, specular, _clipped_pixels(first, second))


def separate_extremes(measurements: Measurements) -> Separation:
    """tau_d = 2 min, tau_s = max - min over the four analysers, as many tools have it.

    `separate_analytic` in steps of 45 degrees: short of it by a factor cos 45 degrees between two analysers.
    """
    least, most = measurements.data.amin(dim=-4), measurements.data.amax(dim=-4)
    return _as_separation(2 * least, most - least, _clipped_pixels(measurements))
