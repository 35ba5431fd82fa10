"""Twin of `whole_frame.make_thumbnail` for one frame on the CPU: one pass over the raw rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, ZERO, compiled, entry
from polsep.compute.rows_kernel import fill
from polsep.compute.threads import RowRange, run_over_rows
from polsep.demosaic.bilinear_kernel import Pattern, read_pattern
from polsep.networks.channels import PERIOD
from polsep.networks.thumbnails import SIDE, scale_thumbnail
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples, read_row

Floats = NDArray[np.float32]

_SIXTEENTH, _LOW = np.float32(1 / 16), np.float32(-1e30)


@compiled
def _read_packed_row(samples: Samples, pattern: Pattern, u: int, codes: Any, stokes: Any) -> None:
    """Row ``u`` of packed pixels: s0, s1, s2 of every colour and the clipped share ``stokes [3 C + 1, w]``."""
    colors = pattern.channels
    for row in range(PERIOD):
        read_row(samples, PERIOD * u + row, 0, codes[row])
    for k in range(stokes.shape[0]):
        fill(ZERO, stokes[k])
    for cell in range(4):
        c = pattern.bayer[cell // 2, cell % 2]
        cells = 0
        for other in range(4):
            cells += pattern.bayer[other // 2, other % 2] == c
        gain = pattern.gains[cell // 2, cell % 2] / np.float32(cells)
        for k in range(4):
            y, x = 2 * (cell // 2) + pattern.places[k, 0], 2 * (cell % 2) + pattern.places[k, 1]
            # m0 - m90 is s1, m45 - m135 is s2.
            signed, sign = stokes[(1 + k % 2) * colors + c], ONE if k < 2 else -ONE
            _add_samples((codes[y][x:], pattern), gain, sign, stokes[c], signed)
            _count_clipped(codes[y][x:], pattern.clip_at, stokes[3 * colors])


@compiled
def _add_samples(own: tuple[Any, Pattern], gain: Any, sign: Any, s0: Any, signed: Any) -> None:
    """Add half of every fourth sample to s0, and all of it, with its sign, to s1 or s2."""
    codes, black = own[0], own[1].black
    for j in range(s0.size):
        value = (codes[PERIOD * j] - black) * gain
        s0[j] += HALF * value
        signed[j] += sign * value


@compiled
def _count_clipped(codes: Any, clip_at: Any, clipped: Any) -> None:
    """Add a sixteenth where every fourth sample clips."""
    for j in range(clipped.size):
        if codes[PERIOD * j] >= clip_at:
            clipped[j] += _SIXTEENTH


@entry
def _pool_rows(samples: Samples, pattern: Pattern, row_range: RowRange, pooled: Any) -> None:
    """Rows ``[SIDE, n, SIDE]``: means of s0, s1, s2, maxima of s0 and of polarized light, and clipped shares."""
    colors, h, w = pattern.channels, pattern.h // 2, pattern.w // 2
    codes, stokes = np.empty((PERIOD, PERIOD * w), np.float32), np.empty((3 * colors + 1, w), np.float32)
    for i in range(row_range[0], row_range[1]):
        first, last = i * h // SIDE, -(-(i + 1) * h // SIDE)
        out = pooled[i]
        for k in range(out.shape[0]):
            fill(_LOW if 3 * colors <= k < 5 * colors else ZERO, out[k])
        for u in range(first, last):
            _read_packed_row(samples, pattern, u, codes, stokes)
            for j in range(SIDE):
                start, stop = j * w // SIDE, -(-(j + 1) * w // SIDE)
                share = ONE / np.float32((last - first) * (stop - start))
                for x in range(start, stop):
                    for k in range(3 * colors):
                        out[k, j] += stokes[k, x] * share
                    for c in range(colors):
                        s0, s1, s2 = stokes[c, x], stokes[colors + c, x], stokes[2 * colors + c, x]
                        out[3 * colors + c, j] = max(out[3 * colors + c, j], s0)
                        out[4 * colors + c, j] = max(out[4 * colors + c, j], np.sqrt(s1 * s1 + s2 * s2))
                    out[5 * colors, j] += stokes[3 * colors, x] * share


def thumbnail_of(raw: RawFrame, layout: Layout, levels: tuple[float, float], light: tuple[float, ...]) -> Floats:
    """The thumbnail ``[1, K, SIDE, SIDE]`` of a raw frame ``[H, W]`` in Sony's order with black and white ``levels``.

    ``light``: colour of the lamp that is divided out.
    """
    samples = as_samples(raw)
    pattern = read_pattern((raw.shape[0], raw.shape[1]), layout, *levels, light)
    colors = layout.channels
    pooled: Floats = np.empty((SIDE, 5 * colors + 1, SIDE), np.float32)
    run_over_rows(lambda row_range: _pool_rows(samples, pattern, row_range, pooled), SIDE, 4)
    means, largest, clipped = np.split(np.moveaxis(pooled, 1, 0)[None], (3 * colors, 5 * colors), axis=1)
    found: Floats = scale_thumbnail(means, largest, clipped)
    return found
