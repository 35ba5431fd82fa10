"""The live view: the newest frame, separated and drawn, as often as the machine can.

The same functions separate here and in `polsep separate`, so both agree sample by sample.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

from polsep.capture.shot import Shot
from polsep.capture.sources import CameraInfo
from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.frames import ReadOptions, decode_frame
from polsep.io.raw.genicam import find_pixel_format
from polsep.io.raw.recording import RawImage
from polsep.io.results.previews import live_sheet
from polsep.io.store.atomic import replace_bytes
from polsep.io.store.image_codecs import encode_jpeg
from polsep.light.find import UNKNOWN_DEG, Light, combine
from polsep.light.light_color import LightColor, find_light_after_checks, is_calibrated
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Capture, Layout
from polsep.separation.report import SeparatedFrame

#: Frames that show the light's colour before it is fixed.
LIGHT_FRAMES = 32
#: Added to the nice value of the live view on Linux: receiving and recording have priority.
NICENESS = 5


@dataclass(frozen=True)
class Shown:
    """The latest picture: bytes of a JPEG file, id of the frame, angle of the light's polarizer [degrees], remarks.

    ``shot``: what a page tells of the frame.
    """

    jpeg: bytes
    frame_id: int
    light_deg: float
    remarks: tuple[str, ...]
    shot: Shot | None = None


class LiveView:
    """Separation of one frame at a time; the latest picture is kept in memory and, if given, in a file."""

    def __init__(
        self,
        method: str,
        layout: Layout | None = None,
        picture: Path | None = None,
        calibration: Path | None = None,
        ambient: tuple[Path, ...] = (),
    ) -> None:
        self._method, self._layout, self._picture = method, layout, picture
        self._calibration, self._ambient = calibration, ambient
        self._options = ReadOptions()
        self._lights: list[Light] = []
        self.latest: Shown | None = None

    def warm_up(self, info: CameraInfo) -> None:
        """Separate a black frame, to compile and load. Raises ValueError if the method does not fit the frames."""
        lower_priority()
        layout = Layout.parse(info.layout) if self._layout is None and info.layout is not None else self._layout
        read = ReadOptions(layout, size=(info.width, info.height), pixel_format=info.pixel_format)
        self._options = with_corrections(read, self._calibration, self._ambient)
        self.separate(bytes(find_pixel_format(info.pixel_format).frame_bytes(info.width, info.height)))

    def separate(self, payload: bytes) -> tuple[SeparatedFrame, tuple[str, ...], Capture]:
        """One separated frame, remarks on it, and the frame as it was."""
        data, notes = decode_frame(payload, self._options)
        frame = separate_capture(data, self._method, self._light(data))
        remarks = (*notes, *frame.report["warnings"])
        return frame, tuple(advise(remark, self._options.pixel_format or "") for remark in remarks), data

    def _light(self, data: Capture) -> LightColor | str:
        """Colour of the light: the mean of what the first `LIGHT_FRAMES` frames that show something say, then fixed."""
        if is_calibrated(data):
            return "auto"
        if len(self._lights) < LIGHT_FRAMES:
            found = find_light_after_checks(data)
            if found.error_deg < UNKNOWN_DEG:
                self._lights.append(found)
        if not self._lights or self._lights[0].log_ratio is None:
            return "white"
        return combine(self._lights).color

    def show(self, image: RawImage) -> Shown:
        """Separate a frame and replace the picture atomically."""
        frame, remarks, data = self.separate(image.payload)
        light = float(frame.report["statistics"]["light_polarizer_deg"])
        picture, shot = encode_jpeg(live_sheet(frame)), Shot(data, frame, remarks)
        shown = Shown(picture, image.frame_id, light, remarks, shot)
        if self._picture is not None:
            replace_bytes(self._picture, shown.jpeg)
        self.latest = shown
        return shown


def advise(remark: str, pixel_format: str) -> str:
    """Advise a pixel format where a remark advises a white level, which cameras do not have."""
    found = re.fullmatch(r"(.*); say --white-level (\d+) if so", remark)
    if found is None:
        return remark
    bits = int(found[2]).bit_length()
    if int(found[2]) != 2**bits - 1:  # codes in the upper bits: no format has such a name
        return found[1]
    return f"{found[1]}; say --pixel-format {re.sub(r'[0-9]+[a-z]*$', str(bits), pixel_format)} if so"


def lower_priority() -> None:
    """Lower the priority of this thread and of those it starts, on Linux."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        nice = os.getpriority(os.PRIO_PROCESS, thread)
        os.setpriority(os.PRIO_PROCESS, thread, min(nice + NICENESS, 19))
