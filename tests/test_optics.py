"""Surfaces and filters act on light as physics says: constants, energy, reciprocity, and two independent references."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tolerances import PRINTED, QUADRATURE, ROUNDING, assert_close, assert_finite, assert_same_angle, assert_within
from torch import Tensor

from polsep.physics.fresnel import ETA, Fresnel, diffuse_dolp, fresnel
from polsep.physics.optics import (
    Beam,
    Geometry,
    beam_frame,
    cross,
    diffuse_stokes,
    dot,
    double_angle,
    ggx_distribution,
    normalize,
    smith_shadowing,
    specular_stokes,
)
from polsep.physics.stokes import Stokes, aolp, dolp, polarized_intensity

DTYPES = (torch.float32, torch.float64)
BREWSTER = math.atan(ETA)
#: DoLP of diffuse light by zenith angle [degrees] for eta = 1.5.
BETA_D = {
    **{10: 0.0017, 20: 0.0071, 30: 0.0170, 40: 0.0329, 45: 0.0440, 50: 0.0577, math.degrees(BREWSTER): 0.0799},
    **{60: 0.0959, 65: 0.1223, 70: 0.1551, 75: 0.1959, 80: 0.2464, 85: 0.3087, 89: 0.3683},
}
Array = NDArray[np.float64]


def cosine(degrees: float) -> Tensor:
    return torch.tensor(math.cos(math.radians(degrees)), dtype=torch.float64)


def vector(*xyz: float) -> Tensor:
    """One direction ``[3, 1, 1]``."""
    return normalize(torch.tensor(xyz, dtype=torch.float64).view(3, 1, 1))


def scalar(value: float) -> Tensor:
    return torch.full((1, 1, 1), value, dtype=torch.float64)


def random_directions(count: int, generator: torch.Generator) -> Tensor:
    return normalize(torch.randn(3, count, 1, generator=generator, dtype=torch.float64))


def random_geometry(count: int, generator: torch.Generator, least_cosine: float = 0.03) -> Geometry:
    """Random directions and up vectors with camera and light in front of the surface."""
    normal = random_directions(count, generator)

    def front(up: Tensor | None = None) -> Tensor:
        found = random_directions(8 * count, generator).view(3, 8, count, 1)
        cosines = (found * normal[:, None]).sum(0, keepdim=True)
        good = (cosines.abs() > least_cosine).to(torch.int8)
        pick = good.argmax(dim=1, keepdim=True).expand(3, 1, count, 1)
        chosen = found.gather(1, pick)[:, 0]
        return chosen * torch.sign(dot(chosen, normal))

    return Geometry(normal, front(), front(), random_directions(count, generator), random_directions(count, generator))


def as_type(geometry: Geometry, dtype: torch.dtype) -> Geometry:
    fields = (geometry.normal, geometry.to_camera, geometry.to_light, geometry.camera_up, geometry.light_up)
    return Geometry(*(v.to(dtype) for v in fields))


def stacked(stokes: Stokes) -> Tensor:
    return torch.stack([stokes.s0, stokes.s1, stokes.s2])


def uniform(count: int, low: float, high: float, generator: torch.Generator) -> Tensor:
    """Scalars ``[1, N, 1]``."""
    return low + (high - low) * torch.rand(1, count, 1, generator=generator, dtype=torch.float64)


# ---------------------------------------------------------------------------------------------------------- Fresnel


@pytest.mark.parametrize(("degrees", "beta"), BETA_D.items())
def test_diffuse_dolp_table(degrees: float, beta: float) -> None:
    """DoLP of diffuse light has its published value at each zenith angle, and the closed form agrees."""
    cos = cosine(degrees)
    value = diffuse_dolp(cos)
    assert_within(value, beta, PRINTED)
    sin2, root = 1 - cos**2, torch.sqrt(ETA**2 - 1 + cos**2)
    closed = (ETA - 1 / ETA) ** 2 * sin2 / (2 + 2 * ETA**2 - (ETA + 1 / ETA) ** 2 * sin2 + 4 * cos * root)
    assert_close(value, closed)


@given(degrees=st.floats(0, 89), eta=st.floats(1.05, 3))
def test_diffuse_dolp_closed_form(degrees: float, eta: float) -> None:
    """-T^-/T^+ equals the closed form at every angle and refractive index."""
    cos = cosine(degrees)
    sin2, root = 1 - cos**2, torch.sqrt(eta**2 - 1 + cos**2)
    closed = (eta - 1 / eta) ** 2 * sin2 / (2 + 2 * eta**2 - (eta + 1 / eta) ** 2 * sin2 + 4 * cos * root)
    # T^+ is a difference from 1 that vanishes with the cosine, so rounding grows with 1 / cosine.
    assert_close(diffuse_dolp(cos, eta), closed, scale=1 / float(cos))


def test_diffuse_dolp_grows_to_its_limit() -> None:
    """DoLP of diffuse light grows with the zenith angle from 0 to at most 0.385."""
    values = diffuse_dolp(torch.cos(torch.linspace(0, math.pi / 2 - 1e-4, 400, dtype=torch.float64)))
    assert values[0].item() == 0
    assert bool((values.diff() > 0).all())
    limit = (ETA - 1 / ETA) ** 2 / (2 + 2 * ETA**2 - (ETA + 1 / ETA) ** 2)
    assert values[-1].item() == pytest.approx(limit, abs=1e-3)
    assert values[-1].item() < 0.385


def test_fresnel_constants() -> None:
    """Printed values: T^+ at 0, 45 and 70 degrees, R^+ at 0, 45 and 70 degrees, Brewster's angle."""
    for degrees, t_plus, r_plus in ((0, 0.960, 0.040), (45, 0.950, 0.050), (70, 0.829, 0.171)):
        f = fresnel(cosine(degrees))
        assert_within(f.t_plus, t_plus, 10 * PRINTED)
        assert_within(f.r_plus, r_plus, 10 * PRINTED)
    assert_within(fresnel(cosine(45)).r_plus, 0.0502, PRINTED)
    assert_close(fresnel(cosine(0)).t_plus, 0.96)
    assert math.degrees(BREWSTER) == pytest.approx(56.31, abs=5e-3)


