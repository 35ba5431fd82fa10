"""Sessions: the files, the frame read from them and its separation, separately for each open page.

A `Session` is the state of one page. It ends with the page, and its user's files are then deleted.
"""

from __future__ import annotations

import re
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from polsep.edit import EditError, Recipe, apply, recipe_as_data, recipe_as_text
from polsep.io.assets.maps import read_map
from polsep.io.raw.frames import Frame, ReadOptions
from polsep.io.results.edited import EditedFrame, write_edited, write_recipe
from polsep.io.results.previews import toned
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.errors import InputError
from polsep.io.store.temporary import (
    TemporaryFolders,
    clear_folder,
    find_upload,
    link_upload,
    make_folder,
    random_name,
    remove_file,
    remove_folder,
)
from polsep.separation.report import SeparatedFrame
from polsep.view.edits import edit_small
from polsep.view.images import EditImage, image_name, read_image, require_fit
from polsep.view.opening import (
    OpenedFrame,
    Settings,
    Source,
    as_source,
    find_sources,
    open_frame,
    open_small,
    plain_name,
    read_source,
)
from polsep.view.pictures import Small
from polsep.view.playback import AHEAD, Prefetcher, Reel

#: Largest number of open pages; beyond it, the one idle for longest ends.
MAX_SESSIONS = 32
#: Largest number of files that a page opens at once.
MAX_FILES = 1000
#: Files to download: the separation, its contact sheet, the edited frame, the edits as a file.
DOWNLOADS = ("exr", "png", "edited", "recipe")


