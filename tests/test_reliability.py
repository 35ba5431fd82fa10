"""Hostile files: refused in one line that names them, quickly, in little memory, and in silence."""

from __future__ import annotations

import io
import json
import os
import struct
import sys
import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from test_bad_input import CODES, npy_header, npz, png, tiff, zipped

import polsep
from polsep.edit.files import read_recipe
from polsep.edit.parameters import EditError
from polsep.edit.recipe import recipe_from_text
from polsep.io.assets.maps import read_map
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.results import exr_header
from polsep.io.results.exr import encode_exr, read_exr_layers
from polsep.io.store.calibrations import read_calibration, write_calibration
from polsep.io.store.errors import MOST, InputError, input_error, one_line
from polsep.io.store.header_checks import LIMITS, PAGES, SAMPLES
from polsep.io.store.json_text import parse_json
from polsep.io.store.quiet import quiet
from polsep.io.store.weights import read_weights
from polsep.methods import METHODS
from polsep.pipeline import separate_capture
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Layout
from polsep.sensor.levels import MAX_RATIO, SPANS, as_mosaic

#: Damaged inputs of each reader.
INPUTS = 200
#: Seconds that refusing a hostile file may take on a busy machine; decoding it would take much longer.
SOON = 60.0


@pytest.fixture(autouse=True)
def silence(capfd: pytest.CaptureFixture[str]) -> Iterator[None]:
    """Nothing is printed, on any stream, by polsep or by a library."""
    yield
    assert capfd.readouterr() == ("", "")


def assert_refused(path: Path, read: Callable[[Path], Any]) -> str:
    """The message with which a file is refused, in time."""
    start = time.monotonic()
    with pytest.raises(ValueError, match=r"expected|must hold") as caught:
        read(path)
    assert time.monotonic() - start < SOON
    text = str(caught.value)
    assert text.isprintable() and len(text) <= MOST and path.name in text, text
    return text


def assert_frames_refused(path: Path, data: bytes) -> str:
    """The message with which frames are refused."""
    path.write_bytes(data)
    return assert_refused(path, lambda path: list(read_frames(path)))


# Random damage.

damage_seeds = pytest.importorskip("evaluation.damage_seeds", reason="needs the extra 'video'")


@pytest.mark.parametrize("name", list(damage_seeds.READERS))
def test_damaged_files_are_read_or_refused(tmp_path: Path, name: str) -> None:
    """The short form of `make fuzz`: the same damage in every run."""
    from evaluation.reliability import damaged_files, judge, write_files

    reader, outcomes, seeds = damage_seeds.READERS[name], set(), damage_seeds.seeds_of(name)
    assert all(seeds.count(seed) == 1 for seed in seeds)
    for seed in seeds:
        assert judge(write_files(tmp_path / "whole", seed), reader)[:2] == ("accepted", ())
    for index in range(INPUTS):
        found = judge(write_files(tmp_path / str(index), damaged_files(name, index)), reader)
        assert found.faults == () and found.outcome, (index, found)
        outcomes.add(found.outcome)
    assert "refused" in outcomes


def test_faults_are_seen(tmp_path: Path) -> None:
    """What the harness counts: each kind of fault, of readers that have it."""
    from evaluation.reliability import judge

    def fails(error: Exception) -> damage_seeds.Reader:
        def read(path: Path) -> Iterator[Any]:
            raise error
            yield

        return damage_seeds.Reader(list, read)

    path = tmp_path / "shot.png"
    assert judge(path, fails(ValueError("expected shot.png, found none")))[:2] == ("refused", ())
    assert judge(path, fails(ValueError("expected another, found none"))).faults == ("bad messages",)
    assert judge(path, fails(ValueError("shot.png: " + "x" * 300))).faults == ("bad messages",)
    assert judge(path, fails(ValueError("shot.png:\nfound none"))).faults == ("bad messages",)
    assert judge(path, fails(TypeError("reshape"))).faults == ("stray exceptions",)
    assert judge(path, fails(MemoryError())).faults == ("over memory",)
    infinite = damage_seeds.Reader(list, lambda path: iter([np.array([np.inf])]))
    assert judge(path, infinite).faults == ("values not finite",)


