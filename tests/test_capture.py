"""Live acquisition: nothing is lost in silence, recordings are exact, and a camera that went is waited for."""

from __future__ import annotations

import json
import math
import signal
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from itertools import count, islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imagecodecs
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_cli import Cli, assert_refused, contents, frame, png
from test_cli import polsep as polsep  # the fixture

from polsep.capture import find, session, sources
from polsep.capture.folder import FolderSource
from polsep.capture.live import LiveView, Shown, advise
from polsep.capture.page import serve_page
from polsep.capture.ring import Ring
from polsep.capture.session import CapturePlan, Counters, Limits, Session, Status
from polsep.capture.sources import (
    Camera,
    CameraError,
    CameraInfo,
    CameraLost,
    CameraSettings,
    EndOfFrames,
    FrameIds,
    Loss,
    SoftwareTrigger,
)
from polsep.io.raw.frames import Frame, ReadOptions, read_frames
from polsep.io.raw.genicam import pack_frame
from polsep.io.raw.recording import INDEX, RAW, RECORD, Header, RawImage, RecordingWriter, read_images
from polsep.io.raw.sequences import open_sequence
from polsep.io.store.atomic import OutputError
from polsep.io.store.errors import InputError
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.levels import level_notes

WIDTH, HEIGHT, PACKED = 36, 32, "BayerRG12p"
INFO = CameraInfo("scripted", WIDTH, HEIGHT, PACKED, patience_s=0.3)
HEADER = Header(WIDTH, HEIGHT, PACKED)

Event = RawImage | Loss | Exception


@cache
def codes(seed: int) -> NDArray[np.uint16]:
    """A 12-bit mosaic with highlights."""
    return frame(seed, size=40)[:HEIGHT, :WIDTH] >> 4


def image(frame_id: int, **more: Any) -> RawImage:
    """A frame that shows which one it is."""
    return RawImage(pack_frame(codes(frame_id % 7), PACKED), frame_id, 1000 * frame_id, **more)


