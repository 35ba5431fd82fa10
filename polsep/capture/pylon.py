"""Basler's cameras, and its camera emulator, through pypylon.

With PYLON_CAMEMU=N in the environment there are N emulated cameras and nothing else is looked for, so that no network
is searched. The emulator replays image files: features ImageFileMode=On, ImageFilename=FOLDER, TestImageSelector=Off.
Codes of formats of 10 or 12 bits it takes from the high bits of 16-bit files. Tested with pypylon 26.9.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from polsep.capture.sources import (
    PATIENCE,
    CameraError,
    CameraInfo,
    CameraLost,
    CameraSettings,
    FrameIds,
    Loss,
)
from polsep.io.raw.genicam import find_pixel_format
from polsep.io.raw.recording import RawImage

#: Buffers that pylon fills while Python is busy.
BUFFERS = 16
#: Names of one feature in the Standard Features Naming Convention and before it.
EXPOSURE, GAIN = ("ExposureTime", "ExposureTimeAbs"), ("Gain",)
RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")


def load_pylon() -> tuple[Any, Any]:
    """The modules pylon and genicam. Raises CameraError, with what to install, where they are missing."""
    try:
        with warnings.catch_warnings():  # its types warn on Python 3.11, and crash where warnings are errors
            warnings.simplefilter("ignore")
            from pypylon import genicam, pylon
    except ImportError as error:
        raise CameraError(
            f"expected the extra 'camera' (pip install 'polsep[camera]') for pylon, found {error}"
        ) from None
    return pylon, genicam


def list_pylon() -> list[tuple[str, str]]:
    """Serial number and description of every camera that pylon finds. Raises CameraError."""
    pylon, genicam = load_pylon()
    try:
        return [(info.GetSerialNumber(), f"{info.GetFriendlyName()}, {info.GetDeviceClass()}") for info in _find(pylon)]
    except genicam.GenericException as error:
        raise CameraError(f"expected pylon to list cameras, found: {_say(error)}") from None


class PylonSource:
    """The camera of a serial number."""

    def __init__(self, name: str, settings: CameraSettings) -> None:
        """Raises CameraError where pypylon is missing."""
        self._pylon, self._genicam = load_pylon()
        self._name, self._settings = name, settings

    @contextmanager
    def connect(self) -> Iterator[_PylonCamera]:
        """Connect, set, and hand over; the camera stops and is let go of on the way out."""
        device = None
        try:
            found = [info for info in _find(self._pylon) if info.GetSerialNumber() == self._name]
            if not found:
                raise CameraError(f"{self._name}: expected a camera of this serial number, found none")
            device = self._pylon.InstantCamera(self._pylon.TlFactory.GetInstance().CreateDevice(found[0]))
            device.Open()
            camera = _PylonCamera(self._pylon, self._genicam, device, self._settings)
        except self._genicam.GenericException as error:
            if device is not None:
                device.Close()
            raise CameraError(f"{self._name}: expected a camera, found: {_say(error)}") from None
        try:
            yield camera
        finally:
            device.Close()


class _PylonCamera:
    """The `Camera` of pylon."""

    def __init__(self, pylon: Any, genicam: Any, device: Any, settings: CameraSettings) -> None:
        self._pylon, self._genicam, self._device = pylon, genicam, device
        self._ids = FrameIds()
        nodes = device.GetNodeMap()
        _apply(genicam, nodes, settings)
        self._software = settings.trigger == "Software"
        self._period, self._due = 1 / (settings.frame_rate_hz or 1.0), 0.0
        self.info = _describe(genicam, device, settings)
        fmt = find_pixel_format(self.info.pixel_format)
        self._bytes = fmt.frame_bytes(self.info.width, self.info.height)

    def start(self) -> None:
        """Begin to acquire, every frame in its turn."""
        try:
            self._device.MaxNumBuffer.SetValue(BUFFERS)
            self._device.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        except self._genicam.GenericException as error:
            raise CameraLost(_say(error)) from None
        self._due = time.monotonic()

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next frame that pylon has finished with, whole or not."""
        try:
            if self._device.IsCameraDeviceRemoved():
                raise CameraLost("the camera was removed")
            if self._software and time.monotonic() >= self._due:
                self._due = max(self._due + self._period, time.monotonic())
                self._device.ExecuteSoftwareTrigger()
            with self._device.RetrieveResult(int(timeout_s * 1000), self._pylon.TimeoutHandling_Return) as result:
                return self._take(result) if result.IsValid() else None
        except self._genicam.GenericException as error:
            raise CameraLost(_say(error)) from None

    def _take(self, result: Any) -> RawImage | Loss:
        """What a grab result holds."""
        if not result.GrabSucceeded():
            return Loss(f"a frame came incomplete ({' '.join(result.GetErrorDescription().split())})")
        width, height, data = result.GetWidth(), result.GetHeight(), bytes(result.GetBuffer())
        if (width, height) != (self.info.width, self.info.height) or len(data) < self._bytes:
            raise CameraError(
                f"expected frames of {self.info.width}x{self.info.height} {self.info.pixel_format} ({self._bytes} "
                f"bytes), found {width}x{height} ({len(data)} bytes)"
            )
        if result.GetPaddingX():
            raise CameraError("expected rows without padding, found padded ones: choose a width in whole bytes")
        stamp = result.GetTimeStamp() or time.time_ns()  # the emulator has no clock
        frame_id = result.GetBlockID()
        return RawImage(data[: self._bytes], frame_id, stamp, self._ids.lost_before(frame_id))


