"""Films by PyAV (extra ``video``): lossless ones to measure in, and ones to watch.

A film is written in parts, each a complete file that begins with a key frame, and the parts are joined without
decoding. Containers have no dates and no random numbers. So a film of an interrupted and resumed run is byte-identical
to that of an uninterrupted one.

FFmpeg ends the process where it is asked to go on after a header that did not fit on a full disk, so it never hears of
a failure: it writes to a `_Sink`, which keeps it for us. PyAV loses what is raised while FFmpeg writes, and what was to
be written: signals wait until it has written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from polsep.compute.threads import get_threads
from polsep.io.raw.videos import load_library
from polsep.io.store.atomic import delayed_signals, release_cache

#: Containers by suffix.
_FORMATS = {".mp4": "mp4", ".mkv": "matroska", ".avi": "avi"}
#: FFmpeg's options for containers without dates and random numbers.
_EXACTLY = {"fflags": "+bitexact"}
#: Colours of films to watch, by their numbers in ITU-T H.273: players take those of BT.709 for granted in large films,
#: FFmpeg makes others where nobody asks. The third is FFmpeg's number of a range from 16 to 235.
_BT709, _SRGB, _LIMITED = 1, 13, 1
#: Bytes of a film that the system keeps in memory, about.
_RELEASED = 2**25


@dataclass(frozen=True)
class FilmKind:
    """A kind of film: ``codec``, ``pixels``, ``options`` as FFmpeg names them. ``threads``: at most, of its encoder."""

    suffix: str
    codec: str
    pixels: str
    options: tuple[tuple[str, str], ...]
    threads: int = 1


#: Slices of a frame of FFV1, which are encoded in threads of their own: as many bytes, and the same.
_SLICES = 4
_FFV1 = (("level", "3"), ("slicecrc", "1"), ("slices", str(_SLICES)), ("g", "1"))
_FFVHUFF = (("pred", "median"),)
#: To watch: H.264 that every player knows, of ``uint8 [H, W, 3]`` with even sides.
WATCHABLE = FilmKind(".mp4", "libx264", "yuv420p", (("preset", "ultrafast"), ("crf", "18")))
#: To measure: every bit of ``uint16 [C, H, W]`` is kept. By codec and number of colours, of which three are G, B, R.
#: FFV1 has a checksum in each slice; FFVHuff, FFmpeg's HuffYUV, takes a tenth of its time and 1.6 times its bytes.
LOSSLESS = {
    ("ffv1", 3): FilmKind(".mkv", "ffv1", "gbrp16le", _FFV1, _SLICES),
    ("ffv1", 1): FilmKind(".mkv", "ffv1", "gray16le", _FFV1, _SLICES),
    ("ffvhuff", 3): FilmKind(".avi", "ffvhuff", "gbrp16le", _FFVHUFF),
    ("ffvhuff", 1): FilmKind(".avi", "ffvhuff", "gray16le", _FFVHUFF),
}


class _Sink:
    """A file as FFmpeg sees it, which never fails: all that comes after the first failure goes nowhere.

    State: where FFmpeg writes, and the first ``failure``, if any.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._at, self._released = file, 0, 0
        self.failure: OSError | None = None

    def write(self, data: bytes) -> int:
        """Write at the present place, and count it as done."""
        self._try(self._file.write, data)
        self._at += len(data)
        if self._at > self._released + _RELEASED and not isinstance(self._file, BytesIO):
            self._released = self._at
            release_cache(self._file.fileno())
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        """Go to a place, and return it."""
        self._at = self._try(self._file.seek, offset, whence) or (offset if whence == 0 else self._at)
        return self._at

    def tell(self) -> int:
        """The present place."""
        return self._at

    def finish(self) -> None:
        """Close a file, and raise the first failure, if any; what is in memory stays open."""
        if not isinstance(self._file, BytesIO) and not self._file.closed:
            self._try(self._file.flush)
            with suppress(OSError):
                self._file.close()
        self.check()

    def check(self) -> None:
        """Raise the first failure, if any."""
        if self.failure is not None:
            raise OSError(self.failure.errno, self.failure.strerror, self._file.name) from self.failure

    def _try(self, do: Callable[..., int | None], *arguments: Any) -> int | None:
        try:
            return do(*arguments) if self.failure is None else None
        except OSError as error:
            self.failure = error
            return None


class Film:
    """A film that is being written; its file is complete after `close`. Raises ValueError without PyAV, and OSError.

    State: the encoder and the file. ``rate`` in frames per second.
    """

    def __init__(self, target: Path | BinaryIO, kind: FilmKind, size: tuple[int, int], rate: float) -> None:
        av = load_library()
        self._kind, self._count = kind, 0
        self._sink = _Sink(target.open("wb") if isinstance(target, Path) else target)
        self._container: Any = av.open(self._sink, "w", format=_FORMATS[kind.suffix], options=_EXACTLY)
        fraction = Fraction(rate).limit_denominator(1001)
        self._stream: Any = self._container.add_stream(kind.codec, rate=fraction, options=dict(kind.options))
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = kind.pixels
        self._stream.codec_context.thread_count = min(kind.threads, get_threads())
        self._stream.codec_context.flags |= av.codec.context.Flags.bitexact
        if kind is WATCHABLE:
            self._stream.codec_context.colorspace = self._stream.codec_context.color_primaries = _BT709
            self._stream.codec_context.color_trc, self._stream.codec_context.color_range = _SRGB, _LIMITED
        self._rate = fraction

    def write(self, image: NDArray[Any]) -> None:
        """Append a frame, as its kind says."""
        import av

        frame: Any
        if image.dtype == np.uint8:
            shown = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame = shown.reformat(format=self._kind.pixels, dst_colorspace=_BT709)
        else:
            frame = av.VideoFrame(image.shape[2], image.shape[1], self._kind.pixels)
            for plane, codes in zip(frame.planes, image, strict=True):  # the library itself copies sample by sample
                np.frombuffer(plane, np.uint16).reshape(image.shape[1], -1)[:, : image.shape[2]] = codes
        frame.pts, frame.time_base = self._count, 1 / self._rate
        self._count += 1
        with delayed_signals():
            self._container.mux(self._stream.encode(frame))
        self._sink.check()

    def close(self) -> None:
        """Write the frames that the encoder still holds, and end the file; again, say again why it failed."""
        with delayed_signals():
            if self._count:
                self._count = 0
                self._container.mux(self._stream.encode())
            self._container.close()
            self._sink.finish()


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
    stream, frames, sink = None, 0, _Sink(path.open("wb"))
    per_second = Fraction(rate).limit_denominator(1001)
    with _container(sink, kind.suffix) as output:
        for part in parts:
            with delayed_signals(), av.open(f"file:{part}") as source:  # a colon alone would end a protocol's name
                template = source.streams.video[0]
                if stream is None:
                    stream = output.add_stream_from_template(template)
                    stream.codec_context.framerate = per_second  # a template has none, and short films do not show it
                for packet in source.demux(template):
                    if packet.size:  # every part counts its frames from 0, and rounds their times
                        packet.pts = packet.dts = round(frames / (per_second * packet.time_base))
                        packet.stream = stream
                        output.mux(packet)
                        frames += 1
            sink.check()


@contextmanager
def _container(sink: _Sink, suffix: str) -> Iterator[Any]:
    """The container that FFmpeg writes into a sink, by the end of the block. Raises OSError where that failed."""
    output = load_library().open(sink, "w", format=_FORMATS[suffix], options=_EXACTLY)
    try:
        yield output
    finally:
        with delayed_signals():
            output.close()
            sink.finish()
