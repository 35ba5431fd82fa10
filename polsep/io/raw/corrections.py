"""Corrections of raw frames, from the files that hold them: a calibration, and frames with the lamp off."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from polsep.io.raw.frames import Frame, ReadOptions, read_frames
from polsep.io.raw.sequences import DamagedFrame, input_files, open_sequence
from polsep.io.store.calibrations import read_calibration
from polsep.io.store.errors import InputError, input_error
from polsep.sensor.ambient import equally_exposed, unit_remarks
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Mosaic
from polsep.sensor.corrections import Corrections

#: Digits of hashes in reports, by which a run that is resumed knows its files again.
DIGITS = 16
#: Called with a file and each frame of it, before that is used.
Check = Callable[[Path, Frame], None]


def with_corrections(read: ReadOptions, calibration: Path | None, ambient: Sequence[Path] = ()) -> ReadOptions:
    """The options with the corrections of files: a calibration, and the mean of all frames of ``ambient``.

    Ambient frames are read with the same options and calibrated too. Raises InputError.
    """
    if calibration is None and not ambient:
        return read
    paths = [path for path in (calibration, *ambient) if path is not None]
    missing = [path for path in paths if not path.exists()]
    if missing:
        raise input_error(missing[0], "expected a file, found nothing at this path")
    files = [file for path in paths for file in input_files(path)]
    stamps = tuple((file, (found := file.stat()).st_mtime_ns, found.st_size) for file in files)
    return _read_corrected(read, calibration, tuple(ambient), stamps)


@lru_cache(maxsize=4)  # viewers ask with every frame
def _read_corrected(
    read: ReadOptions, calibration: Path | None, ambient: tuple[Path, ...], stamps: tuple[tuple[Path, int, int], ...]
) -> ReadOptions:
    sources: dict[str, object] = {}
    measured = None if calibration is None else read_calibration(calibration)
    if calibration is not None:
        digest = hashlib.sha256(calibration.read_bytes()).hexdigest()[:DIGITS]  # its text knows the hash of its maps
        sources |= {"calibration": calibration.name, "calibration_sha256": digest}
    corrections = Corrections(measured, None, sources)
    if ambient:
        times, notes = list[float | None](), list[str]()

        def keep_facts(_: Path, frame: Frame) -> None:
            times.append(frame.exposure)
            notes.extend(frame.notes)

        levels = measured and Calibration(measured.layout, measured.white_level, measured.size, measured.black_level)
        raw = replace(read, corrections=Corrections(levels))
        corrections = corrections.with_ambient(read_mosaics(ambient, raw, keep_facts))
        assert corrections.ambient is not None
        digest = hash_samples(corrections.ambient.data)
        sources |= {"ambient": [path.name for path in ambient], "ambient_sha256": digest}
        said = unit_remarks(notes)
        corrections = replace(corrections, ambient_exposure_s=_one_time(ambient[0], times), ambient_remarks=said)
    return replace(read, corrections=corrections)


def _one_time(path: Path, times: Sequence[float | None]) -> float | None:
    """The exposure time of lamp-off frames [s], None where not all say it. Raises InputError on different ones."""
    known = [time for time in times if time is not None]
    if known and not equally_exposed(known):
        found = f"{min(known):.4g} s and {max(known):.4g} s"
        raise input_error(path, f"expected lamp-off frames of one exposure time, found {found}")
    return known[0] if len(known) == len(times) else None


def hash_samples(samples: Any) -> str:
    """The first `DIGITS` of the sha256 of an array's samples, by which reports know it again."""
    return hashlib.sha256(np.ascontiguousarray(samples).tobytes()).hexdigest()[:DIGITS]


def read_mosaics(paths: Sequence[Path], read: ReadOptions, check: Check | None = None) -> Iterator[Mosaic]:
    """All frames of files and folders, one after the other. Raises InputError on what is not a raw mosaic.

    ``check``: is called with the file or folder and the frame before it is used.
    """
    for path in paths:
        frames = open_sequence(path, read).begin(0) if path.is_dir() else read_frames(path, read)
        for frame in frames:
            if isinstance(frame, DamagedFrame):
                raise InputError(frame.reason)
            if not isinstance(frame.data, Mosaic):
                raise input_error(path, "expected a raw mosaic, found four angle images")
            if check is not None:
                check(path, frame)
            yield frame.data
