"""Films by PyAV (extra ``video``): lossless ones to measure in, and ones to watch.

A film is written in parts, each a complete file that begins with a key frame, and the parts are joined without
decoding. Containers have no dates and no random numbers. So a film of an interrupted and resumed run is byte-identical
to that of an uninterrupted one.

FFmpeg writes through Python's files, which say why they fail, and never again after a failure: asked for a second
header on a full disk, it ends the process.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from io import BufferedWriter, BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.videos import load_library

#: Containers by suffix.
_FORMATS = {".mp4": "mp4", ".mkv": "matroska"}
#: FFmpeg's options for containers without dates and random numbers.
_EXACTLY = {"fflags": "+bitexact"}


@dataclass(frozen=True)
class FilmKind:
    """A kind of film: ``codec``, ``pixels``, ``options`` as FFmpeg names them; ``input_pixels``: those of callers."""

    suffix: str
    codec: str
    pixels: str
    input_pixels: str
    options: tuple[tuple[str, str], ...]


_FFV1 = (("level", "3"), ("slicecrc", "1"), ("slices", "4"), ("g", "1"))
#: To watch: H.264 that every player knows, of ``uint8 [H, W, 3]`` with even sides.
WATCHABLE = FilmKind(".mp4", "libx264", "yuv420p", "rgb24", (("preset", "superfast"), ("crf", "18")))
#: To measure: every bit is kept, with a checksum in each slice; ``uint16 [H, W, 3]``, and ``[H, W, 1]``.
LOSSLESS = FilmKind(".mkv", "ffv1", "gbrp16le", "gbrp16le", _FFV1)
LOSSLESS_GREY = FilmKind(".mkv", "ffv1", "gray16le", "gray16le", _FFV1)


class Film:
    """A film that is being written; its file is complete after `close`. Raises ValueError without PyAV, and OSError.

    State: the encoder, and whether it goes on: not once anything has failed. ``rate`` in frames per second.
    """

    def __init__(self, target: Path | BinaryIO, kind: FilmKind, size: tuple[int, int], rate: float) -> None:
        av = load_library()
        self._kind, self._count, self._open = kind, 0, True
        self._file = target.open("wb") if isinstance(target, Path) else target
        self._container: Any = av.open(self._file, "w", format=_FORMATS[kind.suffix], options=_EXACTLY)
        fraction = Fraction(rate).limit_denominator(1001)
        self._stream: Any = self._container.add_stream(kind.codec, rate=fraction, options=dict(kind.options))
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = kind.pixels
        self._stream.codec_context.thread_count = 1  # threads belong to the separation
        self._stream.codec_context.flags |= av.codec.context.Flags.bitexact
        self._rate = fraction

    def write(self, image: NDArray[Any]) -> None:
        """Append a frame, in the kind's input pixels."""
        import av

        image = image[..., 0] if image.shape[-1] == 1 else image
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=self._kind.input_pixels)
        if self._kind.input_pixels != self._kind.pixels:
            frame = frame.reformat(format=self._kind.pixels)
        frame.pts, frame.time_base = self._count, 1 / self._rate
        self._count += 1
        with self._ending_at_failure():
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Write the frames that the encoder still holds, and end the file; nothing where anything has failed."""
        if self._open:
            with self._ending_at_failure():
                if self._count:
                    self._container.mux(self._stream.encode())
                self._container.close()
                if isinstance(self._file, BufferedWriter):
                    self._file.close()
            self._open = False

    @contextmanager
    def _ending_at_failure(self) -> Iterator[None]:
        """Closes the file where anything is raised inside, as FFmpeg then leaves it alone."""
        try:
            yield
        except BaseException as error:
            self._open = False
            with suppress(OSError):  # of what Python still holds; the first failure is raised
                self._file.close()
            if isinstance(error, OSError) and isinstance(self._file, BufferedWriter):
                raise OSError(error.errno, error.strerror, self._file.name) from error
            raise


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
    """Join films of one ``kind`` and ``rate`` in their order by copying the encoded packets."""
    av = load_library()
    stream, frames = None, 0
    with path.open("wb") as file:  # closed before its container where anything fails: nothing more is written then
        output = av.open(file, "w", format=_FORMATS[kind.suffix], options=_EXACTLY)
        for part in parts:
            with av.open(str(part)) as source:
                template = source.streams.video[0]
                stream = stream or output.add_stream_from_template(template)
                packets = [packet for packet in source.demux(template) if packet.size]
                for packet in packets:
                    # Every part counts its frames from 0.
                    offset = round(frames / (Fraction(rate).limit_denominator(1001) * packet.time_base))
                    packet.pts, packet.dts, packet.stream = packet.pts + offset, packet.dts + offset, stream
                    output.mux(packet)
                frames += len(packets)
        output.close()


def as_codes(image: NDArray[np.float32], white: float) -> NDArray[np.uint16]:
    """Linear light as 16-bit codes: 65535 stands for ``white``; values outside are limited."""
    scaled: NDArray[np.float32] = image * np.float32(65535 / white)
    return np.rint(np.clip(scaled, 0, 65535, out=scaled), out=scaled).astype(np.uint16)
