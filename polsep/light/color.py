"""The lamp's colour from tiles: one robust fit that combines highlights with planes of colour.

Along the AoLP of specular light the polarized part of a point is ``q = S l + k d``: S times the lamp's colour l, plus
what polarization the diffuse light d = s0 - q has, k of it. So q lies in the plane of l and d whatever k is, and where
S is much larger than k d, q itself has the lamp's colour. In coordinates divided by l, what remains of q beside the
grey axis is ``S x + k d``, x being the error of l as log-ratios (ln R/G, ln B/G). Every tile gives a least-squares
estimate of x with one k of its own, whose spread the other component of polarization shows: that is diffuse alone.
Tiles vote; those that disagree lose weight (Student's t), and none counts for more than `VOTE_ERROR` allows.

Source: highlights, Nayar, Fang, Boult 1997 (doi:10.1023/A:1007937815113); planes, after Shafer 1985 and Kajiyama et
al. 2023; the joint fit is this project's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.light.tiles import Tiles

Doubles = NDArray[np.float64]

#: Most tiles of a fit: those of the most polarized light, in units of noise.
MOST_TILES = 640
#: Prior variance of k: least, and factors on the tile's own and on the frame's mean square of the other component.
LEAST_K, OWN_K, MEAN_K = 0.006, 0.8, 0.03
#: The same of the variance of k inside a tile, and how many independent values of it a tile has.
LEAST_JITTER, OWN_JITTER, MEAN_JITTER, INDEPENDENT = 0.005, 0.3, 0.08, 5.0
#: Part of specular light that appears in the other component, as the AoLP varies over a scene.
LEAK = 0.43
#: Polarization across over along the axis at which a tile's vote halves: specular light has little, diffuse light much.
ACROSS = 1.0
#: Least error of a tile's vote, and degrees of freedom of the votes.
VOTE_ERROR, FREEDOM = 0.0045, 3.6
#: Standard deviation of lamps' log-ratios around white, as raw balances and lamps differ.
SPREAD = 0.5
#: Most steps, size of the largest step and of the last.
STEPS, LARGEST_STEP, LAST_STEP = 15, 0.4, 3e-4
#: Largest k.
MAX_K = 0.4

#: Rows: two directions beside grey. Derivative of a colour by the log-ratios.
_BESIDE = np.array([[1.0, -1, 0], [1, 1, -2]]) / np.sqrt(np.array([[2.0], [6.0]]))
_RATIOS = np.array([[1.0, 0], [0, 0], [0, 1]])


class ColorFit(NamedTuple):
    """Log-ratios ``x`` (ln R/G, ln B/G) of the lamp and what the fit shows about their error.

    ``scatter [2, 2]``: covariance from the scatter of the votes. ``across``: polarization across over along the axis, a
    mean over tiles, as their votes count. ``change [2]``: difference of x between the quarter of the tiles with the
    clearest specular light and the others. ``lean``: mean of k over its root mean square. Diffuse light is polarized to
    all sides of a body, so a lean says that k holds specular light, or that x is wrong.
    """

    x: Doubles
    scatter: Doubles
    across: float
    change: Doubles
    lean: float


#: Log-ratios ``[2]``, weighted votes ``[T, 2, 2]`` of all tiles on them, and what pulls of theirs remain ``[T, 2]``.
Iterated = tuple[Doubles, Doubles, Doubles]


class Planes(NamedTuple):
    """Sums over T tiles for one AoLP: ``qq``, ``qd``, ``dd [T, 3, 3]``, noise removed.

    ``spread``, ``jitter [T]``: variances of k between tiles and inside them. ``across [T]``: power of the polarization
    across the axis over that along it.
    """

    qq: Doubles
    qd: Doubles
    dd: Doubles
    spread: Doubles
    jitter: Doubles
    across: Doubles


def axis_of(tiles: Tiles) -> Doubles:
    """Unit vector ``[2]`` of (s1, s2) along which light is polarized most; s0 grows with polarization along it."""
    blocks = tiles.moments[:, 1:, 1:].sum(0).reshape(3, tiles.colors, 3, tiles.colors)
    sums = np.einsum("icjc->ij", blocks)
    noise = 2 * float(tiles.noise.sum())
    along, across, mixed = sums[1, 1] - noise, sums[2, 2] - noise, sums[1, 2]
    angle = 0.5 * math.atan2(2 * mixed, along - across)
    axis = np.array([math.cos(angle), math.sin(angle)])
    return -axis if sums[0, 1:] @ axis < 0 else axis


def planes_along(tiles: Tiles, axis: Doubles) -> Planes:
    """Return the sums of q and d along an axis of (s1, s2), and the spread of k from the component across it."""
    blocks = tiles.moments[:, 1:, 1:].reshape(-1, 3, 3, 3, 3).swapaxes(2, 3)
    noise = tiles.noise[:, :, None] * np.eye(3)
    a, b = axis
    s00, s01, s02 = blocks[:, 0, 0], blocks[:, 0, 1], blocks[:, 0, 2]
    s11, s12, s22 = blocks[:, 1, 1], blocks[:, 1, 2], blocks[:, 2, 2]
    mixed = a * b * (s12 + s12.swapaxes(1, 2))
    qq, across = a * a * s11 + b * b * s22 + mixed, b * b * s11 + a * a * s22 - mixed
    sq, so = a * s01 + b * s02, a * s02 - b * s01
    oq = a * a * s12.swapaxes(1, 2) - b * b * s12 + a * b * (s22 - s11)
    dd = s00 - sq - sq.swapaxes(1, 2) + qq - 3 * noise
    qd = sq.swapaxes(1, 2) - qq + 2 * noise
    qq = qq - 2 * noise
    diffuse = np.maximum(np.trace(dd, axis1=1, axis2=2), 1e-9)
    along = np.maximum(np.trace(qq, axis1=1, axis2=2), 1e-9)
    leak = LEAK**2 * along
    shared = np.trace(so.swapaxes(1, 2) - oq, axis1=1, axis2=2)
    power = np.maximum(np.trace(across, axis1=1, axis2=2) - 2 * tiles.noise.sum(1), 0)
    ratio = power / along
    power = np.maximum(power - leak, 0)
    mean = np.maximum(shared**2 / diffuse - leak, 0) / diffuse
    inside = np.minimum(np.maximum(power / diffuse - mean, 0), 0.05)
    mean = np.minimum(mean, 0.1)
    weight = np.minimum(diffuse, np.median(diffuse))
    weight = weight / weight.sum()
    spread = LEAST_K**2 + OWN_K * mean + MEAN_K * float(weight @ mean)
    jitter = LEAST_JITTER**2 + OWN_JITTER * inside + MEAN_JITTER * float(weight @ inside)
    return Planes(qq, qd, dd, spread, jitter, ratio)


def strongest(tiles: Tiles) -> Tiles:
    """Return the tiles of the most polarized light, `MOST_TILES` at most, in their order."""
    if len(tiles.counts) <= MOST_TILES:
        return tiles
    diagonal = np.diagonal(tiles.moments, axis1=1, axis2=2)
    power = diagonal[:, 1 + tiles.colors :].sum(1) - 4 * tiles.noise.sum(1)
    return tiles.select(np.sort(np.argsort(-power, kind="stable")[:MOST_TILES]))


def fit_color(tiles: Tiles, axis: Doubles, run: Callable[[Planes], Iterated]) -> ColorFit:
    """Fit the lamp's colour to tiles of colour frames, specular light being polarized along ``axis`` of (s1, s2).

    ``run``: `iterate` or its fast twin, `color_kernel.iterate_fast`.
    """
    planes = planes_along(tiles, axis)
    x, votes, rest = run(planes)
    prior = np.eye(2) / SPREAD**2
    spread = np.linalg.inv(votes.sum(0) + prior)
    scatter = spread @ (rest.T @ rest + prior) @ spread
    scale = np.exp(-np.array([x[0], 0, x[1]]))
    along, diffuse = ((sums * (scale[:, None] * scale)).sum((1, 2)) for sums in (planes.qq, planes.dd))
    glossy = np.sqrt(np.maximum(along, 0) / np.maximum(diffuse, 1e-9))
    clear = glossy / np.sqrt(planes.spread)
    best = clear > np.quantile(clear, 0.75)
    halves = [run(Planes(*(np.ascontiguousarray(values[kept]) for values in planes)))[0] for kept in (best, ~best)]
    change = halves[0] - halves[1]
    cast = _cast_votes(planes, x, np.zeros(len(clear)))
    values = np.linalg.eigvalsh(cast.information).clip(0)
    power = (values / (1 + VOTE_ERROR**2 * values)).sum(1)
    power = power / max(float(power.sum()), 1e-12)
    k, light = cast.known / cast.certainty, np.einsum("tii,i->t", planes.dd, scale**2)
    light = np.minimum(light, np.median(light)).clip(0)
    lean = float(light @ k) / max(math.sqrt(float(light.sum()) * float(light @ k**2)), 1e-12)
    return ColorFit(x, scatter, float(power @ np.minimum(planes.across, 3)), change, lean)


def iterate(planes: Planes) -> Iterated:
    """Iterate the votes of all tiles to their robust mean, in NumPy."""
    x, k, prior = np.zeros(2), np.zeros(len(planes.spread)), np.eye(2) / SPREAD**2
    trust = 1 / (1 + (planes.across / ACROSS) ** 2)
    weights = trust
    for step in range(STEPS):
        cast = _cast_votes(planes, x, k)
        values, vectors = np.linalg.eigh(cast.information)
        values = values.clip(0)
        share = 1 / (1 + VOTE_ERROR**2 * values)
        turned = (vectors.swapaxes(1, 2) @ cast.pull[:, :, None])[:, :, 0] * (values > 0)
        if step:
            disagreement = (turned**2 * share / np.maximum(values, 1e-9)).sum(1)
            weights = trust * (FREEDOM + 2) / (FREEDOM + disagreement)
        votes = weights[:, None, None] * ((vectors * (values * share)[:, None, :]) @ vectors.swapaxes(1, 2))
        pulls = weights[:, None] * (vectors @ (turned * share)[:, :, None])[:, :, 0]
        change = np.linalg.solve(votes.sum(0) + prior, pulls.sum(0) - prior @ x)
        change *= min(1.0, LARGEST_STEP / max(float(np.abs(change).max()), 1e-12))
        x = x + change
        k = np.clip((cast.known - cast.coupling @ change) / cast.certainty, -MAX_K, MAX_K)
        if step > 3 and float(np.abs(change).max()) < LAST_STEP:
            break
    return x, votes, pulls - votes @ change


class Votes(NamedTuple):
    """Votes of T tiles: ``information [T, 2, 2]`` and ``pull [T, 2]`` on x, and what k follows from.

    ``k`` is ``(known - coupling x) / certainty``.
    """

    information: Doubles
    pull: Doubles
    known: Doubles
    coupling: Doubles
    certainty: Doubles


def _cast_votes(planes: Planes, x: Doubles, k: Doubles) -> Votes:
    """Linearised least squares of every tile at a colour and its k, with that k eliminated."""
    scale = np.exp(-np.array([x[0], 0, x[1]]))
    qq, qd, dd = (sums * (scale[:, None] * scale) for sums in (planes.qq, planes.qd, planes.dd))
    beside = _BESIDE @ dd @ _BESIDE.T
    whitener = np.linalg.inv(np.eye(2) + (planes.jitter / INDEPENDENT)[:, None, None] * beside)
    metric = _BESIDE.T @ whitener @ _BESIDE
    certainty = (metric * dd).sum((1, 2)).clip(0) + 1 / planes.spread
    # What remains of k adds to the power of S as noise does.
    unknown = (1 / certainty + planes.jitter)[:, None, None]
    times, dq = k[:, None, None], qd.swapaxes(1, 2)
    rest = qq - times * (qd + dq) + (times**2 - unknown) * dd
    power = rest.sum((1, 2)) / 9
    lit = power > 0
    power = power * lit
    to_diffuse = (qd - times * dd).sum(1) / 3 * lit[:, None]
    to_polarized = (qq - times * dq - unknown * dd).sum(1) / 3 * lit[:, None]
    rows = _RATIOS.T @ metric
    coupling = (rows @ to_diffuse[:, :, None])[:, :, 0]
    pull = (rows @ to_polarized[:, :, None])[:, :, 0]
    known = (metric * qd).sum((1, 2))
    information = power[:, None, None] * (rows @ _RATIOS)
    information = information - coupling[:, :, None] * (coupling / certainty[:, None])[:, None, :]
    pull = pull - coupling * (known / certainty)[:, None]
    return Votes(information, pull, known, coupling, certainty)