# Messages.


def test_messages_are_one_printable_line_of_few_characters() -> None:
    """Long texts lose their middle, whatever a terminal would obey is escaped, and the end of a long path stays."""
    assert one_line(" two\n lines ") == "two lines"
    assert one_line("\x1b[2J\ud800") == "\\x1b[2J\\ud800"
    cut = one_line("expected a short one, " + "x" * 10_000 + ", found a long one")
    assert len(cut) == MOST and cut.startswith("expected a short one") and cut.endswith(", found a long one")
    for length in (10, 250, 10_000):
        text = str(input_error(Path("a" * length) / "shot.png", "expected this, found " + "y" * 5000))
        assert len(text) == MOST and "shot.png: expected this, found y" in text


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("names.npz", npz(**{"x" * 5000: CODES, "y" * 5000: CODES})),
        ("member.npz", zipped(**{"x" * 5000: b"no array"})),
        ("shape.npy", npy_header("{'descr': '<u2', 'fortran_order': False, 'shape': (" + "1, " * 2500 + ")}")),
        ("merged.tiff", tiff(description='{"format": "polsep merged mosaic 1", "layout": "' + "x" * 9000 + '"}')),
        ("recording.json", json.dumps({"format": "x" * 9000}).encode()),
        ("recording.json", b'{"format": "polsep recording 1", "width": "' + b"x" * 9000 + b'", "height": 4}'),
    ],
)
def test_messages_do_not_repeat_the_file(tmp_path: Path, name: str, data: bytes) -> None:
    assert_frames_refused(tmp_path / name, data)


# JSON.


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[NaN]", "found NaN"),
        ("[-Infinity]", "found -Infinity"),
        ("[1e999]", "found 1e999"),
        ("[" * 100_000, "levels"),
        ("1" * 5000, "digits, found 5000"),
        ("{", "Expecting"),
    ],
)
def test_json_is_strict(text: str, found: str) -> None:
    with pytest.raises(ValueError, match=found) as caught:
        parse_json(text)
    assert len(str(caught.value)) < MOST


@pytest.mark.parametrize(
    ("field", "value"),
    [("width", "1e999"), ("width", "1" * 30), ("height", "-4"), ("width", "[" * 5000), ("width", "8.5")],
)
def test_recordings_of_absurd_sizes_are_refused(tmp_path: Path, field: str, value: str) -> None:
    entries = {"format": '"polsep recording 1"', "width": "16", "height": "8", "pixel_format": '"Mono8"', field: value}
    (tmp_path / "frames.raw").write_bytes(bytes(128))
    (tmp_path / "frames.jsonl").write_bytes(b"")
    text = "{" + ", ".join(f'"{name}": {entry}' for name, entry in entries.items()) + "}"
    assert_frames_refused(tmp_path / "recording.json", text.encode())


@pytest.mark.parametrize(
    "line", ['{"index": 1e999}', '{"index": 0, "crc32": "x"}', '{"index": 0, "away_s": [1]}', "[" * 5000]
)
def test_absurd_lines_of_an_index_are_refused(tmp_path: Path, line: str) -> None:
    record = {"format": "polsep recording 1", "width": 16, "height": 8, "pixel_format": "Mono8"}
    (tmp_path / "frames.raw").write_bytes(bytes(128))
    (tmp_path / "frames.jsonl").write_text(line + "\n")
    assert "frames.jsonl" in assert_frames_refused(tmp_path / "recording.json", json.dumps(record).encode())


def test_recipes_that_are_no_text_or_too_deep_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "recipe.json"
    for data, found in ((b"\x80abc", "found byte 0x80 at 0"), (b"[" * 100_000, "levels")):
        path.write_bytes(data)
        assert found in assert_refused(path, read_recipe)


