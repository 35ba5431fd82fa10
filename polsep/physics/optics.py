"""Surfaces in polarized light: Fresnel, GGX, the polarimetric BRDF.

Conventions:

* Directions are unit vectors ``[..., 3, H, W]`` that point away from the surface: normal n, to the camera (wo = v), to
  the light (wi = l), half vector h. Axes are right-handed; scalars are ``[..., 1, H, W]``, colours ``[..., C, H, W]``.
* A beam's frame has z along its propagation, y the projection of an "up" vector and x = y cross z. The camera's beam
  travels along v, so x is image-right and y image-up and angles count from x toward y, as in `stokes`. The light's beam
  travels along -l; its polarizer angle is measured in the frame of the light's own up vector.
* Fresnel coefficients as in `fresnel`.
* Roughness r is GGX alpha = r^2. The diffuse lobe is albedo/pi, so both lobes have their physical ratio.

Notes (deviations from the paper; derivation and check in docs/conventions.md): its Eq. 6 needs the INCIDENT azimuth,
its Eq. 8 has a wrong sign of R^x in the numerator and lacks the 1/2 and the two-argument arctangent. Implemented here
is the form that an electric-field ray trace confirms to rounding error, and that equals Mitsuba's ``pplastic``.
Source: Baek, Jeon, Tong, Kim 2018, Simultaneous acquisition of polarimetric SVBRDF and normals, TOG 37(6) 268.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.physics.fresnel import Fresnel, conductor, fresnel
from polsep.physics.stokes import Stokes


class Beam(NamedTuple):
    """Axes x and y of a beam's transverse plane, each ``[..., 3, H, W]``."""

    x: Tensor
    y: Tensor


@dataclass(frozen=True)
class Geometry:
    """Directions at the surface points and the up vectors of the two beams, all ``[..., 3, H, W]`` or broadcastable."""

    normal: Tensor
    to_camera: Tensor
    to_light: Tensor
    camera_up: Tensor
    light_up: Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product over the vector axis, kept: ``[..., 1, H, W]``."""
    return (a * b).sum(dim=-3, keepdim=True)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product over the vector axis."""
    product: Tensor = torch.linalg.cross(*torch.broadcast_tensors(a, b), dim=-3)  # type: ignore[no-untyped-call]
    return product


def normalize(v: Tensor) -> Tensor:
    """Unit vectors; a zero vector stays zero, with finite gradients."""
    squared = dot(v, v)
    return v * torch.rsqrt(squared.clamp(min=torch.finfo(v.dtype).tiny * 4))


def ggx_distribution(normal: Tensor, half: Tensor, alpha: Tensor) -> Tensor:
    """GGX microfacet distribution D(n, h). Source: Walter et al. 2007, Eq. 33. ``alpha = roughness**2``.

    The sine comes from the cross product: 1 - cos^2 would lose the highlight of a glossy surface in float32.
    """
    c, s = dot(normal, half), cross(normal, half)
    return alpha**2 / (math.pi * (c * c * alpha**2 + dot(s, s)) ** 2)


def smith_shadowing(cos_theta: Tensor, alpha: Tensor) -> Tensor:
    """Smith's G1 for GGX. Source: Walter et al. 2007, Eq. 34."""
    c = cos_theta.clamp(min=1e-6)
    return 2 / (1 + torch.sqrt(1 + alpha**2 * (1 - c * c).clamp(min=0) / (c * c)))


def beam_frame(propagation: Tensor, up: Tensor) -> Beam:
    """The frame of a beam: y is ``up`` made perpendicular to the unit vector ``propagation``, x = y cross z."""
    y = normalize(up - dot(up, propagation) * propagation)
    return Beam(cross(y, propagation), y)


def double_angle(vector: Tensor, beam: Beam) -> tuple[Tensor, Tensor]:
    """cos and sin of twice the azimuth of ``vector`` in the beam's frame; (0, 0) if it lies along the beam."""
    a, b = dot(vector, beam.x), dot(vector, beam.y)
    scale = 1 / (a * a + b * b).clamp(min=torch.finfo(a.dtype).tiny * 4)
    return (a * a - b * b) * scale, 2 * a * b * scale


def _camera_and_light_beams(g: Geometry) -> tuple[Beam, Beam]:
    return beam_frame(g.to_camera, g.camera_up), beam_frame(-g.to_light, g.light_up)


def _lit(g: Geometry) -> tuple[Tensor, Tensor, Tensor]:
    """cos at the light, cos at the camera, and 1 where both face the surface's front."""
    cos_i, cos_o = dot(g.normal, g.to_light), dot(g.normal, g.to_camera)
    return cos_i.clamp(0, 1), cos_o.clamp(0, 1), ((cos_i > 0) & (cos_o > 0)).to(cos_i)


