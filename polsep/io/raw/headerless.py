"""Raw camera dumps without a header.

A headerless file is a number of complete frames of one size and pixel format, one after the other. The caller names
both.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from polsep.io.raw.genicam import PixelFormat, find_pixel_format, unpack_frame
from polsep.io.raw.page import Page
from polsep.io.store.header_checks import require_size
from polsep.sensor.camera import Layout


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
        raise ValueError(f"expected a whole number of frames of {frame} bytes ({kind}), found {total} bytes")
    with path.open("rb") as stream:
        stream.seek(first * frame)
        for index in range(first, total // frame):
            yield headerless_page(stream.read(frame), size, pixel_format, index, total // frame)


def headerless_page(payload: bytes, size: tuple[int, int], pixel_format: str, index: int = 0, count: int = 1) -> Page:
    """One frame of (width, height) pixels from the bytes a camera sent.

    Raises ValueError as `genicam.unpack_frame` does.
    """
    fmt = find_pixel_format(pixel_format)
    return Page(
        unpack_frame(payload, *size, pixel_format),
        index,
        count,
        white_level=fmt.white_level if 8 < fmt.bits < 16 else None,  # 8 and 16 bits: that of the dtype
        layout=Layout(bayer=fmt.bayer),
        angles=fmt.planes > 1,
        sampled=fmt.planes > 1,
        notes=_mirror_notes(fmt),
    )


def _mirror_notes(fmt: PixelFormat) -> tuple[str, ...]:
    """Sony sensors read out as RGGB; another order may come from a mirrored frame, whose angles are mirrored too."""
    if fmt.bayer in (None, "RGGB"):
        return ()
    return (f"{fmt.name}: analysers taken as 90,45,135,0 under {fmt.bayer}; a mirrored frame needs its layout said",)
