"""Recordings: every kind gives the same files, kills and damage do no harm, and threads end when they are to."""

from __future__ import annotations

import errno
import io
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
from dying_worker import with_dying_worker
from numpy.typing import NDArray
from test_cli import contents
from torch.nn.functional import interpolate

from polsep import cli
from polsep.compute.threads import own_threads
from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.frames import Frame, ReadOptions, read_frames
from polsep.io.raw.rates import frame_rate
from polsep.io.raw.sequences import DamagedFrame, expand_folders, input_files, natural_order, open_sequence
from polsep.io.results import films, sequences
from polsep.io.results.exr import half_rows, read_exr_layers, zip_rows
from polsep.io.results.films import LOSSLESS, WATCHABLE, Film, encode_film, join_films
from polsep.io.results.pixels_kernel import CHUNK, HEAD
from polsep.io.results.sequences import FILM_WHITE, PART, Picture, SequenceKind, SequenceWriter, write_exr
from polsep.io.store.atomic import OutputError
from polsep.io.store.calibrations import write_calibration
from polsep.io.store.errors import InputError
from polsep.light import light_color
from polsep.light.find import find_light
from polsep.physics.stokes import Stokes
from polsep.pipeline import separate_capture
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import IDEAL, Layout, expose
from polsep.sensor.checks import CheckedMosaic
from polsep.sensor.levels import as_mosaic
from polsep.separation.report import SeparatedFrame
from polsep.video import first_frame, panels
from polsep.video import recordings as video
from polsep.video.reports import shared_report
from polsep.view.opening import as_source, find_sources, read_source

av = pytest.importorskip("av", reason="needs the extra 'video'")

FRAMES, SIDE, WHITE = 2 * PART + 7, 32, 4095
#: How often a run is killed at a random moment; 20 by hand.
KILLS = int(os.environ.get("POLSEP_KILLS", "1"))
#: Seconds that a thread may take to notice that it is to end.
PATIENCE_S = 5.0


