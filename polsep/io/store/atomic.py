"""Atomic files and sets of files.

A reader sees all of a file or the one from before; a set of files appears complete or not at all.
Everything is written under a hidden name in the same directory, then renamed.
"""

from __future__ import annotations

import errno
import os
import shutil
import signal
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

#: What a file is to hold: bytes, or a function that writes them into a stream, so that memory never holds them all.
Contents = bytes | memoryview | Callable[[BinaryIO], object]
#: Seconds after which a hidden folder of a set is nobody's any more: a set of files is written in far less.
FORGOTTEN = 3600.0
#: Endings of files that commands write: a folder to be made with one is a file name in the wrong place.
FILES = (".exr", ".npz", ".tiff", ".tif", ".png", ".json", ".onnx", ".glb", ".mkv", ".mp4")


class OutputError(ValueError):
    """The outputs could not be written, and nothing was: one line of what was expected and what was found."""


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A hidden path to write to, which is renamed to ``path`` at the end of the block. Makes the folder.

    Removes what was written where anything is raised inside; an OSError then names ``path``.
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
    """Replace a file atomically; makes its folder. Raises OSError."""
    with atomic_path(path) as part:
        write_checked(part, data)


def replace_text(path: Path, text: str) -> None:
    """Replace a text file atomically; makes its folder. Raises OSError."""
    replace_bytes(path, text.encode())


def write_checked(path: Path, data: Contents) -> None:
    """Write a file and check its size; raises an OSError that names it. The write itself is not atomic."""
    try:
        with path.open("wb") as stream:
            if callable(data):
                data(stream)
            else:
                stream.write(data)
            size = len(data) if isinstance(data, bytes | memoryview) else stream.seek(0, os.SEEK_END)
    except OSError as error:  # names the file where it cannot be opened, but not where the disk is full
        raise OSError(error.errno, error.strerror, str(path)) from error
    found = path.stat().st_size
    if found != size:
        raise OSError(errno.EIO, f"expected {size} bytes, found {found}", str(path))


def release_cache(file: int | Path) -> None:
    """Have the system write a file to the disk, and forget what of it is there; on Linux, as advice.

    For streams, of each file when it is written and again some files later: they would fill the memory with what
    nobody reads now, and on virtual machines memory that is used for the first time takes ten times as long to fill.
    """
    if not hasattr(os, "posix_fadvise"):
        return
    with suppress(OSError):
        if isinstance(file, Path):
            with file.open("rb") as stream:
                release_cache(stream.fileno())
        else:
            os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)


def is_disk_full(error: BaseException) -> bool:
    """True for an error by which nothing more can be written, such as an `OutputError` of `write_set`."""
    cause = error if isinstance(error, OSError) else error.__cause__
    return isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)


def hold_lock(owner: object, path: Path) -> Callable[[], object]:
    """Hold a file, made if missing, until the function returned is called or ``owner`` or its process is gone.

    Raises BlockingIOError where another holds it, or has just removed it. Does nothing where the system, or that of the
    disk, has no such locks.
    """
    if fcntl is None:
        return lambda: None
    file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    let_go = weakref.finalize(owner, os.close, file)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not os.path.exists(path) or os.stat(path).st_ino != os.fstat(file).st_ino:
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN), str(path))
    except BlockingIOError:
        let_go()
        raise
    except OSError:
        pass
    return let_go


def require_writable(directory: Path) -> None:
    """Raise OutputError where nothing may be written into a directory, or into the one to make it in. Call it first."""
    if directory.suffix.lower() in FILES and not os.path.lexists(directory):
        raise OutputError(f"expected a directory to write into, found the name of a file: {directory}")
    nearest = next((d for d in (directory, *directory.parents) if os.path.lexists(d)), None)
    if nearest is not None and not os.path.isdir(nearest):
        raise OutputError(f"expected a directory to write into, found a file: {nearest}")
    if nearest is not None and not os.access(nearest, os.W_OK | os.X_OK):
        raise OutputError(f"expected a directory to write into, found one without permission to write: {nearest}")


def refuse_existing(directory: Path, targets: Sequence[Path], overwrite: bool) -> None:
    """Raise OutputError where files would be replaced without ``overwrite``, or none can be written. Call it first."""
    require_writable(directory)
    for target in targets:
        if os.path.isdir(target) and not os.path.islink(target):
            raise OutputError(f"expected a file or nothing at {target}, found a directory")
        if not overwrite and os.path.lexists(target):
            raise OutputError(f"expected no {target}, found one from before; --overwrite replaces it")


