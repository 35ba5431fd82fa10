"""What a camera is to polsep: something that connects, and then gives raw frames or says what was lost.

A backend is a `CameraSource`: ``connect`` is a context manager of a `Camera`, and may be called again after the camera
was lost. Nothing is lost in silence: a frame that arrives incomplete is a `Loss` at once, and every frame between two
whole ones is a gap in their ids (`FrameIds`) and in `RawImage.lost_before`, whether anything of it arrived or not.

Units: exposure in microseconds, gain in decibels, rates in Hz, as in GenICam's Standard Features Naming Convention.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol

from polsep.io.raw.recording import RawImage
from polsep.io.store.errors import InputError

#: Seconds without a frame after which a camera that runs by itself is taken for lost; exposure and period come on top.
PATIENCE = 5.0


class CameraError(InputError):
    """A camera, a setting or a library that is not there: one line of what was expected and what was found."""


class CameraLost(ConnectionError):
    """A camera that was connected no longer answers, or gives nothing: worth connecting again."""


class EndOfFrames(Exception):
    """The source has no more frames and never will."""


@dataclass(frozen=True)
class CameraSettings:
    """What to ask of a camera; None leaves a setting as the camera has it.

    ``trigger``: "off" for free running, else the trigger's source by the camera's name for it, such as "Line0" or
    "Software"; with "Software" polsep triggers ``frame_rate_hz`` times a second. ``features``: further GenICam features
    by name, set in this order before the others. Raises CameraError on numbers that no camera has.
    """

    exposure_us: float | None = None
    gain_db: float | None = None
    frame_rate_hz: float | None = None
    trigger: str | None = None
    pixel_format: str | None = None
    features: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        positive = {"an exposure": self.exposure_us, "a frame rate": self.frame_rate_hz}
        for name, value in positive.items():
            if value is not None and not (math.isfinite(value) and value > 0):
                raise CameraError(f"expected {name} above 0, found {value:g}")
        if self.gain_db is not None and not math.isfinite(self.gain_db):
            raise CameraError(f"expected a finite gain, found {self.gain_db:g}")
        if self.trigger == "Software" and self.frame_rate_hz is None:
            raise CameraError("expected a frame rate for software triggers, found none")

    @property
    def triggered(self) -> bool:
        """True where frames wait for a trigger from outside, however long it takes."""
        return self.trigger not in (None, "off", "Software")


@dataclass(frozen=True)
class CameraInfo:
    """A connected camera: size and pixel format of its frames, and its settings as it reports them."""

    name: str
    width: int
    height: int
    pixel_format: str
    settings: dict[str, Any] = field(default_factory=dict)
    patience_s: float = PATIENCE


@dataclass(frozen=True)
class Loss:
    """A frame that did not arrive whole, and why. The ids of the whole frames around it will tell of it again.

    Its own id says nothing: without the packet that holds it, a buffer still has that of the frame before.
    """

    reason: str


class Camera(Protocol):
    """A camera that is connected."""

    @property
    def info(self) -> CameraInfo:
        """What the camera says of itself."""

    def start(self) -> None:
        """Begin to acquire. Raises CameraError when the camera refuses, CameraLost when it is gone."""

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next frame, in order; None when nothing comes in that time. Raises CameraLost, EndOfFrames."""


class CameraSource(Protocol):
    """Where frames come from."""

    def connect(self) -> AbstractContextManager[Camera]:
        """Connect and apply the settings; leaving stops and disconnects.

        Raises CameraError when it is not there or refuses a setting.
        """


class FrameIds:
    """Which frames are missing, from the ids of those that came.

    Ids count up by one. GigE Vision 1.x has 16 bits for them and skips 0, so 65535 is followed by 1. An id that goes
    back otherwise is a camera that began anew: how many it lost nobody knows, and none is counted.
    """

    _WRAP = 65535

    def __init__(self) -> None:
        self._last: int | None = None

    def lost_before(self, frame_id: int) -> int:
        """How many ids lie between the one before and this one; 0 for the first."""
        last, self._last = self._last, frame_id
        if last is None:
            return 0
        step = frame_id - last
        if step <= 0 and last <= self._WRAP and 0 < step + self._WRAP < self._WRAP // 2:
            step += self._WRAP
        return max(step - 1, 0)
