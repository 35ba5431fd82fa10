"""The viewer in Chromium for tests: a viewer, a page of it, and what users do there."""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
from chromium import WAIT_MS, browser, fresh_page
from viewer import running

import polsep
from polsep.pipeline import PolsepWarning
from tools.web_page import CHROMIUM, DEMO

__all__ = ["DEMO", "WAIT_MS", "browser"]  # for tests that use this

READY = CHROMIUM and all(importlib.util.find_spec(name) for name in ("gradio", "playwright"))
needs_browser = pytest.mark.skipif(not READY, reason="needs the extra view, playwright and chromium")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the viewer's temporary files are."""
    return tmp_path_factory.mktemp("view")


@pytest.fixture(scope="module")
def viewer(folder: Path) -> Iterator[str]:
    """A viewer."""
    with running(folder, "--method", "color-affine") as address:
        yield address


@pytest.fixture
def page(browser: Any, viewer: str) -> Iterator[Any]:
    """The page, freshly loaded."""
    with fresh_page(browser, viewer, 1440) as opened:
        opened.wait_for_selector("#ps-demo")
        yield opened


def send(page: Any, name: str, data: bytes) -> None:
    """Choose a file."""
    page.set_input_files("#ps-top input[type=file]", {"name": name, "mimeType": "image/png", "buffer": data})


def choose(page: Any, part: str, value: str) -> None:
    """Choose or type in one of the page's lists."""
    field = page.locator(f"#{part} input")
    field.click()
    if field.get_attribute("readonly") is None:
        field.fill(value)
        field.press("Enter")
    else:
        page.get_by_role("option", name=value, exact=True).click()
    field.blur()
    page.wait_for_function("document.querySelectorAll('[role=option]').length === 0")


def tab(page: Any, name: str) -> None:
    """Open one of the panels beside the picture."""
    page.get_by_role("tab", name=name, exact=True).click()


def await_text(page: Any, part: str, text: str) -> None:
    """Wait until a part of the page has this text: what belongs together comes in several messages."""
    from playwright.sync_api import expect

    expect(page.locator(part)).to_contain_text(text, timeout=WAIT_MS)


def open_demo(page: Any) -> None:
    """Open the demo capture, and wait for its sharp picture."""
    page.click("#ps-demo")
    page.wait_for_selector(".ps-sharp")


def separated(codes: Any, **said: Any) -> Any:
    """What Python makes of a frame."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolsepWarning)
        return polsep.separate(codes, **{"method": "color-affine", "white_level": 4095, **said})


def set_slider(page: Any, part: str, value: float) -> None:
    """Type a number beside a slider; once more where the slider, just unfolded, takes its own value again."""
    field = page.locator(f"#{part} input[type=number]")
    for _ in range(10):
        field.fill(f"{value:g}")
        field.press("Enter")
        page.wait_for_timeout(150)
        if float(field.input_value() or "nan") == float(f"{value:g}"):
            break


def fetch(page: Any, kind: str, folder: Path) -> Path:
    """Click a download button."""
    with page.expect_download() as waiting:
        page.click(f"#ps-get-{kind}")
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def small_frame(place: int = 0) -> bytes:
    """A part of the demo capture as a 12-bit PNG."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())[812 + 8 * place : 1132 + 8 * place, 140:524]
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(codes)))
