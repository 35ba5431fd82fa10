"""Random waves and folds at points in space, which give shapes relief: bumps of stone and skin, folds of cloth.

Points ``[..., 3]`` and heights are in units of the shape. Draws are numbers from one generator, in order.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

Floats = NDArray[np.float64]
#: Random numbers between two bounds, of a shape.
Draw = Callable[..., Floats]

#: Number of waves, their wavelengths, log-uniform, and their height over the wavelength, log-uniform for all together.
WAVES, WAVELENGTHS, HEIGHTS = 12, (0.08, 1.2), (0.001, 0.06)
#: Distance of folds, and their slope, log-uniform; waves that bend them, their wavelengths, and how far: 1 doubles the
#: slope. Share of a fold's second harmonic.
FOLD_LENGTHS, FOLD_SLOPES, BENDS, BEND_LENGTHS, BENT, SHARPER = (0.04, 0.25), (0.1, 0.6), 3, (0.3, 1.2), 1.0, 0.35


def drawn_from(generator: torch.Generator) -> Draw:
    """Return a function that draws numbers between two bounds, one unless a shape is given."""

    def draw(low: float, high: float, *shape: int) -> Floats:
        numbers = torch.rand(*(shape or (1,)), generator=generator, dtype=torch.float64)
        found: Floats = (low + (high - low) * numbers).numpy()
        return found

    return draw


def draw_one(draw: Draw, interval: tuple[float, float] = (0.0, 1.0)) -> float:
    """Return one number of an interval."""
    return float(draw(*interval)[0])


def draw_log(draw: Draw, interval: tuple[float, float]) -> float:
    """Return one number of an interval, log-uniform."""
    return math.exp(draw_one(draw, (math.log(interval[0]), math.log(interval[1]))))


def draw_way(draw: Draw) -> Floats:
    """Return a random unit vector."""
    way = draw(-1, 1, 3)
    return way / max(float(np.linalg.norm(way)), 1e-6)


def bumps(points: Floats, draw: Draw, heights: tuple[float, float] = HEIGHTS) -> Floats:
    """Return the sum of `WAVES` at points, ``[...]``."""
    share = draw(0, 1, WAVES + 2)
    low, high = WAVELENGTHS
    height = heights[0] * (heights[1] / heights[0]) ** share[-1]
    total: Floats = np.zeros(points.shape[:-1])
    for place in share[:WAVES]:
        length = low * (high / low) ** place
        way = draw_way(draw)
        total += length * np.sin(2 * math.pi * (points @ way / length + draw_one(draw)))
    found: Floats = height * total
    return found


def folds(points: Floats, draw: Draw) -> Floats:
    """Return parallel folds at points, bent and stronger here than there, ``[...]``."""
    length, slope = draw_log(draw, FOLD_LENGTHS), draw_log(draw, FOLD_SLOPES)
    phase = 2 * math.pi * (points @ draw_way(draw) / length)
    for _ in range(BENDS):
        bend = draw_log(draw, BEND_LENGTHS)
        far = BENT * draw_one(draw) * bend / (BENDS * length)
        phase += far * np.sin(2 * math.pi * (points @ draw_way(draw) / bend + draw_one(draw)))
    where = 2 * math.pi * (points @ draw_way(draw) / draw_log(draw, BEND_LENGTHS) + draw_one(draw))
    folded: Floats = np.sin(phase) + SHARPER * np.sin(2 * phase + 2 * math.pi * draw_one(draw))
    strength: Floats = slope * length / (2 * math.pi) * (0.5 + 0.5 * np.sin(where))
    return strength * folded
