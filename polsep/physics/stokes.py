"""The algebra of linearly polarized light.

Conventions, shared by everything below and by every other module:

* A Stokes vector is three tensors ``s0, s1, s2`` of one shape ``[..., C, H, W]``, unnormalised, on one linear scale.
  Circular polarization (s3) is zero in this project: linear light stays linear off a dielectric.
* One measurement behind an ideal analyser at angle t is ``m = (s0 + s1 cos 2t + s2 sin 2t) / 2`` (Dave et al. 2022,
  Eqs. 11-12). Unit: 1.0 is one measurement at the sensor's white level, so an unclipped ``s0`` reaches 2.
* Angles are radians, measured from image-right toward image-UP. Image rows grow downward, so a direction
  (d_row, d_col) in an array has the angle ``atan2(-d_row, d_col)``. AoLP lies in [0, pi).
* Where ``s0`` is zero or negative, DoLP is 0. DoLP above 1 (noise, misregistration) is reported, not hidden.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

#: Largest DoLP of separated frames: that of least squares with one bright analyser among four. Methods whose s0 comes
#: from other samples than their s1 and s2 would have any number in the dark.
MAX_DOLP = 2.0


@dataclass(frozen=True)
class Stokes:
    """Linear Stokes images ``s0, s1, s2``, each ``[..., C, H, W]``, floating point, same linear scale."""

    s0: Tensor
    s1: Tensor
    s2: Tensor

    def __post_init__(self) -> None:
        if self.s1.shape != self.s0.shape or self.s2.shape != self.s0.shape:
            shapes = sorted({tuple(s.shape) for s in (self.s0, self.s1, self.s2)})
            raise ValueError(f"s0, s1, s2 must have one shape, found {shapes}")
        if not self.s0.is_floating_point():
            raise TypeError(f"Stokes images must be floating point, found {self.s0.dtype}")

    def __add__(self, other: Stokes) -> Stokes:
        """Incoherent superposition: Stokes vectors of independent light add."""
        return Stokes(self.s0 + other.s0, self.s1 + other.s1, self.s2 + other.s2)

    def __mul__(self, scale: float | Tensor) -> Stokes:
        """Every component times ``scale`` (broadcast against ``[..., C, H, W]``)."""
        return Stokes(self.s0 * scale, self.s1 * scale, self.s2 * scale)

    def map(self, function: Callable[[Tensor], Tensor]) -> Stokes:
        """The same linear image operation (blur, crop, mean over channels) on every component."""
        return Stokes(function(self.s0), function(self.s1), function(self.s2))


@dataclass(frozen=True)
class Measurements:
    """Samples behind K analysers at the same points: ``data`` and ``clipped`` are ``[..., K, C, H, W]``.

    ``angles`` are the K analyser angles in radians. ``clipped`` marks samples that are only known to be at least as
    bright as their value; it may be None when nothing clips. ``variance [..., 1, H, W]`` is the variance of colour
    differences that a demosaicker expects its own interpolation to have added, None for co-sited samples. ``uniform``:
    the same samples with one and the same blur in all colours and analysers, where ``data`` lacks that; else None.
    """

    data: Tensor
    angles: tuple[float, ...]
    clipped: Tensor | None = None
    variance: Tensor | None = None
    uniform: Measurements | None = None

    def __post_init__(self) -> None:
        if self.data.ndim < 4 or self.data.shape[-4] != len(self.angles):
            raise ValueError(f"expected data [..., {len(self.angles)}, C, H, W], found shape {tuple(self.data.shape)}")
        if self.clipped is not None and self.clipped.shape != self.data.shape:
            raise ValueError(
                f"clipped must have the shape of data {tuple(self.data.shape)}, found {tuple(self.clipped.shape)}"
            )


def analyser_matrix(angles: Sequence[float]) -> Tensor:
    """Rows ``[1, cos 2t, sin 2t] / 2`` of K ideal analysers: the matrix P of Eqs. 11-12, ``[K, 3]``."""
    return torch.tensor(_analyser_rows(angles), dtype=torch.float64)


def _analyser_rows(angles: Sequence[float]) -> list[list[float]]:
    """`analyser_matrix` as numbers, which are constants to whoever traces a computation."""
    return [[0.5, 0.5 * math.cos(2 * t), 0.5 * math.sin(2 * t)] for t in angles]


def intensity_behind(stokes: Stokes, angle: float | Tensor) -> Tensor:
    """Intensity behind an ideal linear polarizer at ``angle`` [rad]: Malus' law for any linear state (Eq. 11)."""
    t = torch.as_tensor(angle, dtype=stokes.s0.dtype, device=stokes.s0.device)
    return 0.5 * (stokes.s0 + stokes.s1 * torch.cos(2 * t) + stokes.s2 * torch.sin(2 * t))


