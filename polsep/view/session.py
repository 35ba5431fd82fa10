"""The state of one page: its files, the frame read from them, its separation, and edits of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from polsep.edit import Edit, EditError, Recipe, SeparatedImages, apply, recipe_as_data, recipe_as_text
from polsep.edit.images import Maps, find_map
from polsep.io.assets.maps import read_map
from polsep.io.raw.frames import Frame, ReadOptions
from polsep.io.results.edited import EditedFrame, write_edited, write_recipe
from polsep.io.results.previews import toned
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.temporary import make_folder, random_name, remove_folder
from polsep.separation.report import SeparatedFrame
from polsep.view.edits import edit_small, keep_fitting
from polsep.view.images import EditImage, read_image, require_fit
from polsep.view.opening import (
    OpenedFrame,
    Settings,
    Source,
    find_sources,
    is_result,
    open_frame,
    open_small,
    read_source,
)
from polsep.view.pictures import Floats, Sharp, Small, Window, cut_window
from polsep.view.playback import AHEAD, Prefetcher, Reel

#: Files to download: the separation, its contact sheet, the edited frame, the edits as a file.
DOWNLOADS = ("exr", "png", "edited", "recipe")


class Superseded(Exception):
    """A separation that nobody waits for any more: cancelled, or of files that were closed meanwhile."""


class Session:
    """The state of one page. Its methods may be called from several threads; only separating takes long, and what is
    shown stays usable meanwhile.

    ``kept`` and ``downloads`` are its own folders: for its files, and for results to download. ``sources``: the opened
    files. ``opened`` is the frame whose numbers and files the page has, ``against`` another separation of it that the
    right picture shows, ``shown`` what the page sees: the opened frame, or one that is being played. ``mark``: row and
    column as shares. ``view``: what the pictures show, as last said; ``turn``: number of pictures that were begun, of
    which the last one counts. ``dropped``: edits that did not fit the opened frame.
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
        self.recipe, self.dropped = Recipe(), tuple[Edit, ...]()
        self.images: dict[str, EditImage] = {}
        self._ahead, self._reel = ahead, Reel()
        self.sources: tuple[Source, ...] = ()
        self._read: tuple[tuple[Source, ...], ReadOptions, int, Frame | SeparatedFrame] | None = None
        self._settings: Settings | None = None
        self._made: list[tuple[tuple[Source, ...], Settings, OpenedFrame]] = []
        self._edited_frame_of: tuple[OpenedFrame, Recipe, Floats] | None = None

    def begin(self, sources: tuple[Source, ...]) -> None:
        """Open other files and drop the state of the ones before."""
        with self.lock:
            self._forget()
            self.sources = sources

    def begin_own(self, path: Path) -> None:
        """Open the user's file, or folder of separated frames. Raises InputError."""
        self.begin(find_sources(path))

    def forget(self) -> None:
        """Close all files, as after one that could not be opened."""
        with self.lock:
            self._forget()

    def _forget(self) -> None:
        self._drop_reel()
        self.sources, self.place, self.playing = (), 0, False
        self._read = self.opened = self.against = self.shown = self.mark = self._settings = None
        self.window = self.sharp = self._edited_frame_of = None
        self._made = []

    def _drop_reel(self) -> None:
        self._ahead.drop(self._reel)
        self._reel = Reel()

    def separate(
        self, settings: Settings, against: Settings | None = None, wanted: Callable[[], bool] = lambda: True
    ) -> OpenedFrame:
        """Separate the opened file with these settings, and with those of ``against`` for comparison, if it is raw.

        Raises ValueError, in one line that names the file, and Superseded if the result is not ``wanted`` at the end.
        """
        with self.lock:
            sources = self.sources
        if not sources:
            raise ValueError("expected an opened file, found none: choose one, or the demo capture")
        found = self._find(sources, settings)
        made, other = [(sources, settings, found)], None
        against = None if is_result(sources, settings.index) else against
        if against is not None:
            other = found if against == settings else self._find(sources, against)
            made += [(sources, against, other)] if other is not found else []
        with self.lock:
            if self.sources is not sources or not wanted():
                raise Superseded
            self.dropped = ()
            if self.opened is not None and settings == self._settings:
                found = self.opened  # with its remarks
            elif unfit := self._drop_unfit(found):
                found = replace(found, remarks=found.remarks + unfit)
            shown = self._edited(found.small)  # before the state changes, which then changes as a whole
            if self._settings is None or replace(settings, index=0) != replace(self._settings, index=0):
                self._drop_reel()
            self.mark = self.mark if self.opened is not None and self.opened.index == found.index else None
            self.opened, self._settings, self._made = found, settings, made
            self.against, self.makers = other, (settings.maker, against.maker if against is not None else "")
            self.place, self.shown = found.index, shown
            return found

    def _find(self, sources: tuple[Source, ...], settings: Settings) -> OpenedFrame:
        """The frame with these settings: the one that was made before, else a new one."""
        if (made := self.made(settings, sources)) is not None:
            return made
        with self._working:
            begin = time.perf_counter()
            found = open_frame(sources, settings, self._frame(sources, settings))
            return replace(found, seconds=time.perf_counter() - begin)

    def made(self, settings: Settings, sources: tuple[Source, ...] | None = None) -> OpenedFrame | None:
        """The frame of these files, or the opened ones, with these settings, if it was made before."""
        files = self.sources if sources is None else sources
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
        """Drop masks, normals and edits that do not fit the frame, and return remarks on them."""
        remarks, before = [], self.recipe.edits
        height, width = found.frame.valid.shape
        for sent in list(self.images.values()):
            try:
                require_fit(sent.kind, sent.name, sent.size, (height, width))
            except EditError as error:
                remarks.append(f"the {sent.kind} is left out: {error}")
                self._drop_image(sent.kind)
        self.recipe, unfit = keep_fitting(found.small, self.recipe, self._maps())
        self.dropped = tuple(edit for edit in before if edit not in self.recipe.edits)
        return (*remarks, *unfit)

    def _drop_image(self, kind: str) -> None:
        """Remove the image of a kind with its file, and the edits that name it."""
        sent = self.images.pop(kind, None)
        if sent is not None:
            remove_folder(sent.path.parent)
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
            sources = self.sources
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
        return replace(small, edited=edit_small(small, self.recipe, self._maps()) if self.recipe.edits else None)

    def _maps(self) -> Maps:
        """The images at screen size, by name."""
        return {sent.name: sent.small for sent in self.images.values()}

    def add_image(self, kind: str, path: Path, said: tuple[str, str]) -> None:
        """Have an image, of which the name's two parts are ``said``, for edits, instead of another one of its kind.

        The file is alone in its folder, and the session's from now on. Raises ValueError if it does not fit.
        """
        with self.lock:
            if self.opened is None:
                raise ValueError(f"expected a separated frame before its {kind}, found none: open a file first")
            name = "".join(said)
            if any(sent.name == name for sent in self.images.values() if sent.kind != kind):
                name = f"{kind}-{name}"
            height, width = self.opened.frame.valid.shape
            small = self.opened.small
            sent = read_image(kind, name, path, (height, width), small.step)
            find_map({name: sent.small}, kind, name, SeparatedImages(small.diffuse, small.specular))
            self._drop_image(kind)
            self.images[kind] = sent
            if self.shown is not None:
                self.shown = self._edited(self.shown)

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
