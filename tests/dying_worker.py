"""A program whose first task on a cluster ends with the death of its worker, before its result is sent."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

#: Functions of the main module are sent to workers as they are; these import the real one.
_PROGRAM = """
import os, signal
import {module} as room
def dying(job):
    import {module} as own
    done = own.{name}(job)
    try:
        os.close(os.open({mark!r}, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return done
    os.kill(os.getpid(), signal.SIGKILL)
room.{name} = dying
from polsep.cli import main
main()
"""


def with_dying_worker(task: Callable[..., Any], mark: Path) -> list[str]:
    """The command of polsep, before its arguments; the worker that does a ``task`` first makes a ``mark`` and dies."""
    return [sys.executable, "-c", _PROGRAM.format(module=task.__module__, name=task.__name__, mark=str(mark))]
