"""The viewer's server as strangers meet it: other hosts, other paths, files too large, many at once."""

from __future__ import annotations

import http.client
import importlib.util
import json
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import imagecodecs
import numpy as np
import pytest
from viewer import running

from polsep import cli
from polsep.view.pictures import Exposure, Picture, Place, Small, stage
from polsep.view.server import require_address

GRADIO = importlib.util.find_spec("gradio") is not None
needs_gradio = pytest.mark.skipif(not GRADIO, reason="needs the extra view")
LIMIT_MB = 16


@pytest.fixture(scope="module")
def viewer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A viewer that takes 16 MB."""
    with running(tmp_path_factory.mktemp("view"), "--upload-limit", str(LIMIT_MB), "--method", "analytic") as address:
        yield address


def ask(address: str, verb: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    """Status and body of one answer."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=120)
    try:
        connection.request(verb, path, body or None, {k.replace("_", "-"): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def open_message(config: dict[str, Any], path: str) -> dict[str, Any]:
    """What the page sends after an upload."""
    (event,) = (d for d in config["dependencies"] if d["api_name"] == "open_upload")
    kinds = {c["id"]: c for c in config["components"]}
    file = {"path": path, "orig_name": Path(path).name, "meta": {"_type": "gradio.FileData"}}
    data = [[file] if kinds[i]["type"] == "uploadbutton" else kinds[i]["props"].get("value") for i in event["inputs"]]
    return {"data": data, "fn_index": event["id"]}


def test_separating_starts_no_process_and_calls_nobody() -> None:
    """The network's engine comes without the telemetry of its library, which a viewer must not send."""
    program = (
        "import sys, socket, multiprocessing, torch\n"
        "socket.socket.connect = lambda *a: sys.exit('connected')\n"
        "from polsep.sensor.camera import Layout, Mosaic\n"
        "from polsep.pipeline import separate_capture\n"
        "separate_capture(Mosaic(torch.rand(64, 64), Layout(), 0.0, 1.0), 'joint-fast')\n"
        "assert 'openvino' in sys.modules and sys.modules['openvino_telemetry'] is None\n"
        "assert multiprocessing.active_children() == []\n"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode == 0, run.stderr


def test_the_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without Gradio the command says what to install, and ends with 2."""
    monkeypatch.setitem(sys.modules, "gradio", None)
    monkeypatch.delitem(sys.modules, "polsep.view.page", raising=False)
    monkeypatch.setattr(sys, "argv", ["polsep", "view"])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    said = capsys.readouterr()
    assert (
        said.out == ""
        and said.err == "polsep: error: expected the extra 'view' (pip install 'polsep[view]'), found no gradio\n"
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["nowhere.png"], "nowhere.png: expected a file, found nothing"),
        (["report.json"], "report.json: expected a polsep recording"),
        (["notes.png"], "notes.png: expected a PNG file, found text"),
        (["--method", "magic"], "expected a method of"),
        (["--white-level", "much"], "expected a number as white level"),
    ],
)
def test_bad_options_are_one_line(
    options: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything starts."""
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "notes.png").write_text("no picture at all")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("polsep.view.server.serve", lambda _: pytest.fail("expected a refusal, found a page"))
    monkeypatch.setattr(sys, "argv", ["polsep", "view", *options])
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1


def test_addresses_that_cannot_be_had_are_one_line() -> None:
    """A port that another program has, and names and addresses of no machine or another one."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(ValueError, match=rf"free port, found 127\.0\.0\.1, port {port}: Address already in use"):
            require_address("127.0.0.1", port)
    for host in ("nowhere.invalid", "192.0.2.1", "a" * 70):
        with pytest.raises(ValueError, match=f"^expected an address of this machine and a free port, found {host}: "):
            require_address(host, None)
    require_address("127.0.0.1", port)


@needs_gradio
@pytest.mark.skipif(not socket.has_ipv6, reason="needs IPv6")
def test_it_listens_to_addresses_with_colons(tmp_path: Path) -> None:
    """As browsers write them, in brackets."""
    try:
        require_address("::1", None)
    except ValueError:
        pytest.skip("this machine has no address ::1")
    with running(tmp_path, "--method", "analytic", "--host", "::1") as address:
        assert address.startswith("http://[::1]:") and ask(address, "GET", "/")[0] == 200


@needs_gradio
def test_it_listens_to_this_machine_alone(viewer: str) -> None:
    """The page is there by this machine's names, and not by another, wherever that points."""
    status, page = ask(viewer, "GET", "/")
    assert status == 200 and b"polsep" in page
    assert ask(viewer, "GET", "/", host="evil.example")[0] == 403
    port = urlsplit(viewer).port
    assert port is not None
    others = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for other in others - {"127.0.0.1", "127.0.1.1"}:
        with socket.socket() as probe:
            probe.settimeout(2)
            assert probe.connect_ex((other, port)) != 0


@needs_gradio
def test_nothing_of_the_file_system_is_handed_out(viewer: str, tmp_path: Path) -> None:
    """Neither files nor addresses, by any of the ways that Gradio has."""
    secret = tmp_path / "secret.txt"
    secret.write_text("hidden words")
    source = Path(__file__).resolve()
    for path in (str(secret), str(source), "/etc/passwd", "../../etc/passwd", "http://127.0.0.1:1/x"):
        for way in ("/gradio_api/file=", "/gradio_api/file/", "/gradio_api/proxy=", "/file=", "/static/", "/assets/"):
            status, body = ask(viewer, "GET", f"{way}{path}")
            assert status in (403, 404, 405) and b"hidden words" not in body and b"root:" not in body


@needs_gradio
def test_a_large_upload_is_refused_at_once(viewer: str) -> None:
    """5 GB are refused by what they announce, before any of it is sent; without an announcement, at the limit."""
    address = urlsplit(viewer)
    with socket.create_connection((address.hostname, address.port), 10) as line:
        line.sendall(
            f"POST /gradio_api/upload HTTP/1.1\r\nHost: {address.netloc}\r\nContent-Length: 5000000000\r\n"
            "Content-Type: multipart/form-data; boundary=x\r\n\r\n".encode()
        )
        answer = line.recv(4096)
        while b"MB" not in answer and (more := line.recv(4096)):  # the body may come after the head
            answer += more
    assert answer.startswith(b"HTTP/1.1 413") and b"expected a file of at most 16 MB" in answer
    head = b'--x\r\nContent-Disposition: form-data; name="files"; filename="a.png"\r\n\r\n'
    body = head + bytes((LIMIT_MB << 20) + 1) + b"\r\n--x--\r\n"
    status, said = ask(viewer, "POST", "/gradio_api/upload", body, content_type="multipart/form-data; boundary=x")
    assert status == 413 and b"maximum allowed size" in said


@needs_gradio
def test_claimed_paths_open_nothing(viewer: str) -> None:
    """A message that names a file which was not uploaded does not get to see it."""
    config = json.loads(ask(viewer, "GET", "/config")[1])
    for claim in ("/etc/passwd", str(Path(__file__).resolve()), "http://127.0.0.1:1/a.png"):
        body = json.dumps({**open_message(config, claim), "session_hash": "stranger"}).encode()
        status, said = ask(viewer, "POST", "/gradio_api/run/predict", body, content_type="application/json")
        assert status >= 400 or b"expected a file that this page uploaded" in said
        assert b"ps-stage" not in said


def send_file(address: str, name: str, data: bytes) -> str:
    """Upload a file, and return where the server keeps it."""
    head = f'--x\r\nContent-Disposition: form-data; name="files"; filename="{name}"\r\n\r\n'.encode()
    body, kind = head + data + b"\r\n--x--\r\n", "multipart/form-data; boundary=x"
    status, said = ask(address, "POST", "/gradio_api/upload", body, content_type=kind)
    assert status == 200
    return str(json.loads(said)[0])


def fire(address: str, key: str, message: dict[str, Any]) -> bytes:
    """Everything that the server says to a page about one of its events."""
    body = json.dumps({**message, "session_hash": key}).encode()
    assert ask(address, "POST", "/gradio_api/queue/join", body, content_type="application/json")[0] == 200
    return ask(address, "GET", f"/gradio_api/queue/data?session_hash={key}")[1]


def message_of(config: dict[str, Any], name: str, **more: Any) -> dict[str, Any]:
    """An event of the page with the values that its components begin with."""
    event = next(d for d in config["dependencies"] if d["api_name"] == name)
    kinds = {c["id"]: c for c in config["components"]}
    data = [kinds[i]["props"].get("value") for i in event["inputs"]]
    return {"data": data, "fn_index": event["id"], "event_data": more}


@needs_gradio
def test_fifty_sessions_at_once_see_their_own_frames(viewer: str) -> None:
    """Fifty pages send fifty frames and wait in one line; every one gets its picture, and nothing of another's."""
    config = json.loads(ask(viewer, "GET", "/config")[1])
    cells = np.add.outer(np.arange(64), np.arange(64))

    def run(k: int) -> bytes:
        path = send_file(
            viewer, f"frame{k:03d}.png", bytes(imagecodecs.png_encode((cells * (20 + k)).astype(np.uint16)))
        )
        message = open_message(config, path)
        return fire(viewer, f"page{k}", message)

    with ThreadPoolExecutor(50) as pool:
        found = list(pool.map(run, range(50)))
    for k, said in enumerate(found):
        assert b"process_completed" in said and b"ps-stage" in said, said[-400:]
        assert set(re.findall(rb"frame\d{3}", said)) == {b"frame%03d" % k}
    pictures = {re.findall(rb"data:image/png;base64,[^\\\"]+", said)[0] for said in found}
    assert len(pictures) == 1  # brightness alone differs, and each page fits the exposure to its own frame
    pixels = {
        ask(viewer, "POST", "/gradio_api/run/predict", body, content_type="application/json")[1]
        for k in range(50)
        for body in [json.dumps({**message_of(config, "hover", x=0.9, y=0.9), "session_hash": f"page{k}"}).encode()]
    }
    assert len(pixels) == 50


@needs_gradio
def test_a_stranger_sees_nothing(viewer: str) -> None:
    """A page without a file gets no picture, no number and no file, whatever it asks."""
    config = json.loads(ask(viewer, "GET", "/config")[1])
    path = send_file(viewer, "mine.png", bytes(imagecodecs.png_encode(np.full((32, 32), 99, np.uint8))))
    assert b"ps-stage" in fire(viewer, "owner", open_message(config, path))
    for name in ("draw", "hover", "point", "sharpen", "advance"):
        message = message_of(config, name, x=0.5, y=0.5, window="0,0,10000,10000,100")
        body = json.dumps({**message, "session_hash": "stranger"}).encode()
        status, said = ask(viewer, "POST", "/gradio_api/run/predict", body, content_type="application/json")
        assert status == 200 and b"ps-readout" not in said and b"data:image" not in said and b"mine" not in said
    assert b"ps-stage" not in fire(viewer, "stranger", message_of(config, "separate"))
    assert b"mine" not in fire(viewer, "stranger", message_of(config, "answer"))


@needs_gradio
def test_the_docs_name_what_is_on_the_page(viewer: str) -> None:
    """Every label in docs/view.md is one of the page's."""
    text = (Path(__file__).resolve().parents[1] / "docs" / "view.md").read_text()
    labels = set(re.findall(r"\*\*([^*]+)\*\*", text)) - {"Specular"} | {"Specular [stops]"}
    panels = re.findall(r"^\| (\w+) \|", text[text.index("## Panels") : text.index("Downloads:")], re.MULTILINE)[1:]
    ones = np.ones((4, 4, 3), np.float32)
    small = Small(1, ones, ones, ones[..., 0], ones[..., 0], None, 1.0)
    drawn = stage((Picture("Input", small), Picture("Input", small)), Exposure(), Place(4))
    page = ask(viewer, "GET", "/config")[1].decode() + drawn
    assert len(labels) > 10 and panels == ["Settings", "Pixel", "Exposure", "Light", "Shape", "Edit"]
    assert [label for label in [*labels, *panels] if f'"{label}"' not in page and f">{label}<" not in page] == []


def test_the_pinned_gradio_was_checked() -> None:
    """The page's libraries are pinned, and docs/view.md says when these versions were checked against advisories."""
    root = Path(__file__).resolve().parents[1]
    pinned = dict(re.findall(r"^(\S+)==(\S+)$", (root / "constraints.txt").read_text(), re.MULTILINE))
    said = re.search(r"Checked on \d{4}-\d{2}-\d{2}: (.*?)\.\s", (root / "docs" / "view.md").read_text(), re.DOTALL)
    assert said is not None
    checked = dict(re.findall(r"(\S+) (\d[\d.]*\d)", said[1]))
    assert checked == {name: pinned[name] for name in ("gradio", "fastapi", "starlette", "uvicorn", "python-multipart")}


@needs_gradio
@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP])
def test_temporary_files_go_with_the_program(tmp_path: Path, ending: signal.Signals) -> None:
    """What was uploaded and never opened is gone after the end, also where the terminal is closed."""
    with running(tmp_path / "t", "--method", "analytic", ending=ending) as address:
        body = b'--x\r\nContent-Disposition: form-data; name="files"; filename="a.png"\r\n\r\nabc\r\n--x--\r\n'
        status, said = ask(address, "POST", "/gradio_api/upload", body, content_type="multipart/form-data; boundary=x")
        assert status == 200 and Path(json.loads(said)[0]).exists()
        (root,) = (tmp_path / "t").glob("polsep-view-*")
        assert root.stat().st_mode & 0o077 == 0
    assert list((tmp_path / "t").glob("polsep-view-*")) == []
