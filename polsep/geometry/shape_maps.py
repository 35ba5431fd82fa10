"""Maps that a network sees of one frame to find a surface, and what its outputs mean. NumPy arrays or torch tensors.

Images ``[..., C, h, w]`` at half resolution under a lamp whose colour was divided out. What is seen does not depend on
the exposure: images are logarithms relative to the mean of the object. Polarization turns with the image: it is given
as (s1, s2), never as an angle. Three inputs exist, of the same frame:

* "separated": diffuse and specular image; the polarization of their sum; that of the diffuse light alone, from which
  the lamp's highlights, which have one AoLP, are subtracted; and, as Fresnel's equations say, the projected normal
  that it means, at twice its azimuth, since azimuths are known up to half a turn (Atkinson and Hancock 2006).
* "stokes": s0, s1 and s2 of every colour as measured, and the projected normal that their polarization would mean.
* "rgb": s0 alone, as an ordinary camera sees it.

All get the object's mask and the direction toward the lamp, where it is known.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from polsep.compute.arrays import Array, namespace
from polsep.physics.fresnel import diffuse_dolp
from polsep.physics.gltf import GLASS, Coat, reflect

#: Inputs, and their numbers of maps.
INPUTS = {"separated": 18, "stokes": 18, "rgb": 8}
#: Added to images, relative to the object's mean, before their logarithm, and to those that divide.
FLOOR, LEAST = 0.05, 0.05
#: Light [white level] added before the object's mean is taken.
DARK = 1e-3
#: Factor on polarization, which is small.
GAIN = 4.0
#: Steps of the table of zeniths over the diffuse DoLP.
STEPS = 512
#: Outputs: normal x, y, z before scaling; logarithms of the variance of its error [rad^2], of albedo over the seen
#: image, of roughness and its variance, of the specular strength and its variance.
USUAL = (0.0, 0.0, 0.5, -2.5, 0.3, 0.3, 0.3, -0.9, -1.5, -0.5, -0.5)
#: The output that is the logarithm of the variance of the normal's error.
NORMAL_VARIANCE = 3
#: Range of logarithms of variances, and of other logarithms.
LOG_VARIANCES, LOGARITHMS = (-9.0, 2.0), (-6.0, 6.0)


class Seen(NamedTuple):
    """Images of one frame for an input; those that another input needs may be None.

    ``image [3]``: diffuse, or s0; ``specular [1]``; ``polarized [2 C]``: s1 of C colours, then s2; ``error [1]``:
    deviation of the diffuse image, in its unit; ``mask [1]``; ``light [3]``: toward the lamp, or zeros.
    """

    image: Array
    specular: Array | None
    polarized: Array | None
    error: Array | None
    mask: Array
    light: Array


class Surface(NamedTuple):
    """Maps of a surface: unit ``normal [3]``, x right, y up, z to the camera; relative ``albedo [3]``; ``roughness``
    and ``specular [1]``, the strength of its reflections over a dielectric's; the deviations of ``normal_error`` [rad],
    and of the logarithms of the last two."""

    normal: Array
    albedo: Array
    roughness: Array
    specular: Array
    normal_error: Array
    roughness_error: Array
    specular_error: Array


def object_level(image: Array, mask: Array) -> Array:
    """The geometric mean of an image's light over the mask, ``[..., 1, 1, 1]``."""
    xp = namespace(image)
    light = xp.log(xp.mean(image, axis=-3, keepdims=True).clip(0, None) + DARK) * mask
    count = xp.sum(mask, axis=(-3, -2, -1), keepdims=True).clip(1, None)
    return xp.exp(xp.sum(light, axis=(-3, -2, -1), keepdims=True) / count)


