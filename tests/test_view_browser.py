"""The viewer in Chromium, which may speak to nobody but this machine: files, edits, sequences, and what it leaves."""

from __future__ import annotations

import os
import sys
import time
import zipfile
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
from view_page import (
    DEMO,
    WAIT_MS,
    await_text,
    browser,
    choose,
    fetch,
    folder,
    needs_browser,
    open_demo,
    page,
    send,
    separated,
    set_slider,
    small_frame,
    tab,
    viewer,
)

from polsep import cli
from polsep.io.results.exr import read_exr_layers

__all__ = ["browser", "folder", "page", "viewer"]  # fixtures
pytestmark = needs_browser


def test_one_click_shows_what_polsep_does(page: Any, tmp_path: Path) -> None:
    """The demo capture is separated by the first click; its EXR is the Python result, bit for bit."""
    open_demo(page)
    await_text(page, "#ps-status", "still_life")
    await_text(page, "#ps-status", "color-affine")
    layers = read_exr_layers(fetch(page, "exr", tmp_path))
    truth = separated(imagecodecs.png_decode(DEMO.read_bytes()))
    for k, color in enumerate("RGB"):
        np.testing.assert_array_equal(layers[f"diffuse.{color}"], truth.diffuse[..., k])
        np.testing.assert_array_equal(layers[f"specular.{color}"], truth.specular[..., k])


def test_an_upload_is_separated_compared_edited_and_fetched(page: Any, tmp_path: Path) -> None:
    """A 12-bit raw frame, start to end: the level that the page recommends, the slider, a pixel, an edit, the files."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[512:1280, 600:1624]
    send(page, "shot.png", bytes(imagecodecs.png_encode(np.ascontiguousarray(codes))))
    page.wait_for_selector("#ps-mend-0:visible")
    await_text(page, "#ps-status", "White level 4095")
    await_text(page, "#ps-mend-0", "Use white level 4095")
    page.click("#ps-mend-0")
    page.wait_for_selector("#ps-mend-0", state="hidden")
    page.wait_for_function("document.querySelector('#ps-white input').value === '4095'")
    page.wait_for_function("!document.querySelector('#ps-status').innerText.includes('White level')")
    choose(page, "ps-right", "Specular")
    page.wait_for_selector(".ps-right[alt=Specular]")
    box = page.locator(".ps-stage").bounding_box()
    across, down = box["x"] + box["width"] / 2, box["y"] + box["height"] / 4
    page.mouse.move(across, down)
    page.mouse.down()
    page.mouse.move(across - box["width"] / 4, down, steps=3)
    page.mouse.up()
    assert page.get_attribute(".ps-handle", "aria-valuenow") == "25"
    page.mouse.click(box["x"] + box["width"] * 0.7, down)
    page.wait_for_selector(".ps-readout")
    assert "135°" in page.inner_text(".ps-readout") and page.locator(".ps-mark").count() == 1
    truth = separated(codes)
    layers = read_exr_layers(fetch(page, "exr", tmp_path))
    np.testing.assert_array_equal(layers["specular.G"], truth.specular[..., 1])
    tab(page, "Edit")
    page.click("button:has-text('Strength of highlights')")
    set_slider(page, "ps-specular-gain-gain", 0)
    page.wait_for_selector(".ps-right[alt=Edited]")
    edited = read_exr_layers(fetch(page, "edited", tmp_path))
    np.testing.assert_array_equal(edited["combined.R"], truth.diffuse[..., 0])


def test_a_wrong_file_gives_a_readable_message(page: Any) -> None:
    """What polsep says in one line stands on the page, and the next file works."""
    send(page, "broken.png", b"no picture at all")
    page.wait_for_selector(".ps-error")
    assert page.inner_text(".ps-error") == "broken.png: expected a PNG file, found text"
    open_demo(page)
    assert page.locator(".ps-error").count() == 0


def test_a_dropped_folder_is_the_files_in_it(page: Any, tmp_path: Path) -> None:
    """Its frames are one sequence, whatever else lies there; one without frames is refused in words."""
    film = tmp_path / "film"
    film.mkdir()
    (tmp_path / "empty").mkdir()
    for k in range(3):
        (film / f"s{k}.png").write_bytes(small_frame(4 * k))
    (film / ".DS_Store").write_bytes(b"of another program")
    (film / "notes.txt").write_text("of the owner")
    driver = page.context.new_cdp_session(page)
    for dropped, part, said in (("empty", ".ps-error", "empty: expected"), ("film", "#ps-status", "s0")):
        for kind in ("dragEnter", "dragOver", "drop"):
            data = {"items": [], "files": [str(tmp_path / dropped)], "dragOperationsMask": 1}
            driver.send("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 300, "data": data})
        await_text(page, part, said)
    assert page.locator("#ps-index input[type=number]").get_attribute("max") == "2"


def test_the_picture_follows_the_exposure_slider(page: Any) -> None:
    """Another picture comes for another exposure; `polsep bench view` says how soon."""
    open_demo(page)
    script = """async (value) => {
      const slider = document.querySelector('#ps-stops input[type=range]');
      const source = () => document.querySelector('.ps-left').src;
      const before = source();
      Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set.call(slider, value);
      slider.dispatchEvent(new Event('input', {bubbles: true}));
      while (source() === before) await new Promise(done => setTimeout(done, 2));
      await document.querySelector('.ps-left').decode();
      return source();
    }"""
    pictures = [page.evaluate(script, value) for value in ("1", "-1", "2")]
    assert len(set(pictures)) == 3 and all(picture.startswith("data:image/jpeg") for picture in pictures)


def private(root: Path) -> list[Path]:
    """Files that were sent as private, and folders of pages. A folder that is deleted meanwhile is no error."""
    found = [(Path(folder), [*folders, *files]) for folder, folders, files in os.walk(root)]
    return [at / name for at, names in found for name in names if at == root / "kept" or name.startswith("private")]


def test_a_closed_page_leaves_nothing(browser: Any, viewer: str, folder: Path) -> None:
    """Uploads, and what a session works on and handed out, go when its page does."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[:256, :256]
    context = browser.new_context()
    opened = context.new_page()
    opened.goto(viewer)
    opened.wait_for_selector("#ps-demo", timeout=WAIT_MS)
    send(opened, "private.png", bytes(imagecodecs.png_encode(np.ascontiguousarray(codes))))
    opened.wait_for_selector(".ps-stage", timeout=WAIT_MS)
    with opened.expect_download():
        opened.click("#ps-get-exr")
    (root,) = folder.glob("polsep-view-*")
    assert any(path.name.startswith("private") for path in private(root))
    context.close()
    for _ in range(150):
        left = private(root)
        if not left:
            break
        time.sleep(0.2)
    assert left == []


