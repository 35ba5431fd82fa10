"""Several exposures of one still scene as one frame, by the inverse of their variance.

Frame i, exposed for t_i, shows the light L as y_i = L t_i / t_min, white = 1: the unit of the merged frame is that of
its shortest exposure. Of shot noise and read noise, y_i / t_i has the variance

    (gain L t_i / t_min + floor) (t_min / t_i)^2

A sample counts if it is unclipped in its frame and in all shorter ones, and if these do not predict one near the white
level: chosen by its own value, bright noise would be left out and dark noise kept. What is clipped in the shortest
frame stays clipped. Source: weights Robertson, Borman, Stevenson 2003 (doi:10.1117/1.1557695); the rules of choice are
this project's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import of_kind, to_numpy
from polsep.sensor.ambient import EQUAL
from polsep.sensor.camera import CLIP_MARGIN, Mosaic
from polsep.sensor.noise import Levels, Noise, estimate_noise

Floats = NDArray[np.float32]

#: Predicted samples above this share of white do not count.
BRIGHTEST = 0.95
#: Samples that show the ratio of two exposures: of the longer one, in white. Fewest of them, and the largest ratio that
#: they show: beyond, the shorter one has a few codes of 12 bits there, of which noise and the black level decide.
RATIO_RANGE, MIN_SAMPLES, MOST_RATIO = (0.1, 0.9), 64, 300.0
#: Largest disagreement of stated times with the frames, and share of the samples that may have moved.
MAX_DISAGREEMENT, MAX_MOVED = 0.05, 0.01
#: Deviations from the other exposures beyond which a sample has moved.
MOVED = 6.0
#: Noise of sensors of which the frames do not show it: a full well of 10 000 electrons, a read noise of 3.
USUAL_NOISE = Noise(1e-4, 9e-8)


@dataclass(frozen=True)
class Merged:
    """A merged frame, black at 0 and white at 1; its ``noise``, that of one sample where only the shortest counts.

    ``times``: of the frames, in the unit they came in, or relative to the shortest. ``notes``: for the user.
    """

    mosaic: Mosaic
    times: tuple[float, ...]
    noise: Noise
    notes: tuple[str, ...]


def merge_exposures(frames: Sequence[Mosaic], times: Sequence[float] | None = None) -> Merged:
    """Frames ``[H, W]`` of one still scene merged into one; ``times`` in any unit, None to find them in the frames.

    One frame is returned as it is, in the new unit. Raises ValueError on frames of other sizes or layouts, on times
    that are not positive or in another order than the frames' brightness, and where frames do not show their ratio.
    """
    _require_same(frames)
    if times is not None and (len(times) != len(frames) or not all(0 < t < float("inf") for t in times)):
        raise ValueError(f"expected {len(frames)} positive exposure times, one per frame, found {list(times)}")
    # A calibrated lamp's colour stays in the samples: `replace` keeps it for what reads the merged frame.
    linear = [to_numpy(replace(frame, light_color=(1.0, 1.0, 1.0)).linear()) for frame in frames]
    clipped = [to_numpy(frame.clipped()) for frame in frames]
    found, notes = _find_times(linear, clipped, times)
    order = sorted(range(len(frames)), key=lambda i: found[i])
    ratio = [found[i] / found[order[0]] for i in order]
    noise = _find_noise(linear[order[-1]])
    merged, moved = _merge([linear[i] for i in order], [clipped[i] for i in order], ratio, noise)
    if moved > MAX_MOVED and not notes:  # wrong times look like motion
        notes.append(f"{moved:.1%} of the samples differ between exposures by more than noise: did the scene move?")
    mosaic = replace(frames[0], data=of_kind(merged, frames[0].data), black_level=0.0, white_level=1.0)
    return Merged(mosaic, tuple(found), noise, tuple(notes))


def _require_same(frames: Sequence[Mosaic]) -> None:
    if not frames:
        raise ValueError("expected at least one frame to merge, found none")
    first = frames[0]
    for frame in frames:
        if (frame.layout, frame.data.shape) != (first.layout, first.data.shape) or frame.data.ndim != 2:
            sizes = ["x".join(str(n) for n in reversed(f.data.shape)) + f" {f.layout.spec}" for f in (first, frame)]
            raise ValueError(f"expected frames of one size and layout, found {sizes[0]} and {sizes[1]}")


def _find_times(
    linear: Sequence[Floats], clipped: Sequence[NDArray[np.bool_]], times: Sequence[float] | None
) -> tuple[list[float], list[str]]:
    """Times of all frames, and notes where stated ones disagree with the frames' brightness."""
    order = sorted(range(len(linear)), key=lambda i: float(linear[i].mean()) if times is None else times[i])
    found, notes = {order[0]: 1.0 if times is None else float(times[order[0]])}, []
    for short, long in pairwise(order):
        ratio = _ratio(linear[short], linear[long], ~(clipped[short] | clipped[long]))
        if times is None:
            if ratio is None or ratio > MOST_RATIO:
                raise ValueError("expected exposures that share well exposed samples, found too few: say --times")
            found[long] = found[short] * ratio
            continue
        found[long] = float(times[long])
        stated = found[long] / found[short]
        if ratio is not None and stated > EQUAL and ratio < 1 - MAX_DISAGREEMENT:
            raise ValueError(
                f"expected exposure times in the order of the frames, found {found[short]:g} for frame {short + 1} and "
                f"{found[long]:g} for frame {long + 1}, which is darker ({ratio:.3g} of it)"
            )
        if ratio is not None and abs(ratio / stated - 1) > MAX_DISAGREEMENT:
            notes.append(f"exposure times of 1:{stated:.3g} were stated, the frames' brightness says 1:{ratio:.3g}")
    return [found[i] for i in range(len(linear))], notes


