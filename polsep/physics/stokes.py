"""The algebra of linearly polarized light.

Conventions, shared by everything below and by every other module:

* A Stokes vector is three arrays ``s0, s1, s2`` of one shape ``[..., C, H, W]``, unnormalised, on one linear scale.
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
from dataclasses import dataclass, replace
from functools import lru_cache
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType
from polsep.compute.arrays import Array, constant, namespace, require_floats, short_repr

Doubles = NDArray[np.float64]

#: Largest DoLP of separated frames: that of least squares with one bright analyser among four. Methods whose s0 comes
#: from other samples than their s1 and s2 would have any number in the dark.
MAX_DOLP = 2.0
#: An analyser clips below white if its brightest clipped sample is this much below it: more than rounding and the
#: margin of the sensor's codes. Share of pixels of which that leaves light unknown from which on it matters.
BELOW_WHITE, MOST_BOUNDED = 2.0**-8, 1e-3
#: Largest analyser angle [rad], two turns: numbers beyond are degrees.
MOST_ANGLE = 4 * math.pi


@dataclass(frozen=True, eq=False, repr=False)
class Stokes:
    """Linear Stokes images ``s0, s1, s2``, each ``[..., C, H, W]``, floating point, same linear scale."""

    s0: Array
    s1: Array
    s2: Array

    __repr__ = short_repr

    def __post_init__(self) -> None:
        for image in (self.s0, self.s1, self.s2):
            require_floats("Stokes images", image)
        if self.s1.shape != self.s0.shape or self.s2.shape != self.s0.shape:
            shapes = sorted({tuple(s.shape) for s in (self.s0, self.s1, self.s2)})
            raise ValueError(f"s0, s1, s2 must have one shape, found {shapes}")

    def __add__(self, other: Stokes) -> Stokes:
        """Incoherent superposition: Stokes vectors of independent light add."""
        return Stokes(self.s0 + other.s0, self.s1 + other.s1, self.s2 + other.s2)

    def __mul__(self, scale: float | Array) -> Stokes:
        """Every component times ``scale`` (broadcast against ``[..., C, H, W]``)."""
        return Stokes(self.s0 * scale, self.s1 * scale, self.s2 * scale)

    def map(self, function: Callable[[Array], Array]) -> Stokes:
        """The same linear image operation (blur, crop, mean over channels) on every component."""
        return Stokes(function(self.s0), function(self.s1), function(self.s2))


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Samples behind K analysers at the same points: ``data`` and ``clipped`` are ``[..., K, C, H, W]``.

    ``angles`` are the K analyser angles in radians. ``clipped`` marks samples that are only known to be at least as
    bright as their value; it may be None when nothing clips. ``variance [..., 1, H, W]`` is the variance of colour
    differences that a demosaicker expects its own interpolation to have added, None for co-sited samples. ``uniform``:
    the same samples with one and the same blur in all colours and analysers, where ``data`` lacks that; else None.
    """

    data: Array
    angles: tuple[float, ...]
    clipped: Array | None = None
    variance: Array | None = None
    uniform: Measurements | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        require_floats("measurements", self.data, "floating point, white at 1")
        listed = isinstance(self.angles, Sequence | np.ndarray)
        if not listed or not all(isinstance(angle, Real) for angle in self.angles):
            raise WrongType(f"expected analyser angles in radians, found {self.angles!r:.60}")
        if self.data.ndim < 4 or self.data.shape[-4] != len(self.angles):
            raise ValueError(f"expected data [..., {len(self.angles)}, C, H, W], found shape {tuple(self.data.shape)}")
        if not all(abs(angle) <= MOST_ANGLE for angle in self.angles):  # nor NaN
            raise ValueError(f"expected analyser angles in radians, found {list(map(float, self.angles))}: degrees?")
        shape = getattr(self.clipped, "shape", type(self.clipped).__name__)
        if self.clipped is not None and shape != self.data.shape:
            raise ValueError(f"clipped must have the shape of data {tuple(self.data.shape)}, found {shape}")


