"""The browser page of web/ in Chromium: the numbers of the library, its warnings, its files, no host but its own."""

from __future__ import annotations

import base64
import importlib.util
import json
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import tifffile
from chromium import WAIT_MS, browser, fresh_page

import polsep
from polsep.io.raw.frames import read_frames
from polsep.io.raw.genicam import pack_frame
from polsep.io.results.exr import read_exr_layers
from polsep.io.store.errors import InputError
from polsep.light.find import find_light
from polsep.light.light_color import resolve_light
from polsep.pipeline import PolsepWarning
from polsep.sensor.black_level import check_black_level
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.defects import measure_noise
from polsep.sensor.encoding import encoding_warning
from polsep.sensor.levels import as_mosaic, level_notes
from polsep.sensor.orient import orient
from tools import web_page
from tools.web_page import CHROMIUM, DEMO, HAS_PACKAGES, NODE, WEB, build_page, change, fetch, send, served

__all__ = ["browser"]  # a fixture
#: Largest difference to the library's images, white = 1.
AGREES = 1e-3
#: Largest size of the page on a host.
LARGEST = 25_000_000
BROKEN = b"\x89PNG and nothing else"
#: Drop files on the page, [name, base64] each, one right after the other.
DROP = """(files) => files.forEach(([name, text]) => {
  const transfer = new DataTransfer();
  transfer.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
  dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, cancelable: true }));
})"""

