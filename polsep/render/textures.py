"""Solid textures: procedural patterns of the position that mix the two materials of a slot.

A pattern is a weight in [0, 1] of every point of object space, so it has no seams. Patterns use only an integer hash of
lattice cells and correctly rounded operations: they have the same bits on every machine and in the compiled twin
`polsep.render.patterns_kernel`, in float32.

Sources: Worley 1996, A cellular texture basis function; Perlin 2002, Improving noise; Perlin 1985, An image synthesizer
(sums of octaves, bent stripes); the hash is lowbias32 of C. Wellons 2018, Prospecting for hash functions.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

#: Patterns: none; cells of their own shade; cells and the cracks between them; dots; smooth noise; layers; rings about
#: an axis; cubes.
PLAIN, PATCHES, CRACKS, DOTS, CLOUDS, STRIPES, RINGS, CHECKER = range(8)
#: Most octaves, and ratios of frequency and amplitude of successive ones.
MAX_OCTAVES, LACUNARITY, GAIN = 4, 2.0, 0.5
#: Scales noise to a standard deviation of about 0.3.
NOISE_GAIN = 1.5
#: Odd multipliers of lattice coordinates and of octaves (Teschner et al. 2003; the golden ratio), and of the hash.
PRIMES, OCTAVE_STEP, MIXERS = (73856093, 19349663, 83492791), 0x9E3779B9, (0x7FEB352D, 0x846CA68B)
#: Low 32 bits.
MASK = 0xFFFFFFFF


@dataclass(frozen=True)
class Textures:
    """The second material of S slots and the pattern of its weight: 0 is the first material, 1 the second one.

    ``albedo [S, 3]``, ``roughness [S]``. ``pattern [S]``: one of the constants above. ``transform [S, 3, 4]``: from
    positions to pattern space, whose unit is a cell. ``seed [S]``: 31 bits. ``octaves [S]`` of noise; ``warp [S]``: by
    how many cells noise bends layers and rings. ``threshold``, ``edge [S]``: position and width of the transition
    between weights. Raises ValueError when the counts differ or an edge is not above 0.
    """

    albedo: Tensor
    roughness: Tensor
    pattern: Tensor
    transform: Tensor
    seed: Tensor
    octaves: Tensor
    warp: Tensor
    threshold: Tensor
    edge: Tensor

    def __post_init__(self) -> None:
        slots = self.pattern.numel()
        special = {"albedo": (slots, 3), "transform": (slots, 3, 4)}
        for field in fields(self):
            found, expected = tuple(getattr(self, field.name).shape), special.get(field.name, (slots,))
            if found != expected:
                raise ValueError(f"expected {field.name} {list(expected)} for {slots} slots, found {list(found)}")
        if not bool((self.edge > 0).all()):
            raise ValueError(f"expected edges above 0, found {float(self.edge.min())}")


def pattern_weight(textures: Textures, slot: Tensor, position: Tensor) -> Tensor:
    """Return the weight of the second material ``[1, M, 1]`` at positions ``[3, M, 1]`` of slots ``[M]``, in [0, 1]."""
    weight = torch.zeros_like(position[0, :, 0])
    pattern = textures.pattern[slot]
    for which in range(PATCHES, CHECKER + 1):
        here = torch.nonzero(pattern == which)[:, 0]
        if here.numel():
            weight[here] = _weigh(which, textures, slot[here], position[:, here, 0])
    return weight[None, :, None]


def _weigh(which: int, textures: Textures, slot: Tensor, position: Tensor) -> Tensor:
    """`pattern_weight` ``[N]`` of points ``[3, N]`` that all have one pattern."""
    point = _transform(textures.transform[slot], position)
    seed, threshold, edge = textures.seed[slot], textures.threshold[slot], textures.edge[slot]
    if which in (PATCHES, CRACKS, DOTS):
        nearest, second, first_shade, second_shade = cells(point, seed)
        if which == DOTS:
            return ramp((threshold - nearest) / edge)
        apart = second - nearest
        if which == CRACKS:
            return ramp((apart - threshold) / edge)
        return first_shade + (0.5 - 0.5 * ramp(apart / edge)) * (second_shade - first_shade)
    if which == CHECKER:
        sides = [((wave(0.5 * x) - 0.5) / edge).clamp(-1, 1) for x in point]
        return 0.5 + 0.5 * (sides[0] * sides[1] * sides[2])
    noise = octave_noise(point, seed, textures.octaves[slot])
    if which == CLOUDS:
        return ramp((noise - threshold) / edge + 0.5)
    along = point[0] if which == STRIPES else root(point[0] * point[0] + point[1] * point[1])
    return ramp((wave(along + textures.warp[slot] * noise) - threshold) / edge + 0.5)


def _transform(transform: Tensor, position: Tensor) -> Tensor:
    """Points ``[3, N]`` in pattern space, summed in a fixed order: fused products may round into other cells."""
    x, y, z = position
    rows = [t[:, 0] * x + t[:, 1] * y + t[:, 2] * z + t[:, 3] for t in transform.unbind(1)]
    return torch.stack(rows)


def root(x: Tensor) -> Tensor:
    """Return the correctly rounded square root; torch's in float32 may be off by a bit."""
    return torch.sqrt(x.double()).to(x.dtype)


