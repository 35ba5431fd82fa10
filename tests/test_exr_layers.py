"""EXR files in other programs: all light as R, G, B, Stokes images, and what headers say of the capture."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.testing as npt
import OpenEXR
import pytest
import torch
from test_capture import HEADER, HEIGHT, WIDTH
from test_outputs import random_frame

from polsep import cli, read_frames
from polsep.batch import WriteOptions
from polsep.demosaic.guided import guide_once
from polsep.demosaic.measured_stokes import measured_stokes
from polsep.io.raw.frames import ReadOptions
from polsep.io.raw.recording import RECORD, RawImage, RecordingWriter
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_reader import read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.results.sequences import SequenceKind
from polsep.physics.stokes import Measurements, Stokes, dolp, fit_stokes, measure
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic, sample_mosaic
from polsep.video.recordings import Target, VideoOptions, separate_video

COLOR, MONO = Layout(), Layout(bayer=None)
#: Relative rounding of half floats.
HALF = 2.0**-11
ROUNDED = 1e-5
LIGHT = (0.7, 1.0, 0.8)


def header(path: Path) -> dict:
    return OpenEXR.File(str(path), header_only=True).header()


def random_mosaic(layout: Layout, shape: tuple[int, int] = (64, 88)) -> Mosaic:
    raw = np.random.default_rng(5).integers(100, 4000, shape, np.uint16)
    return Mosaic(raw, layout, 64.0, 4095.0)


@pytest.mark.parametrize("layout", [COLOR, MONO, Layout(((0, 135), (45, 90)), "BGGR")], ids=lambda x: x.spec)
@pytest.mark.parametrize("full", [False, True])
def test_stokes_images_of_an_even_polarized_field_are_exact_to_the_border(layout: Layout, full: bool) -> None:
    colors = layout.channels
    vector = np.array([(0.9, 0.6, 0.3), (0.2, -0.1, 0.1), (-0.3, 0.2, 0.05)], np.float32)[:, :colors]
    field = Stokes(*(np.broadcast_to(s[:, None, None], (colors, 40, 60)) for s in vector))
    mosaic = Mosaic(sample_mosaic(measure(field, layout.angles), layout), layout, 0.0, 1.0)
    found = measured_stokes(mosaic, LIGHT[:colors], full)
    assert found.shape == (3, *((40, 60) if full else (20, 30)), colors) and found.dtype == np.float32
    npt.assert_allclose(found, np.broadcast_to(vector[:, None, None], found.shape), atol=ROUNDED)


def test_color_mosaics_have_the_guided_stokes_images_in_the_light() -> None:
    mosaic, gains = random_mosaic(COLOR), np.array(LIGHT, np.float32)
    guided, _ = guide_once(replace(mosaic, light_color=LIGHT))
    expected = np.stack([np.moveaxis(s, 0, -1) * gains for s in (guided.s0, guided.s1, guided.s2)])
    npt.assert_allclose(measured_stokes(mosaic, LIGHT), expected, atol=ROUNDED)
    moved = replace(mosaic, data=torch.from_numpy(mosaic.data))
    npt.assert_array_equal(measured_stokes(moved, LIGHT), measured_stokes(mosaic, LIGHT))


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_angle_images_are_taken_as_they_are(kind: type) -> None:
    samples = np.random.default_rng(6).random((4, 3, 8, 10), np.float32)
    capture = Measurements(kind(samples), COLOR.angles)
    expected = fit_stokes(Measurements(samples, COLOR.angles))
    found = measured_stokes(capture, LIGHT)
    for k, image in enumerate((expected.s0, expected.s1, expected.s2)):
        npt.assert_allclose(found[k], np.moveaxis(image, 0, -1), atol=ROUNDED)


@pytest.mark.parametrize("full", [False, True])
def test_stokes_images_have_the_polarization_of_the_formula(full: bool) -> None:
    """`analytic` on a mono frame is the bilinear Stokes images and nothing else."""
    result = separate_capture(random_mosaic(MONO), "analytic", full=full).with_stokes()
    assert result.stokes is not None
    npt.assert_allclose(result.stokes[0], result.diffuse + result.specular, atol=ROUNDED)
    s0, s1, s2 = result.stokes
    npt.assert_allclose(dolp(Stokes(s0, s1, s2))[..., 0].clip(max=2), result.dolp, atol=1e-4)


@pytest.mark.parametrize(("channels", "names"), [(3, "RGB"), (1, "Y")])
def test_programs_without_layers_see_all_light(tmp_path: Path, channels: int, names: str) -> None:
    frame = random_frame(channels)
    frame.specular[0, 0] = 1e6
    write_separation(frame, tmp_path, "shot")
    layers = read_exr_layers(tmp_path / "shot.exr")
    for k, name in enumerate(names):
        total = np.minimum(frame.diffuse[..., k] + frame.specular[..., k], 65504)
        npt.assert_allclose(layers[name], total, rtol=HALF)
        npt.assert_array_equal(layers[f"diffuse.{name}"], frame.diffuse[..., k])


@pytest.mark.parametrize(("layout", "names"), [(COLOR, "RGB"), (MONO, "Y")])
def test_stokes_layers_are_written_on_request_and_readers_pass_over_them(
    tmp_path: Path, layout: Layout, names: str
) -> None:
    result = separate_capture(random_mosaic(layout), "analytic")
    result.save(tmp_path / "without.exr")
    result.save(tmp_path / "with.exr", stokes=True)
    before, after = (read_exr_layers(tmp_path / f"{name}.exr") for name in ("without", "with"))
    added = {f"S{k}.{name}": k for k in range(3) for name in names}
    assert set(after) == set(before) | set(added) and not set(before) & set(added)
    stokes = result.with_stokes().stokes
    assert stokes is not None
    for name, k in added.items():
        npt.assert_allclose(after[name], stokes[k, ..., names.index(name[-1])], rtol=HALF, atol=1e-7)
    read = read_separated(tmp_path / "with.exr")
    npt.assert_array_equal(read.diffuse, result.diffuse)
    npt.assert_array_equal(read.dolp, result.dolp)
    assert "m45 - m135" in json.loads((tmp_path / "with.json").read_text())["units"]["S2"]


def test_stokes_images_need_exr_files_and_a_capture(tmp_path: Path) -> None:
    result = separate_capture(random_mosaic(COLOR), "analytic")
    for format in ("npz", "tiff", "png"):
        with pytest.raises(ValueError, match=f"expected the format exr for Stokes images, found {format}"):
            result.save(tmp_path / f"shot.{format}", stokes=True)
        with pytest.raises(ValueError, match=f"expected the format exr for Stokes images, found {format}"):
            WriteOptions(tmp_path, format, stokes=True)
    with pytest.raises(ValueError, match="expected a frame with its capture"):
        replace(result, capture=None).with_stokes()
    assert not list(tmp_path.iterdir())


def test_headers_tell_how_a_frame_was_made(tmp_path: Path) -> None:
    result = separate_capture(random_mosaic(COLOR), "analytic", (0.5, 1, 0.75))
    result.report.update(exposure_s=0.02, captured="2026-03-01T12:30:05.250+02:00")
    result.save(tmp_path / "shot.exr")
    attributes = header(tmp_path / "shot.exr")
    assert (attributes["polsepMethod"], attributes["polsepLayout"], attributes["polsepLightColor"]) == (
        "analytic",
        "90,45,135,0/RGGB",
        "0.5,1,0.75",
    )
    assert (attributes["polsepBlackLevel"], attributes["polsepWhiteLevel"]) == (64, 4095)
    assert attributes["expTime"] == pytest.approx(0.02)
    assert (attributes["capDate"], attributes["utcOffset"]) == ("2026:03:01 10:30:05", 0)
    four = separate_capture(Measurements(np.full((4, 3, 8, 8), 0.2, np.float32), COLOR.angles), "analytic")
    four.save(tmp_path / "four.exr")
    assert not {"polsepWhiteLevel", "expTime", "capDate"} & set(header(tmp_path / "four.exr"))


def recording(folder: Path, count: int, began: str | None) -> Path:
    """Frames 40 ms apart, of 2 ms."""
    writer = RecordingWriter(folder, replace(HEADER, settings={"exposure_us": 2000.0}))
    payload = np.random.default_rng(1).integers(0, 255, HEADER.frame_bytes, np.uint8).tobytes()
    for k in range(count):
        writer.append(RawImage(payload, k, 5_000_000 + 40_000_000 * k))
    writer.note({} if began is None else {"began": began}, finished=True)
    writer.close()
    return folder


@pytest.mark.parametrize("began", ["2026-03-01T23:59:59.980+00:00", "yesterday", "2026-03-01T23:59:59", 7, None])
def test_frames_of_recordings_know_when_they_were_taken(tmp_path: Path, began: str | None) -> None:
    folder = recording(tmp_path / "take", 2, began)
    first, second = read_frames(folder / RECORD)
    known = began is not None and "+" in str(began)
    assert first.captured == ("2026-03-01T23:59:59.980+00:00" if known else None)
    assert second.captured == ("2026-03-02T00:00:00.020+00:00" if known else None)
    assert first.exposure == 0.002
    (late,) = read_frames(folder / RECORD, ReadOptions(), 1)
    assert late.captured == second.captured


def test_frames_of_videos_have_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = recording(tmp_path / "take", 2, "2026-03-01T23:59:59.980+00:00")
    words = ["polsep", "video", str(folder), "-o", str(tmp_path / "out"), "--method", "analytic", "--no-preview"]
    monkeypatch.setattr(sys, "argv", [*words, "--stokes", "--filter", "none"])
    cli.main()
    with pytest.raises(ValueError, match="expected the format exr for Stokes images, found ffvhuff"):
        next(
            separate_video(folder, ReadOptions(), VideoOptions(stokes=True), Target(tmp_path, SequenceKind("ffvhuff")))
        )
    attributes, layers = (
        header(tmp_path / "out" / "take_000001.exr"),
        read_exr_layers(tmp_path / "out" / "take_000001.exr"),
    )
    assert attributes["polsepMethod"] == "analytic" and attributes["capDate"] == "2026:03:02 00:00:00"
    assert attributes["expTime"] == pytest.approx(0.002)
    (second,) = read_frames(folder / RECORD, ReadOptions(), 1)
    light = tuple(json.loads((tmp_path / "out" / "take.json").read_text())["settings"]["light_color"])
    stokes = measured_stokes(second.data, light)
    for k, color in enumerate("RGB"):
        npt.assert_allclose(layers[color], layers[f"diffuse.{color}"] + layers[f"specular.{color}"], rtol=2 * HALF)
        for n in range(3):
            npt.assert_allclose(layers[f"S{n}.{color}"], stokes[n, ..., k], rtol=HALF, atol=1e-3)
    assert layers["R"].shape == (HEIGHT // 2, WIDTH // 2)


@pytest.mark.parametrize(
    ("window", "shown"),
    [
        ((2, 1, 7, 4), (0, 0, 11, 7)),
        ((-3, -2, 14, 9), (0, 0, 11, 7)),
        ((2, 1, 7, 4), (4, 3, 9, 6)),
        ((2, 1, 7, 4),) * 2,
    ],
)
def test_pixels_of_a_data_window_are_at_their_places_of_the_display_window(
    tmp_path: Path, window: tuple[int, ...], shown: tuple[int, ...]
) -> None:
    ys, xs = np.mgrid[window[1] : window[3] + 1, window[0] : window[2] + 1]
    corners = {
        name: (np.array(box[:2], np.int32), np.array(box[2:], np.int32))
        for name, box in (("dataWindow", window), ("displayWindow", shown))
    }
    header = {**corners, "compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"Y": (100 + 10 * ys + xs).astype(np.float32)}).write(str(tmp_path / "cut.exr"))
    ys, xs = np.mgrid[shown[1] : shown[3] + 1, shown[0] : shown[2] + 1]
    inside = (ys >= window[1]) & (ys <= window[3]) & (xs >= window[0]) & (xs <= window[2])
    expected = np.where(inside, 100 + 10 * ys + xs, 0)
    np.testing.assert_array_equal(read_exr_layers(tmp_path / "cut.exr")["Y"], expected)
