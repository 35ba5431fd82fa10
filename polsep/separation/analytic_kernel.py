"""Twin of ``separate_analytic(demosaic_bilinear_half(mosaic))`` in one pass over the frame, on the CPU.

Conventions are those of the twins: linear light, 1.0 = one measurement at the white level, AoLP in [0, pi) from
image-right toward image-up. Values agree to rounding (2e-6 of white), ``valid`` exactly. Rows are computed
independently of each other, so the number of threads (`set_threads`) does not change a bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, THIRD, ZERO, compiled, entry
from polsep.compute.threads import Piece, share
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
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples
from polsep.separation.images import FrameImages, Tally
from polsep.separation.images_kernel import check_images, interleave_colors
from polsep.separation.polarization_kernel import polarize

#: Least cell rows that a thread computes at a time: few enough to share the work, many enough to reuse loaded rows.
STRIP = 32


#: The images of a frame, as streams of this method name them.
AnalyticImages = FrameImages


@dataclass(frozen=True)
class AnalyticOptions:
    """What a stream of frames has in common beside its layout and levels.

    ``light_color``: one gain per channel, divided out of every sample, as in `Mosaic`. ``in_light``: multiply it back
    into diffuse and specular, as the pipeline does. ``report``: also make DoLP, AoLP and the frame's tally. ``out``:
    images to fill.
    """

    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    in_light: bool = False
    report: bool = False
    out: AnalyticImages | None = None


class _Targets(NamedTuple):
    """Images as the kernel takes them: colours ``[h, w C]``; the last three are empty when no report is wanted.

    ``sums [h, 6]``: over every row, of s0, specular, DoLP above 1, power, power along and across, as in `Tally`.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]
    sums: NDArray[np.float64]


class _Conversion(NamedTuple):
    """From analysers to Stokes vectors: ``inverse [3, 4]``, and the light's ``gains [C]`` to multiply back."""

    inverse: NDArray[np.float32]
    gains: NDArray[np.float32]


def separate_analytic_half(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: AnalyticOptions | None = None,
) -> AnalyticImages:
    """Diffuse and specular of one raw mosaic, at half resolution, by the paper's first estimate.

    ``raw``: ``[H, W]`` uint8, uint16, float32, or a `PackedFrame`; levels in its units. Images are ``[h, w, C]`` with
    h and w the whole 2x2 cells from the layout's origin on, in white light unless ``options`` say otherwise. A frame
    whose rows are not contiguous is copied first. The first call ever compiles (see `warm_up`).
    Raises ValueError on another dtype or shape, levels out of order, or images in ``options.out`` that do not fit.
    Source: Dave et al. 2022, Eqs. 15-18.
    """
    options = AnalyticOptions() if options is None else options
    samples = as_samples(raw)
    pattern = read_pattern((raw.shape[0], raw.shape[1]), layout, black_level, white_level, options.light_color)
    out = options.out
    if out is None:
        out = AnalyticImages.empty((raw.shape[0], raw.shape[1]), layout, options.report)
    targets = _as_targets(out, (pattern.h, pattern.w, pattern.channels), options.report)
    gains = options.light_color[: pattern.channels] if options.in_light else (1.0,) * pattern.channels
    conversion = _Conversion(_inverse(layout), np.array(gains, np.float32))
    share(partial(_separate_rows, samples, pattern, conversion, targets), pattern.h, STRIP)
    return replace(out, tally=_tally(out, targets.sums)) if options.report else out


@lru_cache(maxsize=8)
def _inverse(layout: Layout) -> NDArray[np.float32]:
    """The matrix ``[3, 4]`` of `fit_stokes`."""
    return stokes_inverse(layout.angles).float().numpy()


def _as_targets(out: AnalyticImages, shape: tuple[int, int, int], report: bool) -> _Targets:
    """The images of ``out``, checked. Raises ValueError on a wrong shape or dtype, gaps, or no room for a report."""
    check_images(out.arrays(), shape)
    dolp = aolp = np.empty((0, 0), np.float32)
    if report:
        if out.dolp is None or out.aolp is None:
            raise ValueError("expected room for dolp and aolp, which a report needs, found none")
        dolp, aolp = out.dolp, out.aolp
    rows, sums = (shape[0], shape[1] * shape[2]), np.zeros((dolp.shape[0], 6))
    return _Targets(out.diffuse.reshape(rows), out.specular.reshape(rows), out.valid, dolp, aolp, sums)


def _tally(out: AnalyticImages, sums: NDArray[np.float64]) -> Tally:
    """The frame's tally from its rows' sums, in one order whatever the threads."""
    s0, specular, above_one, power, along, across = (float(x) for x in sums.sum(axis=0))
    valid = int(np.count_nonzero(out.valid))
    return Tally(out.valid.size, out.valid.size - valid, valid, int(above_one), s0, specular, power, along, across)


def warm_up() -> None:
    """Compile the kernel, or load it from numba's cache on disk. One compilation serves all dtypes and layouts."""
    for layout in (Layout(), Layout(bayer=None)):
        separate_analytic_half(np.zeros((4, 4), np.uint8), layout, 0, 255, AnalyticOptions(report=True))