def test_many_keys_of_a_recipe_cost_little() -> None:
    """Time grows with the number of keys, not with its square."""
    start = time.monotonic()
    text = json.dumps({f"key{k}": 0 for k in range(50_000)})
    with pytest.raises(EditError, match="found no such key among 'key0'"):
        recipe_from_text(text)
    with pytest.raises(EditError, match="found 'key0' again"):
        recipe_from_text(text[:-1] + ', "key0": 1}')
    assert time.monotonic() - start < SOON


# OpenEXR.


def exr(changes: dict[int, int] | None = None, compression: str = "zip") -> bytes:
    """A small EXR; ``changes``: words of dataWindow by their number."""
    data = bytearray(encode_exr({name: np.ones((8, 8), np.float32) for name in "RGB"}, {}, compression))
    at = data.find(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    for word, value in (changes or {}).items():
        struct.pack_into("<i", data, at + 4 * word, value)
    return bytes(data)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({3: 2**31 - 1}, "at most"),
        ({3: 10_000_000}, "at most"),
        ({2: 2**30}, "at most"),
        ({3: 1_000_000}, "chunks"),
        ({2: -5}, "at least one pixel"),
    ],
)
def test_exr_headers_that_promise_too_much(tmp_path: Path, changes: dict[int, int], found: str) -> None:
    path = tmp_path / "shot.exr"
    path.write_bytes(exr(changes))
    assert found in assert_refused(path, read_exr_layers)


def test_exr_headers_that_are_no_text_or_half_resolution(tmp_path: Path) -> None:
    path, data = tmp_path / "shot.exr", exr()
    path.write_bytes(data.replace(b"B\0", b"\x80\0", 1))
    assert "not UTF-8" in assert_refused(path, read_exr_layers)
    at = data.find(b"chlist\0") + len("chlist\0") + 4
    path.write_bytes(data[: at + 2 + 8] + struct.pack("<2i", 0, 0) + data[at + 2 + 16 :])
    assert "whole pixels in channel B" in assert_refused(path, read_exr_layers)


@pytest.mark.parametrize("compression", ["zip", "piz"])
def test_damaged_pixels_of_exr_are_refused_in_silence(tmp_path: Path, compression: str) -> None:
    ramp = np.arange(200 * 200, dtype=np.float32).reshape(200, 200) ** 0.5
    data = bytearray(encode_exr({"Y": ramp}, {}, compression))
    *_, (_, _, end) = exr_header._attributes(bytes(data))
    (chunk,) = struct.unpack_from("<Q", data, end + 1)
    data[chunk + 8 : chunk + 48] = b"\xff" * 40
    path = tmp_path / "shot.exr"
    path.write_bytes(data)
    assert "complete single-part EXR" in assert_refused(path, read_exr_layers)


def test_only_the_library_is_silenced(capfd: pytest.CaptureFixture[str]) -> None:
    """What other threads print, and lines without the mark, arrive."""
    with quiet(b"library:"):
        other = threading.Thread(target=lambda: print("from a thread"))
        other.start()
        other.join()
        print("from the library")
        os.write(2, b"library: warning\nfrom others\n")
    print("after")
    sys.stdout.flush()
    assert capfd.readouterr() == ("from a thread\nafter\n", "from others\n")


# TIFF.


def chain(count: int, back_to: int | None = None) -> bytes:
    """A BigTIFF of ``count`` empty directories; the last leads on to the one of number ``back_to``."""
    places = [16 + 16 * k for k in range(count)]
    following = [*places[1:], 0 if back_to is None else places[back_to]]
    return b"II+\0" + struct.pack("<HHQ", 8, 0, 16) + b"".join(struct.pack("<QQ", 0, place) for place in following)


