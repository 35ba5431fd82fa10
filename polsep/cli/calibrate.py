"""Measuring a sensor and a lamp: calibrate, with one command per kind; and merging exposures: merge."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    BLACK_LEVEL,
    CALIBRATION,
    FILE,
    LAYOUT,
    OVERWRITE,
    PIXEL_FORMAT,
    SIZE,
    WHITE_LEVEL,
    Number,
    add_options,
    app,
    parse_numbers,
    print_results,
    read_options,
    require_paths,
)
from polsep.cli.progress import show_progress

FRAMES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FRAMES...")
OUTPUT = click.option(
    "-o", "--output", type=FILE, default=Path("rig.json"), metavar="FILE", help="Calibration to make or to add to."
)


#: The arguments that all kinds share.
frame_options = add_options(FRAMES, OUTPUT, LAYOUT, BLACK_LEVEL, WHITE_LEVEL, SIZE, PIXEL_FORMAT)


@app.group()
def calibrate() -> None:
    """Measure a sensor and a lamp, for --calibration of the other commands.

    Each kind writes one section of FILE (rig.json; maps of pixels in rig.npz beside it) and keeps the others: measure
    dark first, then flat, analysers and light, all with the same FILE. FRAMES are raw frames, as for 'polsep separate',
    folders of them, or files of several.

    \b
    polsep calibrate dark cap_*.png --white-level 4095 -o rig.json
    polsep calibrate flat paper_*.png -o rig.json
    polsep calibrate analysers turned_*.png -o rig.json
    polsep calibrate light ball.png -o rig.json
    polsep separate shot.png --calibration rig.json
    """


@calibrate.command()
@frame_options
def dark(files: tuple[Path, ...], output: Path, **options: Any) -> None:
    """Black level, its pattern, read noise and hot pixels, from frames with the lens cap on.

    One frame shows levels, rows and columns; several also every pixel, and the read noise. Use the exposure time
    and gain of the frames to come.
    """
    require_paths(*files)
    from polsep.calibrate.dark_flat import measure_dark

    _measure(files, options, output, "dark", measure_dark)


@calibrate.command()
@frame_options
def flat(files: tuple[Path, ...], output: Path, **options: Any) -> None:
    """Gains of pixels, vignetting and dead pixels, from frames of an evenly lit, unpolarized white.

    White paper before the lens under daylight or a lamp without polarizer, out of focus, at half of the white level.
    One frame shows vignetting and the gain of each filter; several also every pixel. Turn the camera between
    frames if the light may be slightly polarized, as the sky's.
    """
    require_paths(*files)
    from polsep.calibrate.dark_flat import measure_flat

    _measure(files, options, output, "flat", measure_flat)


@calibrate.command()
@frame_options
@click.option(
    "--polarizer-extinction",
    type=Number(float, 1, above=True),
    metavar="N",
    help="Extinction ratio of the turned polarizer.  [default: perfect]",
)
def analysers(files: tuple[Path, ...], output: Path, polarizer_extinction: float | None, **options: Any) -> None:
    """Angle, extinction ratio and gain of each analyser, from frames behind a polarizer that is turned by hand.

    Hold a good linear polarizer before the lens, look at evenly lit white paper, and take ten frames, each with the
    polarizer turned by some 20 degrees more. Its angles need not be known; lamp, exposure and paper stay as they are.
    The middle of the frames is used. Measure flat before: it makes this more exact.
    """
    require_paths(*files)
    from polsep.calibrate.analysers import measure_analysers

    extinction = math.inf if polarizer_extinction is None else polarizer_extinction
    measure = partial(measure_analysers, polarizer_extinction=extinction)
    _measure(files, options, output, "analysers", measure)


@calibrate.command()
@frame_options
@click.option("--card", is_flag=True, help="The middle of the frames shows a grey or white card.")
def light(files: tuple[Path, ...], output: Path, card: bool, **options: Any) -> None:
    """Colour, polarization angle and degree of the lamp, from a shiny dark ball, a grey card, or any object under it.

    Highlights must not clip: expose less than usual. A black billiard ball is best; on other objects the degree of
    polarization is a lower bound. With --card, matte grey card or white paper shows the colour alone.
    """
    require_paths(*files)
    from polsep.calibrate.lamp import measure_lamp

    _measure(files, options, output, "light", partial(measure_lamp, card=card))


def _measure(
    files: tuple[Path, ...], options: dict[str, Any], output: Path, kind: str, measure: Callable[..., Any]
) -> None:
    """Measure one kind and print what was found."""
    from polsep.calibrate.files import calibrate_files

    with show_progress(f"measuring {kind}"):
        line, notes = calibrate_files(files, read_options(options), output, kind, measure)
    print_results(notes, [line])


@app.command()
@FRAMES
@click.option("-o", "--output", type=FILE, required=True, metavar="OUT.tiff", help="The merged frame.")
@click.option(
    "--times", metavar="T,...", help="Exposure time of each frame in any unit.  [default: of the files, or the frames]"
)
@LAYOUT
@BLACK_LEVEL
@WHITE_LEVEL
@CALIBRATION
@SIZE
@PIXEL_FORMAT
@OVERWRITE
def merge(files: tuple[Path, ...], output: Path, times: str | None, overwrite: bool, **options: Any) -> None:
    """Merge frames of one still scene at different exposure times into one, without clipping and with less noise.

    The camera, the lamp and its polarizer must not move between the frames, which are files, folders of them, or files
    of several. OUT is a float TIFF, which every command reads without further options: black at 0, and white at 1,
    where the shortest exposure clips.

    \b
    polsep merge short.png middle.png long.png --white-level 4095 --black-level 64 -o merged.tiff
    polsep merge exposures/*.tiff --times 1,4,16 --calibration rig.json -o merged.tiff
    """
    require_paths(*files)
    exposure_times = None if times is None else list(parse_numbers(times, "--times T,T,... like 1,4,16"))
    from polsep.calibrate.files import merge_files

    with show_progress("merging"):
        line, notes = merge_files(files, read_options(options), output, exposure_times, overwrite)
    print_results(notes, [line])
