"""The robust fit of the lamp's colour, tile after tile: the fast twin of `color.iterate`."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import compiled, entry
from polsep.light.color import (
    ACROSS,
    FREEDOM,
    INDEPENDENT,
    LARGEST_STEP,
    LAST_STEP,
    MAX_K,
    SPREAD,
    STEPS,
    VOTE_ERROR,
    Iterated,
    Planes,
)

Doubles = NDArray[np.float64]

_A, _B = 1 / math.sqrt(2), 1 / math.sqrt(6)


def iterate_fast(planes: Planes) -> Iterated:
    """Iterate the votes of all tiles to their robust mean."""
    count = len(planes.spread)
    x, votes, rest = np.zeros(2), np.zeros((count, 3)), np.zeros((count, 2))
    iterate_tiles(tuple(np.ascontiguousarray(values) for values in planes), x, votes, rest)
    return x, votes[:, [[0, 1], [1, 2]]], rest


def warm_up() -> None:
    """Load the kernel, or compile it."""
    square, line = np.ones((1, 3, 3)), np.ones(1)
    iterate_fast(Planes(square, square, square, line, line, line))


@entry
def iterate_tiles(planes: Any, x: Any, votes: Any, rest: Any) -> None:
    """Log-ratios ``x [2]`` of the sums ``planes``, weighted ``votes [T, 3]`` (rr, rb, bb) and ``rest [T, 2]``.

    ``planes``: qq, qd, dd, spread, jitter, across as in `color.Planes`. ``x`` holds the start.
    """
    qq, qd, dd, spread, jitter, across = planes
    count = spread.size
    k, cast = np.zeros(count), np.zeros((count, 10))
    change0 = change1 = 0.0
    for step in range(STEPS):
        scale = np.array([math.exp(-x[0]), 1.0, math.exp(-x[1])])
        total = np.array([1 / SPREAD**2, 0.0, 1 / SPREAD**2, -x[0] / SPREAD**2, -x[1] / SPREAD**2])
        for t in range(count):
            _vote(qq[t], qd[t], dd[t], (spread[t], jitter[t], k[t]), scale, cast[t])
            _weigh(cast[t], across[t], step > 0)
            for i in range(5):
                total[i] += cast[t, i]
        determinant = total[0] * total[2] - total[1] * total[1]
        change0 = (total[2] * total[3] - total[1] * total[4]) / determinant
        change1 = (total[0] * total[4] - total[1] * total[3]) / determinant
        largest = max(abs(change0), abs(change1))
        shrink = min(1.0, LARGEST_STEP / max(largest, 1e-12))
        change0, change1 = change0 * shrink, change1 * shrink
        x[0] += change0
        x[1] += change1
        for t in range(count):
            own = (cast[t, 5] - cast[t, 6] * change0 - cast[t, 7] * change1) / cast[t, 8]
            k[t] = min(max(own, -MAX_K), MAX_K)
        if step > 3 and largest * shrink < LAST_STEP:
            break
    for t in range(count):
        for i in range(3):
            votes[t, i] = cast[t, i]
        rest[t, 0] = cast[t, 3] - cast[t, 0] * change0 - cast[t, 1] * change1
        rest[t, 1] = cast[t, 4] - cast[t, 1] * change0 - cast[t, 2] * change1


@compiled
def _vote(qq: Any, qd: Any, dd: Any, own: Any, scale: Any, cast: Any) -> None:
    """Information (rr, rb, bb), pull (r, b), and what k follows from (known, coupling, certainty) of a tile."""
    spread, jitter, k = own
    # dd in the two directions beside grey, and the inverse of one plus its jitter.
    aa = ab = bb = 0.0
    for i in range(3):
        for j in range(3):
            value = dd[i, j] * scale[i] * scale[j]
            ui, uj = _first(i), _first(j)
            vi, vj = _second(i), _second(j)
            aa += ui * value * uj
            ab += ui * value * vj
            bb += vi * value * vj
    share = jitter / INDEPENDENT
    w00, w01, w11 = 1 + share * aa, share * ab, 1 + share * bb
    determinant = w00 * w11 - w01 * w01
    w00, w01, w11 = w11 / determinant, -w01 / determinant, w00 / determinant
    certainty, known = 0.0, 0.0
    for i in range(3):
        for j in range(3):
            metric = _metric(w00, w01, w11, i, j) * scale[i] * scale[j]
            certainty += metric * dd[i, j]
            known += metric * qd[i, j]
    certainty = max(certainty, 0.0) + 1 / spread
    unknown = 1 / certainty + jitter
    power = 0.0
    p0 = p1 = p2 = d0 = d1 = d2 = 0.0
    for i in range(3):
        for j in range(3):
            both = scale[i] * scale[j]
            power += (qq[i, j] - k * (qd[i, j] + qd[j, i]) + (k * k - unknown) * dd[i, j]) * both
            to_diffuse = (qd[i, j] - k * dd[i, j]) * both / 3
            to_polarized = (qq[i, j] - k * qd[j, i] - unknown * dd[i, j]) * both / 3
            if j == 0:
                d0, p0 = d0 + to_diffuse, p0 + to_polarized
            elif j == 1:
                d1, p1 = d1 + to_diffuse, p1 + to_polarized
            else:
                d2, p2 = d2 + to_diffuse, p2 + to_polarized
    power /= 9
    if power <= 0:
        power = p0 = p1 = p2 = d0 = d1 = d2 = 0.0
    m00, m01, m02 = _metric(w00, w01, w11, 0, 0), _metric(w00, w01, w11, 0, 1), _metric(w00, w01, w11, 0, 2)
    m12, m22 = _metric(w00, w01, w11, 1, 2), _metric(w00, w01, w11, 2, 2)
    c0, c1 = m00 * d0 + m01 * d1 + m02 * d2, m02 * d0 + m12 * d1 + m22 * d2
    cast[0] = power * m00 - c0 * c0 / certainty
    cast[1] = power * m02 - c0 * c1 / certainty
    cast[2] = power * m22 - c1 * c1 / certainty
    cast[3] = m00 * p0 + m01 * p1 + m02 * p2 - c0 * known / certainty
    cast[4] = m02 * p0 + m12 * p1 + m22 * p2 - c1 * known / certainty
    cast[5], cast[6], cast[7], cast[8] = known, c0, c1, certainty


@compiled
def _weigh(cast: Any, across: float, robust: bool) -> None:
    """Limit a tile's information to what a vote may count, and weigh it by how well it agrees."""
    a, b, c = cast[0], cast[1], cast[2]
    middle, radius = (a + c) / 2, math.hypot((a - c) / 2, b)
    turn = 0.5 * math.atan2(2 * b, a - c)
    cosine, sine = math.cos(turn), math.sin(turn)
    large, small = max(middle + radius, 0.0), max(middle - radius, 0.0)
    one = cosine * cast[3] + sine * cast[4] if large > 0 else 0.0
    two = cosine * cast[4] - sine * cast[3] if small > 0 else 0.0
    share1, share2 = 1 / (1 + VOTE_ERROR**2 * large), 1 / (1 + VOTE_ERROR**2 * small)
    weight = 1 / (1 + (across / ACROSS) ** 2)
    if robust:
        disagreement = one * one * share1 / max(large, 1e-9) + two * two * share2 / max(small, 1e-9)
        weight *= (FREEDOM + 2) / (FREEDOM + disagreement)
    large, small = weight * large * share1, weight * small * share2
    one, two = weight * one * share1, weight * two * share2
    cast[0] = cosine * cosine * large + sine * sine * small
    cast[1] = cosine * sine * (large - small)
    cast[2] = sine * sine * large + cosine * cosine * small
    cast[3], cast[4] = cosine * one - sine * two, sine * one + cosine * two


@compiled
def _first(i: int) -> float:
    """First direction beside grey."""
    return _A if i == 0 else (-_A if i == 1 else 0.0)


@compiled
def _second(i: int) -> float:
    """Second direction beside grey."""
    return -2 * _B if i == 2 else _B


@compiled
def _metric(w00: float, w01: float, w11: float, i: int, j: int) -> float:
    """Element of the metric between colours beside grey."""
    a, b, c, d = _first(i), _second(i), _first(j), _second(j)
    return a * (w00 * c + w01 * d) + b * (w01 * c + w11 * d)
