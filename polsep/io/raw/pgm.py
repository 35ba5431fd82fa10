"""Binary PGM: one gray picture of 8 or 16 bits behind a header of one line.

Note: Pillow reads PGM too, but scales samples to the full range of their type where maxval is another number.
Source: Netpbm, PGM format specification (binary P5; 16-bit samples are big-endian; white is maxval).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polsep.io.raw.page import Page
from polsep.io.store.header_checks import describe, require_signature, require_size

_GAP = rb"(?:\s|#[^\n]*\n)+"
_PGM_HEADER = re.compile(rb"P5" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s")


def read_pgm(path: Path, first: int = 0) -> Iterator[Page]:
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
