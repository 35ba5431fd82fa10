"""The page: its parts, and which function of `answers` answers when one is used. Nothing is computed here.

Reading and separating wait in one queue and run one at a time, whoever asked; pictures of what is already separated do
not wait. A panel that a colleague's registry fills, such as `_edit_panel`, is generated from data.
"""

from __future__ import annotations

import html
from typing import Any

import gradio as gr

from polsep.io.assets.maps import SUFFIXES
from polsep.io.raw.genicam import PIXEL_FORMATS
from polsep.methods import METHODS
from polsep.view.answers import HINT, IMAGES, Answers, Parts, Start
from polsep.view.edits import list_controls
from polsep.view.images import KINDS
from polsep.view.opening import UNSAID
from polsep.view.pictures import VIEWS
from polsep.view.session import WANTED, Sessions
from polsep.view.style import EMPTY, FETCH, STAGE

#: Pages that may wait for a separation; one more is told so.
MAX_WAITING = 64
#: Gradio removes files that no page ended for, looking every so many seconds, when they are so old.
SWEEP_S = (600, 7200)
#: Seconds between frames that are played, at least.
TICK_S = 0.08
_SEPARATE: dict[str, Any] = {"concurrency_id": "separate", "concurrency_limit": 1, "show_progress_on": None}
_AT_ONCE: dict[str, Any] = {"queue": False, "show_progress": "hidden", "trigger_mode": "always_last"}


def build_page(sessions: Sessions, start: Start) -> Any:
    """The page as Gradio blocks, ready to be launched."""
    with gr.Blocks(title="polsep", analytics_enabled=False, delete_cache=SWEEP_S, fill_width=True) as page:
        parts = _lay_out(start)
        _connect(page, parts, Answers(sessions, parts, start))
    page.queue(max_size=MAX_WAITING, default_concurrency_limit=4, api_open=False)
    return page


def _lay_out(start: Start) -> Parts:
    with gr.Row(equal_height=False):
        with gr.Column(scale=0, min_width=330, elem_id="ps-side"):
            gr.HTML("<b>polsep</b><p>Diffuse and specular from one raw frame</p>", elem_id="ps-title")
            file = gr.File(label="Raw frames or polsep EXR", file_count="multiple", height=150, elem_id="ps-file")
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
                            strip, play, settings["index"] = _strip()
                            timer = gr.Timer(TICK_S, active=False)
                        with gr.Column(scale=1, min_width=300), gr.Tabs(elem_id="ps-beside"):
                            with gr.Tab("Pixel"):
                                readout = gr.HTML(HINT, elem_id="ps-pixel")
                            with gr.Tab("Edit"):
                                controls, images, neutral = _edit_panel()
                with gr.Tab("Polarization"):
                    polarization = gr.HTML(EMPTY)
                with gr.Tab("Exposure"):
                    counted = gr.HTML(EMPTY)
                with gr.Tab("Confidence"):
                    confidence = gr.HTML(EMPTY)
    panels = (polarization, counted, confidence)
    return Parts(
        settings, file, demo, suggest, status, left, right, stops, picture, strip, play, timer, readout, panels,
        controls, images, neutral, fetch, link,
    )  # fmt: skip


def _strip() -> tuple[Any, Any, Any]:
    """What sequences have below the picture: play, and which frame."""
    with gr.Row(visible=False, equal_height=True, elem_id="ps-strip") as strip:
        play = gr.Button("Play", scale=0, min_width=90, elem_id="ps-play")
        index = gr.Slider(0, 1, 0, step=1, label="Frame", scale=4, elem_id="ps-index")
    return strip, play, index


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


def _edit_panel() -> tuple[tuple[Any, ...], dict[str, Any], Any]:
    """A control for every value of every edit, a button for every kind of image, and one that sets all back."""
    made, images = [], {}
    controls = list_controls()
    neutral = gr.Button("Undo all edits", size="sm", elem_id="ps-neutral")
    images["mask"] = _image_button("mask")
    with gr.Column(elem_id="ps-edits"):
        for kind in dict.fromkeys(control.edit for control in controls):
            with gr.Group():
                gr.HTML(f'<b class="ps-edit">{html.escape(kind.title)}</b>')
                for needed in (p.kind for p in kind.parameters() if p.kind in KINDS and p.kind != "mask"):
                    images[needed] = _image_button(needed)
                made += [_control(control) for control in controls if control.edit is kind]
    return tuple(made), {kind: images[kind] for kind in KINDS}, neutral


def _image_button(kind: str) -> Any:
    return gr.UploadButton(f"{IMAGES[kind]}: none", file_types=list(SUFFIXES), size="sm", elem_id=f"ps-image-{kind}")


def _control(control: Any) -> Any:
    about, name = control.parameter, f"ps-{control.edit.name}-{control.parameter.name}"
    if about.kind == "color":
        return gr.ColorPicker(control.start, label=control.label, elem_id=name)
    step = (about.high - about.low) / 100
    return gr.Slider(about.low, about.high, control.start, step=step, label=control.label, elem_id=name)


def _fetch_panel() -> tuple[dict[str, Any], Any]:
    """A button for everything that can be fetched; the link they use is out of sight."""
    titles = {"exr": "EXR", "png": "Overview PNG", "edited": "Edited EXR", "recipe": "Edits as recipe"}
    buttons = {}
    gr.HTML('<p class="ps-hint">Download</p>')
    for pair in (WANTED[:2], WANTED[2:]):
        with gr.Row():
            for kind in pair:
                buttons[kind] = gr.Button(titles[kind], size="sm", min_width=120, elem_id=f"ps-get-{kind}")
    return buttons, gr.DownloadButton("fetch", elem_id="ps-fetch")


def _connect(page: Any, parts: Parts, answers: Answers) -> None:
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
    controls = {*parts.controls, *picture}
    for control in parts.controls:
        control.input(answers.edit, controls, parts.edited(), **_AT_ONCE)
    images = list(parts.images.values())
    amount = parts.control("texture", "amount")
    for kind, button in parts.images.items():
        changed = [*parts.edited(), *images, amount]
        button.upload(answers.add_image(kind), {button, *controls}, changed, preprocess=False, **_SEPARATE)
    parts.neutral.click(answers.undo, picture, [*parts.edited(), *images, *parts.controls], **_AT_ONCE)
    played = parts.play.click(answers.toggle, None, [parts.play, parts.timer], **_AT_ONCE)
    played.then(answers.settle, everything, parts.shown(), **{**_SEPARATE, "show_progress": "hidden"})
    parts.timer.tick(answers.advance, picture, parts.played(), **{**_AT_ONCE, "trigger_mode": "once"})
    for kind, button in parts.fetch.items():
        written = button.click(answers.write(kind), None, [parts.link, parts.status], **_SEPARATE)
        written.success(None, None, None, js=FETCH)
    page.unload(answers.leave)
