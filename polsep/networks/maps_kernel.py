"""Kernels before the network of `joint.Joint`: from raw rows to the closed form and the network's inputs.

One pass over the rows of packed pixels; ring buffers hold the rows that windows need. Names are those of `joint` and
`channels`; rows are planar, ``[..., w]``, w packed pixels. A row depends only on the frame, so the number of threads
changes no bit. `images_kernel` writes the images after the network.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, QUARTER, ZERO, compiled, entry
from polsep.compute.rows_kernel import (
    add_product,
    average,
    copy,
    emit,
    emit_bits,
    emit_product,
    fill,
    filter_rows,
    multiply,
    subtract,
    sum_three,
    weave,
)
from polsep.compute.threads import RowRange
from polsep.demosaic.bilinear_kernel import Pattern
from polsep.demosaic.cells_kernel import Source
from polsep.demosaic.guided_kernel import Stream, demosaic_rows, open_stream
from polsep.networks.buffers import ClosedFormRows, Maps, Taps
from polsep.networks.channels import MIN_BRIGHTNESS, MIN_CONTRAST, PERIOD, WINDOWS
from polsep.networks.closed_form_kernel import SUMMED, fit_residual, pool, steady_diffuse_polarization
from polsep.networks.unclip_kernel import leave_clipped_out, unclip
from polsep.sensor.unpack_kernel import Samples, read_row
from polsep.separation.closed_form_kernel import limit_specular_row, offset_row, white_specular_row

Floats = NDArray[np.float32]

#: Rows that rings keep: those from a row to the last one that it depends on.
KEPT = 8
#: Rows between the newest one and the one that is finished: brightness around, and half of the widest window.
REACH = 1 + WINDOWS[0] // 2
_WIDE, _NARROW = (window // 2 for window in WINDOWS)
_CONTRAST_WIDE, _CONTRAST_NARROW = (np.float32(least) for least in MIN_CONTRAST)
_MIN_BRIGHTNESS, _TINY = np.float32(MIN_BRIGHTNESS), np.float32(1e-12)
#: Rows of scratch, the last five of them for light that clipping hid.
_ROWS = 17


class _Rings(NamedTuple):
    """Ring buffers of rows, by row number modulo `KEPT` or `SUMMED`; ``planes`` have a column more on both sides.

    ``s0 [8, 4 C, w]``; ``cosine``, ``sine [8, 4, w]``: means over colours; ``moments [8, 4, w]``: covariances of the
    colours' s0 with s0, s1, s2, and the variance of s1, s2. ``luminance``, ``light``, ``free [8, w]``;
    ``sums [16, 3, w]``.
    ``room [channels, w]``: a row of the maps as bfloat16. ``clipped [8, w]``: as in `Maps`, also of rows that
    another thread writes there.
    """

    planes: Floats
    s0: Floats
    cosine: Floats
    sine: Floats
    moments: Floats
    luminance: Floats
    light: Floats
    free: Floats
    sums: Floats
    room: NDArray[np.uint16]
    clipped: NDArray[np.uint16]


@compiled
def _make_rings(colors: int, maps: Maps) -> _Rings:
    w = maps.closed.clipped.shape[1]
    return _Rings(
        np.zeros((KEPT, 16, w + 2), np.float32),
        np.zeros((KEPT, 4 * colors, w), np.float32),
        np.zeros((KEPT, 4, w), np.float32),
        np.zeros((KEPT, 4, w), np.float32),
        np.zeros((KEPT, 4, w), np.float32),
        np.zeros((KEPT, w + 2), np.float32),
        np.zeros((KEPT, w), np.float32),
        np.zeros((KEPT, w), np.float32),
        np.zeros((SUMMED, 3, w), np.float32),
        np.zeros((maps.halves.shape[2], w), np.uint16),
        np.zeros((KEPT, w), np.uint16),
    )


@compiled
def _enter(source: tuple[Samples, Pattern], u: int, row_range: RowRange, rings: _Rings, found: Any) -> None:
    """Samples of packed row ``u``, and which of them clip, to their rings; the latter to ``found`` too in the range."""
    samples, pattern = source
    planes, clipped = rings.planes[u % KEPT], rings.clipped[u % KEPT]
    w = clipped.size
    codes = np.empty(PERIOD * w, np.float32)
    for j in range(w):
        clipped[j] = 0
    for row in range(PERIOD):
        read_row(samples, PERIOD * u + row, 0, codes)
        some = False
        for x in range(codes.size):
            some |= codes[x] >= pattern.clip_at
        for col in range(PERIOD):
            plane, gain = planes[PERIOD * row + col], pattern.gains[row // 2, col // 2]
            inner, own = plane[1:], codes[col:]
            for j in range(w):
                inner[j] = (own[PERIOD * j] - pattern.black) * gain
            plane[0], plane[w + 1] = plane[1], plane[w]
            if some:
                for j in range(w):
                    if own[PERIOD * j] >= pattern.clip_at:
                        clipped[j] |= np.uint16(1 << (PERIOD * row + col))
    if row_range[0] <= u < row_range[1]:
        copy(clipped, found[u])


@compiled
def _starts(u: int, h: int, size: int) -> Any:
    """Starts of the rows around packed row ``u`` in a ring of rows of ``size``; the border's are repeated."""
    starts = np.empty(3, np.int64)
    for k in range(3):
        starts[k] = min(max(u - 1 + k, 0), h - 1) % KEPT * size
    return starts


