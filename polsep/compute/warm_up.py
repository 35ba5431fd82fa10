"""Compiled code made ready before it is used, with a word to the user where that takes long. Imports no compiler."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache

#: Compilation that takes less than this many seconds is not worth a word.
PATIENCE = 2.0

#: Warnings of those who wait for kernels now.
_NOTICES: list[threading.Timer] = []


@lru_cache
def make_ready(warm_up: Callable[[], object]) -> None:
    """Load or compile what a method needs by ``warm_up``, the first time only; log a warning if it compiles for long.

    Loading never warns, however busy the machine is.
    """
    with _watch_compiler():
        warm_up()


def announce_compilation() -> None:
    """Start the clocks of all who wait in `make_ready`: the compiler has begun."""
    for notice in _NOTICES:
        if notice.ident is None:
            notice.start()


@contextmanager
def _watch_compiler() -> Iterator[None]:
    """Log a warning `PATIENCE` seconds after the compiler starts, if the block is not done by then."""
    text = "compiling this method for this machine, once: up to a minute or two"
    notice = threading.Timer(PATIENCE, logging.getLogger("polsep").warning, (text,))
    notice.daemon = True
    _NOTICES.append(notice)
    try:
        yield
    finally:
        _NOTICES.remove(notice)
        notice.cancel()
