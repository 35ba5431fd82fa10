"""The falloff of a flat frame: vignetting and an uneven diffuser, as a polynomial over the frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: Rows of numbers: coefficients, or numbers per place of one period of filters, ``[period][period]``.
Table = tuple[tuple[float, ...], ...]


def falloff_image(coefficients: Table, height: int, width: int) -> NDArray[np.float32]:
    """The smooth part of a flat frame ``[height, width]``, 1 at the brightest place of the sensor.

    Sum of ``coefficients[i][j]`` P_i(y) P_j(x) over Legendre polynomials of the pixel's place, -1 to 1 over the frame.
    """
    c = np.asarray(coefficients, np.float64)
    rows, cols = (_legendre(n, k) for n, k in zip((height, width), c.shape, strict=True))
    image: NDArray[np.float32] = (rows @ c @ cols.T).astype(np.float32)
    return image


def _legendre(count: int, terms: int) -> NDArray[np.float64]:
    """Values ``[count, terms]`` of Legendre polynomials at the centres of ``count`` pixels."""
    values = np.polynomial.legendre.legvander((2 * np.arange(count) + 1) / count - 1, terms - 1)
    return np.asarray(values, np.float64)
