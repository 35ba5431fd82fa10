"""Black levels from frames with the lens cap on, gains from frames of an evenly lit diffuser.

Both are sums (products) of a level, a table over places of the period, and a map of pixels. What the frames are too
noisy to tell is shrunk or left out: one frame shows levels and tables, several show every pixel.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from polsep.calibrate.statistics import (
    Doubles,
    Floats,
    average_frames,
    median,
    place_means,
    robust_deviation,
    signal_share,
)
from polsep.compute.arrays import to_numpy
from polsep.sensor.calibration import Calibration, tile
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.falloff import Table, falloff_image

#: Least deviation from black of a hot pixel, relative to white, and in robust deviations of all pixels.
HOT, HOT_DEVIATIONS = 0.01, 12.0
#: Share of hot pixels above which they are a picture. Sensors have less than 1 %.
MOST_HOT = 0.05
#: Share of them in a block from which on they are an object in the picture: those of sensors lie apart.
DENSE = 0.25
#: Side of blocks whose means show light in one of several dark frames, and the least change that does, white = 1.
BLOCK, LIGHT = 32, 0.01
#: Least deviation of a defective pixel's gain, and in robust deviations of all pixels.
DEAD, DEAD_DEVIATIONS = 0.25, 8.0
#: Share of dead pixels above which something lies over the paper, and the least falloff of a lens; what is expected.
MOST_DEAD, LEAST_FALLOFF = 0.01, 0.05
WHOLE_FRAME = "expected evenly lit white over the whole frame"
#: Brightest black level that a dark frame may have, relative to white; least signal and most clipping of a flat one.
BRIGHTEST_DARK, DARKEST_FLAT, MOST_CLIPPED = 0.25, 0.02, 0.005
#: Largest degree of the polynomial of the falloff, and blocks of a period along a side that each degree needs.
DEGREE, BLOCKS_PER_DEGREE = 6, 4
#: Apparent degree of polarization of the mean of flat frames, and of one of them, from which gains are not believed:
#: the sky's light averages out where the camera is turned, a polarizer does not belong there.
POLARIZED_FLAT, POLARIZER = 0.1, 0.85
#: Least deviation of the logarithm of a falloff along which noise shows gamma, largest error of its exponent, and the
#: largest variance of one sample that counts for it, in means of all.
LEAST_SPREAD, MOST_ERROR, MOST_NOISE = 0.01, 0.1, 10.0


def measure_dark(frames: Iterable[Mosaic], before: Calibration | None = None) -> Calibration:
    """``before`` with black level, pattern, read noise and hot pixels of frames without light.

    Raises ValueError on frames that hold light.
    """
    dark = average_frames(_unlit(frames))
    require_same_sensor(before, dark.first)
    mosaic, period = dark.first, dark.first.layout.period
    level = float(median(dark.mean))
    if level > BRIGHTEST_DARK * mosaic.white_level:
        raise ValueError(
            f"expected frames without light (lens cap on), found a median of {level:g} of white {mosaic.white_level:g}"
        )
    table = place_means(dark.mean, period)
    level = float(table.mean())
    residual = dark.mean - tile(table, dark.mean.shape)
    spread = robust_deviation(residual)
    hot = np.abs(residual) > max(HOT * mosaic.white_level, HOT_DEVIATIONS * spread)
    _require_scattered(hot, MOST_HOT, "expected frames without light (lens cap on)", "far from black")
    noise = spread**2 if (found := dark.noise) is None else found
    kept = np.where(hot, 0, residual)
    lines = _line_offsets(kept, spread**2)
    kept = residual - lines
    share = 0.0 if dark.variance is None else signal_share(kept, noise / dark.count)
    pattern = lines + np.float32(share) * kept
    varies = bool(share or lines.any())
    details = {
        "frames": dark.count,
        "black_level_error_codes": _rounded(spread / dark.mean.size**0.5),
        "pattern_rms_codes": _rounded(float(np.std(table))),
        "lines_rms_codes": _rounded(float(lines.std())),
        "pixels_rms_codes": _rounded(share**0.5 * robust_deviation(kept)),
        "hot_pixels": int(hot.sum()),
    }
    base = _base(before, mosaic)
    return replace(
        base,
        hot=np.flatnonzero(hot).astype(np.int32),
        black_level=level,
        black_pattern=_as_table(table - level),
        black_map=(tile(table, dark.mean.shape) + pattern).astype(np.float32) if varies else None,
        read_noise=noise**0.5,
        details={**base.details, "dark": details},
    )


def _require_scattered(defects: NDArray[np.bool_], most: float, wanted: str, found: str) -> None:
    """Raise ValueError on too many defective pixels, in the frame or in one place of it."""
    share, densest = float(defects.mean()), float(_block_means(defects).max())
    if share > most:
        raise ValueError(f"{wanted}, found {share:.1%} of the pixels {found}")
    if densest > DENSE:
        raise ValueError(f"{wanted}, found {densest:.1%} of the pixels in one place {found}")


def _rounded(codes: float) -> float:
    """A number to three digits, whatever the unit: frames of floats have a white level of 1."""
    return float(f"{codes:.3g}")


def _unlit(frames: Iterable[Mosaic]) -> Iterator[Mosaic]:
    """The frames, all as dark as the first: light in one would hide in their mean. Raises ValueError."""
    first: Floats | None = None
    for number, mosaic in enumerate(frames, start=1):
        means = _block_means(to_numpy(mosaic.data))
        first = means if first is None else first
        if means.shape == first.shape:  # else they are refused as of different sizes
            largest = float(np.abs(means - first).max()) / mosaic.white_level
            if largest > LIGHT:
                raise ValueError(
                    f"expected frames without light (lens cap on), found parts of frame {number} that differ from "
                    f"frame 1 by {largest:.1%} of white"
                )
        yield mosaic


def _block_means(image: NDArray[np.generic]) -> Floats:
    """Means of blocks of `BLOCK` pixels along a side, or of fewer where the image is smaller."""
    rows, cols = (max(1, n // BLOCK) for n in image.shape)
    height, width = (n // k for n, k in zip(image.shape, (rows, cols), strict=True))
    blocks = image[: rows * height, : cols * width].reshape(rows, height, cols, width)
    means: Floats = blocks.mean(axis=(1, 3), dtype=np.float32)
    return means


def _line_offsets(residual: Floats, pixel_variance: float) -> Floats:
    """Offsets of rows and columns ``[H, W]``, each shrunk by its noise."""
    lines = np.zeros_like(residual)
    for axis in (1, 0):
        means = residual.mean(axis=axis, dtype=np.float64)
        share = signal_share(means, pixel_variance / residual.shape[axis])
        lines += np.expand_dims((share * (means - means.mean())).astype(np.float32), axis)
    return lines


def measure_flat(frames: Iterable[Mosaic], before: Calibration | None = None) -> Calibration:
    """``before`` with gains, falloff and dead pixels of frames of evenly lit, unpolarized white.

    ``frames`` are as the camera wrote them less ``before``'s black level. Raises ValueError on dark, clipped or
    polarized ones.
    """
    flat = average_frames(_lit_evenly(frames))
    require_same_sensor(before, flat.first)
    mosaic, layout = flat.first, flat.first.layout
    span = mosaic.white_level - mosaic.black_level
    signal = flat.mean - np.float32(mosaic.black_level)
    brightness = float(median(signal)) / span
    if flat.clipped > MOST_CLIPPED:
        raise ValueError(f"expected flat frames without clipping, found {flat.clipped:.1%} of the samples clipped")
    means = place_means(signal, layout.period)
    if means.min() <= 0:
        raise ValueError("expected light on every place of the filters' period, found none on some")
    falloff = fit_falloff(signal / tile(means, signal.shape), layout.period)
    fall = falloff_image(falloff, *signal.shape)
    if (least := float(fall.min())) < LEAST_FALLOFF:
        raise ValueError(f"{WHOLE_FRAME}, found light that falls to {max(least, 0):.0%} at its border")
    even = signal / fall
    means = place_means(even, layout.period)
    gains = means / _color_means(means, layout)
    residual = even / tile(means, signal.shape)
    spread = robust_deviation(residual)
    dead = np.abs(residual - 1) > max(DEAD, DEAD_DEVIATIONS * spread)
    _require_scattered(dead, MOST_DEAD, WHOLE_FRAME, "far brighter or darker than others")
    share = 0.0
    if flat.variance is not None:
        relative = flat.variance / np.maximum(signal, 1e-6 * span) ** 2
        limit = np.quantile(relative, 0.99)
        share = signal_share(residual, float(relative[relative <= limit].mean()) / flat.count)
    pixels = 1 + np.float32(share) * np.where(dead, 0, residual - 1)
    polarized = _apparent_dolp(gains, layout)
    _refuse_polarized(polarized, POLARIZED_FLAT)
    details = {
        "frames": flat.count,
        "brightness": round(brightness, 4),
        "pixel_gains_rms": round(share**0.5 * spread, 5),
        "place_gains_error": round(float(spread / (signal.size / layout.period**2) ** 0.5), 6),
        "falloff_least": round(least, 4),
        "falloff_lopsided": round(float((1 - fall / fall[::-1, ::-1]).max()), 4),  # as no lens is
        "noise_exponent": _noise_exponent(flat.variance, fall, layout.period),
        "apparent_dolp": round(polarized, 4),
        "dead_pixels": int(dead.sum()),
    }
    base = _base(before, mosaic)
    if base.analysers is not None and base.gains is None:  # their gains are those of the places, now measured here
        base = replace(base, analysers=tuple(tuple(a._replace(gain=1.0) for a in row) for row in base.analysers))
    return replace(
        base,
        dead=np.flatnonzero(dead).astype(np.int32),
        gains=_as_table(gains),
        gain_map=(tile(gains, signal.shape) * pixels).astype(np.float32) if share else None,
        falloff=falloff,
        details={**base.details, "flat": details},
    )


def _lit_evenly(frames: Iterable[Mosaic]) -> Iterator[Mosaic]:
    """The frames, none dark nor behind a polarizer, which their mean might not show. Raises ValueError."""
    for mosaic in frames:
        light = to_numpy(mosaic.linear())
        if (brightness := float(median(light))) < DARKEST_FLAT:
            raise ValueError(
                f"expected flat frames near half of the white level, found one of {max(brightness, 0):.1%}"
            )
        means = place_means(light, mosaic.layout.period)
        if means.min() > 0:
            dolp = _apparent_dolp(means / _color_means(means, mosaic.layout), mosaic.layout)
            _refuse_polarized(dolp, POLARIZER)
        yield mosaic


def _refuse_polarized(dolp: float, most: float) -> None:
    if dolp > most:
        raise ValueError(
            f"expected unpolarized light on the flat frames, found an apparent DoLP of {dolp:.0%}: take the polarizer "
            "off the lamp and the lens"
        )


def fit_falloff(image: Floats, period: int) -> Table:
    """Coefficients of `falloff.falloff_image`, largest value 1, nearest to an image of mean 1 on every place."""
    rows, cols = (n // period for n in image.shape)
    blocks = image[: rows * period, : cols * period].reshape(rows, period, cols, period)
    values = np.median(blocks.swapaxes(1, 2).reshape(rows * cols, -1), axis=1).astype(np.float64)
    degree = max(0, min(DEGREE, (min(rows, cols) - 1) // BLOCKS_PER_DEGREE))
    centres = [(2 * np.arange(n) + 1) * period / size - 1 for n, size in zip((rows, cols), image.shape, strict=True)]
    y, x = (np.polynomial.legendre.legvander(points, degree) for points in centres)
    terms = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    design = np.stack([np.outer(y[:, i], x[:, j]).reshape(-1) for i, j in terms], axis=1)
    weights = np.ones(values.size, bool)
    for _ in range(2):
        solution = np.linalg.lstsq(design[weights], values[weights], rcond=None)[0]
        residual = np.abs(values - design @ solution)
        weights = residual <= 5 * np.median(residual) + 1e-9
    found = np.zeros((degree + 1, degree + 1))
    for (i, j), value in zip(terms, solution, strict=True):
        found[i, j] = value
    return _as_table(found / (design @ solution).max())


def _noise_exponent(variance: Floats | None, fall: Floats, period: int) -> float | None:
    """Exponent of the power of the light that the variance over frames follows along the falloff; None where unsure.

    It is 1 for shot noise in linear samples and 2 - 1 / g in samples encoded by m^g: -0.2 for the usual g of 1 / 2.2.
    """
    if variance is None:
        return None
    level = np.log(fall, dtype=np.float64)
    level -= level.mean()
    spread = float(level.std())
    noise = np.minimum(variance / np.maximum(tile(place_means(variance, period), fall.shape), 1e-30), MOST_NOISE)
    noise /= max(float(noise.mean()), 1e-30)
    error = float(noise.std()) * (2 / noise.size) ** 0.5 / max(spread, LEAST_SPREAD)  # neighbours share half of it
    sure = spread >= LEAST_SPREAD and error <= MOST_ERROR
    return round(float((level * noise).mean()) / spread**2, 3) if sure else None


def _color_means(table: Doubles, layout: Layout) -> Doubles:
    """For each place, the mean over all places of its colour."""
    period = layout.period
    colors = np.array([[layout.filter_at(row, col).channel for col in range(period)] for row in range(period)])
    means = np.zeros_like(table)
    for color in np.unique(colors):
        means[colors == color] = table[colors == color].mean()
    return means


def _apparent_dolp(gains: Doubles, layout: Layout) -> float:
    """Degree of polarization of a flat frame's light that would make the same gains as its analysers have."""
    period = layout.period
    angles = [2 * np.deg2rad(layout.filter_at(row, col).angle_deg) for row in range(period) for col in range(period)]
    design = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    found = np.linalg.lstsq(design, gains.reshape(-1) - 1, rcond=None)[0]
    return float(np.hypot(*found))


def _base(before: Calibration | None, mosaic: Mosaic) -> Calibration:
    """The calibration to add to: of the frames' sensor."""
    size = (int(mosaic.data.shape[0]), int(mosaic.data.shape[1]))
    return replace(Calibration(mosaic.layout, mosaic.white_level, size) if before is None else before, size=size)


def require_same_sensor(base: Calibration | None, mosaic: Mosaic) -> None:
    """Raise ValueError where frames differ from those that a calibration was begun with."""
    if base is None:
        return
    found = (mosaic.layout.spec, mosaic.white_level, (int(mosaic.data.shape[0]), int(mosaic.data.shape[1])))
    wanted = (base.layout.spec, base.white_level, base.size or found[2])
    for name, want, have in zip(("layout", "white level", "height and width"), wanted, found, strict=True):
        if want != have:
            raise ValueError(f"expected frames of {name} {want}, as in the calibration so far, found {have}")


def _as_table(values: NDArray[np.floating]) -> Table:
    return tuple(tuple(float(x) for x in row) for row in values)
