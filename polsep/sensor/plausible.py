"""Checks of what is claimed about a sensor and its light: values by which frames can be divided.

A gain of 0, an infinite black level or a falloff that crosses 0 would put NaN into every image. Limits are a thousand
times beyond what sensors have.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from polsep.physics.stokes import MAX_DOLP
from polsep.sensor.falloff import Table, falloff_image
from polsep.sensor.levels import require_levels

if TYPE_CHECKING:
    from polsep.sensor.calibration import Calibration

#: Gains, colours of light and falloff, about 1, lie within this factor.
FACTOR = 1000.0
#: Most terms of a falloff along each axis, and the points of each axis where it is looked at.
MOST_TERMS, POINTS = 16, 64
#: Largest angle between an analyser and the layout's [degrees]: others are of another layout. Of lamps: two turns.
MOST_OFF_DEG, MOST_DEGREES = 20.0, 720.0


def require_gains(name: str, values: ArrayLike | None) -> None:
    """Raise ValueError unless values are gains, about 1."""
    require_within(name, values, FACTOR, 1 / FACTOR)


def require_within(name: str, values: ArrayLike | None, limit: float, least: float | None = None) -> None:
    """Raise ValueError unless values are finite numbers from ``least`` to ``limit``; None: from ``-limit`` on."""
    if values is None:
        return
    found, lowest = np.asarray(values), -limit if least is None else least
    if found.size and not (found.min() >= lowest and found.max() <= limit):
        wrong = found[~((found >= lowest) & (found <= limit))]
        wanted = f"within {limit:g}" if least is None else f"from {least:g} to {limit:g}"
        raise ValueError(f"expected {name} {wanted}, found {wrong.flat[0]:g}")


def require_falloff(coefficients: Table | None) -> None:
    """Raise ValueError unless the coefficients are those of a falloff that is positive over the frame."""
    if coefficients is None:
        return
    lengths = {len(row) for row in coefficients}
    if len(lengths) != 1 or not 1 <= len(coefficients) <= MOST_TERMS or not 1 <= max(lengths) <= MOST_TERMS:
        raise ValueError(f"expected a falloff of 1 to {MOST_TERMS} terms along each axis, found other rows")
    require_within("terms of a falloff", np.array(coefficients), FACTOR)
    require_gains("a falloff", falloff_image(coefficients, POINTS, POINTS))


def require_plausible(c: Calibration) -> None:
    """Raise ValueError on fields of a calibration that no sensor and no lamp have."""
    _require_levels(c)
    _require_places(c)
    _require_pixels(c)


def _require_levels(c: Calibration) -> None:
    """Raise ValueError on levels of no sensor, and on a lamp that is none."""
    require_levels(c.black_level or 0.0, c.white_level)
    require_within("black level", c.black_level, c.white_level)
    require_within("read noise", c.read_noise, c.white_level, 0.0)
    if c.lamp is not None:
        require_gains("a lamp's colour", c.lamp.color)
        require_within("a lamp's dolp", c.lamp.dolp, MAX_DOLP, 0.0)
        require_within("a lamp's aolp_deg", c.lamp.aolp_deg, MOST_DEGREES)


def _require_places(c: Calibration) -> None:
    """Raise ValueError on tables of another period, or of what no sensor has."""
    period = c.layout.period
    for name in ("black_pattern", "gains", "analysers"):
        table = getattr(c, name)
        if table is not None and [len(row) for row in table] != [period] * period:
            raise ValueError(f"expected {name} of {period}x{period} places, found {[len(row) for row in table]}")
    require_within("black pattern", c.black_pattern, c.white_level)
    require_gains("gains", c.gains)
    require_falloff(c.falloff)
    for row, analysers in enumerate(c.analysers or ()):
        for col, analyser in enumerate(analysers):
            nominal = c.layout.filter_at(row, col).angle_deg
            if not abs((analyser.angle_deg - nominal + 90) % 180 - 90) <= MOST_OFF_DEG:
                wanted = f"angles of analysers within {MOST_OFF_DEG:g} degrees of the layout's {nominal:g}"
                raise ValueError(f"expected {wanted}, found {analyser.angle_deg:g}")
            require_gains("gains of analysers", analyser.gain)
            if not analyser.extinction > 1:
                raise ValueError(f"expected extinction ratios above 1, found {analyser.extinction:g}")


def _require_pixels(c: Calibration) -> None:
    """Raise ValueError on maps of another size or of what no sensor has, and on pixels beyond the frame."""
    if c.size is not None and min(c.size) < 1:
        raise ValueError(f"expected a size of positive height and width, found {c.size}")
    for name in ("black_map", "gain_map"):
        values = getattr(c, name)
        if values is not None and values.shape != c.size:
            raise ValueError(f"expected a {name} of the size {c.size}, found {values.shape}")
    require_within("black map", c.black_map, c.white_level)
    require_gains("gains of pixels", c.gain_map)
    count = math.prod(c.size or (0,))
    for pixels in (pixels for pixels in (c.hot, c.dead) if pixels is not None):
        if pixels.ndim != 1 or (pixels.size and not 0 <= pixels.min() <= pixels.max() < count):
            raise ValueError(f"expected defective pixels as indices below {count}, found others")
