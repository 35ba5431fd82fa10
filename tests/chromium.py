"""Chromium for tests: a browser, and a page of it that asks nobody else and whose scripts do not fail."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tools.web_page import CHROMIUM, FLAGS

#: Longest wait for anything on a page.
WAIT_MS = 120_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        started = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield started
        started.close()


@contextmanager
def fresh_page(browser: Any, address: str, width: int) -> Iterator[Any]:
    """A page that opens an ``address``; afterwards, nothing was asked of anybody else, and no script failed."""
    asked: list[str] = []
    failed: list[str] = []
    context = browser.new_context(viewport={"width": width, "height": 900}, accept_downloads=True)
    opened = context.new_page()
    opened.set_default_timeout(WAIT_MS)
    context.on("request", lambda request: asked.append(request.url))
    opened.on("pageerror", lambda error: failed.append(str(error)))
    opened.goto(address)
    yield opened
    context.close()
    own = (address.partition("?")[0], "data:", "blob:")
    assert [url for url in asked if not url.startswith(own)] == []
    assert failed == []
