"""Colour, polarization angle and degree of a lamp, from frames of an object or of a grey card under it.

Specular light has the lamp's colour and polarization. On a shiny dark ball it is nearly all the light there is; on
other objects the colour is that of `find_light`, while the degree of polarization is a lower bound. A grey card
shows the colour without any specular light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from polsep.calibrate.dark_flat import MOST_CLIPPED, require_same_sensor
from polsep.calibrate.statistics import Doubles
from polsep.compute.arrays import to_numpy
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.light.find import SURE_DEG, Light, combine, find_light
from polsep.physics.stokes import aolp_of, axis_deg, fit_stokes_unclipped
from polsep.sensor.calibration import Calibration, LampFacts
from polsep.sensor.camera import Mosaic
from polsep.separation.analytic import light_polarizer_angle

#: Polarized light that counts, relative to its 99.9th percentile, and its least strength, white = 1; fewest pixels.
STRONG, LEAST, MIN_PIXELS = 0.3, 0.02, 64
#: Share of those pixels, the most polarized ones, that show the lamp's degree of polarization.
PURE = 0.1
#: Concentration of AoLP in those pixels and in the most polarized ones of them, below which they show no lamp: balls
#: have 1.0, still lifes that show its angle 0.75 and more, rims of objects and wrong white levels 0.5 and less.
ONE_ANGLE = 0.6
#: Parts of a card along each side whose colours are compared for the error, and the largest root mean square of their
#: differences from the mean [degrees]: noise averages out in parts, and lamps are uneven by less.
PARTS, UNEVEN_DEG = 3, 5.0
#: Least brightness of a card, white = 1.
DARKEST_CARD = 0.02


def measure_lamp(frames: Iterable[Mosaic], before: Calibration | None = None, card: bool = False) -> Calibration:
    """``before`` with the lamp of frames that show an object, or, with ``card``, a grey card in their middle.

    ``frames`` are corrected by ``before``. The lamp has no angle and no degree of polarization where their polarized
    light is of many angles, which is refused in mono. Raises ValueError where too little polarized light shows.
    """
    colors, lights, polarizations, first = [], [], [], None
    for mosaic in frames:
        require_same_sensor(before, mosaic)
        first = mosaic if first is None else first
        if card:
            colors += _card_colors(mosaic)
        else:
            polarizations.append(_specular_polarization(mosaic))
            lights.append(find_light(mosaic))
    if first is None:
        raise ValueError("expected frames of the lamp's light, found none")
    color, error = _mean_color(np.array(colors)) if card else _found_color(lights)
    base = Calibration(first.layout, first.white_level) if before is None else before
    lamp = LampFacts(color, None, None) if base.lamp is None else base.lamp._replace(color=color)
    details: dict[str, object] = {"from": "card" if card else "specular light", "color_error_deg": round(error, 3)}
    if polarizations:
        polarized = _mean_polarization(polarizations)
        sure = polarized.concentration >= ONE_ANGLE
        if not sure and first.layout.channels == 1:
            raise ValueError(
                f"expected polarized light of one angle, found many (concentration {polarized.concentration:.2f}): "
                "show a shiny ball, and see that the white level and the layout are right"
            )
        dolp, aolp_deg = (polarized.degree, math.degrees(polarized.aolp)) if sure else (None, None)
        lamp = lamp._replace(dolp=dolp, aolp_deg=aolp_deg)
        details |= {"aolp_concentration": round(polarized.concentration, 3)} | (polarized.facts() if sure else {})
    return replace(base, lamp=lamp, details={**base.details, "light": details})


def _found_color(lights: Sequence[Light]) -> tuple[tuple[float, float, float], float]:
    """Colour with green = 1 that frames of one lamp show, and its expected error [degrees]."""
    light = combine(lights)
    if light.log_ratio is None:
        return (1.0, 1.0, 1.0), 0.0
    if not light.sure:
        raise ValueError(
            f"expected specular light that shows the lamp's colour to {SURE_DEG} degrees, found {light.error_deg:.1f}: "
            "show a shiny ball, or a grey card and say --card"
        )
    r, g, b = light.color
    return (r, g, b), light.error_deg


class _Polarized(NamedTuple):
    """AoLP [radians], degree and concentration of the polarized light of frames, and how far their AoLPs spread."""

    aolp: float
    degree: float
    concentration: float
    spread: float = 0.0

    def facts(self) -> dict[str, object]:
        """The angles for people [degrees]."""
        return {
            "polarizer_deg": axis_deg(math.degrees(light_polarizer_angle(self.aolp)), 2),
            "aolp_spread_deg": round(math.degrees(self.spread), 3),
            "dolp_is": "at least",
        }


def _mean_polarization(found: Sequence[_Polarized]) -> _Polarized:
    """The polarized light of several frames of one lamp, as concentrated as that of the least of them."""
    vector = np.mean([np.exp(2j * one.aolp) for one in found])
    length = float(abs(vector))
    return _Polarized(
        aolp_of(float(vector.real), float(vector.imag)),
        max(one.degree for one in found),
        length * min(one.concentration for one in found),
        math.sqrt(max(-2 * math.log(max(length, 1e-9)), 0)) / 2,
    )


def _specular_polarization(mosaic: Mosaic) -> _Polarized:
    """The polarized light of a frame where it is purest."""
    stokes, determined = fit_stokes_unclipped(demosaic_bilinear_half(mosaic))
    s0, s1, s2 = (
        to_numpy(image).astype(np.float64).reshape(image.shape[-3], -1) for image in (stokes.s0, stokes.s1, stokes.s2)
    )
    known = to_numpy(determined).all(axis=-3).reshape(-1)
    s0, s1, s2 = (image.mean(axis=0) for image in (s0, s1, s2))
    p = np.hypot(s1, s2) * known
    strong = np.flatnonzero(p > max(STRONG * float(np.quantile(p, 0.999)), LEAST))
    if strong.size < MIN_PIXELS:
        raise ValueError(
            f"expected {MIN_PIXELS} unclipped pixels of polarized light, found {strong.size}: expose so that "
            "highlights stay below white, or show a grey card and say --card"
        )
    degree = p[strong] / np.maximum(s0[strong], 1e-6)
    pure = strong[degree >= np.quantile(degree, 1 - PURE)]
    aolp = 0.5 * math.atan2(float(s2[pure].sum()), float(s1[pure].sum()))
    concentration = min(math.hypot(s1[some].sum(), s2[some].sum()) / float(p[some].sum()) for some in (strong, pure))
    return _Polarized(aolp, min(float(np.quantile(degree, 1 - PURE / 2)), 1.0), concentration)


def _card_colors(mosaic: Mosaic) -> list[Doubles]:
    """Mean colours of parts of the middle of a frame."""
    measurements = demosaic_bilinear_half(mosaic)
    height, width = measurements.data.shape[-2:]
    middle = (..., slice(height // 3, height - height // 3), slice(width // 3, width - width // 3))
    if measurements.clipped is not None and to_numpy(measurements.clipped)[middle].mean() > MOST_CLIPPED:
        raise ValueError("expected a card without clipping in the middle of the frame, found clipped samples")
    light = to_numpy(measurements.data)[middle].mean(axis=-4, dtype=np.float64)
    if float(light.mean()) < DARKEST_CARD:
        raise ValueError(f"expected a lit card in the middle of the frame, found {float(light.mean()):.1%} of white")
    bands = np.array_split(light, min(PARTS, light.shape[1]), axis=1)
    parts = [part for band in bands for part in np.array_split(band, min(PARTS, light.shape[2]), axis=2)]
    return [part.reshape(part.shape[0], -1).mean(axis=1) for part in parts]


def _mean_color(colors: Doubles) -> tuple[tuple[float, float, float], float]:
    """Colour with green = 1, and its error [degrees] from the differences of parts. ValueError where one is missing."""
    if colors.shape[1] == 1:
        return (1.0, 1.0, 1.0), 0.0
    units = colors / np.linalg.norm(colors, axis=1, keepdims=True)
    mean = units.mean(axis=0)
    mean /= np.linalg.norm(mean)
    if mean.min() < 0.02 * mean.max():
        raise ValueError(
            f"expected light of all three colours, found {', '.join(f'{c:.3f}' for c in mean / mean.max())}"
        )
    off = float(np.sqrt((np.rad2deg(np.arccos(np.clip(units @ mean, -1, 1))) ** 2).mean()))
    if off > UNEVEN_DEG:
        raise ValueError(f"expected one colour over the card, found parts that differ by {off:.1f} degrees")
    r, g, b = (float(c / mean[1]) for c in mean)
    return (r, g, b), off / len(units) ** 0.5
