"""`InputError`, and how whatever a codec raises becomes one.

Readers of one format raise ValueError (or InputError, from inside `decoding`) without naming the file; whoever knows
the path wraps them, once, in `naming`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A file that can't be read as asked; the message is one line: what was expected, what was found."""


def input_error(path: str | Path, reason: object) -> InputError:
    """An `InputError` with the file in front: ``shot.png: expected ..., found ...``, always one line."""
    return InputError(" ".join(f"{path}: {reason}".split()))


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """ValueError and OSError raised inside leave as an `InputError` that names the file."""
    try:
        yield
    except ValueError as error:
        raise input_error(path, error) from error
    except FileNotFoundError as error:
        raise input_error(path, "expected a file, found nothing at this path") from error
    except OSError as error:
        raise input_error(path, f"expected a readable file, found: {error.strerror or error}") from error


@contextmanager
def decoding(kind: str) -> Iterator[None]:
    """Whatever a codec raises on damaged bytes leaves as one ValueError; no codec documents all that it raises."""
    try:
        yield
    except InputError:  # already in our words
        raise
    except Exception as error:
        raise ValueError(f"expected an intact {kind} file, found damage: {error or type(error).__name__}") from error
