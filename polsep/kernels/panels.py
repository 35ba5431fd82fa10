"""Small sRGB pictures of large linear images, fast enough for every frame of a stream.

Pixels are means over squares, times a gain, through a table of the tone curve; see `io.previews`, whose pictures for
reading are made with more care.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.kernels.compiling import ONE, ZERO, compiled, entry
from polsep.kernels.threads import Piece, share

#: Steps of the tone curve's table.
STEPS = 4096
#: Rows of a panel that a thread takes at a time.
_ROWS = 16


def tone_table() -> NDArray[np.uint8]:
    """sRGB codes of `STEPS` + 1 equal steps of the square root of linear light from 0 to 1 (IEC 61966-2-1:1999)."""
    x = (np.arange(STEPS + 1) / STEPS) ** 2
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 0.0031308) ** (1 / 2.4) - 0.055)
    codes: NDArray[np.uint8] = np.rint(255 * encoded).astype(np.uint8)
    return codes


@compiled
def _code(light: Any, table: Any) -> Any:
    limited = ONE if light > ONE else light
    return table[int(np.sqrt(limited) * np.float32(STEPS) + np.float32(0.5))] if limited > ZERO else table[0]


@entry
def fill_panels(
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    gain: float,
    table: NDArray[np.uint8],
    out: NDArray[np.uint8],
    piece: Piece,
) -> None:
    """Rows of ``out [h, 3 w, 3]``: the sum of both ``images [H, W, C]``, the first and the second."""
    first, second = images
    colors, width = first.shape[2], out.shape[1] // 3
    factor = first.shape[0] // out.shape[0]
    scale = np.float32(gain / (factor * factor))
    for y in range(piece[0], piece[1]):
        for x in range(width):
            for c in range(3):
                one, two = ZERO, ZERO
                own = c if colors == 3 else 0
                for row in range(factor * y, factor * y + factor):
                    for col in range(factor * x, factor * x + factor):
                        one += first[row, col, own]
                        two += second[row, col, own]
                out[y, x, c] = _code((one + two) * scale, table)
                out[y, width + x, c] = _code(one * scale, table)
                out[y, 2 * width + x, c] = _code(two * scale, table)


def make_panels(
    diffuse: NDArray[np.float32], specular: NDArray[np.float32], gain: float, widest: int
) -> NDArray[np.uint8]:
    """Input, diffuse and specular ``[h, 3 w, 3]`` beside one another, even sides, each at most ``widest`` wide."""
    height, width = diffuse.shape[:2]
    factor = -(-max(height, width) // widest)
    out = np.empty((max(height // factor // 2 * 2, 2), 3 * max(width // factor // 2 * 2, 2), 3), np.uint8)
    table = tone_table()
    share(lambda rows: fill_panels((diffuse, specular), gain, table, out, rows), out.shape[0], _ROWS)
    return out
