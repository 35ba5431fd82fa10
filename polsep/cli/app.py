"""The program's frame: the group of commands, what they share, and how failures are said.

Exit status: 0 only when everything asked for was written; 2 after bad input, with one line per failure on stderr;
130 after Ctrl-C, 143 when the system ends it.
"""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from types import FrameType
from typing import NoReturn

import click

SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100}

DIR = click.Path(path_type=Path)


@click.group(context_settings=SETTINGS, no_args_is_help=True)
@click.version_option(package_name="polsep", message="polsep %(version)s")
def app() -> None:
    """One raw frame of a polarization camera in, a diffuse and a specular image out."""


def say(line: str) -> None:
    """One line for the user on stderr; stdout is for results."""
    print(f"polsep: {line}", file=sys.stderr)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """``WIDTHxHEIGHT``."""
    if text is None:
        return None
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal()):
        raise ValueError(f"expected --size WIDTHxHEIGHT like 2448x2048, found {text!r}")
    return int(width), int(height)


def main() -> None:
    """Entry point: bad input is one line on stderr and exit status 2."""
    signal.signal(signal.SIGTERM, _end)
    try:
        app(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        sys.exit(2)
    except click.ClickException as error:
        say(f"error: {' '.join(error.format_message().split())}")
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        say("stopped")
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output has gone: nothing to tell it
        sys.exit(1)
    except OSError as error:
        say(f"error: {error}")
        sys.exit(2)


def _end(number: int, place: FrameType | None) -> NoReturn:
    """End as after Ctrl-C when the system asks for it, so that temporary files go."""
    sys.exit(128 + number)
