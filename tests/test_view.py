"""The viewer apart from any browser: sessions, pictures, read-outs, what is refused, and the server without network."""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import torch

from polsep.edit import EDITS, Metallic, Recipe, Rougher, Texture
from polsep.edit import apply as apply_edits
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_reader import read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.errors import InputError
from polsep.io.store.temporary import TemporaryFolders, find_upload, make_temporary_folders, remove_folder
from polsep.physics.srgb import srgb
from polsep.physics.stokes import Measurements
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.exposure import histogram
from polsep.separation.report import SeparatedFrame
from polsep.view import guard, opening
from polsep.view.components import status_line
from polsep.view.edits import at_scale, edit_small, list_controls, recipe_of
from polsep.view.guard import Guard, host_name, names_address
from polsep.view.opening import Settings, parse_settings, plain_name
from polsep.view.pictures import (
    VIEWS,
    Exposure,
    Picture,
    Place,
    Window,
    cut_window,
    draw,
    exposure_panel,
    light_panel,
    shrink,
    shrink_frame,
    stage,
    tone,
)
from polsep.view.playback import Prefetcher
from polsep.view.readout import read_pixel, readout_panel
from polsep.view.session import Session, Superseded
from polsep.view.sessions import Sessions
from polsep.view.waiting import Ticket

WHITE = 4095


def mosaic_codes(height: int = 96, width: int = 128, seed: int = 0) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """A colour mosaic of smooth light, 12 bits, a corner of it clipped."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    light = 600 + 1400 * (x / width) + 900 * np.sin(y / 9.0) ** 2
    angle = np.choose((y % 2) * 2 + x % 2, [np.pi / 2, np.pi / 4, 3 * np.pi / 4, 0.0])
    codes = light * (1 + 0.3 * np.cos(2 * angle - 0.7)) + rng.normal(0, 4, light.shape)
    codes[:12, -12:] = 9000
    return np.clip(np.rint(codes), 0, WHITE).astype(np.uint16)


@pytest.fixture
def scratch() -> Iterator[TemporaryFolders]:
    """Folders of a server, gone afterwards."""
    made = make_temporary_folders()
    yield made
    remove_folder(made.root)


@pytest.fixture
def sessions(scratch: TemporaryFolders) -> Sessions:
    """No page open yet."""
    return Sessions(scratch, 10 << 20)


def upload(sessions: Sessions, name: str, data: bytes) -> Path:
    """A file as the page's server receives it."""
    folder = sessions.scratch.exchange / f"upload-{len(list(sessions.scratch.exchange.iterdir()))}"
    folder.mkdir()
    (folder / name).write_bytes(data)
    return folder / name


def png(codes: np.ndarray[Any, Any]) -> bytes:
    return bytes(imagecodecs.png_encode(codes))


def opened(sessions: Sessions, key: str = "a", **said: Any) -> opening.OpenedFrame:
    """A small raw frame, uploaded and separated by the closed form."""
    sent = upload(sessions, "shot 1.png", png(mosaic_codes()))
    sessions.open_upload(key, [(str(sent), sent.name)])
    return sessions.find(key).separate(parse_settings({"method": "color-affine", "white": "4095", **said}))


def test_a_session_separates_as_the_library_does(sessions: Sessions) -> None:
    """The frame behind the page is `separate_capture`'s, bit for bit, and so is the EXR that it hands out."""
    found = opened(sessions)
    mosaic = Mosaic(torch.from_numpy(mosaic_codes().astype(np.float32)), Layout(), 0.0, WHITE)
    truth = separate_capture(mosaic, "color-affine")
    for name in ("diffuse", "specular", "valid", "dolp", "aolp"):
        np.testing.assert_array_equal(getattr(found.frame, name), getattr(truth, name))
    assert found.stem == "shot_1"
    layers = read_exr_layers(sessions.find("a").write("exr"))
    for k, color in enumerate("RGB"):
        np.testing.assert_array_equal(layers[f"diffuse.{color}"], truth.diffuse[..., k])
        np.testing.assert_array_equal(layers[f"specular.{color}"], truth.specular[..., k])
    assert sessions.find("a").write("png").read_bytes().startswith(b"\x89PNG")


def test_the_same_settings_cost_nothing_again(sessions: Sessions) -> None:
    """A session keeps what it found until a setting changes; the file is read anew only where reading changes."""
    found = opened(sessions)
    page = sessions.find("a")
    same = parse_settings({"method": "color-affine", "white": "4095"})
    assert page.separate(same) is found
    other = page.separate(parse_settings({"method": "analytic", "white": "4095"}))
    assert other.frame.report["method"] == "analytic"
    assert other.mosaic is found.mosaic
    brighter = page.separate(parse_settings({"method": "analytic", "white": "2000"}))
    assert brighter.mosaic is not found.mosaic