needs_packages = pytest.mark.skipif(not HAS_PACKAGES, reason="needs node and its packages: npm --prefix web ci")
needs_browser = pytest.mark.skipif(
    CHROMIUM is None or importlib.util.find_spec("playwright") is None, reason="needs playwright and chromium"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page as ``make web`` builds it."""
    pytest.importorskip("onnx", reason="exporting needs the extra 'export'")
    return build_page(tmp_path_factory.mktemp("web"))


@pytest.fixture
def address(site: Path) -> Iterator[str]:
    """The page on a host."""
    with served(site) as found:
        yield found


@pytest.fixture
def page(browser: Any, address: str) -> Iterator[Any]:
    """The page, freshly loaded."""
    with fresh_page(browser, f"{address}?threads=2", 1400) as opened:
        yield opened


def crop() -> np.ndarray[Any, Any]:
    """A part of the demo capture with a highlight, dead pixels and clipped ones."""
    return np.ascontiguousarray(imagecodecs.png_decode(DEMO.read_bytes())[752:1040, 1064:1384])


def separated(codes: Any, method: str, **said: Any) -> Any:
    """A frame by the library."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolsepWarning)
        return polsep.separate(codes, method=method, white_level=4095, **said)


def assert_agrees(path: Path, truth: Any) -> None:
    """Raise unless the layers of an EXR file are the library's images."""
    layers = read_exr_layers(path)
    for k, color in enumerate("RGB"):
        for name in ("diffuse", "specular"):
            np.testing.assert_allclose(layers[f"{name}.{color}"], getattr(truth, name)[..., k], rtol=0, atol=AGREES)
        np.testing.assert_allclose(layers[color], layers[f"diffuse.{color}"] + layers[f"specular.{color}"], atol=1e-6)
    np.testing.assert_array_equal(layers["valid.Y"] > 0, truth.valid)
    # Where there is no light, polarization is that of rounding.
    lit = (truth.diffuse + truth.specular).mean(axis=-1) > AGREES
    np.testing.assert_allclose(layers["dolp.Y"][lit], truth.dolp[lit], rtol=0, atol=AGREES)
    assert np.abs(np.sin(layers["aolp.Y"] - truth.aolp))[lit & (truth.dolp > 0.05)].max() < 1e-2
    if truth.error is not None:
        np.testing.assert_allclose(layers["error.specular"], truth.error[..., 1], rtol=0.01, atol=AGREES)


@needs_packages
@needs_browser
def test_the_page_gives_what_the_library_gives(page: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A 12-bit frame, start to end: the level that the page recommends, both methods, a lamp's colour, the files."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    codes = crop()
    codes[100, 100:102] = 0, 4095  # two dead pixels in a dark part
    send(page, "shot.png", bytes(imagecodecs.png_encode(codes)))
    assert "looks like 12-bit right-justified data" in page.inner_text("#notes")
    change(page, lambda: page.click("text=Use white level 4095"))
    assert page.locator("#notes li").count() == 0
    assert_agrees(fetch(page, "exr", tmp_path), separated(codes, "joint-fast"))
    change(page, lambda: page.select_option("#light", "stated"))
    page.fill("#color", "160,200,250")
    change(page, lambda: page.press("#color", "Enter"))
    lit = separated(codes, "joint-fast", light_color=(0.8, 1, 1.25))
    assert_agrees(fetch(page, "exr", tmp_path), lit)
    change(page, lambda: page.select_option("#method", "analytic"))
    truth = separated(codes, "analytic", light_color=(0.8, 1, 1.25))
    assert_agrees(fetch(page, "exr", tmp_path), truth)
    linear = imagecodecs.png_decode(fetch(page, "specular", tmp_path).read_bytes())
    assert linear.dtype == np.uint16
    np.testing.assert_allclose(linear / 65535 * 2, truth.specular.clip(0, 2), rtol=0, atol=AGREES)
    shown = imagecodecs.png_decode(fetch(page, "right", tmp_path).read_bytes())
    assert shown.shape[:2] == truth.valid.shape and shown.dtype == np.uint8
    assert page.evaluate("crossOriginIsolated")
    page.fill("#black", "20")  # the click on the menu leaves the field, and the file waits for what that changes
    darker = separated(codes, "analytic", light_color=(0.8, 1, 1.25), black_level=20)
    assert_agrees(fetch(page, "exr", tmp_path), darker)


@needs_packages
@needs_browser
def test_orders_of_filters_are_checked_and_kept(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A crop off the period: the page says which layout fits, and turns the frame for the network as polsep does."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    codes = np.ascontiguousarray(imagecodecs.png_decode(DEMO.read_bytes())[741:1301, 1067:1467])
    page.fill("#white", "4095")
    page.press("#white", "Enter")  # else leaving the field is a change of its own, later
    send(page, "cropped.png", bytes(imagecodecs.png_encode(codes)))
    with pytest.warns(PolsepWarning, match="contradicts layout") as said:
        polsep.separate(codes, "analytic", white_level=4095)
    (line,) = (str(one.message) for one in said if "contradicts" in str(one.message))
    wanted = line.partition("--layout ")[2].split()[0]
    change(page, lambda: page.click(f"text=Use {wanted}"))
    assert "contradicts" not in page.inner_text("#notes")
    found = page.evaluate("({d: Array.from(window.polsep.images.diffuse), a: Array.from(window.polsep.images.aolp)})")
    truth = separated(codes, "joint-fast", layout=wanted)
    np.testing.assert_allclose(np.reshape(found["d"], truth.diffuse.shape), truth.diffuse, rtol=0, atol=AGREES)
    strong = (truth.dolp > 0.05) & (truth.specular[..., 0] > AGREES)
    assert np.abs(np.sin(np.reshape(found["a"], truth.aolp.shape) - truth.aolp))[strong].max() < 1e-2


@needs_packages
@needs_browser
def test_files_chosen_at_work_wait_and_the_last_one_wins(page: Any) -> None:
    """Three files, one right after the other: nothing is lost but what nobody waits for any more."""
    page.fill("#white", "4095")
    page.press("#white", "Enter")
    codes = crop()
    for k, rows in enumerate((288, 200, 120)):
        png = bytes(imagecodecs.png_encode(np.ascontiguousarray(codes[:rows])))
        page.set_input_files("#file", {"name": f"{k}.png", "mimeType": "image/png", "buffer": png})
    page.wait_for_function("document.getElementById('status').textContent.match(/^2.png .* s$/)")
    assert page.evaluate("[polsep.images.height, document.body.dataset.state]") == [60, "done"]


def shot(rows: int = 64) -> bytes:
    """A PNG file of the first rows of `crop`, to be told from others by its height."""
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(crop()[:rows])))


def state_of(page: Any) -> Any:
    """The state that the page is in, and the height of its images."""
    return page.evaluate("[document.body.dataset.state, window.polsep?.images.height]")


def ask_format(page: Any, name: str, data: bytes) -> None:
    """Give the page a file without a header, and wait until it asks for its format."""
    page.set_input_files("#file", {"name": name, "mimeType": "", "buffer": data})
    page.wait_for_selector("#raw:visible")


def state_format(page: Any, width: int, height: int) -> None:
    """Answer the page, and wait for what it makes of that."""
    page.fill("#width", str(width))
    page.fill("#height", str(height))
    change(page, lambda: page.click("#raw button"))


@needs_packages
@needs_browser
def test_a_file_that_fails_leaves_the_one_before(page: Any, tmp_path: Path) -> None:
    """Its name, its files and its settings stay, and so does what is said of the other one."""
    page.select_option("#method", "analytic")
    send(page, "good.png", shot())
    change(page, lambda: page.click("text=Use white level 4095"))
    send(page, "broken.png", BROKEN)
    said = page.inner_text("#notes")
    assert said.startswith("broken.png: expected a complete PNG file") and page.input_value("#white") == "4095"
    assert page.inner_text("#status").startswith("good.png · 160×32 · ")  # of the picture that stays
    assert fetch(page, "exr", tmp_path).name == "good.exr"
    change(page, lambda: page.select_option("#light", "white"))
    assert page.inner_text("#status").startswith("good.png · ") and page.inner_text("#notes") == said
    ask_format(page, "other.raw", pack_frame(crop()[:96], "BayerRG12p"))
    page.select_option("#light", "auto")  # of the file to come
    assert state_of(page) == ["asking", 32] and page.inner_text("#status").startswith("other.raw: ")
    assert fetch(page, "exr", tmp_path).name == "good.exr"
    state_format(page, 320, 95)
    assert page.inner_text("#notes").startswith("other.raw: expected 45600 bytes for 320x95 BayerRG12p, found 46080")
    state_format(page, 320, 96)  # it may be put right
    assert state_of(page) == ["done", 48] and page.is_hidden("#raw") and "other.raw" not in page.inner_text("#notes")
    assert fetch(page, "exr", tmp_path).name == "other.exr"


@needs_packages
@needs_browser
def test_tiny_frames_are_separated_as_the_library_does(page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """From one period of the filters on, 4x4 samples in colour and 2x2 in mono; less is refused in the same words."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    for sensor, method, (height, width) in (
        ("color", "joint-fast", (4, 4)),
        ("color", "analytic", (7, 9)),
        ("mono", "joint-fast", (3, 2)),
        ("mono", "analytic", (40, 4)),
    ):
        codes = np.ascontiguousarray(crop()[:height, :width])
        page.select_option("#method", method)
        send(page, "tiny.png", bytes(imagecodecs.png_encode(codes)))
        page.evaluate("document.getElementById('white').value = '4095'")
        change(page, lambda sensor=sensor: page.select_option("#sensor", sensor))
        truth = separated(codes, method, layout=sensor)
        found = page.evaluate("Array.from(window.polsep.images.diffuse)")
        np.testing.assert_allclose(np.reshape(found, truth.diffuse.shape), truth.diffuse, rtol=0, atol=AGREES)
    send(page, "less.png", bytes(imagecodecs.png_encode(np.ascontiguousarray(crop()[:3, :8]))))
    with pytest.raises(ValueError, match="at least 4x4 pixels") as said:
        separated(crop()[:3, :8], "analytic")
    assert page.inner_text("#notes") == f"less.png: {said.value}"


@needs_packages
@needs_browser
def test_a_file_whose_format_nobody_says_leaves_settings(page: Any) -> None:
    """Those of the frame that is shown come back when another file takes the place of the one that was asked about."""
    page.select_option("#method", "analytic")
    send(page, "good.png", shot())
    change(page, lambda: page.click("text=Use white level 4095"))
    ask_format(page, "other.raw", pack_frame(crop()[:96], "BayerRG12p"))
    change(page, lambda: page.click("#leave"))
    assert page.input_value("#white") == "4095" and page.is_hidden("#raw")
    assert page.inner_text("#status").startswith("good.png · 160×32 · ")
    ask_format(page, "other.raw", pack_frame(crop()[:96], "BayerRG12p"))
    assert page.input_value("#white") == ""
    send(page, "broken.png", BROKEN)
    assert page.input_value("#white") == "4095" and page.is_hidden("#raw")
    change(page, lambda: page.select_option("#light", "white"))
    assert page.evaluate("polsep.report.white_level") == 4095
    page.fill("#white", "0")
    change(page, lambda: page.press("#white", "Enter"))
    assert "expected a white level above the black level, found white 0, black 0" in page.inner_text("#notes")


@needs_packages
@needs_browser
@pytest.mark.parametrize("missing", ["worker.js", "network.js", "ort-cpu.bin"])
def test_a_host_without_a_part_of_the_page_is_told(browser: Any, site: Path, tmp_path: Path, missing: str) -> None:
    """Every file fails with the name of what is missing: none waits for workers that never started."""
    copied = tmp_path / "site"
    copied.mkdir()
    for path in site.iterdir():
        if path.name != missing:
            (copied / path.name).symlink_to(path)
    with served(copied) as address, fresh_page(browser, f"{address}?threads=2&plain", 800) as opened:
        for name in ("first.png", "second.png"):
            send(opened, name, shot())
            assert opened.inner_text("#notes").startswith(f"{name}: expected {missing} beside the page, found")


@needs_packages
@needs_browser
def test_a_folder_or_several_files_are_not_a_frame(page: Any, tmp_path: Path) -> None:
    """Dropped on the page, they are refused: nothing is taken for all of them."""
    files = [str(tmp_path / name) for name in ("0.png", "45.png")]
    for path in files:
        Path(path).write_bytes(shot())
    driver = page.context.new_cdp_session(page)
    for dropped, said in ((files, "0.png: expected one raw frame, found 2 files"), ([str(tmp_path)], "found a folder")):
        for kind in ("dragEnter", "dragOver", "drop"):
            data = {"items": [], "files": dropped, "dragOperationsMask": 1}
            driver.send("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 300, "data": data})
        page.wait_for_selector(f"#notes li:has-text({said!r})")
        assert state_of(page) == ["failed", None]


@needs_packages
@needs_browser
def test_settings_wait_for_a_frame(page: Any) -> None:
    """Of a first file that cannot be read, or of one whose format is still asked for, nothing is separated."""
    page.select_option("#method", "analytic")
    send(page, "broken.png", BROKEN)
    page.select_option("#light", "white")
    assert page.inner_text("#notes").startswith("broken.png: expected") and state_of(page) == ["failed", None]
    ask_format(page, "first.raw", pack_frame(crop()[:96], "BayerRG12p"))
    page.fill("#white", "4000")
    page.press("#white", "Enter")
    assert page.locator("#notes li").count() == 0 and state_of(page) == ["asking", None]
    state_format(page, 320, 96)
    assert page.evaluate("[polsep.report.white_level, polsep.report.light.source]") == [4000, "stated"]


@needs_packages
@needs_browser
def test_the_files_of_the_page_are_of_what_it_shows(page: Any, tmp_path: Path) -> None:
    """Two files at once while a third is shown, the last one broken: the one between is shown and written."""
    page.select_option("#method", "analytic")
    send(page, "shown.png", shot())
    page.evaluate("document.body.dataset.state = 'sent'")
    files = [("between.png", shot(96)), ("broken.png", BROKEN)]
    page.evaluate(DROP, [[name, base64.b64encode(data).decode()] for name, data in files])
    page.wait_for_selector("body[data-state=failed]")
    assert state_of(page) == ["failed", 48] and page.inner_text("#notes").startswith("broken.png: ")
    path = fetch(page, "exr", tmp_path)
    assert path.name == "between.exr" and read_exr_layers(path)["valid.Y"].shape == (48, 160)


@needs_packages
@needs_browser
def test_another_file_has_settings_of_its_own(page: Any) -> None:
    """The example's level, and what was said of it, do not stay for the next file; the method does."""
    page.select_option("#method", "analytic")
    change(page, lambda: page.click("#example"))
    assert page.input_value("#white") == "4095" and page.locator("#notes li").count() == 0
    change(page, lambda: page.select_option("#light", "stated"))
    send(page, "next.png", shot())
    assert "looks like 12-bit right-justified data" in page.inner_text("#notes")
    found = [page.input_value(f"#{name}") for name in ("white", "black", "sensor", "light", "method")]
    assert found == ["", "", "", "auto", "analytic"] and page.is_hidden("#rgb")


@needs_packages
@needs_browser
def test_the_numbers_of_a_pixel_are_of_the_picture(page: Any) -> None:
    """Also after the frame was separated anew, while the pointer was elsewhere."""
    page.select_option("#method", "analytic")
    send(page, "shot.png", shot())
    page.hover("#canvas", position={"x": 300, "y": 425})  # beside the line
    before = page.inner_text("#readout")
    change(page, lambda: page.click("text=Use white level 4095"))
    after = page.inner_text("#readout")
    assert before.startswith("row ") and after.split()[:4] == before.split()[:4] and after != before
    values = "Array.from(polsep.images.diffuse.subarray(3 * k, 3 * k + 3), (own) => own.toFixed(3)).join(' ')"
    row, column = (int(after.split()[place].strip(",")) for place in (1, 3))
    assert f"diffuse {page.evaluate(f'((k) => {values})({row * 160 + column})')}" in after.splitlines()


@needs_packages
@needs_browser
def test_going_back_to_the_page_begins_anew(page: Any) -> None:
    """The browser does not fill in the level and the filters of the file before, which another file may not have."""
    page.select_option("#sensor", "other")
    page.select_option("#light", "stated")
    for part, value in (("white", "4095"), ("black", "20"), ("layout", "0,45,90,135/RGGB")):
        page.fill(f"#{part}", value)
    page.goto("about:blank")
    page.go_back()
    page.wait_for_selector("body[data-state=ready]")
    found = [page.input_value(f"#{part}") for part in ("white", "black", "layout", "sensor", "light")]
    assert found == ["", "", "", "", "auto"]


@needs_packages
@needs_browser
def test_what_is_no_number_is_refused(page: Any) -> None:
    """Chromium lets 4e stand in a field of numbers, and says that nothing is there."""
    page.select_option("#method", "analytic")
    send(page, "shot.png", shot())
    change(page, lambda: page.click("text=Use white level 4095"))
    page.focus("#white")
    page.keyboard.press("Control+A")
    page.keyboard.type("4e")
    change(page, lambda: page.keyboard.press("Enter"))
    assert page.inner_text("#notes") == "shot.png: expected a number as white level, found text that is none"


@needs_packages
@needs_browser
def test_the_menu_of_downloads_closes(page: Any) -> None:
    """With a click or the keyboard elsewhere; Escape and a download give the keyboard back to its button."""
    page.select_option("#method", "analytic")
    send(page, "shot.png", shot())
    page.click("#download summary")
    page.mouse.click(300, 500)
    assert page.is_hidden("[data-format=exr]")
    page.click("#download summary")
    page.focus("[data-format=exr]")
    page.keyboard.press("Escape")
    assert page.is_hidden("[data-format=exr]") and page.evaluate("document.activeElement.tagName") == "SUMMARY"
    page.keyboard.press("Enter")
    page.focus("[data-format=right]")
    with page.expect_download():
        page.keyboard.press("Enter")
    assert page.is_hidden("[data-format=exr]") and page.evaluate("document.activeElement.tagName") == "SUMMARY"
    page.keyboard.press("Enter")
    page.focus("[data-format=right]")
    page.keyboard.press("Tab")
    assert page.is_hidden("[data-format=exr]")


@needs_browser
def test_a_new_build_is_kept_whole(browser: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service worker does not keep what the browser's own cache still has of the build before."""

    class Remembered(web_page.Handler):
        """A host whose files are good for an hour."""

        def end_headers(self) -> None:
            """Add that."""
            self.send_header("Cache-Control", "max-age=3600")
            super().end_headers()

    monkeypatch.setattr(web_page, "Handler", Remembered)
    worker = (WEB / "src" / "sw.js").read_text().replace("VERSION", "1").replace("FILES_OF_THE_PAGE", '["part.txt"]')
    page, other = "<!doctype html><title>a page</title>", "of another page of this host"
    texts = {"index.html": page, "part.txt": "old", "other.txt": other}
    for name, text in (texts | {"sw.js": worker.replace("FILES_FOR_SOME", '["large.txt"]')}).items():
        (tmp_path / name).write_text(text)
    with served(tmp_path) as address, fresh_page(browser, address, 800) as opened:
        read = "fetch('part.txt').then((answer) => answer.text())"
        assert opened.evaluate(read) == "old"
        (tmp_path / "part.txt").write_text("new")
        assert opened.evaluate(read) == "old"
        opened.evaluate("navigator.serviceWorker.register('sw.js').then(() => 0)")
        opened.evaluate("navigator.serviceWorker.ready.then(() => 0)")
        assert opened.evaluate("caches.match('part.txt').then((found) => found.text())") == "new"
        opened.reload()
        assert opened.evaluate(read) == "new"
        opened.evaluate("fetch('other.txt').then((answer) => answer.text())")
        assert opened.evaluate("caches.match('other.txt').then((found) => found === undefined)")


@needs_packages
@needs_browser
def test_the_page_works_without_its_host(browser: Any, site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loaded once, it needs nobody: not its host either. Packed frames are read by the format that is stated."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    context = browser.new_context(viewport={"width": 390, "height": 844})
    opened = context.new_page()
    opened.set_default_timeout(WAIT_MS)
    with served(site) as address:
        opened.goto(address)
        opened.evaluate("navigator.serviceWorker.ready.then(() => 0)")
    opened.reload()
    codes = crop()
    opened.set_input_files("#file", {"name": "a.raw", "mimeType": "", "buffer": pack_frame(codes, "BayerRG12p")})
    opened.wait_for_selector("#raw:visible")
    for part, value in (("width", codes.shape[1]), ("height", codes.shape[0])):
        opened.fill(f"#{part}", str(value))
    change(opened, lambda: opened.click("#raw button"))
    found = opened.evaluate("Array.from(window.polsep.images.specular)")
    truth = separated(codes, "joint-fast").specular
    np.testing.assert_allclose(np.reshape(found, truth.shape), truth, rtol=0, atol=AGREES)
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    send(opened, "broken.png", BROKEN)
    assert "expected a complete PNG file" in opened.inner_text("#notes")
    context.close()


def lost_bits(name: str) -> int:
    """Bits that a file called so has less than 12."""
    return 4 if "8" in name else 2 if "10" in name else 0


@needs_packages
def test_files_are_read_as_the_library_reads_them(tmp_path: Path) -> None:
    """TIFF of every compression and depth, and every packing of GenICam, sample by sample."""
    codes = crop()[:50, :70]
    writings: dict[str, dict[str, Any]] = {
        "plain": {"byteorder": ">"},
        "lzw": {"compression": "lzw", "predictor": True, "rowsperstrip": 7},
        "deflate": {"compression": "zlib", "tile": (16, 32)},
        "packbits": {"compression": "packbits"},
    }
    for name, how in writings.items():
        tifffile.imwrite(tmp_path / f"{name}.tif", codes, photometric="minisblack", **how)
    tifffile.imwrite(tmp_path / "8.tif", (codes >> 4).astype(np.uint8), photometric="minisblack", compression="lzw")
    formats = ["Mono16", "Mono12p", "Mono12Packed", "BayerRG12p", "Mono10p", "Mono10Packed", "Mono8"]
    for name in formats:
        (tmp_path / f"{name}.raw").write_bytes(pack_frame(codes >> lost_bits(name), name))
    script = f"""
      import {{ readFileSync, readdirSync }} from "node:fs";
      import {{ readFrame }} from {json.dumps((WEB / "src" / "read.js").as_uri())};
      const found = {{}};
      for (const name of readdirSync(".").filter((own) => /tif|raw/.test(own))) {{
        const stated = name.endsWith("raw") && {{ format: name.split(".")[0], width: 70, height: 50 }};
        const {{ data, width, height, white }} = readFrame(name, new Uint8Array(readFileSync(name)), stated);
        found[name] = {{ data: Array.from(data), width, height, white }};
      }}
      console.log(JSON.stringify(found));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    found = json.loads(done.stdout)
    assert len(found) == len(writings) + len(formats) + 1
    for name, frame in found.items():
        np.testing.assert_array_equal(np.reshape(frame["data"], (50, 70)), codes >> lost_bits(name), err_msg=name)


def write_damaged_tiff(folder: Path, codes: Any) -> list[str]:
    """TIFF files of every compression that end early, or whose strips do, or lie nowhere, or changed; their names."""
    names = []
    for kind in ("none", "lzw", "zlib", "packbits"):
        path = folder / f"{kind}.tif"
        tifffile.imwrite(path, codes, photometric="minisblack", compression=kind, rowsperstrip=25, metadata=None)
        whole = path.read_bytes()
        with tifffile.TiffFile(path) as file:
            last = file.pages[0].dataoffsets[1]
            seconds = [(tag.valueoffset, tag.valuebytecount // 2) for tag in map(file.pages[0].tags.get, (273, 279))]
        (offset, long), (count, short) = seconds
        damages = {
            "cut": (len(whole) - 600, b""),
            "header": (60, b""),
            "nowhere": (offset + long, bytes(long) + whole[offset + 2 * long :]),
            "short": (count + short, (100).to_bytes(short, "little") + whole[count + 2 * short :]),
            "changed": (last + 300, bytes(20) + whole[last + 320 :]),
        }
        for damage, (at, rest) in damages.items():
            if (kind, damage) not in (("none", "changed"), ("packbits", "changed")):  # of which nothing tells
                names.append(f"{kind}_{damage}.tif")
                (folder / names[-1]).write_bytes(whole[:at] + rest)
    return names


@needs_packages
def test_files_that_the_library_refuses_are_refused(tmp_path: Path) -> None:
    """Damage that only checksums show, TIFF of other meanings or several pages; names of bytes are no headers."""
    codes = crop()[:50, :70]
    whole = bytearray(imagecodecs.png_encode(codes, level=0))
    (tmp_path / "whole.png").write_bytes(whole)
    whole[len(whole) // 2] ^= 1
    (tmp_path / "damaged.png").write_bytes(whole)
    tifffile.imwrite(tmp_path / "negative.tif", codes, photometric="miniswhite")
    tifffile.imwrite(tmp_path / "pages.tif", np.stack([codes] * 4), photometric="minisblack")
    tifffile.imwrite(tmp_path / "turned.tif", codes, photometric="minisblack", extratags=[(274, 3, 1, 6, True)])
    (tmp_path / "II.raw").write_bytes(b"II" + bytes(62))
    large = imagecodecs.png_encode(np.zeros((8, 8), np.uint8)).replace(bytes([0, 0, 0, 8] * 2), b"\0\0\x40\0" * 2)
    (tmp_path / "large.png").write_bytes(large)
    tifffile.imwrite(tmp_path / "large.tif", np.zeros((6000, 6000), np.uint8), compression="zlib")
    damaged = write_damaged_tiff(tmp_path, codes)
    others = {"photo.png": b"\xff\xd8\xff\xe0", "shot.tiff": b"raw samples", "shot.npy": b"\x93NUMPY", "empty.raw": b""}
    for name, data in others.items():
        (tmp_path / name).write_bytes(data)
    names = [
        *others,
        "large.png",
        "large.tif",
        "whole.png",
        "damaged.png",
        "negative.tif",
        "pages.tif",
        "turned.tif",
        "II.raw",
        *damaged,
    ]
    script = f"""
      import {{ readFileSync }} from "node:fs";
      import {{ readFrame }} from {json.dumps((WEB / "src" / "read.js").as_uri())};
      const said = {{}}, stated = {{ format: "Mono8", width: 8, height: 8 }};
      for (const name of {json.dumps(names)})
        try {{
          said[name] = readFrame(name, new Uint8Array(readFileSync(name)), stated).notes.join();
        }} catch (error) {{
          said[name] = error.message;
        }}
      console.log(JSON.stringify(said));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    said = json.loads(done.stdout)
    assert "complete PNG file" in said["damaged.png"] and "photometric 0" in said["negative.tif"]
    assert said["pages.tif"] == "expected a TIFF file of one picture, found several"
    assert said["turned.tif"] == next(read_frames(tmp_path / "turned.tif")).notes[0]
    assert said["whole.png"] == said["II.raw"] == ""
    for name, side in (("large.png", 16384), ("large.tif", 6000)):  # before anything of that size is made
        assert said[name] == f"expected a frame of at most 30 million samples, found {side}x{side}"
    assert said["empty.raw"] == "expected a raw frame, found an empty file" and said["shot.npy"].endswith("found .npy")
    assert "as the name says" in said["photo.png"] and "as the name says" in said["shot.tiff"]
    for name in damaged:
        with pytest.raises(InputError):
            next(read_frames(tmp_path / name))
        assert said[name].startswith("expected"), name


@needs_packages
@pytest.mark.parametrize("angles", ["90,45,135,0", "0,90,45,135", "0,45,90,135"])
def test_gamma_is_seen_in_all_orders_of_analysers(angles: str, tmp_path: Path) -> None:
    """As the library sees it: crossed pairs on diagonals, in rows and in columns of a cell."""
    sony, places = (90, 45, 135, 0), [divmod(k, 2) for k in range(4)]
    codes = (
        (255 * (imagecodecs.png_decode(DEMO.read_bytes())[400:1424, 600:1624] / 4095) ** (1 / 2.2))
        .round()
        .astype(np.uint8)
    )
    turned = np.zeros_like(codes)
    for place, angle in zip(places, map(int, angles.split(",")), strict=True):
        source = places[sony.index(angle)]
        turned[place[0] :: 2, place[1] :: 2] = codes[source[0] :: 2, source[1] :: 2]
    layout = f"{angles}/RGGB"
    expected = encoding_warning(as_mosaic(turned, Layout.parse(layout))[0])
    assert expected is not None
    (tmp_path / "frame").write_bytes(turned.tobytes())
    script = f"""
      import {{ readFileSync }} from "node:fs";
      import {{ encodingWarning }} from {json.dumps((WEB / "src" / "encoding.js").as_uri())};
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      const [height, width] = {json.dumps(turned.shape)}, data = Float32Array.from(readFileSync("frame"));
      const mosaic = {{ data, height, width, layout: parseLayout({json.dumps(layout)}), black: 0, white: 255 }};
      console.log(JSON.stringify(encodingWarning(mosaic)));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    assert json.loads(done.stdout) == expected


@needs_packages
def test_the_page_finds_the_lamp_that_the_library_finds(tmp_path: Path) -> None:
    """Lamps of a sensor without balance, a bulb, two that no light is like, and light that one colour alone sees."""
    gains = [(1, 1, 1), (0.55, 1, 0.65), (1, 0.625, 0.3), (0.3, 1, 0.3), (1, 0.4, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
    gains.append((0.002, 0.002, 0.002))  # too dark to look for it
    codes, layout = crop(), Layout()
    rows, cols = np.indices(codes.shape)
    channel = np.array([own for row in layout.table() for _, own in row]).reshape(4, 4)[rows % 4, cols % 4]
    frames = [(codes * np.array(own)[channel]).astype(np.uint16) for own in gains]
    (tmp_path / "frames").write_bytes(b"".join(one.astype("<u2").tobytes() for one in frames))
    script = f"""
      import {{ readFileSync }} from "node:fs";
      import {{ findLight }} from {json.dumps((WEB / "src" / "light.js").as_uri())};
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      const [height, width] = {json.dumps(codes.shape)}, bytes = readFileSync("frames"), layout = parseLayout("color");
      const all = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.length / 2);
      console.log(JSON.stringify(Array.from({{ length: all.length / height / width }}, (_, k) => {{
        const data = Float32Array.from(all.subarray(k * height * width, (k + 1) * height * width));
        return findLight({{ data, height, width, layout, black: 0, white: 4095 }});
      }})));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    for own, one, found in zip(gains, frames, json.loads(done.stdout), strict=True):
        light = find_light(one, white_level=4095)
        np.testing.assert_allclose(found["color"], light.color, rtol=1e-3, err_msg=str(own))
        assert found["error_deg"] == pytest.approx(light.error_deg, rel=0.01), own
        assert found["sure"] == light.sure, own
        remarks = [text.replace("--light-color", "the lamp's colour").replace("--m", "m") for text in light.remarks]
        assert found["remarks"] == remarks


@needs_packages
def test_a_lamp_that_is_stated_is_taken_as_the_library_takes_it() -> None:
    """In any unit, and of a mono frame with a remark; what is no colour is refused."""
    said: list[Any] = ["auto", "white", [2, 1.8, 1.4], [3, 3, 3], [1, 2], [1, 0, 1]]
    script = f"""
      import {{ lightOf }} from {json.dumps((WEB / "src" / "light.js").as_uri())};
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      const data = new Float32Array(256).fill(9), sides = {{ data, height: 16, width: 16, black: 0, white: 4095 }};
      const of = (run) => {{ try {{ return run(); }} catch (error) {{ return error.message; }} }};
      console.log(JSON.stringify(["color", "mono"].map((layout) => {json.dumps(said)}.map((light) =>
        of(() => lightOf(light, {{ ...sides, layout: parseLayout(layout) }}))))));"""
    done = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, check=True, timeout=60)
    for layout, lights in zip(("color", "mono"), json.loads(done.stdout), strict=True):
        mosaic = Mosaic(np.full((16, 16), 9, np.float32), Layout.parse(layout), 0.0, 4095.0)
        for light, found in zip(said, lights, strict=True):
            if isinstance(found, str):
                with pytest.raises(ValueError, match=found.partition(", found")[0]):
                    resolve_light(light, mosaic)
                continue
            color, facts, remarks = resolve_light(light, mosaic)
            assert found["color"] == pytest.approx(color) and found["source"] == facts["source"]
            assert found["remarks"] == [text.replace("--light-color", "the lamp's colour") for text in remarks]
        assert sum(isinstance(found, str) for found in lights) == 2


@needs_packages
def test_the_page_finds_the_noise_that_the_library_finds(tmp_path: Path) -> None:
    """Of codes at the left of a word, below a black level that is too high, and below one whose noise has tails."""
    light = np.maximum(np.arange(320) - 80, 0) * 12.0
    noisy = np.random.default_rng(0).normal(240 + light, np.sqrt(0.4 * light + 16), (288, 320)).round()
    above, cases = crop() * 15 // 16 + 240, list[tuple[Any, float, float]]()
    cases += [(16 * above, 0, 65520), (above, 300, 4095), (noisy, 240, 4095), (16 * noisy, 0, 65520)]
    (tmp_path / "frames").write_bytes(b"".join(np.float32(codes).tobytes() for codes, *_ in cases))
    script = f"""
      import {{ readFileSync }} from "node:fs";
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      import {{ checkBlackLevel, measureNoise }} from {json.dumps((WEB / "src" / "noise.js").as_uri())};
      const bytes = readFileSync("frames"), all = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
      console.log(JSON.stringify({json.dumps([levels for _, *levels in cases])}.map(([black, white], k) => {{
        const data = all.subarray(k * 288 * 320, (k + 1) * 288 * 320), layout = parseLayout("color");
        const mosaic = {{ data, height: 288, width: 320, layout, black, white }};
        const {{ gain, floor }} = measureNoise(mosaic);
        return [gain, floor, checkBlackLevel(mosaic)?.text ?? null];
      }})));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    warned = []
    for (codes, black, white), (gain, floor, text) in zip(cases, json.loads(done.stdout), strict=True):
        mosaic = Mosaic(np.float32(codes), Layout(), black, white)
        noise, warning = measure_noise(mosaic, np.float32(codes)), check_black_level(mosaic).warning
        assert (gain, floor) == pytest.approx((noise.gain, noise.floor), rel=1e-3), (black, white)
        assert text == (warning and warning.replace("--black-level", "black level"))
        warned.append(warning is not None)
    assert warned == [False, True, False, True]


@needs_packages
@pytest.mark.parametrize("spec", ["90,45,-45,180/RGGB", "270,45.5,135,0/GRBG@0,1"])
def test_layouts_are_read_as_the_library_reads_them(spec: str) -> None:
    """Angles are kept from 0 to 180 degrees: -45 is Sony's 135, which the network knows."""
    script = f"""
      import {{ parseLayout, specOf }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      console.log(specOf(parseLayout({json.dumps(spec)})));"""
    done = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, check=True, timeout=60)
    assert done.stdout.decode().strip() == Layout.parse(spec).spec


@needs_packages
def test_layouts_are_refused_in_the_words_of_the_library() -> None:
    """Text that is no layout, and filters that the network does not know."""
    said = ["90,45,135/RGGB", "90,45,135,0", "90,45,135,0/", "90,,135,0/RGGB", "90,45,135,x/mono", "90,45,135,0/RGGB@1"]
    said += ["90,45.5,135,225.5/RGGB", "0,45,90,180/mono", "90,45,135,0/RGBG", "90,45,135,0/RGGB@2,0", "color "]
    said += ["90,45,135,0/mono@0,1", "", "90,45,135,0/rggb", "90,45,135,0/RGGB@0.5,0"]
    orders = ["90,45.5,135,0/RGGB", "90,135,0,45/mono", "0,45,90,135/GRBG@0,1"]
    script = f"""
      import {{ orient, parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      const wordsOf = (run) => {{ try {{ run(); return null; }} catch (error) {{ return error.message; }} }};
      console.log(JSON.stringify([...{json.dumps(said)}.map((spec) => wordsOf(() => parseLayout(spec))),
        ...{json.dumps(orders)}.map((spec) => wordsOf(() => orient(8, 8, parseLayout(spec))))]));"""
    done = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, check=True, timeout=60)
    found = dict(zip([*said, *orders], json.loads(done.stdout), strict=True))
    for spec in said:
        with pytest.raises(ValueError, match="expected") as refused:
            Layout.parse(spec)
        assert found[spec] == str(refused.value)
    for spec in orders:
        layout = Layout.parse(spec)
        with pytest.raises(ValueError, match="mirrored, turned or cropped") as refused:
            orient(Mosaic(np.zeros((8, 8), np.float32), layout, 0.0, 1.0), Layout.sony(layout.channels))
        assert found[spec] == str(refused.value)


