"""Images that kernels fill, channels last."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from polsep.compute.compiling import compiled


def check_images(images: Mapping[str, NDArray[Any]], shape: tuple[int, int, int]) -> None:
    """Raises ValueError on images of a wrong shape or dtype, with gaps, or that cannot be written.

    ``diffuse`` and ``specular`` are of the ``shape (h, w, C)``, others ``[h, w]``; all float32, but ``valid`` is bool.
    """
    for name, image in images.items():
        wanted = shape if name in ("diffuse", "specular") else shape[:2]
        dtype = "bool" if name == "valid" else "float32"
        if image.shape != wanted or image.dtype != dtype or not image.flags.c_contiguous or not image.flags.writeable:
            raise ValueError(
                f"expected {name} to be a writable C-contiguous {dtype} array {list(wanted)}, "
                f"found {image.dtype} {list(image.shape)}"
            )


@compiled
def interleave_colors(planes: tuple[Any, Any, Any], gains: Any, image: Any) -> None:
    """Three rows ``[w]`` times their ``gains [3]``, to one row ``image [3 w]``."""
    red, green, blue = planes
    g0, g1, g2 = gains[0], gains[1], gains[2]
    for j in range(image.size // 3):
        image[3 * j] = g0 * red[j]
        image[3 * j + 1] = g1 * green[j]
        image[3 * j + 2] = g2 * blue[j]
