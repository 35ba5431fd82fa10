"""The sessions of all open pages. Each ends with its page, and its user's files are then deleted."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path

from polsep.io.assets.maps import SUFFIXES
from polsep.io.raw.frames import output_stem
from polsep.io.raw.sequences import natural_order
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
from polsep.view.opening import Source, as_source, group_angles, plain_name
from polsep.view.playback import Prefetcher
from polsep.view.session import Session
from polsep.view.waiting import Line

#: Largest number of open pages; beyond it, the one idle for longest ends.
MAX_SESSIONS = 64
#: Bytes of the frames of all pages; beyond them, the page idle for longest ends.
MAX_BYTES = 4 << 30
#: Largest number of files that a page opens at once.
MAX_FILES = 1000


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
        session.begin(tuple(sorted(kept, key=lambda source: natural_order(Path(source.stem)))))

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
        """Use an uploaded image for a page's edits. Raises ValueError for files that are no uploads, or no images.

        The image before it stays until the new one is read.
        """
        path = find_upload(self.scratch, claimed, self.most_bytes)
        said = plain_name(name, SUFFIXES, "an image as PNG, JPEG, TIFF, NPY or EXR")
        session = self.find(key)
        folder = make_folder(session.kept, random_name())
        try:
            session.add_image(kind, self._keep(key, path, folder, said[1]), said)
        except Exception:
            remove_folder(folder)
            raise

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
