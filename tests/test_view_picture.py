"""The viewer's picture in Chromium: zoom, numbers, comparison, settings, keyboard, phones."""

from __future__ import annotations

import base64
from collections.abc import Iterator
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

from polsep.view.edits import list_controls
from polsep.view.pictures import Exposure as Drawn
from polsep.view.pictures import draw, shrink_frame

__all__ = ["browser", "folder", "page", "viewer"]  # fixtures
pytestmark = needs_browser

VIEW = """() => {
  const style = document.querySelector('.ps-stage').closest('[style*="--z"]').style;
  return ['--z', '--x', '--y'].map((name) => parseFloat(style.getPropertyValue(name)));
}"""
#: The source and style of a side's sharp picture as soon as it is of what is seen, and another one than before.
SHARP = """([side, before]) => {
  const stage = document.querySelector('.ps-stage'), image = stage?.querySelector(`.ps-layer-${side} .ps-sharp`);
  if (!image || image.src === before) return null;
  const f = stage.getBoundingClientRect(), w = stage.querySelector('.ps-world').getBoundingClientRect();
  const part = (length, size, round) => Math.min(Math.max(round(10000 * length / size), 0), 10000);
  const left = part(f.left - w.left, w.width, Math.floor), right = part(f.right - w.left, w.width, Math.ceil);
  const top = part(f.top - w.top, w.height, Math.floor), bottom = part(f.bottom - w.top, w.height, Math.ceil);
  const pixels = Math.ceil((right - left) / 10000 * w.width * devicePixelRatio);
  const seen = stage.dataset.window.split(',').map(Number);
  const near = [left, top, right, bottom, pixels].every((number, k) => Math.abs(number - seen[k]) <= 1);
  return near ? [image.src, image.getAttribute('style')] : null;
}"""
#: How many lists hang open.
OPEN = "[...document.querySelectorAll('ul[role=listbox], ul.options')].filter((u) => u.getClientRects().length).length"


@pytest.fixture
def frame(page: Any) -> Any:
    """The codes of a small frame that the page shows."""
    choose(page, "ps-white", "4095")
    send(page, "shot.png", small_frame())
    page.wait_for_selector(".ps-sharp")
    return imagecodecs.png_decode(small_frame())


def source(page: Any, side: str = "left") -> str:
    """The picture's sharp part as text, to tell another one from."""
    return str(page.get_attribute(f".ps-layer-{side} .ps-sharp", "src"))


def sharp(page: Any, side: str = "left", before: str = "") -> tuple[Any, list[float]]:
    """The pixels of the picture's sharp part, and its place in percent: of what is seen, and not the one ``before``."""
    found, style = page.wait_for_function(SHARP, arg=[side, before]).json_value()
    kind, data = found.split(",", 1)
    decode = imagecodecs.png_decode if "png" in kind else imagecodecs.jpeg8_decode
    style = dict(part.split(":") for part in style.replace(" ", "").rstrip(";").split(";"))
    return decode(base64.b64decode(data)), [float(style[k].rstrip("%")) for k in ("left", "top", "width", "height")]


def middle(page: Any) -> tuple[float, float]:
    """A place in the left picture on the screen, above its middle."""
    box = page.locator(".ps-stage").bounding_box()
    return box["x"] + box["width"] * 0.45, box["y"] + box["height"] * 0.4


def test_wheel_buttons_and_keys_zoom(page: Any, frame: Any) -> None:
    """1:1 is one pixel for one, the wheel keeps the place under the pointer, and what is seen is the frame's own."""
    assert page.evaluate(VIEW) == [1, 0, 0]
    page.click("[data-tool=one]")
    width = page.locator(".ps-world").first.bounding_box()["width"]
    assert abs(width - 192) < 0.01 and page.inner_text(".ps-tools output") == "100 %"
    x, y = middle(page)
    page.click("[data-tool=fit]")
    before = page.locator(".ps-world").first.bounding_box()
    share = (y - before["y"]) / before["height"]
    page.mouse.move(x, y)
    for _ in range(10):
        page.mouse.wheel(0, -120)
    page.wait_for_function("parseFloat(document.querySelector('.ps-tools output').textContent) > 1000")
    after = page.locator(".ps-world").first.bounding_box()
    assert abs((y - after["y"]) / after["height"] - share) < 1e-3
    pixels, (left, top, wide, high) = sharp(page)
    truth = shrink_frame(separated(frame))
    rows = slice(round(top * 1.6), round((top + high) * 1.6))
    cols = slice(round(left * 1.92), round((left + wide) * 1.92))
    assert pixels.shape[1] < 192
    np.testing.assert_array_equal(pixels, draw(truth, "Input", Drawn())[rows, cols])
    zoomed = page.evaluate(VIEW)
    page.mouse.down()
    page.mouse.move(x + 80, y + 30, steps=4)
    page.mouse.up()
    moved = page.evaluate(VIEW)
    assert [moved[0], round(moved[1] - zoomed[1]), round(moved[2] - zoomed[2])] == [zoomed[0], 80, 30]
    page.keyboard.press("ArrowRight")
    assert page.evaluate(VIEW)[1] == moved[1] - 60
    page.keyboard.press("0")
    assert page.evaluate(VIEW) == [1, 0, 0]
    page.keyboard.press("1")
    assert page.inner_text(".ps-tools output") == "100 %"