class Scripted:
    """A `CameraSource` whose connections happen as written: events in order, then nothing more is ever sent.

    A connection may be a CameraError instead, for a camera that is not there.
    """

    def __init__(self, *connections: Iterable[Event] | CameraError, info: CameraInfo = INFO) -> None:
        self._connections, self.info = deque(connections), info
        self._events: Iterator[Event] = iter(())

    @contextmanager
    def connect(self) -> Iterator[Camera]:
        """The next connection."""
        connection = self._connections.popleft() if self._connections else CameraError("expected it, found nothing")
        if isinstance(connection, CameraError):
            raise connection
        self._events = iter(connection)
        yield self

    def start(self) -> None:
        """Nothing to do."""

    def read(self, timeout_s: float) -> RawImage | Loss | None:
        """The next event."""
        event = next(self._events, None)
        if event is None:
            time.sleep(0.02)
        if isinstance(event, Exception):
            raise event
        return event


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits of a run are a hundredth of a second."""
    monkeypatch.setattr(session, "RETRY_S", 0.01)
    monkeypatch.setattr(session, "TICK_S", 0.01)


def run(source: Any, plan: CapturePlan, **limits: Any) -> tuple[Status, list[str]]:
    """A whole run, and what it said."""
    said: list[str] = []
    status = Session(source, plan, Limits(**limits), said.append).run(lambda status: None, 0.01)
    return status, said


def index_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / INDEX).read_text().splitlines()]


def record_of(folder: Path) -> dict[str, Any]:
    record = json.loads((folder / RECORD).read_text())
    assert isinstance(record, dict)
    return record


# ids and rings


@given(st.integers(0, 2**40), st.lists(st.integers(1, 300), max_size=40))
def test_ids_tell_how_many_frames_are_missing(first: int, steps: list[int]) -> None:
    ids = FrameIds()
    assert ids.lost_before(first) == 0
    for step in steps:
        first += step
        assert ids.lost_before(first) == step - 1


@given(st.integers(1, 65535), st.lists(st.integers(1, 30000), min_size=1, max_size=20))
def test_ids_of_16_bits_begin_again_at_1(first: int, steps: list[int]) -> None:
    ids = FrameIds()
    ids.lost_before(first)
    for step in steps:
        first += step
        assert ids.lost_before((first - 1) % 65535 + 1) == step - 1


def test_ids_that_go_back_are_another_count() -> None:
    ids = FrameIds()
    assert [ids.lost_before(i) for i in (100, 101, 90, 92)] == [0, 0, 0, 1]
    ids = FrameIds()
    assert [ids.lost_before(i) for i in (2**40, 5, 6)] == [0, 0, 0]


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 20.0, 60.0])
def test_software_triggers_come_at_their_rate(monkeypatch: pytest.MonkeyPatch, rate_hz: float) -> None:
    """Frames come 10 ms after them, however long a read may wait; after a stall, what was due meanwhile is left out."""
    now, frame_s, found = 100.0, math.inf, list[float]()
    monkeypatch.setattr(sources, "time", SimpleNamespace(monotonic=lambda: now))
    trigger = SoftwareTrigger(CameraSettings(frame_rate_hz=rate_hz, trigger="Software"))
    trigger.start()
    while len(found) < 20:
        if trigger.is_due():
            found.append(now)
            frame_s = now + 0.01
        end = now + trigger.limit_wait(0.2)
        now, frame_s = (frame_s, math.inf) if frame_s <= end else (end, frame_s)
    np.testing.assert_allclose(np.diff(found), 1 / rate_hz, rtol=1e-9)
    now += 60.0
    assert trigger.is_due() and not trigger.is_due()
    assert trigger.limit_wait(10.0) == pytest.approx(1 / rate_hz)


def test_other_triggers_are_not_waited_for() -> None:
    trigger = SoftwareTrigger(CameraSettings(trigger="Line0"))
    trigger.start()
    assert not trigger.is_due() and trigger.limit_wait(0.2) == 0.2


@given(st.integers(1, 5), st.lists(st.booleans(), max_size=60))
def test_a_ring_keeps_the_newest_in_order_and_counts_the_rest(capacity: int, puts: list[bool]) -> None:
    ring, model, numbers, taken = Ring[int](capacity), deque[int](maxlen=capacity), count(), list[int]()
    put = 0
    for is_put in puts:
        if is_put:
            number = next(numbers)
            ring.put(number)
            model.append(number)
            put += 1
        else:
            item = ring.take(0)
            assert item == (model.popleft() if model else None)
            taken += [] if item is None else [item]
        assert put == len(taken) + ring.dropped + ring.waiting
    ring.close()
    taken += list(islice(iter(lambda: ring.take(0), None), capacity))
    assert ring.finished and put == len(taken) + ring.dropped
    assert all(a < b for a, b in pairwise(taken))
    assert taken[-len(model) :] == list(model) or not model


def test_a_ring_between_threads_loses_nothing_uncounted() -> None:
    ring, taken = Ring[int](3), list[int]()

    def consume() -> None:
        while not ring.finished:
            item = ring.take(0.1)
            taken.extend([] if item is None else [item])
            time.sleep(0.001)

    consumer = threading.Thread(target=consume)
    consumer.start()
    for number in range(300):
        ring.put(number)
        time.sleep(0.0003)
    ring.close()
    consumer.join()
    assert len(taken) + ring.dropped == 300 and ring.dropped > 0
    assert taken == sorted(taken) and taken[-1] == 299


def test_a_ring_refuses_what_it_cannot_do() -> None:
    with pytest.raises(ValueError, match="expected a ring of at least 1 frame, found 0"):
        Ring(0)
    ring = Ring[int](1)
    ring.close()
    with pytest.raises(ValueError, match="expected an open ring"):
        ring.put(1)
    assert ring.take(10) is None


# files as cameras


def frames_of(source: FolderSource, frames: int | None = None) -> tuple[CameraInfo, list[RawImage]]:
    """What a folder sends, all of it or the first ``frames``."""
    found: list[RawImage] = []
    with source.connect() as camera:
        camera.start()
        while frames is None or len(found) < frames:
            try:
                event = camera.read(1.0)
            except EndOfFrames:
                break
            found += [] if event is None else [event]
        return camera.info, found


def fast(**more: Any) -> CameraSettings:
    return CameraSettings(frame_rate_hz=1000.0, **more)


def test_a_folder_sends_its_files_packed_as_asked(tmp_path: Path) -> None:
    for k in range(3):
        png(tmp_path / f"{k}.png", codes(k))
    info, found = frames_of(FolderSource(tmp_path, fast(pixel_format=PACKED)))
    assert (info.width, info.height, info.pixel_format) == (WIDTH, HEIGHT, PACKED)
    assert [f.payload for f in found] == [pack_frame(codes(k), PACKED) for k in range(3)]
    assert [f.frame_id for f in found] == [0, 1, 2]
    info, found = frames_of(FolderSource(tmp_path / "1.png", fast()))
    assert info.pixel_format == "BayerRG16" and found[0].payload == codes(1).tobytes()


def test_a_folder_counts_2_before_10(tmp_path: Path) -> None:
    for k in (10, 2, 1):
        png(tmp_path / f"shot{k}.png", codes(k % 7))
    _, found = frames_of(FolderSource(tmp_path, fast()))
    assert [f.payload for f in found] == [codes(k % 7).tobytes() for k in (1, 2, 10)]


def test_a_loop_begins_again(tmp_path: Path) -> None:
    for k in range(2):
        png(tmp_path / f"{k}.png", (codes(k) >> 4).astype(np.uint8))
    info, found = frames_of(FolderSource(tmp_path, fast(), loop=True), 5)
    assert info.pixel_format == "BayerRG8"
    assert [f.payload for f in found] == [(codes(k) >> 4).astype(np.uint8).tobytes() for k in (0, 1, 0, 1, 0)]
    assert [f.frame_id for f in found] == [0, 1, 2, 3, 4]


def test_frames_of_files_come_at_their_rate(tmp_path: Path) -> None:
    png(tmp_path / "0.png", codes(0))
    start = time.monotonic()
    frames_of(FolderSource(tmp_path, CameraSettings(frame_rate_hz=20), loop=True), 5)
    assert time.monotonic() - start >= 4 / 20


def test_a_damaged_file_costs_none_before_it(tmp_path: Path) -> None:
    for k in range(4):
        png(tmp_path / f"{k}.png", codes(k))
    (tmp_path / "3.png").write_bytes(b"no picture")
    source = FolderSource(tmp_path, fast())
    with pytest.raises(InputError, match=r"3\.png"):
        run(source, CapturePlan(tmp_path / "out", None))
    assert len(index_of(tmp_path / "out")) == record_of(tmp_path / "out")["frames"] == 3
    status, _ = run(source, CapturePlan(tmp_path / "short", None), frames=3)  # which needs no fourth one
    assert status.counters.recorded == 3


def test_a_recording_is_a_camera_byte_for_byte(tmp_path: Path) -> None:
    images = [image(k) for k in (3, 4, 6)]
    run(Scripted([*images, EndOfFrames()]), CapturePlan(tmp_path / "a", None))
    for path in (tmp_path / "a", tmp_path / "a" / RECORD):
        info, found = frames_of(FolderSource(path, fast()))
        assert info.pixel_format == PACKED
        assert [f.payload for f in found] == [i.payload for i in images]


def test_a_recording_has_no_other_pixel_format(tmp_path: Path) -> None:
    """Its bytes are sent as they are: another one that is asked for would change nothing."""
    run(Scripted([image(1), EndOfFrames()]), CapturePlan(tmp_path / "a", None))
    for path in (tmp_path / "a", tmp_path / "a" / RECORD):
        assert len(frames_of(FolderSource(path, fast(pixel_format=PACKED)))[1]) == 1
        with pytest.raises(InputError, match=f"expected the recording's own pixel format {PACKED}, found BayerRG8$"):
            frames_of(FolderSource(path, fast(pixel_format="BayerRG8")))


def test_a_recording_is_not_written_among_the_frames_that_are_played(tmp_path: Path) -> None:
    """The folder would be that recording from then on, and its frames would be seen no more."""
    (tmp_path / "shots").mkdir()
    png(tmp_path / "shots" / "1.png", codes(0))
    (tmp_path / "link").symlink_to(tmp_path / "shots")
    for path in (tmp_path / "shots", tmp_path / "link", tmp_path / "shots" / "1.png"):
        with pytest.raises(OutputError, match="expected a folder apart from that of the frames"):
            run(FolderSource(path, fast()), CapturePlan(tmp_path / "shots", None))
    assert [file.name for file in (tmp_path / "shots").iterdir()] == ["1.png"]
    run(FolderSource(tmp_path / "shots", fast()), CapturePlan(tmp_path / "shots" / "take", None))


def test_a_recording_that_is_played_keeps_its_layout(tmp_path: Path) -> None:
    """Its copy was read by the pixel format's name, and so was the live view."""
    layout, other = Layout(((0, 45), (135, 90))), Layout(bayer=None)
    run(Scripted([image(1), EndOfFrames()]), CapturePlan(tmp_path / "a", None, layout))
    run(FolderSource(tmp_path / "a", fast()), CapturePlan(tmp_path / "b", None))
    run(FolderSource(tmp_path / "a", fast()), CapturePlan(tmp_path / "c", None, other))
    assert [record_of(tmp_path / name)["layout"] for name in "abc"] == [layout.spec, layout.spec, other.spec]
    for said, expected in ((None, layout), (other, other)):
        view = LiveView("analytic", said)
        view.warm_up(frames_of(FolderSource(tmp_path / "b", fast()))[0])
        data = view.separate(image(1).payload)[2]
        assert isinstance(data, Mosaic) and data.layout == expected