def lamp_direction(polarized: Array, weight: Array) -> tuple[Array, Array]:
    """(cos, sin) of twice the AoLP that most polarized light has ``[..., 2, 1, 1]``, and its concentration from 0 to 1.

    The direction is a unit vector; it means nothing where the concentration is near 0.
    """
    xp = namespace(polarized)

    def length(x: Array) -> Array:
        return xp.sqrt(xp.sum(x * x, axis=-3, keepdims=True))

    total = xp.sum(polarized * weight, axis=(-2, -1), keepdims=True)
    power = xp.sum(length(polarized) * weight, axis=(-2, -1), keepdims=True)
    return total / length(total).clip(1e-9, None), length(total) / power.clip(1e-9, None)


def projected_normal(polarization: Array) -> Array:
    """The projection of the normal at twice its azimuth ``[..., 2, h, w]``, of diffuse polarization (s1, s2) / s0.

    sin(zenith) (cos 2 azimuth, sin 2 azimuth) for a dielectric of index 1.5 (`fresnel.diffuse_dolp`).
    """
    xp = namespace(polarization)
    strength = xp.sqrt(xp.sum(polarization * polarization, axis=-3, keepdims=True))
    table = _sines(polarization)
    place = (xp.sqrt(strength) * (STEPS - 1)).clip(0, STEPS - 1)
    below = xp.floor(place).clip(0, STEPS - 2)
    first = _integers(below)
    sine = table[first] + (place - below) * (table[first + 1] - table[first])
    return polarization * (sine / strength.clip(1e-6, None))


def _integers(x: Array) -> Array:
    return x.astype(np.int64) if isinstance(x, np.ndarray) else x.long()


def _sines(like: Array) -> Array:
    """Sines of zeniths at evenly spaced roots of diffuse DoLPs from 0 to 1; 1 beyond the largest DoLP."""
    zeniths = np.linspace(0, math.radians(89.5), 2000)
    sines = np.interp(np.linspace(0, 1, STEPS) ** 2, diffuse_dolp(np.cos(zeniths)), np.sin(zeniths)).astype(np.float32)
    if isinstance(like, np.ndarray):
        return sines
    import torch

    return torch.from_numpy(sines).to(like.device)


def encode(seen: Seen, name: str) -> Array:
    """The maps ``[..., INPUTS[name], h, w]`` of an input; 0 outside the mask."""
    xp, mask = namespace(seen.image), seen.mask
    level = object_level(seen.image if seen.specular is None else seen.image + seen.specular, mask)
    image = seen.image.clip(0, None) / level
    grey = xp.mean(image, axis=-3, keepdims=True)
    known = xp.sum(seen.light * seen.light, axis=-3, keepdims=True).clip(0, 1)
    shape = (*mask.shape[:-3], 1, *mask.shape[-2:])
    parts = [xp.log(image + FLOOR)]
    if name == "separated":
        assert seen.specular is not None and seen.polarized is not None and seen.error is not None
        specular, polarized = seen.specular.clip(0, None) / level, seen.polarized / level
        lamp, sure = lamp_direction(polarized, specular * mask)
        left = (polarized - specular * lamp) / (grey + LEAST)
        uncertainty = xp.log((seen.error / level) / (grey + LEAST) + 1e-3)
        parts += [xp.log(specular + FLOOR), _limited(polarized / (grey + specular + LEAST)), _limited(left)]
        parts += [projected_normal(left), lamp * sure + 0 * grey, uncertainty]
    elif name == "stokes":
        assert seen.polarized is not None
        polarized = seen.polarized / level
        half = polarized.shape[-3] // 2
        first, second = (polarized[..., part, :, :] for part in (slice(None, half), slice(half, None)))
        mean = xp.concat([xp.mean(x, axis=-3, keepdims=True) for x in (first, second)], axis=-3)
        strength = xp.sqrt(xp.sum(mean * mean, axis=-3, keepdims=True))
        lamp, sure = lamp_direction(mean, strength * mask)
        parts += [_limited(x / (image + LEAST)) for x in (first, second)]
        parts += [projected_normal(mean / (grey + LEAST)), lamp * sure + 0 * grey]
    parts += [xp.broadcast_to(known, shape), xp.broadcast_to(seen.light, (*shape[:-3], 3, *shape[-2:]))]
    return xp.concat([xp.concat(parts, axis=-3) * mask, mask], axis=-3)


