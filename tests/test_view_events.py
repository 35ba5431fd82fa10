"""Events of the viewer's page without a browser: files that overtake each other, edits, comparison, playback."""

from __future__ import annotations

import asyncio
import importlib.util
import re
import threading
import time
import warnings
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_view import mosaic_codes, opened, png, upload
from test_view_sequences import sessions

from polsep.edit import Metallic, Recipe, Rougher
from polsep.io.results.separation_writer import write_separation
from polsep.view.components import MENDS, OF_FILES, PAUSE, SAME, Components, Start, Updates
from polsep.view.edits import list_controls
from polsep.view.images import KINDS
from polsep.view.opening import parse_against, parse_settings
from polsep.view.session import DOWNLOADS, Session
from polsep.view.sessions import Sessions

__all__ = ["sessions"]  # fixtures
GRADIO = importlib.util.find_spec("gradio") is not None
pytestmark = pytest.mark.skipif(not GRADIO, reason="needs the extra view")
if GRADIO:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import gradio as gr

        from polsep.view import events as module
        from polsep.view.events import Events

SETTINGS = ("method", "resolution", "layout", "light", "white", "black", "size", "pixel_format", "index")
VIEW = {"left": "Input", "right": "Diffuse", "against": SAME, "stops": 0, "specular_stops": 0, "marks": False}
VALUES = {**OF_FILES, **VIEW, "method": "analytic", "resolution": "half", "index": 0, "keep": False}
LEVELS = {"white": "4095", "method": "analytic"}
REQUEST: Any = SimpleNamespace(session_hash="a")


def components() -> Components:
    """Components that are their own names."""
    plain = (
        "keep file demo progress cancel status stage strip play timer beside readout exposure light find_shape shape "
        "neutral link"
    )
    return Components(
        settings={name: name for name in SETTINGS},
        mends=tuple(f"mend-{k}" for k in range(MENDS)),
        view={name: name for name in VIEW},
        controls=tuple(f"{c.edit.name}.{c.parameter.name}" for c in list_controls()),
        images={kind: kind for kind in KINDS},
        fetch={kind: kind for kind in DOWNLOADS},
        **{name: name for name in plain.split()},
    )


