"""Twin of ``separate_analytic(demosaic_bilinear_half(mosaic))`` in one pass over the frame, on the CPU.

Conventions are those of the twins: linear light, 1.0 = one measurement at the white level, AoLP in [0, pi) from
image-right toward image-up. Values agree to rounding (2e-6 of white), ``valid`` exactly. Rows are computed
independently of each other, so the number of threads (`numba.set_num_threads`) does not change a bit.

Compiled code is kept on disk by numba: in ``__pycache__`` beside this file or, where that cannot be written, in the
user's cache folder (``NUMBA_CACHE_DIR`` overrides both). Note: numba renews it when this file changes, not when the
modules that it imports do; after editing those, remove ``polsep/kernels/__pycache__``.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit, prange
from numpy.typing import NDArray

from polsep.camera import Layout
from polsep.kernels.bilinear import (
    Pattern,
    advance_window,
    flag_row,
    interpolate_row,
    make_analysers,
    make_window,
    open_window,
    read_pattern,
)
from polsep.kernels.unpack import RawFrame, Samples, as_samples, compiled
from polsep.stokes import Measurements, fit_stokes

#: Cell rows that one thread computes at a time: few enough to share the work, many enough to reuse loaded rows.
STRIP = 32

# numba's plain thread pool, its last resort where neither TBB nor OpenMP is there, ends the process when two threads
# start a parallel kernel at once. A kernel uses all threads anyway, so callers wait for each other.
_LAUNCH = threading.Lock()


@dataclass(frozen=True)
class AnalyticImages:
    """The separated frame, channels last; also the room that a stream gives to be filled again and again.

    ``diffuse``, ``specular``: float32 ``[h, w, C]``, ``valid``: bool ``[h, w]``, as in `Separation`. ``dolp`` and
    ``aolp`` [rad]: float32 ``[h, w]``, of the mean over colours, or both None when nobody wants them.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32] | None = None
    aolp: NDArray[np.float32] | None = None

    @classmethod
    def empty(cls, shape: tuple[int, int], layout: Layout, polarization: bool = False) -> AnalyticImages:
        """Room for mosaics of that ``shape`` (H, W); with ``polarization`` also for DoLP and AoLP."""
        h, w = ((n - start) // 2 for n, start in zip(shape, layout.origin, strict=True))
        images = [np.empty((h, w, layout.channels), np.float32) for _ in range(2)]
        angles = [np.empty((h, w), np.float32) for _ in range(2)] if polarization else [None, None]
        return cls(images[0], images[1], np.empty((h, w), np.bool_), angles[0], angles[1])


@dataclass(frozen=True)
class AnalyticOptions:
    """What a stream of frames has in common beside its layout and levels.

    ``light_color``: one gain per channel, divided out of every sample, as in `Mosaic`. ``in_light``: multiply it back
    into the results, as the pipeline does. ``polarization``: also make DoLP and AoLP. ``out``: images to fill, which
    then say whether DoLP and AoLP are made.
    """

    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    in_light: bool = False
    polarization: bool = False
    out: AnalyticImages | None = None


class _Targets(NamedTuple):
    """Images as the kernel takes them: colours ``[h, w C]``; ``dolp`` and ``aolp`` are ``[0, 0]`` when not wanted."""

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32]
    aolp: NDArray[np.float32]


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
    whose rows are not contiguous is copied first. Uses numba's threads; the first call ever compiles (see `warm_up`).
    Raises ValueError on another dtype or shape, levels out of order, or images in ``options.out`` that do not fit.
    Source: Dave et al. 2022, Eqs. 15-18.
    """
    options = AnalyticOptions() if options is None else options
    samples = as_samples(raw)
    pattern = read_pattern((raw.shape[0], raw.shape[1]), layout, black_level, white_level, options.light_color)
    out = options.out
    if out is None:
        out = AnalyticImages.empty((raw.shape[0], raw.shape[1]), layout, options.polarization)
    targets = _as_targets(out, (pattern.h, pattern.w, pattern.channels))
    gains = options.light_color[: pattern.channels] if options.in_light else (1.0,) * pattern.channels
    conversion = _Conversion(_stokes_inverse(layout), np.array(gains, np.float32))
    with _LAUNCH:
        _separate(samples, pattern, conversion, targets)
    return out


def _stokes_inverse(layout: Layout) -> NDArray[np.float32]:
    """The ``[3, 4]`` matrix that `fit_stokes` applies; its errors are `fit_stokes`' own."""
    unit = torch.eye(4, dtype=torch.float64).reshape(4, 1, 1, 4)
    stokes = fit_stokes(Measurements(unit, layout.angles))
    return np.stack([s.reshape(4).float().numpy() for s in (stokes.s0, stokes.s1, stokes.s2)])


