"""Outputs: what each format holds, and that a frame is written whole or not at all."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import numpy.testing as npt
import OpenEXR
import pytest
import tifffile

from polsep.compute.threads import own_threads
from polsep.io.results import separation_writer
from polsep.io.results.exr import encode_exr, read_exr_layers
from polsep.io.results.separation_writer import FORMATS, UNITS, planned_outputs, write_separation
from polsep.io.store.atomic import OutputError
from polsep.io.store.errors import InputError
from polsep.separation.report import SeparatedFrame

LAYERS = ("diffuse", "specular", "dolp", "aolp", "valid")


def random_frame(channels: int = 3, size: tuple[int, int] = (37, 53)) -> SeparatedFrame:
    rng = np.random.default_rng(3)
    return SeparatedFrame(
        rng.random((*size, channels), np.float32),
        3 * rng.random((*size, channels), np.float32),
        rng.random(size) > 0.2,
        1.1 * rng.random(size, np.float32),
        np.minimum(np.pi * rng.random(size, np.float32), np.float32(3.14159)),
        {"source": "shot.raw", "method": "analytic"},
    )


def frame_with_errors(channels: int = 3) -> SeparatedFrame:
    """`random_frame` with an expected error of two channels."""
    error = np.random.default_rng(4).random((37, 53, 2), np.float32)
    return replace(random_frame(channels), error=0.1 * error)


def contents(directory: Path) -> dict[str, bytes]:
    """Every file below a directory, hidden ones too."""
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def sidecar(directory: Path, stem: str = "shot") -> dict[str, Any]:
    return json.loads((directory / f"{stem}.json").read_text())


@pytest.mark.parametrize("channels", [3, 1])
def test_exr_round_trip_is_exact_with_the_promised_layer_names(tmp_path: Path, channels: int) -> None:
    frame = random_frame(channels)
    write_separation(frame, tmp_path, "shot")
    layers = read_exr_layers(tmp_path / "shot.exr")
    colors = "RGB" if channels == 3 else "Y"
    expected = {f"diffuse.{c}": frame.diffuse[..., k] for k, c in enumerate(colors)}
    expected |= {f"specular.{c}": frame.specular[..., k] for k, c in enumerate(colors)}
    expected |= {"dolp.Y": frame.dolp, "aolp.Y": frame.aolp, "valid.Y": frame.valid.astype(np.float32)}
    assert set(layers) == set(expected) | set(colors)
    for name, plane in expected.items():
        assert layers[name].dtype == np.float32
        npt.assert_array_equal(layers[name], plane)


def test_exr_is_one_zip_part_that_states_units_and_version(tmp_path: Path) -> None:
    write_separation(random_frame(), tmp_path, "shot")
    file = OpenEXR.File(str(tmp_path / "shot.exr"), header_only=True)
    header = file.header()
    assert len(file.parts) == 1
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    assert "radians" in header["aolpUnits"]
    assert {layer: header[f"{layer}Units"] for layer in LAYERS} == {layer: UNITS[layer] for layer in LAYERS}
    assert "errorUnits" not in header
    assert header["polsepVersion"] == sidecar(tmp_path)["polsep"]


def test_openimageio_reads_every_channel_and_what_the_header_says(tmp_path: Path) -> None:
    """The library under Blender, Houdini and other programs."""
    oiio = pytest.importorskip("OpenImageIO", reason="not installed: make optional")
    frame = replace(random_frame(), stokes=np.random.default_rng(1).random((3, 37, 53, 3), np.float32))
    facts = {"method": "analytic", "white_level": 4095.0, "light_color": [0.5, 1, 0.7], "exposure_s": 0.25}
    facts |= {"layout": "90,45,135,0/RGGB", "captured": "2026-05-04T12:13:14+00:00"}
    path = write_separation(replace(frame, report=facts), tmp_path, "shot")[0]
    file = oiio.ImageInput.open(str(path))
    spec, pixels = file.spec(), file.read_image("float")
    file.close()
    planes = dict(zip(spec.channelnames, np.moveaxis(pixels, -1, 0), strict=True))
    for name in ("diffuse", "specular"):
        npt.assert_array_equal(np.stack([planes[f"{name}.{c}"] for c in "RGB"], axis=-1), getattr(frame, name))
    npt.assert_allclose(np.stack([planes[c] for c in "RGB"], axis=-1), frame.diffuse + frame.specular, rtol=1e-3)
    npt.assert_allclose(np.stack([planes[f"S1.{c}"] for c in "RGB"], axis=-1), frame.stokes[1], atol=1e-3)
    said = {name: spec.getattribute(f"polsep{name}") for name in ("Method", "WhiteLevel", "LightColor", "Layout")}
    assert said == {"Method": "analytic", "WhiteLevel": 4095, "LightColor": "0.5,1,0.7", "Layout": facts["layout"]}
    assert (spec.getattribute("ExposureTime"), spec.getattribute("DateTime")) == (0.25, "2026:05:04 12:13:14")


def test_exr_does_not_depend_on_threads() -> None:
    """Any number of threads makes the same bytes, and so do several writers at once."""
    plane = np.random.default_rng(0).random((200, 300), np.float32)
    planes = {"a.Y": plane, "b.Y": np.round(plane, 1)}

    def encode(threads: int) -> bytes:
        with own_threads(threads):
            return bytes(encode_exr(planes, {"note": "x"}))

    with ThreadPoolExecutor(4) as pool:
        assert len({*pool.map(encode, (1, 2, 3, 7) * 4), encode(1)}) == 1


FORKING = """
import os, threading, warnings
import numpy as np
from polsep.compute.threads import set_threads
from polsep.io.results.exr import encode_exr

