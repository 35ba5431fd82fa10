"""The equations of the colour-affine closed form that the networks share with it; `closed_form_kernel` is the twin.

For p = s1 + i s2, the diffuse polarization a and white, fully polarized specular light tau,

    p = a s0 + b,   b = tau (e - a),   |e| = 1

in every colour (derivation: `color_affine`). Complex numbers are pairs of real images: real part, imaginary part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polsep.compute.arrays import Array, constant, namespace

#: Largest possible |a|: the limit (eta^2 - 1) / (eta^2 + 1) = 0.3846 of `fresnel.diffuse_dolp` toward grazing exit for
#: eta = 1.5, rounded up.
MAX_DIFFUSE_DOLP = 0.3847

#: Least eigenvalue of the normal equations of b, 6 without clipping, above which b counts as determined.
MIN_EIGENVALUE = 0.3


def white_specular(
    offset: Sequence[Array] | Array, diffuse_polarization: Sequence[Array] | Array, epsilon: float = 0.0
) -> Array:
    """tau from the pairs b and a; |b| where a = 0.

    The positive root of (|a|^2 - 1) tau^2 + 2 Re(b conj a) tau + |b|^2 = 0, unique because |a| < 1. ``epsilon`` under
    the square root keeps the gradient finite where b = 0.
    """
    (b1, b2), (a1, a2) = offset, diffuse_polarization
    real = b1 * a1 + b2 * a2
    free = 1 - a1**2 - a2**2
    return (real + namespace(real).sqrt(real**2 + free * (b1**2 + b2**2) + epsilon)) / free


def parts(pair: Array) -> tuple[Array, Array]:
    """Real and imaginary part ``[..., 1, h, w]`` of a pair ``[..., 2, h, w]``."""
    return pair[..., :1, :, :], pair[..., 1:, :, :]


def limit_dolp(diffuse_polarization: Array) -> Array:
    """a ``[..., 2, h, w]`` with |a| at most `MAX_DIFFUSE_DOLP`, of the same angle."""
    xp, (a1, a2) = namespace(diffuse_polarization), parts(diffuse_polarization)
    size = xp.sqrt(a1**2 + a2**2 + 1e-12)
    return diffuse_polarization * (MAX_DIFFUSE_DOLP / size.clip(MAX_DIFFUSE_DOLP, None))


def fit_unclipped(y: Array, kept: Array, a: Array, angles: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Least squares of y = g s0 + u . b over N pixels for known a: b ``[2, N]``, s0 ``[C, N]``, where b is determined.

    Behind the analyser at angle t, u = (cos 2t, sin 2t) and g = 1 + u . a. ``y``, twice the samples, and their weights
    ``kept`` (0 or 1) are ``[K, C, N]``; every one of the C colours has its own s0 and all share b. ``a``: ``[2, N]``.
    """
    xp, doubled = namespace(y), 2 * np.array(angles)
    u = constant(np.stack([np.cos(doubled), np.sin(doubled)])[..., None, None], y)
    g = 1 + u[0] * a[0] + u[1] * a[1]
    gg = xp.sum(kept * g * g, axis=0).clip(1e-6, None)
    gy = xp.sum(kept * g * y, axis=0)
    gu = [xp.sum(kept * g * u[i], axis=0) for i in (0, 1)]
    projected = [u[i] - g * gu[i] / gg for i in (0, 1)]
    m00, m01, m11 = (xp.sum(kept * projected[i] * projected[j], axis=(0, 1)) for i, j in ((0, 0), (0, 1), (1, 1)))
    r0, r1 = (xp.sum(kept * projected[i] * y, axis=(0, 1)) for i in (0, 1))
    smallest = (m00 + m11) / 2 - xp.sqrt(((m00 - m11) / 2) ** 2 + m01**2)  # hypot is not known to ONNX
    det = (m00 * m11 - m01 * m01).clip(1e-6, None)
    b = xp.stack([m11 * r0 - m01 * r1, m00 * r1 - m01 * r0]) / det
    s0 = (gy - gu[0] * b[0] - gu[1] * b[1]) / gg
    return b, s0, smallest > MIN_EIGENVALUE
