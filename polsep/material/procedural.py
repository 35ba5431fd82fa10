"""Random materials of a plane: layers of `render.materials` under random masks, with heights of the same patterns.

Everything is drawn from one generator, the same on every machine. No photographs or material libraries are used.
Source: the idea of mixing procedural materials is Deschaintre et al. 2018, Sec. 4.1; these are this project's own.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from polsep.material.svbrdf import Svbrdf, plane_points
from polsep.physics.fresnel import fresnel
from polsep.physics.optics import normalize
from polsep.render.materials import random_materials
from polsep.render.textures import PLAIN, pattern_weight

#: Largest number of layers, and probabilities of 1, 2, 3; each layer has its own texture and mask.
LAYERS, LAYER_SHARES = 3, (0.3, 0.4, 0.3)
#: Reflectance at normal incidence of strength 1: glass of index 1.5, as `optics` has it.
GLASS = 0.04
#: Factor of the specular strength of a layer, 0.5 to 1; log-uniform: indices of refraction of 1.3 to 1.9.
GAINS = (0.5, 2.5)
#: Least roughness: below it, the reflection of a small flash is a point.
MIN_ROUGHNESS = 0.12
#: Share of flat materials; rms slope of the others, log-uniform; no slope is steeper than the last number.
FLAT_SHARE, SLOPES, STEEPEST = 0.08, (0.03, 0.45), 2.0
#: Probability that a pattern of colour also has height, and number of patterns with height only.
RAISED_SHARE, RELIEFS = 0.6, 2
#: Random materials drawn: for layers, masks, and candidates for reliefs.
SLOTS = 2 * LAYERS + 8


def random_svbrdf(size: int, generator: torch.Generator) -> Svbrdf:
    """Maps of ``size`` x ``size`` pixels of a dielectric, whose specular map is white."""
    count = 1 + int(torch.multinomial(torch.tensor(LAYER_SHARES), 1, generator=generator))
    materials = random_materials(SLOTS, generator, size=2.0)
    textures = materials.textures
    assert textures is not None
    points = plane_points(size, size).reshape(3, -1, 1)

    def weigh(slot: int) -> Tensor:
        slots = torch.full((size * size,), slot)
        return pattern_weight(textures, slots, points).view(1, size, size)

    gains = torch.exp(math.log(GAINS[0]) + math.log(GAINS[1] / GAINS[0]) * torch.rand(LAYERS, generator=generator))
    found: list[Tensor] = []
    reliefs = [slot for slot in range(2 * LAYERS, SLOTS) if int(textures.pattern[slot]) != PLAIN][:RELIEFS]
    patterns = [weigh(slot) for slot in reliefs]
    for layer in range(count):
        weight = weigh(layer)
        patterns.append(weight)
        roughness = materials.roughness[layer] + weight * (textures.roughness[layer] - materials.roughness[layer])
        first, second = materials.albedo[layer][:, None, None], textures.albedo[layer][:, None, None]
        specular = (materials.specular[layer] * gains[layer] * GLASS).expand_as(weight)
        maps = torch.cat([first + weight * (second - first), roughness, specular])
        if found:
            mask = weigh(LAYERS + layer)
            patterns.append(mask)
            maps = found[-1] + mask * (maps - found[-1])
        found.append(maps)
    albedo, roughness, specular = torch.split(found[-1], [3, 1, 1])
    # As bright as the same albedo in `optics`, where light passes the surface twice, at normal incidence.
    passed = fresnel(torch.ones(1)).t_plus ** 2
    diffuse = albedo * passed / (1 - specular)
    normal = _normals(_random_height(patterns, generator), generator)
    return Svbrdf(normal, diffuse, roughness.clamp(min=MIN_ROUGHNESS), specular.expand(3, -1, -1))


def _random_height(patterns: list[Tensor], generator: torch.Generator) -> Tensor:
    """A sum of patterns with random signs and sizes, ``[1, H, W]``."""
    sizes = torch.randn(len(patterns), generator=generator)
    raised = torch.rand(len(patterns), generator=generator) < RAISED_SHARE
    raised[:RELIEFS] = True
    sizes = sizes * raised
    return sum((size * pattern for size, pattern in zip(sizes, patterns, strict=True)), torch.zeros_like(patterns[0]))


def _normals(height: Tensor, generator: torch.Generator) -> Tensor:
    """Normals ``[3, H, W]`` of a height ``[1, H, W]`` that is scaled to a random slope."""
    flat, place = torch.rand(2, generator=generator).tolist()
    steepness = 0.0 if flat < FLAT_SHARE else SLOPES[0] * (SLOPES[1] / SLOPES[0]) ** place
    padded = torch.nn.functional.pad(height[None], (2, 2, 2, 2), mode="replicate")[0]
    for dim in (-1, -2):  # a pixel's own extent: 1 2 1
        n = padded.shape[dim] - 2
        padded = (padded.narrow(dim, 0, n) + 2 * padded.narrow(dim, 1, n) + padded.narrow(dim, 2, n)) / 4
    across = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]
    up = padded[:, :-2, 1:-1] - padded[:, 2:, 1:-1]
    slope = torch.cat([across, up])
    spread = float(slope.square().sum(dim=0).mean().sqrt())
    slope = slope * (steepness / spread) if spread > 1e-9 else torch.zeros_like(slope)
    slope = slope / torch.sqrt(1 + slope.square().sum(dim=0, keepdim=True) / STEEPEST**2)
    return normalize(torch.cat([-slope, torch.ones_like(across)]))


def halve(maps: Svbrdf) -> Svbrdf:
    """Means over 2x2 pixels, as in a half-resolution image."""
    small = [torch.nn.functional.avg_pool2d(x[None], 2)[0] for x in vars(maps).values()]
    return replace(Svbrdf(*small), normal=normalize(small[0]))