warnings.simplefilter("ignore")
set_threads(3)
planes, ended = {"a.Y": np.random.default_rng(0).random((200, 300), np.float32)}, threading.Event()

def work():
    while not ended.is_set():
        encode_exr(planes, {})

writer = threading.Thread(target=work)
writer.start()
for _ in range(20):
    child = os.fork()
    if child == 0:
        encode_exr(planes, {})
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
ended.set()
writer.join()
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_child_forked_while_an_exr_is_written_writes_its_own() -> None:
    """It has none of the threads of OpenEXR that its parent's writer uses."""
    assert subprocess.run([sys.executable, "-c", FORKING], check=False, timeout=120).returncode == 0


@pytest.mark.parametrize("turn", [lambda a: a.swapaxes(0, 1), lambda a: a[::-1, ::2]])
def test_exr_of_views_that_are_not_contiguous(tmp_path: Path, turn: Callable[[np.ndarray], np.ndarray]) -> None:
    whole = random_frame()
    frame = replace(whole, **{layer: turn(getattr(whole, layer)) for layer in LAYERS})
    write_separation(frame, tmp_path, "shot")
    layers = read_exr_layers(tmp_path / "shot.exr")
    npt.assert_array_equal(layers["specular.G"], frame.specular[..., 1])
    npt.assert_array_equal(layers["aolp.Y"], frame.aolp)


@pytest.mark.parametrize("channels", [3, 1])
def test_npz_round_trip_is_exact(tmp_path: Path, channels: int) -> None:
    frame = random_frame(channels)
    write_separation(frame, tmp_path, "shot", "npz")
    with np.load(tmp_path / "shot.npz", allow_pickle=False) as arrays:
        assert sorted(arrays) == sorted(LAYERS)
        for layer in LAYERS:
            npt.assert_array_equal(arrays[layer], getattr(frame, layer), strict=True)


@pytest.mark.parametrize("channels", [3, 1])
def test_tiff_round_trip_is_exact(tmp_path: Path, channels: int) -> None:
    frame = random_frame(channels)
    write_separation(frame, tmp_path, "shot", "tiff")
    for layer in ("diffuse", "specular", "dolp", "aolp"):
        expected = getattr(frame, layer)
        expected = expected[..., 0] if expected.ndim == 3 and channels == 1 else expected
        with tifffile.TiffFile(tmp_path / f"shot_{layer}.tiff") as file:
            assert file.pages[0].description == f"{layer}: {UNITS[layer]}"
            npt.assert_array_equal(file.asarray(), expected, strict=True)
    valid = np.where(frame.valid, np.uint8(255), np.uint8(0))
    npt.assert_array_equal(tifffile.imread(tmp_path / "shot_valid.tiff"), valid, strict=True)


