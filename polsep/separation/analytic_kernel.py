"""Twin of ``separate_analytic(demosaic_bilinear_half(mosaic))`` in one pass over the frame, on the CPU.

Conventions are those of the twins: linear light, 1.0 = one measurement at the white level, AoLP in [0, pi) from
image-right toward image-up. Values agree to rounding (2e-6 of white), ``valid`` exactly. Rows are computed
independently of each other, so the number of threads (`set_threads`) does not change a bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, THIRD, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_rows, add_up, copy, fill
from polsep.compute.threads import RowRange, run_over_rows
from polsep.demosaic.bilinear_kernel import (
    PAD,
    Pattern,
    advance_window,
    flag_row,
    interpolate_row,
    make_analysers,
    make_window,
    open_window,
    read_pattern,
)
from polsep.demosaic.bilinear_full_kernel import (
    Sources,
    advance_cells,
    interpolate_pixels,
    make_cells,
    open_cells,
    pixel_buffer,
    sources_of,
    weights_of,
)
from polsep.physics.stokes import stokes_inverse
from polsep.physics.stokes_kernel import fit_stokes_row, polarize
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples
from polsep.separation.images import FrameImages
from polsep.separation.images_kernel import check_images, interleave
from polsep.separation.tally_kernel import ABOVE_ONE, RESIDUAL, S0, SPECULAR, make_tally, tally_row

#: Least cell rows that a thread computes at a time: few enough to share the work, many enough to reuse loaded rows.
STRIP = 32


@dataclass(frozen=True)
class AnalyticOptions:
    """Options that all frames of a stream share, besides layout and levels.

    ``light_color``: one gain per channel, divided out of every sample, as in `Mosaic`. ``in_light``: multiply it back
    into diffuse and specular, as the pipeline does. ``report``: also make DoLP, AoLP and the frame's tally. ``out``:
    images to fill.
    """

    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    in_light: bool = False
    report: bool = False
    out: FrameImages | None = None


class _Targets(NamedTuple):
    """Images as the kernel fills them: colours ``[h, w C]``; the last three are empty when no report is wanted.

    ``sums [h, 6]``: over every row, see `tally_kernel`.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]
    sums: NDArray[np.float64]


def separate_analytic_half(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: AnalyticOptions | None = None,
) -> FrameImages:
    """Diffuse and specular of one raw mosaic, at half resolution, by the paper's first estimate.

    ``raw``: ``[H, W]`` uint8, uint16, float32, or a `PackedFrame`; levels in its units. Images are ``[h, w, C]`` with
    h and w the whole 2x2 cells from the layout's origin on, in white light unless ``options`` say otherwise. A frame
    whose rows are not contiguous is copied first. The first call ever compiles (see `warm_up`).
    Raises ValueError on another dtype or shape, levels out of order, or images in ``options.out`` that do not fit.
    Source: Dave et al. 2022, Eqs. 15-18.
    """
    options = AnalyticOptions() if options is None else options
    samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
    pattern = read_pattern(shape, layout, black_level, white_level, options.light_color)
    out = FrameImages.empty(shape, layout, options.report) if options.out is None else options.out
    dolp, aolp = check_images(out, (pattern.h, pattern.w, pattern.channels), options.report)
    rows, sums = (pattern.h, pattern.w * pattern.channels), np.zeros((dolp.shape[0], RESIDUAL))
    targets = _Targets(out.diffuse.reshape(rows), out.specular.reshape(rows), out.valid, dolp, aolp, sums)
    gains = np.array(options.light_color if options.in_light else (1, 1, 1), np.float32)[: pattern.channels]
    run_over_rows(partial(_separate_rows, samples, pattern, _inverse(layout), gains, targets), pattern.h, STRIP)
    if not options.report:
        return out
    valid = int(np.count_nonzero(out.valid))
    return replace(out, tally=make_tally(out.valid.size, out.valid.size - valid, valid, sums))