@needs_packages
def test_a_white_level_above_where_the_sensor_clips_is_said_as_in_the_library(tmp_path: Path) -> None:
    """The note offers the level that samples share; frames whose brightest are few have none."""
    codes = np.random.default_rng(3).integers(64, 3900, (96, 96)).astype(np.uint16)
    bright = np.full((96, 96), 4095, np.uint16)  # as two rows, which are fewer than a group of rows
    bright[0, :90] = 300
    frames = [codes, np.minimum(codes, 3700), bright]
    (tmp_path / "frames").write_bytes(b"".join(frame.tobytes() for frame in frames))
    script = f"""
      import {{ readFileSync }} from "node:fs";
      import {{ levelNotes }} from {json.dumps((WEB / "src" / "levels.js").as_uri())};
      const bytes = readFileSync("frames"), all = new Uint16Array(bytes.buffer, bytes.byteOffset, bytes.length / 2);
      const parts = [all.subarray(0, 9216), all.subarray(9216, 18432), all.subarray(18432, 18624)];
      console.log(JSON.stringify([...parts.map((samples) => levelNotes(samples, 96, 0, 4095)),
        levelNotes(parts[0], 96, 0, 70000)]));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    even, cut, *others = json.loads(done.stdout)
    for (note,), samples, white in zip(others, (bright[:2], codes), (4095.0, 70000.0), strict=True):
        assert level_notes(samples, 0.0, white) == (note["text"],)
    (said,) = level_notes(frames[1], 0.0, 4095.0)
    assert even == [] and cut == [{"text": said.replace("--white-level", "white level"), "white": 3700}]


@needs_packages
def test_levels_are_refused_as_the_library_refuses_them() -> None:
    """A negative black level brightened all of a frame without a word; others leave float32 no digits."""
    levels = [
        (0, 4095),
        (240, 65535),
        (-5, 4095),
        (4095, 4095),
        (500, 240),
        (0, 0),
        (0, 0.01),
        (0, 1e13),
        (4e3, 4000.001),
    ]
    script = f"""
      import {{ requireLevels }} from {json.dumps((WEB / "src" / "levels.js").as_uri())};
      const wordsOf = (run) => {{ try {{ run(); return null; }} catch (error) {{ return error.message; }} }};
      console.log(JSON.stringify([new Uint8Array(16), new Uint16Array(16)].map((samples) =>
        {json.dumps(levels)}.map(([black, white]) => wordsOf(() => requireLevels(samples, black, white))))));"""
    done = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, check=True, timeout=60)
    for dtype, found in zip((np.uint8, np.uint16), json.loads(done.stdout), strict=True):
        assert found == [refusal_of(np.zeros((4, 4), dtype), black, white) for black, white in levels]


def refusal_of(codes: np.ndarray[Any, Any], black: float, white: float) -> str | None:
    """The page's words for what the library says of levels, or None where it takes them."""
    try:
        as_mosaic(codes, None, black, white)
    except ValueError as refused:
        return str(refused).replace("--white-level", "white level").replace("1e+13", "10000000000000")
    return None


