"""Exposure and focus of a raw frame for people who set up a shot: histogram, cells that clip or are black, sharp edges.

A cell is 2x2 pixels under the four analysers, the unit of half resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.sensor.camera import Mosaic

#: Bits of `exposure_flags`: a sample clips; all samples are at or below the black level.
CLIPPED, BLACK = 1, 2
#: Brightness below which edges are noise, of one measurement at the white level.
_DARK = 0.02


@dataclass(frozen=True)
class Histogram:
    """Shares of raw samples per bin between black and white, for each colour: rows of ``shares`` [colours, bins].

    ``clipped``: the share of samples of each colour that clip.
    """

    names: str
    shares: NDArray[np.float64]
    clipped: tuple[float, ...]


def histogram(mosaic: Mosaic, bins: int = 128) -> Histogram:
    """Histogram of raw samples from black to white; samples beyond count in the first and last bins."""
    mosaic = replace(mosaic, light_color=(1.0, 1.0, 1.0))  # a calibrated lamp's colour is not in raw samples
    samples, clipped = to_numpy(mosaic.linear()), to_numpy(mosaic.clipped())
    layout, period = mosaic.layout, mosaic.layout.period
    count = np.zeros((layout.channels, bins))
    over = np.zeros(layout.channels)
    for row in range(period):
        for col in range(period):
            channel = layout.filter_at(row, col).channel
            values = samples[row::period, col::period]
            codes = np.clip(values * bins, 0, bins - 1).astype(np.int64)
            count[channel] += np.bincount(codes.ravel(), minlength=bins)
            over[channel] += int(np.count_nonzero(clipped[row::period, col::period]))
    total = count.sum(axis=1)
    names = "RGB" if layout.channels == 3 else "Y"
    return Histogram(names, count / total[:, None], tuple((over / total).tolist()))


def exposure_flags(mosaic: Mosaic) -> NDArray[np.uint8]:
    """`CLIPPED` and `BLACK` of every cell, ``uint8 [h, w]`` at half resolution."""
    clipped, black = to_numpy(mosaic.clipped()), to_numpy(mosaic.linear()) <= 0
    flags: NDArray[np.uint8] = np.where(_cells(clipped, mosaic).any(axis=(1, 3)), CLIPPED, 0).astype(np.uint8)
    flags[_cells(black, mosaic).all(axis=(1, 3))] |= BLACK
    return flags


def _cells(plane: NDArray[Any], mosaic: Mosaic) -> NDArray[Any]:
    """A plane ``[H, W]`` as ``[h, 2, w, 2]``."""
    (top, left), (height, width) = mosaic.layout.origin, mosaic.layout.cells(plane.shape)
    return plane[top : top + 2 * height, left : left + 2 * width].reshape(height, 2, width, 2)


def edge_contrast(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Contrast of every pixel of a linear image ``[h, w]`` to the next ones, relative to its brightness: 0 is even.

    It is largest in focus. Polarization does not enter if ``light`` is s0.
    """
    down, across = np.abs(np.diff(light, axis=0, append=light[-1:])), np.abs(np.diff(light, append=light[:, -1:]))
    return (np.hypot(down, across) / np.maximum(light, np.float32(_DARK))).astype(np.float32)
