"""Moments of the colours along the way of `color_affine`'s strips: rows of cells in, weighted moments out.

A strip of cell rows passes through rings, each of which holds the last few rows of one step: demosaicking, Stokes
vectors and noise, then moments of the colours three rows later, weighted by their error. Twins: `sample_variance`,
`fit_diffuse_polarization` and `bilinear_variance` of `polsep.separation.color_affine` and `polsep.demosaic.bilinear`,
whose means over windows are sums here.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, QUARTER, THIRD, TWO, ZERO, compiled
from polsep.compute.rows_kernel import add_up
from polsep.demosaic.bilinear_kernel import PAD, Pattern, make_analysers
from polsep.physics.stokes_kernel import fit_stokes_row, fit_stokes_unclipped
from polsep.separation import color_affine as twin

#: Radii of the windows of `color_affine.SCALES` without the pixel itself, and of `sample_variance`'s.
WIDEST, MIDDLE, NARROW, NOISE = 12, 6, 2, 3
#: Rows up and down that a pixel depends on: the widest window and `sample_variance` of its moments.
REACH = WIDEST + NOISE
#: Rows of weighted moments and of edges that are kept: as far down as the widest window looks, as far up as the middle.
KEPT = 20

_TWELFTH, _LEAST_WEIGHT = np.float32(1 / 12), np.float32(1e-6)
_MARGIN, _VARIANCE_FLOOR = np.float32(twin.CONTRAST_MARGIN), np.float32(twin.VARIANCE_FLOOR)


class Conversion(NamedTuple):
    """Conversion of analysers to Stokes vectors, by which of them are clipped (bit k of the code).

    ``inverses [16, 3, 4]``, whether they are ``exact [16]``, the residual's ``null [4]``, and the light's ``gains [3]``
    to multiply back.
    """

    inverses: NDArray[np.float32]
    exact: NDArray[np.bool_]
    null: NDArray[np.float32]
    gains: NDArray[np.float32]


class Rings(NamedTuple):
    """Rows of a strip on their way, by row number modulo the ring's length; ``n`` is the width with a `PAD` each side.

    ``stokes [16, 5, n]``: s0 of three colours, s1, s2. ``moments [16, 5, n]``: of the colours' deviations from
    their mean, s0 s0, s0 s1, s0 s2; 1 where these are usable; s1 s1 + s2 s2. ``noise [7, 2, n]``: squared residuals and
    their weights, summed along rows. ``bright [4, n]``: mean s0. ``missed [3, n]``: squared second differences of it,
    summed along rows. ``weighted [20, 6, n]``: weighted moments, error, weight and its square. ``wide``, ``middle``,
    ``narrow [L + 1, 6, n]``: rows of one block of window sums of length L, behind it the sum of the block so far.
    ``light [4, 3, n]``: mean s0, s1, s2 of pixels without clipped samples, ``edges [20, 2, n]``: their ratios in
    3x3 pixels; both empty where windows do not end at edges.
    """

    stokes: NDArray[np.float32]
    moments: NDArray[np.float32]
    noise: NDArray[np.float32]
    bright: NDArray[np.float32]
    missed: NDArray[np.float32]
    weighted: NDArray[np.float32]
    wide: NDArray[np.float32]
    middle: NDArray[np.float32]
    narrow: NDArray[np.float32]
    light: NDArray[np.float32]
    edges: NDArray[np.float32]


class Rows(NamedTuple):
    """Single rows: ``m [4, 3, w]`` analysers, ``flags`` like it, ``s [9, n]`` s0, s1, s2 of each colour,
    ``sums [6, n]``, ``nothing`` like it but zero, ``ones [n]``,
    ``near [5, w]`` weights of the window that ends at edges, and others.
    """

    m: NDArray[np.float32]
    flags: NDArray[np.float32]
    s: NDArray[np.float32]
    squared: NDArray[np.float32]
    missed: NDArray[np.float32]
    clipped: NDArray[np.uint16]
    fours: NDArray[np.float32]
    diffuse_polarization: NDArray[np.float32]
    planes: NDArray[np.float32]
    spare: NDArray[np.float32]
    counts: NDArray[np.float32]
    sums: NDArray[np.float32]
    nothing: NDArray[np.float32]
    ones: NDArray[np.float32]
    near: NDArray[np.float32]


@compiled
def make_rings(w: int, edges: int) -> Rings:
    """Empty rings for rows of ``w`` cells; with rows of edges, `KEPT` or 0."""
    n = w + 2 * PAD
    n += -n % PAD
    return Rings(
        np.zeros((16, 5, n), np.float32),
        np.zeros((16, 5, n), np.float32),
        np.zeros((7, 2, n), np.float32),
        np.zeros((4, n), np.float32),
        np.zeros((3, n), np.float32),
        np.zeros((KEPT, 6, n), np.float32),
        np.zeros((2 * WIDEST + 2, 6, n), np.float32),
        np.zeros((2 * MIDDLE + 2, 6, n), np.float32),
        np.zeros((2 * NARROW + 2, 6, n), np.float32),
        np.zeros((4 if edges else 0, 3, n), np.float32),
        np.zeros((edges, 2, n), np.float32),
    )


@compiled
def make_rows(pattern: Pattern) -> Rows:
    """Empty rows, and how many columns each window counts."""
    w = pattern.w
    n = w + 2 * PAD
    n += -n % PAD
    counts = np.ones((4, n), np.float32)
    for i, radius in enumerate((WIDEST, MIDDLE, NARROW, 1)):
        for j in range(w):
            counts[i, PAD + j] = np.float32(min(j + radius, w - 1) - max(j - radius, 0) + 1)
    return Rows(
        make_analysers(pattern),
        make_analysers(pattern),
        np.zeros((9, n), np.float32),
        np.zeros((2, n), np.float32),
        np.zeros(n, np.float32),
        np.zeros(w, np.uint16),
        np.zeros(6 * n, np.float32),
        np.zeros((2, n), np.float32),
        np.zeros((4, w), np.float32),
        np.zeros((3, w), np.float32),
        counts,
        np.zeros((6, n), np.float32),
        np.zeros((6, n), np.float32),
        np.ones(n, np.float32),
        np.zeros((5, w), np.float32),
    )


@compiled
def _residual_of(m: Any, null: Any, squared: Any, bright: Any) -> None:
    """Mean squared residual of a row and mean brightness, ``m [4, 3, w]``."""
    n0, n1, n2, n3 = null[0], null[1], null[2], null[3]
    r0, r1, r2, r3 = m[0, 0], m[1, 0], m[2, 0], m[3, 0]
    g0, g1, g2, g3 = m[0, 1], m[1, 1], m[2, 1], m[3, 1]
    b0, b1, b2, b3 = m[0, 2], m[1, 2], m[2, 2], m[3, 2]
    for j in range(squared.size):
        r = n0 * r0[j] + n1 * r1[j] + n2 * r2[j] + n3 * r3[j]
        g = n0 * g0[j] + n1 * g1[j] + n2 * g2[j] + n3 * g3[j]
        b = n0 * b0[j] + n1 * b1[j] + n2 * b2[j] + n3 * b3[j]
        squared[j] = THIRD * (r * r + g * g + b * b)
        red, green, blue = r0[j] + r1[j] + r2[j] + r3[j], g0[j] + g1[j] + g2[j] + g3[j], b0[j] + b1[j] + b2[j] + b3[j]
        bright[j] = TWO * _TWELFTH * (red + green + blue)


@compiled
def _contrast(s: Any, w: int, moments: Any, stokes: Any) -> None:
    """Moments of the colours' deviations from their mean, and the means of s1 and s2: rows of `Rings`."""
    r0, g0, b0 = s[0, PAD:], s[1, PAD:], s[2, PAD:]
    r1, g1, b1 = s[3, PAD:], s[4, PAD:], s[5, PAD:]
    r2, g2, b2 = s[6, PAD:], s[7, PAD:], s[8, PAD:]
    contrast, first, second, total = moments[0, PAD:], moments[1, PAD:], moments[2, PAD:], moments[4, PAD:]
    red, green, blue, mean1, mean2 = stokes[0, PAD:], stokes[1, PAD:], stokes[2, PAD:], stokes[3, PAD:], stokes[4, PAD:]
    for j in range(w):
        a0 = THIRD * (r0[j] + g0[j] + b0[j])
        a1 = THIRD * (r1[j] + g1[j] + b1[j])
        a2 = THIRD * (r2[j] + g2[j] + b2[j])
        red[j], green[j], blue[j] = r0[j], g0[j], b0[j]
        dr, dg, db = r0[j] - a0, g0[j] - a0, b0[j] - a0
        contrast[j] = dr * dr + dg * dg + db * db
        dr1, dg1, db1, dr2, dg2, db2 = r1[j] - a1, g1[j] - a1, b1[j] - a1, r2[j] - a2, g2[j] - a2, b2[j] - a2
        first[j] = dr * dr1 + dg * dg1 + db * db1
        second[j] = dr * dr2 + dg * dg2 + db * db2
        total[j] = (dr1 * dr1 + dg1 * dg1 + db1 * db1) + (dr2 * dr2 + dg2 * dg2 + db2 * db2)
        mean1[j] = a1
        mean2[j] = a2