def separate_analytic_full(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: AnalyticOptions | None = None,
) -> FrameImages:
    """`separate_analytic_half` at full resolution: images are ``[H, W, C]``, H and W the pixels of all whole cells.

    The twin of ``separate_analytic(demosaic_bilinear(mosaic))``. A tenth to a half of the frame rate at half resolution.
    """
    options = AnalyticOptions() if options is None else options
    samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
    pattern = read_pattern(shape, layout, black_level, white_level, options.light_color)
    out = FrameImages.empty_full(shape, layout, options.report) if options.out is None else options.out
    dolp, aolp = check_images(out, (2 * pattern.h, 2 * pattern.w, pattern.channels), options.report)
    rows, sums = (2 * pattern.h, 2 * pattern.w * pattern.channels), np.zeros((dolp.shape[0], RESIDUAL))
    targets = _Targets(out.diffuse.reshape(rows), out.specular.reshape(rows), out.valid, dolp, aolp, sums)
    gains = np.array(options.light_color if options.in_light else (1, 1, 1), np.float32)[: pattern.channels]
    run_over_rows(partial(_separate_pixels, samples, pattern, _inverse(layout), gains, targets), pattern.h, STRIP)
    if not options.report:
        return out
    valid = int(np.count_nonzero(out.valid))
    return replace(out, tally=make_tally(out.valid.size, out.valid.size - valid, valid, sums))


@lru_cache(maxsize=8)
def _inverse(layout: Layout) -> NDArray[np.float32]:
    """The matrix ``[3, 4]`` of `fit_stokes`."""
    return stokes_inverse(layout.angles).float().numpy()


def warm_up() -> None:
    """Compile the kernel, or load it from numba's cache on disk. One compilation serves all dtypes and layouts."""
    for layout in (Layout(), Layout(bayer=None)):
        separate_analytic_half(np.zeros((4, 4), np.uint8), layout, 0, 255, AnalyticOptions(report=True))


@compiled
def _split_row(s: Any, specular: Any, diffuse: Any) -> None:
    """Eqs. 16-18 for one colour of a row of Stokes vectors ``s [3, n]``. Twin: `analytic.separate_analytic`."""
    s0, s1, s2 = s[0], s[1], s[2]
    for j in range(specular.size):
        total = s0[j] if s0[j] > ZERO else ZERO
        polarized = np.sqrt(s1[j] * s1[j] + s2[j] * s2[j])
        specular[j] = polarized if polarized < total else total
        diffuse[j] = total - specular[j]


@compiled
def _mean_color(planes: Any, mean: Any) -> None:
    """Mean over colours of ``planes [C, n]``, to ``mean [n]``."""
    if planes.shape[0] == 1:
        copy(planes[0], mean)
    else:
        add_rows(planes[0], planes[1], planes[2], THIRD, mean)


@compiled
def _clear_flagged(flags: Any, valid: Any) -> None:
    """False wherever one of ``flags [4, C, n]`` is above 0; True stays only where it was."""
    for k in range(flags.shape[0]):
        for c in range(flags.shape[1]):
            row = flags[k, c]
            for j in range(valid.size):
                valid[j] &= row[j] == ZERO


@entry
def _separate_rows(
    samples: Samples, pattern: Pattern, inverse: Any, gains: Any, targets: _Targets, row_range: RowRange
) -> None:
    """Some of the frame's cell rows, first to last; every thread calls it for others."""
    window, m = make_window(pattern), make_analysers(pattern)
    n = m.shape[2]
    mean, s, split = (
        np.empty((4, 1, n), np.float32),
        np.empty((3, n), np.float32),
        np.empty((2, gains.size, n), np.float32),
    )
    none_skipped = np.empty(0, np.uint16)
    open_window(samples, pattern, window, row_range[0])
    for r in range(row_range[0], row_range[1]):
        flagged = advance_window(samples, pattern, window, r)
        valid = targets.valid[r]
        for j in range(valid.size):
            valid[j] = True
        if flagged:
            flag_row(pattern, window, r, m)
            _clear_flagged(m, valid)
        interpolate_row(pattern, window, r, m)
        for c in range(gains.size):
            fit_stokes_row(m, c, inverse, s[0], s[1], s[2])
            _split_row(s, split[0, c], split[1, c])
        interleave(split[0], gains, targets.specular[r])
        interleave(split[1], gains, targets.diffuse[r])
        if targets.dolp.size:
            for k in range(4):
                _mean_color(m[k], mean[k, 0])
            fit_stokes_row(mean, 0, inverse, s[0], s[1], s[2])
            polarize(s[0], s[1], s[2], targets.dolp[r], targets.aolp[r])
            w, specular, diffuse = valid.size, mean[0, 0], mean[1, 0]
            _mean_color(split[0], specular)
            _mean_color(split[1], diffuse)
            tally_row(specular[:w], diffuse[:w], s[1, :w], s[2, :w], targets.dolp[r], none_skipped, targets.sums[r])


