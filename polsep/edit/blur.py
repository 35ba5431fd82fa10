"""Gaussian blur that keeps the sum of light, and its approximate inverse.

Blurring is y = G x with G_ij = g(i - j) and all mirror images of j beyond the border (``d c b a | a b c d | d c b a``)
added. That G is symmetric and its rows sum to 1, so its columns do too: the sum and uniform light are kept.
g is exp(-k^2 / 2 sigma^2), normalised, to 6 sigma, beyond which it is below the last bit of float32.

With a mask m, light stays inside it: y = (1 - m) x + A (m x), A = diag(m) G diag(1 / G m), whose columns sum to 1
inside. Without this, a blurred highlight would shine beyond the outline of its object.

Images are linear light ``[h, w, C]``, float32; masks ``[h, w]`` in [0, 1]; sigma in pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from polsep.edit.blur_kernel import filter_image

Floats = NDArray[np.float32]

#: Radius of g in sigmas.
REACH = 6.0
#: Light below this counts as zero.
_DARK = np.float32(1e-30)
#: Steps of Richardson-Lucy deconvolution. Each about halves the error of broad shapes and adds noise.
STEPS = 4


def blur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Blur by a Gaussian of ``sigma`` pixels, inside ``mask`` if there is one; the sum is kept up to rounding.

    Stays non-negative. At sigma 0 the values are the image's own.
    """
    weights = gaussian_weights(sigma)
    if mask is None:
        return filter_image(image, weights)
    inside, reached = _inside(image, mask, weights)
    return (1 - inside) * image + inside * filter_image(inside * image / reached, weights)


def deblur(image: Floats, sigma: float, mask: Floats | None = None) -> Floats:
    """Undo a blur of ``sigma`` pixels by `STEPS` steps of Richardson-Lucy deconvolution; the sum is kept.

    x <- x Aᵀ(y / (A x)) from x = y: never negative, hence without dark rims, and of the sum of y at every step, since
    columns of A sum to 1. Detail below the noise is not restored; the noise grows.
    Source: Richardson 1972, doi 10.1364/JOSA.62.000055; Lucy 1974, doi 10.1086/111605.
    """
    weights = gaussian_weights(sigma)
    if mask is None:
        return _richardson_lucy(image, lambda x: filter_image(x, weights), lambda x: filter_image(x, weights))
    inside, reached = _inside(image, mask, weights)
    sharpened = _richardson_lucy(
        inside * image,
        lambda x: inside * filter_image(x / reached, weights),
        lambda x: filter_image(inside * x, weights) / reached,
    )
    return (1 - inside) * image + sharpened


def _richardson_lucy(
    measured: Floats, blurred: Callable[[Floats], Floats], transposed: Callable[[Floats], Floats]
) -> Floats:
    """An image that ``blurred`` maps approximately to ``measured``; ``transposed``: its adjoint."""
    estimate = measured
    for _ in range(STEPS):
        predicted: Floats = np.maximum(blurred(estimate), _DARK)
        estimate = estimate * transposed(measured / predicted)
    return estimate


def _inside(image: Floats, mask: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """m and G m, for every colour ``[h, w, C]``; G m is 1 instead of 0, so that it can be a divisor."""
    share = filter_image(mask[..., None], weights)
    reached = np.where(share > 0, share, np.float32(1))
    # Repeated, because NumPy multiplies by the same number for three colours at a sixth of the speed.
    return np.repeat(mask[..., None], image.shape[2], axis=2), np.repeat(reached, image.shape[2], axis=2)


def gaussian_weights(sigma: float) -> Floats:
    """g at the distances 0, 1, ..., normalised over both sides."""
    places = np.arange(math.ceil(REACH * sigma) + 1, dtype=np.float64)
    with np.errstate(over="ignore", under="ignore"):
        weights = np.exp(-0.5 * (places / sigma) ** 2) if sigma > 0 else np.ones(1)
    scaled: Floats = (weights / (2 * weights.sum() - 1)).astype(np.float32)
    return scaled
