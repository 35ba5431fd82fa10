"""Check that light from inside a body is polarized along the slope of its shading, as it is on convex objects.

Light that leaves a surface from inside is polarized in the plane that holds the normal and the view: its AoLP points
where the surface tilts. There brightness falls or rises too, above all at outlines. Across all of a frame AoLP and the
gradient of brightness therefore agree, whatever the lamp. A frame that was transposed or turned by 180 degrees, read in
the layout it had before, shows them at right angles.

In colour frames p_c = a s0_c + b (docs/conventions.md): how p = s1 + i s2 varies with s0 over the colours gives a, the
polarization from inside, without the specular light. Mono frames have no such contrast, and are not judged.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.compute.warm_up import make_ready
from polsep.sensor import periods_kernel
from polsep.sensor.camera import CLIP_MARGIN, PERIOD, Filter, Layout, Mosaic, first_frame
from polsep.sensor.periods_kernel import sum_periods

Floats = NDArray[np.float32]

#: Pixels along the sides of the smallest blocks, in frames of up to `SIDE` pixels; a multiple of it in larger ones.
BLOCK, SIDE = 4, 1024
#: How many sizes of blocks have to agree, each twice the one before.
SIZES = 3
#: Blocks of less than this share of the mean brightness are background.
BACKGROUND = 0.05
#: DoLP that only specular light of a polarized lamp has, and the share of blocks that show it. Real frames under
#: ordinary light, whose specular light is polarized across slopes too: up to 1 %; under one lamp 2.6 % and more.
SPECULAR, MIN_SPECULAR = 0.3, 0.012
#: The mean agreement, from which on it is no accident of the scene, and over its spread, no chance. Clean frames of
#: `python -m evaluation warned`, their crops and their quarters lie above -3.3.
MIN_AGREEMENT, CERTAIN = 0.1, 3.5


def lies_across(mosaic: Mosaic) -> bool:
    """True if the polarization from inside lies across the slopes in the frame (the first of a batch), beyond doubt.

    False where nothing can be judged: mono frames, light without a polarizer, grey, flat, black and small objects.
    """
    top, left = mosaic.layout.origin
    frame = first_frame(mosaic)[top:, left:]
    side = BLOCK * -(-max(frame.shape) // SIDE)
    most = 1 << SIZES - 1
    if mosaic.layout.bayer is None or min(frame.shape) < 4 * most * side:
        return False
    make_ready(periods_kernel.warm_up)
    layout = replace(mosaic.layout, origin=(0, 0))
    levels = [_block_means(mosaic, to_numpy(frame), side, most)]
    for _ in range(1, SIZES):
        levels.append(_halve(*levels[-1]))
    for number in reversed(range(SIZES)):  # the widest blocks first: they are few, and on most frames enough
        agreement, certainty = slope_agreement(*levels[number], layout, side << number)
        if agreement > -MIN_AGREEMENT or certainty > -CERTAIN:
            return False
    return _specular_share(levels[0][0], layout) > MIN_SPECULAR


def _specular_share(phases: Floats, layout: Layout) -> float:
    """Share of lit blocks whose light is more polarized than light from inside."""
    s0, p = _fit_colors(phases, layout)
    total, polarized = s0.mean(0), np.abs(p.mean(0))
    return float((polarized > SPECULAR * total)[total > BACKGROUND * total.mean()].mean())


def _block_means(mosaic: Mosaic, frame: NDArray[np.generic], side: int, most: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Means ``[4, 4, rows, cols]`` of each pixel of the period over blocks, linear, and blocks where nothing clips.

    Numbers of blocks are multiples of ``most``. Of blocks of several periods the first rows alone are read.
    """
    rows, cols = (n // (side * most) * most for n in frame.shape)
    sums, brightest = sum_periods(frame[: rows * side], side, PERIOD)
    span, black = np.float32(mosaic.white_level - mosaic.black_level), np.float32(mosaic.black_level)
    means = sums[..., :cols] / np.float32(side // PERIOD)
    usable: NDArray[np.bool_] = (brightest[:, :cols] - black) / span < 1 - CLIP_MARGIN
    return (means - black) / span, usable


def _halve(means: Floats, usable: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
    """The same for blocks of twice the side."""
    rows, cols = (n // 2 for n in usable.shape)
    whole: NDArray[np.bool_] = np.all(usable.reshape(rows, 2, cols, 2), axis=(1, 3))
    pairs = means[..., ::2, :] + means[..., 1::2, :]
    return np.float32(0.25) * (pairs[..., ::2] + pairs[..., 1::2]), whole


def slope_agreement(phases: Floats, usable: NDArray[np.bool_], layout: Layout, side: int) -> tuple[float, float]:
    """Agreement of AoLP and slope over all blocks, in [-1, 1], and over its spread: negative where they lie across.

    ``phases [4, 4, rows, cols]``: means of each pixel of the 4x4 period over blocks of ``side`` pixels, linear.
    """
    brightness = phases.mean((0, 1))
    mean = max(float(brightness.mean()), 1e-9)
    down, right = np.gradient(brightness)
    place = (np.arange(4, dtype=np.float32) - 1.5) / side
    shift = place[:, None, None, None] * down + place[None, :, None, None] * right
    s0, p = _fit_colors(phases - phases.mean((2, 3), keepdims=True) / mean * shift, layout)
    total, polarized = s0.mean(0), np.abs(p.mean(0))
    s0, p = s0 - total, p - p.mean(0)
    contrast = np.sqrt((s0 * s0).sum(0))
    steepness = np.hypot(down, right)
    toward = (right + 1j * down) ** 2 / np.maximum(steepness, 1e-12) ** 2  # conjugate: rows grow down, angles up
    weight = np.minimum(steepness / np.maximum(brightness, 0.1 * mean), 1)
    kept = usable & (brightness > BACKGROUND * mean) & (polarized < SPECULAR * total) & (contrast > 0)
    along = ((s0 * p).sum(0) * toward).real / np.maximum(contrast, 1e-9) * weight * kept
    whole, size, spread = float(along.sum()), float(np.abs(along).sum()), float(np.sqrt((along**2).sum()))
    return whole / max(size, 1e-12), whole / max(spread, 1e-12)


def _fit_colors(phases: Floats, layout: Layout) -> tuple[Floats, NDArray[np.complex64]]:
    """s0 and p of the three colours ``[3, rows, cols]``, of analysers 45 degrees apart."""
    s0 = np.zeros((3, *phases.shape[2:]), np.float32)
    p = np.zeros(s0.shape, np.complex64)
    filters = layout.table()
    for row, at in enumerate(filters):
        for col, filter_ in enumerate(at):
            share = np.float32(4 if filter_.channel != 1 else 8)
            s0[filter_.channel] += 2 * phases[row, col] / share
            p[filter_.channel] += (
                4 * phases[row, col] / share * np.complex64(np.exp(2j * np.radians(filter_.angle_deg)))
            )
    return s0, p


def turned_across(layout: Layout) -> Layout:
    """The layout with every analyser 90 degrees on: where ``layout`` puts AoLP across, this one puts it along."""
    return Layout.from_table([[Filter((f.angle_deg + 90) % 180, f.channel) for f in row] for row in layout.table()])