@given(degrees=st.floats(0, 90), eta=st.floats(1.01, 4))
def test_fresnel_conserves_energy(degrees: float, eta: float) -> None:
    """What is reflected and what Snell and the transmission amplitudes let through add up to all of the light."""
    cos = cosine(degrees)
    f = fresnel(cos, eta)
    cos_t = torch.sqrt(1 - (1 - cos**2) / eta**2)
    power_s = 4 * eta * cos * cos_t / (cos + eta * cos_t) ** 2
    power_p = 4 * eta * cos * cos_t / (eta * cos + cos_t) ** 2
    assert_close(f.t_plus + f.r_plus, 1.0)
    assert_close(f.t_plus, (power_s + power_p) / 2)
    assert_close(f.t_minus, (power_s - power_p) / 2)
    assert_close(f.r_minus, -f.t_minus)
    assert f.t_minus.item() <= 0


@given(eta=st.floats(1.05, 4))
def test_brewster(eta: float) -> None:
    """At arctan(eta) no p light is reflected; r_s r_p is negative below that angle and positive above."""
    brewster = math.degrees(math.atan(eta))
    f = fresnel(cosine(brewster), eta)
    assert_close(f.r_plus, f.r_minus)
    assert_close(f.r_cross, 0.0)
    assert fresnel(cosine(0.9 * brewster), eta).r_cross.item() < 0
    assert fresnel(cosine(brewster + 0.1 * (90 - brewster)), eta).r_cross.item() > 0
    assert_close(fresnel(cosine(0), eta).r_cross, -fresnel(cosine(0), eta).r_plus)


@given(degrees=st.floats(0, 90))
def test_reflection_keeps_linear_light_linear(degrees: float) -> None:
    """(R^+)^2 = (R^-)^2 + (r_s r_p)^2: a dielectric changes no fully polarized light into partially polarized."""
    f = fresnel(cosine(degrees))
    assert_close(f.r_minus**2 + f.r_cross**2, f.r_plus**2)


@pytest.mark.parametrize("dtype", DTYPES)
def test_grazing_and_beyond(dtype: torch.dtype) -> None:
    """At grazing incidence everything is reflected; cosines outside [0, 1] are taken at the end of the range."""
    f = fresnel(torch.tensor([0.0, -0.3, 1.0, 1.0001], dtype=dtype))
    assert_close(f.r_plus, [1.0, 1.0, 0.04, 0.04])
    assert_close(f.t_plus, [0.0, 0.0, 0.96, 0.96])
    assert_close(f.r_cross, [1.0, 1.0, -0.04, -0.04])
    assert_finite(*f, diffuse_dolp(torch.tensor([0.0, -0.3, 1.0], dtype=dtype)))


# -------------------------------------------------------------------------------------------------------- microfacets


@pytest.mark.parametrize("roughness", [0.15, 0.3, 0.5, 1.0])
def test_ggx_is_normalized(roughness: float) -> None:
    """The projected area of all microfacets is that of the surface: the integral of D cos over the hemisphere is 1."""
    count = 20_000
    t = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    sin2, weight = t**4, 4 * t**3 / count  # d(sin^2) = 2 sin cos dtheta
    half = torch.stack([sin2.sqrt(), torch.zeros_like(t), (1 - sin2).sqrt()])[..., None]
    d = ggx_distribution(vector(0, 0, 1), half, torch.tensor(roughness**2, dtype=torch.float64))
    assert_within((math.pi * d[0, :, 0] * weight).sum(), 1.0, QUADRATURE)


@pytest.mark.parametrize("degrees", [0, 40, 75])
@pytest.mark.parametrize("alpha", [0.25, 0.6])
def test_smith_shadowing_conserves_visible_area(degrees: float, alpha: float) -> None:
    """Microfacets seen from a direction cover just the surface seen from it: integral of D G1 (v.h)+ = n.v."""
    rings, sectors = 2000, 400
    t = (torch.arange(rings, dtype=torch.float64) + 0.5) / rings
    phi = 2 * math.pi * (torch.arange(sectors, dtype=torch.float64) + 0.5) / sectors
    cos = (1 - t**4).sqrt()
    half = torch.stack(torch.broadcast_tensors(t[:, None] ** 2 * phi.cos(), t[:, None] ** 2 * phi.sin(), cos[:, None]))
    weight = (4 * t**3 / rings / (2 * cos))[:, None] * 2 * math.pi / sectors
    normal, view = vector(0, 0, 1), vector(math.sin(math.radians(degrees)), 0, math.cos(math.radians(degrees)))
    width = torch.tensor(alpha, dtype=torch.float64)
    facing = dot(view, half).clamp(min=0) * ggx_distribution(normal, half, width)
    seen = (facing[0] * weight).sum() * smith_shadowing(dot(normal, view), width)
    assert_within(seen, dot(normal, view), QUADRATURE)


