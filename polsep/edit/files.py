"""Edits on files: separated frames in, edited frames out, single ones and sequences.

Nothing is skipped silently: a missing or damaged frame ends a sequence, or is reported and left out. Inputs are never
overwritten. The same recipe on the same files writes the same bytes, however often a run was stopped.

Previews have the exposure of the input, or less where edits add light; in sequences, that of the first frame.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from os.path import realpath
from pathlib import Path
from typing import Any

import numpy as np

from polsep.compute.workers import map_ahead
from polsep.edit.images import Maps, SeparatedImages
from polsep.edit.parameters import EditError
from polsep.edit.recipe import Recipe, apply, recipe_as_data, recipe_from_text
from polsep.io.assets.maps import hash_map, read_map
from polsep.io.results.edited import EditedFrame, read_recipe_text, write_edited, write_preview
from polsep.io.results.previews import exposure_of, toned
from polsep.io.results.separation_reader import NumberedFiles, find_numbered, read_separated
from polsep.io.results.separation_writer import planned_outputs
from polsep.io.results.sequences import Picture, SequenceKind, SequenceWriter, is_unfinished, read_rate
from polsep.io.store.atomic import OutputError, is_disk_full, refuse_existing, require_writable
from polsep.io.store.errors import InputError, input_error, one_line
from polsep.video.panels import black_picture, draw_panels
from polsep.video.recordings import ON_DAMAGE, Progress, write_pictures

#: Number of frames that are read and edited at once.
AT_ONCE = 2


@dataclass(frozen=True)
class Work:
    """A ``recipe`` with the images that it names, and the sha256 of their files."""

    recipe: Recipe
    maps: Maps = field(default_factory=dict)
    hashes: dict[str, str] = field(default_factory=dict)

    def as_data(self) -> dict[str, Any]:
        """Recipe and hashes for sidecars."""
        return {"recipe": recipe_as_data(self.recipe), "images": self.hashes}


@dataclass(frozen=True)
class EditTarget:
    """The folder of edited frames; ``kind``: of sequences; ``damaged``: of `ON_DAMAGE`, for sequences with gaps."""

    directory: Path
    overwrite: bool = False
    kind: SequenceKind = field(default_factory=SequenceKind)
    damaged: str = "stop"

    def __post_init__(self) -> None:
        if self.damaged not in ON_DAMAGE:
            raise ValueError(f"expected stop or skip for damaged frames, found {self.damaged!r}")
        if self.kind.format != "exr":
            raise ValueError(f"expected exr as format of edited sequences, found {self.kind.format!r}")


@dataclass(frozen=True)
class Edited:
    """The outcome of one file: the files written, or the error in one line."""

    source: Path
    written: tuple[Path, ...] = ()
    error: str | None = None


def read_recipe(path: Path) -> Recipe:
    """The recipe of a file. Raises InputError."""
    try:
        return recipe_from_text(read_recipe_text(path))
    except EditError as error:
        raise input_error(path, error) from error


def load_work(recipe: Recipe, folder: Path) -> Work:
    """Read the images that a recipe names, relative to ``folder``. Raises InputError."""
    paths = {name: folder / name for name in recipe.images()}
    maps = {name: read_map(paths[name], kind) for name, kind in recipe.images().items()}
    for name in (name for name, kind in recipe.images().items() if kind == "mask" and not maps[name].any()):
        raise input_error(paths[name], "expected a mask that holds pixels, found none: nothing would be edited")
    return Work(recipe, maps, {name: hash_map(path) for name, path in paths.items()})


def planned_edits(paths: Sequence[Path], target: EditTarget) -> list[Path]:
    """Every file that edits of these frames and folders may write; none of those that cannot be edited.

    Raises OutputError where two of them would write one file.
    """
    planned = dict[Path, Path]()
    for path in paths:
        try:
            outputs = _planned_edit(path, target)
        except (ValueError, OSError):  # its own edit says so, and the others go on
            continue
        if shared := [output for output in outputs if output in planned]:
            same = f"{planned[shared[0]]}, {path}: both would write {shared[0]}"
            raise OutputError(f"expected inputs of different names, found {same}")
        planned |= dict.fromkeys(outputs, path)
    return list(planned)


def _planned_edit(path: Path, target: EditTarget) -> list[Path]:
    """The files of the edit of one frame or folder. Raises ValueError or OSError where it cannot be edited."""
    if not path.is_dir():
        return planned_outputs(target.directory, path.stem, "exr")
    found = find_numbered(path)
    names = (f"{found.stem}{end}" for end in (".png", ".jsonl", ".json", "_preview.mp4"))
    return [*_frame_paths(found, target), *(target.directory / name for name in names)]


def edit_files(paths: Sequence[Path], work: Work, target: EditTarget) -> Iterator[Edited]:
    """Edit single frames; a bad file gives an outcome with an error, and the rest are edited.

    Raises OutputError before any work if nothing may be written; and on a full disk.
    """
    if paths:
        require_writable(target.directory)
    inputs = {realpath(path) for path in paths}
    for path in paths:
        try:
            targets = planned_outputs(target.directory, path.stem, "exr")
            if clash := [str(output) for output in targets if realpath(output) in inputs]:
                raise OutputError(f"{path}: expected outputs apart from inputs, found that {clash[0]} is an input")
            refuse_existing(target.directory, targets, target.overwrite)
            frame = _edited_frame(path, work)
            yield Edited(path, tuple(write_edited(frame, target.directory, path.stem, target.overwrite)))
        except (ValueError, OSError, MemoryError) as error:
            if is_disk_full(error):
                raise
            yield Edited(path, error=one_line(error) or type(error).__name__)


def _edited_frame(path: Path, work: Work) -> EditedFrame:
    """One file's frame, edited, and its preview."""
    before, after = _edit(path, work)
    gain = _exposure(before, after)
    sidecar = {"source": path.name, **work.as_data(), "light": _light(before, after), "exposure": gain}
    layers = {"diffuse": after.diffuse, "specular": after.specular, "combined": after.combined}
    return EditedFrame(layers, toned(after.combined, gain), {**sidecar, "warnings": work.recipe.cautions()})


