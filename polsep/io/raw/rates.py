"""Frames per second of recordings, which they state, or as the times of their frames show them."""

from __future__ import annotations

from collections.abc import Sequence

#: Share of a rate by which one that is stated may differ from the times: Matroska has them in whole milliseconds. The
#: longest and shortest steps that do not count, as there may be pauses.
TOLERANCE, TRIMMED = 0.05, 0.1
#: Decimals of a rate that was measured.
DIGITS = 3


def frame_rate(stated: float | None, steps_s: Sequence[float]) -> float | None:
    """Frames per second of a recording with these times between frames [s], or None where nothing says it.

    It is the ``stated`` one where that agrees with the times, or where there are none.
    """
    steps = sorted(step for step in steps_s if step > 0)
    cut = int(TRIMMED * len(steps))
    kept = steps[cut : len(steps) - cut]
    if not kept:
        return stated
    found = round(len(kept) / sum(kept), DIGITS)
    return stated if stated is not None and abs(stated / found - 1) <= TOLERANCE else found
