"""The colour-affine closed form: separation of polarized diffuse and white specular light from colour contrast.

Exact where samples are, where the specular is fully polarized and white, and where the surface has colours. The light's
own colour has to be divided out before (`Mosaic.light_color`, found in the frame or stated): with a wrong one,
highlights stay in the diffuse image.

Let p = s1 + i s2 and a = beta_d exp(2i phi_d), the diffuse polarization, which depends on geometry but not on colour.
The specular light of a dielectric is white and fully polarized, so in every pixel and every colour c

    p_c = a tau_d,c + tau_s exp(2i phi_s)   and   s0_c = tau_d,c + tau_s   give   p_c = a s0_c + b,
    b = tau_s (exp(2i phi_s) - a).

a follows from how p varies with s0 over the three colours, b from the mean, and |exp(2i phi_s)| = 1 leaves one
positive tau_s. Neither the light's angle nor training is needed. Where there is no colour contrast a tends to zero and
the result to the paper's analytic split.

With a known, every unclipped sample is linear in (s0_R, s0_G, s0_B, b): a highlight that clips some analysers
in some colours is still solved by least squares over the samples that are left (`_solve_clipped`).

Derivation, related work (Nayar, Fang, Boult 1997; Kajiyama et al., WACV 2023) and tests: docs/conventions.md.
Complex numbers are pairs ``[..., 2, h, w]``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

from polsep.compute.arrays import Array, namespace
from polsep.compute.filters import box_mean
from polsep.compute.resizing import halve, resize_bilinear
from polsep.physics.stokes import (
    Measurements,
    Stokes,
    complete_pair,
    contradictions,
    fit_stokes_unclipped,
    is_pair,
)
from polsep.separation.analytic import Separation, all_pixels, clipped_pixels, separate_analytic_unclipped
from polsep.separation.closed_form import fit_unclipped, limit_dolp, parts, white_specular

#: Windows of the diffuse polarization, widest first: radius in pixels, and standard deviation per component from the
#: next wider window's. The widest one is held toward zero, the paper's unpolarized diffuse.
#: Chosen on random scenes outside every test set; see docs/experiments.md.
SCALES = ((12, 0.1), (6, 0.04), (2, 0.01), (0, 0.005))

#: The window that ends at edges, where they are known: every third pixel of the one of this radius.
EDGE_RADIUS, EDGE_STEP = 6, 3
#: Difference of mean s1 / s0 or s2 / s0 beyond which a pixel lies on another surface: twice a Gaussian's 0.05.
EDGE_REACH = 0.1
#: Light below which polarization says nothing about edges.
EDGE_FLOOR = 1e-3

#: Radius of the window over which the noise of samples is averaged.
NOISE_RADIUS = 3

#: Colour contrast counts only where it exceeds this many times its expected noise.
CONTRAST_MARGIN = 2.0

#: Pixels are weighted 1 / (variance + this): below it (0.3 % of white, rms) all are equally good.
VARIANCE_FLOOR = 1e-5

#: Weight, against 1 of a sample, of the diffuse light around in pixels where clipping leaves b undetermined.
PRIOR_WEIGHT = 0.05

#: Where light must be added for samples to clip: how much more freely than the diffuse light, relative to each one's
#: brightness around, the specular varies; to the fourth power it decides who takes how much.
SPECULAR_FREEDOM = 12.0
#: Squared brightness that is added to both sides of that comparison: in the dark it says nothing.
FREEDOM_FLOOR = 1e-6

#: Least weight of the specular light around as a prior, far below that of any sample and above rounding.
MIN_PRIOR = 1e-6


def separate_color_affine(measurements: Measurements) -> Separation:
    """Diffuse and white specular of colour samples ``[..., 4, 3, h, w]`` by the closed form above.

    Falls back to `separate_analytic_unclipped` on mono data and, smoothly, on grey surfaces. Recovers
    clipped samples from the unclipped analysers and colours of the same pixel; where too few are left, ``valid`` is
    False, the diffuse is interpolated from around and the specular the least that explains the clipping.
    """
    sample = sample_variance(measurements.uniform or measurements)
    measurements = complete_pair(measurements) if is_pair(measurements) else measurements
    if measurements.data.shape[-3] != 3:
        return separate_analytic_unclipped(measurements)
    xp, even = namespace(measurements.data), measurements.uniform or measurements
    stokes, exact = fit_stokes_unclipped(even)
    edges = None if even is measurements else polarization_edges(even, stokes)
    a = fit_diffuse_polarization((stokes, exact), sample, even.variance, edges)
    offset, residual = _offset(stokes, a)
    if even is not measurements:
        stokes = fit_stokes_unclipped(measurements)[0]
        offset, _ = _offset(stokes, a)
    stokes, offset, determined = _solve_clipped(measurements, stokes, a, offset)
    valid = determined
    if measurements.clipped is not None:
        valid = valid & ~xp.any(xp.all(measurements.clipped, axis=-4), axis=-3)
    total = stokes.s0.clip(0, None)
    specular = xp.minimum(white_specular(parts(offset), parts(a)), xp.min(total, axis=-3, keepdims=True))
    specular = xp.broadcast_to(specular, total.shape)
    found = Separation(total - specular, specular, valid, stokes, a, residual, xp.sqrt(sample))
    return found if bool(xp.all(valid)) else _fill(found, measurements, offset, determined)


def _color_mean(x: Array) -> Array:
    return namespace(x).mean(x, axis=-3, keepdims=True)


def _color_sum(x: Array) -> Array:
    return namespace(x).sum(x, axis=-3, keepdims=True)


def _unclipped(measurements: Measurements, clipped: Array) -> Array:
    """1 in pixels ``[..., 1, h, w]`` without a clipped sample, else 0."""
    return namespace(clipped).astype(~clipped[..., None, :, :], measurements.data.dtype)


def sample_variance(measurements: Measurements) -> Array:
    """Local noise variance of one sample ``[..., 1, h, w]`` from the analysers' contradiction of m0 + m90 = m45 + m135.

    It covers sensor noise and misregistration alike, needs no noise model of the sensor, and is zero on exact data.
    Clipped samples are left out of the mean over the window. Three analysers and crossed pairs cannot contradict: of
    them it is from differences of neighbours, in which lines along rows, columns and slopes cancel, but not textures.
    """
    if len(measurements.angles) > 3:
        squared = _color_mean(contradictions(measurements) ** 2)
        squared = namespace(squared).mean(squared, axis=-4)
    else:
        squared = _fine_details(measurements.data)
    clipped = clipped_pixels(measurements)
    if clipped is None:
        return box_mean(squared, NOISE_RADIUS)
    weight = _unclipped(measurements, clipped)
    return box_mean(squared * weight, NOISE_RADIUS) / box_mean(weight, NOISE_RADIUS).clip(1e-6, None)


def _fine_details(data: Array) -> Array:
    """Squared differences of 2x2 pixels across both axes: ``[..., K, C, h, w]`` to ``[..., 1, h, w]``.

    In mean the variance of one sample where all else is even. The last row and column repeat the ones before.
    """
    xp = namespace(data)
    right = data[..., :, 1:] - data[..., :, :-1]
    both = (right[..., 1:, :] - right[..., :-1, :]) / 2
    squared = xp.mean(_color_mean(both * both), axis=-4)
    squared = xp.concat([squared, squared[..., -1:, :]], axis=-2)
    return xp.concat([squared, squared[..., :, -1:]], axis=-1)


def polarization_edges(measurements: Measurements, stokes: Stokes) -> Array:
    """s1 / s0 and s2 / s0 ``[..., 2, h, w]`` of all colours in 3x3 pixels, clipped ones left out.

    They change where the surface does, and at the rim of a highlight, but hardly with texture.
    """
    light = namespace(stokes.s0).concat([_color_mean(s) for s in (stokes.s0, stokes.s1, stokes.s2)], axis=-3)
    clipped = clipped_pixels(measurements)
    if clipped is not None:
        light = light * _unclipped(measurements, clipped)
    light = box_mean(light, 1)
    return light[..., 1:, :, :] / (light[..., :1, :, :] + EDGE_FLOOR)


def fit_diffuse_polarization(
    known: tuple[Stokes, Array], sample: Array, interpolation: Array | None, edges: Array | None = None
) -> Array:
    """Diffuse polarization a ``[..., 2, h, w]`` from how p varies with s0 over colours; |a| at most `MAX_DIFFUSE_DOLP`.

    Fitted to deviations from each pixel's own mean over colours, in which white specular light cancels exactly. Wide
    windows steady narrow ones, down to the single pixel, each in the proportion of its noise to its colour contrast (a
    Gaussian prior per scale). Noise in s0 would pull a toward p/s0 and so erase the specular of grey surfaces:
    contrast that noise explains is not counted, and pixels at colour edges, where demosaicking invents contrast, weigh
    less. ``known``: Stokes images and ``exact [..., C, h, w]``, the colours that clipping leaves known, of which a
    pixel needs two. ``sample``, ``interpolation``: variances of a sample. ``edges``: `polarization_edges`, if any.
    """
    stokes, exact = known
    xp = namespace(sample)
    colors = _color_sum(xp.astype(exact, sample.dtype))
    means = (_color_sum(s * exact) / colors.clip(1, None) for s in (stokes.s0, stokes.s1, stokes.s2))
    d0, d1, d2 = ((s - m) * exact for s, m in zip((stokes.s0, stokes.s1, stokes.s2), means, strict=True))
    usable = colors > 1
    error = 2 * CONTRAST_MARGIN * sample
    if interpolation is not None:
        error = error + interpolation
    weight = xp.astype(usable, error.dtype) * VARIANCE_FLOOR / (error + VARIANCE_FLOOR)
    moments = xp.concat([*(_color_sum(d) for d in (d0 * d0, d0 * d1, d0 * d2)), error], axis=-3)
    a = xp.zeros_like(moments[..., :2, :, :])
    floor = float(xp.finfo(error.dtype).eps) * 1e-2
    for radius, spread in SCALES:
        if radius == EDGE_RADIUS and edges is not None:
            pooled, samples = _pool_to_edges(moments, weight, edges)
        else:
            pooled, samples = _pool(moments, weight, radius) if radius else (moments * usable, xp.ones_like(weight))
        contrast, moment, noise = pooled[..., :1, :, :], pooled[..., 1:3, :, :], pooled[..., 3:, :, :]
        counted = ((contrast - noise) / (contrast + floor)).clip(0, None)
        held = noise / CONTRAST_MARGIN / (spread**2 * samples) + floor
        a = (moment * counted + held * a) / (contrast + held)
    return limit_dolp(a)


def _pool(moments: Array, weight: Array, radius: int) -> tuple[Array, Array]:
    """Weighted window means, and the number of independent pixels in each (interpolated neighbours count a quarter)."""
    xp = namespace(moments)
    means = box_mean(xp.concat([moments * weight, weight, weight * weight], axis=-3), radius)
    total, squares = means[..., -2:-1, :, :].clip(1e-12, None), means[..., -1:, :, :].clip(1e-20, None)
    pixels = (2 * radius + 1) ** 2 * total * total / squares
    return means[..., :-2, :, :] / total, (pixels / 4).clip(1, None)


def _pool_to_edges(moments: Array, weight: Array, edges: Array) -> tuple[Array, Array]:
    """`_pool` over the window of `EDGE_RADIUS`, whose pixels count less the more their polarization differs.

    A bilateral window (Tomasi and Manduchi 1998) with Tukey's biweight for a kernel, which is zero beyond `EDGE_REACH`.
    Every third pixel is independent of the others.
    """
    xp, (height, width) = namespace(moments), weight.shape[-2:]
    weighted = xp.concat([moments * weight, weight, weight * weight], axis=-3)
    sums = xp.zeros_like(weighted)
    steps = range(-EDGE_RADIUS, EDGE_RADIUS + 1, EDGE_STEP)
    for down, right in ((down, right) for down in steps for right in steps):
        here = (..., slice(max(-down, 0), height - max(down, 0)), slice(max(-right, 0), width - max(right, 0)))
        there = (..., slice(max(down, 0), height - max(-down, 0)), slice(max(right, 0), width - max(-right, 0)))
        if abs(down) < height and abs(right) < width:
            apart = edges[there] - edges[here]
            near = (1 - _color_sum(apart * apart) / EDGE_REACH**2).clip(0, None) ** 2
            sums[here][..., :-1, :, :] += weighted[there][..., :-1, :, :] * near
            sums[here][..., -1:, :, :] += weighted[there][..., -1:, :, :] * (near * near)
    total, squares = sums[..., -2:-1, :, :].clip(1e-12, None), sums[..., -1:, :, :].clip(1e-20, None)
    return sums[..., :-2, :, :] / total, (total * total / squares).clip(1, None)


def _offset(stokes: Stokes, a: Array) -> tuple[Array, Array]:
    """b of p_c = a s0_c + b, the mean over colours ``[..., 2, h, w]``, and the rms it leaves ``[..., 1, h, w]``."""
    xp = namespace(a)
    lines = [s - a[..., k : k + 1, :, :] * stokes.s0 for k, s in enumerate((stokes.s1, stokes.s2))]
    means = [_color_mean(line) for line in lines]
    first, second = (_color_sum((line - mean) ** 2) for line, mean in zip(lines, means, strict=True))
    return xp.concat(means, axis=-3), xp.sqrt((first + second) / 3)


def _solve_clipped(
    measurements: Measurements, stokes: Stokes, diffuse_polarization: Array, offset: Array
) -> tuple[Stokes, Array, Array]:
    """Stokes and b of pixels with clipped samples by least squares over the others, and where those determine b.

    For given a, twice a sample is g_k s0_c + u_k . b with u_k = (cos 2t_k, sin 2t_k) and g_k = 1 + u_k . a. The s0 of
    each colour is eliminated, which leaves 2x2 normal equations for b. `_fill` completes what they leave open.
    """
    xp, clipped, determined = namespace(offset), measurements.clipped, all_pixels(stokes.s0)
    if clipped is None or not bool(xp.any(clipped)):
        return stokes, offset, determined
    clipped = xp.moveaxis(clipped, (-4, -3), (0, 1))
    touched = xp.any(xp.any(clipped, axis=0), axis=0)
    kept = ~clipped[:, :, touched]
    samples = xp.moveaxis(measurements.data, (-4, -3), (0, 1))[:, :, touched]
    a = xp.moveaxis(diffuse_polarization, -3, 0)[:, touched]
    b, s0, solvable = fit_unclipped(2 * samples, xp.astype(kept, samples.dtype), a, measurements.angles)
    determined[touched] = solvable
    solved = stokes.map(lambda image: xp.astype(xp.moveaxis(image, -3, 0), image.dtype))
    partly = xp.any(kept, axis=0) & ~xp.all(kept, axis=0)
    for image, values in zip((solved.s0, solved.s1, solved.s2), (s0, a[0] * s0 + b[0], a[1] * s0 + b[1]), strict=True):
        image[:, touched] = xp.where(partly, values, image[:, touched])
    offset = xp.astype(xp.moveaxis(offset, -3, 0), offset.dtype)
    offset[:, touched] = b
    return solved.map(lambda image: xp.moveaxis(image, 0, -3)), xp.moveaxis(offset, 0, -3), determined


def _fill(found: Separation, measurements: Measurements, offset: Array, determined: Array) -> Separation:
    """Complete pixels that clipping left undetermined, with the valid pixels around as a weak prior.

    Where b is not ``determined`` the specular has the phase of its surroundings and fits the unclipped samples. The
    light that clipped samples are missing is of the lobe that varies more freely: specular beside a highlight, diffuse
    on a bright matte surface. Where everything clips the specular is at least as bright as around. Of a colour without
    unclipped samples the diffuse follows from around and from what makes it clip.
    """
    a, before = found.diffuse_polarization, found.specular[..., :1, :, :]
    assert a is not None and measurements.clipped is not None
    xp = namespace(offset)
    hole, known = ~found.valid[..., None, :, :], determined[..., None, :, :]
    own = _unit(offset + a * before)
    nearby = interpolate_around(own * before, found.valid)
    around = interpolate_around(found.diffuse, found.valid)
    phase, freedom = xp.where(known, own, _unit(nearby)), specular_freedom(nearby, around)
    sums = _sum_unclipped(measurements, a, phase, around)
    fitted = _fit_specular(sums, nearby, freedom)
    lit = (a, phase, _fit_diffuse(sums, fitted), fitted)
    specular = xp.where(known, before, _raise_specular(measurements, lit, freedom))
    diffuse = xp.maximum(_fit_diffuse(sums, specular), _least_diffuse(measurements, a, phase, specular))
    core = xp.all(xp.all(measurements.clipped, axis=-4), axis=-3)
    if bool(xp.any(core)):
        rim = interpolate_around(xp.where(hole, specular, before), ~core)
        specular = xp.where(core[..., None, :, :], xp.maximum(specular, rim), specular)
    p1, p2 = (a[..., i : i + 1, :, :] * diffuse + phase[..., i : i + 1, :, :] * specular for i in (0, 1))
    seen = found.stokes
    stokes = [xp.where(hole, new, old) for new, old in ((diffuse + specular, seen.s0), (p1, seen.s1), (p2, seen.s2))]
    diffuse = xp.where(hole, diffuse, found.diffuse)
    specular = xp.where(hole, specular, found.specular)
    return replace(found, diffuse=diffuse, specular=specular, stokes=Stokes(*stokes))


def specular_freedom(nearby: Array, around: Array) -> Array:
    """Variance of the specular light over the diffuse light's ``[..., 1, h, w]``, see `SPECULAR_FREEDOM`.

    ``nearby [..., 2, h, w]``: the specular polarization around, ``around [..., C, h, w]``: the diffuse light.
    """
    specular = SPECULAR_FREEDOM**2 * _color_sum(nearby * nearby)
    ratio = (specular + FREEDOM_FLOOR) / (_color_mean(around) ** 2 + FREEDOM_FLOOR)
    return ratio * ratio


class _Sums(NamedTuple):
    """Sums over unclipped samples of 2 m = g tau_d + p tau_s and the prior tau_d = around, each ``[..., C, h, w]``."""

    gg: Array
    gp: Array
    pp: Array
    gy: Array
    py: Array


def _sum_unclipped(measurements: Measurements, a: Array, phase: Array, around: Array) -> _Sums:
    """`_Sums` for given diffuse polarization, specular phase ``[..., 2, h, w]`` and diffuse light ``around``."""
    xp = namespace(around)
    gg, gy = xp.full_like(around, PRIOR_WEIGHT), PRIOR_WEIGHT * around
    gp, pp, py = xp.zeros_like(around), xp.zeros_like(around), xp.zeros_like(around)
    for g, p, y, clipped in _by_analyser(measurements, a, phase):
        g, p = g * ~clipped, p * ~clipped
        gg, gp, pp, gy, py = gg + g * g, gp + g * p, pp + p * p, gy + g * y, py + p * y
    return _Sums(gg, gp, pp, gy, py)


def _fit_specular(sums: _Sums, nearby: Array, freedom: Array) -> Array:
    """tau_s ``[..., 1, h, w]`` by least squares over all colours, tau_d eliminated; ``nearby`` is its prior."""
    weight = (PRIOR_WEIGHT / freedom).clip(MIN_PRIOR, None)
    curvature = _color_sum(sums.pp - sums.gp**2 / sums.gg) + weight
    pull = _color_sum(sums.py - sums.gp * sums.gy / sums.gg) + weight * _length(nearby)
    return (pull / curvature.clip(MIN_PRIOR / 2, None)).clip(0, None)


def _fit_diffuse(sums: _Sums, specular: Array) -> Array:
    """tau_d ``[..., C, h, w]`` by least squares for given tau_s."""
    return ((sums.gy - sums.gp * specular) / sums.gg).clip(0, None)


def _raise_specular(measurements: Measurements, lit: tuple[Array, ...], freedom: Array) -> Array:
    """tau_s ``[..., 1, h, w]`` with its share of the light that clipped samples lack: 2 m = g tau_d + p tau_s >= 2.

    Never more than the unclipped samples allow, except those nearly crossed with it. ``lit``: diffuse polarization,
    phase, tau_d and tau_s so far.
    """
    xp, (a, phase, diffuse, specular) = namespace(freedom), lit
    raised, most = specular, xp.full_like(specular, math.inf)
    for g, p, y, clipped in _by_analyser(measurements, a, phase):
        missing = xp.max(clipped * (y - g * diffuse - p * specular).clip(0, None), axis=-3, keepdims=True)
        raised = xp.maximum(raised, specular + missing * p * freedom / (p * p * freedom + g * g))
        allowed = xp.where(clipped | (p <= 0.5), math.inf, y / p.clip(0.5, None))
        most = xp.minimum(most, xp.min(allowed, axis=-3, keepdims=True))
    return xp.minimum(raised, most.clip(0, None))


def _least_diffuse(measurements: Measurements, a: Array, phase: Array, specular: Array) -> Array:
    """The least tau_d ``[..., C, h, w]`` that makes every clipped sample clip for given tau_s; 0 where none does."""
    xp = namespace(specular)
    least = xp.zeros_like(measurements.data[..., 0, :, :, :])
    for g, p, y, clipped in _by_analyser(measurements, a, phase):
        least = xp.maximum(least, clipped * ((y - p * specular) / g))
    return least


def _by_analyser(measurements: Measurements, a: Array, phase: Array) -> Iterator[tuple[Array, Array, Array, Array]]:
    """g, p ``[..., 1, h, w]``, y ``[..., C, h, w]`` of y = 2 m = g tau_d + p tau_s by analyser, and what clipped."""
    assert measurements.clipped is not None
    for k, t in enumerate(measurements.angles):
        data, clipped = (x[..., k, :, :, :] for x in (measurements.data, measurements.clipped))
        yield _transmitted(a, t), _transmitted(phase, t), 2 * data, clipped


def _transmitted(polarization: Array, angle: float) -> Array:
    """1 + u.a: twice the share of light of that polarization ``[..., 2, h, w]`` that an analyser passes."""
    return 1 + math.cos(2 * angle) * polarization[..., :1, :, :] + math.sin(2 * angle) * polarization[..., 1:, :, :]


def _length(vectors: Array) -> Array:
    """Lengths ``[..., 1, h, w]`` of vectors ``[..., 2, h, w]``."""
    return namespace(vectors).sqrt(_color_sum(vectors * vectors))


def _unit(vectors: Array) -> Array:
    """Vectors ``[..., 2, h, w]`` at length 1; zero stays zero."""
    return vectors / _length(vectors).clip(1e-12, None)


def interpolate_around(image: Array, valid: Array) -> Array:
    """``image`` where ``valid [..., h, w]``, elsewhere interpolated from the valid pixels around; 0 if there are none.

    Push and pull over a pyramid (after Gortler et al. 1996, The Lumigraph, Sec. 3.3): cost and reach grow with holes.
    """
    xp = namespace(image)
    weight = xp.astype(valid[..., None, :, :], image.dtype)
    levels = [(image * weight, weight)]
    while max(levels[-1][1].shape[-2:]) > 1:
        total, weight = levels[-1]
        levels.append((halve(total), halve(weight)))
    total, weight = levels.pop()
    result = total / weight.clip(1e-12, None)
    for total, weight in reversed(levels):
        coarse = resize_bilinear(result, total.shape[-2:])
        result = xp.where(weight > 0.25, total / weight.clip(1e-12, None), coarse)
    return result
