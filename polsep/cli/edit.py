"""Appearance editing: edit."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import (
    COMPRESSION,
    DAMAGED,
    DIR,
    FILE,
    FINITE,
    OVERWRITE,
    RATE,
    app,
    is_given,
    parse_numbers,
    print_note,
    require_paths,
)
from polsep.cli.progress import report_step, show_progress
from polsep.cli.video import with_preview
from polsep.io.store.errors import MOST, one_line

if TYPE_CHECKING:
    from polsep.edit.files import EditTarget, Work
    from polsep.edit.recipe import Recipe


@app.command()
@click.argument("inputs", nargs=-1, type=click.Path(path_type=Path), metavar="IN...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-edited"), metavar="DIR", help="Folder of the results.")
@click.option("--recipe", "recipe_file", type=FILE, metavar="FILE", help="Apply the edits of a file, in its order.")
@click.option("--save-recipe", type=FILE, metavar="FILE", help="Save the edits of this call to a file.")
@click.option("--mask", metavar="FILE", help="Edit only where this grey image is white.")
@click.option("--recolor", metavar="R,G,B", help="Give the material this linear colour and keep its shading.")
@click.option("--recolor-amount", type=FINITE, metavar="X", help="0 to 1.  [default: 1]")
@click.option("--texture", metavar="FILE", help="Put a texture on the material, under its highlights.")
@click.option("--texture-amount", type=FINITE, metavar="X", help="0 to 1.  [default: 1]")
@click.option("--texture-repeats", type=FINITE, metavar="X", help="Repeats across the image.  [default: 1]")
@click.option("--texture-normals", metavar="FILE", help="Normal map along which the texture follows the shape.")
@click.option("--diffuse-gain", type=FINITE, metavar="X", help="Multiply the diffuse light.")
@click.option(
    "--rougher", type=FINITE, metavar="PX", help="Blur highlights by this sigma; 10 is the paper's matte appearance."
)
@click.option("--sharper", type=FINITE, metavar="PX", help="Undo such a blur of highlights, as far as possible.")
@click.option("--metallic", type=FINITE, metavar="X", help="Metal of the object's colour, 0 to 1.")
@click.option("--metallic-gain", type=FINITE, metavar="X", help="Multiply the specular light of metal.  [default: 45]")
@click.option("--specular-gain", type=FINITE, metavar="X", help="Multiply the specular light.")
@click.option("--remove-highlights", type=FINITE, metavar="X", help="Remove specular light; 0 none, 1 all of it.")
@click.option("--isolate-highlights", type=FINITE, metavar="X", help="Remove diffuse light; 0 none, 1 all of it.")
@click.option("--tint", metavar="R,G,B", help="Multiply the colour of the light.")
@click.option(
    "--compression",
    type=COMPRESSION,
    default="none",
    metavar="none|zip|piz",
    help="Compression of a sequence's EXR files.",
)
@click.option(
    "--preview/--no-preview",
    default=None,
    help="Write a video of a sequence to watch.  [default: where the extra video is installed]",
)
@click.option(
    "--rate",
    type=RATE,
    metavar="N",
    help="Frames per second of that video, like 24 or 24000/1001.  [default: those of the sequence, else 25]",
)
@click.option(
    "--damaged",
    type=DAMAGED,
    default="stop",
    metavar="stop|skip",
    help="Stop at a missing frame of a sequence, or skip it.",
)
@OVERWRITE
@click.option("--list", "listing", is_flag=True, help="List the edits with their ranges and exit.")
def edit(inputs: tuple[Path, ...], **options: Any) -> None:
    """Change the appearance of separated objects: metal, matte, texture, highlights, light.

    IN is a frame of 'polsep separate' (.exr, .npz) or a folder of 'polsep video'. A frame gives DIR/STEM.exr (layers
    diffuse, specular and combined), DIR/STEM.png to look at, and DIR/STEM.json with the recipe and its effect on the
    light. A folder gives STEM_000123.exr for every frame, a video to watch and STEM.json. Run the same command again to
    resume a sequence that was stopped.

    Edits given as options are applied in the order of this list; a recipe has its own order. File names in a recipe are
    relative to it.

    \b
    polsep edit out/shot.exr -o edited --metallic 1 --rougher 10
    polsep edit out/shot.exr -o edited --texture wood.jpg --texture-normals normals.png --save-recipe wood.json
    polsep edit film/ -o edited --recipe wood.json
    """
    if options["listing"]:
        _list()
        return
    if not inputs:
        raise ValueError("expected a separated frame or a folder of them, found nothing to edit")
    _refuse_film_options(inputs)
    if len(inputs) == 1:  # of several the others are edited all the same
        require_paths(*inputs)
    from polsep.compute.workers import keep_memory
    from polsep.edit.files import EditTarget, load_work, planned_edits
    from polsep.io.results.sequences import SequenceKind
    from polsep.io.store.atomic import refuse_inputs

    keep_memory()
    recipe, folder = _find_recipe(options)
    images = [folder / name for name in recipe.images()]
    preview = with_preview(options["preview"]) if any(path.is_dir() for path in inputs) else False
    kind = SequenceKind("exr", options["compression"], preview, options["rate"])
    target = EditTarget(options["output"], options["overwrite"], kind, options["damaged"])
    recipe_file, saved = options["recipe_file"], options["save_recipe"]
    planned = planned_edits(inputs, target)
    refuse_inputs(planned, images if recipe_file is None else [*images, recipe_file])
    if saved is not None:
        frames = [file for path in inputs for file in (path.iterdir() if path.is_dir() else [path])]
        refuse_inputs([saved], [*frames, *images])
        _refuse_result(saved, planned)
    work = load_work(recipe, folder)
    if saved is not None:
        _save_recipe(recipe, folder, saved, options["overwrite"])
    failures = _edit_all(inputs, work, target)
    if failures:
        sys.exit(2)


def _refuse_film_options(inputs: tuple[Path, ...]) -> None:
    """Raise ValueError on an option of sequences that was given where there is none: it would change nothing."""
    given = [name for name in ("compression", "rate", "damaged") if is_given(name)]
    if given and not any(path.is_dir() for path in inputs):
        raise ValueError(f"expected a folder of frames for --{given[0]}, found single files")


def _refuse_result(saved: Path, planned: list[Path]) -> None:
    """Raise ValueError where the recipe that is saved has the name of a result."""
    if os.path.realpath(saved) in map(os.path.realpath, planned):
        raise ValueError(f"expected --save-recipe apart from the results, found {saved}, which is one of them")


def _edit_all(inputs: tuple[Path, ...], work: Work, target: EditTarget) -> int:
    """Edit single frames, then folders, past those that fail; return the number of failures."""
    from polsep.edit.files import edit_files, edit_sequence

    files = [path for path in inputs if not path.is_dir()]
    for caution in work.recipe.cautions() if files else ():
        print_note(caution)
    failures = 0
    for outcome in edit_files(files, work, target):
        if outcome.error is not None:
            print_note(f"error: {outcome.error}")
            failures += 1
        else:
            print(f"{outcome.source} -> {', '.join(map(str, outcome.written))}")
    for path in (path for path in inputs if path.is_dir()):
        try:
            with show_progress(f"editing {path}") as progress:
                failures += sum(report_step(step, progress) for step in edit_sequence(path, work, target))
        except BrokenPipeError:  # nobody reads our output any more
            raise
        except (ValueError, OSError, MemoryError) as error:
            print_note(f"error: {one_line(error, 2 * MOST) or type(error).__name__}")
            failures += 1
    return failures


def _find_recipe(options: dict[str, Any]) -> tuple[Recipe, Path]:
    """Return the edits of the options, and the folder that their files are relative to."""
    from polsep.edit.edits import EDITS
    from polsep.edit.files import read_recipe
    from polsep.edit.parameters import EditError
    from polsep.edit.recipe import Recipe, make_edit

    given = list(_given_edits(options))
    path: Path | None = options["recipe_file"]
    if path is not None:
        if given or options["mask"] is not None:
            raise ValueError("expected --recipe or edits as options, found both")
        return read_recipe(path), path.parent
    if not given:
        raise ValueError("expected an edit such as --metallic 1, or --recipe FILE, found none; --list shows them")
    edits = []
    for kind, values in given:
        try:
            edits.append(make_edit(kind, values))
        except EditError as error:
            name = next(name for name, edit in EDITS.items() if edit is kind)
            raise ValueError(f"--{name}: {error}") from None
    return Recipe(tuple(edits)), Path()


def _given_edits(options: dict[str, Any]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Yield each edit of the options with its values: --NAME is the first, --NAME-VALUE are others, --mask the mask."""
    from polsep.edit.edits import EDITS

    for name, kind in EDITS.items():
        first, *others = (p for p in kind.parameters() if p.kind != "mask")
        flags = {first.name: name, **{p.name: f"{name}-{p.name}" for p in others}}
        texts = {field: options[flag.replace("-", "_")] for field, flag in flags.items()}
        values = {field: value for field, value in texts.items() if value is not None}
        if first.name not in values:
            if values:
                raise ValueError(f"expected --{name} beside --{flags[next(iter(values))]}, found none")
            continue
        if first.kind == "color":
            wanted = f"--{name} R,G,B like 0.8,0.1,0.05"
            values[first.name] = parse_numbers(values[first.name], wanted, lambda color: len(color) == 3)
        yield kind, values if options["mask"] is None else {**values, "mask": options["mask"]}


def _save_recipe(recipe: Recipe, folder: Path, path: Path, overwrite: bool) -> None:
    """Write the recipe with file names relative to its own folder."""
    from polsep.edit.recipe import recipe_as_text, rename_images
    from polsep.io.results.edited import write_recipe_text

    own, real = os.path.realpath(path.parent), os.path.realpath(folder)  # ".." leads out of what a link points to
    moved = rename_images(recipe, lambda name: os.path.relpath(os.path.join(real, name), own))
    write_recipe_text(path, recipe_as_text(moved), overwrite)
    print(path)


def _list() -> None:
    """Print every edit, its parameters and its effect on light."""
    from polsep.edit.edits import EDITS

    for name, kind in EDITS.items():
        print(f"{name}: {kind.title}")
        for p in kind.parameters():
            numbers = f" {p.low:g} to {p.high:g}{p.unit and ' ' + p.unit}" if p.kind in ("number", "color") else ""
            neutral = "" if p.neutral is None else f" Neutral: {p.neutral}."
            print(f"    {p.name}: {p.kind}{numbers}. {p.text}{neutral}")
        print(f"    light: {kind.light}")
