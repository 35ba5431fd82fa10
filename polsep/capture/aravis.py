"""GenICam cameras through Aravis: GigE Vision and USB3 Vision of every vendor, without vendor software.

Aravis keeps the control channel alive and receives packets in its own threads, outside Python; a frame is copied once,
from its buffer into bytes. Tested with Aravis 0.8.26 (Debian 12).
"""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from polsep.capture.sources import CameraError, CameraInfo, CameraLost, CameraSettings, FrameIds, Loss, SoftwareTrigger
from polsep.io.raw.recording import RawImage

#: Buffers that Aravis fills while Python is busy: 1.6 s at 10 frames per second.
BUFFERS = 16
#: Longest time in microseconds that Aravis waits for the missing packets of a frame; its default of 200 ms is too
#: short on a busy machine.
RETENTION_US = 1_000_000


def load_aravis() -> tuple[Any, type[Exception]]:
    """The library and the exception that it raises. Raises CameraError that says what to install."""
    try:
        import gi

        gi.require_version("Aravis", "0.8")
        from gi.repository import Aravis, GLib
    except (ImportError, ValueError) as error:
        raise CameraError(
            "expected Aravis (Debian: apt install gir1.2-aravis-0.8 python3-gi, in a virtual environment made with "
            f"--system-site-packages; see docs/capture.md), found {error}"
        ) from None
    return Aravis, GLib.Error


def list_aravis() -> list[tuple[str, str]]:
    """Id and description of every camera that Aravis finds, in about a second. Raises CameraError."""
    aravis, _ = load_aravis()
    aravis.update_device_list()
    cameras = []
    for k in range(aravis.get_n_devices()):
        vendor, model = aravis.get_device_vendor(k), aravis.get_device_model(k)
        serial, address = aravis.get_device_serial_nbr(k), aravis.get_device_address(k)
        cameras.append((aravis.get_device_id(k), f"{vendor} {model}, serial {serial}, at {address}"))
    return cameras


class AravisSource:
    """The camera of an Aravis id, address (127.0.0.1) or serial number."""

    def __init__(self, name: str, settings: CameraSettings) -> None:
        """Raises CameraError where Aravis is missing."""
        self._aravis, self._error = load_aravis()
        self._name, self._settings = name, settings

    @contextmanager
    def connect(self) -> Iterator[_AravisCamera]:
        """Connect and apply the settings; stop and release the camera on exit."""
        try:
            camera = _AravisCamera(self._aravis, self._error, self._aravis.Camera.new(self._name), self._settings)
        except (ValueError, self._error) as error:
            traceback.clear_frames(error.__traceback__)  # a camera kept alive there would refuse the next connection
            reason = (
                str(error)
                if isinstance(error, ValueError)
                else f"expected a camera that does as asked, found: {_line(error)}"
            )
            raise CameraError(f"{self._name}: {reason}") from None
        try:
            yield camera
        finally:
            camera.stop()


