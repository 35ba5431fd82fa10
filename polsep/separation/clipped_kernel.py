"""Pixels with clipped samples, one by one: twin of `_solve_clipped` and `_fill` of `polsep.separation.color_affine`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, THIRD, TWO, ZERO, compiled, entry
from polsep.compute.rows_kernel import add_rows, add_up
from polsep.compute.threads import RowRange
from polsep.physics.stokes_kernel import fit_stokes_unclipped, polarize
from polsep.separation import color_affine as twin
from polsep.separation.closed_form import MIN_EIGENVALUE
from polsep.separation.closed_form_kernel import fit_unclipped, offset_row, white_specular
from polsep.separation.tally_kernel import RESIDUAL, tally_row

_MIN_EIGENVALUE, _PRIOR = np.float32(MIN_EIGENVALUE), np.float32(twin.PRIOR_WEIGHT)
_FREEDOM, _FREEDOM_FLOOR = np.float32(twin.SPECULAR_FREEDOM), np.float32(twin.FREEDOM_FLOOR)
_MIN_PRIOR = np.float32(twin.MIN_PRIOR)
_SHORT, _INFINITE = np.float32(1e-12), np.float32(np.inf)
ALL_CLIPPED = np.uint16(0xFFF)


class Pixels(NamedTuple):
    """N pixels with clipped samples.

    Given: ``samples [4, 3, N]``; which of them are ``clipped [N]``, one bit per analyser and colour, 1 << (3 k + c);
    ``lines [4, N]``: a and b of p = a s0 + b. Computed: b in ``lines``, ``diffuse [3, N]``, ``specular [N]``, ``valid``
    and ``determined [N]`` (b), and for a report ``stokes [3, N]``, mean over colours, and the ``residual [N]`` of the
    model.
    """

    samples: NDArray[np.float32]
    clipped: NDArray[np.uint16]
    lines: NDArray[np.float32]
    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    determined: NDArray[np.bool_]
    stokes: NDArray[np.float32]
    residual: NDArray[np.float32]


def make_pixels(clipped: NDArray[np.uint16], lines: NDArray[np.float32]) -> Pixels:
    """Pixels of which nothing is computed yet, with buffers for their samples."""
    n = clipped.size
    samples, diffuse, stokes = (np.empty((*shape, n), np.float32) for shape in ((4, 3), (3,), (3,)))
    valid, determined = (np.empty(n, np.bool_) for _ in range(2))
    specular, residual = (np.empty(n, np.float32) for _ in range(2))
    return Pixels(samples, clipped, lines, diffuse, specular, valid, determined, stokes, residual)


@compiled
def _read_pixel(pixels: Pixels, n: int, y: Any, kept: Any) -> None:
    """Twice the samples of a pixel, ``y [3, 4]``, and which of them are not clipped, ``kept [3, 4]``."""
    for c in range(3):
        for k in range(4):
            y[c, k] = TWO * pixels.samples[k, c, n]
            kept[c, k] = not (pixels.clipped[n] >> (3 * k + c)) & 1


@compiled
def _residual(s: Any, a1: Any, a2: Any) -> Any:
    """Rms distance of the colours of ``s [3, 3]`` from p = a s0 + b. Twin: `color_affine._offset`."""
    total = ZERO
    for i, a in ((1, a1), (2, a2)):
        mean = THIRD * ((s[i, 0] - a * s[0, 0]) + (s[i, 1] - a * s[0, 1]) + (s[i, 2] - a * s[0, 2]))
        for c in range(3):
            missed = s[i, c] - a * s[0, c] - mean
            total += missed * missed
    return np.sqrt(THIRD * total)


@entry
def solve_pixels(pixels: Pixels, cosines: Any, sines: Any, inverses: Any, row_range: RowRange) -> None:
    """Diffuse, specular and offset of pixels from their unclipped samples, and which of them are determined.

    ``cosines``, ``sines [4]`` of twice the analysers' angles; ``inverses [16, 3, 4]`` by which of them are clipped.
    """
    s, s0, total = np.empty((3, 3), np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
    y, kept = np.empty((3, 4), np.float32), np.empty((3, 4), np.bool_)
    for n in range(row_range[0], row_range[1]):
        a1, a2 = pixels.lines[0, n], pixels.lines[1, n]
        _read_pixel(pixels, n, y, kept)
        for c in range(3):
            fit_stokes_unclipped(pixels.samples[:, :, n], pixels.clipped[n], inverses, c, s)
        pixels.residual[n] = _residual(s, a1, a2)
        b1, b2, eigenvalue = fit_unclipped(y, kept, cosines, sines, a1, a2, s0)
        pixels.lines[2, n], pixels.lines[3, n], pixels.determined[n] = b1, b2, eigenvalue > _MIN_EIGENVALUE
        tau, valid = white_specular(b1, b2, a1, a2, ZERO), pixels.determined[n]
        for c in range(3):
            count = kept[c].sum()
            valid &= count > 0
            if 0 < count < 4:
                s[0, c], s[1, c], s[2, c] = s0[c], a1 * s0[c] + b1, a2 * s0[c] + b2
            total[c] = s[0, c] if s[0, c] > ZERO else ZERO
            tau = tau if tau < total[c] else total[c]
        for c in range(3):
            pixels.diffuse[c, n] = total[c] - tau
        pixels.specular[n], pixels.valid[n] = tau, valid
        for i in range(3):
            pixels.stokes[i, n] = THIRD * (s[i, 0] + s[i, 1] + s[i, 2])


@compiled
def _unit(x: Any, y: Any) -> Any:
    """The direction of a vector; zero stays zero."""
    size = np.sqrt(x * x + y * y)
    size = size if size > _SHORT else _SHORT
    return x / size, y / size


@compiled
def _specular_freedom(likely: Any, bright: Any) -> Any:
    """Twin of `color_affine.specular_freedom` for the specular light around and the mean diffuse light."""
    ratio = (_FREEDOM * _FREEDOM * likely * likely + _FREEDOM_FLOOR) / (bright * bright + _FREEDOM_FLOOR)
    return ratio * ratio


@compiled
def _fit_specular(y: Any, kept: Any, g: Any, p: Any, likely: Any, weight: Any, sums: Any) -> Any:
    """Twin of `color_affine._fit_specular`.

    ``g``, ``p [4]``: twice the share of diffuse and specular light that passes each analyser. ``likely``: the
    specular light around, with its ``weight`` as a prior. ``sums [3, 3]``, by colour: of g g, g p and g y, with
    ``sums[c, 2]`` holding the prior's share at first.
    """
    curvature, pull = weight, weight * likely
    for c in range(3):
        gg, gp, pp, gy, py = _PRIOR, ZERO, ZERO, sums[c, 2], ZERO
        for k in range(4):
            if kept[c, k]:
                gg += g[k] * g[k]
                gp += g[k] * p[k]
                pp += p[k] * p[k]
                gy += g[k] * y[c, k]
                py += p[k] * y[c, k]
        sums[c, 0], sums[c, 1], sums[c, 2] = gg, gp, gy
        curvature += pp - gp * gp / gg
        pull += py - gp * gy / gg
    value = pull / (curvature if curvature > HALF * _MIN_PRIOR else HALF * _MIN_PRIOR)
    return value if value > ZERO else ZERO


@compiled
def _fit_diffuse(sums: Any, specular: Any, diffuse: Any) -> None:
    """Twin of `color_affine._fit_diffuse`."""
    for c in range(3):
        value = (sums[c, 2] - sums[c, 1] * specular) / sums[c, 0]
        diffuse[c] = value if value > ZERO else ZERO


@compiled
def _raise_specular(y: Any, kept: Any, g: Any, p: Any, diffuse: Any, specular: Any, freedom: Any) -> Any:
    """Twin of `color_affine._raise_specular`; ``diffuse [3]`` and ``specular`` light so far."""
    raised, most = specular, _INFINITE
    for k in range(4):
        share = p[k] * freedom / (p[k] * p[k] * freedom + g[k] * g[k])
        for c in range(3):
            if not kept[c, k]:
                missing = y[c, k] - g[k] * diffuse[c] - p[k] * specular
                enough = specular + missing * share
                raised = enough if enough > raised else raised
            elif p[k] > HALF and y[c, k] / p[k] < most:
                most = y[c, k] / p[k] if y[c, k] > ZERO else ZERO
    return raised if raised < most else most


@entry
def fill_pixels(pixels: Pixels, cosines: Any, sines: Any, holes: Any, around: Any) -> None:
    """Complete the pixels ``holes``, indices among the N, with what is ``around [5, holes]`` them.

    That is the specular polarization and the diffuse light. Twin: `color_affine._fill`, but for the cores of highlights
    where everything clips (`raise_cores`).
    """
    g, p, sums, diffuse = (
        np.empty(4, np.float32),
        np.empty(4, np.float32),
        np.empty((3, 3), np.float32),
        np.empty(3, np.float32),
    )
    y, kept = np.empty((3, 4), np.float32), np.empty((3, 4), np.bool_)
    for i in range(holes.size):
        n = holes[i]
        _read_pixel(pixels, n, y, kept)
        a1, a2, specular = pixels.lines[0, n], pixels.lines[1, n], pixels.specular[n]
        p1, p2 = around[0, i], around[1, i]
        likely = np.sqrt(p1 * p1 + p2 * p2)
        freedom = _specular_freedom(likely, THIRD * (around[2, i] + around[3, i] + around[4, i]))
        if pixels.determined[n]:
            p1, p2 = pixels.lines[2, n] + a1 * specular, pixels.lines[3, n] + a2 * specular
        p1, p2 = _unit(p1, p2)
        for k in range(4):
            g[k] = ONE + cosines[k] * a1 + sines[k] * a2
            p[k] = ONE + cosines[k] * p1 + sines[k] * p2
        for c in range(3):
            sums[c, 2] = _PRIOR * around[2 + c, i]
        weight = _PRIOR / freedom
        fitted = _fit_specular(y, kept, g, p, likely, weight if weight > _MIN_PRIOR else _MIN_PRIOR, sums)
        if not pixels.determined[n]:
            _fit_diffuse(sums, fitted, diffuse)
            specular = _raise_specular(y, kept, g, p, diffuse, fitted, freedom)
        _fit_diffuse(sums, specular, diffuse)
        for k in range(4):
            for c in range(3):
                if not kept[c, k]:  # every clipped sample has to clip; twin: `color_affine._least_diffuse`
                    needed = (y[c, k] - p[k] * specular) / g[k]
                    diffuse[c] = needed if needed > diffuse[c] else diffuse[c]
        mean = THIRD * (diffuse[0] + diffuse[1] + diffuse[2])
        pixels.stokes[0, n] = mean + specular
        pixels.stokes[1, n], pixels.stokes[2, n] = a1 * mean + p1 * specular, a2 * mean + p2 * specular
        pixels.specular[n] = specular
        for c in range(3):
            pixels.diffuse[c, n] = diffuse[c]


@entry
def raise_cores(pixels: Pixels, holes: Any, rim: Any) -> None:
    """Let the pixels ``holes`` where everything clips be at least as bright as their ``rim [holes]``."""
    for i in range(holes.size):
        n = holes[i]
        more = rim[i] - pixels.specular[n]
        if pixels.clipped[n] == ALL_CLIPPED and more > ZERO:
            share = more / (pixels.specular[n] if pixels.specular[n] > _SHORT else _SHORT)
            mean = THIRD * (pixels.diffuse[0, n] + pixels.diffuse[1, n] + pixels.diffuse[2, n])
            pixels.stokes[0, n] += more
            for j in range(2):
                pixels.stokes[1 + j, n] += share * (pixels.stokes[1 + j, n] - pixels.lines[j, n] * mean)
            pixels.specular[n] = rim[i]


@entry
def tally_pixels(pixels: Pixels, dolp: Any, aolp: Any, sums: Any) -> None:
    """DoLP and AoLP of the pixels ``[N]``, and their sums to ``sums [1, 7]``, see `tally_kernel`."""
    s0, s1, s2 = pixels.stokes[0], pixels.stokes[1], pixels.stokes[2]
    polarize(s0, s1, s2, dolp, aolp)
    mean, p1, p2 = np.empty_like(s0), np.empty_like(s0), np.empty_like(s0)
    add_rows(pixels.diffuse[0], pixels.diffuse[1], pixels.diffuse[2], THIRD, mean)
    offset_row(s1, pixels.lines[0], mean, p1)
    offset_row(s2, pixels.lines[1], mean, p2)
    tally_row(pixels.specular.copy(), mean, p1, p2, dolp, pixels.clipped[:0], sums[0])
    sums[0, RESIDUAL] = add_up(pixels.residual)
