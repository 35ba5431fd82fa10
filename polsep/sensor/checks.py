"""All checks of one raw frame, in order: black level, encoding, filter layout, defects; and the corrected frame.

A frame that is encoded, or whose black level is too large, contradicts every layout: then layouts are not judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from polsep.compute.arrays import to_numpy
from polsep.sensor.black_level import check_black_level
from polsep.sensor.camera import Mosaic
from polsep.sensor.defects import remove_defects
from polsep.sensor.encoding import encoding_warning
from polsep.sensor.layout_check import check_layout, phase_means
from polsep.sensor.levels import overexposure_notes

#: Share of pixels that are defects from which on the user is warned.
MANY_DEFECTS = 5e-4


@dataclass(frozen=True)
class CheckedMosaic:
    """The frame, corrected where sure; ``report``: number of defects, black level; ``warnings``: a line each."""

    mosaic: Mosaic
    report: dict[str, Any]
    warnings: tuple[str, ...]


def check_mosaic(mosaic: Mosaic) -> CheckedMosaic:
    """One frame ``[H, W]`` with its defects repaired and, where 0 was stated, the black level that it shows.

    The same object where nothing was found. Raises ValueError on a batch.
    """
    phases = phase_means(mosaic)
    black, encoded, exposure = check_black_level(mosaic), encoding_warning(mosaic, phases), list[str]()
    if black.level is not None and mosaic.black_level == 0:
        samples, white = to_numpy(mosaic.data), float(mosaic.white_level)
        if not overexposure_notes(samples, 0.0, white):  # else the reader has noted it
            exposure += overexposure_notes(samples, black.level, white)
        mosaic = replace(mosaic, black_level=black.level)
        phases = phase_means(mosaic)
    understood = encoded is None and (black.warning is None or black.level is not None)
    layout = check_layout(mosaic, phases).warning if understood else None
    mosaic, count = remove_defects(mosaic)
    lines = (*exposure, encoded, black.warning, layout, _defects_warning(count, math.prod(mosaic.data.shape)))
    report = {"defects": count, "black_level": float(mosaic.black_level)}
    return CheckedMosaic(mosaic, report, tuple(line for line in lines if line))


def _defects_warning(count: int, pixels: int) -> str | None:
    """A line on a frame of so many ``pixels`` of which many were defects, or None."""
    share = count / pixels
    if share < MANY_DEFECTS:
        return None
    return (
        f"{count} dead or hot pixels were repaired ({share:.2%}): a calibration of the dark finds them more surely, "
        "see 'polsep calibrate dark'"
    )
