"""The analytic kernel for full resolution against its twin: layouts, sizes, dtypes, borders, clipped samples, sums."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from test_kernels_analytic import (
    ANGLE,
    LAYOUTS,
    ROUNDING,
    SONY,
    UNUSUAL,
    assert_agrees,
    assert_same,
    random_codes,
    spec,
    twin,
)
from tolerances import assert_within

from polsep.compute.threads import get_threads, set_threads
from polsep.io.raw.genicam import pack_frame
from polsep.kernels import AnalyticImages, AnalyticOptions, PackedFrame, separate_analytic_full
from polsep.sensor.camera import Layout
from polsep.separation.report import images_of, in_light, tally

WHITE_LIGHT, LIGHT = (1.0, 1.0, 1.0), (0.8, 1.0, 1.3)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny frames: on a busy machine a second thread waits longer than the first one works."""
    threads = get_threads()
    set_threads(1)
    yield
    set_threads(threads)


@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[5], Layout(SONY, None)], ids=spec)
def test_one_clipped_sample_marks_what_it_touches(layout: Layout) -> None:
    """Wherever the one clipped sample lies, border included, the same pixels lose validity as in the twin."""
    for row in range(10):
        for col in range(10):
            raw = np.full((10, 10), 0.5, np.float32)
            raw[row, col] = 1
            assert_agrees(raw, layout, full=True)


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_uniform_polarized_field_is_exact_to_the_border(layout: Layout) -> None:
    """A uniform field gives one diffuse and one specular value: nothing is invented at borders."""
    angles = np.array([[layout.filter_at(row, col).angle_deg for col in range(11)] for row in range(9)])
    raw = 0.5 * (0.8 + 0.3 * np.cos(2 * np.radians(angles - 25)))
    images = separate_analytic_full(raw.astype(np.float32), layout, 0.0, 1.0)
    assert images.diffuse.shape[:2] == tuple(
        (n - start) // 2 * 2 for n, start in zip((9, 11), layout.origin, strict=True)
    )
    assert_within(torch.from_numpy(images.specular), 0.3, ROUNDING)
    assert_within(torch.from_numpy(images.diffuse), 0.5, ROUNDING)


def test_samples_stay_where_they_are() -> None:
    """Of one bright sample, its own pixel has what its own filter alone says, whatever is around."""
    layout = Layout(UNUSUAL, None)
    for row, col in ((4, 4), (4, 5), (5, 4), (5, 5)):
        raw = np.zeros((10, 10), np.float32)
        raw[row, col] = 0.8
        images = separate_analytic_full(raw, layout, 0.0, 1.0)
        alone = twin(raw, layout, (0.0, 1.0), WHITE_LIGHT, full=True).stokes.s0[0, row, col]
        total = images.diffuse + images.specular
        assert_within(torch.tensor(total[row, col, 0]), max(float(alone), 0.0), ROUNDING)
        assert float(total.max()) == pytest.approx(float(total[row, col, 0]))


@pytest.mark.parametrize("layout", [LAYOUTS[1], LAYOUTS[6], Layout(SONY, None)], ids=spec)
def test_light_color_is_divided_out_and_multiplied_back(layout: Layout) -> None:
    """As `Mosaic.light_color` and, on demand, as the pipeline's `in_light`."""
    raw = random_codes((17, 23), clipped=0.01)
    expected = twin(raw, layout, (1000.0, 65535.0), LIGHT, full=True)
    found = separate_analytic_full(raw, layout, 1000, 65535, AnalyticOptions(LIGHT))
    assert_same(found, expected, ROUNDING / min(LIGHT))
    found = separate_analytic_full(raw, layout, 1000, 65535, AnalyticOptions(LIGHT, in_light=True))
    assert_same(found, in_light(expected, LIGHT[: layout.channels]), ROUNDING * max(LIGHT))


@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[6], LAYOUTS[8], Layout(SONY, None)], ids=spec)
def test_reports_as_the_twin_does(layout: Layout) -> None:
    """DoLP, AoLP where it is defined, and every sum over the frame, of white light; the counts exactly."""
    raw = random_codes((71, 61), clipped=0.01)
    white = twin(raw, layout, (25_000.0, 65535.0), LIGHT, full=True)
    options = AnalyticOptions(LIGHT, in_light=True, report=True)
    images, expected = separate_analytic_full(raw, layout, 25_000, 65535, options), images_of(white, white)
    assert images.dolp is not None and images.aolp is not None
    assert expected.dolp is not None and expected.aolp is not None
    lit = white.stokes.s0.mean(dim=0).numpy() > 0.05  # noise about black has any DoLP
    np.testing.assert_allclose(images.dolp[lit], expected.dolp[lit], atol=2e-5)
    away = np.abs((images.aolp - expected.aolp + math.pi / 2) % math.pi - math.pi / 2)
    assert float((away * np.minimum(expected.dolp, 1)).max()) < 2 * ANGLE
    found, sums = images.tally, tally(white)
    assert found is not None and found.clipped > 0 and found.above_one > 0
    for name in ("pixels", "clipped", "valid", "above_one", "residual", "noise"):
        assert getattr(found, name) == getattr(sums, name)
    for name in ("s0", "specular", "power", "along", "across"):
        assert getattr(found, name) == pytest.approx(getattr(sums, name), rel=1e-5, abs=1e-5 * sums.power)


@pytest.mark.parametrize("name", ["Mono12Packed", "BayerRG12p"])
def test_packed_frames_agree_with_unpacked_ones(name: str) -> None:
    """GenICam's two 12-bit packings, bit for bit."""
    layout = Layout(SONY, None if name.startswith("Mono") else "RGGB")
    codes = random_codes((9, 13), clipped=0.02) >> 4
    data = np.frombuffer(pack_frame(codes, name), np.uint8)
    packed = PackedFrame(data, 9, 13, "gige" if name.endswith("Packed") else "lsb")
    found, expected = (separate_analytic_full(raw, layout, 64, 4095) for raw in (packed, codes))
    np.testing.assert_array_equal(found.diffuse, expected.diffuse)
    np.testing.assert_array_equal(found.valid, expected.valid)


def test_threads_do_not_change_a_bit() -> None:
    """With one thread and with more than there are strips, into fresh and into given images."""
    raw = random_codes((150, 90), clipped=0.002)
    expected = separate_analytic_full(raw, Layout(), 0, 65535, AnalyticOptions(report=True))
    out = AnalyticImages.empty((150, 90), Layout(), report=True, full=True)
    for count in (1, 2, 3, 7):
        set_threads(count)
        found = separate_analytic_full(raw, Layout(), 0, 65535, AnalyticOptions(report=True, out=out))
        assert found.diffuse is out.diffuse and found.dolp is out.dolp
        assert found.tally == expected.tally
        for name in ("diffuse", "specular", "valid", "dolp", "aolp"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_bad_frames_and_images_are_refused() -> None:
    """As at half resolution; images of half the size do not fit."""
    with pytest.raises(ValueError, match="uint8, uint16 or float32, found float64"):
        separate_analytic_full(np.zeros((8, 8)), Layout(), 0, 1)
    half = AnalyticImages.empty((8, 8), Layout())
    with pytest.raises(ValueError, match="expected diffuse to be"):
        separate_analytic_full(np.zeros((8, 8), np.uint8), Layout(), 0, 255, AnalyticOptions(out=half))
