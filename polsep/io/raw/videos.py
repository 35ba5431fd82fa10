"""Video files by PyAV (extra ``video``): lossless grey ones in, lossless and watchable ones out.

A mosaic survives in a video only as grey samples without loss: FFV1, HuffYUV, raw video, PNG frames and the like, in 8
to 16 bits. Colour or compressed for the eye, it would be another measurement; such files are refused.

Films are written in parts, each a whole file that begins with a key frame, and joined without decoding. So a film that
was made with interruptions has the bytes of one that was not: containers are written without dates and random numbers.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from itertools import count as count_from
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.pages import Page, require_size
from polsep.io.store.errors import InputError, decoding

#: Containers by suffix.
_FORMATS = {".mp4": "mp4", ".mkv": "matroska"}
#: No dates and random numbers in them.
_EXACTLY = {"fflags": "+bitexact"}
#: Pixel formats that hold a mosaic: gray, gray10le, ...
_GREY = re.compile(r"gray(\d*)(?:le|be)?")


@dataclass(frozen=True)
class FilmKind:
    """How a film is kept: ``codec``, ``pixels`` and ``options`` as FFmpeg names them; ``given``: callers' pixels."""

    suffix: str
    codec: str
    pixels: str
    given: str
    options: tuple[tuple[str, str], ...]


_EXACT = (("level", "3"), ("slicecrc", "1"), ("slices", "4"), ("g", "1"))
#: To watch: H.264 that every player knows, of ``uint8 [H, W, 3]`` with even sides.
WATCHABLE = FilmKind(".mp4", "libx264", "yuv420p", "rgb24", (("preset", "superfast"), ("crf", "18")))
#: To measure: every bit as given, with a checksum in each slice; ``uint16 [H, W, 3]``, and ``[H, W, 1]``.
LOSSLESS = FilmKind(".mkv", "ffv1", "gbrp16le", "gbrp16le", _EXACT)
LOSSLESS_GREY = FilmKind(".mkv", "ffv1", "gray16le", "gray16le", _EXACT)


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


class Film:
    """A film that is being written: frames in, a whole file after `close`. Raises ValueError without PyAV.

    State: the encoder. ``rate`` in frames per second.
    """

    def __init__(self, target: Path | BinaryIO, kind: FilmKind, size: tuple[int, int], rate: float) -> None:
        av = load_library()
        self._kind, self._count = kind, 0
        file = str(target) if isinstance(target, Path) else target
        self._container: Any = av.open(file, "w", format=_FORMATS[kind.suffix], options=_EXACTLY)
        fraction = Fraction(rate).limit_denominator(1001)
        self._stream: Any = self._container.add_stream(kind.codec, rate=fraction, options=dict(kind.options))
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = kind.pixels
        self._stream.codec_context.thread_count = 1  # threads belong to the separation
        self._stream.codec_context.flags |= av.codec.context.Flags.bitexact
        self._rate = fraction

    def write(self, image: NDArray[Any]) -> None:
        """One more frame, in the pixels that the kind is given."""
        import av

        image = image[..., 0] if image.shape[-1] == 1 else image
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=self._kind.given)
        if self._kind.given != self._kind.pixels:
            frame = frame.reformat(format=self._kind.pixels)
        frame.pts, frame.time_base = self._count, 1 / self._rate
        self._count += 1
        for packet in self._stream.encode(frame):
            self._container.mux(packet)

    def close(self) -> None:
        """Write what is left."""
        if self._count:
            for packet in self._stream.encode():
                self._container.mux(packet)
        self._container.close()


def encode_film(images: Iterable[NDArray[Any]], kind: FilmKind, rate: float) -> bytes:
    """A short film of images of one shape as a file's bytes. Raises ValueError without images or PyAV."""
    target, film = BytesIO(), None
    for image in images:
        film = film or Film(target, kind, image.shape[:2], rate)
        film.write(image)
    if film is None:
        raise ValueError("expected a film of one image or more, found none")
    film.close()
    return target.getvalue()


def join_films(parts: Sequence[Path], path: Path, kind: FilmKind, rate: float) -> None:
    """One film of several of one ``kind`` and ``rate``, in their order, by copying what is encoded."""
    av = load_library()
    stream, shown = None, 0
    with closing(av.open(str(path), "w", format=_FORMATS[kind.suffix], options=_EXACTLY)) as output:
        for part in parts:
            with av.open(str(part)) as source:
                given = source.streams.video[0]
                stream = stream or output.add_stream_from_template(given)
                packets = [packet for packet in source.demux(given) if packet.size]
                for packet in packets:
                    # Every part counts its frames from 0.
                    later = round(shown / (Fraction(rate).limit_denominator(1001) * packet.time_base))
                    packet.pts, packet.dts, packet.stream = packet.pts + later, packet.dts + later, stream
                    output.mux(packet)
                shown += len(packets)


def as_codes(image: NDArray[np.float32], white: float) -> NDArray[np.uint16]:
    """Linear light as 16-bit codes, 65535 = ``white``, limited."""
    scaled: NDArray[np.float32] = image * np.float32(65535 / white)
    return np.rint(np.clip(scaled, 0, 65535, out=scaled), out=scaled).astype(np.uint16)


def even_side(length: float) -> int:
    """The next even number of pixels, at least 2."""
    return max(2, 2 * math.ceil(length / 2))
