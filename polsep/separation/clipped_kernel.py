"""Pixels with clipped samples, one by one: twin of `_solve_clipped` and `_fill` of `polsep.separation.color_affine`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, THIRD, TWO, ZERO, compiled, entry
from polsep.compute.threads import Piece
from polsep.separation import color_affine as twin
from polsep.separation.moments_kernel import Conversion

_MIN_EIGENVALUE, _PRIOR = np.float32(twin.MIN_EIGENVALUE), np.float32(twin.PRIOR_WEIGHT)
_FREEDOM, _FREEDOM_FLOOR = np.float32(twin.SPECULAR_FREEDOM), np.float32(twin.FREEDOM_FLOOR)
_MIN_PRIOR = np.float32(twin.MIN_PRIOR)
_SINGULAR, _SHORT, _ENDLESS = np.float32(1e-6), np.float32(1e-12), np.float32(np.inf)
ALL_CLIPPED = np.uint16(0xFFF)


class Pixels(NamedTuple):
    """N pixels with clipped samples. Given: ``samples [4, 3, N]`` and which of them are ``clipped [N]``, one bit per
    analyser and colour, 1 << (3 k + c); ``lines [4, N]``, slope and offset.

    Found: the offset in ``lines``, ``diffuse [3, N]``, ``specular [N]``, ``valid`` and ``determined [N]`` (the offset),
    and for a report ``stokes [3, N]`` of all colours together and the ``residual [N]`` of the model.
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


class Analysers(NamedTuple):
    """``cosines``, ``sines [4]`` of twice the angles, and the `Conversion` of their samples."""

    cosines: NDArray[np.float32]
    sines: NDArray[np.float32]
    conversion: Conversion


def make_pixels(clipped: NDArray[np.uint16], lines: NDArray[np.float32]) -> Pixels:
    """Pixels of which nothing is found yet, with room for their samples."""
    n = clipped.size
    return Pixels(
        np.empty((4, 3, n), np.float32),
        clipped,
        lines,
        np.empty((3, n), np.float32),
        np.empty(n, np.float32),
        np.empty(n, np.bool_),
        np.empty(n, np.bool_),
        np.empty((3, n), np.float32),
        np.empty(n, np.float32),
    )


@compiled
def _is_clipped(bits: Any, k: int, c: int) -> bool:
    return bool((bits >> (3 * k + c)) & 1)


@compiled
def _fit_unclipped(pixels: Pixels, n: int, conversion: Conversion, s: Any, kept: Any) -> None:
    """Stokes vectors ``s [3, 3]`` of every colour from its unclipped samples, and how many those are, ``kept [3]``."""
    for c in range(3):
        code = 0
        for k in range(4):
            code |= _is_clipped(pixels.clipped[n], k, c) << k
        kept[c] = 4 - ((code & 1) + (code >> 1 & 1) + (code >> 2 & 1) + (code >> 3 & 1))
        for i in range(3):
            value = ZERO
            for k in range(4):
                value += conversion.inverses[code, i, k] * pixels.samples[k, c, n]
            s[i, c] = value


@compiled
def _left_over(s: Any, a1: Any, a2: Any) -> Any:
    """How far the colours are from one line of slope (a1, a2), rms. Twin: `color_affine._offset`."""
    total = ZERO
    for i, a in ((1, a1), (2, a2)):
        mean = THIRD * ((s[i, 0] - a * s[0, 0]) + (s[i, 1] - a * s[0, 1]) + (s[i, 2] - a * s[0, 2]))
        for c in range(3):
            missed = s[i, c] - a * s[0, c] - mean
            total += missed * missed
    return np.sqrt(THIRD * total)


