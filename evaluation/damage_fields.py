"""Places of the numbers by which readers find their way: sizes, counts, offsets and types in headers of whole files.

Damage at random places of a file rarely meets them. A `Field` is a place, a number of bytes and an order of bytes.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import NamedTuple

_TAG = re.compile(rb"[A-Za-z][A-Za-z0-9 ]{3}")


class Field(NamedTuple):
    """A number of a header: ``size`` bytes at ``place``, in the byte ``order`` of `struct`."""

    place: int
    size: int
    order: str


def find_fields(data: bytes) -> list[Field]:
    """The fields of a file, by its first bytes; none of formats whose headers are text."""
    if data[:2] in (b"II", b"MM"):
        found = _tiff_fields(data)
    elif data[:4] == b"\x76\x2f\x31\x01":
        found = _exr_fields(data)
    elif data[:2] == b"PK":
        found = _zip_fields(data)
    elif data[:4] in (b"RIFF", b"\x89PNG", b"\x1a\x45\xdf\xa3", b"nut/") or data[4:8] in (b"ftyp", b"moov", b"wide"):
        found = _tagged_fields(data)
    else:
        found = iter(())
    return [field for field in found if 0 <= field.place <= len(data) - field.size]


def _tiff_fields(data: bytes) -> Iterator[Field]:
    """Offset of the first directory, its number of entries, types, counts and values, and the next directory."""
    order, big = "<" if data[:2] == b"II" else ">", b"\x2b" in data[2:4]
    step, width, number = (20, 8, 8) if big else (12, 4, 2)
    start = 8 if big else 4
    yield Field(start, width, order)
    if len(data) < start + width:
        return
    (place,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, start)
    if place + number > len(data):
        return
    yield Field(place, number, order)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, place)
    for k in range(min(count, 40)):
        entry = place + number + k * step
        yield from (Field(entry, 2, order), Field(entry + 2, 2, order))
        yield from (
            Field(entry + 4, width, order),
            Field(entry + 4 + width, width, order),
            Field(entry + 4 + width, 2, order),
        )
    yield Field(place + number + count * step, width, order)


def _exr_fields(data: bytes) -> Iterator[Field]:
    """Version, sizes and words of attributes, and the first entries of the table of chunks."""
    yield Field(4, 4, "<")
    place = 8
    while place < len(data) and data[place]:
        place = data.find(b"\0", data.find(b"\0", place) + 1) + 1
        if place < 9 or place + 4 > len(data):
            return
        (size,) = struct.unpack_from("<i", data, place)
        yield from (Field(place + 4 * k, 4, "<") for k in range(min(max(size, 0) // 4 + 1, 12)))
        yield Field(place + 4, 1, "<")
        place += 4 + max(size, 0)
    yield from (Field(place + 1 + 8 * k, 8, "<") for k in range(3))
    yield from (Field(place + 1 + 8 * k, 4, "<") for k in range(40))


def _zip_fields(data: bytes) -> Iterator[Field]:
    """Methods, checksums, sizes, lengths and offsets of members, in both of their headers and at the end."""
    for mark, fields in (
        (b"PK\x03\x04", ((8, 2), (14, 4), (18, 4), (22, 4), (26, 2), (28, 2))),
        (b"PK\x01\x02", ((10, 2), (16, 4), (20, 4), (24, 4), (28, 2), (30, 2), (32, 2), (42, 4))),
        (b"PK\x05\x06", ((8, 2), (10, 2), (12, 4), (16, 4))),
    ):
        start = data.find(mark)
        while start >= 0:
            yield from (Field(start + place, size, "<") for place, size in fields)
            start = data.find(mark, start + 1)


def _tagged_fields(data: bytes) -> Iterator[Field]:
    """The words before and behind four letters: sizes of the chunks of PNG, AVI and MOV, and their first values."""
    for match in _TAG.finditer(data[:4096]):
        yield from (Field(match.start() + 4 * k, 4, order) for k in (-1, 1, 2, 3, 8, 9) for order in "<>")
        yield Field(match.start() - 1, 1, "<")
        yield Field(match.end(), 1, "<")
