"""The light of a frame, found in the frame: one estimate of its colour and polarization, each with how sure it is.

`find_light` measures tiles (`tiles`), fits the colour (`color`) and says how far off the fit is on average on frames
like this one, by a formula fitted to rendered frames of known light (docs/experiments.md). `Light` holds the colour as
log-ratios with a covariance, so that estimates of one lamp, from other frames or other means, combine by `combine`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.warm_up import make_ready
from polsep.light.color import ColorFit, axis_of, fit_color, strongest
from polsep.light.tiles import Tiles, tile_measurements, tile_mosaic
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.levels import as_mosaic

#: Largest expected error of a colour that counts as found [degrees].
SURE_DEG = 1.5
#: Fewest tiles of an estimate.
MIN_TILES = 6
#: Expected error of a colour that nothing shows [degrees]: the mean distance of lamps and raw balances from white.
UNKNOWN_DEG = 20.0
#: Logistic model of the chance that a fit is led astray: of the logarithms of polarization across over along, of gloss,
#: of the disagreement of clear and dull tiles [degrees] and of the scatter of votes [degrees], each with an offset.
ASTRAY = ((0.642, 0.02), (-0.486, 0.02), (0.543, 0.1), (0.49, 0.03))
ASTRAY_BIAS = -0.995
#: Mean error of fits that went astray [degrees], and of the others: power law of the two last quantities.
ASTRAY_DEG, GOOD = 11.3, (1.25 * math.exp(0.407), 0.081, 0.627)
#: Colours within this many expected errors of white are white: exact where it is, and hardly wrong where it is not.
WHITE_ERRORS = 1.5
#: Standard deviation of log-ratios of lamps around white, toward which unsure estimates are drawn.
DRAWN = 0.25


@dataclass(frozen=True)
class Light:
    """Light of the lamp as a frame shows it.

    ``log_ratio``: (ln R/G, ln B/G) of the lamp in camera RGB, and its ``covariance`` (rr, rb, bb); None for mono.
    ``error_deg``: mean angle by which such colours are off. ``sure``: whether the colour is found rather than assumed.
    ``aolp``: of specular light [rad, in [0, pi)], None where nothing shows it.
    """

    log_ratio: tuple[float, float] | None
    covariance: tuple[float, float, float] | None
    error_deg: float
    sure: bool
    aolp: float | None = None

    @property
    def color(self) -> tuple[float, ...]:
        """Camera RGB of the lamp with green = 1; ``(1.0,)`` for mono."""
        if self.log_ratio is None:
            return (1.0,)
        return (math.exp(self.log_ratio[0]), 1.0, math.exp(self.log_ratio[1]))

    def describe(self) -> dict[str, Any]:
        """Entries of a report, JSON-able; angles in degrees."""
        return {
            "color": [round(c, 5) for c in self.color],
            "error_deg": round(self.error_deg, 2),
            "sure": self.sure,
            "log_ratio": None if self.log_ratio is None else [round(r, 5) for r in self.log_ratio],
            "covariance": None if self.covariance is None else [float(f"{c:.4g}") for c in self.covariance],
            "specular_aolp_deg": None if self.aolp is None else round(math.degrees(self.aolp), 2),
        }


def find_light(
    raw: NDArray[Any] | Mosaic | Measurements,
    layout: Layout | None = None,
    black_level: float = 0,
    white_level: float | None = None,
) -> Light:
    """Find the light of a raw frame ``[H, W]``, a `Mosaic` or co-sited `Measurements`; of a batch, of the first frame.

    Arguments as of `polsep.separate`; levels and layout only count for arrays. Mono frames have no colour. Where a
    frame shows little, ``sure`` is False and the colour is drawn toward white. Deterministic. Raises ValueError on
    input that is not a mosaic.
    """
    capture = raw if isinstance(raw, Mosaic | Measurements) else as_mosaic(raw, layout, black_level, white_level)[0]
    tiles = strongest(find_tiles(capture))
    colors = (tiles.moments.shape[1] - 1) // 3
    if len(tiles.counts) < MIN_TILES:
        return unknown_light(colors)
    axis, _ = axis_of(tiles)
    aolp = 0.5 * math.atan2(axis[1], axis[0]) % math.pi
    if colors != 3:
        return Light(None, None, 0.0, True, aolp)
    make_ready(_warm_up)
    from polsep.light.color_kernel import iterate_fast

    return _as_light(fit_color(tiles, axis, iterate_fast), aolp)


def find_tiles(capture: Mosaic | Measurements) -> Tiles:
    """Return the tiles of a capture, by the kernel where it reads the frame."""
    if isinstance(capture, Measurements):
        return tile_measurements(capture)
    data = capture.data.reshape(-1, *capture.data.shape[-2:])[0].detach().cpu()
    if min(data.shape) < 12:
        return Tiles(np.zeros((0, 10, 10)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), np.int64))
    array = data.numpy()
    if array.dtype not in (np.uint8, np.uint16, np.float32):
        return tile_mosaic(capture)
    make_ready(_warm_up)
    from polsep.light.tiles_kernel import tile_raw

    return tile_raw(array, capture.layout, capture.black_level, capture.white_level)


def unknown_light(colors: int) -> Light:
    """Return what is assumed of a light that nothing shows: white."""
    if colors != 3:
        return Light(None, None, 0.0, True)
    variance = _variance_of(UNKNOWN_DEG)
    return Light((0.0, 0.0), (variance, 0.0, variance), UNKNOWN_DEG, False)


def combine(lights: Sequence[Light]) -> Light:
    """Return the light of several frames under one lamp, or of several estimates: the mean weighted by certainty.

    Frames of one recording share their errors, so the error is that of the surest, not less. Raises ValueError on
    none.
    """
    if not lights:
        raise ValueError("expected at least one estimate of the light, found none")
    surest = min(lights, key=lambda light: light.error_deg)
    if surest.log_ratio is None:
        return surest
    ratios = np.array([light.log_ratio for light in lights])
    weights = np.array([1 / (light.error_deg + 0.1) ** 2 for light in lights])
    center = np.array([_weighted_median(ratios[:, k], weights) for k in range(2)])
    distance = np.hypot(*(ratios - center).T)
    weights = weights / (1 + (distance / 0.05) ** 2)
    mean = weights @ ratios / weights.sum()
    return Light((float(mean[0]), float(mean[1])), surest.covariance, surest.error_deg, surest.sure, surest.aolp)


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])


def _as_light(fit: ColorFit, aolp: float) -> Light:
    """The light of a fit, white where that explains it, else drawn toward white as far as it is unsure."""
    x = fit.x
    error = _expected_error(fit)
    variance = _variance_of(error)
    sure = error <= SURE_DEG
    if angle_deg(x) <= WHITE_ERRORS * error:
        x = np.zeros(2)
    elif not sure:
        x = x / (1 + variance / DRAWN**2)
        variance = variance / (1 + variance / DRAWN**2)
    return Light((float(x[0]), float(x[1])), (variance, 0.0, variance), error, sure, aolp)


def _expected_error(fit: ColorFit) -> float:
    """Mean angle [degrees] by which fits like this one are off."""
    change = angle_deg(fit.change)
    scatter = _spread_deg(fit.x, fit.scatter)
    shown = (fit.across, fit.gloss, change, scatter)
    logit = ASTRAY_BIAS + sum(a * math.log(v + b) for (a, b), v in zip(ASTRAY, shown, strict=True))
    chance = 1 / (1 + math.exp(-logit))
    good: float = GOOD[0] * (change + 0.1) ** GOOD[1] * (scatter + 0.03) ** GOOD[2]
    return min((1 - chance) * good + chance * ASTRAY_DEG, UNKNOWN_DEG)


def angle_deg(log_ratio: NDArray[np.float64] | Sequence[float]) -> float:
    """Return the angle [degrees] between a colour of these log-ratios and white."""
    r, b = (math.exp(min(max(float(v), -5.0), 5.0)) for v in log_ratio)
    return math.degrees(math.acos(min(1.0, (r + 1 + b) / math.sqrt(3 * (r * r + 1 + b * b)))))


def _spread_deg(x: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Root mean square angle [degrees] of colours whose log-ratios have this covariance around x."""
    color = np.exp([x[0], 0.0, x[1]])
    beside = np.eye(3) - np.outer(color, color) / (color @ color)
    by_ratio = beside @ np.diag(color)[:, [0, 2]]
    return math.degrees(math.sqrt(max(float(np.trace(by_ratio @ covariance @ by_ratio.T)), 0.0) / (color @ color)))


def _variance_of(error_deg: float) -> float:
    """Variance of each log-ratio of colours near white that are off by this angle on average."""
    per_ratio = 3 / (2 * math.sqrt(2) * math.sqrt(math.pi / 2))  # mean of a Rayleigh variate
    return float((math.radians(error_deg) * per_ratio) ** 2)


def _warm_up() -> None:
    from polsep.light import color_kernel, tiles_kernel

    tiles_kernel.warm_up()
    color_kernel.warm_up()
