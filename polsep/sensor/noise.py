"""Noise of a stream of raw frames, measured from the stream itself: variance = gain x signal + floor.

Photons make the noise of a sample grow with its light (shot noise), the converter adds the same to all (read noise and
rounding). Two differences show both: of a sample to the same sample's mean over the frames before, where nothing moves,
and to its neighbours behind the same filter, where the picture is smooth. Motion and texture only ever add to them, so
at each brightness the smaller one counts, and of each the median over blocks of 4x4 samples after blocks that differ by
far more than most are left out: a minority that moves does not matter, nor does a pan over a scene with smooth parts.

Unit: that of the samples (codes); a sample includes the black level, a signal does not.
Source: the linear model is Janesick 2007 (Photon transfer, doi:10.1117/3.725073) and Foi et al. 2008
(doi:10.1109/TIP.2008.2001399); the estimator is this project's.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.warm_up import make_ready
from polsep.sensor import periods_kernel
from polsep.sensor.periods_kernel import measure_blocks

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

#: Samples along the side of a block: one period of any layout's filters.
BLOCK = 4
#: Approximate number of blocks of an estimate; most and fewest bins of brightness, blocks per bin, the fewest of one.
BLOCKS, MAX_BINS, FEWEST_BINS, BLOCKS_PER_BIN, MIN_BLOCKS = 6144, 64, 6, 48, 24
#: Quarter and median of chi-squared over its degrees, of 12: a block's 16 samples are not of one brightness.
QUARTER, MEDIAN = 8.438 / 12, 11.34 / 12
#: Blocks this many times as different as the quieter quarter says are moving or textured.
OUTLIER = 2.0
#: Least full well that a gain may mean [electrons at white], and the largest deviation of black, relative to white.
MIN_WELL, LARGEST_FLOOR = 200.0, 0.05
#: Full well of sensors with little shot noise [electrons at white]; a frame with less noise is taken for one of these.
LARGEST_WELL = 20_000.0
#: Least deviation of floats, relative to white: noise-free renderings are not exact either.
ROUNDING = 2.0**-20
#: Whole numbers are codes if white is at least this far above black; share of samples that may be others.
MIN_SPAN, MOST_REPAIRED = 100.0, 0.01
#: Rows that show the step between codes, the fewest codes in them, and the least and the largest step of scaled ones,
#: relative to white: of 15 and of 7 bits.
CODE_ROWS, MIN_CODES, STEPS = 8, 32, (2.0**-15, 2.0**-7)
#: Rounds of the robust fit, and the deviation of a bin of one block, relative to its variance: of a median of
#: chi-squared, 1.25 sqrt(2 / 16). Bins off by more count less, those above the line least: motion and texture only add.
ROUNDS, DEVIATION = 16, 0.44
#: Factor on the estimate from neighbours, an upper limit: the smaller of two estimates is too small on average.
MARGIN = 1.15


@dataclass(frozen=True)
class Levels:
    """Black and white in the unit of the samples; ``step`` between codes, 0 for floats; ``clip``: the least clipped."""

    black: float
    white: float
    step: float
    clip: float

    @property
    def span(self) -> float:
        """White above black."""
        return self.white - self.black


@dataclass(frozen=True)
class Noise:
    """Variance of one unclipped sample: ``gain`` times its signal, plus ``floor``."""

    gain: float
    floor: float

    def variance(self, signal: Any) -> Any:
        """Variance at a ``signal`` above black; float32 stays float32."""
        return np.float32(self.gain) * np.maximum(signal, np.float32(0)) + np.float32(self.floor)


def code_step(samples: NDArray[Any], span: float) -> float:
    """Step between the codes that samples ``[H, W]`` are, as of converters; 0 for others, as of renderings.

    Codes that were divided or moved are still codes: k c + b; a few samples that were repaired do not count. ``span``:
    white above black.
    """
    rows = samples[:: max(1, len(samples) // CODE_ROWS)]
    values, counts = np.unique(rows, return_counts=True)
    codes = values[counts > 1].astype(np.float64)
    gaps = np.diff(codes)
    if len(codes) >= MIN_CODES and STEPS[0] * span <= gaps.min() <= STEPS[1] * span:
        step = float(gaps[gaps < 1.5 * gaps.min()].mean())
        step = float(gaps.sum() / np.rint(gaps / step).sum())
        places = (codes - codes[0]) / step
        if float(np.abs(places - np.rint(places)).max()) < 0.05:
            return step
    lit = rows[rows != 0]
    return 1.0 if span >= MIN_SPAN and np.count_nonzero(lit != np.floor(lit)) <= MOST_REPAIRED * lit.size else 0.0


def least_noise(levels: Levels) -> Noise:
    """Noise of exact samples: rounding to codes, of light halfway between two, or to floats."""
    return Noise(0.0, levels.step**2 / 4 + (ROUNDING * levels.span) ** 2)


def blocks_of(image: NDArray[Any]) -> NDArray[Any]:
    """Samples ``[H, W]`` as blocks ``[H/4, W/4, 16]``."""
    rows, cols = (n // BLOCK for n in image.shape)
    return image.reshape(rows, BLOCK, cols, BLOCK).swapaxes(1, 2).reshape(rows, cols, BLOCK * BLOCK)


def estimate_noise(now: NDArray[Any], before: tuple[Floats, Floats] | None, levels: Levels, turn: int) -> Noise | None:
    """The noise of samples ``now [H, W]``; None if too few blocks are usable.

    ``before``: means ``[H, W]`` and their numbers of frames, per block; None in the first frame, when only
    neighbours count. ``turn`` chooses the rows of blocks that are used in large frames. H and W are multiples of 4.
    """
    rows, cols = (n // BLOCK for n in now.shape)
    step = max(1, rows * cols // BLOCKS)
    kept = slice(turn % step, None, step)
    make_ready(periods_kernel.warm_up)
    samples = _rows(now, kept).astype(np.float32)
    blocks = measure_blocks(samples)
    unclipped = (blocks.least > 0) & (blocks.most < levels.clip)
    spread = np.full(unclipped.shape, np.inf, np.float32)
    spread[:, 1:-1] = np.where(unclipped[:, :-2] & unclipped[:, 2:], blocks.square[:, 1:-1], np.float32(np.inf))
    signal = blocks.mean - np.float32(levels.black)
    changes = [spread]
    if before is not None:
        spread *= np.float32(MARGIN)
        x, mean, count = blocks_of(samples), blocks_of(_rows(before[0], kept)), before[1][kept]
        unclipped &= np.all((mean > 0) & (mean < levels.clip), axis=-1)
        changes.append(np.square(x - mean).mean(axis=-1) / (1 + 1 / count))
        signal = mean.mean(axis=-1) - np.float32(levels.black)
    chosen = [values[unclipped] for values in (signal, *changes)]
    if chosen[0].size < MIN_BLOCKS:
        return None
    return _fit(_by_brightness(chosen[0], chosen[1:], levels.span), levels)


def _rows(image: NDArray[Any], kept: slice) -> NDArray[Any]:
    """Some rows of blocks."""
    return image.reshape(-1, BLOCK, image.shape[1])[kept].reshape(-1, image.shape[1])


def _by_brightness(signal: Floats, changes: list[Floats], span: float) -> Doubles:
    """Signal, variance and number ``[K, 3]`` of the blocks of each bin of brightness.

    Bins are of equal width in the root of the signal: of the noise's width times the same number in dark and light.
    """
    root = np.sqrt(np.maximum(signal, 0))
    bins = min(max(root.size // BLOCKS_PER_BIN, FEWEST_BINS), MAX_BINS)
    scale = np.float32(bins / max(float(root.max()), 1e-3 * span**0.5))
    which = np.minimum(root * scale, np.float32(bins - 1)).astype(np.int64)
    ends = np.cumsum(np.bincount(which, minlength=bins))[:-1]
    signals, *parts = (np.split(values[np.lexsort((values, which))], ends) for values in (signal, *changes))
    found = []
    for own, *squares in zip(signals, *parts, strict=True):
        variance = min(_central(ordered) for ordered in squares)
        if np.isfinite(variance):
            found.append((_quantile(own, 0.5), variance, own.size))
    return np.array(found, np.float64).reshape(-1, 3)


def _central(ordered: Floats) -> float:
    """The variance that explains most of the blocks' ascending mean squares; inf if too few are finite."""
    finite = ordered[: np.searchsorted(ordered, np.inf)]
    if finite.size < MIN_BLOCKS:
        return float("inf")
    quiet = _quantile(finite, 0.25) / QUARTER
    return _quantile(finite[: np.searchsorted(finite, OUTLIER * quiet, side="right")], 0.5) / MEDIAN


