"""Damped least squares for a few unknowns (Levenberg 1944, Marquardt 1963), with derivatives by differences."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

#: Steps of the solver.
STEPS = 60


def least_squares(residuals: Callable[[Doubles], Doubles], x: Doubles) -> tuple[Doubles, Doubles]:
    """The nearest minimum of a sum of squares by Levenberg and Marquardt, and the Jacobian there, by differences."""
    damping, value = 1e-3, residuals(x)
    jacobian = _jacobian(residuals, x, value)
    for _ in range(STEPS):
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(
            normal + damping * np.diag(np.diag(normal)) + 1e-12 * np.eye(x.size), -jacobian.T @ value
        )
        moved = residuals(x + step)
        if moved @ moved < value @ value:
            done = float(np.abs(step).max()) < 1e-10
            x, value, damping = x + step, moved, damping / 5
            jacobian = _jacobian(residuals, x, value)
            if done:
                break
        else:
            damping *= 5
    return x, jacobian


def _jacobian(residuals: Callable[[Doubles], Doubles], x: Doubles, value: Doubles) -> Doubles:
    columns = []
    for i in range(x.size):
        moved = x.copy()
        moved[i] += 1e-6
        columns.append((residuals(moved) - value) / 1e-6)
    return np.stack(columns, axis=1)
