"""Largest errors of what must be exact."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch

from polsep.bench.rows import Row
from polsep.methods import METHODS
from polsep.physics.stokes import Measurements, Stokes, fit_stokes_unclipped, measure
from polsep.sensor.camera import Layout


def bench_exactness() -> Iterator[Row]:
    """Largest errors of what must be exact: the analytic formula, and Stokes vectors with one clipped analyser."""
    generator = torch.Generator().manual_seed(2900)
    s0 = 0.4 + 1.4 * torch.rand(3, 64, 64, generator=generator)
    size, angle = (
        s0 * 0.7 * torch.rand(s0.shape, generator=generator),
        math.pi * torch.rand(s0.shape, generator=generator),
    )
    stokes = Stokes(s0, size * torch.cos(2 * angle), size * torch.sin(2 * angle))
    exact = measure(stokes, Layout().angles)
    found = METHODS["analytic"].reference(exact)
    formula = torch.sqrt(stokes.s1**2 + stokes.s2**2)
    error = torch.maximum((found.specular - formula).abs().max(), (found.diffuse - (s0 - formula)).abs().max())
    yield Row("exactness", "analytic against Eqs. 16-18", "analytic", "largest error", float(error), "white")
    worst = 0.0
    for k in range(4):
        data, clipped = exact.data.clone(), torch.zeros_like(exact.data, dtype=torch.bool)
        data[k], clipped[k] = 1.0, True
        recovered, _ = fit_stokes_unclipped(Measurements(data, exact.angles, clipped))
        for name in ("s0", "s1", "s2"):
            worst = max(worst, float((getattr(recovered, name) - getattr(stokes, name)).abs().max()))
    yield Row("exactness", "one clipped analyser recovered", "clip-aware Stokes", "largest error", worst, "white")
