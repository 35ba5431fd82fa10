"""OpenEXR files, read and written by layers.

Note: `encode_exr_halves` makes files without the library, which takes five times as long for the images of a video: it
copies channels, and its ZIP compression searches where there is nothing to find (`pixels_kernel`). Scanlines are a
header, a table of offsets and the chunks; the tests read them back by the library. Source: OpenEXR, "OpenEXR File
Layout" (openexr.com/en/latest/OpenEXRFileLayout.html).
"""

from __future__ import annotations

import io
import os
import struct
import threading
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import OpenEXR  # a bare extension module without stubs
from numpy.typing import NDArray

from polsep.compute.compiling import read_only
from polsep.compute.threads import get_threads, run_over_rows
from polsep.io.results.exr_header import EXPECTED, Notes, Window, check_exr_header, packed_note
from polsep.io.results.pixels_kernel import CHUNK, HEAD, LARGEST, ROWS, STORED, fill_rows, pack_chunks
from polsep.io.store.errors import InputError, naming, refuse_pipe
from polsep.io.store.header_checks import require_signature
from polsep.io.store.quiet import quiet

Number = TypeVar("Number", bound=np.generic)

COMPRESSIONS = {
    "none": OpenEXR.NO_COMPRESSION,
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
}
#: The largest half float.
LARGEST_HALF = float(LARGEST)
#: Numbers of compressions in headers.
_NUMBERS = {"none": 0, "zip": 3}
_MAGIC, _VERSION, _HALF = 20000630, 2, 1
#: How the lines begin that OpenEXR writes to standard error.
_MARK = b"<python_buffer>"
_SIGNATURE = _MAGIC.to_bytes(4, "little")
#: Held while OpenEXR has threads, which are the process's: a child forked meanwhile would wait for them in vain.
_WRITING = threading.Lock()

if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_WRITING.acquire, after_in_parent=_WRITING.release, after_in_child=_WRITING.release)


def read_exr_layers(path: Path) -> dict[str, NDArray[np.float32]]:
    """Every channel of a single-part EXR file by its full name, such as ``diffuse.R``, each ``[H, W]``.

    They are of the display window, as compositing programs show it: 0 where the file has no pixels.
    Raises InputError on anything but a complete single-part EXR (OpenEXR itself returns no part and prints a warning
    when pixels are missing), and on too large sizes in the header, before any pixel is read.
    """
    with naming(path):
        refuse_pipe(path)
        with Path(path).open("rb") as stream:
            require_signature(stream, (_SIGNATURE,), "an OpenEXR")
            data = stream.read()
        window, shown = check_exr_header(data)
        channels = _open_exr(data).channels().items()
        return {name: _in_display(channel.pixels, window, shown) for name, channel in channels}


def _in_display(pixels: NDArray[Number], window: Window, shown: Window) -> NDArray[Number]:
    """The pixels of a data window at their places in the display window that is ``shown``."""
    if window == shown:
        return pixels
    image = np.zeros(shown.size[::-1], pixels.dtype)
    top, bottom = max(window.top, shown.top), min(window.bottom, shown.bottom) + 1
    left, right = max(window.left, shown.left), min(window.right, shown.right) + 1
    if top < bottom and left < right:
        rows, cols = slice(top - window.top, bottom - window.top), slice(left - window.left, right - window.left)
        image[top - shown.top : bottom - shown.top, left - shown.left : right - shown.left] = pixels[rows, cols]
    return image


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


def encode_exr(planes: Mapping[str, NDArray[Any]], notes: Notes, compression: str = "zip") -> memoryview:
    """The file that `write_exr` writes."""
    stream = io.BytesIO()
    write_exr(stream, planes, notes, compression)
    return stream.getbuffer()


