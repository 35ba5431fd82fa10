"""Options of `polsep separate` for photographs of an ordinary camera through a filter, checked before heavy imports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import Number, Word, add_options, parse_numbers, require_extra, require_paths

if TYPE_CHECKING:
    from polsep.photographs import PhotoOptions

#: Options that say something of raw frames of polarization cameras alone, with the value that says nothing.
_OF_FRAMES = {
    "layout": None,
    "calibration": None,
    "ambient": (),
    "lamp_dolp": None,
    "size": None,
    "pixel_format": None,
    "pages": "auto",
}
_OF_PHOTOGRAPHS = {"exposures": None, "extinction": None, "align": None, "encoding": None}
_FILE = click.Path(path_type=str)

#: The options of photographs.
photo_options = add_options(
    click.option("--parallel", type=_FILE, metavar="P", help="Photograph through a filter parallel to the lamp's."),
    click.option("--crossed", type=_FILE, metavar="C", help="The same through a filter crossed with the lamp's."),
    click.option(
        "--angles",
        metavar="A,B,C,...|unknown",
        help="FILEs are photographs of one scene with the filter at these angles in degrees; unknown finds them in "
        "five or more, or in a film.",
    ),
    click.option(
        "--exposures",
        metavar="A,B,...",
        help="Relative exposures of the photographs.  [default: found where they show, else equal]",
    ),
    click.option(
        "--extinction",
        type=Number(float, 1, above=True),
        metavar="N",
        help="Extinction ratio of lamp filter and lens filter together.  [default: perfect]",
    ),
    click.option(
        "--align",
        type=Word("none", "shift", "rigid", "affine", "homography"),
        metavar="MOTION",
        help="Motion undone between photographs: none, shift, rigid, affine or homography.  [default: rigid]",
    ),
    click.option(
        "--encoding",
        type=Word("linear", "srgb"),
        metavar="NAME",
        help="Encoding of photographs: linear or srgb.  [default: linear]",
    ),
)


def find_photographs(files: tuple[str, ...], options: Mapping[str, Any]) -> list[str]:
    """The files of photographs in their order; none where the options say that files are raw frames.

    Raises ValueError on files that are not there, options that don't go together, and extras that are missing.
    """
    parallel, crossed, angles = (options[name] for name in ("parallel", "crossed", "angles"))
    if parallel is None and crossed is None and angles is None:
        given = [name for name, nothing in _OF_PHOTOGRAPHS.items() if options[name] != nothing]
        if given:
            raise ValueError(f"expected --{given[0]} with --parallel and --crossed, or with --angles, found it alone")
        if not files:
            raise click.UsageError("Missing argument 'FILE...'.")
        return []
    if angles is None and (parallel is None or crossed is None):
        raise ValueError(f"expected --parallel and --crossed together, found {'one' if files else 'only one'} of them")
    if (parallel or crossed) and (files or angles):
        raise ValueError("expected two photographs, --parallel P --crossed C, found other files or --angles too")
    given = [name for name, nothing in _OF_FRAMES.items() if options[name] != nothing]
    if given:
        raise ValueError(f"expected photographs without --{given[0].replace('_', '-')}, found it")
    paths = [parallel, crossed] if angles is None else _expand(files, _numbers("angles", angles))
    require_paths(*paths)
    from polsep.io.raw.extensions import is_film, needs_rawpy

    if options["align"] != "none" or needs_rawpy(paths):
        require_extra("photos", "" if needs_rawpy(paths) else "--align none")
    if is_film(paths[0]):
        require_extra("video")
    return paths


def read_photo_options(options: Mapping[str, Any]) -> PhotoOptions:
    """Options of reading photographs, from the options of a command. Raises ValueError."""
    from polsep.photographs import PAIR, Angles, PhotoOptions

    angles: Angles = PAIR
    if options["angles"] is not None:
        angles = _numbers("angles", options["angles"])
    exposures = None if options["exposures"] is None else _numbers("exposures", options["exposures"])
    stated = {name: options[name] for name in ("extinction", "align", "encoding") if options[name] is not None}
    return PhotoOptions(angles, exposures, full=options["full"], **stated)


def _expand(files: tuple[str, ...], angles: tuple[float, ...] | None) -> list[str]:
    """The files, of a template with ``{angle}`` one for each angle. Raises ValueError on too few."""
    if not files:
        raise click.UsageError("Missing argument 'FILE...'.")
    if len(files) == 1 and "{angle}" in files[0]:
        if angles is None:
            raise ValueError("expected angles for a name with {angle}, found --angles unknown: name the files")
        return [files[0].replace("{angle}", f"{angle:g}") for angle in angles]
    if len(files) > 1 and any(Path(path).is_dir() for path in files):
        raise ValueError("expected photographs, or one film or file of several pages, found a folder")
    return list(files)


def _numbers(name: str, text: str) -> tuple[float, ...] | None:
    """Numbers from text with commas; None of ``unknown``. Raises ValueError."""
    if name == "angles" and text == "unknown":
        return None
    return parse_numbers(text, f"--{name} as numbers like 0,60,120", lambda found: all(map(math.isfinite, found)))
