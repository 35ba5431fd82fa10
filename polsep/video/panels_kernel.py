"""Small sRGB pictures of large linear images, for every frame of a stream.

Pixels are means over squares, times a gain, through a table of the tone curve; `io.results.previews` draws the
pictures for reading, with more care.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows

#: Steps of the tone curve's table.
STEPS = 4096
#: Rows of a panel per task.
_ROWS = 16


@compiled
def _shrink(image: Any, at: tuple[int, int], colors: int, room: tuple[Any, Any], row: Any) -> None:
    """Sums over squares of an image ``[H, W C]`` to ``row [w C]``; ``at``: the row, and the side of a square."""
    (y, factor), (rows, sums) = at, room
    for x in range(rows.size):
        rows[x] = ZERO
    for k in range(factor * y, factor * y + factor):
        line = image[k]
        for x in range(rows.size):
            rows[x] += line[x]
    n = rows.size - (factor - 1) * colors
    for x in range(n):
        sums[x] = rows[x]
    for k in range(1, factor):
        shifted = rows[k * colors :]
        for x in range(n):
            sums[x] += shifted[x]
    for x in range(row.size // colors):
        for c in range(colors):
            row[colors * x + c] = sums[factor * colors * x + c]


@compiled
def _encode(light: Any, scale: Any, table: Any, at: Any, codes: Any) -> None:
    """Codes ``[3 w]`` of a row of light ``[w C]``; ``at``: room for places in the table."""
    for x in range(light.size):
        value = light[x] * scale
        value = (value if value < ONE else ONE) if value > ZERO else ZERO
        at[x] = np.int32(np.sqrt(value) * np.float32(STEPS) + np.float32(0.5))
    if light.size == codes.size:
        for x in range(codes.size):
            codes[x] = table[at[x]]
        return
    for x in range(light.size):
        for c in range(3):
            codes[3 * x + c] = table[at[x]]


@entry
def fill_panels(
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    gain: float,
    table: NDArray[np.uint8],
    out: NDArray[np.uint8],
    row_range: RowRange,
) -> None:
    """Rows of ``out [h, 3 w, 3]``: the sum of both ``images [H, W, C]``, the first and the second."""
    height, full, colors = images[0].shape
    width = out.shape[1] // 3
    factor = height // out.shape[0]
    scale = np.float32(gain / (factor * factor))
    room = np.empty(full * colors, np.float32), np.empty(full * colors, np.float32)
    one, two = np.empty(width * colors, np.float32), np.empty(width * colors, np.float32)
    both, at = np.empty(width * colors, np.float32), np.empty(width * colors, np.int32)
    first, second = images[0].reshape(height, -1), images[1].reshape(height, -1)
    panels = out.reshape(out.shape[0], -1)
    for y in range(row_range[0], row_range[1]):
        _shrink(first, (y, factor), colors, room, one)
        _shrink(second, (y, factor), colors, room, two)
        for x in range(both.size):
            both[x] = one[x] + two[x]
        _encode(both, scale, table, at, panels[y, : 3 * width])
        _encode(one, scale, table, at, panels[y, 3 * width : 6 * width])
        _encode(two, scale, table, at, panels[y, 6 * width :])


def make_panels(
    images: tuple[NDArray[np.float32], NDArray[np.float32]], gain: float, table: NDArray[np.uint8], widest: int
) -> NDArray[np.uint8]:
    """Sum, first and second of ``images [H, W, C]`` side by side, ``[h, 3 w, 3]``; sides even, at least 2.

    They are at most ``widest``, but for images too narrow to be shrunk so far.

    ``table``: codes of `STEPS` + 1 equal steps of the square root of linear light from 0 to 1.
    """
    height, width = images[0].shape[:2]
    factor = min(-(-max(height, width) // widest), max(min(height, width) // 2, 1))
    out = np.empty((max(height // factor // 2 * 2, 2), 3 * max(width // factor // 2 * 2, 2), 3), np.uint8)
    whole = out.shape[0] * factor  # rows, from which `fill_panels` takes the factor
    first, second = (read_only(np.ascontiguousarray(image[:whole])) for image in images)
    curve = read_only(table)
    run_over_rows(lambda rows: fill_panels((first, second), gain, curve, out, rows), out.shape[0], _ROWS)
    return out
