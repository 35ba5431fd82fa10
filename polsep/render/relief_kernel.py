"""Bump mapping: normals tilted by the gradient of solid noise, as on leather, bark, plaster or cast metal.

Geometry and cast shadows stay those of the smooth surface; shading follows the normals. Source: Blinn 1978.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, TWO, ZERO, entry
from polsep.compute.threads import RowRange, run_over_rows
from polsep.render.patterns_kernel import gradient_noise

Floats = NDArray[np.float32]

#: Step of the finite differences, in cells of the noise.
_STEP = np.float32(1 / 32)
#: Ratio of the tilts of successive octaves; least cosine between a tilted normal and the direction to the eye.
_GAIN, _MIN_COSINE = np.float32(0.7), np.float32(0.02)
#: Difference between the seeds of octaves.
_KEY_STEP = np.uint32(77)
#: Points per range of work of a thread.
_POINTS_AT_ONCE = 1 << 14


class Relief(NamedTuple):
    """Noise of ``octaves``, the first of ``frequency`` cells per scene unit; ``strength``: tangent of a usual tilt."""

    frequency: float
    strength: float
    octaves: int
    seed: int


def roughen_normals(positions: Floats, normals: Floats, eye: Floats, relief: Relief) -> None:
    """Tilt unit ``normals [3, M]`` at ``positions [3, M]`` in place, except those that would face away from the eye."""
    frequency, strength, seed = np.float32(relief.frequency), np.float32(relief.strength), np.uint32(relief.seed)

    def roughen(row_range: RowRange) -> None:
        _roughen(positions, normals, eye, frequency, strength, relief.octaves, seed, row_range)

    run_over_rows(roughen, positions.shape[1], _POINTS_AT_ONCE)


@entry
def _roughen(
    positions: Any, normals: Any, eye: Any, frequency: Any, strength: Any, octaves: int, seed: Any, row_range: Any
) -> None:
    for m in range(row_range[0], row_range[1]):
        x, y, z = positions[0, m] * frequency, positions[1, m] * frequency, positions[2, m] * frequency
        gx, gy, gz, gain, key = ZERO, ZERO, ZERO, strength / _STEP, seed
        for _ in range(octaves):
            here = gradient_noise(x, y, z, key)
            gx += gain * (gradient_noise(x + _STEP, y, z, key) - here)
            gy += gain * (gradient_noise(x, y + _STEP, z, key) - here)
            gz += gain * (gradient_noise(x, y, z + _STEP, key) - here)
            x, y, z, gain, key = x * TWO, y * TWO, z * TWO, gain * _GAIN, np.uint32(key + _KEY_STEP)
        nx, ny, nz = normals[0, m], normals[1, m], normals[2, m]
        along = gx * nx + gy * ny + gz * nz
        nx, ny, nz = nx - gx + along * nx, ny - gy + along * ny, nz - gz + along * nz
        scale = ONE / np.float32(np.sqrt(nx * nx + ny * ny + nz * nz))
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        vx, vy, vz = eye[0] - positions[0, m], eye[1] - positions[1, m], eye[2] - positions[2, m]
        facing = nx * vx + ny * vy + nz * vz
        if facing > _MIN_COSINE * np.float32(np.sqrt(vx * vx + vy * vy + vz * vz)):
            normals[0, m], normals[1, m], normals[2, m] = nx, ny, nz
