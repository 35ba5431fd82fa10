"""The page: its components, and the function of `events` for each of their events. Nothing is computed here.

Reading and separating share one line for all pages (`waiting`); pictures of separated frames do not wait.
`_edit_panel` is generated from the registry of edits.
"""

from __future__ import annotations

from typing import Any

import gradio as gr

from polsep.io.assets.maps import SUFFIXES
from polsep.io.raw.genicam import PIXEL_FORMATS
from polsep.methods import METHODS
from polsep.view.components import HINT, IMAGES, MENDS, NO_SHAPE, NOTHING, OF_FILES, SAME, Components, Start
from polsep.view.edits import list_controls
from polsep.view.events import Events
from polsep.view.images import KINDS
from polsep.view.opening import FULL, HALF, UNSAID
from polsep.view.pictures import VIEWS
from polsep.view.session import DOWNLOADS
from polsep.view.sessions import Sessions
from polsep.view.style import EMPTY, FETCH, STAGE

#: Largest number of events of all pages that wait; one more gets an error.
MAX_WAITING = 128
#: Seconds between Gradio's removals of old files, and the age of files that it removes.
SWEEP_S = (600, 7200)
#: Least number of seconds between played frames.
TICK_S = 0.08
_QUEUED: dict[str, Any] = {"show_progress": "hidden", "concurrency_id": "line", "concurrency_limit": MAX_WAITING}
_SEPARATE: dict[str, Any] = {**_QUEUED, "trigger_mode": "multiple"}
_WRITE: dict[str, Any] = {"show_progress": "minimal", "concurrency_id": "write", "concurrency_limit": 2}
_AT_ONCE: dict[str, Any] = {"queue": False, "show_progress": "hidden", "trigger_mode": "always_last"}


def build_page(sessions: Sessions, start: Start) -> Any:
    """The page as Gradio blocks, ready to be launched."""
    with gr.Blocks(title="polsep", analytics_enabled=False, delete_cache=SWEEP_S, fill_width=True) as page:
        components = _lay_out(start)
        _connect(page, components, Events(sessions, components, start))
    page.queue(max_size=MAX_WAITING, default_concurrency_limit=4, api_open=False)
    return page


def _lay_out(start: Start) -> Components:
    """The components in the order of the keyboard: files, the picture, how it is drawn, panels beside it."""
    with gr.Row(equal_height=True, elem_id="ps-top"):
        gr.HTML("<b>polsep</b>", elem_id="ps-title")
        file = gr.UploadButton(
            "Open files",
            file_count="multiple",
            variant="secondary",
            size="sm",
            scale=0,
            min_width=110,
            elem_id="ps-file",
        )
        demo = gr.Button("Demo capture", variant="primary", size="sm", scale=0, min_width=130, elem_id="ps-demo")
        progress = gr.HTML("", elem_id="ps-progress")
        cancel = gr.Button("Cancel", size="sm", scale=0, min_width=80, visible=False, elem_id="ps-cancel")
    status = gr.HTML("", elem_id="ps-status")
    with gr.Row(elem_id="ps-mends"):
        mends = tuple(gr.Button(visible=False, size="sm", scale=0, elem_id=f"ps-mend-{k}") for k in range(MENDS))
    with gr.Row(equal_height=False, elem_id="ps-body"):
        with gr.Column(scale=1, min_width=320, elem_id="ps-main"):
            picture = gr.HTML(EMPTY, js_on_load=STAGE, elem_id="ps-picture")
            strip, play, index = _strip()
            view = _view_row()
            timer = gr.Timer(TICK_S, active=False)
        with gr.Column(scale=0, min_width=340, elem_id="ps-side"):
            with gr.Tabs(elem_id="ps-beside", selected="settings") as beside:
                with gr.Tab("Settings", id="settings"):
                    settings, keep = _settings(start)
                with gr.Tab("Pixel", id="pixel"):
                    readout = gr.HTML(HINT, elem_id="ps-pixel")
                with gr.Tab("Exposure", id="exposure"):
                    marks = "Mark clipped pixels red, black ones blue"
                    view["marks"] = gr.Checkbox(False, label=marks, container=False, elem_id="ps-marks")
                    exposure = gr.HTML(NOTHING)
                with gr.Tab("Light", id="light"):
                    light = gr.HTML(NOTHING)
                with gr.Tab("Shape", id="shape"):
                    find_shape = gr.Button("Find the shape", size="sm", elem_id="ps-find-shape")
                    shape = gr.HTML(NO_SHAPE, elem_id="ps-shape")
                with gr.Tab("Edit", id="edit"):
                    controls, images, neutral = _edit_panel()
            fetch, link = _fetch_panel()
    settings["index"] = index
    return Components(
        settings, keep, file, demo, progress, cancel, status, mends, view, picture, strip, play, timer, beside,
        readout, exposure, light, find_shape, shape, controls, images, neutral, fetch, link,
    )  # fmt: skip


