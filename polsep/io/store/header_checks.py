"""Checks of a file's first bytes, sizes and counts, made before it is decoded.

What headers promise above a limit is refused before any memory is allocated for it. `LIMITS` are for sensors and scans
that exist; whoever has larger files sets the environment variable that the message names.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import BinaryIO

from polsep.io.store.errors import InputError

SAMPLES, PAGES = "POLSEP_MAX_SAMPLES", "POLSEP_MAX_PAGES"
#: Most samples in a frame (twenty-five 5-megapixel sensors, or 512 MiB as float32), and most pictures in a file (more
#: than half an hour at 60 per second), by the environment variable that sets another limit.
LIMITS = {SAMPLES: 2**27, PAGES: 2**17}

_most_samples: ContextVar[int | None] = ContextVar("most_samples", default=None)

_SIGNATURES = (
    (b"\x89PNG\r\n\x1a\n", "a PNG file"),
    (b"II*\0", "a TIFF file"),
    (b"MM\0*", "a TIFF file"),
    (b"II+\0", "a BigTIFF file"),
    (b"MM\0+", "a BigTIFF file"),
    (b"\x93NUMPY", "an NPY file"),
    (b"PK\x03\x04", "a ZIP or NPZ file"),
    (b"\xff\xd8\xff", "a JPEG file"),
    (b"\x76\x2f\x31\x01", "an OpenEXR file"),
    (b"GIF8", "a GIF file"),
    (b"BM", "a BMP file"),
    (b"P5", "a binary PGM file"),
    (b"version https://git-lfs", "a Git LFS pointer instead of the file"),
)


def describe(head: bytes) -> str:
    """The kind of a file, by its first bytes."""
    if not head:
        return "an empty file"
    for signature, name in _SIGNATURES:
        if head.startswith(signature):
            return name
    if all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in head):
        return "text"
    return f"unknown bytes {head[:8].hex(' ')}"


def require_signature(stream: BinaryIO, signatures: tuple[bytes, ...], name: str) -> None:
    """Raise InputError unless the stream starts with one of ``signatures``; rewinds it."""
    head = stream.read(64)
    stream.seek(0)
    if not head.startswith(signatures):
        raise InputError(f"expected {name} file, found {describe(head)}")


def limit(name: str) -> int:
    """The limit of that name of `LIMITS`, or the environment's. Raises InputError where that is no whole number."""
    said = os.environ.get(name, "").strip()
    if said and not (said.isdecimal() and len(said) < 19):
        raise InputError(f"expected a whole number as {name}, found {said!r:.40}")
    most = int(said) if said else LIMITS[name]
    lower = _most_samples.get()
    return most if name != SAMPLES or lower is None else min(most, lower)


def advice(name: str) -> str:
    """The end of a message about a limit: how to set another, unless `at_most` lowers it here."""
    return "" if name == SAMPLES and _most_samples.get() is not None else f" ({name} sets another limit)"


def require_at_most(found: int, name: str, what: str) -> None:
    """Raise InputError for more of ``what`` than the limit of that name."""
    if found > (most := limit(name)):
        raise InputError(f"expected at most {most} {what}, found {found}{advice(name)}")


def require_size(shape: tuple[int, ...]) -> None:
    """Raise InputError for a frame without samples, or with more than the limit or `at_most` allows."""
    size = "x".join(str(n) for n in shape)
    if min(shape, default=0) < 1:
        raise InputError(f"expected an image with at least one pixel, found {size}")
    if math.prod(shape) > (most := limit(SAMPLES)):
        raise InputError(f"expected at most {most} samples in a frame, found {size}{advice(SAMPLES)}")


@contextmanager
def at_most(samples: int) -> Iterator[None]:
    """Lower the largest number of samples in a frame inside the block, as for files that strangers upload."""
    token = _most_samples.set(samples)
    try:
        yield
    finally:
        _most_samples.reset(token)
