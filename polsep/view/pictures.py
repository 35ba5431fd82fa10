"""Pictures of the viewer: small linear copies of a separated frame, drawn at any exposure.

A copy is made once per separation; the exposure slider only changes the lookup in a table. Light is averaged before any
tone curve, and polarization as Stokes vectors. Pictures are sRGB ``uint8 [h, w, 3]``.
"""

from __future__ import annotations

import html
from base64 import b64encode
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import to_numpy
from polsep.io.results.previews import aolp_legend, aolp_wheel, dolp_map, exposure_of, srgb
from polsep.io.store.image_codecs import encode_jpeg_quickly, encode_png
from polsep.sensor.camera import Mosaic
from polsep.separation.report import SeparatedFrame

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]

#: Longest side of a picture in pixels.
SCREEN = 640
#: Steps of the tone table: fine enough that no step skips an 8-bit code.
_STEPS = 1 << 14
#: Exposure of pictures of errors relative to that of light: errors are small.
_ERROR_GAIN = 8.0
_COLORS = {"R": "#ff6b6b", "G": "#63d471", "B": "#6ea8fe", "Y": "#d0d0d4"}


@dataclass(frozen=True)
class Small:
    """A linear frame at screen size: ``step`` pixels of the frame wide is one pixel; ``gain``: exposure that fits it.

    ``diffuse``, ``specular``: ``[h, w, C]``; ``dolp``, ``aolp``: ``[h, w]``; ``error``: ``[h, w, 2]`` or None;
    ``edited``: ``[h, w, C]`` after edits, None without.
    """

    step: int
    diffuse: Floats
    specular: Floats
    dolp: Floats
    aolp: Floats
    error: Floats | None
    gain: float
    edited: Floats | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.dolp.shape[0], self.dolp.shape[1]


