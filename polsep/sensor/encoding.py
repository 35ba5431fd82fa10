"""Samples that are no longer linear light: gamma curves and JPEG, recognised in the mosaic itself.

* **Gamma.** Whatever the light, m0 + m90 = m45 + m135 behind four analysers 45 degrees apart. Behind a curve m^g the
  sum of the pair that differs more is too small: in second order m0 + m90 - m45 - m135 = (g - 1) / g (q^2 - u^2) / 4 m,
  with q = m0 - m90, u = m45 - m135 and the mean m, all encoded. The slope of one on the other is 0 for linear samples
  with any black level, -1.2 for the usual g of 1 / 2.2.
  The noise of light grows with it, as x^0.5 to 1 where shot noise is most of it; behind such a curve it falls.
* **JPEG** rounds the cosine transform of blocks of 8x8 pixels. In its own grid the finest waves of a mosaic are weaker
  than in the same grid moved by 4 pixels, one period of the filters; in raw data both are alike.

Source: both identities are elementary; the tests are this project's.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.sensor.black_level import smooth_blocks
from polsep.sensor.camera import Mosaic, first_frame
from polsep.sensor.layout_check import crossed_pairs, phase_cells, phase_means
from polsep.sensor.levels import saturates_early
from polsep.sensor.noise import MIN_SPAN

Floats = NDArray[np.float32]

#: Slopes of encoded samples, and how many standard errors they must be off 0.
MIN_SLOPE, MAX_SLOPE, MIN_ERRORS = -2.0, -0.55, 2.5
#: Exponent of the variance over the level below which samples may be encoded: linear frames have -0.3 and less where
#: all is texture, else 0.15 to 1.0, real ones 0.47 to 0.89; encoded ones -1.7 to 0.1.
MAX_EXPONENT = 0.3
#: Bins of brightness, least blocks of one, least level relative to white, and the least range of levels, as a log.
BINS, MIN_BLOCKS, MIN_LEVEL, MIN_RANGE = 12, 32, 0.02, 0.25
#: Strongest polarization, relative to brightness, that the second order describes; weakest that says anything.
MAX_DOLP, MIN_DOLP = 0.9, 0.05
#: White level of the codes that light given as floats once was.
USUAL_CODES = 4095.0
#: Fewest blocks with polarized light, and the side of the least frame.
MIN_CELLS, MIN_SIDE = 64, 64
#: White level of JPEG files.
JPEG_WHITE = 255.0
#: Side of a block of JPEG, most blocks that are looked at, and the ratio of waves below which they were rounded.
SIDE, BLOCKS, MAX_RATIO = 8, 8192, 0.87


def encoding_warning(mosaic: Mosaic, phases: Floats | None = None) -> str | None:
    """A line on samples that are gamma-encoded or were JPEG files, or None; the first frame of a batch."""
    slope = gamma_slope(mosaic, phases)
    bent = slope is not None and MIN_SLOPE < slope < MAX_SLOPE
    # Samples that clip below the white level contradict the analysers, too.
    bent = bent and not saturates_early(to_numpy(mosaic.data), mosaic.black_level, mosaic.white_level)
    rise = noise_exponent(mosaic) if bent else None
    if rise is not None and rise < MAX_EXPONENT:
        return (
            "the samples are gamma-encoded, as analysers and noise show: linear ones were expected; record with "
            "gamma off (1), or decode the frame first"
        )
    ratio = block_ratio(mosaic) if mosaic.white_level == JPEG_WHITE else None
    if ratio is not None and ratio < MAX_RATIO:
        return (
            "the samples were JPEG-compressed (blocks of 8x8 pixels): raw ones were expected; record PNG, TIFF or raw, "
            "compression costs up to 3 dB"
        )
    return None


def gamma_slope(mosaic: Mosaic, phases: Floats | None = None) -> float | None:
    """Slope of the analysers' contradiction, (g - 1) / g for samples encoded by m^g; None where light shows none."""
    pairs = crossed_pairs(mosaic.layout)
    if pairs is None or min(mosaic.data.shape[-2:]) < MIN_SIDE:
        return None
    cells = phase_cells(phase_means(mosaic) if phases is None else phases, mosaic.layout.origin)
    order = {"diagonals": (0, 3, 1, 2), "rows": (0, 1, 2, 3), "columns": (0, 2, 1, 3)}[pairs]
    a, b, c, d = (cells[:, k].ravel() for k in order)
    middle = (a + b + c + d) / 4
    kept = middle > MIN_LEVEL
    (p, r, s, t), mean = (np.array(values, np.float64)[..., kept] for values in ((a, b, c, d), middle))
    q, u = p - r, s - t
    polarized = np.hypot(q, u) / (2 * mean)
    kept = (polarized < MAX_DOLP) & (polarized > MIN_DOLP)
    if np.count_nonzero(kept) < MIN_CELLS:
        return None
    expected = ((q**2 - u**2) / (4 * mean))[kept]
    missed = (p + r - s - t)[kept]
    power = float((expected**2).sum())
    slope = float((expected * missed).sum()) / max(power, 1e-12)
    rest = missed - slope * expected
    error = float(np.sqrt((expected**2 * rest**2).sum())) / max(power, 1e-12)
    return slope if abs(slope) > MIN_ERRORS * error else 0.0