@compiled
def _least_squares(pixels: Pixels, n: int, analysers: Analysers, s0: Any) -> Any:
    """The offset into the pixel's line, its ``s0 [3]``, and the least eigenvalue of the equations."""
    a1, a2, bits = pixels.lines[0, n], pixels.lines[1, n], pixels.clipped[n]
    m00, m01, m11, r0, r1 = ZERO, ZERO, ZERO, ZERO, ZERO
    gg, gy, gu, gv = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(3, np.float32)
    for c in range(3):
        for k in range(4):
            if not _is_clipped(bits, k, c):
                u, v, y = analysers.cosines[k], analysers.sines[k], TWO * pixels.samples[k, c, n]
                g = ONE + u * a1 + v * a2
                gg[c] += g * g
                gy[c] += g * y
                gu[c] += g * u
                gv[c] += g * v
        gg[c] = gg[c] if gg[c] > _SINGULAR else _SINGULAR
        for k in range(4):
            if not _is_clipped(bits, k, c):
                u, v, y = analysers.cosines[k], analysers.sines[k], TWO * pixels.samples[k, c, n]
                g = ONE + u * a1 + v * a2
                p, q = u - g * gu[c] / gg[c], v - g * gv[c] / gg[c]
                m00 += p * p
                m01 += p * q
                m11 += q * q
                r0 += p * y
                r1 += q * y
    det = m00 * m11 - m01 * m01
    det = det if det > _SINGULAR else _SINGULAR
    b1, b2 = (m11 * r0 - m01 * r1) / det, (m00 * r1 - m01 * r0) / det
    for c in range(3):
        s0[c] = (gy[c] - gu[c] * b1 - gv[c] * b2) / gg[c]
    pixels.lines[2, n], pixels.lines[3, n] = b1, b2
    return HALF * (m00 + m11) - np.sqrt(HALF * HALF * (m00 - m11) * (m00 - m11) + m01 * m01)


@compiled
def _white_specular(b1: Any, b2: Any, a1: Any, a2: Any) -> Any:
    """Twin of `color_affine.white_specular`."""
    ba, bb, rest = b1 * a1 + b2 * a2, b1 * b1 + b2 * b2, ONE - (a1 * a1 + a2 * a2)
    return (ba + np.sqrt(ba * ba + rest * bb)) / rest


@entry
def solve_pixels(pixels: Pixels, analysers: Analysers, piece: Piece) -> None:
    """Diffuse, specular and offset of pixels from their unclipped samples, and which of them are determined."""
    s, s0, kept = np.empty((3, 3), np.float32), np.empty(3, np.float32), np.empty(3, np.int64)
    for n in range(piece[0], piece[1]):
        a1, a2 = pixels.lines[0, n], pixels.lines[1, n]
        _fit_unclipped(pixels, n, analysers.conversion, s, kept)
        pixels.residual[n] = _left_over(s, a1, a2)
        pixels.determined[n] = _least_squares(pixels, n, analysers, s0) > _MIN_EIGENVALUE
        b1, b2 = pixels.lines[2, n], pixels.lines[3, n]
        for c in range(3):
            if 0 < kept[c] < 4:
                s[0, c], s[1, c], s[2, c] = s0[c], a1 * s0[c] + b1, a2 * s0[c] + b2
        tau = _white_specular(b1, b2, a1, a2)
        for c in range(3):
            total = s[0, c] if s[0, c] > ZERO else ZERO
            pixels.diffuse[c, n] = total
            tau = tau if tau < total else total
        for c in range(3):
            pixels.diffuse[c, n] -= tau
        pixels.specular[n] = tau
        pixels.valid[n] = pixels.determined[n] and kept.min() > 0
        for i in range(3):
            pixels.stokes[i, n] = THIRD * (s[i, 0] + s[i, 1] + s[i, 2])


@compiled
def _unit(x: Any, y: Any) -> Any:
    """The direction of a vector; zero stays zero."""
    size = np.sqrt(x * x + y * y)
    size = size if size > _SHORT else _SHORT
    return x / size, y / size


@compiled
def _freedom(likely: Any, bright: Any) -> Any:
    """Twin of `color_affine.specular_freedom` for the specular light around and the mean diffuse light."""
    ratio = (_FREEDOM * _FREEDOM * likely * likely + _FREEDOM_FLOOR) / (bright * bright + _FREEDOM_FLOOR)
    return ratio * ratio


