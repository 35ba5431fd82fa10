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

from polsep.camera import Layout
from polsep.io.frames import Frame, ReadOptions, read_frames
from polsep.io.outputs import OutputError, planned_outputs, write_separation
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
    """Where and how results are written; ``format`` is one of `io.outputs.FORMATS`."""

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

    Raises OutputError before any work when two inputs would write the same files, or one would overwrite an input.
    """
    _refuse_collisions(paths, write)
    for path in paths:
        try:
            for frame in read_frames(path, read):
                yield _separate_frame(path, frame, read, options, write)
        except (ValueError, OSError, MemoryError) as error:
            yield Outcome(path, error=_one_line(error))


def _separate_frame(
    path: str, frame: Frame, read: ReadOptions, options: SeparateOptions, write: WriteOptions
) -> Outcome:
    found = separate_capture(frame.data, options.method, options.light_color, options.device, options.full)
    said = read.layout or Layout()
    found.report["source"] = Path(path).name
    found.report["settings"] = {
        "layout": said.spec,
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
    return " ".join(str(error).split()) or type(error).__name__


def _refuse_collisions(paths: Sequence[str], write: WriteOptions) -> None:
    stems = Counter(Path(path).stem for path in paths)
    repeated = [stem for stem, count in stems.items() if count > 1]
    if repeated:
        same = ", ".join(path for path in paths if Path(path).stem == repeated[0])
        raise OutputError(f"expected inputs of different names, found {same}: their outputs would be one file")
    inputs = {realpath(path) for path in paths}
    for stem in stems:
        for output in planned_outputs(write.directory, stem, write.format):
            if realpath(output) in inputs:
                raise OutputError(f"expected an output directory without the inputs, found that {output} is an input")
