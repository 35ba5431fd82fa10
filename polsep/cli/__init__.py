"""The command line: parse, call one function, print. Heavy imports stay inside the commands."""

from polsep.cli import capture, data, frames, video
from polsep.cli.app import app, main

__all__ = ["app", "capture", "data", "frames", "main", "video"]
