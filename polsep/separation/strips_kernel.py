"""The strips of `separation.color_affine_kernel`: compiled code from raw rows to separated rows.

A strip of cell rows runs through a line of rings (`separation.moments_kernel`): demosaicking, Stokes vectors and noise,
moments of the colours three rows later, window sums and the slope (`separation.diffuse_polarization_kernel`) another
twelve rows later. Guided Stokes rows (`demosaic.guided_kernel`), where asked for, take the place of the bilinear ones
at the end, except in pixels with clipped samples.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, THIRD, ZERO, compiled, entry
from polsep.compute.threads import Piece
from polsep.demosaic import guided_kernel as guided
from polsep.demosaic.bilinear_kernel import (
    PAD,
    Pattern,
    Window,
    advance_window,
    any_clipped,
    flag_row,
    interpolate_row,
    make_analysers,
    make_window,
    open_window,
)
from polsep.demosaic.cells_kernel import Source, add_rows
from polsep.sensor.unpack_kernel import Samples, read_row
from polsep.separation.diffuse_polarization_kernel import find_slope, first_weighed
from polsep.separation.edges_kernel import enter_light, measure_edges
from polsep.separation.images_kernel import interleave_colors
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
    measure_misses,
    measure_spread,
    sum_noise,
    weigh_row,
)
from polsep.separation.polarization_kernel import add_polarization, polarize, sum_row

#: Guided rows that are made at a time, before they are split.
CHUNK = 64

#: Columns of ``sums``: s0, specular, DoLP above 1, power, power along and across, residual, noise.
SUMS = 8


class Targets(NamedTuple):
    """What the kernel fills: colours ``[h, 3 w]``. What is not asked for is empty.

    ``lines [4, h, w]``, slope and offset, and ``clipped [h, w]``, one bit per analyser and colour, 1 << (3 k + c), on
    frames with clipped samples. ``dolp``, ``aolp [h, w]`` and ``sums [h, 8]``, of unclipped pixels, for a report.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    lines: NDArray[np.float32]
    clipped: NDArray[np.uint16]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]
    sums: NDArray[np.float64]


class Frame(NamedTuple):
    """A frame and how it is converted."""

    source: Source
    conversion: Conversion


class Strip(NamedTuple):
    """A strip on its way: rows of results ``start`` to ``stop``, from weighted moments from row ``begin`` on."""

    start: int
    stop: int
    begin: int
    window: Window
    rows: Rows
    rings: Rings


@compiled
def _split(stokes: Any, slope: Any, planes: Any) -> None:
    """Specular and diffuse of a row, ``planes [4, n]``."""
    r, g, b, m1, m2 = stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], stokes[3, PAD:], stokes[4, PAD:]
    a1, a2 = slope[0, PAD:], slope[1, PAD:]
    tau, d0, d1, d2 = planes[0], planes[1], planes[2], planes[3]
    for j in range(tau.size):
        x, y, z = r[j] if r[j] > ZERO else ZERO, g[j] if g[j] > ZERO else ZERO, b[j] if b[j] > ZERO else ZERO
        mean = THIRD * (r[j] + g[j] + b[j])
        b1, b2 = m1[j] - a1[j] * mean, m2[j] - a2[j] * mean
        ba, bb = b1 * a1[j] + b2 * a2[j], b1 * b1 + b2 * b2
        rest = ONE - (a1[j] * a1[j] + a2[j] * a2[j])
        specular = (ba + np.sqrt(ba * ba + rest * bb)) / rest
        specular = specular if specular < x else x
        specular = specular if specular < y else y
        specular = specular if specular < z else z
        tau[j] = specular
        d0[j] = x - specular
        d1[j] = y - specular
        d2[j] = z - specular


@compiled
def _take_better(better: Any, clipped: Any, stokes: Any) -> None:
    """Guided Stokes values in place of a row's bilinear ones, except in ``clipped`` pixels."""
    for k in range(5):
        x, out = better[k], stokes[k, PAD:]
        if clipped.size:
            for j in range(x.size):
                out[j] = x[j] if clipped[j] == 0 else out[j]
        else:
            for j in range(x.size):
                out[j] = x[j]


