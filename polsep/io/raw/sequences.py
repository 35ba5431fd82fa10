"""Recordings as sequences of frames that can be read from any frame on: folders of files, and files of many frames.

A folder's frames are its files of one kind, in natural order (frame2 before frame10), four angle images together as one
frame; maps of a calibration are none.
A folder with a ``recording.json`` is a recording of `polsep capture`; a set of `polsep render` has its raw mosaics
alone as frames. A frame that cannot be read becomes a `DamagedFrame` in its place, and reading continues after it where
the file allows that.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path

from polsep.io.raw.frames import FRAME_FILES, Frame, ReadOptions, output_stem, read_frames
from polsep.io.raw.recording import RECORD, gap_notes, is_recording, recorded_rate, recording_files
from polsep.io.raw.videos import count_frames, cut_notes, find_timing, is_lossless_film
from polsep.io.store.calibrations import holds_maps
from polsep.io.store.errors import InputError, input_error, one_line
from polsep.io.store.result_names import result_names

_NUMBER = re.compile(r"(\d+)")
#: Names of the raw frames of rendered sets, beside which lie their truth and a contact sheet.
_VIEW = re.compile(r"shape\d+_view\d+\.png")
#: Most frames of a film between two key frames; damage may spoil all of them.
KEY_FRAMES = 300


@dataclass(frozen=True)
class DamagedFrame:
    """A frame that could not be read, and the reason in one line that names the file."""

    index: int
    reason: str


@dataclass(frozen=True)
class FrameSequence:
    """A recording: ``begin(first)`` yields its frames from number ``first`` on, about ``count`` in all.

    ``stem`` names its outputs; ``notes`` are one-line remarks for the user; ``rate``: frames per second, if known;
    ``names``: of the files of a folder, in the order of frames.
    """

    stem: str
    count: int
    begin: Callable[[int], Iterator[Frame | DamagedFrame]]
    notes: tuple[str, ...] = ()
    rate: float | None = None
    names: tuple[str, ...] = ()


def open_sequence(path: Path, options: ReadOptions) -> FrameSequence:
    """The frames of a folder or of a file. Raises InputError where there are none, or none can be read."""
    path = path / RECORD if is_recording(path) else path
    if path.is_dir():
        found = _frame_files(path)
        files = sorted(angles_together(found), key=natural_order)
        notes = _gap_notes(files) + _name_notes(files) + _angle_notes(found, files)
        names = tuple(file.name for file in files)
        begin = partial(_read_files, files, options)
        return FrameSequence(path.resolve().name, len(files), begin, notes, names=names)
    unread: str | None = None
    for frame in _read_stack(path, options, 1, 0):
        if isinstance(frame, Frame):
            begin = partial(_read_stack, path, options, frame.count)
            rate, notes = _times_of(path)
            count = count_frames(path, frame.count, 0) if is_lossless_film(path) else frame.count
            return FrameSequence(output_stem(path), count, begin, notes, rate)
        unread = unread or frame.reason
    raise input_error(path, "expected frames, found none") if unread is None else InputError(unread)


def _times_of(path: Path) -> tuple[float | None, tuple[str, ...]]:
    """Frames per second of a file of many frames, if it says them, and notes on what is missing and on their times."""
    if path.name == RECORD:
        return recorded_rate(path), gap_notes(path)
    if not is_lossless_film(path):
        return None, ()
    rate, notes = find_timing(path)
    return rate, cut_notes(path) + notes


def _frame_files(folder: Path) -> list[Path]:
    """The files of a folder's frames in natural order; InputError unless they are of one kind."""
    files = _named_as_frames(folder)
    kinds = Counter(p.suffix.lower() for p in files)
    if not files:
        raise input_error(folder, f"expected a folder of frames ({', '.join(FRAME_FILES)}), found none")
    if len(kinds) > 1:
        found = ", ".join(f"{count} {suffix}" for suffix, count in sorted(kinds.items()))
        raise input_error(folder, f"expected frames of one kind, found {found}")
    return sorted(files, key=natural_order)


def _gap_notes(files: list[Path]) -> tuple[str, ...]:
    """A note on numbers without a file, where names differ in the number at their end and most numbers follow."""
    names, digits = zip(*map(_numbered, files), strict=True)
    if len(set(names)) > 1 or not all(map(str.isdecimal, digits)):
        return ()
    numbers = sorted(map(int, digits))
    gaps = [(a, b) for a, b in pairwise(numbers) if b > a + 1]
    if not gaps or 2 * len(gaps) >= len(files):
        return ()
    some = ", ".join(f"{a + 1}" if b == a + 2 else f"{a + 1} to {b - 1}" for a, b in gaps[:8])
    more = ", ..." if len(gaps) > 8 else ""
    return (f"no files have the numbers {some}{more}: frames are counted from 0, without gaps",)


def _name_notes(files: list[Path]) -> tuple[str, ...]:
    """A note on names that differ as those of two cameras do, where several files have each."""
    names = Counter(_NUMBER.sub("#", path.stem) for path in files)
    if len(names) == 1:
        names = _names_of_cameras(files)
    if len(names) < 2 or min(names.values()) == 1:
        return ()
    some = ", ".join(list(names)[:4]) + ", ..." * (len(names) > 4)
    return (f"files have {len(names)} kinds of names ({some}): all of them are read as one recording",)


