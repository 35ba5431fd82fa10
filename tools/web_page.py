"""The browser page of web/ on this machine: built, on a host, and in Chromium; for tests and measurements."""

from __future__ import annotations

import functools
import http.server
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
WEB, DEMO = ROOT / "web", ROOT / "polsep" / "data" / "still_life.png"
CHROMIUM, NODE = shutil.which("chromium"), shutil.which("node")
#: Chromium without other hosts than this machine, as a user has it else.
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
FLAGS += ["--disable-sync", "--host-resolver-rules=MAP * ~NOTFOUND , EXCLUDE 127.0.0.1"]
#: What building needs.
HAS_PACKAGES = NODE is not None and (WEB / "node_modules" / "onnxruntime-web").is_dir()


class Handler(http.server.SimpleHTTPRequestHandler):
    """Files with the headers that isolate a page, and no log."""

    def end_headers(self) -> None:
        """Add the headers."""
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
        super().end_headers()

    def log_message(self, *args: object) -> None:
        """Write nothing."""
        del args


def build_page(folder: Path) -> Path:
    """Build the page below a folder, as ``make web`` does, and return its own folder.

    Raises ValueError where node or its packages are missing.
    """
    if not HAS_PACKAGES:
        raise ValueError("expected node and the packages of web/ (npm --prefix web ci), found none")
    from tools.web_models import write_models

    write_models(folder / "models")
    command = [str(NODE), str(WEB / "build.mjs"), str(folder / "models"), str(DEMO), str(folder / "dist")]
    subprocess.run(command, check=True, capture_output=True, timeout=240)
    return folder / "dist"


@contextmanager
def served(site: Path) -> Iterator[str]:
    """The address of a folder of files on a host of this machine."""
    host = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(site)))
    threading.Thread(target=host.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{host.server_port}/"
    finally:
        host.shutdown()
        host.server_close()


def send(page: Any, name: str, data: bytes) -> None:
    """Give the page a file, and wait until it has separated it or has said why not."""

    def choose() -> None:
        page.set_input_files("#file", {"name": name, "mimeType": "application/octet-stream", "buffer": data})

    change(page, choose)


def change(page: Any, act: Any) -> None:
    """Do something on the page, and wait for the frame that is separated anew."""
    page.evaluate("document.body.dataset.state = 'sent'")
    act()
    page.wait_for_selector("body[data-state=done], body[data-state=failed]")


def fetch(page: Any, form: str, folder: Path) -> Path:
    """A file that the page offers."""
    page.click("#download summary")
    with page.expect_download() as waiting:
        page.click(f"[data-format={form}]")
    path: Path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path
