"""Checks of a file's first bytes and sizes, made before it is decoded.

Sizes in headers above `MAX_SAMPLES` are refused before any memory is allocated for them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import BinaryIO

from polsep.io.store.errors import InputError

#: Largest number of samples in a frame: fifty 5-megapixel sensors, or 1 GiB as float32.
MAX_SAMPLES = 2**28

_most_samples: ContextVar[int] = ContextVar("most_samples", default=MAX_SAMPLES)

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


def require_size(shape: tuple[int, ...]) -> None:
    """Raise InputError for a frame without samples, or with more than `at_most` allows."""
    size = "x".join(str(n) for n in shape)
    if min(shape, default=0) < 1:
        raise InputError(f"expected an image with at least one pixel, found {size}")
    if math.prod(shape) > (most := _most_samples.get()):
        raise InputError(f"expected at most {most} samples in a frame, found {size}")


@contextmanager
def at_most(samples: int) -> Iterator[None]:
    """Lower the largest number of samples in a frame inside the block, as for files that strangers upload."""
    token = _most_samples.set(min(samples, MAX_SAMPLES))
    try:
        yield
    finally:
        _most_samples.reset(token)
