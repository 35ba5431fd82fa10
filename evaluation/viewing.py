"""Response times of `polsep view` through the page's own server, without a browser, and the time of every edit.

Waiting is from a request to its whole answer, as a browser on this machine makes it: what the browser adds to draw the
picture, some 10 ms at screen size, is not in it. Every number is the median of `TIMES` after a first one, or of
`PLAIN_TIMES` of plain NumPy, which takes seconds; but for the first frame and for what plays.
"""

from __future__ import annotations

import http.client
import json
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from evaluation.naive import NAIVE, naive_texture
from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_capture, read_demo_codes
from polsep.edit import EDITS, SeparatedImages, Texture, make_edit
from polsep.edit.edits import Edit
from polsep.io.store.rows import read_bytes, write_array
from polsep.io.store.samples import DEMO, DEMO_WHITE
from polsep.methods import find_method
from polsep.pipeline import separate_capture
from polsep.sensor.levels import as_mosaic
from polsep.view.edits import list_controls
from polsep.view.server import ViewOptions, serve

#: How often something is measured, and plain NumPy.
TIMES, PLAIN_TIMES = 15, 3
CASE = "2448x2048 colour frame"
SMALL, LARGE = "screen size, 612x512", "1224x1024 in colour"
#: Values of edits that are measured, where the defaults are the identity or too mild.
VALUES: dict[str, dict[str, Any]] = {
    "diffuse-gain": {"gain": 1.5},
    "specular-gain": {"gain": 2.0},
    "tint": {"color": (1.0, 0.8, 0.6)},
    "texture": {"image": "texture", "repeats": 3.0},
}

Floats = NDArray[np.float32]


class Event(NamedTuple):
    """An action of a user: the part of the page, the name of its event, and the new value."""

    part: str
    name: str
    value: Any


class Page:
    """One open page of a viewer at an address. State: the values of its parts, as a browser holds them."""

    def __init__(self, address: str, key: str) -> None:
        self._host, self._key = urlsplit(address).netloc, key
        self._config = json.loads(self._ask("GET", "/config"))
        parts = {part["id"]: part for part in self._config["components"]}
        self._values = {number: part["props"].get("value") for number, part in parts.items()}
        self._ids = {str(part["props"].get("elem_id")): number for number, part in parts.items()}

    def send(self, name: str, data: bytes) -> Any:
        """Upload a file, and return the page's record of it."""
        head = f'--x\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'
        body = head.encode() + data + b"\r\n--x--\r\n"
        (path,) = json.loads(self._ask("POST", "/gradio_api/upload", body, "multipart/form-data; boundary=x"))
        return {"path": path, "orig_name": name, "meta": {"_type": "gradio.FileData"}}

    def do(self, event: Event) -> bytes:
        """Fire an event, and return the answer. Raises ValueError where the answer reports a failure."""
        number = self._ids[event.part]
        self._values[number] = event.value
        return self._fire(number, event.name)

    def tick(self) -> bytes:
        """Fire the page's clock."""
        (number,) = (part["id"] for part in self._config["components"] if part["type"] == "timer")
        return self._fire(number, "tick")

    def _fire(self, number: int, name: str) -> bytes:
        """The answer to an event of a part."""
        (asked,) = (a for a in self._config["dependencies"] if [number, name] in [list(t) for t in a["targets"]])
        data = [self._values[part] for part in asked["inputs"]]
        message = {"data": data, "fn_index": asked["id"], "session_hash": self._key, "trigger_id": number}
        queued = asked["queue"] is not False
        way = "/gradio_api/queue/join" if queued else "/gradio_api/run/predict"
        said = self._ask("POST", way, json.dumps(message).encode(), "application/json")
        said = self._ask("GET", f"/gradio_api/queue/data?session_hash={self._key}") if queued else said
        if b"ps-error" in said or (queued and b"process_completed" not in said):
            raise ValueError(f"expected an answer to {name} of part {number}, found {said[-300:]!r}")
        return said

    def _ask(self, verb: str, path: str, body: bytes | None = None, kind: str = "text/plain") -> bytes:
        connection = http.client.HTTPConnection(self._host, timeout=300)
        try:
            connection.request(verb, path, body, {"Content-Type": kind})
            answer = connection.getresponse()
            said = answer.read()
        finally:
            connection.close()
        if answer.status != 200:
            raise ValueError(f"expected an answer to {path}, found status {answer.status}: {said[:200]!r}")
        return said