def _names_of_cameras(files: list[Path]) -> Counter[str]:
    """Kinds of names of one pattern in which a number seems to be a camera's, as ``cam1_#``; empty if none does.

    With every value of it at least half of the other numbers come again, unlike those of a time. Views of a rendered
    set are of one camera.
    """
    names = [_NUMBER.split(path.stem) for path in files if not _VIEW.fullmatch(path.name)]
    found: Counter[str] = Counter()
    for at in range(1, len(names[0]) if names else 0, 2):
        others: dict[str, set[tuple[str, ...]]] = {}
        for name in names:
            others.setdefault(name[at], set()).add((*name[:at], *name[at + 1 :]))
        least, shared = min(map(len, others.values())), len(set.intersection(*others.values()))
        if least > 1 and len(others) > 1 and 2 * shared >= least and (not found or len(others) < len(found)):
            pattern = ["#" if k % 2 else part for k, part in enumerate(names[0])]
            kinds = {number: "".join((*pattern[:at], number, *pattern[at + 1 :])) for number in others}
            found = Counter({kinds[number]: len(group) for number, group in others.items()})
    return found


def _angle_notes(found: list[Path], files: list[Path]) -> tuple[str, ...]:
    """A note on the files of a folder that are read as four angle images of one frame, if there are any."""
    frames = [path for path in files if path not in found]
    if not frames:
        return ()
    return (f"{4 * len(frames)} of {len(found)} files are read as frames of four angle images, like {frames[0].name}",)


def input_files(path: Path) -> list[Path]:
    """The files that `open_sequence` reads, and their index: those that no output may replace."""
    if path.is_dir() and not is_recording(path):
        return _frame_files(path)
    return [path, *recording_files(path / RECORD if path.is_dir() else path)]


def refuse_frames(path: Path, others: Sequence[Path]) -> None:
    """Raise InputError where one of the ``others`` is a frame of a recording: the lamp would be looked for in it."""
    frames = {os.path.realpath(file) for file in input_files(path)}
    if shared := [file for file in others if os.path.realpath(file) in frames]:
        raise input_error(shared[0], "expected a lamp-off frame apart from the recording, found one of its frames")


def expand_folders(paths: Sequence[str]) -> list[str]:
    """The paths with each folder replaced by its frames: a recording, or its files of all kinds in natural order.

    Files like ``shot_0.png``, ``shot_45.png``, ``shot_90.png``, ``shot_135.png`` without others of their name are four
    angle images, ``shot_{angle}.png``. Raises InputError on a folder without frames.
    """
    return [frame for path in paths for frame in (_folder_frames(Path(path)) if Path(path).is_dir() else [path])]


def _folder_frames(folder: Path) -> list[str]:
    if is_recording(folder):
        return [str(folder / RECORD)]
    files = _named_as_frames(folder)
    if not files:
        raise input_error(folder, f"expected a folder of frames ({', '.join(FRAME_FILES)}), found none")
    return [str(path) for path in sorted(angles_together(files), key=natural_order)]


def angles_together(files: Iterable[Path]) -> list[Path]:
    """The files with ``shot_{angle}.png`` in place of four like ``shot_0.png``, ``shot_45.png`` and so on.

    Four angle images are named so, where no other of these files has their name with another number.
    """
    groups: dict[tuple[Path, str, str], list[Path]] = {}
    for path in files:
        groups.setdefault((path.parent, _numbered(path)[0], path.suffix), []).append(path)
    together = list[Path]()
    for (folder, name, suffix), group in groups.items():
        angles = {_numbered(path)[1] for path in group} == {"0", "45", "90", "135"}
        together += [folder / f"{name}{{angle}}{suffix}"] if angles else group
    return together


def _named_as_frames(folder: Path) -> list[Path]:
    """The files of a folder whose names are those of frames; of a set of `polsep render`, its views without truth.

    Results that lie beside its frames, by their sidecars, and maps of a calibration are none.
    """
    seen = [p for p in folder.iterdir() if not p.name.startswith(".")]
    results = {name for p in seen if p.suffix.lower() == ".json" for name in result_names(p)}
    files = [p for p in seen if p.suffix.lower() in FRAME_FILES and p.name not in results]
    files = [p for p in files if p.suffix.lower() != ".npz" or not holds_maps(p)]
    views = [p for p in files if _VIEW.fullmatch(p.name)]
    return views if views and (folder / "options.json").is_file() else files


def _numbered(path: Path) -> tuple[str, str]:
    """The stem of a file without the digits at its end, and those digits."""
    name = path.stem.rstrip("0123456789")
    return name, path.stem[len(name) :]


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """A key by which numbers in names count as numbers."""
    parts = _NUMBER.split(path.name)
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts if part]


def _read_files(files: list[Path], options: ReadOptions, first: int) -> Iterator[Frame | DamagedFrame]:
    """One frame of each file."""
    for index, path in enumerate(files[first:], first):
        try:
            frames = list(islice(read_frames(path, options), 2))
            if len(frames) != 1:
                found = max(frames[0].count, 2) if frames else 0
                raise input_error(path, f"expected one frame per file of a folder, found {found}")
        except (ValueError, OSError) as error:
            yield DamagedFrame(index, one_line(error))
            continue
        yield replace(frames[0], index=index, count=len(files))


def _read_stack(path: Path, options: ReadOptions, count: int, first: int) -> Iterator[Frame | DamagedFrame]:
    """The frames of one file of about ``count`` from ``first`` on; reading starts anew behind a damaged one.

    It ends where the file does, as films need not say their length. Beyond ``count`` it gives up where the reason stays
    the same, which is none of a frame, and behind as many damaged frames in turn as a film has between key frames.
    """
    good, before = first, ""
    while True:
        try:
            for frame in read_frames(path, options, first):
                good = first = frame.index + 1
                count = frame.count
                yield frame
            return
        except (ValueError, OSError) as error:
            reason = one_line(error)
            if first >= count and (reason == before or first >= good + KEY_FRAMES):
                return
            yield DamagedFrame(first, reason)
            first, before = first + 1, reason
