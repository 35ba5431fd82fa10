"""Basler cameras, and Basler's camera emulator, through pypylon.

With PYLON_CAMEMU=N in the environment there are N emulated cameras and no network is searched. The emulator replays
image files: features ImageFileMode=On, ImageFilename=FOLDER, TestImageSelector=Off. For formats of 10 or 12 bits it
reads the high bits of 16-bit files. Tested with pypylon 26.9.
"""

from __future__ import annotations

import math
import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from polsep.capture.sources import CameraError, CameraInfo, CameraLost, CameraSettings, FrameIds, Loss, SoftwareTrigger
from polsep.io.raw.recording import RawImage

#: Buffers that pylon fills while Python is busy.
BUFFERS = 16
#: Names of each feature in the Standard Features Naming Convention and before it.
EXPOSURE, GAIN = ("ExposureTime", "ExposureTimeAbs"), ("Gain",)
RATE = ("AcquisitionFrameRate", "AcquisitionFrameRateAbs")


def load_pylon() -> tuple[Any, Any]:
    """The modules pylon and genicam. Raises CameraError that says what to install."""
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
        raise CameraError(f"expected pylon to list cameras, found: {_line(error)}") from None


class PylonSource:
    """The camera of a serial number."""

    def __init__(self, name: str, settings: CameraSettings) -> None:
        """Raises CameraError where pypylon is missing."""
        self._pylon, self._genicam = load_pylon()
        self._name, self._settings = name, settings

    @contextmanager
    def connect(self) -> Iterator[_PylonCamera]:
        """Connect and apply the settings; stop and release the camera on exit."""
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
            raise CameraError(f"{self._name}: expected a camera, found: {_line(error)}") from None
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
        self._trigger = SoftwareTrigger(settings)
        self.info = _describe(genicam, device, settings)

    def start(self) -> None:
        """Start acquisition of every frame in order."""
        try:
            self._device.MaxNumBuffer.SetValue(BUFFERS)
            self._device.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        except self._genicam.GenericException as error:
            raise CameraLost(_line(error)) from None
        self._trigger.start()

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next frame from pylon, complete or not."""
        try:
            if self._device.IsCameraDeviceRemoved():
                raise CameraLost("the camera was removed")
            if self._trigger.is_due():
                self._device.ExecuteSoftwareTrigger()
            wait_ms = math.ceil(self._trigger.limit_wait(timeout_s) * 1000)
            with self._device.RetrieveResult(wait_ms, self._pylon.TimeoutHandling_Return) as result:
                return self._read_result(result) if result.IsValid() else None
        except self._genicam.GenericException as error:
            raise CameraLost(_line(error)) from None

    def _read_result(self, result: Any) -> RawImage | Loss:
        """The frame in a grab result."""
        if not result.GrabSucceeded():
            return Loss(f"a frame came incomplete ({' '.join(result.GetErrorDescription().split())})")
        found = f"{result.GetWidth()}x{result.GetHeight()} {self.info.pixel_format}"
        payload = self.info.take_payload(bytes(result.GetBuffer()), found, result.GetPaddingX() > 0)
        stamp = result.GetTimeStamp() or time.time_ns()  # the emulator has no clock
        frame_id = result.GetBlockID()
        return RawImage(payload, frame_id, stamp, self._ids.lost_before(frame_id))


def _find(pylon: Any) -> list[Any]:
    """Every camera, or only the emulated ones where there are any."""
    factory = pylon.TlFactory.GetInstance()
    if not os.environ.get("PYLON_CAMEMU"):
        return list(factory.EnumerateDevices())
    info = pylon.DeviceInfo()
    info.SetDeviceClass("BaslerCamEmu")
    return list(factory.EnumerateDevices([info]))


def _apply(genicam: Any, nodes: Any, settings: CameraSettings) -> None:
    """Apply the settings."""
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
    """Set the first of the features that the camera has. Raises CameraError if it has none or refuses the value."""
    node = next((node for node in map(nodes.GetNode, names) if node is not None and genicam.IsWritable(node)), None)
    if node is None:
        raise CameraError(f"expected a camera with the feature {names[0]}, found none that can be set")
    try:
        if isinstance(value, str):
            node.FromString(value)
        else:
            node.SetValue(value)
    except genicam.GenericException as error:
        text = value if isinstance(value, str) else f"{value:.12g}"
        raise CameraError(f"expected a camera that takes {names[0]} {text}, found: {_line(error)}") from None


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
    reported = {"trigger": settings.trigger, "features": dict(settings.features), "exposure_us": exposure}
    reported |= {"gain_db": _read(genicam, nodes, GAIN), "frame_rate_hz": rate}
    patience_s = settings.patience_s(rate, exposure)
    width, height = (int(nodes.GetNode(side).GetValue()) for side in ("Width", "Height"))
    pixel_format = nodes.GetNode("PixelFormat").ToString()
    return CameraInfo(device.GetDeviceInfo().GetFriendlyName(), width, height, pixel_format, reported, patience_s)


def _line(error: Exception) -> str:
    """The message of GenApi in one line, without the place in its source."""
    return " ".join(str(error).split()).partition(" : ")[0]
