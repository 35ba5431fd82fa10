"""Gaussian blur that keeps the sum of light, and its inverse as far as there is one.

Blurring is y = G x with G_ij = g(i - j) and all mirror images of j beyond the border (``d c b a | a b c d | d c b a``)
added. That G is symmetric and its rows sum to 1, so its columns do: no light is lost, and uniform light stays uniform.
g is exp(-k^2 / 2 sigma^2), normalised, to 6 sigma, beyond which it is below the last bit of float32.

With a mask m, light stays inside it: y = (1 - m) x + A (m x), A = diag(m) G diag(1 / G m), whose columns sum to 1
inside. Without this, a blurred highlight would shine beyond the outline of its object.

Images are linear light ``[h, w, C]``, float32; masks ``[h, w]`` in [0, 1]; sigma in pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Where g ends, in sigmas.
REACH = 6.0
#: Rows of the image that one product makes.
_ROWS = 128
#: Steps of Richardson and Lucy. Each halves errors of broad shapes, about, and adds noise.
STEPS = 4


def blur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Blur by a Gaussian of ``sigma`` pixels, inside ``mask`` if there is one; the sum is kept up to rounding.

    Stays non-negative. At sigma 0 the values are the image's own.
    """
    if mask is None:
        return _gaussian(image, sigma)
    inside = mask[..., None]
    spread = inside * _gaussian(inside * image / _reached(mask, sigma), sigma)
    return (1 - inside) * image + spread


def deblur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Undo a blur of ``sigma`` pixels by `STEPS` steps of Richardson-Lucy deconvolution; the sum is kept.

    x <- x Aᵀ(y / (A x)) from x = y: never negative, hence without dark rims, and of the sum of y at every step, since
    columns of A sum to 1. Detail that a blur took below the noise does not return; the noise grows.
    Source: Richardson 1972, doi 10.1364/JOSA.62.000055; Lucy 1974, doi 10.1086/111605.
    """
    inside = np.float32(1) if mask is None else mask[..., None]
    reached = np.float32(1) if mask is None else _reached(mask, sigma)
    measured = inside * image
    found = measured
    for _ in range(STEPS):
        seen = inside * _gaussian(found / reached, sigma)
        ratio = np.divide(measured, seen, out=np.zeros_like(measured), where=seen > 0)
        found = found * (_gaussian(inside * ratio, sigma) / reached)
    return found if mask is None else (1 - inside) * image + found


def _reached(mask: Floats, sigma: float) -> Floats:
    """G m ``[h, w, 1]``, and 1 where that is 0, so that one may divide by it."""
    share = _gaussian(mask[..., None], sigma)
    return np.where(share > 0, share, np.float32(1))


def _gaussian(image: Floats, sigma: float) -> Floats:
    """G x along both axes of ``[h, w, C]``."""
    weights = _weights(sigma)
    if len(weights) == 1:
        return image
    height, width, colors = image.shape
    columns = _along_rows(image.reshape(height, width * colors), weights).reshape(height, width, colors)
    turned = np.ascontiguousarray(columns.transpose(1, 0, 2)).reshape(width, height * colors)
    return np.ascontiguousarray(_along_rows(turned, weights).reshape(width, height, colors).transpose(1, 0, 2))


def _weights(sigma: float) -> Floats:
    """g from -k to k, of sum 1; a single 1 where neighbours would get less than the last bit of float32."""
    places = np.arange(-math.ceil(REACH * sigma), math.ceil(REACH * sigma) + 1, dtype=np.float64)
    with np.errstate(over="ignore", under="ignore"):
        weights = np.exp(-0.5 * (places / sigma) ** 2) if sigma > 0 else np.ones(1)
    weights = weights[weights > 1e-9]
    scaled: Floats = (weights / weights.sum()).astype(np.float32)
    return scaled


def _along_rows(image: Floats, weights: Floats) -> Floats:
    """Blur ``[n, m]`` along its first axis, as products of one banded matrix with `_ROWS` rows at a time.

    The fastest way there is without a compiled kernel: matrix products use all cores.
    """
    reach, rows = len(weights) // 2, image.shape[0]
    padded = np.pad(image, ((reach, reach), (0, 0)), mode="symmetric")
    band = np.zeros((_ROWS, _ROWS + 2 * reach), np.float32)
    for row in range(_ROWS):
        band[row, row : row + len(weights)] = weights
    out = np.empty_like(image)
    for top in range(0, rows, _ROWS):
        some = min(_ROWS, rows - top)
        np.matmul(band[:some, : some + 2 * reach], padded[top : top + some + 2 * reach], out=out[top : top + some])
    return out
