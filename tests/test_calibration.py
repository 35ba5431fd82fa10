"""Calibration of a simulated sensor recovers what was simulated; applying it undoes it; what is not measured, stays."""

from __future__ import annotations

import json
import math
import os
import warnings
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from numpy.typing import NDArray
from test_cli import Cli, Run
from test_cli import polsep as run_polsep  # noqa: F401

import polsep
from polsep.calibrate.analysers import measure_analysers
from polsep.calibrate.dark_flat import measure_dark, measure_flat
from polsep.calibrate.exposures import merge_exposures
from polsep.calibrate.files import describe
from polsep.calibrate.lamp import measure_lamp
from polsep.calibrate.statistics import median, robust_deviation, robust_mean
from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.raw.sequences import expand_folders
from polsep.io.raw.tiff import write_merged
from polsep.io.store.atomic import OutputError
from polsep.io.store.calibrations import read_calibration, write_calibration
from polsep.io.store.errors import InputError
from polsep.light.light_color import is_calibrated
from polsep.sensor.calibration import (
    Analyser,
    Calibration,
    LampFacts,
    correct_analysers,
    correct_analysers_reference,
    correct_mosaic,
    tile,
)
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.corrections import Corrections, mean_mosaic, subtract_ambient
from polsep.sensor.exposure import histogram
from polsep.sensor.falloff import falloff_image

SIZE = (128, 160)
WHITE = 4095.0
LEVEL = 64.0
WELL, READ = 10_500.0, 2.4
MONO = Layout(bayer=None)
LAYOUTS = pytest.mark.parametrize("layout", [Layout(), MONO, Layout(origin=(1, 0))], ids=lambda x: x.spec)


def test_tables_of_a_period_are_repeated() -> None:
    """From the first sample on, whole or not, of any numbers per place; nothing of nothing."""
    table = np.arange(32.0).reshape(4, 4, 2)
    tiled = tile(table, (6, 11))
    assert tiled.dtype == np.float32 and tile(None, (6, 11)) is None
    np.testing.assert_array_equal(tiled, np.tile(table, (2, 3, 1))[:6, :11])
    np.testing.assert_array_equal(tile(table[..., 0], (8, 4)), np.tile(table[..., 0], (2, 1)))


class BadSensor:
    """A sensor with a black pattern, gains, vignetting, dead pixels and bad analysers; codes of 12 bits."""

    def __init__(self, layout: Layout, seed: int = 1, dead: int = 20) -> None:
        self.layout, self.rng = layout, np.random.default_rng(seed)
        rng, period = self.rng, layout.period
        rows, cols = (np.arange(n) for n in SIZE)
        place = (rows[:, None] % period, cols[None] % period)
        self.black = LEVEL + rng.normal(0, 8, (period, period))[place] + rng.normal(0, 2, SIZE)
        self.black += rng.normal(0, 3, (SIZE[0], 1))
        self.gain = 1 + rng.normal(0, 0.03, (period, period))[place] + rng.normal(0, 0.02, SIZE)
        y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
        self.falloff = 1 / (1 + 0.3 * (x**2 + y**2))
        self.dead = rng.choice(SIZE[0] * SIZE[1], dead, replace=False)
        angles = np.array([[layout.filter_at(r, c).angle_deg for c in range(period)] for r in range(period)])
        self.angles = angles + rng.normal(0, 2, (period, period))
        self.angles -= (self.angles - angles).mean()
        self.diattenuation = np.full((period, period), 29 / 31)

    def sees(self, s0: NDArray[np.float64], dolp: float = 0.0, aolp: float = 0.0) -> NDArray[np.float64]:
        """Light behind each pixel's analyser, white = 1."""
        period = self.layout.period
        place = np.ix_(np.arange(SIZE[0]) % period, np.arange(SIZE[1]) % period)
        d, t = self.diattenuation[place], np.deg2rad(self.angles)[place]
        light: NDArray[np.float64] = s0 * (1 + dolp * d * np.cos(2 * (t - aolp))) / 2
        return light

    def expose(self, light: NDArray[np.float64], noise: bool = True) -> Mosaic:
        """One frame of light behind the analysers."""
        signal = np.maximum(light * self.gain * self.falloff, 0)
        if noise:
            signal = (self.rng.poisson(signal * WELL) + self.rng.normal(0, READ, SIZE)) / WELL
        codes = signal * (WHITE - LEVEL) + self.black
        codes.flat[self.dead] = 0
        codes = np.clip(np.round(codes) if noise else codes, 0, WHITE)
        return Mosaic(torch.from_numpy(codes.astype(np.float32)), self.layout, 0.0, WHITE)

    def calibration(self) -> Calibration:
        """The truth, as a calibration."""
        period = self.layout.period
        table = tuple(
            tuple(
                Analyser(a, (1 + d) / (1 - d), 1.0)
                for a, d in zip(self.angles[row], self.diattenuation[row], strict=True)
            )
            for row in range(period)
        )
        black = self.black.astype(np.float32)
        dead = np.sort(self.dead).astype(np.int32)
        gains = self.gain.astype(np.float32)
        ones = ((1.0,) * period,) * period
        return Calibration(
            self.layout, WHITE, SIZE, LEVEL, None, black, 1.0, ones, gains, ((1.0,),), dead, table, None, {}
        )


@LAYOUTS
def test_dark_and_flat_recover_a_sensor(layout: Layout) -> None:
    """Ten frames of each give black within a third of a code, gains within 0.5 %, vignetting within 0.3 %."""
    sensor = BadSensor(layout)
    sound = np.ones(SIZE, bool)
    sound.flat[sensor.dead] = False
    unlit = np.zeros(SIZE)
    dark = measure_dark(sensor.expose(unlit) for _ in range(10))
    assert dark.black_map is not None and dark.read_noise is not None and dark.black_level is not None
    assert np.std((dark.black_map - sensor.black)[sound]) < 0.35
    assert abs(dark.black_level - sensor.black.mean()) < 0.2
    assert dark.read_noise == pytest.approx(math.hypot(READ * (WHITE - LEVEL) / WELL, 12**-0.5), rel=0.05)
    used = Corrections(replace(dark, hot=None))
    light = sensor.sees(np.full(SIZE, 1.0))
    flat = measure_flat((used.apply(sensor.expose(light)) for _ in range(10)), dark)
    assert flat.gain_map is not None and flat.falloff is not None and flat.dead is not None
    product = flat.gain_map * falloff_image(flat.falloff, *SIZE) / (sensor.gain * sensor.falloff)
    assert np.std(product[sound] / product[sound].mean()) < 0.006
    assert np.abs(falloff_image(flat.falloff, *SIZE) / sensor.falloff - 1).max() < 0.02
    assert set(sensor.dead) <= set(flat.dead.tolist()) and len(flat.dead) == len(sensor.dead)
    assert flat.black_map is dark.black_map