@pytest.mark.parametrize(
    ("files", "settings", "words"),
    [
        ([], {}, "expected files of .png, .tif, .tiff, .npy, .pgm or a recording.json, found none"),
        ([codes(0)], {"exposure_us": 5.0}, "expected a camera to set its exposure, found files"),
        ([codes(0)], {"trigger": "Line0"}, "expected a camera to set its trigger, found files"),
        ([codes(0), codes(1)[:-4]], {}, "1.png: expected 36x32 BayerRG16 as in the frames before, found 36x28 BayerRG"),
        ([np.full((8, 8), 5000, np.uint16)], {"pixel_format": PACKED}, "expected codes in 0 .. 4095 for BayerRG12p"),
        ([np.zeros((8, 8, 3), np.uint8)], {}, r"expected a raw mosaic \[H, W\] of uint8 or uint16 codes"),
        ([codes(0)], {"pixel_format": "BayerXX12"}, "expected a known pixel format"),
    ],
)
def test_folders_refuse_in_one_line(tmp_path: Path, files: list[Any], settings: dict[str, Any], words: str) -> None:
    for k, array in enumerate(files):
        png(tmp_path / f"{k}.png", array)
    with pytest.raises(InputError, match=words) as caught:
        frames_of(FolderSource(tmp_path, fast(**settings)))
    assert "\n" not in str(caught.value)


