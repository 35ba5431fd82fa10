"""Changes to every raw frame before anything else reads it: a calibration, and ambient light that is subtracted."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from polsep.compute.arrays import as_floats, namespace, of_kind, to_numpy
from polsep.sensor.ambient import UNKNOWN_SCALE, CodeScale, ambient_notes, code_scale, scale_notes
from polsep.sensor.calibration import Calibration, correct_mosaic
from polsep.sensor.camera import Layout, Mosaic, clip_level


@dataclass(frozen=True, eq=False)
class Corrections:
    """Changes to every raw frame before anything else reads it; ``sources`` names their files in reports.

    ``ambient_exposure_s`` (where files say it), ``ambient_scale`` and ``ambient_remarks`` are of its raw frames.
    """

    calibration: Calibration | None = None
    ambient: Mosaic | None = None
    sources: Mapping[str, Any] = field(default_factory=dict)
    ambient_exposure_s: float | None = None
    ambient_scale: CodeScale = UNKNOWN_SCALE
    ambient_remarks: tuple[str, ...] = ()

    def with_ambient(self, frames: Iterable[Mosaic]) -> Corrections:
        """The same with the ambient light of raw frames, the mean of which, calibrated, is subtracted."""
        scales = list[CodeScale]()

        def calibrated() -> Iterator[Mosaic]:
            for frame in frames:
                scales.append(code_scale(frame))
                yield self.calibrate(frame)

        return replace(self, ambient=mean_mosaic(calibrated()), ambient_scale=min(scales))

    def calibrate(self, mosaic: Mosaic) -> Mosaic:
        """The frame corrected by the calibration, if there is one. Raises ValueError."""
        return mosaic if self.calibration is None else correct_mosaic(mosaic, self.calibration)

    def apply(self, mosaic: Mosaic) -> Mosaic:
        """The frame calibrated and less the ambient light, which is of calibrated frames. Raises ValueError."""
        mosaic = self.calibrate(mosaic)
        return mosaic if self.ambient is None else subtract_ambient(mosaic, self.ambient)

    def apply_noting(self, mosaic: Mosaic) -> tuple[Mosaic, tuple[str, ...]]:
        """`apply`, and notes for the user. Raises ValueError."""
        calibrated = self.calibrate(mosaic)
        if self.ambient is None:
            return calibrated, ()
        less = subtract_ambient(calibrated, self.ambient)
        return less, self.ambient_remarks + scale_notes(mosaic, self.ambient_scale) + ambient_notes(calibrated, less)


def subtract_ambient(mosaic: Mosaic, ambient: Mosaic) -> Mosaic:
    """A frame less the light of the room: a frame, or the mean of several, of the same exposure with the lamp off.

    A sample that is clipped in either counts as clipped. The noise of both adds up: the mean of n frames adds 1 / n of
    its variance. Raises ValueError on another size, layout or levels.
    """
    for name in ("layout", "black_level", "white_level"):
        wanted, found = getattr(mosaic, name), getattr(ambient, name)
        if wanted != found:
            wanted, found = (x.spec if isinstance(x, Layout) else f"{x:g}" for x in (wanted, found))
            raise ValueError(f"expected an ambient frame with the frame's {name} {wanted}, found {found}")
    if mosaic.data.shape[-2:] != ambient.data.shape[-2:]:
        raise ValueError(f"expected an ambient frame of {_size(mosaic)} as the frame, found {_size(ambient)}")
    other = replace(ambient, data=of_kind(to_numpy(ambient.data), mosaic.data))
    black, white = float(mosaic.black_level), float(mosaic.white_level)
    data = as_floats(mosaic.data)
    data = data - namespace(data).astype(as_floats(other.data) - black, data.dtype, copy=False)
    hidden = (mosaic.clipped() | other.clipped()) & (data < clip_level(black, white))
    return replace(mosaic, data=namespace(data).where(hidden, white, data), less_ambient=True)


def mean_mosaic(mosaics: Iterable[Mosaic]) -> Mosaic:
    """The mean of frames of one exposure, one at a time; a sample is clipped where any frame's is.

    Raises ValueError on none, and on mixed ones.
    """
    frames = iter(mosaics)
    first = next(frames, None)
    if first is None:
        raise ValueError("expected at least one frame, found none")
    xp = namespace(first.data)
    total, clipped, count = xp.astype(first.data, xp.float64), first.clipped(), 1
    for other in frames:
        if (other.layout, other.black_level, other.white_level) != (first.layout, first.black_level, first.white_level):
            raise ValueError("expected frames of one layout and of the same levels, found different ones")
        if other.data.shape != first.data.shape:
            raise ValueError(f"expected frames of one size, found {_size(first)} and {_size(other)}")
        total, clipped, count = total + other.data, clipped | other.clipped(), count + 1
    if count == 1:
        return first
    mean = xp.astype(total / count, xp.float32)
    return replace(first, data=xp.where(clipped, mean.clip(float(first.white_level), None), mean))


def _size(mosaic: Mosaic) -> str:
    return f"{mosaic.data.shape[-1]}x{mosaic.data.shape[-2]}"
