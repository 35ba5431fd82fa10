"""Heights of structured surfaces on a plane: bricks, weaves, pebbles, cracks, leather, pores, scratches and others.

A relief is a height ``[1, H, W]`` of an arbitrary scale and a weight ``[1, H, W]`` in [0, 1] of what it is made of:
1 in joints, cracks and pores, and on one of two kinds of threads. Some reliefs have sharp edges, others are smooth.
Sources: Worley 1996, A cellular texture basis function; the hash of `polsep.render.textures`; else this project's.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from polsep.render.textures import hash_cell, hash_fractions, ramp, wave

#: Sizes of a cell relative to the plane's side, log-uniform, and largest stretch of cells along one axis.
CELLS, LONGEST = (1 / 40, 1 / 5), 3.0
#: Share of reliefs along the frame's sides; the others are turned by any angle.
ALONG_SHARE = 0.4
#: Most octaves of noise, and amplitude of successive ones.
OCTAVES, GAINS = 5, (0.35, 0.7)
#: Largest number of scratches and their half width relative to the plane's side.
SCRATCHES, SCRATCH = 24, (0.002, 0.008)


class Relief(NamedTuple):
    """``height`` and ``weight``, each ``[1, H, W]``; see above."""

    height: Tensor
    weight: Tensor


class Place(NamedTuple):
    """Pixels ``x``, ``y`` ``[H, W]`` in cells, turned and stretched; ``plain``: the same, relative to the plane's side.

    ``generator``: of all further draws.
    """

    x: Tensor
    y: Tensor
    plain: tuple[Tensor, Tensor]
    generator: torch.Generator

    def between(self, low: float, high: float) -> float:
        """A uniform draw."""
        return low + (high - low) * float(torch.rand(1, generator=self.generator))


class Cells(NamedTuple):
    """Each pixel's distances to the ``nearest`` and ``second`` cell's centre, offset ``x``, ``y`` from the nearest.

    ``shades``: three numbers in [0, 1) of the nearest cell.
    """

    nearest: Tensor
    second: Tensor
    x: Tensor
    y: Tensor
    shades: tuple[Tensor, Tensor, Tensor]


def random_relief(size: int, generator: torch.Generator) -> Relief:
    """A relief of a random kind of `KINDS` on ``size`` x ``size`` pixels."""
    kind = int(torch.randint(len(KINDS), (1,), generator=generator))
    found = KINDS[kind](random_place(size, generator))
    return Relief(found.height[None], found.weight[None].clamp(0, 1))


def random_place(size: int, generator: torch.Generator) -> Place:
    """Coordinates of pixels in randomly sized, turned, shifted and stretched cells."""
    scale, longer, along, turn, x, y = torch.rand(6, generator=generator).tolist()
    cell = CELLS[0] * (CELLS[1] / CELLS[0]) ** scale
    angle = math.pi / 2 * round(3 * turn) if along < ALONG_SHARE else 2 * math.pi * turn
    stretch = LONGEST ** max(0.0, 2 * longer - 1)
    places = (torch.arange(size) + 0.5) / size
    rows, cols = torch.meshgrid(places, places, indexing="ij")
    across = math.cos(angle) * cols + math.sin(angle) * rows
    down = math.cos(angle) * rows - math.sin(angle) * cols
    return Place(across / cell + 64 * x, down / (cell * stretch) + 64 * y, (cols, rows), generator)


def find_cells(x: Tensor, y: Tensor, seed: int) -> Cells:
    """Distances of points to random centres, one per unit square. Source: Worley 1996."""
    left, top = torch.floor(x), torch.floor(y)
    far = torch.full_like(x, math.inf)
    nearest, second, dx, dy, hashes = far, far, far, far, torch.zeros_like(x, dtype=torch.long)
    for i, j in itertools.product((-1, 0, 1), repeat=2):
        lattice = torch.stack([(left + i).long(), (top + j).long(), torch.zeros_like(hashes)])
        h = hash_cell(lattice, torch.tensor(seed))
        a, b, _ = hash_fractions(h, x)
        a, b = x - (left + i + a), y - (top + j + b)
        distance = a * a + b * b
        closer = distance < nearest
        second = torch.where(closer, nearest, torch.minimum(second, distance))
        nearest, dx, dy = (torch.where(closer, new, old) for new, old in ((distance, nearest), (a, dx), (b, dy)))
        hashes = torch.where(closer, h, hashes)
    shades = hash_fractions(hash_cell(torch.stack([hashes, hashes >> 7, hashes >> 13]), torch.tensor(seed + 1)), x)
    return Cells(nearest.sqrt(), second.sqrt(), dx, dy, shades)


def smooth_noise(size: int, cells: float, generator: torch.Generator) -> Tensor:
    """Random numbers ``[H, W]`` of standard deviation about 0.7, smooth over ``1 / cells`` of the side."""
    count = max(2, round(cells)) + 3
    lattice = torch.randn(1, 1, count, count, generator=generator)
    return interpolate(lattice, (size, size), mode="bicubic", align_corners=False)[0, 0]


def rough_noise(place: Place) -> Tensor:
    """A sum of octaves of `smooth_noise`."""
    size, gain = place.x.shape[-1], place.between(*GAINS)
    first = 2 ** place.between(1.5, 4)
    octaves = [n for n in range(OCTAVES) if n == 0 or first * 2**n < size / 4]
    return sum(
        (gain**n * smooth_noise(size, first * 2**n, place.generator) for n in octaves), torch.zeros_like(place.x)
    )


def _seed(place: Place) -> int:
    return int(torch.randint(2**31, (1,), generator=place.generator))


def bricks(place: Place) -> Relief:
    """Rows of bricks or tiles with joints between, rounded or sharp; every brick has its own height and tilt."""
    long, shift, joint, edge = (place.between(*r) for r in ((1, 3), (0, 0.6), (0.04, 0.15), (0.02, 0.2)))
    row = torch.floor(place.y)
    along = place.x / long + (shift if shift > 0.2 else 0.0) * row
    brick = torch.floor(along)
    a, b = along - brick, place.y - row
    inside = torch.minimum(torch.minimum(a, 1 - a) * long, torch.minimum(b, 1 - b))
    top = ramp((inside - joint) / edge)
    numbers = hash_cell(
        torch.stack([brick.long(), row.long(), torch.zeros_like(brick, dtype=torch.long)]), torch.tensor(_seed(place))
    )
    lift, right, up = hash_fractions(numbers, a)
    uneven = place.between(0, 0.6)
    tilted = uneven * (0.3 * lift + 0.5 * (right - 0.5) * (a - 0.5) + 0.5 * (up - 0.5) * (b - 0.5))
    return Relief(top * (0.3 + tilted) + 0.03 * rough_noise(place), 1 - top)


def weave(place: Place) -> Relief:
    """Warp and weft that pass over and under each other, plain or twill."""
    period, lift = 2 + int(place.between(0, 3)), place.between(0.2, 0.8)
    i, j = torch.floor(place.x), torch.floor(place.y)
    a, b = place.x - i, place.y - j
    over = torch.where(torch.remainder(i + j, period) < period / 2, 1.0, -1.0)
    round_a, round_b = (torch.sqrt((1 - (2 * t - 1) ** 2).clamp(min=0.02)) for t in (a, b))
    warp, weft = round_a + lift * over * round_b, round_b - lift * over * round_a
    return Relief(torch.maximum(warp, weft), (warp > weft).float())


def pebbles(place: Place) -> Relief:
    """Round grains, or dents as a hammer leaves them."""
    found, up = find_cells(place.x, place.y, _seed(place)), place.between(-1, 1) > -0.4
    dome = torch.sqrt((1.1 - found.nearest**2).clamp(min=0.05)) * (0.7 + 0.6 * found.shades[0])
    return Relief(dome if up else -dome, 1 - ramp((found.second - found.nearest) / place.between(0.1, 0.4)))


def cracks(place: Place) -> Relief:
    """Plates with sharp cracks between, bent by noise."""
    bend, width, edge = place.between(0, 0.5), place.between(0.02, 0.12), place.between(0.03, 0.2)
    size, cells = place.x.shape[-1], 8.0
    x = place.x + bend * smooth_noise(size, cells, place.generator)
    y = place.y + bend * smooth_noise(size, cells, place.generator)
    found = find_cells(x, y, _seed(place))
    plate = ramp((found.second - found.nearest - width) / edge)
    return Relief(plate + place.between(0, 0.3) * found.shades[0] + 0.05 * rough_noise(place), 1 - plate)


def leather(place: Place) -> Relief:
    """Cushions with soft folds between, and a fine grain."""
    bend, size = place.between(0.1, 0.4), place.x.shape[-1]
    x, y = (p + bend * smooth_noise(size, 12, place.generator) for p in (place.x, place.y))
    found = find_cells(x, y, _seed(place))
    fold = (1 - (found.second - found.nearest) / place.between(0.4, 0.9)).clamp(0, 1)
    return Relief(0.6 * (1 - fold**2) + 0.04 * rough_noise(place), fold**3)


def facets(place: Place) -> Relief:
    """Flat facets of random tilt, as of split stone or crumpled paper."""
    found = find_cells(place.x, place.y, _seed(place))
    a, b, lift = (2 * shade - 1 for shade in found.shades)
    return Relief(a * found.x + b * found.y + place.between(0, 0.3) * lift, found.shades[2])


def pores(place: Place) -> Relief:
    """Growth rings of wood, seen along the grain, with short pits."""
    size, narrow = place.x.shape[-1], place.between(6, 14)
    rings = wave(0.3 * place.x + place.between(0.1, 0.6) * smooth_noise(size, 4, place.generator))
    found = find_cells(2 * place.x, place.y / narrow * 4, _seed(place))
    pit = ramp((place.between(0.2, 0.45) - found.nearest) / 0.2) * (found.shades[0] < 0.7)
    return Relief(place.between(0, 0.5) * rings - pit + 0.03 * rough_noise(place), torch.maximum(pit, ramp(rings) ** 2))


def scratches(place: Place) -> Relief:
    """Straight grooves of random places and lengths, along one direction or in all, on a slightly uneven surface."""
    count, aligned = 4 + int(place.between(0, SCRATCHES - 4)), place.between(0, 1) < 0.5
    first, (x, y) = place.between(0, math.pi), place.plain
    depth = torch.zeros_like(x)
    for _ in range(count):
        angle = first + place.between(-0.15, 0.15) if aligned else place.between(0, math.pi)
        u, v, half, width = (place.between(*r) for r in ((0, 1), (0, 1), (0.05, 0.6), SCRATCH))
        off = (math.cos(angle) * (y - v) - math.sin(angle) * (x - u)).abs() / width
        along = (math.cos(angle) * (x - u) + math.sin(angle) * (y - v)).abs() / half
        depth = torch.maximum(depth, (1 - off).clamp(min=0) * (1 - along).clamp(0, 0.2) * 5 * place.between(0.3, 1))
    uneven = place.between(0, 0.1) * rough_noise(place)
    return Relief(uneven - place.between(0.01, 0.03) * depth, depth)


def ribs(place: Place) -> Relief:
    """Parallel ribs or grooves, straight or bent, as of corduroy, corrugated card or brushed plaster."""
    bent = place.x + place.between(0, 1) ** 2 * smooth_noise(place.x.shape[-1], 5, place.generator)
    up = wave(bent)
    round_ = torch.sqrt((1 - up * up).clamp(min=0.02))
    height = round_ if place.between(0, 1) < 0.6 else ramp((up - 0.4) / place.between(0.1, 0.6))
    return Relief(height + 0.03 * rough_noise(place), up)


def plaster(place: Place) -> Relief:
    """Noise of several scales."""
    height = rough_noise(place)
    if place.between(0, 1) < 0.3:  # ridges
        height = -height.abs()
    return Relief(height, ramp((height - place.between(-0.3, 0.3)) / 0.4 + 0.5))


#: Kinds of reliefs, equally likely.
KINDS: tuple[Callable[[Place], Relief], ...] = (
    bricks,
    weave,
    pebbles,
    cracks,
    leather,
    facets,
    pores,
    scratches,
    ribs,
    plaster,
)