@compiled
def _clip_bits(flags: Any, clipped: Any) -> None:
    """Bits 1 << (3 k + c) of the clipped analysers k and colours c of every pixel of a row."""
    clipped[:] = 0
    for k in range(4):
        for c in range(3):
            row, bit = flags[k, c], np.uint16(1 << (3 * k + c))
            for j in range(clipped.size):
                clipped[j] |= bit if row[j] > ZERO else np.uint16(0)


@compiled
def _leave_out_clipped(rows: Rows, conversion: Conversion, moments: Any) -> None:
    """Residuals and moments of a row's pixels with clipped samples, from what the unclipped ones determine."""
    _clip_bits(rows.flags, rows.clipped)
    exact, stokes = np.zeros(3, np.bool_), rows.s.reshape(3, 3, rows.s.shape[1])
    for j in range(rows.clipped.size):
        bits = rows.clipped[j]
        if bits == 0:
            continue
        rows.squared[:, PAD + j] = ZERO
        s = stokes[:, :, PAD + j]
        for c in range(3):
            exact[c] = conversion.exact[fit_stokes_unclipped(rows.m[:, :, j], bits, conversion.inverses, c, s)]
        _moments_of_exact(s, exact, moments[:, PAD + j])


@compiled
def _moments_of_exact(s: Any, exact: Any, moments: Any) -> None:
    """`_contrast` of one pixel over the colours that are ``exact``; all zero unless there are two."""
    moments[:] = ZERO
    colors = np.float32(exact.sum())
    if colors < TWO:
        return
    moments[3] = ONE
    for i in range(3):
        mean0, mean = ZERO, ZERO
        for c in range(3):
            mean0 += exact[c] * s[0, c] / colors
            mean += exact[c] * s[i, c] / colors
        for c in range(3):
            moments[i] += exact[c] * (s[0, c] - mean0) * (s[i, c] - mean)


