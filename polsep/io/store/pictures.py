"""Pictures for documents, as JPEG: the same pixels make the same bytes, and a file is whole or not there.

Pictures for a page are made in memory, as quickly as that goes.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import imagecodecs
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from polsep.io.store.whole import replace_bytes

#: Quality of the JPEG, 1 to 95. Colours are not subsampled, which thin coloured lines would not survive.
QUALITY = 90
#: The same of pictures that follow a slider.
LIVE_QUALITY = 95


def write_picture(path: Path, pixels: NDArray[np.uint8]) -> None:
    """Write ``pixels`` (uint8, sRGB, ``[h, w, 3]``) as a JPEG file without metadata; makes its folder.

    Raises ValueError on another shape or type.
    """
    replace_bytes(path, encode_picture(pixels))


def encode_picture(pixels: NDArray[np.uint8]) -> bytes:
    """The JPEG file of ``pixels`` (uint8, sRGB, ``[h, w, 3]``). Raises ValueError on another shape or type."""
    if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
        raise ValueError(f"expected pixels uint8 [h, w, 3], found {pixels.dtype} {pixels.shape}")
    stream = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "JPEG", quality=QUALITY, subsampling=0, optimize=True)
    return stream.getvalue()


def encode_live(pixels: NDArray[np.uint8]) -> bytes:
    """The JPEG file of ``pixels`` (uint8, sRGB, ``[h, w, 3]``), in 3 ms at screen size where PNG takes 20 to 50."""
    return bytes(imagecodecs.jpeg8_encode(np.ascontiguousarray(pixels), level=LIVE_QUALITY, subsampling="444"))


def encode_lossless(pixels: NDArray[np.uint8]) -> bytes:
    """The PNG file of ``pixels`` (uint8, sRGB, ``[h, w, 3]``): for scales and legends."""
    return bytes(imagecodecs.png_encode(np.ascontiguousarray(pixels)))
