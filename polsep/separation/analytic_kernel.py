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

from polsep.compute.compiling import THIRD, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_rows, copy
from polsep.compute.threads import RowRange, run_over_rows
from polsep.demosaic.bilinear_kernel import (
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
from polsep.separation.tally_kernel import RESIDUAL, make_tally, tally_row

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


@lru_cache(maxsize=8)
def _inverse(layout: Layout) -> NDArray[np.float32]:
    """The matrix ``[3, 4]`` of `fit_stokes`."""
    return stokes_inverse(layout.angles).float().numpy()


def warm_up() -> None:
    """Load the kernel, or compile it. One compilation serves all dtypes and layouts."""
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
