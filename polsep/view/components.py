"""The page's components by their use, what it begins with, and its lines of status: plain data and text."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from polsep.io.store import errors
from polsep.physics.stokes import axis_deg
from polsep.separation.report import PICTURE, angle_origin
from polsep.view.edits import list_controls
from polsep.view.opening import UNSAID, OpenedFrame

HINT = '<p class="ps-hint">Point at the picture to read a pixel, click to keep it.</p>'
PAUSE = '<p class="ps-hint">Pause to read the numbers of this frame.</p>'
NOTHING = '<p class="ps-hint">No frame yet.</p>'
NO_SHAPE = '<p class="ps-hint">The surface of an object before a dark ground, under a lamp that you move.</p>'
#: Labels of the buttons that upload images.
IMAGES = {"texture": "Texture", "normals": "Normals", "mask": "Mask for all edits"}
#: Settings that describe a file, where nothing is said: another file begins with these.
OF_FILES = {"layout": UNSAID, "white": UNSAID, "black": "0", "light": "auto", "size": "", "pixel_format": UNSAID}
#: Remark where a result is to be compared.
RESULT_AS_IS = "a result is shown as it is: only raw frames are separated by other methods"
#: The right picture is of the same separation as the left one.
SAME = "the same"
#: Largest number of offered mends.
MENDS = 3

Values = dict[Any, Any]
Updates = dict[Any, Any]


@dataclass(frozen=True)
class Start:
    """The first state of the page: values of its settings, and a ``file`` of the user to open."""

    settings: dict[str, Any]
    file: Any = None

    def corrections(self) -> dict[str, Any]:
        """The settings that the command line gives and no page may: paths of files."""
        return {name: self.settings[name] for name in ("calibration", "ambient") if name in self.settings}

    def of_files(self) -> dict[str, Any]:
        """`OF_FILES` as the command line says."""
        return {name: self.settings.get(name) or value for name, value in OF_FILES.items()}


@dataclass(frozen=True)
class Components:
    """The page's components. ``settings`` by the names of `parse_settings`, ``images`` by kind."""

    settings: dict[str, Any]
    keep: Any
    file: Any
    demo: Any
    progress: Any
    cancel: Any
    status: Any
    mends: tuple[Any, ...]
    view: dict[str, Any]
    stage: Any
    strip: Any
    play: Any
    timer: Any
    beside: Any
    readout: Any
    exposure: Any
    light: Any
    find_shape: Any
    shape: Any
    controls: tuple[Any, ...]
    images: dict[str, Any]
    neutral: Any
    fetch: dict[str, Any]
    link: Any

    def all(self) -> list[Any]:
        """Components that an event may change."""
        one = [self.file, self.progress, self.cancel, self.status, self.stage, self.strip, self.play, self.timer]
        panels = [self.beside, self.readout, self.exposure, self.light, self.shape]
        many = (self.settings.values(), self.mends, self.view.values(), self.controls, self.images.values())
        return one + panels + [component for group in many for component in group]

    def picture(self) -> list[Any]:
        """Components that determine the picture."""
        return list(self.view.values())

    def control(self, edit: str, parameter: str) -> Any:
        """The control of one parameter of an edit."""
        places = [(control.edit.name, control.parameter.name) for control in list_controls()]
        return self.controls[places.index((edit, parameter))]


def one_line(error: BaseException) -> str:
    """The message of an error in one line."""
    return errors.one_line(error) or type(error).__name__


def failure_line(error: BaseException) -> str:
    """The status after an error."""
    return f'<div class="ps-error" role="alert">{html.escape(one_line(error))}</div>'


def status_line(found: OpenedFrame, more: Sequence[str] = ()) -> str:
    """The status after a separation: size, method, statistics and remarks."""
    frame = found.frame
    height, width = frame.valid.shape
    texts = [f"{width} × {height} pixels", str(frame.report["method"])]
    if found.mosaic is not None:
        rows, cols = found.mosaic.data.shape[-2:]
        texts[0] = f"{cols} × {rows} raw, {texts[0]} separated"
    statistics = frame.report["statistics"]
    if "clipped_fraction" in statistics:
        texts.append(f"{statistics['clipped_fraction']:.2%} of the pixels clip")
    if "clipped_fraction" in statistics and angle_origin(frame.report) == PICTURE:
        texts.append(f"light polarizer about {axis_deg(statistics['light_polarizer_deg']):.0f}°")
    texts.append(f"{found.seconds:.2f} s")
    name = html.escape(found.stem)
    line = "".join(f"<span>{html.escape(text)}</span>" for text in texts)
    remarks = "".join(f'<div class="ps-remark">{html.escape(remark)}</div>' for remark in (*found.remarks, *more))
    return f'<div class="ps-line"><b>{name}</b>{line}</div>{remarks}'
