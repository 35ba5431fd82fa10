"""Pixels as files hold them: half floats in rows of OpenEXR, packed as its ZIP compression does, and 16-bit codes.

A row of an EXR file is 8 bytes, which are there where nothing is compressed, and then the half floats of each channel,
one channel behind the other. Low bytes of half floats are mostly noise, high bytes change little from pixel to pixel,
and channels of one colour are equal: that is all there is to find in them. So each half of a chunk becomes one block of
Huffman codes of single bytes, but for rows that repeat the row before; or it stays as it is where codes save next to
nothing. Searching for more, as zlib does, takes five times as long and makes larger files of coloured light.

Source: OpenEXR, "OpenEXR File Layout" (openexr.com/en/latest/OpenEXRFileLayout.html) and internal_zip.c; P. Deutsch,
"DEFLATE Compressed Data Format Specification" (RFC 1951) and "ZLIB Compressed Data Format Specification" (RFC 1950).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ZERO, compiled, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows

#: Words of 16 bits in front of a row.
HEAD = 4
#: Rows of a chunk of OpenEXR's ZIP compression.
CHUNK = 16
#: Rows that a thread fills at a time.
ROWS = 64

#: The largest half float; light above becomes that.
LARGEST = np.float32(65504)
# In bits of float32: infinity, the least number beyond half floats, the least normal half float.
_INFINITY, _BEYOND, _NORMAL = np.int32(255 << 23), np.int32(143 << 23), np.int32(113 << 23)
# From an exponent of float32 to one of half floats, less half a step; bits of 0.5, whose last one is the least half
# float, so that adding 0.5 rounds what is below the normal ones.
_REBIAS, _HALF_BITS = np.int32((112 << 23) - 0xFFF), np.int32(126 << 23)
_HALF_INFINITY, _HALF_NAN = np.int32(0x7C00), np.int32(0x7E00)
_THIRTEEN, _SIXTEEN, _ODD = np.int32(13), np.int32(16), np.int32(1)
_SIZE, _SIGN = np.int32(0x7FFFFFFF), np.int32(0x8000)
#: The largest code.
_WHITE = np.float32(65535)

#: Codes: bytes, the end of a block, lengths of repetitions; the longest code; bytes of the longest repetition.
_CODES, _END, _LONGEST_CODE, _LONGEST = 286, 256, 15, 258
#: Farthest that a repetition may be from what it repeats, the shortest row that may repeat, bytes of a stored block.
_FARTHEST, _SHORTEST, STORED = 32768, 8, 65535
#: Bits of the codes of lengths, in the order in which they are sent: repetitions have none, 0 to 15 have 4 each.
_SENT = np.array([0, 0, 0] + 16 * [4], np.int64)
#: Codes save next to nothing where a block of them is not smaller than this part of its bytes; bits of a block's head.
_WORTH, _HEAD_BITS = 0.98, 2000
# Bytes that may be added up in 32 bits; the modulus of Adler's sum.
_SUMMED, _ADLER = 2048, 65521


def code_planes(image: NDArray[np.float32], white: float) -> NDArray[np.uint16]:
    """Linear light ``[H, W, C]`` as 16-bit codes ``[C, H, W]``: 65535 stands for ``white``; values outside are limited.

    Colours are in the order green, blue, red, in which films have them.
    """
    height, width, colors = image.shape
    light = read_only(np.ascontiguousarray(image, np.float32).reshape(height, -1))
    planes = np.empty((colors * height, width), np.uint16)
    run_over_rows(partial(fill_planes, light, np.float32(65535 / white), planes), height, ROWS)
    return planes.reshape(colors, height, width)


@compiled
def _split_colors(line: Any, colors: Any) -> None:
    """A line of pixels to ``colors [C, W]``; three of them at once, so that LLVM vectorises it."""
    n, width = colors.shape
    if n == 3:
        a, b, c = colors[0], colors[1], colors[2]
        for x in range(width):
            a[x] = line[3 * x]
            b[x] = line[3 * x + 1]
            c[x] = line[3 * x + 2]
        return
    for k in range(n):
        color, own = colors[k], line[k:]
        for x in range(width):
            color[x] = own[n * x]


@compiled
def _halve(values: Any, limited: Any, raised: Any, halves: Any) -> None:
    """Bits of half floats; ``limited`` and ``raised``: room. Numba would widen sums of int32 that no cast narrows."""
    for x in range(values.size):
        limited[x] = LARGEST if values[x] > LARGEST else values[x]
        raised[x] = abs(limited[x]) + HALF
    bits, tiny = limited.view(np.int32), raised.view(np.int32)
    for x in range(halves.size):
        size = np.int32(bits[x] & _SIZE)
        odd = np.int32(np.int32(size >> _THIRTEEN) & _ODD)
        normal = np.int32(np.int32(np.int32(size - _REBIAS) + odd) >> _THIRTEEN)
        found = np.int32(tiny[x] - _HALF_BITS) if size < _NORMAL else normal
        beyond = _HALF_NAN if size > _INFINITY else _HALF_INFINITY
        found = found if size < _BEYOND else beyond
        halves[x] = np.uint16(found | np.int32(np.int32(bits[x] >> _SIXTEEN) & _SIGN))


@entry
def fill_rows(light: Any, colors: int, place: int, rows: Any, row_range: RowRange) -> None:
    """Half floats of ``light [H, W C]`` to the channels of ``rows`` from ``place`` on, the last channel first."""
    width = light.shape[1] // colors
    values = np.empty((colors, width), np.float32)
    limited, raised = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(row_range[0], row_range[1]):
        _split_colors(light[y], values)
        for k in range(colors):
            first = place + width * k
            _halve(values[colors - 1 - k], limited, raised, rows[y, first : first + width])


@entry
def fill_planes(light: Any, scale: Any, planes: Any, row_range: RowRange) -> None:
    """Codes of ``light [H, W C]``, times ``scale``, to ``planes [C H, W]``."""
    height, width = light.shape[0], planes.shape[1]
    colors = planes.shape[0] // height
    values = np.empty((colors, width), np.float32)
    for y in range(row_range[0], row_range[1]):
        _split_colors(light[y], values)
        for k in range(colors):
            own, codes = values[k], planes[(k + 2) % colors * height + y]
            for x in range(width):
                value = own[x] * scale
                value = (value if value < _WHITE else _WHITE) if value > ZERO else ZERO
                codes[x] = np.uint16(np.int32(np.rint(value)))


@compiled
def _predict(rows: Any, halves: Any) -> None:
    """Differences between bytes next to each other, first of all low bytes of ``rows``, then of the high ones."""
    n = rows.shape[1] - HEAD
    half = halves.size // 2
    low, high = halves[:half], halves[half:]
    for y in range(rows.shape[0]):
        words, first = rows[y, HEAD:], n * y
        before = words[0] if y == 0 else rows[y - 1, HEAD + n - 1]
        low[first] = np.uint8(words[0] - before + 128)
        high[first] = np.uint8((words[0] >> 8) - (before >> 8) + 128)
        a, b = low[first:], high[first:]
        for x in range(1, n):
            a[x] = np.uint8((words[x] & 255) - (words[x - 1] & 255) + 128)
            b[x] = np.uint8((words[x] >> 8) - (words[x - 1] >> 8) + 128)
    last = rows[rows.shape[0] - 1, HEAD + n - 1]
    low[0] = np.uint8(rows[0, HEAD])
    high[0] = np.uint8((rows[0, HEAD] >> 8) - (last & 255) + 128)


@compiled
def _checksum(data: Any) -> Any:
    """Adler's sum."""
    total: Any = 1
    weighted: Any = 0
    for first in range(0, data.size, _SUMMED):
        part = data[first : first + _SUMMED]
        n = part.size
        plain, ranked = np.uint32(0), np.uint32(0)
        for j in range(n):
            plain = np.uint32(plain + np.uint32(part[j]))
            ranked = np.uint32(ranked + np.uint32(part[j]) * np.uint32(n - j))
        weighted = (weighted + n * total + np.int64(ranked)) % _ADLER
        total = (total + np.int64(plain)) % _ADLER
    return np.uint64(weighted << 16 | total)