def test_numbers_follow_the_pointer(page: Any, frame: Any) -> None:
    """The read-out is that of the pixel of the frame, not of the picture; a click keeps it."""
    tab(page, "Pixel")
    page.click("[data-tool=fit]")
    box = page.locator(".ps-world").first.bounding_box()
    truth = separated(frame)
    for row, col in ((11, 17), (100, 155)):
        page.mouse.move(box["x"] + box["width"] * (col + 0.5) / 192, box["y"] + box["height"] * (row + 0.5) / 160)
        page.wait_for_selector(f"#ps-pixel:has-text('row {row}, column {col}')")
        said = page.inner_text("#ps-pixel")
        for value in (*truth.diffuse[row, col], *truth.specular[row, col]):
            assert f"{value:.4f}" in said
    page.mouse.down()
    page.mouse.up()
    page.wait_for_selector(".ps-mark")
    page.mouse.move(5, 5)
    page.wait_for_selector("#ps-pixel:has-text('row 100, column 155')")


def test_methods_and_resolutions_are_compared(page: Any, frame: Any) -> None:
    """Right, another method or full resolution of the same place; the pictures say what made them."""
    choose(page, "ps-against", "analytic, full")
    page.wait_for_selector(".ps-name-right:has-text('Diffuse · analytic, full')")
    assert page.inner_text(".ps-name-left") == "Input · color-affine, half"
    choose(page, "ps-right", "Specular")
    page.wait_for_selector(".ps-right[alt=Specular]")
    page.click("[data-tool=one]")
    pixels, _ = sharp(page, "right")
    full = separated(frame, method="analytic", full=True)
    assert pixels.shape[:2] == full.specular.shape[:2]
    small = shrink_frame(full, step=1)
    gain = shrink_frame(separated(frame)).gain
    expected = draw(type(small)(**{**vars(small), "gain": gain}), "Specular", Drawn())
    assert np.abs(pixels.astype(int) - expected).mean() < 1.5  # JPEG
    tab(page, "Pixel")
    page.mouse.move(*middle(page))
    page.wait_for_selector("#ps-pixel:has-text('analytic, full')")
    assert page.locator(".ps-readout").count() == 2


def test_specular_has_its_own_exposure_and_clipping_is_marked(page: Any, frame: Any) -> None:
    """One slider for the specular alone; red where a sample clips."""
    choose(page, "ps-right", "Specular")
    page.wait_for_selector(".ps-right[alt=Specular]")
    (left, _), (right, _), before = sharp(page), sharp(page, "right"), source(page, "right")
    set_slider(page, "ps-specular-stops", 3)
    (brighter, _), (same, _), before = sharp(page, "right", before), sharp(page), source(page, "right")
    np.testing.assert_array_equal(same, left)
    assert brighter.mean() > 1.5 * right.mean()
    tab(page, "Exposure")
    assert page.locator(".ps-histogram polyline").count() == 3
    page.click("#ps-marks input")
    marked, _ = sharp(page, "right", before)  # the specular, which is grey
    clipped = (frame >= 4091).reshape(160, 2, 192, 2).any(axis=(1, 3))
    red = (marked.astype(int) - (255, 40, 40)).__abs__().sum(axis=2) < 120
    assert clipped.sum() > 20 and red[clipped].mean() > 0.95 and (red & ~clipped).sum() < clipped.sum()
    tab(page, "Light")
    await_text(page, "#ps-side", "Polarizer of the light")
    assert page.locator(".ps-rose path").count() == 1


def test_settings_are_the_new_files(page: Any) -> None:
    """The demo's levels do not stay for the next file, nor what was typed for the file before, unless they are kept."""
    open_demo(page)
    assert page.input_value("#ps-white input") == "4095"
    send(page, "shot.png", small_frame())
    page.wait_for_selector("#ps-status:has-text('shot')")
    assert page.input_value("#ps-white input") == "from file"
    page.click("#ps-mend-0")
    page.wait_for_selector("#ps-mend-0", state="hidden")
    page.click("#ps-keep input")
    send(page, "again.png", small_frame(1))
    page.wait_for_selector("#ps-status:has-text('again')")
    assert page.input_value("#ps-white input") == "4095"
    page.click("#ps-keep input")
    send(page, "third.png", small_frame(2))
    page.wait_for_selector("#ps-status:has-text('third')")
    assert page.input_value("#ps-white input") == "from file"


