"""Reader of separated frames that polsep wrote: EXR by layers, NPZ, and numbered sequences of them.

The twin of `separation_writer` and `sequences`. Half floats become float32. TIFF and PNG sets and lossless films are
not read: PNG limits light, and sets are many files for one frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.npy import read_arrays
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.sidecars import read_report
from polsep.io.store.errors import InputError, as_path, input_error, naming, refuse_pipe
from polsep.light.light_color import LightColor, color_notes, is_to_be_found, stated_gains
from polsep.separation.report import SeparatedFrame

Floats = NDArray[np.float32]
#: Arrays of a file by the names of `SeparatedFrame`.
Images = dict[str, Floats]

#: Files that hold a separated frame.
SUFFIXES = (".exr", ".npz")
_MAPS = ("dolp", "aolp", "valid")
#: Shapes behind height and width, of all but the images.
_BESIDE: dict[str, tuple[tuple[int, ...], ...]] = {**dict.fromkeys(_MAPS, ((),)), "error": ((2,),)}
_NUMBERED = re.compile(r"(?P<stem>.+)_(?P<number>\d{4,})\.(exr|npz)")
#: Numbers from the first to the last of a sequence: at most so many for each file, and so many besides.
_SPARSE, _GAP = 10, 1000


@dataclass(frozen=True)
class NumberedFiles:
    """A sequence of separated frames: ``stem``, and the file of each number from ``first`` on, None where missing."""

    stem: str
    first: int
    files: tuple[Path | None, ...]

    def missing(self) -> list[int]:
        """The numbers that have no file."""
        return [number for number, path in enumerate(self.files, self.first) if path is None]


def read_separated(path: str | Path) -> SeparatedFrame:
    """The frame in a file of polsep, bit for bit, without its report.

    Files of diffuse and specular alone, as of `polsep video` and `polsep edit`, are valid everywhere and of DoLP and
    AoLP 0. Raises InputError, also on values that no separation has (below 0, infinite, not a number) and on too large
    sizes in the header.
    """
    path = as_path(path)
    suffix = path.suffix.lower()
    with naming(path):
        path.stat()  # raises where nothing is
    if suffix not in SUFFIXES:
        found = "a directory" if path.is_dir() else repr(suffix) if suffix else "no extension"
        raise input_error(path, f"expected a separated frame ({', '.join(SUFFIXES)}), found {found}")
    planes = read_exr_layers(path) if suffix == ".exr" else None
    with naming(path):
        refuse_pipe(path)
        images = _from_archive(path) if planes is None else _from_layers(planes)
        return _as_frame(images, path.name)


def open_separated(path: Path, light_color: LightColor | str = "auto") -> tuple[SeparatedFrame, list[str]]:
    """A frame that was separated before, with the report beside its file, and notes for the user, a line each.

    ``light_color`` of the report is the one that is stated here, else the one beside the file; without either it is
    left out and a note says so. Raises InputError on what cannot be read.
    """
    frame = replace(read_separated(path), report=read_report(path))
    notes = list(frame.report.get("warnings", ()))
    if not is_to_be_found(light_color):
        frame.report["light_color"] = stated_gains(light_color, frame.diffuse.shape[-1])
        notes += color_notes(light_color, frame.diffuse.shape[-1])
    elif "light_color" not in frame.report and frame.diffuse.shape[-1] > 1:
        notes.append(f"the lamp's colour is neither stated nor in {path.stem}.json beside the file: taken for white")
    return frame, notes


def is_separated(path: Path) -> bool:
    """True for a name of an EXR file, and for an NPZ archive that `holds_separated`: raw frames come in NPZ too."""
    suffix = path.suffix.lower()
    return suffix == ".exr" or (suffix == ".npz" and holds_separated(path))


def holds_separated(path: Path) -> bool:
    """True for an NPZ archive with the names of a separated frame's arrays, False for any other."""
    try:
        refuse_pipe(path)
        return {"diffuse", "specular"} <= set(read_arrays(path, ())[1])
    except (ValueError, OSError):
        return False


