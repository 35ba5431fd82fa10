"""Pictures of the viewer: small linear copies of a separated frame, drawn at any exposure.

A copy is made once per separation; the exposure slider only changes the lookup in a table. A window of the frame is a
copy too, in as many pixels as the screen has. Light is averaged before any tone curve, and polarization as Stokes
vectors. Pictures are sRGB ``uint8 [h, w, 3]``.
"""

from __future__ import annotations

import html
import math
import re
from base64 import b64encode
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.results.charts import CHANNELS, histogram_svg, rose_shares, rose_svg
from polsep.io.results.previews import aolp_legend, aolp_wheel, dolp_map, exposure_of
from polsep.io.store.image_codecs import encode_jpeg_quickly, encode_png
from polsep.physics.srgb import srgb, srgb_bytes
from polsep.physics.stokes import wrap_aolp
from polsep.sensor.exposure import BLACK, CLIPPED, Histogram
from polsep.separation.report import PICTURE, SeparatedFrame, angle_origin

Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]

#: Longest side of a picture in pixels.
SCREEN = 640
#: Longest side of a window in pixels.
MAX_WINDOW = 2048
#: Pictures of at most so many pixels are sent without loss: every pixel of the frame is large then.
LOSSLESS = 1 << 16
#: Steps of the tone table: fine enough that no step skips an 8-bit code.
_STEPS = 1 << 14
#: Exposure of pictures of errors relative to that of light: errors are small.
_ERROR_GAIN = 8.0
#: Colours of marked pixels.
_MARKS = {CLIPPED: (255, 40, 40), BLACK: (40, 110, 255)}


@dataclass(frozen=True)
class Small:
    """A linear frame at screen size: ``step`` pixels of the frame wide is one pixel; ``gain``: exposure that fits it.

    ``diffuse``, ``specular``: ``[h, w, C]``; ``dolp``, ``aolp``: ``[h, w]``; ``error``: ``[h, w, 2]`` or None;
    ``edited``: ``[h, w, C]`` after edits, None without; ``flags``: `exposure_flags`, None without a raw frame.
    """

    step: int
    diffuse: Floats
    specular: Floats
    dolp: Floats
    aolp: Floats
    error: Floats | None
    gain: float
    edited: Floats | None = None
    flags: Pixels | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.dolp.shape[0], self.dolp.shape[1]


@dataclass(frozen=True)
class Exposure:
    """Exposure of pictures: stops above the exposure that fits, more for the specular; marks of clipping."""

    stops: float = 0.0
    specular_stops: float = 0.0
    marks: bool = False


