"""Raw frames from files of any supported kind, lazily, as `Mosaic` or `Measurements`.

`READERS` says which reader reads which file name extension. A new raw format is one module with a reader and one line
there. Besides, a path with ``{angle}`` in it names four angle images, and headerless dumps need a size and a pixel
format from the caller. The extension decides which format is expected, the content must agree.

Four angle images are co-sited `Measurements` when they are RGB, or gray without a colour layout;
LUCID's four planes, and gray ones under a colour layout, are samples of one mosaic and go back to it.

White levels: what the caller says, else what the file says (packed TIFF, PGM, pixel format), else that of the dtype;
layouts: what the caller says, else what the pixel format's name says, else Sony's colour order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType
from polsep.io.raw.extensions import ANGLES, LOSSLESS, PLACEHOLDER, template_files
from polsep.io.raw.headerless import headerless_page, read_headerless, with_layout
from polsep.io.raw.npy import read_npy, read_npz, stack_angles
from polsep.io.raw.page import MergedFacts, Page
from polsep.io.raw.pgm import read_pgm
from polsep.io.raw.png import read_png
from polsep.io.raw.recording import RECORD, read_recording
from polsep.io.raw.tiff import read_tiff
from polsep.io.raw.videos import read_video
from polsep.io.store.errors import as_path, input_error, naming, refuse_pipe
from polsep.io.store.header_checks import describe
from polsep.physics.stokes import Measurements
from polsep.sensor.ambient import exposure_notes
from polsep.sensor.camera import Capture, Layout, Mosaic
from polsep.sensor.corrections import Corrections
from polsep.sensor.levels import (
    WHITE_LEVELS,
    ForgottenLevel,
    as_mosaic,
    interleave_planes,
    planes_as_capture,
)


class Reader(NamedTuple):
    """A format: its ``name`` in messages, and ``read(path, first)``, which yields its pictures in order.

    ``first`` is the number of the first picture wanted; a reader may yield earlier ones too, which are dropped.
    ``single``: a file of one frame as a rule, so that a folder of such files is a sequence.
    """

    name: str
    read: Callable[[Path, int], Iterator[Page]]
    single: bool = True


#: The reader of each file name extension.
READERS: dict[str, Reader] = {
    ".png": Reader("PNG", read_png),
    ".tif": Reader("TIFF", read_tiff),
    ".tiff": Reader("TIFF", read_tiff),
    ".npy": Reader("NPY", read_npy),
    ".npz": Reader("NPZ", read_npz),
    ".pgm": Reader("PGM", read_pgm),
    **dict.fromkeys(LOSSLESS, Reader("a lossless video", read_video, single=False)),
    ".json": Reader("a recording.json", read_recording, single=False),
}
#: Extensions of files without a header.
HEADERLESS = (".raw", ".bin")
#: Extensions of files that a folder of frames may hold.
FRAME_FILES = (*(suffix for suffix, reader in READERS.items() if reader.single), *HEADERLESS)
_LOSSY = {".jpg": "JPEG", ".jpeg": "JPEG", ".webp": "WebP", ".heic": "HEIC", ".mp4": "video"}
#: Mean contradiction of four pages, relative to their mean differences, below which they are angle images.
MOST_CONTRADICTION = 0.25

#: Every supported format, for messages.
SUPPORTED = (
    ", ".join(dict.fromkeys(reader.name for reader in READERS.values()))
    + ", or headerless raw (.raw, .bin) with a size and pixel format"
)


#: Types of `ReadOptions`, and how messages name them.
_KINDS: dict[str, tuple[Any, str]] = {
    "layout": (Layout | None, "a Layout, text or None"),
    "black_level": (Real, "a number"),
    "white_level": (Real | None, "a number or None"),
    "pixel_format": (str | None, "a name or None"),
    "corrections": (Corrections | None, "Corrections or None"),
}


@dataclass(frozen=True)
class ReadOptions:
    """Facts that files may not contain. Levels are in the units of the samples; None: see the module.

    ``layout`` as text is read by `Layout.parse`. ``size`` (width, height) and ``pixel_format`` (a GenICam name)
    describe headerless raw. ``pages``: several pages of a file are separate "frames", or every four are the "angles" 0,
    45, 90, 135; "auto": angles if they are four RGB pages, or four grey ones that obey m0 + m90 = m45 + m135 as no four
    frames do. ``corrections``: made to every mosaic, by a calibration that also says the white level where nothing else
    does. Raises ValueError on anything else; of wrong types it is a `WrongType`.
    """

    layout: Layout | None = None
    black_level: float = 0.0
    white_level: float | None = None
    size: tuple[int, int] | None = None
    pixel_format: str | None = None
    pages: str = "auto"
    corrections: Corrections | None = None

    def __post_init__(self) -> None:
        if self.pages not in ("auto", "frames", "angles"):
            raise ValueError(f'expected pages "auto", "frames" or "angles", found {self.pages!r}')
        if isinstance(self.layout, str):
            object.__setattr__(self, "layout", Layout.parse(self.layout))
        self._require_types()
        if self.corrections is not None and self.corrections.calibration is not None:
            self.corrections.calibration.require_black_level(self.black_level, "--black-level")
        if self.size is not None:
            if len(self.size) != 2 or min(self.size) < 1:
                raise ValueError(f"expected a size of positive width and height, found {self.size}")
            object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))

    def _require_types(self) -> None:
        """Raise WrongType on a value of another type than that of its field."""
        for name, (kind, wanted) in _KINDS.items():
            if not isinstance(value := getattr(self, name), kind):
                raise WrongType(f"expected {name} as {wanted}, found {value!r:.40}")
        size = self.size
        if size is not None and not (isinstance(size, Sequence) and all(isinstance(n, Integral) for n in size)):
            raise WrongType(f"expected a size of width and height in whole pixels, found {size!r:.40}")

    def settings(self) -> dict[str, Any]:
        """The options as a report lists them."""
        listed = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "corrections"}
        listed |= {"layout": self.layout.spec if self.layout else None, "size": list(self.size) if self.size else None}
        return listed | dict(self.corrections.sources if self.corrections else {})


@dataclass(frozen=True)
class Frame:
    """One frame of a file: ``stem`` names its outputs, ``notes`` are one-line remarks for the user.

    It is number ``index`` of ``count`` (approximate where a video does not say). Where the file says them,
    ``exposure``: its time in seconds, and ``captured``: when it was taken, in ISO 8601. ``white_level``: in the units
    of the file, said or of its type. ``merged``: by `polsep merge`, so black is at 0.
    """

    stem: str
    data: Capture
    notes: tuple[str, ...]
    index: int = 0
    count: int = 1
    exposure: float | None = None
    captured: str | None = None
    white_level: float | None = None
    merged: bool = False

    def taken(self) -> dict[str, Any]:
        """Facts of the capture, for reports: those that the file says."""
        found = {"exposure_s": self.exposure, "captured": self.captured}
        return {name: value for name, value in found.items() if value is not None}


def read_frames(path: str | Path, options: ReadOptions | None = None, first: int = 0) -> Iterator[Frame]:
    """The frames of a file, or of the four files of a template with ``{angle}``, one page at a time, from ``first`` on.

    A single frame has the stem of the file; of several, frame k is ``stem_000k``, counted from 0. Nothing is opened
    before the first frame is asked for. Raises InputError, in one line that names the file, on whatever can't be
    read; frames before a damaged one have been yielded by then.
    """
    if not isinstance(options, ReadOptions | None):
        raise WrongType(f"expected ReadOptions, found {type(options).__name__}")
    path = as_path(path)
    options = ReadOptions() if options is None else options
    if PLACEHOLDER in str(path):
        pages: Iterator[Page] = iter([_read_template(str(path), options)])
    elif options.pages == "frames":
        pages = read_pages(path, options, first)
    elif options.pages == "angles":
        pages = _group_angles(path, options, first)
    else:
        pages = _look_for_angles(path, options, first)
    for page in pages:
        if page.index < first:
            continue
        with naming(path):
            data, notes = _convert(page, options)
        stem = output_stem(path)
        name = stem if page.count == 1 else f"{stem}_{page.index:04d}"
        taken = (page.exposure, page.captured, _white_level(page, options), page.merged is not None)
        yield Frame(name, data, page.notes + notes, page.index, page.count, *taken)


def read_pages(path: Path, options: ReadOptions | None = None, first: int = 0) -> Iterator[Page]:
    """The pictures of one file as codes, not yet light, by its extension. Raises InputError as `read_frames`.

    Readers that can skip pictures leave out those before ``first``.
    """
    options = ReadOptions() if options is None else options
    with naming(path):
        if path.is_dir():
            raise ValueError("expected a file, found a directory")
        refuse_pipe(path)
        suffix = path.suffix.lower()
        if suffix in READERS:
            described = options.size is not None or options.pixel_format is not None
            notes = ("the size and pixel format given are for headerless raw: the file's own header is used",)
            for page in READERS[suffix].read(path, first):
                yield replace(page, notes=page.notes + notes) if described else page
        elif suffix in HEADERLESS or (options.pixel_format is not None and suffix not in _LOSSY):
            for page in read_headerless(path, *_headerless_format(options), first):
                yield _noting_layout(page, options)
        elif suffix in _LOSSY:
            raise ValueError(f"expected {SUPPORTED}, found {_LOSSY[suffix]}: lossy compression and gamma spoil samples")
        else:
            with path.open("rb") as stream:
                found = describe(stream.read(64))
            raise ValueError(f"expected {SUPPORTED}, found extension {path.suffix!r} and {found}")


def forgets_level(frame: Frame) -> bool:
    """True if nobody said the white level of a frame of a file, and it is likely another than assumed."""
    return any(isinstance(note, ForgottenLevel) for note in frame.notes)


def refuse_forgotten(path: str | Path, frame: Frame) -> None:
    """Raise InputError on a frame of a file whose white level was likely forgotten, before anything is made of it."""
    note = next((note for note in frame.notes if isinstance(note, ForgottenLevel)), None)
    if note is not None:
        default = WHITE_LEVELS["float32" if note.startswith("float") else "uint16"]
        raise input_error(path, f"expected a white level, found that {note}, or --white-level {default:g} if not")


def decode_frame(payload: bytes, options: ReadOptions) -> tuple[Capture, tuple[str, ...]]:
    """One frame from the bytes a camera sent, and notes, exactly as `read_frames` reads it from a file of them.

    ``options`` say size and pixel format. Raises ValueError when they do not or the bytes do not fit them.
    """
    page = _noting_layout(headerless_page(payload, *_headerless_format(options)), options)
    data, notes = _convert(page, options)
    return data, page.notes + notes


def output_stem(path: str | Path) -> str:
    """File name without extension and placeholder: ``nir_{angle}.png`` gives ``nir``; a recording has its folder's."""
    if Path(path).name == RECORD:
        return Path(path).absolute().parent.name or "recording"
    stem = Path(path).stem
    return stem if PLACEHOLDER not in stem else stem.replace(PLACEHOLDER, "").strip("_-. ") or "angles"


