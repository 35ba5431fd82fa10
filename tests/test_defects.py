"""Defects are found and repaired; light, however sharp, is left alone."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import polsep
from polsep.physics.stokes import Stokes
from polsep.render.distances import random_light, random_parts
from polsep.render.simulate import blur
from polsep.render.sphere_tracing import PinholeCamera, Scene, render
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, Sensor, expose
from polsep.sensor.defects import (
    find_defects,
    find_defects_reference,
    find_lasting_defects,
    remove_defects,
    repair,
    repair_reference,
)

COLOR, MONO = Layout(), Layout(bayer=None)
SIZE = 96
#: Hot, dead and stuck pixels: inside, in corners, on borders, next to each other and next to one of their kind.
DEFECTS = {
    (40, 41): 4095.0,
    (30, 60): 0.0,
    (50, 20): 2600.0,
    (0, 0): 3500.0,
    (SIZE - 1, 3): 0.0,
    (1, SIZE - 2): 4000.0,
    (70, 70): 0.0,
    (70, 71): 0.0,
    (60, 40): 3000.0,
    (60, 44): 3300.0,
    (80, 20): 4095.0,
    (81, 21): 3900.0,
}


def smooth_light(channels: int) -> Stokes:
    """Bright polarized light that changes slowly and differs by colour."""
    across = torch.linspace(0.0, 1.0, SIZE).expand(SIZE, SIZE)
    s0 = torch.stack([0.3 + (0.3 + 0.1 * c) * across + 0.2 * across.T for c in range(channels)])
    return Stokes(s0, 0.3 * s0 * across.T, 0.2 * s0 * (1 - across))


def frame_of(layout: Layout, seed: int = 1, sensor: Sensor = IMX250, exposure: float = 1.0) -> Mosaic:
    return expose(smooth_light(layout.channels) * exposure, layout, sensor, torch.Generator().manual_seed(seed))


def with_samples(mosaic: Mosaic, samples: dict[tuple[int, int], float]) -> Mosaic:
    data = mosaic.data.clone()
    for place, value in samples.items():
        data[place] = value
    return Mosaic(data, mosaic.layout, mosaic.black_level, mosaic.white_level)


def places(mask: NDArray[np.bool_]) -> set[tuple[int, int]]:
    return {(int(i), int(j)) for i, j in np.argwhere(mask)}


@cache
def objects(size: int, sigma: float, seed: int) -> Stokes:
    """Shiny objects on black under one polarized light, behind a lens."""
    generator = torch.Generator().manual_seed(seed)
    diffuse, specular = render(random_parts(generator, 4), PinholeCamera(), random_light(generator), (size, size))
    scene = blur(Scene(diffuse, specular, torch.ones(size, size, dtype=torch.bool)), sigma)
    return scene.diffuse + scene.specular


@pytest.mark.parametrize("layout", [COLOR, MONO, Layout(bayer="GBRG", origin=(0, 1))], ids=lambda layout: layout.spec)
def test_defects_are_found_and_nothing_else(layout: Layout) -> None:
    """All kinds of defects, clusters of two and those on borders are found; repaired samples are off by noise only."""
    clean = frame_of(layout)
    broken = with_samples(clean, DEFECTS)
    assert places(find_defects(broken)) == set(DEFECTS)
    repaired, count = remove_defects(broken)
    assert count == len(DEFECTS)
    noise = float((clean.data - frame_of(layout, 2).data).std())
    assert max(abs(float(repaired.data[p] - clean.data[p])) for p in DEFECTS) < 5 * noise
    others = torch.ones(clean.data.shape, dtype=torch.bool)
    others[tuple(np.array(list(DEFECTS)).T)] = False
    assert torch.equal(repaired.data[others], clean.data[others])


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_even_light_is_repaired_exactly(layout: Layout) -> None:
    """In even light of any colour and polarization the repaired sample is the true one, up to the border."""
    s0 = torch.tensor([0.9, 0.5, 0.3])[: layout.channels, None, None].expand(-1, 24, 28)
    clean = expose(Stokes(s0, 0.4 * s0, -0.3 * s0.flip(0)), layout, IDEAL)
    mask = np.zeros((24, 28), np.bool_)
    mask[[0, 0, 11, 12, 12, 23, 23], [0, 9, 13, 13, 17, 27, 4]] = True
    broken = Mosaic(torch.where(torch.from_numpy(mask), 5.0, clean.data), layout, 0.0, 1.0)
    assert float((repair(broken, mask).data - clean.data).abs().max()) < 2e-5


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
@pytest.mark.parametrize("exposure", [1.0, 0.05, 0.002])
def test_clean_frames_are_left_alone(layout: Layout, exposure: float) -> None:
    """Nothing is found on smooth light at any noise level, nor on sharp objects on black, and the frame is the same."""
    light = objects(128, 0.6, 1)
    light = light if layout is COLOR else light.map(lambda s: s[1:2])
    for full_well, bits in ((10_500.0, 12), (2_600.0, 12), (10_500.0, 8)):
        sensor = Sensor(full_well, 2.4, bits)
        sharp = expose(light * exposure, layout, sensor, torch.Generator().manual_seed(3))
        for clean in (frame_of(layout, 1, sensor, exposure), sharp):
            same, count = remove_defects(clean)
            assert same is clean and count == 0


def test_points_of_light_behind_a_lens_are_no_defects() -> None:
    """A white point on any part of a pixel shines on its neighbours too, if the lens is as good as lenses are."""
    generator = torch.Generator().manual_seed(4)
    light = smooth_light(3) * 0.1
    for row in range(8, SIZE - 8, 8):
        for col in range(8, SIZE - 8, 8):
            y, x, angle = torch.rand(3, generator=generator).tolist()
            edges = torch.arange(-3, 5)
            along = [torch.special.ndtr((edges - place) / 0.4).diff() for place in (y, x)]
            at = (..., slice(row - 3, row + 4), slice(col - 3, col + 4))
            spot = 2.0 * torch.outer(*along)
            light.s0[at] += spot
            light.s1[at] += 0.8 * spot * math.cos(math.pi * angle)
            light.s2[at] += 0.8 * spot * math.sin(math.pi * angle)
    assert np.count_nonzero(find_defects(expose(light, COLOR, IMX250, generator))) <= 2


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_mirrored_frames_have_mirrored_defects(layout: Layout) -> None:
    """Mirroring and transposing frame and layout mirrors and transposes the mask."""
    broken = with_samples(frame_of(layout), DEFECTS)
    mask = find_defects(broken)
    turned = Mosaic(broken.data.flip(-1), layout.flipped_horizontal(SIZE), 0.0, broken.white_level)
    assert np.array_equal(find_defects(turned), mask[:, ::-1])
    turned = Mosaic(broken.data.T.contiguous(), layout.transposed(), 0.0, broken.white_level)
    assert np.array_equal(find_defects(turned), mask.T)


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_kernels_agree_with_their_twins(layout: Layout) -> None:
    """In a small frame of textures and highlights with defects, both find the same and repair alike."""
    light = objects(64, 0.6, 2)
    light = light if layout is COLOR else light.map(lambda s: s[1:2])
    clean = expose(light, layout, IMX250, torch.Generator().manual_seed(5))
    rows, cols = np.random.default_rng(6).integers(0, 64, (2, 12))
    broken = with_samples(clean, {(int(i), int(j)): 400.0 * k for k, (i, j) in enumerate(zip(rows, cols, strict=True))})
    mask = find_defects_reference(broken)
    assert np.count_nonzero(mask) >= 6
    assert np.array_equal(find_defects(broken) & mask, mask)
    by_kernel, by_twin = repair(broken, mask).data, repair_reference(broken, mask).data
    assert float((by_kernel - by_twin).abs().max()) < 0.05


def test_lasting_defects_are_those_of_most_frames() -> None:
    """In a recording a spot that two of three frames lack is no defect, one that a frame hides is."""
    frames = [with_samples(frame_of(MONO, seed), {(40, 40): 4000.0}) for seed in (1, 2)]
    frames.append(with_samples(frame_of(MONO, 3), {(20, 30): 4000.0}))
    mask = find_lasting_defects(frames)
    assert mask is not None and places(mask) == {(40, 40)}
    assert find_lasting_defects([]) is None


def test_the_pipeline_repairs_and_reports() -> None:
    """`separate` gives nearly what it gives without the defects, counts them, and tells of many."""
    clean = frame_of(COLOR)
    broken = with_samples(clean, DEFECTS)
    raw = (frame.data.numpy().astype(np.uint16) for frame in (clean, broken))
    with pytest.warns(polsep.PolsepWarning, match="12 dead or hot pixels"):
        expected, out = (polsep.separate(x, "analytic", white_level=4095) for x in raw)
    assert (expected.report["defects"], out.report["defects"]) == (0, 12)
    assert float(np.abs(out.diffuse - expected.diffuse).max()) < 0.03


def test_bad_input() -> None:
    """Batches and masks of another size are refused."""
    frame = frame_of(MONO)
    with pytest.raises(ValueError, match="expected one frame"):
        find_defects(Mosaic(frame.data[None], MONO, 0.0, 4095.0))
    with pytest.raises(ValueError, match="mask of its size"):
        repair(frame, np.zeros((8, 8), np.bool_))
    assert not find_defects(Mosaic(torch.rand(8, 8), MONO, 0.0, 1.0)).any()