def _find(pylon: Any) -> list[Any]:
    """Every camera, or the emulated ones alone where there are any."""
    factory = pylon.TlFactory.GetInstance()
    if not os.environ.get("PYLON_CAMEMU"):
        return list(factory.EnumerateDevices())
    info = pylon.DeviceInfo()
    info.SetDeviceClass("BaslerCamEmu")
    return list(factory.EnumerateDevices([info]))


def _apply(genicam: Any, nodes: Any, settings: CameraSettings) -> None:
    """Set what was asked for."""
    for name, value in settings.features:
        _set(genicam, nodes, (name,), value)
    if settings.pixel_format is not None:
        _set(genicam, nodes, ("PixelFormat",), settings.pixel_format)
    if settings.exposure_us is not None:
        _set(genicam, nodes, EXPOSURE, settings.exposure_us)
    if settings.gain_db is not None:
        _set(genicam, nodes, GAIN, settings.gain_db)
    if settings.trigger is not None:
        _set(genicam, nodes, ("TriggerSelector",), "FrameStart")
        _set(genicam, nodes, ("TriggerMode",), "Off" if settings.trigger == "off" else "On")
        if settings.trigger != "off":
            _set(genicam, nodes, ("TriggerSource",), settings.trigger)
    if settings.frame_rate_hz is not None and settings.trigger in (None, "off"):
        _set(genicam, nodes, ("AcquisitionFrameRateEnable",), "true")
        _set(genicam, nodes, RATE, settings.frame_rate_hz)


def _set(genicam: Any, nodes: Any, names: tuple[str, ...], value: float | str) -> None:
    """Set the first of the features that the camera has. Raises CameraError when it has none or takes no such value."""
    node = next((node for node in map(nodes.GetNode, names) if node is not None and genicam.IsWritable(node)), None)
    if node is None:
        raise CameraError(f"expected a camera with the feature {names[0]}, found none that can be set")
    try:
        if isinstance(value, str):
            node.FromString(value)
        else:
            node.SetValue(value)
    except genicam.GenericException as error:
        raise CameraError(f"expected a camera that takes {names[0]} {_text(value)}, found: {_say(error)}") from None


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:.12g}"


def _read(genicam: Any, nodes: Any, names: tuple[str, ...]) -> float | None:
    """The value of the first of the features that the camera has."""
    for node in map(nodes.GetNode, names):
        if node is not None and genicam.IsReadable(node):
            return float(node.GetValue())
    return None


def _describe(genicam: Any, device: Any, settings: CameraSettings) -> CameraInfo:
    """The camera as it is now."""
    nodes = device.GetNodeMap()
    exposure, rate = _read(genicam, nodes, EXPOSURE), _read(genicam, nodes, RATE)
    asked = {"trigger": settings.trigger, "features": dict(settings.features), "exposure_us": exposure}
    asked |= {"gain_db": _read(genicam, nodes, GAIN), "frame_rate_hz": rate}
    period = 1 / (settings.frame_rate_hz or rate or 1.0)
    patience = float("inf") if settings.triggered else PATIENCE + period + (exposure or 0.0) * 1e-6
    width, height = (int(nodes.GetNode(side).GetValue()) for side in ("Width", "Height"))
    pixel_format = nodes.GetNode("PixelFormat").ToString()
    return CameraInfo(device.GetDeviceInfo().GetFriendlyName(), width, height, pixel_format, asked, patience)


def _say(error: Exception) -> str:
    """What GenApi says, in one line, without the place in its source."""
    return " ".join(str(error).split()).partition(" : ")[0]
