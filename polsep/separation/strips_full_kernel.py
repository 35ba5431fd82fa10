"""The strips of `separation.color_affine_kernel` at full resolution: `strips_kernel` with pixels in place of cells.

Rows of pixels come from `demosaic.bilinear_full_kernel` and `demosaic.guided_full_kernel`; what follows is the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ZERO, compiled, entry
from polsep.compute.rows_kernel import copy, fill
from polsep.compute.threads import RowRange
from polsep.demosaic import guided_full_kernel as guided
from polsep.demosaic.bilinear_full_kernel import (
    Cells,
    advance_cells,
    any_flagged,
    interpolate_analysers,
    make_cells,
    open_cells,
)
from polsep.demosaic.bilinear_kernel import Pattern, make_analysers
from polsep.demosaic.cells_kernel import Source
from polsep.separation.diffuse_polarization_kernel import first_weighed
from polsep.separation.edges_kernel import enter_light
from polsep.separation.moments_kernel import (
    KEPT,
    NOISE,
    REACH,
    Conversion,
    Rings,
    Rows,
    enter_row,
    make_rings,
    make_rows,
)
from polsep.separation.strips_kernel import Targets, pass_on

#: Cell rows of which guided rows of pixels are made at a time, before they are split.
CHUNK = 8


class Frame(NamedTuple):
    """A frame of samples and ``pixels``: its pattern with rows and columns of pixels in place of cells."""

    source: Source
    pixels: Pattern


class PixelStrip(NamedTuple):
    """A `strips_kernel.Strip` of rows of pixels."""

    start: int
    stop: int
    begin: int
    cells: Cells
    rows: Rows
    rings: Rings


@entry
def open_pixel_strip(frame: Frame, row_range: RowRange, edges: int) -> PixelStrip:
    """A strip that is to separate a range of rows of pixels; ``edges``: rows of edges to keep, `KEPT` or 0."""
    source, begin = frame.source, first_weighed(row_range[0])
    cells = make_cells(source.pattern)
    open_cells(source.samples, source.pattern, cells, max(begin - NOISE, 0) // 2)
    rows, rings = make_rows(frame.pixels), make_rings(frame.pixels.w, edges)
    return PixelStrip(row_range[0], row_range[1], begin, cells, rows, rings)


@compiled
def _read_row(frame: Frame, conversion: Conversion, y: int, strip: PixelStrip, targets: Targets) -> None:
    """Demosaic row ``y`` of pixels, put it into the rings, and note what is clipped."""
    rows, rings, cells, source = strip.rows, strip.rings, strip.cells, frame.source
    if y % 2 == 0 or y == strip.begin - NOISE:
        advance_cells(source.samples, source.pattern, cells, y // 2)
    interpolate_analysers(source.pattern, cells, cells.values, y, rows.m)
    flagged = any_flagged(cells)
    if flagged:
        interpolate_analysers(source.pattern, cells, cells.flags, y, rows.flags)
    enter_row(frame.pixels, conversion, flagged, y, rows, rings)
    if rings.edges.size:
        enter_light(frame.pixels, flagged, y, rows, rings)
    if flagged and strip.start <= y < strip.stop:
        copy(rows.clipped, targets.clipped[y])


@entry
def separate_pixels(
    frame: Frame, conversion: Conversion, targets: Targets, strip: PixelStrip, row_range: RowRange, better: Any
) -> None:
    """Separate the next rows of pixels of a strip; ``better [rows, 5, w]``: their guided Stokes rows, or empty."""
    first, h = max(strip.begin - NOISE, 0), frame.pixels.h
    for y in range(row_range[0] + REACH if row_range[0] > strip.start else strip.begin - NOISE, row_range[1] + REACH):
        if first <= y < h:
            _read_row(frame, conversion, y, strip, targets)
        elif y >= h:
            fill(ZERO, strip.rings.noise[y % 7].reshape(-1))
        pass_on(frame.pixels, conversion, targets, strip, y, better, y - REACH - row_range[0])


def separate_pixel_strip(frame: Frame, conversion: Conversion, targets: Targets, row_range: RowRange) -> None:
    """The pixels of a strip of cell rows from bilinear samples."""
    rows = (2 * row_range[0], 2 * row_range[1])
    nothing = np.empty((0, 5, frame.pixels.w), np.float32)
    separate_pixels(frame, conversion, targets, open_pixel_strip(frame, rows, 0), rows, nothing)


def separate_guided_pixel_strip(frame: Frame, conversion: Conversion, targets: Targets, row_range: RowRange) -> None:
    """The pixels of a strip of cell rows from guided Stokes rows, a few at a time."""
    places = frame.source.pattern.places
    null = conversion.null[np.argsort(2 * places[:, 0] + places[:, 1])]
    stream = guided.open_full_stream(frame.source, null, row_range[0])
    strip = open_pixel_strip(frame, (2 * row_range[0], 2 * row_range[1]), KEPT)
    better = _at_cache_line((2 * CHUNK, 5, frame.pixels.w))
    for start in range(row_range[0], row_range[1], CHUNK):
        stop = min(start + CHUNK, row_range[1])
        guided.demosaic_pixels(frame.source, stream, (start, stop), better)
        separate_pixels(frame, conversion, targets, strip, (2 * start, 2 * stop), better)


def _at_cache_line(shape: tuple[int, ...]) -> NDArray[np.float32]:
    """An array of that ``shape`` that begins at a cache line, which stores of a line's length prefer."""
    size, line = math.prod(shape), 16
    numbers = np.empty(size + line, np.float32)
    first = -(numbers.ctypes.data // 4) % line
    return numbers[first : first + size].reshape(shape)


@entry
def collect_pixels(frame: Frame, places: Any, data: Any, row_range: RowRange) -> None:
    """The bilinear analysers of some pixels of ``places [N]``, flat and ascending, into ``data [4, 3, N]``."""
    samples, pattern, _ = frame.source
    cells, m = make_cells(pattern), make_analysers(frame.pixels)
    last, newest = -1, -2
    for i in range(row_range[0], row_range[1]):
        y, x = places[i] // frame.pixels.w, places[i] % frame.pixels.w
        r = y // 2
        if r != newest:
            if r != newest + 1:
                open_cells(samples, pattern, cells, r)
            advance_cells(samples, pattern, cells, r)
            newest = r
        if y != last:
            interpolate_analysers(pattern, cells, cells.values, y, m)
            last = y
        for k in range(4):
            for c in range(3):
                data[k, c, i] = m[k, c, x]
