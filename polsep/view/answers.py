"""What the page's events do to the session that they come from; each gives what the page shows next, in order.

A page that plays asks for frame after frame; each answer has the next one if it is ready, under the current edits.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gradio as gr

from polsep.view.edits import list_controls, recipe_of
from polsep.view.images import KINDS
from polsep.view.opening import DEMO, DEMO_WHITE, Found, parse_settings
from polsep.view.pictures import confidence_panel, histogram_panel, polarization_panel, stage
from polsep.view.readout import read_pixel, readout_panel
from polsep.view.session import Session, Sessions
from polsep.view.style import EMPTY

HINT = '<p class="ps-hint">Click into the picture to read a pixel; drag to move the line.</p>'
#: What goes wrong with a file, a setting or a disk; all say it in one line.
FAILURES = (ValueError, OSError, MemoryError, RuntimeError)
#: Names of the buttons that take images.
IMAGES = {"texture": "Texture", "normals": "Normals", "mask": "Mask for all edits"}

Said = dict[Any, Any]


@dataclass(frozen=True)
class Start:
    """What the page shows first: the values of its settings, and whether a ``file`` of the owner's is opened."""

    settings: dict[str, str]
    file: Any = None


@dataclass(frozen=True)
class Parts:
    """The page's components. ``settings`` by the names that `parse_settings` knows, ``images`` by kind."""

    settings: dict[str, Any]
    file: Any
    demo: Any
    suggest: Any
    status: Any
    left: Any
    right: Any
    stops: Any
    stage: Any
    strip: Any
    play: Any
    timer: Any
    readout: Any
    panels: tuple[Any, Any, Any]
    controls: tuple[Any, ...]
    images: dict[str, Any]
    neutral: Any
    fetch: dict[str, Any]
    link: Any

    def shown(self) -> list[Any]:
        """What a separation changes, in the order of `Answers.show`."""
        index = self.settings["index"]
        changed = [self.status, self.stage, self.readout, *self.panels, self.strip, index, self.play, self.timer]
        return [*changed, *self.images.values(), self.suggest]

    def picture(self) -> list[Any]:
        """What says how the picture is drawn."""
        return [self.left, self.right, self.stops]

    def edited(self) -> list[Any]:
        """What an edit changes."""
        return [self.stage, self.status, self.left, self.right]

    def played(self) -> list[Any]:
        """What the next frame changes."""
        return [self.stage, self.settings["index"], self.status, self.play, self.timer]

    def control(self, edit: str, parameter: str) -> Any:
        """The control of one value of an edit."""
        places = [(control.edit.name, control.parameter.name) for control in list_controls()]
        return self.controls[places.index((edit, parameter))]


