"""Recordings of `polsep capture`: a camera's frames on disk exactly as it sent them, and a record of them.

A recording is a folder:

* ``frames.raw``      the payloads one after the other, in the camera's pixel format: headerless raw;
* ``frames.jsonl``    a line per frame: index, frame_id, timestamp_ns, crc32 of the payload, lost_before and away_s (the
  frames that the wire lost just before it, and for how long the camera was away);
* ``recording.json``  size, pixel format, layout, camera, settings, counters, interruptions.

A payload is written before its line, and both before the next frame: whenever the program is killed, every complete
frame can be read. ``recording.json`` exists from the start with ``finished`` false, and is replaced atomically at the
end.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

from polsep import __version__
from polsep.io.raw.genicam import find_pixel_format
from polsep.io.raw.headerless import headerless_page, with_layout
from polsep.io.raw.page import Page
from polsep.io.raw.rates import frame_rate
from polsep.io.store.atomic import refuse_existing, replace_text
from polsep.io.store.header_checks import require_size
from polsep.io.store.json_text import parse_json, read_record, read_text
from polsep.sensor.camera import Layout

FORMAT = "polsep recording 1"
RAW, INDEX, RECORD, PICTURE = "frames.raw", "frames.jsonl", "recording.json", "live.jpg"


@dataclass(frozen=True)
class Header:
    """Properties that all frames share. ``layout``: the spec of a layout where the user gave one, else None.

    ``began``: time of the first frame in ISO 8601, of recordings that were read, or None where it is not known.
    ``width`` and ``height`` are those of the pixel format (of ONE angle image for LUCID's angles); ``settings`` are
    the camera's, as it reported them. Raises ValueError on an unknown pixel format, or a size that no frame has.
    """

    width: int
    height: int
    pixel_format: str
    camera: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    layout: str | None = None
    began: str | None = None

    def __post_init__(self) -> None:
        planes = find_pixel_format(self.pixel_format).planes
        require_size((planes, self.height, self.width) if planes > 1 else (self.height, self.width))

    @property
    def frame_bytes(self) -> int:
        """Bytes of one payload."""
        return find_pixel_format(self.pixel_format).frame_bytes(self.width, self.height)


@dataclass(frozen=True)
class RawImage:
    """One complete frame: the bytes as the camera sent them, and its number, time and losses.

    ``lost_before``: how many frames the wire lost between the one before and this one. ``away_s``: how long the camera
    had been away, for the first frame after an interruption.
    """

    payload: bytes
    frame_id: int
    timestamp_ns: int
    lost_before: int = 0
    away_s: float = 0.0


class RecordingWriter:
    """Writer that appends frames to a recording; to be closed. After a failure the frames before it stay readable."""

    def __init__(self, directory: Path, header: Header, overwrite: bool = False) -> None:
        """Make the folder and its files. Raises OutputError where a recording exists and ``overwrite`` is False."""
        refuse_recording(directory, overwrite)
        directory.mkdir(parents=True, exist_ok=True)
        self.directory, self.header, self.frames = directory, header, 0
        (directory / PICTURE).unlink(missing_ok=True)
        self._raw: BinaryIO = (directory / RAW).open("wb", buffering=0)
        self._index: BinaryIO = (directory / INDEX).open("wb", buffering=0)
        self.note({}, finished=False)

    def append(self, image: RawImage) -> None:
        """Write one frame. Raises ValueError on a payload of another size, OSError when the disk is full."""
        expected = self.header.frame_bytes
        if len(image.payload) != expected:
            raise ValueError(f"expected a payload of {expected} bytes, found {len(image.payload)}")
        line = {
            "index": self.frames,
            "frame_id": image.frame_id,
            "timestamp_ns": image.timestamp_ns,
            "crc32": zlib.crc32(image.payload),
            "lost_before": image.lost_before,
            "away_s": round(image.away_s, 3),
        }
        try:
            _write_all(self._raw, image.payload)
            _write_all(self._index, (json.dumps(line) + "\n").encode())
        except OSError:
            with suppress(OSError):  # a full disk may still shrink a file
                self._raw.truncate(self.frames * expected)
            raise
        self.frames += 1

    def note(self, remarks: Mapping[str, Any], finished: bool) -> None:
        """Replace the record: header, number of frames so far, and remarks such as counters."""
        record = {
            "format": FORMAT,
            "polsep": __version__,
            "finished": finished,
            "width": self.header.width,
            "height": self.header.height,
            "pixel_format": self.header.pixel_format,
            "frame_bytes": self.header.frame_bytes,
            "layout": self.header.layout,
            "camera": self.header.camera,
            "settings": dict(self.header.settings),
            "frames": self.frames,
            **remarks,
        }
        replace_text(self.directory / RECORD, json.dumps(record, indent=2, allow_nan=False) + "\n")

    def close(self) -> None:
        """Close the files."""
        self._raw.close()
        self._index.close()


def refuse_recording(directory: Path, overwrite: bool) -> None:
    """Raise OutputError where an earlier recording would be replaced without ``overwrite``. Call it first."""
    refuse_existing(directory, [directory / name for name in (RAW, INDEX, RECORD, PICTURE)], overwrite)


def read_header(path: Path) -> Header:
    """The header of a ``recording.json``. Raises ValueError when it is another file or incomplete."""
    record = read_record(path, f"a polsep recording ({RECORD})", FORMAT)
    width, height = record.get("width"), record.get("height")
    name, layout = record.get("pixel_format"), record.get("layout")
    if not (isinstance(width, int) and isinstance(height, int) and isinstance(name, str)):
        raise ValueError(
            f"expected width, height and pixel_format in {RECORD}, found {width!r:.40}, {height!r:.40} and {name!r:.40}"
        )
    if layout is not None:
        Layout.parse(str(layout))
    camera, settings = str(record.get("camera", "")), record.get("settings")
    began = record.get("began") if _is_time(record.get("began")) else None
    return Header(width, height, name, camera, settings if isinstance(settings, dict) else {}, layout, began)


def is_recording(folder: Path) -> bool:
    """True for a folder of `polsep capture`; the report on a frame or film called recording has a record's name."""
    if not (folder / RECORD).is_file() or any((folder / name).is_file() for name in (RAW, INDEX)):
        return (folder / RECORD).is_file()
    try:
        read_header(folder / RECORD)
    except ValueError:
        return False
    return True


def recording_files(path: Path) -> list[Path]:
    """The files of the recording that a file belongs to; none of other files."""
    names = (RECORD, RAW, INDEX)
    return [path.with_name(name) for name in names] if path.name in names and path.with_name(RECORD).is_file() else []


def _require_parts(path: Path) -> None:
    """Raise ValueError where frames or index of a ``recording.json`` are missing."""
    missing = [name for name in (RAW, INDEX) if not path.with_name(name).is_file()]
    if missing:
        raise ValueError(f"expected {RAW} and {INDEX} beside it, found no {missing[0]}")


def _is_time(text: Any) -> bool:
    """True for a time with its zone, in ISO 8601."""
    try:
        return datetime.fromisoformat(text).tzinfo is not None
    except (TypeError, ValueError):
        return False


def read_images(path: Path, first: int = 0) -> Iterator[RawImage]:
    """The frames of a ``recording.json`` as the camera sent them, from ``first`` to the last complete one.

    Frames without a line in the index, as the last one of a killed recording may be, have their own number as id.
    Raises ValueError when there is none, or a payload differs from the checksum that was taken of it.
    """
    size = read_header(path).frame_bytes
    _require_parts(path)
    raw, lines = path.with_name(RAW), _read_index(path.with_name(INDEX))
    total = raw.stat().st_size
    if total < size:
        raise ValueError(f"expected at least one frame of {size} bytes in {RAW}, found {total} bytes")
    with raw.open("rb") as stream:
        stream.seek(first * size)
        for index in range(first, total // size):
            data, line = stream.read(size), lines.get(index, {})
            found, expected = zlib.crc32(data), line.get("crc32")
            if expected is not None and found != expected:
                raise ValueError(f"expected frame {index} of {RAW} with checksum {expected}, found {found}: damage")
            losses = {name: line[name] for name in ("lost_before", "away_s") if name in line}
            yield RawImage(data, line.get("frame_id", index), line.get("timestamp_ns", 0), **losses)


def read_recording(path: Path, first: int = 0) -> Iterator[Page]:
    """The frames of a ``recording.json`` from ``first`` on, as pages. Raises ValueError as `read_images`."""
    header = read_header(path)
    _require_parts(path)
    count, rest = divmod(path.with_name(RAW).stat().st_size, header.frame_bytes)
    notes = (f"{RAW} ends within a frame: {rest} bytes after frame {count - 1} are left out",) if rest else ()
    size = (header.width, header.height)
    exposure_us = header.settings.get("exposure_us")
    exposure = exposure_us * 1e-6 if isinstance(exposure_us, int | float) and exposure_us > 0 else None
    starts = _starts(_read_index(path.with_name(INDEX)))
    for index, image in enumerate(read_images(path, first), first):
        page = headerless_page(image.payload, size, header.pixel_format, index, count)
        if header.layout is not None:
            page = with_layout(page, Layout.parse(header.layout))
        yield replace(
            page, notes=page.notes + notes, exposure=exposure, captured=_captured(header, starts.get(index), image)
        )


def gap_notes(path: Path) -> tuple[str, ...]:
    """Notes on what is missing of a ``recording.json``: its end, and frames between others. Raises ValueError."""
    _require_parts(path)
    lines = sorted(_read_index(path.with_name(INDEX)).items())
    away_s = sum(line.get("away_s", 0) for _, line in lines)
    gaps = {after: count for before, (after, line) in pairwise(lines) if (count := _missing(before[1], line))}
    found = [f"{sum(gaps.values())} frames are missing, first before frame {min(gaps)}"] if gaps else []
    found += [f"the camera was away for {away_s:g} s"] if away_s > 0 else []
    notes: tuple[str, ...] = (f"{' and '.join(found)}: frames are counted from 0, without gaps",) if found else ()
    if parse_json(read_text(path)).get("finished") is False:
        notes += ("the recording is under way, or was stopped before its end: the frames that are there are read",)
    return notes


def recorded_rate(path: Path) -> float | None:
    """Frames per second of a ``recording.json``, or None where nothing says them. Raises ValueError.

    They are those of the camera's settings unless frames came at another rate, as they may with a trigger.
    """
    stated = read_header(path).settings.get("frame_rate_hz")
    lines = [line for _, line in sorted(_read_index(path.with_name(INDEX)).items())]
    whole = [(a, b) for a, b in pairwise(lines) if not _missing(a, b) and not b.get("away_s")]
    steps_s = [1e-9 * (b.get("timestamp_ns", 0) - a.get("timestamp_ns", 0)) for a, b in whole]
    return frame_rate(stated if isinstance(stated, int | float) and stated > 0 else None, steps_s)


def _missing(before: Mapping[str, Any], line: Mapping[str, Any]) -> int:
    """Number of frames missing between those of two lines: lost on the wire or dropped; none while away.

    Ids that go back begin again.
    """
    step = line.get("frame_id", 0) - before.get("frame_id", 0)
    return 0 if line.get("away_s", 0) > 0 else max(step - 1, line.get("lost_before", 0), 0)


def _starts(lines: Mapping[int, Mapping[str, Any]]) -> dict[int, int]:
    """The time of the first frame [ns] by the clock of each one: a camera that was away may count from 0 again.

    Nothing where the first frame has no time.
    """
    starts, start, before = dict[int, int](), 0, 0
    for number, line in sorted(lines.items()) if lines.get(0, {}).get("timestamp_ns") else ():
        stamp, away_s = line.get("timestamp_ns", 0), line.get("away_s", 0)
        if number == 0:
            start = stamp
        elif away_s > 0:
            start += stamp - before - int(away_s) * 10**9 - round(away_s % 1 * 1e9)
        starts[number], before = start, stamp
    return starts


def _captured(header: Header, start: int | None, image: RawImage) -> str | None:
    """Time of a frame: by the camera's clock after the first one, whose time by that clock is ``start`` [ns]."""
    if header.began is None or start is None or image.timestamp_ns < start:
        return None
    try:
        when = datetime.fromisoformat(header.began) + timedelta(microseconds=(image.timestamp_ns - start) // 1000)
    except OverflowError:  # away for longer than there are years
        return None
    return when.isoformat(timespec="milliseconds")


def _read_index(path: Path) -> dict[int, dict[str, Any]]:
    """The lines of the index by frame, without a last line that was cut short."""
    found: dict[int, dict[str, Any]] = {}
    with path.open("rb") as stream:
        for number, text in enumerate(stream, 1):
            if text.endswith(b"\n"):
                line = _parse_line(text, number)
                found[line["index"]] = line
    return found


def _parse_line(text: bytes, number: int) -> dict[str, Any]:
    """One line of an index, whose numbers are numbers. Raises ValueError."""
    try:
        line = parse_json(text.decode("utf-8"))
    except ValueError:
        line = None
    if not isinstance(line, dict) or not isinstance(line.get("index"), int):
        raise ValueError(f"expected a JSON object with an index in every line of {INDEX}, found another as {number}")
    for name in ("crc32", "frame_id", "timestamp_ns", "lost_before", "away_s"):
        value = line.get(name, 0)
        if not isinstance(value, int | float if name == "away_s" else int):
            raise ValueError(f"expected a number as {name} in every line of {INDEX}, found {value!r:.40} in {number}")
    return line


def _write_all(stream: BinaryIO, data: bytes) -> None:
    """Write every byte: an unbuffered stream may write fewer than asked."""
    left = memoryview(data)
    while left:
        left = left[stream.write(left) :]