def shrink_frame(frame: SeparatedFrame) -> Small:
    """The copy of a frame whose longer side is at most `SCREEN`."""
    step = -(-max(frame.valid.shape) // SCREEN)
    diffuse, specular = (shrink(np.maximum(image, 0), step) for image in (frame.diffuse, frame.specular))
    s0 = (frame.diffuse + frame.specular).mean(axis=-1, dtype=np.float32)
    polarized = s0 * frame.dolp
    s1, s2 = (shrink(polarized * wave, step) for wave in (np.cos(2 * frame.aolp), np.sin(2 * frame.aolp)))
    light = shrink(s0, step)
    dolp = (np.hypot(s1, s2) / np.where(light > 0, light, 1)).astype(np.float32)
    aolp = np.mod(np.arctan2(s2, s1) / 2, np.float32(np.pi))
    error = None if frame.error is None else np.sqrt(shrink(frame.error**2, step))
    return Small(step, diffuse, specular, dolp, aolp, error, exposure_of(diffuse + specular))


def shrink(image: Floats, step: int) -> Floats:
    """The mean over blocks of ``step`` pixels on a side; those at the right and lower border may be smaller."""
    if step == 1:
        return image
    height, width = image.shape[:2]
    rows, cols = np.arange(0, height, step), np.arange(0, width, step)
    sums: NDArray[Any] = np.add.reduceat(np.add.reduceat(image, rows, axis=0), cols, axis=1)
    count = np.diff(rows, append=height)[:, None] * np.diff(cols, append=width)
    mean: Floats = (sums / count.reshape(count.shape + (1,) * (image.ndim - 2))).astype(np.float32)
    return mean


@cache
def _tones() -> Pixels:
    """8-bit sRGB codes of the squares of `_STEPS` even steps from 0 to 1: finer steps in the dark."""
    return np.rint(255 * srgb((np.arange(_STEPS) / (_STEPS - 1)) ** 2)).astype(np.uint8)


def tone(image: Floats, gain: float) -> Pixels:
    """A linear image ``[h, w, C]`` as sRGB ``[h, w, 3]``, 1 / ``gain`` and more as white."""
    place = np.sqrt(np.clip(image * np.float32(gain), 0, 1)) * np.float32(_STEPS - 1) + np.float32(0.5)
    codes: Pixels = _tones()[place.astype(np.uint16)]
    return codes if codes.shape[2] == 3 else codes.repeat(3, axis=2)


#: Pictures that can be compared, by name: functions of a copy and a gain.
VIEWS: dict[str, Callable[[Small, float], Pixels]] = {
    "Input": lambda small, gain: tone(small.diffuse + small.specular, gain),
    "Diffuse": lambda small, gain: tone(small.diffuse, gain),
    "Specular": lambda small, gain: tone(small.specular, gain),
    "Edited": lambda small, gain: tone(small.diffuse + small.specular if small.edited is None else small.edited, gain),
    "DoLP": lambda small, gain: dolp_map(small.dolp),
    "AoLP": lambda small, gain: aolp_wheel(small.aolp, small.dolp),
}


def draw(small: Small, view: str, stops: float) -> Pixels:
    """One of `VIEWS`, ``stops`` above the exposure that fits the frame. Raises ValueError for another name."""
    if view not in VIEWS:
        raise ValueError(f"expected a picture of {', '.join(VIEWS)}, found {view!r:.60}")
    return VIEWS[view](small, small.gain * 2.0**stops)


def draw_error(small: Small) -> tuple[Pixels, Pixels] | None:
    """Expected errors of diffuse and of specular, `_ERROR_GAIN` times as bright as the frame."""
    if small.error is None:
        return None
    gain = np.float32(small.gain * _ERROR_GAIN)
    return dolp_map(small.error[..., 0] * gain), dolp_map(small.error[..., 1] * gain)


def error_at_white(small: Small) -> float:
    """The error at the brightest colour of `draw_error`, in the images' unit."""
    return 1 / (small.gain * _ERROR_GAIN)


def as_url(pixels: Pixels) -> str:
    """A picture as a data URL, without a file.

    Note: JPEG of high quality, unlike the PNG previews in files, because it must follow a slider. Numbers are read from
    the frame (`readout`), never from here.
    """
    return f"data:image/jpeg;base64,{b64encode(encode_jpeg_quickly(pixels)).decode('ascii')}"


def scale_url(pixels: Pixels) -> str:
    """A legend or scale as a data URL, lossless."""
    return f"data:image/png;base64,{b64encode(encode_png(pixels)).decode('ascii')}"


def stage(small: Small, views: tuple[str, str], stops: float, mark: tuple[int, int] | None = None) -> str:
    """The page's element that compares two pictures; ``mark``: row and column of a marked pixel."""
    with ThreadPoolExecutor(2) as pool:
        left, right = pool.map(lambda view: as_url(draw(small, view, stops)), views)
    height, width = small.size
    names = [html.escape(view) for view in views]
    ring = ""
    if mark is not None:
        x, y = 100 * (mark[1] + 0.5) / width, 100 * (mark[0] + 0.5) / height
        ring = f'<span class="ps-mark" style="left:{x:.3f}%;top:{y:.3f}%"></span>'
    return (
        f'<div class="ps-stage" style="--ratio:{width / height:.5f}">'
        f'<img class="ps-left" src="{left}" alt="{names[0]}" decoding="sync" draggable="false">'
        f'<img class="ps-right" src="{right}" alt="{names[1]}" decoding="sync" draggable="false">{ring}'
        f'<span class="ps-name ps-name-left">{names[0]}</span><span class="ps-name ps-name-right">{names[1]}</span>'
        '<span class="ps-handle" role="slider" tabindex="0" aria-label="Compare" aria-valuemin="0" aria-valuemax="100" '
        'aria-valuenow="50"></span></div>'
    )


def polarization_panel(small: Small) -> str:
    """DoLP with its scale and AoLP with its wheel."""
    bar = np.repeat(dolp_map(np.linspace(0, 1, 256))[None], 4, axis=0)
    ticks = "".join(f"<span>{k / 4:g}</span>" for k in range(5))
    places = {"0°": (104, 50), "45°": (90, 8), "90°": (50, -8), "135°": (10, 8)}
    angles = "".join(f'<i style="left:{x}%;top:{y}%">{angle}</i>' for angle, (x, y) in places.items())
    wheel = f'<div class="ps-wheel"><img src="{scale_url(aolp_legend(96))}" alt="colour wheel">{angles}</div>'
    return _pair(
        _figure("Degree of linear polarization", draw(small, "DoLP", 0)),
        _scale(scale_url(bar), ticks),
        _figure("Angle of linear polarization, from right toward up", draw(small, "AoLP", 0)),
        f'<div class="ps-legend">{wheel}<p>centre: unpolarized<br>rim: fully polarized</p></div>',
    )


def confidence_panel(frame: SeparatedFrame, small: Small) -> str:
    """Expected errors per pixel, and the share of valid pixels."""
    valid = f"{float(frame.valid.mean()):.2%} of the pixels are valid: clipping left nothing of them to assumption."
    drawn = draw_error(small)
    if drawn is None:
        return f'<p class="ps-empty">This method does not say how far off it expects to be. {valid}</p>'
    bar = np.repeat(dolp_map(np.linspace(0, 1, 256))[None], 4, axis=0)
    white = error_at_white(small)
    ticks = "".join(f"<span>{white * k / 4:.2g}</span>" for k in range(5))
    assert frame.error is not None
    rms = [float(np.sqrt(np.mean(frame.error[..., k].astype(np.float64) ** 2))) for k in range(2)]
    return _pair(
        _figure(f"Expected error of diffuse, rms {rms[0]:.2g}", drawn[0]),
        _scale(scale_url(bar), ticks),
        _figure(f"Expected error of specular, rms {rms[1]:.2g}", drawn[1]),
        f'<div class="ps-legend"><p>standard deviation, 1 = one measurement at the white level<br>{valid}</p></div>',
    )


def _figure(title: str, pixels: Pixels) -> str:
    return f'<figcaption>{html.escape(title)}</figcaption><img src="{as_url(pixels)}" alt="{html.escape(title)}">'


def _scale(bar: str, ticks: str) -> str:
    return f'<div class="ps-legend"><div class="ps-scale"><img src="{bar}" alt="scale"><div>{ticks}</div></div></div>'


def _pair(first: str, below_first: str, second: str, below_second: str) -> str:
    """Two pictures side by side, each with its legend."""
    cells = ((first, below_first), (second, below_second))
    return f'<div class="ps-pair">{"".join(f"<figure>{figure}{legend}</figure>" for figure, legend in cells)}</div>'


@dataclass(frozen=True)
class Histogram:
    """Shares of raw samples per bin between black and white, for each colour: rows of ``shares`` [colours, bins].

    ``clipped``: the share of samples of each colour that clip.
    """

    names: str
    shares: NDArray[np.float64]
    clipped: tuple[float, ...]


def histogram(mosaic: Mosaic, bins: int = 128) -> Histogram:
    """Histogram of raw samples from black to white; samples beyond count in the first and last bins."""
    samples, clipped = to_numpy(mosaic.linear()), to_numpy(mosaic.clipped())
    layout, period = mosaic.layout, mosaic.layout.period
    count = np.zeros((layout.channels, bins))
    over = np.zeros(layout.channels)
    for row in range(period):
        for col in range(period):
            channel = layout.filter_at(row, col).channel
            values = samples[row::period, col::period]
            codes = np.clip(values * bins, 0, bins - 1).astype(np.int64)
            count[channel] += np.bincount(codes.ravel(), minlength=bins)
            over[channel] += int(np.count_nonzero(clipped[row::period, col::period]))
    total = count.sum(axis=1)
    names = "RGB" if layout.channels == 3 else "Y"
    return Histogram(names, count / total[:, None], tuple((over / total).tolist()))


def histogram_panel(found: Histogram | None) -> str:
    """The histogram as a drawing, with the clipped share of every colour."""
    if found is None:
        return '<p class="ps-empty">Results and angle images have no raw samples to count.</p>'
    width, height, floor = 640, 220, 1e-6
    shown = np.log10(np.maximum(found.shares, floor) / floor)
    top = max(float(shown.max()), 1.0)
    lines = []
    for name, row in zip(found.names, shown, strict=True):
        x = (np.arange(row.size) + 0.5) * width / row.size
        points = " ".join(f"{a:.1f},{height - b / top * (height - 12):.1f}" for a, b in zip(x, row, strict=True))
        lines.append(
            f'<polyline points="0,{height} {points} {width},{height}" fill="{_COLORS[name]}" fill-opacity=".13" '
            f'stroke="{_COLORS[name]}" stroke-width="1.5" vector-effect="non-scaling-stroke"/>'
        )
    shares = "".join(
        f'<span style="color:{_COLORS[name]}">{_label(name)} {share:.3%}</span>'
        for name, share in zip(found.names, found.clipped, strict=True)
    )
    return (
        f'<div class="ps-histogram"><svg viewBox="0 0 {width} {height}" preserveAspectRatio="none" role="img" '
        f'aria-label="histogram of raw samples">{"".join(lines)}</svg>'
        '<div class="ps-axis"><span>black level</span><span>raw samples, shares on a logarithmic scale</span>'
        f'<span>white level</span></div><div class="ps-shares"><b>Clipped</b>{shares}</div></div>'
    )


def _label(color: str) -> str:
    return {"R": "red", "G": "green", "B": "blue", "Y": "all"}[color]
