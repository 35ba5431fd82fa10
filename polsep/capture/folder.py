"""Files as a camera: raw frames of a folder, a file or a recording, once or in a loop, at a rate."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import numpy as np

from polsep.capture.sources import CameraError, CameraInfo, CameraSettings, EndOfFrames
from polsep.io.raw.frames import read_pages
from polsep.io.raw.genicam import find_pixel_format, pack_frame
from polsep.io.raw.page import Page
from polsep.io.raw.recording import RECORD, RawImage, is_recording, read_header, read_images
from polsep.io.raw.sequences import natural_order
from polsep.io.store.errors import input_error, naming

#: Extensions of files that describe themselves, so that their codes need no settings.
KINDS = (".png", ".tif", ".tiff", ".npy", ".pgm")
#: Frames per second without a rate in the settings.
RATE_HZ = 10.0


class FolderSource:
    """Frames of files as `read_pages` finds them, in natural order (2 before 10), or of a recording, byte for byte.

    Codes of 8 bits become BayerRG8, wider ones BayerRG10, 12 or 16 by the file's white level; the settings' pixel
    format, which may be a packed one, overrides this. A recording has its own format alone. All frames must have one
    size. Files have no exposure to set.
    """

    def __init__(self, path: Path, settings: CameraSettings, loop: bool = False) -> None:
        """List the files. Raises CameraError if there are no frames, or on settings that only cameras have."""
        camera_only = {
            "exposure": settings.exposure_us,
            "gain": settings.gain_db,
            "trigger": settings.trigger,
            "features": settings.features or None,
        }
        for name, value in camera_only.items():
            if value is not None:
                raise CameraError(f"{path}: expected a camera to set its {name}, found files")
        self._path, self._settings, self._loop = path, settings, loop
        self.files = _files_of(path)

    @contextmanager
    def connect(self) -> Iterator[_Files]:
        """Connect a camera that starts at the first frame."""
        files = _Files(self._path.name or str(self._path), self._frames(), self._settings.frame_rate_hz or RATE_HZ)
        files.info = replace(files.info, patience_s=math.inf)  # files do not get lost
        yield files

    def _frames(self) -> Iterator[tuple[bytes, CameraInfo]]:
        for _ in repeat(None) if self._loop else (None,):
            for path in self.files:
                with naming(path):
                    yield from self._recorded(path) if path.name == RECORD else self._packed(path)

    def _recorded(self, path: Path) -> Iterator[tuple[bytes, CameraInfo]]:
        """Frames of a recording."""
        header, asked = read_header(path), self._settings.pixel_format
        if asked not in (None, header.pixel_format):
            raise ValueError(f"expected the recording's own pixel format {header.pixel_format}, found {asked}")
        info = CameraInfo(str(path), header.width, header.height, header.pixel_format, layout=header.layout)
        for image in read_images(path):
            yield image.payload, info

    def _packed(self, path: Path) -> Iterator[tuple[bytes, CameraInfo]]:
        for page in read_pages(path):
            name = self._settings.pixel_format or _pixel_format(page)
            fmt = find_pixel_format(name)
            codes = page.array[..., 0] if page.array.shape[2:] == (1,) else page.array
            if page.angles or codes.ndim != 2 or codes.dtype not in (np.uint8, np.uint16) or fmt.planes > 1:
                found = f"{codes.dtype} {codes.shape} for {name}"
                raise ValueError(f"expected a raw mosaic [H, W] of uint8 or uint16 codes, found {found}")
            height, width = codes.shape
            yield pack_frame(codes, name), CameraInfo(str(path), width, height, name)


class _Files:
    """The `Camera` of a folder: frames when they are due, counted from 0."""

    def __init__(self, name: str, frames: Iterator[tuple[bytes, CameraInfo]], rate_hz: float) -> None:
        self._frames, self._period = frames, 1 / rate_hz
        self._next = next(self._frames, None)
        if self._next is None:
            raise CameraError(f"{name}: expected at least one frame, found none")
        first = self._next[1]
        settings = {"frame_rate_hz": rate_hz}
        self.info = replace(first, name=name, settings=settings)
        self._count, self._due = 0, 0.0

    def start(self) -> None:
        """Make the first frame due now."""
        self._due = time.monotonic()

    def read(self, timeout_s: float) -> RawImage | None:
        """The next frame, not before it is due; later where reading is slower than the rate."""
        if self._next is None:  # not sooner: one that cannot be read costs none before it
            self._next = next(self._frames, None)
        wait = self._due - time.monotonic()
        if wait > timeout_s:
            time.sleep(timeout_s)
            return None
        time.sleep(max(wait, 0))
        if self._next is None:
            raise EndOfFrames
        (payload, info), self._next = self._next, None
        if info.describe() != self.info.describe():
            expected = f"expected {self.info.describe()} as in the frames before"
            raise input_error(info.name, f"{expected}, found {info.describe()}")
        image = RawImage(payload, self._count, time.time_ns())
        self._count += 1
        self._due = max(self._due + self._period, time.monotonic())
        return image


def _files_of(path: Path) -> list[Path]:
    """The recording, the files of a folder, or the file itself."""
    if is_recording(path):
        return [path / RECORD]
    if not path.is_dir():
        if not path.exists():
            raise CameraError(f"{path}: expected a folder or file of raw frames, found nothing at this path")
        return [path]
    seen = (file for file in path.iterdir() if not file.name.startswith("."))
    files = sorted((file for file in seen if file.suffix.lower() in KINDS), key=natural_order)
    if not files:
        raise CameraError(f"{path}: expected files of {', '.join(KINDS)} or a {RECORD}, found none")
    return files


def _pixel_format(page: Page) -> str:
    """The colour pixel format for the codes of a page."""
    if page.array.dtype == np.uint8:
        return "BayerRG8"
    return {1023.0: "BayerRG10", 4095.0: "BayerRG12"}.get(page.white_level or 0.0, "BayerRG16")
