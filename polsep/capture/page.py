"""A page with the live picture for a browser on this machine.

The server listens on 127.0.0.1 only and requires that name in requests, which keeps out other machines, and scripts of
other sites in the same browser. It reads no files.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from polsep.capture.live import Shown
from polsep.capture.sources import CameraError

HOST = "127.0.0.1"

PAGE = b"""<!doctype html><meta charset="utf-8"><title>polsep capture</title>
<style>body{background:#161618;color:#ebebeb;font:16px sans-serif;margin:16px}img{max-width:100%}</style>
<div id="line">waiting for the first frame</div><p><img id="picture" alt="input, diffuse, specular">
<script>
let shown = null;
async function look() {
  try {
    const state = await (await fetch("state.json")).json();
    document.getElementById("line").textContent = state.line;
    if (state.frame_id !== null && state.frame_id !== shown) {
      shown = state.frame_id;
      document.getElementById("picture").src = "live.jpg?" + shown;
    }
  } catch { document.getElementById("line").textContent = "polsep capture has ended"; }
  setTimeout(look, 200);
}
look();
</script>
"""


@contextmanager
def serve_page(port: int, latest: Callable[[], Shown | None], line: Callable[[], str]) -> Iterator[str]:
    """Serve the page inside the block and yield its address; port 0 picks a free one.

    Raises CameraError if the port is in use.
    """

    class Handler(BaseHTTPRequestHandler):
        """Responses for the page, its picture and its state."""

        def do_GET(self) -> None:
            """Send the page, the state or the picture."""
            name = self.path.partition("?")[0]
            shown = latest()
            if self.headers.get("Host", "").rpartition(":")[0] not in (HOST, "localhost"):
                self.send_error(HTTPStatus.FORBIDDEN)
            elif name == "/":
                self._answer("text/html; charset=utf-8", PAGE)
            elif name == "/state.json":
                state = {"line": line(), "frame_id": shown.frame_id if shown else None}
                self._answer("application/json", json.dumps(state).encode())
            elif name == "/live.jpg" and shown is not None:
                self._answer("image/jpeg", shown.jpeg)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

        def _answer(self, kind: str, body: bytes) -> None:
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Log nothing: the terminal shows the capture."""

    try:
        server = ThreadingHTTPServer((HOST, port), Handler)
    except (OSError, OverflowError) as error:
        raise CameraError(f"expected a free port for --show, found {port}: {error}") from None
    thread = threading.Thread(target=server.serve_forever, args=(0.1,), name="page", daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