@compiled
def _put(bits: Any, count: Any, words: Any, state: Any) -> None:
    """Append up to 32 bits to a stream; ``state``: bits that are not in ``words`` yet, their number, that of words."""
    state[0] |= np.uint64(bits) << state[1]
    state[1] += np.uint64(count)
    if state[1] >= np.uint64(32):
        words[state[2]] = np.uint32(state[0])
        state[0] >>= np.uint64(32)
        state[1] -= np.uint64(32)
        state[2] += np.uint64(1)


@compiled
def _align(words: Any, state: Any) -> None:
    """End a byte."""
    _put(0, (8 - np.int64(state[1]) % 8) % 8, words, state)


@compiled
def _find_repeats(data: Any, width: int, repeats: Any) -> None:
    """Mark lines of bytes, all but the first one of which the line before has too."""
    for line in range(repeats.size):
        repeats[line] = False
        if line == 0 or width < _SHORTEST or width > _FARTHEST:
            continue
        own, before = data[width * line + 1 : width * (line + 1)], data[width * (line - 1) + 1 : width * line]
        x, n = 0, own.size
        while x < n and own[x] == before[x]:
            x += 1
        repeats[line] = x == n


@compiled
def _next_length(left: int) -> int:
    """Length of the next repetition of ``left`` bytes: none of fewer than 3 may remain."""
    if left <= _LONGEST:
        return left
    return _LONGEST if left - _LONGEST >= 3 else _LONGEST - 3