def _as_targets(out: AnalyticImages, shape: tuple[int, int, int]) -> _Targets:
    """The images of ``out``, checked. Raises ValueError on a wrong shape or dtype, or on arrays with gaps."""
    if (out.dolp is None) != (out.aolp is None):
        raise ValueError("expected both dolp and aolp or neither, found one of them")
    none = np.empty((0, 0), np.float32)
    dolp, aolp = (none, none) if out.dolp is None or out.aolp is None else (out.dolp, out.aolp)
    targets = _Targets(out.diffuse, out.specular, out.valid, dolp, aolp)
    for name, image in targets._asdict().items():
        if image is none:
            continue
        wanted = shape if name in ("diffuse", "specular") else shape[:2]
        dtype = "bool" if name == "valid" else "float32"
        if image.shape != wanted or image.dtype != dtype or not image.flags.c_contiguous or not image.flags.writeable:
            raise ValueError(
                f"expected {name} to be a writable C-contiguous {dtype} array {list(wanted)}, "
                f"found {image.dtype} {list(image.shape)}"
            )
    rows = (shape[0], shape[1] * shape[2])
    return targets._replace(diffuse=out.diffuse.reshape(rows), specular=out.specular.reshape(rows))


def warm_up() -> None:
    """Compile the kernel, or load it from numba's cache on disk. One compilation serves all dtypes and layouts."""
    for layout in (Layout(), Layout(bayer=None)):
        separate_analytic_half(np.zeros((4, 4), np.uint8), layout, 0, 255, AnalyticOptions(polarization=True))


_ZERO, _ONE = np.float32(0), np.float32(1)
_HALF, _PI, _HALF_PI = np.float32(0.5), np.float32(math.pi), np.float32(math.pi / 2)

# atan(x) / x on [0, 1] as a polynomial in x^2: own minimax fit (iteratively reweighted least squares), 2.5e-7 rad.
_A0, _A1, _A2, _A3, _A4, _A5, _A6 = (
    np.float32(c)
    for c in (0.999996112, -0.333173682, 0.198078157, -0.132333405, 0.079623623, -0.0336041677, 0.00681177381)
)


@compiled
def _split_row(m: Any, c: int, gain: Any, inverse: Any) -> None:
    """Eqs. 15-18 for colour ``c`` of a row ``m [4, C, n]``: it becomes (specular, diffuse, -, -), times ``gain``.

    In place, because LLVM gives up on loops over so many arrays of which each might overlap each.
    """
    i00, i01, i02, i03 = gain * inverse[0, 0], gain * inverse[0, 1], gain * inverse[0, 2], gain * inverse[0, 3]
    i10, i11, i12, i13 = gain * inverse[1, 0], gain * inverse[1, 1], gain * inverse[1, 2], gain * inverse[1, 3]
    i20, i21, i22, i23 = gain * inverse[2, 0], gain * inverse[2, 1], gain * inverse[2, 2], gain * inverse[2, 3]
    m0, m1, m2, m3 = m[0, c], m[1, c], m[2, c], m[3, c]
    for j in range(m0.size):
        s0 = i00 * m0[j] + i01 * m1[j] + i02 * m2[j] + i03 * m3[j]
        s1 = i10 * m0[j] + i11 * m1[j] + i12 * m2[j] + i13 * m3[j]
        s2 = i20 * m0[j] + i21 * m1[j] + i22 * m2[j] + i23 * m3[j]
        total = s0 if s0 > _ZERO else _ZERO
        polarized = math.sqrt(s1 * s1 + s2 * s2)
        specular = polarized if polarized < total else total
        m0[j] = specular
        m1[j] = total - specular


@compiled
def _half_angle(s1: Any, s2: Any) -> Any:
    """AoLP in [0, pi) without branches: atan2(s2, s1) / 2."""
    x, y = abs(s1), abs(s2)
    steep = y > x
    long, short = (y, x) if steep else (x, y)
    ratio = short / (long if long > _ZERO else _ONE)
    z = ratio * ratio
    angle = ratio * (_A0 + z * (_A1 + z * (_A2 + z * (_A3 + z * (_A4 + z * (_A5 + z * _A6))))))
    angle = _HALF_PI - angle if steep else angle
    angle = _HALF * (_PI - angle if s1 < _ZERO else angle)
    angle = _PI - angle if s2 < _ZERO else angle
    return angle if angle < _PI else _ZERO


