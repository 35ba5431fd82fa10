"""Twins of ``separate_analytic`` after `demosaic_bilinear_half` and `demosaic_bilinear`, in one pass over the frame.

Conventions are those of the twins: linear light, 1.0 = one measurement at the white level, AoLP in [0, pi) from
image-right toward image-up. Values agree to rounding (2e-6 of white), ``valid`` exactly. Rows are computed
independently of each other, so the number of threads (`set_threads`) does not change a bit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, THIRD, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_rows, copy
from polsep.compute.threads import RowRange, run_over_rows
from polsep.demosaic.bilinear_full_kernel import (
    Sources,
    advance_cells,
    interpolate_pixels,
    make_cells,
    make_pixels,
    open_cells,
    sources_of,
    weights_of,
)
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
from polsep.physics.stokes import stokes_inverse
from polsep.physics.stokes_kernel import fit_stokes_row, polarize
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples
from polsep.separation.images import FrameImages
from polsep.separation.images_kernel import check_images, interleave
from polsep.separation.tally_kernel import LANES, RESIDUAL, make_tally, tally_pixels, tally_row

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
    whose rows are not contiguous is copied first.
    Raises ValueError on another dtype or shape, levels out of order, or images in ``options.out`` that do not fit.
    Source: Dave et al. 2022, Eqs. 15-18.
    """
    return _separate(_separate_rows, raw, layout, (black_level, white_level), options or AnalyticOptions())


def separate_analytic_full(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: AnalyticOptions | None = None,
) -> FrameImages:
    """`separate_analytic_half` at full resolution: images ``[H, W, C]`` of all pixels of whole cells."""
    return _separate(_separate_pixels, raw, layout, (black_level, white_level), options or AnalyticOptions())


def _separate(
    run: Callable[..., None],
    raw: RawFrame,
    layout: Layout,
    levels: tuple[float, float],
    options: AnalyticOptions,
) -> FrameImages:
    """One frame by `_separate_rows` or `_separate_pixels`; ``levels``: black and white."""
    samples, shape, full = as_samples(raw), (raw.shape[0], raw.shape[1]), run is _separate_pixels
    pattern = read_pattern(shape, layout, *levels, options.light_color)
    out = FrameImages.empty(shape, layout, options.report, full) if options.out is None else options.out
    h, w = (2 * pattern.h, 2 * pattern.w) if full else (pattern.h, pattern.w)
    dolp, aolp = check_images(out, (h, w, pattern.channels), options.report)
    diffuse, specular = (image.reshape(h, w * pattern.channels) for image in (out.diffuse, out.specular))
    targets = _Targets(diffuse, specular, out.valid, dolp, aolp, np.zeros((dolp.shape[0], RESIDUAL)))
    gains = np.array(options.light_color if options.in_light else (1, 1, 1), np.float32)[: pattern.channels]
    run_over_rows(partial(run, samples, pattern, _inverse(layout), gains, targets), pattern.h, STRIP)
    if not options.report:
        return out
    valid = int(np.count_nonzero(out.valid))
    return replace(out, tally=make_tally(out.valid.size, out.valid.size - valid, valid, targets.sums))


@lru_cache(maxsize=8)
def _inverse(layout: Layout) -> NDArray[np.float32]:
    """The matrix ``[3, 4]`` of `fit_stokes`."""
    return stokes_inverse(layout.angles).astype(np.float32)


def warm_up() -> None:
    """Load the kernel, or compile it. One compilation serves all dtypes and layouts."""
    for layout in (Layout(), Layout(bayer=None)):
        separate_analytic_half(np.zeros((4, 4), np.uint8), layout, 0, 255, AnalyticOptions(report=True))


def warm_up_full() -> None:
    """`warm_up` of the kernel for full resolution."""
    for layout in (Layout(), Layout(bayer=None)):
        separate_analytic_full(np.zeros((4, 4), np.uint8), layout, 0, 255, AnalyticOptions(report=True))


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
def _as_tuples(w: Any) -> Any:
    """Weights ``[4, 3]`` as tuples, which loops keep in registers."""
    left, right = (w[0, 0], w[0, 1], w[0, 2]), (w[1, 0], w[1, 1], w[1, 2])
    return left, right, (w[2, 0], w[2, 1], w[2, 2]), (w[3, 0], w[3, 1], w[3, 2])


@compiled
def _weigh(own: Any, others: Any, x: Any, y: Any) -> Any:
    """A Stokes vector, or a part of it: ``own x + others y``."""
    return own[0] * x + others[0] * y, own[1] * x + others[1] * y, own[2] * x + others[2] * y


