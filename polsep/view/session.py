"""What one open page works on: its file, the frame read from it, and the separation, all of them its own.

A `Session` is the state behind one page. It ends with the page, and with it everything that came from its user.
"""

from __future__ import annotations

import re
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from polsep.camera import Layout, Mosaic
from polsep.edit import Recipe, apply, recipe_as_data, recipe_as_text
from polsep.io.edited import EditedFrame, write_edited, write_recipe_text
from polsep.io.errors import InputError
from polsep.io.frames import FRAME_FILES, Frame, ReadOptions, read_frames
from polsep.io.outputs import write_separation
from polsep.io.pages import at_most
from polsep.io.previews import toned
from polsep.io.scratch import Scratch, drop_file, drop_folder, find_upload, fresh_name, keep_upload, make_folder
from polsep.io.separated import read_separated
from polsep.methods import check_method
from polsep.pipeline import LightColor, parse_light_color, separate_capture
from polsep.report import SeparatedFrame
from polsep.view.edits import edit_small
from polsep.view.pictures import Histogram, Small, histogram, shrink_frame

#: The capture that comes with polsep, and its white level.
DEMO = Path(__file__).resolve().parents[1] / "data" / "still_life.png"
DEMO_WHITE = 4095.0
#: Results that can be opened again.
RESULT_FILES = (".exr",)
#: Samples of the largest frame that is opened: four times a 16-megapixel sensor.
MOST_SAMPLES = 2**26
#: Pages that are open at once; beyond, the one idle for longest ends.
MOST_SESSIONS = 32
#: What can be fetched: the separation, its contact sheet, the edited frame, the edits as a file.
WANTED = ("exr", "png", "edited", "recipe")
#: What the page calls "nothing said": the file, or the type of its samples, decides.
UNSAID = "from file"


@dataclass(frozen=True)
class Settings:
    """How a file is read and separated: `ReadOptions` and arguments of `pipeline.separate`, and which frame of it."""

    read: ReadOptions = field(default_factory=ReadOptions)
    method: str = "auto"
    light_color: LightColor | str = (1.0, 1.0, 1.0)
    index: int = 0


def parse_settings(said: Mapping[str, Any]) -> Settings:
    """Settings from the fields of the page: layout, black, white, light, method, size, pixel_format, index.

    Raises ValueError, in one line, on what they cannot mean.
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
    return Settings(read, method, parse_light_color(_text(said.get("light")) or "white"), int(said.get("index") or 0))


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
class Found:
    """One separated frame and all that is shown of it. ``mosaic`` and ``histogram`` are None without a raw frame.

    It is number ``index`` of ``count``; ``remarks`` are lines for the user; ``seconds``: how long reading and
    separating took.
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


class Session:
    """What one page has opened. Its methods may be called from several threads; one at a time works.

    ``kept`` and ``fetched`` are folders of its own: for the file it works on, and for results to be fetched.
    """

    def __init__(self, kept: Path, fetched: Path) -> None:
        self.kept, self.fetched = kept, fetched
        self.lock = threading.Lock()
        self.found: Found | None = None
        self.mark: tuple[int, int] | None = None
        self.recipe = Recipe()
        self._path: Path | None = None
        self._stem = ""
        self._read: tuple[ReadOptions, int, Frame] | None = None
        self._settings: Settings | None = None

    def begin(self, path: Path, stem: str) -> None:
        """Work on another file; what was found in the one before is forgotten."""
        with self.lock:
            self._path, self._stem = path, stem
            self._read = self.found = self.mark = self._settings = None

    def forget(self) -> None:
        """Work on no file, as after one that could not be opened."""
        with self.lock:
            self._path = self._read = self.found = self.mark = self._settings = None

    def separate(self, settings: Settings) -> Found:
        """The opened file under these settings. Raises ValueError, in one line that names the file."""
        with self.lock:
            if self._path is None:
                raise ValueError("expected an opened file, found none: choose one, or the demo capture")
            if self.found is None or settings != self._settings:
                self.mark = self.mark if self.found is not None and self.found.index == settings.index else None
                begin = time.perf_counter()
                found = self._reopen() if self._path.suffix in RESULT_FILES else self._separate(settings)
                self.found = replace(found, small=self._edited(found.small), seconds=time.perf_counter() - begin)
                self._settings = settings
            return self.found

    def edit(self, recipe: Recipe) -> None:
        """Show the frame with these edits from now on. Raises EditError where they do not fit it."""
        with self.lock:
            before, self.recipe = self.recipe, recipe
            try:
                if self.found is not None:
                    self.found = replace(self.found, small=self._edited(self.found.small))
            except ValueError:
                self.recipe = before
                raise

    def _edited(self, small: Small) -> Small:
        return replace(small, edited=edit_small(small, self.recipe) if self.recipe.edits else None)

    def _reopen(self) -> Found:
        assert self._path is not None
        with at_most(MOST_SAMPLES), _renamed(self._path, self._stem):
            frame = read_separated(self._path)
        return Found(frame, shrink_frame(frame), None, None, (), self._stem)

    def _separate(self, settings: Settings) -> Found:
        raw = self._frame(settings)
        frame = separate_capture(raw.data, settings.method, settings.light_color)
        frame.report["source"] = self._stem
        frame.report["warnings"] = [*raw.notes, *frame.report["warnings"]]
        mosaic = raw.data if isinstance(raw.data, Mosaic) else None
        remarks = tuple(
            remark.replace("say --white-level", "set White level to") for remark in frame.report["warnings"]
        )
        counted = None if mosaic is None else histogram(mosaic)
        stem = self._stem if raw.count == 1 else f"{self._stem}_{raw.index:04d}"
        return Found(frame, shrink_frame(frame), mosaic, counted, remarks, stem, raw.index, raw.count)

    def _frame(self, settings: Settings) -> Frame:
        """The raw frame, read anew only where the file or how it is read has changed."""
        assert self._path is not None
        if self._read is None or self._read[:2] != (settings.read, settings.index):
            with at_most(MOST_SAMPLES), _renamed(self._path, self._stem):
                frame = next(read_frames(self._path, settings.read, settings.index), None)
            if frame is None:
                raise ValueError(f"{self._stem}: expected a frame number {settings.index}, found none")
            self._read = (settings.read, settings.index, frame)
        return self._read[2]

    def write(self, kind: str) -> Path:
        """Write what the user wants to fetch, one of `WANTED`, into a folder of its own. Raises ValueError."""
        with self.lock:
            if self.found is None:
                raise ValueError("expected a separated frame, found none: open a file first")
            folder = make_folder(self.fetched, fresh_name())
            stem = self.found.stem
            if kind in ("exr", "png"):
                write_separation(self.found.frame, folder, stem, "exr")
                return folder / f"{stem}.{kind}"
            if kind == "recipe":
                write_recipe_text(folder / f"{stem}_recipe.json", recipe_as_text(self.recipe), False)
                return folder / f"{stem}_recipe.json"
            write_edited(self._edited_frame(self.found), folder, f"{stem}_edited", False)
            return folder / f"{stem}_edited.exr"

    def _edited_frame(self, found: Found) -> EditedFrame:
        """The frame at its own size under the recipe, as `polsep edit` writes it."""
        after = apply(found.frame, self.recipe)
        layers = {"diffuse": after.diffuse, "specular": after.specular, "combined": after.combined}
        said = {"source": found.stem, "recipe": recipe_as_data(self.recipe), "warnings": self.recipe.cautions()}
        return EditedFrame(layers, np.asarray(toned(after.combined, found.small.gain)), said)


