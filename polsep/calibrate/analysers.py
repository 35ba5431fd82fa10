"""Angle, extinction ratio and gain of the analysers, from frames behind a polarizer at unknown angles.

Frame f shows an evenly lit diffuser through a linear polarizer at the angle phi_f. On place k of the period, of colour
c, the mean of its middle is

    m_fk = S_fc g_k (1 + D_k cos 2 (theta_k - phi_f)) / 2

All of S, g, D, theta and phi are unknown. The product is bilinear in sources and analysers, so a linear map could move
from one to the other; what fixes it:

* the mean of all theta_k is the layout's (the frames cannot tell a turned sensor from turned sources);
* the polarizer is perfect, or of a stated extinction ratio (only the product of both degrees is seen);
* gains g_k average to 1 in each colour, and are near 1 each: within `GAIN_SPREAD` after a flat frame, else within
  `LOOSE_GAIN_SPREAD`; the light S is the same in all frames within `LIGHT_SPREAD`. Without these two, an uneven light
  that follows the polarizer's angle looks like analysers of uneven gains.

Solved by damped least squares (Levenberg 1944, Marquardt 1963) from the layout's angles.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.calibrate.dark_flat import MOST_CLIPPED, require_same_sensor
from polsep.calibrate.statistics import Doubles, place_means
from polsep.compute.arrays import to_numpy
from polsep.compute.least_squares import least_squares
from polsep.physics.stokes import analyser_matrix, axis_deg, diattenuation, stokes_inverse
from polsep.sensor.calibration import Analyser, Calibration
from polsep.sensor.camera import Layout, Mosaic

Ints = NDArray[np.int64]

#: Expected deviations of gains with and without a flat frame before, of the light over frames (all relative), and of a
#: mean of samples from the model, relative to the brightest.
GAIN_SPREAD, LOOSE_GAIN_SPREAD, LIGHT_SPREAD, MISFIT = 0.003, 0.05, 0.01, 5e-4
#: Most solutions for a light that varies more; it does if it is found to by this factor.
MOST_LOOKS, AGREE = 6, 1.1
#: Deviation that holds where a mean is fixed by definition.
FIXED = 1e-6
#: Fewest frames, and least eigenvalue of their mean sources (1, cos 2 phi, sin 2 phi), 0.5 for evenly spread angles.
MIN_FRAMES, MIN_SPREAD = 5, 0.1
#: Largest rms residual of frames that fit the model, relative to their light.
MAX_RESIDUAL = 0.02
#: Standard errors beyond which analysers are better than perfect ones, so that the polarizer is better than stated.
SURE = 3.0
#: Least signal, and least degree of polarization by the layout's analysers, of a frame behind a polarizer.
DARKEST, MIN_DOLP = 0.02, 0.5


class Fit(NamedTuple):
    """Analysers' ``gain``, ``diattenuation`` and ``angle [K]``, sources' ``phi [F]`` and ``light [F, C]``."""

    gain: Doubles
    diattenuation: Doubles
    angle: Doubles
    phi: Doubles
    light: Doubles


def measure_analysers(
    frames: Iterable[Mosaic], before: Calibration | None = None, polarizer_extinction: float = math.inf
) -> Calibration:
    """``before`` with the analyser of each place of the period, from at least `MIN_FRAMES` frames; see the module.

    Frames are corrected by ``before``'s black level and gains. Raises ValueError where they show no turned polarizer.
    """
    if not polarizer_extinction > 1:
        raise ValueError(f"expected an extinction ratio above 1 of the polarizer, found {polarizer_extinction:g}")
    means, first = _means_of(frames, before)
    layout = first.layout
    if len(means) < MIN_FRAMES:
        raise ValueError(f"expected at least {MIN_FRAMES} frames behind a turned polarizer, found {len(means)}")
    colors, nominal = _places(layout)
    start = _start(means, colors, nominal)
    spread = GAIN_SPREAD if before is not None and before.gains is not None else LOOSE_GAIN_SPREAD
    fit, errors, residual = _solve(means, start, colors, nominal, spread)
    if residual > MAX_RESIDUAL:
        raise ValueError(
            f"expected frames of an evenly lit polarizer that turns, found samples that differ by {residual:.1%}"
        )
    rho = diattenuation(polarizer_extinction)
    both = float(fit.diattenuation.mean())
    if math.isfinite(polarizer_extinction) and both > rho + SURE * errors.diattenuation:
        raise ValueError(
            f"expected a polarizer's extinction ratio of at least {_extinction(both):.0f}, which the frames show of it "
            f"and the analysers together, found {polarizer_extinction:g}"
        )
    period = layout.period
    found = [
        Analyser(math.degrees(t) % 180, _extinction(d / rho), float(g))
        for g, d, t in zip(fit.gain, fit.diattenuation, fit.angle, strict=True)
    ]
    angles = np.rad2deg(fit.angle) - np.rad2deg(nominal)
    details = {
        "frames": len(means),
        "polarizer_angles_deg": [axis_deg(math.degrees(phi), 2) for phi in fit.phi],
        "angle_off_rms_deg": round(float(np.sqrt((angles**2).mean())), 4),
        "angle_off_largest_deg": round(float(np.abs(angles).max()), 4),
        "angle_error_deg": round(math.degrees(errors.angle), 4),
        "diattenuation": round(both / rho, 5),
        "diattenuation_error": round(errors.diattenuation, 5),
        "gain_error": round(errors.gain, 5),
        "residual_rms": round(residual, 6),
    }
    size = (int(first.data.shape[0]), int(first.data.shape[1]))
    base = Calibration(layout, first.white_level) if before is None else before
    assert base.size in (None, size)
    table = tuple(tuple(found[row * period : (row + 1) * period]) for row in range(period))
    return replace(base, analysers=table, details={**base.details, "analysers": details})


class Errors(NamedTuple):
    """Standard deviations, in the root mean square over places; angle in radians."""

    gain: float
    diattenuation: float
    angle: float


def _means_of(frames: Iterable[Mosaic], before: Calibration | None) -> tuple[Doubles, Mosaic]:
    """Mean ``[F, K]`` on each place in the middle of each frame, white = 1, and the first frame. Raises ValueError."""
    rows, first = [], None
    for mosaic in frames:
        require_same_sensor(before, mosaic)
        if first is not None and (mosaic.layout, mosaic.data.shape) != (first.layout, first.data.shape):
            raise ValueError("expected frames of one size and layout, found different ones")
        first = mosaic if first is None else first
        period = mosaic.layout.period
        height, width = mosaic.data.shape
        top, left = height // 4 // period * period, width // 4 // period * period
        middle = (slice(top, height - top), slice(left, width - left))
        if (clipped := float(to_numpy(mosaic.clipped())[middle].mean())) > MOST_CLIPPED:
            raise ValueError(f"expected frames without clipping, found {clipped:.1%} of a frame's middle clipped")
        rows.append(place_means(to_numpy(mosaic.linear())[middle], period).reshape(-1))
    if first is None:
        raise ValueError("expected frames behind a turned polarizer, found none")
    means = np.array(rows)
    if means.max(axis=1).min() < DARKEST:
        raise ValueError(
            f"expected frames near half of the white level, found one of {means.max(axis=1).min():.1%} of it"
        )
    return means, first


def _places(layout: Layout) -> tuple[Ints, Doubles]:
    """Colour and nominal angle [radians] ``[K]`` of each place of the period in reading order."""
    filters = [layout.filter_at(row, col) for row in range(layout.period) for col in range(layout.period)]
    return np.array([f.channel for f in filters]), np.deg2rad([f.angle_deg for f in filters])


def _start(means: Doubles, colors: Ints, nominal: Doubles) -> Fit:
    """Sources by least squares behind ideal analysers, in the mean over colours. ValueError on unpolarized ones."""
    light = []
    vector = np.zeros((len(means), 2))
    for color in np.unique(colors):
        stokes = means[:, colors == color] @ stokes_inverse(nominal[colors == color]).T
        light.append(stokes[:, 0])
        vector += stokes[:, 1:]
    strength = np.stack(light, axis=1)
    dolp = np.hypot(*vector.T) / strength.sum(axis=1)
    if dolp.min() < MIN_DOLP:
        raise ValueError(
            f"expected frames behind a linear polarizer, found one of a degree of polarization of {dolp.min():.2f}"
        )
    phi = 0.5 * np.arctan2(vector[:, 1], vector[:, 0])
    sources = 2 * analyser_matrix(phi.tolist())
    spread = float(np.linalg.eigvalsh(sources.T @ sources / len(phi))[0])
    if spread < MIN_SPREAD:
        raise ValueError(
            "expected polarizer angles spread over 180 degrees, found "
            + ", ".join(f"{axis_deg(math.degrees(angle)):.0f}" for angle in phi)
        )
    ones = np.ones_like(nominal)
    return Fit(ones, 0.98 * ones, nominal.copy(), phi, strength)


def _solve(means: Doubles, start: Fit, colors: Ints, nominal: Doubles, gain_spread: float) -> tuple[Fit, Errors, float]:
    """The fit, its errors, and the rms residual relative to the light.

    A light that is found to vary more than `LIGHT_SPREAD` may vary so much: it is found again until both agree.
    """
    allowed = LIGHT_SPREAD
    for _ in range(MOST_LOOKS):
        found = _solve_once(means, start, colors, nominal, (gain_spread, allowed))
        logs = np.log(found[0].light)
        varies = float((logs - logs.mean(axis=0)).std())
        if varies <= AGREE * allowed:
            break
        allowed = varies
    return found


def _solve_once(
    means: Doubles, start: Fit, colors: Ints, nominal: Doubles, spreads: tuple[float, float]
) -> tuple[Fit, Errors, float]:
    """`_solve` for relative ``spreads`` of the gains and of the light."""
    gain_spread, light_spread = spreads
    k, f, c = len(nominal), len(means), start.light.shape[1]
    index = np.searchsorted(np.unique(colors), colors)
    scale = MISFIT * float(start.light.max())
    mean_light = start.light.mean(axis=0)

    def unpack(x: Doubles) -> Fit:
        return Fit(
            np.exp(x[:k]),
            x[k : 2 * k],
            nominal + x[2 * k : 3 * k],
            start.phi + x[3 * k : 3 * k + f],
            mean_light * np.exp(x[3 * k + f :].reshape(f, c)),
        )

    def residuals(x: Doubles) -> Doubles:
        fit = unpack(x)
        cosine = np.cos(2 * (fit.angle[None] - fit.phi[:, None]))
        model = 0.5 * fit.light[:, index] * fit.gain * (1 + fit.diattenuation * cosine)
        logs, light = x[:k], x[3 * k + f :].reshape(f, c)
        fixed = [logs[index == color].mean() for color in range(c)] + [float(x[2 * k : 3 * k].mean())]
        uneven = (light - light.mean(axis=0)).reshape(-1)
        parts = [
            ((model - means) / scale).reshape(-1),
            logs / gain_spread,
            np.array(fixed) / FIXED,
            uneven / light_spread,
        ]
        return np.concatenate(parts)

    x = np.concatenate(
        [np.zeros(k), start.diattenuation, np.zeros(k + f), np.log(start.light / mean_light).reshape(-1)]
    )
    x, jacobian = least_squares(residuals, x)
    fit, rest = unpack(x), residuals(x)[: f * k] * scale
    residual = float(np.sqrt((rest**2).mean()) / start.light.mean())
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(1.0, (residual * start.light.mean() / scale) ** 2)
    deviations = [float(np.sqrt(np.diag(covariance)[i * k : (i + 1) * k].mean())) for i in range(3)]
    return fit, Errors(*deviations), residual


def _extinction(diattenuation: float) -> float:
    """Ratio of the transmissions along and across; infinite from a diattenuation of 1."""
    return math.inf if diattenuation >= 1 else (1 + diattenuation) / (1 - diattenuation)
