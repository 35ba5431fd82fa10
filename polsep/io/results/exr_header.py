"""The header of an OpenEXR file, read and measured before OpenEXR sees the file.

OpenEXR makes room for what a header promises: gigabytes for a few hundred bytes. Here a header is refused unless the
file can hold the table of its chunks, and unless its channels are ones that polsep reads.
Source: OpenEXR, "OpenEXR File Layout" (openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import NamedTuple

from polsep.io.store.errors import InputError
from polsep.io.store.header_checks import require_size

#: Attributes of a file by name: texts, and numbers, which become float32.
Notes = Mapping[str, str | float]

#: How every message begins.
EXPECTED = "expected a complete single-part EXR file"
#: Flags of the version field: tiles, deep pixels, several parts.
_TILED, _DEEP, _PARTS = 1 << 9, 1 << 11, 1 << 12
#: Rows per chunk of scanlines by the number of the compression; 1 of those that are not listed.
_ROWS = {3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256, 10: 32, 11: 256, 12: 256}
#: Longest name, and most attributes and channels in a header.
_LONGEST, _MOST = 255, 1000
#: Bytes of a chunk before its pixels at least, and of its entry in the table.
_LEADER, _ENTRY = 8, 8


class Window(NamedTuple):
    """The first and the last column and row of pixels."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.right - self.left + 1, self.bottom - self.top + 1


def check_exr_header(data: bytes) -> tuple[Window, Window]:
    """The data window and the display window of a file.

    Raises InputError unless its header is of one flat part that the file has room for, of sizes allowed.
    """
    (version,) = struct.unpack_from("<I", data, 4) if len(data) >= 8 else (0,)
    if version & 255 != 2 or version & (_DEEP | _PARTS):
        raise InputError(f"{EXPECTED}, found another version, deep pixels or more parts")
    values, end = dict[str, bytes](), 8
    for name, value, place in _attributes(data):
        values[name], end = value, place
    missing = [name for name in ("channels", "compression", "dataWindow") if not values.get(name)]
    if missing or len(values["dataWindow"]) != 16:
        raise InputError(f"{EXPECTED}, found a header without {', '.join(missing) or 'dataWindow'}")
    channels = sum(1 for _ in _channels(values["channels"]))
    window, shown = _window(values["dataWindow"]), _window(values.get("displayWindow", values["dataWindow"]))
    width, height = window.size
    for size in (window.size, shown.size):
        require_size((size[1], size[0], max(channels, 1)))
    chunks = -(-height // _ROWS.get(values["compression"][0], 1))
    if version & _TILED:
        if len(values.get("tiles", b"")) != 9:
            raise InputError(f"{EXPECTED}, found tiles of no size")
        across, down = struct.unpack_from("<2I", values["tiles"])
        require_size((down, across, max(channels, 1)))
        chunks = -(-width // across) * -(-height // down)
    if (needed := end + chunks * (_LEADER + _ENTRY)) > len(data):
        raise InputError(f"{EXPECTED} of {needed} bytes or more for {chunks} chunks, found {len(data)} bytes")
    return window, shown


def _window(value: bytes) -> Window:
    """The window of an attribute. Raises InputError."""
    if len(value) != 16:
        raise InputError(f"{EXPECTED}, found a window of {len(value)} bytes")
    return Window(*struct.unpack("<4i", value))


def packed_note(note: str | float) -> tuple[str, bytes]:
    """Type and bytes of an attribute."""
    return ("string", note.encode()) if isinstance(note, str) else ("float", struct.pack("<f", note))


def _attributes(data: bytes) -> Iterator[tuple[str, bytes, int]]:
    """Name, value and end of every attribute of a header; the last end is that of the header, but for one byte."""
    place = 8
    for _ in range(_MOST):
        name, place = _text(data, place)
        if not name:
            return
        _, place = _text(data, place)
        (size,) = struct.unpack_from("<i", data, place) if place + 4 <= len(data) else (-1,)
        place += 4
        if not 0 <= size <= len(data) - place:
            raise InputError(f"{EXPECTED}, found the end of {name} beyond the file")
        yield name, data[place : place + size], place + size
        place += size
    raise InputError(f"{EXPECTED} of at most {_MOST} attributes, found more")


def _channels(listed: bytes) -> Iterator[str]:
    """The names of a list of channels of whole resolution; InputError on others."""
    place = 0
    for _ in range(_MOST):
        name, place = _text(listed, place)
        if not name:
            return
        if place + 16 > len(listed):
            break
        kind, _, across, down = struct.unpack_from("<iI2i", listed, place)
        place += 16
        if kind not in (0, 1, 2) or (across, down) != (1, 1):
            raise InputError(f"expected whole pixels in channel {name}, found type {kind} of every {across}x{down}")
        yield name
    raise InputError(f"{EXPECTED} of at most {_MOST} channels, found more, or a damaged list")


def _text(data: bytes, place: int) -> tuple[str, int]:
    """The text that ends with a zero byte at ``place``, and the place behind that. Raises InputError."""
    end = data.find(b"\0", place, place + _LONGEST + 1)
    if end < 0:
        raise InputError(f"{EXPECTED}, found a header that ends early or is damaged")
    try:
        return data[place:end].decode("utf-8"), end + 1
    except UnicodeDecodeError:
        raise InputError(f"{EXPECTED}, found a name in its header that is not UTF-8") from None