def with_tag(code: int, count: int, value: int | None = None) -> bytes:
    """The TIFF of `CODES` in tiles, with the number of values of an entry and its value overwritten."""
    data = bytearray(tiff(compression="zlib", tile=(16, 16), metadata=None))
    with tifffile.TiffFile(io.BytesIO(bytes(data))) as tif:
        entry = tif.pages.first.tags[code]
        struct.pack_into("<I", data, entry.offset + 4, count)
        if value is not None:
            struct.pack_into({3: "<H", 4: "<I"}[int(entry.dtype)], data, entry.offset + 8, value)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (chain(300, 250), "a way back"),
        (chain(2, 0), "a way back"),
        (chain(LIMITS[PAGES] + 1), f"at most {LIMITS[PAGES]} pictures in a TIFF, found {LIMITS[PAGES] + 1} ({PAGES}"),
        (with_tag(324, 2**30), "within"),
        (with_tag(322, 1, 65520) + bytes(9), "about the picture's size"),
        (with_tag(323, 1, 2**31), "at most"),
        (tiff(compression="jpegxl"), "JPEG XL"),
        (tiff(description="ImageJ=1.54\nimages=5\n"), "found one for 5 pictures"),
    ],
    ids=["loop", "short loop", "pages", "offsets", "wide tiles", "tall tiles", "codec", "ImageJ"],
)
def test_tiff_directories_that_promise_too_much(tmp_path: Path, data: bytes, found: str) -> None:
    assert found in assert_frames_refused(tmp_path / "shot.tiff", data)


def test_exif_of_much_more_than_the_file_is_refused(tmp_path: Path) -> None:
    """Hundreds of entries that all stand for the same bytes would be as many copies of them."""
    data = tiff(description="x" * 100_000, extratags=[(65001, 4, 1, 0, True)], metadata=None)
    data = data.replace(struct.pack("<HHII", 65001, 4, 1, 0), struct.pack("<HHII", 34665, 4, 1, len(data)))
    entries = b"".join(struct.pack("<HHII", 1000 + k, 7, 100_000, 8) for k in range(900))
    found = assert_frames_refused(tmp_path / "shot.tiff", data + struct.pack("<H", 900) + entries + bytes(4))
    assert "share no bytes" in found
    stack = tiff(extratags=[(33628, 4, 2, (0, 0), True)], metadata=None)
    assert "stack of MetaMorph" in assert_frames_refused(tmp_path / "stack.tiff", stack)


@pytest.mark.parametrize("compression", ["png", "jpeg2000", "lerc"])
def test_chunks_of_tiff_that_hold_larger_pictures(tmp_path: Path, compression: str) -> None:
    """Their decoders would make room for the chunk's own size."""
    large = tiff(np.zeros((640, 640), np.uint16), compression=compression, rowsperstrip=640, metadata=None)
    data = bytearray(large)
    with tifffile.TiffFile(io.BytesIO(large)) as tif:
        tags = tif.pages.first.tags
        for code, side in ((256, 64), (257, 48), (278, 48)):
            struct.pack_into({3: "<H", 4: "<I"}[int(tags[code].dtype)], data, tags[code].valueoffset, side)
    assert "chunk of at most 48x64x1 as the TIFF says, found 640x640x1" in assert_frames_refused(
        tmp_path / "a.tiff", bytes(data)
    )


@pytest.mark.parametrize(("compression", "form", "place"), [("jpeg2000", ">H", 40), ("lerc", "<i", 22)])
def test_chunks_of_tiff_with_more_samples(tmp_path: Path, compression: str, form: str, place: int) -> None:
    """So would thousands of samples per pixel."""
    data = bytearray(tiff(compression=compression, metadata=None))
    with tifffile.TiffFile(io.BytesIO(data)) as tif:
        start = tif.pages.first.dataoffsets[0]
    assert struct.unpack_from(form, data, start + place) == (1,)
    struct.pack_into(form, data, start + place, 9000)
    assert "x9000" in assert_frames_refused(tmp_path / "a.tiff", bytes(data))


def test_more_pictures_and_samples_can_be_allowed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "shot.tiff"
    path.write_bytes(tiff(np.stack([CODES] * 3), photometric="minisblack"))
    assert len(list(read_frames(path))) == 3
    monkeypatch.setenv(PAGES, "2")
    assert f"at most 2 pictures in a TIFF, found 3 ({PAGES} sets" in assert_refused(
        path, lambda path: list(read_frames(path))
    )
    monkeypatch.setenv(PAGES, "3")
    assert len(list(read_frames(path))) == 3
    monkeypatch.setenv(SAMPLES, str(CODES.size - 1))
    assert f"at most {CODES.size - 1} samples" in assert_refused(path, lambda path: list(read_frames(path)))
    monkeypatch.setenv(SAMPLES, "many")
    assert f"a whole number as {SAMPLES}, found 'many'" in assert_refused(path, lambda path: list(read_frames(path)))


