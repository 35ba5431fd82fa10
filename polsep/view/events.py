"""Event functions of the page: each acts on the page's session and returns updates of components, in order.

A playing page asks for frame after frame; each answer has the next one if it is ready, with the current edits.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gradio as gr

from polsep.io.store import errors
from polsep.view.edits import list_controls, recipe_of
from polsep.view.images import KINDS
from polsep.view.opening import DEMO, DEMO_WHITE, OpenedFrame, parse_settings
from polsep.view.pictures import confidence_panel, histogram_panel, polarization_panel, stage
from polsep.view.readout import read_pixel, readout_panel
from polsep.view.session import Session, Sessions
from polsep.view.style import EMPTY

HINT = '<p class="ps-hint">Click into the picture to read a pixel; drag to move the line.</p>'
#: Errors of files, settings and disks; each message is one line.
FAILURES = (ValueError, OSError, MemoryError, RuntimeError)
#: Labels of the buttons that upload images.
IMAGES = {"texture": "Texture", "normals": "Normals", "mask": "Mask for all edits"}

Values = dict[Any, Any]


@dataclass(frozen=True)
class Start:
    """The first state of the page: values of its settings, and a ``file`` of the owner to open."""

    settings: dict[str, Any]
    file: Any = None

    def corrections(self) -> dict[str, Any]:
        """The settings that the command line gives and no page may: paths of files."""
        return {name: self.settings[name] for name in ("calibration", "ambient") if name in self.settings}


@dataclass(frozen=True)
class Components:
    """The page's components. ``settings`` by the names of `parse_settings`, ``images`` by kind."""

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
        """Components that a separation changes, in the order of `Events._show`."""
        index = self.settings["index"]
        changed = [self.status, self.stage, self.readout, *self.panels, self.strip, index, self.play, self.timer]
        return [*changed, *self.images.values(), self.suggest]

    def picture(self) -> list[Any]:
        """Components that determine the picture."""
        return [self.left, self.right, self.stops]

    def edited(self) -> list[Any]:
        """Components that an edit changes."""
        return [self.stage, self.status, self.left, self.right]

    def played(self) -> list[Any]:
        """Components that the next frame changes."""
        return [self.stage, self.settings["index"], self.status, self.play, self.timer]

    def control(self, edit: str, parameter: str) -> Any:
        """The control of one parameter of an edit."""
        places = [(control.edit.name, control.parameter.name) for control in list_controls()]
        return self.controls[places.index((edit, parameter))]


