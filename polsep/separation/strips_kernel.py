"""The strips of `separation.color_affine_kernel`: compiled code from raw rows to separated rows.

A strip of cell rows runs through a line of rings (`separation.moments_kernel`): demosaicking, Stokes vectors and noise,
moments of the colours three rows later, window sums and diffuse polarization (`separation.diffuse_polarization_kernel`)
another twelve rows later. Guided Stokes rows (`demosaic.guided_kernel`), where asked for, take the place of the
bilinear ones at the end, except in pixels with clipped samples.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import THIRD, TWO, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_rows, add_up, copy
from polsep.compute.threads import RowRange
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
from polsep.demosaic.cells_kernel import Source
from polsep.physics.stokes_kernel import polarize
from polsep.sensor.unpack_kernel import Samples, read_row
from polsep.separation.closed_form_kernel import limit_specular_row, offset_row, white_specular_row
from polsep.separation.diffuse_polarization_kernel import first_weighed, fit_diffuse_polarization
from polsep.separation.edges_kernel import enter_light, measure_edges
from polsep.separation.images_kernel import interleave
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
    sum_noise,
    weigh_row,
)
from polsep.separation.tally_kernel import RESIDUAL, clear_where, tally_row

#: Guided rows that are made at a time, before they are split.
CHUNK = 64


class Targets(NamedTuple):
    """Images that the kernel fills: colours ``[h, 3 w]``; those that are not wanted are empty.

    On frames with clipped samples ``lines [4, h, w]``: a and b of p = a s0 + b, and ``clipped [h, w]``: a bit per
    analyser k and colour c, 1 << (3 k + c). For a report ``dolp``, ``aolp [h, w]`` and ``sums [h, 8]`` of unclipped
    pixels, see `tally_kernel`.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    lines: NDArray[np.float32]
    clipped: NDArray[np.uint16]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]
    sums: NDArray[np.float64]


class Strip(NamedTuple):
    """A strip on its way: rows of results ``start`` to ``stop``, from weighted moments from row ``begin`` on."""

    start: int
    stop: int
    begin: int
    window: Window
    rows: Rows
    rings: Rings


@compiled
def _split(stokes: Any, a: Any, spare: Any, planes: Any) -> None:
    """Specular and diffuse of a row, ``planes [4, w]``, by the closed form. Twin: `color_affine`."""
    mean, b1, b2, tau = spare[0], spare[1], spare[2], planes[0]
    add_rows(stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], THIRD, mean)
    offset_row(stokes[3, PAD:], a[0, PAD:], mean, b1)
    offset_row(stokes[4, PAD:], a[1, PAD:], mean, b2)
    white_specular_row(b1, b2, a[0, PAD:], a[1, PAD:], ZERO, tau)
    for c in range(3):
        limit_specular_row(stokes[c, PAD:], tau)
    for c in range(3):
        s0, diffuse = stokes[c, PAD:], planes[1 + c]
        for j in range(tau.size):
            diffuse[j] = (s0[j] if s0[j] > ZERO else ZERO) - tau[j]


@compiled
def _replace_unclipped(better: Any, clipped: Any, stokes: Any) -> None:
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
def _report(strip: Strip, t: int, clipped: Any, targets: Targets) -> None:
    """DoLP and AoLP of row ``t``, and what its unclipped pixels add to the sums."""
    rows, stokes, moments = strip.rows, strip.rings.stokes[t % 16], strip.rings.moments[t % 16]
    mean, p1, p2 = rows.spare[0], rows.spare[1], rows.spare[2]
    s1, s2, a1, a2 = (
        stokes[3, PAD:],
        stokes[4, PAD:],
        rows.diffuse_polarization[0, PAD:],
        rows.diffuse_polarization[1, PAD:],
    )
    contrast, first, second, total = moments[0, PAD:], moments[1, PAD:], moments[2, PAD:], moments[4, PAD:]
    add_rows(stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], THIRD, mean)
    polarize(mean, s1, s2, targets.dolp[t], targets.aolp[t])
    for j in range(mean.size):
        explained = (a1[j] * a1[j] + a2[j] * a2[j]) * contrast[j]
        left = total[j] - (a1[j] * first[j] + a2[j] * second[j]) * TWO + explained
        p1[j] = np.sqrt(THIRD * left) if left > ZERO else ZERO
    clear_where(clipped, p1)
    targets.sums[t, RESIDUAL] = add_up(p1)
    add_rows(rows.planes[1], rows.planes[2], rows.planes[3], THIRD, mean)
    offset_row(s1, a1, mean, p1)
    offset_row(s2, a2, mean, p2)
    tally_row(rows.planes[0], mean, p1, p2, targets.dolp[t], clipped, targets.sums[t])


@compiled
def _write_row(gains: Any, t: int, strip: Strip, better: Any, targets: Targets) -> None:
    """Write specular and diffuse of row ``t``, by its diffuse polarization; ``better``: its guided Stokes row."""
    rows, stokes = strip.rows, strip.rings.stokes[t % 16]
    clipped = targets.clipped[t] if targets.clipped.size else targets.clipped[0:0].reshape(-1)
    if better.size:
        _replace_unclipped(better, clipped, stokes)
    _split(stokes, rows.diffuse_polarization, rows.spare, rows.planes)
    interleave(rows.planes[0:1], gains, targets.specular[t])
    interleave(rows.planes[1:4], gains, targets.diffuse[t])
    if targets.lines.size:
        for i in range(2):
            copy(rows.diffuse_polarization[i, PAD:], targets.lines[i, t])
            copy(rows.spare[1 + i], targets.lines[2 + i, t])
    if targets.sums.size:
        _report(strip, t, clipped, targets)