def _strip() -> tuple[Any, Any, Any]:
    """Controls of sequences below the picture: play, and the frame number."""
    with gr.Row(visible=False, equal_height=True, elem_id="ps-strip") as strip:
        play = gr.Button("Play", scale=0, min_width=90, elem_id="ps-play")
        index = gr.Slider(0, 1, 0, step=1, label="Frame", scale=4, elem_id="ps-index")
    return strip, play, index


def _view_row() -> dict[str, Any]:
    """Choice of what the two pictures show, and their exposure."""
    makers = [SAME, *(f"{name}, {size}" for name in METHODS for size in (HALF, FULL))]
    lists: dict[str, Any] = {"min_width": 130, "filterable": False}
    sliders: dict[str, Any] = {"minimum": -6, "maximum": 6, "value": 0, "step": 0.1, "min_width": 180, "scale": 2}
    with gr.Row(equal_height=True, elem_id="ps-view"):
        left = gr.Dropdown(list(VIEWS), value="Input", label="Left", elem_id="ps-left", **lists)
        right = gr.Dropdown(list(VIEWS), value="Diffuse", label="Right", elem_id="ps-right", **lists)
        against = gr.Dropdown(makers, value=SAME, label="Right by", elem_id="ps-against", **lists | {"min_width": 190})
        stops = gr.Slider(label="Exposure [stops]", elem_id="ps-stops", **sliders)
        specular = gr.Slider(label="Specular [stops]", elem_id="ps-specular-stops", **sliders)
    return {
        "left": left, "right": right, "against": against, "stops": stops, "specular_stops": specular,
    }  # fmt: skip


def _settings(start: Start) -> tuple[dict[str, Any], Any]:
    """Settings of reading and separating, and whether those of a file are kept for the next one."""
    values = {**start.settings, **start.of_files()}

    def choice(name: str, label: str, choices: list[str], **more: Any) -> Any:
        value = values.get(name) or choices[0]
        known = choices if value in choices else [*choices, value]
        return gr.Dropdown(known, value=value, label=label, elem_id=f"ps-{name}", min_width=120, **more)

    free: dict[str, Any] = {"allow_custom_value": True}
    with gr.Row():
        found = {"method": choice("method", "Method", ["auto", *METHODS], filterable=False)}
        found["resolution"] = choice("resolution", "Resolution", [HALF, FULL], filterable=False)
    with gr.Row():
        found["layout"] = choice("layout", "Filter layout", [UNSAID, "color", "mono", "90,45,135,0/RGGB"], **free)
        found["light"] = choice("light", "Light colour R,G,B", ["auto", "white", "1,0.9,0.7"], **free)
    with gr.Row():
        found["white"] = choice("white", "White level", [UNSAID, "255", "1023", "4095", "16383", "65535"], **free)
        found["black"] = choice("black", "Black level", ["0", "16", "64", "256"], **free)
    opened = any(values[name] != OF_FILES[name] for name in ("size", "pixel_format"))
    with gr.Accordion("Headerless raw (.raw, .bin)", open=opened), gr.Row():
        found["size"] = gr.Textbox(
            values["size"], label="Size", placeholder="2448x2048", min_width=120, elem_id="ps-size"
        )
        found["pixel_format"] = choice("pixel_format", "Pixel format", [UNSAID, *PIXEL_FORMATS], **free)
    keep = gr.Checkbox(False, label="Keep levels, layout and light for the next file", elem_id="ps-keep")
    return found, keep


