"""Appearance editing: edit."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import DIR, app, say

if TYPE_CHECKING:
    from polsep.edit.files import EditTarget, Work
    from polsep.edit.recipe import Recipe

FILE = click.Path(path_type=Path, dir_okay=False)


@app.command()
@click.argument("inputs", nargs=-1, type=click.Path(path_type=Path), metavar="IN...")
@click.option("-o", "--output", type=DIR, default=Path("polsep-edited"), metavar="DIR", help="Where results go.")
@click.option("--recipe", "recipe_file", type=FILE, metavar="FILE", help="Edits from a file, in its order.")
@click.option("--save-recipe", type=FILE, metavar="FILE", help="Keep the edits of this call for others.")
@click.option("--mask", metavar="FILE", help="Edit only where this grey image is white.")
@click.option("--recolor", metavar="R,G,B", help="The material in this linear colour, its shading kept.")
@click.option("--recolor-amount", type=float, metavar="X", help="0 to 1.  [default: 1]")
@click.option("--texture", metavar="FILE", help="A pattern on the material, under its highlights.")
@click.option("--texture-amount", type=float, metavar="X", help="0 to 1.  [default: 1]")
@click.option("--texture-repeats", type=float, metavar="X", help="Repeats across the image.  [default: 1]")
@click.option("--texture-normals", metavar="FILE", help="Normals by which the texture follows the shape.")
@click.option("--diffuse-gain", type=float, metavar="X", help="Times the diffuse light.")
@click.option(
    "--rougher", type=float, metavar="PX", help="Blur highlights by this sigma; the paper's matte look is 10."
)
@click.option("--sharper", type=float, metavar="PX", help="Undo such a blur of highlights, as far as that goes.")
@click.option("--metallic", type=float, metavar="X", help="0 to 1: metal of the object's colour.")
@click.option("--metallic-gain", type=float, metavar="X", help="Times the specular light.  [default: 45]")
@click.option("--specular-gain", type=float, metavar="X", help="Times the specular light.")
@click.option("--remove-highlights", type=float, metavar="X", help="0 to 1: less specular light; 1 none.")
@click.option("--isolate-highlights", type=float, metavar="X", help="0 to 1: less diffuse light; 1 none.")
@click.option("--tint", metavar="R,G,B", help="Times the light's colours.")
@click.option("--compression", default="none", metavar="none|zip|piz", help="Of a sequence's EXR files.")
@click.option("--preview/--no-preview", default=True, help="A film of a sequence to watch; needs the extra video.")
@click.option("--rate", type=float, default=25.0, metavar="N", help="Frames per second of that film.")
@click.option("--damaged", default="stop", metavar="stop|skip", help="What to do at a sequence's missing frame.")
@click.option("--overwrite", is_flag=True, help="Replace results that exist.")
@click.option("--list", "listing", is_flag=True, help="List the edits with their ranges, and stop.")
def edit(inputs: tuple[Path, ...], **options: Any) -> None:
    """Change how separated objects look: metal, matte, texture, highlights, light.

    IN is a frame of 'polsep separate' (.exr, .npz) or a folder of 'polsep video'. A frame gives DIR/STEM.exr (layers
    diffuse, specular and combined), DIR/STEM.png to look at, and DIR/STEM.json with the recipe and what it did to the
    light. A folder gives STEM_000123.exr for every frame, a film to watch and STEM.json; a run that was stopped goes on
    when the same command is given again.

    Edits given as options act in the order of this list; a recipe has its own order. File names in a recipe are
    relative to it.

    \b
    polsep edit out/shot.exr -o edited --metallic 1 --rougher 10
    polsep edit out/shot.exr -o edited --texture wood.jpg --texture-normals normals.png --save-recipe wood.json
    polsep edit film/ -o edited --recipe wood.json
    """
    from polsep.compute.workers import keep_memory
    from polsep.edit.files import EditTarget, load_work
    from polsep.io.results.sequences import SequenceKind

    if options["listing"]:
        _list()
        return
    keep_memory()
    try:
        if not inputs:
            raise ValueError("expected a separated frame or a folder of them, found nothing to edit")
        recipe, folder = _find_recipe(options)
        work = load_work(recipe, folder)
        kind = SequenceKind("exr", options["compression"], options["preview"], options["rate"])
        target = EditTarget(options["output"], options["overwrite"], kind, options["damaged"])
        if options["save_recipe"] is not None:
            _save_recipe(recipe, folder, options["save_recipe"], options["overwrite"])
        failures = _edit_all(inputs, work, target)
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    if failures:
        sys.exit(2)


def _edit_all(inputs: tuple[Path, ...], work: Work, target: EditTarget) -> int:
    """Single frames, then folders; how many of all frames failed."""
    from polsep.edit.files import edit_files, edit_sequence

    files = [path for path in inputs if not path.is_dir()]
    for caution in work.recipe.cautions() if files else ():
        say(caution)
    failures = 0
    for done in edit_files(files, work, target):
        if done.error is not None:
            say(f"error: {done.error}")
            failures += 1
        else:
            print(f"{done.source} -> {', '.join(map(str, done.written))}")
    for folder in (path for path in inputs if path.is_dir()):
        for step in edit_sequence(folder, work, target):
            if step.warning is not None:
                say(step.warning)
            failures += step.damaged
            for path in step.written:
                print(path)
    return failures


def _find_recipe(options: dict[str, Any]) -> tuple[Recipe, Path]:
    """The edits asked for, and the folder that their files are relative to."""
    from polsep.edit.files import read_recipe
    from polsep.edit.recipe import Recipe, make_edit

    given = list(_given_edits(options))
    path: Path | None = options["recipe_file"]
    if path is not None:
        if given or options["mask"] is not None:
            raise ValueError("expected --recipe or edits as options, found both")
        return read_recipe(path), path.parent
    if not given:
        raise ValueError("expected an edit such as --metallic 1, or --recipe FILE, found none; --list shows them")
    return Recipe(tuple(make_edit(kind, values) for kind, values in given)), Path()


def _given_edits(options: dict[str, Any]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Each edit that options ask for, with its values: --NAME gives the first, --NAME-VALUE others, --mask the mask."""
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
            values[first.name] = _parse_color(name, values[first.name])
        yield kind, values if options["mask"] is None else {**values, "mask": options["mask"]}


def _parse_color(name: str, text: str) -> tuple[float, ...]:
    """``R,G,B``."""
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"expected --{name} R,G,B like 0.8,0.1,0.05, found {text!r}") from None
    return (red, green, blue)


def _save_recipe(recipe: Recipe, folder: Path, path: Path, overwrite: bool) -> None:
    """Write the recipe with file names relative to where it lies."""
    from polsep.edit.recipe import recipe_as_text, rename_images
    from polsep.io.results.edited import write_recipe_text

    moved = rename_images(recipe, lambda name: os.path.relpath(folder / name, path.parent))
    write_recipe_text(path, recipe_as_text(moved), overwrite)
    print(path)


def _list() -> None:
    """Every edit, its values and what it does to light."""
    from polsep.edit.edits import EDITS

    for name, kind in EDITS.items():
        print(f"{name}: {kind.title}")
        for p in kind.parameters():
            numbers = f" {p.low:g} to {p.high:g}{p.unit and ' ' + p.unit}" if p.kind in ("number", "color") else ""
            neutral = "" if p.neutral is None else f" Neutral: {p.neutral}."
            print(f"    {p.name}: {p.kind}{numbers}. {p.text}{neutral}")
        print(f"    light: {kind.light}")
