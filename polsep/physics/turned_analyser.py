"""Angles and exposures of photographs behind one turned analyser, from the photographs themselves.

Photograph k sees m_k = (s0 + s1 cos 2t_k + s2 sin 2t_k) / 2 in every pixel and colour. So the matrix of all samples,
one row per photograph, is a product of rank 3: rows (1, cos 2t_k, sin 2t_k) / 2 times Stokes vectors. Its column space,
which the `gram` matrix holds, says what the pictures can say about the angles: the rows lie on an ellipse of a plane,
and the one affine map that makes it the unit circle gives them. Open remain a common *roll* (where 0 lies) and a
*mirror* (the sense of turning), which change AoLP but neither s0 nor DoLP. An ellipse needs five photographs, and
light of several directions of polarization. Exposures must be equal or known: with unknown ones there is a family of
solutions, since Lorentz boosts map the cone of Stokes vectors onto itself.

Angles are refined by weighted subspace fitting, which reaches the least possible error for many pixels.
Source: Viberg and Ottersten 1991, Sensor array processing based on subspace fitting, Sec. IV (the weights); the rest
is elementary.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.least_squares import least_squares
from polsep.physics.stokes import analyser_matrix

Doubles = NDArray[np.float64]

#: Fewest photographs whose angles can be found.
LEAST_FOR_ANGLES = 5
#: Share of the largest eigenvalue of a `gram` matrix below which others are rounding.
ROUNDING = 1e-12
#: Range of samples whose ratio says something, and the width over which ratios count as one, as a log.
USABLE, RATIO_WIDTH = (0.02, 0.95), 0.02


class Turned(NamedTuple):
    """Angles ``[K]`` [rad] with the first one at 0, and the rms ``error`` of the others that noise causes."""

    angles: tuple[float, ...]
    error: float


def gram(samples: NDArray[np.floating]) -> tuple[Doubles, int]:
    """Products ``[K, K]`` of photographs ``[K, N]`` with each other, summed over their N samples; and N."""
    doubles = samples.astype(np.float64)
    return doubles @ doubles.T, samples.shape[1]


def find_angles(products: Doubles, count: int) -> Turned:
    """Angles in [0, pi) of K photographs from their `gram` matrix over ``count`` samples, up to a roll and a mirror.

    By convention the first is 0 and the second lies below pi / 2. The error is large or infinite where the polarization
    of all pixels lies along one direction, and infinite where fewer than `LEAST_FOR_ANGLES` photographs differ by more
    than noise: rows of fewer angles, however many they are, lie on many ellipses. Raises ValueError on fewer of them.
    """
    number = len(products)
    if number < LEAST_FOR_ANGLES:
        raise ValueError(f"expected at least {LEAST_FOR_ANGLES} photographs to find their angles in, found {number}")
    signal, noise = _signal(products, count)
    turns = np.arange(1, number, dtype=np.float64) * np.float64(math.pi / number)
    starts = [start for start in (_angles_on_ellipse(signal), turns, 2 * turns) if start is not None]
    found, error = min((_fit(signal, noise, start) for start in starts), key=lambda fit: fit[2])[:2]
    if _count_different(products, noise * count) < LEAST_FOR_ANGLES:
        error = math.inf
    angles = np.concatenate([[0.0], found])
    if math.sin(2 * angles[1]) < 0:
        angles = -angles
    return Turned(tuple(float(t) % math.pi % math.pi for t in angles), error)


def find_pair_exposure(parallel: NDArray[np.floating], crossed: NDArray[np.floating]) -> float:
    """Exposure of the parallel photograph over the crossed one's, from samples ``[...]`` of both, white = 1.

    Specular light only ever adds to the parallel one, and most samples of most scenes have little of it: so the ratio
    of exposures is the most frequent ratio of samples. Broad highlights and polarized diffuse light move it, by 5 % as
    a rule (docs/experiments.md). Raises ValueError where fewer than a hundred samples are bright and unclipped.
    """
    least, most = USABLE
    usable = (np.minimum(parallel, crossed) > least) & (np.maximum(parallel, crossed) < most)
    logs = np.log(parallel[usable] / crossed[usable])
    if logs.size < 100:
        raise ValueError(f"expected bright photographs to compare their exposures, found {logs.size} usable samples")
    step = RATIO_WIDTH / 4
    edges = np.arange(-4, 4, step)
    count = np.histogram(logs, edges)[0]
    kernel = np.exp(-0.5 * (np.arange(-16, 17) / 4) ** 2)
    smooth = np.convolve(count, kernel, "same")
    top = int(smooth.argmax())
    below, middle, above = smooth[top - 1], smooth[top], smooth[top + 1]
    offset = 0.5 * (below - above) / (below - 2 * middle + above)  # the parabola through the three
    return math.exp(edges[top] + step * (0.5 + offset))


def _count_different(products: Doubles, noise: float) -> int:
    """Number of photographs that differ from each other: by more than twice what ``noise``, of each, makes differ."""
    power = np.diag(products)
    apart = power[:, None] + power - 2 * products  # sums of (m_k - m_l)^2
    least, different = max(4 * noise, ROUNDING * float(power.max())), list[int]()
    for k, row in enumerate(apart):
        if all(row[other] > least for other in different):
            different.append(k)
    return len(different)


def _signal(products: Doubles, count: int) -> tuple[Doubles, float]:
    """Basis ``[K, 3]`` of the column space, weighted by how well each direction is known, and the noise variance."""
    values, vectors = np.linalg.eigh(products)
    level = float(values[:-3].mean())
    strength = np.clip(values[-3:] - level, 0, None) / np.sqrt(np.clip(values[-3:], 1e-300, None))
    strength[values[-3:] < ROUNDING * values[-1]] = 0.0
    return vectors[:, -3:] * strength, max(level, 0.0) / count


def _angles_on_ellipse(signal: Doubles) -> Doubles | None:
    """Angles of photographs 1 to K - 1 relative to photograph 0; None where the rows lie on no ellipse."""
    scale = np.linalg.norm(signal, axis=0)
    if scale.min() < 1e-9 * scale.max():
        return None
    rows = signal / scale
    plane = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    across = np.linalg.svd(plane[None])[2][1:]
    x, y = (rows @ across.T).T
    a, b, c, d, e, f = np.linalg.svd(np.stack([x * x, x * y, y * y, x, y, np.ones_like(x)], axis=1))[2][-1]
    form = np.array([[a, b / 2], [b / 2, c]])
    if np.linalg.det(form) <= 0:
        return None
    centre = np.linalg.solve(form, [-d / 2, -e / 2])
    form = form / (centre @ form @ centre - f)
    if np.trace(form) <= 0:
        return None
    u, v = np.linalg.cholesky(form).T @ (np.stack([x, y]) - centre[:, None])
    turned = np.arctan2(v, u) / 2
    return np.asarray(turned[1:] - turned[0])


def _fit(signal: Doubles, noise: float, start: Doubles) -> tuple[Doubles, float, float]:
    """Angles of photographs 1 to K - 1 whose analysers span the signal best, their rms error, and the misfit."""

    def residuals(x: Doubles) -> Doubles:
        basis = np.linalg.qr(analyser_matrix([0.0, *x]))[0]
        return np.asarray(signal - basis @ (basis.T @ signal)).reshape(-1)

    x, jacobian = least_squares(residuals, start)
    normal, misfit = jacobian.T @ jacobian, float((residuals(x) ** 2).sum())
    if np.linalg.cond(normal) > 1e12:
        return x, math.inf, misfit
    return x, math.sqrt(noise * float(np.diag(np.linalg.inv(normal)).mean())), misfit