def bench_view() -> Iterator[Row]:
    """Seconds from opening a frame to its picture, answers to sliders, and edits beside plain NumPy.

    Raises ValueError without the extra view.
    """
    try:
        with serve(ViewOptions(settings={"white": f"{DEMO_WHITE:g}"})) as address:
            yield from _bench_page(address)
    except ModuleNotFoundError as error:
        raise ValueError(f"expected the extra view (pip install 'polsep[view]'), found no {error.name}") from None
    yield from bench_edits()


def _bench_page(address: str) -> Iterator[Row]:
    """Rows of the times that a user waits."""
    page = Page(address, "bench")
    data, codes = read_bytes(DEMO), read_demo_codes()
    method = find_method("auto", as_mosaic(codes, white_level=DEMO_WHITE)[0]).name

    def open_frame() -> None:
        page.do(Event("ps-file", "upload", [page.send("shot.png", data)]))

    yield Row("view/page", CASE, method, "opened just after the start", _seconds(open_frame), "s")
    yield Row("view/page", CASE, method, "opened, separated and shown", _median(open_frame, 5), "s")
    steps = iter(np.linspace(-2, 2, 1000).tolist())
    moved = _median(lambda: page.do(Event("ps-stops", "input", next(steps))))
    yield Row("view/page", SMALL, "slider of exposure", "answer", 1000 * moved, "ms")
    for control in list_controls():
        about = control.parameter
        if about.kind != "number" or control.edit is Texture:
            continue
        part = f"ps-{control.edit.name}-{about.name}"
        places = iter(np.linspace(about.low, about.high, TIMES + 3)[1:].tolist())
        moved = _median(lambda part=part, places=places: page.do(Event(part, "input", next(places))))  # type: ignore[misc]
        yield Row("view/page", SMALL, f"slider {control.edit.name} {about.name}", "answer", 1000 * moved, "ms")
        page.do(Event(part, "input", control.start))
    with TemporaryDirectory() as folder:
        path = Path(folder) / "stack.npy"
        write_array(path, np.stack([np.roll(codes, 16 * k, axis=1) for k in range(4)]))
        page.do(Event("ps-file", "upload", [page.send("stack.npy", read_bytes(path))]))
    page.do(Event("ps-play", "click", "Play"))
    made = _seconds(lambda: _show(page, 4))
    yield Row("view/page", f"sequence of {CASE}s", method, "played at first", 4 / made, "frames/s")
    shown = _seconds(lambda: _show(page, TIMES))
    yield Row("view/page", f"sequence of {CASE}s", method, "played again", TIMES / shown, "frames/s")


def _show(page: Page, count: int) -> None:
    """Wait until ``count`` frames of the playing sequence were shown."""
    while count > 0:
        count -= b"ps-stage" in page.tick()


def bench_edits() -> Iterator[Row]:
    """Every edit on the demo's frame, and the same in plain NumPy: time, ratio, and the largest difference."""
    found = separate_capture(read_demo_capture(), "color-affine", "white")
    images = SeparatedImages(found.diffuse, found.specular)
    texture = np.random.default_rng(0).random((512, 512, 3), dtype=np.float32)
    for name, kind in EDITS.items():
        edit = make_edit(kind, VALUES.get(name, {}))
        plain = naive_texture(texture) if kind is Texture else NAIVE[name]
        yield from _compare(edit, plain, images, {"texture": texture})


def _compare(
    edit: Edit, plain: Callable[[Edit, Floats, Floats], tuple[Floats, Floats]], images: SeparatedImages, maps: Any
) -> Iterator[Row]:
    mine = _median(lambda: edit.change(images, maps))
    theirs = _median(lambda: plain(edit, images.diffuse, images.specular), PLAIN_TIMES)
    expected, after = plain(edit, images.diffuse, images.specular), edit.change(images, maps)
    pairs = zip((after.diffuse, after.specular), expected, strict=True)
    largest = max(float(np.abs(a - b).max() / max(float(np.abs(b).max()), 1e-9)) for a, b in pairs)
    rows = (("polsep", 1000 * mine, "ms"), ("plain NumPy", 1000 * theirs, "ms"), ("times as fast", theirs / mine, "x"))
    for metric, value, unit in (*rows, ("largest difference", largest, "of the largest value")):
        yield Row("view/edits", LARGE, edit.name, metric, value, unit)


def _seconds(work: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def _median(work: Callable[[], Any], count: int = TIMES) -> float:
    work()
    return statistics.median(_seconds(work) for _ in range(count))
