"""Dead, hot and stuck pixels: found in one raw frame by their contradiction to everything around, and repaired.

A defect says nothing about light, so no neighbour shows it; light does, since every lens spreads a point over pixels.
Three steps, each a law of the sensor or the scene:

1. A *candidate* stands out of the eight nearest pixels of its own kind (analyser and colour, one period apart), of
   which one may be a defect itself, by more than noise does.
2. Every pixel is *predicted* from the other samples of 9x9 pixels, of all kinds: the best linear prediction (kriging)
   where s0, s1 and s2 of each colour are unknown constants plus a random texture that colours share. It is exact in
   even light of any colour and polarization: the four analysers of a cell obey m0 + m90 = m45 + m135.
3. A candidate is a *defect* if it differs from its prediction by more than noise and `RATIO` times more than any pixel
   within two of it does, once it is repaired: in textures and highlights the neighbours deviate too. And its next
   neighbours must not share its light, as they do under the sharpest lens (`SPREAD`). If another pixel spoils that,
   both may be defects: clusters of up to four are looked for, but for those of one 2x2 square, as points of light are.

Repairing puts the prediction in place; several defects in one window are predicted together, by the samples that are
left. Noise is measured in the frame (`noise`). Unit: that of the samples.
Source: the prediction is universal kriging (Matheron 1969); noise, Foi et al. 2008; the detector is this project's.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.arrays import of_kind, to_numpy
from polsep.compute.warm_up import make_ready
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.noise import (
    BLOCK,
    BLOCKS,
    LARGEST_WELL,
    MIN_BLOCKS,
    Levels,
    Noise,
    blocks_of,
    code_step,
    estimate_noise,
    least_noise,
)

if TYPE_CHECKING:
    from polsep.sensor.defects_kernel import Predictor, Rules

Floats = NDArray[np.float32]
Places = NDArray[np.int64]
Place = tuple[int, int]

#: Standard deviations by which a candidate stands out of its own kind, and a defect from its prediction.
CANDIDATE, CONFIRMED = 4.0, 6.0
#: Least difference of a defect to its prediction, over the largest one around it; the same of all in a cluster.
RATIO, CLUSTER_RATIO = 3.0, 8.0
#: Least light of its four neighbours, over its own, that shows a point of light behind a lens. Under a Gaussian of
#: 0.3 pixels, as sharp as lenses are, a point in the middle of a pixel gives them 0.095 of its light at DoLP 1.
SPREAD = 0.06
#: Distance [pixels] over which textures stay alike, correlation of two colours' textures, their degree of
#: polarization, and the noise that a prediction allows for, relative to the texture.
LENGTH, CORRELATION, POLARIZATION, ALLOWANCE = 3.0, 0.95, 0.5, 0.02
#: Rounds of finding: defects near others are found once these are repaired.
ROUNDS = 3
#: Samples along the sides of the least frame in which defects are looked for.
MIN_SIZE = 16


def remove_defects(mosaic: Mosaic) -> tuple[Mosaic, int]:
    """The frame ``[H, W]`` with its defects repaired, and their number; the same object where there are none.

    Raises ValueError on a batch.
    """
    places, repaired = _find(mosaic)
    if not len(places):
        return mosaic, 0
    return replace(mosaic, data=of_kind(repaired, mosaic.data)), len(places)


def find_defects(mosaic: Mosaic) -> NDArray[np.bool_]:
    """Mask ``[H, W]`` of the dead, hot and stuck pixels of one frame; empty for frames smaller than `MIN_SIZE`.

    Raises ValueError on a batch.
    """
    places, _ = _find(mosaic)
    mask = np.zeros(mosaic.data.shape, np.bool_)
    mask[places[:, 0], places[:, 1]] = True
    return mask


def find_lasting_defects(frames: Iterable[Mosaic]) -> NDArray[np.bool_] | None:
    """Mask ``[H, W]`` of what is a defect in more than half of some frames of one size; None without frames.

    Highlights move from frame to frame, defects do not.
    """
    votes, count = np.zeros(0, np.int64), 0
    for frame in frames:
        found = find_defects(frame)
        votes, count = (votes + found if count else found.astype(np.int64)), count + 1
    return 2 * votes > count if count else None


def repair(mosaic: Mosaic, mask: NDArray[np.bool_]) -> Mosaic:
    """The frame ``[H, W]`` with the samples of ``mask [H, W]`` predicted from all others; those stay bit for bit.

    Raises ValueError on a batch, a mask of another size, and frames smaller than `MIN_SIZE`.
    """
    from polsep.sensor import defects_kernel as kernel

    x = _samples(mosaic)
    if mask.shape != x.shape or min(x.shape) < MIN_SIZE:
        sizes = " and ".join("x".join(map(str, shape)) for shape in (x.shape, mask.shape))
        raise ValueError(f"expected a frame of at least {MIN_SIZE}x{MIN_SIZE} and a mask of its size, found {sizes}")
    make_ready(kernel.warm_up)
    x = x.copy()
    kernel.fill(x, make_predictor(mosaic.layout, x.shape), mosaic.clip_level, np.argwhere(mask))
    return replace(mosaic, data=of_kind(x, mosaic.data))


def _find(mosaic: Mosaic) -> tuple[Places, Floats]:
    """Places ``[N, 2]`` of the defects of a frame, and its samples, repaired where there are any."""
    from polsep.sensor import defects_kernel as kernel

    x = _samples(mosaic)
    places = np.empty((0, 2), np.int64)
    if min(x.shape) < MIN_SIZE:
        return places, x
    make_ready(kernel.warm_up)
    rules, predictor = make_rules(mosaic, x), make_predictor(mosaic.layout, x.shape)
    candidates, repaired = kernel.find_candidates(x, rules), x
    for _ in range(ROUNDS):
        new = kernel.confirm(repaired, predictor, rules, candidates)
        if not len(new):
            break
        places = np.unique(np.concatenate([places, new]), axis=0)
        if repaired is x:
            repaired = pages.empty(x.shape, x.dtype.type)
            repaired[:] = x
        repaired[places[:, 0], places[:, 1]] = x[places[:, 0], places[:, 1]]
        kernel.fill(repaired, predictor, float(rules.clip), places)
        candidates = _near(candidates, new, places, x.shape)
    return places, repaired


def find_defects_reference(mosaic: Mosaic) -> NDArray[np.bool_]:
    """One round of `find_defects` in NumPy, slowly: the readable twin of the kernels."""
    x = _samples(mosaic)
    rules, predictor = make_rules(mosaic, x), make_predictor(mosaic.layout, x.shape)
    window = Window(x, predictor, float(rules.clip))
    mask = np.zeros(x.shape, np.bool_)
    for place in np.argwhere(stands_out(x, rules)).tolist():
        for found in grow_cluster(window, rules, (place[0], place[1])):
            mask[found] = True
    return mask


def stands_out(x: Floats, rules: Rules) -> NDArray[np.bool_]:
    """Samples ``[H, W]`` beyond the second largest or smallest of their 8 neighbours of one kind, by more than noise.

    Beyond the border, the neighbour on the other side counts twice.
    """
    p, (height, width) = rules.period, x.shape
    rows, cols = (np.arange(n)[None] + np.array([-p, 0, p])[:, None] for n in x.shape)
    rows, cols = (np.where((k < 0) | (k >= n), 2 * np.arange(n) - k, k) for k, n in ((rows, height), (cols, width)))
    around = [x[rows[a]][:, cols[b]] for a in range(3) for b in range(3) if (a, b) != (1, 1)]
    ordered = np.sort(np.stack(around), axis=0)
    low, high = ordered[1], ordered[-2]
    excess = np.maximum(x - high, low - x)
    variance = rules.gain * np.maximum(high - rules.black, 0) + rules.floor
    found: NDArray[np.bool_] = (excess > 0) & (excess**2 > rules.candidate**2 * variance)
    return found


@dataclass(frozen=True)
class Window:
    """Samples ``x [H, W]``, and their ``predictor``; samples of ``clip`` and more are clipped."""

    x: Floats
    predictor: Predictor
    clip: float

    def coefficients(self, place: Place) -> tuple[Floats, Place, float]:
        """Coefficients ``[9, 9]`` of the residual of a pixel, the first place of the window, and its noise."""
        from polsep.sensor.defects_kernel import MIN_CLIPPED, SIDE

        first = [min(max(i - SIDE // 2, 0), n - SIDE) for i, n in zip(place, self.x.shape, strict=True)]
        case = [
            i if i < 4 else 12 + i - n if i >= n - 4 else 4 + i % 4 for i, n in zip(place, self.x.shape, strict=True)
        ]
        samples = self.x[first[0] : first[0] + SIDE, first[1] : first[1] + SIDE]
        at = (int(np.count_nonzero(samples >= self.clip) >= MIN_CLIPPED), case[0], case[1])
        table, spread = self.predictor.coefficients[at], self.predictor.spread[at]
        return table.reshape(SIDE, SIDE), (first[0], first[1]), float(spread)

    def residual(self, place: Place) -> float:
        """The sample of a pixel minus its prediction from all others of the window."""
        table, (top, left), _ = self.coefficients(place)
        return float((self.x[top : top + len(table), left : left + len(table)] * table).sum())

    def factor(self, place: Place, other: Place) -> float:
        """The coefficient of the sample of another pixel in the residual of one."""
        table, (top, left), _ = self.coefficients(place)
        a, b = other[0] - top, other[1] - left
        return float(table[a, b]) if 0 <= a < len(table) and 0 <= b < len(table) else 0.0


def grow_cluster(window: Window, rules: Rules, place: Place) -> list[Place]:
    """The cluster of defects around a candidate, or nothing: the worst pixel around it joins until all others agree."""
    from polsep.sensor.defects_kernel import MAX_UNEVEN, MOST

    places = [place]
    while len(places) <= MOST:
        factors = np.array([[window.factor(one, other) for other in places] for one in places])
        excess = np.linalg.solve(factors, [window.residual(one) for one in places])
        for one, own in zip(places, excess, strict=True):
            light = max(float(window.x[one]) - own - float(rules.black), 0)
            noise = (rules.gain * light + rules.floor) ** 0.5 * window.coefficients(one)[2]
            if abs(own) <= rules.confirmed * noise:
                return []
        rest = _rest_around(window, places, excess)
        ratio = rules.ratio if len(places) == 1 else rules.cluster_ratio
        uneven = [one for one, value in rest.items() if abs(value) > np.abs(excess).min() / ratio]
        if not uneven:
            spread = rules.spread if len(places) == 1 else rules.spread / 2
            square = len(places) > 2 and max(max(v) - min(v) for v in zip(*places, strict=True)) == 1
            return [] if square or _light_around(rest, places, excess) >= spread else places
        if len(uneven) > MAX_UNEVEN:
            return []
        places = [*places, max(uneven, key=lambda one: abs(rest[one]))]
    return []


def _rest_around(window: Window, places: list[Place], excess: NDArray[np.float64]) -> dict[Place, float]:
    """Residuals of the pixels around some places, once these are repaired."""
    from polsep.sensor.defects_kernel import RING

    spans = [
        range(max(min(values) - RING, 0), min(max(values) + RING + 1, n))
        for values, n in zip(zip(*places, strict=True), window.x.shape, strict=True)
    ]
    around = [(i, j) for i in spans[0] for j in spans[1] if (i, j) not in places]
    return {
        one: window.residual(one) - sum(window.factor(one, k) * own for k, own in zip(places, excess, strict=True))
        for one in around
    }


def _light_around(rest: dict[Place, float], places: list[Place], excess: NDArray[np.float64]) -> float:
    """Share of the excess of some places that the next pixels have too; 0 where it may be noise or texture."""
    from polsep.sensor.defects_kernel import SIGNIFICANT, SIGNIFICANT_CLUSTER

    light, power, near, far = 0.0, 0.0, 0, 0
    for one, value in rest.items():
        steps = [abs(one[0] - k[0]) + abs(one[1] - k[1]) for k in places]
        if min(steps) == 1:
            light += value * np.sign(excess[int(np.argmin(steps))])
            near += 1
        elif min(steps) > 2:
            power += value**2
            far += 1
    significant = SIGNIFICANT if len(places) == 1 else SIGNIFICANT_CLUSTER
    if not far or light**2 <= significant * power * near / far:
        return 0.0
    return light / float(np.abs(excess).sum())


def repair_reference(mosaic: Mosaic, mask: NDArray[np.bool_]) -> Mosaic:
    """`repair` by one system of equations: at the repaired samples all their residuals are 0."""
    window = Window(_samples(mosaic).copy(), make_predictor(mosaic.layout, mask.shape), mosaic.clip_level)
    places = [(int(i), int(j)) for i, j in np.argwhere(mask)]
    factors = np.array([[window.factor(one, other) for other in places] for one in places])
    excess = np.linalg.solve(factors, [window.residual(one) for one in places])
    for one, own in zip(places, excess, strict=True):
        window.x[one] -= own
    return replace(mosaic, data=of_kind(window.x, mosaic.data))


def _samples(mosaic: Mosaic) -> Floats:
    """The samples of one frame in their own unit. Raises ValueError on a batch."""
    if mosaic.data.ndim != 2:
        raise ValueError(f"expected one frame [H, W], found {tuple(mosaic.data.shape)}")
    return np.ascontiguousarray(to_numpy(mosaic.data), np.float32)


def _near(candidates: Places, new: Places, known: Places, shape: tuple[int, ...]) -> Places:
    """The candidates that are not ``known`` and whose residuals may depend on one of the ``new`` defects."""
    reach = -(-8 // BLOCK)
    blocks = np.zeros([-(-n // BLOCK) + 2 * reach for n in shape], np.bool_)
    for row in range(2 * reach + 1):
        for col in range(2 * reach + 1):
            blocks[new[:, 0] // BLOCK + row, new[:, 1] // BLOCK + col] = True
    near = candidates[blocks[candidates[:, 0] // BLOCK + reach, candidates[:, 1] // BLOCK + reach]]
    numbers, taken = (places[:, 0] * shape[1] + places[:, 1] for places in (near, known))
    return near[~np.isin(numbers, taken)]


def make_rules(mosaic: Mosaic, x: Floats) -> Rules:
    """The numbers of the kernels for samples ``x [H, W]``, by the noise that the frame shows."""
    from polsep.sensor.defects_kernel import Rules

    noise = measure_noise(mosaic, x)
    levels = (noise.gain, noise.floor, mosaic.black_level, mosaic.clip_level)
    numbers = (*levels, CANDIDATE, CONFIRMED, RATIO, CLUSTER_RATIO, SPREAD)
    return Rules._make([*(np.float32(number) for number in numbers), mosaic.layout.period])


def measure_noise(mosaic: Mosaic, x: Floats) -> Noise:
    """Noise of samples ``x [H, W]``; that of exact samples where nothing shows it."""
    black, white = float(mosaic.black_level), float(mosaic.white_level)
    levels = Levels(black, white, code_step(x, white - black), mosaic.clip_level)
    whole = x[: x.shape[0] // BLOCK * BLOCK, : x.shape[1] // BLOCK * BLOCK]
    noise = estimate_noise(whole, None, levels, 0) or least_noise(levels)
    dark = _dark_variance(whole, levels)
    return Noise(max(noise.gain, levels.span / LARGEST_WELL), noise.floor if dark is None else dark)


def _dark_variance(x: Floats, levels: Levels) -> float | None:
    """Variance of black samples, half of whose noise is cut off at zero; None where few blocks are black."""
    step = max(1, x.shape[0] * x.shape[1] // BLOCK**2 // BLOCKS)
    blocks = blocks_of(x.reshape(-1, BLOCK, x.shape[1])[::step].reshape(-1, x.shape[1]))
    black = blocks[np.count_nonzero(blocks <= levels.black, axis=-1) >= BLOCK**2 // 4]
    if len(black) < MIN_BLOCKS:
        return None
    square = float(np.median(np.square(np.maximum(black - levels.black, 0)).mean(axis=-1)))
    return max(2 * square, least_noise(levels).floor)


def make_predictor(layout: Layout, shape: tuple[int, ...]) -> Predictor:
    """Coefficients of residuals for frames of a shape."""
    return _predictor(layout, shape[0] % 4, shape[1] % 4)


@lru_cache(maxsize=8)
def _predictor(layout: Layout, rows: int, cols: int) -> Predictor:
    from polsep.sensor.defects_kernel import Predictor

    (tops, middles_y), (lefts, middles_x) = (np.array(_window_places(16 + extra)).T for extra in (rows, cols))
    middles = 9 * middles_y[:, None] + middles_x
    kept = np.ascontiguousarray(_residuals(layout)[:, tops[:, None] % 4, lefts % 4, middles])
    return Predictor(kept.astype(np.float32), np.sqrt((kept**2).sum(-1)).astype(np.float32))


def _window_places(size: int) -> list[tuple[int, int]]:
    """First row of the window, and row in it, for the twelve cases of `defects_kernel.Predictor`."""
    return [*((0, i) for i in range(4)), *((i, 4) for i in range(4, 8)), *((size - 9, i) for i in range(5, 9))]


def _residuals(layout: Layout) -> NDArray[np.float64]:
    """Coefficients ``[2, 4, 4, 81, 81]`` by table, first row and column of the window modulo 4, sample and others."""
    y, x = np.divmod(np.arange(81), 9)
    at = (np.arange(4)[:, None, None] + y) % 4, (np.arange(4)[:, None] + x) % 4
    angle = np.radians([[place.angle_deg for place in row] for row in layout.table()])[at]
    color = np.array([[place.channel for place in row] for row in layout.table()])[at]
    same = (angle[..., None] == angle[..., None, :]) & (color[..., None] == color[..., None, :])
    alike = np.where(color[..., None] == color[..., None, :], 1.0, CORRELATION)
    mix = 0.25 * (1 + POLARIZATION**2 * np.cos(2 * (angle[..., None] - angle[..., None, :])))
    distance = np.hypot(y[:, None] - y, x[:, None] - x)
    covariance = np.exp(-distance / LENGTH) * alike * mix + ALLOWANCE**2 * np.eye(81)
    shapes = np.stack([np.ones_like(angle), np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    drift = np.concatenate([shapes * (color == c)[..., None] for c in np.unique(color)], axis=-1)
    kinds = np.unique(np.stack([color, angle], axis=-1).reshape(-1, 2), axis=0)
    constant = np.stack([(color == c) & (angle == t) for c, t in kinds], axis=-1)
    return np.stack([_kriging(covariance, drift), _kriging(covariance * same, constant)])


def _kriging(covariance: NDArray[np.float64], drift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients of each sample's residual, in rows: 1 for itself, minus the weights that predict it from the others.

    ``covariance [..., n, n]`` of the samples; ``drift [..., n, k]``: what unknown constants add to them.
    Source: O. Dubrule, "Cross validation of kriging in a unique neighborhood", Math. Geology 15, 1983.
    """
    inverse = np.linalg.inv(covariance)
    share = inverse @ drift
    inverse -= share @ np.linalg.solve(drift.mT @ share, share.mT)
    return inverse / np.diagonal(inverse, axis1=-2, axis2=-1)[..., None]