@compiled
def _split(s0: Any, s1: Any, s2: Any) -> Any:
    """Specular light and s0, not below 0, of one pixel."""
    total = s0 if s0 > ZERO else ZERO
    polarized = np.sqrt(s1 * s1 + s2 * s2)
    return polarized if polarized < total else total, total


@compiled
def _split_pixels(x: Sources, weights: Any, specular: Any, total: Any) -> None:
    """`_split_row` of a row of pixels from rows of cells: one loop, in which Stokes vectors stay in registers."""
    n = x.left.size // 2
    le, lo, ln = x.left[PAD:], x.left[n + PAD :], x.left[PAD + 1 :]
    rl, re, ro = x.right[n + PAD - 1 :], x.right[PAD:], x.right[n + PAD :]
    ye, yo, yn = x.left_near[PAD:], x.left_near[n + PAD :], x.left_near[PAD + 1 :]
    ze, zo, zn = x.left_far[PAD:], x.left_far[n + PAD :], x.left_far[PAD + 1 :]
    ul, ue, uo = x.right_near[n + PAD - 1 :], x.right_near[PAD:], x.right_near[n + PAD :]
    vl, ve, vo = x.right_far[n + PAD - 1 :], x.right_far[PAD:], x.right_far[n + PAD :]
    l0, l1, l2 = weights[0, 0], weights[0, 1], weights[0, 2]
    r0, r1, r2 = weights[1, 0], weights[1, 1], weights[1, 2]
    m0, m1, m2 = weights[2, 0], weights[2, 1], weights[2, 2]
    q0, q1, q2 = weights[3, 0], weights[3, 1], weights[3, 2]
    for t in range(specular.size // 4):
        left, left_odd, left_next = le[t], lo[t], ln[t]
        other, other_odd, other_next = ye[t] + ze[t], yo[t] + zo[t], yn[t] + zn[t]
        right_last, right, right_odd = rl[t], re[t], ro[t]
        far_last, far, far_odd = ul[t] + vl[t], ue[t] + ve[t], uo[t] + vo[t]
        # sums over the left analysers at even and odd cells and the next even one, and the right ones' from the last on
        a0, a1, a2 = l0 * left + m0 * other, l1 * left + m1 * other, l2 * left + m2 * other
        b0, b1, b2 = l0 * left_odd + m0 * other_odd, l1 * left_odd + m1 * other_odd, l2 * left_odd + m2 * other_odd
        c0, c1, c2 = r0 * right + q0 * far, r1 * right + q1 * far, r2 * right + q2 * far
        d0, d1, d2 = r0 * right_odd + q0 * far_odd, r1 * right_odd + q1 * far_odd, r2 * right_odd + q2 * far_odd
        e0, e1, e2 = l0 * left_next + m0 * other_next, l1 * left_next + m1 * other_next, l2 * left_next + m2 * other_next
        f0, f1, f2 = r0 * right_last + q0 * far_last, r1 * right_last + q1 * far_last, r2 * right_last + q2 * far_last
        specular[4 * t], total[4 * t] = _split(a0 + HALF * (f0 + c0), a1 + HALF * (f1 + c1), a2 + HALF * (f2 + c2))
        specular[4 * t + 1], total[4 * t + 1] = _split(
            HALF * (a0 + b0) + c0, HALF * (a1 + b1) + c1, HALF * (a2 + b2) + c2
        )
        specular[4 * t + 2], total[4 * t + 2] = _split(
            b0 + HALF * (c0 + d0), b1 + HALF * (c1 + d1), b2 + HALF * (c2 + d2)
        )
        specular[4 * t + 3], total[4 * t + 3] = _split(
            HALF * (b0 + e0) + d0, HALF * (b1 + e1) + d1, HALF * (b2 + e2) + d2
        )


@compiled
def _clear_rest(planes: Any, size: int) -> None:
    """0 in all ``planes [K, n]`` behind the first ``size`` numbers."""
    for k in range(planes.shape[0]):
        for j in range(size, planes.shape[1]):
            planes[k, j] = ZERO


@compiled
def _add_products(gray: Any, sums: Any) -> None:
    """Add what `tally_kernel` sums of a row of Stokes vectors ``gray [3, n]`` to ``sums [4, L]``, L pixels at a time."""
    above, power, along, across = sums[0], sums[1], sums[2], sums[3]
    for first in range(0, gray.shape[1], sums.shape[1]):
        s0, s1, s2 = gray[0, first:], gray[1, first:], gray[2, first:]
        for j in range(above.size):
            squared = s1[j] * s1[j] + s2[j] * s2[j]
            size = np.sqrt(squared)
            above[j] += ONE if size > s0[j] and s0[j] > ZERO else ZERO
            power[j] += squared
            along[j] += size * s1[j]
            across[j] += size * s2[j]


@compiled
def _add_colors(planes: Any, sums: Any) -> None:
    """Add the mean over ``planes [C, n]`` to ``sums [L]``, L pixels at a time."""
    share, last = ONE / np.float32(planes.shape[0]), planes.shape[0] - 1
    for first in range(0, planes.shape[1], sums.size):
        x, y, z = planes[0, first:], planes[last // 2, first:], planes[last, first:]
        for j in range(sums.size):
            sums[j] += share * (x[j] + (y[j] + z[j] if last else ZERO))


@compiled
def _tally_pixels(split: Any, gray: Any, size: int, lanes: Any, sums: Any) -> None:
    """`tally_row` of a row of ``size`` pixels; ``lanes [6, L]``: a buffer whose length divides that of the rows."""
    for k in range(2):
        _clear_rest(split[k], size)
    _clear_rest(gray, size)
    for k in range(6):
        fill(ZERO, lanes[k])
    _add_colors(split[0], lanes[SPECULAR])
    _add_colors(split[1], lanes[S0])
    _add_products(gray, lanes[ABOVE_ONE:])
    for k in range(6):
        sums[k] = add_up(lanes[k])


@compiled
def _write_difference(split: Any, gains: Any, image: Any) -> None:
    """`interleave` of s0 minus specular light, ``split [2, C, n]``."""
    last = gains.size - 1
    r, g, b, x, y, z = split[0, 0], split[0, last // 2], split[0, last], split[1, 0], split[1, last // 2], split[1, last]
    g0, g1, g2 = gains[0], gains[last // 2], gains[last]
    if last == 0:
        for j in range(image.size):
            image[j] = g0 * (x[j] - r[j])
        return
    for j in range(image.size // 3):
        image[3 * j] = g0 * (x[j] - r[j])
        image[3 * j + 1] = g1 * (y[j] - g[j])
        image[3 * j + 2] = g2 * (z[j] - b[j])


@entry
def _separate_pixels(
    samples: Samples, pattern: Pattern, matrix: Any, gains: Any, targets: _Targets, row_range: RowRange
) -> None:
    """`_separate_rows` at full resolution: two rows of pixels for each of the frame's cell rows, first to last."""
    cells, n, channels = make_cells(pattern), pixel_buffer(pattern), gains.size
    split, lanes = np.zeros((2, channels, n), np.float32), np.empty((6, 2 * PAD), np.float32)
    gray, weights, any_analyser = np.zeros((1, 3, n), np.float32), np.empty((channels, 1, n), np.float32), np.ones((1, 4), np.float32)
    open_cells(samples, pattern, cells, row_range[0])
    for r in range(row_range[0], row_range[1]):
        flagged = advance_cells(samples, pattern, cells, r)
        for y in range(2 * r, 2 * r + 2):
            valid = targets.valid[y]
            for j in range(valid.size):
                valid[j] = True
            if flagged:
                interpolate_pixels(pattern, cells, cells.flags, any_analyser, y, weights)
                _clear_flagged(weights, valid)
            of_sources = weights_of(cells.analysers, matrix, y)
            for c in range(channels):
                _split_pixels(sources_of(pattern, cells.analysers, cells.values, y, c), of_sources, split[0, c], split[1, c])
            interleave(split[0], gains, targets.specular[y])
            _write_difference(split, gains, targets.diffuse[y])
            if targets.dolp.size:
                interpolate_pixels(pattern, cells, cells.means if channels == 3 else cells.values, matrix, y, gray)
                polarize(gray[0, 0], gray[0, 1], gray[0, 2], targets.dolp[y], targets.aolp[y])
                _tally_pixels(split, gray[0], valid.size, lanes, targets.sums[y])
