"""The fused analytic kernels against their twin: every layout, size, dtype, packing and border, clipped samples too."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tolerances import assert_within

from polsep import kernels
from polsep.compute import library
from polsep.compute.threads import get_threads, set_threads
from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half
from polsep.demosaic.bilinear_kernel import clip_code
from polsep.io.raw.genicam import pack_frame
from polsep.kernels import AnalyticImages, AnalyticOptions, PackedFrame, separate_analytic_full, separate_analytic_half
from polsep.methods import compose
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import BAYER_ORDERS, CLIP_MARGIN, Layout, Mosaic
from polsep.separation import analytic_kernel as analytic
from polsep.separation.analytic import Separation, separate_analytic
from polsep.separation.report import images_of, in_light, tally

SONY = ((90, 45), (135, 0))
PERMUTED = ((0, 135), (45, 90))
UNUSUAL = ((10, 75), (200, -30))
LIGHT = (0.8, 1.0, 1.3)
WHITES = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0}
ROUNDING = 2e-6  # of white: float32, summed in another order
ANGLE = 1e-5  # [rad], the polynomial's arctangent

LAYOUTS = [
    *(Layout(SONY, bayer) for bayer in BAYER_ORDERS),
    *(Layout(SONY, "GRBG", origin) for origin in ((0, 1), (1, 0), (1, 1))),
    Layout(PERMUTED, "BGGR"),
    Layout(UNUSUAL, "RGGB"),
    Layout(SONY, None),
    Layout(UNUSUAL, None),
]
#: Kernels by their resolution.
KERNELS = {"half": separate_analytic_half, "full": separate_analytic_full}
RESOLUTIONS = pytest.mark.parametrize("full", [False, True], ids=KERNELS)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Tiny frames: on a busy machine a second thread waits longer than the first one works."""
    threads = get_threads()
    set_threads(1)
    yield
    set_threads(threads)


def spec(layout: Layout) -> str:
    return layout.spec


def random_codes(shape: tuple[int, int], dtype: str = "uint16", clipped: float = 0.0, seed: int = 0) -> NDArray[Any]:
    """Independent samples up to 0.95 of white, and a fraction of clipped ones."""
    rng = np.random.default_rng(seed)
    samples = 0.95 * rng.random(shape)
    samples[rng.random(shape) < clipped] = 1
    return (samples * WHITES[dtype]).astype(dtype)


def twin(
    raw: NDArray[Any], layout: Layout, levels: tuple[float, float], light: tuple[float, ...], full: bool = False
) -> Separation:
    mosaic = Mosaic(torch.from_numpy(raw.astype(np.float32)), layout, *levels, light)
    return compose(demosaic_bilinear if full else demosaic_bilinear_half, separate_analytic)(mosaic)


def assert_same(images: AnalyticImages, expected: Separation, tolerance: float = ROUNDING) -> None:
    """Images to rounding, the mask exactly."""
    assert_within(torch.from_numpy(images.diffuse), expected.diffuse.movedim(-3, -1), tolerance)
    assert_within(torch.from_numpy(images.specular), expected.specular.movedim(-3, -1), tolerance)
    np.testing.assert_array_equal(images.valid, expected.valid.numpy())


def separate(full: bool, *given: Any) -> AnalyticImages:
    """What the kernel of a resolution makes of a frame."""
    return KERNELS["full" if full else "half"](*given)


def assert_agrees(
    raw: NDArray[Any], layout: Layout, black: float = 0.0, white: float | None = None, full: bool = False
) -> AnalyticImages:
    levels = black, WHITES[str(raw.dtype)] if white is None else white
    images = separate(full, raw, layout, *levels)
    assert_same(images, twin(raw, layout, levels, (1.0, 1.0, 1.0), full))
    return images


@RESOLUTIONS
@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_every_layout_and_size_agrees(layout: Layout, full: bool) -> None:
    """From one period on, odd sizes too, with and without clipped samples, within a strip and across strips."""
    top, left = layout.origin
    for seed, (height, width) in enumerate(
        ((4, 4), (4, 6), (6, 4), (5, 7), (6, 6), (9, 11), (8, 70), (67, 9), (134, 6))
    ):
        shape = (max(height, layout.period + top), max(width, layout.period + left))
        assert_agrees(random_codes(shape, seed=seed), layout, full=full)
        assert_agrees(random_codes(shape, clipped=0.03, seed=seed), layout, full=full)


