"""Lossless grey video files by PyAV (extra ``video``).

A video keeps the samples of a mosaic only as lossless grey: FFV1, HuffYUV, raw video, PNG frames and the like, in 8 to
16 bits. Colour and lossy videos change samples, so they are refused.
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

#: FFmpeg's pixel formats that hold a mosaic: gray, gray10le, ...; the number of bits is 8 unless named.
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
    path.open("rb").close()  # a missing file is reported as such, not as damage
    av = load_library()
    with decoding("video"):
        container = av.open(str(path))
    with container:
        stream, bits = _grey_stream(container)
        # 10 and 12 bits have their own white level, 8 and 16 that of the dtype.
        white = None if bits in (8, 16) else float(2**bits - 1)
        duration = (container.duration or 0) / 1_000_000
        count = max(int(stream.frames), round(duration * float(stream.average_rate or 0)), 2)  # approximate
        stream.thread_type = "SLICE"  # each packet then yields its own frame
        index, intact = None, False
        for number, packet in _packets_from_key_frame(container.demux(stream), first):
            index = number if index is None else index
            frames, damage = _decode(av, packet)
            intact = damage is None and (intact or packet.is_keyframe or not packet.size)
            if frames or damage:
                if index >= first and not intact:
                    raise ValueError(f"expected frame {index} intact, found {damage or 'one before it damaged'}")
                if index >= first:
                    with decoding("video"):
                        array: NDArray[Any] = frames[0].to_ndarray()
                    yield Page(array, index, max(count, index + 1), white_level=white)
                index += 1


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


def _grey_stream(container: Any) -> tuple[Any, int]:
    """The one video stream, which checks its checksums, and its bits per sample.

    Raises ValueError unless it is lossless and grey.
    """
    streams = container.streams.video
    if len(streams) != 1:
        raise InputError(f"expected one video stream, found {len(streams)}")
    stream = streams[0]
    context = stream.codec_context
    grey = _GREY.fullmatch(context.pix_fmt or "")
    if grey is None:
        raise InputError(f"expected a mosaic as grey samples, found pixels {context.pix_fmt} of {context.name}")
    if context.codec.lossy or not context.codec.lossless:
        raise InputError(f"expected a lossless codec such as FFV1, found {context.name}")
    require_size((context.height, context.width))
    context.options = {"err_detect": "crccheck+explode"}
    return stream, int(grey[1] or 8)