def test_smith_limits() -> None:
    """Nothing is shadowed at normal incidence or on a smooth surface, all at grazing, more with more roughness."""
    cos = torch.linspace(0.01, 1, 50, dtype=torch.float64)
    for alpha in (0.04, 0.25, 1.0):
        g = smith_shadowing(cos, torch.tensor(alpha, dtype=torch.float64))
        assert_close(g[-1], 1.0)
        assert bool((g.diff() > 0).all()) and bool((g > 0).all())
        assert smith_shadowing(torch.zeros(1), torch.tensor(alpha)).item() < 1e-4
    assert_close(smith_shadowing(cos, torch.zeros(1, dtype=torch.float64)), torch.ones_like(cos))
    tan = torch.tan(torch.acos(cos))
    assert_close(smith_shadowing(cos, torch.tensor(0.3, dtype=torch.float64)), 2 / (1 + torch.sqrt(1 + 0.09 * tan**2)))


def test_ggx_closed_form() -> None:
    """D by cosine and cross product equals Walter's form in tan(theta_h), also for a glossy surface in float32."""
    theta = torch.linspace(0, 1.5, 200, dtype=torch.float64)
    half = torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()])[..., None]
    for alpha in (0.01, 0.04, 0.25):
        expected = alpha**2 / (math.pi * theta.cos() ** 4 * (alpha**2 + theta.tan() ** 2) ** 2)
        for dtype in DTYPES:
            d = ggx_distribution(vector(0, 0, 1).to(dtype), half.to(dtype), torch.tensor(alpha, dtype=dtype))
            assert_close(d[0, :, 0], expected, scale=expected.max().item())


# -------------------------------------------------------------------------------------------------------- frames


def test_beam_frame_is_right_handed(generator: torch.Generator) -> None:
    """A beam's axes are orthonormal, x cross y is the propagation, and y has no part against up."""
    z, up = random_directions(50, generator), random_directions(50, generator)
    x, y = beam_frame(z, up)
    assert_close(cross(x, y), z)
    for a, b, expected in ((x, x, 1.0), (y, y, 1.0), (x, y, 0.0), (x, z, 0.0), (x, up, 0.0)):
        assert_close(dot(a, b), torch.full_like(dot(a, b), expected))
    assert bool((dot(y, up) > 0).all())


def test_camera_frame_is_image_right_and_up() -> None:
    """For a camera on +z with up +y, x is to the right and azimuths count counter-clockwise in the image."""
    beam = beam_frame(vector(0, 0, 1), vector(0, 1, 0))
    assert_close(beam.x, vector(1, 0, 0))
    assert_close(beam.y, vector(0, 1, 0))
    cos, sin = double_angle(vector(math.cos(0.4), math.sin(0.4), 3), beam)
    assert_close(torch.atan2(sin, cos), scalar(0.8))
    assert double_angle(vector(0, 0, 1), beam) == (scalar(0), scalar(0))


# ------------------------------------------------------------------------- an independent trace of the electric field


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


def axes(propagation: Array, up: Array) -> tuple[Array, Array]:
    """x and y of a beam by Gram-Schmidt."""
    y = unit(up - (up @ propagation) * propagation)
    return np.cross(y, propagation), y


def field_stokes(field: Array, x: Array, y: Array) -> Array:
    """Stokes vector of a real electric field, measured along two axes."""
    ex, ey = field @ x, field @ y
    return np.array([ex * ex + ey * ey, ex * ex - ey * ey, 2 * ex * ey])


def amplitudes(cos: float) -> tuple[float, float, float, float]:
    """r_s, r_p and the transmitted powers T_s, T_p by Fresnel's sine and tangent laws (Verdet's sign of r_p)."""
    incident = math.acos(min(cos, 1.0))
    if incident < 1e-6:
        r = (1 - ETA) / (1 + ETA)
        return r, -r, 1 - r * r, 1 - r * r
    refracted = math.asin(math.sin(incident) / ETA)
    minus, plus = incident - refracted, incident + refracted
    share = math.sin(2 * incident) * math.sin(2 * refracted) / math.sin(plus) ** 2
    r_p = math.tan(minus) / math.tan(plus)
    return -math.sin(minus) / math.sin(plus), r_p, share, share / math.cos(minus) ** 2


def senkrecht(propagation: Array, normal: Array) -> Array:
    """Unit vector perpendicular to the plane of incidence; any one across the beam at normal incidence."""
    s = np.cross(propagation, normal)
    return unit(s) if np.linalg.norm(s) > 1e-9 else axes(propagation, np.array([0.6, 0.64, 0.48]))[0]