@compiled
def _filter_samples(taps: Taps, u: int, h: int, rings: _Rings, polarized: Any) -> None:
    """Stokes images of row ``u`` by the linear filter: s0 to its ring, s1 and s2 to ``polarized [8 C, w]``."""
    x, starts = rings.planes.reshape(-1), _starts(u, h, rings.planes[0].size)
    s0, colors = rings.s0[u % KEPT], taps.colors
    for cell in range(4):
        for k in range(0, 3 * colors, 3):
            first, second, third = (
                _stokes_row(4 * k + cell, s0, polarized),
                _stokes_row(4 * k + 4 + cell, s0, polarized),
                _stokes_row(4 * k + 8 + cell, s0, polarized),
            )
            weight = taps.weight[cell, k : k + 3]
            filter_rows(weight, taps.row[cell], taps.place[cell], x, starts, first, second, third)


@compiled
def _filter_details(taps: Taps, u: int, h: int, rings: _Rings, work: tuple[Any, Any]) -> None:
    """Details of s0 of row ``u`` by the linear filter."""
    details, spare = work
    x, starts = rings.planes.reshape(-1), _starts(u, h, rings.planes[0].size)
    for cell in range(4):
        for k in range(0, 3 * taps.colors, 3):
            weight = taps.weight[cell, 3 * taps.colors + k : 3 * taps.colors + k + 3]
            filter_rows(weight, taps.row[cell], taps.place[cell], x, starts, spare[0], spare[1], spare[2])
            for i in range(3):
                row, out = spare[i], details[2 * u + cell // 2, k + i, cell % 2 :]
                for j in range(row.size):
                    out[2 * j] = row[j]


@compiled
def _stokes_row(k: int, s0: Any, polarized: Any) -> Any:
    """One of the rows of s0, s1 and s2."""
    return s0[k] if k < s0.shape[0] else polarized[k - s0.shape[0]]


@compiled
def _take_apart(rows: Any, s0: Any, polarized: Any) -> None:
    """Stokes rows ``[2, 9 or 18, 2 w]`` of two rows of cells as packed ones, ``[12, w]`` and ``[24, w]``."""
    for cell in range(4):
        for k in range(9):
            row, packed = rows[cell // 2, k, cell % 2 :], s0[4 * k + cell] if k < 3 else polarized[4 * (k - 3) + cell]
            for j in range(packed.size):
                packed[j] = row[2 * j]


@compiled
def _describe(colors: int, u: int, rings: _Rings, polarized: Any, spare: Any) -> None:
    """Means over colours, the colours' moments, and the brightness of row ``u``, to their rings."""
    slot = u % KEPT
    moments = rings.moments[slot]
    for k in range(4):
        fill(ZERO, moments[k])
    luminance = rings.luminance[slot]
    fill(ZERO, luminance)
    mean, x, y, s0 = spare[0], spare[1], spare[2], rings.s0[slot]
    share, count = np.float32(1 / colors), np.float32(1 / (4 * colors))
    for cell in range(4):
        fill(ZERO, mean)
        for c in range(colors):
            add_product(s0[4 * c + cell], share, mean)
        add_product(mean, QUARTER, luminance[1:-1])
        for k, means in ((0, rings.cosine[slot, cell]), (1, rings.sine[slot, cell])):
            fill(ZERO, means)
            for c in range(colors):
                add_product(polarized[4 * (colors * k + c) + cell], share, means)
        if colors == 1:
            continue
        for c in range(colors):
            subtract(s0[4 * c + cell], mean, x)
            for j in range(x.size):
                moments[0, j] += x[j] * x[j] * count
            for k, means in ((0, rings.cosine[slot, cell]), (1, rings.sine[slot, cell])):
                subtract(polarized[4 * (colors * k + c) + cell], means, y)
                multiply(x, y, count, moments[k + 1])
                multiply(y, y, count, moments[3])
    leave_clipped_out(rings.clipped[slot], s0, polarized, moments)


@compiled
def _look_around(v: int, h: int, rings: _Rings, spare: Any) -> None:
    """The light around row ``v``, whether anything there clips, and the moments relative to the light."""
    w, slot = rings.light.shape[1], v % KEPT
    total, light, free = spare[0], rings.light[slot], rings.free[slot]
    fill(ZERO, light)
    fill(ONE, free)
    first, last = max(v - 1, 0), min(v + 1, h - 1)
    for row in range(first, last + 1):
        around = rings.luminance[row % KEPT]
        sum_three(around, around[1:], around[2:], total)
        add_product(total, ONE, light)
        bits, some = rings.clipped[row % KEPT], False
        for j in range(w):
            some |= bits[j] != 0
        if some:
            for j in range(w):
                if bits[j] != 0:
                    for i in range(max(j - 1, 0), min(j + 2, w)):
                        free[i] = ZERO
    rows = np.float32(last - first + 1)
    average(light, 1, rows)
    weight = spare[1]
    for j in range(w):
        light[j] = (light[j] if light[j] > ZERO else ZERO) + _MIN_BRIGHTNESS
    for j in range(w):
        weight[j] = ONE / (light[j] * light[j])
    sums, moments = rings.sums[v % SUMMED], rings.moments[slot]
    for k, moment in ((0, 1), (1, 2), (2, 0)):
        fill(ZERO, sums[k])
        multiply(moments[moment], weight, ONE, sums[k])


@compiled
def _fit_polarization(t: int, h: int, sums: Any, spare: Any) -> None:
    """Diffuse polarization of row ``t``, wide and narrow, to ``spare[4:8]``; narrow moments stay in ``[1:4]``."""
    pooled, wide, narrow = spare[1:4], spare[4:6], spare[6:8]
    fill(ZERO, wide[0])
    fill(ZERO, wide[1])
    pool(t, h, _WIDE, sums, pooled)
    steady_diffuse_polarization(pooled, _CONTRAST_WIDE, wide[0], wide[1])
    copy(wide[0], narrow[0])
    copy(wide[1], narrow[1])
    pool(t, h, _NARROW, sums, pooled)
    steady_diffuse_polarization(pooled, _CONTRAST_NARROW, narrow[0], narrow[1])


@compiled
def _split(t: int, slot: int, rings: _Rings, closed: ClosedFormRows, spare: Any) -> None:
    """Diffuse, specular and polarization of row ``t``; ``spare[6:8]``: its diffuse polarization."""
    colors = rings.s0.shape[1] // 4
    lacking = spare[12 : 14 + colors]
    clips = colors > 1 and unclip(rings.planes[slot, :, 1:], rings.clipped[slot], spare[6:8], lacking)
    a1, a2, mean, b1, b2, share = spare[6], spare[7], spare[8], spare[9], spare[10], np.float32(1 / colors)
    for cell in range(4):
        tau, cosine, sine = closed.specular[t, cell], rings.cosine[slot, cell], rings.sine[slot, cell]
        fill(ZERO, mean)
        for c in range(colors):
            add_product(rings.s0[slot, 4 * c + cell], share, mean)
        offset_row(cosine, a1, mean, b1)
        offset_row(sine, a2, mean, b2)
        if clips:
            add_product(lacking[0], ONE, b1)
            add_product(lacking[1], ONE, b2)
            for c in range(colors):
                add_product(lacking[2 + c], ONE, rings.s0[slot, 4 * c + cell])
        white_specular_row(b1, b2, a1, a2, _TINY, tau)
        for c in range(colors):
            limit_specular_row(rings.s0[slot, 4 * c + cell], tau)
        for c in range(colors):
            subtract(rings.s0[slot, 4 * c + cell], tau, closed.diffuse[t, 4 * c + cell])
        copy(cosine, closed.s1[t, cell])
        copy(sine, closed.s2[t, cell])


@compiled
def _emit_samples(t: int, slot: int, rings: _Rings, maps: Maps, spare: Any) -> None:
    """Samples of row ``t``, relative to the brightness, and which of them clip, to their maps."""
    channels, inverse, row = maps.channels, spare[0], spare[11]
    if channels.samples >= 0:
        for k in range(16):
            emit_product(rings.planes[slot, k, 1:], inverse, maps.floats, rings.room, channels.samples + k, t, row)
    if channels.clipped >= 0:
        for k in range(16):
            emit_bits(maps.closed.clipped[t], k, maps.floats, rings.room, channels.clipped + k, t, row)
        emit(rings.free[slot], maps.floats, rings.room, channels.unclipped_around, t)


@compiled
def _emit_closed_form(t: int, rings: _Rings, maps: Maps, spare: Any) -> None:
    """The closed form of row ``t`` to its maps."""
    channels, closed, inverse, row, contrast = maps.channels, maps.closed, spare[0], spare[11], spare[3]
    for k in range(closed.diffuse.shape[1]):
        emit_product(closed.diffuse[t, k], inverse, maps.floats, rings.room, channels.diffuse + k, t, row)
    for k in range(4):
        emit_product(closed.specular[t, k], inverse, maps.floats, rings.room, channels.specular + k, t, row)
    for k in range(2):
        emit(spare[4 + k], maps.floats, rings.room, channels.wide + k, t)
        emit(spare[6 + k], maps.floats, rings.room, channels.narrow + k, t)
    for j in range(row.size):
        row[j] = np.sqrt(contrast[j] + _TINY)
    emit(row, maps.floats, rings.room, channels.contrast, t)
    emit_product(closed.fit_residual[t], inverse, maps.floats, rings.room, channels.fit_residual, t, row)


@compiled
def _finish_row(t: int, rings: _Rings, maps: Maps, spare: Any) -> None:
    """The closed form of row ``t``, and the network's maps of it."""
    slot, closed, channels = t % KEPT, maps.closed, maps.channels
    light, inverse, row = rings.light[slot], spare[0], spare[11]
    for j in range(light.size):
        inverse[j] = ONE / light[j]
    _fit_polarization(t, closed.clipped.shape[0], rings.sums, spare)
    _split(t, slot, rings, closed, spare)
    copy(light, closed.brightness[t])
    fit_residual(rings.moments[slot], spare[6], spare[7], closed.fit_residual[t])
    _emit_samples(t, slot, rings, maps, spare)
    for cell in range(4):
        if channels.cosine >= 0:
            emit_product(rings.cosine[slot, cell], inverse, maps.floats, rings.room, channels.cosine + cell, t, row)
        if channels.sine >= 0:
            emit_product(rings.sine[slot, cell], inverse, maps.floats, rings.room, channels.sine + cell, t, row)
    if channels.diffuse >= 0:
        _emit_closed_form(t, rings, maps, spare)
    for j in range(row.size):
        row[j] = np.log(light[j])
    emit(row, maps.floats, rings.room, channels.log_brightness, t)
    if maps.halves.size:
        weave(rings.room, maps.halves[t])


@compiled
def _advance(u: int, row_range: RowRange, rings: _Rings, maps: Maps, spare: Any) -> None:
    """Compute what earlier rows lacked until row ``u`` was described."""
    v, h = u - 1, maps.closed.clipped.shape[0]
    if (v > max(row_range[0] - REACH, 0) or v == 0) and v < h:
        _look_around(v, h, rings, spare)
    if u - REACH >= row_range[0]:
        _finish_row(u - REACH, rings, maps, spare)


@entry
def map_rows(samples: Samples, pattern: Pattern, taps: Taps, maps: Maps, row_range: RowRange) -> None:
    """The maps and the closed form of a range of the packed rows, by the linear filter."""
    h, w = maps.closed.clipped.shape
    rings, spare = _make_rings(taps.colors, maps), np.zeros((_ROWS, w), np.float32)
    polarized = np.empty((8 * taps.colors, w), np.float32)
    begin = max(row_range[0] - REACH, 0)
    for u in range(max(begin - 1, 0), begin + 1):
        _enter((samples, pattern), u, row_range, rings, maps.closed.clipped)
    for u in range(begin, row_range[1] + REACH):
        if u + 1 < h:
            _enter((samples, pattern), u + 1, row_range, rings, maps.closed.clipped)
        if u < h:
            _filter_samples(taps, u, h, rings, polarized)
            if maps.details.size and row_range[0] <= u < row_range[1]:
                _filter_details(taps, u, h, rings, (maps.details, spare))
            _describe(taps.colors, u, rings, polarized, spare)
        _advance(u, row_range, rings, maps, spare)


@entry
def _map_guided_rows(source: Source, stream: Stream, maps: Maps, row_range: RowRange) -> None:
    h, w = maps.closed.clipped.shape
    rings, spare, polarized = _make_rings(3, maps), np.zeros((_ROWS, w), np.float32), np.empty((24, w), np.float32)
    rows = np.empty((2, 18 if maps.details.size else 9, 2 * w), np.float32)
    for u in range(max(row_range[0] - REACH, 0), row_range[1] + REACH):
        if u < h:
            _enter((source.samples, source.pattern), u, row_range, rings, maps.closed.clipped)
            demosaic_rows(source, stream, (2 * u, 2 * u + 2), rows)
            _take_apart(rows, rings.s0[u % KEPT], polarized)
            if maps.details.size and row_range[0] <= u < row_range[1]:
                for k in range(18):
                    copy(rows[k // 9, 9 + k % 9], maps.details[2 * u + k // 9, k % 9])
            _describe(3, u, rings, polarized, spare)
        _advance(u, row_range, rings, maps, spare)


def map_guided_rows(source: Source, maps: Maps, row_range: RowRange) -> None:
    """The maps and the closed form of a range of the packed rows of a colour frame, by the intensity guide."""
    stream = open_stream(source, 2 * max(row_range[0] - REACH, 0), apart=True, details=maps.details.size > 0)
    _map_guided_rows(source, stream, maps, row_range)
