"""The page: its components, and the function of `events` for each of their events. Nothing is computed here.

Reading and separating share one queue for all pages and run one at a time; pictures of separated frames are not queued.
`_edit_panel` is generated from the registry of edits.
"""

from __future__ import annotations

import html
from typing import Any

import gradio as gr

from polsep.io.assets.maps import SUFFIXES
from polsep.io.raw.genicam import PIXEL_FORMATS
from polsep.methods import METHODS
from polsep.view.edits import list_controls
from polsep.view.events import HINT, IMAGES, Components, Events, Start
from polsep.view.images import KINDS
from polsep.view.opening import UNSAID
from polsep.view.pictures import VIEWS
from polsep.view.session import DOWNLOADS, Sessions
from polsep.view.style import EMPTY, FETCH, STAGE

#: Largest number of pages in the queue; one more gets an error.
MAX_WAITING = 64
#: Seconds between Gradio's removals of old files, and the age of files that it removes.
SWEEP_S = (600, 7200)
#: Least number of seconds between played frames.
TICK_S = 0.08
_SEPARATE: dict[str, Any] = {"concurrency_id": "separate", "concurrency_limit": 1, "show_progress_on": None}
_AT_ONCE: dict[str, Any] = {"queue": False, "show_progress": "hidden", "trigger_mode": "always_last"}


def build_page(sessions: Sessions, start: Start) -> Any:
    """The page as Gradio blocks, ready to be launched."""
    with gr.Blocks(title="polsep", analytics_enabled=False, delete_cache=SWEEP_S, fill_width=True) as page:
        components = _lay_out(start)
        _connect(page, components, Events(sessions, components, start))
    page.queue(max_size=MAX_WAITING, default_concurrency_limit=4, api_open=False)
    return page


def _lay_out(start: Start) -> Components:
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
    return Components(
        settings, file, demo, suggest, status, left, right, stops, picture, strip, play, timer, readout, panels,
        controls, images, neutral, fetch, link,
    )  # fmt: skip


def _strip() -> tuple[Any, Any, Any]:
    """Controls of sequences below the picture: play, and the frame number."""
    with gr.Row(visible=False, equal_height=True, elem_id="ps-strip") as strip:
        play = gr.Button("Play", scale=0, min_width=90, elem_id="ps-play")
        index = gr.Slider(0, 1, 0, step=1, label="Frame", scale=4, elem_id="ps-index")
    return strip, play, index


def _settings(start: Start) -> dict[str, Any]:
    """Settings of reading and separating."""
    values = start.settings

    def choice(name: str, label: str, choices: list[str], **more: Any) -> Any:
        value = values.get(name) or choices[0]
        known = choices if value in choices else [*choices, value]
        return gr.Dropdown(known, value=value, label=label, elem_id=f"ps-{name}", **more)

    free: dict[str, Any] = {"allow_custom_value": True}
    found = {"method": choice("method", "Method", ["auto", *METHODS])}
    found["layout"] = choice("layout", "Filter layout", [UNSAID, "color", "mono", "90,45,135,0/RGGB"], **free)
    with gr.Row():
        found["white"] = choice("white", "White level", [UNSAID, "255", "1023", "4095", "16383", "65535"], **free)
        found["black"] = choice("black", "Black level", ["0", "16", "64", "256"], **free)
    found["light"] = choice("light", "Light colour R,G,B", ["auto", "white", "1,0.9,0.7"], **free)
    with (
        gr.Accordion("Headerless raw (.raw, .bin)", open=bool(values.get("size") or values.get("pixel_format"))),
        gr.Row(),
    ):
        found["size"] = gr.Textbox(values.get("size", ""), label="Size", placeholder="2448x2048", elem_id="ps-size")
        found["pixel_format"] = choice("pixel_format", "Pixel format", [UNSAID, *PIXEL_FORMATS], **free)
    return found


def _picture_row() -> tuple[Any, Any, Any]:
    """Choice of the compared pictures, and their exposure."""
    with gr.Row(equal_height=True):
        left = gr.Dropdown(list(VIEWS), value="Input", label="Left", min_width=110, elem_id="ps-left")
        right = gr.Dropdown(list(VIEWS), value="Diffuse", label="Right", min_width=110, elem_id="ps-right")
        stops = gr.Slider(-6, 6, 0, step=0.1, label="Exposure [stops]", scale=3, elem_id="ps-stops")
    return left, right, stops


def _edit_panel() -> tuple[tuple[Any, ...], dict[str, Any], Any]:
    """A control for every parameter of every edit, a button for every kind of image, and one to undo all."""
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
    """A button for every download; the link that they use is hidden."""
    titles = {"exr": "EXR", "png": "Overview PNG", "edited": "Edited EXR", "recipe": "Edits as recipe"}
    buttons = {}
    gr.HTML('<p class="ps-hint">Download</p>')
    for pair in (DOWNLOADS[:2], DOWNLOADS[2:]):
        with gr.Row():
            for kind in pair:
                buttons[kind] = gr.Button(titles[kind], size="sm", min_width=120, elem_id=f"ps-get-{kind}")
    return buttons, gr.DownloadButton("fetch", elem_id="ps-fetch")


def _connect(page: Any, components: Components, events: Events) -> None:
    """Connect events to their functions."""
    settings, picture = set(components.settings.values()), set(components.picture())
    everything = settings | picture
    opened = [
        *components.shown(),
        components.settings["white"],
        components.file,
    ]  # the file field is emptied for the next upload
    components.file.upload(events.open_upload, {components.file, *everything}, opened, preprocess=False, **_SEPARATE)
    components.demo.click(events.open_demo, everything, opened, **_SEPARATE)
    components.suggest.click(events.use_white, everything, opened, **_SEPARATE)
    if start_file := events.start.file:
        page.load(lambda values, request: events.open_own(start_file, values, request), everything, opened, **_SEPARATE)
    for name, component in components.settings.items():
        listen = component.release if name == "index" else component.submit if name == "size" else component.input
        listen(events.separate, everything, components.shown(), **_SEPARATE)
    for component in (components.left, components.right, components.stops):
        component.input(events.draw, picture, components.stage, **_AT_ONCE)
    components.stage.click(events.point, picture, [components.stage, components.readout], **_AT_ONCE)
    controls = {*components.controls, *picture}
    for control in components.controls:
        control.input(events.edit, controls, components.edited(), **_AT_ONCE)
    images = list(components.images.values())
    amount = components.control("texture", "amount")
    for kind, button in components.images.items():
        changed = [*components.edited(), *images, amount]
        button.upload(events.add_image(kind), {button, *controls}, changed, preprocess=False, **_SEPARATE)
    components.neutral.click(events.undo, picture, [*components.edited(), *images, *components.controls], **_AT_ONCE)
    played = components.play.click(events.toggle, None, [components.play, components.timer], **_AT_ONCE)
    played.then(events.settle, everything, components.shown(), **{**_SEPARATE, "show_progress": "hidden"})
    components.timer.tick(events.advance, picture, components.played(), **{**_AT_ONCE, "trigger_mode": "once"})
    for kind, button in components.fetch.items():
        written = button.click(events.write(kind), None, [components.link, components.status], **_SEPARATE)
        written.success(None, None, None, js=FETCH)
    page.unload(events.leave)