# recordings


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Five frames on disk."""
    run(Scripted([*map(image, range(5)), EndOfFrames()]), CapturePlan(tmp_path / "take", None))
    return tmp_path / "take"


def test_a_recording_holds_the_bytes_as_they_came(recording: Path) -> None:
    assert (recording / RAW).read_bytes() == b"".join(image(k).payload for k in range(5))
    assert list(read_images(recording / RECORD)) == [image(k) for k in range(5)]
    assert record_of(recording) | {"finished": True, "frames": 5, "pixel_format": PACKED} == record_of(recording)


@given(cut=st.integers(1, 5 * HEADER.frame_bytes), line=st.integers(0, 60))
def test_a_recording_cut_anywhere_is_read_to_its_last_whole_frame(
    tmp_path_factory: pytest.TempPathFactory, cut: int, line: int
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    writer = RecordingWriter(folder / "take", HEADER)
    for k in range(5):
        writer.append(image(k))
    writer.close()  # without a last note, as after a kill
    raw, index = folder / "take" / RAW, folder / "take" / INDEX
    raw.write_bytes(raw.read_bytes()[:-cut])
    index.write_bytes(index.read_bytes()[: max(index.stat().st_size - line, 0)])
    whole = 5 - -(-cut // HEADER.frame_bytes)
    if whole == 0:
        with pytest.raises(InputError, match=r"expected at least one frame of 1728 bytes in frames\.raw, found"):
            next(read_frames(folder / "take" / RECORD))
        return
    frames = list(read_frames(folder / "take" / RECORD))
    assert [f.stem for f in frames] == (["take"] if whole == 1 else [f"take_{k:04d}" for k in range(whole)])
    assert all(np.array_equal(f.data.data, codes(k)) for k, f in enumerate(frames))
    assert any("ends within a frame" in note for note in frames[0].notes) == (cut % HEADER.frame_bytes > 0)


def test_what_is_missing_between_frames_is_said(tmp_path: Path) -> None:
    """Lost on the wire or dropped at the disk; ids that begin again, also behind an interruption, lack nothing."""
    writer = RecordingWriter(tmp_path, HEADER)
    steps = [(65533, 0, 0.0), (65534, 0, 0.0), (1, 1, 0.0), (2, 0, 0.0), (5, 1, 0.0), (900, 0, 3.5), (901, 0, 0.0)]
    for done, (frame_id, lost, away_s) in enumerate(steps, 1):
        writer.append(replace(image(frame_id % 9), frame_id=frame_id, lost_before=lost, away_s=away_s))
        if done in (2, len(steps)):
            *said, last = open_sequence(tmp_path, ReadOptions()).notes
            assert last.startswith("the recording is under way, or was stopped before its end")
            assert said == [] if done == 2 else "3 frames are missing, first before frame 2 and the camera" in said[0]
    writer.note({}, finished=True)
    writer.close()
    assert "was away for 3.5 s: frames are counted from 0" in said[0]
    assert list(open_sequence(tmp_path, ReadOptions()).notes) == said


def test_a_recording_has_the_rate_at_which_its_frames_came(tmp_path: Path) -> None:
    """Or that of its settings where times say nothing; what is lost and where the camera was away says nothing."""
    steps_ns = [(1, 0, 0.0), (2, 40_000_000, 0.0), (5, 160_000_000, 0.0), (6, 200_000_000, 0.0), (7, 5_000, 9.0)]
    for settings, scale, rate in (
        ({"frame_rate_hz": 10.0}, 1, 25.0),
        ({"frame_rate_hz": 25.02}, 1, 25.02),
        ({}, 0, None),
    ):
        writer = RecordingWriter(tmp_path, replace(HEADER, settings=settings), overwrite=True)
        for frame_id, stamp, away_s in steps_ns:
            writer.append(replace(image(1), frame_id=frame_id, timestamp_ns=scale * stamp, away_s=away_s))
        writer.close()
        assert open_sequence(tmp_path, ReadOptions()).rate == rate


def test_frames_have_the_time_at_which_they_came(tmp_path: Path) -> None:
    """Behind a trigger that was waited for, and by a clock that begins again where the camera was without power."""

    def late() -> Iterator[Event]:
        time.sleep(0.2)
        yield replace(image(1), timestamp_ns=5_000_000_000)
        yield replace(image(2), timestamp_ns=5_040_000_000)
        yield CameraLost("gone")

    def back() -> Iterator[Event]:
        yield replace(image(1), timestamp_ns=5_001_000_000)
        yield replace(image(2), timestamp_ns=5_021_000_000)
        yield EndOfFrames()

    before = datetime.now(UTC)
    run(Scripted(late(), back()), CapturePlan(tmp_path, None))
    times = [datetime.fromisoformat(str(frame.captured)) for frame in read_frames(tmp_path / RECORD)]
    away_s = index_of(tmp_path)[2]["away_s"]
    assert (times[0] - before).total_seconds() > 0.19
    steps = [(after - earlier).total_seconds() for earlier, after in pairwise(times)]
    assert steps == pytest.approx([0.04, away_s, 0.02], abs=0.0011)
    lines = (tmp_path / INDEX).read_text().replace(f'"away_s": {away_s}', '"away_s": 1e300')
    (tmp_path / INDEX).write_text(lines)
    assert [frame.captured is None for frame in read_frames(tmp_path / RECORD)] == [False, False, True, True]


def test_a_recording_can_be_begun_anywhere(recording: Path) -> None:
    frames = list(read_frames(recording / RECORD, first=3))
    assert [(f.index, f.count, f.stem) for f in frames] == [(3, 5, "take_0003"), (4, 5, "take_0004")]
    footage = open_sequence(recording, ReadOptions())
    assert (footage.stem, footage.count) == ("take", 5)
    later = next(footage.begin(4))
    assert isinstance(later, Frame) and np.array_equal(later.data.data, codes(4))


@pytest.mark.parametrize("name", [RAW, INDEX])
def test_missing_parts_are_named(recording: Path, name: str) -> None:
    (recording / name).unlink()
    with pytest.raises(InputError, match=rf"recording\.json: expected .* beside it, found no {name}"):
        next(read_frames(recording / RECORD))


def test_a_recording_is_not_replaced_by_its_results(recording: Path, polsep: Cli) -> None:
    """Neither the index nor the record gives way to a log or a report of its name."""
    before = {path.name: path.read_bytes() for path in recording.iterdir()}
    folder = recording.rename(recording.with_name("recording"))
    for source in ([folder / RAW, "--size", f"{WIDTH}x{HEIGHT}", "--pixel-format", PACKED], [folder]):
        run = polsep("video", *source, "-o", folder, "--method", "analytic", "--white-level", "4095", "--overwrite")
        assert run.status == 2 and "is an input" in run.err
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_damage_is_seen(recording: Path) -> None:
    damaged = bytearray((recording / RAW).read_bytes())
    damaged[2 * HEADER.frame_bytes + 5] ^= 1
    (recording / RAW).write_bytes(damaged)
    with pytest.raises(InputError, match=r"recording\.json: expected frame 2 of frames\.raw with checksum"):
        list(read_frames(recording / RECORD))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "expected a polsep recording .recording.json., found a file that is not JSON"),
        ('{"a": 1}', "found another JSON file"),
        ('{"format": "polsep recording 1", "width": 4}', "expected width, height and pixel_format"),
        (
            '{"format": "polsep recording 1", "width": 4, "height": 0, "pixel_format": "Mono8"}',
            "expected an image with at least one pixel, found 0x4",
        ),
    ],
)
def test_other_json_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / RECORD).write_text(text)
    with pytest.raises(InputError, match=words):
        next(read_frames(tmp_path / RECORD))


class FullDisk:
    """A file that takes only so many bytes."""

    def __init__(self, path: Path, room: int) -> None:
        self._file, self._room = path.open("wb", buffering=0), room

    def write(self, data: bytes) -> int:
        """A part of the data, until nothing fits."""
        if not self._room:
            raise OSError(28, "No space left on device")
        taken = self._file.write(data[: self._room])
        self._room -= taken
        return taken

    def truncate(self, size: int) -> int:
        """As files do."""
        return self._file.truncate(size)

    def close(self) -> None:
        """As files do."""
        self._file.close()


def test_a_full_disk_is_said_and_whole_frames_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = RecordingWriter.__init__

    def on_small_disk(self: Any, directory: Path, header: Header, overwrite: bool = False) -> None:
        start(self, directory, header, overwrite)
        self._raw.close()
        self._raw = FullDisk(directory / RAW, int(2.5 * HEADER.frame_bytes))

    monkeypatch.setattr(RecordingWriter, "__init__", on_small_disk)
    with pytest.raises(OutputError, match=r"expected to keep recording into .*, found: No space left on device"):
        run(Scripted([image(k) for k in range(9)]), CapturePlan(tmp_path, None))
    record = record_of(tmp_path)
    count = record["counters"]
    assert not record["finished"] and count["recorded"] == 2 and count["dropped"] == count["received"] - 2 > 0
    assert (tmp_path / RAW).read_bytes() == image(0).payload + image(1).payload


# runs


def test_a_run_counts_what_the_wire_lost(tmp_path: Path) -> None:
    part = Loss("a frame came incomplete")
    events = [
        image(1),
        part,
        image(4, lost_before=2),
        image(7, lost_before=2),
        part,
        part,
        image(9, lost_before=1),
        part,
    ]
    status, said = run(Scripted([*events, EndOfFrames()]), CapturePlan(tmp_path, None))
    assert status.counters == Counters(received=4, lost=2 + 2 + 2 + 1, recorded=4)
    assert [line["lost_before"] for line in index_of(tmp_path)] == [0, 2, 2, 2]
    assert said[1:] == ["lost in transfer: a frame came incomplete; further losses are only counted"]


def test_a_slow_disk_drops_the_oldest_and_counts_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append = RecordingWriter.append

    def slowly(self: RecordingWriter, image: RawImage) -> None:
        time.sleep(0.03)
        append(self, image)

    monkeypatch.setattr(RecordingWriter, "append", slowly)
    status, _ = run(Scripted([*map(image, range(40)), EndOfFrames()]), CapturePlan(tmp_path, None), ring=4)
    count = status.counters
    assert count.received == 40 and count.dropped > 30 and count.recorded == 40 - count.dropped
    ids = [line["frame_id"] for line in index_of(tmp_path)]
    assert len(ids) == count.recorded and ids[-4:] == [36, 37, 38, 39]
    assert record_of(tmp_path)["counters"] | {"dropped": count.dropped} == record_of(tmp_path)["counters"]
    assert [i.payload for i in read_images(tmp_path / RECORD)] == [image(k).payload for k in ids]


def test_a_slow_view_costs_the_recording_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def slowly(self: LiveView, image: RawImage) -> Shown:
        time.sleep(0.05)
        return Shown(b"", image.frame_id, 0.0, ())

    monkeypatch.setattr(LiveView, "warm_up", lambda self, info: None)
    monkeypatch.setattr(LiveView, "show", slowly)
    status, _ = run(Scripted([*map(image, range(30)), EndOfFrames()]), CapturePlan(tmp_path, "analytic"))
    count = status.counters
    assert (count.received, count.recorded, count.dropped) == (30, 30, 0)
    assert 1 <= count.shown < 30


def test_a_view_that_fails_is_said_and_the_recording_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: LiveView, image: RawImage) -> Shown:
        raise ValueError("no picture today")

    monkeypatch.setattr(LiveView, "warm_up", lambda self, info: None)
    monkeypatch.setattr(LiveView, "show", broken)
    with pytest.raises(ValueError, match="expected to show every frame, found: no picture today"):
        run(Scripted([*map(image, range(9)), EndOfFrames()]), CapturePlan(tmp_path, "analytic"))
    assert record_of(tmp_path)["counters"]["recorded"] == 9


def test_a_camera_that_was_unplugged_is_waited_for(tmp_path: Path) -> None:
    gone, absent = CameraLost("the cable is out"), CameraError("expected a camera, found none")
    source = Scripted([image(1), image(2), gone], absent, absent, [image(1), image(2), image(4)])
    status, said = run(source, CapturePlan(tmp_path, None), frames=5)
    count = status.counters
    assert (count.received, count.recorded, count.lost, count.interruptions) == (5, 5, 0, 1)
    assert count.away_s > 0
    assert [line["frame_id"] for line in index_of(tmp_path)] == [1, 2, 1, 2, 4]
    assert [line["away_s"] > 0 for line in index_of(tmp_path)] == [False, False, True, False, False]
    assert record_of(tmp_path)["interruptions"][0]["received_before"] == 2
    assert sum("camera lost: the cable is out; trying again every second for 30 s" in line for line in said) == 1
    assert sum("camera back after" in line for line in said) == 1


def test_a_camera_that_says_nothing_is_connected_again(tmp_path: Path) -> None:
    status, said = run(Scripted([image(1)], [image(9)]), CapturePlan(tmp_path, None), frames=2)
    assert status.counters.interruptions == 1
    assert any("camera lost: no frame for" in line for line in said)


def test_a_camera_that_stays_away_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"expected the camera back within 0\.1 s, found: expected it, found nothing"):
        run(Scripted([image(1), CameraLost("gone")]), CapturePlan(tmp_path, None), timeout_s=0.1)
    record = record_of(tmp_path)
    assert not record["finished"] and record["counters"]["recorded"] == 1 and record["counters"]["away_s"] >= 0.1


@pytest.fixture
def pass_time(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Let seconds pass for a run."""
    passed = [0.0]
    clock = SimpleNamespace(monotonic=lambda: time.monotonic() + sum(passed), sleep=time.sleep)
    monkeypatch.setattr(session, "time", clock)
    return passed.append