def measure(stokes: Stokes, angles: Sequence[float]) -> Measurements:
    """Forward model of K analysers without a sensor: m = P s (Eq. 12). Twin of `fit_stokes`; nothing clips."""
    data = torch.stack([intensity_behind(stokes, t) for t in angles], dim=-4)
    return Measurements(data, tuple(float(t) for t in angles))


def _combine(matrix: Tensor, data: Tensor) -> Stokes:
    """Apply a [3, K] matrix along the analyser axis of ``[..., K, C, H, W]``."""
    s = torch.einsum("sk,...kchw->s...chw", matrix.to(data), data)
    return Stokes(s[0], s[1], s[2])


def fit_stokes(measurements: Measurements) -> Stokes:
    """Least-squares Stokes images from any three or more analysers, clipped values taken at face value.

    This is the paper's Eq. 15, s = P^+ m, for any set of angles. Clipping biases it; see `fit_stokes_unclipped`.
    Raises ValueError when the angles do not determine a Stokes vector.
    """
    return _combine(stokes_inverse(measurements.angles), measurements.data)


def stokes_inverse(angles: Sequence[float]) -> Tensor:
    """The pseudo-inverse ``[3, K]`` of `analyser_matrix`, float64: Stokes vectors from the samples of K analysers.

    Raises ValueError when the angles do not determine a Stokes vector.
    """
    return torch.tensor(_pseudo_inverse(tuple(angles)), dtype=torch.float64)


@lru_cache(maxsize=32)
def _pseudo_inverse(angles: tuple[float, ...]) -> list[list[float]]:
    """The numbers of `_analyser_rows`."""
    matrix = np.array(_analyser_rows(angles))
    if np.linalg.matrix_rank(matrix, tol=1e-6 * np.linalg.norm(matrix, 2)) < 3:
        degrees = [round(math.degrees(t), 3) for t in angles]
        raise ValueError(f"need three analysers of different angles (modulo 180 degrees), found {degrees}")
    found = np.linalg.pinv(matrix)
    inverse: list[list[float]] = np.where(np.abs(found) < 1e-12, 0, found).tolist()  # rounding would polarize
    return inverse


def fit_stokes_unclipped(measurements: Measurements) -> tuple[Stokes, Tensor]:
    """Least squares from the unclipped analysers only, and where ``[..., C, H, W]`` they determine s0, s1 and s2.

    Any three unclipped analysers are exact: with 0/45/90/135 degrees, m0 = m45 + m135 - m90 and its three siblings
    (the identity m0 + m90 = m45 + m135). With two unclipped analysers that are crossed, s0 and the component along
    them are exact and the other one is set to 0; otherwise the clipped values enter as the lower bounds they are.
    Source: docs/conventions.md, clipping; three-angle case also in Dave et al. 2022b (PANDORA, ECCV).
    """
    stokes = fit_stokes(measurements)
    if measurements.clipped is None or not bool(measurements.clipped.any()):
        return stokes, torch.ones_like(stokes.s0, dtype=torch.bool)
    data = measurements.data.movedim(-4, 0)
    clipped = measurements.clipped.movedim(-4, 0)
    touched = clipped.any(dim=0)
    codes = sum(clipped[k][touched].long() << k for k in range(len(measurements.angles)))
    assert isinstance(codes, Tensor)
    samples = data[:, touched]
    solution = torch.stack([s[touched] for s in (stokes.s0, stokes.s1, stokes.s2)])
    determined = torch.ones_like(touched)
    determined_touched = torch.zeros_like(codes, dtype=torch.bool)
    for code in set(codes.tolist()):
        matrix, exact = unclipped_inverse(measurements.angles, int(code))
        rows = codes == code
        determined_touched[rows] = exact
        if matrix is not None:
            solution[:, rows] = matrix.to(samples) @ samples[:, rows]
    determined[touched] = determined_touched
    s0, s1, s2 = stokes.s0.clone(), stokes.s1.clone(), stokes.s2.clone()
    for image, values in zip((s0, s1, s2), solution, strict=True):
        image[touched] = values
    return Stokes(s0, s1, s2), determined