@compiled
def _split(value: int, kept: int) -> tuple[int, int]:
    """Class of a length or distance, of 2^``kept`` classes per octave, and the number of its extra bits."""
    extra = 0
    while value >> extra >= 2 << kept:
        extra += 1
    return (extra << kept) + (value >> extra), extra


@compiled
def _length_code(length: int) -> tuple[int, int]:
    """Code of a length of 3 to 258, and the number of its extra bits."""
    if length == _LONGEST:
        return _CODES - 1, 0
    found, extra = _split(length - 3, 2)
    return _END + 1 + found, extra


@compiled
def _count(data: Any, width: int, repeats: Any, counts: Any) -> None:
    """Count how often each code is needed: of bytes, of the end, and of lengths."""
    room = np.zeros((4, 256), np.int32)
    a, b, c, d = room[0], room[1], room[2], room[3]
    for x in range(counts.size):
        counts[x] = 0
    counts[_END] = 1
    for line in range(repeats.size):
        own = data[width * line : width * (line + 1)]
        n = 1 if repeats[line] else own.size
        for x in range(0, n - 3, 4):
            a[own[x]] += 1
            b[own[x + 1]] += 1
            c[own[x + 2]] += 1
            d[own[x + 3]] += 1
        for x in range(n - n % 4, n):
            a[own[x]] += 1
        left = own.size - n
        while left > 0:
            length = _next_length(left)
            code, _ = _length_code(length)
            counts[code] += 1
            left -= length
    for x in range(256):
        counts[x] += a[x] + b[x] + c[x] + d[x]


@compiled
def _sort_codes(counts: Any, order: Any) -> int:
    """The codes that are needed, rarest first, to ``order``; their number is returned."""
    used = 0
    for code in range(counts.size):
        if counts[code] > 0:
            x = used
            while x > 0 and counts[order[x - 1]] > counts[code]:
                order[x] = order[x - 1]
                x -= 1
            order[x] = code
            used += 1
    return used


@compiled
def _measure(counts: Any, order: Any, lengths: Any) -> Any:
    """Lengths of Huffman's codes; the longest one's is returned. ``order``: room for the codes."""
    for code in range(counts.size):
        lengths[code] = 0
    used = _sort_codes(counts, order)
    if used == 1:
        lengths[order[0]] = 1
        return 1
    # Nodes: codes by their counts, then pairs as they are made; both in ascending order.
    weight, parent = np.zeros(2 * used, np.int64), np.zeros(2 * used, np.int64)
    for x in range(used):
        weight[x] = counts[order[x]]
    leaf, pair = 0, used
    for node in range(used, 2 * used - 1):
        for _ in range(2):
            if leaf < used and (pair >= node or weight[leaf] <= weight[pair]):
                taken, leaf = leaf, leaf + 1
            else:
                taken, pair = pair, pair + 1
            weight[node] += weight[taken]
            parent[taken] = node
    depth = weight
    depth[2 * used - 2] = 0
    for x in range(2 * used - 3, -1, -1):
        depth[x] = depth[parent[x]] + 1
    for x in range(used):
        lengths[order[x]] = depth[x]
    return depth[0]


@compiled
def _assign(lengths: Any, codes: Any) -> None:
    """Codes of given lengths, as they are written, times 16 plus their length."""
    code = 0
    for length in range(1, _LONGEST_CODE + 1):
        code <<= 1
        for x in range(lengths.size):
            if lengths[x] == length:
                turned = 0
                for k in range(length):
                    turned |= (code >> k & 1) << (length - 1 - k)
                codes[x] = np.uint64(turned << 4 | length)
                code += 1


@compiled
def _describe(lengths: Any, distance: int, words: Any, state: Any) -> None:
    """The head of a block: lengths of all codes; ``distance``: the one code of distances, or -1."""
    _put(2, 2, words, state)
    _put(_CODES - 257, 5, words, state)
    _put(max(distance, 0), 5, words, state)
    _put(15, 4, words, state)
    for x in range(_SENT.size):
        _put(_SENT[x], 3, words, state)
    for x in range(_CODES + max(distance, 0) + 1):
        length = lengths[x] if x < _CODES else 1 if x - _CODES == distance else 0
        turned = (length & 1) << 3 | (length & 2) << 1 | (length & 4) >> 1 | length >> 3
        _put(turned, 4, words, state)