@compiled
def _polarize_row(m: Any, inverse: Any) -> None:
    """DoLP and AoLP of a row: ``m [4, n]`` becomes (DoLP, AoLP, -, -)."""
    i00, i01, i02, i03 = inverse[0, 0], inverse[0, 1], inverse[0, 2], inverse[0, 3]
    i10, i11, i12, i13 = inverse[1, 0], inverse[1, 1], inverse[1, 2], inverse[1, 3]
    i20, i21, i22, i23 = inverse[2, 0], inverse[2, 1], inverse[2, 2], inverse[2, 3]
    m0, m1, m2, m3 = m[0], m[1], m[2], m[3]
    for j in range(m0.size):
        s0 = i00 * m0[j] + i01 * m1[j] + i02 * m2[j] + i03 * m3[j]
        s1 = i10 * m0[j] + i11 * m1[j] + i12 * m2[j] + i13 * m3[j]
        s2 = i20 * m0[j] + i21 * m1[j] + i22 * m2[j] + i23 * m3[j]
        degree = math.sqrt(s1 * s1 + s2 * s2) / (s0 if s0 > _ZERO else _ONE)
        m0[j] = degree if s0 > _ZERO else _ZERO
        m1[j] = _half_angle(s1, s2)


@compiled
def _mean_color(m: Any, gains: Any, mean: Any) -> None:
    """Mean over colours of ``m [4, C, n]``, in the light's colour, to ``mean [4, n]``."""
    if m.shape[1] == 1:
        for k in range(4):
            _copy(m[k, 0], mean[k])
        return
    third = _ONE / np.float32(3)
    g0, g1, g2 = third * gains[0], third * gains[1], third * gains[2]
    for k in range(4):
        red, green, blue, out = m[k, 0], m[k, 1], m[k, 2], mean[k]
        for j in range(out.size):
            out[j] = g0 * red[j] + g1 * green[j] + g2 * blue[j]


@compiled
def _interleave(planes: Any, image: Any) -> None:
    """Channels last: ``planes [C, n]`` to a row ``image [w C]``."""
    if planes.shape[0] == 1:
        _copy(planes[0], image)
        return
    red, green, blue = planes[0], planes[1], planes[2]
    for j in range(image.size // 3):
        image[3 * j] = red[j]
        image[3 * j + 1] = green[j]
        image[3 * j + 2] = blue[j]


@compiled
def _copy(row: Any, image: Any) -> None:
    """The first values of ``row``; a loop, because numba compiles far longer for an assignment of slices."""
    for j in range(image.size):
        image[j] = row[j]


@compiled
def _clear_flagged(flags: Any, valid: Any) -> None:
    """False wherever one of ``flags [4, C, n]`` is above 0; True stays only where it was."""
    for k in range(flags.shape[0]):
        for c in range(flags.shape[1]):
            row = flags[k, c]
            for j in range(valid.size):
                valid[j] &= row[j] == _ZERO


@compiled
def _separate_strip(samples: Samples, pattern: Pattern, conversion: _Conversion, targets: _Targets, start: int) -> None:
    """One strip of cell rows, from ``start`` on."""
    inverse, gains = conversion.inverse, conversion.gains
    window, m = make_window(pattern), make_analysers(pattern)
    mean = np.empty((4, m.shape[2]), np.float32)
    open_window(samples, pattern, window, start)
    for r in range(start, start + STRIP if start + STRIP < pattern.h else pattern.h):
        flagged = advance_window(samples, pattern, window, r)
        valid = targets.valid[r]
        for j in range(valid.size):
            valid[j] = True
        if flagged:
            flag_row(pattern, window, r, m)
            _clear_flagged(m, valid)
        interpolate_row(pattern, window, r, m)
        if targets.dolp.size:
            _mean_color(m, gains, mean)
            _polarize_row(mean, inverse)
            _copy(mean[0], targets.dolp[r])
            _copy(mean[1], targets.aolp[r])
        for c in range(pattern.channels):
            _split_row(m, c, gains[c], inverse)
        _interleave(m[0], targets.specular[r])
        _interleave(m[1], targets.diffuse[r])


@njit(cache=True, nogil=True, parallel=True)
def _separate(samples: Samples, pattern: Pattern, conversion: _Conversion, targets: _Targets) -> None:
    """All strips, shared among numba's threads."""
    for strip in prange((pattern.h + STRIP - 1) // STRIP):
        _separate_strip(samples, pattern, conversion, targets, strip * STRIP)
