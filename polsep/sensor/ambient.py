"""Signs that a frame that is subtracted as the room's light is not that: the lamp was on, or its unit is another.

A lamp as bright as in the frame leaves nothing. A dimmer one leaves highlights that are polarized as those of the
ambient frame are: of one lamp. Those of a room lie elsewhere, or are polarized at other angles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.physics.stokes import stokes_inverse
from polsep.sensor.camera import Layout, Mosaic, clip_level
from polsep.sensor.levels import CODE_ERROR, LIT, MOST_FLOAT, OtherUnit

Floats = NDArray[np.float32]
#: Part of a lit sample's light that ambient light leaves at least, and the share of lit samples with less from which on
#: the ambient frame was taken with the lamp on.
LEAST_LEFT, MOST_GONE = 0.05, 0.5
#: Side of blocks of samples in pixels, of which highlights count: polarized light of more than this share of the
#: strongest and of white. Fewest blocks, and samples of a frame above which only some rows of blocks are looked at.
SIDE, STRONG, LEAST, MIN_BLOCKS, MANY = 8, 0.3, 0.01, 12, 2**20
#: Least concentration of the angles of highlights, so that they are a lamp's and no rims; least correlation of their
#: polarized light with that of the ambient frame, and least part of it there. In 10 stages of `datasets.reality` in a
#: room, ambient frames with the lamp off have 0.40 at most where highlights are so concentrated, with a lamp of a fifth
#: of its light 0.63 to 0.996.
ONE_LAMP, ALIKE, LEAST_PART = 0.5, 0.8, 0.02
#: Exposure times within this factor are equal.
EQUAL = 1.02
#: Codes of 16-bit words.
WORDS = 65536


class CodeScale(NamedTuple):
    """The power of two of which all codes of 16 bits are multiples, 0 where unknown, and the largest code."""

    step: int
    largest: float


UNKNOWN_SCALE = CodeScale(0, 0.0)


def code_scale(mosaic: Mosaic) -> CodeScale:
    """The scale of a raw frame, by every fifth sample of every fifth row; it is unknown of frames of one code.

    Floats of a white level of about 1 are codes of some bits over the largest of these.
    """
    samples = to_numpy(mosaic.data)[..., ::5, ::5]
    if mosaic.white_level <= MOST_FLOAT:
        return _float_scale(samples.astype(np.float64))
    if not 0 <= samples.min() <= samples.max() < WORDS:
        return UNKNOWN_SCALE
    codes = samples.astype(np.int64)
    used, varies = (int(np.bitwise_or.reduce(c, axis=None)) for c in (codes, codes ^ codes.flat[0]))
    known = varies and (codes == samples).all()
    return CodeScale(used & -used if known else 0, float(samples.max()))


def _float_scale(samples: NDArray[np.float64]) -> CodeScale:
    for bits in (8, 10, 12, 14, 16):
        codes = (2**bits - 1) * samples
        whole = np.rint(codes).astype(np.int64)
        if (np.abs(codes - whole) <= CODE_ERROR).all():
            used, high = int(np.bitwise_or.reduce(whole, axis=None)), int(whole.max())
            known = 0 <= whole.min() < high < WORDS
            return CodeScale((used & -used) << 16 - bits, float(high << 16 - bits)) if known else UNKNOWN_SCALE
    return UNKNOWN_SCALE


def unit_remarks(notes: Iterable[str]) -> tuple[str, ...]:
    """Remarks on an ambient frame of other samples than the frame's, of the notes on its levels, each once."""
    found = dict.fromkeys(note for note in notes if isinstance(note, OtherUnit))
    return tuple(f"the ambient frame may be in another unit than this one: {note}" for note in found)


def scale_notes(frame: Mosaic, ambient: CodeScale) -> tuple[str, ...]:
    """A note where codes of one of a frame and its ambient frame are left-justified, and those of the other are not."""
    scales = {"this frame": code_scale(frame), "the ambient frame": ambient}
    (right, low), (left, high) = sorted(scales.items(), key=lambda item: item[1].step)
    if low.step != 1 or high.step < 4 or low.largest * high.step >= WORDS:
        return ()
    much = "little" if right == "the ambient frame" else "much"
    if frame.white_level <= MOST_FLOAT:
        return (
            f"float samples of {left} are multiples of {high.step}/65535, those of {right} are not and reach "
            f"{low.largest:g}/65535: are both of one unit? Else {high.step} times too {much} is subtracted",
        )
    return (
        f"codes of {left} are multiples of {high.step}, those of {right} are not and reach {low.largest:g}: is only "
        f"one left-justified in 16 bits? Then {high.step} times too {much} is subtracted",
    )


