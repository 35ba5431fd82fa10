"""OpenEXR files, read and written by layers.

Note: `write_exr_halves` writes uncompressed half floats without the library, which takes twice as long: it spends 35 of
50 ms per 2448x2048 frame on copying channels, too much for a video. (Best of 9 on two busy cores, two such colour
images: 0.91 s by `encode_exr(planes, {}, "none")`, 0.44 s by `write_exr_halves`.) Uncompressed scanlines are a header,
a table of offsets and the rows; the tests read them back by the library. Source: OpenEXR, "OpenEXR File Layout"
(openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import io
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import OpenEXR  # a bare extension module without stubs
from numpy.typing import NDArray

from polsep.io.results.exr_header import EXPECTED, check_exr_header
from polsep.io.store.errors import InputError, naming
from polsep.io.store.header_checks import require_signature
from polsep.io.store.quiet import quiet

Number = TypeVar("Number", bound=np.generic)

COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
}
#: The largest half float.
LARGEST_HALF = 65504.0
_MAGIC, _VERSION, _HALF = 20000630, 2, 1
#: How the lines begin that OpenEXR writes to standard error.
_MARK = b"<python_buffer>"
_SIGNATURE = _MAGIC.to_bytes(4, "little")


def read_exr_layers(path: Path) -> dict[str, NDArray[np.float32]]:
    """Every channel of a single-part EXR file by its full name, such as ``diffuse.R``, each ``[H, W]``.

    Raises InputError on anything but a complete single-part EXR (OpenEXR itself returns no part and prints a warning
    when pixels are missing), and on too large sizes in the header, before any pixel is read.
    """
    with naming(path):
        with Path(path).open("rb") as stream:
            require_signature(stream, (_SIGNATURE,), "an OpenEXR")
            data = stream.read()
        check_exr_header(data)
        return {name: channel.pixels for name, channel in _open_exr(data).channels().items()}


def _open_exr(data: bytes) -> Any:
    """OpenEXR's view of a file of one part."""
    try:
        with quiet(_MARK):
            file = OpenEXR.File(io.BytesIO(data), separate_channels=True)
    except Exception as error:  # RuntimeError as a rule, and what pybind11 makes of other damage
        raise InputError(f"{EXPECTED}, found one that OpenEXR cannot open") from error
    if len(file.parts) != 1:
        raise InputError(f"{EXPECTED}, found {len(file.parts)} readable parts")
    return file


def encode_exr(planes: Mapping[str, NDArray[Any]], notes: Mapping[str, str], compression: str = "zip") -> memoryview:
    """One part of scanlines: channels ``[H, W]``, float16 or float32, by name; ``notes``: attributes."""
    header = {**notes, "compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    # A fresh dict, because OpenEXR replaces its arrays, and contiguous planes, because it misreads others silently.
    channels = {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
    stream = io.BytesIO()
    OpenEXR.File(header, channels).write(stream)
    return stream.getbuffer()


def as_planes(layers: Mapping[str, NDArray[Number]]) -> dict[str, NDArray[Number]]:
    """Channels of layers by name, views: name.R, name.G and name.B of ``[H, W, 3]``, name.Y of ``[H, W, 1]``."""
    return {
        f"{name}.{color}": image[..., k]
        for name, image in layers.items()
        for k, color in enumerate("RGB" if image.shape[2] == 3 else "Y")
    }


def as_half_planes(layers: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float16]]:
    """`as_planes` in half floats. Light above the largest half float becomes that."""
    halves: dict[str, NDArray[np.float16]] = {}
    for name, image in layers.items():
        halves[name] = np.minimum(image, np.float32(LARGEST_HALF)).astype(np.float16)
    return as_planes(halves)


def write_exr_halves(path: Path, planes: Mapping[str, NDArray[np.float16]], notes: Mapping[str, str]) -> None:
    """Write channels ``[H, W]`` without compression; ``notes``: attributes. Raises OSError."""
    names = sorted(planes)
    height, width = planes[names[0]].shape
    rows = np.empty(height, np.dtype([("y", "<i4"), ("bytes", "<i4"), ("light", "<f2", (len(names), width))]))
    rows["y"], rows["bytes"] = np.arange(height), 2 * len(names) * width
    for place, name in enumerate(names):
        rows["light"][:, place] = planes[name]
    head = _header(names, (width, height), notes)
    offsets = len(head) + 8 * height + rows.itemsize * np.arange(height, dtype="<u8")
    with path.open("wb") as stream:
        stream.write(head)
        stream.write(offsets.astype("<u8").tobytes())
        stream.write(rows.data)


def _header(channels: list[str], size: tuple[int, int], notes: Mapping[str, str]) -> bytes:
    """Magic number, version and attributes of a part of scanlines."""
    window = struct.pack("<4i", 0, 0, size[0] - 1, size[1] - 1)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<i4B2i", _HALF, 0, 0, 0, 0, 1, 1) for name in channels)
    attributes = [
        ("channels", "chlist", listed + b"\0"),
        ("compression", "compression", b"\0"),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
        *((name, "string", text.encode()) for name, text in notes.items()),
    ]
    packed = (
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    return struct.pack("<2i", _MAGIC, _VERSION) + b"".join(packed) + b"\0"