def trace_specular(geometry: tuple[Array, ...], nu: float, alpha: float) -> Array:
    """Stokes vector of the field that microfacets reflect: split into s and p, multiplied by r_s, r_p, recombined."""
    n, v, light, up_camera, up_light = geometry
    xi, yi = axes(-light, up_light)
    field = math.cos(nu) * xi + math.sin(nu) * yi
    h = unit(v + light)
    s = senkrecht(-light, h)
    r_s, r_p, _, _ = amplitudes(h @ light)
    reflected = r_s * (field @ s) * s + r_p * (field @ np.cross(s, -light)) * np.cross(s, v)
    tan2 = [float(np.linalg.norm(np.cross(n, a)) / (n @ a)) ** 2 for a in (h, v, light)]
    d = alpha**2 / (math.pi * (n @ h) ** 4 * (alpha**2 + tan2[0]) ** 2)
    g = math.prod(2 / (1 + math.sqrt(1 + alpha**2 * t)) for t in tan2[1:])
    return field_stokes(reflected, *axes(v, up_camera)) * d * g / (4 * (n @ v))


def trace_diffuse(geometry: tuple[Array, ...], nu: float) -> Array:
    """Stokes vector of light that enters, loses all polarization, and leaves as two incoherent s and p fields."""
    n, v, light, up_camera, up_light = geometry
    xi, yi = axes(-light, up_light)
    field = math.cos(nu) * xi + math.sin(nu) * yi
    s = senkrecht(-light, n)
    _, _, enter_s, enter_p = amplitudes(n @ light)
    inside = enter_s * (field @ s) ** 2 + enter_p * (field @ np.cross(s, -light)) ** 2
    s = senkrecht(v, n)
    _, _, leave_s, leave_p = amplitudes(n @ v)
    x, y = axes(v, up_camera)
    out = 0.5 * leave_s * field_stokes(s, x, y) + 0.5 * leave_p * field_stokes(np.cross(s, v), x, y)
    return out * inside * (n @ light) / math.pi


def rows(geometry: Geometry) -> list[tuple[Array, ...]]:
    """The geometry point by point as NumPy vectors."""
    fields = (geometry.normal, geometry.to_camera, geometry.to_light, geometry.camera_up, geometry.light_up)
    count = max(f.shape[1] for f in fields)
    table = torch.stack([f.expand(3, count, 1)[..., 0] for f in fields]).double().numpy()
    return [tuple(table[k, :, i] for k in range(5)) for i in range(count)]


def test_specular_lobe_is_the_reflected_field(generator: torch.Generator) -> None:
    """The specular closed form equals the ray trace of the electric field on random geometries."""
    count = 300
    geometry = random_geometry(count, generator)
    nu, roughness = uniform(count, 0, math.pi, generator), uniform(count, 0.2, 0.9, generator)
    actual = stacked(specular_stokes(geometry, nu, scalar(1.7), roughness))[:, 0, :, 0]
    alphas = (roughness**2).flatten().tolist()
    traced = [trace_specular(g, a, b) for g, a, b in zip(rows(geometry), nu.flatten().tolist(), alphas, strict=True)]
    expected = 1.7 * torch.from_numpy(np.stack(traced, axis=1))
    assert_close(actual, expected, scale=expected.max().item())


def test_diffuse_lobe_is_the_transmitted_field(generator: torch.Generator) -> None:
    """The diffuse closed form equals the ray trace of the electric field on random geometries."""
    count = 300
    geometry = random_geometry(count, generator)
    nu = uniform(count, 0, math.pi, generator)
    albedo = torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64).view(3, 1, 1)
    actual = stacked(diffuse_stokes(geometry, nu, scalar(1.7), albedo))[..., 0]
    traced = np.stack([trace_diffuse(g, a) for g, a in zip(rows(geometry), nu.flatten().tolist(), strict=True)], axis=1)
    assert_close(actual, 1.7 * torch.from_numpy(traced)[:, None] * albedo[:, :, 0])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("offset", [0.0, 1e-12, 1e-9, 1e-7, 3e-6, 1e-5, 1e-4, 1e-3, 1e-2])
def test_camera_and_light_in_line(dtype: torch.dtype, offset: float, generator: torch.Generator) -> None:
    """In line and nearly so, with any two ups, both lobes are finite and those of the traced field."""
    count = 40
    g = random_geometry(count, generator, least_cosine=0.2)
    aside = normalize(cross(g.to_camera, random_directions(count, generator)))
    light = normalize(g.to_camera + offset * aside)
    typed = as_type(Geometry(g.normal, g.to_camera, light, g.camera_up, g.light_up), dtype)
    nu, roughness = uniform(count, 0, math.pi, generator), scalar(0.5)
    specular = stacked(specular_stokes(typed, nu.to(dtype), scalar(1.0).to(dtype), roughness.to(dtype)))[:, 0, :, 0]
    diffuse = stacked(diffuse_stokes(typed, nu.to(dtype), scalar(1.0).to(dtype), scalar(0.5).to(dtype)))[:, 0, :, 0]
    exact = rows(as_type(typed, torch.float64))
    for actual, traced in (
        (specular, [trace_specular(e, a, 0.25) for e, a in zip(exact, nu.flatten().tolist(), strict=True)]),
        (diffuse, [0.5 * trace_diffuse(e, a) for e, a in zip(exact, nu.flatten().tolist(), strict=True)]),
    ):
        assert_finite(actual)
        expected = torch.from_numpy(np.stack(traced, axis=1))
        # The trace's own plane of incidence is only as sharp as rounding over the offset; its error enters squared.
        torch.testing.assert_close(actual.double(), expected, rtol=0, atol=4 * ROUNDING[dtype] + 1e-9)


