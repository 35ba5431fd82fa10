"""The command line: parse, call one function, print. Heavy imports stay inside the commands."""

from polsep.cli import (  # noqa: F401  # each adds its commands to the app
    bench,
    calibrate,
    capture,
    doctor,
    edit,
    frames,
    geometry,
    material,
    render,
    samples,
    shape,
    train,
    video,
    view,
)
from polsep.cli.app import app, main

__all__ = ["app", "main"]