def test_a_camera_is_waited_for_from_its_loss(tmp_path: Path, pass_time: Callable[[float], None]) -> None:
    """A camera that waits for triggers may have been silent for long, also when it has just come back."""

    def quiet(*images: RawImage) -> Iterator[Event]:
        yield from images
        pass_time(60.0)
        yield CameraLost("unplugged")

    absent = CameraError("expected a camera, found none")
    triggered = replace(INFO, patience_s=math.inf)
    source = Scripted(quiet(image(1)), absent, quiet(), absent, [image(2)], info=triggered)
    status, said = run(source, CapturePlan(tmp_path, None), frames=2)
    assert (status.counters.recorded, status.counters.interruptions) == (2, 1)
    assert sum(line == "camera lost: unplugged; trying again every second for 30 s" for line in said) == 2
    assert 120 <= status.counters.away_s < 150  # from the last frame to the next one


def test_a_camera_that_comes_back_silent_ends_the_run(tmp_path: Path, pass_time: Callable[[float], None]) -> None:
    """One that runs freely is back with its first frame, not where it can merely be connected to."""

    def silent() -> Iterator[Event]:
        pass_time(10.0)
        yield CameraLost("no frame for 10 s")

    source = Scripted([image(1), CameraLost("gone")], *(silent() for _ in range(9)))
    with pytest.raises(CameraError, match="expected the camera back within 30 s, found: no frame for 10 s"):
        run(source, CapturePlan(tmp_path, None))


