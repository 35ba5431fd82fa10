"""Compiled code made ready before it is used, with a word to the user where that takes long. Imports no compiler."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

#: Compilation that takes less than this many seconds is not worth a word.
PATIENCE = 2.0


@lru_cache
def make_ready(warm_up: Callable[[], object]) -> None:
    """Load or compile what a method needs by ``warm_up``, the first time only; log a warning if it compiles for long.

    Loading never warns, however busy the machine is.
    """
    with _watch_compiler():
        warm_up()


@contextmanager
def _watch_compiler() -> Iterator[None]:
    """Log a warning `PATIENCE` seconds after the compiler starts, if the block is not done by then."""
    from numba.core import event

    text = "compiling this method for this machine, once: up to a minute or two"
    notice = threading.Timer(PATIENCE, logging.getLogger("polsep").warning, (text,))
    notice.daemon = True

    class Start(event.Listener):
        def on_start(self, event: Any) -> None:
            del event
            if notice.ident is None:
                notice.start()

        def on_end(self, event: Any) -> None:
            del event

    with event.install_listener("numba:compile", Start()):
        try:
            yield
        finally:
            notice.cancel()
