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
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Where g ends, in sigmas.
REACH = 6.0
#: Rows, or columns, that one product makes: fewest and most.
_ROWS = (32, 128)
#: Less light than this is none.
_DARK = np.float32(1e-30)
#: Steps of Richardson and Lucy. Each halves errors of broad shapes, about, and adds noise.
STEPS = 4


def blur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Blur by a Gaussian of ``sigma`` pixels, inside ``mask`` if there is one; the sum is kept up to rounding.

    Stays non-negative. At sigma 0 the values are the image's own.
    """
    weights = _weights(sigma)
    light = _as_planes(image)
    if mask is None:
        return _as_image(_gaussian(light, weights))
    spread = mask * _gaussian(mask * light / _reached(mask, weights), weights)
    return _as_image((1 - mask) * light + spread)


def deblur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Undo a blur of ``sigma`` pixels by `STEPS` steps of Richardson-Lucy deconvolution; the sum is kept.

    x <- x Aᵀ(y / (A x)) from x = y: never negative, hence without dark rims, and of the sum of y at every step, since
    columns of A sum to 1. Detail that a blur took below the noise does not return; the noise grows.
    Source: Richardson 1972, doi 10.1364/JOSA.62.000055; Lucy 1974, doi 10.1086/111605.
    """
    weights = _weights(sigma)
    light = _as_planes(image)
    if mask is None:
        return _as_image(_richardson_lucy(light, lambda x: _gaussian(x, weights), lambda x: _gaussian(x, weights)))
    inside, reached = mask, _reached(mask, weights)

    def blurred(x: Floats) -> Floats:
        return inside * _gaussian(x / reached, weights)

    def transposed(x: Floats) -> Floats:
        return _gaussian(inside * x, weights) / reached

    return _as_image((1 - mask) * light + _richardson_lucy(mask * light, blurred, transposed))


def _richardson_lucy(
    measured: Floats, blurred: Callable[[Floats], Floats], transposed: Callable[[Floats], Floats]
) -> Floats:
    """The image that ``blurred`` maps to ``measured``, about; ``transposed``: its adjoint."""
    found = measured
    for _ in range(STEPS):
        found = found * transposed(measured / np.maximum(blurred(found), _DARK))
    return found


def _reached(mask: Floats, weights: Floats) -> Floats:
    """G m ``[h, w]``, and 1 where that is 0, so that one may divide by it."""
    share = _gaussian(mask[None], weights)[0]
    return np.where(share > 0, share, np.float32(1))


def _as_planes(image: Floats) -> Floats:
    """``[C, h, w]``, contiguous."""
    return np.ascontiguousarray(image.transpose(2, 0, 1))


def _as_image(planes: Floats) -> Floats:
    """``[h, w, C]``, contiguous."""
    return np.ascontiguousarray(planes.transpose(1, 2, 0))


def _weights(sigma: float) -> Floats:
    """g from -k to k, of sum 1; a single 1 where neighbours would get less than the last bit of float32."""
    reach = math.ceil(REACH * sigma)
    places = np.arange(-reach, reach + 1, dtype=np.float64)
    with np.errstate(over="ignore", under="ignore"):
        weights = np.exp(-0.5 * (places / sigma) ** 2) if sigma > 0 else np.ones(1)
    weights = weights[weights > 1e-9]
    scaled: Floats = (weights / weights.sum()).astype(np.float32)
    return scaled


def _gaussian(planes: Floats, weights: Floats) -> Floats:
    """G x along both axes of ``[C, h, w]``, as products of one banded matrix with some rows, or columns, at a time.

    Matrix products use all cores, and are the fastest there is without a compiled kernel.
    """
    reach = len(weights) // 2
    if reach == 0:
        return planes
    some = min(max(2 * reach, _ROWS[0]), _ROWS[1])
    band = np.zeros((some, some + 2 * reach), np.float32)
    for row in range(some):
        band[row, row : row + len(weights)] = weights
    down, out = np.empty_like(planes), np.empty_like(planes)
    padded = np.pad(planes, ((0, 0), (reach, reach), (0, 0)), mode="symmetric")
    for top, n in _pieces(planes.shape[1], some):
        np.matmul(band[:n, : n + 2 * reach], padded[:, top : top + n + 2 * reach], out=down[:, top : top + n])
    padded = np.pad(down, ((0, 0), (0, 0), (reach, reach)), mode="symmetric")
    for left, n in _pieces(planes.shape[2], some):
        out[..., left : left + n] = padded[..., left : left + n + 2 * reach] @ band[:n, : n + 2 * reach].T
    return out


def _pieces(count: int, some: int) -> Iterator[tuple[int, int]]:
    """Beginnings and lengths of pieces of at most ``some``."""
    yield from ((start, min(some, count - start)) for start in range(0, count, some))