class Answers:
    """What the page's events do to the session that they come from."""

    def __init__(self, sessions: Sessions, parts: Parts, start: Start) -> None:
        self.sessions, self.parts, self.start = sessions, parts, start

    def open_upload(self, said: Said, request: gr.Request) -> list[Any]:
        """Files that the user has just sent."""
        sent = [_claim(file) for file in said[self.parts.file] or ()]
        return self._open(lambda: self.sessions.open_upload(_key(request), sent), said, request)

    def open_demo(self, said: Said, request: gr.Request) -> list[Any]:
        """The capture that comes with polsep, whose white level is known."""
        white = self.parts.settings["white"]
        said = {**said, white: f"{DEMO_WHITE:g}", self.parts.settings["black"]: "0"}
        return self._open(lambda: self._session(request).begin_own(DEMO), said, request)

    def open_own(self, file: Any, said: Said, request: gr.Request) -> list[Any]:
        """The file that the command named."""
        return self._open(lambda: self._session(request).begin_own(file), said, request)

    def use_white(self, said: Said, request: gr.Request) -> list[Any]:
        """The white level that a remark recommends."""
        found = self._session(request).found
        white = None if found is None else found.suggested_white()
        said = said if white is None else {**said, self.parts.settings["white"]: f"{white:g}"}
        return [*self.separate(said, request), said[self.parts.settings["white"]], None]

    def _open(self, prepare: Callable[[], None], said: Said, request: gr.Request) -> list[Any]:
        session, white = self._session(request), said[self.parts.settings["white"]]
        session.playing = False
        try:
            prepare()
        except FAILURES as error:
            session.forget()
            return [*self._failed(error, session), white, None]
        return [*self.separate({**said, self.parts.settings["index"]: 0}, request), white, None]

    def separate(self, said: Said, request: gr.Request) -> list[Any]:
        """The session's file under the settings that the page shows."""
        session = self._session(request)
        try:
            found = session.separate(parse_settings({n: said[part] for n, part in self.parts.settings.items()}))
        except FAILURES as error:
            return self._failed(error, session)
        return self._show(session, found, said)

    def _show(self, session: Session, found: Found, said: Said) -> list[Any]:
        white = found.suggested_white()
        return [
            status_line(found),
            self._stage(session, said),
            self._readout(session, found),
            polarization_panel(found.small),
            histogram_panel(found.histogram),
            confidence_panel(found.frame, found.small),
            gr.update(visible=found.count > 1),
            gr.update(maximum=max(found.count - 1, 1), value=found.index),
            *_play_state(session),
            *_image_names(session),
            gr.update(visible=white is not None, value=f"Use white level {white or 0:g}"),
        ]

    def _failed(self, error: BaseException, session: Session) -> list[Any]:
        """The error in the status; pictures stay where there still is a frame."""
        session.playing = False
        nothing = [EMPTY, HINT, *[EMPTY] * 3, gr.update(visible=False)]
        kept = [gr.skip()] * len(nothing) if session.found is not None else nothing
        stopped = [gr.skip(), *_play_state(session), *_image_names(session), gr.update(visible=False)]
        return [failure_line(error), *kept, *stopped]

    def draw(self, said: Said, request: gr.Request) -> Any:
        """The same frame, other pictures or another exposure."""
        return self._stage(self._session(request), said)

    def point(self, said: Said, request: gr.Request, event: gr.EventData) -> list[Any]:
        """The numbers of the pixel that was clicked."""
        session = self._session(request)
        found = session.found
        if found is None:
            return [gr.skip(), gr.skip()]
        height, width = found.small.size
        session.mark = _inside(event.y, height), _inside(event.x, width)
        return [self._stage(session, said), self._readout(session, found)]

    def edit(self, said: Said, request: gr.Request) -> list[Any]:
        """The frame with the edits that the controls stand for, shown in place of the right picture."""
        session = self._session(request)
        try:
            session.edit(self._recipe(session, said))
        except FAILURES as error:
            return [gr.skip(), failure_line(error), gr.skip(), gr.skip()]
        return self._edited(session, said)

    def undo(self, said: Said, request: gr.Request) -> list[Any]:
        """The frame without edits, and without their images."""
        session, starts = self._session(request), [control.start for control in list_controls()]
        session.edit(recipe_of(starts))
        session.drop_images()
        return [*self._edited(session, said), *_image_names(session), *starts]

    def add_image(self, kind: str) -> Callable[[Said, gr.Request], list[Any]]:
        """An answer that takes an image of a kind for edits; a first texture is laid on at once."""

        def answer(said: Said, request: gr.Request) -> list[Any]:
            session, part = self._session(request), self.parts.images[kind]
            amount = self.parts.control("texture", "amount")
            said = said | {amount: said[amount] or 1.0} if kind == "texture" else said
            try:
                self.sessions.add_image(_key(request), kind, *_claim(said[part]))
                session.edit(self._recipe(session, said))
            except FAILURES as error:
                skipped = [gr.skip()] * (len(self.parts.edited()) - 2)
                return [gr.skip(), failure_line(error), *skipped, *_image_names(session), gr.skip()]
            return [*self._edited(session, said), *_image_names(session), said[amount]]

        return answer

    def _recipe(self, session: Session, said: Said) -> Any:
        names = {kind: sent.name for kind, sent in session.images.items()}
        return recipe_of([said[control] for control in self.parts.controls], names)

    def toggle(self, request: gr.Request) -> list[Any]:
        """Play, or pause."""
        session = self._session(request)
        session.playing = not session.playing and session.found is not None and session.found.count > 1
        return _play_state(session)

    def settle(self, said: Said, request: gr.Request) -> list[Any]:
        """After a pause: numbers and panels of the frame that is seen."""
        session = self._session(request)
        if session.playing or session.found is None or session.place == session.found.index:
            return [gr.skip()] * len(self.parts.shown())
        return self.separate({**said, self.parts.settings["index"]: session.place}, request)

    def advance(self, said: Said, request: gr.Request) -> list[Any]:
        """The next frame of what is being played, if it is ready."""
        session = self._session(request)
        waiting = [gr.skip()] * len(self.parts.played())
        try:
            if not session.playing or not session.play():
                return waiting
        except FAILURES as error:
            session.playing = False
            return [gr.skip(), gr.skip(), failure_line(error), *_play_state(session)]
        return [self._stage(session, said), session.place, *waiting[2:]]

    def _edited(self, session: Session, said: Said) -> list[Any]:
        said = {**said, self.parts.left: "Input", self.parts.right: "Edited"}
        remarks = session.recipe.cautions()
        status = gr.skip() if session.found is None else status_line(session.found, remarks)
        return [self._stage(session, said), status, "Input", "Edited"]

    def write(self, kind: str) -> Callable[[gr.Request], list[Any]]:
        """An answer that writes one of `WANTED` and hands it out."""

        def answer(request: gr.Request) -> list[Any]:
            session = self._session(request)
            try:
                return [str(session.write(kind)), gr.skip()]
            except FAILURES as error:
                raise gr.Error(one_line(error), print_exception=False) from error

        return answer

    def leave(self, request: gr.Request) -> None:
        """The page was closed."""
        self.sessions.end(_key(request))

    def _session(self, request: gr.Request) -> Session:
        return self.sessions.find(_key(request))

    def _stage(self, session: Session, said: Said) -> Any:
        shown = session.shown
        if shown is None:
            return EMPTY
        left, right, stops = (said[part] for part in self.parts.picture())
        return stage(shown, (str(left), str(right)), float(stops), session.mark)

    def _readout(self, session: Session, found: Found) -> str:
        if session.mark is None:
            return HINT
        step, (height, width) = found.small.step, found.frame.valid.shape
        row, col = (min(n * step + step // 2, most - 1) for n, most in zip(session.mark, (height, width), strict=True))
        return readout_panel(read_pixel(found.frame, found.mosaic, (row, col)))


def _key(request: gr.Request) -> str:
    return str(request.session_hash)


def _claim(sent: object) -> tuple[object, str]:
    """Path and name of an uploaded file as a client tells them."""
    told = sent if isinstance(sent, dict) else {}
    return told.get("path"), str(told.get("orig_name") or told.get("path") or "")


def _play_state(session: Session) -> list[Any]:
    """The button and the clock of a page that plays, or does not."""
    return [gr.update(value="Pause" if session.playing else "Play"), gr.update(active=session.playing)]


def _image_names(session: Session) -> list[Any]:
    """The buttons that take images, by what they hold."""
    names = {kind: session.images[kind].name if kind in session.images else "none" for kind in KINDS}
    return [gr.update(label=f"{IMAGES[kind]}: {names[kind]}") for kind in KINDS]


def _inside(share: object, count: int) -> int:
    """The pixel at a share of a side, wherever a client says it was."""
    value = float(share) if isinstance(share, (int, float)) else 0.0
    return min(max(int(min(max(value, 0.0), 1.0) * count), 0), count - 1)


def one_line(error: BaseException) -> str:
    """What went wrong, in one line."""
    return " ".join(str(error).split())[:500] or type(error).__name__


def failure_line(error: BaseException) -> str:
    """The status after something went wrong."""
    return f'<div class="ps-error" role="alert">{html.escape(one_line(error))}</div>'


def status_line(found: Found, more: Sequence[str] = ()) -> str:
    """The status after a separation: what was separated, how, what is remarkable about it."""
    frame = found.frame
    height, width = frame.valid.shape
    said = [f"{width} × {height} pixels", str(frame.report["method"])]
    if found.mosaic is not None:
        rows, cols = found.mosaic.data.shape[-2:]
        said[0] = f"{cols} × {rows} raw, {said[0]} separated"
    statistics = frame.report["statistics"]
    if "clipped_fraction" in statistics:
        said.append(f"{statistics['clipped_fraction']:.2%} of the pixels clip")
        said.append(f"light polarizer about {statistics['light_polarizer_deg']:.0f}°")
    said.append(f"{found.seconds:.2f} s")
    name = html.escape(found.stem)
    line = "".join(f"<span>{html.escape(text)}</span>" for text in said)
    remarks = "".join(f'<div class="ps-remark">{html.escape(remark)}</div>' for remark in (*found.remarks, *more))
    return f'<div class="ps-line"><b>{name}</b>{line}</div>{remarks}'
