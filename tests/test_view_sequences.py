"""Sequences on the viewer's page, and images that its edits use, apart from any browser."""

from __future__ import annotations

import threading
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import torch
from test_edit import sphere
from test_view import mosaic_codes, opened, png, upload

from polsep.edit import Metallic, Recipe, Rougher, Texture, apply
from polsep.edit.files import load_work, read_recipe
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_reader import read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.results.sequences import Picture, write_exr
from polsep.io.store.errors import InputError
from polsep.io.store.temporary import make_temporary_folders, remove_folder
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.view import images
from polsep.view.edits import edit_small
from polsep.view.opening import Settings, find_sources, parse_settings
from polsep.view.pictures import Small, shrink, shrink_frame
from polsep.view.playback import Prefetcher, Reel, pack, unpack
from polsep.view.session import Session
from polsep.view.sessions import Sessions

COUNT = 4
ANALYTIC = {"white": "4095", "method": "analytic"}


@pytest.fixture
def sessions() -> Iterator[Sessions]:
    """No page open yet; afterwards, nothing is left to be made."""
    scratch = make_temporary_folders()
    made = Sessions(scratch, 10 << 20)
    yield made
    made.close()
    remove_folder(scratch.root)


def small_frame(level: float, size: tuple[int, int] = (6, 8)) -> Small:
    """A copy at screen size of even light."""
    light = np.full((*size, 3), level, np.float32)
    return Small(1, light, light / 2, light[..., 0], light[..., 0], None, 1.0)


def until(ready: Callable[[], Any]) -> Any:
    """What a function gives, as soon as that is something."""
    for _ in range(3000):
        if (found := ready()) is not None and found is not False:
            return found
        time.sleep(0.01)
    raise AssertionError("expected something, found nothing for half a minute")


def stacked(sessions: Sessions) -> Session:
    """A page with a stack of frames, the first of them separated."""
    sent = upload(sessions, "stack.npy", b"")
    np.save(sent, np.stack([mosaic_codes(seed=k) for k in range(COUNT)]))
    sessions.open_upload("a", [(str(sent), sent.name)])
    page = sessions.find("a")
    page.separate(parse_settings(ANALYTIC))
    page.toggle()
    return page


def truth_of(place: int) -> Small:
    """The copy of a frame of `stacked` as it is when it is opened alone."""
    codes = mosaic_codes(seed=place).astype(np.float32)
    return shrink_frame(separate_capture(Mosaic(torch.from_numpy(codes), Layout(), 0.0, 4095.0), "analytic"))


def test_a_stack_plays_in_order_and_around(sessions: Sessions) -> None:
    """Frame after frame, each as it is when opened alone, to half floats; after the last comes the first."""
    page = stacked(sessions)
    for place in [*range(1, COUNT), 0, 1]:
        until(page.play)
        assert page.place == place and page.shown is not None
        np.testing.assert_allclose(page.shown.specular, truth_of(place).specular, rtol=1e-3, atol=1e-6)
    assert page.opened is not None and page.opened.index == 0
    assert page.separate(parse_settings({**ANALYTIC, "index": 1})).stem == "stack_0001"
    until(page.play)
    assert page.place == 2
    page.toggle()
    assert not page.play() and page.place == 2


def test_what_plays_has_its_marks(sessions: Sessions) -> None:
    """The flags of a frame that plays are those of the frame when it is opened, at both resolutions."""
    for more in ({}, {"resolution": "full"}):
        page = stacked(sessions)
        page.separate(parse_settings({**ANALYTIC, **more}))
        until(page.play)
        assert page.shown is not None and page.shown.flags is not None and page.shown.flags.any()
        found = page.separate(parse_settings({**ANALYTIC, **more, "index": 1}))
        np.testing.assert_array_equal(page.shown.flags, found.small.flags)


def test_edits_apply_while_it_plays(sessions: Sessions) -> None:
    """An edit changes the picture at once, and is on every frame behind it."""
    page = stacked(sessions)
    until(page.play)
    page.edit(recipe := Recipe((Rougher(sigma=3.0), Metallic(amount=0.5))))
    for place in (1, 2):
        shown = page.shown
        assert shown is not None and shown.edited is not None and page.place == place
        np.testing.assert_array_equal(shown.edited, edit_small(shown, recipe))
        until(page.play)


def test_other_settings_are_other_frames(sessions: Sessions) -> None:
    """What was made ahead under other settings is forgotten."""
    page = stacked(sessions)
    until(page.play)
    page.separate(parse_settings({**ANALYTIC, "white": "3000", "index": 0}))
    until(page.play)
    assert page.shown is not None
    np.testing.assert_array_less(truth_of(1).diffuse.mean(), page.shown.diffuse.mean())