@compiled
def _sum_seven(x: Any, out: Any) -> None:
    """Sums of seven neighbours along a row."""
    a, b, c, d, e, f, g = x[0:], x[1:], x[2:], x[3:], x[4:], x[5:], x[6:]
    for j in range(out.size):
        out[j] = ((a[j] + b[j]) + (c[j] + d[j])) + ((e[j] + f[j]) + g[j])


@compiled
def _missed_brightness(above: Any, here: Any, below: Any, out: Any) -> None:
    """Squared differences of a row's samples from the mean of their four neighbours."""
    left, middle, right = here[0:], here[1:], here[2:]
    for j in range(out.size):
        missed = middle[j] - QUARTER * (left[j] + right[j] + above[j] + below[j])
        out[j] = missed * missed


@compiled
def _sum_three(x: Any, out: Any) -> None:
    a, b, c = x[0:], x[1:], x[2:]
    for j in range(out.size):
        out[j] = a[j] + b[j] + c[j]


@compiled
def _errors(noise: Any, missed: Any, per_column: Any, counts: Any, error: Any) -> None:
    """Expected error of the contrast from rings of noise and missed brightness."""
    q0, q1, q2, q3 = noise[0, 0, PAD:], noise[1, 0, PAD:], noise[2, 0, PAD:], noise[3, 0, PAD:]
    q4, q5, q6 = noise[4, 0, PAD:], noise[5, 0, PAD:], noise[6, 0, PAD:]
    w0, w1, w2, w3 = noise[0, 1, PAD:], noise[1, 1, PAD:], noise[2, 1, PAD:], noise[3, 1, PAD:]
    w4, w5, w6 = noise[4, 1, PAD:], noise[5, 1, PAD:], noise[6, 1, PAD:]
    v0, v1, v2, columns = missed[0, PAD:], missed[1, PAD:], missed[2, PAD:], counts[PAD:]
    for j in range(error.size):
        total = ((q0[j] + q1[j]) + (q2[j] + q3[j])) + ((q4[j] + q5[j]) + q6[j])
        weight = ((w0[j] + w1[j]) + (w2[j] + w3[j])) + ((w4[j] + w5[j]) + w6[j])
        weight = weight if weight > _LEAST_WEIGHT else _LEAST_WEIGHT
        error[j] = TWO * _MARGIN * total / weight + (v0[j] + v1[j] + v2[j]) / (per_column * columns[j])