class _renamed:
    """ValueErrors inside speak of the user's file, not of where it is kept."""

    def __init__(self, path: Path, stem: str) -> None:
        self._path, self._name = str(path), stem + path.suffix

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError):
            raise InputError(str(error).replace(self._path, self._name)) from error


class Sessions:
    """All open pages by the key that the browser drew for each; a key that is not here has nothing.

    At most `MOST_SESSIONS` are kept: beyond, the one idle for longest ends.
    """

    def __init__(self, scratch: Scratch, most_bytes: int) -> None:
        self.scratch, self.most_bytes = scratch, most_bytes
        self._lock = threading.Lock()
        self._open: OrderedDict[str, Session] = OrderedDict()
        self._uploads: dict[Path, set[str]] = {}

    def find(self, key: str) -> Session:
        """The session of a page, made when it asks first."""
        with self._lock:
            if key not in self._open:
                name = fresh_name()
                folders = (make_folder(parent, name) for parent in (self.scratch.kept, self.scratch.exchange))
                self._open[key] = Session(*folders)
            self._open.move_to_end(key)
            oldest = next(iter(self._open)) if len(self._open) > MOST_SESSIONS else None
        if oldest is not None:
            self.end(oldest)
        return self._open[key]

    def open_upload(self, key: str, claimed: object, name: str) -> None:
        """Let a page work on what it uploaded. Raises InputError for what is no upload, or no frame or result."""
        path = find_upload(self.scratch, claimed, self.most_bytes)
        stem, suffix = plain_name(name)
        session = self.find(key)
        with self._lock:
            self._uploads.setdefault(path, set()).add(key)
        session.begin(keep_upload(path, session.kept, f"{fresh_name()}{suffix}"), stem)

    def end(self, key: str) -> None:
        """Forget a page, and remove its files."""
        with self._lock:
            session = self._open.pop(key, None)
            for users in self._uploads.values():
                users.discard(key)
            alone = [path for path, users in self._uploads.items() if not users]
            for path in alone:
                del self._uploads[path]
        for path in alone:
            drop_file(path)
        if session is not None:
            for folder in (session.kept, session.fetched):
                drop_folder(folder)

    def __len__(self) -> int:
        """How many are open."""
        return len(self._open)


def plain_name(name: str) -> tuple[str, str]:
    """Stem and extension of the name that a user's file has, harmless in any path. Raises InputError for what is no
    frame or result: recordings and films refer to other files, and four angle images are four."""
    base = re.split(r"[/\\]", name)[-1]
    stem, suffix = Path(base).stem, Path(base).suffix.lower()
    if suffix not in (*FRAME_FILES, *RESULT_FILES):
        kinds = "PNG, TIFF, NPY, NPZ, PGM, headless raw (.raw, .bin) or polsep's own EXR"
        raise InputError(f"{base[:80]}: expected {kinds}, found {suffix or 'no extension'!r}")
    return re.sub(r"[^A-Za-z0-9._-]+", "_", stem).strip("._")[:64] or "frame", suffix
