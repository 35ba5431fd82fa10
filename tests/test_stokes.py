"""The algebra of linear polarization obeys its laws: Malus, least squares, clipping, frames and mirror images."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import ROUNDING, SIGMAS, assert_close, assert_finite, assert_same_angle
from torch import Tensor

from polsep.cli.summary import summary
from polsep.physics.stokes import (
    Measurements,
    Stokes,
    analyser_matrix,
    analyser_residual,
    aolp,
    axis_deg,
    dolp,
    fit_stokes,
    fit_stokes_unclipped,
    flip_horizontal,
    flip_vertical,
    intensity_behind,
    measure,
    polarized_intensity,
    rotate_frame,
    rotate_quarter,
    transpose,
)

SONY = tuple(math.radians(t) for t in (0, 45, 90, 135))
DTYPES = (torch.float32, torch.float64)


def random_stokes(generator: torch.Generator, shape: tuple[int, ...], dtype: torch.dtype = torch.float64) -> Stokes:
    """Partially polarized light with s0 in [0.5, 1.5] and DoLP up to 0.95."""
    s0, degree, angle = torch.rand(3, *shape, generator=generator, dtype=torch.float64)
    s0, degree, angle = 0.5 + s0, 0.95 * degree, math.pi * angle
    return linear_light(s0, angle, degree).map(lambda s: s.to(dtype))


def linear_light(intensity: Tensor, angle: Tensor, degree: float | Tensor = 1.0) -> Stokes:
    """Light of that intensity whose polarized part vibrates along ``angle``."""
    polarized = intensity * degree
    return Stokes(intensity, polarized * torch.cos(2 * angle), polarized * torch.sin(2 * angle))


def components(stokes: Stokes) -> tuple[Tensor, Tensor, Tensor]:
    return stokes.s0, stokes.s1, stokes.s2


def assert_stokes_close(actual: Stokes, expected: Stokes, scale: float = 1.0) -> None:
    for a, e in zip(components(actual), components(expected), strict=True):
        assert_close(a, e, scale)


@given(phi=st.floats(-10, 10), angle=st.floats(-10, 10), intensity=st.floats(0, 100))
def test_malus(phi: float, angle: float, intensity: float) -> None:
    """Fully polarized light passes a polarizer with the squared cosine of the angle between them."""
    light = linear_light(torch.full((1, 1, 1), intensity, dtype=torch.float64), torch.tensor(phi, dtype=torch.float64))
    expected = torch.full((1, 1, 1), intensity * math.cos(angle - phi) ** 2, dtype=torch.float64)
    assert_close(intensity_behind(light, angle), expected, scale=1 + intensity)


@pytest.mark.parametrize("dtype", DTYPES)
def test_crossed_polarizers_and_halves(dtype: torch.dtype) -> None:
    """A crossed polarizer blocks linear light, and any polarizer halves unpolarized light."""
    angles = torch.linspace(0, 3, 7, dtype=dtype).view(1, 1, 7)
    light = linear_light(torch.ones(1, 1, 7, dtype=dtype), angles)
    for k, angle in enumerate(angles.flatten().tolist()):
        assert_close(intensity_behind(light, angle + math.pi / 2)[..., k], torch.zeros(1, 1))
        assert_close(intensity_behind(light, angle)[..., k], torch.ones(1, 1))
    zero = torch.zeros(1, 1, 7, dtype=dtype)
    assert_close(intensity_behind(Stokes(zero + 3, zero, zero), 0.7), zero + 1.5)


def test_angles_may_vary_per_pixel(generator: torch.Generator) -> None:
    """A tensor of analyser angles acts pixel by pixel like each angle on its own."""
    stokes = random_stokes(generator, (3, 4, 5))
    angles = torch.rand(4, 5, generator=generator, dtype=torch.float64) * 4
    image = intensity_behind(stokes, angles)
    for row, col in itertools.product(range(4), range(5)):
        assert_close(image[:, row, col], intensity_behind(stokes, angles[row, col].item())[:, row, col])


@given(
    steps=st.lists(st.integers(0, 17), min_size=3, max_size=9, unique=True),
    offset=st.floats(-180, 180),
    turns=st.lists(st.integers(-2, 2), min_size=9, max_size=9),
    seed=st.integers(0, 1000),
)
def test_fit_inverts_measure(steps: list[int], offset: float, turns: list[int], seed: int) -> None:
    """Least squares gives back the light from any three or more different analysers, modulo half turns."""
    angles = [math.radians(offset + 10 * step + 180 * turn) for step, turn in zip(steps, turns, strict=False)]
    stokes = random_stokes(torch.Generator().manual_seed(seed), (2, 3, 2, 2))
    condition = float(np.linalg.cond(analyser_matrix(angles)))
    assert_stokes_close(fit_stokes(measure(stokes, angles)), stokes, scale=condition)


@pytest.mark.parametrize("dtype", DTYPES)
def test_fit_inverts_measure_of_the_sony_analysers(dtype: torch.dtype, generator: torch.Generator) -> None:
    """With 0/45/90/135 degrees the round trip is exact to rounding in either precision, in the input's dtype."""
    stokes = random_stokes(generator, (2, 3, 5, 4), dtype)
    fitted = fit_stokes(measure(stokes, SONY))
    assert fitted.s0.dtype == dtype
    assert_stokes_close(fitted, stokes)