def read_png(path: Path, bits: int) -> np.ndarray:
    codes = imagecodecs.png_decode(path.read_bytes())
    assert codes.dtype == (np.uint16 if bits == 16 else np.uint8)
    return codes


@pytest.mark.parametrize("channels", [3, 1])
def test_png_holds_the_values_within_half_a_code_up_to_its_stated_limits(tmp_path: Path, channels: int) -> None:
    frame = random_frame(channels)
    write_separation(frame, tmp_path, "shot", "png")
    for layer, white in (("diffuse", 2.0), ("specular", 2.0), ("dolp", 1.0)):
        expected = np.clip(getattr(frame, layer), 0, white).astype(np.float64)
        codes = read_png(tmp_path / f"shot_{layer}.png", 16).reshape(expected.shape)
        npt.assert_allclose(codes * (white / 65535), expected, rtol=0, atol=0.5001 * white / 65535)
    aolp = read_png(tmp_path / "shot_aolp.png", 16) * (np.pi / 65536)
    error = (aolp - frame.aolp + np.pi / 2) % np.pi - np.pi / 2
    npt.assert_allclose(error, 0, atol=0.5001 * np.pi / 65536)
    npt.assert_array_equal(read_png(tmp_path / "shot_valid.png", 8), np.where(frame.valid, 255, 0))


def test_png_codes_at_the_ends_of_each_scale(tmp_path: Path) -> None:
    frame = random_frame(1, (1, 4))
    frame.specular[0, :, 0] = (0, 1, 2, 5)
    frame.dolp[0] = (0, 1, 0.5, 1.2)
    frame.aolp[0] = (0, np.pi / 2, np.nextafter(np.float32(np.pi), np.float32(0)), np.pi / 4)
    write_separation(frame, tmp_path, "shot", "png")
    npt.assert_array_equal(read_png(tmp_path / "shot_specular.png", 16), [[0, 32768, 65535, 65535]])
    npt.assert_array_equal(read_png(tmp_path / "shot_dolp.png", 16), [[0, 65535, 32768, 65535]])
    npt.assert_array_equal(read_png(tmp_path / "shot_aolp.png", 16), [[0, 32768, 0, 16384]])
    assert sidecar(tmp_path)["limited_samples"]["specular"] == {"below": 0, "above": 1}
    assert sidecar(tmp_path)["limited_samples"]["dolp"] == {"below": 0, "above": 1}


def test_limited_samples_are_counted_in_the_sidecar_and_only_png_limits(tmp_path: Path) -> None:
    frame = random_frame()
    frame.diffuse[0, 0] = (-0.25, 0.5, 0.5)
    write_separation(frame, tmp_path / "png", "shot", "png")
    limited = sidecar(tmp_path / "png")["limited_samples"]
    assert limited["diffuse"] == {"below": 1, "above": 0}
    assert limited["specular"] == {"below": 0, "above": np.count_nonzero(frame.specular > 2)}
    assert limited["dolp"] == {"below": 0, "above": np.count_nonzero(frame.dolp > 1)}
    assert limited["specular"]["above"] > 0
    write_separation(frame, tmp_path / "exr", "shot")
    assert "limited_samples" not in sidecar(tmp_path / "exr")


