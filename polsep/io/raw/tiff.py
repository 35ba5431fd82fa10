"""TIFF of any lossless compression: 8 to 16 bits (packed too) and floats, one picture or many.

tifffile tolerates much damage with a log message. Checks here refuse what would spoil measurements: a broken chain of
pictures, strips outside the file, and files in which zero is not dark. Orientation tags are not applied.
Source: Adobe, TIFF Revision 6.0; Adobe, Digital Negative Specification 1.7 (photometric 32803, 34892).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from polsep.compute.arrays import to_numpy
from polsep.io.raw.page import MergedFacts, Page
from polsep.io.raw.tiff_chunks import PICTURES, STREAMS, check_chunks
from polsep.io.raw.tiff_directories import check_entries, find_pictures, walk_directories
from polsep.io.store.atomic import replace_bytes
from polsep.io.store.errors import InputError, decoding
from polsep.io.store.header_checks import require_signature, require_size
from polsep.io.store.json_text import parse_json
from polsep.io.store.quiet import mute
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.plausible import require_falloff, require_gains

#: Format of the description of merged frames.
MERGED = "polsep merged mosaic 1"

#: Photometric interpretations in which larger means brighter and samples are the data themselves.
_PHOTOMETRIC = {1: "black is zero", 2: "RGB", 32803: "colour filter array", 34892: "linear raw"}

#: Compressions that change samples, or do not say whether they did.
_LOSSY = {6: "old JPEG", 7: "JPEG", 34892: "lossy JPEG", 50001: "WebP", 50002: "JPEG XL", 52546: "JPEG XL"}

#: Vendors' formats that tifffile would look for while it opens a file, in ways that no limit holds.
_UNWANTED: dict[str, Any] = {"is_lsm": False, "is_scanimage": False, "is_ndpi": False, "is_ome": False}

mute("tifffile", "imagecodecs")


def read_tiff(path: Path, first: int = 0) -> Iterator[Page]:
    """Every picture of a TIFF file in order, from ``first`` on: ``[H, W]`` or ``[H, W, C]``. Raises ValueError."""
    with path.open("rb") as stream:
        require_signature(stream, (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "a TIFF")
        size = path.stat().st_size
        places = walk_directories(stream, size)
        check_entries(stream, places[0], size)
        pictures = find_pictures(stream, places)
        stream.seek(0)
        with decoding("TIFF"):
            tif = tifffile.TiffFile(stream, **_UNWANTED)
        with tif:
            for index, number in enumerate(pictures[first:], first):
                check_entries(stream, places[number], size)
                with decoding("TIFF"):
                    directory = tif.pages[number]
                    assert isinstance(directory, tifffile.TiffPage)  # frames only come from TiffPages.useframes
                    _require_readable(directory, size)
                    check_chunks(stream, directory)
                    page = _read_page(directory, index, len(pictures))
                left = len(places) - len(pictures)
                note = f"{left} of {len(places)} TIFF pictures left out: thumbnails or masks of others"
                yield replace(page, notes=(*page.notes, note)) if left else page


def _read_page(page: tifffile.TiffPage, index: int, count: int) -> Page:
    """Samples of one directory, once it is checked."""
    if count == 1 and (pictures := _described_pictures(page)) > 1:
        raise InputError(f"expected one TIFF directory per picture, found one for {pictures} pictures")
    array = np.asarray(page.asarray())
    if page.planarconfig == 2 and array.ndim == 3:  # separate planes [C, H, W]
        if len(array) not in (1, 3):  # as tifffile writes four frames or angles, unless it is told otherwise
            pages = "frames and angles are pages of their own (tifffile: photometric='minisblack')"
            raise InputError(f"expected a picture of one plane, or of three, found one of {len(array)}: {pages}")
        array = np.moveaxis(array, 0, -1)
    bits = page.bitspersample
    white = 2.0**bits - 1 if array.dtype == np.uint16 and bits < 16 else None
    facts = _merged_facts(page)
    if facts is not None:
        return Page(array, index, count, 1.0, Layout.parse(facts["layout"]), merged=_as_merged(facts))
    orientation = page.tags.valueof(274, default=1)
    notes = () if orientation == 1 else (f"TIFF orientation {orientation} is not applied: pixels stay as stored",)
    return Page(array, index, count, white_level=white, notes=notes, exposure=_exposure_time(page))


def _described_pictures(page: tifffile.TiffPage) -> int:
    """The number of pictures that a file's only directory stands for, by descriptions of ImageJ and of tifffile.

    ImageJ writes one directory for stacks of more than 4 GB, tifffile where it is asked to.
    """
    text = page.description
    if text.startswith("ImageJ="):
        said = re.search(r"^images=(\d{1,9})", text, re.MULTILINE)
        return int(said[1]) if said else 1
    if not text.startswith('{"shape": '):
        return 1
    shape = parse_json(text).get("shape")
    whole = math.prod(side for side in shape if isinstance(side, int)) if isinstance(shape, list) else 1
    return whole // max(math.prod(page.shape), 1)


def _exposure_time(page: tifffile.TiffPage) -> float | None:
    """Exposure time in seconds, of the tag ExposureTime in the directory or in its EXIF; None without one."""
    exif = page.tags.valueof(34665)
    found = page.tags.valueof(33434) or (exif.get("ExposureTime") if isinstance(exif, dict) else None)
    if isinstance(found, tuple) and len(found) == 2 and found[1]:
        found = found[0] / found[1]
    return float(found) if isinstance(found, int | float) and 0 < found < math.inf else None


def _merged_facts(page: tifffile.TiffPage) -> dict[str, Any] | None:
    """The facts that `write_merged` put into the description; None in other files."""
    text = page.tags.valueof(270)
    if not isinstance(text, str) or not text.startswith('{"format": "' + MERGED):
        return None
    facts = parse_json(text)
    return facts if isinstance(facts, dict) else None


def _as_merged(facts: dict[str, Any]) -> MergedFacts:
    falloff = facts["falloff_legendre"]
    falloff = None if falloff is None else tuple(tuple(float(x) for x in row) for row in falloff)
    color = tuple(float(x) for x in facts["light_color"])
    if len(color) not in (1, 3):
        raise InputError(f"expected a light of one or three colours, found {len(color)}")
    require_gains("light colour", color)
    require_falloff(falloff)
    used = tuple(str(facts[name]) for name in ("calibration", "calibration_sha256") if name in facts)
    known = (used[0], used[1]) if len(used) == 2 else None
    return MergedFacts(color, falloff, facts.get("lamp_measured") is True, known)  # earlier files lack the last two


def write_merged(path: Path, mosaic: Mosaic, facts: Mapping[str, Any]) -> None:
    """Write a merged float mosaic, black 0 and white 1, atomically; ``facts``: more for people. Raises OSError."""
    text = {
        "format": MERGED,
        "layout": mosaic.layout.spec,
        "black_level": 0,
        "white_level": 1,
        "light_color": mosaic.light_color,
        "falloff_legendre": mosaic.falloff,
        "lamp_measured": mosaic.lamp_measured,
        **facts,
    }
    data, description, file = to_numpy(mosaic.data), json.dumps(text, allow_nan=False), BytesIO()
    tifffile.imwrite(file, data, photometric="minisblack", metadata=None, software="polsep", description=description)
    replace_bytes(path, file.getbuffer())  # NumPy, writing a file itself, names neither it nor a disk that is full


def _require_readable(page: tifffile.TiffPage, size: int) -> None:
    """Raise InputError unless a directory describes linear samples that all lie inside the file."""
    samples = page.samplesperpixel
    require_size((page.imagelength, page.imagewidth, *((samples,) if samples > 1 else ())))
    if page.imagedepth != 1:
        raise InputError(f"expected a TIFF of flat pictures, found depth {page.imagedepth}")
    if page.photometric not in _PHOTOMETRIC:
        raise InputError(f"expected gray samples with black at zero, found TIFF photometric {_name(page.photometric)}")
    if page.compression in _LOSSY:
        raise InputError(f"expected lossless samples, found TIFF compression {_LOSSY[int(page.compression)]}")
    if page.compression not in (*STREAMS, *PICTURES):
        raise InputError(f"expected a TIFF compression such as LZW or DEFLATE, found {_name(page.compression)}")
    if page.dtype is None or page.bitspersample < 8:
        bits, kind = page.bitspersample, page.sampleformat
        raise InputError(f"expected samples of 8 bits or more, found {bits} bits of sample format {kind}")
    strips = sum(1 for place in zip(page.dataoffsets, page.databytecounts, strict=False) if all(place))
    if strips < math.prod(page.chunked):
        raise InputError(f"expected {math.prod(page.chunked)} TIFF strips or tiles, found {strips}")
    end = max(offset + count for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True))
    if end > size:
        raise InputError(f"expected TIFF samples up to byte {end}, found a file of {size} bytes: it is truncated")


def _name(value: object) -> str:
    """``PALETTE`` of an enumeration member, else the number."""
    return str(getattr(value, "name", value))
