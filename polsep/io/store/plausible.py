"""Checks of what files claim about a sensor and its light: values by which frames can be divided.

A gain of 0, an infinite black level or a falloff that crosses 0 would put NaN into every image; here the file is named
instead. Limits are a thousand times beyond what sensors have.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.sensor.calibration import Table, falloff_image

#: Gains, colours of light and falloff, about 1, lie within this factor.
FACTOR = 1000.0
#: Most terms of a falloff along each axis, and the points of each axis where it is looked at.
MOST_TERMS, POINTS = 16, 64


def require_gains(name: str, values: Iterable[float] | NDArray[Any] | None) -> None:
    """Raise ValueError unless values are gains, about 1."""
    if values is None:
        return
    found = np.asarray(values if isinstance(values, np.ndarray) else list(values), np.float64)
    wrong = found[~((found >= 1 / FACTOR) & (found <= FACTOR))]
    if wrong.size:
        raise ValueError(f"expected {name} from {1 / FACTOR:g} to {FACTOR:g}, found {wrong.flat[0]:g}")


def require_within(name: str, values: NDArray[Any] | float | None, limit: float, least: float | None = None) -> None:
    """Raise ValueError unless values are finite numbers from ``least`` to ``limit``; None: from ``-limit`` on."""
    if values is None:
        return
    found = np.asarray(values, np.float64)
    wrong = found[~((found >= (-limit if least is None else least)) & (found <= limit))]
    if wrong.size:
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


def require_level(name: str, value: float) -> None:
    """Raise ValueError unless a level is a positive finite number."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"expected a {name} above 0, found {value:g}")
