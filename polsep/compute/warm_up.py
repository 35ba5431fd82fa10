"""Compiled code made ready before it is used, with a word to the user where that takes long. Imports no compiler."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from functools import lru_cache

#: Loading compiled code takes less than this many seconds, also on a busy machine; compiling it takes more.
PATIENCE = 6.0


@lru_cache
def make_ready(warm_up: Callable[[], object]) -> None:
    """Load or compile what a method needs by ``warm_up``, the first time only; log a warning once it takes long."""
    import numba  # noqa: F401  # its import is not what takes long

    notice = threading.Timer(
        PATIENCE,
        logging.getLogger("polsep").warning,
        ("compiling this method for this machine, once: up to a minute or two",),
    )
    notice.daemon = True
    notice.start()
    try:
        warm_up()
    finally:
        notice.cancel()