@pytest.mark.parametrize("format", FORMATS)
def test_sidecar_states_version_source_report_units_and_a_sha256_of_every_other_file(
    tmp_path: Path, format: str
) -> None:
    frame = random_frame()
    written = write_separation(frame, tmp_path, "shot", format)
    said = sidecar(tmp_path)
    assert said["source"] == "shot.raw"
    assert said["report"] == frame.report
    assert said["format"] == format
    assert said["shape"] == [37, 53, 3]
    assert set(said["units"]) == set(LAYERS)
    assert ("65535 = 2.0" in said["units"]["specular"]) == (format == "png")
    assert isinstance(said["polsep"], str)
    assert [f["name"] for f in said["files"]] == [p.name for p in written[:-1]]
    for entry, path in zip(said["files"], written[:-1], strict=True):
        data = path.read_bytes()
        assert entry == {"name": path.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


@pytest.mark.parametrize("format", FORMATS)
def test_exactly_the_planned_files_appear_in_new_directories(tmp_path: Path, format: str) -> None:
    directory = tmp_path / "a" / "b"
    planned = planned_outputs(directory, "shot", format)
    assert write_separation(frame_with_errors(), directory, "shot", format) == planned
    assert sorted(p for p in tmp_path.rglob("*") if not p.is_dir()) == sorted(planned)
    assert sorted(p.name for p in directory.iterdir()) == sorted(p.name for p in planned)
    without = [path for path in planned if path.name != f"shot_error.{format}"]
    assert len(planned) - len(without) == (1 if format in ("tiff", "png") else 0)
    assert write_separation(random_frame(), directory, "shot", format, overwrite=True) == without
    assert sorted(p for p in tmp_path.rglob("*") if not p.is_dir()) == sorted(without)


@pytest.mark.parametrize("format", ["tiff", "png"])
@pytest.mark.parametrize("frame", [random_frame(), frame_with_errors()], ids=["without", "with"])
def test_an_error_image_from_before_is_refused_and_never_stays_beside_other_images(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str, frame: SeparatedFrame
) -> None:
    """Also where the frame has no error; and it is back when anything fails, at whichever step."""
    directory = tmp_path / "out"
    write_separation(frame_with_errors(1), directory, "shot", format)
    before = contents(directory)
    alone = tmp_path / "alone" / f"shot_error.{format}"
    alone.parent.mkdir()
    alone.write_bytes(b"mine")
    with pytest.raises(OutputError, match=rf"shot_error\.{format}, found one from before; --overwrite"):
        write_separation(frame, alone.parent, "shot", format)
    assert contents(alone.parent) == {alone.name: b"mine"}
    steps = len(before) - (1 if frame.error is None else 0)  # put in place
    for calls in range(steps):
        with monkeypatch.context() as failing:
            fail_at_replace(failing, calls, OSError(5, "Input/output error"))
            with pytest.raises(OutputError, match="Input/output"):
                write_separation(frame, directory, "shot", format, overwrite=True)
        assert contents(directory) == before
    write_separation(frame, directory, "shot", format, overwrite=True)
    write_separation(frame, tmp_path / "fresh", "shot", format)
    assert contents(directory) == contents(tmp_path / "fresh")


@pytest.mark.parametrize("channels", [3, 1])
def test_expected_errors_survive_every_format(tmp_path: Path, channels: int) -> None:
    """Exactly, two channels, diffuse first, and in PNG within half a code; the sidecar says so."""
    frame = frame_with_errors(channels)
    assert frame.error is not None
    frame.error[0, 0] = (3, 2)
    for format in FORMATS:
        write_separation(frame, tmp_path, "shot", format, overwrite=True)
        said = sidecar(tmp_path)
        assert set(said["units"]) == {*LAYERS, "error"}
        limited = said.get("limited_samples", {"error": None})
        assert limited["error"] == ({"below": 0, "above": 1} if format == "png" else None)
    layers = read_exr_layers(tmp_path / "shot.exr")
    assert OpenEXR.File(str(tmp_path / "shot.exr"), header_only=True).header()["errorUnits"] == UNITS["error"]
    npt.assert_array_equal(layers["error.diffuse"], frame.error[..., 0])
    npt.assert_array_equal(layers["error.specular"], frame.error[..., 1])
    with np.load(tmp_path / "shot.npz", allow_pickle=False) as arrays:
        assert sorted(arrays) == sorted([*LAYERS, "error"])
        npt.assert_array_equal(arrays["error"], frame.error, strict=True)
    with tifffile.TiffFile(tmp_path / "shot_error.tiff") as file:
        assert file.pages[0].description == f"error: {UNITS['error']}"
        npt.assert_array_equal(file.asarray(), frame.error, strict=True)
    codes = read_png(tmp_path / "shot_error.png", 16)
    expected = np.minimum(frame.error, 2).astype(np.float64)
    npt.assert_allclose(codes[..., :2] * (2 / 65535), expected, rtol=0, atol=0.5001 * 2 / 65535)
    assert codes.shape == (37, 53, 3) and int(codes[..., 2].max()) == 0


def test_planned_names_are_the_public_contract() -> None:
    names = {f: [p.name for p in planned_outputs(Path("d"), "s", f)] for f in FORMATS}
    assert names["exr"] == ["s.exr", "s.png", "s.json"]
    assert names["npz"] == ["s.npz", "s.png", "s.json"]
    for format in ("tiff", "png"):
        assert names[format] == [f"s_{layer}.{format}" for layer in (*LAYERS, "error")] + ["s.png", "s.json"]


def test_writing_twice_gives_the_same_bytes_and_needs_overwrite(tmp_path: Path) -> None:
    for format in FORMATS:
        directory = tmp_path / format
        write_separation(random_frame(), directory, "shot", format)
        before = contents(directory)
        with pytest.raises(OutputError, match="--overwrite"):
            write_separation(random_frame(), directory, "shot", format)
        write_separation(random_frame(), directory, "shot", format, overwrite=True)
        assert contents(directory) == before


def test_an_existing_output_is_refused_by_name_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "shot.png").write_text("a picture of mine")
    monkeypatch.setattr(separation_writer, "_write_exr", lambda frame, stream: pytest.fail("worked before looking"))
    with pytest.raises(OutputError, match=r"shot\.png.*--overwrite"):
        write_separation(random_frame(), tmp_path, "shot")
    assert contents(tmp_path) == {"shot.png": b"a picture of mine"}


