"""The first frame of a recording, which fixes what all have: light, exposure, defects, and of what camera they are."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.corrections import hash_samples
from polsep.io.raw.frames import Frame, refuse_forgotten
from polsep.io.raw.sequences import DamagedFrame, FrameSequence
from polsep.io.results.previews import exposure_of
from polsep.io.results.sequences import PART
from polsep.io.store.errors import InputError
from polsep.light.find import Light, combine
from polsep.light.light_color import LightColor, find_light_after_checks, is_calibrated, is_to_be_found
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Mosaic
from polsep.sensor.defects import find_lasting_defects
from polsep.sensor.levels import BlackFrame

if TYPE_CHECKING:
    from polsep.video.recordings import VideoOptions

#: First frames in which dead and hot pixels are looked for.
DEFECT_FRAMES = 8
#: Distance of the frames of the first part that show the light's colour.
LIGHT_STEP = 8


@dataclass(frozen=True)
class FirstFrame:
    """Values that the first frame fixes for all: colour of the ``light``, ``gain`` of the preview, ``size`` of images.

    ``size`` includes colours. ``shape``: of raw frames. ``warnings``: for the user. ``defects``: mask ``[H, W]`` of the
    pixels that are repaired in every frame, None where there are none. ``facts``: of the light, for the report.
    ``black_level``: of raw frames. ``sha256``: of its samples, by which a run that is resumed knows its recording.
    ``camera``: what all frames have in common, as `of_one_camera` compares it.
    """

    method: str
    light: tuple[float, ...]
    gain: float
    size: tuple[int, int, int]
    shape: tuple[int, ...]
    warnings: tuple[str, ...]
    defects: NDArray[np.bool_] | None = None
    facts: dict[str, Any] = field(default_factory=dict)
    black_level: float | None = None
    sha256: str = ""
    camera: dict[str, str] = field(default_factory=dict)


def separate_first(recording: FrameSequence, options: VideoOptions) -> FirstFrame:
    """Separate the first undamaged frame that shows light. Raises ValueError if there is none among those of one part.

    Where all of them are black, it is the first one. With ``damaged`` "stop", a frame that is looked at and cannot be
    read is an error here already: what is found without it would not be what is found once it is repaired.
    """
    reason, black_frame = "none at all", None
    for _, frame in zip(range(PART), recording.begin(0), strict=False):
        if isinstance(frame, DamagedFrame):
            reason = frame.reason
            if _ends_run(frame, options):
                black_frame = None
                break
        elif any(isinstance(note, BlackFrame) for note in frame.notes):
            black_frame = black_frame or frame  # which says nothing of levels, nor of the light
        else:
            return _separate_first(recording, options, frame)
    if black_frame is None:
        raise ValueError(f"expected a frame that can be read, found {reason}")
    return _separate_first(recording, options, black_frame)


def _separate_first(recording: FrameSequence, options: VideoOptions, frame: Frame) -> FirstFrame:
    refuse_forgotten(recording.stem, frame)
    camera = _camera_of(frame)
    spread = islice(recording.begin(frame.index), 0, PART, LIGHT_STEP)
    light_color, found = _light_of(_intact(spread, camera, options), options)
    separated = separate_capture(frame.data, options.method, light_color, options.device)
    height, width, colors = separated.diffuse.shape
    remarks = () if found is None else found.remarks
    return FirstFrame(
        method=separated.report["method"],
        light=tuple(float(c) for c in separated.report["light_color"]),
        gain=exposure_of(separated.diffuse + separated.specular),
        size=(height, width, colors),
        shape=tuple(frame.data.data.shape),
        warnings=(*recording.notes, *frame.notes, *remarks, *separated.report["warnings"]),
        defects=_defects_of(_intact(islice(recording.begin(0), DEFECT_FRAMES), camera, options)),
        facts=separated.report["light"] if found is None else {"source": "found", **found.describe()},
        black_level=separated.report.get("black_level"),
        sha256=hash_samples(frame.data.data),
        camera=camera,
    )


def _ends_run(damaged: DamagedFrame, options: VideoOptions) -> bool:
    """True for a frame at which the run will stop."""
    return options.damaged == "stop" and (options.frames is None or damaged.index < options.frames)


def _intact(frames: Iterator[Frame | DamagedFrame], camera: dict[str, str], options: VideoOptions) -> Iterator[Frame]:
    """The frames of one ``camera`` that are not damaged. Raises InputError at one that ends the run."""
    for frame in frames:
        checked = of_one_camera(frame, camera)
        if isinstance(checked, Frame):
            yield checked
        elif _ends_run(checked, options):
            raise InputError(checked.reason)


def _camera_of(frame: Frame) -> dict[str, str]:
    """The properties that all frames of a recording share, in words."""
    size = "x".join(map(str, reversed(frame.data.data.shape)))
    layout = frame.data.layout.spec if isinstance(frame.data, Mosaic) else "of angle images"
    return {"layout": layout, "size": size, "white level": f"{frame.white_level or math.nan:g}"}


def of_one_camera(frame: Frame | DamagedFrame, camera: dict[str, str]) -> Frame | DamagedFrame:
    """A frame, which counts as damaged where it differs from the ``camera`` of the first one."""
    if isinstance(frame, DamagedFrame):
        return frame
    found = _camera_of(frame)
    for name, wanted in camera.items():
        if found[name] != wanted:
            reason = f"expected {name} {wanted} as in the first frame, found {found[name]}"
            return DamagedFrame(frame.index, f"{frame.stem}: {reason}")
    return frame


def _light_of(frames: Iterator[Frame], options: VideoOptions) -> tuple[LightColor | str, Light | None]:
    """Colour of the light as stated, or as ``frames`` of the first part show it; and the light found, for reports.

    None where nothing is to be found: the colour is stated, or a calibration has it, or frames are mono.
    """
    if not is_to_be_found(options.light_color):
        return options.light_color, None
    captures = [frame.data for frame in frames]
    if not captures or any(is_calibrated(capture) for capture in captures):
        return options.light_color, None
    found = combine([find_light_after_checks(capture) for capture in captures])
    if found.log_ratio is None:
        return options.light_color, None
    return found.color, found


def _defects_of(frames: Iterator[Frame]) -> NDArray[np.bool_] | None:
    """Mask of the defects that ``frames`` share; None where there are none."""
    mask = find_lasting_defects(frame.data for frame in frames if isinstance(frame.data, Mosaic))
    return mask if mask is not None and mask.any() else None