def diffuse_stokes(g: Geometry, polarizer: Tensor, irradiance: Tensor, albedo: Tensor) -> Stokes:
    """Stokes image of the diffuse lobe: transmitted in, depolarized, transmitted out.

    ``polarizer``: angle [rad] of the fully polarized light in its own frame; ``irradiance``: I/d^2 at the point,
    without the cosine; ``albedo`` ``[..., C, H, W]``. AoLP is the azimuth of the normal, DoLP is `diffuse_dolp`.
    No shadows: multiply ``irradiance``. Source: Eqs. 4-6 corrected (the incident azimuth of n).
    """
    camera, light = _camera_and_light_beams(g)
    cos_i, cos_o, lit = _lit(g)
    into, out = fresnel(cos_i), fresnel(cos_o)
    ci, si = double_angle(g.normal, light)
    co, so = double_angle(g.normal, camera)
    entered = into.t_plus - into.t_minus * (ci * torch.cos(2 * polarizer) + si * torch.sin(2 * polarizer))
    shading = lit * cos_i * irradiance / math.pi * entered * albedo
    return Stokes(shading * out.t_plus, -shading * out.t_minus * co, -shading * out.t_minus * so)


def _mirror_axis(g: Geometry, camera: Beam) -> Tensor:
    """The s axis of the mirror reflection: perpendicular to both beams, so one axis serves both frames.

    With light and camera in line every perpendicular axis is right, but both frames must use the same one.
    """
    axis = cross(g.to_camera, g.to_light)
    in_line = dot(axis, axis) < torch.finfo(axis.dtype).eps ** 1.5
    return torch.where(in_line, camera.y, axis)


def specular_stokes(g: Geometry, polarizer: Tensor, irradiance: Tensor, roughness: Tensor) -> Stokes:
    """Stokes image of the specular lobe: Fresnel reflection off GGX microfacets, for specular strength 1.

    Arguments as `diffuse_stokes`; ``roughness`` ``[..., 1, H, W]``, above 0. Linear light stays fully polarized:
    s1^2 + s2^2 = s0^2. Multiply the result by a specular strength or colour. Source: Eqs. 7-8 corrected.
    """
    shading, cosine = _facets(g, irradiance, roughness)
    return _mirror(g, polarizer, shading, fresnel(cosine))


def metal_stokes(g: Geometry, polarizer: Tensor, irradiance: Tensor, roughness: Tensor, reflectance: Tensor) -> Stokes:
    """Stokes image of a metal, which has no diffuse lobe: `fresnel.conductor` off GGX microfacets.

    Arguments as `specular_stokes`; ``reflectance`` ``[..., C, H, W]`` at normal incidence, in (0, 1). A little of the
    light becomes circular, so that s1^2 + s2^2 <= s0^2.
    """
    shading, cosine = _facets(g, irradiance, roughness)
    return _mirror(g, polarizer, shading, conductor(cosine, reflectance))


def _facets(g: Geometry, irradiance: Tensor, roughness: Tensor) -> tuple[Tensor, Tensor]:
    """Light that facets would send to the camera if they reflected all of it; the cosine between them and the light."""
    cos_i, cos_o, lit = _lit(g)
    h = normalize(torch.where(lit > 0, g.to_camera + g.to_light, g.normal))
    alpha = roughness**2
    lobe = ggx_distribution(g.normal, h, alpha) * smith_shadowing(cos_i, alpha) * smith_shadowing(cos_o, alpha)
    return lit * irradiance * lobe / (4 * cos_o.clamp(min=1e-4)), dot(h, g.to_light)


def _mirror(g: Geometry, polarizer: Tensor, shading: Tensor, f: Fresnel) -> Stokes:
    """The specular light of facets with Fresnel coefficients ``f``."""
    camera, light = _camera_and_light_beams(g)
    axis = _mirror_axis(g, camera)
    # The azimuth of h is that of the s axis turned by 90 degrees in either frame, hence the minus signs.
    ci, si = (-x for x in double_angle(axis, light))
    co, so = (-x for x in double_angle(axis, camera))
    cn, sn = torch.cos(2 * polarizer), torch.sin(2 * polarizer)
    c, s = ci * cn + si * sn, si * cn - ci * sn
    a, b = f.r_plus * c - f.r_minus, f.r_cross * s
    return Stokes(shading * (f.r_plus - f.r_minus * c), shading * (a * co + b * so), shading * (a * so - b * co))
