"""Facts for setting up a shot: exposure, focus and polarization of the newest frame, and a picture with marks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.charts import CHANNELS, histogram_svg, rose_shares, rose_svg
from polsep.io.results.previews import exposure_of, toned
from polsep.io.store.image_codecs import encode_jpeg
from polsep.sensor.camera import Capture, Mosaic
from polsep.sensor.exposure import BLACK, CLIPPED, edge_contrast, exposure_flags, histogram
from polsep.separation.report import SeparatedFrame

#: Longest side of the picture in pixels.
SCREEN = 1024
#: Contrast above which an edge is marked as sharp; about the largest percent of the pixels of a focused scene.
PEAK = 0.35
#: Colours of marks: clipped, black, sharp.
_COLORS = {"clipped": (255, 40, 40), "black": (40, 110, 255), "sharp": (60, 255, 90)}


@dataclass(frozen=True)
class Shot:
    """A raw frame and its separation; what is computed of them is computed when a page asks, once."""

    capture: Capture
    frame: SeparatedFrame
    remarks: tuple[str, ...]

    @cached_property
    def focus(self) -> float:
        """Contrast that one pixel of 200 exceeds: largest in focus, of the same scene at the same exposure."""
        return float(np.quantile(self._contrast, 0.995))

    @cached_property
    def _contrast(self) -> NDArray[np.float32]:
        total = self.frame.diffuse + self.frame.specular
        return edge_contrast(total.mean(axis=-1, dtype=np.float32))

    @cached_property
    def facts(self) -> dict[str, Any]:
        """Numbers, charts as SVG and remarks, for a page."""
        statistics = self.frame.report["statistics"]
        axes = {"found": statistics["specular_aolp_deg"], "lamp": statistics["light_polarizer_deg"]}
        power = (self.frame.diffuse + self.frame.specular).mean(axis=-1) * self.frame.dolp
        found = histogram(self.capture) if isinstance(self.capture, Mosaic) else None
        clipped = (
            [] if found is None else [(CHANNELS[n][1], s) for n, s in zip(found.names, found.clipped, strict=True)]
        )
        return {
            "clipped": clipped,
            "focus": self.focus,
            "light_deg": axes["lamp"],
            "concentration": statistics["specular_aolp_concentration"],
            "specular": statistics["specular_fraction"],
            "remarks": list(self.remarks),
            "histogram": "" if found is None else histogram_svg(found),
            "rose": rose_svg(rose_shares(self.frame.aolp, power), axes),
        }

    def picture(self, marks: frozenset[str]) -> bytes:
        """The input as a JPEG file with marks, of "clipped" (red, black ones blue) and "sharp" (green)."""
        total = np.maximum(self.frame.diffuse, 0) + np.maximum(self.frame.specular, 0)
        step = -(-max(total.shape) // SCREEN)
        pixels = toned(total[::step, ::step], exposure_of(total))
        if "sharp" in marks:
            _mark(pixels, self._contrast > PEAK, step, "sharp")
        if "clipped" in marks and isinstance(self.capture, Mosaic):
            flags = exposure_flags(self.capture)
            _mark(pixels, (flags & BLACK) > 0, step, "black")
            _mark(pixels, (flags & CLIPPED) > 0, step, "clipped")
        return encode_jpeg(pixels)


def _mark(pixels: NDArray[np.uint8], where: NDArray[np.bool_], step: int, name: str) -> None:
    """Colour the pixels of a picture that have a marked one among the ``step`` x ``step`` of the frame below them."""
    rows, cols = (np.arange(0, side, step) for side in where.shape)
    found = np.logical_or.reduceat(np.logical_or.reduceat(where, rows, axis=0), cols, axis=1)
    pixels[found] = _COLORS[name]