def test_files_of_other_stems_and_formats_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "shot.npz").write_text("old")
    (tmp_path / "other.exr").write_text("other")
    write_separation(random_frame(), tmp_path, "shot", overwrite=True)
    assert (tmp_path / "shot.npz").read_text() == "old"
    assert (tmp_path / "other.exr").read_text() == "other"


@pytest.mark.parametrize("stem", ["", ".", "..", "a/b", "../a", "a\\b", "a\0b"])
def test_stems_that_lead_elsewhere_are_refused(tmp_path: Path, stem: str) -> None:
    with pytest.raises(OutputError, match="stem"):
        write_separation(random_frame(), tmp_path, stem)
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="expected a format of exr, npz, tiff, png, found 'jpg'"):
        write_separation(random_frame(), tmp_path, "shot", "jpg")


@pytest.mark.parametrize("below", [".", "deeper/still"])
def test_a_directory_that_is_a_file_is_refused_by_name(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError, match=r"expected a directory.*found a file.*file"):
        write_separation(random_frame(), tmp_path / "file" / below, "shot")
    with pytest.raises(OutputError, match=r"expected a directory to write into, found the name of a file: .*new\.exr"):
        write_separation(random_frame(), tmp_path / "new.exr", "shot")
    assert contents(tmp_path) == {"file": b"x"}


def test_no_preview_replaces_a_raw_frame(tmp_path: Path) -> None:
    """Results beside their frame have a preview of its name: what was recorded is kept, also with overwrite."""
    raw = imagecodecs.png_encode(np.arange(64, dtype=np.uint16).reshape(8, 8))
    (tmp_path / "shot.png").write_bytes(raw)
    with pytest.raises(OutputError, match=r"expected a preview of before to replace, found a grey PNG, .*shot\.png"):
        write_separation(random_frame(), tmp_path, "shot", overwrite=True)
    assert contents(tmp_path) == {"shot.png": raw}


def test_a_directory_in_the_place_of_an_output_is_refused_even_with_overwrite(tmp_path: Path) -> None:
    (tmp_path / "shot.exr").mkdir()
    (tmp_path / "shot.exr" / "precious").write_text("x")
    with pytest.raises(OutputError, match="found a directory"):
        write_separation(random_frame(), tmp_path, "shot", overwrite=True)
    assert contents(tmp_path) == {"shot.exr/precious": b"x"}


