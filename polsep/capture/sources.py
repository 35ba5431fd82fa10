"""The interface of cameras: connect, then read raw frames and reports of lost ones; and what its backends share.

A backend is a `CameraSource`: ``connect`` is a context manager of a `Camera`, and may be called again after the camera
was lost. No loss is silent: an incomplete frame is a `Loss` at once, and every frame missing between two complete ones
is a gap in their ids (`FrameIds`) and in `RawImage.lost_before`, whether any of it arrived or not.

Units: exposure in microseconds, gain in decibels, rates in Hz, as in GenICam's Standard Features Naming Convention.
"""

from __future__ import annotations

import math
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any, Protocol

from polsep.io.raw.genicam import find_pixel_format
from polsep.io.raw.recording import RawImage
from polsep.io.store.errors import InputError

#: Seconds without a frame after which a free-running camera counts as lost; exposure and period are added.
PATIENCE_S = 5.0


class CameraError(InputError):
    """A missing camera, setting or library: one line of what was expected and what was found."""


class CameraLost(ConnectionError):
    """A connected camera no longer answers or sends frames; connecting again may help."""


class EndOfFrames(Exception):
    """The source has no more frames."""


@dataclass(frozen=True)
class CameraSettings:
    """Settings to apply to a camera; None keeps the camera's own.

    ``trigger``: "off" for free running, else the trigger's source by the camera's name for it, such as "Line0" or
    "Software"; with "Software" polsep triggers ``frame_rate_hz`` times a second. ``features``: further GenICam features
    by name, set in this order before the others. Raises CameraError on impossible numbers.
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

    def patience_s(self, frame_rate_hz: float | None, exposure_us: float | None) -> float:
        """Seconds without a frame after which the camera counts as lost, with the rate and exposure that it reports."""
        if self.triggered:
            return math.inf
        return PATIENCE_S + 1 / (self.frame_rate_hz or frame_rate_hz or 1.0) + (exposure_us or 0.0) * 1e-6

    @property
    def triggered(self) -> bool:
        """True if frames wait for an external trigger, for any time."""
        return self.trigger not in (None, "off", "Software")


@dataclass(frozen=True)
class CameraInfo:
    """A connected camera: size and pixel format of its frames, and the settings that it reports.

    ``layout``: a `Layout.spec` that was said of its frames, None where the pixel format's name is all that is known.
    """

    name: str
    width: int
    height: int
    pixel_format: str
    settings: dict[str, Any] = field(default_factory=dict)
    patience_s: float = PATIENCE_S
    layout: str | None = None

    def take_payload(self, data: bytes, found: str, padded: bool) -> bytes:
        """The bytes of one frame. Raises CameraError on other frames (``found`` says which) and on padded rows."""
        count = find_pixel_format(self.pixel_format).frame_bytes(self.width, self.height)
        if found != self.describe() or len(data) < count:
            raise CameraError(
                f"expected frames of {self.describe()} ({count} bytes), found {found} ({len(data)} bytes)"
            )
        if padded:
            raise CameraError("expected rows without padding, found padded ones: choose a width in whole bytes")
        return data[:count]

    def describe(self) -> str:
        """Size and pixel format for messages."""
        return f"{self.width}x{self.height} {self.pixel_format}"


@dataclass(frozen=True)
class Loss:
    """A frame that arrived incomplete, and why. It also shows as a gap in the ids of the complete frames around it.

    Its own id means nothing: without the packet that holds it, a buffer keeps the id of the frame before.
    """

    reason: str


class Camera(Protocol):
    """A connected camera."""

    @property
    def info(self) -> CameraInfo:
        """The camera as it describes itself."""

    def start(self) -> None:
        """Start acquisition. Raises CameraError when the camera refuses, CameraLost when it is gone."""

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next frame, in order; None if there is none in that time. Raises CameraLost, EndOfFrames."""


class CameraSource(Protocol):
    """A source of frames."""

    def connect(self) -> AbstractContextManager[Camera]:
        """Connect and apply the settings; stop and disconnect on exit.

        Raises CameraError when the camera is missing or refuses a setting.
        """


class FrameIds:
    """Count of missing frames, from the ids of those that arrived.

    Ids count up by one. GigE Vision 1.x has 16 bits for them and skips 0, so 65535 is followed by 1. Any other id that
    goes back is a restarted camera: its losses are unknown, and none is counted.
    """

    _WRAP = 65535

    def __init__(self) -> None:
        self._last: int | None = None

    def lost_before(self, frame_id: int) -> int:
        """Number of ids between the one before and this one; 0 for the first."""
        last, self._last = self._last, frame_id
        if last is None:
            return 0
        step = frame_id - last
        if step <= 0 and last <= self._WRAP and 0 < step + self._WRAP < self._WRAP // 2:
            step += self._WRAP
        return max(step - 1, 0)


class SoftwareTrigger:
    """A schedule of software triggers, where the settings ask for them; triggers that came too late are left out.

    State: when the next trigger is due.
    """

    def __init__(self, settings: CameraSettings) -> None:
        self._used = settings.trigger == "Software"
        self._period_s, self._due_s = 1 / (settings.frame_rate_hz or 1.0), 0.0

    def start(self) -> None:
        """Make the first trigger due now."""
        self._due_s = time.monotonic()

    def is_due(self) -> bool:
        """True if a trigger is due; the next one is then due a period later."""
        now = time.monotonic()
        if not self._used or now < self._due_s:
            return False
        self._due_s += self._period_s
        if self._due_s <= now:
            self._due_s = now + self._period_s
        return True

    def limit_wait(self, timeout_s: float) -> float:
        """Seconds to wait for a frame: until the next trigger is due, and at most the time given."""
        return min(timeout_s, max(self._due_s - time.monotonic(), 0.0)) if self._used else timeout_s
