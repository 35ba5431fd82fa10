"""The black level that a frame shows by itself, compared with the one that was stated.

Light brings noise: a sample of light x above black has the variance gain x + floor (photon transfer). Dark parts whose
noise is far smaller than their level asks for are dark: their level is the black level. Two laws must agree:

1. Nothing lies below black but noise: the darkest samples stop at it.
2. The variance of smooth parts falls to the converter's and the reading's own at it, on a line through brighter parts.

Frames with samples near the black level that was stated are never in doubt. Unit: codes, as in `Mosaic.data`.
Source: photon transfer, Janesick 2007 (doi:10.1117/3.725073); the test is this project's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.compute.warm_up import make_ready
from polsep.sensor import periods_kernel
from polsep.sensor.camera import Mosaic, first_frame
from polsep.sensor.noise import BLOCK, LARGEST_WELL, MIN_SPAN, code_step
from polsep.sensor.periods_kernel import measure_blocks

Floats = NDArray[np.float32]

#: Blocks of 4x4 samples that are looked at, about; the fewest that make a level; levels of brightness.
BLOCKS, MIN_BLOCKS, LEVELS = 24_576, 32, 24
#: Share of the blocks whose darkest level is black, if any is.
DARKEST = 0.004
#: A dark level is black if its variance is below this share of what its level asks for.
QUIET = 0.35
#: And below this share of what it asks for on a sensor of `LARGEST_WELL`.
LEAST_NOISE = 0.6
#: Least noise of bright parts, over that of the same sensor.
MIN_GAIN = 0.5
#: Least black level that is reported, and the least excess of one that was stated, relative to white.
LEAST, LEAST_EXCESS = 0.0015, 0.002
#: Share of codes below black from which on too much is subtracted; corrected samples may be negative.
BELOW = 0.002


@dataclass(frozen=True)
class BlackLevel:
    """``level``: the black level that the frame shows, None if it does not; ``warning``: a line, or None."""

    level: float | None
    warning: str | None


def check_black_level(mosaic: Mosaic) -> BlackLevel:
    """Compare the first frame with its black level; silent where the frame does not show it."""
    stated, span = float(mosaic.black_level), float(mosaic.white_level - mosaic.black_level)
    if min(mosaic.data.shape[-2:]) < 4 * BLOCK:
        return BlackLevel(None, None)
    rows = _some_rows(mosaic)
    least, lowest = stated - LEAST_EXCESS * span, float(rows.min())
    below = float(np.mean(rows < least)) if 0 <= lowest < least and not mosaic.less_ambient else 0.0
    if below > BELOW and not _shows(mosaic, stated, rows):
        excess = f"{below:.1%} of the samples lie below the black level {stated:g}, which only noise should"
        return BlackLevel(None, f"{excess}: the darkest are at {np.quantile(rows, 0.001):g}, say a lower --black-level")
    level = _black_of(mosaic, rows)
    if level is None or level - stated < LEAST * span:
        return BlackLevel(None, None)
    shown = f"black lies at {level:.4g}, not at {stated:g}, as the noise of dark parts shows"
    advice = "taken so, say" if stated == 0 else "say"
    return BlackLevel(level, f"{shown}: {advice} --black-level {level:.4g}")


def _shows(mosaic: Mosaic, stated: float, rows: Floats) -> bool:
    """True if the dark parts of a frame show the stated black level, or more: below are tails of their noise."""
    level = _black_of(replace(mosaic, black_level=0.0), rows)
    return level is not None and level > stated - LEAST * float(mosaic.white_level - stated)


def _some_rows(mosaic: Mosaic) -> Floats:
    """Rows of blocks, evenly spread over the first frame, about `BLOCKS` of them."""
    x = to_numpy(first_frame(mosaic))
    height, width = (n // BLOCK * BLOCK for n in x.shape)
    step = max(1, height * width // BLOCK**2 // BLOCKS)
    rows = x[:height].reshape(-1, BLOCK, x.shape[1])[::step, :, :width]
    return np.ascontiguousarray(rows, np.float32).reshape(-1, width)


def _black_of(mosaic: Mosaic, rows: Floats) -> float | None:
    """The level of the darkest parts if they are black, by their noise; None where that is not shown."""
    stated, span = float(mosaic.black_level), float(mosaic.white_level - mosaic.black_level)
    level, variance = smooth_blocks(mosaic, rows)
    if level.size < 4 * MIN_BLOCKS or not _is_codes(mosaic, rows):
        return None
    count = max(MIN_BLOCKS, int(DARKEST * level.size))
    if float(np.median(np.partition(level, count - 1)[:count])) - stated < LEAST * span:
        return None
    order = np.argsort(level)
    level, variance = level[order], variance[order]
    dark, quiet = float(np.median(level[:count])), float(np.median(variance[:count]))
    if not level[-1] > dark:
        return None
    edges = dark + (level[-1] - dark) * np.linspace(0.0, 1.0, LEVELS + 1)[1:] ** 2
    parts = np.split(np.arange(level.size), np.searchsorted(level, edges))
    gains = [
        (float(np.quantile(variance[part], 0.25)) - quiet) / (float(np.median(level[part])) - dark)
        for part in parts[1:]
        if part.size >= MIN_BLOCKS and float(np.median(level[part])) > dark
    ]
    if len(gains) < 3:
        return None
    gain = float(np.quantile(gains, 0.25))
    if gain < MIN_GAIN * span / LARGEST_WELL:
        return None
    if quiet > (dark - stated) * min(QUIET * gain, LEAST_NOISE * span / LARGEST_WELL):
        return None
    return float(np.median(level[level <= dark + 4 * (quiet / BLOCK**2) ** 0.5]))


def _is_codes(mosaic: Mosaic, rows: Floats) -> bool:
    """True for codes, as converters give, also scaled; renderings without noise are none and show no black level."""
    span = float(mosaic.white_level - mosaic.black_level)
    return 0 < code_step(rows, span) <= span / MIN_SPAN


def smooth_blocks(mosaic: Mosaic, rows: Floats | None = None) -> tuple[Floats, Floats]:
    """Mean level and variance of unclipped blocks, without what is common to all samples of a block: texture.

    Of blocks whose neighbours on both sides are not clipped either. ``rows``: `_some_rows`, where they are known.
    """
    make_ready(periods_kernel.warm_up)
    blocks = measure_blocks(_some_rows(mosaic) if rows is None else rows)
    clip = np.float32(mosaic.clip_level)
    unclipped = blocks.most < clip
    kept = unclipped[:, 1:-1] & unclipped[:, :-2] & unclipped[:, 2:]
    return blocks.mean[:, 1:-1][kept], blocks.variance[:, 1:-1][kept]
