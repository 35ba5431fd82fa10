"""The page: its parts, and which function of `session` answers when one is used. Nothing is computed here.

Reading and separating wait in one queue and run one at a time, whoever asked; pictures of what is already separated do
not wait. A panel that a colleague's registry fills, such as `_edit_panel`, is generated from data.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gradio as gr

from polsep.io.genicam import PIXEL_FORMATS
from polsep.methods import METHODS
from polsep.view.edits import list_controls, recipe_of
from polsep.view.pictures import VIEWS, confidence_panel, histogram_panel, polarization_panel, stage
from polsep.view.readout import read_pixel, readout_panel
from polsep.view.session import DEMO, DEMO_WHITE, UNSAID, WANTED, Found, Session, Sessions, parse_settings
from polsep.view.style import EMPTY, FETCH, STAGE

#: Pages that may wait for a separation; one more is told so.
MOST_WAITING = 64
#: Gradio removes files that no page ended for, looking every so many seconds, when they are so old.
SWEEP_S = (600, 7200)
HINT = '<p class="ps-hint">Click into the picture to read a pixel; drag to move the line.</p>'
#: What goes wrong with a file, a setting or a disk; all say it in one line.
FAILURES = (ValueError, OSError, MemoryError, RuntimeError)
_SEPARATE: dict[str, Any] = {"concurrency_id": "separate", "concurrency_limit": 1, "show_progress_on": None}
_AT_ONCE: dict[str, Any] = {"queue": False, "show_progress": "hidden", "trigger_mode": "always_last"}

Said = dict[Any, Any]


@dataclass(frozen=True)
class Start:
    """What the page shows first: the values of its settings, and whether a ``file`` of the owner's is opened."""

    settings: dict[str, str]
    file: Any = None


@dataclass(frozen=True)
class Parts:
    """The page's components. ``settings`` by the names that `parse_settings` knows."""

    settings: dict[str, Any]
    file: Any
    demo: Any
    suggest: Any
    status: Any
    left: Any
    right: Any
    stops: Any
    stage: Any
    readout: Any
    panels: tuple[Any, Any, Any]
    controls: tuple[Any, ...]
    neutral: Any
    fetch: dict[str, Any]
    link: Any

    def shown(self) -> list[Any]:
        """What a separation changes, in the order of `_Answers.show`."""
        return [self.status, self.stage, self.readout, *self.panels, self.settings["index"], self.suggest]

    def picture(self) -> list[Any]:
        """What says how the picture is drawn."""
        return [self.left, self.right, self.stops]


def build_page(sessions: Sessions, start: Start) -> Any:
    """The page as Gradio blocks, ready to be launched."""
    with gr.Blocks(title="polsep", analytics_enabled=False, delete_cache=SWEEP_S, fill_width=True) as page:
        parts = _lay_out(start)
        _connect(page, parts, _Answers(sessions, parts, start))
    page.queue(max_size=MOST_WAITING, default_concurrency_limit=4, api_open=False)
    return page


def _lay_out(start: Start) -> Parts:
    with gr.Row(equal_height=False):
        with gr.Column(scale=0, min_width=330, elem_id="ps-side"):
            gr.HTML("<b>polsep</b><p>Diffuse and specular from one raw frame</p>", elem_id="ps-title")
            file = gr.File(label="Raw frame or polsep EXR", height=150, elem_id="ps-file")
            demo = gr.Button("Open the demo capture", variant="primary", elem_id="ps-demo")
            settings = _settings(start)
            suggest = gr.Button(visible=False, size="sm", elem_id="ps-suggest")
            fetch, link = _fetch_panel()
        with gr.Column(scale=1, min_width=480, elem_id="ps-main"):
            status = gr.HTML("", elem_id="ps-status")
            with gr.Tabs():
                with gr.Tab("Compare"):
                    left, right, stops = _picture_row()
                    with gr.Row():
                        with gr.Column(scale=3, min_width=420):
                            picture = gr.HTML(EMPTY, js_on_load=STAGE, elem_id="ps-picture")
                            settings["index"] = gr.Slider(
                                0, 1, 0, step=1, label="Frame", visible=False, elem_id="ps-index"
                            )
                        with gr.Column(scale=1, min_width=300), gr.Tabs(elem_id="ps-beside"):
                            with gr.Tab("Pixel"):
                                readout = gr.HTML(HINT, elem_id="ps-pixel")
                            with gr.Tab("Edit"):
                                controls, neutral = _edit_panel()
                with gr.Tab("Polarization"):
                    polarization = gr.HTML(EMPTY)
                with gr.Tab("Exposure"):
                    counted = gr.HTML(EMPTY)
                with gr.Tab("Confidence"):
                    confidence = gr.HTML(EMPTY)
    panels = (polarization, counted, confidence)
    return Parts(
        settings, file, demo, suggest, status, left, right, stops, picture, readout, panels, controls, neutral,
        fetch, link,
    )  # fmt: skip