def test_several_files_are_a_sequence(sessions: Sessions) -> None:
    """In the order of their numbers; each has its own name, and files of several frames do not go with others."""
    sent = [(upload(sessions, f"s{k}.png", png(mosaic_codes(seed=k))), k) for k in (10, 2, 1)]
    sessions.open_upload("a", [(str(path), path.name) for path, _ in sent])
    page = sessions.find("a")
    for place, number in enumerate((1, 2, 10)):
        found = page.separate(parse_settings({**ANALYTIC, "index": place}))
        assert (found.stem, found.index, found.count) == (f"s{number}", place, 3)
    np.testing.assert_array_equal(found.small.diffuse, truth_of(10).diffuse)
    np.save(stack := upload(sessions, "s3.npy", b""), np.zeros((2, 8, 8), np.uint16))
    sessions.open_upload("a", [(str(path), path.name) for path in (sent[0][0], stack)])
    with pytest.raises(InputError, match=r"^s3.npy: expected one frame in each of several files, found 2"):
        sessions.find("a").separate(parse_settings(ANALYTIC))


def test_separated_sequences_play(sessions: Sessions, tmp_path: Path) -> None:
    """Frames of `polsep video`, opened as the owner's folder or sent together."""
    light = np.random.default_rng(0).random((COUNT, 6, 8, 3), dtype=np.float32)
    for k in range(COUNT):
        write_exr(tmp_path / f"take_{k:06d}.exr", Picture(light[k], light[k], None, {}), "none")
    page = sessions.find("a")
    page.begin_own(tmp_path)
    assert page.separate(Settings(index=2)).stem == "take_000002"
    page.toggle()
    until(page.play)
    assert page.place == 3 and page.shown is not None
    np.testing.assert_allclose(page.shown.diffuse, light[3], rtol=1e-3)
    sent = [upload(sessions, p.name, p.read_bytes()) for p in sorted(tmp_path.glob("*.exr"))]
    sessions.open_upload("b", [(str(path), path.name) for path in sent])
    assert sessions.find("b").separate(Settings(index=1)).count == COUNT


@pytest.mark.parametrize("format", ["exr", "npz"])
def test_results_of_both_formats_are_opened(sessions: Sessions, tmp_path: Path, format: str) -> None:
    """NPZ is a result where it has a result's arrays, and raw otherwise."""
    frame = opened(sessions).frame
    path = write_separation(frame, tmp_path, "shot", format)[0]
    back = read_separated(path)
    for name in ("diffuse", "specular", "valid", "dolp", "aolp"):
        np.testing.assert_array_equal(getattr(back, name), getattr(frame, name))
    assert find_sources(path)[0].separated
    np.savez(tmp_path / "raw.npz", mosaic_codes())
    assert not find_sources(tmp_path / "raw.npz")[0].separated


def test_what_is_kept_is_bounded() -> None:
    """Frames seen longest ago go first; a frame that cannot be made says why, once it is its turn."""
    size = pack(small_frame(0.0)).size
    ahead, reel = Prefetcher(3 * size), Reel()
    for place in range(6):
        ahead.want(reel, [place], lambda place: small_frame(place / 8))
        until(lambda place=place: ahead.frame(reel, place))
    assert len(ahead) == 3
    assert [ahead.frame(reel, place) is not None for place in range(6)] == [False] * 3 + [True] * 3
    ahead.want(reel, [7], lambda place: small_frame(1 / 0))
    with pytest.raises(ZeroDivisionError):
        until(lambda: ahead.frame(reel, 7))
    ahead.drop(reel)
    assert len(ahead) == 0 and ahead.frame(reel, 5) is None
    ahead.close()


def test_a_dropped_sequence_keeps_nothing() -> None:
    """A frame that was being made when its page closed is not kept."""
    ahead, reel, begun, go = Prefetcher(), Reel(), threading.Event(), threading.Event()

    def make(place: int) -> Small:
        begun.set()
        assert go.wait(30)
        return small_frame(place)

    ahead.want(reel, [0, 1], make)
    assert begun.wait(30)
    ahead.drop(reel)
    go.set()
    ahead.close()
    assert len(ahead) == 0


def test_half_floats_keep_what_is_seen() -> None:
    """To a thousandth; light beyond the largest half float becomes that, not infinite."""
    frame = small_frame(0.3)
    for name in ("diffuse", "specular", "dolp", "aolp"):
        np.testing.assert_allclose(getattr(unpack(pack(frame)), name), getattr(frame, name), rtol=5e-4)
    assert np.isfinite(unpack(pack(small_frame(1e6))).diffuse).all()
    assert unpack(pack(frame)).error is None and unpack(pack(frame)).flags is None
    error = np.random.default_rng(0).random((*frame.size, 2), dtype=np.float32) / 100
    whole = replace(frame, error=error, flags=np.arange(error[..., 0].size, dtype=np.uint8).reshape(frame.size) % 4)
    back = unpack(pack(whole))
    assert back.error is not None and pack(whole).size == pack(frame).size + 5 * error[..., 0].size
    np.testing.assert_allclose(back.error, error, rtol=5e-4, atol=1e-7)
    np.testing.assert_array_equal(back.flags, whole.flags)


