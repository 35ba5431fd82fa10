"""The transfer function of sRGB, by which displays show linear light, and its inverse. Source: IEC 61966-2-1:1999."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def srgb(linear: ArrayLike) -> NDArray[np.float64]:
    """Encode linear light with the sRGB transfer function; values are clipped to [0, 1] first. Any shape."""
    x = np.clip(np.asarray(linear, dtype=np.float64), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)


def linear_from_srgb(display: ArrayLike) -> NDArray[np.float32]:
    """Linear light of sRGB values in [0, 1]: the inverse of `srgb`."""
    x = np.asarray(display, dtype=np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((np.maximum(x, 0.04045) + 0.055) / 1.055) ** 2.4)


def srgb_bytes(linear: ArrayLike) -> NDArray[np.uint8]:
    """`srgb` in the codes of 8 bits that pictures hold. Any shape."""
    return np.rint(255 * srgb(linear)).astype(np.uint8)
