"""Opening of files on a page: raw frames, results, and sequences of either.

A sequence is one file of several frames, or several files of one frame each.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.frames import FRAME_FILES, Frame, ReadOptions, read_frames
from polsep.io.results.separation_reader import find_numbered, holds_separated, read_separated
from polsep.io.store.errors import InputError
from polsep.io.store.header_checks import at_most
from polsep.methods import check_method
from polsep.pipeline import LightColor, parse_light_color, separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.report import SeparatedFrame
from polsep.view.pictures import Histogram, Small, histogram, shrink_frame

if TYPE_CHECKING:
    from collections.abc import Iterator

#: The capture that comes with polsep, and its white level.
DEMO = Path(__file__).resolve().parents[1] / "data" / "still_life.png"
DEMO_WHITE = 4095.0
#: Largest number of samples of a frame: four times a 16-megapixel sensor.
MAX_SAMPLES = 2**26
#: The value of unset fields: the file, or the type of its samples, decides.
UNSAID = "from file"


@dataclass(frozen=True)
class Settings:
    """Settings of reading and separating, as in `ReadOptions` and `pipeline.separate`, and the frame's ``index``."""

    read: ReadOptions = field(default_factory=ReadOptions)
    method: str = "auto"
    light_color: LightColor | str = "auto"
    index: int = 0


def parse_settings(said: Mapping[str, Any]) -> Settings:
    """Settings from the fields of the page: layout, black, white, light, method, size, pixel_format, index.

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
    return Settings(read, method, light, int(said.get("index") or 0))


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
    """A file as a source with a display name."""
    separated = path.suffix.lower() == ".exr" or (path.suffix.lower() == ".npz" and holds_separated(path))
    return Source(path, stem, separated)


def find_sources(path: Path) -> tuple[Source, ...]:
    """The owner's own file, or the frames of a folder as `polsep video` writes them. Raises InputError."""
    paths = [file for file in find_numbered(path).files if file is not None] if path.is_dir() else [path]
    return tuple(as_source(file, file.stem) for file in paths)


@dataclass(frozen=True)
class OpenedFrame:
    """One separated frame and its display data. ``mosaic`` and ``histogram`` are None without a raw frame.

    It is number ``index`` of ``count``; ``remarks`` are lines for the user; ``seconds``: time of reading and
    separating.
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

    def suggested_white(self) -> float | None:
        """The white level that a remark recommends."""
        for remark in self.remarks:
            if (said := re.search(r"set White level to (\d+)", remark)) is not None:
                return float(said[1])
        return None


def read_source(sources: tuple[Source, ...], read: ReadOptions, index: int) -> Frame | SeparatedFrame:
    """Read frame number ``index`` of a sequence. Raises InputError, in one line that names the file."""
    several = len(sources) > 1
    source = sources[min(index, len(sources) - 1)]
    with at_most(MAX_SAMPLES), _renamed(source):
        if source.separated:
            return read_separated(source.path)
        frame = next(read_frames(source.path, read, 0 if several else index), None)
        if frame is None:
            raise ValueError(f"{source.path}: expected a frame number {index}, found none")
        if several and frame.count > 1:
            raise ValueError(f"{source.path}: expected one frame in each of several files, found {frame.count}")
    return replace(frame, index=index, count=len(sources)) if several else frame


def open_frame(sources: tuple[Source, ...], settings: Settings, read: Frame | SeparatedFrame) -> OpenedFrame:
    """Display data of a frame that was read: separated with the settings, or as it is."""
    stem = sources[min(settings.index, len(sources) - 1)].stem
    if isinstance(read, SeparatedFrame):
        return OpenedFrame(read, shrink_frame(read), None, None, (), stem, settings.index, len(sources))
    frame = separate_capture(read.data, settings.method, settings.light_color)
    frame.report["source"] = stem
    frame.report["warnings"] = [*read.notes, *frame.report["warnings"]]
    mosaic = read.data if isinstance(read.data, Mosaic) else None
    remarks = tuple(remark.replace("say --white-level", "set White level to") for remark in frame.report["warnings"])
    counted = None if mosaic is None else histogram(mosaic)
    stem = stem if len(sources) > 1 or read.count == 1 else f"{stem}_{read.index:04d}"
    return OpenedFrame(frame, shrink_frame(frame), mosaic, counted, remarks, stem, read.index, read.count)


def open_small(sources: tuple[Source, ...], settings: Settings) -> Small:
    """A frame at screen size only."""
    read = read_source(sources, settings.read, settings.index)
    if isinstance(read, SeparatedFrame):
        return shrink_frame(read)
    return shrink_frame(separate_capture(read.data, settings.method, settings.light_color))


@contextmanager
def _renamed(source: Source) -> Iterator[None]:
    """Replace the path of the stored file by the user's file name in ValueErrors inside."""
    try:
        yield
    except ValueError as error:
        raise InputError(str(error).replace(str(source.path), source.stem + source.path.suffix)) from error


def plain_name(name: str, suffixes: tuple[str, ...] = (*FRAME_FILES, ".exr"), kinds: str = "") -> tuple[str, str]:
    """Stem and extension of the name that a user's file has, harmless in any path. Raises InputError for what is no
    frame or result: recordings and films refer to other files, and four angle images are four."""
    base = re.split(r"[/\\]", name)[-1]
    stem, suffix = Path(base).stem, Path(base).suffix.lower()
    if suffix not in suffixes:
        kinds = kinds or "PNG, TIFF, NPY, NPZ, PGM, headerless raw (.raw, .bin) or polsep's own EXR"
        raise InputError(f"{base[:80]}: expected {kinds}, found {suffix or 'no extension'!r}")
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._")[:64] or "frame", suffix
