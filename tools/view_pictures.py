"""The pictures of docs/view.md: `python -m tools.view_pictures`. Needs the extra view, playwright and chromium."""

from __future__ import annotations

import importlib
import shutil
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from polsep.bench.truth import read_demo_codes
from polsep.io.store.image_codecs import encode_png
from polsep.view.server import ViewOptions, serve

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
WAIT_MS = 240_000


def choose(page: Any, part: str, value: str) -> None:
    """Choose from one of the page's lists."""
    page.click(f"#{part} input")
    page.get_by_role("option", name=value, exact=True).click()
    page.locator(f"#{part} input").blur()
    page.wait_for_function("document.querySelectorAll('[role=option]').length === 0")


def save(page: Any, name: str) -> None:
    """The page as it is, as soon as it rests."""
    page.mouse.move(5, 5)
    page.wait_for_timeout(2500)
    Image.open(BytesIO(page.screenshot())).convert("RGB").save(IMAGES / name, quality=85, optimize=True)


def show_demo(page: Any) -> None:
    """The demo capture: input and specular light, the rose of its angles."""
    page.click("#ps-demo")
    page.wait_for_selector(".ps-sharp")
    choose(page, "ps-right", "Specular")
    page.get_by_role("tab", name="Light", exact=True).click()
    save(page, "view.jpg")


def show_sequence(page: Any, folder: Path) -> None:
    """A sequence that plays under edits."""
    codes, files = read_demo_codes(), []
    for k in range(4):
        files.append(folder / f"shot{k}.png")
        files[-1].write_bytes(encode_png(np.roll(codes, 16 * k, axis=1)))
    page.set_input_files("#ps-top input[type=file]", files)
    page.wait_for_selector("#ps-mend-0:visible")
    page.click("#ps-mend-0")
    page.wait_for_selector("#ps-mend-0", state="hidden")
    page.get_by_role("tab", name="Edit", exact=True).click()
    for title, part, value in (("Metallic", "metallic-amount", "0.6"), ("Rougher", "rougher-sigma", "6")):
        page.click(f"#ps-edits button:has-text('{title}')")
        field = page.locator(f"#ps-{part} input[type=number]")
        field.fill(value)
        field.press("Enter")
    page.wait_for_selector(".ps-right[alt=Edited]")
    page.click("#ps-play")
    page.wait_for_function("document.querySelector('#ps-index input[type=number]').value === '2'")
    save(page, "view_sequence.jpg")


def main() -> None:
    """Write both pictures."""
    playwright = importlib.import_module("playwright.sync_api")
    flags = ["--no-sandbox", "--disable-gpu"]
    with TemporaryDirectory() as folder, serve(ViewOptions()) as address, playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_page(viewport={"width": 1440, "height": 900})
        page.set_default_timeout(WAIT_MS)
        page.goto(address)
        page.wait_for_selector("#ps-demo")
        show_demo(page)
        page.get_by_role("tab", name="Settings", exact=True).click()
        choose(page, "ps-method", "color-affine")
        show_sequence(page, Path(folder))
        browser.close()


if __name__ == "__main__":
    main()