def frames(count: int = FRAMES) -> NDArray[np.uint16]:
    """A coloured scene with highlights of one angle, 12 bits ``[N, H, W]``.

    Its lower half moves by the period of the filters, the upper half is still but for noise.
    """
    generator = torch.Generator().manual_seed(7)
    coarse = torch.rand(1, 4, 4, SIDE, generator=generator)
    fine = interpolate(coarse, size=(SIDE, SIDE + 4 * count), mode="bilinear")[0]
    diffuse, specular = 0.2 + 0.5 * fine[:3], 0.7 * fine[3:]
    light = Stokes(diffuse + specular, (0.8 * specular).expand(3, -1, -1), (0.6 * specular).expand(3, -1, -1))
    codes = torch.round(expose(light, Layout(), IDEAL).data * WHITE).to(torch.int32).numpy().astype(np.uint16)
    images = np.stack([codes[:, 4 * k : 4 * k + SIDE] for k in range(count)])
    noise = np.random.default_rng(1).integers(0, 60, (count, SIDE // 2, SIDE), np.uint16)
    images[:, : SIDE // 2] = np.minimum(codes[: SIDE // 2, :SIDE] + noise, WHITE)
    return images


def write_film(
    path: Path,
    images: NDArray[np.uint16],
    codec: str = "ffv1",
    pixels: str = "gray12le",
    times_ms: Sequence[int] | None = None,
    rate: int = 50,
) -> Path:
    """The images as a film, of ``rate`` frames per second where no times are said."""
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream(codec, rate=rate)
        stream.height, stream.width, stream.pix_fmt = images.shape[1], images.shape[2], pixels
        stream.options = {"level": "3", "slicecrc": "1", "g": "1"} if codec == "ffv1" else {}
        for number, image in enumerate(images):
            given = image if pixels.startswith("gray1") else np.repeat((image >> 4).astype(np.uint8)[..., None], 3, 2)
            shown = av.VideoFrame.from_ndarray(given, format=pixels if given is image else "rgb24")
            shown = shown.reformat(format=pixels)
            if times_ms is not None:
                stream.codec_context.time_base = shown.time_base = Fraction(1, 1000)
                shown.pts = times_ms[number]
            container.mux(stream.encode(shown))
        container.mux(stream.encode())
    return path


def write_folder(path: Path, images: NDArray[np.uint16]) -> Path:
    path.mkdir()
    for k, image in enumerate(images):
        (path / f"shot{k}.png").write_bytes(imagecodecs.png_encode(image))
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording as one NPY file."""
    path = tmp_path_factory.mktemp("recording") / "run.npy"
    np.save(path, frames())
    return path


def command(recording: Path, output: Path, *more: str) -> list[str]:
    """Each frame for itself, to be compared with itself alone; too small to show the lamp, which is white."""
    given = ["--method", "analytic", "--white-level", str(WHITE), "--filter", "none", "--light-color", "white"]
    return ["video", str(recording), "-o", str(output), *given, *more]


#: Frames that depend on the ones before.
STEADY = ("--filter", "temporal")


def run(*args: str) -> int:
    """What `polsep ARGS` exits with, in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["polsep", *args])
        try:
            cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
    return 0


def separated_alone(image: NDArray[np.uint16]) -> SeparatedFrame:
    """A frame of the recording, without what the command line would warn of."""
    return separate_capture(as_mosaic(image, white_level=WHITE)[0], "analytic")


@pytest.fixture(scope="module")
def undisturbed(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one run makes of it."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run(*command(recording, folder)) == 0
    return folder


@pytest.fixture(scope="module")
def steady(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What one run with the temporal filter makes of it."""
    folder = tmp_path_factory.mktemp("steady")
    assert run(*command(recording, folder, *STEADY)) == 0
    return folder


def test_every_frame_is_what_it_is_alone(recording: Path, undisturbed: Path) -> None:
    for index in (0, PART, FRAMES - 1):
        alone = separated_alone(np.load(recording)[index])
        layers = read_exr_layers(undisturbed / f"run_{index:06d}.exr")
        for name in ("diffuse", "specular"):
            for k, color in enumerate("RGB"):
                np.testing.assert_array_equal(
                    layers[f"{name}.{color}"], getattr(alone, name)[..., k].astype(np.float16)
                )
    log = [json.loads(line) for line in (undisturbed / "run.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in log] == list(range(FRAMES))
    assert log[-1]["mean_s0"] == alone.report["statistics"]["mean_s0"]
    report = json.loads((undisturbed / "run.json").read_text())
    assert (report["frames"], report["damaged"]) == (FRAMES, [])
    assert not [p for p in undisturbed.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("compression", ["none", "zip", "piz"])
def test_files_hold_half_floats(colors: int, compression: str, tmp_path: Path) -> None:
    """Our own files are what the library reads, and the same as its own; light beyond half floats is their largest."""
    generator = np.random.default_rng(3)
    diffuse, specular = generator.normal(1, 0.5, (2, 7, 5, colors)).astype(np.float32)
    specular[2, 3] = 1e6
    specular.setflags(write=False)
    write_exr(tmp_path / "a.exr", Picture(diffuse, specular, None, {}), compression)
    layers = read_exr_layers(tmp_path / "a.exr")
    expected = {
        f"{name}{color}": np.minimum(image[..., k], 65504).astype(np.float16)
        for name, image in (("diffuse.", diffuse), ("specular.", specular), ("", diffuse + specular))
        for k, color in enumerate("RGB" if colors == 3 else "Y")
    }
    assert set(layers) == set(expected)
    for name, plane in expected.items():
        assert layers[name].dtype == np.float16
        np.testing.assert_array_equal(layers[name], plane)
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("compression", ["none", "zip", "piz"])
def test_every_channel_has_its_own_name(colors: int, compression: str, tmp_path: Path) -> None:
    """Stokes layers and the layer without a name, too: in mono, Y lies behind S0, in colour B before it."""
    images = np.random.default_rng(3).random((5, 7, 5, colors), np.float32)
    write_exr(tmp_path / "a.exr", Picture(images[0], images[1], None, {}, stokes=images[2:]), compression)
    layers = read_exr_layers(tmp_path / "a.exr")
    named = {"S0.": images[2], "S1.": images[3], "S2.": images[4], "": images[0] + images[1], "diffuse.": images[0]}
    for name, image in named.items():
        for k, color in enumerate("RGB" if colors == 3 else "Y"):
            np.testing.assert_array_equal(layers[f"{name}{color}"], image[..., k].astype(np.float16))


def test_half_floats_are_rounded_to_even() -> None:
    """As NumPy rounds them: all half floats, what lies between two of them, and what has no half float."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    between = (halves[1:] + halves[:-1]) / 2
    positive = np.concatenate([halves, between, np.nextafter(between, 0), np.nextafter(between, 1e9), [1e9, 1e-30]])
    values = np.concatenate([positive, -positive, [np.inf, -np.inf, np.nan, 65519.99, -65520]]).astype(np.float32)
    found = half_rows([values.reshape(1, -1, 1)])[0, HEAD:].view(np.float16)
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(found, np.minimum(values, np.float32(65504)).astype(np.float16))
    assert np.signbit(found[positive.size])


@pytest.mark.parametrize("size", [(40, 61), (33, 7), (17, 300)])
@pytest.mark.parametrize("kind", ["noise", "dark", "grey", "few", "skewed"])
def test_packed_rows_are_zlib_streams_of_what_they_were(kind: str, size: tuple[int, int]) -> None:
    generator = np.random.default_rng(5)
    (height, width), n = size, 6
    words = generator.integers(0, 65536, (height, n, width))
    fibonacci = np.round(1.618 ** np.arange(22))  # the rarest of whose codes would be the longest
    words = {
        "noise": words,
        "dark": np.zeros_like(words),
        "grey": np.broadcast_to(words[:, :1], words.shape),
        "few": words % 3,
        "skewed": 256 * np.cumsum(generator.choice(22, words.size, p=fibonacci / fibonacci.sum())).reshape(words.shape),
    }[kind]
    rows = np.zeros((height, HEAD + n * width), np.uint16)
    rows[:, HEAD:] = (words % 65536).reshape(height, -1)
    chunks = zip_rows(rows, width)
    assert len(chunks) == -(-height // CHUNK)
    for k, chunk in enumerate(chunks):
        expected = rows[CHUNK * k : CHUNK * (k + 1), HEAD:].astype("<u2").tobytes()
        assert len(chunk) <= len(expected)
        if len(chunk) == len(expected):
            assert bytes(chunk) == expected
            continue
        data = np.frombuffer(zlib.decompress(chunk), np.uint8).astype(np.int64)
        data[1:] -= 128
        low, high = np.cumsum(data).astype(np.uint8).reshape(2, -1)
        assert np.stack([low, high], axis=-1).tobytes() == expected
    saved = {"noise": 0.0, "dark": 0.5, "grey": 0.0 if width < 60 else 0.5, "few": 0.25, "skewed": 0.25}[kind]
    assert sum(map(len, chunks)) <= (1 - saved) * 2 * words.size


def test_the_film_to_watch_has_every_frame_at_its_time(undisturbed: Path) -> None:
    with av.open(str(undisturbed / "run_preview.mp4")) as container:
        times = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    np.testing.assert_allclose(times, np.arange(FRAMES) / 25, atol=1e-3)


@pytest.mark.parametrize("kind", ["folder", "tiff", "mkv", "raw"])
def test_every_kind_of_recording_gives_the_same_images(kind: str, undisturbed: Path, tmp_path: Path) -> None:
    images, more = frames(), []
    path = tmp_path / f"run.{kind}"
    if kind == "folder":
        write_folder(path := tmp_path / "run", images)
    elif kind == "tiff":
        tifffile.imwrite(path, images, photometric="minisblack")
    elif kind == "mkv":
        write_film(path, images)
    else:
        path.write_bytes((images << 4).astype("<u2").tobytes())  # 12 bits, left-justified
        more = ["--size", f"{SIDE}x{SIDE}", "--pixel-format", "BayerRG16", "--white-level", str(WHITE * 16)]
    assert run(*command(path, tmp_path / "out", "--no-preview", *more)) == 0
    made = {folder: sorted(folder.glob("*.exr")) for folder in (tmp_path / "out", undisturbed)}
    assert [path.name for path in made[undisturbed]] == [path.name for path in made[tmp_path / "out"]]
    for one, other in zip(*made.values(), strict=True):
        if kind != "raw":
            assert one.read_bytes() == other.read_bytes()
        before, after = (read_exr_layers(path) for path in (one, other))  # headers of raw have another white level
        for name in before | after:
            np.testing.assert_array_equal(before[name], after[name])


@pytest.mark.parametrize("suffix", ["mkv", "nut"])
def test_films_of_uneven_times_say_so_and_have_all_frames(suffix: str, tmp_path: Path) -> None:
    """A note, where times differ by more than the milliseconds they are rounded to; and the viewer reaches the last
    frame and none behind it, though the length of a film by its duration is a guess."""
    images = frames(6)[:, :64, :64].repeat(4, axis=0)
    even = [round(1000 / 29.97 * k) for k in range(len(images))]
    for times, uneven in ((even, False), ([t * (1 + t // 300) for t in even], True), ([*even[:-1], 2000], True)):
        film = write_film(tmp_path / f"run.{suffix}", images, times_ms=times)
        notes = open_sequence(film, ReadOptions()).notes
        assert (len(notes) == 1 and "found them 33 to" in notes[0]) if uneven else not notes
        first = read_source((as_source(film, "run"),), ReadOptions(), 0)
        assert isinstance(first, Frame) and first.count == len(images)


@pytest.mark.parametrize(("codec", "suffix"), [("ffv1", "mkv"), ("ffvhuff", "avi")])
def test_lossless_films_hold_the_images_in_sixteen_bits(
    codec: str, suffix: str, recording: Path, tmp_path: Path
) -> None:
    more = ("--format", codec, "--frames", str(PART + 2), "--no-preview", "--rate", "30")
    assert run(*command(recording, tmp_path, *more)) == 0
    assert set(contents(tmp_path)) == {f"run_diffuse.{suffix}", f"run_specular.{suffix}", "run.json", "run.jsonl"}
    for name, white in FILM_WHITE.items():
        with av.open(str(tmp_path / f"run_{name}.{suffix}")) as container:
            assert container.streams.video[0].average_rate == 30
            shown = [frame.to_ndarray() for frame in container.decode(video=0)]
        assert len(shown) == PART + 2
        for index in (0, PART + 1):
            alone = getattr(separated_alone(np.load(recording)[index]), name) * np.float32(65535 / white)
            np.testing.assert_array_equal(shown[index], np.rint(np.clip(alone, 0, 65535)).astype(np.uint16))


@pytest.mark.parametrize("colors", [1, 3])
@pytest.mark.parametrize("codec", ["ffv1", "ffvhuff"])
def test_films_do_not_depend_on_threads(codec: str, colors: int, tmp_path: Path) -> None:
    """Neither do they on the width, of which rows in memory are a multiple."""
    light = np.random.default_rng(4).uniform(0, 3, (2, 22, 35, colors)).astype(np.float32)
    films = []
    for threads in (1, 4):
        with own_threads(threads):
            writer = SequenceWriter(
                tmp_path / str(threads), "run", SequenceKind(codec, preview=False), {"colors": colors}
            )
            writer.append(0, Picture(light[0], light[1], None, {}))
            writer.end_part()
            films.append([path.read_bytes() for path in writer.finish({})])
            writer.close()
    assert films[0] == films[1]


def test_an_error_of_a_thread_that_writes_ends_the_run(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The part is not complete, and the same command goes on."""

    def fail(path: Path, *more: Any) -> None:
        if path.name.endswith(f"{PART + 3:06d}.exr"):
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write_exr(path, *more)

    monkeypatch.setattr(sequences, "write_exr", fail)
    assert run(*command(recording, tmp_path)) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and f"{PART + 3:06d}.exr" in error
    assert not (tmp_path / "run.json").exists() and not list(tmp_path.rglob("*.part"))
    assert [path.name for path in (tmp_path / ".polsep-run").glob("0*.json")] == ["000000.json"]
    monkeypatch.setattr(sequences, "write_exr", write_exr)
    assert run(*command(recording, tmp_path)) == 0


def test_films_end_behind_the_frame_that_is_being_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where Ctrl-C ends the wait for it: an encoder in two hands ends the process."""
    black = np.zeros((4, 4, 3), np.float32)
    closing, done = threading.Event(), list[str]()

    class Slow:
        def __init__(self, *given: Any) -> None: ...

        def write(self, image: NDArray[Any]) -> None:
            closing.wait(0.2)  # long enough for whoever closes too soon
            done.append("written")

        def close(self) -> None:
            done.append("closed")
            closing.set()

    monkeypatch.setattr(sequences, "Film", Slow)
    writer = SequenceWriter(tmp_path, "run", SequenceKind("ffv1", preview=False), {"colors": 3})
    writer.append(0, Picture(black, black, None, {"frame": 0}))
    with monkeypatch.context() as patch:
        patch.setattr(sequences, "wait", interrupt)
        with pytest.raises(KeyboardInterrupt):
            writer.append(1, Picture(black, black, None, {"frame": 1}))
    writer.close()
    assert done == ["written", "written", "closed", "closed"]


def test_ctrl_c_while_ffmpeg_writes_costs_no_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is heard once that is written: raised within, it is lost, and what was to be written too."""
    kind, write, paths = LOSSLESS["ffv1", 1], films._Sink.write, [tmp_path / "a.mkv", tmp_path / "b.mkv"]
    presses = list[signal.Signals]()

    def pressed(sink: Any, data: bytes) -> int:
        for number in presses:
            signal.raise_signal(number)
        return write(sink, data)

    monkeypatch.setattr(films._Sink, "write", pressed)
    started = [Film(path, kind, (4, 4), 25.0) for path in paths]
    for film in started:
        film.write(np.arange(16, dtype=np.uint16).reshape(1, 4, 4))
    started[0].close()
    presses.append(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        started[1].close()
    assert paths[0].read_bytes() == paths[1].read_bytes()
    with pytest.raises(KeyboardInterrupt):
        join_films(paths, tmp_path / "film.mkv", kind, 25.0)


def test_a_second_run_into_the_same_files_is_refused(tmp_path: Path) -> None:
    """While the first is under way, also one that would replace it; not where that was closed or is gone."""
    black = Picture(np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 3), np.float32), None, {"frame": 0})
    for overwrite in (False, True):
        begin = partial(SequenceWriter, tmp_path, "run", SequenceKind(preview=False), {"colors": 3}, overwrite)
        first = begin()
        first.append(0, black)
        for _ in range(2):
            with pytest.raises(OutputError, match=r"expected no other run that writes .*run, found one"):
                begin()
        first.end_part()
        first.close()
        second = begin()
        assert second.first == (0 if overwrite else 1)
        del second
        last = begin()
        last.append(0, black)
        last.end_part()
        last.finish({})
        assert sorted(path.name for path in tmp_path.iterdir()) == ["run.json", "run.jsonl", "run_000000.exr"]


def test_a_recording_goes_on_from_any_frame(recording: Path, tmp_path: Path) -> None:
    """Seeking gives what reading on gives, in every kind of file."""
    images = frames()
    np.save(tmp_path / "a.npy", images)
    tifffile.imwrite(tmp_path / "a.tiff", images, photometric="minisblack")
    write_film(tmp_path / "a.mkv", images)
    write_folder(tmp_path / "a", images)
    for path in (tmp_path / "a.npy", tmp_path / "a.tiff", tmp_path / "a.mkv", tmp_path / "a"):
        footage = open_sequence(path, ReadOptions(white_level=WHITE))
        for first in (0, 1, PART, FRAMES - 1, FRAMES):
            seen = list(footage.begin(first))
            assert [frame.index for frame in seen] == list(range(first, FRAMES))
            for frame in seen:
                assert isinstance(frame, Frame)
                np.testing.assert_array_equal(frame.data.data, images[frame.index])


def test_numbers_in_names_count_as_numbers() -> None:
    names = ["b1.png", "a10.png", "a9.png", "a9b.png", "a010.png"]
    assert [p.name for p in sorted(map(Path, names), key=natural_order)] == [
        "a9.png",
        "a9b.png",
        "a010.png",
        "a10.png",
        "b1.png",
    ]


def test_results_called_recording_are_no_recording(tmp_path: Path) -> None:
    """Their report is a recording.json, too: their folder could not be viewed, nor raw frames beside it be read."""
    np.save(tmp_path / "recording.npy", frames(3))
    assert run(*command(tmp_path / "recording.npy", tmp_path, "--no-preview")) == 0
    assert (tmp_path / "recording.json").exists()
    assert [source.path.name for source in find_sources(tmp_path)] == [f"recording_{k:06d}.exr" for k in range(3)]
    assert input_files(tmp_path) == [tmp_path / "recording.npy"]
    assert expand_folders([str(tmp_path)]) == [str(tmp_path / "recording.npy")]


def test_four_angle_images_of_a_folder_are_one_frame(tmp_path: Path) -> None:
    """As `polsep separate` reads the folder: each alone would be taken for a mosaic."""
    for k, mosaic in enumerate(frames(3)):
        places = {0: mosaic[1::2, 1::2], 45: mosaic[::2, 1::2], 90: mosaic[::2, ::2], 135: mosaic[1::2, ::2]}
        for angle, image in places.items():
            (tmp_path / f"shot{k}_{angle}.png").write_bytes(imagecodecs.png_encode(image.copy()))
    sequence = open_sequence(tmp_path, ReadOptions(white_level=WHITE))
    read = list(sequence.begin(1))
    assert sequence.count == 3 and [frame.index for frame in read] == [1, 2]
    assert all(isinstance(frame, Frame) and frame.data.data.shape[0] == 4 for frame in read)
    assert sequence.notes == ("12 of 12 files are read as frames of four angle images, like shot0_{angle}.png",)


def test_rate_and_length_of_a_film_are_its_own(tmp_path: Path) -> None:
    """The rate of its first frames where the file states another; a pause is none, nor are whole milliseconds."""
    images = frames(20)[:, :16, :16]
    paused = [20 * k + 900 * (k > 9) for k in range(20)]
    for times, rate in ((None, 50.0), ([40 * k for k in range(20)], 25.0), (paused, 50.0)):
        sequence = open_sequence(write_film(tmp_path / "run.mkv", images, times_ms=times), ReadOptions())
        assert sequence.count == 20 and sequence.rate == rate
    for rate in (1500, 3000):  # Matroska counts milliseconds, in which several frames fall
        sequence = open_sequence(write_film(tmp_path / "fast.mkv", images, rate=rate), ReadOptions())
        assert (sequence.count, sequence.rate, sequence.notes) == (20, rate, ())
        assert [frame.index for frame in sequence.begin(0)] == list(range(20))
    assert frame_rate(300.0, [0.003, 0.003, 0.004] * 21) == 300.0 and frame_rate(None, []) is None


def test_films_have_the_rate_of_the_recording(tmp_path: Path) -> None:
    """Another one only where that is said; what has no rate has 25, and edited films have that of the film."""
    film = write_film(tmp_path / "run.mkv", frames(3))
    assert run(*command(film, tmp_path / "out")) == 0
    assert run(*command(film, tmp_path / "said", "--rate", "24000/1001")) == 0
    assert run(*command(write_folder(tmp_path / "none", frames(3)), tmp_path / "none-out")) == 0
    edit = ["edit", str(tmp_path / "out"), "-o", str(tmp_path / "edited"), "--metallic", "1"]
    assert run(*edit) == 0
    previews = ("out/run", "said/run", "none-out/none", "edited/run")
    assert [rate_of(tmp_path / f"{name}_preview.mp4") for name in previews] == [50, Fraction(24000, 1001), 25, 50]


def test_rates_that_no_film_has_are_not_those_of_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Clocks of cameras count in any unit, and lossless films in milliseconds: only a rate that is said is refused."""
    film = write_film(tmp_path / "run.mkv", frames(2), rate=2500)
    assert run(*command(film, tmp_path / "out", "--format", "ffv1", "--no-preview")) == 0
    assert "no film of ffv1 has the recording's 2500 frames/s: 25, or say --rate" in capsys.readouterr().err
    for kind, found, rate in (("exr", 1e6, 25), ("exr", 2500, 2500), ("ffv1", 2500, 25), ("exr", 1e-4, 25)):
        assert SequenceKind(kind).at(found).rate == rate
    assert SequenceKind(rate=24.0).at(50.0).rate == 24


def rate_of(film: Path) -> Fraction:
    with av.open(str(film)) as container:
        return Fraction(container.streams.video[0].average_rate)


def test_numbers_without_a_file_are_said(tmp_path: Path) -> None:
    """Results are counted from 0, so that their names do not show gaps."""
    folder = write_folder(tmp_path / "run", frames(9))
    assert open_sequence(folder, ReadOptions()).notes == ()
    for number in (3, 5, 6):
        (folder / f"shot{number}.png").unlink()
    assert "the numbers 3, 5 to 6:" in open_sequence(folder, ReadOptions()).notes[0]
    for number in (1, 7):  # 0, 2, 4, 8: most do not follow
        (folder / f"shot{number}.png").unlink()
    assert open_sequence(folder, ReadOptions()).notes == ()


@pytest.mark.usefixtures("compiled")
def test_a_killed_run_goes_on_to_the_same_files(recording: Path, steady: Path, tmp_path: Path) -> None:
    generator = random.Random(5)
    program = [sys.executable, "-c", "from polsep.cli import main; main()"]
    for kill in range(KILLS):
        output = tmp_path / str(kill)
        process = subprocess.Popen([*program, *command(recording, output, *STEADY)], stdout=subprocess.DEVNULL)
        wanted = generator.randrange(1, FRAMES - PART // 2)  # so that there is something left to be killed
        while process.poll() is None and len(list(output.glob("*.exr"))) < wanted:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert not (output / "run.json").exists()
        done = PART * len(list(output.glob(".polsep-*/[0-9]*.json")))
        again = [*program, *command(recording, output, *STEADY)]
        resumed = subprocess.run(again, check=True, capture_output=True, text=True, timeout=120)
        assert (f"polsep: resuming at frame {done} of {FRAMES}" in resumed.stderr) == (done > 0), resumed.stderr
        assert contents(output) == contents(steady)


def test_a_damaged_frame_stops_the_run_until_it_is_repaired(
    tmp_path: Path, undisturbed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "run", frames())
    broken = folder / f"shot{PART + 3}.png"
    whole = broken.read_bytes()
    broken.write_bytes(whole[:100])
    assert run(*command(folder, tmp_path / "out")) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and broken.name in error
    assert not (tmp_path / "out" / "run.json").exists()
    broken.write_bytes(whole)
    assert run(*command(folder, tmp_path / "out")) == 0
    found, expected = contents(tmp_path / "out"), contents(undisturbed)
    assert found.keys() == expected.keys()
    assert all(found[name] == expected[name] for name in found if not name.startswith("run.json"))
    lines = [json.loads(line) for line in found["run.jsonl"].splitlines()]
    assert [line.pop("file") for line in lines] == [f"shot{number}.png" for number in range(FRAMES)]
    assert lines == [json.loads(line) for line in expected["run.jsonl"].splitlines()]


def test_frames_of_two_cameras_make_no_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Where their bits tell them apart; where only their names do, a note says so."""
    folder = write_folder(tmp_path / "run", frames(4) << 4)
    for number in range(2):
        (folder / f"other{number}.png").write_bytes((folder / f"shot{number}.png").read_bytes())
    assert "2 kinds of names (other#, shot#)" in open_sequence(folder, ReadOptions()).notes[0]
    (folder / "shot2.png").write_bytes(imagecodecs.png_encode((frames(1)[0] >> 4).astype(np.uint8)))
    given = ["--method", "analytic", "--filter", "none", "--no-preview"]
    assert run("video", str(folder), "-o", str(tmp_path / "out"), *given) == 2
    assert "shot2: expected white level 65535 as in the first frame, found 255" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "kinds"),
    [
        (["cam1_0001", "cam1_0002", "cam1_0003", "cam2_0002", "cam2_0003"], "2 kinds of names (cam1_#, cam2_#)"),
        ([f"{frame}-cam{camera}" for frame in range(8, 12) for camera in (0, 1)], "2 kinds of names (#-cam0, #-cam1)"),
        (["20260101_115959_970", "20260101_115959_990", "20260101_120000_010", "20260101_120000_030"], None),
        (["cam1_0001", "cam1_0002", "cam1_0003"], None),
        (["1_1", "2_2", "3_3"], None),
        (["shape000_view00", "shape000_view01", "shape001_view00", "shape001_view01"], None),
    ],
)
def test_numbers_of_cameras_in_names_are_noted(tmp_path: Path, names: list[str], kinds: str | None) -> None:
    """Cameras that differ by a number alone were mixed without a word; times, counters and views are no cameras."""
    for name in names:
        (tmp_path / f"{name}.png").touch()
    notes = open_sequence(tmp_path, ReadOptions()).notes
    assert kinds in notes[0] if kinds else notes == ()


def test_a_damaged_frame_that_others_depend_on_is_repaired(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The first one, which shows the exposure; nothing of a run without it is left."""
    images = frames(3)
    images[0] //= 2
    folder, out = write_folder(tmp_path / "run", images), tmp_path / "out"
    assert run(*command(folder, tmp_path / "whole")) == 0
    whole = (folder / "shot0.png").read_bytes()
    (folder / "shot0.png").write_bytes(b"no picture")
    assert run(*command(folder, out)) == 2
    assert "shot0.png" in capsys.readouterr().err and not out.exists()
    (folder / "shot0.png").write_bytes(whole)
    assert run(*command(folder, out)) == 0
    assert contents(out) == contents(tmp_path / "whole")


@pytest.mark.parametrize(
    "wrong",
    [b"no picture", imagecodecs.png_encode(np.full((SIDE, SIDE + 4), 900, np.uint16))],
    ids=["no picture", "another size"],
)
def test_the_lamp_is_not_found_without_a_frame_that_ends_the_run(wrong: bytes, tmp_path: Path) -> None:
    """It would be another one once the frame is repaired."""
    folder = write_folder(tmp_path / "run", frames(first_frame.LIGHT_STEP + 1))
    (folder / f"shot{first_frame.LIGHT_STEP}.png").write_bytes(wrong)
    found, options = open_sequence(folder, ReadOptions(white_level=WHITE)), video.VideoOptions("analytic")
    with pytest.raises(InputError, match=rf"shot{first_frame.LIGHT_STEP}(\.png|: expected size 32x32)"):
        first_frame.separate_first(found, options)
    for other in ({"damaged": "skip"}, {"frames": first_frame.LIGHT_STEP}):
        assert first_frame.separate_first(found, replace(options, **other)).shape == (SIDE, SIDE)


def test_a_run_does_not_go_on_where_files_have_other_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One that was separated is gone: the next file to separate would be left out."""
    folder = write_folder(tmp_path / "run", frames(PART + 3))
    (folder / f"shot{PART + 1}.png").write_bytes(b"no picture")
    assert run(*command(folder, tmp_path / "out")) == 2
    (folder / "shot20.png").unlink()
    capsys.readouterr()
    assert run(*command(folder, tmp_path / "out")) == 2
    assert "expected frame 20 in shot20.png, as the run was begun, found shot21.png" in capsys.readouterr().err


def test_a_run_that_a_damaged_frame_stopped_goes_on_without_it(
    tmp_path: Path, undisturbed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing that is done depends on what becomes of damage; a run that goes on says that a frame is missing."""
    folder, out = write_folder(tmp_path / "run", frames()), tmp_path / "out"
    (folder / f"shot{PART + 3}.png").write_bytes(b"no picture")
    assert run(*command(folder, out)) == 2
    first = (out / "run_000000.exr").stat().st_ino
    finish = SequenceWriter.finish
    monkeypatch.setattr(SequenceWriter, "finish", interrupt)
    assert run(*command(folder, out, "--damaged", "skip")) == 130
    monkeypatch.setattr(SequenceWriter, "finish", finish)
    assert run(*command(folder, out, "--damaged", "skip")) == 2
    assert (out / "run_000000.exr").stat().st_ino == first
    report = json.loads((out / "run.json").read_text())
    assert [line["frame"] for line in report["damaged"]] == [PART + 3] and report["settings"]["damaged"] == "skip"
    found, expected = contents(out), contents(undisturbed)
    assert set(expected) - set(found) == {f"run_{PART + 3:06d}.exr"}


def test_a_run_that_was_stopped_behind_its_last_frame_goes_on_there(
    recording: Path,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The last part is a short one."""
    with monkeypatch.context() as patch:
        patch.setattr(SequenceWriter, "finish", interrupt)
        assert run(*command(recording, tmp_path)) == 130
    capsys.readouterr()
    assert run(*command(recording, tmp_path)) == 0
    said = capsys.readouterr()
    assert said.err == f"polsep: resuming at frame {FRAMES} of {FRAMES}\n" and f"  {FRAMES} frames: " in said.out
    assert contents(tmp_path) == contents(undisturbed)


def test_films_go_into_folders_with_a_colon(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg takes the word before a colon for a protocol."""
    monkeypatch.chdir(tmp_path)
    out = Path("take1:left")
    assert run(*command(recording, out, "--frames", "2")) == 0
    assert (out / "run_preview.mp4").stat().st_size > 0


def test_films_to_watch_have_the_colors_that_players_take_for_granted(tmp_path: Path) -> None:
    """Those of BT.709, and they say so, also once they are joined."""
    color = np.array([200, 40, 60])
    (tmp_path / "part.mp4").write_bytes(encode_film([np.full((16, 16, 3), color, np.uint8)], WATCHABLE, 25.0))
    join_films([tmp_path / "part.mp4"], tmp_path / "film.mp4", WATCHABLE, 25.0)
    with av.open(str(tmp_path / "film.mp4")) as container:
        (frame,) = container.decode(video=0)
        context = container.streams.video[0].codec_context
        said = (context.colorspace, context.color_primaries, context.color_trc, context.color_range)
    assert said == (1, 1, 13, 1)  # BT.709 twice, sRGB; 16 to 235
    luma, blue, red = (np.frombuffer(plane, np.uint8)[0] for plane in frame.planes)
    light = (luma - 16.0) / 219, (blue - 128.0) / 224, (red - 128.0) / 224
    found = np.array([light[0] + 1.5748 * light[2], 0.0, light[0] + 1.8556 * light[1]])  # ITU-R BT.709
    found[1] = (light[0] - 0.2126 * found[0] - 0.0722 * found[2]) / 0.7152
    np.testing.assert_allclose(255 * found, color, atol=4)


def test_frames_of_joined_films_have_times_of_their_own(tmp_path: Path) -> None:
    """At a rate at which times of a part, and of its beginning, rounded to milliseconds each, meet."""
    rate, kind = 783.0, LOSSLESS["ffv1", 1]
    parts = [tmp_path / f"{k}.mkv" for k in range(6)]
    for part in parts:
        film = Film(part, kind, (4, 4), rate)
        for _ in range(PART):
            film.write(np.zeros((1, 4, 4), np.uint16))
        film.close()
    join_films(parts, tmp_path / "film.mkv", kind, rate)
    with av.open(str(tmp_path / "film.mkv")) as container:
        times = [packet.pts for packet in container.demux(video=0) if packet.size]
    assert times == [round(1000 * k / rate) for k in range(len(parts) * PART)]


@pytest.mark.parametrize("kind", [LOSSLESS["ffv1", 1], LOSSLESS["ffvhuff", 1], WATCHABLE])
@pytest.mark.parametrize("lengths", [(1,), (2,), (1, 1), (2, 1), (3, 3)])
def test_joined_films_say_their_rate(kind: films.FilmKind, lengths: tuple[int, ...], tmp_path: Path) -> None:
    """Also those of one or two frames, whose times don't show it."""
    image = np.zeros((16, 16, 3), np.uint8) if kind is WATCHABLE else np.zeros((1, 16, 16), np.uint16)
    parts, rate = [tmp_path / f"{k}{kind.suffix}" for k in range(len(lengths))], 12.5
    for part, length in zip(parts, lengths, strict=True):
        film = Film(part, kind, (16, 16), rate)
        for _ in range(length):
            film.write(image)
        film.close()
    join_films(parts, joined := tmp_path / f"film{kind.suffix}", kind, rate)
    with av.open(str(joined)) as container:
        assert container.streams.video[0].average_rate == Fraction(rate)


def interrupt(*arguments: object) -> None:
    """Ctrl-C, in place of some function."""
    raise KeyboardInterrupt


def test_damaged_frames_are_left_out_when_that_is_asked(
    tmp_path: Path, undisturbed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "run", frames())
    (folder / "shot4.png").write_bytes(b"no picture")
    other = imagecodecs.png_encode(np.zeros((SIDE, SIDE + 4), np.uint16))
    (folder / f"shot{PART}.png").write_bytes(other)
    assert run(*command(folder, tmp_path / "out", "--damaged", "skip")) == 2
    said = capsys.readouterr()
    errors = said.err.splitlines()
    assert len(errors) == 2 and "shot4.png" in errors[0]
    assert f"  {FRAMES - 2} frames: " in said.out
    assert f"shot{PART}: expected size {SIDE}x{SIDE} as in the first frame, found {SIDE + 4}x{SIDE}" in errors[1]
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [line["frame"] for line in report["damaged"]] == [4, PART]
    found, expected = contents(tmp_path / "out"), contents(undisturbed)
    assert set(expected) - set(found) == {"run_000004.exr", f"run_{PART:06d}.exr"}
    assert all(expected[name] == data for name, data in found.items() if name.endswith("exr"))
    with av.open(str(tmp_path / "out" / "run_preview.mp4")) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == FRAMES
    assert pictures[4].max() < 16 < pictures[5].max()


def test_damage_in_the_middle_of_a_film_costs_its_frame_only(tmp_path: Path) -> None:
    path = write_film(tmp_path / "run.mkv", frames())
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8] = bytes(255 - b for b in data[middle : middle + 8])
    path.write_bytes(data)
    seen = list(open_sequence(path, ReadOptions()).begin(0))
    damaged = [frame for frame in seen if isinstance(frame, DamagedFrame)]
    assert len(damaged) == 1 and "run.mkv" in damaged[0].reason
    for frame in seen:
        if isinstance(frame, Frame):
            np.testing.assert_array_equal(frame.data.data, frames()[frame.index])
    assert [frame.index for frame in seen] == list(range(FRAMES))


class Pipe(io.RawIOBase):
    """Takes bytes and cannot go back."""

    def __init__(self) -> None:
        self.data = bytearray()

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        self.data += data
        return len(data)


def piped_film(images: NDArray[np.uint16], between: int) -> bytearray:
    """A film whose file does not say how long it is, with a key frame after every ``between`` frames."""
    pipe = Pipe()
    with av.open(pipe, "w", format="matroska") as container:
        stream: Any = container.add_stream("ffv1", rate=50)
        stream.height, stream.width, stream.pix_fmt = images.shape[1], images.shape[2], "gray12le"
        stream.options = {"level": "3", "slicecrc": "1", "g": str(between)}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray12le")))
        container.mux(stream.encode())
    return pipe.data


@pytest.mark.parametrize("between", [1, 12])
def test_films_of_unknown_length_are_read_to_their_end(between: int, tmp_path: Path) -> None:
    """From any frame on, behind a damaged one, and where the file is cut off; its frames are counted at once."""
    path, data = tmp_path / "run.mkv", piped_film(frames(), between)
    path.write_bytes(data)
    film = open_sequence(path, ReadOptions())
    assert film.count == FRAMES > next(read_frames(path)).count
    with pytest.MonkeyPatch.context() as patch:  # of large ones the number is estimated
        patch.setattr("polsep.io.raw.videos.SMALL", 0)
        assert FRAMES / 2 < open_sequence(path, ReadOptions()).count < 2 * FRAMES
    for first in (0, PART, FRAMES):
        assert [frame.index for frame in film.begin(first)] == list(range(first, FRAMES))
    place = len(data) // 50
    path.write_bytes(data[:place] + bytes(255 - b for b in data[place : place + 8]) + data[place + 8 :])
    seen = list(open_sequence(path, ReadOptions()).begin(0))
    assert [frame.index for frame in seen] == list(range(FRAMES))
    assert [frame.index for frame in seen if isinstance(frame, DamagedFrame)] == list(range(between))
    assert not film.notes
    path.write_bytes(data[: len(data) // 2])
    cut = list(open_sequence(path, ReadOptions()).begin(0))
    assert 1 < len(cut) < FRAMES and all(isinstance(frame, Frame) for frame in cut[:-1])


@pytest.mark.parametrize("suffix", ["mkv", "avi", "nut"])
def test_a_film_that_is_cut_short_says_so(suffix: str, tmp_path: Path) -> None:
    """By a note or by a damaged frame, wherever it is cut."""
    path = write_film(tmp_path / f"run.{suffix}", frames(20))
    data = path.read_bytes()
    assert not open_sequence(path, ReadOptions()).notes
    for share in (0.5, 0.66, 0.99):
        path.write_bytes(data[: int(len(data) * share)])
        film = open_sequence(path, ReadOptions())
        seen = list(film.begin(0))
        cut = film.notes and f"expected {len(data)} bytes, found {int(len(data) * share)}" in film.notes[0]
        assert 1 < len(seen) <= 20 and (cut or isinstance(seen[-1], DamagedFrame))


def test_a_damaged_first_frame_is_one_of_many(tmp_path: Path) -> None:
    codes = np.full((3, 12, 16), 0.5, np.float32)
    codes[0, 3, 5] = np.nan
    np.save(tmp_path / "run.npy", codes)
    found = open_sequence(tmp_path / "run.npy", ReadOptions(pages="frames"))
    kinds = [type(frame) for frame in found.begin(0)]
    assert found.count == 3 and kinds == [DamagedFrame, Frame, Frame]
    codes[:] = np.nan
    np.save(tmp_path / "run.npy", codes)
    with pytest.raises(InputError, match=r"run\.npy: expected finite values"):
        open_sequence(tmp_path / "run.npy", ReadOptions(pages="frames"))


def test_a_damaged_page_costs_its_four_angles_only(tmp_path: Path) -> None:
    pages = np.full((12, 6, 6), 0.5, np.float32)
    pages[5, 0, 0] = np.nan
    np.save(tmp_path / "run.npy", pages)
    seen = list(open_sequence(tmp_path / "run.npy", ReadOptions(pages="angles")).begin(0))
    assert [(frame.index, type(frame)) for frame in seen] == [(0, Frame), (1, DamagedFrame), (2, Frame)]


def test_a_black_first_frame_says_nothing_of_levels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A lamp that is not on yet: 12-bit codes behind it still need their white level."""
    images = np.concatenate([np.zeros_like(frames(3)[:1]), frames(3)])
    folder = write_folder(tmp_path / "run", images)
    plain = ("video", str(folder), "-o", str(tmp_path / "out"), "--method", "analytic", "--no-preview")
    assert run(*plain) == 2
    assert "expected a white level" in capsys.readouterr().err and not list((tmp_path / "out").glob("*.exr"))
    lit = list[bool]()
    monkeypatch.setattr(
        light_color, "find_light", lambda capture: lit.append(capture.data.any()) or find_light(capture)
    )
    assert run(*plain, "--white-level", str(WHITE)) == 0
    assert lit and all(lit)  # nor of the lamp
    write_folder(tmp_path / "dark", images[:1].repeat(2, axis=0))
    assert run("video", str(tmp_path / "dark"), "-o", str(tmp_path / "dark-out"), "--no-preview") == 0


def test_remarks_on_later_frames_are_kept(tmp_path: Path) -> None:
    images = frames(3)
    images[1, : SIDE // 2] = WHITE
    folder = write_folder(tmp_path / "run", images)
    assert run(*command(folder, tmp_path / "out", "--format", "none")) == 0
    lines = [json.loads(line) for line in (tmp_path / "out" / "run.jsonl").read_text().splitlines()]
    said = [any("overexposed" in text for text in line.get("warnings", [])) for line in lines]
    assert said == [False, True, False]


def test_remarks_that_differ_in_numbers_count_as_one(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "run", frames(4))
    level = str(int(frames(4).max()) - 40)
    words = ("video", str(folder), "-o", str(tmp_path / "out"), "--method", "analytic", "--filter", "none")
    assert run(*words, "--white-level", level, "--format", "none") == 0
    found = json.loads((tmp_path / "out" / "run.json").read_text())["warnings"]
    (count,) = [often for text, often in found.items() if "samples exceed the white level" in text]
    assert count > 1


def test_angles_of_a_film_are_averaged_around_the_circle() -> None:
    """The mean of 179 and 1 degree is 0, not 90; of 44 and 46 it is 45."""
    first = first_frame.FirstFrame("joint", (1.0,), 1.0, (1, 1, 1), (2, 2), ())
    for angles, mean in (((179.0, 1.0), 0.0), ((44.0, 46.0), 45.0)):
        lines = [{"frame": k, "specular_aolp_deg": t, "light_polarizer_deg": 180 - t} for k, t in enumerate(angles)]
        report = shared_report(first, lines)
        assert report is not None
        for name, expected in (("specular_aolp_deg", mean), ("light_polarizer_deg", -mean)):
            assert (report["statistics"][name] - expected + 90) % 180 == pytest.approx(90)


def test_frames_without_light_say_nothing_of_its_angle() -> None:
    """A film of which most frames are black had an angle near their 0 degrees."""
    first = first_frame.FirstFrame("joint", (1.0,), 1.0, (1, 1, 1), (2, 2), ())
    seen = {"mean_s0": 0.4, "specular_fraction": 0.1, "specular_aolp_concentration": 0.9}
    angles = {"specular_aolp_deg": 60.0, "light_polarizer_deg": 120.0}
    black = {name: 0.0 for name in (*seen, *angles)}
    lines = [{"frame": k, **(seen | angles if k == 0 else black)} for k in range(5)]
    for some, expected in ((lines, angles), (lines[1:], {name: 0.0 for name in angles})):
        report = shared_report(first, some)
        assert report is not None
        assert {name: report["statistics"][name] for name in angles} == pytest.approx(expected)


def test_the_lamp_of_a_film_is_found_in_frames_put_right(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the black level that a frame shows, as separate finds it."""
    seen = list[float]()

    def checked(mosaic: Any) -> Any:
        return CheckedMosaic(replace(mosaic, black_level=7.0), {"black_level": 7.0}, ())

    def found(capture: Any) -> Any:
        seen.append(capture.black_level)
        return find_light(capture)

    monkeypatch.setattr(light_color, "check_mosaic", checked)
    monkeypatch.setattr(light_color, "find_light", found)
    first_frame.separate_first(open_sequence(recording, ReadOptions(white_level=WHITE)), video.VideoOptions("analytic"))
    assert seen and set(seen) == {7.0}


@pytest.mark.parametrize("size", [(22, 2048), (30, 2400), (6, 1300), (2, 4000), (1300, 6)])
def test_panels_of_low_and_narrow_frames_hold_nothing_else(size: tuple[int, int]) -> None:
    """The panel of a black image is black, and an even one is even: nothing from beyond the images is read."""
    even, black = np.full((*size, 3), 0.25, np.float32), np.zeros((*size, 3), np.float32)
    drawn = panels.draw_panels(even, black, 1.0)
    width = drawn.shape[1] // 3
    assert (drawn[:, 2 * width :] == 0).all()
    assert (drawn[:, : 2 * width] == drawn[0, 0]).all() and drawn[0, 0].min() > 0


def test_a_lamp_off_frame_is_no_frame_of_the_recording(tmp_path: Path) -> None:
    """It would come first, so the lamp's colour and the exposure would be those of its noise."""
    folder = write_folder(tmp_path / "run", frames(3))
    (folder / "off.png").write_bytes(imagecodecs.png_encode(frames(1)[0] // 16))
    given = command(folder, tmp_path / "out", "--no-preview", "--ambient")
    (tmp_path / "link").symlink_to(folder)
    read = with_corrections(ReadOptions(white_level=WHITE), None, [folder / "off.png"])
    target = video.Target(tmp_path / "out", kept=(tmp_path / "link" / "off.png",))
    with pytest.raises(InputError, match=r"off.png: expected a lamp-off frame apart from .* one of its frames"):
        next(video.separate_video(folder, read, video.VideoOptions("analytic"), target))
    assert run(*given, str(folder / "off.png")) == 2
    (folder / "off.png").rename(tmp_path / "off.png")
    assert run(*given, str(tmp_path / "off.png")) == 0


def test_a_calibration_is_not_replaced_by_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, rig = write_folder(tmp_path / "rig", frames(2)), tmp_path / "rig.json"
    write_calibration(rig, Calibration(Layout(), float(WHITE), (SIDE, SIDE), black_level=0.0, read_noise=1.0), "0")
    before = rig.read_bytes()
    words = ("--calibration", str(rig), "--overwrite", "--method", "analytic", "--no-preview")
    assert run("video", str(folder), "-o", str(tmp_path), *words) == 2
    assert "is an input" in capsys.readouterr().err and rig.read_bytes() == before


def test_results_of_other_commands_are_not_replaced_unasked(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Single frames and logs without a report of a recording beside them; a run that was stopped goes on."""
    for name in (f"{recording.stem}_000002.exr", f"{recording.stem}.jsonl"):
        folder = tmp_path / Path(name).suffix[1:]
        folder.mkdir()
        (folder / name).write_bytes(b"mine")
        assert run(*command(recording, folder, "--frames", "3")) == 2
        assert f"expected no {folder / name}" in capsys.readouterr().err
        assert contents(folder) == {name: b"mine"}
        assert run(*command(recording, folder, "--frames", "3", "--overwrite")) == 0


def test_what_is_there_is_not_replaced_unasked(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = ("--frames", "3", "--format", "none")
    assert run(*command(recording, tmp_path, *short)) == 0
    before = contents(tmp_path)
    assert run(*command(recording, tmp_path, *short)) == 2
    assert "--overwrite replaces it" in capsys.readouterr().err
    assert contents(tmp_path) == before
    assert run(*command(recording, tmp_path, *short, "--overwrite")) == 0
    assert contents(tmp_path) == before


def test_a_run_that_replaces_a_longer_one_leaves_none_of_its_frames(recording: Path, tmp_path: Path) -> None:
    """And touches nothing else."""
    others = {name: b"mine" for name in ("other_000004.exr", f"{recording.stem}_4.exr", f"{recording.stem}_000004.txt")}
    for name, data in others.items():
        (tmp_path / name).write_bytes(data)
    assert run(*command(recording, tmp_path, "--frames", "5")) == 0
    assert run(*command(recording, tmp_path, "--frames", "3", "--overwrite")) == 0
    left = sorted(path.name for path in tmp_path.glob("*_00*.exr"))
    assert left == sorted([*(f"{recording.stem}_{k:06d}.exr" for k in range(3)), "other_000004.exr"])
    assert {name: (tmp_path / name).read_bytes() for name in others} == others


def test_a_run_that_replaces_another_is_resumed_like_any(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without --overwrite, which begins anew; the report of before is gone with the first of its frames."""
    recording, out = tmp_path / "run.npy", tmp_path / "out"
    np.save(recording, frames())
    more = ("--no-preview", "--method", "color-affine", "--frames", str(PART + 5))
    assert run(*command(recording, out, "--no-preview")) == 0
    before = {path.name for path in out.iterdir()}
    with monkeypatch.context() as patch:
        patch.setattr(video, "write_pictures", partial(stopped_behind, video.write_pictures, PART + 2))
        assert run(*command(recording, out, *more, "--overwrite")) == 130
    assert {path.name for path in out.glob("run*")} == before - {"run.json"}
    first = (out / "run_000000.exr").stat().st_mtime_ns
    assert run(*command(recording, out, *more)) == 0
    assert (out / "run_000000.exr").stat().st_mtime_ns == first
    assert len(list(out.glob("*.exr"))) == json.loads((out / "run.json").read_text())["frames"] == PART + 5


def stopped_behind(write: Any, count: int, *given: Any) -> Iterator[video.Progress]:
    """`write_pictures`, until Ctrl-C."""
    for step in write(*given):
        yield step
        if step.done == count:
            raise KeyboardInterrupt


def test_a_run_that_replaces_films_leaves_none_of_another_kind(recording: Path, tmp_path: Path) -> None:
    few = command(recording, tmp_path, "--frames", "3", "--overwrite")
    kinds = {"ffv1": ["_diffuse.mkv", "_specular.mkv"], "ffvhuff": ["_diffuse.avi", "_specular.avi"], "exr": []}
    for kind, expected in kinds.items():
        assert run(*few, "--format", kind) == 0
        found = {path.name.removeprefix(recording.stem) for path in tmp_path.glob("*.*") if path.suffix[1:2] in "am"}
        assert found == {*expected, "_preview.mp4"}
    assert run(*few, "--no-preview") == 0
    assert not list(tmp_path.glob("*.mp4"))


def test_a_run_does_not_go_on_with_other_settings(recording: Path, tmp_path: Path) -> None:
    def steps(method: str, count: int | None = None) -> Iterator[video.Progress]:
        options = video.VideoOptions(method, frames=count)
        return video.separate_video(recording, ReadOptions(white_level=WHITE), options, video.Target(tmp_path))

    begun = steps("analytic")
    while next(begun).done < PART + 1:
        pass
    begun.close()  # type: ignore[attr-defined]  # a generator
    words = r"expected method analytic, with which .* was begun, found method color-affine; --overwrite begins anew"
    with pytest.raises(OutputError, match=words):
        next(steps("color-affine"))
    with pytest.raises(OutputError, match=r"expected frames not said, with which .* was begun, found frames 40; "):
        next(steps("analytic", 40))
    *_, end = steps("analytic")
    assert end.done == FRAMES and end.written


def test_a_run_does_not_go_on_with_another_recording_of_its_name(tmp_path: Path) -> None:
    """Also where everything that its first frame fixes is the same; a frame behind may be repaired."""
    images, path = frames(PART + 3), tmp_path / "run.npy"
    others = [images.copy(), images.copy()]
    others[0][0, SIDE - 3, SIDE - 3] ^= 1
    others[1][-1] ^= 1

    def steps(samples: NDArray[np.uint16]) -> Iterator[video.Progress]:
        np.save(path, samples)
        target = video.Target(tmp_path / "out", SequenceKind(preview=False))
        return video.separate_video(path, ReadOptions(white_level=WHITE), video.VideoOptions("analytic"), target)

    begun = steps(images)
    while next(begun).done < PART + 1:
        pass
    begun.close()  # type: ignore[attr-defined]  # a generator
    with pytest.raises(OutputError, match=r"expected first_frame_sha256 \w+, .*found first_frame_sha256 \w+"):
        next(steps(others[0]))
    *_, end = steps(others[1])
    assert end.done == PART + 3 and end.written


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: (p / "run").mkdir(), "expected a folder of frames"),
        (lambda p: [(p / "run").mkdir(), (p / "run/a.png").touch(), (p / "run/b.tiff").touch()], "1 .png, 1 .tiff"),
        (lambda p: None, "found nothing at this path"),
        (lambda p: [(p / "run").mkdir(), (p / "run/a.png").touch()], "expected a frame that can be read, found"),
    ],
    ids=["empty", "mixed", "missing", "unreadable"],
)
def test_what_is_no_recording_is_said_in_a_line(
    make: Any, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make(tmp_path)
    assert run(*command(tmp_path / "run" if words[0] != "f" else tmp_path / "run.npy", tmp_path / "o")) == 2
    said = capsys.readouterr()
    assert said.err.count("\n") == 1 and words in said.err
    assert not (tmp_path / "o").exists()


def test_damage_is_said_in_words_alone(tmp_path: Path) -> None:
    """Neither by FFmpeg's numbers, nor with the name of the file twice."""
    (tmp_path / "run.mkv").touch()
    with pytest.raises(InputError, match="found damage: Invalid data found") as error:
        open_sequence(tmp_path / "run.mkv", ReadOptions())
    assert str(error.value).count("run.mkv") == 1


def test_a_stream_that_is_cut_short_says_what_there_is(tmp_path: Path) -> None:
    """Not read to its last whole frame: a wrong size has a rest, too."""
    (tmp_path / "run.raw").write_bytes(bytes(2 * 64 + 7))
    with pytest.raises(InputError, match=r"found 135 bytes, 2 frames and 7 bytes: .* head -c 128 takes the whole ones"):
        open_sequence(tmp_path / "run.raw", ReadOptions(size=(8, 8), pixel_format="Mono8"))


@pytest.mark.parametrize(("codec", "pixels"), [("libx264", "yuv420p"), ("mjpeg", "yuvj420p"), ("ffv1", "bgr0")])
def test_films_that_hold_no_mosaic_are_refused(codec: str, pixels: str, tmp_path: Path) -> None:
    path = write_film(tmp_path / "run.mkv", frames(2), codec, pixels)
    with pytest.raises(ValueError, match=r"run.mkv: expected a mosaic as grey samples, found pixels"):
        open_sequence(path, ReadOptions())


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ({"format": "gif"}, "expected a format of exr, ffv1, ffvhuff, none, found 'gif'"),
        ({"compression": "rar"}, "expected a compression of none, zip, piz, found 'rar'"),
        ({"compression": "zip", "format": "ffv1"}, "expected the format exr for compression zip, found ffv1"),
        ({"rate": 0.0}, "expected a rate of 0.001 to 100000 frames per second, found 0"),
        ({"format": "ffv1", "rate": 1001.0}, "expected a rate of at most 1000 frames per second in ffv1, found 1001"),
        (
            {"format": "ffvhuff", "rate": 1001.0},
            "expected a rate of at most 1000 frames per second in ffvhuff, found 1001",
        ),
        ({"format": "none", "preview": False}, "expected something to write"),
    ],
)
def test_kinds_that_are_not_are_refused(kind: dict[str, Any], words: str) -> None:
    with pytest.raises(OutputError, match=words):
        SequenceKind(**kind)


def test_without_the_library_films_are_refused_before_any_work(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    for asked in ("--preview", "--format=ffv1", "--format=ffvhuff"):
        assert run(*command(recording, tmp_path / "o", asked)) == 2
        said = capsys.readouterr().err
        assert "expected the extra 'video'" in said and said.count("\n") == 1
        assert not (tmp_path / "o").exists()
    assert run(*command(recording, tmp_path / "o", "--frames", "1")) == 0
    assert "no video to watch is written: it needs the extra 'video'" in capsys.readouterr().err
    assert not list((tmp_path / "o").glob("*.mp4"))


@pytest.mark.usefixtures("compiled")
def test_ray_makes_the_same_bytes_with_a_worker_killed(recording: Path, steady: Path, tmp_path: Path) -> None:
    """The cluster of one machine loses a worker in the middle of its work."""
    pytest.importorskip("ray", reason="needs the extra 'ray'")
    program = with_dying_worker(video.separate_one, tmp_path / "died")
    arguments = command(recording, tmp_path / "out", *STEADY, "--engine", "ray")
    subprocess.run([*program, *arguments], stdout=subprocess.DEVNULL, timeout=300, check=True)
    assert (tmp_path / "died").exists()
    assert contents(tmp_path / "out") == contents(steady)


def test_what_stands_still_is_steady(tmp_path: Path) -> None:
    """Noise of a still scene falls as frames are averaged, by both filters; across parts too."""
    still = frames(1)[0].astype(np.float64)
    noise = np.random.default_rng(2).normal(0, 20, (FRAMES, SIDE, SIDE))
    np.save(tmp_path / "run.npy", np.clip(still + noise, 0, 4000).round().astype(np.uint16))
    spread = {}
    for name in ("none", "temporal"):
        more = ("--filter", name, "--no-preview")
        assert run(*command(tmp_path / "run.npy", tmp_path / name, *more)) == 0
        late = [read_exr_layers(tmp_path / name / f"run_{k:06d}.exr")["diffuse.G"] for k in range(PART - 3, PART + 9)]
        spread[name] = float(np.std(np.stack(late).astype(np.float64), axis=0).mean())
    assert spread["temporal"] < 0.2 * spread["none"]
