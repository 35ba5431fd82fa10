"""Files that appear whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def beside(path: Path) -> Iterator[Path]:
    """A place to write to, which then becomes ``path``: a reader sees all of a file, or the one from before.

    Makes the folder. What was written is removed where anything is raised inside, and OSError names ``path``.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        os.replace(part, path)
    except BaseException as error:
        part.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, str(part)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def replace_bytes(path: Path, data: bytes | memoryview) -> None:
    """Replace a file as a whole; makes its folder. Raises OSError."""
    with beside(path) as part:
        write_checked(part, data)


def replace_text(path: Path, text: str) -> None:
    """Replace a text file as a whole; makes its folder. Raises OSError."""
    replace_bytes(path, text.encode())


def write_checked(path: Path, data: bytes | memoryview) -> None:
    """Write a file and check that all of it arrived; OSError that names it otherwise."""
    try:
        path.write_bytes(data)
    except OSError as error:  # names the file where it cannot be opened, but not where the disk is full
        raise OSError(error.errno, error.strerror, str(path)) from error
    found = path.stat().st_size
    if found != len(data):
        raise OSError(errno.EIO, f"expected {len(data)} bytes, found {found}", str(path))