def test_a_directory_that_cannot_be_written_gives_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: object) -> str:
        raise PermissionError(13, "Permission denied", str(tmp_path))

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    with pytest.raises(OutputError, match=r"^expected to write 'shot' into .* found PermissionError: .*denied.*$"):
        write_separation(random_frame(), tmp_path / "new" / "er", "shot")
    assert list(tmp_path.iterdir()) == []


def test_a_name_too_long_for_the_file_system_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="OSError"):
        write_separation(random_frame(), tmp_path, "x" * 300)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"valid": np.ones((37, 53), np.uint8)}, "valid as bool"),
        ({"diffuse": np.zeros((37, 53, 2), np.float32)}, r"diffuse as float32 \[37, 53, 1\], found .*37, 53, 2"),
        ({"specular": np.zeros((37, 53, 1), np.float32)}, r"specular as float32 \[37, 53, 3\]"),
        ({"dolp": np.zeros((37, 53))}, "dolp as float32.*float64"),
        ({"aolp": np.full((37, 53), np.nan, np.float32)}, "finite values in aolp, found 1961"),
        ({"error": np.zeros((37, 53), np.float32)}, r"error as float32 \[37, 53, 2\], found float32 \[37, 53\]"),
        ({"error": np.full((37, 53, 2), np.inf, np.float32)}, "finite values in error, found 3922"),
        ({"error": np.full((37, 53, 2), -0.5, np.float32)}, "deviations of 0 or more in error, found -0.5"),
        ({"report": {"x": {1}}}, "set"),
        ({"report": {"x": float("nan")}}, "JSON"),
    ],
)
def test_a_frame_that_breaks_its_contract_writes_nothing(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(OutputError, match=message):
        write_separation(replace(random_frame(), **change), tmp_path / "new", "shot")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", FORMATS)
def test_a_failing_encoder_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, format: str) -> None:
    def fail(frame: object) -> np.ndarray:
        raise RuntimeError("out of\npaint")

    monkeypatch.setattr(separation_writer, "contact_sheet", fail)  # the last image of every format
    with pytest.raises(OutputError, match="RuntimeError: out of paint") as caught:
        write_separation(random_frame(), tmp_path / "new", "shot", format)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def fail_at_replace(monkeypatch: pytest.MonkeyPatch, calls: int, error: BaseException) -> None:
    """Let `os.replace` work ``calls`` times, fail once, then work again."""
    real, count = os.replace, [0]

    def replace_or_fail(source: Path, target: Path) -> None:
        count[0] += 1
        if count[0] == calls + 1:
            raise error
        real(source, target)

    monkeypatch.setattr(os, "replace", replace_or_fail)


def refuse_links(*paths: Path, **options: bool) -> None:
    raise PermissionError(1, "Operation not permitted")


@pytest.mark.parametrize("calls", range(3))
def test_a_failing_rename_takes_back_the_files_already_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: int
) -> None:
    fail_at_replace(monkeypatch, calls, OSError(28, "No space left on device"))
    with pytest.raises(OutputError, match="No space left"):
        write_separation(random_frame(), tmp_path, "shot")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("calls", "links"), [*((calls, True) for calls in range(3)), *((calls, False) for calls in range(6))]
)
def test_a_failing_overwrite_restores_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: int, links: bool
) -> None:
    """On file systems with and without second names."""
    if not links:
        monkeypatch.setattr(os, "link", refuse_links)
    old = {"shot.exr": b"old exr", "shot.png": b"old png", "shot.json": b"old json"}
    for name, data in old.items():
        (tmp_path / name).write_bytes(data)
    fail_at_replace(monkeypatch, calls, OSError(5, "Input/output error"))
    with pytest.raises(OutputError, match="Input/output"):
        write_separation(random_frame(), tmp_path, "shot", overwrite=True)
    assert contents(tmp_path) == old
    assert len(list(tmp_path.iterdir())) == 3


