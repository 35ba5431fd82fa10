"""Live acquisition: capture."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import DIR, app, say

if TYPE_CHECKING:
    from polsep.capture.session import Status


@app.command()
@click.argument("camera", required=False, metavar="[CAMERA]")
@click.option("-o", "--output", type=DIR, metavar="DIR", help="Record into this folder.")
@click.option("--list", "listing", is_flag=True, help="List the cameras there are, and stop.")
@click.option("--seconds", type=float, metavar="N", help="End after N seconds.  [default: at Ctrl-C]")
@click.option("--frames", type=int, metavar="N", help="End after N frames.")
@click.option("--exposure", type=float, metavar="US", help="Exposure time in microseconds.")
@click.option("--gain", type=float, metavar="DB", help="Gain in decibels.")
@click.option("--rate", type=float, metavar="HZ", help="Frames per second.")
@click.option("--trigger", metavar="SOURCE", help="off, Software (at --rate), or a line, like Line0.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format, like BayerRG12p.")
@click.option("--set", "features", multiple=True, metavar="NAME=VALUE", help="Any further GenICam feature.")
@click.option("--method", default="auto-fast", metavar="NAME", help="For the live view; none records alone.")
@click.option("--layout", metavar="color|mono|SPEC", help="The sensor's filters.  [default: by the pixel format]")
@click.option("--show", type=int, metavar="PORT", help="Show the live view at http://127.0.0.1:PORT/; 0 picks a port.")
@click.option("--timeout", type=float, default=30.0, metavar="S", help="How long to wait for a lost camera.")
@click.option("--ring", type=int, default=32, metavar="N", help="Frames kept while the disk is busy.")
@click.option("--overwrite", is_flag=True, help="Replace a recording that exists.")
def capture(camera: str | None, listing: bool, **options: Any) -> None:
    """Record a camera without loss, and show its separation live.

    CAMERA is aravis:ID, pylon:ID, folder:PATH or loop:PATH (raw frames of files, once or again and again); without it,
    the only camera there is. DIR gets frames.raw, the bytes as they came, frames.jsonl, a line per frame,
    recording.json and live.jpg, the newest separation. Frames that are lost on the wire or dropped because the disk is
    slow are counted. A camera that is unplugged is waited for.

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
    from polsep.sensor.camera import Layout

    if listing:
        _list()
        return
    try:
        limits = Limits(options["seconds"], options["frames"], options["timeout"], options["ring"])
        method = None if options["method"] == "none" else options["method"]
        output, port = options["output"], options["show"]
        if output is None and (port is None or method is None):
            raise ValueError("expected -o DIR to record, or --show PORT to watch, found neither")
        if port is not None and method is None:
            raise ValueError("expected a method to show, found --method none")
        if method is not None:
            check_method(method)
        layout = None if options["layout"] is None else Layout.parse(options["layout"])
        settings = CameraSettings(
            options["exposure"],
            options["gain"],
            options["rate"],
            options["trigger"],
            options["pixel_format"],
            tuple(_parse_feature(text) for text in options["features"]),
        )
        plan = CapturePlan(output, method, layout, port, options["overwrite"])
        terminal = _Terminal()
        session = Session(find_source(camera, settings), plan, limits, terminal.say)
        try:
            status = session.run(terminal.tell)
        finally:
            terminal.clear()
    except ValueError as error:
        raise click.ClickException(str(error)) from None
    print(f"{output / 'recording.json' if output else 'not recorded'}: {status.line()}")


def _list() -> None:
    """Cameras on stdout, libraries that are missing on stderr."""
    from polsep.capture.find import list_cameras

    found = list_cameras()
    for name, text in found.cameras.items():
        print(f"{name}  {text}")
    for name, reason in found.missing.items():
        say(f"{name}: {reason}")
    if not found.cameras:
        say("no camera found; folder:PATH and loop:PATH play raw frames of files")


def _parse_feature(text: str) -> tuple[str, str]:
    """``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise ValueError(f"expected --set NAME=VALUE, found {text!r}")
    return name, value


class _Terminal:
    """Lines for the user, and one that tells where the run stands: renewed in place, or where nobody watches, rarely.

    State: whether the last line is to be replaced, and when one was last printed.
    """

    EVERY_S = 5.0

    def __init__(self) -> None:
        self._live = sys.stderr.isatty()
        self._drawn, self._told = False, 0.0

    def say(self, line: str) -> None:
        """A line that stays."""
        self.clear()
        say(line)

    def tell(self, status: Status) -> None:
        """Where the run stands."""
        if self._live:
            print(f"\r\033[K{status.line()}", end="", file=sys.stderr, flush=True)
            self._drawn = True
        elif status.seconds - self._told >= self.EVERY_S:
            self._told = status.seconds
            say(status.line())

    def clear(self) -> None:
        """Remove the line that tells where the run stands."""
        if self._drawn:
            print("\r\033[K", end="", file=sys.stderr, flush=True)
            self._drawn = False