def shrink_frame(frame: SeparatedFrame, flags: Pixels | None = None, step: int | None = None) -> Small:
    """The copy of a frame whose longer side is at most `SCREEN`, or at ``step`` pixels per pixel."""
    step = step or -(-max(frame.valid.shape) // SCREEN)
    diffuse, specular = (shrink(np.maximum(image, 0), step) for image in (frame.diffuse, frame.specular))
    s0 = (frame.diffuse + frame.specular).mean(axis=-1, dtype=np.float32)
    polarized = s0 * frame.dolp
    s1, s2 = (shrink(polarized * wave, step) for wave in (np.cos(2 * frame.aolp), np.sin(2 * frame.aolp)))
    light = shrink(s0, step)
    dolp = (np.hypot(s1, s2) / np.where(light > 0, light, 1)).astype(np.float32)
    aolp = wrap_aolp(np.arctan2(s2, s1) / 2)
    error = None if frame.error is None else np.sqrt(shrink(frame.error**2, step))
    marked = None if flags is None else _any_flag(flags, step)
    return Small(step, diffuse, specular, dolp, aolp, error, exposure_of(diffuse + specular), None, marked)


def _any_flag(flags: Pixels, step: int) -> Pixels:
    """The flags that any pixel of a block has."""
    if step == 1:
        return flags
    rows, cols = (np.arange(0, side, step) for side in flags.shape)
    found: Pixels = np.bitwise_or.reduceat(np.bitwise_or.reduceat(flags, rows, axis=0), cols, axis=1)
    return found


@dataclass(frozen=True)
class Window:
    """A part of a frame that a page shows: shares of the frame's sides, and the width on screen in pixels."""

    left: float
    top: float
    right: float
    bottom: float
    pixels: int

    @classmethod
    def parse(cls, text: object) -> Window:
        """The window ``left,top,right,bottom,pixels`` of a page, sides in 1/10000. Raises ValueError on others."""
        found = re.fullmatch(r"(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5}),(\d{1,5})", str(text))
        numbers = [int(part) for part in found.groups()] if found else []
        if not numbers or not (numbers[0] < numbers[2] <= 10000 and numbers[1] < numbers[3] <= 10000 and numbers[4]):
            raise ValueError(f"expected a window like 0,0,10000,10000,800, found {text!r:.60}")
        left, top, right, bottom = (number / 10000 for number in numbers[:4])
        return cls(left, top, right, bottom, numbers[4])

    def __str__(self) -> str:
        sides = (self.left, self.top, self.right, self.bottom)
        return ",".join(f"{round(10000 * side)}" for side in sides) + f",{self.pixels}"


@dataclass(frozen=True)
class Sharp:
    """A window of a frame as a copy; its place as shares of the frame's sides, in whole pixels."""

    small: Small
    left: float
    top: float
    right: float
    bottom: float


def cut_window(
    frame: SeparatedFrame, window: Window, like: Small, edited: Floats | None, flags: Pixels | None
) -> Sharp:
    """The part of a frame in a window, in about as many pixels as the window has, with the exposure of ``like``."""
    height, width = frame.valid.shape
    cols = math.floor(window.left * width), min(math.ceil(window.right * width), width)
    rows = math.floor(window.top * height), min(math.ceil(window.bottom * height), height)
    part = np.s_[rows[0] : rows[1], cols[0] : cols[1]]
    longest = max(rows[1] - rows[0], cols[1] - cols[0])
    step = max((cols[1] - cols[0]) // window.pixels, -(-longest // MAX_WINDOW), 1)
    error = None if frame.error is None else frame.error[part]
    images = (frame.diffuse[part], frame.specular[part], frame.valid[part], frame.dolp[part], frame.aolp[part])
    small = shrink_frame(SeparatedFrame(*images, {}, error), None if flags is None else flags[part], step)
    small = replace(small, gain=like.gain, edited=None if edited is None else shrink(edited[part], step))
    return Sharp(small, cols[0] / width, rows[0] / height, cols[1] / width, rows[1] / height)


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
    return srgb_bytes((np.arange(_STEPS) / (_STEPS - 1)) ** 2)


def tone(image: Floats, gain: float) -> Pixels:
    """A linear image ``[h, w, C]`` as sRGB ``[h, w, 3]``, 1 / ``gain`` and more as white."""
    place = np.sqrt(np.clip(image * np.float32(gain), 0, 1)) * np.float32(_STEPS - 1) + np.float32(0.5)
    codes: Pixels = _tones()[place.astype(np.uint16)]
    return codes if codes.shape[2] == 3 else codes.repeat(3, axis=2)


#: Pictures that can be compared, by name: functions of a copy, its gain, and that of its specular light.
VIEWS: dict[str, Callable[[Small, float, float], Pixels]] = {
    "Input": lambda small, gain, _: tone(small.diffuse + small.specular, gain),
    "Diffuse": lambda small, gain, _: tone(small.diffuse, gain),
    "Specular": lambda small, _, gain: tone(small.specular, gain),
    "Edited": lambda small, gain, _: tone(
        small.diffuse + small.specular if small.edited is None else small.edited, gain
    ),
    "DoLP": lambda small, *_: dolp_map(small.dolp),
    "AoLP": lambda small, *_: aolp_wheel(small.aolp, small.dolp),
    "Error of diffuse": lambda small, *_: _draw_error(small, 0),
    "Error of specular": lambda small, *_: _draw_error(small, 1),
}


def draw(small: Small, view: str, exposure: Exposure) -> Pixels:
    """One of `VIEWS`. Raises ValueError for another name."""
    if view not in VIEWS:
        raise ValueError(f"expected a picture of {', '.join(VIEWS)}, found {view!r:.60}")
    gain = small.gain * 2.0**exposure.stops
    pixels = VIEWS[view](small, gain, gain * 2.0**exposure.specular_stops)
    if exposure.marks and small.flags is not None:
        for flag, color in _MARKS.items():
            pixels[(small.flags & flag) > 0] = color
    return pixels


def _draw_error(small: Small, which: int) -> Pixels:
    """The expected error of diffuse or specular, `_ERROR_GAIN` times as bright as the frame; grey without any."""
    if small.error is None:
        return np.full((*small.size, 3), 48, np.uint8)
    return dolp_map(small.error[..., which] * np.float32(small.gain * _ERROR_GAIN))


def error_at_white(small: Small) -> float:
    """The error at the brightest colour of a picture of errors, in the images' unit."""
    return 1 / (small.gain * _ERROR_GAIN)


def as_url(pixels: Pixels) -> str:
    """A picture as a data URL, without a file.

    Note: JPEG of high quality, unlike the PNG previews in files, because it must follow a slider. Numbers are read from
    the frame (`readout`), never from here.
    """
    if pixels.shape[0] * pixels.shape[1] <= LOSSLESS:
        return lossless_url(pixels)
    return f"data:image/jpeg;base64,{b64encode(encode_jpeg_quickly(pixels)).decode('ascii')}"


def lossless_url(pixels: Pixels) -> str:
    """A small picture as a data URL, without loss."""
    return f"data:image/png;base64,{b64encode(encode_png(pixels, 1)).decode('ascii')}"


@dataclass(frozen=True)
class Picture:
    """One of the two compared pictures: a view of a frame, what made it, and the window of it that is seen."""

    view: str
    small: Small
    maker: str = ""
    sharp: Sharp | None = None

    def urls(self, exposure: Exposure) -> tuple[str, str | None]:
        """The whole picture, and its window."""
        whole = as_url(draw(self.small, self.view, exposure))
        return whole, None if self.sharp is None else as_url(draw(self.sharp.small, self.view, exposure))


@dataclass(frozen=True)
class Place:
    """Places on a picture: the frame's width in pixels, a marked place (row and column as shares), and the window."""

    width: int
    mark: tuple[float, float] | None = None
    window: Window | None = None


def stage(pictures: tuple[Picture, Picture], exposure: Exposure, place: Place) -> str:
    """The page's element that compares two pictures: layers of both, names, legends, and tools to zoom."""
    with ThreadPoolExecutor(2) as pool:
        urls = list(pool.map(lambda picture: picture.urls(exposure), pictures))
    layers = "".join(
        f'<div class="ps-layer ps-layer-{side}"><div class="ps-world">{_images(picture, url, side)}</div></div>'
        for picture, url, side in zip(pictures, urls, ("left", "right"), strict=True)
    )
    names = "".join(
        f'<span class="ps-name ps-name-{side}">{html.escape(" · ".join(t for t in (p.view, p.maker) if t))}</span>'
        f'<div class="ps-key ps-key-{side}">{_key(p)}</div>'
        for p, side in zip(pictures, ("left", "right"), strict=True)
    )
    ring = ""
    if place.mark is not None:
        ring = f'<span class="ps-mark" style="left:{100 * place.mark[1]:.4f}%;top:{100 * place.mark[0]:.4f}%"></span>'
    height, width = pictures[0].small.size
    tools = "".join(
        f'<button type="button" data-tool="{tool}" title="{title}" aria-label="{title}">{text}</button>'
        for tool, title, text in (
            ("out", "Zoom out (-)", "−"), ("in", "Zoom in (+)", "+"),
            ("one", "One pixel of the frame is one of the screen (1)", "1:1"), ("fit", "Fit (0)", "Fit"),
        )
    )  # fmt: skip
    key = "" if place.window is None or pictures[0].sharp is None else str(place.window)
    return (
        f'<div class="ps-stage" tabindex="0" role="group" aria-label="Pictures: arrow keys move, plus and minus zoom" '
        f'style="--ratio:{width / height:.5f}" data-width="{place.width}" data-window="{key}">{layers}'
        f'<div class="ps-layer ps-over"><div class="ps-world">{ring}</div></div>{names}'
        '<span class="ps-handle" role="slider" tabindex="0" aria-label="Compare" aria-valuemin="0" aria-valuemax="100" '
        f'aria-valuenow="50"></span><div class="ps-tools">{tools}<output></output></div></div>'
    )


def _images(picture: Picture, urls: tuple[str, str | None], side: str) -> str:
    whole, window = urls
    name = html.escape(picture.view)
    found = f'<img class="ps-{side}" src="{whole}" alt="{name}" decoding="sync" draggable="false">'
    if window is not None and (sharp := picture.sharp) is not None:
        place = f"left:{100 * sharp.left:.5f}%;top:{100 * sharp.top:.5f}%"
        size = f"width:{100 * (sharp.right - sharp.left):.5f}%;height:{100 * (sharp.bottom - sharp.top):.5f}%"
        found += (
            f'<img class="ps-sharp" src="{window}" alt="" style="{place};{size}" decoding="sync" draggable="false">'
        )
    return found


def _key(picture: Picture) -> str:
    """The legend of a picture that shows no light."""
    if picture.view == "AoLP":
        angles = "".join(f"<i>{angle}°</i>" for angle in (0, 45, 90, 135))
        return f'<div class="ps-wheel"><img src="{_wheel_url()}" alt="colour wheel">{angles}</div>'
    if picture.view.startswith("Error") and picture.small.error is None:
        return "<span>this method expects no errors</span>"
    if picture.view != "DoLP" and not picture.view.startswith("Error"):
        return ""
    most = 1.0 if picture.view == "DoLP" else error_at_white(picture.small)
    return f'<span>0</span><img class="ps-bar" src="{_bar_url()}" alt="scale"><span>{most:.2g}</span>'


@cache
def _wheel_url() -> str:
    return lossless_url(aolp_legend(72))


@cache
def _bar_url() -> str:
    return lossless_url(np.repeat(dolp_map(np.linspace(0, 1, 128))[None], 4, axis=0))


def exposure_panel(frame: SeparatedFrame, found: Histogram | None) -> str:
    """The histogram with the clipped share of every colour, the share of valid pixels, and expected errors."""
    rows = [f"{float(frame.valid.mean()):.2%} of the pixels are valid: clipping left nothing of them to assumption."]
    if frame.error is None:
        rows.append("This method does not say how far off it expects to be.")
    else:
        levels = [np.quantile(error, (0.5, 0.95)) for error in np.moveaxis(frame.error, -1, 0)]
        diffuse, specular = (f"{median:.2g} (95 % below {most:.2g})" for median, most in levels)
        rows.append(
            f"Expected error, median: diffuse {diffuse}, specular {specular}; 1 is one measurement at the white level."
        )
    said = "".join(f"<p>{row}</p>" for row in rows)
    if found is None:
        return f'<div class="ps-note"><p>Results and angle images have no raw samples to count.</p>{said}</div>'
    shares = "".join(
        f'<span style="color:{CHANNELS[name][0]}">{CHANNELS[name][1]} {share:.3%}</span>'
        for name, share in zip(found.names, found.clipped, strict=True)
    )
    return (
        f'<div class="ps-histogram">{histogram_svg(found)}'
        '<div class="ps-axis"><span>black</span><span>raw samples, logarithmic</span><span>white</span></div>'
        f'<div class="ps-shares"><b>Clipped</b>{shares}</div></div><div class="ps-note">{said}</div>'
    )


def shape_panel(frame: SeparatedFrame, stem: str) -> str:
    """The surface of a frame's object on a page of its own, and how sure it is. Raises ValueError."""
    from polsep.geometry.one_frame import find_shape
    from polsep.geometry.one_frame_files import page_of

    surface = find_shape(frame, None, None)
    error = float(np.degrees(np.median(surface.normal_error[surface.mask])))
    page, title = html.escape(page_of(surface, stem).decode(), quote=True), f"Relit {html.escape(stem)}"
    window = f'<iframe class="ps-relit" title="{title}" sandbox="allow-scripts" srcdoc="{page}"></iframe>'
    notes = surface.warnings()
    if "light_color" not in frame.report and frame.diffuse.shape[-1] > 1:
        notes.append("the lamp's colour of this result is not known: taken for white, unless Light colour says it")
    remarks = "".join(f'<div class="ps-remark">{html.escape(line)}</div>' for line in notes)
    return f'{window}<p class="ps-hint">Expected error of normals {error:.0f}° in the median.</p>{remarks}'


def light_panel(frame: SeparatedFrame, small: Small) -> str:
    """The rose of the polarized light's angles, the angle of the light's polarizer, and the light's colour."""
    power = (small.diffuse + small.specular).mean(axis=-1) * small.dolp
    statistics = frame.report.get("statistics", {})
    origin = angle_origin(frame.report)
    start = "right toward up" if origin == PICTURE else f"{html.escape(origin)}, which no degrees of the picture say"
    axes, rows = {}, [f"Angles of all polarized light, from {start}; the area is its share."]
    if "specular_aolp_deg" in statistics and origin == PICTURE:
        axes = {"ps-found": statistics["specular_aolp_deg"], "ps-lamp": statistics["light_polarizer_deg"]}
        rows.append(
            f'<b class="ps-found">Highlights</b> {axes["ps-found"]:.0f}°, concentration '
            f"{statistics['specular_aolp_concentration']:.2f} of 1"
        )
        rows.append(f'<b class="ps-lamp">Polarizer of the light</b> {axes["ps-lamp"]:.0f}°')
    color = frame.report.get("light_color")
    if color is not None and len(color) == 3:
        swatch = "".join(f"{round(255 * float(part)):02x}" for part in srgb(np.array(color) / max(color)))
        source = html.escape(str(frame.report.get("light", {}).get("source", "")))
        values = ", ".join(f"{part:.3f}" for part in color)
        rows.append(f'<i class="ps-swatch" style="background:#{swatch}"></i><b>Light colour</b> {values} {source}')
    text = "".join(f"<p>{row}</p>" for row in rows)
    return (
        f'<div class="ps-rose">{rose_svg(rose_shares(small.aolp, power), axes)}</div><div class="ps-note">{text}</div>'
    )
