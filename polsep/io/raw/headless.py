"""Raw camera dumps without a header, and PGM, whose header is one line.

A headless file is any whole number of frames of one size and pixel format, one after the other; both must be said.
Source: Netpbm, PGM format specification (binary P5; 16-bit samples are big-endian; white is maxval).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polsep.io.raw.genicam import PixelFormat, find_pixel_format, unpack_frame
from polsep.io.raw.pages import Page, describe, require_signature, require_size
from polsep.sensor.camera import Layout

_GAP = rb"(?:\s|#[^\n]*\n)+"
_PGM_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s")


def read_headless(path: Path, size: tuple[int, int], pixel_format: str, first: int = 0) -> Iterator[Page]:
    """The frames of a dump of (width, height) pixels, from ``first`` on; of ONE angle image for LUCID's angles.

    Raises ValueError.
    """
    fmt = find_pixel_format(pixel_format)
    width, height = size
    require_size((fmt.planes, height, width) if fmt.planes > 1 else (height, width))
    frame = fmt.frame_bytes(width, height)
    total = path.stat().st_size
    if total == 0 or total % frame:
        kind = f"{width}x{height} {fmt.name}" + ("; the size of ONE angle image" if fmt.planes > 1 else "")
        raise ValueError(f"expected a whole number of frames of {frame} bytes ({kind}), found {total} bytes")
    with path.open("rb") as stream:
        stream.seek(first * frame)
        for index in range(first, total // frame):
            yield headless_page(stream.read(frame), size, pixel_format, (index, total // frame))


def headless_page(payload: bytes, size: tuple[int, int], pixel_format: str, place: tuple[int, int] = (0, 1)) -> Page:
    """One frame of (width, height) pixels from the bytes a camera sent; ``place``: its index, of how many.

    Raises ValueError as `genicam.unpack_frame` does.
    """
    fmt = find_pixel_format(pixel_format)
    return Page(
        unpack_frame(payload, *size, pixel_format),
        *place,
        white_level=fmt.white_level if 8 < fmt.bits < 16 else None,  # 8 and 16 bits: that of the dtype
        layout=Layout(bayer=fmt.bayer),
        angles=fmt.planes > 1,
        sampled=fmt.planes > 1,
        notes=_mirror_notes(fmt),
    )


def _mirror_notes(fmt: PixelFormat) -> tuple[str, ...]:
    """Sony sensors read out as RGGB; another order may come from a mirrored frame, whose angles are mirrored too."""
    if fmt.bayer in (None, "RGGB"):
        return ()
    return (f"{fmt.name}: analysers taken as 90,45,135,0 under {fmt.bayer}; a mirrored frame needs its layout said",)


def read_pgm(path: Path) -> Iterator[Page]:
    """The one picture of a binary PGM: ``[H, W]`` uint8, or uint16 when maxval exceeds 255. Raises ValueError."""
    with path.open("rb") as stream:
        require_signature(stream, (b"P5",), "a binary PGM (P5)")
        head = stream.read(4096)
        match = _PGM_HEADER.match(head)
        if match is None:
            raise ValueError(f"expected a PGM header 'P5 width height maxval', found {describe(head[2:34])}")
        width, height, maxval = (int(number) for number in match.groups())
        require_size((height, width))
        if not 1 <= maxval <= 65535:
            raise ValueError(f"expected a PGM maxval in 1 .. 65535, found {maxval}")
        dtype = np.dtype(np.uint8) if maxval < 256 else np.dtype(">u2")
        expected = width * height * dtype.itemsize
        found = path.stat().st_size - match.end()
        if found != expected:
            raise ValueError(f"expected {expected} bytes for {width}x{height} of maxval {maxval}, found {found}")
        stream.seek(match.end())
        array = np.frombuffer(stream.read(expected), dtype).reshape(height, width)
    white = None if maxval in (255, 65535) else float(maxval)
    yield Page(array.astype(dtype.newbyteorder("=")), white_level=white)