def test_pseudo_inverse_of_the_sony_analysers(generator: torch.Generator) -> None:
    """With 0/45/90/135 degrees s0 is half the sum and s1, s2 are differences of crossed samples, noisy or not."""
    data = torch.rand(4, 3, 2, 2, generator=generator, dtype=torch.float64)
    fitted = fit_stokes(Measurements(data, SONY))
    assert_stokes_close(fitted, Stokes(data.sum(0) / 2, data[0] - data[2], data[1] - data[3]))


@pytest.mark.parametrize(
    "degrees", [(0,), (0, 90), (0, 45), (0, 90, 180, 270), (30, 210, 75), (10, 10, 10, 10), (0, 45, 180, 225)]
)
def test_undetermined_angles_are_refused(degrees: tuple[float, ...]) -> None:
    """Fewer than three analysers that differ modulo a half turn raise an error that names them."""
    angles = tuple(math.radians(t) for t in degrees)
    with pytest.raises(ValueError, match=r"need three analysers of different angles .* found \["):
        fit_stokes(Measurements(torch.ones(len(angles), 1, 1, 1), angles))


def clipped_subsets(stokes: Stokes, angles: tuple[float, ...]) -> tuple[Measurements, Tensor]:
    """Every subset of analysers clipped at the level of 60 % of the truth, one subset per column: [K, C, H, 2^K]."""
    count = 2 ** len(angles)
    measured = measure(stokes, angles)
    codes = torch.arange(count)
    clipped = torch.stack([(codes >> k & 1).bool() for k in range(len(angles))])
    mask = clipped[:, None, None, :].expand_as(measured.data).clone()
    return Measurements(torch.where(mask, 0.6 * measured.data, measured.data), measured.angles, mask), codes


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("turn_deg", [0.0, 17.0])
def test_every_subset_of_four_clipped(dtype: torch.dtype, turn_deg: float, generator: torch.Generator) -> None:
    """Of four analysers one may clip; two left crossed give s0 and their own component; fewer is flagged."""
    angles = tuple(t + math.radians(turn_deg) for t in SONY)
    stokes = random_stokes(generator, (3, 2, 16), dtype)
    measurements, codes = clipped_subsets(stokes, angles)
    fitted, determined = fit_stokes_unclipped(measurements)
    assert fitted.s0.dtype == dtype
    face_value = fit_stokes(measurements)
    local, truth = rotate_frame(fitted, angles[0]), rotate_frame(stokes, angles[0])
    for code in codes.tolist():
        here = (..., code)
        exact = code in (0, 1, 2, 4, 8)
        assert bool((determined[here] == exact).all())
        if exact:
            pairs = list(zip(components(fitted), components(stokes), strict=True))
        elif code in (0b0101, 0b1010):  # 0 and 90 clipped: s2 remains; 45 and 135 clipped: s1 remains
            kept, lost = (local.s2, local.s1) if code == 0b0101 else (local.s1, local.s2)
            true = truth.s2 if code == 0b0101 else truth.s1
            pairs = [(local.s0, stokes.s0), (kept, true), (lost, torch.zeros_like(lost))]
        else:
            pairs = list(zip(components(fitted), components(face_value), strict=True))
        for actual, expected in pairs:
            assert_close(actual[here], expected[here])