def test_reflection_straight_back_keeps_the_direction_of_the_field(generator: torch.Generator) -> None:
    """Light that returns along its own path vibrates along the same line in space, whatever the two ups."""
    count = 100
    g = random_geometry(count, generator)
    in_line = Geometry(g.to_camera, g.to_camera, g.to_camera, g.camera_up, g.light_up)
    nu = uniform(count, 0, math.pi, generator)
    light, camera = beam_frame(-g.to_camera, g.light_up), beam_frame(g.to_camera, g.camera_up)
    field = torch.cos(nu) * light.x + torch.sin(nu) * light.y
    azimuth = torch.atan2(dot(field, camera.y), dot(field, camera.x))
    specular = specular_stokes(in_line, nu, scalar(1.0), scalar(0.3))
    assert_same_angle(aolp(specular), azimuth, ROUNDING[torch.float64])


# ------------------------------------------------------------------------------------------ other formulas, reference


def azimuth(v: Tensor, beam: Beam) -> Tensor:
    return torch.atan2(dot(v, beam.y), dot(v, beam.x))[0, :, 0]


def matrix_of(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def mueller_rotator(angle: Tensor) -> Tensor:
    """C(t) ``[..., 4, 4]``: turns the frame of a Stokes vector by ``+angle`` [rad]. Source: Baek et al. 2018."""
    c, s, zero, one = torch.cos(2 * angle), torch.sin(2 * angle), torch.zeros_like(angle), torch.ones_like(angle)
    return matrix_of([[one, zero, zero, zero], [zero, c, s, zero], [zero, -s, c, zero], [zero, zero, zero, one]])


def mueller_reflection(f: Fresnel) -> Tensor:
    """Fresnel reflection ``[..., 4, 4]`` in the frame whose x axis is s (perpendicular to the plane of incidence)."""
    plus, minus, cross, zero = f.r_plus, f.r_minus, f.r_cross, torch.zeros_like(f.r_plus)
    linear = [[plus, minus, zero, zero], [minus, plus, zero, zero]]
    return matrix_of([*linear, [zero, zero, cross, zero], [zero, zero, zero, cross]])


def mueller_diffuse(out: Fresnel, into: Fresnel) -> Tensor:
    """Transmission in, complete depolarization, transmission out: ``[..., 4, 4]`` in the s frames of both beams."""
    zero = torch.zeros_like(out.t_plus)
    rows = [[t * into.t_plus, t * into.t_minus, zero, zero] for t in (out.t_plus, out.t_minus)]
    return matrix_of([*rows, [zero] * 4, [zero] * 4])


def through_mueller(matrix: Tensor, g: Geometry, facet: Tensor, nu: Tensor) -> Tensor:
    """Stokes vectors [4, N] of polarized light of intensity 1 behind C(-(az_o + pi/2)) F C(az_i + pi/2)."""
    camera, light = beam_frame(g.to_camera, g.camera_up), beam_frame(-g.to_light, g.light_up)
    turn_in = mueller_rotator(azimuth(facet, light) + math.pi / 2)
    turn_out = mueller_rotator(-(azimuth(facet, camera) + math.pi / 2))
    t = nu[0, :, 0]
    incident = torch.stack([torch.ones_like(t), torch.cos(2 * t), torch.sin(2 * t), torch.zeros_like(t)], dim=-1)
    return (turn_out @ matrix @ turn_in @ incident[..., None])[..., 0].T


def test_closed_forms_are_the_mueller_product(generator: torch.Generator) -> None:
    """Rotators and the Fresnel matrices of both lobes multiply out to the closed forms, and s3 stays 0."""
    count = 300
    g = random_geometry(count, generator)
    nu = uniform(count, 0, math.pi, generator)
    h = normalize(g.to_camera + g.to_light)
    alpha = scalar(0.3)
    into, out = fresnel(dot(g.normal, g.to_light)[0, :, 0]), fresnel(dot(g.normal, g.to_camera)[0, :, 0])
    diffuse = through_mueller(mueller_diffuse(out, into), g, g.normal, nu)
    specular = through_mueller(mueller_reflection(fresnel(dot(h, g.to_light)[0, :, 0])), g, h, nu)
    cos_i, cos_o = dot(g.normal, g.to_light), dot(g.normal, g.to_camera)
    lobe = ggx_distribution(g.normal, h, alpha) * smith_shadowing(cos_i, alpha) * smith_shadowing(cos_o, alpha)
    lobe = lobe / (4 * cos_o)
    expected = diffuse * (cos_i / math.pi)[0, :, 0]
    assert_close(stacked(diffuse_stokes(g, nu, scalar(1.0), scalar(1.0)))[:, 0, :, 0], expected[:3])
    expected = specular * lobe[0, :, 0]
    actual = stacked(specular_stokes(g, nu, scalar(1.0), scalar(0.3**0.5)))[:, 0, :, 0]
    assert_close(actual, expected[:3], scale=expected.max().item())
    assert_close(torch.stack([diffuse[3], specular[3]]), torch.zeros(2, count, dtype=torch.float64))


@pytest.fixture(scope="module")
def reference(shared: Path) -> Any:
    """The independent float64 reference implementation, loaded by its path."""
    path = shared / "reference" / "pbrdf.py"
    if not path.is_file():
        pytest.skip(f"no reference implementation at {path}")
    module_spec = importlib.util.spec_from_file_location("reference_pbrdf", path)
    assert module_spec is not None and module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    module_spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("dtype", DTYPES)
def test_lobes_agree_with_the_reference(dtype: torch.dtype, reference: Any, generator: torch.Generator) -> None:
    """Both lobes equal the external reference on random geometries, front and back, relative to their peak."""
    count = 2000
    front = random_geometry(count, generator)
    light = torch.where(uniform(count, 0, 1, generator) < 0.1, -front.to_light, front.to_light)
    g = Geometry(front.normal, front.to_camera, light, front.camera_up, front.light_up)
    nu, roughness = uniform(count, 0, math.pi, generator), uniform(count, 0.2, 0.9, generator)
    albedo = torch.rand(3, count, 1, generator=generator, dtype=torch.float64)
    typed, angle = as_type(g, dtype), nu.to(dtype)
    fields = (g.normal, g.to_camera, g.to_light, g.camera_up, g.light_up)
    arrays = [f[..., 0].T.numpy() for f in fields]
    diffuse, specular = reference.shade(
        *arrays, nu[0, :, 0].numpy(), albedo[..., 0].T.numpy(), np.ones((count, 1)), (roughness**2)[0].numpy(), E=2.0
    )
    irradiance = scalar(2.0).to(dtype)
    for stokes, expected in (
        (diffuse_stokes(typed, angle, irradiance, albedo.to(dtype)), diffuse),
        (specular_stokes(typed, angle, irradiance, roughness.to(dtype)), specular),
    ):
        target = torch.from_numpy(expected).permute(1, 2, 0)
        assert_close(stacked(stokes)[..., 0], target, scale=target.abs().max().item())


# -------------------------------------------------------------------------------------------------------- laws of both


@pytest.mark.parametrize("degrees", [0, 20, 45, 90, 130])
def test_facing_camera_and_light(degrees: float) -> None:
    """n = v = l: the diffuse is 0.9216 and unpolarized, the specular 0.04 (1, cos 2nu, -sin 2nu)."""
    z, up, nu = vector(0, 0, 1), vector(0, 1, 0), math.radians(degrees)
    g = Geometry(z, z, z, up, up)
    diffuse = stacked(diffuse_stokes(g, scalar(nu), scalar(math.pi), scalar(1.0))).flatten()
    assert_close(diffuse, [0.9216, 0.0, 0.0])
    specular = stacked(specular_stokes(g, scalar(nu), scalar(4 * math.pi), scalar(1.0))).flatten()
    assert_close(specular, [0.04, 0.04 * math.cos(2 * nu), -0.04 * math.sin(2 * nu)])


@pytest.mark.parametrize("dtype", DTYPES)
def test_specular_is_fully_polarized(dtype: torch.dtype, generator: torch.Generator) -> None:
    """s1^2 + s2^2 = s0^2 for every geometry and roughness."""
    g = as_type(random_geometry(1000, generator), dtype)
    specular = specular_stokes(
        g, uniform(1000, 0, 3, generator).to(dtype), scalar(1.0).to(dtype), scalar(0.3).to(dtype)
    )
    assert_close(polarized_intensity(specular), specular.s0, scale=specular.s0.max().item())


def test_diffuse_polarization_depends_on_the_exit_alone(generator: torch.Generator) -> None:
    """DoLP is that of the exit angle and AoLP the normal's azimuth, whatever light, polarizer and albedo."""
    g = random_geometry(500, generator)
    diffuse = diffuse_stokes(g, uniform(500, 0, 3, generator), scalar(3.0), uniform(500, 0.1, 1, generator))
    assert_close(dolp(diffuse), diffuse_dolp(dot(g.normal, g.to_camera)), scale=10)
    expected = azimuth(g.normal, beam_frame(g.to_camera, g.camera_up))
    weight = dolp(diffuse)[0, :, 0]
    assert_close(weight * torch.cos(2 * (aolp(diffuse)[0, :, 0] - expected)), weight, scale=10)


def test_diffuse_of_a_sphere_is_radial() -> None:
    """Seen from afar, the diffuse AoLP of a sphere points from its centre in the image (rows grow down)."""
    size = 16
    rows_down, cols = torch.meshgrid(*[torch.arange(size, dtype=torch.float64) - 7.3] * 2, indexing="ij")
    x, y = cols / 13, -rows_down / 13
    normal = torch.stack([x, y, torch.sqrt(1 - x**2 - y**2)])
    g = Geometry(normal, vector(0, 0, 1), vector(0.2, 0.5, 1), vector(0, 1, 0), vector(0, 1, 0))
    diffuse = diffuse_stokes(g, scalar(0.5), scalar(1.0), scalar(1.0))
    assert_same_angle(aolp(diffuse)[0], torch.atan2(-rows_down, cols), 100 * ROUNDING[torch.float64])


def test_lobes_do_not_depend_on_the_choice_of_world_axes(generator: torch.Generator) -> None:
    """Turning surface, camera, light and both ups together changes nothing that the camera measures."""
    g = random_geometry(100, generator)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    turn = turn * torch.linalg.det(turn)
    fields = (g.normal, g.to_camera, g.to_light, g.camera_up, g.light_up)
    turned = Geometry(*(torch.einsum("ij,jnw->inw", turn, f) for f in fields))
    nu = uniform(100, 0, 3, generator)
    for lobe, extra in ((diffuse_stokes, scalar(0.7)), (specular_stokes, scalar(0.5))):
        expected = stacked(lobe(g, nu, scalar(1.0), extra))
        assert_close(stacked(lobe(turned, nu, scalar(1.0), extra)), expected, scale=expected.max().item())


def test_turning_polarizer_and_light_up_together_changes_nothing(generator: torch.Generator) -> None:
    """Only the direction of the light's field in space counts, not the frame that its angle is measured in."""
    g = random_geometry(100, generator)
    nu, delta = uniform(100, 0, 3, generator), 0.6
    beam = beam_frame(-g.to_light, g.light_up)
    # The frame is turned by +delta, so the same field has the angle nu - delta in it.
    up = math.cos(delta) * beam.y - math.sin(delta) * beam.x
    turned = Geometry(g.normal, g.to_camera, g.to_light, g.camera_up, up)
    for lobe, extra in ((diffuse_stokes, scalar(0.7)), (specular_stokes, scalar(0.5))):
        expected = stacked(lobe(g, nu, scalar(1.0), extra))
        assert_close(stacked(lobe(turned, nu - delta, scalar(1.0), extra)), expected, scale=expected.max().item())


def unpolarized(lobe: Callable[..., Stokes], g: Geometry, extra: Tensor) -> Tensor:
    """Radiance s0 under unpolarized light of irradiance 1: the mean over two crossed polarizers."""
    return (lobe(g, scalar(0.3), scalar(1.0), extra).s0 + lobe(g, scalar(0.3 + math.pi / 2), scalar(1.0), extra).s0) / 2


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_reciprocity(lobe: Callable[..., Stokes], generator: torch.Generator) -> None:
    """For unpolarized light the BRDF is the same with camera and light exchanged."""
    g = random_geometry(500, generator, least_cosine=0.05)
    back = Geometry(g.normal, g.to_light, g.to_camera, g.light_up, g.camera_up)
    forward = unpolarized(lobe, g, scalar(0.5)) / dot(g.normal, g.to_light)
    backward = unpolarized(lobe, back, scalar(0.5)) / dot(g.normal, g.to_camera)
    assert_close(backward, forward, scale=forward.max().item())


@pytest.mark.parametrize("degrees", [0, 30, 60, 80])
@pytest.mark.parametrize("roughness", [0.3, 0.7])
def test_a_white_surface_reflects_no_more_than_it_receives(degrees: float, roughness: float) -> None:
    """In a uniform unpolarized surround both lobes together send at most the surround's radiance to the camera."""
    rings, sectors = 300, 60
    cos = (torch.arange(rings, dtype=torch.float64) + 0.5) / rings
    phi = 2 * math.pi * (torch.arange(sectors, dtype=torch.float64) + 0.5) / sectors
    sin = torch.sqrt(1 - cos**2)[:, None]
    light = torch.stack(torch.broadcast_tensors(sin * phi.cos(), sin * phi.sin(), cos[:, None]))
    camera = vector(math.sin(math.radians(degrees)), 0, math.cos(math.radians(degrees)))
    g = Geometry(vector(0, 0, 1), camera, light, vector(0, 1, 0), vector(0.1, 1, 0.2))
    radiance = unpolarized(diffuse_stokes, g, scalar(1.0)) + unpolarized(specular_stokes, g, scalar(roughness))
    total = radiance.mean().item() * 2 * math.pi
    assert 0.5 < total <= 1 + QUADRATURE


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
@pytest.mark.parametrize("dtype", DTYPES)
def test_nothing_from_behind(lobe: Callable[..., Stokes], dtype: torch.dtype) -> None:
    """A surface that camera or light see from behind or edge-on is black, without NaN."""
    z, side, back, up = (v.to(dtype) for v in (vector(0, 0, 1), vector(1, 0, 0), vector(0.3, 0, -1), vector(0, 1, 0)))
    for camera, light in ((z, back), (back, z), (side, z), (z, side), (back, back)):
        stokes = lobe(Geometry(z, camera, light, up, up), *(scalar(a).to(dtype) for a in (0.3, 1.0, 0.5)))
        assert torch.equal(stacked(stokes), torch.zeros(3, 1, 1, 1, dtype=dtype))


@pytest.mark.parametrize("dtype", DTYPES)
def test_light_exactly_behind_the_surface(dtype: torch.dtype) -> None:
    """A light that the camera would see straight through the surface lights nothing, without NaN."""
    z, camera, up = (v.to(dtype) for v in (vector(0, 0, 1), vector(0.3, 0, 1), vector(0, 1, 0)))
    settings = (scalar(a).to(dtype) for a in (0.3, 1.0, 0.5))
    stokes = specular_stokes(Geometry(z, camera, -camera, up, up), *settings)
    assert torch.equal(stacked(stokes), torch.zeros(3, 1, 1, 1, dtype=dtype))


# -------------------------------------------------------------------------------------------------------- derivatives


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_gradients_are_right(lobe: Callable[..., Stokes], generator: torch.Generator) -> None:
    """Derivatives by normal, polarizer, irradiance and albedo or roughness agree with finite differences."""
    g = random_geometry(4, generator, least_cosine=0.3)

    def shade(normal: Tensor, *rest: Tensor) -> Tensor:
        return stacked(lobe(Geometry(normalize(normal), g.to_camera, g.to_light, g.camera_up, g.light_up), *rest))

    inputs = (g.normal.clone(), scalar(0.4), scalar(1.2), scalar(0.5))
    torch.autograd.gradcheck(shade, [i.requires_grad_() for i in inputs], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
@pytest.mark.parametrize("dtype", DTYPES)
def test_gradients_are_finite_at_special_points(lobe: Callable[..., Stokes], dtype: torch.dtype) -> None:
    """No derivative is NaN where camera, light and normal are in line, edge-on, or face away."""
    z, side, back = vector(0, 0, 1), vector(1, 0, 0), vector(0.3, 0, -1)
    cases = [(z, z, z), (z, vector(0.3, 0, 1), vector(0.3, 0, 1)), (z, side, z), (z, z, side), (z, back, z)]
    cases += [(z, z, back), (z, vector(0.3, 0.1, 1), vector(-0.3, -0.1, 1)), (z, vector(1, 0, 1e-6), vector(-1, 0, 1))]
    for normal, camera, light in cases:
        directions = [v.to(dtype).clone().requires_grad_() for v in (normal, camera, light)]
        up = vector(0, 1, 0).to(dtype)
        rest = [scalar(a).to(dtype).clone().requires_grad_() for a in (0.3, 1.0, 0.5)]
        stokes = stacked(lobe(Geometry(*directions, up, up), *rest))
        assert_finite(stokes, *torch.autograd.grad(stokes.square().sum(), [*directions, *rest]))


def test_zero_vectors_stay_zero_with_finite_gradients() -> None:
    """Normalizing a zero vector gives zero and a finite derivative, in either precision."""
    for dtype in DTYPES:
        v = torch.zeros(3, 1, 1, dtype=dtype, requires_grad=True)
        unit_vector = normalize(v)
        assert torch.equal(unit_vector, torch.zeros_like(unit_vector))
        assert_finite(*torch.autograd.grad(unit_vector.sum(), v))


# --------------------------------------------------------------------------------------------------------- rotators


@given(a=st.floats(-4, 4), b=st.floats(-4, 4))
def test_rotators_add_angles(a: float, b: float) -> None:
    """Turning a frame by a and then by b is turning it by a + b, and half a turn is none."""
    first, second = (mueller_rotator(torch.tensor(t, dtype=torch.float64)) for t in (a, b))
    assert_close(second @ first, mueller_rotator(torch.tensor(a + b, dtype=torch.float64)))
    assert_close(mueller_rotator(torch.tensor(a + math.pi, dtype=torch.float64)), first)
    assert_close(first[1:3, 1:3] @ torch.tensor([math.cos(2 * a), math.sin(2 * a)], dtype=torch.float64), [1.0, 0.0])


# ---------------------------------------------------------------------------------------- reciprocity of the matrix


def mueller(lobe: Callable[..., Stokes], g: Geometry, extra: Tensor) -> Tensor:
    """The matrix ``[3, 3, N]`` from linear light to linear light, per irradiance perpendicular to the surface.

    Its columns come from light behind polarizers at 0, 45 and 90 degrees: (1, 1, 0), (1, 0, 1) and (1, -1, 0).
    """
    along, diagonal, across = (
        torch.stack([s.s0, s.s1, s.s2])[:, 0, :, 0] / dot(g.normal, g.to_light)[0, :, 0]
        for s in (lobe(g, scalar(t), scalar(1.0), extra) for t in (0.0, math.pi / 4, math.pi / 2))
    )
    unpolarized = (along + across) / 2
    return torch.stack([unpolarized, (along - across) / 2, diagonal - unpolarized], dim=1)


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_exchanged_camera_and_light_transpose_the_matrix(
    lobe: Callable[..., Stokes], generator: torch.Generator
) -> None:
    """M back = F M^T F: the x axis of a beam's frame turns round with the beam, so F = diag(1, 1, -1).

    Source: van de Hulst 1957, Light Scattering by Small Particles, 5.22; de Hoop 1960.
    """
    g = random_geometry(400, generator)
    back = Geometry(g.normal, g.to_light, g.to_camera, g.light_up, g.camera_up)
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    there, again = mueller(lobe, g, scalar(0.6)), mueller(lobe, back, scalar(0.6))
    expected = torch.einsum("ij,kjn,kl->iln", flip, there, flip)
    assert float((there - there.transpose(0, 1)).abs().max()) > 1e-3
    assert_close(again, expected, scale=float(there.abs().max()))


@pytest.mark.parametrize("lobe", [diffuse_stokes, specular_stokes])
def test_no_light_is_polarized_beyond_its_power(lobe: Callable[..., Stokes], generator: torch.Generator) -> None:
    """Every linear state goes in, and what comes out has a DoLP of at most 1 and a power not below 0."""
    matrix = mueller(lobe, random_geometry(400, generator), scalar(0.6))
    angles = torch.linspace(0, 2 * math.pi, 13, dtype=torch.float64)
    for degree in (0.0, 0.5, 1.0):
        light = torch.stack([torch.ones_like(angles), degree * angles.cos(), degree * angles.sin()])
        s0, s1, s2 = torch.einsum("ijn,jk->ikn", matrix, light)
        assert float(s0.min()) >= -1e-12
        assert bool((torch.hypot(s1, s2) <= s0 + 1e-12 * float(s0.max())).all())
