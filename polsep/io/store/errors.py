"""`InputError`, and the conversion of other errors to it.

Readers of one format raise ValueError (or InputError, from inside `decoding`) without naming the file; the caller
that knows the path wraps them, once, in `naming`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class InputError(ValueError):
    """A file that can't be read as asked; its message is one line, "expected ..., found ..."."""


def input_error(path: str | Path, reason: object) -> InputError:
    """An `InputError` with the file in front: ``shot.png: expected ..., found ...``, always one line."""
    return InputError(" ".join(f"{path}: {reason}".split()))


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Turn ValueError and OSError raised inside into an `InputError` that names the file."""
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
    """Turn whatever a codec raises on damaged bytes into one ValueError; no codec documents all that it raises."""
    try:
        yield
    except InputError:  # has its message already
        raise
    except Exception as error:
        raise ValueError(f"expected an intact {kind} file, found damage: {error or type(error).__name__}") from error
