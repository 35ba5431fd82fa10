"""Checks of the fields of a `camera.Mosaic`."""

from __future__ import annotations

import math
from numbers import Real

import numpy as np
from array_api_compat import is_array_api_obj

from polsep.compute.arguments import WrongType
from polsep.compute.arrays import Array, namespace

#: Least degree of polarization of a lamp: of less, most of its specular light is unpolarized.
MIN_LAMP_DOLP = 0.3


def require_samples(data: Array) -> None:
    """Raise WrongType unless ``data`` is an array of whole numbers or floats: others have no place on a sensor."""
    if not is_array_api_obj(data) or isinstance(data, np.ma.MaskedArray):  # masked samples have no value
        raise WrongType(f"expected samples as a NumPy array or a torch tensor, found {type(data).__name__}")
    if not namespace(data).isdtype(data.dtype, ("integral", "real floating")):
        raise WrongType(f"expected samples of whole numbers or floats, found {data.dtype}")


def require_gains(gains: object, channels: int) -> None:
    """Raise ValueError unless ``gains`` are positive numbers, three or one per channel; of others it is a WrongType."""
    try:
        numbers = [float(gain) for gain in gains]  # type: ignore[attr-defined]
    except (TypeError, ValueError):
        raise WrongType(f"expected a light_color of positive numbers, found {gains!r:.40}") from None
    if len(numbers) not in (3, channels) or not all(0 < gain < math.inf for gain in numbers):
        raise ValueError(f"expected a light_color of three positive numbers, found {gains!r:.80}")


def require_degree(degree: object) -> None:
    """Raise ValueError unless the ``degree`` is None or one that a lamp may have; of no number it is a WrongType."""
    if degree is None:
        return
    if isinstance(degree, bool) or not isinstance(degree, Real):
        raise WrongType(f"expected lamp_dolp as a number, found {degree!r:.40}")
    if not MIN_LAMP_DOLP <= float(degree) <= 1:
        raise ValueError(f"expected lamp_dolp from {MIN_LAMP_DOLP:g} to 1, found {degree:g}")
