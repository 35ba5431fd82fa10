"""Pictures of a separated frame for people: tone curve, colour maps with legends, and a contact sheet.

Pure functions on arrays; nothing here reads or writes a file, and nothing measured should be read off a preview.

Conventions: inputs are linear light ``[H, W, C]`` (C = 3 or 1), results are sRGB ``uint8 [h, w, 3]``. Angles
are radians in [0, pi) from image-right toward image-UP; rows grow downward, so a direction (d_row, d_col) has the
angle atan2(-d_row, d_col). Shrinking averages light, and polarization as Stokes vectors, before any tone curve.
"""

from __future__ import annotations

import builtins
import math
import textwrap
from collections.abc import Callable, Sequence
from functools import cache, partial, reduce
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw, ImageFont

from polsep.physics.srgb import srgb, srgb_bytes
from polsep.physics.stokes import wrap_aolp

if TYPE_CHECKING:
    from polsep.separation.report import SeparatedFrame

Values = NDArray[np.floating[Any]]
Pixels = NDArray[np.uint8]
Picture: TypeAlias = Image.Image
#: Some rows of an image, made when asked for: whole images of large frames are not made a second time.
Rows: TypeAlias = Callable[[slice], Values | NDArray[np.bool_]]

PANEL = 640  # longest side of a panel in pixels
STRIP = 32  # rows of a panel that are averaged at a time
COLUMNS = 4  # panels in a row of the contact sheet
TITLE, GUTTER, MARGIN, LEGEND = 34, 12, 16, 116  # heights and gaps of the contact sheet in pixels
HEADER, LINE = 38, 22  # heights of its first line, and of one of the warnings below
NARROWEST = 300  # width that titles and legends need
BACKGROUND, TEXT, FAINT = (22, 22, 24), (235, 235, 235), (150, 150, 155)
WARNING, FADED = (240, 180, 60), (70, 70, 76)
#: Light in units of its noise below which polarization is not shown, and from which on it is in full.
AT_NOISE, CLEAR = 4.0, 20.0

#: Nine evenly spaced colours of matplotlib's "inferno" (van der Walt and Smith 2015, CC0): ever lighter.
INFERNO = "000004 210c4a 56106e 89226a bb3754 e35932 f98c0a f9c932 fcffa4"
#: Three colours that also colour-blind people tell apart (Okabe and Ito 2008): vermilion, sky blue, yellow.
NOT_VALID, ABOVE_RANGE, ABOVE_ONE = (213, 94, 0), (86, 180, 233), (240, 228, 66)


class Flag(NamedTuple):
    """A kind of pixel that the mask panel marks: its ``share`` of each block ``[h, w]``, and of the frame."""

    share: NDArray[np.float64]
    of_frame: float
    color: tuple[int, int, int]
    name: str


class Panel(NamedTuple):
    """One cell of the contact sheet: a title, a remark and the picture ``uint8 [h, w, 3]``."""

    title: str
    note: str
    pixels: Pixels


def exposure_of(image: Values, percentile: float = 99.5) -> float:
    """The gain that shows ``percentile`` of the samples of a linear image at 0.9; one gain serves all its parts.

    Where that percentile is 0, the brightest sample is shown at 0.9; an image without light has gain 1.
    """
    level = float(np.percentile(image, percentile))
    level = level if level > 0 else float(np.max(image))
    return 0.9 / level if level > 0 else 1.0


def aolp_wheel(aolp: ArrayLike, dolp: ArrayLike | None = None) -> Pixels:
    """Colours ``uint8 [..., 3]`` of angles in radians: red at 0, green at 60, blue at 120 degrees, and around again.

    Channel k is cos^2(aolp - k 60 deg), Malus's law for three analysers. These are the hues of the HSV wheel at
    hue = aolp / pi without its corners, so a rotation by 60 degrees permutes the channels. With ``dolp`` (limited to
    [0, 1]) colours darken so that their light is proportional to it: unpolarized is black, however random its angle.
    """
    angles = np.asarray(aolp, dtype=np.float64)[..., None] - np.arange(3) * (np.pi / 3)
    color = np.cos(angles) ** 2
    if dolp is not None:
        color = color * srgb(dolp)[..., None]
    return _to_bytes(color)


