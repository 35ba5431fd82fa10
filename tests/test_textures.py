"""Procedural patterns: in range, continuous across cells, with the statistics of noise, the same from both twins."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tolerances import SIGMAS
from torch import Tensor

from polsep.compute.compiling import entry
from polsep.render import patterns_kernel as patterns
from polsep.render import textures
from polsep.render.materials import USUAL_SIZE, Materials, random_materials
from polsep.render.textures import (
    CHECKER,
    CLOUDS,
    CRACKS,
    DOTS,
    PATCHES,
    PLAIN,
    RINGS,
    STRIPES,
    Textures,
    cells,
    gradient_noise,
    hash_cell,
    octave_noise,
    pattern_weight,
    wave,
)

PATTERNS = (PLAIN, PATCHES, CRACKS, DOTS, CLOUDS, STRIPES, RINGS, CHECKER)
POINTS = 20000


def random_points(generator: torch.Generator, count: int = POINTS, extent: float = 200.0) -> Tensor:
    return extent * (torch.rand(3, count, generator=generator) - 0.5)


def one_texture(pattern: int, **changes: float) -> Textures:
    """Slot 0 of ``pattern`` in pattern space itself: a cell is one unit."""
    values = {"warp": 0.0, "threshold": 0.4, "edge": 0.1} | changes
    one = {name: torch.tensor([value]) for name, value in values.items()}
    transform = torch.eye(3, 4)[None]
    whole = {"seed": torch.tensor([77]), "octaves": torch.tensor([3])}
    return Textures(torch.ones(1, 3), torch.ones(1), torch.tensor([pattern]), transform, **whole, **one)


def weigh(texture: Textures, points: Tensor) -> Tensor:
    return pattern_weight(texture, torch.zeros(points.shape[1], dtype=torch.long), points[..., None])[0, :, 0]


def test_the_hash_is_lowbias32() -> None:
    """Of the origin it is the published function of the seed, here in plain integers."""

    def lowbias32(x: int) -> int:
        x ^= x >> 16
        x = x * 0x7FEB352D % 2**32
        x ^= x >> 15
        x = x * 0x846CA68B % 2**32
        return x ^ x >> 16

    seeds = [0, 1, 2, 12345, 2**31 - 1]
    found = hash_cell(torch.zeros(3, len(seeds), dtype=torch.long), torch.tensor(seeds))
    assert found.tolist() == [lowbias32(seed) for seed in seeds]


def test_hashes_are_uniform_and_independent(generator: torch.Generator) -> None:
    """Every bit is set half of the time, and neighbours in space and seed share half of their bits."""
    lattice = torch.randint(-500, 500, (3, POINTS), generator=generator)
    seed = torch.randint(2**31, (POINTS,), generator=generator)
    h = hash_cell(lattice, seed)
    others = [hash_cell(lattice + step.view(3, 1), seed) for step in torch.eye(3, dtype=torch.long)]
    tolerance = SIGMAS * 0.5 / math.sqrt(POINTS)
    for bits in (h, *(h ^ other for other in others), h ^ hash_cell(lattice, seed + 1)):
        for k in range(32):
            assert abs(float((bits >> k & 1).float().mean()) - 0.5) < tolerance


def test_noise_is_zero_on_the_lattice_and_continuous_across_it(generator: torch.Generator) -> None:
    """Perlin's noise vanishes at whole points; a small step across a cell's border changes it little."""
    seed = torch.randint(2**31, (POINTS,), generator=generator)
    points = random_points(generator)
    assert float(gradient_noise(points.round(), seed).abs().max()) == 0
    border = points.clone()
    border[0] = border[0].round()
    step = torch.tensor([[1e-3], [0.0], [0.0]])
    before, after = gradient_noise(border - step, seed), gradient_noise(border + step, seed)
    assert float((before - after).abs().max()) < 0.01


def test_noise_has_its_spread(generator: torch.Generator) -> None:
    """Mean 0 and a standard deviation of about 0.3, with more octaves more."""
    points, seed = random_points(generator), torch.randint(2**31, (POINTS,), generator=generator)
    spreads = []
    for octaves in (1, 4):
        noise = octave_noise(points, seed, torch.full((POINTS,), octaves))
        assert abs(float(noise.mean())) < SIGMAS * 0.35 / math.sqrt(POINTS)
        assert float(noise.abs().max()) < 1.6
        spreads.append(float(noise.std()))
    assert 0.25 < spreads[0] < spreads[1] < 0.36


def test_the_nearest_centre_is_the_nearest(generator: torch.Generator) -> None:
    """Distances agree with a search over 5 x 5 x 5 cells; no shade leaves [0, 1)."""
    points, seed = random_points(generator, 500, 40.0), torch.full((500,), 9)
    first, second, shade, other = cells(points, seed)
    steps = torch.stack(torch.meshgrid(*[torch.arange(-2, 3)] * 3, indexing="ij")).reshape(3, 125, 1)
    lattice = (points.floor().long()[:, None] + steps).reshape(3, -1)
    offsets = torch.stack(textures.hash_fractions(hash_cell(lattice, torch.full((lattice.shape[1],), 9)), points))
    distance = (lattice + offsets - points.repeat(1, 125)).square().sum(dim=0).sqrt().view(125, 500)
    nearest = distance.sort(dim=0).values
    torch.testing.assert_close(first, nearest[0], rtol=0, atol=1e-4)
    torch.testing.assert_close(second, nearest[1], rtol=0, atol=1e-4)
    for values in (shade, other):
        assert float(values.min()) >= 0 and float(values.max()) < 1
        assert abs(float(values.mean()) - 0.5) < 0.1


@pytest.mark.parametrize("pattern", PATTERNS)
def test_weights_are_continuous(pattern: int, generator: torch.Generator) -> None:
    """Weights lie in [0, 1], reach both ends but for a plain slot, and never jump, in any direction, over cells too."""
    texture = one_texture(pattern, edge=0.3, threshold=0.4 if pattern != CLOUDS else 0.0)
    points = random_points(generator, extent=40.0)
    points[:, ::2] = points[:, ::2].round()
    weight = weigh(texture, points)
    assert float(weight.min()) >= 0 and float(weight.max()) <= 1
    if pattern == PLAIN:
        assert float(weight.max()) == 0
        return
    assert float(weight.min()) < 0.1 and float(weight.max()) > 0.9
    step = 2e-4 * torch.randn(3, POINTS, generator=generator)
    # Slivers: where three patches meet, and where the second nearest centre is two cells away.
    share = 0.001 if pattern in (PATCHES, CRACKS) else 0
    assert float(((weigh(texture, points + step) - weight).abs() > 0.02).float().mean()) <= share


def test_stripes_and_checkers_lie_where_they_should() -> None:
    """Stripes repeat every cell along x alone; cubes of a checker differ from all their neighbours."""
    at = torch.tensor([[0.0, 3.3, 1.2], [0.5, 3.3, 1.2], [1.0, -8.0, 0.1], [7.5, 0.0, 0.0]]).T
    assert weigh(one_texture(STRIPES), at).tolist() == [1, 0, 1, 0]
    centre = torch.tensor([0.5, 0.5, 0.5]) + 0.5
    steps = torch.cat([torch.zeros(1, 3), torch.eye(3), 2 * torch.eye(3)])
    found = weigh(one_texture(CHECKER), (centre + steps).T)
    assert found[0] == found[4] == found[5] == found[6]
    assert found[1] == found[2] == found[3] == 1 - found[0]
    assert wave(torch.tensor([0.0, 0.25, 0.5, -1.25, 4.0])).tolist() == [1, 0.5, 0, 0.5, 1]


def test_rings_and_dots_are_round(generator: torch.Generator) -> None:
    """Without noise rings depend on the distance to their axis; a dot is where its centre is near."""
    points = random_points(generator, extent=10.0)
    turned = torch.stack([-points[1], points[0], points[2] + 3])
    torch.testing.assert_close(weigh(one_texture(RINGS), turned), weigh(one_texture(RINGS), points))
    near = cells(points, torch.full((POINTS,), 77))[0]
    dots = weigh(one_texture(DOTS), points)
    assert bool((dots[near > 0.4] == 0).all()) and bool((dots[near < 0.3] == 1).all())


@entry
def _weigh_all(table: patterns.PatternTable, slots, positions, weights) -> None:  # type: ignore[no-untyped-def]
    """Weights of points ``[3, N RUN]``, of which every run has one slot."""
    f = np.empty(patterns.NUMBER_ROWS * patterns.RUN, np.float32)
    k = np.empty(patterns.INTEGER_ROWS * patterns.RUN, np.uint32)
    for block in range(slots.size):
        first = block * patterns.RUN
        for axis in range(3):
            for n in range(patterns.RUN):
                f[axis * patterns.RUN + n] = positions[axis, first + n]
        patterns.weigh_run(table, slots[block], patterns.RUN, f, k)
        for n in range(patterns.RUN):
            weights[first + n] = f[n]


def test_the_compiled_twin_has_the_same_bits(generator: torch.Generator) -> None:
    """All patterns of 120 random materials, points on both sides of every axis, none of them one bit apart."""
    materials = random_materials(120, generator)
    assert materials.textures is not None
    assert set(materials.textures.pattern.tolist()) == set(PATTERNS)
    slots = torch.arange(120)
    positions = USUAL_SIZE * (torch.rand(3, 120 * patterns.RUN, generator=generator) - 0.5)
    weights = np.empty(120 * patterns.RUN, np.float32)
    _weigh_all(patterns.pattern_table(materials), slots.numpy(), positions.numpy(), weights)
    expected = pattern_weight(materials.textures, slots.repeat_interleave(patterns.RUN), positions[..., None])
    np.testing.assert_array_equal(weights, expected[0, :, 0].numpy())


def test_plain_materials_have_no_weight() -> None:
    """The table of materials without textures weighs nothing."""
    plain = Materials(torch.ones(1, 3), torch.ones(1), torch.ones(1))
    weights = np.ones(patterns.RUN, np.float32)
    _weigh_all(patterns.pattern_table(plain), np.zeros(1, np.int64), np.ones((3, patterns.RUN), np.float32), weights)
    assert float(np.abs(weights).max()) == 0


def test_counts_and_edges_are_checked() -> None:
    """One value of everything per slot, and edges of some width."""
    good = one_texture(CLOUDS)
    fields = dict(vars(good))
    with pytest.raises(ValueError, match=r"expected warp \[1\] for 1 slots, found \[2\]"):
        Textures(**fields | {"warp": torch.zeros(2)})
    with pytest.raises(ValueError, match=r"expected transform \[1, 3, 4\]"):
        Textures(**fields | {"transform": torch.zeros(1, 3, 3)})
    with pytest.raises(ValueError, match="expected edges above 0"):
        Textures(**fields | {"edge": torch.zeros(1)})
