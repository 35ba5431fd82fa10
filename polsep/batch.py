"""Files in, files out: read every frame of every file, separate it, write it, and go on after a failure.

A frame's outputs appear whole or not at all. Inputs are never overwritten. Nothing in an output depends on the time or
on the order of files, so the same command on the same files writes the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from os.path import realpath
from pathlib import Path
from typing import Any

from polsep.io.raw.frames import Frame, ReadOptions, output_stem, read_frames
from polsep.io.results.separation_writer import planned_outputs, write_separation
from polsep.io.store.atomic import OutputError, refuse_existing
from polsep.pipeline import LightColor, separate_capture


@dataclass(frozen=True)
class SeparateOptions:
    """How frames are separated; the fields are arguments of `pipeline.separate`."""

    method: str = "auto"
    light_color: LightColor | str = (1.0, 1.0, 1.0)
    device: str = "auto"
    full: bool = False


@dataclass(frozen=True)
class WriteOptions:
    """Where and how results are written; ``format`` is one of `io.results.separation_writer.FORMATS`."""

    directory: Path = Path("polsep-out")
    format: str = "exr"
    overwrite: bool = False


@dataclass(frozen=True)
class Outcome:
    """What became of one frame, or of a file that could not be read: the files written, or the error in one line."""

    source: str
    written: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)
    error: str | None = None


def separate_files(
    paths: Sequence[str], read: ReadOptions, options: SeparateOptions, write: WriteOptions
) -> Iterator[Outcome]:
    """Separate every frame of the files, one outcome per frame; a bad file is one with an error, and the rest go on.

    Raises OutputError before any work when two inputs have one name. A frame whose outputs would replace an input, or
    what another frame has just given, is refused, also with ``overwrite``.
    """
    _refuse_equal_names(paths)
    angles = ("0", "45", "90", "135")
    taken = {realpath(path.replace("{angle}", angle)): "is an input" for path in paths for angle in angles}
    for path in paths:
        try:
            for frame in read_frames(path, read):
                outputs = planned_outputs(write.directory, frame.stem, write.format)
                if clash := sorted({realpath(output) for output in outputs} & taken.keys()):
                    raise OutputError(f"{path}: expected outputs of its own, found that {clash[0]} {taken[clash[0]]}")
                refuse_existing(write.directory, outputs, write.overwrite)
                outcome = _separate_frame(path, frame, read, options, write)
                taken |= {realpath(output): f"is of {path}" for output in outcome.written}
                yield outcome
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            yield Outcome(path, error=_one_line(error))


def _separate_frame(
    path: str, frame: Frame, read: ReadOptions, options: SeparateOptions, write: WriteOptions
) -> Outcome:
    try:
        found = separate_capture(frame.data, options.method, options.light_color, options.device, options.full)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{path}: {error}") from error
    found.report["source"] = Path(path).name
    found.report["settings"] = {
        "layout": read.layout.spec if read.layout else None,
        "black_level": read.black_level,
        "white_level": read.white_level,
        "size": list(read.size) if read.size else None,
        "pixel_format": read.pixel_format,
        "pages": read.pages,
    }
    found.report["warnings"] = [*frame.notes, *found.report["warnings"]]
    written = write_separation(found, write.directory, frame.stem, write.format, write.overwrite)
    return Outcome(path, tuple(written), tuple(found.report["warnings"]), found.report)


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:500] or type(error).__name__


def _refuse_equal_names(paths: Sequence[str]) -> None:
    stems = Counter(output_stem(path) for path in paths)
    repeated = [stem for stem, count in stems.items() if count > 1]
    if repeated:
        same = ", ".join(path for path in paths if output_stem(path) == repeated[0])
        raise OutputError(f"expected inputs of different names, found {same}: their outputs would be one file")
