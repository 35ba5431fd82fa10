"""Patterns of the mosaic's period in the outputs of real frames.

A demosaicker that fails leaves dots, blocks or stripes that repeat with the mosaic. Scenes rarely have power at exactly
these frequencies and not beside them. Frames are cut into tiles under a Hann window; power of a tile at the period's
frequencies over the median around them tells a pattern from texture.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from polsep.bench.rows import Row
from polsep.bench.truth import read_real_frames
from polsep.methods import METHODS
from polsep.pipeline import PolsepWarning, separate_capture
from polsep.sensor.camera import Mosaic

#: Side of a tile at half resolution; bins around a frequency that its window spreads over, and those compared with it.
TILE, NEAR, AROUND = 32, 2, 5


class Pattern(NamedTuple):
    """Power at the period's frequencies over that around them [dB], of all tiles and of the worst; its ``place``.

    ``amplitude``: rms of the pattern in the worst tile, over the frame's mean brightness.
    """

    whole: float
    worst: float
    amplitude: float
    place: tuple[int, int]


def measure_pattern(image: Tensor, period: int) -> Pattern:
    """Return the pattern of a ``period`` (2 or 4, in the image's pixels) of an image ``[C, H, W]``."""
    tiles = image.double().unfold(1, TILE, TILE).unfold(2, TILE, TILE)
    window = torch.hann_window(TILE, dtype=torch.float64)
    power = torch.fft.fft2(tiles * window * window[:, None]).abs() ** 2
    step = TILE // period
    at = [(y * step, x * step) for y in range(period) for x in range(period) if (y, x) != (0, 0)]
    far = torch.ones(2 * AROUND + 1, 2 * AROUND + 1, dtype=torch.bool)
    far[AROUND - NEAR : AROUND + NEAR + 1, AROUND - NEAR : AROUND + NEAR + 1] = False
    peaks, floors = [], []
    for y, x in at:
        rows, cols = ((torch.arange(k - AROUND, k + AROUND + 1)) % TILE for k in (y, x))
        near = power[..., rows[:, None], cols]
        peaks.append(power[..., y, x])
        # Edges along the mosaic have power at all frequencies across them, so rows and columns count by themselves.
        around = (near[..., far], near[..., AROUND, far[AROUND]], near[..., far[:, AROUND], AROUND])
        # The median of exponentially distributed powers is ln 2 of their mean.
        floors.append(torch.stack([x.median(dim=-1).values for x in around]).amax(dim=0) / math.log(2))
    peak, floor = torch.stack(peaks), torch.stack(floors)
    least = 1e-12 * float(power.mean()) + 1e-30
    whole = 10 * math.log10((float(peak.mean()) + least) / (float(floor.mean()) + least))
    # A tile counts by its pattern's power; the ratio alone would name black tiles.
    excess = (peak - 4 * floor).clamp(min=0).sum(dim=(0, 1))
    index = int(excess.argmax())
    place = (index // excess.shape[1], index % excess.shape[1])
    worst = (float(peak[..., place[0], place[1]].sum()) + least) / (float(floor[..., place[0], place[1]].sum()) + least)
    gain = float((window * window[:, None]).sum()) ** 2 * image.shape[0]
    amplitude = math.sqrt(float(excess.max()) / gain) / max(float(image.mean()), 1e-9)
    return Pattern(whole, 10 * math.log10(worst), amplitude, (place[0] * TILE, place[1] * TILE))


def bench_period(data: Path, methods: Sequence[str]) -> Iterator[Row]:
    """Patterns of the mosaic's period in diffuse and specular images of the real frames of ``data``/raw."""
    for stem, mosaic in read_real_frames(data):
        for method in (name for name in methods if METHODS[name].accepts(mosaic)):
            for full in (False, True):
                if full and method == "paper":
                    continue
                yield from _rows_of(stem, method, mosaic, full)


def _rows_of(stem: str, method: str, mosaic: Mosaic, full: bool) -> Iterator[Row]:
    period = mosaic.layout.period // (1 if full else 2)
    if period < 2:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolsepWarning)
        out = separate_capture(mosaic, method, full=full)
    case = f"{stem}, {'full' if full else 'half'} resolution"
    for name, image in (("diffuse", out.diffuse), ("specular", out.specular)):
        found = measure_pattern(torch.from_numpy(image).permute(2, 0, 1), period)
        yield Row("reality/period", case, method, f"{name} pattern", found.whole, "dB")
        yield Row("reality/period_worst", case, method, f"{name} pattern, worst tile", 100 * found.amplitude, "%")