def aolp_legend(size: int) -> Pixels:
    """The disc ``uint8 [size, size, 3]`` that explains `aolp_wheel`: angle around, DoLP from 0 at the centre to 1."""
    fine = 4 * size
    right = np.broadcast_to(np.arange(fine) - (fine - 1) / 2, (fine, fine))
    up = -right.T
    radius = np.hypot(right, up) / (fine / 2)
    color = aolp_wheel(np.arctan2(up, right), radius).astype(np.float64)
    color[radius > 1] = BACKGROUND
    mean: NDArray[np.float64] = color.reshape(size, 4, size, 4, 3).mean(axis=(1, 3))
    return np.rint(mean).astype(np.uint8)


def dolp_map(dolp: ArrayLike) -> Pixels:
    """Colours ``uint8 [..., 3]`` of degrees of polarization: black at 0 over purple and orange to pale yellow at 1.

    `INFERNO`, linearly interpolated. Values above 1 get the last colour here and a mark in `contact_sheet`.
    """
    table = np.array([list(bytes.fromhex(color)) for color in INFERNO.split()]) / 255
    x = np.clip(np.asarray(dolp, dtype=np.float64), 0, 1)
    at = np.linspace(0, 1, len(table))
    return _to_bytes(np.stack([np.interp(x, at, table[:, k]) for k in range(3)], axis=-1))


def contact_sheet(frame: SeparatedFrame) -> Pixels:
    """One picture ``uint8 [h, w, 3]`` of a frame: its file, method and warnings; light above, maps with legends below.

    Light: input (diffuse + specular), diffuse and specular with one gain, and specular with a gain of its own. Maps:
    DoLP and AoLP, faded where the light is at the noise, a mask, and the expected error where the method has one.
    Panels keep the aspect ratio, at most `PANEL` pixels on the longer side; frames smaller than half of that show
    every pixel as 2x2. The mask marks pixels that are not valid, sums above the measurable 2, and DoLP above 1, with
    their shares.
    """
    flags = _flags(frame)
    panels = _panels(frame, flags)
    height, width = panels[0].pixels.shape[:2]
    scale = 2 if 2 * max(height, width) <= PANEL else 1
    cell_width, cell_height = max(scale * width, NARROWEST), TITLE + scale * height + GUTTER
    lefts = [MARGIN + k * (cell_width + GUTTER) for k in range(COLUMNS)]
    full_width = lefts[-1] + cell_width + MARGIN
    warned = _warning_lines(frame, full_width - 2 * MARGIN)
    begin = HEADER + LINE * len(warned)
    sheet = Image.new("RGB", (full_width, begin + 2 * cell_height + LEGEND + 2 * MARGIN), BACKGROUND)
    _draw_header(sheet, frame, warned)
    for k, panel in enumerate(panels):
        left, top = lefts[k % COLUMNS], begin + MARGIN + k // COLUMNS * cell_height
        _draw_title(sheet, (left, top, cell_width), panel.title, panel.note)
        _paste(sheet, panel.pixels.repeat(scale, axis=0).repeat(scale, axis=1), (left, top + TITLE))
    below = begin + MARGIN + 2 * cell_height
    _draw_dolp_legend(sheet, (lefts[0], below, cell_width))
    _draw_aolp_legend(sheet, (lefts[1], below))
    _draw_flag_legend(sheet, (lefts[2], below), flags)
    return np.array(sheet, dtype=np.uint8)


def show_frame(frame: SeparatedFrame) -> Picture:
    """Open the contact sheet in the system's picture viewer, and return it; in a notebook only return it."""
    sheet = Image.fromarray(contact_sheet(frame))
    if not hasattr(builtins, "__IPYTHON__"):
        sheet.show()
    return sheet


def live_sheet(frame: SeparatedFrame) -> Pixels:
    """Input, diffuse and specular side by side, ``uint8 [h, w, 3]``, with one gain; fast enough for a live view."""
    diffuse, specular = _shrunk_parts(frame)
    total = diffuse + specular
    gain = exposure_of(total)
    gap = np.full((total.shape[0], GUTTER, 3), BACKGROUND, np.uint8)
    return np.concatenate([toned(total, gain), gap, toned(diffuse, gain), gap, toned(specular, gain)], axis=1)