def analyser_matrix(angles: Sequence[float]) -> Doubles:
    """Rows ``[1, cos 2t, sin 2t] / 2`` of K ideal analysers: the matrix P of Eqs. 11-12, ``[K, 3]``."""
    return np.array([[0.5, 0.5 * math.cos(2 * t), 0.5 * math.sin(2 * t)] for t in angles])


def _direction(angle: float | Array, like: Array) -> tuple[Array, Array]:
    """cos 2t and sin 2t of an angle [rad], in the dtype of ``like``."""
    xp = namespace(like)
    t = constant(float(angle), like) if isinstance(angle, Real) else xp.astype(angle, like.dtype, copy=False)
    return xp.cos(2 * t), xp.sin(2 * t)


def intensity_behind(stokes: Stokes, angle: float | Array) -> Array:
    """Intensity behind an ideal linear polarizer at ``angle`` [rad]: Malus' law for any linear state (Eq. 11)."""
    c, s = _direction(angle, stokes.s0)
    return 0.5 * (stokes.s0 + stokes.s1 * c + stokes.s2 * s)


def measure(stokes: Stokes, angles: Sequence[float]) -> Measurements:
    """Forward model of K analysers without a sensor: m = P s (Eq. 12). Twin of `fit_stokes`; nothing clips."""
    data = namespace(stokes.s0).stack([intensity_behind(stokes, t) for t in angles], axis=-4)
    return Measurements(data, tuple(float(t) for t in angles))


def _combine(weights: Doubles, data: Array) -> Array:
    """Sums ``[n, ..., C, H, W]`` over the analysers of ``[..., K, C, H, W]``, weighted by each row of ``[n, K]``."""
    matrix = constant(weights, data)
    if isinstance(data, np.ndarray):  # threads of BLAS go on waiting for work, for 30 ms, on other cores
        return np.einsum("nk,...kchw->n...chw", matrix, data, order="C")
    return namespace(data).tensordot(matrix, data, axes=([1], [-4]))


def fit_stokes(measurements: Measurements) -> Stokes:
    """Least-squares Stokes images from any three or more analysers, clipped values taken at face value.

    This is the paper's Eq. 15, s = P^+ m, for any set of angles. Clipping biases it; see `fit_stokes_unclipped`.
    Raises ValueError when the angles do not determine a Stokes vector.
    """
    s = _combine(stokes_inverse(measurements.angles), measurements.data)
    return Stokes(s[0], s[1], s[2])


def stokes_inverse(angles: Sequence[float]) -> Doubles:
    """The pseudo-inverse ``[3, K]`` of `analyser_matrix`, float64: Stokes vectors from the samples of K analysers.

    Raises ValueError when the angles do not determine a Stokes vector.
    """
    return _pseudo_inverse(tuple(angles)).copy()


@lru_cache(maxsize=32)
def _pseudo_inverse(angles: tuple[float, ...]) -> Doubles:
    matrix = analyser_matrix(angles)
    if _rank(matrix) < 3:
        degrees = [round(math.degrees(t), 3) for t in angles]
        raise ValueError(f"need three analysers of different angles (modulo 180 degrees), found {degrees}")
    found = np.linalg.pinv(matrix)
    return np.where(np.abs(found) < 1e-12, 0, found)  # rounding would polarize


def _rank(matrix: Doubles) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=1e-6 * np.linalg.norm(matrix, 2)))


