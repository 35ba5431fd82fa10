"""The command line: parse, call one function, print. Heavy imports stay inside the commands."""

from polsep.cli import capture, data, edit, frames, geometry, material, video, view
from polsep.cli.app import app, main

__all__ = ["app", "capture", "data", "edit", "frames", "geometry", "main", "material", "video", "view"]
