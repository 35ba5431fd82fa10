"""Previews: the tone curve, the two colour maps with their legends, the contact sheet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.testing as npt
import pytest
from skimage.color import rgb2lab
from test_outputs import random_frame

from polsep.io.results.previews import (
    BACKGROUND,
    FADED,
    NOT_VALID,
    PANEL,
    aolp_legend,
    aolp_wheel,
    contact_sheet,
    dolp_map,
    exposure_of,
)
from polsep.physics.srgb import srgb
from polsep.separation.report import SeparatedFrame


def uniform_frame(height: int, width: int, dolp: float, aolp: float) -> SeparatedFrame:
    size = (height, width)
    half = np.full((*size, 3), 0.5, np.float32)
    return SeparatedFrame(
        half, half, np.ones(size, bool), np.full(size, dolp, np.float32), np.full(size, aolp, np.float32), {}
    )


def test_srgb_at_the_constants_of_the_standard() -> None:
    npt.assert_allclose(srgb([0, 0.0031308, 0.5, 1]), [0, 0.040449936, 0.7353569831, 1], atol=1e-10)


def test_srgb_is_continuous_increasing_and_clips_outside_0_to_1() -> None:
    npt.assert_allclose(srgb(0.0031308 + 1e-12), srgb(0.0031308), atol=1e-7)
    assert np.all(np.diff(srgb(np.linspace(0, 1, 10_001))) > 0)
    npt.assert_allclose(srgb([-1, 2]), [0, 1], atol=1e-15)


def test_exposure_shows_the_percentile_at_nine_tenths_and_follows_the_light() -> None:
    image = np.random.default_rng(0).random((50, 60, 3))
    gain = exposure_of(image)
    npt.assert_allclose(np.percentile(gain * image, 99.5), 0.9, rtol=1e-12)
    npt.assert_allclose(exposure_of(4 * image), gain / 4, rtol=1e-12)


def test_exposure_of_one_bright_pixel_and_of_no_light() -> None:
    image = np.zeros((40, 40, 1))
    assert exposure_of(image) == 1.0
    image[3, 4] = 0.3
    npt.assert_allclose(exposure_of(image), 3.0, rtol=1e-12)


def test_wheel_has_the_primaries_of_hsv_at_0_60_120_degrees_and_closes() -> None:
    colors = aolp_wheel(np.radians([0, 60, 120, 180]))
    npt.assert_array_equal(colors, [[255, 64, 64], [64, 255, 64], [64, 64, 255], [255, 64, 64]])


def test_rotation_by_60_degrees_permutes_the_channels_and_a_mirror_swaps_green_and_blue() -> None:
    aolp = np.linspace(0, np.pi, 500)
    npt.assert_array_equal(aolp_wheel(aolp + np.pi / 3), np.roll(aolp_wheel(aolp), 1, axis=-1))
    npt.assert_array_equal(aolp_wheel(np.pi - aolp), aolp_wheel(aolp)[:, [0, 2, 1]])


def test_wheel_has_no_seam_and_no_two_angles_share_a_colour() -> None:
    colors = aolp_wheel(np.radians(np.arange(0, 180.5, 0.5))).astype(int)
    assert np.abs(np.diff(colors, axis=0)).max() <= 3
    assert len(np.unique(colors[:-1], axis=0)) == 360


def test_unpolarized_is_black_whatever_its_angle_and_light_is_proportional_to_dolp() -> None:
    aolp = np.linspace(0, np.pi, 50)
    npt.assert_array_equal(aolp_wheel(aolp, np.zeros(50)), 0)
    npt.assert_array_equal(aolp_wheel(aolp, np.ones(50)), aolp_wheel(aolp))
    npt.assert_allclose(aolp_wheel(0.0, 0.5)[0] / 255, srgb(0.5), atol=0.5 / 255)


@pytest.mark.parametrize(("degrees", "right", "up"), [(0, 1, 0), (45, 1, 1), (90, 0, 1), (135, -1, 1)])
def test_legend_points_0_to_the_right_and_45_up_right(degrees: float, right: int, up: int) -> None:
    size, reach = 101, 45 / np.hypot(right, up)
    legend = aolp_legend(size).astype(int)
    expected = aolp_wheel(np.radians(degrees), reach * np.hypot(right, up) / (size / 2)).astype(int)
    for sign in (1, -1):  # an axis has two ends
        row, col = round(size // 2 - sign * up * reach), round(size // 2 + sign * right * reach)
        assert np.abs(legend[row, col] - expected).max() <= 4


def test_legend_is_unchanged_by_half_a_turn() -> None:
    legend = aolp_legend(64)
    npt.assert_array_equal(legend, legend[::-1, ::-1])


def test_dolp_map_grows_lighter_all_the_way_and_limits_outside() -> None:
    colors = dolp_map(np.linspace(0, 1, 101))
    assert np.all(np.diff(rgb2lab(colors[None])[0, :, 0]) > 0)
    npt.assert_array_equal(colors[[0, -1]], [[0, 0, 4], [252, 255, 164]])
    npt.assert_array_equal(dolp_map([-0.1, 1.5]), colors[[0, -1]])


@pytest.mark.parametrize("shape", [(1, 1, 3), (7, 13, 1), (5, 300, 3), (641, 333, 3), (700, 1301, 1)])
def test_sheet_is_rgb_bytes_of_bounded_size_for_any_frame(shape: tuple[int, int, int]) -> None:
    sheet = contact_sheet(random_frame(shape[2], shape[:2]))
    assert sheet.dtype == np.uint8
    assert sheet.shape[2] == 3
    assert sheet.shape[0] <= 2 * PANEL + 300
    assert sheet.shape[1] <= 4 * PANEL + 100


def panel_of(sheet: np.ndarray, row: int, col: int, height: int, width: int) -> np.ndarray:
    """The pixels of one panel of a sheet whose cells are as wide as the panels."""
    top = 38 + 16 + 34 + row * (34 + height + 12)
    left = 16 + col * (width + 12)
    return sheet[top : top + height, left : left + width]


def test_panels_keep_the_aspect_ratio_and_show_uniform_polarization_exactly_to_the_border() -> None:
    sheet = contact_sheet(uniform_frame(1001, 1203, 0.3, np.radians(60)))
    height, width = 501, 602
    npt.assert_array_equal(panel_of(sheet, 1, 0, height, width), np.full((height, width, 3), dolp_map(0.3)))
    expected = np.full((height, width, 3), aolp_wheel(np.radians(60), 0.3))
    assert np.abs(panel_of(sheet, 1, 1, height, width).astype(int) - expected).max() <= 1


def test_input_diffuse_and_specular_share_one_exposure() -> None:
    sheet = contact_sheet(uniform_frame(400, 500, 0, 0))
    for col, level in ((0, 0.9), (1, 0.45), (2, 0.45)):
        npt.assert_array_equal(panel_of(sheet, 0, col, 400, 500), round(255 * float(srgb(level))))


def test_specular_light_is_shown_at_an_exposure_of_its_own() -> None:
    frame = uniform_frame(400, 500, 0, 0)
    sheet = contact_sheet(replace(frame, specular=0.01 * frame.specular))
    npt.assert_array_equal(panel_of(sheet, 0, 3, 400, 500), round(255 * float(srgb(0.9))))


def test_expected_errors_have_a_panel_where_there_are_any() -> None:
    frame = uniform_frame(400, 500, 0, 0)
    assert (panel_of(contact_sheet(frame), 1, 3, 400, 500) == BACKGROUND).all()
    error = np.zeros((400, 500, 2), np.float32)
    error[:200, :, 1] = 0.25
    panel = panel_of(contact_sheet(replace(frame, error=error)), 1, 3, 400, 500)
    npt.assert_array_equal(panel[:200], np.broadcast_to(dolp_map(1.0), (200, 500, 3)))
    npt.assert_array_equal(panel[200:], np.broadcast_to(dolp_map(0.0), (200, 500, 3)))


def test_file_method_and_warnings_stand_above() -> None:
    frame = uniform_frame(400, 500, 0, 0)
    named = contact_sheet(replace(frame, report={"source": "shot.png", "method": "joint"}))
    plain = contact_sheet(frame)
    assert named.shape == plain.shape
    assert (named[:38] != plain[:38]).any() and (named[38:] == plain[38:]).all()
    warned = contact_sheet(replace(frame, report={"warnings": ["black frame", "word " * 400]}))
    assert warned.shape[1] == plain.shape[1] and warned.shape[0] > plain.shape[0] + 3 * 22


def test_polarization_is_faded_where_the_light_is_at_the_noise() -> None:
    rng = np.random.default_rng(3)
    frame = uniform_frame(400, 500, 0.3, 0.5)
    dark = 1e-3 * rng.random((400, 500), np.float32)
    dark[:, 250:] = 0.5
    aolp = np.pi * rng.random((400, 500), np.float32)
    aolp[:, 250:] = 0.5
    dolp = np.where(dark < 0.5, 2 * rng.random((400, 500)), 0.3).astype(np.float32)
    noisy = replace(frame, diffuse=np.stack([dark] * 3, -1), specular=0 * frame.specular, dolp=dolp, aolp=aolp)
    for col, color in ((0, dolp_map(0.3)), (1, aolp_wheel(0.5, 0.3))):
        panel = panel_of(contact_sheet(noisy), 1, col, 400, 500)
        npt.assert_array_equal(panel[:, :249], np.broadcast_to(FADED, (400, 249, 3)))
        assert np.abs(panel[:, 251:].astype(int) - color).max() <= 1


def test_shrinking_averages_light_before_the_tone_curve() -> None:
    frame = uniform_frame(800, 1000, 0, 0)
    stripes = np.zeros_like(frame.diffuse)
    stripes[:, ::2] = 1
    sheet = contact_sheet(replace(frame, diffuse=stripes, specular=0 * stripes))
    npt.assert_array_equal(panel_of(sheet, 0, 0, 400, 500), round(255 * float(srgb(0.45))))


def test_shrinking_averages_angles_as_stokes_vectors() -> None:
    frame = uniform_frame(800, 1000, 1, 0)
    frame.aolp[:, ::2], frame.aolp[:, 1::2] = np.radians(175), np.radians(5)
    sheet = contact_sheet(frame)
    expected = aolp_wheel(0.0, np.cos(np.radians(10))).astype(int)
    assert np.abs(panel_of(sheet, 1, 1, 400, 500).astype(int) - expected).max() <= 1


def test_mask_shows_a_single_pixel_that_is_not_valid() -> None:
    frame = uniform_frame(800, 1000, 0, 0)
    frame.valid[301, 401] = False
    mask = panel_of(contact_sheet(frame), 1, 2, 400, 500).astype(int)
    assert np.argwhere(np.ptp(mask, axis=-1) > 0).tolist() == [[150, 200]]
    assert np.argmax(mask[150, 200]) == np.argmax(NOT_VALID)


def test_small_frames_show_each_pixel_twice_as_large() -> None:
    frame = random_frame(size=(100, 310))
    panel = panel_of(contact_sheet(frame), 0, 0, 200, 620)
    npt.assert_array_equal(panel[::2, ::2], panel[1::2, 1::2])
    total = frame.diffuse + frame.specular
    npt.assert_allclose(panel[::2, ::2], 255 * srgb(exposure_of(total) * total), atol=0.5 + 1e-3)


def test_no_light_gives_black_panels_without_warnings() -> None:
    zero = np.zeros((350, 400, 1), np.float32)
    frame = SeparatedFrame(zero, zero, np.zeros((350, 400), bool), zero[..., 0], zero[..., 0], {})
    sheet = contact_sheet(frame)
    for col in range(3):
        npt.assert_array_equal(panel_of(sheet, 0, col, 350, 400), 0)
    npt.assert_array_equal(panel_of(sheet, 1, 1, 350, 400), 0)