@compiled
def _split_row(m: Any, c: int, inverse: Any) -> None:
    """Eqs. 15-18 for colour ``c`` of a row ``m [4, C, n]``: it becomes (specular, diffuse, -, -).

    In place, because LLVM gives up on loops over so many arrays of which each might overlap each.
    """
    i00, i01, i02, i03 = inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[0, 3]
    i10, i11, i12, i13 = inverse[1, 0], inverse[1, 1], inverse[1, 2], inverse[1, 3]
    i20, i21, i22, i23 = inverse[2, 0], inverse[2, 1], inverse[2, 2], inverse[2, 3]
    m0, m1, m2, m3 = m[0, c], m[1, c], m[2, c], m[3, c]
    for j in range(m0.size):
        s0 = i00 * m0[j] + i01 * m1[j] + i02 * m2[j] + i03 * m3[j]
        s1 = i10 * m0[j] + i11 * m1[j] + i12 * m2[j] + i13 * m3[j]
        s2 = i20 * m0[j] + i21 * m1[j] + i22 * m2[j] + i23 * m3[j]
        total = s0 if s0 > ZERO else ZERO
        polarized = math.sqrt(s1 * s1 + s2 * s2)
        specular = polarized if polarized < total else total
        m0[j] = specular
        m1[j] = total - specular


@compiled
def _fit_row(m: Any, inverse: Any) -> None:
    """Stokes vectors of a row, in place: ``m [4, n]`` becomes (s0, s1, s2, -)."""
    i00, i01, i02, i03 = inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[0, 3]
    i10, i11, i12, i13 = inverse[1, 0], inverse[1, 1], inverse[1, 2], inverse[1, 3]
    i20, i21, i22, i23 = inverse[2, 0], inverse[2, 1], inverse[2, 2], inverse[2, 3]
    m0, m1, m2, m3 = m[0], m[1], m[2], m[3]
    for j in range(m0.size):
        s0 = i00 * m0[j] + i01 * m1[j] + i02 * m2[j] + i03 * m3[j]
        s1 = i10 * m0[j] + i11 * m1[j] + i12 * m2[j] + i13 * m3[j]
        s2 = i20 * m0[j] + i21 * m1[j] + i22 * m2[j] + i23 * m3[j]
        m0[j] = s0
        m1[j] = s1
        m2[j] = s2


@compiled
def _mean_color(planes: Any, mean: Any) -> None:
    """Mean over colours of ``planes [C, n]``, to ``mean [n]``."""
    if planes.shape[0] == 1:
        _scale(planes[0], ONE, mean)
    else:
        red, green, blue = planes[0], planes[1], planes[2]
        for j in range(mean.size):
            mean[j] = THIRD * (red[j] + green[j] + blue[j])


@compiled
def _polarize_row(m: Any, mean: Any, inverse: Any, r: int, targets: _Targets) -> None:
    """DoLP and AoLP of row ``r`` of analysers ``m [4, C, n]``; ``mean [4, n]`` becomes (s0, s1, s2, -)."""
    for k in range(4):
        _mean_color(m[k], mean[k])
    _fit_row(mean, inverse)
    polarize(mean[0], mean[1], mean[2], targets.dolp[r], targets.aolp[r])


@compiled
def _sum_row(m: Any, mean: Any, dolp: Any, sums: Any) -> None:
    """Sums over a row in double precision; ``m [4, C, n]`` is (specular, diffuse, -, -), ``mean`` from the above."""
    _mean_color(m[0], mean[0])
    _mean_color(m[1], mean[3])
    s, s1, s2, d = mean[0], mean[1], mean[2], mean[3]
    specular, diffuse, above_one, power, along, across = 0.0, 0.0, 0, 0.0, 0.0, 0.0
    for j in range(dolp.size):
        specular += s[j]
        diffuse += d[j]
        above_one += dolp[j] > ONE
        square = s1[j] * s1[j] + s2[j] * s2[j]
        weight = math.sqrt(square)
        power += square
        along += weight * s1[j]
        across += weight * s2[j]
    sums[0], sums[1], sums[2] = specular + diffuse, specular, above_one
    sums[3], sums[4], sums[5] = power, along, across


@compiled
def _scale(row: Any, gain: Any, image: Any) -> None:
    """The first values of ``row`` times ``gain``."""
    for j in range(image.size):
        image[j] = gain * row[j]


@compiled
def _interleave(planes: Any, gains: Any, image: Any) -> None:
    """Channels last, in the light's colour: ``planes [C, n]`` to a row ``image [w C]``."""
    if planes.shape[0] == 1:
        _scale(planes[0], gains[0], image)
    else:
        interleave_colors((planes[0], planes[1], planes[2]), gains, image)


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
    samples: Samples, pattern: Pattern, conversion: _Conversion, targets: _Targets, piece: Piece
) -> None:
    """A piece of the frame's cell rows."""
    inverse, gains = conversion.inverse, conversion.gains
    first, stop = piece
    window, m = make_window(pattern), make_analysers(pattern)
    mean = np.empty((4, m.shape[2]), np.float32)
    open_window(samples, pattern, window, first)
    for r in range(first, stop):
        flagged = advance_window(samples, pattern, window, r)
        valid = targets.valid[r]
        for j in range(valid.size):
            valid[j] = True
        if flagged:
            flag_row(pattern, window, r, m)
            _clear_flagged(m, valid)
        interpolate_row(pattern, window, r, m)
        if targets.dolp.size:
            _polarize_row(m, mean, inverse, r, targets)
        for c in range(pattern.channels):
            _split_row(m, c, inverse)
        if targets.dolp.size:
            _sum_row(m, mean, targets.dolp[r], targets.sums[r])
        _interleave(m[0], gains, targets.specular[r])
        _interleave(m[1], gains, targets.diffuse[r])