@pytest.mark.parametrize("dtype", DTYPES)
def test_any_three_of_six_analysers_are_exact(dtype: torch.dtype, generator: torch.Generator) -> None:
    """With six analysers every pixel with three or more unclipped ones is exact and flagged as determined."""
    angles = tuple(math.radians(30 * k + 4) for k in range(6))
    stokes = random_stokes(generator, (1, 2, 64), dtype)
    measurements, codes = clipped_subsets(stokes, angles)
    fitted, determined = fit_stokes_unclipped(measurements)
    enough = torch.tensor([6 - int(code).bit_count() >= 3 for code in codes])
    assert torch.equal(determined, enough.expand_as(determined))
    for actual, expected in zip(components(fitted), components(stokes), strict=True):
        assert_close(actual[..., enough], expected[..., enough], scale=10)


def test_unclipped_fit_without_clipping(generator: torch.Generator) -> None:
    """Where nothing clips, with or without a mask, the unclipped fit is the plain fit and all of it is determined."""
    measured = measure(random_stokes(generator, (2, 3, 4, 4)), SONY)
    nothing = torch.zeros_like(measured.data, dtype=torch.bool)
    for clipped in (None, nothing):
        fitted, determined = fit_stokes_unclipped(Measurements(measured.data, SONY, clipped))
        assert bool(determined.all())
        assert_stokes_close(fitted, fit_stokes(measured))


def test_clipping_touches_only_its_own_pixels(generator: torch.Generator) -> None:
    """A clipped sample changes neither other pixels, nor other colours, nor other frames of a batch."""
    noisy = torch.rand(2, 4, 3, 4, 4, generator=generator)
    clipped = torch.zeros_like(noisy, dtype=torch.bool)
    clipped[1, 2, 0, 3, 1] = True
    plain = fit_stokes(Measurements(noisy, SONY))
    fitted, _ = fit_stokes_unclipped(Measurements(noisy, SONY, clipped))
    changed = torch.zeros(2, 3, 4, 4, dtype=torch.bool)
    changed[1, 0, 3, 1] = True
    for a, p in zip(components(fitted), components(plain), strict=True):
        assert torch.equal(a[~changed], p[~changed])
    assert_close(fitted.s0[changed], (noisy[1, 1] + noisy[1, 3])[0, 3, 1].reshape(1))


@given(offset=st.floats(0, math.pi), steps=st.sets(st.integers(0, 11), min_size=4, max_size=4), seed=st.integers(0, 99))
def test_residual_of_a_stokes_vector_is_zero(offset: float, steps: set[int], seed: int) -> None:
    """Four samples of one state of light leave no residual, whatever the four analysers."""
    angles = [offset + math.radians(15 * step) for step in steps]
    measured = measure(random_stokes(torch.Generator().manual_seed(seed), (3, 2, 2)), angles)
    residual = analyser_residual(measured)
    assert_close(residual, torch.zeros_like(residual))


def test_residual_of_the_sony_analysers(generator: torch.Generator) -> None:
    """With 0/45/90/135 degrees the residual is half the difference of the two crossed sums."""
    data = torch.rand(4, 3, 2, 2, generator=generator, dtype=torch.float64)
    residual = analyser_residual(Measurements(data, SONY))
    assert_close(residual, (data[0] - data[1] + data[2] - data[3]) / 2)


@pytest.mark.parametrize("count", [3, 5])
def test_residual_needs_four_analysers(count: int) -> None:
    """The residual of another number of analysers is refused."""
    measurements = Measurements(torch.ones(count, 1, 1, 1), tuple(0.3 * k for k in range(count)))
    with pytest.raises(ValueError, match="four analysers of at least three angles"):
        analyser_residual(measurements)