class Session:
    """The state of one page. Its methods may be called from several threads and exclude each other.

    ``kept`` and ``downloads`` are its own folders: for its files, and for results to download.
    ``found`` is the frame whose numbers and files the page has, ``shown`` what it sees: the same, or a frame that
    is being played.
    """

    def __init__(self, kept: Path, downloads: Path, ahead: Prefetcher) -> None:
        self.kept, self.downloads = kept, downloads
        self.lock = threading.Lock()
        self.opened: OpenedFrame | None = None
        self.shown: Small | None = None
        self.place, self.playing = 0, False
        self.mark: tuple[int, int] | None = None
        self.recipe = Recipe()
        self.images: dict[str, EditImage] = {}
        self._ahead, self._reel = ahead, Reel()
        self._sources: tuple[Source, ...] = ()
        self._read: tuple[ReadOptions, int, Frame | SeparatedFrame] | None = None
        self._settings: Settings | None = None

    def begin(self, sources: tuple[Source, ...]) -> None:
        """Open other files and drop the state of the ones before."""
        with self.lock:
            self._forget()
            self._sources = sources

    def begin_own(self, path: Path) -> None:
        """Open the owner's file, or folder of separated frames. Raises InputError."""
        self.begin(find_sources(path))

    def forget(self) -> None:
        """Close all files, as after one that could not be opened."""
        with self.lock:
            self._forget()

    def _forget(self) -> None:
        self._drop_reel()
        self._sources, self.place, self.playing = (), 0, False
        self._read = self.opened = self.shown = self.mark = self._settings = None

    def _drop_reel(self) -> None:
        self._ahead.drop(self._reel)
        self._reel = Reel()

    def separate(self, settings: Settings) -> OpenedFrame:
        """Separate the opened file with these settings. Raises ValueError, in one line that names the file."""
        with self.lock:
            if not self._sources:
                raise ValueError("expected an opened file, found none: choose one, or the demo capture")
            if self.opened is None or settings != self._settings:
                if self._settings is None or replace(settings, index=0) != replace(self._settings, index=0):
                    self._drop_reel()
                self.mark = self.mark if self.opened is not None and self.opened.index == settings.index else None
                begin = time.perf_counter()
                found = open_frame(self._sources, settings, self._frame(settings))
                found = replace(found, remarks=found.remarks + self._drop_unfit(found))
                self.opened = replace(found, seconds=time.perf_counter() - begin)
                self._settings, self.place = settings, found.index
            self.place = self.opened.index
            self.shown = self._edited(self.opened.small)
            return self.opened

    def _frame(self, settings: Settings) -> Frame | SeparatedFrame:
        """The frame of the file, read again only if the file or the reading options have changed."""
        if self._read is None or self._read[:2] != (settings.read, settings.index):
            frame = read_source(self._sources, settings.read, settings.index)
            self._read = (settings.read, settings.index, frame)
        return self._read[2]

    def _drop_unfit(self, found: OpenedFrame) -> tuple[str, ...]:
        """Drop masks and normals that do not fit the frame, and return remarks on them."""
        remarks = []
        height, width = found.frame.valid.shape
        for sent in list(self.images.values()):
            try:
                require_fit(sent.kind, sent.name, sent.size, (height, width))
            except EditError as error:
                remarks.append(f"the {sent.kind} is left out: {error}")
                self._drop_image(sent.kind)
        return tuple(remarks)

    def _drop_image(self, kind: str) -> None:
        """Remove the image of a kind, and the edits that name it."""
        sent = self.images.pop(kind, None)
        if sent is not None:
            edits = (edit for edit in self.recipe.edits if sent.name not in (name for _, name in edit.images()))
            self.recipe = Recipe(tuple(edits))

    def play(self) -> bool:
        """Show the next frame of the sequence if it is ready, and request those after it; True if it was ready.

        Raises ValueError if there is no sequence, or a frame of it cannot be read.
        """
        with self.lock:
            found, settings = self.opened, self._settings
            if found is None or settings is None or found.count < 2:
                raise ValueError("expected a sequence to play, found none")
            places = [(self.place + 1 + k) % found.count for k in range(min(AHEAD, found.count))]
            sources = self._sources
            self._ahead.want(self._reel, places, lambda place: open_small(sources, replace(settings, index=place)))
            small = self._ahead.frame(self._reel, places[0])
            if small is None:
                return False
            self.shown = self._edited(replace(small, gain=found.small.gain))
            self.place = places[0]
            return True

    def edit(self, recipe: Recipe) -> None:
        """Show the frame with these edits from now on. Raises EditError if they do not fit it."""
        with self.lock:
            before, self.recipe = self.recipe, recipe
            try:
                if self.shown is not None:
                    self.shown = self._edited(self.shown)
            except ValueError:
                self.recipe = before
                raise

    def _edited(self, small: Small) -> Small:
        maps = {sent.name: sent.small for sent in self.images.values()}
        return replace(small, edited=edit_small(small, self.recipe, maps) if self.recipe.edits else None)

    def add_image(self, kind: str, path: Path, said: tuple[str, str]) -> None:
        """Have an image, of which the name's two parts are ``said``, for edits. Raises ValueError."""
        with self.lock:
            if self.opened is None:
                raise ValueError(f"expected a separated frame before its {kind}, found none: open a file first")
            self._drop_image(kind)
            name = "".join(said)
            if any(sent.name == name for sent in self.images.values() if sent.kind != kind):
                name = f"{kind}-{name}"
            height, width = self.opened.frame.valid.shape
            self.images[kind] = read_image(kind, name, path, (height, width), self.opened.small.step)

    def drop_images(self) -> None:
        """Remove all images, and the edits that name them."""
        with self.lock:
            for kind in list(self.images):
                self._drop_image(kind)
            if self.shown is not None:
                self.shown = self._edited(self.shown)

    def write(self, kind: str) -> Path:
        """Write a download, one of `DOWNLOADS`, into a new folder. Raises ValueError."""
        with self.lock:
            if self.opened is None:
                raise ValueError("expected a separated frame, found none: open a file first")
            folder = make_folder(self.downloads, random_name())
            stem = self.opened.stem
            if kind in ("exr", "png"):
                write_separation(self.opened.frame, folder, stem, "exr")
                return folder / f"{stem}.{kind}"
            if kind == "recipe":
                named = self.recipe.images()
                files = {sent.name: sent.path for sent in self.images.values() if sent.name in named}
                return write_recipe(folder, f"{stem}_recipe", recipe_as_text(self.recipe), files)
            write_edited(self._edited_frame(self.opened), folder, f"{stem}_edited", False)
            return folder / f"{stem}_edited.exr"

    def _edited_frame(self, found: OpenedFrame) -> EditedFrame:
        """The frame at full size with the recipe, as `polsep edit` writes it."""
        paths = {sent.name: sent.path for sent in self.images.values()}
        maps = {name: read_map(paths[name], kind) for name, kind in self.recipe.images().items()}
        after = apply(found.frame, self.recipe, maps)
        layers = {"diffuse": after.diffuse, "specular": after.specular, "combined": after.combined}
        said = {"source": found.stem, "recipe": recipe_as_data(self.recipe), "warnings": self.recipe.cautions()}
        return EditedFrame(layers, np.asarray(toned(after.combined, found.small.gain)), said)