def ambient_notes(frame: Mosaic, less: Mosaic) -> tuple[str, ...]:
    """A note where the lamp was on in the ambient light that a frame had and that is gone in the frame ``less`` it.

    Most of the light is gone too (in every fifth sample of every fifth row, which are samples of all filters), or the
    highlights that are left are those of the ambient light. Also a note where what is gone is no light at all.
    """
    black, white = float(frame.black_level), float(frame.white_level)
    was, left = (to_numpy(mosaic.data[..., ::5, ::5]) - black for mosaic in (frame, less))
    if (was < left).all():
        return (
            "every sample of the ambient frame is below black: is it of another unit, or the black level too high?",
        )
    lit = was > LIT * (white - black)
    gone = float(np.mean(left[lit] < LEAST_LEFT * was[lit])) if lit.any() else 0.0
    if gone >= MOST_GONE:
        return (f"the ambient frame is as bright as this one in {gone:.0%} of what is lit: was the lamp off in it?",)
    part = shared_highlights(frame, less) if min(frame.data.shape) >= SIDE else None
    if part is None:
        return ()
    return (f"the ambient frame has the highlights of this one in {part:.0%} of their light: was the lamp off in it?",)


def exposure_notes(frame_s: float | None, ambient_s: float | None) -> tuple[str, ...]:
    """A note where a frame and the ambient light that is subtracted from it say different exposure times [s]."""
    if frame_s is None or ambient_s is None or equally_exposed([frame_s, ambient_s]):
        return ()
    much = "much" if ambient_s > frame_s else "little"
    times = f"the ambient frame was exposed for {ambient_s:.4g} s, this one for {frame_s:.4g} s"
    return (f"{times}: too {much} is subtracted, take one of the same exposure",)


def equally_exposed(times_s: Sequence[float]) -> bool:
    """True for exposure times that differ by no more than rounding."""
    return max(times_s) <= EQUAL * min(times_s)


def shared_highlights(frame: Mosaic, less: Mosaic) -> float | None:
    """Part of the polarized light of a frame's highlights that the light gone in ``less`` has too.

    None where it is not of the same places and angles, or where no highlights of one angle show.
    """
    black, white = float(less.black_level), float(less.white_level)
    left, was = _bands(to_numpy(less.data)), _bands(to_numpy(frame.data))
    unclipped = ~(left >= clip_level(black, white)).any(axis=(1, 2, 4, 5))
    weights = _polarization(less.layout) / np.float32(white - black)
    total, lamp = (np.einsum("hipwjq,cpq->chw", blocks, weights)[:, unclipped] for blocks in (was, left))
    strength = np.hypot(*lamp)
    strong = strength > max(STRONG * float(np.quantile(strength, 0.999)), LEAST) if strength.size else strength > 0
    if int(strong.sum()) < MIN_BLOCKS:
        return None
    lamp, room = lamp[:, strong].astype(np.float64), (total - lamp)[:, strong].astype(np.float64)
    concentration = np.hypot(*lamp.sum(axis=1)) / np.hypot(*lamp).sum()
    product, power = float((lamp * room).sum()), float((lamp**2).sum())
    alike = product > ALIKE * (power * float((room**2).sum())) ** 0.5
    part = product / (power + product)
    return part if alike and concentration > ONE_LAMP and part > LEAST_PART else None


def _bands(samples: NDArray[Any]) -> NDArray[Any]:
    """Blocks ``[h, SIDE / 4, 4, w, SIDE / 4, 4]`` of samples, of some rows of blocks where there are many."""
    height, width = (n // SIDE for n in samples.shape)
    rows = samples[: height * SIDE].reshape(height, SIDE, -1)[:: max(1, samples.size // MANY), :, : width * SIDE]
    return rows.reshape(-1, SIDE // 4, 4, width, SIDE // 4, 4)


@lru_cache(maxsize=4)
def _polarization(layout: Layout) -> Floats:
    """Weights ``[2, 4, 4]`` of 4x4 samples, whatever their colours, that make s1 and s2 of a block, mean of colours."""
    filters = [filt for row in layout.table() for filt in row]
    angle, channel = np.deg2rad([f.angle_deg for f in filters]), np.array([f.channel for f in filters])
    weights = np.zeros((2, 16))
    for color in np.unique(channel):
        weights[:, channel == color] = stokes_inverse(angle[channel == color])[1:]
    scale = len(np.unique(channel)) * (SIDE // 4) ** 2
    return (weights / scale).astype(np.float32).reshape(2, 4, 4)