def test_an_unsaid_white_level_is_recommended_not_guessed(sessions: Sessions) -> None:
    """12 bits in 16 give a remark in the page's words, and the level that a button offers."""
    found = opened(sessions, white=opening.UNSAID)
    assert found.mosaic is not None and found.mosaic.white_level == 65535
    assert any("White level 4095" in remark and "--" not in remark for remark in found.remarks)
    assert found.mends() == (("white", "4095", "Use white level 4095"),)
    advised = ("say --layout 90,45,135,0/GBRG (rows); or --layout mono", "say --white-level N if N is white")
    mends = opening.OpenedFrame(found.frame, found.small, None, None, (), "a", advice=advised).mends()
    assert [mend[:2] for mend in mends] == [("layout", "90,45,135,0/GBRG"), ("layout", "mono")]


def test_results_are_opened_again(sessions: Sessions, tmp_path: Path) -> None:
    """What `write_separation` wrote comes back bit for bit, with expected errors where there are any."""
    frame = opened(sessions).frame
    error = np.random.default_rng(0).random((*frame.valid.shape, 2), dtype=np.float32)
    frame = SeparatedFrame(frame.diffuse, frame.specular, frame.valid, frame.dolp, frame.aolp, frame.report, error)
    (path, *_) = write_separation(frame, tmp_path, "shot")
    back = read_separated(path)
    for name in ("diffuse", "specular", "valid", "dolp", "aolp", "error"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frame, name))
    sent = upload(sessions, "shot.exr", path.read_bytes())
    sessions.open_upload("b", [(str(sent), sent.name)])
    found = sessions.find("b").separate(Settings())
    assert found.mosaic is None and found.histogram is None
    np.testing.assert_array_equal(found.frame.specular, frame.specular)


def test_results_keep_their_name_and_their_lamp(sessions: Sessions, tmp_path: Path) -> None:
    """An upload is named as its owner names it; the owner's file has the report beside it; the page's word counts."""
    frame = opened(sessions, light="0.5,1,0.25").frame
    (path, *_) = write_separation(frame, tmp_path, "shot")
    sent = upload(sessions, "my shot.exr", path.read_bytes())
    sessions.open_upload("b", [(str(sent), sent.name)])
    found = sessions.find("b").separate(Settings())
    assert found.frame.report["source"] == "my_shot" and "light_color" not in found.frame.report
    stated = sessions.find("b").separate(parse_settings({"light": "1,2,0.5"}))
    assert stated.frame.report["light_color"] == [0.5, 1.0, 0.25] and "0.500, 1.000, 0.250 stated" in light_panel(
        stated.frame, stated.small
    )
    page = sessions.find("c")
    page.begin_own(path)
    own = page.separate(Settings())
    assert own.frame.report["light_color"] == [0.5, 1.0, 0.25] and own.frame.report["method"] == "color-affine"
    assert own.remarks == tuple(frame.report["warnings"]) and own.mends() == ()


def test_results_of_light_alone_say_so(sessions: Sessions, tmp_path: Path) -> None:
    """Frames of a film have no polarization and no mask, which the panels would show as 0 and valid."""
    frame = opened(sessions).frame
    assert opening.LIGHT_ALONE not in frame.report["warnings"]
    np.savez(tmp_path / "frame.npz", diffuse=frame.diffuse, specular=frame.specular)
    page = sessions.find("b")
    page.begin_own(tmp_path / "frame.npz")
    assert page.separate(Settings()).remarks == (opening.LIGHT_ALONE,)


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("notes.txt", b"hello", "notes.txt: expected PNG, TIFF, .* found '.txt'"),
        ("photo.jpg", b"\xff\xd8\xff", "photo.jpg: expected PNG"),
        ("recording.json", b"{}", "recording.json: expected PNG"),
        ("film.mkv", b"", "film.mkv: expected PNG"),
        ("broken.png", b"\x89PNG\r\n\x1a\nrest", "^broken.png: expected a PNG header"),
        ("text.png", b"just text in disguise", "^text.png: expected a PNG file, found text"),
        ("empty.npy", b"", "^empty.npy: expected .* found an empty file"),
        ("rgb.png", png(np.dstack([mosaic_codes()] * 2 + [mosaic_codes(seed=1)])), "^rgb.png: expected one channel"),
        ("dump.raw", b"0" * 64, "^dump.raw: expected the size and pixel format"),
        ("cut.exr", b"\x76\x2f\x31\x01\2\0\0\0", "^cut.exr: expected"),
        ("other.exr", b"not at all", "^other.exr: expected an OpenEXR file, found text"),
    ],
)
def test_wrong_files_are_refused_in_one_line(sessions: Sessions, name: str, data: bytes, said: str) -> None:
    """The message speaks of the user's file, never of where it is kept."""
    sent = upload(sessions, name, data)

    def try_it() -> None:
        sessions.open_upload("a", [(str(sent), name)])
        sessions.find("a").separate(Settings())

    with pytest.raises(ValueError, match=said) as caught:
        try_it()
    assert "\n" not in str(caught.value) and str(sessions.scratch.root) not in str(caught.value)