@needs_packages
@pytest.mark.parametrize("sees", [True, False])
def test_networks_that_do_not_see_the_frame_are_given_no_thumbnail(sees: bool) -> None:
    """Those for mono frames: a thumbnail was made of every frame in vain."""
    script = f"""
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      import {{ separateJoint }} from {json.dumps((WEB / "src" / "joint.js").as_uri())};
      const layout = parseLayout("mono"), data = new Float32Array(32 * 32).fill(0.5), given = [];
      const run = async (samples, rows, width, thumbnail) => {{
        given.push(thumbnail?.length ?? 0);
        const plane = (count) => new Float32Array((count * rows * width) / 4);
        const [diffuse, specular, error, s1, s2, residual] = [1, 1, 2, 1, 1, 1].map(plane);
        return {{ diffuse, specular, error, s1, s2, residual }};
      }};
      await separateJoint({{ data, height: 32, width: 32, layout, black: 0, white: 1 }}, [1],
        {{ run, seesFrame: {json.dumps(sees)}, count: 1 }}, () => {{}});
      console.log(JSON.stringify(given));"""
    done = subprocess.run([str(NODE), "--input-type=module", "-e", script], capture_output=True, check=True, timeout=60)
    given = json.loads(done.stdout)
    assert given and all((size > 0) == sees for size in given)