def test_a_camera_that_comes_back_as_another_is_refused(tmp_path: Path) -> None:
    source = Scripted([image(1), CameraLost("gone")], [image(2)])

    def changed(line: str) -> None:
        if "camera lost" in line:
            source.info = CameraInfo("other", WIDTH, HEIGHT, "BayerRG8")

    with pytest.raises(CameraError, match="expected the camera back with 36x32 BayerRG12p, found 36x32 BayerRG8"):
        Session(source, CapturePlan(tmp_path, None), Limits(), changed).run(lambda status: None, 0.01)


def test_runs_end_at_their_limits_and_at_ctrl_c(tmp_path: Path) -> None:
    def endless() -> Scripted:
        return Scripted(map(image, count()))

    status, _ = run(endless(), CapturePlan(tmp_path / "frames", None), frames=7)
    assert status.counters.received == 7
    status, _ = run(endless(), CapturePlan(tmp_path / "seconds", None), seconds=0.1)
    assert 0 < status.seconds < 5
    before = signal.getsignal(signal.SIGINT)
    interrupts = iter([signal.SIGINT])

    def press_once(status: Status) -> None:
        for number in interrupts if status.counters.recorded else ():
            signal.raise_signal(number)

    status = Session(endless(), CapturePlan(tmp_path / "stopped", None), Limits(), print).run(press_once, 0.01)
    assert signal.getsignal(signal.SIGINT) is before
    record = record_of(tmp_path / "stopped")
    assert record["finished"] and record["frames"] == status.counters.recorded == len(index_of(tmp_path / "stopped"))