class _AravisCamera:
    """The `Camera` of Aravis."""

    def __init__(self, aravis: Any, error: type[Exception], device: Any, settings: CameraSettings) -> None:
        self._aravis, self._error = aravis, error
        self._device, self._stream = device, None
        self._ids, self._gone = FrameIds(), threading.Event()
        _apply(aravis, device, settings)
        self._trigger = SoftwareTrigger(settings)
        self._code = device.get_pixel_format()
        self.info = _describe(device, settings)

    def start(self) -> None:
        """Create the stream and start acquisition."""
        gone = self._gone
        try:
            self._stream = stream = self._device.create_stream(None, None)
            if self._device.is_gv_device():
                stream.set_property("socket-buffer", self._aravis.GvStreamSocketBuffer.AUTO)
                stream.set_property("frame-retention", RETENTION_US)
            payload = self._device.get_payload()
            for _ in range(BUFFERS):
                stream.push_buffer(self._aravis.Buffer.new_allocate(payload))
            self._device.get_device().connect("control-lost", lambda _: gone.set())
            self._device.start_acquisition()
        except self._error as error:
            raise CameraLost(_line(error)) from None
        self._trigger.start()

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next frame from Aravis, complete or not."""
        assert self._stream is not None, "expected a camera that was started"
        if self._gone.is_set():
            raise CameraLost("the control channel is closed")
        if self._trigger.is_due():
            try:
                self._device.software_trigger()
            except self._error as error:
                raise CameraLost(_line(error)) from None
        buffer = self._stream.timeout_pop_buffer(int(self._trigger.limit_wait(timeout_s) * 1e6))
        if buffer is None:
            return None
        try:
            return self._read_buffer(buffer)
        finally:
            self._stream.push_buffer(buffer)

    def stop(self) -> None:
        """Stop and release the camera, which may be gone already."""
        with suppress(self._error):
            self._device.stop_acquisition()
        self._stream = None
        self._device = None

    def _read_buffer(self, buffer: Any) -> RawImage | Loss:
        """The frame in a buffer."""
        frame_id, status = buffer.get_frame_id(), buffer.get_status()
        if status != self._aravis.BufferStatus.SUCCESS:
            return Loss(f"a frame came incomplete ({status.value_nick})")
        code = buffer.get_image_pixel_format()
        name = self.info.pixel_format if code == self._code else f"in format 0x{code:08X}"
        found, padded = (
            f"{buffer.get_image_width()}x{buffer.get_image_height()} {name}",
            any(buffer.get_image_padding()),
        )
        payload = self.info.take_payload(buffer.get_image_data(), found, padded)
        stamp = buffer.get_timestamp() or buffer.get_system_timestamp()
        return RawImage(payload, frame_id, stamp, self._ids.lost_before(frame_id))


def _apply(aravis: Any, device: Any, settings: CameraSettings) -> None:
    """Apply the settings, in an order in which later ones do not undo earlier ones."""
    device.set_range_check_policy(aravis.RangeCheckPolicy.ENABLE)
    device.set_acquisition_mode(aravis.AcquisitionMode.CONTINUOUS)
    for name, value in settings.features:
        device.get_device().set_features_from_string(f"{name}={value}")
    if settings.pixel_format is not None:
        known = device.dup_available_pixel_formats_as_strings()
        if settings.pixel_format not in known:
            raise CameraError(f"expected a pixel format of {', '.join(known)}, found {settings.pixel_format!r}")
        device.set_pixel_format_from_string(settings.pixel_format)
    off = aravis.Auto.OFF
    if settings.exposure_us is not None:
        if device.is_exposure_auto_available():
            device.set_exposure_time_auto(off)
        _set_within("exposure", "us", settings.exposure_us, device.get_exposure_time_bounds(), device.set_exposure_time)
    if settings.gain_db is not None:
        if device.is_gain_auto_available():
            device.set_gain_auto(off)
        _set_within("gain", "dB", settings.gain_db, device.get_gain_bounds(), device.set_gain)
    if settings.trigger is not None:
        _set_trigger(device, settings.trigger)
    if settings.frame_rate_hz is not None and settings.trigger in (None, "off"):
        bounds = device.get_frame_rate_bounds()
        _set_within("frame rate", "Hz", settings.frame_rate_hz, bounds, device.set_frame_rate)


def _set_trigger(device: Any, trigger: str) -> None:
    """Set free running, or a trigger source by the camera's name for it."""
    device.clear_triggers()
    if trigger == "off":
        return
    known = device.dup_available_trigger_sources()
    if trigger not in known:
        raise CameraError(f"expected a trigger of off, {', '.join(known)}, found {trigger!r}")
    device.set_trigger(trigger)


def _set_within(name: str, unit: str, value: float, bounds: Any, put: Callable[[float], None]) -> None:
    """Set a number after a check of its range, which Aravis itself does not make."""
    low, high = bounds
    if not low <= value <= high:
        raise CameraError(f"expected {name} in {low:g} .. {high:g} {unit}, found {value:g}")
    put(value)


def _describe(device: Any, settings: CameraSettings) -> CameraInfo:
    """The camera as it is now."""
    region = device.get_region()
    reported: dict[str, Any] = {"trigger": settings.trigger, "features": dict(settings.features)}
    if device.is_exposure_time_available():
        reported["exposure_us"] = device.get_exposure_time()
    if device.is_gain_available():
        reported["gain_db"] = device.get_gain()
    if device.is_frame_rate_available():
        reported["frame_rate_hz"] = device.get_frame_rate()
    patience_s = settings.patience_s(reported.get("frame_rate_hz"), reported.get("exposure_us"))
    name = " ".join((device.get_vendor_name(), device.get_model_name(), device.get_device_serial_number()))
    return CameraInfo(name, region.width, region.height, device.get_pixel_format_as_string(), reported, patience_s)


def _line(error: Exception) -> str:
    """The message of GLib in one line."""
    return " ".join(str(getattr(error, "message", error)).split())
