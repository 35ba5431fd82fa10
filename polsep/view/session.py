"""Sessions: the files, the frame read from them and its separation, separately for each open page.

A `Session` is the state of one page. It ends with the page, and its user's files are then deleted.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polsep.edit import EditError, Recipe, SeparatedImages, apply, recipe_as_data, recipe_as_text
from polsep.io.assets.maps import read_map
from polsep.io.raw.frames import Frame, ReadOptions, output_stem
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
    group_angles,
    in_numbers,
    open_frame,
    open_small,
    plain_name,
    read_source,
)
from polsep.view.pictures import Floats, Sharp, Small, Window, cut_window
from polsep.view.playback import AHEAD, Prefetcher, Reel
from polsep.view.waiting import Line

#: Largest number of open pages; beyond it, the one idle for longest ends.
MAX_SESSIONS = 64
#: Bytes of the frames of all pages; beyond them, the page idle for longest ends.
MAX_BYTES = 4 << 30
#: Largest number of files that a page opens at once.
MAX_FILES = 1000
#: Files to download: the separation, its contact sheet, the edited frame, the edits as a file.
DOWNLOADS = ("exr", "png", "edited", "recipe")


class Superseded(Exception):
    """A separation that nobody waits for any more: cancelled, or of files that were closed meanwhile."""


class Session:
    """The state of one page. Its methods may be called from several threads; only separating takes long, and what is
    shown stays usable meanwhile.

    ``kept`` and ``downloads`` are its own folders: for its files, and for results to download. ``opened`` is the frame
    whose numbers and files the page has, ``against`` another separation of it that the right picture shows, ``shown``
    what the page sees: the opened frame, or one that is being played. ``mark``: row and column as shares. ``view``:
    what the pictures show, as last said; ``turn``: number of pictures that were begun, of which the last one counts.
    """

    def __init__(self, kept: Path, downloads: Path, ahead: Prefetcher) -> None:
        self.kept, self.downloads = kept, downloads
        self.lock, self._working = threading.Lock(), threading.Lock()
        self.opened: OpenedFrame | None = None
        self.against: OpenedFrame | None = None
        self.makers = ("", "")
        self.shown: Small | None = None
        self.place, self.playing = 0, False
        self.mark: tuple[float, float] | None = None
        self.view: dict[str, Any] = {}
        self.turn = 0
        self.window: Window | None = None
        self.sharp: tuple[Sharp, Sharp] | None = None
        self.recipe = Recipe()
        self.images: dict[str, EditImage] = {}
        self._ahead, self._reel = ahead, Reel()
        self._sources: tuple[Source, ...] = ()
        self._read: tuple[tuple[Source, ...], ReadOptions, int, Frame | SeparatedFrame] | None = None
        self._settings: Settings | None = None
        self._made: list[tuple[tuple[Source, ...], Settings, OpenedFrame]] = []
        self._edited_frame_of: tuple[OpenedFrame, Recipe, Floats] | None = None

    def begin(self, sources: tuple[Source, ...]) -> None:
        """Open other files and drop the state of the ones before."""
        with self.lock:
            self._forget()
            self._sources = sources

    @property
    def sources(self) -> tuple[Source, ...]:
        """The opened files."""
        return self._sources

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
        self._read = self.opened = self.against = self.shown = self.mark = self._settings = None
        self.window = self.sharp = self._edited_frame_of = None
        self._made = []

    def _drop_reel(self) -> None:
        self._ahead.drop(self._reel)
        self._reel = Reel()

    def separate(
        self, settings: Settings, against: Settings | None = None, wanted: Callable[[], bool] = lambda: True
    ) -> OpenedFrame:
        """Separate the opened file with these settings, and with those of ``against`` for comparison.

        Raises ValueError, in one line that names the file, and Superseded if the result is not ``wanted`` at the end.
        """
        with self.lock:
            sources = self._sources
        if not sources:
            raise ValueError("expected an opened file, found none: choose one, or the demo capture")
        found = self._find(sources, settings)
        other = None if against is None else self._find(sources, against)
        with self.lock:
            if self._sources is not sources or not wanted():
                raise Superseded
            if settings != self._settings:
                if self._settings is None or replace(settings, index=0) != replace(self._settings, index=0):
                    self._drop_reel()
                self.mark = self.mark if self.opened is not None and self.opened.index == found.index else None
                unfit = self._drop_unfit(found)
                found = replace(found, remarks=found.remarks + unfit) if unfit else found
                self.opened, self._settings = found, settings
            assert self.opened is not None
            self.against, self.makers = other, (settings.maker, against.maker if against is not None else "")
            self._made = [made for made in self._made if made[0] is sources and made[1] in (settings, against)]
            self.place, self.sharp = self.opened.index, None
            self.shown = self._edited(self.opened.small)
            return self.opened

    def _find(self, sources: tuple[Source, ...], settings: Settings) -> OpenedFrame:
        """The frame with these settings: the one that was made before, else a new one."""
        if (made := self.made(settings, sources)) is not None:
            return made
        with self._working:
            begin = time.perf_counter()
            found = open_frame(sources, settings, self._frame(sources, settings))
            found = replace(found, seconds=time.perf_counter() - begin)
        self._made = [*self._made, (sources, settings, found)]
        return found

    def made(self, settings: Settings, sources: tuple[Source, ...] | None = None) -> OpenedFrame | None:
        """The frame of these files, or the opened ones, with these settings, if it was made before."""
        files = self._sources if sources is None else sources
        return next((found for of, made, found in self._made if of is files and made == settings), None)

    def _frame(self, sources: tuple[Source, ...], settings: Settings) -> Frame | SeparatedFrame:
        """The frame of the file, read again only if the file or the reading options have changed."""
        read = self._read
        if read is None or read[:3] != (sources, settings.read, settings.index):
            read = self._read = (
                sources,
                settings.read,
                settings.index,
                read_source(sources, settings.read, settings.index),
            )
        return read[3]

    def sharpen(self, window: Window) -> bool:
        """Cut what is seen of the frame out of it, at the screen's resolution; False while another frame is shown."""
        with self.lock:
            found, other = self.opened, self.against
            if found is None or self.shown is None or self.playing or self.place != found.index:
                return False
            edited = self._edited_image(found) if self.recipe.edits else None
            self.window, left = window, cut_window(found.frame, window, found.small, edited, found.flags)
            right = left if other is None else cut_window(other.frame, window, found.small, None, other.flags)
            self.sharp = left, right
            return True

    def _edited_image(self, found: OpenedFrame) -> Floats:
        """The edited picture at full size, made once for a recipe."""
        made = self._edited_frame_of
        if made is None or made[0] is not found or made[1] is not self.recipe:
            made = self._edited_frame_of = (found, self.recipe, self._apply(found).combined)
        return made[2]

    def size(self) -> int:
        """Bytes of the frames in memory."""
        frames = [found for *_, found in self._made]
        images = (x for found in frames for x in vars(found.frame).values() if isinstance(x, np.ndarray))
        return int(sum(image.nbytes for image in images) + sum(f.mosaic.data.nbytes for f in frames[:1] if f.mosaic))

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

    def toggle(self) -> None:
        """Begin to play if a sequence is open, or stop."""
        with self.lock:
            self.playing = not self.playing and self.opened is not None and self.opened.count > 1

    def play(self) -> bool:
        """Show the next frame of the sequence if it is ready, and request those after it; True if it was ready.

        After a pause there is no next frame. Raises ValueError if there is no sequence, or a frame cannot be read.
        """
        with self.lock:
            if not self.playing:
                return False
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
            self.place, self.sharp = places[0], None
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
        self.sharp = None
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

    def _apply(self, found: OpenedFrame) -> SeparatedImages:
        """The frame at full size with the recipe."""
        paths = {sent.name: sent.path for sent in self.images.values()}
        maps = {name: read_map(paths[name], kind) for name, kind in self.recipe.images().items()}
        return apply(found.frame, self.recipe, maps)

    def _edited_frame(self, found: OpenedFrame) -> EditedFrame:
        """The frame at full size with the recipe, as `polsep edit` writes it."""
        after = self._apply(found)
        layers = {"diffuse": after.diffuse, "specular": after.specular, "combined": after.combined}
        said = {"source": found.stem, "recipe": recipe_as_data(self.recipe), "warnings": self.recipe.cautions()}
        return EditedFrame(layers, np.asarray(toned(after.combined, found.small.gain)), said)


