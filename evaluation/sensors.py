"""Losses before a bad sensor and under a lamp that is not white, before and after each `polsep calibrate`.

Scenes of `datasets.reality`, split test, as `polsep bench reality` has them, each before a `BAD` sensor of its own with
vignetting, a black level and a black pattern. Ten frames of each kind are recorded, too, and measured as the command
measures its files: the cap on, an even unpolarized field, a polarizer turned before it, a grey card under the lamp.
Loss: PSNR of the ideal twin, whose white lamp is stated, less that of the frame.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polsep.bench.reality import score
from polsep.bench.rows import Row
from polsep.calibrate.analysers import measure_analysers
from polsep.calibrate.dark_flat import measure_dark, measure_flat
from polsep.calibrate.files import corrections_for
from polsep.calibrate.lamp import measure_lamp
from polsep.datasets.reality import Capture, Frame, Stage, build_stage, expose_frame, ideal_frame, light_stage
from polsep.physics.stokes import Stokes
from polsep.render.disturbances import LAMPS, as_color
from polsep.render.sensor_errors import SensorErrors, record
from polsep.render.simulate import half_resolution
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Layout, Mosaic, Sensor

#: Methods whose frames are separated; number of scenes, raw pixels per side, frames of each calibration.
METHODS, SCENES, SIDE, FRAMES = ("analytic", "color-affine", "joint", "joint-large"), 24, 512, 10
#: The sensor: extinction of 30 in every colour, and what of its pixels differs.
WORN = Sensor(10_500.0, 2.4, 12, (29 / 31, 29 / 31, 29 / 31))
BAD = SensorErrors(angles_deg=3.0, gains=0.03, black=64 / 4095, defects=1e-3)
#: Light in the corners over that in the middle; rms of the black pattern [codes].
CORNER, PATTERN = 0.6, 8.0
#: Light of even frames, as a share of what clips; the lamp that is not white.
LEVEL, LAMP = 0.6, LAMPS["daylight"]
#: Rows of the bad sensor: what of it is known.
KNOWN = ("black level", "dark", "dark, flat", "dark, flat, analysers")


def bench_sensors(scenes: int = SCENES) -> Iterator[Row]:
    """Loss of methods before a bad sensor and a coloured lamp, by what of them is measured."""
    losses: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number in range(scenes):
        stage = build_stage("test", number, SIDE)
        twin = ideal_frame(stage)
        frames = {**_before_bad_sensor(stage), **_under_lamp(stage)}
        for method in METHODS:
            ideal = score(twin, method, True)
            for case, frame in frames.items():
                found = score(frame, method, True)
                pair = (ideal.diffuse - found.diffuse, ideal.specular - found.specular)
                losses.setdefault((case, method), []).append(pair)
    for (case, method), pairs in losses.items():
        for output, values in zip(("diffuse", "specular"), zip(*pairs, strict=True), strict=True):
            yield Row("sensors", case, method, f"{output} loss", round(statistics.fmean(values), 2), "dB")


def _before_bad_sensor(stage: Stage) -> dict[str, Frame]:
    """The scene before its bad sensor, by what of that is stated."""
    sensor = _BadSensor(stage)
    scene = light_stage(stage)
    diffuse, specular, mask = half_resolution(scene)
    raw = sensor.expose(scene.diffuse + scene.specular, stage.seed).data.numpy().astype(np.uint16)
    frame = Frame(raw, WORN.white_level, diffuse, specular, mask, torch.ones(3, 1, 1), Layout())
    dark = measure_dark(sensor.even(0.0, None) for _ in range(FRAMES))
    flat = measure_flat((_corrected("flat", dark, sensor.even(LEVEL, None)) for _ in range(FRAMES)), dark)
    turns = (math.pi * k / FRAMES for k in range(FRAMES))
    turned = (_corrected("analysers", flat, sensor.even(LEVEL, turn)) for turn in turns)
    known: list[dict[str, Any]] = [{"black_level": BAD.black * WORN.white_level}]
    known += [{"calibration": one} for one in (dark, flat, measure_analysers(turned, flat))]
    white = {"light_color": (1.0, 1.0, 1.0)}
    return {f"worn sensor: {name}": replace(frame, options=white | one) for name, one in zip(KNOWN, known, strict=True)}


def _under_lamp(stage: Stage) -> dict[str, Frame]:
    """The scene under a lamp that is not white to the sensor, not stated, and measured by a grey card."""
    lamp = Capture(LAMP)
    card = Stokes(LEVEL * as_color(LAMP).expand(3, SIDE, SIDE), *_no_polarization())
    cards = (record(card, Layout(), lamp.sensor, lamp.errors, stage.seed + 1 + k) for k in range(FRAMES))
    measured = {"calibration": measure_lamp(cards, card=True)}
    found = {"not told": {}, "light": measured}
    return {
        f"daylight lamp: {name}": expose_frame(stage, light_stage(stage), lamp, options)
        for name, options in found.items()
    }


class _BadSensor:
    """The sensor of a scene, and its lens."""

    def __init__(self, stage: Stage) -> None:
        self._errors, self._seed = replace(BAD, specimen=stage.seed % 1000), stage.seed + 1000
        across = torch.linspace(-1, 1, SIDE)
        self._falloff = 1 - (1 - CORNER) * (across[:, None] ** 2 + across**2) / 2
        kinds = torch.randn(4, 4, generator=stage.draw(9)).repeat(SIDE // 4, SIDE // 4)
        rows, columns = (
            torch.randn(*size, generator=stage.draw(10 + k)) for k, size in enumerate(((SIDE, 1), (1, SIDE)))
        )
        self._pattern = PATTERN * (kinds + rows + columns) / math.sqrt(3)

    def expose(self, light: Stokes, seed: int | None = None) -> Mosaic:
        """A frame of light ``[3, H, W]``."""
        self._seed += 1
        mosaic = record(light * self._falloff, Layout(), WORN, self._errors, self._seed if seed is None else seed)
        codes = torch.round(mosaic.data + self._pattern).clamp(0, WORN.white_level)
        # The pattern is there before the codes are made: what saturates is white, whatever the pattern adds.
        return replace(mosaic, data=torch.where(mosaic.data >= WORN.white_level, mosaic.data, codes))

    def even(self, level: float, turn: float | None) -> Mosaic:
        """A frame of even light: unpolarized, or behind a polarizer with its axis at ``turn`` [rad]."""
        one = torch.full((3, SIDE, SIDE), level)
        if turn is None:
            return self.expose(Stokes(one, *_no_polarization()))
        return self.expose(Stokes(one, math.cos(2 * turn) * one, math.sin(2 * turn) * one))


def _no_polarization() -> tuple[Tensor, Tensor]:
    return torch.zeros(3, SIDE, SIDE), torch.zeros(3, SIDE, SIDE)


def _corrected(kind: str, before: Calibration, mosaic: Mosaic) -> Mosaic:
    """A frame as `polsep calibrate` corrects it before it measures a ``kind``."""
    return corrections_for(kind, before).apply(mosaic)