def test_replays_separate_to_the_same_images_as_live(tmp_path: Path, polsep: Cli) -> None:
    png(tmp_path / "shot.png", codes(5))
    shown: list[Any] = []

    class Watched(LiveView):
        """Keeps what it separates."""

        def separate(self, payload: bytes) -> Any:
            shown.append(super().separate(payload))
            return shown[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "LiveView", Watched)
        source = FolderSource(tmp_path / "shot.png", fast(pixel_format=PACKED))
        run(source, CapturePlan(tmp_path / "take", "analytic"))
    live = shown[-1][0]
    replayed = next(read_frames(tmp_path / "take" / RECORD))
    again = separate_capture(replayed.data, "analytic")
    arguments = [
        (tmp_path / "shot.png", "--white-level", "4095"),
        (tmp_path / "take" / RECORD,),
        (tmp_path / "take" / RAW, "--size", f"{WIDTH}x{HEIGHT}", "--pixel-format", PACKED),
    ]
    found = []
    for k, words in enumerate(arguments):
        done = polsep("separate", *words, "--method", "analytic", "--format", "npz", "-o", tmp_path / f"out{k}")
        assert done.status == 0, done
        found.append(np.load(next((tmp_path / f"out{k}").glob("*.npz"))))
    for layer in ("diffuse", "specular", "dolp", "aolp", "valid"):
        expected = getattr(live, layer)
        for value in (getattr(again, layer), *(arrays[layer] for arrays in found)):
            np.testing.assert_array_equal(value, expected)
    picture = imagecodecs.jpeg_decode((tmp_path / "take" / "live.jpg").read_bytes())
    assert picture.shape == (HEIGHT // 2, 3 * (WIDTH // 2) + 24, 3)
    assert not list((tmp_path / "take").glob(".*"))


def test_a_layout_said_goes_into_the_record(tmp_path: Path) -> None:
    layout = Layout(((0, 45), (135, 90)))
    run(Scripted([image(1), EndOfFrames()]), CapturePlan(tmp_path / "take", None, layout))
    assert next(read_frames(tmp_path / "take" / RECORD)).data.layout == layout
    assert next(read_frames(tmp_path / "take" / RECORD, ReadOptions(Layout()))).data.layout == Layout()


def test_a_method_that_cannot_take_the_frames_is_said_before_anything_is_recorded(tmp_path: Path) -> None:
    tiny = CameraInfo("tiny", 2, 2, "BayerRG8")
    with pytest.raises(ValueError, match="expected a mosaic of at least 4x4 pixels, found 2x2"):
        run(Scripted([image(1)], info=tiny), CapturePlan(tmp_path / "a", "analytic"))
    assert not (tmp_path / "a").exists()


# the page


def test_the_page_shows_the_latest_picture_to_this_machine() -> None:
    shown: list[Shown | None] = [None]
    with serve_page(0, lambda: shown[0], lambda: "12 received") as address:

        def get(name: str, **headers: str) -> bytes:
            with urllib.request.urlopen(urllib.request.Request(address + name, headers=headers), timeout=5) as answer:
                return bytes(answer.read())

        assert address.startswith("http://127.0.0.1:")
        assert b"live.jpg" in get("")
        assert json.loads(get("state.json")) == {"line": "12 received", "frame_id": None}
        with pytest.raises(urllib.error.HTTPError, match="404"):
            get("live.jpg")
        shown[0] = Shown(b"jpeg", 7, 25.0, ())
        assert get("live.jpg?7") == b"jpeg" and json.loads(get("state.json"))["frame_id"] == 7
        for host in ("127.0.0.1", "localhost", "localhost:80"):  # browsers do not name port 80
            assert get("live.jpg", Host=host) == b"jpeg"
        for host in ("elsewhere.example:80", "elsewhere.example", "127.0.0.1.example", ""):
            with pytest.raises(urllib.error.HTTPError, match="403"):
                get("live.jpg", Host=host)
        port = int(address.rpartition(":")[2].strip("/"))
        with pytest.raises(CameraError, match="expected a free port for --show"), serve_page(port, lambda: None, str):
            pass


def test_a_tab_that_was_closed_is_no_error(capfd: pytest.CaptureFixture[str]) -> None:
    """Nothing is printed over the status line, wherever in the answer the browser goes."""
    asked, closed = threading.Event(), threading.Event()

    def latest() -> None:
        asked.set()
        assert closed.wait(10)

    with serve_page(0, latest, str) as address:
        port = int(address.rpartition(":")[2].strip("/"))
        with socket.create_connection(("127.0.0.1", port)) as tab:
            tab.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closing it is a reset
            tab.sendall(b"GET /state.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert asked.wait(10)
        closed.set()
        for thread in threading.enumerate():
            if "process_request_thread" in thread.name:
                thread.join(10)
    assert capfd.readouterr().err == ""


# the command


def test_the_command_records_and_says_where(tmp_path: Path, polsep: Cli) -> None:
    png(tmp_path / "shot.png", codes(5))
    words = ("--frames", "4", "--rate", "200", "--method", "none")
    done = polsep("capture", f"loop:{tmp_path}", "-o", tmp_path / "take", *words)
    assert done.status == 0, done
    assert "recording.json: " in done.out and "4 received, 0 lost, 0 dropped, 4 recorded" in done.out
    again = polsep("capture", f"loop:{tmp_path}", "-o", tmp_path / "take", *words)
    assert_refused(again, "expected no", "found one from before; --overwrite replaces it")
    assert polsep("capture", f"loop:{tmp_path}", "-o", tmp_path / "take", *words, "--overwrite").status == 0


@pytest.mark.parametrize("source", ["take", "loop:take", "folder:take/recording.json"])
def test_a_recording_is_not_recorded_over_itself(
    monkeypatch: pytest.MonkeyPatch, recording: Path, polsep: Cli, source: str
) -> None:
    monkeypatch.chdir(recording.parent)
    before = contents(recording)
    done = polsep("capture", source, "-o", "take", "--overwrite", "--method", "none")
    assert_refused(done, "expected outputs apart from inputs, found that", "recording.json is an input")
    png(recording.parent / "shot.png", codes(5))
    done = polsep("capture", "shot.png", "-o", "take", "--overwrite", "--ambient", "take/frames.raw")
    assert_refused(done, "expected outputs apart from inputs, found that", "frames.raw is an input")
    assert contents(recording) == before


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("folder:nowhere", "-o", "out"), "expected a folder or file of raw frames, found nothing"),
        (("loop:.", "-o", "out"), "expected files of .png"),
        (("loop:.",), "expected -o DIR to record, or --show PORT to watch, found neither"),
        (("loop:.", "-o", "out", "--seconds", "0"), "'--seconds': expected a finite number above 0, found '0'"),
        (("loop:.", "-o", "out", "--ring", "0"), "'--ring': expected a whole number of 1 or more, found '0'"),
        (("loop:.", "-o", "out", "--rate", "-1"), "'--rate': expected a finite number above 0, found '-1'"),
        (("loop:.", "-o", "out", "--trigger", "Software"), "expected a frame rate for software triggers, found none"),
        (("loop:.", "-o", "out", "--set", "Width"), "expected --set NAME=VALUE, found 'Width'"),
        (("loop:.", "-o", "out", "--method", "magic"), "expected a method of"),
        (("loop:.", "--show", "0", "--method", "none"), "expected -o DIR to record, or --show PORT"),
        (("loop:.", "-o", "o", "--method", "none", "--calibration", "no.json"), "expected --calibration with a method"),
    ],
)
def test_the_command_refuses_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, polsep: Cli, words: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(polsep("capture", *words), said)
    assert not list(tmp_path.iterdir())