@LAYOUTS
def test_what_all_pixels_share_is_no_noise(layout: Layout) -> None:
    """A lamp that flickers by 10 %, a camera that is turned, and black that drifts hide neither pixels nor noise."""
    sensor = BadSensor(layout, dead=0)
    drift = (2.0 * k for k in range(10))
    frames = (sensor.expose(np.zeros(SIZE)) for _ in range(10))
    dark = measure_dark(replace(frame, data=frame.data + step) for frame, step in zip(frames, drift, strict=True))
    assert dark.read_noise == pytest.approx(math.hypot(READ * (WHITE - LEVEL) / WELL, 12**-0.5), rel=0.05)
    across = np.linspace(-0.1, 0.1, SIZE[1])
    lights = (np.broadcast_to(0.9 + 0.1 * (-1) ** k + (-1) ** (k // 2) * across, SIZE) for k in range(10))
    used = Corrections(replace(sensor.calibration(), gain_map=None, gains=None, analysers=None))
    flat = measure_flat(used.apply(sensor.expose(sensor.sees(light))) for light in lights)
    assert flat.gain_map is not None
    assert np.std(flat.gain_map / sensor.gain) < 0.006


@pytest.mark.parametrize("flat", [True, False])
def test_a_lamp_that_flickers_is_told_from_the_analysers(flat: bool) -> None:
    """Light that varies by 8 %: after a flat frame angles are as exact as ever; without one, the error said grows."""
    sensor = BadSensor(Layout(), dead=0)
    truth = sensor.calibration()
    known = replace(truth, gains=truth.gains if flat else None, gain_map=truth.gain_map if flat else None)
    used = Corrections(replace(known, analysers=None))
    aolps, levels = np.arange(10) * np.deg2rad(20), 0.75 * (1 + 0.08 * np.cos(np.arange(10) ** 2))
    pairs = zip(levels, aolps, strict=True)
    frames = [used.apply(sensor.expose(sensor.sees(np.full(SIZE, level), 1.0, aolp))) for level, aolp in pairs]
    found = measure_analysers(frames, replace(known, analysers=None))
    assert found.analysers is not None and truth.analysers is not None
    off = ((np.array(found.analysers) - np.array(truth.analysers))[..., 0] + 90) % 180 - 90
    said = found.details["analysers"]["angle_error_deg"]
    assert np.abs(off).max() < (0.1 if flat else 4 * said)
    assert said < 0.1 if flat else said > 0.2  # 0.13 under a steady lamp


@pytest.mark.parametrize("layout", [Layout(), MONO], ids=lambda x: x.spec)
@pytest.mark.parametrize("flat", [True, False])
def test_a_turned_polarizer_shows_the_analysers(layout: Layout, flat: bool) -> None:
    """Ten frames at unknown angles, with light that varies by 1 %, give angles within 0.4 degrees (0.1 after a flat
    frame) and extinction ratios of 30 within 1.5; the same frames in another order give the same."""
    sensor = BadSensor(layout, dead=0)
    truth = sensor.calibration()
    known = replace(truth, gains=truth.gains if flat else None, gain_map=truth.gain_map if flat else None)
    used = Corrections(replace(known, analysers=None))
    aolps = np.linspace(0, np.pi, 10, endpoint=False) + sensor.rng.normal(0, 0.1, 10)
    levels = 0.8 * (1 + sensor.rng.normal(0, 0.01, 10))
    frames = [
        used.apply(sensor.expose(sensor.sees(np.full(SIZE, level), 1.0, aolp)))
        for level, aolp in zip(levels, aolps, strict=True)
    ]
    found = measure_analysers(frames, replace(known, analysers=None))
    assert found.analysers is not None and truth.analysers is not None
    off = np.array(found.analysers) - np.array(truth.analysers)
    angles = (off[..., 0] + 90) % 180 - 90
    assert np.abs(angles).max() < (0.1 if flat else 0.4)
    assert np.abs(off[..., 1]).max() < 1.5
    assert abs(angles.mean()) < 0.02
    said, loss = found.details["analysers"], off[..., 1] * (1 - 29 / 31) ** 2 / 2
    assert said["angle_error_deg"] / 2.5 < np.sqrt((angles**2).mean()) < 2.5 * said["angle_error_deg"]
    assert said["diattenuation_error"] / 6 < np.sqrt((loss**2).mean()) < 2.5 * said["diattenuation_error"]
    again = measure_analysers(frames[::-1], replace(known, analysers=None))
    np.testing.assert_allclose(np.array(again.analysers), np.array(found.analysers), rtol=1e-4)
    imperfect = measure_analysers(frames, replace(known, analysers=None), polarizer_extinction=50.0)
    assert imperfect.details["analysers"]["diattenuation"] > found.details["analysers"]["diattenuation"]
    with pytest.raises(ValueError, match="extinction ratio of at least 30, which the frames show of it and the"):
        measure_analysers(frames, replace(known, analysers=None), polarizer_extinction=20.0)


@pytest.mark.parametrize("card", [True, False])
def test_the_lamp_is_found(card: bool) -> None:
    """A black ball shows the lamp's colour within 0.3 degrees, its angle within 0.5 and its degree within 0.02; a card
    shows the colour; a calibrated lamp's colour goes with the frame."""
    sensor, color = BadSensor(Layout(), dead=0), np.array([0.5, 1.0, 0.7])
    channels = np.array([[Layout().filter_at(r % 4, c % 4).channel for c in range(SIZE[1])] for r in range(SIZE[0])])
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    s0 = color[channels] * (0.6 if card else 0.01 + 0.9 * np.exp(-8 * (x**2 + y**2)))
    truth = sensor.calibration()
    sensor.falloff = np.ones(SIZE)
    frame = correct_mosaic(sensor.expose(sensor.sees(s0, 0.0 if card else 0.96, 0.5)), truth)
    found = measure_lamp([frame], replace(truth, lamp=None), card)
    lamp, line = found.lamp, describe(found, "light")
    assert lamp is not None and ("from card" in line if card else "from specular light, polarizer at 151" in line)
    cosine = np.array(lamp.color) @ color / np.linalg.norm(lamp.color) / np.linalg.norm(color)
    assert math.degrees(math.acos(min(cosine, 1))) < 0.3
    if not card:
        assert lamp.dolp is not None and lamp.dolp == pytest.approx(0.95, abs=0.03)
        assert lamp.aolp_deg == pytest.approx(math.degrees(0.5), abs=0.5)
    assert correct_mosaic(frame, Calibration(Layout(), WHITE, lamp=lamp)).light_color == lamp.color


def test_the_lamp_of_several_frames_is_their_mean() -> None:
    """Angles on both sides of 0, half of their distance as their spread, and the largest degree of polarization."""
    sensor = BadSensor(MONO, dead=0)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    s0, truth = 0.01 + 0.9 * np.exp(-8 * (x**2 + y**2)), sensor.calibration()
    sensor.falloff = np.ones(SIZE)
    shots = [(0.96, 0.06), (0.8, -0.06)]
    found = measure_lamp(correct_mosaic(sensor.expose(sensor.sees(s0, *shot)), truth) for shot in shots)
    assert found.lamp is not None and found.lamp.dolp == pytest.approx(0.96, abs=0.03)
    assert found.lamp.aolp_deg is not None and abs((found.lamp.aolp_deg + 90) % 180 - 90) < 0.5
    assert found.details["light"]["aolp_spread_deg"] == pytest.approx(math.degrees(0.06), rel=0.1)


@pytest.mark.parametrize("layout", [Layout(), MONO])
def test_rims_of_objects_show_no_lamp(layout: Layout) -> None:
    """Light that is polarized around the middle, as that of a matte ball's rim, has no angle: none is named for the
    lamp, and a mono frame, of which nothing is left, is refused. A highlight in the middle has the lamp's."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    turns = np.deg2rad([[2 * layout.filter_at(r % 4, c % 4).angle_deg for c in range(SIZE[1])] for r in range(SIZE[0])])
    rim = 0.3 * (1 + 0.3 * (x**2 + y**2) * np.cos(turns - 2 * np.arctan2(y, x)))
    shine = 1.2 * np.exp(-20 * (x**2 + y**2)) * (1 + np.cos(turns - 1))
    ball, shiny = (Mosaic((light / 2).astype(np.float32), layout, 0.0, 1.5) for light in (rim, rim + shine))
    lamp = measure_lamp([shiny]).lamp
    assert lamp is not None and lamp.aolp_deg == pytest.approx(math.degrees(0.5), abs=1)
    if layout is MONO:
        with pytest.raises(ValueError, match=r"expected polarized light of one angle, found many \(concentration 0\.0"):
            measure_lamp([ball])
        return
    found = measure_lamp([ball])
    assert found.lamp is not None and found.lamp.aolp_deg is None and found.lamp.dolp is None
    assert "polarizer not found: its light shows many angles (concentration 0.0" in describe(found, "light")


def test_a_frame_without_the_lamp_is_refused() -> None:
    """Unpolarized light shows no reflection of the lamp, and a dark frame no card."""
    sensor = BadSensor(Layout(), dead=0)
    frame = correct_mosaic(sensor.expose(sensor.sees(np.full(SIZE, 0.5))), sensor.calibration())
    with pytest.raises(ValueError, match="expected 64 unclipped pixels of polarized light"):
        measure_lamp([frame])
    red = torch.tensor(
        [[Layout().filter_at(r % 4, c % 4).channel == 0 for c in range(SIZE[1])] for r in range(SIZE[0])]
    )
    edge = torch.where(red & (torch.arange(SIZE[1]) < SIZE[1] // 2), 0.2, 1.0)
    with pytest.raises(ValueError, match=r"expected one colour over the card, found parts that differ by \d+"):
        measure_lamp([replace(frame, data=frame.data * edge)], card=True)
    with pytest.raises(ValueError, match="expected a lit card in the middle"):
        measure_lamp([replace(frame, data=torch.full(SIZE, LEVEL))], card=True)


def test_pictures_are_no_dark_frames() -> None:
    """A dark picture of a bright object: most of it is black, a tenth is not. Nor is an evenly lit frame, nor one with
    a glowing corner, whose pixels would all count as hot ones."""
    picture = np.full(SIZE, LEVEL, np.float32)
    picture[: SIZE[0] // 10] += 0.3 * WHITE
    corner = np.full(SIZE, LEVEL, np.float32)
    corner[:28, :28] += 0.02 * WHITE
    for data, found in (
        (picture, r"found .*% of the pixels far from black"),
        (picture * 0 + WHITE / 2, "found a median of"),
        (corner, r"found 7\d\.\d% of the pixels in one place far from black"),
    ):
        with pytest.raises(ValueError, match=rf"expected frames without light \(lens cap on\), {found}"):
            measure_dark([Mosaic(data, Layout(), 0.0, WHITE)] * 2)


@pytest.mark.parametrize("measure", [measure_dark, measure_flat])
def test_copies_of_one_frame_are_refused(measure: Callable[..., Calibration]) -> None:
    """They would measure no noise, and take that of the frame for its pattern."""
    sensor = BadSensor(Layout(), dead=0)
    light = 0.0 if measure is measure_dark else 0.8
    frame = replace(sensor.expose(sensor.sees(np.full(SIZE, light))), black_level=LEVEL)
    with pytest.raises(ValueError, match="taken one after another, found the same samples 3 times"):
        measure([frame] * 3)


def test_one_wrong_frame_among_many_is_refused() -> None:
    """A frame of paper or of a small object among dark ones, and a dark one among flat ones, hide in the mean."""
    sensor = BadSensor(Layout(), dead=0)
    dark = [sensor.expose(np.zeros(SIZE)) for _ in range(7)]
    bright = np.zeros(SIZE)
    bright[40:80, 40:90] = 0.1
    paper = sensor.expose(sensor.sees(np.full(SIZE, 0.8)))
    for lit in (paper, sensor.expose(sensor.sees(bright))):
        with pytest.raises(ValueError, match=r"without light \(lens cap on\), found parts of frame 8 that differ"):
            measure_dark([*dark, lit])
    flat = [replace(frame, black_level=LEVEL) for frame in (paper, paper, paper, dark[0])]
    with pytest.raises(ValueError, match=r"near half of the white level, found one of 0\.\d%"):
        measure_flat(flat)


def test_a_lamp_that_objects_do_not_show_is_refused() -> None:
    """Polarized light of a body's own colour is not the lamp's: the frame is refused, with what to do."""
    sensor, body = BadSensor(Layout(), dead=0), np.array([0.2, 0.3, 0.9])
    channels = np.array([[Layout().filter_at(r % 4, c % 4).channel for c in range(SIZE[1])] for r in range(SIZE[0])])
    y = np.linspace(-1, 1, SIZE[0])[:, None]
    frame = correct_mosaic(sensor.expose(sensor.sees(body[channels], 0.12 * y**2, 0.5)), sensor.calibration())
    with pytest.raises(ValueError, match=r"shows the lamp's colour to 2\.5 degrees, found .*grey card"):
        measure_lamp([frame])


def test_frames_that_show_no_turned_polarizer_are_refused() -> None:
    """Too few frames, frames of one angle and unpolarized ones are a line each."""
    sensor = BadSensor(Layout(), dead=0)

    def frames(aolps: list[float], dolp: float = 1.0) -> list[Mosaic]:
        return [replace(sensor.expose(sensor.sees(np.full(SIZE, 0.8), dolp, t)), black_level=LEVEL) for t in aolps]

    for some, expected in (
        ([], "found none"),
        (frames([0.0, 1.0]), "at least 5 frames behind a turned polarizer, found 2"),
        (frames([0.0, 0.1, 0.2, 0.1, 0.0]), "expected polarizer angles spread over 180 degrees"),
        (frames([0.0, 1.0, 2.0, 1.5, 0.4], dolp=0.1), "expected frames behind a linear polarizer"),
    ):
        with pytest.raises(ValueError, match=expected):
            measure_analysers(some)


def test_doubtful_light_is_said() -> None:
    """Paper lit from one side, whose shading would be divided out of every image, and light beside the polarizer."""
    sensor = BadSensor(MONO, dead=0)
    across = np.broadcast_to(np.linspace(0.8, 1.2, SIZE[1]), SIZE)
    for light, said in ((np.ones(SIZE), False), (across, True)):
        flat = measure_flat([replace(sensor.expose(sensor.sees(light)), black_level=LEVEL)])
        assert ("one side is 3" in describe(flat, "flat")) == said
    for dolp, said in ((1.0, False), (0.8, True)):
        turned = (sensor.expose(sensor.sees(np.full(SIZE, 0.8), dolp, turn)) for turn in np.arange(10) * 0.3)
        found = measure_analysers(replace(frame, black_level=LEVEL) for frame in turned)
        assert ("was the polarizer poor" in describe(found, "analysers")) == said


@LAYOUTS
@pytest.mark.parametrize("bits", [8, 12])
def test_gamma_of_flat_frames_is_said(layout: Layout, bits: int) -> None:
    """Shot noise grows with light along the falloff of a lens; behind a gamma curve it does not."""
    sensor, white = BadSensor(layout, dead=0), 2.0**bits - 1
    for gamma, said in ((1.0, False), (1 / 1.8, True), (1 / 2.2, True)):
        linear = [(sensor.expose(sensor.sees(np.full(SIZE, 1.0))).data.numpy() - LEVEL) / WHITE for _ in range(30)]
        codes = [np.round(white * light.clip(0) ** gamma).astype(np.float32) for light in linear]
        flat = measure_flat(Mosaic(samples, layout, 0.0, white) for samples in codes)
        assert ("is gamma off in the camera?" in describe(flat, "flat")) == said, (gamma, flat.details)


def test_polarized_flat_frames_are_refused() -> None:
    """Gains that hide a lamp's polarization would take it out of every frame; of a tenth of that polsep warns."""
    sensor = BadSensor(Layout(), dead=0)

    def flat(dolp: float) -> Calibration:
        return measure_flat([replace(sensor.expose(sensor.sees(np.full(SIZE, 1.0), dolp)), black_level=LEVEL)])

    with pytest.raises(ValueError, match="expected unpolarized light on the flat frames, found an apparent DoLP of"):
        flat(0.3)
    assert flat(0.03).details["flat"]["apparent_dolp"] < 0.06
    turned = [sensor.sees(np.full(SIZE, 1.0), 1.0, aolp) for aolp in np.arange(4) * np.pi / 4]
    with pytest.raises(ValueError, match="off the lamp and the lens"):
        measure_flat(replace(sensor.expose(light), black_level=LEVEL) for light in turned)


def test_one_frame_gives_tables_and_no_map() -> None:
    """Where noise hides the pixels, no pixel is corrected: a single flat frame changes filters and vignetting only."""
    sensor = BadSensor(Layout(), dead=0)
    flat = measure_flat([replace(sensor.expose(sensor.sees(np.full(SIZE, 1.0))), black_level=LEVEL)])
    assert flat.gain_map is None and flat.gains is not None
    ideal = measure_dark([Mosaic(torch.full(SIZE, LEVEL), Layout(), 0.0, WHITE)] * 3)
    assert ideal.black_map is None and ideal.black_level == LEVEL and ideal.read_noise == 0


@pytest.mark.parametrize("layout", [Layout(), MONO, Layout(origin=(1, 0)), Layout(origin=(0, 1))], ids=lambda x: x.spec)
def test_applying_undoes_the_sensor(layout: Layout) -> None:
    """Even polarized light through a bad sensor without noise comes out as ideal analysers measure it, except at dead
    pixels: these are predicted."""
    sensor = BadSensor(layout)
    ideal = BadSensor(layout, dead=0)
    ideal.angles = np.array(
        [[layout.filter_at(r, c).angle_deg for c in range(layout.period)] for r in range(layout.period)]
    )
    ideal.diattenuation = np.ones_like(ideal.angles)
    sensor.falloff = np.ones(SIZE)
    s0 = np.full(SIZE, 0.8)
    found = correct_mosaic(sensor.expose(sensor.sees(s0, 0.5, 0.4), noise=False), sensor.calibration())
    assert found.falloff == ((1.0,),)
    wanted = torch.from_numpy(ideal.sees(s0, 0.5, 0.4).astype(np.float32))
    dead = torch.zeros(SIZE)
    dead.view(-1)[torch.from_numpy(sensor.dead)] = 1
    mixed = torch.nn.functional.max_pool2d(dead[None], 7, 1, 3)[0] > 0  # samples that dead ones are mixed into
    torch.testing.assert_close(found.linear()[~mixed], wanted[~mixed], atol=2e-5, rtol=0)
    assert float((found.linear() - wanted).abs().max()) < 0.02


def test_kernel_and_reference_of_analysers_agree() -> None:
    """Compiled and readable mixing of neighbours are the same to rounding, to the border."""
    for layout in (Layout(), MONO, Layout(origin=(1, 0)), Layout(origin=(0, 1))):
        sensor = BadSensor(layout)
        samples = sensor.rng.random(SIZE).astype(np.float32)
        pair = [f(samples, 0.1, sensor.calibration()) for f in (correct_analysers, correct_analysers_reference)]
        np.testing.assert_allclose(*pair, atol=1e-6)


def identity(layout: Layout, black: float) -> Calibration:
    """A calibration of a sensor without errors."""
    period = range(layout.period)
    table = tuple(tuple(Analyser(layout.filter_at(r, c).angle_deg, math.inf, 1.0) for c in period) for r in period)
    ones = tuple(tuple(1.0 for _ in period) for _ in period)
    maps = np.full(SIZE, black, np.float32), np.ones(SIZE, np.float32)
    none = np.zeros(0, np.int32)
    return Calibration(layout, WHITE, SIZE, black, None, maps[0], 1.0, ones, maps[1], None, none, table)


@LAYOUTS
def test_identity_changes_no_bit(layout: Layout) -> None:
    """Calibrations of perfect sensors, empty ones, and ambient frames without light return the frame's bits."""
    codes = torch.randint(0, 4096, SIZE).float()
    mosaic = Mosaic(codes, layout, LEVEL, WHITE)
    for calibration in (Calibration(layout, WHITE), identity(layout, LEVEL)):
        assert torch.equal(correct_mosaic(mosaic, calibration).data, codes)
    unlit = replace(mosaic, data=torch.full(SIZE, LEVEL))
    assert torch.equal(subtract_ambient(mosaic, unlit).data, codes)
    assert torch.equal(subtract_ambient(mosaic, mean_mosaic([unlit] * 3)).data, codes)


def test_clipped_samples_stay_clipped() -> None:
    """A sample at the white level is clipped after any correction, and one far below it is not."""
    sensor = BadSensor(Layout())
    light = np.full(SIZE, 0.4)
    light[40:60, 40:60] = 3.0
    light[80:90] = 1.5
    frame = sensor.expose(light, noise=False)
    found = correct_mosaic(frame, sensor.calibration())
    sound = np.ones(SIZE, bool)
    sound.flat[sensor.dead] = False
    was, now = (x.clipped().numpy()[sound] for x in (frame, found))
    assert (now[was]).all() and not now[(light < 0.5)[sound]].any()
    room = replace(frame, data=torch.where(torch.from_numpy(light) > 2, WHITE, 900.0))
    less = subtract_ambient(frame, room)
    assert torch.equal(less.clipped(), frame.clipped() | room.clipped())


def test_ambient_light_is_subtracted() -> None:
    """A frame of lamp and room less one of the room is the lamp's; of four frames their mean."""
    rng = np.random.default_rng(3)
    lamp, room = rng.uniform(0, 1500, SIZE), rng.uniform(0, 800, SIZE)

    def frame(light: NDArray[np.float64]) -> Mosaic:
        return Mosaic(torch.from_numpy((light + LEVEL).astype(np.float32)), Layout(), LEVEL, WHITE)

    less = subtract_ambient(frame(lamp + room), mean_mosaic([frame(room * k) for k in (0.8, 0.9, 1.1, 1.2)]))
    np.testing.assert_allclose(less.data.numpy(), lamp + LEVEL, atol=1e-3)


@pytest.mark.parametrize("color", [(1.0, 1.0, 1.0), (0.5, 1.0, 0.7)])
def test_a_measured_lamp_is_not_sought_in_frames(color: tuple[float, float, float], tmp_path: Path) -> None:
    """White lamps count as measured too, also in a frame that was merged; mono frames have no colour to measure."""
    for layout, known in ((Layout(), True), (MONO, False)):
        raw = Mosaic(np.full(SIZE, 500, np.float32), layout, 0.0, WHITE)
        assert not is_calibrated(raw)
        mosaic = correct_mosaic(raw, Calibration(layout, WHITE, lamp=LampFacts(color, None, None)))
        assert is_calibrated(mosaic) == known
        write_merged(tmp_path / "merged.tiff", merge_exposures([mosaic]).mosaic, {})
        assert is_calibrated(next(read_frames(tmp_path / "merged.tiff", ReadOptions())).data) == known


def test_histograms_are_of_raw_samples() -> None:
    """The colour of a calibrated lamp moves no sample toward white."""
    mosaic = Mosaic(torch.full(SIZE, 2000.0), Layout(), 0.0, WHITE)
    lit = replace(mosaic, light_color=(0.5, 1.0, 0.7))
    np.testing.assert_array_equal(histogram(lit).shares, histogram(mosaic).shares)


def test_histograms_count_what_clips_of_each_colour() -> None:
    """On every place of the period, and no other colour's samples."""
    blue = np.array([[Layout().filter_at(r, c).channel == 2 for c in range(SIZE[1])] for r in range(SIZE[0])])
    upper = np.arange(SIZE[0])[:, None] < SIZE[0] // 4
    found = histogram(Mosaic(np.where(blue & upper, WHITE, 2000.0).astype(np.float32), Layout(), 0.0, WHITE))
    assert found.clipped == (0.0, 0.0, 0.25) and found.shares[2, -1] == 0.25
    np.testing.assert_allclose(found.shares.sum(axis=1), 1)


def test_a_mean_takes_frames_one_at_a_time() -> None:
    """Ambient frames of a long recording are never all in memory."""
    alive: list[weakref.ref[torch.Tensor]] = []

    def frames() -> Iterator[Mosaic]:
        for k in range(6):
            data = torch.full(SIZE, 100.0 + k)
            alive.append(weakref.ref(data))
            yield Mosaic(data, Layout(), 0.0, WHITE)
            del data
            assert sum(ref() is not None for ref in alive) <= 3

    assert float(mean_mosaic(frames()).data.mean()) == pytest.approx(102.5)
    with pytest.raises(ValueError, match="expected at least one frame"):
        mean_mosaic([])


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (5, 7), (64, 48)])
def test_medians_are_those_of_numpy(shape: tuple[int, int], kind: type[np.floating]) -> None:
    """To the last bit, of floats and of codes."""
    noise = np.random.default_rng(1).normal(240, 3, shape).astype(kind)
    for values in (noise, noise.round(), noise[::2, ::2]):
        assert median(values) == np.median(values) and median(values).dtype == kind


def test_coarse_codes_have_their_mean() -> None:
    """Where most codes are equal, the others still count: 64.3 is not 64, and its noise is not 0."""
    rng = np.random.default_rng(0)
    codes = np.round(rng.normal(64.3, 0.3, 20_000)).astype(np.float32)
    assert robust_mean(codes) == pytest.approx(float(codes.mean()), abs=0.01) and robust_deviation(codes) > 0.3


def test_what_is_said_of_float_frames_is_not_rounded_away() -> None:
    """Frames whose white level is 1: black level, its error and the noise have digits."""
    rng = np.random.default_rng(3)
    frames = [rng.normal(64 / 4095, 2 / 4095, SIZE).astype(np.float32) for _ in range(4)]
    found = measure_dark(Mosaic(frame, Layout(), 0.0, 1.0) for frame in frames)
    assert found.details["dark"]["black_level_error_codes"] == pytest.approx(1 / 4095 / 143, rel=0.1)
    line = describe(found, "dark")
    assert "black level 0.0156" in line and "read noise 0.0004" in line


def test_black_of_float_frames_is_kept(tmp_path: Path) -> None:
    """A pattern of a code in frames whose white level is 1 survives its file."""
    black = (np.arange(SIZE[0] * SIZE[1]).reshape(SIZE) % 3 - 1).astype(np.float32) / 4095
    written = Calibration(Layout(), 1.0, SIZE, black_level=0.0, read_noise=1e-3, black_map=black)
    write_calibration(tmp_path / "rig.json", written, "1")
    found = read_calibration(tmp_path / "rig.json").black_map
    assert found is not None
    np.testing.assert_allclose(found, black, atol=2e-6)


def test_files_return_what_was_written(tmp_path: Path) -> None:
    """A calibration survives its file, maps to the precision of half floats; files are the same bytes each time."""
    sensor = BadSensor(Layout())
    written = replace(
        sensor.calibration(), lamp=LampFacts((0.5, 1.0, 0.6), 0.98, None), details={"dark": {"frames": 9}}
    )
    paths = write_calibration(tmp_path / "rig.json", written, "0")
    assert [p.name for p in paths] == ["rig.json", "rig.npz"]
    bytes_before = [p.read_bytes() for p in paths]
    found = read_calibration(tmp_path / "rig.json")
    assert found.black_map is not None and found.gain_map is not None
    np.testing.assert_allclose(found.black_map, written.black_map, atol=0.02)
    np.testing.assert_allclose(found.gain_map, written.gain_map, atol=1e-4)
    for name in ("layout", "white_level", "size", "black_level", "read_noise", "gains", "falloff", "lamp"):
        assert getattr(found, name) == getattr(written, name)
    assert found.analysers is not None and written.analysers is not None
    np.testing.assert_allclose(found.analysers, written.analysers, atol=1e-6)
    assert found.details["dark"] == {"frames": 9}
    write_calibration(tmp_path / "rig.json", found, "0")
    assert [p.read_bytes() for p in paths] == bytes_before
    (tmp_path / "rig.npz").unlink()
    with pytest.raises(ValueError, match=r"expected its maps in rig\.npz beside it, found none"):
        read_calibration(tmp_path / "rig.json")


def test_maps_cannot_change_behind_what_is_remembered() -> None:
    """A change in place would be seen by whoever reads the file next, and not by the frames that are corrected."""
    gains = np.ones(SIZE, np.float32)
    rig = Calibration(Layout(), WHITE, SIZE, gain_map=gains, dead=np.array([7], np.int32))
    gains[:] = 2
    assert rig.gain_map is not None and float(rig.gain_map.max()) == 1 and rig.dead is not None
    for values in (rig.gain_map, rig.dead):
        with pytest.raises(ValueError, match="read-only"):
            values[:] = 0


def test_files_are_those_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of one name in two folders, of one time as archives leave them, are told apart."""
    for level in (1.0, 2.0):
        folder = tmp_path / str(level)
        folder.mkdir()
        written = Calibration(Layout(), WHITE, black_level=level, black_pattern=((level,) * 4,) * 4, read_noise=1.0)
        write_calibration(folder / "rig.json", written, "0")
        os.utime(folder / "rig.json", (1e9, 1e9))
        monkeypatch.chdir(folder)
        assert read_calibration("rig.json").black_level == level


def save(path: Path, mosaic: Mosaic) -> Path:
    """A frame as a 16-bit TIFF."""
    tifffile.imwrite(path, mosaic.data.numpy().astype(np.uint16))
    return path


def test_commands_measure_and_apply(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Dark and flat build one file; with it, levels need not be typed; the same as in Python; bad input is one line."""
    sensor = BadSensor(Layout())
    rig = tmp_path / "rig.json"
    caps = [save(tmp_path / f"cap{i}.tiff", sensor.expose(np.zeros(SIZE))) for i in range(4)]
    paper = [save(tmp_path / f"paper{i}.tiff", sensor.expose(sensor.sees(np.full(SIZE, 1.0)))) for i in range(4)]
    shot = save(tmp_path / "shot.tiff", sensor.expose(sensor.sees(np.full(SIZE, 0.7), 0.2, 1.0)))
    room = save(tmp_path / "room.tiff", sensor.expose(sensor.sees(np.full(SIZE, 0.1))))
    forgotten = run_polsep("calibrate", "dark", *caps, "-o", rig)
    assert forgotten.status == 2 and "expected --white-level N" in forgotten.err and not rig.exists()
    done = run_polsep("calibrate", "dark", *caps, "--white-level", 4095, "-o", rig)
    assert done.status == 0 and done.out.count("\n") == 1 and "read noise" in done.out
    done = run_polsep("calibrate", "flat", *paper, "-o", rig)
    assert done.status == 0 and "20 dead pixels" in done.out
    assert set(json.loads(rig.read_text())) >= {"dark", "flat", "maps"}
    done = run_polsep(
        *("separate", shot, "--calibration", rig, "--ambient", room, "--method", "analytic"),
        *("-o", tmp_path / "out", "--format", "npz"),
    )
    assert done.status == 0
    assert json.loads((tmp_path / "out" / "shot.json").read_text())["report"]["settings"]["calibration"] == "rig.json"
    with np.load(tmp_path / "out" / "shot.npz") as written:
        diffuse = written["diffuse"]
    raws = [tifffile.imread(path) for path in (shot, room)]
    out = polsep.separate(raws[0], "analytic", calibration=rig, ambient=raws[1])
    np.testing.assert_array_equal(diffuse, out.diffuse)
    assert abs(float((out.diffuse + out.specular).mean()) - 0.6) < 0.01
    both = ("separate", shot, room, "--ambient", room, "--calibration", rig, "-o", tmp_path / "both")
    done = run_polsep(*both, "--method", "analytic")
    assert done.status == 0 and "room.tiff is the lamp-off frame: it is not separated" in done.err
    assert {path.stem for path in (tmp_path / "both").iterdir()} == {"shot"}
    save(tmp_path / "small.tiff", replace(sensor.expose(np.zeros(SIZE)), data=torch.zeros(64, 64)))
    for arguments, expected in (
        (("separate", tmp_path / "small.tiff", "--calibration", rig), "expected frames of 160x128, as calibrated"),
        (("separate", shot, "--calibration", tmp_path / "none.json"), "expected a file, found nothing"),
        (("separate", shot, "--calibration", shot), "expected a calibration of 'polsep calibrate'"),
        (("separate", shot, "--ambient", tmp_path / "small.tiff"), "expected an ambient frame of 160x128"),
        (("separate", room, "--ambient", room), "expected frames with the lamp on, found the lamp-off frame alone"),
        (("calibrate", "dark", *paper, "--white-level", 800, "-o", rig), "expected frames of white level 4095.0"),
        (("calibrate", "flat", *caps, "-o", rig), "expected flat frames near half of the white level"),
    ):
        failed: Run = (
            run_polsep(*arguments, "-o", tmp_path / "none") if arguments[0] == "separate" else run_polsep(*arguments)
        )
        assert failed.status == 2 and failed.err.count("\n") == 1 and expected in failed.err, failed


def test_a_calibration_lies_beside_its_frames(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Its maps are no frame of the folder: dark frames are measured twice there, and shots separated."""
    sensor = BadSensor(Layout())
    for i in range(3):
        save(tmp_path / f"cap{i}.tiff", sensor.expose(np.zeros(SIZE)))
    measure = ("calibrate", "dark", tmp_path, "--white-level", 4095, "-o", tmp_path / "rig.json")
    for _ in range(2):
        done = run_polsep(*measure)
        assert (done.status, done.err) == (0, "") and (tmp_path / "rig.npz").exists() and "3 frames" in done.out
    assert [Path(path).suffix for path in expand_folders([str(tmp_path)])] == [".tiff"] * 3


def test_dark_frames_of_different_exposure_times_are_noted(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Dark current grows with time: the calibration is for none of them. Frames that say no time are like all."""
    caps, codes = [tmp_path / f"cap{k}.tiff" for k in range(3)], np.random.default_rng(1).integers(60, 70, (3, 32, 32))

    def said(*times: int | None) -> str:
        for path, frame, time in zip(caps, codes, times, strict=True):
            tags = [] if time is None else [(33434, "2I", 1, (time, 100), True)]
            tifffile.imwrite(path, frame.astype(np.uint16), photometric="minisblack", extratags=tags)
        done = run_polsep("calibrate", "dark", *caps, "--white-level", WHITE, "-o", tmp_path / "rig.json")
        assert done.status == 0
        return done.err

    assert "dark frames were exposed for 0.01 s to 0.04 s: use the exposure time of" in said(1, 4, None)
    assert said(4, 4, None) == said(None, None, None) == ""


def test_a_wrong_layout_is_noted(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Frames of a mono sensor measured as colour are a note: all later frames would be read so."""
    sensor = BadSensor(MONO, dead=0)
    paper = [save(tmp_path / f"paper{i}.tiff", sensor.expose(sensor.sees(np.full(SIZE, 1.0)))) for i in range(3)]
    said = ("--white-level", WHITE, "--black-level", LEVEL, "-o", tmp_path / "rig.json", "--layout")
    right = run_polsep("calibrate", "flat", *paper, *said, "mono")
    (tmp_path / "rig.json").unlink()
    wrong = run_polsep("calibrate", "flat", *paper, *said, "color")
    assert (right.status, right.err) == (0, "")
    assert wrong.status == 0 and wrong.err.startswith("polsep: paper0: the frame shows no colour pattern")
    assert wrong.err.count("\n") == 1


def test_an_ambient_frame_with_the_lamp_on_is_said() -> None:
    """Such a frame leaves hardly any light; one of a dimmer room, or of none, says nothing. Strips are seen, too."""
    scene = np.random.default_rng(3).integers(500, 3000, SIZE).astype(np.uint16)

    def said(room: NDArray[np.uint16]) -> bool:
        with warnings.catch_warnings(action="ignore"):
            out = polsep.separate(scene[: len(room)], "analytic", white_level=4095, ambient=room)
        return any("was the lamp off in it?" in warning for warning in out.report["warnings"])

    assert said(scene) and said(scene + np.uint16(9)) and said(scene[:6]) and not said(scene[:6] // 8)
    assert not said(scene // 2) and not said(scene // 10) and not said(np.zeros_like(scene))


@pytest.mark.parametrize("layout", [Layout(), MONO, Layout(((0, 45), (90, 135)), "BGGR", (1, 0))])
def test_a_dim_lamp_in_an_ambient_frame_is_said(layout: Layout) -> None:
    """A lamp at a twentieth of its light, or at most of it, is seen by its highlights; no room is that is mirrored
    elsewhere, or in the same places at another angle."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    turns = np.deg2rad([[2 * layout.filter_at(r, c).angle_deg for c in range(SIZE[1])] for r in range(SIZE[0])])
    body = 0.1 + 0.05 * np.sin(40 * x) * np.sin(30 * y)

    def lit(place: float, angle: float) -> NDArray[np.float64]:
        return 0.5 * (body + 0.6 * np.exp(-9 * ((x - place) ** 2 + y**2)) * (1 + np.cos(turns - 2 * angle)))

    def said(room: NDArray[np.float64], lamp: float = 1.0) -> tuple[str, ...]:
        noise = np.random.default_rng(1).normal(0, 0.003, (2, *SIZE))
        frame, dark = (
            Mosaic((k + n).astype(np.float32), layout, 0.0, 2.0)
            for k, n in zip((lit(0, 1) * lamp + room, room), noise, strict=True)
        )
        return Corrections(None, dark).apply_noting(frame)[1]

    for part in (0.05, 0.5, 0.8):
        (note,) = said(part * lit(0, 1), 1 - part)
        assert "has the highlights of this one in" in note and "was the lamp off in it?" in note, (part, note)
    assert said(lit(0.6, 1)) == said(lit(0, 1.8)) == said(0 * x) == ()


def test_ambient_frames_of_another_exposure_time_are_named(tmp_path: Path) -> None:
    """Where the files of both say it: nothing is scaled. Lamp-off frames of several times are refused."""

    def shot(name: str, time: int | None) -> Path:
        tags = [] if time is None else [(33434, "2I", 1, (time, 1000), True)]
        tifffile.imwrite(tmp_path / name, np.full((16, 16), 900, np.uint16), extratags=tags)
        return tmp_path / name

    def said(time: int | None, *rooms: int | None) -> list[str]:
        paths = [shot(f"room{k}.tiff", room) for k, room in enumerate(rooms)]
        read = with_corrections(ReadOptions(white_level=1000), None, paths)
        (frame,) = read_frames(shot("shot.tiff", time), read)
        return [note for note in frame.notes if "exposed for" in note]

    assert said(10, 100) == [
        "the ambient frame was exposed for 0.1 s, this one for 0.01 s: too much is subtracted, "
        "take one of the same exposure"
    ]
    assert "too little" in said(10, 5)[0]
    assert said(10, 10, 10) == said(10, 10, None) == said(10, None) == said(None, 10) == []
    with pytest.raises(InputError, match=r"room0\.tiff: expected .* one exposure time, found 0\.01 s and 0\.02 s"):
        said(10, 10, 20)


@pytest.mark.parametrize("room", [np.uint8, np.float32])
@pytest.mark.parametrize("black", [0, 64])
def test_ambient_frames_of_another_type_are_said(room: type, black: int, tmp_path: Path) -> None:
    """12 bits in words beside 8 bits, or floats of white 1: hardly anything is subtracted, or less than nothing."""
    rng = np.random.default_rng(0)
    lit, dark = (rng.uniform(100, most, SIZE) for most in (3000, 300))
    np.save(tmp_path / "shot.npy", lit.astype(np.uint16))
    np.save(tmp_path / "good.npy", dark.astype(np.uint16))
    np.save(tmp_path / "room.npy", (dark / 16).astype(room) if room is np.uint8 else (dark / 4095).astype(room))
    notes = []
    for name in ("good.npy", "room.npy"):
        read = with_corrections(ReadOptions(black_level=black, white_level=4095), None, [tmp_path / name])
        (frame,) = read_frames(tmp_path / "shot.npy", read)
        notes.append([note for note in frame.notes if "another unit" in note])
    assert not notes[0] and len(notes[1]) == 1, notes
    with warnings.catch_warnings(action="ignore"):
        codes, samples = np.load(tmp_path / "shot.npy"), np.load(tmp_path / "room.npy")
        if room is np.float32:
            with pytest.raises(ValueError, match="expected a lamp-off frame like the frame"):
                polsep.separate(codes, "analytic", None, black, 4095, ambient=samples)
        else:
            out = polsep.separate(codes, "analytic", None, black, 4095, ambient=samples)
            assert [note for note in out.report["warnings"] if "another unit" in note] == notes[1]


def test_paper_that_does_not_fill_the_frame_is_refused() -> None:
    """A border in half the light, and a corner in none: neither is a lens, nor are so many pixels dead."""
    sensor = BadSensor(MONO, dead=0)
    used, light = (
        Corrections(replace(sensor.calibration(), gains=None, gain_map=None, falloff=None)),
        np.full(SIZE, 1.0),
    )
    for part in (np.s_[:16], np.s_[:, :24]):
        dim = light.copy()
        dim[part] *= 0.3
        with pytest.raises(ValueError, match="expected evenly lit white over the whole frame"):
            measure_flat((used.apply(sensor.expose(sensor.sees(dim))) for _ in range(4)), None)


def test_what_cannot_be_read_again_is_not_written(tmp_path: Path) -> None:
    """The calibration of before stays."""
    good = BadSensor(Layout()).calibration()
    write_calibration(tmp_path / "rig.json", good, "0")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="expected black_level with its black_map"):
        write_calibration(tmp_path / "rig.json", replace(good, black_level=None), "0")
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


DAMAGES: list[tuple[str, Any, str]] = [
    ("layout", 3, "expected layout as text, found 3"),
    ("white_level_codes", "4095", 'expected white_level_codes as a number, found "4095"'),
    ("height", 1.5, "expected height in whole pixels, found 1.5"),
    ("dark", True, "expected dark as a section of entries, found true"),
    ("dark", None, "expected black_level with its black_map, found none: is a section missing?"),
    ("dark.black_level_codes", True, "expected black_level_codes as a number, found true"),
    ("dark.read_noise_codes", -2, "expected read noise from 0 to 4095, found -2"),
    ("dark.black_pattern_codes", [1, 2], "expected black_pattern_codes as a list of numbers, found 1"),
    ("flat", {}, "expected an entry gains, found none"),
    ("flat.gains", None, "expected gains as rows of numbers, found null"),
    ("analysers.gain", [[1.0]], "expected angle_deg, extinction and gain of the same places, found rows of [[4, 4, 4"),
    ("analysers.extinction", [[0.5] * 4] * 4, "expected extinction ratios above 1, found 0.5"),
    ("light", [1, 2], "expected light as a section of entries, found [1, 2]"),
    ("light.color_rgb", [1, 2], "expected color_rgb as 3 numbers, found [1, 2]"),
    ("light.dolp", "x", 'expected dolp as a number, found "x"'),
    ("light.dolp", -5, "expected a lamp's dolp from 0 to 2, found -5"),
    ("maps", "rig.npz", 'expected maps as a section of entries, found "rig.npz"'),
    ("maps", {}, "expected an entry sha256, found none"),
]


@pytest.mark.parametrize(
    ("place", "value", "message"), DAMAGES, ids=[f"{place}-{value}" for place, value, _ in DAMAGES]
)
def test_damaged_files_name_the_entry(tmp_path: Path, place: str, value: Any, message: str) -> None:
    layout, table, zeros = Layout(), ((1.0,) * 4,) * 4, np.zeros((8, 8), np.float32)
    analysers = tuple(tuple(Analyser(layout.filter_at(r, c).angle_deg, 99.0, 1.0) for c in range(4)) for r in range(4))
    rig = Calibration(layout, 4095.0, (8, 8), 64.0, table, zeros + 64, 2.0, table, zeros + 1, ((1.0,),))
    path = tmp_path / "rig.json"
    write_calibration(path, replace(rig, analysers=analysers, lamp=LampFacts((0.5, 1.0, 0.7), 0.9, 30.0)), "test")
    read_calibration(path)
    record = json.loads(path.read_text())
    section, _, entry = place.rpartition(".")
    (record[section] if section else record)[entry] = value
    path.write_text(json.dumps(record))
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    assert message in str(caught.value), caught.value


def test_an_unknown_read_noise_is_read_again(tmp_path: Path) -> None:
    write_calibration(tmp_path / "rig.json", Calibration(Layout(), 4095.0, black_level=2.0), "test")
    found = read_calibration(tmp_path / "rig.json")
    assert found.black_level == 2 and found.read_noise is None and found.black_pattern is None


def test_measuring_again_replaces_defects_of_its_own_kind() -> None:
    """A second flat forgets the dead pixels of the first, and keeps the hot ones of the dark."""
    sensor = BadSensor(MONO, dead=3)
    hot = np.array([7, 99], np.int32)
    base = replace(sensor.calibration(), hot=hot, dead=np.array([1000], np.int32))
    used = Corrections(replace(base, gains=None, gain_map=None, falloff=None, hot=None, dead=None, analysers=None))
    found = measure_flat((used.apply(sensor.expose(sensor.sees(np.full(SIZE, 1.0)))) for _ in range(4)), base)
    assert found.hot is base.hot and found.dead is not None
    assert found.dead.tolist() == sorted(sensor.dead.tolist())
    assert found.defects.tolist() == sorted({*hot.tolist(), *sensor.dead.tolist()})


def test_gains_are_undone_once_in_any_order() -> None:
    """Analysers measured before the flat hold the gains of places; the flat then takes them over."""
    sensor = BadSensor(MONO, dead=0)
    plain = replace(sensor.calibration(), gains=None, gain_map=None, falloff=None, dead=None, analysers=None)
    aolps = np.linspace(0, np.pi, 10, endpoint=False)
    used = Corrections(plain)
    turned = [used.apply(sensor.expose(sensor.sees(np.full(SIZE, 0.8), 1.0, aolp))) for aolp in aolps]
    first = measure_analysers(turned, plain)
    found = measure_flat((used.apply(sensor.expose(sensor.sees(np.full(SIZE, 1.0)))) for _ in range(10)), first)
    even = correct_mosaic(sensor.expose(sensor.sees(np.full(SIZE, 0.8)), noise=False), found)
    assert even.falloff is not None
    light = even.linear().numpy() / falloff_image(even.falloff, *SIZE)
    places = np.array([light[r::2, c::2].mean() for r in (0, 1) for c in (0, 1)])
    np.testing.assert_allclose(places / places.mean(), 1, atol=0.005)


def test_a_small_part_of_a_card_is_enough() -> None:
    mosaic = Mosaic(torch.full((16, 16), 0.5), Layout(), 0.0, 1.0)
    lamp = measure_lamp([mosaic], None, True).lamp
    assert lamp is not None and lamp.color == (1.0, 1.0, 1.0)


def test_a_hot_pixel_on_a_card_is_no_clipping() -> None:
    """Of many pixels one counts for nothing; a clipped part of the card is refused."""
    data = np.full((192, 192), 0.5, np.float32)
    data[96, 96] = 1
    lamp = measure_lamp([Mosaic(data, Layout(), 0.0, 1.0)], None, True).lamp
    assert lamp is not None and lamp.color == pytest.approx((1, 1, 1), abs=0.01)
    data[90:100, 90:100] = 1
    with pytest.raises(ValueError, match="found clipped samples"):
        measure_lamp([Mosaic(data, Layout(), 0.0, 1.0)], None, True)


def test_a_black_level_that_nobody_says_is_asked_for(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Where frames show that black is not at 0: the lamp's colour and exposure times would be wrong without a word."""
    rng = np.random.default_rng(0)
    light = np.repeat([0.0, 0.0, 200.0, 800.0, 2000.0, 5000.0, 5000.0, 7000.0], 64)[:, None]
    codes = [240 + 0.4 * rng.poisson(k * light, (512, 512)) + rng.normal(0, 1.5, (512, 512)) for k in (0.5, 1)]
    names = [tmp_path / f"{k}.tiff" for k in range(2)]
    for name, frame in zip(names, codes, strict=True):
        tifffile.imwrite(name, np.rint(frame).clip(0, 4095).astype(np.uint16))
    for command in (("calibrate", "light", "--card"), ("calibrate", "analysers"), ("merge",)):
        output = tmp_path / ("m.tiff" if command[0] == "merge" else "rig.json")
        done = run_polsep(*command, *names, "--white-level", 4095, "-o", output)
        assert done.status == 2 and "expected black at 0, found it at 24" in done.err and not output.exists(), done
    done = run_polsep("merge", *names, "--white-level", 4095, "--black-level", 240, "-o", tmp_path / "m.tiff")
    assert done.status == 0
    ones = ((1.02, 0.98) * 2, (0.99, 1.01) * 2) * 2
    gains = Calibration(Layout(), 4095.0, (512, 512), gains=ones, falloff=((1.0,),))
    write_calibration(tmp_path / "gains.json", gains, "0")  # samples that gains divide are no codes any more
    for white in ((), ("--white-level", 4095)):  # which the calibration says, too
        words = (*white, "--calibration", tmp_path / "gains.json", "-o", tmp_path / "n.tiff")
        done = run_polsep("merge", *names, *words)
        assert done.status == 2 and "expected black at 0, found it at 24" in done.err, done


def test_levels_of_the_dark_are_said_once(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """A black level beside a calibration that has one is refused: one of them would be ignored."""
    write_calibration(tmp_path / "rig.json", BadSensor(Layout()).calibration(), "0")
    shot = save(tmp_path / "shot.tiff", BadSensor(Layout()).expose(np.full(SIZE, 0.4)))
    words = ("--calibration", tmp_path / "rig.json", "--black-level", 100, "-o", tmp_path / "out")
    done = run_polsep("separate", shot, *words)
    assert done.status == 2 and "expected no --black-level but 64, which a calibration" in done.err
    words = ("--white-level", 4095, "--black-level", 100, "-o", tmp_path / "new.json")
    done = run_polsep(
        "calibrate", "dark", save(tmp_path / "cap.tiff", BadSensor(Layout()).expose(np.zeros(SIZE))), *words
    )
    assert done.status == 2 and "expected no --black-level but 6" in done.err and not (tmp_path / "new.json").exists()
    with pytest.raises(ValueError, match="expected no black_level but 64"):
        polsep.separate(tifffile.imread(shot), calibration=tmp_path / "rig.json", black_level=100)
    with warnings.catch_warnings(action="ignore"):  # of an even frame
        polsep.separate(tifffile.imread(shot), "analytic", calibration=tmp_path / "rig.json", black_level=64)


@pytest.mark.parametrize("scale", [1, 16])
@pytest.mark.parametrize(("name", "lit"), [("black frame", 0), ("overexposed", 1000)])
def test_exposure_is_judged_above_the_measured_black(tmp_path: Path, scale: int, name: str, lit: int) -> None:
    """What is said of overexposed and of black frames is the same whether the black level was said or measured."""
    codes = np.full((96, 96), 240, np.uint16)
    codes[40:60] += lit
    codes[40:44] = 4095 if lit else 239
    codes *= scale
    tifffile.imwrite(tmp_path / "shot.tiff", codes)
    measured = Calibration(Layout(), WHITE, black_level=240.0)
    said = ReadOptions(black_level=240.0 * scale, white_level=WHITE * scale)
    read = replace(said, black_level=0.0, corrections=Corrections(measured))
    (one,), (other,) = (list(read_frames(tmp_path / "shot.tiff", options)) for options in (said, read))
    assert other.notes == one.notes and [note.startswith(name) for note in other.notes] == [True]
    assert isinstance(other.data, Mosaic) and other.data.black_level == 240 * scale
    with warnings.catch_warnings(action="ignore"):
        found = polsep.separate(codes, "analytic", white_level=WHITE * scale, calibration=measured)
    assert found.report["warnings"][0] == one.notes[0]


def test_the_white_of_floats_is_not_that_of_codes(tmp_path: Path) -> None:
    """A lamp that was measured in a merged frame, whose white is 1, says nothing of the white level of raw frames."""
    lamp = Calibration(Layout(), 1.0, lamp=LampFacts((0.5, 1.0, 0.7), None, None))
    codes = np.random.default_rng(2).integers(100, 65_000, (32, 32)).astype(np.uint16)
    np.save(tmp_path / "shot.npy", codes)
    (read,) = read_frames(tmp_path / "shot.npy", ReadOptions(corrections=Corrections(lamp)))
    with warnings.catch_warnings(action="ignore"):  # of noise
        found = polsep.separate(codes, "analytic", calibration=lamp)
    assert read.white_level == found.report["white_level"] == 65535
    assert lamp.white_level_of(codes.astype(np.float32)) == 1


def test_maps_replace_no_file_of_something_else(tmp_path: Path) -> None:
    """Raw frames in rig.npz stay when rig.json is written, with maps and without; maps of before do not."""
    sensor, rig, maps = BadSensor(Layout()), tmp_path / "rig.json", tmp_path / "rig.npz"
    plain = replace(sensor.calibration(), dead=None, black_map=None, gain_map=None)
    maps.write_bytes(b"frames")
    for calibration in (plain, sensor.calibration()):
        with pytest.raises(OutputError, match=r"expected no .*rig\.npz"):
            write_calibration(rig, calibration, "0")
        assert maps.read_bytes() == b"frames" and not rig.exists()
    maps.unlink()
    write_calibration(rig, sensor.calibration(), "0")
    assert maps.exists()
    write_calibration(rig, plain, "0")
    assert not maps.exists()
    write_calibration(rig, sensor.calibration(), "0")
    rig.unlink()  # to begin anew: maps of before are none of something else
    write_calibration(rig, plain, "0")
    assert not maps.exists()


def test_an_ambient_folder_is_read_again_when_its_files_change(tmp_path: Path) -> None:
    """A file that is written anew leaves the folder's own time as it was."""
    codes = np.full((16, 16), 10, np.uint8)
    for value in (10, 90):
        np.save(tmp_path / "room.npy", np.full_like(codes, value))
        read = with_corrections(ReadOptions(), None, [tmp_path])
        assert read.corrections is not None and read.corrections.ambient is not None
        assert float(read.corrections.ambient.data.mean()) == value


def test_settings_know_the_content_of_corrections(tmp_path: Path) -> None:
    """By which a film that is resumed knows a calibration or an ambient frame of the same name for another one."""
    settings = []
    for level in (8.0, 9.0):
        write_calibration(tmp_path / "rig.json", Calibration(Layout(), 255.0, (16, 16), level, read_noise=1.0), "0")
        np.save(tmp_path / "room.npy", np.full((16, 16), int(level), np.uint8))
        settings.append(with_corrections(ReadOptions(), tmp_path / "rig.json", [tmp_path / "room.npy"]).settings())
    assert settings[0]["calibration"] == settings[1]["calibration"] == "rig.json"
    assert all(settings[0][name] != settings[1][name] for name in ("calibration_sha256", "ambient_sha256"))


def test_recordings_are_corrected(tmp_path: Path) -> None:
    """Every frame of a file is corrected as it is read, ambient frames too."""
    sensor = BadSensor(Layout())
    write_calibration(tmp_path / "rig.json", sensor.calibration(), "0")
    frames = [sensor.expose(sensor.sees(np.full(SIZE, 0.5))) for _ in range(3)]
    codes = np.stack([frame.data.numpy().astype(np.uint16) for frame in frames])
    np.save(tmp_path / "film.npy", codes)
    np.save(tmp_path / "room.npy", codes)
    read = with_corrections(ReadOptions(), tmp_path / "rig.json", [tmp_path / "room.npy"])
    total = sum(frame.data.linear() for frame in read_frames(tmp_path / "film.npy", read))  # type: ignore[union-attr]
    assert float(np.abs(total).max()) < 2e-3