def _edit_panel() -> tuple[tuple[Any, ...], dict[str, Any], Any]:
    """A control for every parameter of every edit, a button for every kind of image, and one to undo all."""
    made, images = [], {}
    controls = list_controls()
    with gr.Row():
        neutral = gr.Button("Undo all edits", size="sm", min_width=120, elem_id="ps-neutral")
        images["mask"] = _image_button("mask")
    with gr.Column(elem_id="ps-edits"):
        for kind in dict.fromkeys(control.edit for control in controls):
            with gr.Accordion(kind.title, open=False):
                for needed in (p.kind for p in kind.parameters() if p.kind in KINDS and p.kind != "mask"):
                    images[needed] = _image_button(needed)
                made += [_control(control) for control in controls if control.edit is kind]
    return tuple(made), {kind: images[kind] for kind in KINDS}, neutral


def _image_button(kind: str) -> Any:
    label, types = f"{IMAGES[kind]}: none", list(SUFFIXES)
    return gr.UploadButton(label, file_types=types, size="sm", min_width=120, elem_id=f"ps-image-{kind}")


def _control(control: Any) -> Any:
    about, name = control.parameter, f"ps-{control.edit.name}-{control.parameter.name}"
    if about.kind == "color":
        return gr.ColorPicker(control.start, label=control.label, elem_id=name)
    return gr.Slider(about.low, about.high, control.start, step=control.step, label=control.label, elem_id=name)


def _fetch_panel() -> tuple[dict[str, Any], Any]:
    """A button for every download; the link that they use is hidden."""
    titles = {"exr": "EXR", "png": "Overview PNG", "edited": "Edited EXR", "recipe": "Edits as recipe"}
    buttons = {}
    with gr.Row(elem_id="ps-downloads"):
        for kind in DOWNLOADS:
            buttons[kind] = gr.Button(titles[kind], size="sm", min_width=130, elem_id=f"ps-get-{kind}")
    return buttons, gr.DownloadButton("fetch", elem_id="ps-fetch")


def _connect(page: Any, components: Components, events: Events) -> None:
    """Connect events to their functions."""
    settings, picture = set(components.settings.values()), set(components.picture())
    everything, changed = settings | picture | {components.keep}, components.all()
    components.file.upload(events.open_upload, {components.file, *everything}, changed, preprocess=False, **_SEPARATE)
    components.demo.click(events.open_demo, everything, changed, **_SEPARATE)
    for place, button in enumerate(components.mends):
        button.click(events.mend(place), everything, changed, **_SEPARATE)
    if start_file := events.start.file:
        page.load(_opening(events, start_file), everything, changed, **_SEPARATE)
    for name, component in {**components.settings, "against": components.view["against"]}.items():
        listen = component.release if name == "index" else component.submit if name == "size" else component.input
        listen(events.separate, everything, changed, **_SEPARATE)
    components.cancel.click(events.cancel, None, [components.progress, components.cancel], **_AT_ONCE)
    for name, component in components.view.items():
        if name != "against":
            component.input(events.draw, picture, components.stage, **_AT_ONCE)
    components.stage.input(events.sharpen, None, components.stage, **_AT_ONCE)
    components.stage.click(events.point, None, [components.stage, components.beside, components.readout], **_AT_ONCE)
    components.stage.select(events.hover, None, components.readout, **_AT_ONCE)
    controls = {*components.controls, *picture}
    for control in components.controls:
        control.input(events.edit, controls, changed, **_AT_ONCE)
    for kind, button in components.images.items():
        button.upload(events.add_image(kind), {button, *controls}, changed, preprocess=False, **_WRITE)
    components.find_shape.click(events.find_shape, None, [components.shape, components.status], **_WRITE)
    components.neutral.click(events.undo, picture, changed, **_AT_ONCE)
    played = components.play.click(events.toggle, None, [components.play, components.timer], **_AT_ONCE)
    played.then(events.settle, everything, changed, **_SEPARATE)
    components.timer.tick(events.advance, None, changed, **{**_AT_ONCE, "trigger_mode": "once"})
    for kind, button in components.fetch.items():
        written = button.click(events.write(kind), None, components.link, **_WRITE)
        written.success(None, None, None, js=FETCH)
    page.unload(events.leave)


def _opening(events: Events, file: Any) -> Any:
    """A function that opens the user's file."""

    async def answer(values: Any, request: gr.Request) -> Any:
        async for update in events.open_own(file, values, request):
            yield update

    return answer