def test_large_frames_are_refused_by_their_header(sessions: Sessions) -> None:
    """A small file that promises more samples than the viewer opens is refused before it is decoded."""
    header = b"\x93NUMPY\1\0" + (118).to_bytes(2, "little")
    header += b"{'descr': '<u2', 'fortran_order': False, 'shape': (20000, 20000), }".ljust(117) + b"\n"
    sent = upload(sessions, "big.npy", header)
    sessions.open_upload("a", [(str(sent), sent.name)])
    with pytest.raises(InputError, match=f"big.npy: expected at most {opening.MAX_SAMPLES} samples"):
        sessions.find("a").separate(Settings())


def test_nothing_outside_of_uploads_exists(sessions: Sessions, tmp_path: Path) -> None:
    """Paths of a client name files in the exchange folder, or nothing, and the answer is the same either way."""
    outside = tmp_path / "secret.png"
    outside.write_bytes(png(mosaic_codes()))
    scratch = sessions.scratch
    (scratch.kept / "other.png").write_bytes(b"x")
    link = scratch.exchange / "link.png"
    link.symlink_to(outside)
    claims = [outside, "/nowhere", link, scratch.kept / "other.png", f"{scratch.exchange}/../kept/other.png", "", None]
    said = set()
    for claim in [*claims, scratch.exchange, "a\0b", 7, "http://example.org/a.png"]:
        with pytest.raises(InputError) as caught:
            find_upload(scratch, str(claim) if isinstance(claim, Path) else claim, 1 << 20)
        said.add(str(caught.value))
    assert said == {"expected a file that this page uploaded, found another path"}
    sent = upload(sessions, "a.png", bytes(2 << 20))
    assert find_upload(scratch, str(sent), 2 << 20) == sent
    with pytest.raises(InputError, match="expected a file of at most 1 MB, found 2 MB"):
        find_upload(scratch, str(sent), 1 << 20)


def test_names_of_files_become_harmless() -> None:
    """Folders, templates and odd characters do not reach a path."""
    assert plain_name("../../etc/shot.PNG") == ("shot", ".png")
    assert plain_name("C:\\data\\a b.tif") == ("a_b", ".tif")
    assert plain_name("s_{angle}.png") == ("s__angle", ".png")
    assert plain_name("....raw")[0] == "frame"
    assert len(plain_name("x" * 500 + ".npy")[0]) == 64


def test_sessions_are_apart_and_leave_nothing(sessions: Sessions) -> None:
    """Two pages that sent the same file do not share frames; the file goes with the last of them, and so does all."""
    sent = upload(sessions, "shot.png", png(mosaic_codes()))
    for key in ("a", "b"):
        sessions.open_upload(key, [(str(sent), sent.name)])
        sessions.find(key).separate(parse_settings({"method": "analytic", "white": "4095"}))
    assert sessions.find("a").opened is not sessions.find("b").opened
    with pytest.raises(ValueError, match="expected an opened file"):
        sessions.find("c").separate(Settings())
    sessions.find("a").write("exr")
    sessions.end("a")
    assert sent.exists()
    assert sessions.find("b").separate(parse_settings({"method": "paper", "white": "4095"})).count == 1
    for key in ("b", "c", "never"):
        sessions.end(key)
    assert len(sessions) == 0
    assert [*sessions.scratch.exchange.iterdir(), *sessions.scratch.kept.iterdir()] == []


