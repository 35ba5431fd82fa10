"""The one table of tolerances: how exactly each kind of claim has to hold."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

#: Formulas that are exact up to rounding: absolute error for values of order one, and relative error.
ROUNDING = {torch.float32: 1e-5, torch.float64: 1e-12}

#: Claims that are not exact, by what limits them.
PRINTED = 6e-5  # constants printed with four decimals
QUADRATURE = 2e-3  # integrals over a hemisphere by the midpoint rule
MITSUBA = 1e-5  # a renderer that computes in float32, relative to the largest matrix element
NORMALS = 1e-3  # unit normals by central differences of a float32 signed distance
SHADING = 5e-3  # what such normals leave of angles [rad] and degrees of polarization
HIT = 2e-3  # where sphere tracing stops before a surface that it meets at up to about 80 degrees
SIGMAS = 5.0  # sample statistics, in standard errors


def as_tensor(value: Any) -> Tensor:
    """Tensors as they are; plain numbers and lists in float64."""
    return value if isinstance(value, Tensor) else torch.as_tensor(value, dtype=torch.float64)


def assert_close(actual: Any, expected: Any, scale: float = 1.0) -> None:
    """Equal up to rounding in the dtype of ``actual``; ``scale`` is the magnitude of what went into both."""
    actual, expected = as_tensor(actual), as_tensor(expected)
    tolerance = ROUNDING[actual.dtype]
    torch.testing.assert_close(actual, expected.to(actual.dtype), rtol=tolerance, atol=tolerance * scale)


def assert_within(actual: Any, expected: Any, tolerance: float) -> None:
    """Equal up to an absolute ``tolerance``, one of the constants above."""
    actual, expected = as_tensor(actual), as_tensor(expected)
    torch.testing.assert_close(actual.double(), expected.double().expand_as(actual), rtol=0, atol=tolerance)


def assert_same_angle(actual: Any, expected: Any, tolerance: float, period: float = torch.pi) -> None:
    """Angles [rad] equal modulo ``period`` up to ``tolerance`` [rad]."""
    difference = as_tensor(actual).double() - as_tensor(expected).double()
    wrapped = torch.remainder(difference + period / 2, period) - period / 2
    assert_within(wrapped, torch.zeros_like(wrapped), tolerance)


def assert_finite(*tensors: Tensor | None) -> None:
    """Every tensor is there and holds neither NaN nor infinity."""
    for tensor in tensors:
        assert tensor is not None
        assert bool(torch.isfinite(tensor).all())
