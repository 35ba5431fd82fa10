"""The viewer in Chromium, which may speak to nobody but this machine."""

from __future__ import annotations

import importlib.util
import shutil
import sys
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
from viewer import running

import polsep
from polsep import cli
from polsep.io.results.exr import read_exr_layers

CHROMIUM = shutil.which("chromium")
READY = CHROMIUM and all(importlib.util.find_spec(name) for name in ("gradio", "playwright"))
pytestmark = pytest.mark.skipif(not READY, reason="needs the extra view, playwright and chromium")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
FLAGS += ["--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"]
DEMO = Path(polsep.__file__).parent / "data" / "still_life.png"
WAIT_MS = 120_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the viewer's temporary files are."""
    return tmp_path_factory.mktemp("view")


@pytest.fixture(scope="module")
def viewer(folder: Path) -> Iterator[str]:
    """A viewer."""
    with running(folder) as address:
        yield address


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@pytest.fixture
def page(browser: Any, viewer: str) -> Iterator[Any]:
    """The page, freshly loaded; afterwards, nothing was asked of anybody else, and no script failed."""
    asked: list[str] = []
    failed: list[str] = []
    context = browser.new_context(viewport={"width": 1440, "height": 900}, accept_downloads=True)
    opened = context.new_page()
    opened.set_default_timeout(WAIT_MS)
    opened.on("request", lambda request: asked.append(request.url))
    opened.on("pageerror", lambda error: failed.append(str(error)))
    opened.goto(viewer)
    opened.wait_for_selector("#ps-demo")
    yield opened
    context.close()
    assert [url for url in asked if not url.startswith((viewer, "data:", "blob:"))] == []
    assert failed == []


def send(page: Any, name: str, data: bytes) -> None:
    """Choose a file."""
    page.set_input_files("#ps-file input[type=file]", {"name": name, "mimeType": "image/png", "buffer": data})


def choose(page: Any, part: str, value: str) -> None:
    """Type into one of the page's lists."""
    field = page.locator(f"#{part} input")
    field.fill(value)
    field.press("Enter")


def fetch(page: Any, kind: str, folder: Path) -> Path:
    """Click a download button."""
    with page.expect_download() as waiting:
        page.click(f"#ps-get-{kind}")
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def test_one_click_shows_what_polsep_does(page: Any, tmp_path: Path) -> None:
    """The demo capture is separated by the first click; its EXR is the Python result, bit for bit."""
    page.click("#ps-demo")
    page.wait_for_selector(".ps-stage")
    assert "still_life" in page.inner_text("#ps-status") and "joint" in page.inner_text("#ps-status")
    layers = read_exr_layers(fetch(page, "exr", tmp_path))
    truth = polsep.separate(imagecodecs.png_decode(DEMO.read_bytes()), white_level=4095)
    for k, color in enumerate("RGB"):
        np.testing.assert_array_equal(layers[f"diffuse.{color}"], truth.diffuse[..., k])
        np.testing.assert_array_equal(layers[f"specular.{color}"], truth.specular[..., k])


def test_an_upload_is_separated_compared_edited_and_fetched(page: Any, tmp_path: Path) -> None:
    """A 12-bit raw frame, start to end: the level that the page recommends, the slider, a pixel, an edit, the files."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[512:1280, 600:1624]
    send(page, "shot.png", bytes(imagecodecs.png_encode(np.ascontiguousarray(codes))))
    page.wait_for_selector("#ps-suggest:visible")
    assert "set White level to 4095" in page.inner_text("#ps-status")
    page.click("#ps-suggest")
    page.wait_for_selector("#ps-suggest", state="hidden")
    page.wait_for_function("!document.querySelector('#ps-status').innerText.includes('set White')")
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
    truth = polsep.separate(codes, white_level=4095)
    layers = read_exr_layers(fetch(page, "exr", tmp_path))
    np.testing.assert_array_equal(layers["specular.G"], truth.specular[..., 1])
    page.get_by_role("tab", name="Edit", exact=True).click()
    field = page.locator("#ps-specular_gain-gain input[type=number], #ps-specular-gain-gain input[type=number]")
    field.fill("0")
    field.press("Enter")
    page.wait_for_selector(".ps-right[alt=Edited]")
    edited = read_exr_layers(fetch(page, "edited", tmp_path))
    np.testing.assert_array_equal(edited["combined.R"], truth.diffuse[..., 0])


def test_a_wrong_file_gives_a_readable_message(page: Any) -> None:
    """What polsep says in one line stands on the page, and the next file works."""
    send(page, "broken.png", b"no picture at all")
    page.wait_for_selector(".ps-error")
    assert page.inner_text(".ps-error") == "broken.png: expected a PNG file, found text"
    page.click("#ps-demo")
    page.wait_for_selector(".ps-stage")
    assert page.locator(".ps-error").count() == 0


def test_the_picture_follows_the_exposure_slider(page: Any) -> None:
    """Another picture comes for another exposure; `polsep bench view` says how soon."""
    page.click("#ps-demo")
    page.wait_for_selector(".ps-stage")
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
    assert list(root.rglob("private*")) != []
    context.close()
    for _ in range(150):
        left = [*root.rglob("private*"), *(root / "kept").iterdir()]
        if not left:
            break
        time.sleep(0.2)
    assert left == []


def small_frame(place: int = 0) -> bytes:
    """A part of the demo capture as a 12-bit PNG."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[812 + 8 * place : 1132 + 8 * place, 140:524]
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(codes)))