# Archives, PNG, films, weights, calibrations, maps.


def test_archives_that_unpack_to_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        body = io.BytesIO()
        np.save(body, np.zeros((64, 64, 64), np.uint16))
        archive.writestr("raw.npy", body.getvalue())
    monkeypatch.setenv(SAMPLES, "60000")
    assert "bytes in raw.npy" in assert_frames_refused(tmp_path / "shot.npz", stream.getvalue())


def test_png_with_more_bytes_than_samples_is_read_in_silence(tmp_path: Path) -> None:
    """libpng warns; the samples are complete, and have their checksum."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in CODES)
    path = tmp_path / "shot.png"
    path.write_bytes(png(idat=zlib.compress(rows + b"more")))
    (frame,) = read_frames(path)
    assert np.array_equal(np.asarray(frame.data.data), CODES)


@pytest.mark.parametrize("suffix", [".avi", ".mov", ".mkv"])
def test_films_of_unknown_codecs_are_refused(tmp_path: Path, suffix: str) -> None:
    films = [seed for seed in damage_seeds.video_seeds() if f"shot{suffix}" in seed]
    data = films[0][f"shot{suffix}"]
    for codec in (b"FFV1", b"V_FFV1", b"png ", b"MPNG", b"V_MS/VFW"):
        data = data.replace(codec, b"ZZZZZZZZ"[: len(codec)])
    assert_frames_refused(tmp_path / f"shot{suffix}", data)


@pytest.mark.parametrize("text", ["#EXTM3U\n#EXTINF:1,\nother.avi\n", "ffconcat version 1.0\nfile other.avi\n"])
def test_lists_of_other_files_are_no_films(tmp_path: Path, text: str) -> None:
    """FFmpeg would open what they name."""
    (seed,) = [seed for seed in damage_seeds.video_seeds() if "shot.avi" in seed][:1]
    (tmp_path / "other.avi").write_bytes(seed["shot.avi"])
    assert_frames_refused(tmp_path / "list.mkv", text.encode())


@pytest.mark.parametrize(
    "shape", ["[1099511627776, 0]", "[0, 18446744073709551615]", "[-1, 0]", "[4, 0, 9223372036854775807]"]
)
def test_weights_of_absurd_shapes_are_refused(tmp_path: Path, shape: str) -> None:
    array = f'{{"dtype": "F16", "shape": {shape}, "data_offsets": [0, 0]}}'
    text = f'{{"__metadata__": {{"method": "joint", "sha256": "0"}}, "a": {array}}}'.encode()
    path = tmp_path / "net.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text)
    assert_refused(path, read_weights)


def test_weights_with_a_long_header_are_refused_in_few_words(tmp_path: Path) -> None:
    text = json.dumps({"__metadata__": {"method": "joint", "sha256": "x" * 9000}}).encode()
    path = tmp_path / "net.safetensors"
    path.write_bytes(struct.pack("<Q", len(text)) + text)
    assert_refused(path, read_weights)


ONES = tuple((1.0,) * 4 for _ in range(4))


@pytest.mark.parametrize(
    ("section", "name", "value"),
    [
        ("flat", "gains", [[0.0] * 4] * 4),
        ("flat", "falloff_legendre", [[0.1, 1.0], [0.0, 0.0]]),
        ("flat", "falloff_legendre", [[1.0]] * 500),
        ("dark", "black_level_codes", 1e30),
        ("dark", "black_pattern_codes", [[1e30] * 4] * 4),
        (None, "white_level_codes", 0),
        (None, "layout", "0,180,45,90/RGGB"),
    ],
)
def test_calibrations_that_would_divide_by_zero_are_refused(
    tmp_path: Path, section: str | None, name: str, value: object
) -> None:
    path = tmp_path / "cal.json"
    whole = Calibration(
        Layout(), 4095.0, black_level=60.0, black_pattern=ONES, read_noise=2.0, gains=ONES, falloff=((0.9, 0.1),)
    )
    write_calibration(path, whole, "0.1")
    read_calibration(path)
    record = json.loads(path.read_text())
    (record if section is None else record[section])[name] = value
    path.write_text(json.dumps(record))
    assert_refused(path, read_calibration)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_normals_that_are_no_vectors_are_refused(tmp_path: Path, value: float) -> None:
    path = tmp_path / "normals.npy"
    np.save(path, np.full((4, 4, 3), value, np.float32))
    assert "about unit length" in assert_refused(path, lambda path: read_map(path, "normals"))


# Levels.


def ramp(scale: float, kind: type = np.float64) -> Any:
    return (np.random.default_rng(0).random((32, 32)) * scale).astype(kind)


@pytest.mark.parametrize(
    ("samples", "black", "white", "found"),
    [
        (ramp(1e20), 0.0, None, "within 1e+06 times the white level"),
        (ramp(1e38, np.float32), 0.0, None, "within 1e+06 times the white level"),
        (ramp(-1e30), 0.0, None, "within 1e+06 times the white level"),
        (ramp(1e38, np.float32), 0.0, 1e38, "white level well above"),
        (ramp(0), 0.0, 1e-300, "white level well above"),
        (ramp(9), 4095.0, float(np.nextafter(4095, 9999)), "white level well above"),
        (ramp(255, np.uint8), 0.0, 1e-5, "times the white level"),
        *((ramp(scale, np.float32), 0.0, 1.0, "times the white level") for scale in (1e20, 1e25, 1e30, 1e35, 3e38)),
        *((ramp(1e20), 0.0, white, "white level well above") for white in (1e20, 1e30, 1e38, 1e300)),
        (ramp(1), 0.0, 1e-300, "white level well above"),
        (ramp(1), 1.0, float(np.nextafter(np.float32(1), np.float32(2))), "white level well above"),
        (ramp(1), 0.0, float("nan"), "white level"),
        (ramp(1), float("inf"), 1.0, "expected"),
    ],
)
def test_levels_beyond_single_precision_are_refused(
    samples: Any, black: float, white: float | None, found: str
) -> None:
    with pytest.raises(ValueError, match=found.replace("+", r"\+")):
        polsep.separate(samples, method="analytic", black_level=black, white_level=white)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("layout", ["color", "mono"])
@pytest.mark.parametrize("name", list(METHODS))
def test_images_and_reports_are_finite_at_the_limits(name: str, layout: str, full: bool) -> None:
    """With the widest levels, and samples as far beyond as allowed, for which the paper's networks are too narrow."""
    one = ramp(1)
    one[5, 7] = MAX_RATIO
    for samples, white in ((ramp(SPANS[1]), SPANS[1]), (ramp(SPANS[0]), SPANS[0]), (ramp(MAX_RATIO), 1.0), (one, 1.0)):
        mosaic = as_mosaic(samples, layout, 0.0, white)[0]
        if not METHODS[name].accepts(mosaic):
            pytest.skip("no weights for these colours")
        if name == "paper" and np.median(samples) > white:
            with pytest.raises(ValueError, match="expected finite images of paper"):
                separate_capture(mosaic, name, full=full)
            continue
        found = separate_capture(mosaic, name, full=full)
        json.dumps(found.report, allow_nan=False)
        images = (found.diffuse, found.specular, found.dolp, found.aolp)
        assert all(np.isfinite(image).all() for image in images)


def test_options_cannot_describe_what_is_not(tmp_path: Path) -> None:
    """A name of a pixel format of any length costs little and is not repeated."""
    path = tmp_path / "shot.raw"
    path.write_bytes(bytes(64))
    text = assert_refused(
        path, lambda path: list(read_frames(path, ReadOptions(size=(8, 8), pixel_format="Mono" * 20_000)))
    )
    assert isinstance(input_error(path, text), InputError)