@compiled
def _write_bytes(data: Any, codes: Any, words: Any, state: Any) -> None:
    """Codes of bytes."""
    waiting, held, at = state[0], state[1], state[2]
    four, mask, full = np.uint64(4), np.uint64(15), np.uint64(32)
    even = data.size - data.size % 2
    for x in range(0, even, 2):
        one, two = codes[data[x]], codes[data[x + 1]]
        waiting |= (one >> four) << held
        held += one & mask
        waiting |= (two >> four) << held
        held += two & mask
        if held >= full:
            words[at] = np.uint32(waiting)
            waiting >>= full
            held -= full
            at += np.uint64(1)
    state[0], state[1], state[2] = waiting, held, at
    for x in range(even, data.size):
        _put(codes[data[x]] >> four, codes[data[x]] & mask, words, state)


@compiled
def _write_codes(data: Any, width: int, repeats: Any, codes: Any, words: Any, state: Any) -> None:
    """The codes of a block, without its head."""
    _, extra = _split(width - 1, 1)
    for line in range(repeats.size):
        own = data[width * line : width * (line + 1)]
        n = 1 if repeats[line] else own.size
        _write_bytes(own[:n], codes, words, state)
        left = own.size - n
        while left > 0:
            length = _next_length(left)
            code, more = _length_code(length)
            _put(codes[code] >> np.uint64(4), codes[code] & np.uint64(15), words, state)
            _put((length - 3) & ((1 << more) - 1), more, words, state)
            _put(0, 1, words, state)
            _put((width - 1) & ((1 << extra) - 1), extra, words, state)
            left -= length
    _put(codes[_END] >> np.uint64(4), codes[_END] & np.uint64(15), words, state)


@compiled
def _write_stored(data: Any, last: int, words: Any, state: Any) -> None:
    """Bytes as they are."""
    for first in range(0, data.size, STORED):
        part = data[first : first + STORED]
        n = part.size
        _put(last if first + n == data.size else 0, 1, words, state)
        _put(0, 2, words, state)
        _align(words, state)
        _put(n, 16, words, state)
        _put(~n & 65535, 16, words, state)
        for x in range(0, n - n % 4, 4):
            one, two = np.uint64(part[x]), np.uint64(part[x + 1])
            three, four = np.uint64(part[x + 2]), np.uint64(part[x + 3])
            _put(one | two << np.uint64(8) | three << np.uint64(16) | four << np.uint64(24), 32, words, state)
        for x in range(n - n % 4, n):
            _put(part[x], 8, words, state)


@compiled
def _write_block(data: Any, width: int, last: int, words: Any, state: Any) -> None:
    """A half of a chunk, in lines of ``width`` bytes."""
    repeats = np.empty(data.size // width, np.bool_)
    counts, tamed = np.empty(_CODES, np.int64), np.empty(_CODES, np.int64)
    order, lengths, codes = np.empty(_CODES, np.int64), np.empty(_CODES, np.int64), np.zeros(_CODES, np.uint64)
    _find_repeats(data, width, repeats)
    _count(data, width, repeats, counts)
    again = False
    for line in range(repeats.size):
        again |= repeats[line]
    for x in range(_CODES):
        tamed[x] = counts[x]
    while _measure(tamed, order, lengths) > _LONGEST_CODE:
        for x in range(_CODES):
            tamed[x] = (tamed[x] + 1) // 2
    size = 0
    for x in range(_CODES):
        size += counts[x] * lengths[x]
    if size > _WORTH * 8 * data.size - _HEAD_BITS:
        _write_stored(data, last, words, state)
        return
    _assign(lengths, codes)
    distance, _ = _split(width - 1, 1)
    _put(last, 1, words, state)
    _describe(lengths, distance if again else -1, words, state)
    _write_codes(data, width, repeats, codes, words, state)


@entry
def pack_chunks(rows: Any, width: int, packed: Any, sizes: Any, chunk_range: RowRange) -> None:
    """Chunks of rows as zlib's streams in words of 32 bits; ``sizes``: of the streams in bytes."""
    state = np.zeros(3, np.uint64)
    for chunk in range(chunk_range[0], chunk_range[1]):
        part, words = rows[CHUNK * chunk : CHUNK * (chunk + 1)], packed[chunk]
        data = np.empty(2 * part.shape[0] * (part.shape[1] - HEAD), np.uint8)
        half = data.size // 2
        _predict(part, data)
        for x in range(state.size):
            state[x] = np.uint64(0)
        _put(0x0178, 16, words, state)
        _write_block(data[:half], width, 0, words, state)
        _write_block(data[half:], width, 1, words, state)
        _align(words, state)
        total = _checksum(data)
        for k in range(4):
            _put(total >> np.uint64(24 - 8 * k) & np.uint64(255), 8, words, state)
        sizes[chunk] = 4 * np.int64(state[2]) + np.int64(state[1]) // 8
        words[state[2]] = np.uint32(state[0])