def test_twenty_pages_all_finish(browser: Any, viewer: str) -> None:
    """Twenty users ask at once and wait in one queue; each gets a picture of their own frame."""
    contexts = [browser.new_context() for _ in range(20)]
    pages = [context.new_page() for context in contexts]
    for opened in pages:
        opened.set_default_timeout(WAIT_MS)
        opened.goto(viewer)
    for opened in pages:
        opened.wait_for_selector("#ps-demo")
    for place, opened in enumerate(pages):
        send(opened, f"shot{place}.png", small_frame(place))
    for place, opened in enumerate(pages):
        opened.wait_for_selector(".ps-stage")
        assert f"shot{place}" in opened.inner_text("#ps-status") and opened.locator(".ps-error").count() == 0
    for context in contexts:
        context.close()


def test_five_gigabytes_are_refused_by_the_page(page: Any, tmp_path: Path) -> None:
    """Before a byte is sent, and in words; the next file works."""
    large = tmp_path / "large.raw"
    with large.open("wb") as stream:
        stream.truncate(5_000_000_000)
    sent: list[str] = []
    page.on("request", lambda request: sent.append(request.url) if "upload?" in request.url else None)
    page.set_input_files("#ps-file input[type=file]", large)
    page.wait_for_selector("text=/maximum|exceeds|too large/i")
    assert sent == []
    send(page, "shot.png", small_frame())
    page.wait_for_selector(".ps-stage")


def choose_image(page: Any, kind: str, path: Path) -> None:
    """Send an image for edits."""
    with page.expect_file_chooser() as waiting:
        page.click(f"#ps-image-{kind}")
    waiting.value.set_files(path)


@pytest.mark.filterwarnings("ignore::polsep.pipeline.PolsepWarning")
def test_a_sequence_plays_under_edits(page: Any, tmp_path: Path) -> None:
    """Several files are one sequence: it plays, edits are on what plays, a pause has the numbers of its frame."""
    files = [{"name": f"s{k}.png", "mimeType": "image/png", "buffer": small_frame(4 * k)} for k in range(4)]
    choose(page, "ps-white", "4095")
    page.set_input_files("#ps-file input[type=file]", files)
    page.wait_for_selector("#ps-play:visible")
    assert "s0" in page.inner_text("#ps-status")
    page.click("#ps-play")
    index = "document.querySelector('#ps-index input[type=number]').value"
    for place in ("1", "2", "3", "0"):
        page.wait_for_function(f"{index} === '{place}'")
    page.get_by_role("tab", name="Edit", exact=True).click()
    field = page.locator("#ps-specular-gain-gain input[type=number]")
    field.fill("0")
    field.press("Enter")
    page.wait_for_selector(".ps-right[alt=Edited]")
    before = page.get_attribute(".ps-right", "src")
    page.wait_for_function(f"document.querySelector('.ps-right').src !== {before!r}")
    page.click("#ps-play")
    page.wait_for_selector("#ps-play:has-text('Play')")
    page.wait_for_function(f"document.querySelector('#ps-status').innerText.startsWith('s' + {index})")
    edited = read_exr_layers(fetch(page, "edited", tmp_path))
    place = int(page.evaluate(index))
    truth = polsep.separate(imagecodecs.png_decode(small_frame(4 * place)), white_level=4095)
    np.testing.assert_array_equal(edited["combined.G"], truth.diffuse[..., 1])


def test_a_recipe_with_images_is_replayed_by_the_command(
    page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A texture and a mask that were sent come with the recipe; `polsep edit` makes the same frame of it."""
    choose(page, "ps-white", "4095")
    send(page, "shot.png", small_frame())
    page.wait_for_selector(".ps-stage")
    page.get_by_role("tab", name="Edit", exact=True).click()
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
