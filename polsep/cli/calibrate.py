"""Measuring a sensor and a lamp: calibrate, with one command per kind."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import BLACK_LEVEL, FILE, LAYOUT, PIXEL_FORMAT, SIZE, WHITE_LEVEL, app, read_options

FRAMES = click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FRAMES...")
OUTPUT = click.option(
    "-o", "--output", type=FILE, default=Path("rig.json"), metavar="FILE", help="Calibration to make or to add to."
)


def frame_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """The arguments that all kinds share."""
    for option in (PIXEL_FORMAT, SIZE, WHITE_LEVEL, BLACK_LEVEL, LAYOUT, OUTPUT, FRAMES):
        command = option(command)
    return command


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

    One frame shows levels, rows and columns; ten or more also every pixel, and the read noise. Use the exposure time
    and gain of the frames to come.
    """
    from polsep.calibrate.dark_flat import measure_dark
    from polsep.calibrate.files import calibrate_files

    print(calibrate_files(files, read_options(options), output, "dark", measure_dark))


@calibrate.command()
@frame_options
def flat(files: tuple[Path, ...], output: Path, **options: Any) -> None:
    """Gains of pixels, vignetting and dead pixels, from frames of an evenly lit, unpolarized white.

    White paper before the lens under daylight or a lamp without polarizer, out of focus, at half of the white level.
    One frame shows vignetting and the gain of each filter; four or more also every pixel. Turn the camera between
    frames if the light may be slightly polarized, as the sky's.
    """
    from polsep.calibrate.dark_flat import measure_flat
    from polsep.calibrate.files import calibrate_files

    print(calibrate_files(files, read_options(options), output, "flat", measure_flat))
