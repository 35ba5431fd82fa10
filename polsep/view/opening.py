"""Opening of files on a page: raw frames, results, and sequences of either.

A sequence is one file of several frames, or several files of one frame each. Four files whose names differ by 0, 45,
90 and 135 are one frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.extensions import ANGLES, PLACEHOLDER, template_files
from polsep.io.raw.frames import FRAME_FILES, HEADERLESS, Frame, ReadOptions, output_stem, read_frames
from polsep.io.raw.recording import RECORD, is_recording
from polsep.io.raw.sequences import natural_order
from polsep.io.raw.videos import count_frames, is_lossless_film
from polsep.io.results.separation_reader import find_numbered, is_separated, read_separated
from polsep.io.results.sidecars import read_report
from polsep.io.store.errors import InputError, input_error
from polsep.io.store.header_checks import at_most
from polsep.io.store.result_names import result_names
from polsep.light.light_color import LightColor, color_notes, is_to_be_found, parse_light_color, stated_gains
from polsep.methods import check_method
from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.exposure import Histogram, exposure_flags, histogram
from polsep.separation.report import SeparatedFrame
from polsep.view.pictures import Pixels, Small, shrink_frame

if TYPE_CHECKING:
    from collections.abc import Iterator

#: Largest number of samples of a frame: four times a 16-megapixel sensor.
MAX_SAMPLES = 2**26
#: The value of unset fields: the file, or the type of its samples, decides.
UNSAID = "from file"
#: Resolutions: a pixel per cell of 2x2 samples, or per sample.
HALF, FULL = "half", "full"
#: What a remark advises: the command's option, the page's name of it, and the setting.
OPTIONS = {
    "white-level": ("White level", "white"),
    "black-level": ("Black level", "black"),
    "layout": ("Filter layout", "layout"),
    "light-color": ("Light colour", "light"),
}
_ADVICE = re.compile(rf"--({'|'.join(OPTIONS)}) (?!N\b)([\w][^\s;:)]*)")
#: Remark on results of `polsep video` and `polsep edit`.
LIGHT_ALONE = "the file holds diffuse and specular alone: DoLP and AoLP are shown as 0, and every pixel as valid"
_ANGLE = re.compile(r"(?<!\d)(?:0{1,3}|0?45|0?90|135)(?!\d)")


@dataclass(frozen=True)
class Settings:
    """Settings of reading and separating, as in `ReadOptions` and `pipeline.separate`, and the frame's ``index``.

    ``full``: at full resolution, where the frame is a mosaic.
    """

    read: ReadOptions = field(default_factory=ReadOptions)
    method: str = "auto"
    light_color: LightColor | str = "auto"
    index: int = 0
    full: bool = False

    @property
    def maker(self) -> str:
        """Method and resolution in words."""
        return f"{self.method}, {FULL if self.full else HALF}"


def parse_settings(said: Mapping[str, Any]) -> Settings:
    """Settings from the fields of the page: layout, black, white, light, method, resolution, size, pixel_format, index.

    ``calibration`` and ``ambient`` are paths that only the command line gives.

    Raises ValueError, in one line, on values without meaning.
    """
    method = str(said.get("method") or "auto")
    check_method(method)
    layout = _text(said.get("layout"))
    read = ReadOptions(
        None if layout is None else Layout.parse(layout),
        _number(said.get("black"), "black level") or 0.0,
        _number(said.get("white"), "white level"),
        _size(_text(said.get("size"))),
        _text(said.get("pixel_format")),
    )
    read = with_corrections(read, said.get("calibration"), said.get("ambient") or ())
    light = parse_light_color(_text(said.get("light")) or "auto")
    return Settings(read, method, light, int(said.get("index") or 0), said.get("resolution") == FULL)


def parse_against(text: object, settings: Settings) -> Settings | None:
    """The settings of a comparison ``METHOD, half`` or ``METHOD, full``; None where it names none."""
    method, comma, resolution = str(text or "").partition(", ")
    if not comma:
        return None
    check_method(method)
    return replace(settings, method=method, full=resolution == FULL)


def _text(value: object) -> str | None:
    text = "" if value is None else str(value).strip()
    return None if text in ("", UNSAID) else text


def _number(value: object, name: str) -> float | None:
    text = _text(value)
    try:
        return None if text is None else float(text)
    except ValueError:
        raise ValueError(f"expected a number as {name}, found {text!r:.40}") from None


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,6})\s*[x×]\s*(\d{1,6})", text.lower())
    if found is None:
        raise ValueError(f"expected a size like 2448x2048, found {text!r:.40}")
    return int(found[1]), int(found[2])


@dataclass(frozen=True)
class Source:
    """One file: its path, its name without extension for display, and whether it holds a separated frame."""

    path: Path
    stem: str
    separated: bool


def as_source(path: Path, stem: str) -> Source:
    """A file, or a template of four angle images, as a source with a display name."""
    return Source(path, stem, PLACEHOLDER not in path.name and is_separated(path))


def find_sources(path: Path) -> tuple[Source, ...]:
    """The user's own file, four of a template with ``{angle}``, or a folder: frames as `polsep video` writes them, or
    raw ones. Raises InputError.
    """
    path = path / RECORD if is_recording(path) else path
    if not path.is_dir():
        return (as_source(path, output_stem(path)),)
    try:
        return tuple(as_source(file, file.stem) for file in find_numbered(path).files if file is not None)
    except InputError:
        seen = [file for file in path.iterdir() if not file.name.startswith(".")]
        results = {name for file in seen if file.suffix.lower() == ".json" for name in result_names(file)}
        frames = (f for f in seen if f.suffix.lower() in FRAME_FILES)
        plain = (f for f in frames if f.name not in results or as_source(f, f.stem).separated)
        files = sorted(plain, key=natural_order)
        if not files and not any(file.suffix.lower() == ".exr" for file in seen):
            raise input_error(path, "expected raw frames or results of polsep in the folder, found none") from None
        if not files:
            raise
        groups = group_angles([file.name for file in files])
        if groups is None or not all(file.is_file() for name in groups for file in template_files(path / name)):
            return tuple(as_source(file, file.stem) for file in files)
        return tuple(as_source(path / template, output_stem(template)) for template in groups)


def require_first(sources: tuple[Source, ...], read: ReadOptions) -> None:
    """Raise InputError, in one line, where the first frame cannot be read, and no setting of the page would change
    that: of headerless raw, size and pixel format may be said there.
    """
    if sources[0].path.suffix.lower() not in HEADERLESS or None not in (read.size, read.pixel_format):
        read_source(sources, read, 0)


def group_angles(names: Sequence[str]) -> dict[str, tuple[int, ...]] | None:
    """Frames of four angle images: the places of 0, 45, 90 and 135 degrees in ``names``, by template.

    None unless all names belong to one: frames of a sequence may have such numbers too.
    """
    found: dict[str, dict[int, int]] = {}
    for place, name in enumerate(names):
        for match in _ANGLE.finditer(name):
            template = name[: match.start()] + PLACEHOLDER + name[match.end() :]
            found.setdefault(template, {})[int(match[0])] = place
    whole = {t: tuple(places[a] for a in ANGLES) for t, places in found.items() if set(places) == set(ANGLES)}
    used = sorted(place for places in whole.values() for place in places)
    return whole if used == list(range(len(names))) else None


class Mend(NamedTuple):
    """Advice of a remark: a setting, its value, and words for a button."""

    setting: str
    value: str
    words: str


@dataclass(frozen=True)
class OpenedFrame:
    """One separated frame and its display data. ``mosaic`` and ``histogram`` are None without a raw frame.

    It is number ``index`` of ``count``; ``remarks`` are lines for the user; ``seconds``: time of reading and
    separating; ``flags``: `exposure_flags` at the frame's resolution; ``advice``: the remarks in the command's words.
    """

    frame: SeparatedFrame
    small: Small
    mosaic: Mosaic | None
    histogram: Histogram | None
    remarks: tuple[str, ...]
    stem: str
    index: int = 0
    count: int = 1
    seconds: float = 0.0
    flags: Pixels | None = None
    advice: tuple[str, ...] = ()

    def mends(self) -> tuple[Mend, ...]:
        """The settings that remarks advise, each once."""
        found = [(OPTIONS[name], value) for remark in self.advice for name, value in _ADVICE.findall(remark)]
        return tuple(
            dict.fromkeys(Mend(setting, value, f"Use {words.lower()} {value}") for (words, setting), value in found)
        )


def is_result(sources: tuple[Source, ...], index: int) -> bool:
    """True if frame number ``index`` of a sequence was separated before: no method makes another of it."""
    return _source(sources, index).separated


def _source(sources: tuple[Source, ...], index: int) -> Source:
    return sources[min(index, len(sources) - 1)]


def read_source(sources: tuple[Source, ...], read: ReadOptions, index: int) -> Frame | SeparatedFrame:
    """Read frame number ``index`` of a sequence. Raises InputError, in one line that names the file."""
    several = len(sources) > 1
    source = _source(sources, index)
    with at_most(MAX_SAMPLES), _renamed(source):
        if source.separated:
            separated = read_separated(source.path)
            return replace(separated, report=separated.report | read_report(source.path))
        frame = next(read_frames(source.path, read, 0 if several else index), None)
        if frame is None:
            raise ValueError(f"{source.path}: expected a frame number {index}, found none")
        if several and frame.count > 1:
            raise ValueError(f"{source.path}: expected one frame in each of several files, found {frame.count}")
        if frame.count > 1 and not several and is_lossless_film(source.path):
            frame = replace(frame, count=count_frames(source.path, frame.count, index))
    return replace(frame, index=index, count=len(sources)) if several else frame


def open_frame(sources: tuple[Source, ...], settings: Settings, read: Frame | SeparatedFrame) -> OpenedFrame:
    """Display data of a frame that was read: separated with the settings, or as it is."""
    stem = _source(sources, settings.index).stem
    if isinstance(read, SeparatedFrame):
        frame = _as_opened(read, settings.light_color, stem)
        remarks = tuple(frame.report["warnings"])
        return OpenedFrame(frame, shrink_frame(frame), None, None, remarks, stem, settings.index, len(sources))
    frame = separate_capture(read.data, settings.method, settings.light_color, full=settings.full)
    frame.report["source"] = stem
    advice = (*read.notes, *frame.report["warnings"])
    frame.report["warnings"] = list(advice)
    remarks = tuple(re.sub(rf"--({'|'.join(OPTIONS)})", lambda found: OPTIONS[found[1]][0], text) for text in advice)
    mosaic = _as_separated(read.data, frame.capture)
    flags = None if mosaic is None else _flags(mosaic, frame.valid.shape)
    counted = None if mosaic is None else histogram(mosaic)
    stem = stem if len(sources) > 1 or read.count == 1 else f"{stem}_{read.index:04d}"
    small, place = shrink_frame(frame, flags), (read.index, read.count)
    return OpenedFrame(frame, small, mosaic, counted, remarks, stem, *place, flags=flags, advice=advice)


def _as_opened(read: SeparatedFrame, light_color: LightColor | str, stem: str) -> SeparatedFrame:
    """A result under the user's name for it, of the lamp's colour that the page says, and remarks on what it lacks."""
    report = read.report | {"source": stem, "warnings": list(read.report.get("warnings", ()))}
    if not is_to_be_found(light_color):
        color = stated_gains(light_color, read.diffuse.shape[-1])
        report |= {"light_color": color, "light": {"source": "stated", "color": color}}
        report["warnings"] += color_notes(light_color, len(color))
    if not read.dolp.any():
        report["warnings"].append(LIGHT_ALONE)
    return replace(read, report=report)


def _as_separated(read: object, capture: object) -> Mosaic | None:
    """A raw frame as it was read, with the black level that was separated; None for other captures."""
    if not isinstance(read, Mosaic) or not isinstance(capture, Mosaic):
        return None
    return read if read.black_level == capture.black_level else replace(read, black_level=capture.black_level)


def _flags(mosaic: Mosaic, shape: tuple[int, ...]) -> Pixels:
    """`exposure_flags` for a separated frame of a shape: of its cells, or of the samples in them."""
    cells = exposure_flags(mosaic)
    if cells.shape == shape:
        return cells
    (top, left), (height, width) = mosaic.layout.origin, cells.shape
    flags = np.zeros(shape, np.uint8)
    flags[top : top + 2 * height, left : left + 2 * width] = cells.repeat(2, axis=0).repeat(2, axis=1)
    return flags


def open_small(sources: tuple[Source, ...], settings: Settings) -> Small:
    """A frame at screen size only."""
    read = read_source(sources, settings.read, settings.index)
    if isinstance(read, SeparatedFrame):
        return shrink_frame(read)
    frame = separate_capture(read.data, settings.method, settings.light_color, full=settings.full)
    mosaic = _as_separated(read.data, frame.capture)
    return shrink_frame(frame, None if mosaic is None else _flags(mosaic, frame.valid.shape))


@contextmanager
def _renamed(source: Source) -> Iterator[None]:
    """Replace the path of the stored file by the user's file name in ValueErrors inside."""
    try:
        yield
    except ValueError as error:
        said = str(error).replace(str(source.path), source.stem + source.path.suffix)
        if PLACEHOLDER in source.path.name:
            for path, angle in zip(template_files(source.path), ANGLES, strict=True):
                said = said.replace(str(path), f"{source.stem} {angle}°{path.suffix}")
        raise InputError(said) from error


def plain_name(name: str, suffixes: tuple[str, ...] = (*FRAME_FILES, ".exr"), kinds: str = "") -> tuple[str, str]:
    """Stem and extension of the name that a user's file has, harmless in any path. Raises InputError for what is no
    frame or result: recordings and films refer to other files, and four angle images are four."""
    base = re.split(r"[/\\]", name)[-1]
    stem, suffix = Path(base).stem, Path(base).suffix.lower()
    if suffix not in suffixes:
        kinds = kinds or "PNG, TIFF, NPY, NPZ, PGM, headerless raw (.raw, .bin) or polsep's own EXR"
        raise InputError(f"{base[:80]}: expected {kinds}, found {suffix or 'no extension'!r}")
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._")[:64] or "frame", suffix
