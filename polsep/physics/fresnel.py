"""Fresnel coefficients of air-dielectric and air-metal interfaces, for NumPy arrays and torch tensors.

They follow Verdet's convention (r_p = -r_s at normal incidence), with the angle on the AIR side, also for light that
leaves the material; Stokes vectors carry no eta^2 factor on leaving (reciprocal, as Mitsuba 3).
"""

from __future__ import annotations

from typing import NamedTuple

from polsep.compute.arrays import Array, namespace

#: Refractive index of every dielectric in the paper (Sec. 3.1).
ETA = 1.5


class Fresnel(NamedTuple):
    """Half sums and differences of the power coefficients for s and p light, and the signed product r_s r_p."""

    r_plus: Array
    r_minus: Array
    r_cross: Array
    t_plus: Array
    t_minus: Array


def fresnel(cos_theta: Array, eta: float = ETA) -> Fresnel:
    """Fresnel coefficients for the cosine of the air-side angle of incidence.

    r_cross = r_s r_p is negative below Brewster's angle arctan(eta) and positive above. t_minus = -r_minus <= 0:
    transmission favours p. Source: Born and Wolf, Principles of Optics, 1.5.2; signs as Mitsuba 3 `fresnel.h`.
    """
    xp = namespace(cos_theta)
    c = xp.clip(cos_theta, min=0, max=1)
    ct = xp.sqrt(1 - (1 - c * c) / eta**2)
    rs = (c - eta * ct) / (c + eta * ct)
    rp = (eta * c - ct) / (eta * c + ct)
    power_s, power_p = rs * rs, rp * rp
    plus, minus = 0.5 * (power_s + power_p), 0.5 * (power_s - power_p)
    return Fresnel(plus, minus, rs * rp, 1 - plus, -minus)


def conductor(cos_theta: Array, reflectance: Array) -> Fresnel:
    """Fresnel coefficients of a metal of ``reflectance`` in (0, 1) at normal incidence; nothing is transmitted.

    The index of refraction is taken as 1 + ik, k = 2 sqrt(R / (1 - R)), as near aluminium's; other real parts with the
    same R differ little below 60 degrees. r_cross is the real part of r_s r_p*: the imaginary part makes light
    circular, which linear analysers do not see. Source: Born and Wolf, Principles of Optics, 14.2; k from R as in
    Gulbrandsen 2014, Artist Friendly Metallic Fresnel.
    """
    xp = namespace(cos_theta)
    c = xp.clip(cos_theta, min=0, max=1)
    k2 = 4 * reflectance / (1 - reflectance)
    square = 1 - k2 + 2j * xp.sqrt(k2)
    inside = xp.sqrt(square - (1 - c * c))
    rs, rp = (c - inside) / (c + inside), (square * c - inside) / (square * c + inside)
    power_s, power_p = xp.abs(rs) ** 2, xp.abs(rp) ** 2
    cross = xp.real(rs) * xp.real(rp) + xp.imag(rs) * xp.imag(rp)
    nothing = 0 * power_s
    return Fresnel(0.5 * (power_s + power_p), 0.5 * (power_s - power_p), cross, nothing, nothing)


def diffuse_dolp(cos_theta: Array, eta: float = ETA) -> Array:
    """beta_d = -T^-/T^+: DoLP of diffuse light that leaves at that zenith angle; 0.044 at 45 degrees, at most 0.385.

    At exact grazing, where no light leaves, it is 0.
    """
    f, xp = fresnel(cos_theta, eta), namespace(cos_theta)
    return -f.t_minus / xp.clip(f.t_plus, min=float(xp.finfo(cos_theta.dtype).eps))
