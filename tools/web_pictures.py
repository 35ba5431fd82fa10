"""Pictures of docs/web.md: `python -m tools.web_pictures`. Needs node with the packages of web/, and chromium."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from polsep.io.store.rows import read_bytes
from tools.web_page import CHROMIUM, DEMO, FLAGS, ROOT, build_page, send, served

SIZES = {"web.jpg": (1400, 900), "web_phone.jpg": (390, 844)}
WAIT_MS = 240_000


def main() -> None:
    """The page with the demo capture, on a desk and on a phone."""
    from playwright.sync_api import sync_playwright

    with TemporaryDirectory() as folder, sync_playwright() as driver, served(build_page(Path(folder))) as address:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for name, (width, height) in SIZES.items():
            page = browser.new_page(viewport={"width": width, "height": height})
            page.set_default_timeout(WAIT_MS)
            page.goto(address)
            page.fill("#white", "4095")
            send(page, "still_life.png", read_bytes(DEMO))
            page.locator("#white").blur()  # which separates once more
            page.wait_for_timeout(1000)
            page.wait_for_selector("body[data-state=done]")
            page.wait_for_timeout(1000)
            picture = Image.open(BytesIO(page.screenshot())).convert("RGB")
            picture.save(ROOT / "docs" / "images" / name, quality=85, optimize=True)
        browser.close()


if __name__ == "__main__":
    main()