def _edit(path: Path, work: Work) -> tuple[SeparatedImages, SeparatedImages]:
    """A frame before and after the edits. Raises InputError that names its file."""
    frame = read_separated(path)
    before = SeparatedImages(frame.diffuse, frame.specular)
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            after = apply(before, work.recipe, work.maps)
            held = bool(np.isfinite(after.combined).all())
    except EditError as error:
        raise input_error(path, error) from error
    if not held:
        raise input_error(path, "expected light that 32-bit floats hold after the edits, found more")
    return before, after


def _exposure(before: SeparatedImages, after: SeparatedImages) -> float:
    """The gain of previews."""
    lit = [image for image in (before.combined, after.combined) if image.any()]
    return min(map(exposure_of, lit), default=1.0)


def _light(before: SeparatedImages, after: SeparatedImages) -> dict[str, Any]:
    """Mean light of each image before and after the edits."""
    return {"before": before.light(), "after": after.light()}


def edit_sequence(folder: Path, work: Work, target: EditTarget) -> Generator[Progress, None, None]:
    """Edit a sequence of `polsep video` and yield the progress; a stopped run resumes and writes the same bytes.

    Writes STEM_000123.exr (half floats, layers diffuse, specular, combined), STEM.png of the first frame, a preview
    video if ``kind`` has one, STEM.jsonl and STEM.json. Raises ValueError on what cannot be read or written and, with
    ``damaged`` "stop", at the first missing or damaged frame; frames done by then stay.
    """
    found = find_numbered(folder)
    if (missing := found.missing()) and target.damaged == "stop":
        some = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        raise input_error(
            folder, f"expected frames without gaps, found none of number {some}; --damaged skip continues"
        )
    kind = target.kind.at(read_rate(folder / f"{found.stem}.json"))
    before, after = _first_frame(found, work, target.damaged)
    gain, size = _exposure(before, after), before.diffuse.shape
    settings = {
        **work.as_data(),
        "source": folder.resolve().name,
        "film": _film_hashes(folder, found),
        "first": found.first,
        "count": len(found.files),
        "missing": missing,
        "kind": asdict(kind),
        "gain": gain,
        "shape": list(size),
        "colors": size[2],
    }
    _refuse_frames(folder, found, target)
    writer = SequenceWriter(target.directory, found.stem, kind, settings, target.overwrite)
    count = len(found.files)
    unfinished = f"{folder}: the run that writes it is not finished, the frames that are there are edited"
    cautions = [unfinished] * is_unfinished(folder, found.stem) + work.recipe.cautions()
    for caution in cautions:
        yield Progress(writer.first, count, caution)
    yield Progress(writer.first, count)
    pictures = _SequenceEdit(found, work, gain, size, kind.preview).picture
    with closing(map_ahead(pictures, range(writer.first, count), AT_ONCE)) as edited:
        yield from write_pictures(writer, ((picture, {}) for picture in edited), target.damaged, count)
    preview = target.directory / f"{found.stem}.png"
    write_preview(preview, toned(after.combined, gain))
    lines = writer.lines()
    damaged = [line for line in lines if "damaged" in line]
    said = {**settings, "damaged": target.damaged}
    report = {"frames": len(lines), "damaged": damaged, "settings": said, "warnings": cautions}
    yield Progress(count, count, damaged=bool(damaged), written=(preview, *writer.finish(report)))


