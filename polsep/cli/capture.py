"""Live acquisition: capture."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import AMBIENT, CALIBRATION, COUNT, DIR, FINITE, POSITIVE, Number, app, chosen_layout, print_note

if TYPE_CHECKING:
    from polsep.capture.session import Status


@app.command()
@click.argument("camera", required=False, metavar="[CAMERA]")
@click.option("-o", "--output", type=DIR, metavar="DIR", help="Record into this folder.")
@click.option("--list", "listing", is_flag=True, help="List the connected cameras and exit.")
@click.option("--seconds", type=POSITIVE, metavar="N", help="End after N seconds.  [default: at Ctrl-C]")
@click.option("--frames", type=COUNT, metavar="N", help="End after N frames.")
@click.option("--exposure", type=POSITIVE, metavar="US", help="Exposure time in microseconds.")
@click.option("--gain", type=FINITE, metavar="DB", help="Gain in decibels.")
@click.option("--rate", type=POSITIVE, metavar="HZ", help="Frames per second.")
@click.option("--trigger", metavar="SOURCE", help="Trigger source: off, Software (at --rate), or a line like Line0.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format, like BayerRG12p.")
@click.option("--set", "features", multiple=True, metavar="NAME=VALUE", help="Set any other GenICam feature.")
@click.option(
    "--method", default="auto-fast", metavar="NAME", help="Separation method of the live view; none only records."
)
@click.option("--layout", metavar="color|mono|SPEC", help="Filter layout of the sensor.  [default: by pixel format]")
@click.option(
    "--show",
    type=Number(int, 0, 65_535),
    metavar="PORT",
    help="Show the live view at http://127.0.0.1:PORT/ with exposure, focus and polarization; 0 picks a free port.",
)
@CALIBRATION
@AMBIENT
@click.option("--timeout", type=POSITIVE, default=30.0, metavar="S", help="Seconds to wait for a lost camera.")
@click.option("--ring", type=COUNT, default=32, metavar="N", help="Frames buffered while the disk is busy.")
@click.option("--overwrite", is_flag=True, help="Replace an existing recording.")
def capture(camera: str | None, listing: bool, **options: Any) -> None:
    """Record a camera without loss, and show its separation live.

    CAMERA is aravis:ID, pylon:ID, folder:PATH or loop:PATH (raw frames of files, once or repeatedly); without it, the
    only connected camera. DIR gets frames.raw, the bytes as they came, frames.jsonl, a line per frame, recording.json
    and live.jpg, the newest separation. Frames lost in transfer, or dropped because the disk is slow, are counted. A
    camera that is unplugged is waited for. Basler's pylon cameras need the extra camera.

    \b
    polsep capture --list
    polsep capture -o take1 --pixel-format BayerRG12p --exposure 8000 --rate 10 --show 8000
    polsep capture aravis:192.168.0.5 -o take2 --seconds 60 --method none
    polsep separate take1/recording.json -o out            every frame of a recording
    polsep separate take1/frames.raw --size 2448x2048 --pixel-format BayerRG12p
    """
    from polsep.capture.find import find_source
    from polsep.capture.session import CapturePlan, Limits, Session
    from polsep.capture.sources import CameraSettings
    from polsep.methods import check_method

    if listing:
        _list()
        return
    limits = Limits(options["seconds"], options["frames"], options["timeout"], options["ring"])
    method = None if options["method"] == "none" else options["method"]
    output, port = options["output"], options["show"]
    if output is None and (port is None or method is None):
        raise ValueError("expected -o DIR to record, or --show PORT to watch, found neither")
    if port is not None and method is None:
        raise ValueError("expected a method to show, found --method none")
    if method is not None:
        check_method(method)
    for name in ("calibration", "ambient"):
        if method is None and options[name]:
            raise ValueError(
                f"expected --{name} with a method to show, found --method none: frames are recorded as they are"
            )
    layout = chosen_layout(options)
    settings = CameraSettings(
        options["exposure"],
        options["gain"],
        options["rate"],
        options["trigger"],
        options["pixel_format"],
        tuple(_parse_feature(text) for text in options["features"]),
    )
    corrections = (options["calibration"], options["ambient"])
    plan = CapturePlan(output, method, layout, port, options["overwrite"], *corrections)
    status_line = _StatusLine()
    session = Session(find_source(camera, settings), plan, limits, status_line.print_above)
    try:
        status = session.run(status_line.update)
    finally:
        status_line.clear()
    print(f"{output / 'recording.json' if output else 'not recorded'}: {status.line()}")


def _list() -> None:
    """Print cameras on stdout, missing libraries on stderr."""
    from polsep.capture.find import list_cameras

    listing = list_cameras()
    for name, text in listing.cameras.items():
        print(f"{name}  {text}")
    for name, reason in listing.missing.items():
        print_note(f"{name}: {reason}")
    if not listing.cameras:
        print_note("no camera found; folder:PATH and loop:PATH play raw frames of files")


def _parse_feature(text: str) -> tuple[str, str]:
    """Name and value from ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ValueError(f"expected --set NAME=VALUE, found {text!r}")
    return name, value


class _StatusLine:
    """The state of the run on stderr: one line updated in place on a terminal, else a new line every few seconds.

    State: whether the last line is to be replaced, and when one was last printed.
    """

    EVERY_S = 5.0

    def __init__(self) -> None:
        self._in_place = sys.stderr.isatty()
        self._drawn, self._printed_s = False, 0.0

    def print_above(self, line: str) -> None:
        """Print a line that stays."""
        self.clear()
        print_note(line)

    def update(self, status: Status) -> None:
        """Show the state of the run."""
        if self._in_place:
            print(f"\r\033[K{status.line()}", end="", file=sys.stderr, flush=True)
            self._drawn = True
        elif status.seconds - self._printed_s >= self.EVERY_S:
            self._printed_s = status.seconds
            print_note(status.line())

    def clear(self) -> None:
        """Remove the line that is updated in place."""
        if self._drawn:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
            self._drawn = False
