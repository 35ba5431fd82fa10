"""`Page`, the type that every reader of raw files yields.

A reader takes a path and the number of the first picture wanted, and yields one `Page` per picture, lazily; files of
one picture ignore the number. It raises ValueError, in one line, on what it can't read. Before it decodes, it makes the
checks of `io.store.header_checks`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray

from polsep.sensor.camera import Layout


class MergedFacts(NamedTuple):
    """Properties of a frame of `polsep merge`, which nothing may correct again: fields of `Mosaic`.

    ``calibration``: name and hash of the file by which its exposures were calibrated, None where it names none.
    """

    light_color: tuple[float, ...]
    falloff: tuple[tuple[float, ...], ...] | None
    lamp_measured: bool
    calibration: tuple[str, str] | None = None


@dataclass(frozen=True)
class Page:
    """One picture of a file: ``array`` ``[H, W]`` or ``[H, W, C]``; with ``angles`` a leading axis of 0, 45, 90, 135.

    ``exposure``: its time in seconds; ``captured``: when it was taken, in ISO 8601; ``let_in``: light that the camera
    let in (time, sensitivity, aperture), up to a factor. ``merged``: facts of a frame of `polsep merge`. ``index`` of
    ``count`` pictures. ``white_level`` and ``layout`` are those that the file itself names, or None. ``sampled``: the
    angle planes were taken from one mosaic, so their pixels lie at different points.
    """

    array: NDArray[Any]
    index: int = 0
    count: int = 1
    white_level: float | None = None
    layout: Layout | None = None
    angles: bool = False
    sampled: bool = False
    notes: tuple[str, ...] = ()
    exposure: float | None = None
    captured: str | None = None
    let_in: float | None = None
    merged: MergedFacts | None = None
