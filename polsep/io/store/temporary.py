"""Temporary folders of a server: one for what arrives and is fetched, and one per session that nobody else can name.

Everything lies below one root, made with permissions for its owner alone and removed as a whole at the end.
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
    """``root`` holds ``exchange``, whose files a server hands out by name, and ``kept``, whose files it does not."""

    root: Path

    @property
    def exchange(self) -> Path:
        """Uploads, and results to be fetched."""
        return self.root / "exchange"

    @property
    def kept(self) -> Path:
        """What sessions work on."""
        return self.root / "kept"


def make_temporary_folders() -> TemporaryFolders:
    """New folders below the system's temporary one. Raises OSError."""
    scratch = TemporaryFolders(Path(os.path.realpath(tempfile.mkdtemp(prefix="polsep-view-"))))
    scratch.exchange.mkdir(mode=0o700)
    scratch.kept.mkdir(mode=0o700)
    return scratch


def remove_folder(folder: Path) -> None:
    """Remove a folder and all that is in it, as far as that can be done."""
    shutil.rmtree(folder, ignore_errors=True)


def remove_file(path: Path) -> None:
    """Remove a file, and its folder when that is empty then."""
    path.unlink(missing_ok=True)
    if not any(path.parent.iterdir()):
        path.parent.rmdir()


def random_name() -> str:
    """A name that nobody guesses."""
    return secrets.token_urlsafe(24)


def make_folder(parent: Path, name: str) -> Path:
    """A folder for its owner alone; it may be there already."""
    folder = parent / name
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def clear_folder(folder: Path) -> Path:
    """An empty folder for its owner alone."""
    remove_folder(folder)
    return make_folder(folder.parent, folder.name)


def file_size(path: Path) -> int:
    """Bytes of a file."""
    return path.stat().st_size


def find_upload(scratch: TemporaryFolders, claimed: object, most_bytes: int) -> Path:
    """The file of an upload that a client names; only what lies in ``exchange`` exists for it.

    Raises InputError for any other path, for links and for folders, without saying whether they are there, and for
    files of more than ``most_bytes``.
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
    """The same file under a ``name`` of ours in a session's folder."""
    kept = folder / name
    try:
        os.link(path, kept)
    except OSError:  # another file system, or one without links
        shutil.copyfile(path, kept)
    return kept
