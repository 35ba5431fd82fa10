"""`InputError`, and the conversion of other errors to it.

Readers of one format raise ValueError (or InputError, from inside `decoding`) without naming the file; the caller
that knows the path wraps them, once, in `naming`. Libraries quote what they read, so every message passes `one_line`.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from polsep.compute.arguments import WrongType

#: Most characters of a message with the name of its file, and of that name.
MOST, MOST_OF_NAME = 300, 200
_CUT = " ... "


class InputError(ValueError):
    """A file that can't be read as asked; its message is one line, "expected ..., found ..."."""


def as_path(path: Any) -> Path:
    """The path of text or of a path-like thing. Raises WrongType on anything else."""
    try:
        return Path(path)
    except TypeError:
        raise WrongType(f"expected the path of a file, found {path!r:.40}") from None


def one_line(text: object, most: int = MOST) -> str:
    """One line of at most ``most`` printable characters: a longer text loses its middle, others are escaped.

    So nothing in a file can move a terminal's cursor, or fill the screen.
    """
    whole = str(text)
    if len(whole) > 8 * most:  # so that huge texts cost nothing; what is cut here would be cut below
        whole = whole[: 4 * most] + _CUT + whole[-4 * most :]
    return _shortened(printable(" ".join(whole.split())), most)


def input_error(path: str | Path, reason: object) -> InputError:
    """An `InputError` with the file in front: ``shot.png: expected ..., found ...``, always one line."""
    name = _name_of(path)
    return InputError(f"{name}: {one_line(reason, MOST - len(name) - 2)}")


def _name_of(path: str | Path) -> str:
    return _shortened(printable(str(path)), MOST_OF_NAME)


def printable(text: str) -> str:
    """One line: unprintable characters, such as line ends in names of files, as ``\\x1b``."""
    return text if text.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    end = (most - len(_CUT)) // 2
    return text[: most - len(_CUT) - end] + _CUT + text[-end:]


def refuse_pipe(path: str | Path) -> None:
    """Raise ValueError on a pipe or socket: it cannot be rewound, and its writer might be waited for in vain."""
    try:
        mode = os.stat(path).st_mode
    except OSError:  # left to whoever opens it
        return
    if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode):
        raise ValueError("expected a file, found a pipe: save what comes through it first")


def refuse_repeated(paths: Iterable[Path], wanted: str) -> None:
    """Raise InputError where two paths lead to one file; ``wanted``: what all of them should be."""
    seen: dict[str, Path] = {}
    for path in paths:
        file = os.path.realpath(path)
        if file in seen:
            raise input_error(path, f"expected {wanted}, found {seen[file]} again")
        seen[file] = path


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Turn ValueError and OSError raised inside into an `InputError` that names the file; once, where they nest."""
    try:
        yield
    except ValueError as error:
        if isinstance(error, InputError) and str(error).startswith(f"{_name_of(path)}: "):
            raise
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
        found = one_line(getattr(error, "strerror", None) or error) or type(error).__name__
        raise ValueError(f"expected an intact {kind} file, found damage: {found}") from error