def _settings(start: Start) -> dict[str, Any]:
    """How files are read and separated."""
    said = start.settings

    def choice(name: str, label: str, choices: list[str], **more: Any) -> Any:
        value = said.get(name) or choices[0]
        known = choices if value in choices else [*choices, value]
        return gr.Dropdown(known, value=value, label=label, elem_id=f"ps-{name}", **more)

    free: dict[str, Any] = {"allow_custom_value": True}
    found = {"method": choice("method", "Method", ["auto", *METHODS])}
    found["layout"] = choice("layout", "Filter layout", [UNSAID, "color", "mono", "90,45,135,0/RGGB"], **free)
    with gr.Row():
        found["white"] = choice("white", "White level", [UNSAID, "255", "1023", "4095", "16383", "65535"], **free)
        found["black"] = choice("black", "Black level", ["0", "16", "64", "256"], **free)
    found["light"] = choice("light", "Light colour R,G,B", ["white", "estimate", "1,0.9,0.7"], **free)
    with gr.Accordion("Headless raw (.raw, .bin)", open=bool(said.get("size") or said.get("pixel_format"))), gr.Row():
        found["size"] = gr.Textbox(said.get("size", ""), label="Size", placeholder="2448x2048", elem_id="ps-size")
        found["pixel_format"] = choice("pixel_format", "Pixel format", [UNSAID, *PIXEL_FORMATS], **free)
    return found


def _picture_row() -> tuple[Any, Any, Any]:
    """Which pictures are compared, and how bright."""
    with gr.Row(equal_height=True):
        left = gr.Dropdown(list(VIEWS), value="Input", label="Left", min_width=110, elem_id="ps-left")
        right = gr.Dropdown(list(VIEWS), value="Diffuse", label="Right", min_width=110, elem_id="ps-right")
        stops = gr.Slider(-6, 6, 0, step=0.1, label="Exposure [stops]", scale=3, elem_id="ps-stops")
    return left, right, stops


def _edit_panel() -> tuple[tuple[Any, ...], Any]:
    """A control for every value of every edit of the registry, and a button that sets all back."""
    made = []
    controls = list_controls()
    neutral = gr.Button("Undo all edits", size="sm", elem_id="ps-neutral")
    with gr.Column(elem_id="ps-edits"):
        for kind in dict.fromkeys(control.edit for control in controls):
            with gr.Group():
                gr.HTML(f'<b class="ps-edit">{html.escape(kind.title)}</b>')
                made += [_control(control) for control in controls if control.edit is kind]
    return tuple(made), neutral


def _control(control: Any) -> Any:
    about, name = control.parameter, f"ps-{control.edit.name}-{control.parameter.name}"
    if about.kind == "color":
        return gr.ColorPicker(control.start, label=control.label, elem_id=name)
    step = (about.high - about.low) / 100
    return gr.Slider(about.low, about.high, control.start, step=step, label=control.label, elem_id=name)


def _fetch_panel() -> tuple[dict[str, Any], Any]:
    """A button for everything that can be fetched; the link they use is out of sight."""
    titles = {"exr": "EXR", "png": "Overview PNG", "edited": "Edited EXR", "recipe": "Edits as JSON"}
    buttons = {}
    gr.HTML('<p class="ps-hint">Download</p>')
    for pair in (WANTED[:2], WANTED[2:]):
        with gr.Row():
            for kind in pair:
                buttons[kind] = gr.Button(titles[kind], size="sm", min_width=120, elem_id=f"ps-get-{kind}")
    return buttons, gr.DownloadButton("fetch", elem_id="ps-fetch")


