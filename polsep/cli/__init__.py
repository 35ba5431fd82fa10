"""The command line: parse, call one function, print. Heavy imports stay inside the commands."""

from polsep.cli import capture, data, edit, frames, material, video, view
from polsep.cli.app import app, main

__all__ = ["app", "capture", "data", "edit", "frames", "main", "material", "video", "view"]
