"""File name extensions of photographs and films, to be known before anything heavy is imported."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

#: Camera raw files that LibRaw reads, JPEG, films that may be lossless, and all films.
CAMERA_RAW = (".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".iiq")
JPEG = (".jpg", ".jpeg")
LOSSLESS = (".mkv", ".avi", ".mov", ".nut")
FILMS = (*LOSSLESS, ".mp4", ".m4v", ".webm")


def needs_rawpy(paths: Sequence[str]) -> bool:
    """True if a path is of a camera raw file, by its extension."""
    return any(Path(path).suffix.lower() in CAMERA_RAW for path in paths)


def is_film(path: str) -> bool:
    """True if a path is of a film, by its extension."""
    return Path(path).suffix.lower() in FILMS