def _convert(page: Page, options: ReadOptions) -> tuple[Capture, tuple[str, ...]]:
    """Codes to light, by the rules of the module, corrected; and notes."""
    options, remarks = (options, ()) if page.merged is None else _left_for(page.merged, options)
    data, notes = _to_light(page, options)
    if page.merged is not None and isinstance(data, Mosaic):
        color, falloff, measured, _ = page.merged
        data = replace(data, light_color=color, falloff=falloff, lamp_measured=measured)
    notes = remarks + notes
    if options.corrections is None:
        return data, notes
    if isinstance(data, Measurements):
        raise ValueError("expected a raw mosaic to calibrate or to subtract room light from, found four angle images")
    data, more = options.corrections.apply_noting(data)
    return data, notes + more + exposure_notes(page.exposure, options.corrections.ambient_exposure_s)


def _left_for(merged: MergedFacts, options: ReadOptions) -> tuple[ReadOptions, tuple[str, ...]]:
    """Options for a frame of `polsep merge`, which has levels and is calibrated; and notes. Raises ValueError."""
    notes = list[str]()
    if options.black_level != 0 or options.white_level not in (1, None):
        notes.append("levels stated are those of raw frames: a frame of 'polsep merge' has black 0 and white 1")
        options = replace(options, black_level=0.0, white_level=1.0)
    corrections = options.corrections
    if corrections is None or corrections.calibration is None:
        return options, tuple(notes)
    if merged.calibration is None:
        raise ValueError("expected --calibration with 'polsep merge', found it with a frame that was merged without")
    name, digest = merged.calibration
    if corrections.sources.get("calibration_sha256") != digest:
        raise ValueError(f"expected {name}, by which the merged frame is calibrated already, found another calibration")
    notes.append(f"the merged frame is calibrated by {name} already: this is not done again")
    return replace(options, corrections=replace(corrections, calibration=None)), tuple(notes)