class Events:
    """Functions of the page's events; ``values``: of the components, by component."""

    def __init__(self, sessions: Sessions, components: Components, start: Start) -> None:
        self.sessions, self.components, self.start = sessions, components, start

    def open_upload(self, values: Values, request: gr.Request) -> list[Any]:
        """Open files that the user uploaded."""
        sent = [_claim(file) for file in values[self.components.file] or ()]
        return self._open(lambda: self.sessions.open_upload(_key(request), sent), values, request)

    def open_demo(self, values: Values, request: gr.Request) -> list[Any]:
        """Open the example frame of polsep, whose white level is known."""
        white = self.components.settings["white"]
        values = {**values, white: f"{DEMO_WHITE:g}", self.components.settings["black"]: "0"}
        return self._open(lambda: self._session(request).begin_own(DEMO), values, request)

    def open_own(self, file: Any, values: Values, request: gr.Request) -> list[Any]:
        """Open the file named on the command line."""
        return self._open(lambda: self._session(request).begin_own(file), values, request)

    def use_white(self, values: Values, request: gr.Request) -> list[Any]:
        """Separate with the white level that a remark recommends."""
        found = self._session(request).opened
        white = None if found is None else found.suggested_white()
        values = values if white is None else {**values, self.components.settings["white"]: f"{white:g}"}
        return [*self.separate(values, request), values[self.components.settings["white"]], None]

    def _open(self, prepare: Callable[[], None], values: Values, request: gr.Request) -> list[Any]:
        session, white = self._session(request), values[self.components.settings["white"]]
        session.playing = False
        try:
            prepare()
        except FAILURES as error:
            session.forget()
            return [*self._failed(error, session), white, None]
        return [*self.separate({**values, self.components.settings["index"]: 0}, request), white, None]

    def separate(self, values: Values, request: gr.Request) -> list[Any]:
        """Separate the session's file with the settings of the page."""
        session = self._session(request)
        try:
            said = {n: values[component] for n, component in self.components.settings.items()}
            found = session.separate(parse_settings(self.start.corrections() | said))
        except FAILURES as error:
            return self._failed(error, session)
        return self._show(session, found, values)

    def _show(self, session: Session, found: OpenedFrame, values: Values) -> list[Any]:
        white = found.suggested_white()
        return [
            status_line(found),
            self._stage(session, values),
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
        """Show the error in the status; pictures stay if there is still a frame."""
        session.playing = False
        nothing = [EMPTY, HINT, *[EMPTY] * 3, gr.update(visible=False)]
        kept = [gr.skip()] * len(nothing) if session.opened is not None else nothing
        stopped = [gr.skip(), *_play_state(session), *_image_names(session), gr.update(visible=False)]
        return [failure_line(error), *kept, *stopped]

    def draw(self, values: Values, request: gr.Request) -> Any:
        """Draw the same frame with other pictures or another exposure."""
        return self._stage(self._session(request), values)

    def point(self, values: Values, request: gr.Request, event: gr.EventData) -> list[Any]:
        """Show the numbers of the clicked pixel."""
        session = self._session(request)
        found = session.opened
        if found is None:
            return [gr.skip(), gr.skip()]
        height, width = found.small.size
        session.mark = _inside(event.y, height), _inside(event.x, width)
        return [self._stage(session, values), self._readout(session, found)]

    def edit(self, values: Values, request: gr.Request) -> list[Any]:
        """Show the frame with the edits of the controls as the right picture."""
        session = self._session(request)
        try:
            session.edit(self._recipe(session, values))
        except FAILURES as error:
            return [gr.skip(), failure_line(error), gr.skip(), gr.skip()]
        return self._edited(session, values)

    def undo(self, values: Values, request: gr.Request) -> list[Any]:
        """Remove all edits and their images."""
        session, starts = self._session(request), [control.start for control in list_controls()]
        session.edit(recipe_of(starts))
        session.drop_images()
        return [*self._edited(session, values), *_image_names(session), *starts]

    def add_image(self, kind: str) -> Callable[[Values, gr.Request], list[Any]]:
        """A function that uses an uploaded image of a kind for edits; a first texture is applied at once."""

        def answer(values: Values, request: gr.Request) -> list[Any]:
            session, component = self._session(request), self.components.images[kind]
            amount = self.components.control("texture", "amount")
            values = values | {amount: values[amount] or 1.0} if kind == "texture" else values
            try:
                self.sessions.add_image(_key(request), kind, *_claim(values[component]))
                session.edit(self._recipe(session, values))
            except FAILURES as error:
                skipped = [gr.skip()] * (len(self.components.edited()) - 2)
                return [gr.skip(), failure_line(error), *skipped, *_image_names(session), gr.skip()]
            return [*self._edited(session, values), *_image_names(session), values[amount]]

        return answer

    def _recipe(self, session: Session, values: Values) -> Any:
        names = {kind: sent.name for kind, sent in session.images.items()}
        return recipe_of([values[control] for control in self.components.controls], names)

    def toggle(self, request: gr.Request) -> list[Any]:
        """Play or pause."""
        session = self._session(request)
        session.playing = not session.playing and session.opened is not None and session.opened.count > 1
        return _play_state(session)

    def settle(self, values: Values, request: gr.Request) -> list[Any]:
        """After a pause, show numbers and panels of the current frame."""
        session = self._session(request)
        if session.playing or session.opened is None or session.place == session.opened.index:
            return [gr.skip()] * len(self.components.shown())
        return self.separate({**values, self.components.settings["index"]: session.place}, request)

    def advance(self, values: Values, request: gr.Request) -> list[Any]:
        """Show the next frame of a playing sequence, if it is ready."""
        session = self._session(request)
        waiting = [gr.skip()] * len(self.components.played())
        try:
            if not session.playing or not session.play():
                return waiting
        except FAILURES as error:
            session.playing = False
            return [gr.skip(), gr.skip(), failure_line(error), *_play_state(session)]
        return [self._stage(session, values), session.place, *waiting[2:]]

    def _edited(self, session: Session, values: Values) -> list[Any]:
        values = {**values, self.components.left: "Input", self.components.right: "Edited"}
        remarks = session.recipe.cautions()
        status = gr.skip() if session.opened is None else status_line(session.opened, remarks)
        return [self._stage(session, values), status, "Input", "Edited"]

    def write(self, kind: str) -> Callable[[gr.Request], list[Any]]:
        """A function that writes one of `DOWNLOADS` and returns its path."""

        def answer(request: gr.Request) -> list[Any]:
            session = self._session(request)
            try:
                return [str(session.write(kind)), gr.skip()]
            except FAILURES as error:
                raise gr.Error(one_line(error), print_exception=False) from error

        return answer

    def leave(self, request: gr.Request) -> None:
        """End the session of a closed page."""
        self.sessions.end(_key(request))

    def _session(self, request: gr.Request) -> Session:
        return self.sessions.find(_key(request))

    def _stage(self, session: Session, values: Values) -> Any:
        shown = session.shown
        if shown is None:
            return EMPTY
        left, right, stops = (values[component] for component in self.components.picture())
        return stage(shown, (str(left), str(right)), float(stops), session.mark)

    def _readout(self, session: Session, found: OpenedFrame) -> str:
        if session.mark is None:
            return HINT
        step, (height, width) = found.small.step, found.frame.valid.shape
        row, col = (min(n * step + step // 2, most - 1) for n, most in zip(session.mark, (height, width), strict=True))
        return readout_panel(read_pixel(found.frame, found.mosaic, (row, col)))


def _key(request: gr.Request) -> str:
    return str(request.session_hash)


def _claim(sent: object) -> tuple[object, str]:
    """Path and name of an uploaded file, as the client claims."""
    upload = sent if isinstance(sent, dict) else {}
    return upload.get("path"), str(upload.get("orig_name") or upload.get("path") or "")


def _play_state(session: Session) -> list[Any]:
    """Updates of the play button and the timer."""
    return [gr.update(value="Pause" if session.playing else "Play"), gr.update(active=session.playing)]


def _image_names(session: Session) -> list[Any]:
    """Labels of the upload buttons with the names of their images."""
    names = {kind: session.images[kind].name if kind in session.images else "none" for kind in KINDS}
    return [gr.update(label=f"{IMAGES[kind]}: {names[kind]}") for kind in KINDS]


def _inside(share: object, count: int) -> int:
    """The pixel at a share of a side, limited to the side for any value of a client."""
    value = float(share) if isinstance(share, (int, float)) else 0.0
    return min(max(int(min(max(value, 0.0), 1.0) * count), 0), count - 1)


def one_line(error: BaseException) -> str:
    """The message of an error in one line."""
    return errors.one_line(error) or type(error).__name__


def failure_line(error: BaseException) -> str:
    """The status after an error."""
    return f'<div class="ps-error" role="alert">{html.escape(one_line(error))}</div>'


def status_line(found: OpenedFrame, more: Sequence[str] = ()) -> str:
    """The status after a separation: size, method, statistics and remarks."""
    frame = found.frame
    height, width = frame.valid.shape
    texts = [f"{width} × {height} pixels", str(frame.report["method"])]
    if found.mosaic is not None:
        rows, cols = found.mosaic.data.shape[-2:]
        texts[0] = f"{cols} × {rows} raw, {texts[0]} separated"
    statistics = frame.report["statistics"]
    if "clipped_fraction" in statistics:
        texts.append(f"{statistics['clipped_fraction']:.2%} of the pixels clip")
        texts.append(f"light polarizer about {statistics['light_polarizer_deg']:.0f}°")
    texts.append(f"{found.seconds:.2f} s")
    name = html.escape(found.stem)
    line = "".join(f"<span>{html.escape(text)}</span>" for text in texts)
    remarks = "".join(f'<div class="ps-remark">{html.escape(remark)}</div>' for remark in (*found.remarks, *more))
    return f'<div class="ps-line"><b>{name}</b>{line}</div>{remarks}'