def fit_stokes_unclipped(measurements: Measurements) -> tuple[Stokes, Array]:
    """Least squares from the unclipped analysers only, and where ``[..., C, H, W]`` they determine s0, s1 and s2.

    Any three unclipped analysers are exact: with 0/45/90/135 degrees, m0 = m45 + m135 - m90 and its three siblings
    (the identity m0 + m90 = m45 + m135). With two unclipped analysers that are crossed, s0 and the component along
    them are exact and the other one is set to 0; otherwise the clipped values enter as the lower bounds they are.
    Source: docs/conventions.md, clipping; three-angle case also in Dave et al. 2022b (PANDORA, ECCV).
    """
    stokes, xp = fit_stokes(measurements), namespace(measurements.data)
    if measurements.clipped is None or not bool(xp.any(measurements.clipped)):
        return stokes, xp.ones_like(stokes.s0, dtype=xp.bool)
    data = xp.moveaxis(measurements.data, -4, 0)
    clipped = xp.moveaxis(measurements.clipped, -4, 0)
    touched = xp.any(clipped, axis=0)
    codes: Array = sum(xp.astype(clipped[k][touched], xp.int64) << k for k in range(len(measurements.angles)))
    samples = data[:, touched]
    solution = xp.stack([s[touched] for s in (stokes.s0, stokes.s1, stokes.s2)])
    determined = xp.ones_like(touched)
    determined_touched = xp.zeros_like(codes, dtype=xp.bool)
    for code in set(codes.tolist()):
        matrix, exact = unclipped_inverse(measurements.angles, int(code))
        rows = codes == code
        determined_touched[rows] = exact
        if matrix is not None:
            solution[:, rows] = constant(matrix, samples) @ samples[:, rows]
    determined[touched] = determined_touched
    found = stokes.map(lambda image: xp.astype(image, image.dtype, copy=True))
    for image, values in zip((found.s0, found.s1, found.s2), solution, strict=True):
        image[touched] = values
    return found, determined


def unclipped_inverse(angles: tuple[float, ...], code: int) -> tuple[Doubles | None, bool]:
    """`stokes_inverse` without the analysers whose bits in ``code`` are set, and whether it determines s0, s1 and s2.

    ``[3, K]`` with zeros for those analysers. Two crossed ones leave the third component 0; fewer or others give None.
    """
    kept = [k for k in range(len(angles)) if not code >> k & 1]
    matrix = analyser_matrix(angles)
    rank = _rank(matrix[kept]) if kept else 0
    crossed = len(kept) == 2 and abs(math.cos(2 * (angles[kept[0]] - angles[kept[1]])) + 1) < 1e-6
    if rank < 3 and not crossed:
        return None, False
    inverse = np.zeros((3, len(angles)))
    inverse[:, kept] = np.linalg.pinv(matrix[kept], rcond=1e-6)
    return inverse, rank == 3


def contradictions(measurements: Measurements) -> Array:
    """Components of m outside the range of P, ``[..., K - 3, C, H, W]``: what K > 3 analysers cannot all see.

    Zero without noise, clipping or misregistration, and each of the same standard deviation as one sample's noise
    otherwise. Raises ValueError unless four or more analysers determine a Stokes vector.
    """
    matrix = analyser_matrix(measurements.angles)
    if len(measurements.angles) < 4 or _rank(matrix) < 3:
        degrees = [round(math.degrees(t), 3) for t in measurements.angles]
        raise ValueError(f"need four analysers of at least three angles, found {degrees}")
    null = np.linalg.svd(matrix)[0][:, 3:].T
    first = [row[np.abs(row) > 0.5 * np.abs(row).max()][0] for row in null]
    return namespace(measurements.data).moveaxis(_combine(null * np.sign(first)[:, None], measurements.data), 0, -4)


def analyser_residual(measurements: Measurements) -> Array:
    """`contradictions` of four analysers, ``[..., C, H, W]``: ``(m0 - m45 + m90 - m135) / 2`` with 0/45/90/135 degrees.

    Raises ValueError on other numbers of analysers, and unless they determine a Stokes vector.
    """
    if len(measurements.angles) != 4:
        raise ValueError(f"need four analysers of at least three angles, found {len(measurements.angles)} analysers")
    return contradictions(measurements)[..., 0, :, :, :]


def is_pair(measurements: Measurements) -> bool:
    """True for two crossed analysers, which see s0 and one component of the polarization."""
    turns = [2 * t for t in measurements.angles]
    return len(turns) == 2 and abs(math.cos(turns[0] - turns[1]) + 1) < 1e-6