@needs_packages
def test_even_light_has_no_angle(tmp_path: Path) -> None:
    """A frame of one value, as all that clips: rounding does not polarize it, and the report warns as the library's."""
    script = f"""
      import {{ separateAnalytic }} from {json.dumps((WEB / "src" / "analytic.js").as_uri())};
      import {{ parseLayout }} from {json.dumps((WEB / "src" / "layout.js").as_uri())};
      import {{ addPolarization, describe, tallyOf }} from {json.dumps((WEB / "src" / "report.js").as_uri())};
      const layout = parseLayout("color"), data = new Float32Array(32 * 32).fill(4095);
      const images = separateAnalytic({{ data, height: 32, width: 32, layout, black: 0, white: 4095 }}, [1, 1, 1]);
      addPolarization(images);
      console.log(JSON.stringify(describe(tallyOf(images), false, 3)));"""
    done = subprocess.run(
        [str(NODE), "--input-type=module", "-e", script], cwd=tmp_path, capture_output=True, check=True, timeout=60
    )
    found, truth = json.loads(done.stdout), separated(np.full((32, 32), 4095, np.uint16), "analytic").report
    assert found["statistics"]["specular_aolp_concentration"] == 0 == truth["statistics"]["specular_aolp_concentration"]
    assert found["warnings"][0] in truth["warnings"]


@needs_packages
def test_the_page_is_small(site: Path) -> None:
    """All that a host serves, the example and both runtimes included."""
    assert sum(path.stat().st_size for path in site.iterdir()) < LARGEST
