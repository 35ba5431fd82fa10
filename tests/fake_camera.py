"""A GigE camera on 127.0.0.1 that sends our own frames: Aravis's fake camera, for a program of its own.

    python fake_camera.py WIDTHxHEIGHT PIXEL_FORMAT CODE FILE...

FILE k holds the bytes of one frame; a frame of id n is file n modulo their number. CODE is the pixel format's number
(Pixel Format Naming Convention). Prints "ready" when it can be connected to, and runs until it is killed or ten minutes
old. Ids begin at 65400, as Aravis has it, so that 16 bits are soon used up.
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import gi

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402

#: Whoever started it may have been killed before it could end it.
LIFETIME_S = 600
FILL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32)


def genicam_file(pixel_format: str, code: int) -> str:
    """Aravis's own description of its fake camera, with one more pixel format."""
    xml, _ = Aravis.FakeCamera.new("any").get_genicam_xml()
    head = '<Enumeration Name="PixelFormat" NameSpace="Standard">'
    entry = f'<EnumEntry Name="{pixel_format}" NameSpace="Standard"><Value>{code}</Value></EnumEntry>'
    assert head in xml
    with tempfile.NamedTemporaryFile("w", suffix=".xml", delete=False) as file:
        file.write(xml.replace(head, head + entry))
    return file.name


def fill_with(fake: Any, frames: list[bytes]) -> ctypes._CFuncPtr:
    """What the camera calls for every frame; the buffer does not know its size yet."""
    library = ctypes.CDLL("libaravis-0.8.so.0")
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.c_void_p]
    library.arv_buffer_get_frame_id.restype = ctypes.c_uint64
    library.arv_buffer_get_frame_id.argtypes = [ctypes.c_void_p]
    library.arv_fake_camera_set_fill_pattern.argtypes = [ctypes.c_void_p, FILL, ctypes.c_void_p]

    def fill(buffer: int, _data: int, _exposure: int, _gain: int, _format: int) -> None:
        frame = frames[library.arv_buffer_get_frame_id(buffer) % len(frames)]
        ctypes.memmove(library.arv_buffer_get_data(buffer, None), frame, min(len(frame), fake.get_payload()))

    return FILL(fill)


def main(size: str, pixel_format: str, code: str, *files: str) -> None:
    """Serve the frames."""
    width, height = map(int, size.split("x"))
    camera = Aravis.GvFakeCamera.new_full("127.0.0.1", "POLSEP", genicam_file(pixel_format, int(code, 0)))
    assert camera.is_running(), "no camera on 127.0.0.1: is there another one?"
    fake = camera.get_fake_camera()
    registers = {"SENSOR_WIDTH": width, "SENSOR_HEIGHT": height, "WIDTH": width, "HEIGHT": height}
    for name, value in {**registers, "PIXEL_FORMAT": int(code, 0)}.items():
        fake.write_register(getattr(Aravis, f"FAKE_CAMERA_REGISTER_{name}"), value)
    fill = fill_with(fake, [Path(file).read_bytes() for file in files])
    ctypes.CDLL("libaravis-0.8.so.0").arv_fake_camera_set_fill_pattern(ctypes.c_void_p(hash(fake)), fill, None)
    print("ready", flush=True)
    threading.Event().wait(LIFETIME_S)


if __name__ == "__main__":
    main(*sys.argv[1:])
