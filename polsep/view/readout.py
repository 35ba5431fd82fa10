"""The numbers of one pixel: raw samples of its 2x2 cell, their Stokes vector, and its separation.

Coordinates are those of the separated images, row and column from the upper left. At half resolution, the cell of pixel
(r, c) starts at raw pixel (2r, 2c), after the layout's origin; at full resolution it is the one around the pixel.
Angles are in degrees, from image-right toward image-up.
"""

from __future__ import annotations

import html
import math
from dataclasses import dataclass, replace

import numpy as np

from polsep.physics.stokes import Measurements, axis_deg, fit_stokes
from polsep.sensor.camera import Mosaic
from polsep.separation.report import SeparatedFrame


@dataclass(frozen=True)
class Sample:
    """One raw sample: its analyser in degrees, its value in the file's units, whether it clips."""

    angle_deg: float
    value: float
    clipped: bool


@dataclass(frozen=True)
class Readout:
    """The numbers of one pixel; ``samples``, ``color`` and ``stokes`` are empty where there is no raw frame.

    ``stokes``: s0, s1, s2 of the cell's own four samples, linear, of the one colour that covers it. ``error``: of
    diffuse and specular, or None.
    """

    row: int
    col: int
    color: str
    samples: tuple[Sample, ...]
    stokes: tuple[float, float, float] | None
    diffuse: tuple[float, ...]
    specular: tuple[float, ...]
    dolp: float
    aolp_deg: float
    valid: bool
    error: tuple[float, float] | None


def read_pixel(frame: SeparatedFrame, mosaic: Mosaic | None, place: tuple[int, int]) -> Readout:
    """The numbers at row and column ``place``. Raises ValueError outside of the frame."""
    row, col = place
    height, width = frame.valid.shape
    if not (0 <= row < height and 0 <= col < width):
        raise ValueError(f"expected a pixel of {width}x{height}, found row {row}, column {col}")
    if mosaic is not None and height > mosaic.data.shape[-2] // 2:  # full resolution
        cells = [
            min(max(n - start, 0) // 2, (side - start) // 2 - 1)
            for n, start, side in zip(place, mosaic.layout.origin, mosaic.data.shape, strict=True)
        ]
        row, col = cells
    samples, color, stokes = ((), "", None) if mosaic is None else _read_cell(mosaic, row, col)
    row, col = place
    error = None if frame.error is None else (float(frame.error[row, col, 0]), float(frame.error[row, col, 1]))
    return Readout(
        row,
        col,
        color,
        samples,
        stokes,
        tuple(frame.diffuse[row, col].tolist()),
        tuple(frame.specular[row, col].tolist()),
        float(frame.dolp[row, col]),
        math.degrees(float(frame.aolp[row, col])),
        bool(frame.valid[row, col]),
        error,
    )


def _read_cell(mosaic: Mosaic, row: int, col: int) -> tuple[tuple[Sample, ...], str, tuple[float, float, float]]:
    """Samples by angle, the colour over them, and their Stokes vector."""
    top, left = (2 * n + start for n, start in zip((row, col), mosaic.layout.origin, strict=True))
    cell, clipped = mosaic.data[top : top + 2, left : left + 2], mosaic.clipped()[top : top + 2, left : left + 2]
    as_measured = replace(mosaic, light_color=(1.0, 1.0, 1.0))  # as the images are: in a calibrated lamp's light
    linear = as_measured.linear()[top : top + 2, left : left + 2]
    filters = {(r, c): mosaic.layout.filter_at(top + r, left + c) for r in (0, 1) for c in (0, 1)}
    order = sorted(filters, key=lambda at: filters[at].angle_deg)
    samples = tuple(Sample(filters[at].angle_deg, float(cell[at]), bool(clipped[at])) for at in order)
    light = np.array([float(linear[at]) for at in order])
    angles = tuple(math.radians(sample.angle_deg) for sample in samples)
    found = fit_stokes(Measurements(light.reshape(4, 1, 1, 1), angles))
    colors = "RGB" if mosaic.layout.bayer else "Y"
    color = colors[filters[order[0]].channel]
    return samples, color, (found.s0.item(), found.s1.item(), found.s2.item())


def readout_panel(found: Readout, maker: str = "") -> str:
    """The numbers as a table; ``maker``: what separated them."""
    rows = [("Method", html.escape(maker))] if maker else []
    rows += [("Pixel", f"row {found.row}, column {found.col}" + ("" if found.valid else " · not valid"))]
    if found.samples:
        name = {"R": "red", "G": "green", "B": "blue", "Y": "mono"}[found.color]
        raw = "".join(
            f"<span{' class=ps-clipped' if s.clipped else ''}><i>{s.angle_deg:g}°</i>{s.value:g}</span>"
            for s in found.samples
        )
        rows.append((f"Raw, {name}", f'<div class="ps-cells">{raw}</div>'))
    if found.stokes is not None:
        s = "".join(f"<span><i>s{k}</i>{value:.4f}</span>" for k, value in enumerate(found.stokes))
        rows.append(("Stokes of these", f'<div class="ps-cells">{s}</div>'))
    rows.append(("Diffuse", _colors(found.diffuse)))
    rows.append(("Specular", _colors(found.specular)))
    if found.error is not None:
        rows.append(("Expected error", f"diffuse {found.error[0]:.4f}, specular {found.error[1]:.4f}"))
    rows.append(("Polarization", f"DoLP {found.dolp:.3f}, AoLP {axis_deg(found.aolp_deg, 1):.1f}°"))
    body = "".join(f"<tr><th>{name}</th><td>{value}</td></tr>" for name, value in rows)
    return f'<table class="ps-readout">{body}</table>'


def _colors(values: tuple[float, ...]) -> str:
    names = "RGB" if len(values) == 3 else "Y"
    cells = "".join(f"<span><i>{name}</i>{value:.4f}</span>" for name, value in zip(names, values, strict=True))
    return f'<div class="ps-cells">{cells}</div>'