@compiled
def _read_row(source: Source, conversion: Conversion, t: int, strip: Strip, targets: Targets) -> None:
    """Demosaic row ``t`` of the frame, put it into the rings, and note what is clipped."""
    rows, rings, pattern = strip.rows, strip.rings, source.pattern
    flagged = advance_window(source.samples, pattern, strip.window, t)
    interpolate_row(pattern, strip.window, t, rows.m)
    if flagged:
        flag_row(pattern, strip.window, t, rows.flags)
    enter_row(pattern, conversion, flagged, t, rows, rings)
    if rings.edges.size:
        enter_light(pattern, flagged, t, rows, rings)
    if flagged and strip.start <= t < strip.stop:
        copy(rows.clipped, targets.clipped[t])


@entry
def open_strip(source: Source, row_range: RowRange, edges: int) -> Strip:
    """A strip that is to separate a range of the frame's cell rows; ``edges``: rows of edges to keep, `KEPT` or 0."""
    pattern, begin = source.pattern, first_weighed(row_range[0])
    window = make_window(pattern)
    open_window(source.samples, pattern, window, max(begin - NOISE, 0))
    return Strip(row_range[0], row_range[1], begin, window, make_rows(pattern), make_rings(pattern.w, edges))


@compiled
def pass_on(
    frame: Pattern, conversion: Conversion, targets: Targets, strip: Any, t: int, better: Any, place: int
) -> None:
    """After row ``t`` has entered the rings: everything behind it, to the row that is complete now.

    ``frame``: of the images' size. ``strip``: of cells, or of pixels (`strips_full_kernel`). ``better``: guided Stokes
    rows, that of the complete row at ``place``, or empty.
    """
    rows, rings, first = strip.rows, strip.rings, max(strip.begin - NOISE, 0)
    if t - 2 > first or t - 2 == 0:
        measure_misses(frame, t - 2, rows, rings)
        if rings.edges.size:
            measure_edges(frame, t - 2, rows, rings)
    weighed, done = t - NOISE, t - REACH
    if weighed >= strip.begin:
        weigh_row(frame, weighed, rows, rings)
        if targets.sums.size and 0 <= weighed < frame.h:  # neighbouring strips write the same
            targets.sums[weighed, 7] = sum_noise(frame, rings.noise, rows.spare[0])
        fit_diffuse_polarization(frame, done, strip.start, rows, rings)
    if done >= strip.start:
        _write_row(conversion.gains, done, strip, better[place] if better.size else better[:0, 0], targets)


@entry
def separate_rows(
    source: Source, conversion: Conversion, targets: Targets, strip: Strip, row_range: RowRange, better: Any
) -> None:
    """Separate the next rows of a strip; ``better [rows, 5, w]``: their guided Stokes rows, or empty."""
    pattern, first = source.pattern, max(strip.begin - NOISE, 0)
    for t in range(row_range[0] + REACH if row_range[0] > strip.start else strip.begin - NOISE, row_range[1] + REACH):
        if first <= t < pattern.h:
            _read_row(source, conversion, t, strip, targets)
        elif t >= pattern.h:
            strip.rings.noise[t % 7] = ZERO
        pass_on(pattern, conversion, targets, strip, t, better, t - REACH - row_range[0])


def separate_strip(source: Source, conversion: Conversion, targets: Targets, row_range: RowRange) -> None:
    """A strip of the frame from bilinear samples."""
    nothing = np.empty((0, 5, source.pattern.w), np.float32)
    separate_rows(source, conversion, targets, open_strip(source, row_range, 0), row_range, nothing)


def separate_guided_strip(source: Source, conversion: Conversion, targets: Targets, row_range: RowRange) -> None:
    """A strip of the frame from guided Stokes rows, a few at a time."""
    stream, strip = guided.open_stream(source, row_range[0]), open_strip(source, row_range, KEPT)
    better = np.empty((CHUNK, 5, source.pattern.w), np.float32)
    for start in range(row_range[0], row_range[1], CHUNK):
        chunk = (start, min(start + CHUNK, row_range[1]))
        guided.demosaic_rows(source, stream, chunk, better)
        separate_rows(source, conversion, targets, strip, chunk, better)


@entry
def rows_clip(samples: Samples, pattern: Pattern, row_range: RowRange) -> bool:
    """True if any sample of these cell rows of the frame is clipped."""
    row = np.empty(2 * pattern.w, np.float32)
    for y in range(2 * row_range[0], 2 * row_range[1]):
        read_row(samples, pattern.top + y, pattern.left, row)
        if any_clipped(row, pattern.clip_at):
            return True
    return False


@entry
def collect(source: Source, places: Any, data: Any, row_range: RowRange) -> None:
    """The bilinear analysers of some pixels of ``places [N]``, flat and ascending, into ``data [4, 3, N]``."""
    samples, pattern, _ = source
    window, m = make_window(pattern), make_analysers(pattern)
    last = -2
    for i in range(row_range[0], row_range[1]):
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