def _to_light(page: Page, options: ReadOptions) -> tuple[Capture, tuple[str, ...]]:
    layout = page.layout if options.layout is None else options.layout
    white, array, black = _said_white_level(page, options), page.array, options.black_level
    if options.corrections is not None and options.corrections.calibration is not None:
        black = options.corrections.calibration.black_level_of(array, black, white)
    if not page.angles:
        return as_mosaic(array, layout, black, white)
    if array.ndim == 4 and array.shape[-1] == 1:
        array = array[..., 0]
    if page.sampled and layout is not None:
        return as_mosaic(interleave_planes(array, layout), layout, black, white)
    return planes_as_capture(array, layout, black, white)


def _said_white_level(page: Page, options: ReadOptions) -> float | None:
    """The white level that the user says, or the file, or a calibration; None where nobody does."""
    white = page.white_level if options.white_level is None or page.merged is not None else options.white_level
    if white is None and options.corrections is not None and options.corrections.calibration is not None:
        return options.corrections.calibration.white_level_of(page.array)
    return white


def _white_level(page: Page, options: ReadOptions) -> float | None:
    """`_said_white_level`, else that of the samples' type."""
    white = _said_white_level(page, options)
    return WHITE_LEVELS.get(page.array.dtype.name) if white is None else white


def _headerless_format(options: ReadOptions) -> tuple[tuple[int, int], str]:
    """Size and pixel format of headerless raw. Raises ValueError where the caller did not give both."""
    if options.size is not None and options.pixel_format is not None:
        return options.size, options.pixel_format
    found = "only the size" if options.size else "only the pixel format" if options.pixel_format else "neither"
    raise ValueError(
        f"expected the size and pixel format of headerless raw, such as 2448x2048 and BayerRG12p, found {found}"
    )


