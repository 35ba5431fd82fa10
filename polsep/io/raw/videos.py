"""Lossless grey video files by PyAV (extra ``video``).

A video keeps the samples of a mosaic only as lossless grey: FFV1, HuffYUV, raw video, PNG frames and the like, in 8 to
16 bits. Colour and lossy videos change samples, so they are refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import count as count_from
from itertools import islice, pairwise
from os import SEEK_CUR
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.extensions import LOSSLESS
from polsep.io.raw.page import Page
from polsep.io.raw.rates import frame_rate
from polsep.io.store.errors import InputError, decoding
from polsep.io.store.header_checks import SAMPLES, limit, require_size
from polsep.io.store.quiet import mute

#: FFmpeg's pixel formats that hold a mosaic: gray, gray10le, ...; the number of bits is 8 unless named.
_GREY = re.compile(r"gray(\d*)(?:le|be)?")
#: FFmpeg's name of each container. It would look for any, also for lists that name other files or addresses.
CONTAINERS = dict(zip(LOSSLESS, ("matroska", "avi", "mov", "nut"), strict=True))

#: Marks of the two parts of a Matroska file.
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
#: Bytes of films whose frames are counted as they are opened. First frames whose times are looked at, and the range of
#: the times between them, relative to the median, from which on they are uneven.
SMALL, FIRST, UNEVEN = 2**30, 64, 0.2
#: Frames that a film is taken to have where it does not say how many.
FEWEST = 2

mute("libav")


def is_lossless_film(path: Path) -> bool:
    """True for the name of a film that may be lossless, by its extension; `extensions.is_film` knows all films."""
    return path.suffix.lower() in CONTAINERS


def load_library() -> Any:
    """PyAV. Raises ValueError where it is not installed."""
    try:
        import av
    except ModuleNotFoundError:
        raise InputError("expected the extra 'video' (pip install 'polsep[video]'), found no PyAV") from None
    return av


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, _Grey]]:
    """The container of a film, and its stream. Raises ValueError."""
    path.open("rb").close()  # a missing file is reported as such, not as damage
    av = load_library()
    options = {"max_pixels": str(limit(SAMPLES))}
    with decoding("video"):
        container = av.open(f"file:{path}", format=CONTAINERS[path.suffix.lower()], options=options)
    with container:
        with decoding("video"):
            kind = _grey_stream(container, path.stat().st_size)
        yield container, kind


def read_video(path: Path, first: int = 0) -> Iterator[Page]:
    """The frames of a lossless grey video from ``first`` on: uint8 or uint16 ``[H, W]``. Raises ValueError."""
    av = load_library()
    with _opened(path) as (container, kind):
        kind.stream.thread_type = "SLICE"  # each packet then yields its own frame
        index, intact = None, False
        for number, packet in _packets_from_key_frame(container.demux(kind.stream), first):
            index = number if index is None else index
            frames, damage = _decode(av, packet)
            intact = damage is None and (intact or packet.is_keyframe or not packet.size)
            if frames or damage:
                if index >= first and not intact:
                    raise ValueError(f"expected frame {index} intact, found {damage or 'one before it damaged'}")
                if index >= first:
                    array = _as_array(frames[0], kind, index)
                    yield Page(array, index, max(kind.about, index + 1), white_level=kind.white)
                index += 1


def count_frames(path: Path, about: int, index: int) -> int:
    """The number of frames of a film, where it says ``about`` how many.

    They are counted if the file is small, or if ``index`` is that of its last ones, for which it is read to its end
    anyway. Of a large file that does not say its length, the number is estimated from the bytes of the first ones.
    """
    found = path.stat()
    try:
        if found.st_size > SMALL and index + 1 < about:
            return about if about > FEWEST else _estimate_frames(path)
        return max(_count_packets(path.absolute(), (found.st_mtime_ns, found.st_size)), index + 1)
    except ValueError:  # the frame that is damaged says so
        return about


def _estimate_frames(path: Path) -> int:
    with _opened(path) as (container, kind), decoding("video"):
        sizes: list[int] = [packet.size for packet in islice(container.demux(kind.stream), FIRST) if packet.size]
    return max(path.stat().st_size * len(sizes) // max(sum(sizes), 1), FEWEST)


@lru_cache(maxsize=64)
def _count_packets(path: Path, stamp: tuple[int, int]) -> int:
    with _opened(path) as (container, kind), decoding("video"):
        return sum(packet.size > 0 for packet in container.demux(kind.stream))


def find_timing(path: Path) -> tuple[float | None, tuple[str, ...]]:
    """Frames per second of a film, or None; and a note where its first frames come at uneven times, which are not kept.

    Of the first frames; the rate is that of `frame_rate`, or the stated one of a film whose clock ticks less often.
    """
    try:
        with _opened(path) as (container, kind), decoding("video"):
            packets = islice(container.demux(kind.stream), FIRST)
            times = sorted(packet.pts for packet in packets if packet.size and packet.pts is not None)
            unit, stated = float(kind.stream.time_base or 0), float(kind.stream.average_rate or 0) or None
    except ValueError:  # the frame that is damaged says so
        return None, ()
    steps = sorted(after - before for before, after in pairwise(times))
    if unit and stated and stated * unit > 1:  # Matroska's milliseconds are too long to contradict it
        return stated, ()
    rate = frame_rate(stated, [unit * step for step in steps])
    if not steps or steps[-1] - steps[0] <= max(UNEVEN * steps[len(steps) // 2], 2):
        return rate, ()
    least, most = (1000 * unit * step for step in (steps[0], steps[-1]))
    return rate, (
        f"frames were expected at even times, found them {least:.3g} to {most:.3g} ms apart: the times are not kept, "
        "every frame counts alike",
    )


def cut_notes(path: Path) -> tuple[str, ...]:
    """A note on a Matroska film of fewer bytes than it says, whose frames behind its end FFmpeg leaves out silently.

    Films of other kinds end with a damaged frame.
    """
    with path.open("rb") as stream:
        ends = 0
        for element in (_EBML, _SEGMENT):  # a header, and all else
            if stream.read(4) != element:
                return ()
            first = stream.read(1)
            length = 9 - first[0].bit_length() if first else 9
            size = int.from_bytes(first + stream.read(length - 1)) & ~(1 << 7 * length)
            if length > 8 or size == (1 << 7 * length) - 1:  # unknown while it is recorded
                return ()
            ends = stream.seek(size, SEEK_CUR)
    found = path.stat().st_size
    return (f"the film is cut short: expected {ends} bytes, found {found}, the last frames are missing",) * (
        ends > found
    )


class _Grey(NamedTuple):
    """A stream of grey frames ``[H, W]`` of a dtype, ``about`` so many; ``white``: its own white level, if any."""

    stream: Any
    shape: tuple[int, int]
    dtype: type[np.unsignedinteger[Any]]
    white: float | None
    about: int


def _as_array(frame: Any, kind: _Grey, index: int) -> NDArray[Any]:
    """The samples of a frame, which must be as the stream announced them."""
    with decoding("video"):
        array: NDArray[Any] = frame.to_ndarray()
    if array.shape != kind.shape or array.dtype != kind.dtype:
        expected, found = (f"{np.dtype(t)} {'x'.join(map(str, s))}" for s, t in (kind[1:3], (array.shape, array.dtype)))
        raise ValueError(f"expected frame {index} as {expected}, found {found}")
    return array


def _decode(av: Any, packet: Any) -> tuple[list[Any], str | None]:
    """The frames of a packet, and the damage found in it; FFmpeg often reports damage only in its log."""
    before = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture(local=False) as log:
            frames = list(packet.decode())
    except av.error.FFmpegError as error:
        return [], error.strerror or "damage"
    finally:
        av.logging.set_level(before)
    return frames, log[0][2].strip() if log else None


def _packets_from_key_frame(packets: Iterator[Any], first: int) -> Iterator[tuple[int, Any]]:
    """Packets with their numbers, from the last key frame that is not after ``first`` on."""
    held: list[tuple[int, Any]] = []
    for number in count_from(0):
        with decoding("video"):
            packet = next(packets, None)
        if packet is None:
            return
        if packet.is_keyframe and number <= first:
            held = []
        held.append((number, packet))
        if number >= first or not packet.size:  # an empty packet ends a stream
            yield from held
            held = []


def _grey_stream(container: Any, size: int) -> _Grey:
    """The one video stream of a file of ``size`` bytes, which checks its checksums.

    Raises ValueError unless it is lossless and grey.
    """
    streams = container.streams.video
    if len(streams) != 1:
        raise InputError(f"expected one video stream, found {len(streams)}")
    stream = streams[0]
    context = stream.codec_context
    if context is None:
        raise InputError("expected a lossless codec such as FFV1, found none that is known")
    grey = _GREY.fullmatch(context.pix_fmt or "")
    if grey is None:
        raise InputError(f"expected a mosaic as grey samples, found pixels {context.pix_fmt} of {context.name}")
    if context.codec.lossy or not context.codec.lossless:
        raise InputError(f"expected a lossless codec such as FFV1, found {context.name}")
    shape, bits = (int(context.height), int(context.width)), int(grey[1] or 8)
    require_size(shape)
    context.options = {"err_detect": "crccheck+explode", "max_pixels": str(limit(SAMPLES))}
    # 10 and 12 bits have their own white level, 8 and 16 that of the dtype.
    white = None if bits in (8, 16) else float(2**bits - 1)
    duration = (container.duration or 0) / 1_000_000
    count = max(int(stream.frames), round(duration * float(stream.average_rate or 0)), FEWEST)  # approximate
    return _Grey(stream, shape, np.uint8 if bits == 8 else np.uint16, white, min(count, max(size, 2)))