@RESOLUTIONS
@given(
    st.sampled_from(LAYOUTS),
    st.tuples(st.integers(5, 24), st.integers(5, 40)),
    st.sampled_from(sorted(WHITES)),
    st.sampled_from([0.0, 0.02, 0.3, 1.0]),
    st.integers(0, 2**32 - 1),
)
def test_any_frame_agrees(
    full: bool, layout: Layout, shape: tuple[int, int], dtype: str, clipped: float, seed: int
) -> None:
    """Random layouts, sizes, dtypes and numbers of clipped samples, black at a twentieth of white."""
    raw = random_codes(shape, dtype, clipped, seed)
    assert_agrees(raw, layout, black=WHITES[dtype] / 20, full=full)


@RESOLUTIONS
@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[5], Layout(SONY, None)], ids=spec)
def test_one_clipped_sample_marks_what_it_touches(layout: Layout, full: bool) -> None:
    """Wherever the one clipped sample lies, border included, the same pixels lose validity as in the twin."""
    for row in range(10):
        for col in range(10):
            raw = np.full((10, 10), 0.5, np.float32)
            raw[row, col] = 1
            assert_agrees(raw, layout, full=full)


@RESOLUTIONS
@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_uniform_polarized_field_is_exact_to_the_border(layout: Layout, full: bool) -> None:
    """A uniform field gives one diffuse and one specular value, of every whole cell: nothing is invented at borders."""
    angles = np.array([[layout.filter_at(row, col).angle_deg for col in range(11)] for row in range(9)])
    raw = 0.5 * (0.8 + 0.3 * np.cos(2 * np.radians(angles - 25)))
    images = separate(full, raw.astype(np.float32), layout, 0.0, 1.0)
    cells = tuple((n - start) // 2 for n, start in zip((9, 11), layout.origin, strict=True))
    assert images.diffuse.shape[:2] == tuple(2 * n if full else n for n in cells)
    assert_within(torch.from_numpy(images.specular), 0.3, ROUNDING)
    assert_within(torch.from_numpy(images.diffuse), 0.5, ROUNDING)


def test_samples_stay_where_they_are() -> None:
    """Of one bright sample, its own pixel has what its own filter alone says, whatever is around."""
    layout = Layout(UNUSUAL, None)
    for row, col in ((4, 4), (4, 5), (5, 4), (5, 5)):
        raw = np.zeros((10, 10), np.float32)
        raw[row, col] = 0.8
        images = separate_analytic_full(raw, layout, 0.0, 1.0)
        alone = twin(raw, layout, (0.0, 1.0), (1.0, 1.0, 1.0), full=True).stokes.s0[0, row, col]
        total = images.diffuse + images.specular
        assert_within(torch.tensor(total[row, col, 0]), max(float(alone), 0.0), ROUNDING)
        assert float(total.max()) == pytest.approx(float(total[row, col, 0]))


@RESOLUTIONS
@pytest.mark.parametrize("light", [LIGHT, (2.0, 1.0, 0.25)])
@pytest.mark.parametrize("layout", [LAYOUTS[1], LAYOUTS[6], Layout(SONY, None)], ids=spec)
def test_light_color_is_divided_out_and_multiplied_back(layout: Layout, light: tuple[float, ...], full: bool) -> None:
    """As `Mosaic.light_color` and, on demand, as the pipeline's `in_light`."""
    raw = random_codes((17, 23), clipped=0.01)
    expected = twin(raw, layout, (1000.0, 65535.0), light, full)
    found = separate(full, raw, layout, 1000, 65535, AnalyticOptions(light))
    assert_same(found, expected, ROUNDING / min(light))
    found = separate(full, raw, layout, 1000, 65535, AnalyticOptions(light, in_light=True))
    assert_same(found, in_light(expected, light[: layout.channels]), ROUNDING * max(light))


@RESOLUTIONS
@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[6], LAYOUTS[8], Layout(SONY, None)], ids=spec)
def test_dolp_and_aolp_agree_with_the_pipeline(layout: Layout, full: bool) -> None:
    """DoLP and AoLP of the mean over colours in white light; AoLP where it is defined to more than rounding."""
    raw = random_codes((40, 60))
    images = separate(full, raw, layout, 0, 65535, AnalyticOptions(LIGHT, in_light=True, report=True))
    white = twin(raw, layout, (0.0, 65535.0), LIGHT, full)
    expected = images_of(white, white)
    assert expected.dolp is not None and expected.aolp is not None
    assert images.dolp is not None and images.aolp is not None
    assert_within(torch.from_numpy(images.dolp), torch.from_numpy(expected.dolp), 1e-5)
    assert images.aolp.min() >= 0 and images.aolp.max() < np.float32(math.pi)
    away = np.abs((images.aolp - expected.aolp + math.pi / 2) % math.pi - math.pi / 2)
    assert float((away * np.minimum(expected.dolp, 1)).max()) < ANGLE


