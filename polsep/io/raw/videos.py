"""Lossless grey video files by PyAV (extra ``video``).

A mosaic survives in a video only as grey samples without loss: FFV1, HuffYUV, raw video, PNG frames and the like, in 8
to 16 bits. Colour or compressed for the eye, it would be another measurement; such files are refused.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import count as count_from
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from polsep.io.raw.page import Page
from polsep.io.store.errors import InputError, decoding
from polsep.io.store.header_checks import require_size

#: Pixel formats that hold a mosaic: gray, gray10le, ...
_GREY = re.compile(r"gray(\d*)(?:le|be)?")


def load_library() -> Any:
    """PyAV. Raises ValueError where it is not installed."""
    try:
        import av
    except ModuleNotFoundError:
        raise InputError("expected the extra 'video' (pip install 'polsep[video]'), found no PyAV") from None
    return av


def read_video(path: Path, first: int = 0) -> Iterator[Page]:
    """The frames of a lossless grey video from ``first`` on: uint8 or uint16 ``[H, W]``. Raises ValueError."""
    path.open("rb").close()  # files that are not there are said so, not as damage
    av = load_library()
    with decoding("video"):
        container = av.open(str(path))
    with container:
        stream = _grey_stream(container)
        bits, count = _bits(stream.codec_context.pix_fmt), _count(container, stream)
        stream.thread_type = "SLICE"  # so that each packet gives its own frame
        index, whole = None, False
        for number, packet in _needed(container.demux(stream), first):
            index = number if index is None else index
            frames, damage = _decode(av, packet)
            whole = damage is None and (whole or packet.is_keyframe or not packet.size)
            if frames or damage:
                if index >= first and not whole:
                    raise ValueError(f"expected frame {index} intact, found {damage or 'one before it damaged'}")
                if index >= first:
                    yield _page(frames[0], bits, (index, max(count, index + 1)))
                index += 1


def _decode(av: Any, packet: Any) -> tuple[list[Any], str | None]:
    """The frames of a packet, and what is wrong with them: FFmpeg often only says so in its log."""
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


def _needed(packets: Iterator[Any], first: int) -> Iterator[tuple[int, Any]]:
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


def _grey_stream(container: Any) -> Any:
    """The one video stream, lossless and grey; checksums are looked at. Raises ValueError on any other."""
    streams = container.streams.video
    if len(streams) != 1:
        raise InputError(f"expected one video stream, found {len(streams)}")
    stream = streams[0]
    context = stream.codec_context
    if context.pix_fmt is None or _GREY.fullmatch(context.pix_fmt) is None:
        raise InputError(f"expected a mosaic as grey samples, found pixels {context.pix_fmt} of {context.name}")
    if context.codec.lossy or not context.codec.lossless:
        raise InputError(f"expected a lossless codec such as FFV1, found {context.name}")
    require_size((context.height, context.width))
    context.options = {"err_detect": "crccheck+explode"}
    return stream


def _bits(pixels: str) -> int:
    """8 for gray, 12 for gray12le."""
    match = _GREY.fullmatch(pixels)
    assert match is not None
    return int(match[1] or 8)


def _count(container: Any, stream: Any) -> int:
    """How many frames there are, about: containers tell, or their duration does; at least 2."""
    duration = (container.duration or 0) / 1_000_000
    return max(int(stream.frames), round(duration * float(stream.average_rate or 0)), 2)


def _page(frame: Any, bits: int, place: tuple[int, int]) -> Page:
    """A decoded frame as samples; 10 and 12 bits have their white level, 8 and 16 that of the dtype."""
    with decoding("video"):
        array: NDArray[Any] = frame.to_ndarray()
    return Page(array, *place, white_level=float(2**bits - 1) if bits not in (8, 16) else None)
