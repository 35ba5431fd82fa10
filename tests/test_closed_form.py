"""The equations of the closed form: torch and kernels agree, and both invert the model."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tolerances import assert_within

from polsep.compute.compiling import entry
from polsep.separation.closed_form import MAX_DIFFUSE_DOLP, MIN_EIGENVALUE, fit_unclipped, limit_dolp, white_specular
from polsep.separation.closed_form_kernel import fit_unclipped as fit_unclipped_pixel
from polsep.separation.closed_form_kernel import limit_dolp_row, white_specular_row

PIXELS = 500
ANGLES = tuple(math.radians(angle) for angle in (0, 45, 90, 135))
#: Of float32 arithmetic in another order, for values of order one; of a system of equations, by its least eigenvalue.
ORDER, SOLVED = 1e-6, 2e-4


@entry
def _white_specular(b: Any, a: Any, tau: Any) -> None:
    white_specular_row(b[0], b[1], a[0], a[1], np.float32(0), tau)
    limit_dolp_row(a[0], a[1])


@entry
def _fit(y: Any, kept: Any, a: Any, cosines: Any, sines: Any, s0: Any, b: Any) -> None:
    for n in range(y.shape[0]):
        b[0, n], b[1, n], b[2, n] = fit_unclipped_pixel(y[n], kept[n], cosines, sines, a[0, n], a[1, n], s0[n])


def random_polarization(most: float) -> NDArray[np.float32]:
    """Pairs ``[2, N]`` of at most that size."""
    rng = np.random.default_rng(2)
    size, angle = most * np.sqrt(rng.random(PIXELS)), 2 * math.pi * rng.random(PIXELS)
    return np.stack([size * np.cos(angle), size * np.sin(angle)]).astype(np.float32)


def test_white_specular_and_the_limit_of_dolp_agree() -> None:
    a, b = random_polarization(0.6), 2 * random_polarization(1.0)[:, ::-1].copy()
    limited, tau = a.copy(), np.empty(PIXELS, np.float32)
    _white_specular(b, limited, tau)
    assert_within(torch.from_numpy(tau), white_specular(torch.from_numpy(b), torch.from_numpy(a)), ORDER)
    expected = limit_dolp(torch.from_numpy(a)[..., None])[..., 0]
    assert_within(torch.from_numpy(limited), expected, ORDER)
    assert_within(np.hypot(*limited).max(), MAX_DIFFUSE_DOLP, ORDER)


def test_least_squares_of_unclipped_samples_agree_and_invert_the_model() -> None:
    """With three to twelve of the twelve samples, and where too few are left."""
    rng = np.random.default_rng(3)
    a, b = random_polarization(MAX_DIFFUSE_DOLP), random_polarization(0.5)[:, ::-1]
    s0 = rng.random((PIXELS, 3)).astype(np.float32)
    kept = rng.random((PIXELS, 3, 4)) < rng.random((PIXELS, 1, 1))
    cosines, sines = (f(2 * np.array(ANGLES)).astype(np.float32) for f in (np.cos, np.sin))
    g = 1 + cosines * a[0][:, None] + sines * a[1][:, None]
    y = g[:, None] * s0[..., None] + (cosines * b[0][:, None] + sines * b[1][:, None])[:, None]
    found, solved = np.empty_like(s0), np.empty((3, PIXELS), np.float32)
    _fit(y.astype(np.float32), kept, a, cosines, sines, found, solved)

    samples, weights = (torch.from_numpy(x.transpose(2, 1, 0).astype(np.float32)) for x in (y, kept))
    twin_b, twin_s0, determined = fit_unclipped(samples, weights, torch.from_numpy(a), ANGLES)
    clear = np.abs(solved[2] - MIN_EIGENVALUE) > 1e-4
    np.testing.assert_array_equal((solved[2] > MIN_EIGENVALUE)[clear], determined.numpy()[clear])
    sure = determined.numpy()
    assert 0.3 < sure.mean() < 0.95
    np.testing.assert_allclose(solved[:2, sure], twin_b.numpy()[:, sure], atol=SOLVED)
    np.testing.assert_allclose(solved[:2, sure], b[:, sure], atol=SOLVED)
    seen = kept.any(axis=2) & sure[:, None]
    np.testing.assert_allclose(found[seen], twin_s0.numpy().T[seen], atol=SOLVED)
    np.testing.assert_allclose(found[seen], s0[seen], atol=SOLVED)