def _noting_layout(page: Page, options: ReadOptions) -> Page:
    """A page of a named pixel format, with a note where the caller's layout has other colours than the name."""
    given, named = options.layout, page.layout
    if given is None or named is None:
        return page
    page = with_layout(page, named)
    if given.bayer == named.bayer:
        return page
    note = f"layout {given.spec} is used although {options.pixel_format} says {named.bayer or 'mono'}"
    return replace(page, notes=(note, *page.notes))


def _group_angles(path: Path, options: ReadOptions, first: int) -> Iterator[Page]:
    """Every four pages of a file as one page of angles; pages that are angles already pass."""
    group: list[Page] = []
    for page in read_pages(path, options, 4 * first):
        if page.angles:
            yield from read_pages(path, options, first)
            return
        if page.index < 4 * first:
            continue
        if page.count % 4:
            raise input_error(path, f"expected four pages for the angles 0, 45, 90, 135, found {page.count}")
        group.append(page)
        if len(group) == 4:
            with naming(path):
                yield _stacked(group, [f"page {p.index}" for p in group])
            group = []


def _look_for_angles(path: Path, options: ReadOptions, first: int) -> Iterator[Page]:
    """The pages of a file, or its only four as one page of angles where they look like that."""
    pages = read_pages(path, options, first)
    start = next(pages, None)
    if start is None:
        return
    if start.count != 4 or start.index or start.angles:
        yield start
        yield from pages
        return
    group = [start]
    try:
        for page in islice(pages, 3):
            group.append(page)
    except (ValueError, OSError):  # those before a damaged page are frames
        yield from group
        raise
    if len(group) == 4 and _are_angles([page.array for page in group]):
        note = "its four pages are read as the angles 0, 45, 90, 135: say --pages frames if they are frames"
        page = _stacked(group, [f"page {p.index}" for p in group])
        yield replace(page, notes=(*page.notes, note))
        return
    yield from group
    yield from pages


def _are_angles(images: list[NDArray[Any]]) -> bool:
    """True if four images are RGB, so not mosaics, or contradict m0 + m90 = m45 + m135 by far less than they differ.

    Frames with noise differ 1.4 times as much as they contradict, those under a light that changes evenly twice.
    """
    if len({(image.shape, image.dtype.name) for image in images}) != 1:
        return False
    first = images[0]
    if first.ndim == 3 and first.shape[-1] == 3:
        return not bool((first == first[..., :1]).all())
    height, width = (n // 4 * 4 for n in first.shape[:2])
    if min(height, width) < 16:
        return False
    m0, m45, m90, m135 = (
        image[:height, :width].reshape(height // 4, 4, width // 4, -1).mean((1, 3)) for image in images
    )
    differ = float(np.abs(m0 - m90).mean() + np.abs(m45 - m135).mean())
    return float(np.abs(m0 + m90 - m45 - m135).mean()) < MOST_CONTRADICTION * differ


def _read_template(template: str, options: ReadOptions) -> Page:
    """The four images of a path with ``{angle}`` as one page of angles."""
    group: list[Page] = []
    for path in template_files(template):
        page = next(read_pages(path, options))
        if page.count != 1 or page.angles:
            raise input_error(path, f"expected one image of one angle, found {4 if page.angles else page.count}")
        group.append(page)
    with naming(template):
        return _stacked(group, [f"{angle} deg" for angle in ANGLES])


def _stacked(group: list[Page], names: list[str]) -> Page:
    """Four pages as one of angles; ValueError when they differ in size, type or white level."""
    levels = {page.white_level for page in group}
    if len(levels) != 1:
        raise ValueError(f"expected angle images of one bit depth, found white levels {sorted(map(str, levels))}")
    array = stack_angles({name: page.array for name, page in zip(names, group, strict=True)})
    notes = tuple(dict.fromkeys(note for page in group for note in page.notes))
    first = group[0]
    count = max(first.count // 4, 1)
    return Page(array, first.index // 4, count, first.white_level, first.layout, angles=True, notes=notes)