def test_noise_gains(generator: torch.Generator) -> None:
    """Noise of variance v gives var s0 = v, var s1 = var s2 = 2 v, var residual = v, all uncorrelated."""
    sigma, count = 0.02, 200_000
    noise = sigma * torch.randn(4, 1, 1, count, generator=generator, dtype=torch.float64)
    measured = Measurements(0.4 + noise, SONY)
    stokes = fit_stokes(measured)
    rows = torch.stack([stokes.s0, stokes.s1, stokes.s2, analyser_residual(measured)]).reshape(4, count)
    normalized = torch.cov(rows) / sigma**2
    expected = torch.diag(torch.tensor([1.0, 2.0, 2.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(normalized, expected, rtol=0, atol=SIGMAS * 2 * math.sqrt(2 / count))


@pytest.mark.parametrize("dtype", DTYPES)
def test_dark_and_unphysical_pixels(dtype: torch.dtype) -> None:
    """DoLP is 0 where s0 is zero or negative, never NaN, and a DoLP above 1 is reported."""
    s0 = torch.tensor([[[0.0, 0.0, -1.0, 1.0, 2.0]]], dtype=dtype)
    s1 = torch.tensor([[[0.0, 0.3, 0.3, 3.0, 0.0]]], dtype=dtype)
    s2 = torch.tensor([[[0.0, 0.4, 0.4, 4.0, 0.0]]], dtype=dtype)
    stokes = Stokes(s0, s1, s2)
    assert_close(dolp(stokes), torch.tensor([[[0.0, 0.0, 0.0, 5.0, 0.0]]]))
    assert_close(polarized_intensity(stokes), torch.tensor([[[0.0, 0.5, 0.5, 5.0, 0.0]]]))
    assert_finite(aolp(stokes))
    assert aolp(stokes)[0, 0, 0] == 0 and aolp(stokes)[0, 0, 4] == 0


@pytest.mark.parametrize("dtype", DTYPES)
@given(s1=st.floats(-8, 8, width=32), s2=st.floats(-8, 8, width=32))
def test_aolp_range(dtype: torch.dtype, s1: float, s2: float) -> None:
    """AoLP lies in [0, pi), also where rounding would reach pi, and describes the same vibration as s1 and s2."""
    stokes = Stokes(*(torch.full((1, 1, 1), s, dtype=dtype) for s in (10.0, s1, s2)))
    angle = aolp(stokes)
    assert 0 <= angle.item() < math.pi
    strength = polarized_intensity(stokes)
    assert_close(strength * torch.cos(2 * angle), stokes.s1, scale=10)
    assert_close(strength * torch.sin(2 * angle), stokes.s2, scale=10)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("s2", [-1e-30, -1e-20, -1e-16, -1e-8, -0.0])
def test_aolp_just_below_zero(dtype: torch.dtype, s2: float) -> None:
    """An angle a hair below 0 is either just below pi or 0, but never pi itself."""
    ones = torch.ones(1, 1, 1, dtype=dtype)
    angle = aolp(Stokes(ones, ones, s2 * ones)).item()
    assert 0 <= angle < float(torch.tensor(math.pi, dtype=dtype))
    assert_same_angle(angle, 0.5 * s2, ROUNDING[dtype])


@pytest.mark.parametrize("operation", [rotate_quarter, transpose])
def test_aolp_of_unpolarized_light_after_a_turn(operation: Callable[[Stokes], Stokes]) -> None:
    """Unpolarized light has AoLP 0 also after a turn or a mirror has changed the sign of its zeros."""
    zeros = torch.zeros(1, 2, 2)
    assert bool((aolp(operation(Stokes(zeros + 1, zeros, zeros))) == 0).all())


@pytest.mark.parametrize(
    ("row", "col", "degrees"), [(0, 1, 0), (-1, 1, 45), (-1, 0, 90), (-1, -1, 135), (0, -1, 0), (1, -1, 45)]
)
def test_angles_count_from_image_right_toward_image_up(row: int, col: int, degrees: float) -> None:
    """Light that vibrates along a step (row, col) of the array is brightest behind the analyser of that angle."""
    phi = torch.tensor(math.atan2(-row, col), dtype=torch.float64)
    light = linear_light(torch.ones(1, 1, 1, dtype=torch.float64), phi)
    assert_same_angle(aolp(light), math.radians(degrees), ROUNDING[torch.float64])
    behind = [intensity_behind(light, math.radians(t)).item() for t in (0, 45, 90, 135)]
    assert (0, 45, 90, 135)[behind.index(max(behind))] == degrees


@given(angle=st.floats(-7, 7), analyser=st.floats(-7, 7), seed=st.integers(0, 99))
def test_rotate_frame(angle: float, analyser: float, seed: int) -> None:
    """Turning the frame shifts AoLP back, leaves intensities alone, and undoes itself; an analyser turns along."""
    stokes = random_stokes(torch.Generator().manual_seed(seed), (3, 2, 2))
    turned = rotate_frame(stokes, angle)
    assert torch.equal(turned.s0, stokes.s0)
    assert_close(polarized_intensity(turned), polarized_intensity(stokes))
    assert_stokes_close(rotate_frame(turned, -angle), stokes)
    assert_close(intensity_behind(turned, analyser), intensity_behind(stokes, analyser + angle), scale=10)
    difference = 2 * (aolp(stokes) - aolp(turned) - angle)
    weight = polarized_intensity(stokes)
    assert_close(weight * torch.cos(difference), weight, scale=10)


#: Each image operation, the same on a bare array, and the analyser angle of the new frame that shows the old angle t.
OPERATIONS: dict[str, tuple[Callable[[Stokes], Stokes], Callable[[Tensor], Tensor], Callable[[float], float]]] = {
    "flip_horizontal": (flip_horizontal, lambda a: a.flip(-1), lambda t: -t),
    "flip_vertical": (flip_vertical, lambda a: a.flip(-2), lambda t: -t),
    "rotate_quarter": (rotate_quarter, lambda a: torch.rot90(a, 1, (-2, -1)), lambda t: t + math.pi / 2),
    "transpose": (transpose, lambda a: a.transpose(-1, -2), lambda t: math.pi / 2 - t),
}
each_operation = pytest.mark.parametrize(("operation", "on_array", "relabel"), OPERATIONS.values(), ids=OPERATIONS)


def where_is(labels: Tensor, label: int) -> tuple[int, int]:
    row, col = (labels == label).nonzero()[0].tolist()
    return row, col


@each_operation
def test_operations_carry_directions_along(
    operation: Callable[[Stokes], Stokes], on_array: Callable[[Tensor], Tensor], relabel: Callable[[float], float]
) -> None:
    """Light that vibrates along the line between two pixels still does after the image operation moved both."""
    height, width, start = 5, 7, 2 * 7 + 3
    labels = torch.arange(height * width).view(height, width)
    moved = on_array(labels)
    for target in range(height * width):
        if target == start:
            continue
        (r0, c0), (r1, c1) = where_is(labels, start), where_is(labels, target)
        phi = torch.full((1, height, width), math.atan2(-(r1 - r0), c1 - c0), dtype=torch.float64)
        after = operation(linear_light(torch.ones_like(phi), phi))
        (r0, c0), (r1, c1) = where_is(moved, start), where_is(moved, target)
        assert_same_angle(aolp(after)[0, r0, c0], math.atan2(-(r1 - r0), c1 - c0), ROUNDING[torch.float64])


@each_operation
def test_operations_commute_with_measuring(
    operation: Callable[[Stokes], Stokes],
    on_array: Callable[[Tensor], Tensor],
    relabel: Callable[[float], float],
    generator: torch.Generator,
) -> None:
    """Measuring the moved scene is moving the measured images and relabelling their analysers."""
    stokes = random_stokes(generator, (2, 3, 4, 6))
    angles = [0.0, 0.3, 1.1, 2.5]
    before = on_array(measure(stokes, angles).data)
    assert_close(measure(operation(stokes), [relabel(t) for t in angles]).data, before)


def test_operations_form_the_group_of_the_square(generator: torch.Generator) -> None:
    """Mirrors undo themselves, four quarter turns do nothing, two are both mirrors, a quarter is transpose and flip."""
    stokes = random_stokes(generator, (3, 4, 6))
    for mirror in (flip_horizontal, flip_vertical, transpose):
        assert_stokes_close(mirror(mirror(stokes)), stokes)
    half = rotate_quarter(rotate_quarter(stokes))
    assert_stokes_close(half, flip_horizontal(flip_vertical(stokes)))
    assert_stokes_close(rotate_quarter(rotate_quarter(half)), stokes)
    assert_stokes_close(rotate_quarter(stokes), flip_vertical(transpose(stokes)))


def test_a_quarter_turn_is_a_turned_frame(generator: torch.Generator) -> None:
    """Apart from moving pixels, turning the scene by a quarter is turning the frame by a quarter the other way."""
    stokes = random_stokes(generator, (3, 4, 4))
    assert_stokes_close(rotate_quarter(stokes), rotate_frame(stokes, -math.pi / 2).map(lambda s: s.rot90(1, (-2, -1))))


@pytest.mark.parametrize("function", [aolp, dolp, polarized_intensity])
def test_gradients_are_finite_and_right(function: Callable[[Stokes], Tensor], generator: torch.Generator) -> None:
    """Away from unpolarized light the derivatives agree with finite differences."""
    angle = torch.linspace(0.1, 3.0, 12, dtype=torch.float64).view(1, 3, 4)
    degree = 0.1 + 0.8 * torch.rand(1, 3, 4, generator=generator, dtype=torch.float64)
    inputs = [s.clone().requires_grad_() for s in components(linear_light(torch.ones_like(degree), angle, degree))]
    torch.autograd.gradcheck(lambda s0, s1, s2: function(Stokes(s0, s1, s2)), inputs)


def test_superposition_of_two_polarized_lights() -> None:
    """Eq. 10 with its factor 4: |z|^2 = (a + b)^2 - 4 a b sin^2 of the angle between them, .48458 for the example."""
    a, b, phi_d, phi_s = 0.3, 0.7, 0.4, 1.3
    one = torch.ones(1, 1, 1, dtype=torch.float64)
    mixed = linear_light(a * one, phi_d * one) + linear_light(b * one, phi_s * one)
    squared = polarized_intensity(mixed).item() ** 2
    assert squared == pytest.approx((a + b) ** 2 - 4 * a * b * math.sin(phi_d - phi_s) ** 2, abs=1e-12)
    assert squared == pytest.approx(0.48458, abs=5e-6)
    assert mixed.s0.item() == pytest.approx(a + b, abs=1e-12)


def test_exposure_scales_everything(generator: torch.Generator) -> None:
    """Measurement, fit and polarized intensity are linear in exposure; DoLP and AoLP do not depend on it."""
    stokes = random_stokes(generator, (3, 2, 2))
    bright = stokes * 3.5
    assert_close(measure(bright, SONY).data, 3.5 * measure(stokes, SONY).data)
    assert_close(polarized_intensity(bright), 3.5 * polarized_intensity(stokes))
    assert_close(dolp(bright), dolp(stokes))
    assert_close(aolp(bright), aolp(stokes))


def test_shown_angles_stay_below_180() -> None:
    """Also rounded: a polarizer at 179.6 degrees was printed as at 180, which is no AoLP in [0, 180)."""
    assert [axis_deg(angle) for angle in (0.0, 89.5, 179.4, 179.6)] == [0, 90, 179, 0]
    assert [axis_deg(angle, 1) for angle in (179.94, 179.96)] == [179.9, 0]
    report = {"method": "joint", "light_color": [1.0], "warnings": []}
    statistics = {"clipped_fraction": 0.0, "light_polarizer_deg": 179.6}
    assert "polarizer at 0 deg" in summary({**report, "statistics": statistics})


def test_inconsistent_images_are_refused() -> None:
    """Stokes images and measurements of mixed shapes or of integers are refused with what was found."""
    image = torch.ones(3, 2, 2)
    with pytest.raises(ValueError, match="one shape"):
        Stokes(image, image, image[..., :1])
    with pytest.raises(TypeError, match=r"floating point, found torch\.int64"):
        Stokes(image.long(), image.long(), image.long())
    with pytest.raises(ValueError, match=r"expected data \[..., 4, C, H, W\]"):
        Measurements(torch.ones(3, 1, 2, 2), SONY)
    with pytest.raises(ValueError, match="clipped must have the shape of data"):
        Measurements(torch.ones(4, 1, 2, 2), SONY, torch.ones(4, 3, 2, 2, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"expected analyser angles in radians, found \[nan"):
        Measurements(torch.ones(4, 1, 2, 2), (math.nan, 0.0, 1.0, 2.0))
    with pytest.raises(TypeError, match=r"floating point, white at 1, found torch\.uint8"):
        Measurements(torch.ones(4, 1, 2, 2, dtype=torch.uint8), SONY)