@RESOLUTIONS
@pytest.mark.parametrize("light", [(1.0, 1.0, 1.0), LIGHT])
@pytest.mark.parametrize("layout", [LAYOUTS[0], LAYOUTS[6], LAYOUTS[8], Layout(SONY, None)], ids=spec)
def test_tally_is_the_twins(layout: Layout, light: tuple[float, ...], full: bool) -> None:
    """Every sum over the frame, of white light whatever the images are in; the counts exactly."""
    raw = random_codes((71, 61), clipped=0.01)
    expected = tally(twin(raw, layout, (25_000.0, 65535.0), light, full))
    options = AnalyticOptions(light, in_light=True, report=True)
    found = separate(full, raw, layout, 25_000, 65535, options).tally
    assert found is not None and found.clipped > 0 and found.above_one > 0
    for name in ("pixels", "clipped", "valid", "above_one", "residual", "noise"):
        assert getattr(found, name) == getattr(expected, name)
    for name in ("s0", "specular", "power", "along", "across"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-5, abs=1e-5 * expected.power)


def test_aolp_is_exact_around_the_circle() -> None:
    """Uniform fields of every AoLP, the axes and diagonals among them; nothing polarized and nothing lit give 0."""
    layout = Layout(SONY, None)
    analysers = np.radians([[90, 45], [135, 0]])
    for degrees in range(0, 180, 3):
        cell = 0.25 * (1 + np.cos(2 * (math.radians(degrees) - analysers)))
        options = AnalyticOptions(report=True)
        images = separate_analytic_half(np.tile(cell, (2, 2)).astype(np.float32), layout, 0, 1, options)
        assert images.dolp is not None and images.aolp is not None
        away = (images.aolp - math.radians(degrees) + math.pi / 2) % math.pi - math.pi / 2
        assert float(np.abs(away).max()) < ANGLE
        assert_within(torch.from_numpy(images.dolp), 1.0, ROUNDING)
    for level in (0, 100):
        frame = np.full((4, 4), level, np.uint8)
        images = separate_analytic_half(frame, layout, 0, 255, AnalyticOptions(report=True))
        assert images.dolp is not None and images.aolp is not None
        assert max(images.dolp.max(), images.aolp.max(), images.specular.max()) <= ROUNDING * level


@RESOLUTIONS
@pytest.mark.parametrize("name", ["Mono12Packed", "BayerRG12Packed", "Mono12p", "BayerRG12p"])
def test_packed_frames_agree_with_unpacked_ones(name: str, full: bool) -> None:
    """GenICam's two 12-bit packings, bit for bit, for odd widths and origins, as a stream and in padded rows."""
    packing = "gige" if name.endswith("Packed") else "lsb"
    mono = name.startswith("Mono")
    layouts = [Layout(SONY, None)] if mono else [Layout(), Layout(SONY, "GBRG", (1, 1)), Layout(SONY, "RGGB", (0, 1))]
    for layout in layouts:
        for height, width in ((5, 5), (6, 7), (8, 8), (9, 13), (7, 50)):
            codes = random_codes((height, width), clipped=0.02) >> 4
            expected = separate(full, codes, layout, 64, 4095)
            stream = np.frombuffer(pack_frame(codes, name), np.uint8)
            rows = [np.frombuffer(pack_frame(row[None], name) + b"\xff" * 5, np.uint8) for row in codes]
            for data in (stream, np.stack(rows)):
                found = separate(full, PackedFrame(data, height, width, packing), layout, 64, 4095)
                np.testing.assert_array_equal(found.diffuse, expected.diffuse)
                np.testing.assert_array_equal(found.specular, expected.specular)
                np.testing.assert_array_equal(found.valid, expected.valid)