def _from_layers(planes: Mapping[str, NDArray[Any]]) -> Images:
    """Images from channels by their full names; other channels are ignored, but for those of a material's maps."""
    names = set(planes)
    if {"diffuse.R", "normal.X", "roughness.Y"} <= names and not {"R", "Y"} & names:  # frames among passes have a total
        raise InputError("expected a separated frame, found maps of a material: reflectances, not light")
    images = {}
    for layer in ("diffuse", "specular"):
        channels = next((c for c in ("RGB", "Y") if all(f"{layer}.{color}" in planes for color in c)), None)
        if channels is None:
            found = ", ".join(sorted(planes)[:8])
            raise InputError(f"expected channels {layer}.R, .G and .B, or {layer}.Y, found {found}")
        images[layer] = _stacked(planes, [f"{layer}.{color}" for color in channels])
    images |= {name: planes[f"{name}.Y"].astype(np.float32) for name in _MAPS if f"{name}.Y" in planes}
    errors = [f"error.{name}" for name in ("diffuse", "specular")]
    return images | ({"error": _stacked(planes, errors)} if all(name in planes for name in errors) else {})


def _stacked(planes: Mapping[str, NDArray[Any]], names: list[str]) -> Floats:
    return np.stack([planes[name] for name in names], axis=-1).astype(np.float32)


def _from_archive(path: Path) -> Images:
    """Images from arrays by name."""
    arrays, names = read_arrays(path, ("diffuse", "specular", *_MAPS, "error"))
    if not {"diffuse", "specular"} <= set(arrays):
        raise InputError(f"expected arrays diffuse and specular, found {', '.join(names[:8]) or 'none'}")
    for image in (arrays["diffuse"], arrays["specular"]):
        if image.dtype not in (np.float32, np.float16) or image.ndim != 3 or image.shape[2] not in (1, 3):
            raise InputError(
                f"expected float32 or float16 arrays [h, w, 3 or 1], found {image.dtype} {list(image.shape)}"
            )
    return {name: array.astype(np.float32, copy=False) for name, array in arrays.items()}


def _as_frame(images: Images, source: str) -> SeparatedFrame:
    """The frame of images by name, once shapes and values are checked."""
    diffuse, specular = images["diffuse"], images["specular"]
    if diffuse.shape != specular.shape:
        shapes = f"{list(diffuse.shape)} and {list(specular.shape)}"
        raise InputError(f"expected diffuse and specular of one shape, found {shapes}")
    size = diffuse.shape[:2]
    for name, image in images.items():
        if image.shape[:2] != size or image.shape[2:] not in _BESIDE.get(name, ((1,), (3,))):
            raise InputError(f"expected {name} like the images {list(size)}, found {list(image.shape)}")
        wrong = int(np.count_nonzero(~((image >= 0) & (image < np.inf))))
        if wrong:
            unit = "values" if name in _BESIDE else "light"
            raise InputError(f"expected finite {name} {unit} of 0 or more, found {wrong} other samples")
    zero = np.zeros(size, np.float32)
    dolp, aolp = (images.get(name, zero) for name in ("dolp", "aolp"))
    valid = images["valid"] > 0.5 if "valid" in images else np.ones(size, bool)
    report = {"statistics": {}, "warnings": [], "source": source, "method": "opened as a result"}
    return SeparatedFrame(diffuse, specular, valid, dolp, aolp, report, images.get("error"))


def find_numbered(folder: Path) -> NumberedFiles:
    """The sequence in a folder, as `polsep video` writes it: STEM_000123.exr. Hidden files are not of it.

    Raises InputError unless there is one, and where most numbers lack a file, as in names with the time.
    """
    found: dict[str, dict[int, Path]] = {}
    for path in sorted(folder.iterdir()):
        if not path.name.startswith(".") and (match := _NUMBERED.fullmatch(path.name)) is not None:
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
    if last - first >= _SPARSE * len(frames) + _GAP:
        raise input_error(
            folder,
            f"expected consecutive numbers, found {len(frames)} from {first} to {last}; name single files themselves",
        )
    return NumberedFiles(Path(name).stem, first, tuple(frames.get(number) for number in range(first, last + 1)))