def complete_pair(pair: Measurements) -> Measurements:
    """Two crossed analysers and, between them, the two that would see the same light if the pair saw all of it.

    Nothing is then polarized obliquely to the pair, so both analysers between see s0 / 2. Exact for unpolarized
    diffuse light and a lamp along the pair. Angles in [0, pi) from the pair's first. Raises ValueError on others.
    """
    if not is_pair(pair):
        degrees = [round(math.degrees(t), 3) for t in pair.angles]
        raise ValueError(f"need two crossed analysers, found {degrees}")
    xp = namespace(pair.data)
    half = xp.mean(pair.data, axis=-4)
    data = xp.stack([pair.data[..., 0, :, :, :], half, pair.data[..., 1, :, :, :], half], axis=-4)
    clipped = pair.clipped
    if clipped is not None:
        some = xp.any(clipped, axis=-4)
        clipped = xp.stack([clipped[..., 0, :, :, :], some, clipped[..., 1, :, :, :], some], axis=-4)
    return Measurements(data, tuple(pair.angles[0] + k * math.pi / 4 for k in range(4)), clipped)


def behind_angles(measurements: Measurements, angles: tuple[float, ...]) -> Measurements:
    """The same light behind analysers at other ``angles`` [rad], by `fit_stokes_unclipped`.

    A sample counts as clipped from white on, and where clipping leaves it unknown, and is white at least there
    (`bounded_below_white` says where that is not known). At the same angles samples stay as they are, but those that
    clipped below white.
    """
    turns = [t % math.pi for t in angles]
    same = len(turns) == len(measurements.angles) and np.allclose(
        [t % math.pi for t in measurements.angles], turns, 0, 1e-9
    )
    below, xp = _clipped_below_white(measurements), namespace(measurements.data)
    if same and below is None:
        return measurements if tuple(measurements.angles) == tuple(angles) else replace(measurements, angles=angles)
    stokes, determined = fit_stokes_unclipped(measurements)
    found = measure(stokes, angles)
    clipped = (found.data >= 1) | ~determined[..., None, :, :, :]
    data = xp.where(clipped, found.data.clip(1, None), found.data)
    if same:
        data = xp.where(below, data, measurements.data)
        clipped = xp.where(below, clipped, measurements.clipped)
    return replace(found, data=data, clipped=clipped)


def bounded_below_white(measurements: Measurements) -> bool:
    """True where clipping leaves light of many pixels unknown that may be less than white.

    So it is in photographs of several exposures. Where all samples of a pixel clip it is unknown anyway.
    """
    below, clipped = _clipped_below_white(measurements), measurements.clipped
    if below is None or clipped is None:
        return False
    xp = namespace(measurements.data)
    unknown = ~fit_stokes_unclipped(measurements)[1] & ~xp.all(clipped, axis=-4)
    bounded = xp.any(unknown & xp.any(below, axis=-4), axis=-3)
    return float(xp.mean(xp.astype(bounded, xp.float32))) > MOST_BOUNDED


def _clipped_below_white(measurements: Measurements) -> Array | None:
    """Samples that clipped at less than white, ``[..., N, C, H, W]``; None where there are none.

    Of analysers that clip there: samples beside clipped ones, which were interpolated, are marked whatever their value.
    """
    data, clipped, xp = measurements.data, measurements.clipped, namespace(measurements.data)
    if clipped is None or not bool(xp.any(clipped)):
        return None
    level = xp.max(xp.where(clipped, data, 0.0), axis=(-3, -2, -1), keepdims=True)
    below = clipped & (level < 1 - BELOW_WHITE)
    return below if bool(xp.any(below)) else None


def diattenuation(extinction: float) -> float:
    """D = (ER - 1) / (ER + 1) of an analyser of that extinction ratio ER; 1 of an ideal one, whose ER is infinite."""
    return 1.0 if math.isinf(extinction) else (extinction - 1) / (extinction + 1)


def correct_extinction(measurements: Measurements, extinction: float) -> Measurements:
    """Samples of ideal analysers, from those of ones that pass 1 / ``extinction`` of the light across them.

    m = (s0 + D p_t) / 2, so m - s0 / 2 is divided by the `diattenuation` D. The extinction may be that of a lamp's
    filter and an analyser together. Raises ValueError unless it is above 1.
    """
    if not extinction > 1:
        raise ValueError(f"expected an extinction ratio above 1, found {extinction:g}")
    if math.isinf(extinction):
        return measurements
    whole = complete_pair(measurements) if is_pair(measurements) else measurements
    half = fit_stokes_unclipped(whole)[0].s0[..., None, :, :, :] / 2
    return replace(measurements, data=half + (measurements.data - half) / diattenuation(extinction))


