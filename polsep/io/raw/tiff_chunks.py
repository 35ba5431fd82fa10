"""Strips and tiles of a TIFF picture, measured before they are decoded.

A chunk's room is what the directory says, but PNG, JPEG 2000 and LERC chunks have headers of their own, and their
decoders believe those: a tile of 700 bytes can hold a picture of gigabytes. They say too where samples were changed.
Sources: ISO/IEC 15444-1, A.5.1 (SIZ), A.6.1 (COD); W3C, PNG, 3rd edition, 11.2.1 (IHDR); Esri, LERC 2, Lerc2.h.
"""

from __future__ import annotations

import math
import struct
from typing import BinaryIO

import tifffile

from polsep.io.store.errors import InputError
from polsep.io.store.header_checks import require_size

#: Compressions of streams of bytes, whose decoders stop at the room of a chunk, and of pictures.
STREAMS = (1, 5, 8, 32773, 32946, 34925, 34926, 50000)
PNG, JPEG_2000, LERC = 34933, (33003, 33005, 34712), 34887
PICTURES = (PNG, *JPEG_2000, LERC)
#: Bytes of a chunk that hold its header, and places of the type of samples and their largest error in those of LERC, by
#: version.
_HEAD, _LERC_FIELDS = 1024, {2: (30, 34), 3: (34, 38), 6: (38, 50)}
#: Samples that a chunk may have more than four times its picture: scanners write large tiles.
_SPARE = 2**18


def check_chunks(stream: BinaryIO, page: tifffile.TiffPage) -> None:
    """Raise InputError where the chunks of a directory could hold much more than its picture."""
    across, chunk = page.chunked, math.prod(page.chunks)
    require_size(page.chunks)
    if chunk > 4 * math.prod(page.shape) + _SPARE:
        sides = "x".join(map(str, page.chunks))
        raise InputError(f"expected TIFF strips or tiles of about the picture's size, found {sides} samples in one")
    if page.compression not in PICTURES:
        return
    height, width = (page.tilelength, page.tilewidth) if page.is_tiled else (page.imagelength, page.imagewidth)
    for offset, count in zip(page.dataoffsets[: math.prod(across)], page.databytecounts, strict=False):
        if count:
            stream.seek(offset)
            head = stream.read(min(count, _HEAD))
            found = _size_in(int(page.compression), head)
            most = (height, width, page.samplesperpixel)
            if found is None or any(own > said for own, said in zip(found, most, strict=True)):
                raise InputError(f"expected a chunk of at most {_said(most)} as the TIFF says, found {_said(found)}")
            if loss := _loss_in(int(page.compression), head):
                raise InputError(f"expected lossless samples, found {loss}")


def _said(size: tuple[int, ...] | None) -> str:
    return "a damaged one" if size is None else "x".join(map(str, size))


def _size_in(compression: int, head: bytes) -> tuple[int, int, int] | None:
    """Height, width and samples per pixel by a chunk's own header; None where that is not of the ``compression``.

    PNG has four samples at most, of which nothing is said here.
    """
    samples = 1
    if compression == PNG and head[:8] == b"\x89PNG\r\n\x1a\n" and head[12:16] == b"IHDR" and len(head) >= 24:
        width, height = struct.unpack_from(">2I", head, 16)
    elif compression in JPEG_2000 and head[:4] == b"\xff\x4f\xff\x51" and len(head) >= 42:
        width, height = struct.unpack_from(">2I", head, 8)
        (samples,) = struct.unpack_from(">H", head, 40)
    elif compression == LERC and head[:6] == b"Lerc2 " and len(head) >= 26:
        (version,) = struct.unpack_from("<i", head, 6)
        height, width, samples = struct.unpack_from("<3i", head, 14 if version >= 3 else 10)
        samples = samples if version >= 4 else 1
    else:
        return None
    return height, width, samples


def _loss_in(compression: int, head: bytes) -> str | None:
    """Loss that a chunk's own header tells of; None where it tells of none."""
    place = 2  # behind SOC, markers with lengths come until the first tile
    while compression in JPEG_2000 and place + 14 <= len(head) and head[place : place + 2] != b"\xff\x90":
        marker, length = struct.unpack_from(">2H", head, place)
        if marker == 0xFF52:  # COD: the wavelet is its tenth byte
            return "JPEG 2000 of the irreversible wavelet" if head[place + 13] == 0 else None
        place += 2 + length
    if compression == LERC and len(head) >= 58:
        kind_at, error_at = _LERC_FIELDS.get(struct.unpack_from("<i", head, 6)[0], (38, 42))
        (kind,), (error,) = struct.unpack_from("<i", head, kind_at), struct.unpack_from("<d", head, error_at)
        if error > (0.5 if kind < 6 else 0.0):  # whole numbers keep to half a step
            return f"LERC with errors up to {error:g}"
    return None
