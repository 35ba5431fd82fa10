"""Silence for libraries that would write to the program's output by themselves.

Most log by Python, which prints what nobody handles: `mute` handles it. OpenEXR offers no switch: its core writes to
file descriptor 2 and its Python layer prints. File descriptor 2 belongs to the whole process, so lines of others that
arrive while `quiet` holds it are kept and written afterwards: nothing is lost.
"""

from __future__ import annotations

import logging
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

_STDERR = 2
_ONE_AT_A_TIME = threading.Lock()


def mute(*libraries: str) -> None:
    """Keep warnings that libraries log off the terminal; applications that configure logging still see them."""
    for library in libraries:
        logging.getLogger(library).addHandler(logging.NullHandler())


class _OthersOnly:
    """A text stream that drops what one thread writes, and passes on all else."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._silent = stream, threading.get_ident()

    def write(self, text: str) -> int:
        return len(text) if threading.get_ident() == self._silent else int(self._stream.write(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextmanager
def quiet(mark: bytes) -> Iterator[None]:
    """Drop what this thread prints inside, and lines on file descriptor 2 that begin with ``mark``.

    One thread at a time is inside. Where there is no file descriptor 2, nothing needs to be done about it.
    """
    with _ONE_AT_A_TIME:
        before = sys.stdout
        sys.stdout = None if before is None else _OthersOnly(before)
        try:
            with _kept_lines(mark):
                yield
        finally:
            sys.stdout = before


@contextmanager
def _kept_lines(mark: bytes) -> Iterator[None]:
    try:
        outside = os.dup(_STDERR)
    except OSError:
        yield
        return
    try:
        with tempfile.TemporaryFile() as caught:
            os.dup2(caught.fileno(), _STDERR)
            try:
                yield
            finally:
                os.dup2(outside, _STDERR)
                caught.seek(0)
                kept = b"".join(line for line in caught if not line.startswith(mark))
                with suppress(OSError):
                    os.write(outside, kept)
    finally:
        os.close(outside)