def _panels(frame: SeparatedFrame, flags: list[Flag]) -> list[Panel]:
    """The pictures of the contact sheet in reading order, all of one size."""
    size, seldom = frame.valid.shape, slice(None, None, _block(frame.valid.shape))
    gain, own = exposure_of(_total(frame, seldom)), exposure_of(frame.specular[seldom])
    parts = _shrunk_parts(frame)
    light = (parts[0] + parts[1]).mean(axis=-1)
    s1, s2 = np.moveaxis(_shrunk(partial(_polarized, frame), size), -1, 0)
    dolp = np.hypot(s1, s2) / np.where(light > 0, light, 1)
    aolp = wrap_aolp(np.arctan2(s2, s1) / 2)
    shown = _clearness(frame, light)[..., None]
    combined, diffuse, specular = (toned(image, gain) for image in (parts[0] + parts[1], *parts))
    exposure = f"exposure x {gain:.3g}"
    panels = [
        Panel("Input", exposure, combined),
        Panel("Diffuse", exposure, diffuse),
        Panel("Specular", exposure, specular),
        Panel(
            "Specular, brighter" if own >= gain else "Specular, darker",
            f"exposure x {own:.3g}",
            toned(parts[1], own),
        ),
        Panel("DoLP", "degree of linear polarization", _faded(_in_strips(dolp_map, dolp), shown)),
        Panel("AoLP", "angle of linear polarization", _faded(_in_strips(aolp_wheel, aolp, dolp), shown)),
        Panel("Mask", "", _flagged(combined, flags)),
    ]
    if frame.error is not None:
        error = _shrunk(partial(_largest_error, frame.error), size)
        top = max(float(np.percentile(error, 99)), 1e-9)
        panels.append(Panel("Expected error", f"yellow: {top:.2g} or more", _in_strips(dolp_map, error / top)))
    return panels


def _total(frame: SeparatedFrame, rows: slice) -> Values:
    """All light ``[h, W, C]`` of some rows."""
    total: Values = np.maximum(frame.diffuse[rows], 0)
    total += np.maximum(frame.specular[rows], 0)
    return total


def _brightness(frame: SeparatedFrame, rows: slice) -> Values:
    """The mean over colours of all light ``[h, W]`` of some rows, a colour at a time."""
    channels = range(frame.diffuse.shape[-1])
    parts = (np.maximum(frame.diffuse[rows, :, k], 0) + np.maximum(frame.specular[rows, :, k], 0) for k in channels)
    mean: Values = reduce(np.add, parts) / len(channels)
    return mean


def _polarized(frame: SeparatedFrame, rows: slice) -> Values:
    """s1 and s2 ``[h, W, 2]`` of some rows, the mean over colours."""
    power, angle = _brightness(frame, rows) * frame.dolp[rows], 2 * frame.aolp[rows]
    return np.stack([power * np.cos(angle), power * np.sin(angle)], axis=-1)


def _largest_error(error: Values, rows: slice) -> Values:
    """The larger one of both expected errors ``[h, W]`` of some rows."""
    return np.maximum(error[rows, :, 0], error[rows, :, 1])


def _shrunk_parts(frame: SeparatedFrame) -> list[NDArray[np.float64]]:
    """Diffuse and specular light, shrunk."""
    size = frame.valid.shape

    def lit(image: Values, rows: slice) -> Values:
        return np.maximum(image[rows], 0)

    return [_shrunk(partial(lit, image), size) for image in (frame.diffuse, frame.specular)]


def _clearness(frame: SeparatedFrame, light: Values) -> NDArray[np.float64]:
    """From 0 where the shrunk ``light`` is at the frame's noise to 1 where polarization can be seen.

    The noise is that of s1 in the darkest quarter, as neighbours on the diagonal differ there, in two rows of a block.
    """
    k = _block(frame.valid.shape)
    bright = _brightness(frame, slice(1, None, k))
    dark = bright <= np.percentile(bright, 25) if bright.size else bright > 0
    found = [np.zeros(0, np.float32)]
    for first in range(0, len(dark), STRIP):
        strip = dark[first : first + STRIP, 1:]
        upper, lower = (slice(k * first + y, k * (first + len(strip)) + y, k) for y in (0, 1))
        above, below = (_polarized(frame, rows)[..., 0] for rows in (upper, lower))
        found.append(np.abs(below[:, 1:] - above[:, :-1])[strip])
    steps = np.concatenate(found)
    noise = float(steps.mean()) * np.sqrt(np.pi) / 2 if steps.size else 0.0
    if noise == 0:
        return np.ones_like(light, np.float64)
    clear: NDArray[np.float64] = np.clip((light / noise - AT_NOISE) / (CLEAR - AT_NOISE), 0, 1)
    return clear


def _faded(picture: Pixels, share: Values) -> Pixels:
    """A picture where ``share [h, w, 1]`` is 1, grey where it is 0."""
    mixed: NDArray[np.float64] = share * picture + (1 - share) * np.array(FADED)
    return np.rint(mixed).astype(np.uint8)


