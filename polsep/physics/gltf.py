"""The shading of game engines and of glTF viewers, without polarization: GGX and a diffuse body. NumPy or torch.

GGX, Smith with k = alpha / 2, Schlick by a power of two, diffuse (1 - specular) / pi; roughness r is GGX alpha = r^2.
Source: Karis 2013; Deschaintre et al. 2018, doi:10.1145/3197517.3201378. Note: a part of the energy that `optics` has
is missing: relit pictures compare surfaces, they do not predict frames.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from polsep.compute.arrays import Array, namespace

#: Exponents of Schlick's term as a power of two (Karis 2013).
SCHLICK = (-5.55473, -6.98316)
#: Least roughness and cosine of the shading.
MIN_ROUGHNESS, MIN_COSINE = 0.03, 1e-3
#: Largest mean reflectance at normal incidence of dielectrics, and least of metals: gems reach 0.17, iron has 0.56.
DIELECTRICS, METALS = 0.2, 0.32
#: Reflectance at normal incidence of a dielectric of index 1.5: ((1.5 - 1) / (1.5 + 1))^2.
GLASS = 0.04


class Coat(NamedTuple):
    """A surface: unit ``normal``, ``diffuse`` and ``specular`` ``[..., 3, H, W]``, ``roughness [..., 1, H, W]``.

    ``specular`` is the reflectance at normal incidence, 0.04 for glass.
    """

    normal: Array
    diffuse: Array
    roughness: Array
    specular: Array


def reflect(coat: Coat, to_camera: Array, to_light: Array) -> Array:
    """The BRDF times the light's cosine for unit directions, all ``[..., 3, H, W]``; 0 behind the surface.

    Times pi it is the radiance under a light by which white paper shows 1.
    """
    xp = namespace(coat.normal)
    half = to_camera + to_light
    half = half / xp.sqrt(_dot(half, half)).clip(1e-12, None)
    lit, seen = _dot(coat.normal, to_light), _dot(coat.normal, to_camera)
    front = xp.where((lit > 0) & (seen > 0), 1.0 + 0 * lit, 0 * lit)
    lit, seen = lit.clip(MIN_COSINE, 1), seen.clip(MIN_COSINE, 1)
    vh, nh = _dot(to_camera, half).clip(0, 1), _dot(coat.normal, half).clip(0, 1)
    alpha = coat.roughness.clip(MIN_ROUGHNESS, None) ** 2
    alpha2 = alpha * alpha
    spread = 1 - nh * nh + nh * nh * alpha2
    k = alpha / 2
    smith = (lit * (1 - k) + k) * (seen * (1 - k) + k)
    fresnel = coat.specular + (1 - coat.specular) * xp.exp2((SCHLICK[0] * vh + SCHLICK[1]) * vh)
    lobe = alpha2 / (4 * math.pi * spread * spread * smith)
    return front * lit * (fresnel * lobe + (1 - coat.specular) * coat.diffuse / math.pi)


def metalness(specular: Array) -> Array:
    """The share ``[..., 1, H, W]`` of metal in pixels of reflectances ``[..., 3, H, W]`` at normal incidence.

    0 up to `DIELECTRICS`, 1 from `METALS` on; between them pixels hold both.
    """
    mean = namespace(specular).mean(specular, axis=-3, keepdims=True)
    return ((mean - DIELECTRICS) / (METALS - DIELECTRICS)).clip(0, 1)


def _dot(a: Array, b: Array) -> Array:
    return namespace(a).sum(a * b, axis=-3, keepdims=True)