@compiled
def _fit_specular(pixels: Pixels, n: int, passed: tuple[Any, Any], prior: tuple[Any, Any], sums: Any) -> Any:
    """`color_affine._fit_specular`; ``passed``: twice the share of diffuse and specular light behind each analyser.

    ``prior``: the likely specular light and the weight of that. ``sums [3, 3]``, by colour: of g g, g p and g y, with
    ``sums[c, 2]`` holding the prior's share at first.
    """
    g, p = passed
    likely, weight = prior
    curvature, pull = weight, weight * likely
    for c in range(3):
        gg, gp, pp, gy, py = _PRIOR, ZERO, ZERO, sums[c, 2], ZERO
        for k in range(4):
            if not _is_clipped(pixels.clipped[n], k, c):
                y = TWO * pixels.samples[k, c, n]
                gg += g[k] * g[k]
                gp += g[k] * p[k]
                pp += p[k] * p[k]
                gy += g[k] * y
                py += p[k] * y
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
def _raise_specular(pixels: Pixels, n: int, passed: tuple[Any, Any], lit: tuple[Any, Any], freedom: Any) -> Any:
    """`color_affine._raise_specular`; ``lit``: diffuse and specular light so far."""
    g, p = passed
    diffuse, specular = lit
    raised, most = specular, _ENDLESS
    for k in range(4):
        taken = p[k] * freedom / (p[k] * p[k] * freedom + g[k] * g[k])
        for c in range(3):
            y = TWO * pixels.samples[k, c, n]
            if _is_clipped(pixels.clipped[n], k, c):
                lack = y - g[k] * diffuse[c] - p[k] * specular
                enough = specular + lack * taken
                raised = enough if enough > raised else raised
            elif p[k] > HALF and y / p[k] < most:
                most = y / p[k] if y > ZERO else ZERO
    return raised if raised < most else most


@compiled
def _raise_diffuse(pixels: Pixels, n: int, passed: tuple[Any, Any], specular: Any, diffuse: Any) -> None:
    """Let every clipped sample clip for given specular light. Twin: `color_affine._least_diffuse`."""
    g, p = passed
    for k in range(4):
        for c in range(3):
            if _is_clipped(pixels.clipped[n], k, c):
                needed = (TWO * pixels.samples[k, c, n] - p[k] * specular) / g[k]
                diffuse[c] = needed if needed > diffuse[c] else diffuse[c]


@entry
def fill_pixels(pixels: Pixels, analysers: Analysers, holes: Any, around: Any) -> None:
    """Complete the pixels ``holes``, indices among the N, with what is ``around [5, holes]`` them.

    That is the specular polarization and the diffuse light. Twin: `color_affine._fill`, but for the cores of highlights
    where everything clips.
    """
    g, p = np.empty(4, np.float32), np.empty(4, np.float32)
    sums, diffuse = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    for i in range(holes.size):
        n = holes[i]
        a1, a2, known, specular = pixels.lines[0, n], pixels.lines[1, n], pixels.determined[n], pixels.specular[n]
        p1, p2 = around[0, i], around[1, i]
        likely = np.sqrt(p1 * p1 + p2 * p2)
        freedom = _freedom(likely, THIRD * (around[2, i] + around[3, i] + around[4, i]))
        if known:
            p1, p2 = pixels.lines[2, n] + a1 * specular, pixels.lines[3, n] + a2 * specular
        p1, p2 = _unit(p1, p2)
        for k in range(4):
            g[k] = ONE + analysers.cosines[k] * a1 + analysers.sines[k] * a2
            p[k] = ONE + analysers.cosines[k] * p1 + analysers.sines[k] * p2
        for c in range(3):
            sums[c, 2] = _PRIOR * around[2 + c, i]
        weight = _PRIOR / freedom
        fitted = _fit_specular(pixels, n, (g, p), (likely, weight if weight > _MIN_PRIOR else _MIN_PRIOR), sums)
        if not known:
            _fit_diffuse(sums, fitted, diffuse)
            specular = _raise_specular(pixels, n, (g, p), (diffuse, fitted), freedom)
        _fit_diffuse(sums, specular, diffuse)
        _raise_diffuse(pixels, n, (g, p), specular, diffuse)
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
