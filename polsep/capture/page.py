"""A page with the live picture for a browser on this machine, and with what setting up a shot needs.

The server listens on 127.0.0.1 only and requires that name in requests, which keeps out other machines, and scripts of
other sites in the same browser. It reads no files.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from polsep.capture.live import Shown, lower_priority
from polsep.capture.sources import CameraError

HOST = "127.0.0.1"

PAGE = b"""<!doctype html><html lang="en"><meta charset="utf-8"><title>polsep capture</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body { background: #161618; color: #ebebeb; font: 15px/1.45 system-ui, sans-serif; margin: 12px 16px; }
main { display: flex; flex-wrap: wrap; gap: 18px; }
#left { flex: 1 1 480px; min-width: 0; } #right { flex: 0 0 300px; }
img { max-width: 100%; display: block; border-radius: 4px; background: #000; object-fit: contain; }
#marked { width: 100%; max-height: 62vh; } #picture { max-height: 27vh; margin: auto; }
label { margin-right: 16px; } p { margin: 8px 0; } b { font-weight: 600; }
#remarks p { border-left: 3px solid #e0b13c; background: #2f2a1c; color: #f3e3b5; padding: 5px 10px; }
#histogram svg { width: 100%; height: 130px; background: #202024; border-radius: 4px; }
#rose svg { width: 100%; max-width: 240px; display: block; margin: auto; }
#rose path { fill: #7aa7ff66; stroke: #7aa7ff; stroke-width: .6; } #rose .rim { fill: none; stroke: #45454d; }
#rose text { fill: #9a9aa2; font-size: 11px; text-anchor: middle; } #rose line { stroke: #ffb454; stroke-width: 2; }
#rose line.lamp { stroke: #63d471; stroke-dasharray: 5 4; } .found { color: #ffb454; } .lamp { color: #63d471; }
.many { color: #ff8f85; } #numbers, #line { font-variant-numeric: tabular-nums; }
</style>
<div id="line">waiting for the first frame</div>
<p><label><input type="checkbox" id="clipped" checked> mark clipped red, black blue</label>
<label><input type="checkbox" id="sharp"> mark sharp edges green</label></p>
<main><div id="left"><img id="marked" alt="input with marks"><p><img id="picture" alt="input, diffuse, specular"></div>
<div id="right"><div id="remarks"></div><div id="numbers"></div><div id="histogram"></div><div id="rose"></div></div>
</main>
<script>
let shown = null, best = 0;
const at = (name) => document.getElementById(name);
const percent = (share) => (100 * share).toFixed(2) + " %";
const marks = () => ["clipped", "sharp"].filter((name) => at(name).checked).join(",");
function tell(shot) {
  best = Math.max(best, shot.focus);
  at("remarks").replaceChildren(...shot.remarks.map((text) => {
    const line = document.createElement("p");
    line.textContent = text;
    return line;
  }));
  const clipped = shot.clipped.map(([name, share]) => `<span class="${share > .01 ? "many" : ""}">${name} ` +
    `${percent(share)}</span>`).join(", ");
  at("numbers").innerHTML = (clipped ? `<p><b>Clipped</b> ${clipped}</p>` : "") +
    `<p><b>Focus</b> ${shot.focus.toFixed(3)}, best so far ${best.toFixed(3)}</p>` +
    `<p><b class="found">Highlights</b> of one angle: ${shot.concentration.toFixed(2)} of 1, ` +
    `${percent(shot.specular)} of the light</p>` +
    `<p><b class="lamp">Polarizer of the light</b> ${shot.light_deg.toFixed(0) % 180}&deg;</p>`;
  at("histogram").innerHTML = shot.histogram;
  at("rose").innerHTML = shot.rose;
}
async function look() {
  try {
    const state = await (await fetch("state.json")).json();
    at("line").textContent = state.line;
    const now = state.frame_id + " " + marks();
    if (state.frame_id !== null && now !== shown) {
      shown = now;
      at("picture").src = "live.jpg?" + state.frame_id;
      if (state.shot) {
        tell(state.shot);
        at("marked").src = "shot.jpg?" + marks() + "&" + state.frame_id;
      }
    }
  } catch { at("line").textContent = "polsep capture has ended"; }
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
        """Responses for the page, its pictures and its state."""

        def handle(self) -> None:
            """Read and answer requests until the browser has gone on: nothing is said of that."""
            with suppress(ConnectionError):
                super().handle()

        def do_GET(self) -> None:
            """Send the page, the state or a picture."""
            if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):  # port 80 is not named
                self.send_error(HTTPStatus.FORBIDDEN)
            elif (found := _content(self.path, latest(), line())) is None:
                self.send_error(HTTPStatus.NOT_FOUND)
            else:
                self._answer(*found)

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

    def run() -> None:
        lower_priority()  # threads that answer begin with it too
        server.serve_forever(0.1)

    thread = threading.Thread(target=run, name="page", daemon=True)
    thread.start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def _content(path: str, shown: Shown | None, line: str) -> tuple[str, bytes] | None:
    """Type and bytes of a part of the page: itself, its state, the latest picture, or the input with marks."""
    name, _, words = path.partition("?")
    shot = shown.shot if shown is not None else None
    if name == "/":
        return "text/html; charset=utf-8", PAGE
    if name == "/state.json":
        state = {"line": line, "frame_id": shown.frame_id if shown else None}
        return "application/json", json.dumps(state | ({"shot": shot.facts} if shot else {})).encode()
    if name == "/live.jpg" and shown is not None:
        return "image/jpeg", shown.jpeg
    if name == "/shot.jpg" and shot is not None:
        return "image/jpeg", shot.picture(frozenset(words.partition("&")[0].split(",")))
    return None