@given(st.integers(-100, 1000), st.integers(1, 70_000))
def test_clip_threshold_is_the_twins(black: int, span: int) -> None:
    """The smallest clipped code: it is clipped for `Mosaic`, and the float32 below it is not."""
    code = clip_code(black, black + span)
    below = np.nextafter(code, np.float32(-np.inf))
    data = torch.tensor([[below, code]] * 2)
    clipped = Mosaic(data, Layout(SONY, None), black, black + span).clipped()
    assert clipped.tolist() == [[False, True]] * 2
    assert code == pytest.approx(black + span * (1 - CLIP_MARGIN), rel=1e-4, abs=1e-2)


@RESOLUTIONS
def test_threads_do_not_change_a_bit(full: bool) -> None:
    """With one thread and with more than there are strips, into fresh and into given images."""
    raw = random_codes((150, 90), clipped=0.002)
    expected = separate(full, raw, Layout(), 0, 65535, AnalyticOptions(report=True))
    out = AnalyticImages.empty((150, 90), Layout(), report=True, full=full)
    for count in (1, 2, 3, 7):
        set_threads(count)
        found = separate(full, raw, Layout(), 0, 65535, AnalyticOptions(report=True, out=out))
        assert found.diffuse is out.diffuse and found.dolp is out.dolp
        assert found.tally == expected.tally
        for name in ("diffuse", "specular", "valid", "dolp", "aolp"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_frames_with_gaps_and_read_only_frames_are_taken() -> None:
    """Views, steps, reversed rows and buffers that cannot be written give what their copies give."""
    raw = random_codes((24, 30))
    raw.flags.writeable = False
    for view in (raw, raw[3:19, 5:25], raw[::-1], raw[::2, 1::2], raw.T):
        found = separate_analytic_half(view, Layout(), 0, 65535)
        np.testing.assert_array_equal(found.diffuse, separate_analytic_half(view.copy(), Layout(), 0, 65535).diffuse)


def test_diffuse_and_specular_add_up_to_s0() -> None:
    """Energy: the sum is the s0 of the twin, and both are non-negative, black level above some samples included."""
    raw = random_codes((30, 30))
    images = separate_analytic_half(raw, Layout(), 20_000, 65535)
    stokes: Stokes = twin(raw, Layout(), (20_000.0, 65535.0), (1.0, 1.0, 1.0)).stokes
    total = torch.from_numpy(images.diffuse + images.specular)
    assert_within(total, stokes.s0.clamp(min=0).movedim(-3, -1), ROUNDING)
    assert images.diffuse.min() >= 0 and images.specular.min() >= 0


@pytest.mark.parametrize(
    ("raw", "layout", "levels", "message"),
    [
        (np.zeros((8, 8), np.float64), Layout(), (0, 1), "uint8, uint16 or float32, found float64"),
        (np.zeros((8, 8), ">u2"), Layout(), (0, 1), "found >u2"),
        (np.zeros((8, 8, 3), np.uint8), Layout(), (0, 255), r"\[H, W\], found shape \(8, 8, 3\)"),
        (np.zeros((3, 8), np.uint8), Layout(), (0, 255), "at least 4x4"),
        (np.zeros((4, 8), np.uint8), Layout(origin=(1, 0)), (0, 255), "at least 5x4"),
        (np.zeros((8, 8), np.uint8), Layout(), (255, 255), "expected a white level above the black level"),
        ([[0, 1], [2, 3]], Layout(), (0, 255), "NumPy mosaic or a PackedFrame, found list"),
    ],
)
@RESOLUTIONS
def test_bad_frames_are_refused(
    raw: Any, layout: Layout, levels: tuple[float, float], message: str, full: bool
) -> None:
    """One line of what was expected and what was found."""
    with pytest.raises(ValueError, match=message) as error:
        separate(full, raw, layout, *levels)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("data", "height", "packing", "message"),
    [
        (np.zeros(24, np.uint8), 4, "bits", "packing of gige, lsb"),
        (np.zeros(25, np.uint8), 4, "gige", r"expected \[24\] or"),
        (np.zeros((4, 5), np.uint8), 4, "lsb", "found shape"),
        (np.zeros((3, 6), np.uint8), 4, "lsb", "found shape"),
        (np.zeros(24, np.int8), 4, "lsb", "uint8, found int8"),
        (np.zeros(0, np.uint8), 0, "lsb", "positive height and width"),
    ],
)
def test_bad_packed_frames_are_refused(data: Any, height: int, packing: str, message: str) -> None:
    """A stream holds exactly its pixels, padded rows at least theirs."""
    with pytest.raises(ValueError, match=message):
        PackedFrame(data, height, 4, packing)