def test_cameras_are_found_by_name(monkeypatch: pytest.MonkeyPatch, polsep: Cli) -> None:
    def none() -> list[tuple[str, str]]:
        raise CameraError("expected Aravis, found nothing")

    def sources(name: str, settings: CameraSettings) -> Any:
        return f"source of {name}"

    two = find.Backend(lambda: [("A1", "first"), ("B2", "second")], sources)
    monkeypatch.setattr(find, "BACKENDS", {"aravis": find.Backend(none, sources), "pylon": two})
    settings = CameraSettings()
    assert find.find_source("B2", settings) == find.find_source("pylon:B2", settings) == "source of B2"
    assert find.find_source("aravis:10.0.0.1", settings) == "source of 10.0.0.1"
    with pytest.raises(CameraError, match="found pylon:A1, pylon:B2; aravis is not usable: expected Aravis"):
        find.find_source(None, settings)
    with pytest.raises(CameraError, match=r"expected a camera as .* found 'C3'"):
        find.find_source("C3", settings)
    listed = polsep("capture", "--list")
    assert listed.out == "pylon:A1  first\npylon:B2  second\n"
    assert "aravis: expected Aravis, found nothing" in listed.err


@pytest.mark.parametrize(("pixel_format", "advised"), [("BayerRG16", "BayerRG12"), ("Mono16", "Mono12")])
def test_advice_is_what_a_camera_takes(pixel_format: str, advised: str) -> None:
    """Narrow codes in wide words: cameras have pixel formats, not white levels. Other remarks stay as they are."""
    (remark,) = level_notes(np.full((4, 4), 4000, np.uint16) + np.arange(4, dtype=np.uint16), 0.0, None)
    assert "--white-level 4095" in remark
    assert advise(remark, pixel_format) == remark.replace("--white-level 4095", f"--pixel-format {advised}")
    (left,) = level_notes(np.full((4, 4), 4000, np.uint16) << 4, 0.0, None)
    assert "say" not in advise(left, pixel_format)
    assert advise("black frame", pixel_format) == "black frame"