class Sessions:
    """All open pages, by the key that each browser page drew.

    At most `MAX_SESSIONS` are kept: beyond, the one idle for longest ends. ``most_bytes``: of what a page opens.
    """

    def __init__(self, scratch: TemporaryFolders, most_bytes: int) -> None:
        self.scratch, self.most_bytes = scratch, most_bytes
        self._ahead, self.line = Prefetcher(), Line()
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
            found = self._open[key]
            size = sum(session.size() for session in self._open.values())
            over: list[str] = []
            for other, session in list(self._open.items())[:-1]:
                if len(self._open) - len(over) > MAX_SESSIONS or size > MAX_BYTES:
                    over.append(other)
                    size -= session.size()
        for other in over:
            self.end(other)
        return found

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
        groups = group_angles(["".join(name) for name in names])
        session = self.find(key)
        session.forget()
        folder = clear_folder(session.kept / "frames")
        if groups is not None:
            kept = [self._keep_angles(key, [paths[k] for k in places], folder, t) for t, places in groups.items()]
        else:
            pairs = zip(names, paths, strict=True)
            kept = [as_source(self._keep(key, path, folder, suffix), stem) for (stem, suffix), path in pairs]
        session.begin(tuple(sorted(kept, key=lambda source: in_numbers(source.stem))))

    def _keep_angles(self, key: str, paths: Sequence[Path], folder: Path, template: str) -> Source:
        """Link the uploads of four angles, 0, 45, 90 and 135, as one source."""
        suffix, name = Path(template).suffix, random_name()
        with self._lock:
            for path in paths:
                self._uploads.setdefault(path, set()).add(key)
        for path, angle in zip(paths, (0, 45, 90, 135), strict=True):
            link_upload(path, folder, f"{name}_{angle}{suffix}")
        return as_source(folder / f"{name}_{{angle}}{suffix}", output_stem(template))

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
        self.line.leave(key)
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
        self.line.close()
        for key in list(self._open):
            self.end(key)
        self._ahead.close()

    def __len__(self) -> int:
        """Number of open pages."""
        return len(self._open)