def unclipped_inverse(angles: tuple[float, ...], code: int) -> tuple[Tensor | None, bool]:
    """`stokes_inverse` without the analysers whose bits in ``code`` are set, and whether it determines s0, s1 and s2.

    ``[3, K]`` with zeros for those analysers. Two crossed ones leave the third component 0; fewer or others give None.
    """
    kept = [k for k in range(len(angles)) if not code >> k & 1]
    matrix = analyser_matrix(angles)
    rank = int(torch.linalg.matrix_rank(matrix[kept], rtol=1e-6)) if kept else 0
    crossed = len(kept) == 2 and abs(math.cos(2 * (angles[kept[0]] - angles[kept[1]])) + 1) < 1e-6
    if rank < 3 and not crossed:
        return None, False
    inverse = torch.zeros(3, len(angles), dtype=matrix.dtype)
    inverse[:, kept] = torch.linalg.pinv(matrix[kept], rtol=1e-6)
    return inverse, rank == 3


def analyser_residual(measurements: Measurements) -> Tensor:
    """Contradiction of four analysers: the component of m outside the range of P, ``[..., C, H, W]``.

    With 0/45/90/135 degrees it is ``(m0 - m45 + m90 - m135) / 2``: zero without noise, clipping or misregistration,
    and of the same standard deviation as one sample's noise otherwise. Raises ValueError unless four analysers
    determine a Stokes vector.
    """
    matrix = analyser_matrix(measurements.angles)
    if len(measurements.angles) != 4 or torch.linalg.matrix_rank(matrix, rtol=1e-6) < 3:
        degrees = [round(math.degrees(t), 3) for t in measurements.angles]
        raise ValueError(f"the residual needs four analysers of at least three angles, found {degrees}")
    null = torch.linalg.svd(matrix, full_matrices=True).U[:, 3]
    null = null * torch.sign(null[null.abs() > 0.5 * null.abs().max()][0])
    return torch.einsum("k,...kchw->...chw", null.to(measurements.data), measurements.data)


def polarized_intensity(stokes: Stokes) -> Tensor:
    """sqrt(s1^2 + s2^2), the intensity of the polarized part: tau_s of the analytic split (Eq. 18).

    Its gradient is taken as 0 where nothing is polarized.
    """
    polarized = (stokes.s1 != 0) | (stokes.s2 != 0)
    return torch.where(polarized, torch.hypot(torch.where(polarized, stokes.s1, 1.0), stokes.s2), 0.0)


def dolp(stokes: Stokes) -> Tensor:
    """Degree of linear polarization (Eq. 2), 0 where s0 <= 0; above 1 only for unphysical (noisy) data."""
    lit = stokes.s0 > 0
    return torch.where(lit, polarized_intensity(stokes) / torch.where(lit, stokes.s0, 1.0), 0.0)


def aolp(stokes: Stokes) -> Tensor:
    """Angle of linear polarization in [0, pi) [rad], image-right toward image-up; 0 where nothing is polarized.

    Eq. 2 with the two-argument arctangent, which the paper's tan^-1 leaves out.
    """
    angle = torch.remainder(0.5 * torch.atan2(stokes.s2 + 0.0, stokes.s1 + 0.0), math.pi)  # + 0.0 turns -0 into 0
    return torch.where(angle >= math.pi, torch.zeros_like(angle), angle)


def rotate_frame(stokes: Stokes, angle: float | Tensor) -> Stokes:
    """The same light in a frame turned counter-clockwise by ``angle`` [rad]: AoLP falls by ``angle``."""
    t = torch.as_tensor(angle, dtype=stokes.s0.dtype, device=stokes.s0.device)
    c, s = torch.cos(2 * t), torch.sin(2 * t)
    return Stokes(stokes.s0, c * stokes.s1 + s * stokes.s2, c * stokes.s2 - s * stokes.s1)


def flip_horizontal(stokes: Stokes) -> Stokes:
    """The scene mirrored left-right: columns reverse and s2 changes sign (45 and 135 degrees swap)."""
    return Stokes(stokes.s0.flip(-1), stokes.s1.flip(-1), -stokes.s2.flip(-1))


def flip_vertical(stokes: Stokes) -> Stokes:
    """The scene mirrored top-bottom: rows reverse and s2 changes sign."""
    return Stokes(stokes.s0.flip(-2), stokes.s1.flip(-2), -stokes.s2.flip(-2))


def rotate_quarter(stokes: Stokes) -> Stokes:
    """The scene turned by 90 degrees counter-clockwise: s1 and s2 change sign (0 and 90, 45 and 135 swap)."""
    return Stokes(*(sign * s.rot90(1, (-2, -1)) for sign, s in ((1, stokes.s0), (-1, stokes.s1), (-1, stokes.s2))))


def transpose(stokes: Stokes) -> Stokes:
    """The scene mirrored about the array's main diagonal: rows and columns swap and s1 changes sign (0 and 90 swap).

    The diagonal runs along -45 degrees, so an angle t becomes -90 deg - t: cos 2t changes sign, sin 2t does not.
    """
    return Stokes(stokes.s0.mT, -stokes.s1.mT, stokes.s2.mT)
