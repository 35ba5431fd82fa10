"""Temporary folders of a server: one for uploads and downloads, and one per session with a secret name.

All are below one root, which only its owner can read and which is removed at the end.
"""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from polsep.io.store.errors import InputError


@dataclass(frozen=True)
class TemporaryFolders:
    """``root`` holds ``exchange``, whose files the server sends by name, and ``kept``, whose files it does not."""

    root: Path

    @property
    def exchange(self) -> Path:
        """Uploads and downloads."""
        return self.root / "exchange"

    @property
    def kept(self) -> Path:
        """Working files of the sessions."""
        return self.root / "kept"


def make_temporary_folders() -> TemporaryFolders:
    """New folders below the system's temporary one. Raises OSError."""
    scratch = TemporaryFolders(Path(os.path.realpath(tempfile.mkdtemp(prefix="polsep-view-"))))
    scratch.exchange.mkdir(mode=0o700)
    scratch.kept.mkdir(mode=0o700)
    return scratch


def remove_folder(folder: Path) -> None:
    """Remove a folder and its contents, as far as possible."""
    shutil.rmtree(folder, ignore_errors=True)


def remove_file(path: Path) -> None:
    """Remove a file, and its folder when that is empty then."""
    path.unlink(missing_ok=True)
    if not any(path.parent.iterdir()):
        path.parent.rmdir()


def random_name() -> str:
    """A secret name."""
    return secrets.token_urlsafe(24)


def make_folder(parent: Path, name: str) -> Path:
    """Make a folder that only its owner can read; it may exist."""
    folder = parent / name
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def clear_folder(folder: Path) -> Path:
    """Make or empty a folder that only its owner can read."""
    remove_folder(folder)
    return make_folder(folder.parent, folder.name)


def find_upload(scratch: TemporaryFolders, claimed: object, most_bytes: int) -> Path:
    """The file of an upload that a client names, which must be in ``exchange``.

    Raises InputError on any other path, link or folder, with the same message whether it exists or not, and on files of
    more than ``most_bytes``.
    """
    refused = InputError("expected a file that this page uploaded, found another path")
    if not isinstance(claimed, str) or not claimed or "\0" in claimed:
        raise refused
    path = Path(os.path.realpath(claimed))
    if scratch.exchange not in path.parents or str(path) != os.path.abspath(claimed) or not path.is_file():
        raise refused
    if (size := path.stat().st_size) > most_bytes:
        raise InputError(f"expected a file of at most {most_bytes / 2**20:.0f} MB, found {size / 2**20:.0f} MB")
    return path


def link_upload(path: Path, folder: Path, name: str) -> Path:
    """Link or copy an upload to ``name`` in a session's folder."""
    kept = folder / name
    try:
        os.link(path, kept)
    except OSError:  # another file system, or one without links
        shutil.copyfile(path, kept)
    return kept
