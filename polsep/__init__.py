"""polsep: one raw frame of a polarization camera in, a diffuse and a specular image out.

    import polsep
    out = polsep.separate(raw)        # raw: uint8, uint16 or float32 [H, W] mosaic
    out.diffuse, out.specular         # float32 [H/2, W/2, 3]
    out.valid                         # bool [H/2, W/2]

Names are loaded on first use, so ``import polsep`` and ``polsep --help`` cost nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from polsep.geometry.one_frame import Shape, shape
    from polsep.io.raw.frames import Frame, ReadOptions, read_frames
    from polsep.io.results.separation_reader import read_separated
    from polsep.io.store.calibrations import read_calibration
    from polsep.light.find import Light, find_light
    from polsep.methods import METHODS
    from polsep.physics.stokes import Measurements, Stokes
    from polsep.pipeline import PolsepWarning, Result, separate
    from polsep.sensor.calibration import Calibration
    from polsep.sensor.camera import Layout, Mosaic
    from polsep.separation.analytic import Separation
    from polsep.separation.report import SeparatedFrame

__all__ = [
    "METHODS",
    "Calibration",
    "Frame",
    "Layout",
    "Light",
    "Measurements",
    "Mosaic",
    "PolsepWarning",
    "ReadOptions",
    "Result",
    "SeparatedFrame",
    "Separation",
    "Shape",
    "Stokes",
    "find_light",
    "read_calibration",
    "read_frames",
    "read_separated",
    "separate",
    "shape",
]

_HOME = {
    "METHODS": "methods",
    "Calibration": "sensor.calibration",
    "Frame": "io.raw.frames",
    "Layout": "sensor.camera",
    "Light": "light.find",
    "Measurements": "physics.stokes",
    "Mosaic": "sensor.camera",
    "PolsepWarning": "pipeline",
    "ReadOptions": "io.raw.frames",
    "Result": "pipeline",
    "SeparatedFrame": "separation.report",
    "Separation": "separation.analytic",
    "Shape": "geometry.one_frame",
    "Stokes": "physics.stokes",
    "find_light": "light.find",
    "read_calibration": "io.store.calibrations",
    "read_frames": "io.raw.frames",
    "read_separated": "io.results.separation_reader",
    "separate": "pipeline",
    "shape": "geometry.one_frame",
}

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'polsep' has no attribute {name!r}")
    return getattr(import_module(f"polsep.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