@pytest.fixture
def events(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> Events:
    """Events of pages that tell their progress often."""
    monkeypatch.setattr(module, "WORD_S", 0.02)
    return Events(sessions, components(), Start({}))


class Held:
    """Separations of a file named slow: one has begun, and all may go on."""

    def __init__(self) -> None:
        self.begun, self.go_on = threading.Event(), threading.Event()


@pytest.fixture
def held(sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> Iterator[Held]:
    """Separations of a file named slow last until they may go on."""
    from polsep.view import session

    found, real = Held(), session.open_frame

    def open_frame(sources: Any, settings: Any, read: Any) -> Any:
        if sources[0].stem == "slow":
            found.begun.set()
            assert found.go_on.wait(60)
        return real(sources, settings, read)

    monkeypatch.setattr(session, "open_frame", open_frame)
    yield found
    found.go_on.set()


async def collect(updates: AsyncIterator[Updates]) -> list[Updates]:
    """All that an event tells the page."""
    return [update async for update in updates]


async def reached(flag: threading.Event) -> None:
    """Wait for a flag of another thread."""
    assert await asyncio.to_thread(flag.wait, 60)


def file(folder: Path, name: str) -> Path:
    """A small frame of the owner."""
    path = folder / f"{name}.png"
    path.write_bytes(png(mosaic_codes()))
    return path


def until(ready: Callable[[], Any]) -> None:
    """Wait until a function is true."""
    for _ in range(3000):
        if ready():
            return
        time.sleep(0.01)
    raise AssertionError("expected truth, found none for half a minute")


def playing(sessions: Sessions, against: str = SAME) -> Session:
    """A page that has played the second frame of a stack, the first being separated."""
    np.save(sent := upload(sessions, "stack.npy", b""), np.stack([mosaic_codes(seed=k) for k in range(2)]))
    sessions.open_upload("a", [(str(sent), sent.name)])
    page, settings = sessions.find("a"), parse_settings({**LEVELS, "method": "color-affine"})
    page.separate(settings, parse_against(against, settings))
    page.toggle()
    until(page.play)
    assert page.place == 1
    return page


def names(update: Updates) -> tuple[str, str]:
    """The names of the two pictures."""
    left, right = re.findall(r'<span class="ps-name ps-name-\w+">(.*?)</span>', update["stage"])
    return left, right


def test_the_file_that_was_sent_last_is_shown(events: Events, held: Held, tmp_path: Path) -> None:
    """Also while another one with the same settings is separated, whose result is dropped."""

    async def act() -> tuple[list[Updates], list[Updates]]:
        first = asyncio.create_task(collect(events.open_own(file(tmp_path, "slow"), VALUES, REQUEST)))
        await reached(held.begun)
        second = events.open_own(file(tmp_path, "next"), VALUES, REQUEST)
        shown = [await anext(second)]
        before = await asyncio.wait_for(first, 60)
        held.go_on.set()
        return before, shown + await collect(second)

    before, shown = asyncio.run(act())
    assert "Waiting, 1 before this one" in shown[0]["progress"]
    assert "<b>next</b>" in shown[-1]["status"] and shown[-1]["progress"] == ""
    assert shown[-1]["cancel"] == gr.update(visible=False)
    assert all("status" not in update for update in before)


def test_settings_changed_meanwhile_stay(events: Events, held: Held, tmp_path: Path) -> None:
    """A file says its settings once, not with every word on progress; a wrong setting ends the work by others."""

    async def act() -> tuple[list[Updates], list[Updates]]:
        first = asyncio.create_task(collect(events.open_demo({**VALUES, "keep": True}, REQUEST)))
        await asyncio.wait_for(first, 60)
        slow = events.open_own(file(tmp_path, "slow"), VALUES, REQUEST)
        shown = [await asyncio.wait_for(anext(slow), 60) for _ in range(3)]
        rest = asyncio.create_task(collect(slow))
        await reached(held.begun)
        wrong = await collect(events.separate({**VALUES, "white": "40x"}, REQUEST))
        return shown + await asyncio.wait_for(rest, 60), wrong

    shown, (wrong,) = asyncio.run(act())
    assert "white" in shown[0] and all("white" not in update for update in shown[1:])
    assert "expected a number as white level" in wrong["status"]
    assert all("status" not in update for update in shown)  # which would replace the message
    held.go_on.set()


def test_a_file_that_fails_ends_the_wait_for_the_one_before(
    events: Events, sessions: Sessions, held: Held, tmp_path: Path
) -> None:
    """The page says what failed, waits for nothing, and has no frame."""
    sent = upload(sessions, "notes.txt", b"hello")

    async def act() -> tuple[list[Updates], list[Updates]]:
        first = asyncio.create_task(collect(events.open_own(file(tmp_path, "slow"), VALUES, REQUEST)))
        await reached(held.begun)
        claimed = {"path": str(sent), "orig_name": sent.name}
        shown = await collect(events.open_upload({**VALUES, "file": [claimed]}, REQUEST))
        return await asyncio.wait_for(first, 60), shown

    before, (shown,) = asyncio.run(act())
    assert "notes.txt: expected" in shown["status"] and shown["cancel"] == gr.update(visible=False)
    assert before[-1]["progress"] == "" and all("status" not in update for update in before)
    held.go_on.set()
    assert sessions.line.join("b", lambda ticket: "done").future.result(60) == "done"  # after the one before
    assert sessions.find("a").opened is None


def test_frames_without_colour_reset_the_controls_of_colour(events: Events, sessions: Sessions) -> None:
    """Edits that are left out have a remark, and their controls stand where they start; others stay."""
    opened(sessions)
    sessions.find("a").edit(Recipe((Rougher(sigma=3.0), Metallic(amount=0.5))))
    shown = asyncio.run(collect(events.separate({**VALUES, **LEVELS, "layout": "mono"}, REQUEST)))[-1]
    assert f"{Metallic.title} is left out" in shown["status"] and isinstance(shown["stage"], str)
    starts = {f"{c.edit.name}.{c.parameter.name}": c.start for c in list_controls()}
    reset = {name: value for name, value in shown.items() if name in starts}
    assert reset == {name: starts[name] for name in starts if name.startswith("metallic.")}


def test_no_numbers_of_another_frame_while_it_plays(events: Events, sessions: Sessions) -> None:
    """A pixel is read from the frame that is seen, or not at all."""
    page = playing(sessions)
    events._see(page, VALUES)
    at: Any = SimpleNamespace(x=0.5, y=0.25)
    assert events.hover(REQUEST, at) == {"readout": PAUSE}
    assert asyncio.run(events.point(REQUEST, at))["readout"] == PAUSE
    page.toggle()
    shown = asyncio.run(collect(events.settle({**VALUES, **LEVELS}, REQUEST)))[-1]
    assert shown["index"]["value"] == 1
    assert "row 12, column 32" in events.hover(REQUEST, at)["readout"]


def test_what_plays_is_of_one_method(events: Events, sessions: Sessions) -> None:
    """The compared method has its name while its picture is there, and no other picture has it."""
    page = playing(sessions, "analytic, half")
    assert names(asyncio.run(events.draw(VALUES, REQUEST))) == ("Input", "Diffuse")
    until(page.play)
    assert page.place == 0
    expected = ("Input · color-affine, half", "Diffuse · analytic, half")
    assert names(asyncio.run(events.draw(VALUES, REQUEST))) == expected


def test_the_compared_method_is_not_edited(events: Events, sessions: Sessions) -> None:
    """Its picture is named as what it is, also at the screen's resolution; without edits both are one."""
    opened(sessions)
    page, settings = sessions.find("a"), parse_settings({**LEVELS, "method": "color-affine"})
    page.separate(settings, parse_against("analytic, half", settings))
    edited = {**VALUES, "left": "Edited", "right": "Edited"}
    assert names(asyncio.run(events.draw(edited, REQUEST)))[1] == "Edited · analytic, half"
    page.edit(Recipe((Metallic(amount=0.5),)))
    shown = asyncio.run(events.draw(edited, REQUEST))
    assert names(shown) == ("Edited · color-affine, half", "Input · analytic, half")
    plain = asyncio.run(events.draw({**edited, "right": "Input"}, REQUEST))
    assert shown["stage"] == plain["stage"]


def test_a_result_is_not_compared_with_itself(events: Events, sessions: Sessions, tmp_path: Path) -> None:
    """No method makes another separation of one, so no picture has a method's name, and the page says so."""
    path = write_separation(opened(sessions).frame, tmp_path, "shot", "exr")[0]
    shown = asyncio.run(collect(events.open_own(path, {**VALUES, "against": "analytic, half"}, REQUEST)))[-1]
    assert names(shown) == ("Input", "Diffuse")
    assert shown["against"] == SAME and "only raw frames are separated by other methods" in shown["status"]
    assert "against" not in asyncio.run(collect(events.separate(VALUES, REQUEST)))[-1]


def test_a_later_picture_stays(events: Events, sessions: Sessions, monkeypatch: pytest.MonkeyPatch) -> None:
    """The exposure is moved while panels of a new frame are drawn: its picture has been sent then."""
    opened(sessions)
    real, drawn = module.light_panel, list[Updates]()

    async def act() -> Updates:
        loop = asyncio.get_running_loop()

        def light_panel(*said: Any) -> str:
            later = events.draw({**VALUES, "stops": 2}, REQUEST)
            drawn.append(asyncio.run_coroutine_threadsafe(later, loop).result(60))
            return real(*said)

        monkeypatch.setattr(module, "light_panel", light_panel)
        return (await collect(events.separate({**VALUES, **LEVELS}, REQUEST)))[-1]

    shown = asyncio.run(act())
    assert isinstance(drawn[0]["stage"], str) and shown["stage"] == gr.skip()
    assert "analytic" in shown["status"] and shown["progress"] == ""


def test_a_frame_that_was_closed_is_not_shown(
    events: Events, sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file was opened while its panels were drawn: nothing of them reaches the page."""
    opened(sessions)
    real = module.light_panel

    def light_panel(*said: Any) -> str:
        sessions.find("a").forget()
        return real(*said)

    monkeypatch.setattr(module, "light_panel", light_panel)
    shown = asyncio.run(collect(events.separate({**VALUES, **LEVELS}, REQUEST)))[-1]
    assert shown == {"stage": gr.skip()}


@pytest.mark.parametrize("action", ["undo", "a wrong file"])
def test_other_pages_go_on_while_one_waits_for_its_session(events: Events, sessions: Sessions, action: str) -> None:
    """A download that is being written holds its own page's edits and files, not the server."""
    opened(sessions)
    page, holds, release = sessions.find("a"), threading.Event(), threading.Event()
    events._see(page, VALUES)

    def hold() -> None:
        with page.lock:
            holds.set()
            release.wait(20)

    async def undo() -> Any:
        return await events.undo(VALUES, REQUEST)

    async def send() -> Any:
        claimed = {"path": str(upload(sessions, "notes.txt", b"hello")), "orig_name": "notes.txt"}
        return await collect(events.open_upload({**VALUES, "file": [claimed]}, REQUEST))

    async def act() -> bool:
        holder = asyncio.create_task(asyncio.to_thread(hold))
        await reached(holds)
        waits = asyncio.create_task((undo if action == "undo" else send)())
        _, pending = await asyncio.wait({waits}, timeout=0.1)
        free = not holder.done()
        release.set()
        await waits
        return bool(pending) and free

    assert asyncio.run(act())


def test_the_demo_is_by_another_sensor_than_the_owners(sessions: Sessions, tmp_path: Path) -> None:
    """The owner's calibration and lamp-off frame are for the owner's files, not for the example frame."""
    room, demo = file(tmp_path, "room"), file(tmp_path, "demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "DEMO", demo)
        events = Events(sessions, components(), Start({"ambient": (room,)}))
        last = asyncio.run(collect(events.open_demo({**VALUES, **LEVELS}, REQUEST)))[-1]
        assert "analytic" in last["status"]
        page = sessions.find("a").opened
        assert page is not None and page.frame.diffuse.mean() > 0.05
        asyncio.run(collect(events.open_own(file(tmp_path, "own"), {**VALUES, **LEVELS}, REQUEST)))
        page = sessions.find("a").opened
        assert page is not None and page.stem == "own" and page.frame.diffuse.mean() == 0  # less itself


def test_a_shape_of_a_frame_that_was_closed_is_not_shown(
    events: Events, sessions: Sessions, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another file was opened while it was found."""
    opened(sessions)

    def shape_panel(*said: Any) -> str:
        if later:
            sessions.find("a").forget()
        return "surface"

    monkeypatch.setattr(module, "shape_panel", shape_panel)
    later = False
    assert asyncio.run(events.find_shape(REQUEST))["shape"] == "surface"
    later = True
    shown = asyncio.run(events.find_shape(REQUEST))
    assert "surface" not in shown.values() and set(shown) <= {"shape", "status"}  # what the button may change
