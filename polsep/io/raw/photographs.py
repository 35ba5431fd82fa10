"""Photographs of an ordinary camera: camera raw (rawpy), TIFF, PNG and the like, JPEG, and films (PyAV).

All are read as codes ``[K, H, W]`` or ``[K, H, W, 3]`` of one type. Camera raw comes demosaicked (AHD, by LibRaw) in
the camera's own colours, without white balance, curve or turning: black 0 and white 1; unless it is ``full``, with the
mean of each 2x2 pixels, as all colours are measured there. What a clipped sample contributed to is white at least.
JPEG, and films that are not lossless RGB or grey, have a curve, so they are read only as ``encoded`` ones.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from polsep.compute.filters import box_mean
from polsep.compute.resizing import halve
from polsep.io.raw.extensions import CAMERA_RAW, FILMS, JPEG
from polsep.io.raw.frames import read_pages
from polsep.io.raw.npy import stack_angles
from polsep.io.raw.page import Page
from polsep.io.raw.videos import load_library
from polsep.io.store.errors import InputError, decoding, input_error, naming, refuse_repeated
from polsep.io.store.header_checks import SAMPLES, limit, require_signature, require_size

#: The EXIF tag of a picture's orientation, and the note on one that is not upright: angles count in the stored pixels.
ORIENTATION = 0x0112
TURNED = "the camera was turned: its orientation is not applied, pixels stay as stored"
#: Most frames of a film that are used, evenly spaced: more of them add little and fill the memory.
MOST_FRAMES = 24
#: Reach of LibRaw's interpolation in pixels, within which a clipped sample counts.
REACH = 2
#: Year of a camera's clock that was never set: seconds count from its beginning.
UNKNOWN_YEAR = 1970
#: Channel of LibRaw's colour numbers: 3 is the second green.
_CHANNEL = np.array([0, 1, 2, 1])


@dataclass(frozen=True)
class Photographs:
    """K photographs as codes ``[K, H, W]`` or ``[K, H, W, 3]``, and ``names`` of them for messages.

    ``white_level``: what the files themselves say, else None. ``exposures``: how much light each one let in, up to a
    factor (time, sensitivity and aperture), where all say it. Of the first one, where it says them, ``exposure``: its
    time in seconds, and ``captured``: when it was taken, in ISO 8601.
    """

    array: NDArray[Any]
    names: tuple[str, ...]
    white_level: float | None = None
    exposures: tuple[float, ...] | None = None
    notes: tuple[str, ...] = ()
    exposure: float | None = None
    captured: str | None = None


def read_photographs(paths: Sequence[Path], encoded: bool = False, full: bool = False) -> Photographs:
    """The photographs of K files, or of one film or file of several pages; see the module.

    Raises InputError on whatever can't be read, on a file that is named twice, and on photographs of different sizes,
    types or white levels.
    """
    pages: list[tuple[str, Page]] = []
    refuse_repeated(paths, "a photograph of each angle of the filter")
    for path in paths:
        with naming(path):
            found = _read_pages(path, encoded, full)
        if len(paths) > 1 and len(found) > 1:
            raise input_error(path, f"expected one photograph per file, found {len(found)}")
        pages += [(path.name if len(found) == 1 else f"{path.name} {page.index}", page) for page in found]
    names = tuple(name for name, _ in pages)
    levels = {page.white_level for _, page in pages}
    if len(paths) > 1:
        _refuse_copies(paths, [page.array for _, page in pages])
    if len(levels) != 1:
        raise ValueError(f"expected photographs of one bit depth, found white levels {sorted(map(str, levels))}")
    array = stack_angles({f"{k}: {name}": page.array for k, (name, page) in enumerate(pages)}, "photographs")
    said, first = tuple(page.let_in for _, page in pages if page.let_in is not None), pages[0][1]
    notes = tuple(dict.fromkeys(note for _, page in pages for note in page.notes))
    exposures = said if len(said) == len(pages) else None
    return Photographs(array, names, levels.pop(), exposures, notes, first.exposure, first.captured)


def _refuse_copies(paths: Sequence[Path], arrays: Sequence[NDArray[Any]]) -> None:
    """Raise InputError on two files of the same samples, which no two photographs have: their noise differs."""
    for k, path in enumerate(paths):
        for other in range(k):
            if np.array_equal(arrays[other], arrays[k]):
                raise input_error(
                    path, f"expected a photograph of each angle of the filter, found that of {paths[other]} again"
                )


def _read_pages(path: Path, encoded: bool, full: bool) -> list[Page]:
    suffix = path.suffix.lower()
    if suffix in CAMERA_RAW:
        if encoded:
            raise ValueError("expected --encoding linear for camera raw, found srgb")
        return [_read_camera_raw(path, full)]
    if suffix in FILMS:
        return _read_film(path, encoded)
    if suffix in JPEG:
        if not encoded:
            raise ValueError("expected linear photographs, or --encoding srgb for JPEG, found JPEG")
        return [_read_jpeg(path)]
    pages = [page for page in read_pages(path) if not page.sampled]
    if any(page.angles for page in pages):
        return [Page(array, k, 4, page.white_level) for page in pages for k, array in enumerate(page.array)]
    return pages


def _read_jpeg(path: Path) -> Page:
    with path.open("rb") as stream:
        require_signature(stream, (b"\xff\xd8\xff",), "a JPEG")
        data = stream.read()
    _require_end(data)
    with decoding("JPEG"):
        array = np.asarray(imagecodecs.jpeg_decode(data))
    require_size(array.shape)
    unwarned = warnings.catch_warnings(action="ignore")  # of large pictures, which have a limit of their own
    with decoding("JPEG"), unwarned, Image.open(BytesIO(data), formats=["JPEG"]) as picture:
        turned = orientation_of(picture) != 1
    curve = "JPEG has the camera's own curve, which --encoding srgb only resembles: use camera raw"
    return Page(array, notes=(curve, TURNED) if turned else (curve,))


def orientation_of(picture: Image.Image) -> int:
    """The EXIF orientation of a picture; upright, 1, where its EXIF data are damaged."""
    with suppress(Exception):  # no reader of EXIF says all that it raises
        return int(picture.getexif().get(ORIENTATION, 1))
    return 1


def _require_end(data: bytes) -> None:
    """Raise InputError on a JPEG without its end marker, whose missing part decoders fill with grey.

    Source: ITU-T T.81, B.1.1: segments have lengths; behind those of scans, 0xFF comes with 0 or a restart marker.
    """
    place = data.find(b"\xff", 2)
    while 0 <= place < len(data) - 1:
        code = data[place + 1]
        if code == 0xD9:
            return
        alone = code in (0, 1) or 0xD0 <= code <= 0xD7
        step = 1 if code == 0xFF else 2 if alone else 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        place = data.find(b"\xff", place + step)
    raise InputError(f"expected a JPEG up to its end marker, found its end at byte {len(data)}: it is truncated")


def _read_camera_raw(path: Path, full: bool) -> Page:
    import rawpy

    path.open("rb").close()  # a missing file is reported as such, not as damage
    with decoding("camera raw"), rawpy.imread(str(path)) as raw:
        require_size((raw.sizes.height, raw.sizes.width))
        turned = raw.sizes.flip  # what comes next sets it to 0
        image = raw.postprocess(
            gamma=(1, 1),
            no_auto_bright=True,
            output_bps=16,
            output_color=rawpy.ColorSpace.raw,
            user_wb=[1.0, 1.0, 1.0, 1.0],
            adjust_maximum_thr=0.0,
            user_flip=0,
        )
        samples, facts = raw.raw_image_visible, _capture_facts(raw.other)
        clipped = samples >= raw.white_level
        channels = _CHANNEL[raw.raw_colors_visible] if samples.ndim == 2 else None
    planes = np.moveaxis(image.astype(np.float32) / 65535, -1, 0)
    if channels is not None and clipped.any():  # else LibRaw interpolates nothing
        for channel, plane in enumerate(planes):
            near = box_mean((clipped & (channels == channel)).astype(np.float32), REACH) > 0
            plane[near[: plane.shape[0], : plane.shape[1]]] = 1
    if not full:
        height, width = (n // 2 * 2 for n in planes.shape[1:])
        whole = planes[:, :height, :width]
        planes = np.where(halve((whole >= 1).astype(np.float32)) > 0, 1, halve(whole)).astype(np.float32)
    notes = (TURNED,) if turned else ()
    return Page(np.ascontiguousarray(np.moveaxis(planes, 0, -1)), white_level=1.0, notes=notes, **facts)


def _capture_facts(facts: Any) -> dict[str, Any]:
    """Fields of a `Page` that camera raw says.

    Light let in is time times sensitivity over the square of the f-number (1 where a lens tells none). The camera's
    clock has no time zone: it is taken for this machine's, as LibRaw does.
    """
    time, iso, stop = float(facts.shutter_speed), float(facts.iso_speed), float(facts.aperture)
    found: dict[str, Any] = {}
    if time > 0:
        found |= {"exposure": time, "let_in": time * (iso or 1) / (stop or 1) ** 2}
    if facts.timestamp.year > UNKNOWN_YEAR:
        found["captured"] = facts.timestamp.astimezone().isoformat()
    return found


def _read_film(path: Path, encoded: bool) -> list[Page]:
    """At most `MOST_FRAMES` frames of a film, evenly spaced over it."""
    path.open("rb").close()
    av = load_library()
    with decoding("film"):
        with av.open(f"file:{path}", options={"max_pixels": str(limit(SAMPLES))}) as container:
            number = sum(packet.size > 0 for packet in container.demux(video=0))
        wanted = set(np.unique(np.linspace(0, number - 1, min(number, MOST_FRAMES)).round().astype(int)).tolist())
        pages: list[Page] = []
        with av.open(f"file:{path}", options={"max_pixels": str(limit(SAMPLES))}) as container:
            stream = container.streams.video[0]
            context = stream.codec_context
            codec, pixels = context.codec, str(context.pix_fmt)
            exact = codec.lossless and not codec.lossy and pixels.startswith(("gray", "gbr", "rgb", "bgr"))
            if not (exact or encoded):
                kind = f"{context.pix_fmt} of {context.name}"
                raise InputError(f"expected lossless RGB or grey, or --encoding srgb for other films, found {kind}")
            for index, frame in enumerate(islice(container.decode(stream), number)):
                if index in wanted:
                    pages.append(Page(_as_codes(frame), len(pages), len(wanted)))
    return pages


def _as_codes(frame: Any) -> NDArray[Any]:
    """A film's frame as uint8, or uint16 scaled to 65535: grey or RGB."""
    deep = frame.format.components[0].bits > 8
    grey = len(frame.format.components) == 1
    kind = ("gray16le" if grey else "rgb48le") if deep else ("gray" if grey else "rgb24")
    return np.asarray(frame.to_ndarray(format=kind))