def test_an_interrupt_cleans_up_and_stays_an_interrupt(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_at_replace(monkeypatch, 1, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        write_separation(random_frame(), tmp_path / "new", "shot")
    assert list(tmp_path.iterdir()) == []


INTERRUPTED = """
import signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_outputs import random_frame, write_separation
from polsep.io.store import atomic
move = atomic._move_into_place
def interrupted(*arguments):
    signal.raise_signal(signal.SIGINT)
    if "fail" in sys.argv:
        raise OSError("no room")
    move(*arguments)
atomic._move_into_place = interrupted
if "default" in sys.argv:
    signal.signal(signal.SIGINT, signal.SIG_DFL)
before = signal.getsignal(signal.SIGINT)
try:
    write_separation(random_frame(), Path(sys.argv[2]), "shot")
except KeyboardInterrupt:
    print("interrupted", signal.getsignal(signal.SIGINT) is before)
"""


def test_an_interrupt_waits_until_a_frame_is_written(tmp_path: Path) -> None:
    """Ctrl-C while files are moved: they are all there, nothing else is, and then it interrupts.

    In a program of its own, as signals are a whole program's.
    """
    run = run_interrupted(tmp_path)
    assert run.stdout.split() == ["interrupted", "True"], run.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"shot.exr", "shot.png", "shot.json"}


def test_an_interrupt_ends_a_program_that_leaves_it_to_the_system(tmp_path: Path) -> None:
    assert run_interrupted(tmp_path, "default").returncode == -signal.SIGINT
    assert {path.name for path in tmp_path.iterdir()} == {"shot.exr", "shot.png", "shot.json"}


def test_an_interrupt_is_not_lost_when_writing_fails(tmp_path: Path) -> None:
    assert run_interrupted(tmp_path, "fail").stdout.split() == ["interrupted", "True"]
    assert list(tmp_path.iterdir()) == []


def run_interrupted(folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    """`INTERRUPTED`, to its end."""
    program = [sys.executable, "-c", INTERRUPTED, str(Path(__file__).parent), str(folder), *more]
    return subprocess.run(program, capture_output=True, text=True, timeout=60)


def test_a_short_write_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.open

    @contextmanager
    def losing(path: Path, mode: str) -> Iterator[Any]:
        with real(path, mode) as stream:
            yield stream
        os.truncate(path, path.stat().st_size - 1)

    monkeypatch.setattr(Path, "open", losing)
    with pytest.raises(OutputError, match=r"expected \d+ bytes, found \d+: .*shot\.exr"):
        write_separation(random_frame(), tmp_path, "shot")
    assert list(tmp_path.iterdir()) == []


LIMITED = """
import resource, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_outputs import FORMATS, OutputError, random_frame, write_separation
root, frame = Path(sys.argv[2]), random_frame()
for format in FORMATS:
    whole = root / format
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    sizes = sorted({path.stat().st_size for path in write_separation(frame, whole, "shot", format)})
    for limit in (0, 100, *(size - 1 for size in sizes)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        try:
            write_separation(frame, root / "limited", "shot", format)
        except OutputError as error:
            print(format, limit, error, (root / "limited").exists())
        else:
            print(format, limit, "written")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_files_that_do_not_fit_leave_nothing_in_every_format(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "error", "-c", LIMITED, str(Path(__file__).parent), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    lines = done.stdout.splitlines()
    assert done.stderr == ""
    assert len(lines) == sum(2 + (3 if format in ("exr", "npz") else 7) for format in FORMATS)
    for line in lines:
        assert "File too large" in line
        assert line.endswith("False")


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.5, 0.99])
def test_reading_a_short_exr_is_refused(tmp_path: Path, kept: float, capfd: pytest.CaptureFixture[str]) -> None:
    write_separation(random_frame(), tmp_path, "shot")
    data = (tmp_path / "shot.exr").read_bytes()
    (tmp_path / "short.exr").write_bytes(data[: int(kept * len(data))])
    with pytest.raises(InputError, match=r"short\.exr: expected an? (complete single-part EXR|OpenEXR)"):
        read_exr_layers(tmp_path / "short.exr")
    capfd.readouterr()  # OpenEXR warns on the terminal by itself
