"""Twin of `color_affine.interpolate_around` for few holes in a large frame: push and pull over a pyramid.

Only the pyramid, a third of the frame, is ever made; of the frame itself nothing but the holes is interpolated.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, QUARTER, ZERO, compiled, entry
from polsep.compute.threads import RowRange, run_over_rows

#: Means and, in the last plane, weights of one level of a pyramid: ``[K + 1, h, w]``.
Level = NDArray[np.float32]

_MIN_WEIGHT = np.float32(1e-12)
#: Rows of a frame that one thread halves, an even number.
_ROWS = 64


def interpolate_holes(finest: Level, shape: tuple[int, int], places: NDArray[np.int64]) -> NDArray[np.float32]:
    """Values ``[K, N]`` at the flat ``places [N]``, holes all, of a frame of that ``shape (h, w)``.

    ``finest``: the first level above the frame, from `halve_specular` or `halve_separation`, which is completed.
    """
    levels = [finest]
    while max(levels[-1].shape[1:]) > 1:
        levels.append(_halve(levels[-1]))
    for level, coarse in zip(levels[-2::-1], levels[:0:-1], strict=True):
        _push(level, coarse)
    values: NDArray[np.float32] = _push_at(finest, shape, places)
    return values


def halve_separation(
    diffuse: NDArray[np.float32], specular: NDArray[np.float32], lines: NDArray[np.float32], valid: NDArray[np.bool_]
) -> Level:
    """The first level of the specular polarization (two planes) and of the diffuse light (three), where ``valid``.

    ``diffuse``, ``specular [h, w, 3]``, ``lines [4, h, w]``: a and b of p = a s0 + b.
    """
    h, w = valid.shape
    level = np.zeros((6, (h + 1) // 2, (w + 1) // 2), np.float32)
    run_over_rows(partial(_halve_separation, diffuse, specular, lines, valid, level), h, _ROWS)
    return level


def halve_specular(specular: NDArray[np.float32], outside: NDArray[np.bool_]) -> Level:
    """The first level of a white specular image ``[h, w, 3]``, ``outside`` of its holes."""
    h, w = outside.shape
    level = np.zeros((2, (h + 1) // 2, (w + 1) // 2), np.float32)
    run_over_rows(partial(_halve_specular, specular, outside, level), h, _ROWS)
    return level


def _halve(level: Level) -> Level:
    """The next level: means over 2x2 of totals and weights."""
    planes, h, w = level.shape
    coarse = np.zeros((planes, (h + 1) // 2, (w + 1) // 2), np.float32)
    _halve_planes(level, coarse)
    return coarse


@compiled
def _share(i: int, j: int, h: int, w: int) -> Any:
    """1 / the number of pixels of the 2x2 block of a pixel, at an odd border fewer than 4."""
    count = (2 if i // 2 * 2 + 1 < h else 1) * (2 if j // 2 * 2 + 1 < w else 1)
    return ONE / np.float32(count)


@entry
def _halve_separation(diffuse: Any, specular: Any, lines: Any, valid: Any, level: Any, row_range: RowRange) -> None:
    h, w = valid.shape
    for i in range(row_range[0], row_range[1]):
        for j in range(w):
            if not valid[i, j]:
                continue
            y, x = i // 2, j // 2
            share, tau = _share(i, j, h, w), specular[i, j, 0]
            p1, p2 = lines[2, i, j] + lines[0, i, j] * tau, lines[3, i, j] + lines[1, i, j] * tau
            size = np.sqrt(p1 * p1 + p2 * p2)
            scale = share * tau / (size if size > _MIN_WEIGHT else _MIN_WEIGHT)
            level[0, y, x] += scale * p1
            level[1, y, x] += scale * p2
            for c in range(3):
                level[2 + c, y, x] += share * diffuse[i, j, c]
            level[5, y, x] += share


@entry
def _halve_specular(specular: Any, outside: Any, level: Any, row_range: RowRange) -> None:
    h, w = outside.shape
    for i in range(row_range[0], row_range[1]):
        for j in range(w):
            share = _share(i, j, h, w) if outside[i, j] else ZERO
            level[0, i // 2, j // 2] += share * specular[i, j, 0]
            level[1, i // 2, j // 2] += share


@entry
def _halve_planes(level: Any, coarse: Any) -> None:
    planes, h, w = level.shape
    for k in range(planes):
        for i in range(h):
            for j in range(w):
                coarse[k, i // 2, j // 2] += _share(i, j, h, w) * level[k, i, j]


@compiled
def _between(place: int, size: int, coarse: int) -> tuple[int, int, Any]:
    """The two samples of ``coarse`` that interpolation to ``place`` of ``size`` mixes, and the second one's share."""
    source = (np.float32(place) + HALF) * (np.float32(coarse) / np.float32(size)) - HALF
    source = source if source > ZERO else ZERO
    first = min(int(source), coarse - 1)
    return first, min(first + 1, coarse - 1), source - np.float32(first)


@compiled
def _value(level: Any, k: int, i: int, j: int) -> Any:
    """The mean of what is known of a pixel of a level."""
    weight = level[-1, i, j]
    return level[k, i, j] / (weight if weight > _MIN_WEIGHT else _MIN_WEIGHT)


@compiled
def _sample(level: Any, k: int, rows: Any, cols: Any) -> Any:
    """One plane, linearly between four pixels."""
    r0, r1, v = rows
    c0, c1, u = cols
    above = (ONE - u) * _value(level, k, r0, c0) + u * _value(level, k, r0, c1)
    below = (ONE - u) * _value(level, k, r1, c0) + u * _value(level, k, r1, c1)
    return (ONE - v) * above + v * below


@entry
def _push(level: Any, coarse: Any) -> None:
    """Complete a level from the one above it, wherever a quarter of a pixel or less is known."""
    planes, h, w = level.shape
    for i in range(h):
        rows = _between(i, h, coarse.shape[1])
        for j in range(w):
            if level[planes - 1, i, j] <= QUARTER:
                cols = _between(j, w, coarse.shape[2])
                for k in range(planes - 1):
                    level[k, i, j] = _sample(coarse, k, rows, cols)
                level[planes - 1, i, j] = ONE


@entry
def _push_at(level: Any, shape: tuple[int, int], places: Any) -> Any:
    """The completed level above a frame, interpolated to some of the frame's pixels."""
    planes, h, w = level.shape
    result = np.empty((planes - 1, places.size), np.float32)
    for n in range(places.size):
        rows = _between(places[n] // shape[1], shape[0], h)
        cols = _between(places[n] % shape[1], shape[1], w)
        for k in range(planes - 1):
            result[k, n] = _sample(level, k, rows, cols)
    return result
