"""Twin of ``separate_color_affine(demosaic_bilinear_half(mosaic))`` in one pass over the frame, on the CPU.

A strip of cell rows runs through a line of rings (`kernels.moments`): demosaicking, Stokes vectors and noise, moments
of the colours three rows later, window sums and the slope (`kernels.slope`) another twelve rows later.

Pixels with clipped samples are few: the kernel leaves them out of the slope as the twin does, and the twin's own torch
functions solve and fill them afterwards. Note: in a forked child, torch needs ``torch.set_num_threads(1)`` first if it
has used several threads in the parent; only clipped frames need torch.

Strips are computed independently of each other and their height is fixed, so the number of threads (`set_threads`)
does not change a bit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep import color_affine as twin
from polsep.camera import Layout
from polsep.kernels.bilinear import (
    PAD,
    Pattern,
    advance_window,
    any_clipped,
    flag_row,
    interpolate_row,
    make_analysers,
    make_window,
    open_window,
    read_pattern,
)
from polsep.kernels.compiling import ONE, THIRD, ZERO, compiled, entry
from polsep.kernels.images import check_images, interleave_colors
from polsep.kernels.moments import (
    NOISE,
    REACH,
    WIDEST,
    Conversion,
    Rings,
    Rows,
    enter_row,
    make_rings,
    make_rows,
    measure_misses,
    weigh_row,
)
from polsep.kernels.slope import find_slope
from polsep.kernels.threads import Piece, share
from polsep.kernels.unpack import RawFrame, Samples, as_samples, read_row
from polsep.separation import Separation
from polsep.stokes import Measurements, analyser_residual, fit_stokes_unclipped, stokes_inverse, unclipped_inverse

#: Cell rows of a strip; each also computes the moments of `REACH` rows above and below.
STRIP = 128


@dataclass(frozen=True)
class ColorAffineImages:
    """The separated frame, channels last; also the room that a stream gives to be filled again and again.

    ``diffuse``, ``specular``: float32 ``[h, w, 3]``, ``valid``: bool ``[h, w]``, as in `Separation`.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]

    @classmethod
    def empty(cls, shape: tuple[int, int], layout: Layout) -> ColorAffineImages:
        """Room for mosaics of that ``shape`` (H, W)."""
        h, w = ((n - start) // 2 for n, start in zip(shape, layout.origin, strict=True))
        return cls(np.empty((h, w, 3), np.float32), np.empty((h, w, 3), np.float32), np.empty((h, w), np.bool_))


@dataclass(frozen=True)
class ColorAffineOptions:
    """What a stream of frames has in common beside its layout and levels.

    ``light_color``: one gain per channel, divided out of every sample, as in `Mosaic`. ``in_light``: multiply it back
    into the results, as the pipeline does. ``out``: images to fill.
    """

    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    in_light: bool = False
    out: ColorAffineImages | None = None


class _Targets(NamedTuple):
    """What the kernel fills: colours ``[h, 3 w]``. On frames without clipped samples the last two are empty.

    ``lines [4, h, w]``: slope and offset. ``clipped [h, w]``: one bit per analyser and colour, 1 << (3 k + c).
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    lines: NDArray[np.float32]
    clipped: NDArray[np.uint16]


def separate_color_affine_half(
    raw: RawFrame,
    layout: Layout,
    black_level: float,
    white_level: float,
    options: ColorAffineOptions | None = None,
) -> ColorAffineImages:
    """Diffuse and white specular of one raw colour mosaic, at half resolution, by the colour-affine closed form.

    ``raw``: ``[H, W]`` uint8, uint16, float32, or a `PackedFrame`; levels in its units. Images are ``[h, w, 3]`` with
    h and w the whole 2x2 cells from the layout's origin on, in white light unless ``options`` say otherwise. Pixels
    with clipped samples are solved, and where too few are left filled, by `polsep.color_affine` in torch; filling
    takes pyramids over the whole frame. Raises ValueError on a mono layout, another dtype or shape, levels out of
    order, or images in ``options.out`` that do not fit.
    """
    options = ColorAffineOptions() if options is None else options
    if layout.channels != 3:
        raise ValueError(f"expected a colour layout, found {layout.spec!r}; mono frames have separate_analytic_half")
    samples = as_samples(raw)
    pattern = read_pattern((raw.shape[0], raw.shape[1]), layout, black_level, white_level, options.light_color)
    shape = (pattern.h, pattern.w)
    out = options.out
    if out is None:
        out = ColorAffineImages.empty((raw.shape[0], raw.shape[1]), layout)
    check_images(vars(out), (*shape, 3))
    gains = np.array(options.light_color[:3] if options.in_light else (1, 1, 1), np.float32)
    clips = any(share(partial(_rows_clip, samples, pattern), pattern.h, STRIP))
    # Filling compares colours with each other, so with clipped samples the light waits until it is done.
    conversion = Conversion(*_matrices(layout), np.ones(3, np.float32) if clips else gains)
    room = shape if clips else (0, 0)
    rows = (pattern.h, 3 * pattern.w)
    targets = _Targets(
        out.diffuse.reshape(rows),
        out.specular.reshape(rows),
        np.empty((4, *room), np.float32),
        np.zeros(room, np.uint16),
    )
    share(partial(_separate_rows, samples, pattern, conversion, targets), pattern.h, STRIP)
    out.valid[:] = True
    if clips:
        places = np.flatnonzero(targets.clipped)
        if places.size:
            _complete(_gather(samples, pattern, targets, layout, places), targets, places, out)
        if options.in_light:
            out.diffuse[...] *= gains
            out.specular[...] *= gains
    return out


def warm_up() -> None:
    """Compile the kernels, or load them from numba's cache on disk. One compilation serves all dtypes and layouts."""
    separate_color_affine_half(np.full((4, 4), 255, np.uint8), Layout(), 0, 255)


@lru_cache(maxsize=8)
def _matrices(layout: Layout) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """The matrices of `fit_stokes_unclipped`, which of them are exact, and the vector of `analyser_residual`."""
    full = stokes_inverse(layout.angles).float().numpy()
    inverses, exact = np.stack([full] * 16), np.zeros(16, np.bool_)
    exact[0] = True
    for code in range(1, 16):
        matrix, exact[code] = unclipped_inverse(layout.angles, code)
        if matrix is not None:
            inverses[code] = matrix.float().numpy()
    unit = torch.eye(4, dtype=torch.float64).reshape(4, 1, 1, 4)
    null = analyser_residual(Measurements(unit, layout.angles)).reshape(4).float().numpy()
    return inverses, exact, null


def _gather(
    samples: Samples, pattern: Pattern, targets: _Targets, layout: Layout, places: NDArray[np.int64]
) -> Measurements:
    """The analysers of the N pixels with clipped samples, as an image ``[4, 3, 1, N]``."""
    data = np.empty((4, 3, places.size), np.float32)
    _collect(samples, pattern, places, data)
    bits = targets.clipped.reshape(-1)[places]
    clipped = (bits >> np.arange(12, dtype=np.uint16).reshape(4, 3, 1)) & 1 > 0
    return Measurements(torch.from_numpy(data)[:, :, None], layout.angles, torch.from_numpy(clipped)[:, :, None])


def _complete(measurements: Measurements, targets: _Targets, places: NDArray[np.int64], out: ColorAffineImages) -> None:
    """Solve and fill the pixels ``places`` with clipped samples by the twin's functions, into ``out``."""
    assert measurements.clipped is not None
    diffuse, specular, valid = (torch.from_numpy(x) for x in (out.diffuse, out.specular, out.valid))
    lines, at = torch.from_numpy(targets.lines).flatten(1), torch.from_numpy(places)
    slope = lines[:2, at][:, None]
    stokes = fit_stokes_unclipped(measurements)[0]
    stokes, offset, determined = twin.solve_clipped(measurements, stokes, slope, lines[2:, at][:, None])
    lines[2:, at] = offset[:, 0]
    total = stokes.s0.clamp(min=0)
    tau = torch.minimum(twin.white_specular(offset, slope), total.amin(dim=-3, keepdim=True)).expand_as(total)
    diffuse.view(-1, 3)[at] = (total - tau)[:, 0].T
    specular.view(-1, 3)[at] = tau[:, 0].T
    valid.view(-1)[at] = (determined & ~measurements.clipped.all(dim=-4).any(dim=-3))[0]
    hole = ~valid.view(-1)[at]
    if not bool(hole.any()):
        return
    found = Separation(total[..., hole] - tau[..., hole], tau[..., hole], valid.view(-1)[at][None, hole], stokes)
    found = replace(found, slope=slope[..., hole])
    holes = Measurements(measurements.data[..., hole], measurements.angles, measurements.clipped[..., hole])
    _fill(found, holes, (diffuse, specular, valid, lines.view(targets.lines.shape)), at[hole], determined[:, hole])


def _fill(found: Separation, holes: Measurements, frame: tuple[Tensor, ...], at: Tensor, determined: Tensor) -> None:
    """`polsep.color_affine._fill` where only the N pixels ``at`` have holes; what is around them is the ``frame``.

    ``found`` and ``holes`` are images ``[..., 1, N]``; ``frame``: diffuse, specular, valid and lines, which it changes.
    """
    assert holes.clipped is not None
    assert found.slope is not None
    diffuse, specular, valid, lines = frame
    known, before = determined[..., None, :, :], found.specular[:1]

    def at_holes(image: Tensor) -> Tensor:
        return image.flatten(1)[:, at][:, None]

    tau = specular[None, ..., 0]
    own = twin.unit_vectors(lines[2:] + lines[:2] * tau)
    phase = twin.unit_vectors(at_holes(twin.interpolate_around(own * tau, valid)))
    phase = torch.where(known, at_holes(own), phase)
    around = at_holes(twin.interpolate_around(diffuse.movedim(-1, 0), valid))
    sums = twin.sum_unclipped(holes, found.slope, phase, around)
    s = torch.where(known, before, twin.fit_specular(sums))
    d = twin.fit_diffuse(sums, s)
    s = torch.where(known, s, torch.maximum(s, twin.least_specular(holes, found.slope, d, phase)))
    d = torch.where(known, torch.maximum(d, twin.least_diffuse(holes, found, s, phase)), d)
    core = holes.clipped.all(dim=-4).all(dim=-3)
    if bool(core.any()):
        image, outside = tau.clone(), torch.ones_like(valid)
        image.view(-1)[at], outside.view(-1)[at] = s.reshape(-1), ~core[0]
        s = torch.where(core[None], torch.maximum(s, at_holes(twin.interpolate_around(image, outside))), s)
    diffuse.view(-1, 3)[at] = d[:, 0].T
    specular.view(-1, 3)[at] = s[:, 0].T.expand(-1, 3)


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
def _leave(pattern: Pattern, gains: Any, t: int, scratch: tuple[Rows, Rings], targets: _Targets) -> None:
    """Specular and diffuse of row ``t``, whose slope is found, to the images."""
    rows, rings = scratch
    stokes = rings.stokes[t % 16]
    _split(stokes, rows.slope, rows.planes)
    tau, d0, d1, d2 = rows.planes[0], rows.planes[1], rows.planes[2], rows.planes[3]
    interleave_colors((tau, tau, tau), gains, targets.specular[t])
    interleave_colors((d0, d1, d2), gains, targets.diffuse[t])
    if targets.clipped.size:
        _keep_lines(stokes, rows.slope, targets.lines[:, t])


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
def _separate_strip(samples: Samples, pattern: Pattern, conversion: Conversion, targets: _Targets, start: int) -> None:
    """One strip of cell rows, from ``start`` on."""
    stop = min(start + STRIP, pattern.h)
    first = max(start - REACH, 0)
    window, scratch = make_window(pattern), (make_rows(pattern), make_rings(pattern.w))
    rows, rings = scratch
    open_window(samples, pattern, window, first)
    for t in range(start - REACH, stop + REACH):
        if first <= t < pattern.h:
            flagged = advance_window(samples, pattern, window, t)
            interpolate_row(pattern, window, t, rows.m)
            if flagged:
                flag_row(pattern, window, t, rows.flags)
            enter_row(pattern, conversion, flagged, t, scratch)
            if flagged and start <= t < stop:
                for j in range(pattern.w):
                    targets.clipped[t, j] = rows.clipped[j]
        elif t >= pattern.h:
            rings.noise[t % 7] = ZERO
        if t - 2 > first or t - 2 == 0:
            measure_misses(pattern, t - 2, scratch)
        if t - NOISE >= start - WIDEST:
            weigh_row(pattern, t - NOISE, scratch)
            find_slope(pattern, t - REACH, start, scratch)
        if t - REACH >= start:
            _leave(pattern, conversion.gains, t - REACH, scratch, targets)


@entry
def _separate_rows(samples: Samples, pattern: Pattern, conversion: Conversion, targets: _Targets, piece: Piece) -> None:
    """A piece of the frame's cell rows, strip by strip."""
    for start in range(piece[0], piece[1], STRIP):
        _separate_strip(samples, pattern, conversion, targets, start)


@entry
def _rows_clip(samples: Samples, pattern: Pattern, piece: Piece) -> bool:
    """Whether any sample of a piece of the frame's cell rows is clipped."""
    row = np.empty(2 * pattern.w, np.float32)
    for y in range(2 * piece[0], 2 * piece[1]):
        read_row(samples, pattern.top + y, pattern.left, row)
        if any_clipped(row, pattern.clip_at):
            return True
    return False


@entry
def _collect(samples: Samples, pattern: Pattern, places: Any, data: Any) -> None:
    """Analysers of the pixels ``places``, flat and in order, into ``data [4, 3, N]``."""
    window, m = make_window(pattern), make_analysers(pattern)
    last = -2
    for i in range(places.size):
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
