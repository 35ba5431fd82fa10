"""Separated frames as polsep wrote them: EXR with the layers diffuse and specular, NPZ, and numbered sequences of them.

Images come as float32 ``[h, w, C]``, C = 3 or 1, linear light. Half floats are read as they are. TIFF and PNG sets and
lossless films are not read: PNG limits light, and sets are many files for one frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.errors import InputError, decoding, input_error, naming
from polsep.io.exr import read_exr_layers

Floats = NDArray[np.float32]
Pair = tuple[Floats, Floats]

#: Files that hold a separated frame.
SUFFIXES = (".exr", ".npz")
_NUMBERED = re.compile(r"(?P<stem>.+)_(?P<number>\d{4,})\.(exr|npz)")


@dataclass(frozen=True)
class Numbered:
    """A sequence of separated frames: ``stem``, and for each number from ``first`` on its file, None where it lacks."""

    stem: str
    first: int
    files: tuple[Path | None, ...]

    def missing(self) -> list[int]:
        """The numbers in between that have no file."""
        return [number for number, path in enumerate(self.files, self.first) if path is None]


def read_separated(path: Path) -> Pair:
    """Diffuse and specular images of a file that polsep wrote. Raises InputError.

    Also refuses values that no separation has: below 0, infinite, not a number.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise input_error(
            path, f"expected a separated frame ({', '.join(SUFFIXES)}), found {suffix or 'no extension'!r}"
        )
    planes = read_planes(path) if suffix == ".exr" else None
    with naming(path):
        found = _from_archive(path) if planes is None else _from_layers(planes)
        for name, image in zip(("diffuse", "specular"), found, strict=True):
            wrong = int(np.count_nonzero(~((image >= 0) & (image < np.inf))))
            if wrong:
                raise InputError(f"expected finite {name} light of 0 or more, found {wrong} other samples")
    return found


def read_planes(path: Path) -> dict[str, NDArray[np.float32]]:
    """`read_exr_layers`, whose every failure is an InputError that names the file."""
    try:
        return read_exr_layers(path)
    except OSError:
        with naming(path):
            raise


def _from_layers(planes: Mapping[str, NDArray[Any]]) -> Pair:
    """Images from channels by their full names."""
    images = []
    for layer in ("diffuse", "specular"):
        for colors in ("RGB", "Y"):
            names = [f"{layer}.{color}" for color in colors]
            if all(name in planes for name in names):
                images.append(np.stack([planes[name] for name in names], axis=-1).astype(np.float32))
                break
        else:
            found = ", ".join(sorted(planes)[:8])
            raise InputError(f"expected channels {layer}.R, .G and .B, or {layer}.Y, found {found}")
    return _of_one_shape(images[0], images[1])


def _from_archive(path: Path) -> Pair:
    """Images from arrays by name."""
    with path.open("rb") as stream, decoding("NPZ"), np.load(stream, allow_pickle=False) as archive:
        missing = [name for name in ("diffuse", "specular") if name not in archive.files]
        if missing:
            found = ", ".join(archive.files[:8]) or "none"
            raise InputError(f"expected arrays diffuse and specular, found {found}")
        images = [np.asarray(archive[name]) for name in ("diffuse", "specular")]
    for image in images:
        if image.dtype != np.float32 or image.ndim != 3 or image.shape[2] not in (1, 3) or 0 in image.shape:
            raise InputError(f"expected arrays float32 [h, w, 3 or 1], found {image.dtype} {list(image.shape)}")
    return _of_one_shape(images[0], images[1])


def _of_one_shape(diffuse: Floats, specular: Floats) -> Pair:
    if diffuse.shape != specular.shape:
        shapes = f"{list(diffuse.shape)} and {list(specular.shape)}"
        raise InputError(f"expected diffuse and specular of one shape, found {shapes}")
    return diffuse, specular


def find_numbered(folder: Path) -> Numbered:
    """The sequence in a folder, as `polsep video` writes it: STEM_000123.exr. Raises InputError unless there is one."""
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.iterdir()):
        if (match := _NUMBERED.fullmatch(path.name)) is not None:
            frames = found.setdefault(match["stem"] + path.suffix, {})
            if frames.setdefault(int(match["number"]), path) != path:
                raise input_error(
                    folder, f"expected each number once, found {frames[int(match['number'])].name} and {path.name}"
                )
    if not found:
        raise input_error(
            folder, "expected a sequence STEM_000123.exr or .npz, found none; name single files themselves"
        )
    if len(found) > 1:
        raise input_error(folder, f"expected one sequence, found {len(found)}: {', '.join(found)}")
    ((name, frames),) = found.items()
    first, last = min(frames), max(frames)
    return Numbered(Path(name).stem, first, tuple(frames.get(number) for number in range(first, last + 1)))