# Images that edits name.


def add(sessions: Sessions, kind: str, name: str, data: bytes) -> None:
    sent = upload(sessions, name, data)
    sessions.add_image("a", kind, str(sent), name)


def checks(height: int, width: int) -> bytes:
    """A texture as PNG."""
    y, x = np.mgrid[:height, :width] // 4
    return png(np.stack([(x + y) % 2 * 255, 128 + 0 * x, 255 - 20 * (x % 3)], axis=-1).astype(np.uint8))


def test_sent_images_are_used_and_come_with_the_recipe(sessions: Sessions, tmp_path: Path) -> None:
    """The page's files and its recipe are those of `polsep edit`: unpacked, the recipe finds its images."""
    found = opened(sessions)
    page, (height, width) = sessions.find("a"), found.frame.valid.shape
    mask = np.zeros((height, width), np.uint8)
    mask[:, width // 2 :] = 255
    normals = np.rint((sphere((height, width)) + 1) / 2 * 65535).astype(np.uint16)
    add(sessions, "texture", "../my wood.png", checks(40, 64))
    add(sessions, "normals", "n.png", png(normals))
    add(sessions, "mask", "m.png", png(mask))
    names = {kind: sent.name for kind, sent in page.images.items()}
    assert names == {"texture": "my_wood.png", "normals": "n.png", "mask": "m.png"}
    recipe = Recipe((Texture(image=names["texture"], normals=names["normals"], mask=names["mask"]),))
    page.edit(recipe)
    assert page.shown is not None and page.shown.edited is not None
    light = found.small.diffuse + found.small.specular
    np.testing.assert_array_equal(page.shown.edited[:, : width // 2], light[:, : width // 2])
    assert not np.array_equal(page.shown.edited[:, width // 2 :], light[:, width // 2 :])
    archive = page.write("recipe")
    assert archive.name == "shot_1_recipe.zip"
    with zipfile.ZipFile(archive) as packed:
        packed.extractall(tmp_path)
    replayed = read_recipe(tmp_path / "shot_1_recipe.json")
    assert replayed == recipe
    truth = apply(found.frame, replayed, load_work(replayed, tmp_path).maps)
    layers = read_exr_layers(page.write("edited"))
    np.testing.assert_array_equal(layers["diffuse.R"], truth.diffuse[..., 0])
    np.testing.assert_array_equal(layers["specular.R"], found.frame.specular[..., 0])
    page.drop_images()
    assert page.images == {} and page.recipe == Recipe() and page.shown.edited is None
    assert page.write("recipe").suffix == ".json"


def test_images_of_one_name_stay_apart(sessions: Sessions) -> None:
    """A recipe has one image of a name."""
    found = opened(sessions)
    add(sessions, "texture", "a.png", checks(8, 8))
    add(sessions, "mask", "a.png", png(np.zeros(found.frame.valid.shape, np.uint8)))
    assert [sent.name for sent in sessions.find("a").images.values()] == ["a.png", "mask-a.png"]


def bomb() -> bytes:
    """A small PNG that promises 20000 x 20000 pixels."""
    data = bytearray(png(np.zeros((8, 8), np.uint8)))
    data[16:24] = (20000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(data[12:29]).to_bytes(4, "big")
    return bytes(data)


def huge_jpeg() -> bytes:
    """A JPEG whose header promises 60000 x 60000 pixels."""
    data = bytearray(imagecodecs.jpeg8_encode(np.zeros((8, 8), np.uint8)))
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = (60000).to_bytes(2, "big") * 2
    return bytes(data)


@pytest.mark.parametrize(
    ("kind", "name", "data", "said"),
    [
        ("texture", "film.mkv", b"", "film.mkv: expected an image as PNG.* found '.mkv'"),
        ("texture", "t.png", b"hello", "^t.png: expected a PNG file, found text"),
        ("texture", "t.jpg", b"\xff\xd8\xff broken", "^t.jpg: expected an intact JPEG"),
        ("texture", "t.jpg", huge_jpeg(), r"^t.jpg: expected (at most \d+ samples|an intact JPEG file)"),
        ("texture", "t.png", bomb(), r"^t.png: expected at most \d+ samples in a frame, found 20000x20000"),
        ("mask", "m.png", png(np.zeros((5, 7), np.uint8)), "m.png: expected mask of 64x48 pixels .* found 7x5"),
        ("mask", "m.png", checks(48, 64), "^m.png: expected a grey image as mask, found colours"),
        ("normals", "n.png", checks(5, 7), "n.png: expected normals of 64x48 pixels .* found 7x5"),
    ],
)
def test_bad_images_are_refused_in_one_line(sessions: Sessions, kind: str, name: str, data: bytes, said: str) -> None:
    """By their header where that promises too much; the message names the user's file, and nothing is left of it."""
    opened(sessions)
    with pytest.raises(ValueError, match=said) as caught:
        add(sessions, kind, name, data)
    assert "\n" not in str(caught.value) and str(sessions.scratch.root) not in str(caught.value)
    assert sessions.find("a").images == {}


def test_a_bad_image_leaves_the_one_before(sessions: Sessions) -> None:
    """With its file, its edits and the picture; the next good one takes its place, and its file goes."""
    found, page = opened(sessions), sessions.find("a")
    add(sessions, "texture", "t.png", checks(8, 8))
    add(sessions, "mask", "m.png", png(np.full(found.frame.valid.shape, 255, np.uint8)))
    page.edit(recipe := Recipe((Texture(image="t.png", mask="m.png"),)))
    before, shown = dict(page.images), page.shown
    kept = sorted(page.kept.iterdir())
    for kind, name, data in (
        ("texture", "t.png", b"hello"),
        ("texture", "film.mkv", b""),
        ("mask", "m2.png", png(np.zeros((5, 7), np.uint8))),
    ):
        with pytest.raises(ValueError, match=name):
            add(sessions, kind, name, data)
    assert page.images == before and page.recipe == recipe and page.shown is shown
    assert sorted(page.kept.iterdir()) == kept and page.write("recipe").suffix == ".zip"
    add(sessions, "texture", "t.png", checks(16, 16))
    assert page.images["texture"].size == (16, 16) and page.recipe == Recipe()
    assert page.shown is not None and page.shown.edited is None  # until the recipe is said again
    assert page.images["texture"].path.exists() and not before["texture"].path.exists()
    page.edit(recipe)
    page.drop_images()
    assert [path for path in page.kept.rglob("*") if path.suffix == ".png" and "frames" not in path.parts] == []


def test_textures_fit_the_colours_of_the_frame(sessions: Sessions) -> None:
    """A texture in colour is refused for a frame of one channel, before it replaces a grey one."""
    opened(sessions, layout="mono")
    add(sessions, "texture", "grey.png", png(np.full((8, 8), 128, np.uint8)))
    with pytest.raises(ValueError, match=r"expected texture 'c.png' as float32 \[h, w, 1\], found"):
        add(sessions, "texture", "c.png", checks(8, 8))
    assert sessions.find("a").images["texture"].name == "grey.png"


def test_images_need_a_frame_and_an_upload(sessions: Sessions, tmp_path: Path) -> None:
    """No image before a frame, which says how large it must be, and none that was not uploaded."""
    with pytest.raises(ValueError, match="expected a separated frame before its mask"):
        add(sessions, "mask", "m.png", checks(4, 4))
    opened(sessions)
    (tmp_path / "secret.png").write_bytes(checks(4, 4))
    with pytest.raises(InputError, match="expected a file that this page uploaded"):
        sessions.add_image("a", "texture", str(tmp_path / "secret.png"), "t.png")


def test_masks_go_where_frames_do_not_fit(sessions: Sessions) -> None:
    """Another frame of another size has a remark, no mask, and no edit by it; textures stay."""
    found = opened(sessions)
    add(sessions, "texture", "t.png", checks(8, 8))
    add(sessions, "mask", "m.png", png(np.zeros(found.frame.valid.shape, np.uint8)))
    page = sessions.find("a")
    page.edit(Recipe((Texture(image="t.png"), Rougher(mask="m.png"))))
    sent = upload(sessions, "b.png", png(mosaic_codes(64, 96)))
    sessions.open_upload("a", [(str(sent), sent.name)])
    found = page.separate(parse_settings(ANALYTIC))
    assert any("the mask is left out: m.png: expected mask of 48x32" in remark for remark in found.remarks)
    assert list(page.images) == ["texture"] and page.recipe == Recipe((Texture(image="t.png"),))


def test_small_textures_stand_for_large_ones(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> None:
    """A texture is kept at screen size; the file that is handed out is made from all of it."""
    opened(sessions)
    monkeypatch.setattr(images, "TEXTURE", 32)
    add(sessions, "texture", "t.png", checks(64, 96))
    (sent,) = sessions.find("a").images.values()
    assert sent.small.shape == (22, 32, 3) and sent.size == (64, 96)
    whole = images.read_map(sent.path, "texture")
    np.testing.assert_array_equal(sent.small, shrink(whole, 3))