@compiled
def _split(s: Any, before: Any, after: Any) -> Any:
    """Specular light and s0, not below 0, of the Stokes vector that is ``s`` and the mean of its two neighbours."""
    s0, s1, s2 = s[0] + HALF * (before[0] + after[0]), s[1] + HALF * (before[1] + after[1]), s[2]
    s2 += HALF * (before[2] + after[2])
    total, polarized = s0 if s0 > ZERO else ZERO, np.sqrt(s1 * s1 + s2 * s2)
    return polarized if polarized < total else total, total


@compiled
def _split_pixels(x: Sources, weights: Any, specular: Any, total: Any) -> None:
    """`_split_row` of a row of pixels from rows of cells, all in one loop so that Stokes vectors stay in registers.

    An analyser in the left column of the cells is there at every even pixel and between two at the odd ones; one in the
    right column at every odd pixel.
    """
    n, (left, right, lefts, rights) = x.left.size // 2, weights
    a, b, c = x.left[PAD:], x.left[n + PAD :], x.left[PAD + 1 :]
    a1, b1, c1 = x.left_near[PAD:], x.left_near[n + PAD :], x.left_near[PAD + 1 :]
    a2, b2, c2 = x.left_far[PAD:], x.left_far[n + PAD :], x.left_far[PAD + 1 :]
    d, e, f = x.right[n + PAD - 1 :], x.right[PAD:], x.right[n + PAD :]
    d1, e1, f1 = x.right_near[n + PAD - 1 :], x.right_near[PAD:], x.right_near[n + PAD :]
    d2, e2, f2 = x.right_far[n + PAD - 1 :], x.right_far[PAD:], x.right_far[n + PAD :]
    for t in range(specular.size // 4):
        here, beside = _weigh(left, lefts, a[t], a1[t] + a2[t]), _weigh(left, lefts, b[t], b1[t] + b2[t])
        after = _weigh(left, lefts, c[t], c1[t] + c2[t])
        before = _weigh(right, rights, d[t], d1[t] + d2[t])
        there, last = _weigh(right, rights, e[t], e1[t] + e2[t]), _weigh(right, rights, f[t], f1[t] + f2[t])
        specular[4 * t], total[4 * t] = _split(here, before, there)
        specular[4 * t + 1], total[4 * t + 1] = _split(there, here, beside)
        specular[4 * t + 2], total[4 * t + 2] = _split(beside, there, last)
        specular[4 * t + 3], total[4 * t + 3] = _split(last, beside, after)


@compiled
def _write_difference(split: Any, gains: Any, image: Any) -> None:
    """`interleave` of s0 minus specular light, ``split [2, C, n]``."""
    (r, x), g0 = (split[0, 0], split[1, 0]), gains[0]
    if gains.size == 1:
        for j in range(image.size):
            image[j] = g0 * (x[j] - r[j])
        return
    g, y, g1 = split[0, 1], split[1, 1], gains[1]
    b, z, g2 = split[0, 2], split[1, 2], gains[2]
    for j in range(image.size // 3):
        image[3 * j] = g0 * (x[j] - r[j])
        image[3 * j + 1] = g1 * (y[j] - g[j])
        image[3 * j + 2] = g2 * (z[j] - b[j])


@entry
def _separate_pixels(
    samples: Samples, pattern: Pattern, matrix: Any, gains: Any, targets: _Targets, row_range: RowRange
) -> None:
    """`_separate_rows` at full resolution: two rows of pixels for each of the frame's cell rows, first to last."""
    cells, channels = make_cells(pattern), gains.size
    split, gray = make_pixels(pattern, 2, channels), make_pixels(pattern, 1, 3)
    weights, any_analyser = make_pixels(pattern, channels, 1), np.ones((1, 4), np.float32)
    lanes = np.empty((6, LANES), np.float32)
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
            by_source = _as_tuples(weights_of(cells.analysers, matrix, y))
            for c in range(channels):
                x = sources_of(pattern, cells.analysers, cells.values, y, c)
                _split_pixels(x, by_source, split[0, c], split[1, c])
            interleave(split[0], gains, targets.specular[y])
            _write_difference(split, gains, targets.diffuse[y])
            if targets.dolp.size:
                interpolate_pixels(pattern, cells, cells.means if channels == 3 else cells.values, matrix, y, gray)
                polarize(gray[0, 0], gray[0, 1], gray[0, 2], targets.dolp[y], targets.aolp[y])
                tally_pixels(split, gray[0], valid.size, lanes, targets.sums[y])