def polarized_intensity(stokes: Stokes) -> Array:
    """sqrt(s1^2 + s2^2), the intensity of the polarized part: tau_s of the analytic split (Eq. 18).

    Its gradient is taken as 0 where nothing is polarized.
    """
    xp = namespace(stokes.s1)
    polarized = (stokes.s1 != 0) | (stokes.s2 != 0)
    return xp.where(polarized, xp.hypot(xp.where(polarized, stokes.s1, 1.0), stokes.s2), 0.0)


def dolp(stokes: Stokes) -> Array:
    """Degree of linear polarization (Eq. 2), 0 where s0 <= 0; above 1 only for unphysical (noisy) data."""
    xp, lit = namespace(stokes.s0), stokes.s0 > 0
    return xp.where(lit, polarized_intensity(stokes) / xp.where(lit, stokes.s0, 1.0), 0.0)


def aolp(stokes: Stokes) -> Array:
    """Angle of linear polarization in [0, pi) [rad], image-right toward image-up; 0 where nothing is polarized.

    Eq. 2 with the two-argument arctangent, which the paper's tan^-1 leaves out.
    """
    return wrap_aolp(0.5 * namespace(stokes.s1).atan2(stokes.s2 + 0.0, stokes.s1 + 0.0))  # + 0.0 turns -0 into 0


def wrap_aolp(angles: Array) -> Array:
    """Angles [rad] as AoLP in [0, pi); those that rounding takes to pi become 0."""
    xp = namespace(angles)
    wrapped = xp.remainder(angles, math.pi)
    return xp.where(wrapped >= math.pi, 0.0, wrapped)


def aolp_of(s1: float, s2: float) -> float:
    """`aolp` of light whose s1 and s2, or sums of them, are two numbers."""
    return 0.5 * math.atan2(s2, s1) % math.pi % math.pi  # twice: rounding takes tiny negative angles to pi


def axis_deg(degrees: float, digits: int = 0) -> float:
    """An AoLP in [0, 180) [degrees] as it is shown with so many digits: rounding takes 179.6 to 0, not to 180."""
    return round(degrees, digits) % 180


def rotate_frame(stokes: Stokes, angle: float | Array) -> Stokes:
    """The same light in a frame turned counter-clockwise by ``angle`` [rad]: AoLP falls by ``angle``."""
    c, s = _direction(angle, stokes.s0)
    return Stokes(stokes.s0, c * stokes.s1 + s * stokes.s2, c * stokes.s2 - s * stokes.s1)


def flip_horizontal(stokes: Stokes) -> Stokes:
    """The scene mirrored left-right: columns reverse and s2 changes sign (45 and 135 degrees swap)."""
    found = stokes.map(lambda image: namespace(image).flip(image, axis=-1))
    return Stokes(found.s0, found.s1, -found.s2)


def flip_vertical(stokes: Stokes) -> Stokes:
    """The scene mirrored top-bottom: rows reverse and s2 changes sign."""
    found = stokes.map(lambda image: namespace(image).flip(image, axis=-2))
    return Stokes(found.s0, found.s1, -found.s2)


def rotate_quarter(stokes: Stokes) -> Stokes:
    """The scene turned by 90 degrees counter-clockwise: s1 and s2 change sign (0 and 90, 45 and 135 swap)."""
    found = stokes.map(lambda image: namespace(image).flip(image, axis=-1).mT)
    return Stokes(found.s0, -found.s1, -found.s2)


def transpose(stokes: Stokes) -> Stokes:
    """The scene mirrored about the array's main diagonal: rows and columns swap and s1 changes sign (0 and 90 swap).

    The diagonal runs along -45 degrees, so an angle t becomes -90 deg - t: cos 2t changes sign, sin 2t does not.
    """
    return Stokes(stokes.s0.mT, -stokes.s1.mT, stokes.s2.mT)