def ramp(x: Tensor) -> Tensor:
    """Return 0 below 0, 1 above 1, and the cubic 3x² - 2x³ between."""
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def wave(x: Tensor) -> Tensor:
    """Return a triangle wave of period 1 in [0, 1]: 1 at whole numbers, 0 between them."""
    return (2 * (x - torch.floor(x)) - 1).abs()


def hash_cell(lattice: Tensor, seed: Tensor) -> Tensor:
    """Return 32 random bits, int64 ``[N]``, of lattice points ``[3, N]``."""
    h = (lattice[0] * PRIMES[0] ^ lattice[1] * PRIMES[1] ^ lattice[2] * PRIMES[2] ^ seed) & MASK
    h = h ^ (h >> 16)
    h = (h * MIXERS[0]) & MASK
    h = h ^ (h >> 15)
    h = (h * MIXERS[1]) & MASK
    mixed: Tensor = h ^ (h >> 16)
    return mixed


def hash_fractions(h: Tensor, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return three fractions in [0, 1] of ten bits each."""
    x, y, z = ((h >> shift & 1023).to(like.dtype) * (1 / 1024) for shift in (0, 10, 20))
    return x, y, z


def cells(point: Tensor, seed: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return distances to the nearest and second nearest of random centres, one per lattice cell, and their shades.

    ``point [3, N]``; results ``[N]``, shades in [0, 1). Source: Worley 1996.
    """
    base = torch.floor(point)
    inside, lattice = point - base, base.long()
    near = torch.full_like(point[0], math.inf)
    first, second, first_hash, second_hash = near, near, torch.zeros_like(seed), torch.zeros_like(seed)
    for step in itertools.product((-1, 0, 1), repeat=3):
        h = hash_cell(lattice + torch.tensor(step, device=point.device)[:, None], seed)
        x, y, z = ((s + f) - p for s, f, p in zip(step, hash_fractions(h, point), inside, strict=True))
        distance = x * x + y * y + z * z
        closer, between = distance < first, distance < second
        second = torch.where(closer, first, torch.where(between, distance, second))
        second_hash = torch.where(closer, first_hash, torch.where(between, h, second_hash))
        first, first_hash = torch.where(closer, distance, first), torch.where(closer, h, first_hash)
    shades = [((h ^ h >> 7) * MIXERS[0] >> 8 & 0xFFFF).to(point.dtype) * (1 / 65536) for h in (first_hash, second_hash)]
    return root(first), root(second), shades[0], shades[1]


def octave_noise(point: Tensor, seed: Tensor, octaves: Tensor) -> Tensor:
    """Return the sum of `gradient_noise` over octaves, about -1 to 1; points ``[3, N]`` to ``[N]``."""
    total = torch.zeros_like(point[0])
    for octave in range(MAX_OCTAVES):
        layer = gradient_noise(point * LACUNARITY**octave, seed + octave * OCTAVE_STEP & MASK)
        total = total + torch.where(octaves > octave, NOISE_GAIN * GAIN**octave * layer, torch.zeros_like(layer))
    return total


def gradient_noise(point: Tensor, seed: Tensor) -> Tensor:
    """Return noise ``[N]`` of points ``[3, N]``: 0 at the lattice, with random gradients. Source: Perlin 2002."""
    base = torch.floor(point)
    inside, lattice = point - base, base.long()
    corners: list[Tensor] = []
    for step in itertools.product((0, 1), repeat=3):
        h = hash_cell(lattice + torch.tensor(step, device=point.device)[:, None], seed)
        gx, gy, gz = (2 * f - 1 for f in hash_fractions(h, point))
        x, y, z = (p - s for p, s in zip(inside, step, strict=True))
        corners.append(gx * x + gy * y + gz * z)
    u, v, w = (t * t * t * (t * (t * 6 - 15) + 10) for t in inside)
    for t in (w, v, u):
        corners = [a + t * (b - a) for a, b in zip(corners[::2], corners[1::2], strict=True)]
    return corners[0]
