"""Damage done to files: random, but the same for the same seed.

`damage` takes the bytes of a file and gives those of a damaged one, by one to three changes of `CHANGES`: bits and
bytes, cuts and insertions, fields of headers and other numbers at extremes, binary or text, parts of another file.
"""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Callable

from evaluation.damage_fields import find_fields

#: Whole numbers at which readers go wrong: around 0 and around the ends of types.
NUMBERS: tuple[int, ...] = (0, 1, 2, 3, 7, 255, 256, 32767, 32768, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1)
NUMBERS += (2**40, 2**63, 2**64 - 1)
#: What stands for a number in damaged text.
WORDS: tuple[str, ...] = ("0", "-1", "1e999", "-1e999", "1e-300", "NaN", "Infinity", "null", "true", '""', "[]", "{}")
WORDS += ("1" * 400, "1e38")
WORDS += ("[" * 3000, '"' + "x" * 2000 + '"', str(2**31), str(2**63), "65536", "1048576", '"\\ud800\\u001b[2J"')
_DIGITS = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
#: Bytes at the beginning of a file in which most headers lie.
HEAD = 256


def damage(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """``data`` after one to three changes; ``other``: a file of the same kind, from which parts are taken."""
    for _ in range(draw.choice((1, 1, 2, 3))):
        data = draw.choice(CHANGES)(data, other, draw)
    return data


def _place(data: bytes, draw: random.Random) -> int:
    """A place in a file, in its first bytes as often as anywhere."""
    return draw.randrange(max(min(len(data), HEAD) if draw.random() < 0.5 else len(data), 1))


def _length(draw: random.Random) -> int:
    return draw.choice((1, 2, 4, 8, 16, 64, 512))


def flip_bits(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """One to eight bits inverted."""
    changed = bytearray(data)
    for _ in range(draw.randint(1, 8) if data else 0):
        changed[_place(data, draw)] ^= 1 << draw.randrange(8)
    return bytes(changed)


def set_bytes(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """A run of bytes at 0, 127, 128 or 255, or random."""
    place, count = _place(data, draw), min(_length(draw), len(data))
    value = draw.choice((0, 127, 128, 255, None))
    run = draw.randbytes(count) if value is None else bytes([value]) * count
    return data[:place] + run + data[place + count :]


def set_number(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """A binary whole number of `NUMBERS`, or the size of the file, over two, four or eight bytes."""
    code, size = draw.choice((("H", 2), ("I", 4), ("I", 4), ("Q", 8)))
    number = draw.choice((*NUMBERS, len(data), len(data) - 1)) % 2 ** (8 * size)
    place = max(_place(data, draw), 0)
    return data[:place] + struct.pack(draw.choice("<>") + code, number) + data[place + size :]


def set_field(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """A field of a header at an extreme, or a little or a power of two away; in a file without fields, a number."""
    fields = find_fields(data)
    if not fields:
        return set_text_number(data, other, draw)
    place, size, order = draw.choice(fields)
    code, most = order + {1: "B", 2: "H", 4: "I", 8: "Q"}[size], 2 ** (8 * size)
    (before,) = struct.unpack_from(code, data, place)
    near = (before + 1, before - 1, 2 * before, before // 2, before << draw.randrange(24), most - 1 - before)
    number = draw.choice((*NUMBERS, *near, *near, len(data), place, draw.randrange(16))) % most
    return data[:place] + struct.pack(code, number) + data[place + size :]


def set_text_number(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """A number in text replaced by one of `WORDS`; in a file without text, a binary one."""
    found = list(_DIGITS.finditer(data[: 1 << 16]))
    if not found:
        return set_number(data, other, draw)
    at = draw.choice(found)
    return data[: at.start()] + draw.choice(WORDS).encode() + data[at.end() :]


def cut(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """The end missing."""
    return data[: _place(data, draw)]


def insert(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """Random bytes, or bytes of the file, inserted."""
    place, count = _place(data, draw), _length(draw)
    start = _place(data, draw)
    return data[:place] + draw.choice((draw.randbytes(count), data[start : start + count])) + data[place:]


def remove(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """Bytes removed."""
    place = _place(data, draw)
    return data[:place] + data[place + _length(draw) :]


def move(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """Bytes written over others of the same file."""
    count = min(_length(draw), len(data))
    start, place = _place(data, draw), _place(data, draw)
    part = data[start : start + count]
    return data[:place] + part + data[place + len(part) :]


def splice(data: bytes, other: bytes, draw: random.Random) -> bytes:
    """The beginning of one file and the end of another."""
    return data[: _place(data, draw)] + other[_place(other, draw) :]


Change = Callable[[bytes, bytes, random.Random], bytes]
CHANGES: tuple[Change, ...] = (flip_bits, set_bytes, set_number, *[set_field] * 3, set_text_number, cut, insert)
CHANGES += (remove, move, splice)