def _limited(polarization: Array) -> Array:
    """Polarization times `GAIN`, limited to +-2."""
    return (GAIN * polarization).clip(-2, 2)


def decode(outputs: Array, image: Array, mask: Array) -> Surface:
    """The surface that outputs ``[..., len(USUAL), h, w]`` mean; ``image [..., 3, h, w]``: the one that was seen.

    Albedo is relative to that of the object's mean level.
    """
    xp = namespace(outputs)
    level = object_level(image, mask)
    x, y, z = (outputs[..., k : k + 1, :, :] for k in range(3))
    up = xp.log(1 + xp.exp(z.clip(-20, 20))) + 1e-3  # positive: a camera sees what faces it
    length = xp.sqrt(x * x + y * y + up * up)
    normal = xp.concat([x / length, y / length, up / length], axis=-3)
    deviation = [xp.exp(outputs[..., k : k + 1, :, :].clip(*LOG_VARIANCES) / 2) for k in (NORMAL_VARIANCE, 8, 10)]
    light = image.clip(0, None) / level + FLOOR
    albedo = light * xp.exp(outputs[..., 4:7, :, :].clip(*LOGARITHMS))
    roughness = xp.exp(outputs[..., 7:8, :, :].clip(LOGARITHMS[0], 0))
    specular = xp.exp(outputs[..., 9:10, :, :].clip(*LOGARITHMS))
    return Surface(normal, albedo, roughness, specular, *deviation)


def mirror_seen(seen: Seen) -> Seen:
    """Images mirrored across: the signs of s2 and of the lamp's x change (`stokes.flip_horizontal`). NumPy only."""
    image, specular, polarized, error, mask, light = (None if x is None else x[..., ::-1] for x in seen)
    if polarized is not None:
        first, second = np.split(polarized, 2, axis=-3)
        polarized = np.concatenate([first, -second], axis=-3)
    return Seen(image, specular, polarized, error, mask, _x_turned(light))


def mirror_surface(surface: Surface) -> Surface:
    """A surface mirrored across. NumPy only."""
    mirrored = Surface(*(x[..., ::-1] for x in surface))
    return mirrored._replace(normal=_x_turned(mirrored.normal))


def _x_turned(vectors: Array) -> Array:
    return vectors * np.array([-1, 1, 1], np.float32).reshape(3, 1, 1)


def mean_surface(*surfaces: Surface) -> Surface:
    """The mean of estimates: of normals by their expected variances, of logarithms of all else.

    Expected errors are of estimates that err alike.
    """
    logs = (math.prod(values) ** (1 / len(surfaces)) for values in zip(*(s[1:] for s in surfaces), strict=True))
    xp = namespace(surfaces[0].normal)
    normal = sum(s.normal / s.normal_error**2 for s in surfaces)
    return Surface(normal / xp.sqrt(xp.sum(normal * normal, axis=-3, keepdims=True)), *logs)


def relight(surface: Surface, lamp: Array) -> Array:
    """The picture ``[..., 3, h, w]`` of a surface under a far lamp in a unit direction ``[3]``, without shadows.

    1 is white paper that faces the lamp; shading is that of `physics.gltf`.
    """
    xp, like = namespace(surface.normal), 0 * surface.normal
    specular = (GLASS * surface.specular).clip(None, 1) + like
    camera = xp.concat([like[..., :2, :, :], like[..., :1, :, :] + 1], axis=-3)
    coat = Coat(surface.normal, surface.albedo, surface.roughness, specular)
    return math.pi * reflect(coat, camera, lamp.reshape(3, 1, 1) + like)