def test_five_gigabytes_are_refused_by_the_page(page: Any, tmp_path: Path) -> None:
    """Before a byte is sent, and in words; the next file works."""
    large = tmp_path / "large.raw"
    with large.open("wb") as stream:
        stream.truncate(5_000_000_000)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if "upload?" in request.url else None)
    page.set_input_files("#ps-top input[type=file]", large)
    page.wait_for_selector("text=/maximum|exceeds|too large/i")
    assert sent == []
    send(page, "shot.png", small_frame())
    page.wait_for_selector(".ps-stage")


def choose_image(page: Any, kind: str, path: Path) -> None:
    """Send an image for edits."""
    with page.expect_file_chooser() as waiting:
        page.click(f"#ps-image-{kind}")
    waiting.value.set_files(path)


def test_a_sequence_plays_under_edits(page: Any, tmp_path: Path) -> None:
    """Several files are one sequence: it plays, edits are on what plays, a pause has the numbers of its frame."""
    files = [{"name": f"s{k}.png", "mimeType": "image/png", "buffer": small_frame(4 * k)} for k in range(4)]
    choose(page, "ps-white", "4095")
    page.set_input_files("#ps-top input[type=file]", files)
    page.wait_for_selector("#ps-play:visible")
    await_text(page, "#ps-status", "s0")
    page.click("#ps-play")
    index = "document.querySelector('#ps-index input[type=number]').value"
    for place in ("1", "2", "3", "0"):
        page.wait_for_function(f"{index} === '{place}'")
    tab(page, "Edit")
    page.click("button:has-text('Strength of highlights')")
    set_slider(page, "ps-specular-gain-gain", 0)
    page.wait_for_selector(".ps-right[alt=Edited]")
    before = page.get_attribute(".ps-right", "src")
    page.wait_for_function(f"document.querySelector('.ps-right').src !== {before!r}")
    page.click("#ps-play")
    page.wait_for_selector("#ps-play:has-text('Play')")
    for _ in range(100):
        path = fetch(page, "edited", tmp_path)
        place = int(path.name[1])
        shown = page.evaluate(index), page.inner_text("#ps-status")[:2]
        if shown == (str(place), f"s{place}"):  # the numbers of the shown frame are there
            break
        page.wait_for_timeout(100)
    assert shown == (str(place), f"s{place}")
    edited = read_exr_layers(path)
    truth = separated(imagecodecs.png_decode(small_frame(4 * place)))
    np.testing.assert_array_equal(edited["combined.G"], truth.diffuse[..., 1])


