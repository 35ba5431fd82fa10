"""Names of files, to be known before anything heavy is imported: extensions, and templates of four angle images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

#: Camera raw files that LibRaw reads, JPEG, films that may be lossless, and all films.
CAMERA_RAW = (".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".iiq")
JPEG = (".jpg", ".jpeg")
LOSSLESS = (".mkv", ".avi", ".mov", ".nut")
FILMS = (*LOSSLESS, ".mp4", ".m4v", ".webm")
#: Placeholder in the path of four angle images, and the angles [degrees] that stand in its place.
PLACEHOLDER, ANGLES = "{angle}", (0, 45, 90, 135)


def needs_rawpy(paths: Sequence[str]) -> bool:
    """True if a path is of a camera raw file, by its extension."""
    return any(Path(path).suffix.lower() in CAMERA_RAW for path in paths)


def is_film(path: str) -> bool:
    """True if a path is of a film, by its extension."""
    return Path(path).suffix.lower() in FILMS


def template_files(path: str | Path) -> list[Path]:
    """The files of a path: four, in the order of `ANGLES`, where it has the placeholder, else the one."""
    if PLACEHOLDER not in str(path):
        return [Path(path)]
    return [Path(str(path).replace(PLACEHOLDER, str(angle))) for angle in ANGLES]