@compiled
def _keep_lines(stokes: Any, slope: Any, lines: Any) -> None:
    """Slope and offset of a row, ``lines [4, w]``."""
    for j in range(lines.shape[1]):
        x = PAD + j
        mean = THIRD * (stokes[0, x] + stokes[1, x] + stokes[2, x])
        for i in range(2):
            lines[i, j] = slope[i, x]
            lines[2 + i, j] = stokes[3 + i, x] - slope[i, x] * mean


@compiled
def _report(strip: Strip, t: int, clipped: Any, targets: Targets) -> None:
    """DoLP and AoLP of row ``t``, and what its unclipped pixels add to the sums."""
    rows, stokes = strip.rows, strip.rings.stokes[t % 16]
    mean, p1, p2 = rows.spare[0], rows.spare[1], rows.spare[2]
    dolp, sums = targets.dolp[t], targets.sums[t]
    add_rows(stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], THIRD, mean)
    s1, s2 = stokes[3, PAD:], stokes[4, PAD:]
    polarize(mean, s1, s2, dolp, targets.aolp[t])
    for j in range(dolp.size):
        p1[j] = ONE if dolp[j] > ONE else ZERO
    sums[2] = sum_row(p1, clipped)
    add_rows(rows.planes[1], rows.planes[2], rows.planes[3], THIRD, mean)
    a1, a2 = rows.slope[0, PAD:], rows.slope[1, PAD:]
    for j in range(mean.size):
        p1[j] = s1[j] - a1[j] * mean[j]
        p2[j] = s2[j] - a2[j] * mean[j]
    add_polarization(p1, p2, clipped, sums[3:6])
    sums[1] = sum_row(rows.planes[0], clipped)
    sums[0] = sums[1] + sum_row(mean, clipped)
    spread = strip.rings.spread[t % 16]
    contrast, first, second, total = spread[0, PAD:], spread[1, PAD:], spread[2, PAD:], spread[3, PAD:]
    for j in range(mean.size):
        explained = (a1[j] * a1[j] + a2[j] * a2[j]) * contrast[j]
        left = total[j] - (a1[j] * first[j] + a2[j] * second[j]) * np.float32(2) + explained
        p1[j] = np.sqrt(THIRD * left) if left > ZERO else ZERO
    sums[6] = sum_row(p1, clipped)


@compiled
def _leave(gains: Any, t: int, strip: Strip, better: Any, targets: Targets) -> None:
    """Specular and diffuse of row ``t``, whose slope is found, to the images; ``better``: its guided Stokes row."""
    rows, stokes = strip.rows, strip.rings.stokes[t % 16]
    clipped = targets.clipped[t] if targets.clipped.size else targets.clipped[0:0].reshape(-1)
    if better.size:
        _take_better(better, clipped, stokes)
    _split(stokes, rows.slope, rows.planes)
    tau, d0, d1, d2 = rows.planes[0], rows.planes[1], rows.planes[2], rows.planes[3]
    interleave_colors((tau, tau, tau), gains, targets.specular[t])
    interleave_colors((d0, d1, d2), gains, targets.diffuse[t])
    if targets.lines.size:
        _keep_lines(stokes, rows.slope, targets.lines[:, t])
    if targets.sums.size:
        _report(strip, t, clipped, targets)


@compiled
def _enter(frame: Frame, t: int, strip: Strip, targets: Targets) -> None:
    """Demosaic row ``t`` of the frame, put it into the rings, and note what is clipped."""
    rows, pattern, scratch = strip.rows, frame.source.pattern, (strip.rows, strip.rings)
    flagged = advance_window(frame.source.samples, pattern, strip.window, t)
    interpolate_row(pattern, strip.window, t, rows.m)
    if flagged:
        flag_row(pattern, strip.window, t, rows.flags)
    enter_row(pattern, frame.conversion, flagged, t, scratch)
    if strip.rings.edges.size:
        enter_light(pattern, flagged, t, scratch)
    if targets.sums.size:
        measure_spread(pattern, t, scratch)
    if flagged and strip.start <= t < strip.stop:
        for j in range(pattern.w):
            targets.clipped[t, j] = rows.clipped[j]


@compiled
def _weigh(frame: Frame, t: int, strip: Strip, targets: Targets) -> None:
    """Weighted moments of row ``t``, and its noise to the sums, for which neighbouring strips find the same."""
    pattern = frame.source.pattern
    weigh_row(pattern, t, (strip.rows, strip.rings))
    if targets.sums.size and 0 <= t < pattern.h:
        targets.sums[t, 7] = sum_noise(pattern, strip.rings.noise)