def _film_hashes(folder: Path, found: NumberedFiles) -> dict[str, str]:
    """The sha256 of the first frame and of any report: a film that was separated anew is another one."""
    files = [next(path for path in found.files if path is not None), folder / f"{found.stem}.json"]
    return {path.name: hash_map(path) for path in files if path.is_file()}


def _first_frame(found: NumberedFiles, work: Work, on_damage: str) -> tuple[SeparatedImages, SeparatedImages]:
    """The first frame before and after the edits; with "skip", the first that can be edited."""
    failed: ValueError | None = None
    for path in found.files:
        try:
            if path is not None:
                return _edit(path, work)
        except ValueError as error:
            if on_damage == "stop":
                raise
            failed = failed or error
    assert failed is not None
    raise failed


def _refuse_frames(folder: Path, found: NumberedFiles, target: EditTarget) -> None:
    """Raise OutputError instead of overwriting inputs, or frames of another run without ``overwrite``."""
    if realpath(folder) == realpath(target.directory):
        raise OutputError(f"expected another directory than that of the input, found {target.directory}")
    if target.overwrite or (target.directory / f".polsep-{found.stem}").exists():
        return
    targets = [*_frame_paths(found, target), target.directory / f"{found.stem}.png"]
    refuse_existing(target.directory, targets, overwrite=False)


def _frame_paths(found: NumberedFiles, target: EditTarget) -> list[Path]:
    """The edited frames of a sequence, also of numbers that are missing."""
    numbers = range(found.first, found.first + len(found.files))
    return [target.directory / f"{found.stem}_{number:06d}.exr" for number in numbers]


@dataclass(frozen=True)
class _SequenceEdit:
    """A sequence and its edits; ``gain`` and ``size [h, w, C]`` are those of the first frame."""

    frames: NumberedFiles
    work: Work
    gain: float
    size: tuple[int, ...]
    preview: bool

    def picture(self, index: int) -> Picture:
        """The edited frame at an index of the sequence; a black one, with the reason, where it cannot be edited."""
        path, number = self.frames.files[index], self.frames.first + index
        if path is None:
            return black_picture(
                self.size, self.preview, {"frame": number, "damaged": "there is no file of this number"}
            )
        try:
            before, after = _edit(path, self.work)
            if before.diffuse.shape != self.size:
                size = list(before.diffuse.shape)
                raise InputError(f"{path}: expected {list(self.size)} as in the first frame, found {size}")
        except (ValueError, OSError) as error:
            line = {"frame": number, "damaged": one_line(error)}
            return black_picture(self.size, self.preview, line)
        panels = draw_panels(after.diffuse, after.specular, self.gain) if self.preview else None
        line = {"frame": number, "light": _light(before, after)}
        return Picture(after.diffuse, after.specular, panels, line, after.combined)