def refuse_inputs(targets: Sequence[Path], inputs: Sequence[Path]) -> None:
    """Raise OutputError where an output would replace an input. Call it first."""
    clash = {os.path.realpath(path) for path in targets} & {os.path.realpath(path) for path in inputs}
    if clash:
        raise OutputError(f"expected outputs apart from inputs, found that {min(clash)} is an input")


def write_set(targets: Sequence[Path], name: str, write: Callable[[Path], None]) -> None:
    """Write a set of files atomically: ``write(folder)`` makes them, then they move to ``targets`` of the same names.

    The targets share one directory, which is made if missing. After a failure no new file is left and the files from
    before are back in place. A target that was not written is removed. Two writers of one set at the same time are not
    guarded against. Raises OutputError, naming the set by ``name``.
    """
    directory = targets[0].parent
    missing = [d for d in (directory, *directory.parents) if not os.path.exists(d)]
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with delayed_signals():
            _write_and_move(targets, write)
    except BaseException as error:
        for path in missing:
            with suppress(OSError):
                path.rmdir()
        if isinstance(error, OutputError) or not isinstance(error, Exception):
            raise
        reason = " ".join(str(error).split()) or "no reason given"
        raise OutputError(
            f"expected to write {name!r} into {directory}, found {type(error).__name__}: {reason}"
        ) from error


@contextmanager
def delayed_signals() -> Iterator[None]:
    """Ctrl-C, a closed terminal and the system's request to end wait for the end of the block and its cleanup."""
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    if threading.current_thread() is not threading.main_thread() or None in before.values():  # no signal arrives here
        yield
        return
    caught: list[int] = []
    for number in before:
        signal.signal(number, lambda number, frame: caught.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if caught:  # also where the block has failed, or the system's own handler ends the program
            signal.raise_signal(caught[0])


def _write_and_move(targets: Sequence[Path], write: Callable[[Path], None]) -> None:
    """Write into a hidden directory beside the targets, then rename; that directory is gone afterwards."""
    _remove_forgotten(targets[0].parent)
    staging = Path(tempfile.mkdtemp(prefix=".polsep-", dir=targets[0].parent))
    try:
        (staging / "new").mkdir()
        (staging / "old").mkdir()
        write(staging / "new")
        _move_into_place(staging, targets)
        shutil.rmtree(staging / "old", ignore_errors=True)
    finally:
        shutil.rmtree(staging / "new", ignore_errors=True)
        for path in (staging / "old", staging):  # not emptied by force: only a failed restore leaves files in old/
            with suppress(OSError):
                path.rmdir()


def _move_into_place(staging: Path, targets: Sequence[Path]) -> None:
    """Rename staging/new/* to the targets and keep what was there in staging/old; undo everything on failure."""
    begun: list[Path] = []
    written = {path.name for path in (staging / "new").iterdir()}
    try:
        for target in targets:
            begun.append(target)
            if os.path.lexists(target):
                _keep(target, staging / "old" / target.name)
            if target.name in written:
                os.replace(staging / "new" / target.name, target)
            else:
                target.unlink(missing_ok=True)
    except BaseException:
        for target in reversed(begun):
            kept = staging / "old" / target.name
            if os.path.lexists(kept):
                os.replace(kept, target)
                kept.unlink(missing_ok=True)  # where both are one file, replacing does nothing
            elif target.name in written and not (staging / "new" / target.name).exists():
                target.unlink(missing_ok=True)
        raise


def _keep(target: Path, kept: Path) -> None:
    """A second name for a file, so that the first is there whenever the program is killed; or move it."""
    try:
        os.link(target, kept, follow_symlinks=False)
    except (OSError, NotImplementedError):
        os.replace(target, kept)


def _remove_forgotten(directory: Path) -> None:
    """Remove what killed programs have left of sets in a directory, but for files from before."""
    for old in directory.glob(".polsep-*/old"):
        with suppress(OSError):
            if time.time() - old.stat().st_mtime > FORGOTTEN:
                shutil.rmtree(old.with_name("new"), ignore_errors=True)
                old.rmdir()
                old.parent.rmdir()