@pytest.mark.parametrize("light", [(1.0, 1.0), (1.0, 0.0, 1.0), (1.0, math.nan, 1.0)])
def test_bad_light_colors_are_refused(light: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="light colour of 3 positive numbers"):
        separate_analytic_half(np.zeros((8, 8), np.uint8), Layout(), 0, 255, AnalyticOptions(light))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"layout": "color"}, "expected a polsep.Layout"),
        ({"white_level": None}, "expected a number as white_level"),
        ({"black_level": "0"}, "expected a number as black_level"),
        ({"options": {"report": True}}, "Options, found dict"),
        ({"options": AnalyticOptions("white")}, "light_color as one number per colour"),  # type: ignore[arg-type]
        ({"options": AnalyticOptions(None)}, "light_color as one number per colour"),  # type: ignore[arg-type]
        ({"options": AnalyticOptions(out=np.zeros((4, 4, 3)))}, "found ndarray"),  # type: ignore[arg-type]
    ],
)
@pytest.mark.parametrize("name", ["analytic_half", "analytic_full", "color_affine_half", "color_affine_full"])
def test_wrong_types_are_refused_in_one_line(name: str, given: dict[str, Any], words: str) -> None:
    """An AttributeError of a str was what a layout's name gave."""
    if name.startswith("color") and isinstance(given.get("options"), AnalyticOptions):
        given = {"options": kernels.ColorAffineOptions(**vars(given["options"]) | {"guided": True})}
    usual: dict[str, Any] = {"layout": Layout(), "black_level": 0, "white_level": 255}
    with pytest.raises(TypeError, match=words) as error:
        getattr(kernels, f"separate_{name}")(np.zeros((8, 8), np.uint8), **usual | given)
    assert isinstance(error.value, ValueError) and "\n" not in str(error.value)


def test_bad_images_are_refused() -> None:
    """Given images must fit: shape, dtype, contiguous; a report needs DoLP and AoLP."""
    good = AnalyticImages.empty((8, 8), Layout(), report=True)
    changes: list[dict[str, Any]] = [
        {"diffuse": np.empty((4, 4, 1), np.float32)},
        {"specular": np.empty((4, 4, 3), np.float64)},
        {"valid": np.empty((4, 8), np.bool_)[:, ::2]},
        {"dolp": None},
    ]
    for change in changes:
        with pytest.raises(ValueError, match="expected"):
            separate_analytic_half(
                np.zeros((8, 8), np.uint8),
                Layout(),
                0,
                255,
                AnalyticOptions(report=True, out=AnalyticImages(**vars(good) | change)),
            )
    with pytest.raises(ValueError, match="expected diffuse to be"):
        separate_analytic_full(np.zeros((8, 8), np.uint8), Layout(), 0, 255, AnalyticOptions(out=good))


def test_one_compilation_serves_all_frames() -> None:
    """Dtypes, packings, layouts and read-only buffers share one specialisation, so the library holds one only."""
    separate_analytic_half(PackedFrame(np.frombuffer(bytes(24), np.uint8), 4, 4, "lsb"), Layout(), 0, 4095)
    table = json.loads(library.PATH.with_suffix(".json").read_text())
    assert len(table["entries"][library.name_of(analytic._separate_rows)]["overloads"]) == 1
