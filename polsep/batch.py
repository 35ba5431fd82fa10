"""Files in, files out: read every frame of every file, separate it, write it, and continue after a failure.

A frame's outputs appear together or not at all. Inputs are never overwritten. Outputs do not depend on the time or on
the order of files, so the same command on the same files writes the same bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from os.path import realpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

from polsep.io.raw.extensions import template_files
from polsep.io.raw.frames import Frame, ReadOptions, output_stem, read_frames, refuse_forgotten
from polsep.io.results.separation_writer import planned_outputs, write_separation
from polsep.io.store.atomic import OutputError, is_disk_full, refuse_existing, refuse_inputs, require_writable
from polsep.io.store.errors import one_line
from polsep.light.light_color import LightColor
from polsep.methods import find_method, release_memory
from polsep.pipeline import Result, separate_capture, with_lamp_dolp
from polsep.sensor.levels import BlackFrame, ForgottenLevel

if TYPE_CHECKING:
    from polsep.photographs import PhotoOptions


@dataclass(frozen=True)
class SeparateOptions:
    """Arguments of `pipeline.separate` for every frame."""

    method: str = "auto"
    light_color: LightColor | str = "auto"
    device: str = "auto"
    full: bool = False
    lamp_dolp: float | None = None


@dataclass(frozen=True)
class WriteOptions:
    """Directory and ``format`` of the results, one of `io.results.separation_writer.FORMATS`.

    ``stokes``: with Stokes images, for EXR files alone. ``kept``: files that no output may replace, besides frames.
    Raises OutputError on Stokes images in others.
    """

    directory: Path = Path("polsep-out")
    format: str = "exr"
    overwrite: bool = False
    stokes: bool = False
    kept: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.stokes and self.format != "exr":
            raise OutputError(f"expected the format exr for Stokes images, found {self.format}")


@dataclass(frozen=True)
class Outcome:
    """Result of one frame, or of a file that could not be read: the files written, or the error in one line.

    ``last``: nothing more comes of that file.
    """

    source: str
    written: tuple[Path, ...] = ()
    warnings: tuple[str, ...] = ()
    report: dict[str, Any] = field(default_factory=dict)
    error: str | None = None
    last: bool = True


def separate_files(
    paths: Sequence[str], read: ReadOptions, options: SeparateOptions, write: WriteOptions
) -> Iterator[Outcome]:
    """Separate every frame of the files and yield one outcome per frame, or one with an error for a bad file.

    Raises OutputError before any work when two inputs have one name. A frame whose outputs would replace an input, or
    one of another frame, is refused, also with ``overwrite``. So is one whose white level was likely forgotten, unless
    a frame before it used the range of that level. A failure ends its file, and a full disk raises OutputError.
    """
    require_writable(write.directory)
    _refuse_equal_names(paths)
    claimed = {realpath(file): "is an input" for path in paths for file in template_files(path)}
    claimed |= {realpath(path): "is an input" for path in write.kept}
    trusted: set[float | None] = set()  # white levels
    for path in paths:
        remaining: int | None = None  # frames of the file that are not written yet, None before the first is read
        try:
            for frame in read_frames(path, read):
                remaining, level = frame.count - frame.index, frame.white_level
                if not any(isinstance(note, ForgottenLevel | BlackFrame) for note in frame.notes):
                    trusted.add(level)
                if level not in trusted:
                    refuse_forgotten(path, frame)
                outputs = planned_outputs(write.directory, frame.stem, write.format)
                if clash := sorted({realpath(output) for output in outputs} & claimed.keys()):
                    raise OutputError(f"{path}: expected outputs of its own, found that {clash[0]} {claimed[clash[0]]}")
                refuse_existing(write.directory, outputs, write.overwrite)
                stem, last = frame.stem, path == paths[-1] and frame.count == 1
                separated = _separate_frame(path, frame, read, options, write.stokes)
                del frame  # like the rest, memory that the writer can use
                if last:
                    release_memory()
                outcome = _write_frame(path, stem, separated, write)
                claimed |= {realpath(output): f"is of {path}" for output in outcome.written}
                remaining -= 1
                yield replace(outcome, last=remaining <= 0)
            if remaining is None:
                raise ValueError(f"{path}: expected frames, found none")
        except (ValueError, OSError, MemoryError, RuntimeError) as error:
            if is_disk_full(error):
                raise
            more = f"; {remaining - 1} frames behind it are left out" if remaining and remaining > 1 else ""
            yield Outcome(path, error=(one_line(error) or type(error).__name__) + more)


def separate_photographs(
    paths: Sequence[str], photos: PhotoOptions, read: ReadOptions, options: SeparateOptions, write: WriteOptions
) -> Outcome:
    """Separate the photographs of one scene through a turned filter, as one frame with the name of the first.

    The report's ``photographs`` holds their angles, exposures and alignment. Raises ValueError.
    """
    from polsep.photographs import ANY_PAIR, PAIR, read_measurements

    if photos.angles_deg == PAIR:
        find_method(options.method, ANY_PAIR)
    outputs = planned_outputs(write.directory, output_stem(paths[0]), write.format)
    refuse_inputs(outputs, [Path(path) for path in paths])
    refuse_existing(write.directory, outputs, write.overwrite)
    frame, facts = read_measurements(paths, photos, read)
    separated = _separate_frame(paths[0], frame, read, options, write.stokes)
    separated.report["photographs"] = facts
    return _write_frame(paths[0], frame.stem, separated, write)


def _separate_frame(path: str, frame: Frame, read: ReadOptions, options: SeparateOptions, stokes: bool) -> Result:
    """A frame's images with all that its file says, without its capture; ``stokes``: with Stokes images."""
    try:
        capture = with_lamp_dolp(frame.data, options.lamp_dolp)
        separated = separate_capture(capture, options.method, options.light_color, options.device, options.full)
    except (ValueError, RuntimeError, MemoryError) as error:
        raise ValueError(f"{path}: {str(error) or 'out of memory'}") from error
    separated.report["source"] = Path(path).name
    separated.report["settings"] = read.settings()
    separated.report["warnings"] = [*frame.notes, *separated.report["warnings"]]
    separated.report.update(frame.taken())
    return replace(separated.with_stokes() if stokes else separated, capture=None)


def _write_frame(path: str, stem: str, separated: Result, write: WriteOptions) -> Outcome:
    """Write a separated frame."""
    written = write_separation(separated, write.directory, stem, write.format, write.overwrite)
    return Outcome(path, tuple(written), tuple(separated.report["warnings"]), separated.report)


def _refuse_equal_names(paths: Sequence[str]) -> None:
    stems = Counter(output_stem(path) for path in paths)
    repeated = [stem for stem, count in stems.items() if count > 1]
    if repeated:
        same = ", ".join(path for path in paths if output_stem(path) == repeated[0])
        raise OutputError(f"expected inputs of different names, found {same}: their outputs would be one file")