def _quantile(ordered: Floats, share: float) -> float:
    """`numpy.quantile` of ascending values, without its overhead, which is most of an estimate's time."""
    whole, part = divmod(share * (ordered.size - 1), 1)
    first, second = (float(ordered[min(int(whole) + step, ordered.size - 1)]) for step in (0, 1))
    return first + part * (second - first)


def _fit(points: Doubles, levels: Levels) -> Noise:
    """The line through variances, relative residuals by size, within what cameras can be."""
    least = least_noise(levels)
    if not len(points):
        return least
    signal, variance, count = points[:, 0], np.maximum(points[:, 1], least.floor), points[:, 2]
    most = Noise(levels.span / MIN_WELL, (LARGEST_FLOOR * levels.span) ** 2)
    trust = count / variance**2
    line, weight = least, trust
    for _ in range(ROUNDS):
        line = _line(signal, variance, weight, least.floor)
        line = Noise(min(line.gain, most.gain), min(line.floor, most.floor))
        above = (variance - line.gain * signal - line.floor) / variance / (DEVIATION / np.sqrt(count))
        weight = trust / np.where(above > 0, np.maximum(above, 1) ** 2, np.maximum(-above, 1))
    return line


def _line(x: Doubles, y: Doubles, weight: Doubles, least: float) -> Noise:
    """Weighted least squares of y = gain x + floor with a gain of 0 or more and a floor of ``least`` or more."""
    whole = weight.sum()
    middle, height = (x * weight).sum() / whole, (y * weight).sum() / whole
    spread = float((weight * (x - middle) ** 2).sum())
    gain = float((weight * (x - middle) * (y - height)).sum()) / spread if spread > 0 else 0.0
    floor = float(height - gain * middle)
    if gain < 0:
        return Noise(0.0, max(float(height), least))
    if floor < least:
        power = float((weight * x**2).sum())
        gain = float((weight * x * (y - least)).sum()) / power if power > 0 else 0.0
        return Noise(max(gain, 0.0), least)
    return Noise(gain, floor)