def _connect(page: Any, parts: Parts, answers: _Answers) -> None:
    """Which answer follows which event."""
    settings, picture = set(parts.settings.values()), set(parts.picture())
    everything = settings | picture
    opened = [*parts.shown(), parts.settings["white"], parts.file]  # the place for files is empty again for the next
    parts.file.upload(answers.open_upload, {parts.file, *everything}, opened, preprocess=False, **_SEPARATE)
    parts.demo.click(answers.open_demo, everything, opened, **_SEPARATE)
    parts.suggest.click(answers.use_white, everything, opened, **_SEPARATE)
    if start_file := answers.start.file:
        page.load(lambda said, request: answers.open_own(start_file, said, request), everything, opened, **_SEPARATE)
    for name, part in parts.settings.items():
        listen = part.release if name == "index" else part.submit if name == "size" else part.input
        listen(answers.separate, everything, parts.shown(), **_SEPARATE)
    for part in (parts.left, parts.right, parts.stops):
        part.input(answers.draw, picture, parts.stage, **_AT_ONCE)
    parts.stage.click(answers.point, picture, [parts.stage, parts.readout], **_AT_ONCE)
    edited = [parts.stage, parts.status, parts.left, parts.right]
    for control in parts.controls:
        control.input(answers.edit, {*parts.controls, *picture}, edited, **_AT_ONCE)
    parts.neutral.click(answers.undo, picture, [*edited, *parts.controls], **_AT_ONCE)
    for kind, button in parts.fetch.items():
        written = button.click(answers.write(kind), None, [parts.link, parts.status], **_SEPARATE)
        written.success(None, None, None, js=FETCH)
    page.unload(answers.leave)


class _Answers:
    """What the page's events do to the session that they come from."""

    def __init__(self, sessions: Sessions, parts: Parts, start: Start) -> None:
        self.sessions, self.parts, self.start = sessions, parts, start

    def open_upload(self, said: Said, request: gr.Request) -> list[Any]:
        """A file that the user has just sent."""
        sent = said[self.parts.file] or {}
        name = str(sent.get("orig_name") or sent.get("path") or "")
        return self._open(lambda: self.sessions.open_upload(_key(request), sent.get("path"), name), said, request)

    def open_demo(self, said: Said, request: gr.Request) -> list[Any]:
        """The capture that comes with polsep, whose white level is known."""
        white = self.parts.settings["white"]
        said = {**said, white: f"{DEMO_WHITE:g}", self.parts.settings["black"]: "0"}
        return self._open(lambda: self._session(request).begin(DEMO, DEMO.stem), said, request)

    def open_own(self, file: Any, said: Said, request: gr.Request) -> list[Any]:
        """The file that the command named."""
        return self._open(lambda: self._session(request).begin(file, file.stem), said, request)

    def use_white(self, said: Said, request: gr.Request) -> list[Any]:
        """The white level that a remark recommends."""
        found = self._session(request).found
        white = None if found is None else found.suggested_white()
        said = said if white is None else {**said, self.parts.settings["white"]: f"{white:g}"}
        return [*self.separate(said, request), said[self.parts.settings["white"]], None]

    def _open(self, prepare: Callable[[], None], said: Said, request: gr.Request) -> list[Any]:
        session, white = self._session(request), said[self.parts.settings["white"]]
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
            gr.update(visible=found.count > 1, maximum=max(found.count - 1, 1), value=found.index),
            gr.update(visible=white is not None, value=f"Use white level {white or 0:g}"),
        ]

    def _failed(self, error: BaseException, session: Session) -> list[Any]:
        """The error in the status; pictures stay where there still is a frame."""
        kept = [gr.skip()] * 6 if session.found is not None else [EMPTY, HINT, *[EMPTY] * 3, gr.update(visible=False)]
        return [failure_line(error), *kept, gr.update(visible=False)]

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
            session.edit(recipe_of([said[control] for control in self.parts.controls]))
        except FAILURES as error:
            return [gr.skip(), failure_line(error), gr.skip(), gr.skip()]
        return self._edited(session, said)

    def undo(self, said: Said, request: gr.Request) -> list[Any]:
        """The frame without edits."""
        session, starts = self._session(request), [control.start for control in list_controls()]
        session.edit(recipe_of(starts))
        return [*self._edited(session, said), *starts]

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
        found = session.found
        if found is None:
            return EMPTY
        left, right, stops = (said[part] for part in self.parts.picture())
        return stage(found.small, (str(left), str(right)), float(stops), session.mark)

    def _readout(self, session: Session, found: Found) -> str:
        if session.mark is None:
            return HINT
        step, (height, width) = found.small.step, found.frame.valid.shape
        row, col = (min(n * step + step // 2, most - 1) for n, most in zip(session.mark, (height, width), strict=True))
        return readout_panel(read_pixel(found.frame, found.mosaic, (row, col)))


def _key(request: gr.Request) -> str:
    return str(request.session_hash)


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
