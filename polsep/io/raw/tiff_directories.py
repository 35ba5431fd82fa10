"""Directories of a TIFF file, walked and measured before tifffile reads them.

tifffile follows loops of directories, believes counts of values and looks for pictures in the formats of many vendors.
Here a directory is a place in the file and what its entries claim, nothing more.
Source: Adobe, TIFF Revision 6.0, section 2; Aware Systems, "The BigTIFF File Format".
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import BinaryIO, Literal, NamedTuple

from polsep.io.store.errors import InputError
from polsep.io.store.header_checks import PAGES, require_at_most

#: Most entries in a directory; those of cameras and microscopes have up to two hundred.
MOST_TAGS = 1024
#: Most numbers in an entry: strips or tiles of the largest pictures. Bytes and text are limited by the file alone.
MOST_NUMBERS = 2**18
#: Bytes per value of the types of entries; unknown types are left out by tifffile.
_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_TEXT = (1, 2, 6, 7)
#: Entries that lead to other directories: EXIF, GPS, interoperability. Entries of MetaMorph's stacks.
_INNER, _STACKS = (34665, 34853, 40965), (33628, 33629, 33630, 33631)
#: The entry NewSubfileType, and its bits of reduced pictures and masks.
_SUBFILE, _PARTS = 254, 0b101


class _Form(NamedTuple):
    """Structures of a TIFF: number of entries, an entry without its value, and an offset (also a value's room)."""

    number: struct.Struct
    entry: struct.Struct
    offset: struct.Struct

    @property
    def step(self) -> int:
        """Bytes from an entry to the next."""
        return self.entry.size + self.offset.size


def walk_directories(stream: BinaryIO, size: int) -> list[int]:
    """The place of every directory of a file of ``size`` bytes in order.

    Raises InputError where the chain breaks, or loops, or has more pictures than allowed.
    """
    form, offset = _read_form(stream)
    places: dict[int, None] = {}
    while offset:
        found = f"found {len(places)} of them"
        if offset in places:
            raise InputError(f"expected a chain of TIFF directories with an end, {found} and a way back: it is damaged")
        stream.seek(min(offset, size))
        head = stream.read(form.number.size)
        tags = form.number.unpack(head)[0] if len(head) == form.number.size else 0
        end = offset + form.number.size + tags * form.step
        if end + form.offset.size > size or len(head) < form.number.size:
            missing = "no readable one" if not places else f"{len(places)} of them"
            raise InputError(f"expected a complete chain of TIFF directories, found {missing}: it is truncated")
        if tags > MOST_TAGS:
            raise InputError(f"expected at most {MOST_TAGS} entries in a TIFF directory, found {tags}")
        places[offset] = None
        require_at_most(len(places), PAGES, "pictures in a TIFF")
        stream.seek(end)
        (offset,) = form.offset.unpack(stream.read(form.offset.size))
    if not places:
        raise InputError("expected a TIFF with a picture, found no readable directory: it is truncated or damaged")
    return list(places)


def find_pictures(stream: BinaryIO, places: Sequence[int]) -> list[int]:
    """The numbers of the directories at ``places`` that are no thumbnail and no mask of another; all, if none is left.

    NewSubfileType says so, the first entry of a directory that has it.
    """
    form, _ = _read_form(stream)
    order: Literal["little", "big"] = "little" if form.entry.format.startswith("<") else "big"
    kept = []
    for number, place in enumerate(places):
        stream.seek(place + form.number.size)
        first = stream.read(form.step).ljust(form.step, b"\0")  # a directory may be empty
        code, kind, _ = form.entry.unpack_from(first)
        value = first[form.entry.size :][: _BYTES.get(kind, 0)]
        if code != _SUBFILE or not int.from_bytes(value, order) & _PARTS:
            kept.append(number)
    return kept or list(range(len(places)))


def check_entries(stream: BinaryIO, place: int, size: int) -> None:
    """Raise InputError where entries of the directory at ``place`` claim more than a file of ``size`` bytes holds.

    So do those of its EXIF and GPS directories, which tifffile reads with it.
    """
    form, _ = _read_form(stream)
    for code, start in _check_entries(stream, form, place, size):
        if code in _INNER:
            for _ in _check_entries(stream, form, start, size):
                pass


def _check_entries(stream: BinaryIO, form: _Form, place: int, size: int) -> list[tuple[int, int]]:
    """The code and the offset of every entry of one directory, once they are checked."""
    stream.seek(min(place, size))
    head = stream.read(form.number.size)
    tags = form.number.unpack(head)[0] if len(head) == form.number.size else 0
    if tags > MOST_TAGS:
        raise InputError(f"expected at most {MOST_TAGS} entries in a TIFF directory, found {tags}")
    data, total = stream.read(tags * form.step), 0
    if len(data) < tags * form.step:
        raise InputError(f"expected {tags} entries of a TIFF directory, found the end of the file: it is truncated")
    found = []
    for k in range(tags):
        code, kind, count = form.entry.unpack_from(data, k * form.step)
        needed = count * _BYTES.get(kind, 0)
        (start,) = form.offset.unpack_from(data, k * form.step + form.entry.size)
        if needed > form.offset.size and start + needed > size:
            raise InputError(f"expected TIFF entry {code} within {size} bytes, found its end at {start + needed}")
        if kind not in _TEXT and count > MOST_NUMBERS:
            raise InputError(f"expected at most {MOST_NUMBERS} numbers in TIFF entry {code}, found {count}")
        if code in _STACKS:
            raise InputError("expected one TIFF directory per picture, found a stack of MetaMorph")
        total += needed
        found.append((code, start))
    if total > 2 * size + tags * form.offset.size:
        raise InputError(f"expected TIFF entries that share no bytes, found {total} bytes of them in {size}")
    return found


def _read_form(stream: BinaryIO) -> tuple[_Form, int]:
    """The structures of a file, and the place of its first directory."""
    stream.seek(0)
    head = stream.read(16)
    order = "<" if head[:2] == b"II" else ">"
    big = head[2:4] in (b"+\0", b"\0+")
    form = _Form(*(struct.Struct(order + text) for text in (("Q", "HHQ", "Q") if big else ("H", "HHI", "I"))))
    start = 8 if big else 4
    if len(head) < start + form.offset.size:
        raise InputError(f"expected an intact TIFF file, found damage: a header of {len(head)} bytes")
    return form, int(form.offset.unpack_from(head, start)[0])