def test_the_page_idle_for_longest_makes_room(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is bounded: one page too many ends another."""
    monkeypatch.setattr("polsep.view.sessions.MAX_SESSIONS", 2)
    first = sessions.find("a")
    sessions.find("b")
    assert sessions.find("a") is first
    sessions.find("c")
    assert len(sessions) == 2 and sessions.find("a") is first


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"method": "magic"}, "expected a method of auto"),
        ({"layout": "rgb"}, 'expected "color", "mono"'),
        ({"white": "bright"}, "expected a number as white level"),
        ({"size": "2448"}, "expected a size like 2448x2048"),
        ({"light": "1,2"}, "expected a light colour R,G,B like"),
    ],
)
def test_settings_that_mean_nothing_are_refused(said: dict[str, str], message: str) -> None:
    """Fields of the page are texts; each has its own one-line error."""
    with pytest.raises(ValueError, match=message):
        parse_settings(said)


def test_settings_are_those_of_the_library() -> None:
    """What the page says becomes read options and arguments of `separate`."""
    settings = parse_settings({"layout": "mono", "black": "16", "white": "4095", "light": "1, 0.9,0.7", "index": 3})
    assert settings.read.layout == Layout(bayer=None)
    assert (settings.read.black_level, settings.read.white_level) == (16.0, 4095.0)
    assert settings.light_color == (1.0, 0.9, 0.7) and settings.index == 3
    plain = parse_settings({"layout": opening.UNSAID, "white": opening.UNSAID, "light": "auto", "size": ""})
    assert plain == Settings()
    assert parse_settings({"size": "2448 x 2048"}).read.size == (2448, 2048)


def test_frames_of_a_stack_are_reached_by_number(sessions: Sessions) -> None:
    """A file of several frames has as many; each is separated as if it were alone."""
    stack = np.stack([mosaic_codes(seed=k) for k in range(3)])
    sent = upload(sessions, "stack.npy", b"")
    np.save(sent, stack)
    sessions.open_upload("a", [(str(sent), sent.name)])
    page = sessions.find("a")
    found = page.separate(parse_settings({"white": "4095", "method": "analytic", "index": 2}))
    assert (found.index, found.count, found.stem) == (2, 3, "stack_0002")
    alone = separate_capture(Mosaic(torch.from_numpy(stack[2].astype(np.float32)), Layout(), 0.0, WHITE), "analytic")
    np.testing.assert_array_equal(found.frame.diffuse, alone.diffuse)


def test_tones_are_srgb() -> None:
    """The table is within one code of the formula, hits both ends, and never goes down."""
    light = np.linspace(0, 1.2, 4001, dtype=np.float32)[None, :, None]
    codes = tone(light, 1.0)
    assert np.abs(codes[..., 0].astype(int) - np.rint(255 * srgb(light[..., 0]))).max() <= 1
    assert (codes[0, 0] == 0).all() and (codes[0, -1] == 255).all()
    assert (np.diff(codes[0, :, 0].astype(int)) >= 0).all()
    np.testing.assert_array_equal(tone(light / 4, 4.0), codes)


def test_shrinking_keeps_means_and_angles(sessions: Sessions) -> None:
    """Blocks are averaged as light and as Stokes vectors: a uniform field keeps its DoLP and AoLP."""
    image = np.random.default_rng(0).random((7, 10, 3), dtype=np.float32)
    small = shrink(image, 3)
    assert small.shape == (3, 4, 3)
    np.testing.assert_allclose(small[0, 0], image[:3, :3].mean(axis=(0, 1)), rtol=1e-6)
    np.testing.assert_allclose(small[2, 3], image[6:, 9:].mean(axis=(0, 1)), rtol=1e-6)
    size = (700, 1300)
    ones = np.ones((*size, 3), np.float32)
    frame = SeparatedFrame(
        ones, ones, np.ones(size, bool), np.full(size, 0.25, np.float32), np.full(size, 2.8, np.float32), {}
    )
    copy = shrink_frame(frame)
    assert copy.step == 3 and max(copy.size) <= 640
    np.testing.assert_allclose(copy.dolp, 0.25, rtol=1e-4)
    np.testing.assert_allclose(copy.aolp, 2.8, rtol=1e-4)


def test_exposure_is_in_stops(sessions: Sessions) -> None:
    """One stop more is twice the light, of the input as of its parts; maps of polarization stay."""
    small = opened(sessions).small
    up, own = Exposure(1.0), Exposure(1.0, 2.0)
    np.testing.assert_array_equal(draw(small, "Diffuse", up), tone(small.diffuse, 2 * small.gain))
    np.testing.assert_array_equal(draw(small, "Diffuse", own), draw(small, "Diffuse", up))
    np.testing.assert_array_equal(draw(small, "Specular", own), tone(small.specular, 8 * small.gain))
    np.testing.assert_array_equal(draw(small, "DoLP", up), draw(small, "DoLP", Exposure(-3.0)))
    assert draw(small, "Input", up).astype(int).sum() > draw(small, "Input", Exposure()).astype(int).sum()
    for view in VIEWS:
        picture = draw(small, view, Exposure())
        assert picture.dtype == np.uint8 and picture.shape == (*small.size, 3)
    with pytest.raises(ValueError, match="expected a picture of Input"):
        draw(small, "<script>", Exposure())


def test_marks_are_on_cells_that_clip(sessions: Sessions) -> None:
    """Every cell with a clipped sample is red, and no other changes; at full resolution, its four pixels are."""
    found = opened(sessions)
    assert found.mosaic is not None and found.flags is not None
    clipped = np.asarray(found.mosaic.clipped()).reshape(48, 2, 64, 2).any(axis=(1, 3))
    plain, marked = (draw(found.small, "Input", Exposure(marks=marks)) for marks in (False, True))
    assert clipped.any() and (marked[clipped] == (255, 40, 40)).all()
    np.testing.assert_array_equal(marked[~clipped], plain[~clipped])
    said = {"method": "color-affine", "white": "4095", "resolution": "full"}
    full = sessions.find("a").separate(parse_settings(said))
    assert full.flags is not None
    np.testing.assert_array_equal(full.flags, found.flags.repeat(2, axis=0).repeat(2, axis=1))


def test_windows_are_the_frame_itself(sessions: Sessions) -> None:
    """As many pixels as the screen has, those of the frame where it has fewer, at the place that the window says."""
    found = opened(sessions)
    sharp = cut_window(found.frame, Window(0.25, 0.5, 0.5, 1.0, 999), found.small, None, found.flags)
    assert (sharp.left, sharp.top, sharp.right, sharp.bottom) == (0.25, 0.5, 0.5, 1.0) and sharp.small.step == 1
    np.testing.assert_array_equal(sharp.small.specular, found.frame.specular[24:, 16:32])
    assert sharp.small.gain == found.small.gain
    coarse = cut_window(found.frame, Window(0, 0, 1, 1, 32), found.small, found.frame.diffuse, None).small
    np.testing.assert_array_equal(coarse.diffuse, shrink(found.frame.diffuse, 2))
    np.testing.assert_array_equal(coarse.edited, shrink(found.frame.diffuse, 2))
    assert str(Window.parse("0,25,5000,10000,640")) == "0,25,5000,10000,640"
    for wrong in ("", "1,2,3", "5,0,5,9,1", "0,0,10001,9,1", "0,0,9,9,0", "a,b,c,d,e", None, "-1,0,2,2,2"):
        with pytest.raises(ValueError, match="expected a window like"):
            Window.parse(wrong)


def test_two_separations_of_a_frame_are_compared(sessions: Sessions) -> None:
    """The right picture is of another method or resolution; both are the library's, and coming back costs nothing."""
    page = sessions.find("a")
    first = opened(sessions)
    settings = parse_settings({"method": "color-affine", "white": "4095"})
    against = opening.parse_against("analytic, full", settings)
    assert against is not None and opening.parse_against("the same", settings) is None
    assert page.separate(settings, against) is first
    mosaic = Mosaic(torch.from_numpy(mosaic_codes().astype(np.float32)), Layout(), 0.0, WHITE)
    truth = separate_capture(mosaic, "analytic", full=True)
    assert page.against is not None and page.makers == ("color-affine, half", "analytic, full")
    np.testing.assert_array_equal(page.against.frame.specular, truth.specular)
    other = page.against
    assert page.separate(against, settings) is other and page.against is first
    assert page.sharpen(Window(0, 0, 1, 1, 500))
    assert page.sharp is not None and [s.small.size for s in page.sharp] == [(96, 128), (48, 64)]
    seen = read_pixel(other.frame, other.mosaic, (41, 63))
    assert seen.samples == read_pixel(first.frame, first.mosaic, (20, 31)).samples
    with pytest.raises(ValueError, match="expected a method of"):
        opening.parse_against("magic, full", settings)


def test_four_angle_images_are_one_frame(sessions: Sessions, tmp_path: Path) -> None:
    """Files whose names differ by 0, 45, 90 and 135 alone are one; any other file makes a sequence of them."""
    group = opening.group_angles
    assert group(["a_135.png", "a_0.png", "a_45.png", "a_90.png"]) == {"a_{angle}.png": (1, 2, 3, 0)}
    assert group(["000.tif", "045.tif", "090.tif", "135.tif"]) == {"{angle}.tif": (0, 1, 2, 3)}
    assert group([f"s{n}_{a}.png" for n in (0, 1) for a in (0, 45, 90, 135)]) is not None
    assert group(["a_0.png", "a_45.png", "a_90.png"]) is None and group([f"f{k}.png" for k in range(136)]) is None
    light = np.random.default_rng(0).integers(100, 3000, (4, 20, 24, 3), np.uint16)
    sent = [upload(sessions, f"car_{a}.png", png(light[k])) for k, a in enumerate((0, 45, 90, 135))]
    sessions.open_upload("a", [(str(path), path.name) for path in sent[::-1]])
    found = sessions.find("a").separate(parse_settings({"method": "analytic", "white": "4095"}))
    assert (found.count, found.stem, found.mosaic) == (1, "car", None)
    planes = torch.from_numpy(np.moveaxis(light, -1, 1).astype(np.float32) / WHITE)
    measurements = Measurements(planes, tuple(math.radians(angle) for angle in (0, 45, 90, 135)))
    truth = separate_capture(measurements, "analytic")
    np.testing.assert_allclose(found.frame.specular, truth.specular, atol=1e-6)
    sent[2].write_bytes(png(light[0, :-2]))
    sessions.open_upload("b", [(str(path), path.name) for path in sent])
    folder = tmp_path / "angles"
    folder.mkdir()
    for path in sent:
        (folder / path.name).write_bytes(path.read_bytes())
    (source,) = opening.find_sources(folder)
    assert (source.path, source.stem, source.separated) == (folder / "car_{angle}.png", "car", False)
    (folder / "more.png").write_bytes(b"")
    assert [source.stem for source in opening.find_sources(folder)] == ["car_0", "car_45", "car_90", "car_135", "more"]
    with pytest.raises(InputError, match=r"^car.png: expected") as caught:
        sessions.find("b").separate(parse_settings({"white": "4095"}))
    assert str(sessions.scratch.root) not in str(caught.value)
    sessions.end("a")
    sessions.end("b")
    assert [*sessions.scratch.exchange.iterdir(), *sessions.scratch.kept.iterdir()] == []


def test_a_result_that_nobody_waits_for_is_dropped(sessions: Sessions) -> None:
    """A cancelled separation leaves the page as it was; the page is usable while another one is made."""
    page, found = sessions.find("a"), opened(sessions)
    other = parse_settings({"method": "analytic", "white": "4095"})
    size = page.size()
    for k in range(3):
        with pytest.raises(Superseded):
            page.separate(replace(other, light_color=(1.0, 1.0, 1.0 + k)), wanted=lambda: False)
    assert page.opened is found and page.size() == size
    begun, go_on = threading.Event(), threading.Event()
    line = sessions.line

    def slow(ticket: Ticket) -> Any:
        begun.set()
        go_on.wait(60)
        return page.separate(other, wanted=lambda: ticket.wanted)

    first, second = line.join("a", slow), line.join("b", lambda ticket: "done")
    begun.wait(60)
    assert first.describe().startswith("Separating") and second.describe() == "Waiting, 1 before this one"
    page.edit(Recipe((Metallic(amount=0.5),)))
    line.leave("a", by_user=True)
    line.leave("a")
    assert first.future.cancelled() and first.by_user
    go_on.set()
    assert second.future.result(60) == "done" and page.opened is found
    again, later = line.join("c", lambda ticket: 1), line.join("c", lambda ticket: 2)
    assert later.future.result(60) == 2 and (again.future.cancelled() or again.future.result() == 1)
    assert not again.by_user
    failed = line.join("d", lambda ticket: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        failed.future.result(60)


def test_panels_hold_their_pictures_and_nothing_from_elsewhere(sessions: Sessions) -> None:
    """Everything that a page shows is in the text itself: no address, no file."""
    found = opened(sessions)
    panels = [
        stage(
            (Picture("AoLP", found.small), Picture("Specular", found.small, "<b>")), Exposure(), Place(64, (0.1, 0.2))
        ),
        exposure_panel(found.frame, found.histogram),
        exposure_panel(found.frame, None),
        light_panel(found.frame, found.small),
        readout_panel(read_pixel(found.frame, found.mosaic, (3, 4))),
    ]
    for panel in panels:
        assert "http" not in panel and "file=" not in panel and "<script" not in panel
    assert panels[0].count("data:image/") == 3 and "ps-mark" in panels[0] and "<b>" not in panels[0]
    assert "does not say how far off" in panels[1]


def test_angles_of_photographs_are_not_called_those_of_the_picture(sessions: Sessions) -> None:
    """Where they count from the first photograph, no degrees of the lamp's polarizer are shown."""
    found = opened(sessions)
    assert "Polarizer of the light" in light_panel(found.frame, found.small)
    assert "light polarizer about" in status_line(found)
    report = {**found.frame.report, "photographs": {"frame": "the first photograph"}}
    turned = replace(found, frame=replace(found.frame, report=report))
    said = light_panel(turned.frame, found.small)
    assert "from the first photograph, which" in said and "Polarizer of the light" not in said
    assert "light polarizer about" not in status_line(turned)


def test_the_histogram_counts_every_sample(sessions: Sessions) -> None:
    """Shares of each colour sum to 1, and clipped shares are the mosaic's."""
    found = opened(sessions)
    assert found.mosaic is not None and found.histogram is not None
    np.testing.assert_allclose(found.histogram.shares.sum(axis=1), 1.0, rtol=1e-12)
    clipped = float(found.mosaic.clipped().mean())
    weights = np.array([1, 2, 1]) / 4
    assert math.isclose(float(np.dot(weights, found.histogram.clipped)), clipped, rel_tol=1e-6)
    mono = Mosaic(found.mosaic.data, Layout(bayer=None), 0.0, WHITE)
    assert histogram(mono).names == "Y" and math.isclose(histogram(mono).clipped[0], clipped, rel_tol=1e-6)


def test_a_pixel_reads_its_own_cell(sessions: Sessions) -> None:
    """Raw values are those of the file under the right angles, and their Stokes vector obeys Malus's law."""
    found = opened(sessions)
    codes = mosaic_codes()
    seen = read_pixel(found.frame, found.mosaic, (20, 31))
    assert [s.angle_deg for s in seen.samples] == [0, 45, 90, 135]
    assert [s.value for s in seen.samples] == [codes[41, 63], codes[40, 63], codes[40, 62], codes[41, 62]]
    assert seen.color == "G" and not any(s.clipped for s in seen.samples)
    assert seen.stokes is not None
    s0, s1, s2 = seen.stokes
    assert math.isclose(s0, 2 * sum(s.value for s in seen.samples) / 4 / WHITE, rel_tol=1e-5)
    assert math.isclose(s1, (seen.samples[0].value - seen.samples[2].value) / WHITE, rel_tol=1e-4)
    assert math.isclose(s2, (seen.samples[1].value - seen.samples[3].value) / WHITE, rel_tol=1e-4)
    assert seen.diffuse == tuple(found.frame.diffuse[20, 31].tolist())
    assert all(s.clipped for s in read_pixel(found.frame, found.mosaic, (0, 63)).samples)
    with pytest.raises(ValueError, match="expected a pixel of 64x48"):
        read_pixel(found.frame, found.mosaic, (48, 0))


def test_numbers_are_of_what_was_separated(tmp_path: Path) -> None:
    """Samples, histogram and marks have the black level that was found; pixels a calibrated lamp's light."""
    rng = np.random.default_rng(0)
    light = np.repeat([0.0, 0.0, 200.0, 800.0, 2000.0, 5000.0, 5000.0, 8000.0], 64)[:, None]
    codes = 240 + 0.4 * rng.poisson(light, (512, 512)) + rng.normal(0, 1.5, (512, 512))
    codes = np.clip(np.rint(codes), 0, WHITE).astype(np.uint16)
    (tmp_path / "dark.png").write_bytes(png(codes))
    settings = parse_settings({"method": "analytic", "white": "4095"})
    sources = opening.find_sources(tmp_path / "dark.png")
    found = opening.open_frame(sources, settings, opening.read_source(sources, settings.read, 0))
    assert found.mosaic is not None and found.histogram is not None and found.flags is not None
    assert found.mosaic.black_level == found.frame.report["black_level"] == pytest.approx(240, abs=2)
    assert found.histogram.shares[:, 0].min() > 0.2
    frame = opening.read_source(sources, settings.read, 0)
    lit = replace(frame, data=replace(frame.data, light_color=(0.5, 1.0, 0.7)))
    found = opening.open_frame(sources, settings, lit)
    seen = read_pixel(found.frame, found.mosaic, (240, 100))
    assert seen.stokes is not None and seen.color == "R"
    assert seen.stokes[0] == pytest.approx(seen.diffuse[0] + seen.specular[0], rel=0.02)


def test_folders_are_read_as_other_commands_read_them(tmp_path: Path) -> None:
    """A recording by its index, no hidden files; previews of results are no raw frames, padded angles no template."""
    codes = png(mosaic_codes())
    (tmp_path / "take").mkdir()
    for name in ("recording.json", "frames.raw", "frames.jsonl"):
        (tmp_path / "take" / name).write_bytes(b"")
    (source,) = opening.find_sources(tmp_path / "take")
    assert (source.path.name, source.stem) == ("recording.json", "take")
    for folder, names, stems in (
        ("hidden", ("._a1.png", "a1.png", "a2.png"), ["a1", "a2"]),
        ("padded", ("s_000.png", "s_045.png", "s_090.png", "s_135.png"), ["s_000", "s_045", "s_090", "s_135"]),
        ("angles", ("s_0.png", "s_45.png", "s_90.png", "s_135.png"), ["s"]),
    ):
        (tmp_path / folder).mkdir()
        for name in names:
            (tmp_path / folder / name).write_bytes(codes)
        assert [source.stem for source in opening.find_sources(tmp_path / folder)] == stems
    (tmp_path / "hidden" / "probe.exr").write_bytes(b"of something else")
    assert [source.stem for source in opening.find_sources(tmp_path / "hidden")] == ["a1", "a2"]
    frame = separate_capture(Mosaic(mosaic_codes(), Layout(), 0.0, float(WHITE)), "analytic")
    sequences, either = "name single files themselves", "expected raw frames or results of polsep in the folder"
    for kind, said in (("exr", sequences), ("tiff", either), ("png", either)):
        write_separation(frame, tmp_path / kind, "shot", kind)
        with pytest.raises(InputError, match=said):
            opening.find_sources(tmp_path / kind)
    write_separation(frame, tmp_path / "npz", "shot", "npz")
    (source,) = opening.find_sources(tmp_path / "npz")
    assert source.separated and source.path.name == "shot.npz"


def test_controls_are_generated_from_the_registry() -> None:
    """Every edit has its controls; where they start, nothing is edited, and edits without their image do nothing."""
    controls = list_controls()
    assert {control.edit for control in controls} == set(EDITS.values())
    starts = [control.start for control in controls]
    assert recipe_of(starts) == Recipe()
    moved = [5.0 if (c.edit, c.parameter.name) == (Rougher, "sigma") else c.start for c in controls]
    assert recipe_of(moved) == Recipe((Rougher(sigma=5.0),))
    laid = [1.0 if (c.edit, c.parameter.name) == (Texture, "amount") else c.start for c in controls]
    assert recipe_of(laid) == recipe_of(laid, {"mask": "m.png"}) == Recipe()
    assert recipe_of(laid, {"texture": "t.png"}) == Recipe((Texture(image="t.png"),))
    sent = {"texture": "t.png", "normals": "n.png", "mask": "m.png"}
    assert recipe_of(laid, sent) == Recipe((Texture(image="t.png", normals="n.png", mask="m.png"),))
    with pytest.raises(ValueError, match="expected a colour like"):
        recipe_of(["url(x)" if c.parameter.kind == "color" else c.start for c in controls])
    with pytest.raises(ValueError, match="expected sigma from"):
        recipe_of([1e9 if c.parameter.name == "sigma" else c.start for c in controls])


def test_edits_are_shown_small_and_written_large(sessions: Sessions) -> None:
    """The page shows the recipe at its scale; the file that it hands out is `polsep.edit.apply`'s at full size."""
    found = opened(sessions)
    page = sessions.find("a")
    recipe = Recipe((Rougher(sigma=4.0), Metallic(amount=0.5)))
    assert [at_scale(edit, 2) for edit in recipe.edits] == [Rougher(sigma=2.0), Metallic(amount=0.5)]
    page.edit(recipe)
    assert page.shown is not None and page.shown.edited is not None
    np.testing.assert_array_equal(page.shown.edited, edit_small(found.small, recipe))
    layers = read_exr_layers(page.write("edited"))
    truth = apply_edits(found.frame, recipe)
    np.testing.assert_array_equal(layers["combined.G"], truth.combined[..., 1])
    assert json.loads(page.write("recipe").read_text())["edits"][0]["edit"] == "rougher"
    page.edit(Recipe())
    assert page.opened.small.edited is None


def test_edits_that_do_not_fit_are_left_out(sessions: Sessions) -> None:
    """Edits in colour of a frame without any: a remark on each, and the picture, the numbers and the files agree."""
    page = sessions.find("a")
    opened(sessions)
    page.edit(Recipe((Rougher(sigma=3.0), Metallic(amount=0.5))))
    found = opened(sessions, layout="mono")
    assert page.opened is found and page.recipe == Recipe((Rougher(sigma=3.0),))
    assert page.dropped == (Metallic(amount=0.5),)
    assert [r for r in found.remarks if "left out" in r] == [
        f"{Metallic.title} is left out: expected images in colour for metallic, found one channel"
    ]
    assert page.shown is not None and page.shown.edited is not None
    np.testing.assert_array_equal(page.shown.edited, edit_small(found.small, page.recipe))
    layers = read_exr_layers(page.write("edited"))
    np.testing.assert_array_equal(layers["combined.Y"], apply_edits(found.frame, page.recipe).combined[..., 0])
    page.edit(Recipe((Rougher(sigma=2.0),)))
    settings = parse_settings({"method": "color-affine", "white": "4095", "layout": "mono"})
    assert page.separate(settings) is found and page.dropped == ()  # said once


def test_requests_name_this_machine() -> None:
    """Host headers lose port and brackets."""
    assert [host_name(h) for h in ("127.0.0.1:7860", "LocalHost", "[::1]:80", "evil.example:7860")] == [
        "127.0.0.1",
        "localhost",
        "::1",
        "evil.example",
    ]


def test_addresses_in_messages_are_found() -> None:
    """Gradio would fetch a file whose path is an address, however deep it lies in a message."""
    assert names_address(b'{"data": [[{"a": {"path": "http://10.0.0.1/x"}}]]}')
    assert names_address(b'{"path": "file:///etc/passwd"}')
    assert not names_address(b'{"data": [{"path": "/tmp/x/a.png", "url": "http://127.0.0.1:7860/file=/tmp/x/a.png"}]}')
    assert not names_address(b"") and not names_address(b"{")


def ask(path: str, verb: str = "GET", body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    """Status and what the server behind the guard got."""
    got: list[bytes] = []
    sent: list[Any] = []

    async def behind(scope: Any, receive: Any, send: Any) -> None:
        got.append((await receive()).get("body", b""))
        await send({"type": "http.response.start", "status": 200, "headers": []})

    async def receive() -> Any:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    named = {"host": "127.0.0.1:7860", **headers}
    pairs = [(name.replace("_", "-").encode(), value.encode()) for name, value in named.items()]
    scope = {"type": "http", "method": verb, "path": path, "headers": pairs}
    asyncio.run(Guard(behind, guard.LOOPBACK, 1 << 20)(scope, receive, send))
    return sent[0]["status"], b"".join(got)


@pytest.mark.parametrize(
    ("path", "verb", "headers", "status"),
    [
        ("/", "GET", {}, 200),
        ("/", "GET", {"host": "evil.example"}, 403),
        ("/gradio_api/file=/tmp/a.exr", "GET", {}, 200),
        ("/gradio_api/file=http://10.0.0.1/", "GET", {}, 403),
        ("/gradio_api/file=http:/10.0.0.1/", "GET", {}, 403),
        ("/gradio_api/proxy=http://10.0.0.1/", "GET", {}, 403),
        ("/gradio_api/stream/x", "POST", {}, 403),
        ("/gradio_api/run/predict", "POST", {}, 200),
        ("/gradio_api/upload", "POST", {"content_length": "5000000000"}, 413),
        ("/gradio_api/upload", "POST", {"content_length": "-1"}, 413),
        ("/gradio_api/upload", "POST", {"content_length": "1000"}, 200),
        ("/monitoring", "GET", {}, 403),
        ("/", "DELETE", {}, 403),
    ],
)
def test_only_the_viewers_own_requests_pass(path: str, verb: str, headers: dict[str, str], status: int) -> None:
    """What the page does not need is refused by its head alone."""
    assert ask(path, verb, **headers)[0] == status


def test_messages_pass_whole_or_not_at_all() -> None:
    """A message reaches the server as it was, unless it is too long or names an address as a file."""
    body = b'{"data": [1, 2]}'
    assert ask("/gradio_api/queue/join", "POST", body) == (200, body)
    assert ask("/gradio_api/queue/join", "POST", b" " * (guard.MAX_JSON + 1))[0] == 413
    assert ask("/gradio_api/queue/join", "POST", b'{"data": [{"path": "https://a.example"}]}')[0] == 403


def test_a_session_without_a_file_says_so(tmp_path: Path) -> None:
    """Nothing to separate, nothing to fetch."""
    page = Session(tmp_path, tmp_path, Prefetcher())
    with pytest.raises(ValueError, match="expected an opened file"):
        page.separate(Settings())
    with pytest.raises(ValueError, match="expected a separated frame"):
        page.write("exr")