def test_four_angle_files_are_one_frame(page: Any) -> None:
    """Four images, one for each analyser, open as one frame."""
    light = np.random.default_rng(0).integers(100, 3000, (64, 80, 3), np.uint16)
    gains = {0: 1.0, 45: 0.8, 90: 0.6, 135: 0.8}
    files = [
        {"name": f"{a}.png", "mimeType": "image/png", "buffer": bytes(imagecodecs.png_encode((light * g).astype("u2")))}
        for a, g in gains.items()
    ]
    choose(page, "ps-white", "4095")
    page.set_input_files("#ps-top input[type=file]", files)
    page.wait_for_selector(".ps-sharp")
    await_text(page, "#ps-status", "80 × 64 pixels")
    assert not page.is_visible("#ps-strip")


def test_waiting_is_said_and_ended(page: Any) -> None:
    """A long separation says so, and Cancel ends the wait at once; the picture and its numbers stay."""
    choose(page, "ps-resolution", "full")  # which separates longer
    open_demo(page)
    before = page.inner_text("#ps-status")
    choose(page, "ps-method", "paper")
    page.wait_for_selector("#ps-progress:has-text('Separating')")
    page.click("#ps-cancel")
    page.wait_for_selector("#ps-progress:has-text('Cancelled: the picture is as before')")
    page.wait_for_selector("#ps-cancel", state="hidden")
    assert page.inner_text("#ps-status") == before
    choose(page, "ps-method", "color-affine")
    page.wait_for_function("document.querySelector('#ps-progress').innerText === ''")
    await_text(page, "#ps-status", "color-affine")


def test_sliders_agree_with_their_boxes(page: Any, frame: Any) -> None:
    """For start and typed values alike, and the panel of edits has no scroller of its own."""
    tab(page, "Edit")
    for title in page.locator("#ps-edits > div > button").all():
        title.click()
    for control in list_controls():
        if control.parameter.kind == "color":
            continue
        part, low, high = (
            f"ps-{control.edit.name}-{control.parameter.name}",
            control.parameter.low,
            control.parameter.high,
        )
        for value in (control.start, low, high, low + 0.3217 * (high - low), control.start):
            set_slider(page, part, value)
            slider = float(page.input_value(f"#{part} input[type=range]"))
            box = float(page.input_value(f"#{part} input[type=number]"))
            assert abs(slider - box) <= control.step / 2 * 1.001, (part, value)
    inner = """() => [...document.querySelectorAll('#ps-side, #ps-side *')].filter((e) =>
      e.scrollHeight > e.clientHeight + 1 && /auto|scroll/.test(getComputedStyle(e).overflowY))
      .map((e) => e.className)"""
    assert page.evaluate(inner) == []


def test_the_picture_stays_while_a_panel_is_scrolled(page: Any, frame: Any) -> None:
    """All edits are longer than the screen; the picture keeps its size, and can be seen from the last one."""
    tab(page, "Edit")
    height = page.locator(".ps-stage").bounding_box()["height"]
    for title in page.locator("#ps-edits > div > button").all():
        title.click()
    last = page.locator("#ps-edits > div > button").last
    page.mouse.move(1300, 600)
    page.mouse.wheel(0, 5000)
    page.wait_for_function("scrollY > 300")
    last.click()
    page.wait_for_timeout(300)
    box = page.locator(".ps-stage").bounding_box()
    assert box["height"] == height and box["y"] >= 0 and box["y"] + height <= 900


def test_lists_show_what_they_hold(page: Any, frame: Any) -> None:
    """A longer value than its list is cut off before the arrow, not under it."""
    choose(page, "ps-against", "analytic, full")
    page.wait_for_selector(".ps-name-right:has-text('analytic, full')")
    script = """() => [...document.querySelectorAll('input[role=combobox]')].filter((e) => e.offsetParent).map((e) => {
      const style = getComputedStyle(e), arrow = e.parentElement.querySelector('svg').getBoundingClientRect();
      const box = e.getBoundingClientRect();
      return [style.textOverflow, box.right - parseFloat(style.paddingRight) - arrow.left];
    })"""
    found = page.evaluate(script)
    assert len(found) > 5 and all(cut == "ellipsis" and beyond < 4 for cut, beyond in found), found


