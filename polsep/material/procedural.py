"""Random materials of a plane: layers of `render.materials` or of metal under random masks, with reliefs.

Everything is drawn from one generator, the same on every machine. No photographs or material libraries are used.
Slopes count at `MAP_SIZE` pixels, the resolution of maps; finer frames show finer slopes, too. Heights tilt normals;
they cast no shadows and hide nothing, as normal maps of renderers.
Source: the idea of mixing procedural materials is Deschaintre et al. 2018, Sec. 4.1; these are this project's own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.material.heights import Relief, random_relief
from polsep.material.svbrdf import MAP_SIZE, Svbrdf, plane_points
from polsep.physics.fresnel import fresnel
from polsep.physics.gltf import GLASS
from polsep.physics.optics import normalize
from polsep.render.materials import random_materials
from polsep.render.textures import pattern_weight

#: Largest number of layers, and probabilities of 1, 2, 3; each layer has its own texture and mask.
LAYERS, LAYER_SHARES = 3, (0.3, 0.4, 0.3)
#: Factor of the specular strength of a layer, 0.5 to 1; log-uniform: indices of refraction of 1.3 to 1.9.
GAINS = (0.5, 2.5)
#: Least roughness: below it, the reflection of a small flash is a point.
MIN_ROUGHNESS = 0.12
#: Share of samples with metal, and of those that are metal all over; in the others one layer is metal.
METAL_SHARE, ALL_METAL_SHARE = 0.2, 0.5
#: Reflectance of metals at normal incidence, share of grey ones, largest difference of their colours, and ratios of
#: green to red and blue to green of the others, as from copper to gold; the factor of the second material of a texture.
REFLECTANCES, GREY_METALS, GREY_SPREAD = (0.4, 0.95), 0.5, 0.04
GREENS, BLUES, TARNISH = (0.65, 0.95), (0.42, 0.9), (0.8, 1.0)
#: Share of flat materials; rms slope along an axis of the others, at `MAP_SIZE`, log-uniform. No slope is steeper than
#: the third number; the raw pixels of reliefs that are finer than the maps have no larger rms than the last.
FLAT_SHARE, SLOPES, STEEPEST, FINEST = 0.05, (0.04, 0.8), 3.0, 1.2
#: Probability of a second relief; probabilities that patterns of colour also have height, and that a
#: layer lies where the relief says.
SECOND_SHARE, RAISED_SHARE, FOLLOWS_SHARE = 0.5, 0.5, 0.5
#: Rounds in which heights are scaled to a slope.
ROUNDS = 4


def random_svbrdf(size: int, generator: torch.Generator) -> Svbrdf:
    """Maps of ``size`` x ``size`` pixels; specular maps of dielectrics are white, metals have no diffuse light."""
    count = 1 + int(torch.multinomial(torch.tensor(LAYER_SHARES), 1, generator=generator))
    materials = random_materials(2 * LAYERS, generator, size=2.0)
    textures = materials.textures
    assert textures is not None
    points = plane_points(size, size).reshape(3, -1, 1)

    def weigh(slot: int) -> Tensor:
        slots = torch.full((size * size,), slot)
        return pattern_weight(textures, slots, points).view(1, size, size)

    gains = torch.exp(math.log(GAINS[0]) + math.log(GAINS[1] / GAINS[0]) * torch.rand(LAYERS, generator=generator))
    metal = _metal_layers(count, generator)
    relief = [random_relief(size, generator) for _ in range(1 + int(_draw((0, 1), generator) < SECOND_SHARE))]
    patterns = list[Tensor]()
    found: list[Tensor] = []
    for layer in range(count):
        weight = weigh(layer)
        patterns.append(weight)
        roughness = materials.roughness[layer] + weight * (textures.roughness[layer] - materials.roughness[layer])
        first, second = materials.albedo[layer][:, None, None], textures.albedo[layer][:, None, None]
        diffuse = _transmitted(first + weight * (second - first))
        specular = (materials.specular[layer] * gains[layer] * GLASS).expand_as(diffuse)
        if metal[layer]:
            bright, dull = _random_reflectance(generator)[:, None, None], _draw(TARNISH, generator)
            diffuse, specular = torch.zeros_like(diffuse), bright * (1 + weight * (dull - 1))
        maps = torch.cat([diffuse, roughness, specular])
        if found:
            mask = _mask(relief, generator)
            if mask is None:
                mask = weigh(LAYERS + layer)
                patterns.append(mask)
            maps = found[-1] + mask * (maps - found[-1])
        found.append(maps)
    diffuse, roughness, specular = torch.split(found[-1], [3, 1, 3])
    diffuse = diffuse / (1 - specular)
    normal = _normals(_random_height(relief, patterns, generator), generator)
    return Svbrdf(normal, diffuse.clamp(max=1), roughness.clamp(min=MIN_ROUGHNESS), specular)


def _draw(interval: tuple[float, float], generator: torch.Generator) -> float:
    """A uniform draw."""
    low, high = interval
    return low + (high - low) * float(torch.rand(1, generator=generator))


def _transmitted(albedo: Tensor) -> Tensor:
    """Diffuse reflectance of an albedo in `optics`, where light passes the surface twice, at normal incidence."""
    diffuse: Tensor = albedo * fresnel(torch.ones(1)).t_plus ** 2
    return diffuse


def _metal_layers(count: int, generator: torch.Generator) -> list[bool]:
    """Draw the layers that are metal."""
    some, whole = torch.rand(2, generator=generator).tolist()
    one = int(torch.randint(count, (1,), generator=generator))
    return [some < METAL_SHARE and (whole < ALL_METAL_SHARE or layer == one) for layer in range(count)]


def _random_reflectance(generator: torch.Generator) -> Tensor:
    """Reflectance ``[3]`` of a metal at normal incidence."""
    red, green, blue = _draw(REFLECTANCES, generator), _draw(GREENS, generator), _draw(BLUES, generator)
    grey = _draw((0, 1), generator) < GREY_METALS
    spread = GREY_SPREAD * (2 * torch.rand(3, generator=generator) - 1)
    color = red + spread if grey else torch.tensor([red, red * green, red * green * blue])
    if not grey:
        color = color * (max(red, 0.75) / red)  # coloured metals are bright in red
    return color.clamp(max=REFLECTANCES[1])


def _mask(reliefs: list[Relief], generator: torch.Generator) -> Tensor | None:
    """The place of a layer that follows one of the reliefs, in it or on it; None for one that does not."""
    follows, inside = torch.rand(2, generator=generator).tolist()
    which = int(torch.randint(len(reliefs), (1,), generator=generator))
    if follows >= FOLLOWS_SHARE:
        return None
    weight = reliefs[which].weight
    return weight if inside < 0.5 else 1 - weight


def _random_height(reliefs: list[Relief], patterns: list[Tensor], generator: torch.Generator) -> Tensor:
    """A sum of reliefs and patterns with random signs and sizes ``[1, H, W]``; the first relief is the steepest."""
    sizes = torch.randn(len(patterns), generator=generator)
    raised = torch.rand(len(patterns), generator=generator) < RAISED_SHARE
    height = torch.zeros_like(patterns[0])
    for size, pattern in zip((0.5 * sizes * raised).tolist(), patterns, strict=True):
        height = height + size * _even(pattern)
    for number, relief in enumerate(reliefs):
        height = height + _even(relief.height) * (1.0 if number == 0 else _draw((0.1, 0.7), generator))
    return height


def _slopes(height: Tensor) -> Tensor:
    """Differences to the right and up ``[2, H, W]`` of a height ``[1, H, W]``."""
    padded = torch.nn.functional.pad(height[None], (2, 2, 2, 2), mode="replicate")[0]
    for dim in (-1, -2):  # a pixel's own extent: 1 2 1
        n = padded.shape[dim] - 2
        padded = (padded.narrow(dim, 0, n) + 2 * padded.narrow(dim, 1, n) + padded.narrow(dim, 2, n)) / 4
    return torch.cat([padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2], padded[:, :-2, 1:-1] - padded[:, 2:, 1:-1]])


def _even(height: Tensor) -> Tensor:
    """A height whose slopes have an rms of 1, or none."""
    rms = float(_slopes(height).square().mean().sqrt())
    return height / rms if rms > 1e-6 else torch.zeros_like(height)


def _normals(height: Tensor, generator: torch.Generator) -> Tensor:
    """Normals ``[3, H, W]`` of a height ``[1, H, W]`` that is scaled to a random rms slope at `MAP_SIZE`."""
    flat, place = torch.rand(2, generator=generator).tolist()
    steepness = 0.0 if flat < FLAT_SHARE else SLOPES[0] * (SLOPES[1] / SLOPES[0]) ** place
    slope = _slopes(height)
    raw = float(slope.square().mean().sqrt())
    if steepness == 0.0 or raw < 1e-9:
        return normalize(torch.cat([torch.zeros_like(slope), torch.ones_like(slope[:1])]))
    gain = steepness / raw
    for _ in range(ROUNDS):
        found = rms_slope(_tilted(gain * slope))
        gain = min(gain * min(max(steepness / max(found, 1e-6), 0.5), 4.0), FINEST / raw)
    return _tilted(gain * slope)


def _tilted(slope: Tensor) -> Tensor:
    """Normals of slopes, none steeper than `STEEPEST`."""
    slope = slope / torch.sqrt(1 + slope.square().sum(dim=0, keepdim=True) / STEEPEST**2)
    return normalize(torch.cat([-slope, torch.ones_like(slope[:1])]))


def rms_slope(normal: Tensor) -> float:
    """Root mean square of x / z and y / z of normals ``[3, H, W]``, averaged to `MAP_SIZE` pixels or fewer."""
    mean = avg_pool2d(normal[None], max(1, normal.shape[-1] // MAP_SIZE))[0]
    return float((mean[:2] / mean[2:]).square().mean().sqrt())


def halve(maps: Svbrdf) -> Svbrdf:
    """Means over 2x2 pixels, as in a half-resolution image."""
    small = [torch.nn.functional.avg_pool2d(x[None], 2)[0] for x in vars(maps).values()]
    return replace(Svbrdf(*small), normal=normalize(small[0]))