def test_a_recipe_with_images_is_replayed_by_the_command(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A texture and a mask that were sent come with the recipe; `polsep edit` makes the same frame of it."""
    choose(page, "ps-white", "4095")
    send(page, "shot.png", small_frame())
    page.wait_for_selector(".ps-stage")
    tab(page, "Edit")
    page.click("button:has-text('Texture under')")
    wood, mask, wrong = tmp_path / "my wood.png", tmp_path / "m.png", tmp_path / "wrong.png"
    rng = np.random.default_rng(0)
    wood.write_bytes(imagecodecs.png_encode(rng.integers(0, 255, (20, 30, 3), np.uint8)))
    mask.write_bytes(imagecodecs.png_encode(rng.integers(0, 255, (160, 192), np.uint8)))
    wrong.write_bytes(imagecodecs.png_encode(np.zeros((5, 7), np.uint8)))
    choose_image(page, "texture", wood)
    page.wait_for_selector(".ps-right[alt=Edited]")
    page.wait_for_selector("#ps-image-texture:has-text('my_wood.png')")
    choose_image(page, "mask", wrong)
    page.wait_for_selector(".ps-error")
    assert page.inner_text(".ps-error").startswith("wrong.png: expected mask of 192x160 pixels")
    choose_image(page, "mask", mask)
    page.wait_for_selector("#ps-image-mask:has-text('m.png')")
    shot, edited, recipe = (fetch(page, kind, tmp_path) for kind in ("exr", "edited", "recipe"))
    with zipfile.ZipFile(recipe) as archive:
        archive.extractall(tmp_path / "at-home")
    options = ["-o", str(tmp_path / "again"), "--recipe", str(tmp_path / "at-home" / "shot_recipe.json")]
    monkeypatch.setattr(sys, "argv", ["polsep", "edit", str(shot), *options])
    cli.main()
    again, shown = read_exr_layers(tmp_path / "again" / "shot.exr"), read_exr_layers(edited)
    assert set(again) == set(shown)
    for name, plane in again.items():
        np.testing.assert_array_equal(plane, shown[name])


def test_a_shape_is_found_and_relit(page: Any) -> None:
    """The demo's surface appears under a lamp that follows the pointer; another frame takes it away."""
    open_demo(page)
    tab(page, "Shape")
    page.click("#ps-find-shape")
    inside = page.frame_locator("#ps-shape iframe")
    inside.locator("canvas[data-ready=yes]").wait_for()
    before = inside.locator("canvas").evaluate("canvas => canvas.toDataURL()")
    inside.locator("canvas").click(position={"x": 60, "y": 60})
    assert inside.locator("canvas").evaluate("canvas => canvas.toDataURL()") != before
    assert "Expected error of normals" in page.locator("#ps-shape").inner_text()
    tab(page, "Settings")
    choose(page, "ps-method", "analytic")
    page.wait_for_function("document.querySelector('#ps-status').innerText.includes('analytic')")
    tab(page, "Shape")
    page.wait_for_function("document.querySelectorAll('#ps-shape iframe').length === 0")