def test_the_page_fits_its_screen(page: Any, frame: Any) -> None:
    """At 1440x900 nothing scrolls, in any panel, as soon as its sizes have been observed."""
    frames = "new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))"
    fits = "document.documentElement.scrollHeight <= 900 && document.documentElement.scrollWidth <= 1440"
    for name in ("Settings", "Pixel", "Exposure", "Light", "Edit"):
        tab(page, name)
        page.get_by_role("tab", name=name, exact=True, selected=True).wait_for()
        page.evaluate(frames)
        assert page.wait_for_function(fits), name


def test_the_keyboard_goes_from_top_to_bottom(page: Any, frame: Any) -> None:
    """Files, picture, its controls, panels; no list stays open behind, and every stop has a name."""
    page.locator("#ps-file").focus()
    seen = []
    for _ in range(60):
        page.wait_for_timeout(20)
        part, name = page.evaluate("""() => {
          const at = document.activeElement;
          return [at.closest('#ps-top, #ps-picture, #ps-view, #ps-side')?.id,
            at.ariaLabel || at.innerText || at.labels?.[0]?.innerText || at.value];
        }""")
        if part is None:
            break
        assert name, seen
        seen.append(part)
        page.keyboard.press("Tab")
    assert list(dict.fromkeys(seen)) == ["ps-top", "ps-picture", "ps-view", "ps-side"]
    assert seen == sorted(seen, key=["ps-top", "ps-picture", "ps-view", "ps-side"].index) and len(seen) > 25
    page.wait_for_function(f"{OPEN} === 0")


@pytest.fixture
def phone(browser: Any, viewer: str) -> Iterator[Any]:
    """The page on a phone."""
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    opened = context.new_page()
    opened.set_default_timeout(WAIT_MS)
    opened.goto(viewer)
    opened.wait_for_selector("#ps-demo")
    yield opened
    context.close()


def test_a_phone_shows_the_picture_first(phone: Any) -> None:
    """Buttons to open, the picture, its controls, panels: in one column as wide as the screen."""
    send(phone, "shot.png", small_frame())
    phone.wait_for_selector(".ps-stage")
    tops = [phone.locator(part).bounding_box()["y"] for part in ("#ps-top", ".ps-stage", "#ps-view", "#ps-side")]
    assert tops == sorted(tops) and tops[2] < 844
    box = phone.locator(".ps-stage").bounding_box()
    assert box["width"] > 300 and box["y"] + box["height"] < 700
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390


def test_a_phone_shows_the_wait(phone: Any, page: Any) -> None:
    """How long, and the button that ends it, lie within the screen."""
    for opened in (page, phone):  # long, so that neither ends before it is cancelled, or its page is closed
        choose(opened, "ps-resolution", "full")
        choose(opened, "ps-method", "paper")
    page.click("#ps-demo")
    page.wait_for_selector("#ps-progress:has-text('Separating')")
    phone.tap("#ps-demo")
    phone.wait_for_selector("#ps-progress:has-text('ing')")
    for part in ("#ps-file", "#ps-demo", "#ps-progress [role=status]", "#ps-cancel"):
        box = phone.locator(part).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= 390, part
    phone.tap("#ps-cancel")
    phone.wait_for_selector("#ps-progress:has-text('Cancelled')")


def test_fingers_pinch(phone: Any) -> None:
    """Two fingers zoom about their middle; a tap reads a pixel."""
    send(phone, "shot.png", small_frame())
    phone.wait_for_selector(".ps-sharp")
    box = phone.locator(".ps-stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    speak = phone.context.new_cdp_session(phone)

    def touch(kind: str, *places: tuple[float, float]) -> None:
        points = [{"x": a, "y": b, "id": k} for k, (a, b) in enumerate(places)]
        speak.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", (x - 20, y))
    touch("touchStart", (x - 20, y), (x + 20, y))
    for wide in (30, 45, 60):
        touch("touchMove", (x - wide, y), (x + wide, y))
    touch("touchEnd")
    z, across, down = phone.evaluate(VIEW)
    assert abs(z - 3) < 0.05 and abs(across) < 2 and abs(down) < 2
    world = phone.locator(".ps-world").first.bounding_box()
    phone.touchscreen.tap(world["x"] + world["width"] * 76.5 / 192, world["y"] + world["height"] * 82.5 / 160)
    phone.wait_for_selector(".ps-readout:has-text('row 82, column 76')")


def test_the_demo_is_opened_again_after_an_error(page: Any) -> None:
    """An error leaves the page usable, and the picture fits again."""
    send(page, "a.png", b"nothing")
    page.wait_for_selector(".ps-error")
    open_demo(page)
    await_text(page, "#ps-status", DEMO.stem)
    assert page.evaluate(VIEW) == [1, 0, 0]