def noise_exponent(mosaic: Mosaic) -> float | None:
    """Exponent of the power of the level that the variance of smooth parts follows; None where levels are too alike.

    None for small frames, too.
    """
    if min(mosaic.data.shape[-2:]) < 8 * SIDE:
        return None
    level, variance = smooth_blocks(mosaic)
    level -= np.float32(mosaic.black_level)
    kept = level > MIN_LEVEL * (mosaic.white_level - mosaic.black_level)
    level, variance = level[kept], variance[kept]
    if level.size < BINS * MIN_BLOCKS:
        return None
    order = np.argsort(level)
    parts = np.array_split(order, BINS)
    span = mosaic.white_level - mosaic.black_level
    step = 1.0 if span >= MIN_SPAN else span / USUAL_CODES  # floats of white 1 once were codes
    points = np.log([[np.median(level[part]), np.quantile(variance[part], 0.1) + step**2 / 12] for part in parts])
    if np.ptp(points[:, 0]) < MIN_RANGE:
        return None
    return float(np.polyfit(points[:, 0], points[:, 1], 1)[0])


def block_ratio(mosaic: Mosaic) -> float | None:
    """Strength of the finest waves in blocks of 8x8 over that in blocks moved by 4; None for small frames."""
    x = to_numpy(first_frame(mosaic)).astype(np.float32, copy=False)
    if min(x.shape) < 8 * SIDE:
        return None
    number = np.arange(SIDE)
    waves = np.cos(np.pi / SIDE * np.outer(number, number + 0.5)) * np.where(number, 0.5, 0.125**0.5)[:, None]
    waves = waves.astype(np.float32)
    fine = number[:, None] + number >= SIDE + 1
    strengths = []
    for start in (0, SIDE // 2):
        rows, cols = ((n - SIDE) // SIDE for n in x.shape)
        step = max(1, rows * cols // BLOCKS)
        kept = x[start : start + SIDE * rows].reshape(rows, SIDE, -1)[::step, :, start : start + SIDE * cols]
        blocks = kept.reshape(-1, SIDE, cols, SIDE).swapaxes(1, 2).reshape(-1, SIDE, SIDE)
        blocks = blocks[blocks.max(axis=(1, 2)) > blocks.min(axis=(1, 2))]
        if len(blocks) < 64:
            return None
        strengths.append(float(np.median(np.abs(waves @ blocks @ waves.T)[:, fine])))
    return strengths[0] / strengths[1] if strengths[1] > 0 else None
