"""The command line: parse, call one function, print. Heavy imports stay inside the commands."""

from polsep.cli import bench, calibrate, capture, edit, frames, geometry, material, render, train, video, view
from polsep.cli.app import app, main

__all__ = [
    "app",
    "bench",
    "calibrate",
    "capture",
    "edit",
    "frames",
    "geometry",
    "main",
    "material",
    "render",
    "train",
    "video",
    "view",
]