@entry
def open_strip(frame: Frame, piece: Piece, edges: int) -> Strip:
    """A strip that is to separate a piece of the frame's cell rows; ``edges``: rows of edges to keep, `KEPT` or 0."""
    pattern, begin = frame.source.pattern, first_weighed(piece[0])
    window = make_window(pattern)
    open_window(frame.source.samples, pattern, window, max(begin - NOISE, 0))
    return Strip(piece[0], piece[1], begin, window, make_rows(pattern), make_rings(pattern.w, edges))


@entry
def separate_rows(frame: Frame, targets: Targets, strip: Strip, piece: Piece, better: Any) -> None:
    """The next rows of a strip; ``better [rows, 5, w]``: their guided Stokes rows, or empty."""
    pattern, scratch = frame.source.pattern, (strip.rows, strip.rings)
    first = max(strip.begin - NOISE, 0)
    for t in range(piece[0] + REACH if piece[0] > strip.start else strip.begin - NOISE, piece[1] + REACH):
        if first <= t < pattern.h:
            _enter(frame, t, strip, targets)
        elif t >= pattern.h:
            strip.rings.noise[t % 7] = ZERO
        if t - 2 > first or t - 2 == 0:
            measure_misses(pattern, t - 2, scratch)
            if strip.rings.edges.size:
                measure_edges(pattern, t - 2, scratch)
        if t - NOISE >= strip.begin:
            _weigh(frame, t - NOISE, strip, targets)
            find_slope(pattern, t - REACH, strip.start, scratch)
        if t - REACH >= strip.start:
            r = t - REACH
            _leave(frame.conversion.gains, r, strip, better[r - piece[0]] if better.size else better[:0, 0], targets)


def separate_piece(frame: Frame, targets: Targets, piece: Piece) -> None:
    """A strip of the frame from bilinear samples."""
    nothing = np.empty((0, 5, frame.source.pattern.w), np.float32)
    separate_rows(frame, targets, open_strip(frame, piece, 0), piece, nothing)


def separate_guided_piece(frame: Frame, targets: Targets, piece: Piece) -> None:
    """A strip of the frame from guided Stokes rows, a few at a time."""
    stream, strip = guided.open_stream(frame.source, piece[0]), open_strip(frame, piece, KEPT)
    better = np.empty((CHUNK, 5, frame.source.pattern.w), np.float32)
    for start in range(piece[0], piece[1], CHUNK):
        chunk = (start, min(start + CHUNK, piece[1]))
        guided.demosaic_rows(frame.source, stream, chunk, better)
        separate_rows(frame, targets, strip, chunk, better)


@entry
def rows_clip(samples: Samples, pattern: Pattern, piece: Piece) -> bool:
    """Whether any sample of a piece of the frame's cell rows is clipped."""
    row = np.empty(2 * pattern.w, np.float32)
    for y in range(2 * piece[0], 2 * piece[1]):
        read_row(samples, pattern.top + y, pattern.left, row)
        if any_clipped(row, pattern.clip_at):
            return True
    return False


@entry
def collect(source: Source, places: Any, data: Any, piece: Piece) -> None:
    """The bilinear analysers of some pixels of ``places [N]``, flat and ascending, into ``data [4, 3, N]``."""
    samples, pattern, _ = source
    window, m = make_window(pattern), make_analysers(pattern)
    last = -2
    for i in range(piece[0], piece[1]):
        r, j = places[i] // pattern.w, places[i] % pattern.w
        if r != last:
            if r != last + 1:
                open_window(samples, pattern, window, r)
            advance_window(samples, pattern, window, r)
            interpolate_row(pattern, window, r, m)
            last = r
        for k in range(4):
            for c in range(3):
                data[k, c, i] = m[k, c, j]


@entry
def find_clipped(clipped: Any) -> Any:
    """The flat places of the pixels of ``clipped [h, w]`` that are not 0, ascending."""
    flat = clipped.reshape(-1)
    count = 0
    for n in range(flat.size):
        count += flat[n] != 0
    places = np.empty(count, np.int64)
    count = 0
    for n in range(flat.size):
        if flat[n] != 0:
            places[count] = n
            count += 1
    return places
