"""The group of commands, the options that several commands share, and how failures are reported.

Exit status: 0 only when everything asked for was written; 2 after bad input, with one line per failure on stderr;
130 after Ctrl-C, 143 after SIGTERM.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from polsep.io.store.errors import MOST, one_line

if TYPE_CHECKING:
    from rich.progress import Progress

    from polsep.io.raw.frames import ReadOptions

SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100}

DIR = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)

LAYOUT = click.option(
    "--layout", metavar="color|mono|SPEC", help="Filter layout of the sensor, as in 'polsep separate'."
)
BLACK_LEVEL = click.option("--black-level", type=float, default=0.0, metavar="N", help="Sample value without light.")
WHITE_LEVEL = click.option(
    "--white-level",
    type=float,
    metavar="N",
    help="Sample value at which the sensor clips.  [default: largest of the data type]",
)
LIGHT_COLOR = click.option(
    "--light-color",
    default="auto",
    metavar="auto|white|R,G,B",
    help="Colour of the light: auto finds it in the frame; or camera RGB.",
)
SIZE = click.option("--size", metavar="WxH", help="Size of headerless raw frames, like 2448x2048.")
PIXEL_FORMAT = click.option(
    "--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw frames, like BayerRG12p."
)
CALIBRATION = click.option(
    "--calibration", type=FILE, metavar="FILE", help="Calibration of the sensor, of 'polsep calibrate'."
)
AMBIENT = click.option(
    "--ambient",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FRAME",
    help="Frame with the lamp off, subtracted; of several (the option repeated, or in a file) their mean.",
)
OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace existing results.")
DEVICE = click.option("--device", default="auto", metavar="NAME", help="Device: auto, cpu or cuda.")
ENGINE = click.option(
    "--engine", default="local", metavar="NAME", help="local: this machine; ray: the cluster of RAY_ADDRESS."
)


@click.group(context_settings=SETTINGS, no_args_is_help=True)
@click.version_option(package_name="polsep", message="polsep %(version)s")
def app() -> None:
    """One raw frame of a polarization camera in, a diffuse and a specular image out."""


def print_note(line: str) -> None:
    """Print one line for the user on stderr; stdout is for results."""
    print(f"polsep: {line}", file=sys.stderr)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from ``WIDTHxHEIGHT``."""
    if text is None:
        return None
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"expected --size WIDTHxHEIGHT like 2448x2048, found {text!r}")
    return int(width), int(height)


def read_options(options: Mapping[str, Any]) -> ReadOptions:
    """Options of reading raw frames, from the options of a command. Raises ValueError."""
    from polsep.io.raw.corrections import with_corrections
    from polsep.io.raw.frames import ReadOptions
    from polsep.sensor.camera import Layout

    read = ReadOptions(
        None if options["layout"] is None else Layout.parse(options["layout"]),
        options["black_level"],
        options["white_level"],
        parse_size(options.get("size")),
        options.get("pixel_format"),
        options.get("pages", "frames"),
    )
    return with_corrections(read, options.get("calibration"), options.get("ambient", ()))


def progress_bar() -> Progress:
    """A progress bar on stderr, hidden unless stderr is a terminal; each task has a field ``speed``."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=not sys.stderr.isatty(),
    )


@contextmanager
def extra_needed(extra: str, *modules: str) -> Iterator[None]:
    """Name the extra to install where one of its modules is missing; without names, where any module is."""
    try:
        yield
    except ModuleNotFoundError as error:
        if modules and (error.name or "").partition(".")[0] not in modules:
            raise
        missing = "none" if modules else f"no {error.name}"
        raise ValueError(f"expected the extra {extra!r} (pip install 'polsep[{extra}]'), found {missing}") from None


def main() -> None:
    """Run the program: bad input is one line on stderr and exit status 2."""
    signal.signal(signal.SIGTERM, _exit_on_signal)
    try:
        app(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        print_note("stopped")
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()  # nobody reads our output any more
        sys.exit(1)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        print_note("error: expected the extra 'torch' (pip install 'polsep[torch]'), found no torch")
        sys.exit(2)
    except (click.ClickException, ValueError, RuntimeError, OSError) as error:
        message = error.format_message() if isinstance(error, click.ClickException) else str(error)
        print_note(f"error: {one_line(message, 2 * MOST)}")
        sys.exit(2)


def _exit_on_signal(number: int, frame: FrameType | None) -> NoReturn:
    """Exit on SIGTERM as on Ctrl-C, so that temporary files are removed."""
    sys.exit(128 + number)
