"""Raw camera dumps without a header.

A headerless file is a number of complete frames of one size and pixel format, one after the other. The caller names
both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.genicam import Codes, PixelFormat, find_pixel_format, unpack_frame
from polsep.io.raw.page import Page
from polsep.io.store.header_checks import require_size
from polsep.sensor.camera import PERIOD, Layout

#: Rows of a frame in which its packing is checked, about, and how many times rougher codes must be to be of the wrong
#: one: those are 6 times and more.
CHECKED_ROWS, ROUGHER = 64, 3.0


class AssumedLayout(str):
    """A note on a layout that was assumed, which says nothing where somebody says the layout."""


def with_layout(page: Page, layout: Layout | None) -> Page:
    """The page with a layout that somebody says, without notes on an assumed one."""
    return replace(page, layout=layout, notes=tuple(note for note in page.notes if not isinstance(note, AssumedLayout)))


def read_headerless(path: Path, size: tuple[int, int], pixel_format: str, first: int = 0) -> Iterator[Page]:
    """The frames of a dump of (width, height) pixels, from ``first`` on; of ONE angle image for LUCID's angles.

    Raises ValueError.
    """
    fmt = find_pixel_format(pixel_format)
    width, height = size
    require_size((fmt.planes, height, width) if fmt.planes > 1 else (height, width))
    frame = fmt.frame_bytes(width, height)
    total = path.stat().st_size
    if total == 0 or total % frame:
        kind = f"{width}x{height} {fmt.name}" + ("; the size of ONE angle image" if fmt.planes > 1 else "")
        found, whole = f"{total} bytes", total // frame
        if whole:
            more = f"{whole} frames and {total % frame} bytes"
            found += f", {more}: where the last one was cut short, head -c {whole * frame} takes the whole ones"
        raise ValueError(f"expected a whole number of frames of {frame} bytes ({kind}), found {found}")
    with path.open("rb") as stream:
        stream.seek(first * frame)
        for index in range(first, total // frame):
            yield headerless_page(stream.read(frame), size, pixel_format, index, total // frame)


def headerless_page(payload: bytes, size: tuple[int, int], pixel_format: str, index: int = 0, count: int = 1) -> Page:
    """One frame of (width, height) pixels from the bytes a camera sent.

    Raises ValueError as `genicam.unpack_frame` does.
    """
    fmt = find_pixel_format(pixel_format)
    codes = unpack_frame(payload, *size, pixel_format)
    return Page(
        codes,
        index,
        count,
        white_level=fmt.white_level if 8 < fmt.bits < 16 else None,  # 8 and 16 bits: that of the dtype
        layout=Layout(bayer=fmt.bayer),
        angles=fmt.planes > 1,
        sampled=fmt.planes > 1,
        notes=(*_mirror_notes(fmt), *_packing_notes(fmt, codes)),
    )


def _mirror_notes(fmt: PixelFormat) -> tuple[str, ...]:
    """Sony sensors read out as RGGB; another order may come from a mirrored frame, whose angles are mirrored too."""
    if fmt.bayer in (None, "RGGB"):
        return ()
    taken = f"{fmt.name}: analysers taken as 90,45,135,0 under {fmt.bayer}; a mirrored frame needs its layout said"
    return (AssumedLayout(taken),)


def _packing_notes(fmt: PixelFormat, codes: Codes) -> tuple[str, ...]:
    """A note on 12-bit codes that are smooth in the other packing, which has as many bytes and the same odd columns."""
    other = {"lsb": "12Packed", "gige": "12p"}.get(fmt.packing)
    if fmt.bits != 12 or other is None or fmt.planes > 1 or codes.shape[1] % 2 or codes.shape[1] < 4 * PERIOD:
        return ()
    rows = codes[:: max(1, len(codes) // CHECKED_ROWS)]
    even, odd = rows[:, ::2], rows[:, 1::2]
    turned = (even << 4 & 0xFFF | even >> 8) if fmt.packing == "lsb" else (even >> 4 | (even & 15) << 8)
    if _roughness(even) <= ROUGHER * max(_roughness(odd), _roughness(turned)):
        return ()
    return (f"every other column of {fmt.name} is noise that would be a picture in a format ending in {other}",)


def _roughness(columns: NDArray[Any]) -> float:
    """Mean difference of neighbours behind one filter, of every other column."""
    step = PERIOD // 2
    return float(np.abs(columns[:, step:].astype(np.int32) - columns[:, :-step]).mean())