class Sessions:
    """All open pages, by the key that each browser page drew.

    At most `MAX_SESSIONS` are kept: beyond, the one idle for longest ends. ``most_bytes``: of what a page opens.
    """

    def __init__(self, scratch: TemporaryFolders, most_bytes: int) -> None:
        self.scratch, self.most_bytes = scratch, most_bytes
        self._ahead = Prefetcher()
        self._lock = threading.Lock()
        self._open: OrderedDict[str, Session] = OrderedDict()
        self._uploads: dict[Path, set[str]] = {}

    def find(self, key: str) -> Session:
        """The session of a page, created at its first request."""
        with self._lock:
            if key not in self._open:
                name = random_name()
                kept, downloads = (make_folder(parent, name) for parent in (self.scratch.kept, self.scratch.exchange))
                self._open[key] = Session(kept, downloads, self._ahead)
            self._open.move_to_end(key)
            oldest = next(iter(self._open)) if len(self._open) > MAX_SESSIONS else None
        if oldest is not None:
            self.end(oldest)
        return self._open[key]

    def open_upload(self, key: str, sent: Sequence[tuple[object, str]]) -> None:
        """Open the files that a page uploaded, in the order of their names; ``sent``: claimed path and name.

        Raises InputError for files that are no uploads, or no frames or results.
        """
        if not 0 < len(sent) <= MAX_FILES:
            raise InputError(f"expected 1 to {MAX_FILES} files, found {len(sent)}")
        paths = [find_upload(self.scratch, claimed, self.most_bytes) for claimed, _ in sent]
        if (size := sum(path.stat().st_size for path in paths)) > self.most_bytes:
            most = self.most_bytes / 2**20
            raise InputError(f"expected files of at most {most:.0f} MB together, found {size / 2**20:.0f} MB")
        names = [plain_name(name) for _, name in sent]
        session = self.find(key)
        session.forget()
        folder = clear_folder(session.kept / "frames")
        pairs = sorted(zip(names, paths, strict=True), key=lambda pair: _in_numbers(pair[0][0]))
        kept = [(self._keep(key, path, folder, suffix), stem) for (stem, suffix), path in pairs]
        session.begin(tuple(as_source(path, stem) for path, stem in kept))

    def add_image(self, key: str, kind: str, claimed: object, name: str) -> None:
        """Use an uploaded image for a page's edits. Raises ValueError for files that are no uploads, or no images."""
        path = find_upload(self.scratch, claimed, self.most_bytes)
        said = image_name(name)
        session = self.find(key)
        folder = clear_folder(session.kept / kind)
        session.add_image(kind, self._keep(key, path, folder, said[1]), said)

    def _keep(self, key: str, path: Path, folder: Path, suffix: str) -> Path:
        """Link an upload under a new name; the upload is deleted with the last page that uses it."""
        with self._lock:
            self._uploads.setdefault(path, set()).add(key)
        return link_upload(path, folder, f"{random_name()}{suffix}")

    def end(self, key: str) -> None:
        """End a session and delete its files."""
        with self._lock:
            session = self._open.pop(key, None)
            for users in self._uploads.values():
                users.discard(key)
            alone = [path for path, users in self._uploads.items() if not users]
            for path in alone:
                del self._uploads[path]
        for path in alone:
            remove_file(path)
        if session is not None:
            session.forget()
            for folder in (session.kept, session.downloads):
                remove_folder(folder)

    def close(self) -> None:
        """End all sessions, and wait for the frame in progress."""
        for key in list(self._open):
            self.end(key)
        self._ahead.close()

    def __len__(self) -> int:
        """Number of open pages."""
        return len(self._open)


def _in_numbers(name: str) -> list[tuple[int, str]]:
    """A key that sorts numbered names by number: shot2 before shot10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