def _to_bytes(display: Values) -> Pixels:
    """Display values in [0, 1] as 8 bits."""
    return np.rint(np.clip(display, 0, 1) * 255).astype(np.uint8)


def toned(image: Values, gain: float) -> Pixels:
    """A linear image ``[H, W, C]``, times ``gain``, as sRGB ``uint8 [H, W, 3]``."""
    return _in_strips(lambda part: np.broadcast_to(srgb_bytes(gain * part), (*part.shape[:2], 3)), image)


def _in_strips(draw: Callable[..., Pixels], *images: Values) -> Pixels:
    """Images drawn pixel by pixel, some rows at a time, since ``draw`` needs several times their memory."""
    strips = range(0, len(images[0]), STRIP)
    return np.concatenate([draw(*(image[top : top + STRIP] for image in images)) for top in strips])


def _block(size: tuple[int, int]) -> int:
    """Side of the blocks that `_shrunk` averages."""
    return -(-max(size) // PANEL)


def _shrunk(rows: Rows, size: tuple[int, int]) -> NDArray[np.float64]:
    """Area average over square blocks, cut at the border, so that neither side of ``[H, W, ...]`` exceeds `PANEL`."""
    height, k = size[0], _block(size)
    strips = range(0, height, STRIP * k)
    sums = np.concatenate([_block_sums(rows, (top, min(top + STRIP * k, height)), k) for top in strips])
    mean: NDArray[np.float64] = sums / _counts(size).reshape(*sums.shape[:2], *[1] * (sums.ndim - 2))
    return mean


def _counts(size: tuple[int, int]) -> NDArray[np.int64]:
    """Pixels of each block of `_shrunk`."""
    high, wide = (np.diff(np.arange(0, n, _block(size)), append=n) for n in size)
    return np.asarray(high[:, None] * wide)


def _block_sums(rows: Rows, strip: tuple[int, int], k: int) -> NDArray[np.float64]:
    """Sums over blocks of k x k pixels of some rows of an image."""
    first, last = strip
    bands = np.array(rows(slice(first, last, k)), np.float32)
    for row in range(first + 1, first + k):  # whole rows at a time
        own = rows(slice(row, last, k))
        bands[: len(own)] += own
    sums = np.zeros((len(bands), -(-bands.shape[1] // k), *bands.shape[2:]))
    for column in range(k):
        part = bands[:, column::k]
        sums[:, : part.shape[1]] += part
    return sums


def _flags(frame: SeparatedFrame) -> list[Flag]:
    """The flags of the mask panel; later ones are drawn over earlier ones."""
    size = frame.valid.shape
    kinds: list[tuple[Rows, tuple[int, int, int], str]] = [
        (lambda rows: frame.dolp[rows] > 1, ABOVE_ONE, "DoLP above 1"),
        (lambda rows: _total(frame, rows).max(axis=-1) > 2, ABOVE_RANGE, "above the measurable range"),
        (lambda rows: ~frame.valid[rows], NOT_VALID, "not valid"),
    ]
    found = []
    for where, color, name in kinds:
        share = _shrunk(where, size)
        found.append(Flag(share, float((share * _counts(size)).sum()) / math.prod(size), color, name))
    return found


def _flagged(picture: Pixels, flags: list[Flag]) -> Pixels:
    """The picture grey and dim, with every flagged pixel tinted, however few of a block they are."""
    grey = picture.mean(axis=-1, keepdims=True) * 0.55
    out: NDArray[np.float64] = np.repeat(grey, picture.shape[-1], axis=-1)
    for flag in flags:
        there = flag.share > 0
        opacity = 0.45 + 0.4 * flag.share[there][:, None]
        out[there] += opacity * (np.array(flag.color) - out[there])
    return np.rint(out).astype(np.uint8)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The font that comes with Pillow."""
    return ImageFont.load_default(size=size)


def _paste(sheet: Image.Image, pixels: Pixels, corner: tuple[int, int]) -> None:
    """Copy an array onto the sheet with its top left pixel at ``corner`` (x, y)."""
    sheet.paste(Image.fromarray(np.ascontiguousarray(pixels)), corner)


def _warning_lines(frame: SeparatedFrame, width: int) -> list[str]:
    """The warnings of a report, wrapped to a width in pixels."""
    wrapped = (textwrap.wrap(f"Warning: {text}", width // 8) for text in frame.report.get("warnings", ()))
    return [line for lines in wrapped for line in lines]


def _draw_header(sheet: Image.Image, frame: SeparatedFrame, warned: list[str]) -> None:
    """File, method and warnings above the panels."""
    draw = ImageDraw.Draw(sheet)
    named = "   ".join(str(frame.report[key]) for key in ("source", "method") if frame.report.get(key))
    draw.text((MARGIN, HEADER - 8), named, fill=TEXT, font=_font(20), anchor="ls")
    for k, line in enumerate(warned):
        draw.text((MARGIN, HEADER + k * LINE + LINE / 2), line, fill=WARNING, font=_font(15), anchor="lm")


def _draw_title(sheet: Image.Image, box: tuple[int, int, int], title: str, note: str) -> None:
    """Title at the left and note at the right above a panel; ``box`` is left, top, width."""
    draw, (left, top, width) = ImageDraw.Draw(sheet), box
    base = top + TITLE - 10
    draw.text((left, base), title, fill=TEXT, font=_font(20), anchor="ls")
    draw.text((left + width, base), note, fill=FAINT, font=_font(15), anchor="rs")


def _draw_dolp_legend(sheet: Image.Image, box: tuple[int, int, int]) -> None:
    """The scale bar of `dolp_map` with five ticks; ``box`` is left, top, width."""
    draw, (left, top, width) = ImageDraw.Draw(sheet), box
    bar = np.repeat(dolp_map(np.linspace(0, 1, width))[None], 18, axis=0)
    _paste(sheet, bar, (left, top))
    draw.rectangle((left, top, left + width - 1, top + 17), outline=FAINT)
    for k in range(5):
        x = left + round((width - 1) * k / 4)
        draw.line((x, top + 18, x, top + 23), fill=FAINT)
        draw.text((x, top + 28), f"{k / 4:g}", fill=TEXT, font=_font(15), anchor="lmmmr"[k] + "t")


def _draw_aolp_legend(sheet: Image.Image, corner: tuple[int, int]) -> None:
    """The wheel with its angles in degrees and a note beside it, from ``corner`` (x, y) right and down."""
    draw, size = ImageDraw.Draw(sheet), 96
    left, top = corner[0] + 36, corner[1] + 18
    _paste(sheet, aolp_legend(size), (left, top))
    x, y, reach = left + size / 2, top + size / 2, size / 2 + 5
    for angle, anchor in ((0, "lm"), (45, "lb"), (90, "mb"), (135, "rb")):
        at = (x + reach * np.cos(np.radians(angle)), y - reach * np.sin(np.radians(angle)))
        draw.text(at, f"{angle}°", fill=TEXT, font=_font(14), anchor=anchor)
    for text, offset in (("centre: DoLP 0", -24), ("rim: DoLP 1", 0), ("grey: at the noise", 24)):
        draw.text((left + size + 44, y + offset), text, fill=FAINT, font=_font(15), anchor="lm")


def _draw_flag_legend(sheet: Image.Image, corner: tuple[int, int], flags: list[Flag]) -> None:
    """A coloured square, a name and a share of the pixels per flag, from ``corner`` (x, y) down."""
    draw, (left, top) = ImageDraw.Draw(sheet), corner
    for k, flag in enumerate(reversed(flags)):
        y = top + 26 * k
        draw.rectangle((left, y + 1, left + 15, y + 16), fill=flag.color)
        text = f"{flag.name}: {_percent(flag.of_frame)}"
        draw.text((left + 26, y + 9), text, fill=TEXT, font=_font(15), anchor="lm")


def _percent(share: float) -> str:
    """A share in percent; a few pixels never read as none."""
    return "none" if share == 0 else f"{100 * share:.3g} %" if share >= 1e-4 else "below 0.01 %"


def titled_sheet(rows: Sequence[Sequence[Panel]]) -> Pixels:
    """Rows of titled pictures of one size on a dark sheet."""
    height, width = rows[0][0].pixels.shape[:2]
    columns = max(len(row) for row in rows)
    size = (MARGIN + columns * (width + GUTTER) - GUTTER + MARGIN, MARGIN + len(rows) * (TITLE + height + GUTTER))
    sheet = Image.new("RGB", size, BACKGROUND)
    for r, row in enumerate(rows):
        for c, panel in enumerate(row):
            left, top = MARGIN + c * (width + GUTTER), MARGIN + r * (TITLE + height + GUTTER) - GUTTER
            _draw_title(sheet, (left, top, width), panel.title, panel.note)
            _paste(sheet, panel.pixels, (left, top + TITLE))
    return np.asarray(sheet)