@compiled
def _weigh(moments: Any, w: int, weighted: Any) -> None:
    """Weighted moments, error, weight and its square; the error waits in ``weighted[3]``."""
    c, m1, m2, usable = moments[0, PAD:], moments[1, PAD:], moments[2, PAD:], moments[3, PAD:]
    x0, x1, x2 = weighted[0, PAD:], weighted[1, PAD:], weighted[2, PAD:]
    x3, x4, x5 = weighted[3, PAD:], weighted[4, PAD:], weighted[5, PAD:]
    for j in range(w):
        error = x3[j]
        weight = usable[j] * _VARIANCE_FLOOR / (error + _VARIANCE_FLOOR)
        x0[j] = weight * c[j]
        x1[j] = weight * m1[j]
        x2[j] = weight * m2[j]
        x3[j] = weight * error
        x4[j] = weight
        x5[j] = weight * weight


@compiled
def enter_row(pattern: Pattern, conversion: Conversion, flagged: bool, t: int, rows: Rows, rings: Rings) -> None:
    """Stokes vectors, moments, residuals and brightness of row ``t``, whose analysers are in ``rows.m``."""
    m, s, w = rows.m, rows.s, pattern.w
    inside = slice(PAD, PAD + w)
    stokes, moments, bright = rings.stokes[t % 16], rings.moments[t % 16], rings.bright[t % 4]
    for c in range(3):
        fit_stokes_row(m, c, conversion.inverses[0], s[c, inside], s[3 + c, inside], s[6 + c, inside])
    _residual_of(m, conversion.null, rows.squared[0, inside], bright[inside])
    bright[PAD - 1], bright[PAD + w] = bright[PAD], bright[PAD + w - 1]
    _contrast(s, w, moments, stokes)
    moments[3, inside] = ONE
    rows.squared[1, inside] = ONE
    if flagged:
        _leave_out_clipped(rows, conversion, moments)
    for i in range(2):
        _sum_seven(rows.squared[i, PAD - NOISE :], rings.noise[t % 7, i, inside])


@compiled
def sum_noise(pattern: Pattern, noise: Any, row: Any) -> float:
    """The sum over a row of the standard deviation of a sample, from a full ring of noise. Twin: `sample_variance`.

    ``row [w]``: a buffer.
    """
    q0, q1, q2, q3 = noise[0, 0, PAD:], noise[1, 0, PAD:], noise[2, 0, PAD:], noise[3, 0, PAD:]
    q4, q5, q6 = noise[4, 0, PAD:], noise[5, 0, PAD:], noise[6, 0, PAD:]
    w0, w1, w2, w3 = noise[0, 1, PAD:], noise[1, 1, PAD:], noise[2, 1, PAD:], noise[3, 1, PAD:]
    w4, w5, w6 = noise[4, 1, PAD:], noise[5, 1, PAD:], noise[6, 1, PAD:]
    for j in range(pattern.w):
        total = ((q0[j] + q1[j]) + (q2[j] + q3[j])) + ((q4[j] + q5[j]) + q6[j])
        weight = ((w0[j] + w1[j]) + (w2[j] + w3[j])) + ((w4[j] + w5[j]) + w6[j])
        row[j] = np.sqrt(total / (weight if weight > _LEAST_WEIGHT else _LEAST_WEIGHT))
    return add_up(row)


@compiled
def measure_misses(pattern: Pattern, t: int, rows: Rows, rings: Rings) -> None:
    """Squared error of the mean of four neighbours as brightness of row ``t``; 0 outside the frame."""
    inside = slice(PAD, PAD + pattern.w)
    if not 0 <= t < pattern.h:
        rings.missed[t % 3] = ZERO
        return
    above, below = rings.bright[max(t - 1, 0) % 4], rings.bright[min(t + 1, pattern.h - 1) % 4]
    _missed_brightness(above[inside], rings.bright[t % 4, PAD - 1 :], below[inside], rows.missed[inside])
    _sum_three(rows.missed[PAD - 1 :], rings.missed[t % 3, inside])


@compiled
def rows_around(t: int, radius: int, h: int) -> Any:
    """Rows of a window about row ``t`` that lie inside a frame of ``h`` rows, float32."""
    return np.float32(min(t + radius, h - 1) - max(t - radius, 0) + 1)


@compiled
def weigh_row(pattern: Pattern, t: int, rows: Rows, rings: Rings) -> None:
    """Weighted moments of row ``t``, zero outside the frame."""
    weighted = rings.weighted[t % KEPT]
    if not 0 <= t < pattern.h:
        weighted[:] = ZERO
        return
    inside = slice(PAD, PAD + pattern.w)
    per_column = rows_around(t, 1, pattern.h)
    _errors(rings.noise, rings.missed, per_column, rows.counts[3], weighted[3, inside])
    _weigh(rings.moments[t % 16], pattern.w, weighted)
