"""Sums over the places of a frame: the fast twin of `lamp_polarization.measure_places`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import HALF, ONE, THIRD, ZERO, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows
from polsep.separation.lamp_polarization import SIDE, Places

Floats = NDArray[np.float32]

#: Rows of places per task of a thread.
_ROWS = 4


def measure_places_fast(diffuse: Floats, specular: Floats, gains: Floats, cell: int) -> Places:
    """Places of images ``[h, w, 3]`` in a light of ``gains [3]``, means over squares of ``cell`` pixels first."""
    rows, cols = (n // (SIDE * cell) for n in diffuse.shape[:2])
    sums = np.empty((9, rows, cols), np.float32)
    images = tuple(read_only(np.ascontiguousarray(image)) for image in (diffuse, specular))
    factors = read_only((1 / gains / cell**2).astype(np.float32))
    run_over_rows(lambda row_range: add_places(images, factors, cell, sums, row_range), rows, _ROWS)
    flat = sums.reshape(9, -1)
    return Places(flat[:3], flat[3:4], flat[4:5], flat[5:8], flat[8])


def warm_up() -> None:
    """Load the kernel, or compile it."""
    image = np.zeros((SIDE, SIDE, 3), np.float32)
    measure_places_fast(image, image, np.ones(3, np.float32), 1)


@entry
def add_places(images: Any, factors: Any, cell: int, sums: Any, row_range: RowRange) -> None:
    """Fill some rows of ``sums [9, rows, cols]``: means of diffuse, specular, specular^2, both's products; largest."""
    diffuse, specular = images
    share = ONE / np.float32(SIDE * SIDE)
    for r in range(row_range[0], row_range[1]):
        for c in range(sums.shape[2]):
            d0 = d1 = d2 = light = square = p0 = p1 = p2 = ZERO
            largest = ZERO
            for y in range(SIDE * r, SIDE * r + SIDE):
                for x in range(SIDE * c, SIDE * c + SIDE):
                    a0 = a1 = a2 = b0 = b1 = b2 = ZERO
                    for i in range(y * cell, y * cell + cell):
                        for j in range(x * cell, x * cell + cell):
                            a0, a1, a2 = a0 + diffuse[i, j, 0], a1 + diffuse[i, j, 1], a2 + diffuse[i, j, 2]
                            b0, b1, b2 = b0 + specular[i, j, 0], b1 + specular[i, j, 1], b2 + specular[i, j, 2]
                    a0, a1, a2 = a0 * factors[0], a1 * factors[1], a2 * factors[2]
                    s = THIRD * (b0 * factors[0] + b1 * factors[1] + b2 * factors[2])
                    d0, d1, d2, light, square = d0 + a0, d1 + a1, d2 + a2, light + s, square + s * s
                    p0, p1, p2 = p0 + s * a0, p1 + s * a1, p2 + s * a2
                    largest = max(largest, s + HALF * max(a0, a1, a2))
            sums[0, r, c], sums[1, r, c], sums[2, r, c] = d0 * share, d1 * share, d2 * share
            sums[3, r, c], sums[4, r, c] = light * share, square * share
            sums[5, r, c], sums[6, r, c], sums[7, r, c] = p0 * share, p1 * share, p2 * share
            sums[8, r, c] = largest
