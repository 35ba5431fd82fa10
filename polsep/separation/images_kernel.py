"""Separated images that kernels fill, channels last."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import compiled
from polsep.separation.images import FrameImages


def check_images(
    images: FrameImages, shape: tuple[int, int, int], report: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """DoLP and AoLP for kernels to fill, both empty unless a ``report`` is wanted.

    Raises ValueError on images that do not fit ``shape`` (h, w, C), of another dtype, with gaps, that cannot be
    written, or missing for a report.
    """
    for name, image in images.arrays().items():
        wanted = shape if name in ("diffuse", "specular") else shape[:2]
        dtype = "bool" if name == "valid" else "float32"
        if image.shape != wanted or image.dtype != dtype or not image.flags.c_contiguous or not image.flags.writeable:
            raise ValueError(
                f"expected {name} to be a writable C-contiguous {dtype} array {list(wanted)}, "
                f"found {image.dtype} {list(image.shape)}"
            )
    if not report:
        return np.empty((0, 0), np.float32), np.empty((0, 0), np.float32)
    if images.dolp is None or images.aolp is None:
        raise ValueError("expected arrays for dolp and aolp, which a report needs, found none")
    return images.dolp, images.aolp


@compiled
def interleave(planes: Any, gains: Any, image: Any) -> None:
    """Rows ``planes [C, n]``, or one row for all colours, times ``gains [C]``, to a row ``image [w C]``."""
    if gains.size == 1:
        gray, gain = planes[0], gains[0]
        for j in range(image.size):
            image[j] = gain * gray[j]
        return
    red, green, blue = planes[0], planes[1 % planes.shape[0]], planes[2 % planes.shape[0]]
    g0, g1, g2 = gains[0], gains[1], gains[2]
    for j in range(image.size // 3):
        image[3 * j] = g0 * red[j]
        image[3 * j + 1] = g1 * green[j]
        image[3 * j + 2] = g2 * blue[j]
