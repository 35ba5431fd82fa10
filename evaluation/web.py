"""The browser page of web/ on a frame of 2448x2048 samples in Chromium: seconds and memory, with one and two cores.

Seconds are the page's own, from the samples of the file to the images: checks, the light, the separation and the
report. Reading the file and drawing are not in it; "first" is the first frame of a page that has just loaded its
network. Memory is the sum over Chromium's processes, each with its share of what they share, while it separates, above
that of an empty page.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from polsep.bench.rows import Row
from polsep.io.store.rows import read_bytes
from tools.web_page import CHROMIUM, DEMO, FLAGS, build_page, change, send, served

METHODS, CORES, AGAIN = ("analytic", "joint-fast"), (1, 2), 3
CASE, WHITE = "2448x2048 colour frame, {} core{}", "4095"
WAIT_MS = 300_000
#: Seconds between two looks at memory.
LOOK = 0.05


class Memory:
    """The largest memory [MiB] of Chromium's processes while it is looked at. State: a thread that looks."""

    def __init__(self, marker: str) -> None:
        self._marker, self._ended, self.largest = marker, threading.Event(), 0.0

    def __enter__(self) -> Memory:
        self._thread = threading.Thread(target=self._look)
        self._thread.start()
        return self

    def __exit__(self, *unused: object) -> None:
        self._ended.set()
        self._thread.join()

    def now(self) -> float:
        """The memory of all processes whose command names the marker."""
        total = 0
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if self._marker not in (path / "cmdline").read_text():
                    continue
                lines = (path / "smaps_rollup").read_text().splitlines()
            except OSError:  # it has ended
                continue
            total += sum(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        return total / 1024

    def _look(self) -> None:
        while not self._ended.wait(LOOK):
            self.largest = max(self.largest, self.now())


def bench_web(cores: tuple[int, ...] = CORES, again: int = AGAIN) -> Iterator[Row]:
    """Seconds and memory of the browser page, by method and number of cores. Raises ValueError without its needs."""
    with TemporaryDirectory() as folder, served_page(Path(folder)) as (site, driver, address):
        size = sum(path.stat().st_size for path in site.iterdir())
        yield Row("web", "page", "all files", "size", size / 1e6, "MB")
        for count in cores:
            for method in METHODS:
                profile = Path(folder) / f"{method}{count}"
                case = CASE.format(count, "s" * (count > 1))
                with opened(driver, profile, f"{address}?threads={count}", method) as page:
                    yield from _measure(page, (case, method, again), profile)


@contextmanager
def served_page(folder: Path) -> Iterator[tuple[Path, Any, str]]:
    """The page, built below a folder and on a host: its own folder, a driver of browsers, the address.

    Raises ValueError without its needs.
    """
    try:
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError:
        raise ValueError("expected playwright (pip install playwright), found none") from None
    if CHROMIUM is None:
        raise ValueError("expected chromium, found none")
    with sync_playwright() as driver:
        site = build_page(folder)
        with served(site) as address:
            yield site, driver, address


@contextmanager
def opened(driver: Any, profile: Path, address: str, method: str) -> Iterator[Any]:
    """The page in a browser of its own, for frames of `WHITE`, with its network loaded."""
    context = driver.chromium.launch_persistent_context(
        profile, executable_path=CHROMIUM, args=FLAGS, viewport={"width": 1400, "height": 900}
    )
    page = context.pages[0]
    page.set_default_timeout(WAIT_MS)
    page.goto(address)
    page.select_option("#method", method)
    page.fill("#white", WHITE)
    page.press("#white", "Enter")  # else it counts when the field is left, in the middle of something else
    page.wait_for_timeout(5000)  # the network loads meanwhile
    yield page
    context.close()


def _measure(page: Any, what: tuple[str, str, int], profile: Path) -> Iterator[Row]:
    """Rows of one method on a page of its own."""
    case, method, again = what
    memory = Memory(str(profile))
    empty = memory.now()
    with memory:
        send(page, "shot.png", read_bytes(DEMO))
        first = _seconds(page)
        others = []
        for k in range(again):
            # Another level, as little, separates the frame anew.
            change(page, lambda k=k: page.fill("#black", f"0.{k + 1}") or page.press("#black", "Enter"))
            others.append(_seconds(page))
    yield Row("web", case, method, "first frame", first, "s")
    yield Row("web", case, method, "next frame, least", min(others), "s")
    yield Row("web", case, method, "memory above an empty page", memory.largest - empty, "MiB")


def _seconds(page: Any) -> float:
    """Seconds that the page says of its last separation. Raises ValueError where it failed."""
    if page.get_attribute("body", "data-state") != "done":
        raise ValueError(f"expected a separated frame, found: {page.inner_text('#notes')}")
    steps = page.evaluate("window.polsep.report.seconds")
    return sum(float(own) for name, own in steps.items() if name != "load")
