"""The light of a frame, found in the frame: one estimate of its colour and polarization, each with how sure it is.

`find_light` measures tiles (`tiles`), fits the colour (`color`) and says how far off the fit is on average on frames
like this one, by a formula fitted to rendered frames of known light (docs/experiments.md). `Light` holds the colour as
log-ratios with their error, so that estimates of one lamp, from several frames, combine by `combine`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.compute.averages import weighted_median
from polsep.compute.warm_up import make_ready
from polsep.light.color import ColorFit, Doubles, axis_of, fit_color, planes_along, strongest
from polsep.light.metals import MIN_SPECULAR_TILES, beside, is_metal, metal_share, only_specular
from polsep.light.tiles import Tiles, tile_measurements, tile_mosaic
from polsep.physics.stokes import Measurements, aolp_of
from polsep.sensor.camera import Capture, Layout, first_frame
from polsep.sensor.levels import as_mosaic

#: Largest expected error of a colour that counts as found [degrees].
SURE_DEG = 2.5
#: Fewest tiles of an estimate.
MIN_TILES = 6
#: Expected error of a colour that nothing shows [degrees]: the mean distance of lamps and raw balances from white.
UNKNOWN_DEG = 20.0
#: Logistic model of the chance that a fit is led astray: of the logarithms of polarization across over along and of the
#: disagreement of clear and dull tiles [degrees], each with an offset; and of the lean of the diffuse polarization.
ASTRAY, ASTRAY_LEAN, ASTRAY_BIAS = ((0.938, 0.02), (0.323, 0.1)), -0.674, 0.017
#: Log-ratios of lamps before usual sensors, least and most: of bluish LEDs to bulbs.
RAW_LAMPS = np.array([[-1.05, 0.13], [-1.35, 0.03]])
#: Direction from cold to warm lamps after a white balance.
WARM = np.array([0.524, -0.852])
#: Chances of lamps before a frame is seen: white (balanced for the lamp); even among `RAW_LAMPS`, of soft edges; along
#: `WARM` after another balance; any colour; saturated, as coloured LEDs. Standard deviations of log-ratios along and
#: beside `WARM`, of any colour, of saturated ones; log-ratio from which on a channel shows its noise, not the lamp.
WHITE_SHARE, RAW_SHARE, WARM_SHARE, ANY_SHARE, LED_SHARE = 0.6, 0.27, 0.08, 0.03, 0.02
RAW_EDGE, WARM_SPREAD, ANY_SPREAD, LED_SPREAD, LED_LIMIT = 0.06, (0.5, 0.08), 0.5, 1.5, 3.4
#: Standard deviations of log-ratios: of the mean of a frame around its lamp, as bodies are coloured; of fits that went
#: astray around the lamp; of the others, over their mean error [rad].
BODIES_SPREAD, ASTRAY_SPREAD, GOOD_SPREAD = 1.0, 0.5, 2.03
#: Chance from which on a frame's lamp counts as white; least chance that the fit did not go astray of a sure colour.
LIKELY_WHITE, LIKELY_RIGHT = 0.5, 0.5
#: Largest log-ratio of a colour, either way: beyond it a channel is dark, as under one LED, and says no more.
LARGEST_RATIO = 5.0
#: Steps of the grid of lamps: from, to [log-ratio], count.
GRID = (-1.5, 0.8, 47)
#: Mean error of fits that did not go astray [degrees]: power law of that disagreement and of the scatter of votes.
GOOD = (1.25 * math.exp(0.28), 0.126, 0.563)
#: What calls for a remark: least expected error of a colour [degrees], least share of coloured metal, and, where white
#: is assumed, largest sum of the log-ratios of the frame's mean: raw frames without white balance are that green.
UNCERTAIN_DEG, LEAST_METAL, GREENISH = 5.5, 0.02, -1.2
#: Remark on a frame in which no colour can be looked for.
TOO_LITTLE = (
    "a frame that shows the lamp's colour was expected, found one too small, dark or overexposed; white is assumed: "
    "if the lamp is not white, say --light-color"
)


@dataclass(frozen=True)
class Light:
    """Light of the lamp as a frame shows it.

    ``log_ratio``: (ln R/G, ln B/G) of the lamp in camera RGB, and its ``covariance`` (rr, rb, bb); None for mono.
    ``error_deg``: mean angle by which such colours are off. ``sure``: whether the colour is found rather than assumed.
    ``aolp``: along which the frame is polarized most [rad, in [0, pi)], None where nothing shows it; that of specular
    light, but where much diffuse light is polarized (statistics of reports are of separated light). ``metal``: share of
    the lit frame that reflects the lamp in the colour of gold or copper. ``remarks``: what the user should know
    of that, and of the levels of an array.
    """

    log_ratio: tuple[float, float] | None
    covariance: tuple[float, float, float] | None
    error_deg: float
    sure: bool
    aolp: float | None = None
    metal: float = 0.0
    remarks: tuple[str, ...] = ()

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
            "metal_fraction": round(self.metal, 4),
        }


@np.errstate(under="ignore")  # also for callers to whom NumPy is to raise: small chances are 0
def find_light(
    raw: NDArray[Any] | Capture,
    layout: Layout | str | None = None,
    black_level: float = 0,
    white_level: float | None = None,
) -> Light:
    """Find the light of a raw frame ``[H, W]``, a `Mosaic` or co-sited `Measurements`; of a batch, of the first frame.

    Arguments as of `polsep.separate`; levels and layout only count for arrays. Mono frames have no colour. Where a
    frame shows little, ``sure`` is False and the colour is the likeliest of usual lamps. Deterministic. Raises
    ValueError on input that is not a mosaic.
    """
    if isinstance(raw, Capture):
        return _light_of(raw)
    mosaic, notes = as_mosaic(raw, layout, black_level, white_level)
    found = _light_of(mosaic)
    return replace(found, remarks=(*notes, *found.remarks))


def _light_of(capture: Capture) -> Light:
    """The light of a capture; see `find_light`."""
    tiles = find_tiles(capture)
    if len(tiles.counts) < MIN_TILES:
        return unknown_light(tiles.colors)
    axis = axis_of(strongest(tiles))
    if tiles.colors != 3:
        return Light(None, None, 0.0, True, aolp_of(*axis))
    make_ready(_warm_up)
    light = _light_of_tiles(tiles, axis)
    return replace(light, remarks=tuple(_remarks_on(light, tiles)))


def _light_of_tiles(tiles: Tiles, axis: NDArray[np.float64]) -> Light:
    """The light of a colour frame, that of its bodies alone where they show that it holds coloured metal."""
    from polsep.light.color_kernel import iterate_fast

    fit = fit_color(strongest(tiles), axis, iterate_fast)
    specular = only_specular(tiles, axis)
    bodies = tiles.select(~beside(tiles, specular))
    if specular.sum() < MIN_SPECULAR_TILES or len(bodies.counts) < MIN_TILES:
        return _as_light(fit, tiles, aolp_of(*axis))
    reflected = iterate_fast(planes_along(strongest(tiles.select(specular)), axis))[0]
    own_axis = axis_of(strongest(bodies))
    own = fit_color(strongest(bodies), own_axis, iterate_fast)
    if not is_metal(reflected - own.x):
        return _as_light(fit, tiles, aolp_of(*axis))
    return replace(_as_light(own, bodies, aolp_of(*own_axis)), metal=metal_share(tiles, own_axis, own.x))


def _remarks_on(light: Light, tiles: Tiles) -> Iterator[str]:
    """Remarks for the user: metals, and a colour that may be wrong."""
    if light.metal >= LEAST_METAL:
        yield (
            f"highlights of the lamp's colour were expected, found those of gold or copper on {light.metal:.0%} of the "
            "lit frame: diffuse and specular may be wrong there; compare with --method analytic"
        )
    if light.sure:
        return
    mean = (tiles.moments[:, 0, 1:4] / tiles.moments[:, :1, 0]).mean(0)
    unclear = light.error_deg > UNCERTAIN_DEG
    if light.color == (1.0, 1.0, 1.0):
        unclear &= float(mean[0] * mean[2]) < math.exp(GREENISH) * float(mean[1]) ** 2
    if unclear:
        color = ",".join(f"{c:.2f}" for c in light.color)
        yield (
            f"highlights that show the lamp's colour were expected, found too few; {color} is assumed: show a shiny "
            "object, or measure a grey card and say --light-color"
        )


def find_tiles(capture: Capture) -> Tiles:
    """Return the tiles of a capture, by the kernel where it reads the frame."""
    if isinstance(capture, Measurements):
        return tile_measurements(capture)
    array = to_numpy(first_frame(capture))
    if min(array.shape) < 12:
        colors = capture.layout.channels
        moments = np.zeros((0, 1 + 3 * colors, 1 + 3 * colors))
        return Tiles(moments, np.zeros((0, colors)), np.zeros(0), np.zeros((0, 2), np.int64))
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
    return Light((0.0, 0.0), (variance, 0.0, variance), UNKNOWN_DEG, False, remarks=(TOO_LITTLE,))


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
    center = np.array([weighted_median(ratios[:, k], weights) for k in range(2)])
    distance = np.hypot(*(ratios - center).T)
    weights = weights / (1 + (distance / 0.05) ** 2)
    mean = weights @ ratios / weights.sum()
    return replace(surest, log_ratio=(float(mean[0]), float(mean[1])))


def _as_light(fit: ColorFit, tiles: Tiles, aolp: float) -> Light:
    """The light of a fit to a frame of these tiles."""
    good, astray = _expected_errors(fit)
    x, error, right = likely_lamp(fit.x, good, astray, _mean_color(tiles))
    error = min(error, UNKNOWN_DEG)
    variance = _variance_of(error)
    sure = error <= SURE_DEG and right >= LIKELY_RIGHT
    return Light((float(x[0]), float(x[1])), (variance, 0.0, variance), error, sure, aolp)


def likely_lamp(fitted: Doubles, good: float, astray: float, mean: Doubles) -> tuple[Doubles, float, float]:
    """The likely lamp ``[2]`` of a frame, its mean error [degrees], and the chance that the fit did not go astray.

    By Bayes' rule it is white, or the mean of what else is likely; lamps are as likely before as the shares above say.
    Log-ratios ``fitted``: of the fit, off by ``good`` degrees on average, but for a chance ``astray`` that it is
    anywhere; ``mean``: of the frame, that of coloured bodies under the lamp.
    """
    fitted, mean = (x.clip(-LARGEST_RATIO, LARGEST_RATIO) for x in (fitted, mean))

    def chance(lamps: Doubles) -> tuple[Doubles, Doubles]:
        seen = _normal(lamps - mean, BODIES_SPREAD)
        return (1 - astray) * seen, astray * seen * _normal(lamps - fitted, ASTRAY_SPREAD)

    white = np.zeros((1, 2))
    right, wrong = chance(white)
    of_white = WHITE_SHARE * float((right * _normal(white - fitted, GOOD_SPREAD * math.radians(good)) + wrong)[0])
    lamps, prior = _usual_lamps()
    # Near a fit that is right, all else hardly varies.
    of_fit = float(_prior_density(fitted[None])[0] * chance(fitted[None])[0][0])
    of_others = prior * chance(lamps)[1]
    of_colored = of_fit + float(of_others.sum())
    if of_white > LIKELY_WHITE * (of_white + of_colored):
        likely = np.zeros(2)
    else:
        likely = (of_fit * fitted + of_others @ lamps) / of_colored
    to_fit = math.hypot(good, float(_angles_deg(fitted[None], likely)[0]))
    to_white, to_others = float(_angles_deg(white, likely)[0]), _angles_deg(lamps, likely)
    off = of_white * to_white + of_fit * to_fit + float(of_others @ to_others)
    of_right, of_all = of_white - WHITE_SHARE * float(wrong[0]) + of_fit, of_white + of_colored
    return likely, off / of_all, of_right / of_all


def _angles_deg(lamps: Doubles, lamp: Doubles) -> Doubles:
    """Angles [degrees] between colours of log-ratios ``[N, 2]`` and one of log-ratios ``[2]``."""
    limited = (np.insert(x.clip(-LARGEST_RATIO, LARGEST_RATIO), 1, 0.0, axis=-1) for x in (lamps, lamp))
    colors, color = (np.exp(x) for x in limited)
    cosine = colors @ color / np.linalg.norm(colors, axis=-1) / np.linalg.norm(color)
    angles: Doubles = np.degrees(np.arccos(cosine.clip(-1, 1)))
    return angles


def _normal(offset: Doubles, spread: float) -> Doubles:
    """Density of offsets ``[N, 2]`` of log-ratios, each of this standard deviation."""
    density: Doubles = np.exp(-(offset**2).sum(axis=-1) / (2 * spread**2)) / (2 * math.pi * spread**2)
    return density


def _prior_density(lamps: Doubles) -> Doubles:
    """Density of lamps ``[N, 2]`` before a frame is seen, but for exactly white ones."""
    least, most = RAW_LAMPS.T
    inside = (np.tanh((lamps - least) / (2 * RAW_EDGE)) - np.tanh((lamps - most) / (2 * RAW_EDGE))) / 2
    raw = (inside / (most - least)).prod(axis=1)
    along, across = lamps @ WARM, lamps[:, 0] * WARM[1] - lamps[:, 1] * WARM[0]
    length, width = WARM_SPREAD
    warm = np.exp(-((along / length) ** 2 + (across / width) ** 2) / 2) / (2 * math.pi * length * width)
    led = (np.abs(lamps) < LED_LIMIT).all(axis=1) * _normal(lamps, LED_SPREAD)
    density: Doubles = RAW_SHARE * raw + WARM_SHARE * warm + ANY_SHARE * _normal(lamps, ANY_SPREAD) + LED_SHARE * led
    return density


@cache
def _usual_lamps() -> tuple[Doubles, Doubles]:
    """A grid of lamps ``[N, 2]``, and the chance of each before a frame is seen."""
    steps, size = np.linspace(*GRID, retstep=True)
    lamps = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return lamps, _prior_density(lamps) * float(size) ** 2


def _mean_color(tiles: Tiles) -> Doubles:
    """Log-ratios ``[2]`` of the mean s0 of tiles of a colour frame."""
    red, green, blue = tiles.moments[:, 0, 1:4].sum(axis=0).clip(1e-9)
    return np.array([math.log(red / green), math.log(blue / green)])


def _expected_errors(fit: ColorFit) -> tuple[float, float]:
    """Mean angle [degrees] by which fits like this one are off that were not led astray; the chance that it was."""
    change = float(_angles_deg(fit.change[None], np.zeros(2))[0])
    scatter = _spread_deg(fit.x, fit.scatter)
    logit = ASTRAY_BIAS + ASTRAY_LEAN * fit.lean
    logit += sum(a * math.log(v + b) for (a, b), v in zip(ASTRAY, (fit.across, change), strict=True))
    chance = 1 / (1 + math.exp(-logit))
    good: float = GOOD[0] * (change + 0.1) ** GOOD[1] * (scatter + 0.03) ** GOOD[2]
    return good, chance


def _spread_deg(x: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Root mean square angle [degrees] of colours whose log-ratios have this covariance around x."""
    color = np.exp([x[0], 0.0, x[1]])
    beside = np.eye(3) - np.outer(color, color) / (color @ color)
    by_ratio = beside @ np.diag(color)[:, [0, 2]]
    return math.degrees(math.sqrt(max(float(np.trace(by_ratio @ covariance @ by_ratio.T)), 0.0) / (color @ color)))


def _variance_of(error_deg: float) -> float:
    """Variance of each log-ratio of colours near white that are off by this angle on average."""
    per_ratio = 3 / (math.sqrt(2) * math.sqrt(math.pi / 2))  # the angle's square is 2/9 (x^2 + y^2 - x y)
    return float((math.radians(error_deg) * per_ratio) ** 2)


def _warm_up() -> None:
    from polsep.light import color_kernel, tiles_kernel

    tiles_kernel.warm_up()
    color_kernel.warm_up()
