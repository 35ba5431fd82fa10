"""PNG of 8 and 16 bits, gray (a mosaic) or RGB (one analyser's picture), exact.

Every chunk is checked before decoding, and ancillary chunks are left out: gamma, colour profiles and transparency say
nothing about linear samples.
Note: a decoder alone does not do. imagecodecs turns transparency into a channel and returns files without their end as
if they were complete; Pillow reads 16-bit RGB as 8 bits.
Source: W3C, Portable Network Graphics (PNG) Specification, 3rd edition, sections 5 and 11.2.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import imagecodecs
import numpy as np

from polsep.io.raw.page import Page
from polsep.io.store.errors import decoding
from polsep.io.store.header_checks import require_signature, require_size
from polsep.io.store.quiet import mute

SIGNATURE = b"\x89PNG\r\n\x1a\n"

#: Colour types of the standard, section 11.2.1, table 12.
_COLORS = {0: "gray", 2: "RGB", 3: "palette", 4: "gray with alpha", 6: "RGB with alpha"}
_CHANNELS = {0: 1, 2: 3}

mute("imagecodecs")


def read_png(path: Path, first: int = 0) -> Iterator[Page]:
    """The one picture of a PNG file: ``[H, W]`` or ``[H, W, 3]``, uint8 or uint16. Raises ValueError."""
    with path.open("rb") as stream:
        require_signature(stream, (SIGNATURE,), "a PNG")
        head = stream.read(33)
        shape, dtype = _parse_header(head)
        data = head + stream.read()
    stripped = _critical_chunks(data)
    with decoding("PNG"):
        array = np.asarray(imagecodecs.png_decode(stripped))
    if array.shape != shape or array.dtype != dtype:
        raise ValueError(f"expected {dtype} samples {shape} as the PNG header says, found {array.dtype} {array.shape}")
    yield Page(array)


def _parse_header(head: bytes) -> tuple[tuple[int, ...], np.dtype[np.uint8] | np.dtype[np.uint16]]:
    """Shape and dtype by the IHDR chunk. Raises ValueError on kinds of PNG that hold no raw samples."""
    if len(head) < 33:
        raise ValueError(f"expected a PNG header of 33 bytes, found {len(head)}")
    if head[8:16] != b"\0\0\0\x0dIHDR" or zlib.crc32(head[12:29]) != struct.unpack(">I", head[29:33])[0]:
        raise ValueError("expected an intact PNG header (IHDR), found a damaged one")
    width, height, depth, color = struct.unpack(">IIBB", head[16:26])
    if color not in _CHANNELS:
        raise ValueError(f"expected a gray or RGB PNG, found {_COLORS.get(color, f'colour type {color}')}")
    if depth not in (8, 16):
        raise ValueError(f"expected 8 or 16 bits per sample, found {depth}")
    shape = (height, width) if color == 0 else (height, width, _CHANNELS[color])
    require_size(shape)
    return shape, np.dtype(np.uint8) if depth == 8 else np.dtype(np.uint16)


def _critical_chunks(data: bytes) -> bytes:
    """The file with critical chunks only. Raises ValueError at the first chunk that is cut or has a wrong checksum."""
    view = memoryview(data)
    kept: list[bytes | memoryview] = [SIGNATURE]
    position = len(SIGNATURE)
    while True:
        if len(data) - position < 12:
            raise ValueError(f"expected a PNG that ends with IEND, found its end at byte {len(data)}: it is truncated")
        length = struct.unpack_from(">I", data, position)[0]
        kind = data[position + 4 : position + 8]
        end = position + 12 + length
        if end > len(data):
            raise ValueError(
                f"expected {length} bytes in PNG chunk {kind!r}, found {len(data) - position - 12}: it is truncated"
            )
        if zlib.crc32(view[position + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise ValueError(f"expected the checksum of PNG chunk {kind!r} to match, found damage at byte {position}")
        if not kind[0] & 32:  # bit 5 of the first byte: ancillary (section 5.4)
            kept.append(view[position:end])
        if kind == b"IEND":
            return b"".join(kept)
        position = end
