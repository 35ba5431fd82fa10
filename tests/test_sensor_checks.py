"""Black level, gamma curves and JPEG are seen in the frame, and nothing is said of linear frames."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch
from torch import Tensor

import polsep
from polsep.calibrate.files import calibrate_files, merge_files
from polsep.calibrate.lamp import measure_lamp
from polsep.io.raw.frames import ReadOptions
from polsep.physics.stokes import Stokes
from polsep.render.simulate import filter_light
from polsep.sensor.black_level import BELOW, LEAST_EXCESS, check_black_level
from polsep.sensor.camera import IMX250, Layout, Mosaic, Sensor
from polsep.sensor.checks import check_mosaic
from polsep.sensor.encoding import block_ratio, encoding_warning, gamma_slope, noise_exponent
from polsep.sensor.levels import level_notes
from polsep.sensor.noise import code_step

COLOR, MONO = Layout(), Layout(bayer=None)
LAYOUTS = pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
SIZE = 256


def scene(channels: int) -> Stokes:
    """Smooth polarized objects of several colours on black."""
    y, x = torch.meshgrid(torch.linspace(0, 1, SIZE), torch.linspace(0, 1, SIZE), indexing="ij")
    inside = ((y - 0.5) ** 2 + (x - 0.5) ** 2 < 0.18).float()
    s0 = torch.stack([inside * (0.25 + 0.5 * x + 0.4 * c * y) for c in range(channels)])
    return Stokes(s0, s0 * (0.9 * x - 0.3), s0 * (0.7 * y - 0.2))


def frame(layout: Layout, black: float = 0.0, sensor: Sensor = IMX250) -> Mosaic:
    """A frame whose codes have ``black`` added before the converter cuts off at 0, read with a black level of 0."""
    signal = filter_light(scene(layout.channels), layout, sensor)
    noise = torch.from_numpy(np.random.default_rng(1).standard_normal(signal.shape, np.float32))
    noisy = signal + sensor.noise_variance(signal).sqrt() * noise
    codes = (noisy * (sensor.white_level - black) + black).clamp(0, sensor.white_level).round()
    return Mosaic(codes, layout, 0.0, sensor.white_level)


def encoded(linear: Mosaic, power: float) -> Mosaic:
    codes = (255 * (linear.data / linear.white_level) ** power).round()
    return Mosaic(codes, linear.layout, 0.0, 255.0)


@LAYOUTS
def test_linear_frames_pass_unchanged(layout: Layout) -> None:
    """Nothing is found in a linear frame at 8 or 12 bits: it comes back as the same object."""
    for sensor in (IMX250, replace(IMX250, bits=8)):
        clean = frame(layout, 0.0, sensor)
        checked = check_mosaic(clean)
        assert checked.mosaic is clean
        assert checked.warnings == ()
        assert checked.report == {"defects": 0, "black_level": 0.0}


@LAYOUTS
@pytest.mark.parametrize("black", [16.0, 64.0, 240.0])
def test_black_level_is_found_and_put_right(layout: Layout, black: float) -> None:
    """The black level that nobody said is found to a code, taken, and named as an option; layouts are not blamed."""
    checked = check_mosaic(frame(layout, black))
    assert checked.mosaic.black_level == pytest.approx(black, abs=1.5)
    (line,) = checked.warnings
    assert "--black-level" in line and "layout" not in line


@LAYOUTS
@pytest.mark.parametrize("scale", [1 / 4095, 1 / 65535, 16.0, 0.37])
def test_scaled_codes_are_codes(layout: Layout, scale: float) -> None:
    """Codes that were divided by white, as floats are, show the same black level and the same defects."""
    codes = frame(layout, 64.0)
    codes.data[100:103:2, 120] = codes.data.amax()
    scaled = Mosaic((codes.data.double() * scale).float(), layout, 0.0, codes.white_level * scale)
    one, other = check_mosaic(codes), check_mosaic(scaled)
    assert other.mosaic.black_level == pytest.approx(one.mosaic.black_level * scale, rel=1e-3)
    assert other.report["defects"] == one.report["defects"] == 2
    assert len(other.warnings) == len(one.warnings) == 1
    for data, step in ((codes.data.numpy(), 1.0), (scaled.data.numpy(), scale)):
        repaired = data.copy()
        repaired[::8, 7] += np.linspace(0.1, 0.4, SIZE // 8) * step
        assert code_step(repaired, 4095 * step) == pytest.approx(step, rel=1e-5)
    data = np.linspace(0, 0.9, SIZE * SIZE, dtype=np.float32).reshape(SIZE, SIZE)
    assert code_step(data, 1.0) == 0, "a rendering has no codes"


@LAYOUTS
def test_a_black_level_that_was_said_is_kept(layout: Layout) -> None:
    """The right one passes without a word; one that is too small or too large is reported but never changed."""
    right = replace(frame(layout, 240.0), black_level=240.0)
    assert check_black_level(right).warning is None
    for said, true in ((64.0, 240.0), (240.0, 0.0)):
        wrong = replace(frame(layout, true), black_level=said)
        checked = check_mosaic(wrong)
        assert checked.mosaic.black_level == said
        assert any("black" in line for line in checked.warnings)


@LAYOUTS
def test_a_level_that_polsep_advised_is_not_doubted(layout: Layout) -> None:
    """With much read noise some samples lie far below the black level that the frame shows, which is right."""
    noisy = frame(layout, 240.0, replace(IMX250, read_noise=10.0))
    advised = check_black_level(noisy).level
    assert advised == pytest.approx(240, abs=1.5)
    stated = replace(noisy, black_level=advised)
    assert np.mean(stated.data.numpy() < advised - LEAST_EXCESS * (4095 - advised)) > BELOW
    assert check_black_level(stated).warning is None
    assert "say a lower" in (check_black_level(replace(noisy, black_level=260.0)).warning or "")


@LAYOUTS
def test_overexposure_is_seen_above_a_black_level_that_is_found(layout: Layout) -> None:
    """As if the level had been said: samples at black are not lit."""
    bright = frame(layout, 240.0)
    bright.data[120:132, 60:200] = 4095.0
    lines = check_mosaic(bright).warnings
    said = level_notes(bright.data.numpy(), 240.0, 4095.0)
    assert level_notes(bright.data.numpy(), 0.0, 4095.0) == ()
    assert said[0].startswith("overexposed") and lines[0] == said[0] and "black lies at" in lines[1]


@LAYOUTS
def test_light_everywhere_is_no_black_level(layout: Layout) -> None:
    """Room light on the dark parts has its own noise: it is light."""
    light = scene(layout.channels)
    lit = Stokes(light.s0 + 0.2, light.s1, light.s2)
    signal = filter_light(lit, layout, IMX250)
    noise = torch.from_numpy(np.random.default_rng(2).standard_normal(signal.shape, np.float32))
    codes = (4095 * (signal + IMX250.noise_variance(signal).sqrt() * noise)).clamp(0, 4095).round()
    assert check_black_level(Mosaic(codes, layout, 0.0, 4095.0)).level is None


@LAYOUTS
@pytest.mark.parametrize("power", [1 / 2.2, 0.5])
def test_gamma_curves_are_seen(layout: Layout, power: float) -> None:
    """The contradiction of the analysers measures the curve, and the line names it."""
    bent = encoded(frame(layout), power)
    assert gamma_slope(bent) == pytest.approx((power - 1) / power, rel=0.35)
    assert gamma_slope(frame(layout)) == pytest.approx(0, abs=0.1)
    assert "gamma" in (encoding_warning(bent) or "")


@LAYOUTS
def test_the_noise_of_floats_is_that_of_their_codes(layout: Layout) -> None:
    """Samples of white 1 have the noise exponent of the codes that they were."""
    codes = frame(layout)
    floats = Mosaic(codes.data / 4095, layout, 0.0, 1.0)
    assert noise_exponent(codes) == pytest.approx(noise_exponent(floats), abs=0.01)
    assert (noise_exponent(codes) or 0) > 0.4


@LAYOUTS
def test_clipped_parts_have_no_noise_to_look_at(layout: Layout) -> None:
    """The exponent of the others is the frame's, also beside a black level that is known."""
    whole = replace(frame(layout, 240.0), black_level=240.0)
    data = whole.data.clone()
    data[:, : SIZE // 4] = 4095
    clipped = noise_exponent(replace(whole, data=data))
    assert clipped == pytest.approx(noise_exponent(replace(whole, data=whole.data[:, SIZE // 4 :])), abs=0.1)


def test_a_frame_less_another_has_noise_below_black() -> None:
    """Parts that only the room lights are black with the noise of both frames, which is no wrong black level."""
    rng = np.random.default_rng(4)
    codes = rng.normal(64, 12, (SIZE, SIZE)).clip(0).round().astype(np.float32)
    mosaic = Mosaic(torch.from_numpy(codes), COLOR, 64.0, 4095.0)
    assert "lower" in (check_black_level(mosaic).warning or "")
    assert check_black_level(replace(mosaic, less_ambient=True)).warning is None


@pytest.mark.parametrize(("white", "kind"), [(4095, np.uint16), (255, np.uint8), (1, np.float32)])
def test_a_sensor_that_clips_below_the_white_level_is_said(white: float, kind: type[np.generic]) -> None:
    """Samples pile up where it clips, the brightest of others do not; the contradiction of such samples is no gamma."""
    light = frame(COLOR).data.numpy() / 4095
    light *= 0.95 / light.max()
    codes = (light * white).astype(kind)
    top = np.quantile(codes, 0.99).astype(kind)
    said = [level_notes(samples, 0.0, white) for samples in (codes, np.minimum(codes, top), (codes / 8).astype(kind))]
    assert said[0] == said[2] == () and f"say --white-level {top:.6g}" in said[1][0] and len(said[1]) == 1
    cut = Mosaic(np.minimum(codes, top).astype(np.float32), COLOR, 0.0, white)
    assert encoding_warning(cut) is None and check_mosaic(cut).warnings == ()


def test_overexposure_is_seen_in_codes_moved_to_the_left() -> None:
    """12 bits in 16-bit words end at 65520 of 65535, and clip there."""
    codes = np.where(np.arange(64)[:, None] < 32, 4095, 1000) * np.ones((1, 64), int) << 4
    assert any("overexposed: 50%" in note for note in level_notes(codes.astype(np.uint16), 0.0, None))


@LAYOUTS
def test_jpeg_is_seen(layout: Layout) -> None:
    """Blocks of 8x8 show after compression, not before."""
    plain = encoded(frame(layout), 1.0)
    codes = imagecodecs.jpeg_encode(plain.data.numpy().astype(np.uint8), level=95)
    rounded = replace(plain, data=torch.from_numpy(imagecodecs.jpeg_decode(codes).astype(np.float32)))
    assert block_ratio(plain) == pytest.approx(1, abs=0.1)
    assert "JPEG" in (encoding_warning(rounded) or "")


def test_encoded_frames_are_said_where_they_are_measured_or_merged(tmp_path: Path) -> None:
    """Linear light is what calibrations and merged exposures are of."""
    for power, said in ((1.0, False), (1 / 2.2, True)):
        shot, read = tmp_path / f"{power:.1f}.png", ReadOptions(white_level=255.0)
        shot.write_bytes(imagecodecs.png_encode(encoded(frame(COLOR), power).data.numpy().astype(np.uint8)))
        for _, notes in (
            calibrate_files([shot], read, tmp_path / f"{power:.1f}.json", "light", partial(measure_lamp, card=True)),
            merge_files([shot], read, tmp_path / f"{power:.1f}.tiff", None, False),
        ):
            assert any("the samples are gamma-encoded" in note for note in notes) == said


@pytest.mark.parametrize("size", [2, 4, 6, 16, 30])
def test_small_frames_pass(size: int) -> None:
    """Frames too small for any check come back as they are."""
    small = Mosaic(torch.full((size, size), 90.0), MONO, 0.0, 255.0)
    assert check_mosaic(small).mosaic is small


def test_a_mono_frame_read_as_colour_is_told_what_to_say() -> None:
    """One option to paste, not several."""
    lines = check_mosaic(replace(frame(MONO), layout=COLOR)).warnings
    assert [line for line in lines if "--layout mono (" in line]


def test_separate_corrects_the_black_level() -> None:
    """The default call gives with an unknown black level nearly what it gives when it is said."""
    raw: Tensor = frame(COLOR, 240.0).data
    said = polsep.separate(raw.numpy(), "analytic", black_level=240, white_level=4095, light_color="white")
    with pytest.warns(polsep.PolsepWarning, match="--black-level"):
        found = polsep.separate(raw.numpy(), "analytic", white_level=4095, light_color="white")
    assert float(np.abs(found.diffuse - said.diffuse).max()) < 2e-3