def _ratio(short: Floats, long: Floats, unclipped: NDArray[np.bool_]) -> float | None:
    """Brightness of the longer exposure over that of the shorter one, without what moved; None where too little shows.

    Samples are chosen by the longer one, whose noise is the smaller; the ratio of sums has no bias.
    """
    chosen = unclipped & (long > RATIO_RANGE[0]) & (long < RATIO_RANGE[1])
    x, y = short[chosen].astype(np.float64), long[chosen].astype(np.float64)
    if x.size < MIN_SAMPLES or x.sum() <= 0:
        return None
    ratio = float(y.sum() / x.sum())
    for _ in range(3):
        off = np.abs(y - ratio * x)
        kept = off <= 4 * np.median(off) + 1e-9
        ratio = float(y[kept].sum() / x[kept].sum())
    return ratio


def _find_noise(linear: Floats) -> Noise:
    """Noise of one sample, white = 1, from smooth parts of a frame."""
    rows, cols = (n // 4 * 4 for n in linear.shape)
    step = Levels(0.0, 1.0, 0.0, 1 - CLIP_MARGIN)
    found = estimate_noise(linear[:rows, :cols], None, step, 0) if min(rows, cols) >= 16 else None
    return found if found is not None and found.floor + found.gain > 1e-8 else USUAL_NOISE


def _merge(
    linear: Sequence[Floats], clipped: Sequence[NDArray[np.bool_]], ratio: Sequence[float], noise: Noise
) -> tuple[Floats, float]:
    """The merged frame of exposures in rising order of their times, and the share of samples that moved."""
    if len(linear) == 1:
        return linear[0], 0.0
    usable, light = [], linear[0]
    for i, image in enumerate(linear):
        used = ~np.logical_or.reduce([c for c, t in zip(clipped, ratio, strict=True) if t <= EQUAL * ratio[i]])
        shorter = [j for j in range(i) if ratio[i] > EQUAL * ratio[j]]
        if shorter:
            used &= linear[shorter[-1]] * np.float32(ratio[i] / ratio[shorter[-1]]) < BRIGHTEST
        usable.append(used)
        light = np.where(used, image / np.float32(ratio[i]), light)
    total, weights = np.zeros_like(light), np.zeros_like(light)
    least = np.maximum(light, 0)
    for image, used, t in zip(linear, usable, ratio, strict=True):
        weight = np.where(used, np.float32(t * t) / (np.float32(noise.gain * t) * least + np.float32(noise.floor)), 0)
        total += weight * image / np.float32(t)
        weights += weight
    known = weights > 0
    merged = np.where(known, total / np.where(known, weights, 1), 1).astype(np.float32)
    moved = 0
    for image, used, t in zip(linear, usable, ratio, strict=True):
        expected = merged * np.float32(t)
        deviation = np.sqrt(noise.variance(expected)) + np.float32(0.002)
        moved += int(np.count_nonzero(used & (np.abs(image - expected) > MOVED * deviation)))
    return merged, moved / (len(linear) * merged.size)
