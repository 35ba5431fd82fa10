"""Patterns of the mosaic's period where samples clip: gone to rounding, and every other pixel as it was."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tolerances import assert_close

from polsep.bench.period import measure_pattern
from polsep.physics.stokes import Stokes
from polsep.pipeline import separate_capture
from polsep.sensor.camera import PERIOD, Layout, Mosaic
from polsep.separation.analytic import Separation
from polsep.separation.clipped_pattern import REACH, smooth_clipped, smooth_separation, taps_of
from polsep.separation.images import FrameImages, Tally

CELLS, WHITE = 48, 4095
LIGHT = (0.5, 1.0, 0.7)
COLOR, MONO = Layout(), Layout(bayer=None)
#: Layouts and pixels per cell whose images can show a pattern.
CASES = [(COLOR, 1), (COLOR, 2), (MONO, 1), (MONO, 2)]
#: Cells in the middle of the frame, where samples clip.
SKY = slice(12, 36)


def frame(layout: Layout, analysers: int = 4, cells: slice = SKY) -> Mosaic:
    """A dark frame in which samples of so many analysers clip in all of some rows and columns of cells."""
    data = np.full((2 * CELLS, 2 * CELLS), 100, np.uint16)
    for i, j in ((0, 0), (1, 1), (0, 1), (1, 0))[:analysers]:
        data[2 * cells.start + i : 2 * cells.stop : 2, 2 * cells.start + j : 2 * cells.stop : 2] = WHITE
    return Mosaic(data, layout, 0.0, float(WHITE))


def images_of(image: NDArray[Any]) -> FrameImages:
    """The image as the diffuse one and twice it as the specular one, with sums over white light."""
    diffuse = image.astype(np.float32)
    white = (diffuse / np.float32(LIGHT[: diffuse.shape[2]])).mean(axis=2)
    tally = Tally(pixels=white.size, s0=3 * float(white.sum()), specular=2 * float(white.sum()))
    return FrameImages(diffuse, 2 * diffuse, np.ones(diffuse.shape[:2], np.bool_), tally=tally)


def dots(layout: Layout, scale: int) -> NDArray[Any]:
    """An image that is another random number at every place of the mosaic's period, the same in all periods."""
    period = PERIOD * scale // 2
    random = np.random.default_rng(5).uniform(0, 1, (period, period, layout.channels))
    return np.tile(random, (CELLS * scale // period, CELLS * scale // period, 1))


def inside(scale: int, margin: int) -> slice:
    """Rows or columns of pixels at least so many cells inside of `SKY`."""
    return slice(scale * (SKY.start + margin), scale * (SKY.stop - margin))


@pytest.mark.parametrize(
    ("layout", "scale", "analysers"),
    [(*case, 4) for case in CASES] + [(*case, 2) for case in CASES] + [(MONO, 1, 1), (MONO, 2, 1)],
)
def test_what_repeats_with_the_mosaic_is_gone(layout: Layout, scale: int, analysers: int) -> None:
    """Its mean over a period is left where half of the samples clip, in mono a quarter; nothing changes far away."""
    before = dots(layout, scale)
    found = smooth_clipped(images_of(before), frame(layout, analysers), LIGHT)
    deep = inside(scale, PERIOD // 2 + REACH)
    mean = before.mean(axis=(0, 1))
    np.testing.assert_allclose(
        found.diffuse[deep, deep], np.broadcast_to(mean, found.diffuse[deep, deep].shape), atol=1e-6
    )
    np.testing.assert_allclose(found.specular, 2 * found.diffuse, atol=1e-6)
    plain = smooth_clipped(replace(images_of(before), tally=None), frame(layout, analysers), LIGHT)
    assert np.array_equal(plain.diffuse, found.diffuse) and plain.tally is None
    far = inside(scale, -PERIOD // 2 - 1)
    outside = np.ones(before.shape[:2], np.bool_)
    outside[far, far] = False
    assert np.array_equal(found.diffuse[outside], before.astype(np.float32)[outside])


@pytest.mark.parametrize(("layout", "scale"), CASES)
def test_even_and_sloping_light_stays(layout: Layout, scale: int) -> None:
    """The filter keeps constants and planes: its taps are symmetric and sum to one."""
    rows, cols = np.mgrid[: CELLS * scale, : CELLS * scale] / CELLS
    plane = np.stack([0.3 + 0.2 * rows + 0.1 * cols] * layout.channels, axis=-1)
    found = smooth_clipped(images_of(plane), frame(layout), LIGHT)
    np.testing.assert_allclose(found.diffuse, plane, atol=1e-6)


def test_the_filter_is_zero_at_the_frequencies_of_its_period() -> None:
    """And the response to light that does not vary is one."""
    for period in (2, 4):
        response = np.fft.fft(taps_of(period), 64)
        assert response[0] == pytest.approx(1)
        np.testing.assert_allclose(response[:: 64 // period][1:], 0, atol=1e-15)


@pytest.mark.parametrize(("layout", "scale"), CASES)
def test_small_highlights_of_one_analyser_stay(layout: Layout, scale: int) -> None:
    """A quarter of the samples of a few cells is no reason to smooth; images keep every bit."""
    before = images_of(dots(layout, scale))
    few = frame(layout, 1, slice(20, 20 + 2 * REACH))
    found = smooth_clipped(images_of(dots(layout, scale)), few, LIGHT)
    assert np.array_equal(found.diffuse, before.diffuse) and found.tally == before.tally


@pytest.mark.parametrize(("layout", "scale"), CASES)
@pytest.mark.parametrize("analysers", [4, 2, 1])
def test_kernels_and_tensors_agree(layout: Layout, scale: int, analysers: int) -> None:
    """In batches too, at the border, and on frames that do not begin with a cell."""
    data = np.random.default_rng(5).uniform(0, 1, (CELLS * scale, CELLS * scale, layout.channels))
    planes = torch.from_numpy(data.astype(np.float32)).movedim(-1, 0)
    capture = frame(layout, analysers, slice(30, CELLS))
    for mosaic in (capture, replace(capture, data=np.pad(capture.data, 1), layout=layout.rolled(1, 1))):
        one = smooth_clipped(images_of(data), mosaic, LIGHT)
        batch = torch.stack([planes, 0.5 * planes])
        valid = torch.ones(2, *planes.shape[1:], dtype=torch.bool)
        apart = Separation(batch, 2 * batch, valid, Stokes(3 * batch, batch, batch))
        frames = torch.from_numpy(np.stack([mosaic.data] * 2))
        two = smooth_separation(apart, replace(mosaic, data=frames))
        changes = not np.array_equal(one.diffuse, data.astype(np.float32))
        assert changes is (analysers > 1 or layout is MONO)
        for k, factor in enumerate((1, 2)):
            assert_close(two.diffuse[k].movedim(0, -1) * factor, torch.from_numpy(one.diffuse))
            assert_close(two.specular[k].movedim(0, -1) * factor, torch.from_numpy(one.specular))
        assert two.stokes is apart.stokes


@pytest.mark.parametrize("layout", [COLOR, MONO])
def test_the_order_of_samples_in_memory_changes_nothing(layout: Layout) -> None:
    mosaic = frame(layout)
    turned = replace(mosaic, data=np.asfortranarray(mosaic.data))
    plain, other = (smooth_clipped(images_of(dots(layout, 1)), each, LIGHT) for each in (mosaic, turned))
    assert (plain.diffuse == other.diffuse).all() and plain.tally == other.tally


@pytest.mark.parametrize(("layout", "scale"), CASES)
def test_sums_are_those_of_the_images(layout: Layout, scale: int) -> None:
    """Of white light, means over colours, as the report has them."""
    found = smooth_clipped(
        images_of(np.random.default_rng(6).uniform(0, 1, dots(layout, scale).shape)), frame(layout), LIGHT
    )
    gain = np.float32(LIGHT[: layout.channels])
    assert found.tally is not None
    assert found.tally.s0 == pytest.approx(((found.diffuse + found.specular) / gain).mean(axis=2).sum(dtype=np.float64))
    assert found.tally.specular == pytest.approx((found.specular / gain).mean(axis=2).sum(dtype=np.float64))


@pytest.mark.parametrize("method", ["joint", "joint-fast"])
@pytest.mark.parametrize(("layout", "full"), [(COLOR, False), (COLOR, True), (MONO, False), (MONO, True)])
def test_a_clipped_sky_has_no_grid(method: str, layout: Layout, full: bool) -> None:
    """Three of four analysers clip in all of a frame, noise in the last: a pattern of less than 0.2 % of the image."""
    generator = np.random.default_rng(7)
    data = np.full((256, 256), WHITE, np.uint16)
    data[1::2, 1::2] = generator.normal(3000, 30, (128, 128)).astype(np.uint16)
    out = separate_capture(Mosaic(data, layout, 0.0, float(WHITE)), method, "white", full=full)
    period = PERIOD if full else PERIOD // 2
    for image in (out.diffuse, out.specular):
        assert measure_pattern(torch.from_numpy(image).permute(2, 0, 1), period).amplitude < 2e-3
