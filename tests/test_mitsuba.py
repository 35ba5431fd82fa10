"""Both lobes equal Mitsuba's polarized plastic, evaluated direction by direction without any sampling noise."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tolerances import MITSUBA, assert_within
from torch import Tensor

from polsep.physics.fresnel import ETA
from polsep.physics.optics import Geometry, beam_frame, diffuse_stokes, dot, normalize, specular_stokes

mi = pytest.importorskip("mitsuba")

VARIANT = "scalar_spectral_polarized"
if VARIANT not in mi.variants():
    pytest.skip(f"this Mitsuba has no {VARIANT}", allow_module_level=True)
POLARIZERS = (0.0, 0.4, 1.1, 2.0)
Array = NDArray[np.float64]


@pytest.fixture(scope="module", autouse=True)
def _variant() -> None:
    mi.set_variant(VARIANT)


def plastic(roughness: float, albedo: float, specular: float) -> Any:
    """Mitsuba's polarized plastic with GGX microfacets of alpha = roughness^2 in air."""
    return mi.load_dict(
        {
            "type": "pplastic",
            "distribution": "ggx",
            "alpha": roughness**2,
            "int_ior": ETA,
            "ext_ior": 1.0,
            "diffuse_reflectance": {"type": "uniform", "value": albedo},
            "specular_reflectance": {"type": "uniform", "value": specular},
        }
    )


def mueller_elements(bsdf: Any, g: dict[str, Array]) -> Array:
    """Mueller matrix [4, 4] (cosine included) from the light's to the camera's frame, for a normal along +z.

    `eval` works in the local frame; Stokes vectors in and out are in Mitsuba's bases of both propagation directions,
    and its light beam travels against the direction to the light.
    """
    camera, light = (mi.Vector3f(*g[k]) for k in ("to_camera", "to_light"))
    interaction = mi.SurfaceInteraction3f()
    interaction.wi = camera
    interaction.wavelengths = [500.0, 500.0, 500.0, 500.0]
    matrix = bsdf.eval(mi.BSDFContext(), interaction, light)
    basis = mi.mueller.stokes_basis
    turned = mi.mueller.rotate_mueller_basis(
        matrix, -light, basis(-light), mi.Vector3f(*g["light_x"]), camera, basis(camera), mi.Vector3f(*g["camera_x"])
    )
    return np.array(turned, dtype=np.float64)[..., 0]


def random_points(count: int, generator: torch.Generator) -> Geometry:
    """Random cameras, lights and ups above a surface whose normal is +z."""

    def directions() -> Tensor:
        return normalize(torch.randn(3, count, 1, generator=generator, dtype=torch.float64))

    def above() -> Tensor:
        d = directions()
        return normalize(torch.cat([d[:2], d[2:].abs() + 0.05]))

    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).view(3, 1, 1).expand(3, count, 1)
    return Geometry(normal, above(), above(), directions(), directions())


def turned(g: Geometry, generator: torch.Generator) -> Geometry:
    """The same geometry in other world axes, so that the normal is no special direction for us."""
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))
    rotation = rotation * torch.linalg.det(rotation)
    fields = (g.normal, g.to_camera, g.to_light, g.camera_up, g.light_up)
    return Geometry(*(torch.einsum("ij,jnw->inw", rotation, f) for f in fields))


def mitsuba_stokes(bsdf: Any, g: Geometry) -> Tensor:
    """Stokes vectors [polarizers, 3, N] of light of irradiance 1 behind each of the polarizers."""
    camera, light = beam_frame(g.to_camera, g.camera_up), beam_frame(-g.to_light, g.light_up)
    fields = {"to_camera": g.to_camera, "to_light": g.to_light, "camera_x": camera.x, "light_x": light.x}
    arrays = {k: f[..., 0].numpy() for k, f in fields.items()}
    incident = np.array([[1, math.cos(2 * t), math.sin(2 * t), 0] for t in POLARIZERS])
    points = range(g.normal.shape[1])
    matrices = np.stack([mueller_elements(bsdf, {k: a[:, i] for k, a in arrays.items()}) for i in points])
    return torch.from_numpy(np.einsum("nij,pj->pin", matrices, incident))[:, :3]


def our_stokes(g: Geometry, roughness: float, albedo: float, specular: float) -> Tensor:
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    result = []
    for angle in POLARIZERS:
        light = diffuse_stokes(g, angle * one, one, albedo * one)
        light = light + specular_stokes(g, angle * one, one, roughness * one) * specular
        result.append(torch.stack([light.s0, light.s1, light.s2])[:, 0, :, 0])
    return torch.stack(result)


@pytest.mark.parametrize(
    ("roughness", "albedo", "specular"),
    [(0.3, 0.7, 0.0), (0.3, 0.0, 1.0), (0.2, 0.0, 1.0), (0.5, 0.0, 0.6), (0.7, 0.4, 1.0)],
)
def test_lobes_agree_with_mitsuba(roughness: float, albedo: float, specular: float, generator: torch.Generator) -> None:
    """Diffuse, specular and their sum equal Mitsuba's Mueller matrix on random geometries and polarizers."""
    g = random_points(150, generator)
    expected = mitsuba_stokes(plastic(roughness, albedo, specular), g)
    peak = expected.abs().max().item()
    actual = our_stokes(turned(g, generator), roughness, albedo, specular)
    assert_within(actual / peak, expected / peak, MITSUBA)


def test_highlights_agree_with_mitsuba(generator: torch.Generator) -> None:
    """Near the mirror direction, where the lobe is steep, all Stokes components agree relative to the highlight."""
    g = random_points(150, generator)
    mirror = 2 * dot(g.normal, g.to_camera) * g.normal - g.to_camera
    light = normalize(mirror + 0.05 * g.light_up)
    light = torch.cat([light[:2], light[2:].abs()])
    near = Geometry(g.normal, g.to_camera, light, g.camera_up, g.light_up.roll(1, dims=1))
    expected = mitsuba_stokes(plastic(0.4, 0.0, 1.0), near)
    peak = expected[:, :1].amax(dim=0, keepdim=True)
    actual = our_stokes(turned(near, generator), 0.4, 0.0, 1.0)
    assert_within(actual / peak, expected / peak, 10 * MITSUBA)