def write_exr(stream: BinaryIO, planes: Mapping[str, NDArray[Any]], notes: Notes, compression: str = "zip") -> None:
    """One part of scanlines: channels ``[H, W]``, float16 or float32, by name; ``notes``: attributes.

    ``[H, W, 3]`` is three channels, name.R, name.G and name.B, which are not copied. Raises the OSError of the stream.
    """
    header = {**notes, "compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    # A fresh dict, because OpenEXR replaces its arrays, and contiguous planes, because it misreads others silently.
    channels = {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
    with _WRITING:
        OpenEXR.set_global_thread_count(get_threads())
        try:
            OpenEXR.File(header, channels).write(stream)
        finally:
            OpenEXR.set_global_thread_count(0)


def as_planes(layers: Mapping[str, NDArray[Number]]) -> dict[str, NDArray[Number]]:
    """Channels of layers by name, views: name.R, name.G and name.B of ``[H, W, 3]``, name.Y of ``[H, W, 1]``.

    Those of the layer "" have no prefix: programs that know no layers show them.
    """
    return {
        f"{name}.{color}" if name else color: image[..., k]
        for name, image in layers.items()
        for k, color in enumerate("RGB" if image.shape[2] == 3 else "Y")
    }


def encode_exr_halves(layers: Mapping[str, NDArray[np.float32]], notes: Notes, compression: str) -> list[Any]:
    """Pieces of a file of half floats, one part of scanlines; ``layers [H, W, C]`` by name, ``notes``: attributes.

    Light above the largest half float becomes that.
    """
    # Channels by name, as the format wants them and as half_rows puts them: B before G before R.
    ordered = sorted(([*as_planes({name: image})][::-1], name) for name, image in layers.items())
    names = [channel for channels, _ in ordered for channel in channels]
    rows = half_rows([layers[name] for _, name in ordered])
    height, width = next(iter(layers.values())).shape[:2]
    if compression not in _NUMBERS:
        planes = (rows[:, HEAD + width * k : HEAD + width * (k + 1)] for k in range(len(names)))
        halves = {name: np.ascontiguousarray(plane).view(np.float16) for name, plane in zip(names, planes, strict=True)}
        return [encode_exr(halves, notes, compression)]
    if compression == "none":
        rows[:, :HEAD].view("<i4")[:] = [(y, 2 * len(names) * width) for y in range(height)]
        chunks: list[Any] = [rows.data.cast("B")]
        sizes = np.full(height, rows.strides[0])
    else:
        packed = zip_rows(rows, width)
        leaders = (struct.pack("<2i", CHUNK * k, len(chunk)) for k, chunk in enumerate(packed))
        chunks = [piece for pair in zip(leaders, packed, strict=True) for piece in pair]
        sizes = np.array([8 + len(chunk) for chunk in packed])
    head = _header(names, (width, height), notes, _NUMBERS[compression])
    offsets = len(head) + 8 * len(sizes) + np.cumsum(sizes) - sizes
    return [head, offsets.astype("<u8").tobytes(), *chunks]


def half_rows(images: Sequence[NDArray[np.float32]]) -> NDArray[np.uint16]:
    """Rows ``[H, HEAD + n W]`` with the bits of half floats, rounded to even, of planes ``[H, W]`` of n channels.

    ``images [H, W, C]``: their channels follow in the order of the images, from the last channel to the first. Light
    above `LARGEST_HALF` becomes that. The first words are not set.
    """
    height, width = images[0].shape[:2]
    rows = np.empty((height, HEAD + width * sum(image.shape[2] for image in images)), np.uint16)
    place = HEAD
    for image in images:
        light = read_only(np.ascontiguousarray(image, np.float32).reshape(height, -1))
        fill = partial(fill_rows, light, image.shape[2], place, rows)
        run_over_rows(fill, height, ROWS)
        place += width * image.shape[2]
    return rows


def zip_rows(rows: NDArray[np.uint16], width: int) -> list[memoryview]:
    """The chunks of rows ``[H, HEAD + n width]``, packed; one that would not get smaller as it is."""
    chunks = -(-rows.shape[0] // CHUNK)
    size = 2 * CHUNK * (rows.shape[1] - HEAD)
    packed = np.empty((chunks, size // 4 + 5 * (size // STORED + 2) + 16), np.uint32)
    sizes = np.zeros(chunks, np.int64)
    run_over_rows(partial(pack_chunks, read_only(rows), width, packed, sizes), chunks, 1)
    found = []
    for k in range(chunks):
        own = rows[CHUNK * k : CHUNK * (k + 1), HEAD:]
        data: NDArray[Any] = np.ascontiguousarray(own) if sizes[k] >= own.nbytes else packed[k]
        found.append(data.data.cast("B")[: min(int(sizes[k]), own.nbytes)])
    return found


def _header(channels: list[str], size: tuple[int, int], notes: Notes, compression: int) -> bytes:
    """Magic number, version and attributes of a part of scanlines."""
    window = struct.pack("<4i", 0, 0, size[0] - 1, size[1] - 1)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<i4B2i", _HALF, 0, 0, 0, 0, 1, 1) for name in channels)
    attributes = [
        ("channels", "chlist", listed + b"\0"),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0, 0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
        *((name, *packed_note(note)) for name, note in notes.items()),
    ]
    packed = (
        name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
        for name, kind, value in attributes
    )
    return struct.pack("<2i", _MAGIC, _VERSION) + b"".join(packed) + b"\0"
