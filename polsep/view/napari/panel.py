"""The panel that separates the shown frame of an image layer, in another thread, and adds layers of what it finds."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import napari
import numpy as np
from magicgui.widgets import CheckBox, ComboBox, Container, LineEdit, PushButton, TextEdit, create_widget
from napari.layers import Image, Layer
from napari.qt.threading import create_worker
from napari.utils.notifications import show_warning
from numpy.typing import NDArray

from polsep.io.raw.frames import Frame
from polsep.io.store.errors import one_line
from polsep.methods import METHODS
from polsep.physics.stokes import axis_deg
from polsep.sensor.camera import Layout
from polsep.sensor.levels import as_mosaic
from polsep.view.napari.layers import FACTS, frame_layers
from polsep.view.opening import FULL, HALF, OpenedFrame, Settings, Source, open_frame, parse_settings

#: Choices of layout; the last is said in a line of text.
LAYOUTS = ("color", "mono", "other")
NOTHING = "Open a raw frame, or File > Open Sample > polsep."


def make_panel() -> Any:
    """The panel as napari shows it: a container of magicgui, whose ``panel`` is a `Panel`."""
    return Panel().container


class Panel:
    """The panel and its fields, which are its state; a layer that knows its layout and levels fills them in.

    ``fields`` are by the names of `parse_settings`, but for the layout.
    """

    def __init__(self) -> None:
        self.layer = create_widget(annotation=Image, label="Raw frame")
        self.layout = ComboBox(label="Layout", choices=LAYOUTS, tooltip="Sony's orders, or filters said below")
        self.filters = LineEdit(label="Filters", value=Layout().spec, visible=False, tooltip="2x2 angles / Bayer order")
        self.fields = {
            "method": ComboBox(label="Method", choices=("auto", *METHODS), tooltip="auto: the best for the frame"),
            "black": LineEdit(label="Black level", value="0"),
            "white": LineEdit(label="White level", tooltip="4095 for 12 bits; empty: the type's largest"),
            "light": LineEdit(label="Light colour", value="auto", tooltip="auto, white, or the lamp's raw R,G,B"),
            "resolution": ComboBox(label="Resolution", choices=(HALF, FULL)),
        }
        self.grid = CheckBox(text="Layers side by side", value=True)
        self.button, self.status = PushButton(text="Separate"), TextEdit(value=NOTHING)
        self.status.native.setReadOnly(True)
        said = Container(widgets=(self.status,), labels=False)
        self.container = Container(
            widgets=(self.layer, self.layout, self.filters, *self.fields.values(), self.grid, self.button, said)
        )
        self.container.panel = self  # lives as long as what it serves
        self.layout.changed.connect(self._show_filters)
        self.layer.changed.connect(self._fill_in)
        self.button.changed.connect(self.separate)
        self._fill_in()

    def _show_filters(self) -> None:
        self.filters.visible = self.layout.value == LAYOUTS[-1]

    def _fill_in(self) -> None:
        layer = self.layer.value
        facts = {} if layer is None else layer.metadata.get(FACTS, {})
        if "white" in facts:  # a raw frame
            specs = {Layout.parse(name).spec: name for name in LAYOUTS[:-1]}
            self.layout.value = specs.get(facts["layout"], LAYOUTS[-1])
            self.filters.value = facts["layout"]
            for name in ("black", "white"):
                self.fields[name].value = f"{facts[name]:g}"

    def settings(self) -> Settings:
        """The settings that the fields say. Raises ValueError, in one line, on values without meaning."""
        said = {name: shown.value for name, shown in self.fields.items()}
        layout = self.layout.value if self.layout.value != LAYOUTS[-1] else self.filters.value
        return parse_settings({**said, "layout": layout})

    def separate(self) -> None:
        """Begin to separate what the viewer shows of the chosen layer; layers are added when it is done."""
        viewer, layer = napari.current_viewer(), self.layer.value
        try:
            if viewer is None or layer is None:
                raise ValueError(NOTHING)
            if "method" in layer.metadata.get(FACTS, {}):
                raise ValueError(f"expected a raw frame, found {layer.name!r}, which was separated")
            settings, samples = self.settings(), shown_samples(layer, viewer)
        except ValueError as error:
            self.status.value = one_line(error)
            return
        self.button.enabled, self.status.value = False, f"Separating {layer.name} …"
        create_worker(
            separate_samples,
            samples,
            layer.name,
            settings,
            _connect={"returned": partial(self._show, viewer, layer), "errored": self._fail},
            _ignore_errors=True,  # `_fail` says them
        )

    def _show(self, viewer: Any, layer: Any, found: OpenedFrame) -> None:
        """Add the layers, instead of those of an earlier run, and say what the user should know."""
        for data, shown, kind in frame_layers(found.frame, found.stem):
            if shown["name"] in viewer.layers:
                viewer.layers.remove(shown["name"])
            viewer.add_layer(Layer.create(data, {**shown, **place_on(layer, shown)}, kind))
        if self.grid.value:
            viewer.canvas.grid.stride = -1  # from the top of the list
            viewer.canvas.grid.enabled = True
            viewer.reset_view()
        for remark in found.remarks:
            show_warning(remark)
        report = found.frame.report
        clipped, angle = (report["statistics"][name] for name in ("clipped_fraction", "light_polarizer_deg"))
        polarizer = f"light polarizer at {axis_deg(angle):.0f}°"
        said = f"Separated by {report['method']}. {clipped:.2%} of the pixels clip; {polarizer}."
        self._end("\n\n".join([said, *found.remarks]))

    def _fail(self, error: BaseException) -> None:
        self._end(one_line(error) or type(error).__name__)

    def _end(self, text: str) -> None:
        self.button.enabled, self.status.value = True, text


def separate_samples(samples: NDArray[Any], name: str, settings: Settings) -> OpenedFrame:
    """The separation of a raw frame ``[H, W]``. Raises ValueError as `polsep.separate` does."""
    read = settings.read
    mosaic, notes = as_mosaic(samples, read.layout, read.black_level, read.white_level)
    return open_frame((Source(Path(name), name, False),), settings, Frame(name, mosaic, notes))


def shown_samples(layer: Any, viewer: Any) -> NDArray[Any]:
    """The plane ``[H, W]`` (or ``[H, W, C]``) of a layer's data that the viewer's sliders show."""
    data = layer.data[0] if layer.multiscale else layer.data
    place = layer.world_to_data(viewer.dims.point[-layer.ndim :])
    index = tuple(int(np.clip(round(at), 0, n - 1)) for at, n in zip(place[:-2], data.shape, strict=False))
    return np.asarray(data[index])


def place_on(layer: Any, shown: dict[str, Any]) -> dict[str, Any]:
    """Scale and translation of a layer, in the data of a raw frame, as that frame's own layer lies in the world."""
    scale, start = layer.scale[-2:], layer.translate[-2:]
    own, offset = shown.get("scale", (1.0, 1.0)), shown.get("translate", (0.0, 0.0))
    return {"scale": tuple(scale * own), "translate": tuple(start + scale * offset)}
