"""Laws of the separation methods: the paper's equations, exact recovery, equivariance, and what noise may do."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_finite, assert_within
from torch import Tensor
from torch.nn.functional import interpolate

from polsep.compute.filters import box_mean
from polsep.physics.stokes import (
    Measurements,
    Stokes,
    aolp_of,
    dolp,
    fit_stokes,
    flip_horizontal,
    flip_vertical,
    intensity_behind,
    measure,
    transpose,
)
from polsep.render.distances import ball, plain
from polsep.render.sphere_tracing import Part, PinholeCamera, PointLight, render
from polsep.separation.analytic import Separation, light_polarizer_angle, separate_analytic, separate_analytic_unclipped
from polsep.separation.closed_form import MAX_DIFFUSE_DOLP, white_specular
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.images import Tally
from polsep.separation.multi_capture import separate_debevec2000, separate_ding2021, separate_extremes
from polsep.separation.report import dominant_angle, in_light, tally, under_white_light

SONY = tuple(math.radians(t) for t in (0, 45, 90, 135))
Split = Callable[[Measurements], Separation]
METHODS: list[Split] = [separate_analytic, separate_analytic_unclipped, separate_color_affine]
SIZE = 48


@dataclass(frozen=True)
class Truth:
    """Known diffuse and specular ``[3, h, w]``, and the Stokes image that they make."""

    diffuse: Tensor
    specular: Tensor
    stokes: Stokes


def smooth(generator: torch.Generator, channels: int, knots: int = 6) -> Tensor:
    """Smooth random images in [0, 1]."""
    coarse = torch.rand(1, channels, knots, knots, generator=generator, dtype=torch.float64)
    return interpolate(coarse, size=(SIZE, SIZE), mode="bicubic", align_corners=True)[0].clamp(0, 1)


def random_truth(seed: int, grey: bool = False, exposure: float = 1.0, gain: tuple[float, ...] | None = None) -> Truth:
    """Polarized diffuse light of random colours (|slope| < 0.3, smooth) and white specular light of smooth phase.

    Colours differ from pixel to pixel; with ``gain`` (of each colour) they are smooth instead.
    """
    generator = torch.Generator().manual_seed(seed)
    color = torch.rand(3, SIZE, SIZE, generator=generator, dtype=torch.float64)
    if gain is not None:
        color = smooth(generator, 3) * torch.tensor(gain, dtype=torch.float64).view(3, 1, 1)
    diffuse = exposure * (0.1 + 0.6 * (color[:1].expand(3, -1, -1) if grey else color))
    size, turn = 0.29 * smooth(generator, 1), 2 * math.pi * smooth(generator, 1)
    specular = (exposure * 0.6 * smooth(generator, 1) ** 2).expand(3, -1, -1)
    phase = 2 * math.pi * smooth(generator, 1, knots=4)
    s1 = size * torch.cos(turn) * diffuse + torch.cos(phase) * specular
    s2 = size * torch.sin(turn) * diffuse + torch.sin(phase) * specular
    return Truth(diffuse, specular, Stokes(diffuse + specular, s1, s2))


def measured(truth: Truth) -> Measurements:
    return measure(truth.stokes, SONY)


def noisy(truth: Truth, sigma: float, seed: int = 9) -> Measurements:
    seen = measured(truth)
    noise = torch.randn(seen.data.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Measurements(seen.data + sigma * noise, SONY)


def with_clipped(seen: Measurements, clipped: Tensor) -> Measurements:
    """Marked samples read 80 % of what they should: anyone who believes them makes an error."""
    return Measurements(torch.where(clipped, 0.8 * seen.data, seen.data), seen.angles, clipped)


def saturated(seen: Measurements) -> Measurements:
    """What a sensor that stops at 1 makes of the samples."""
    return Measurements(seen.data.clamp(max=1), seen.angles, seen.data >= 1)


def psnr(found: Tensor, truth: Tensor) -> float:
    """Linear light, peak 1 [dB]."""
    return -10 * math.log10(float(((found - truth) ** 2).mean()) + 1e-30)


def largest(x: Tensor) -> float:
    return float(x.abs().max())


@pytest.mark.parametrize("channels", [1, 3])
def test_analytic_is_the_printed_equations(channels: int) -> None:
    """Eqs. 16-18 in plain NumPy: s from the four measurements, tau_s = |s12|, tau_d = s0 - tau_s."""
    data = torch.rand(4, channels, 20, 24, generator=torch.Generator().manual_seed(1))
    m0, m45, m90, m135 = data.double().numpy()
    s0, s1, s2 = (m0 + m45 + m90 + m135) / 2, m0 - m90, m45 - m135
    specular = np.minimum(np.sqrt(s1**2 + s2**2), s0)
    found = separate_analytic(Measurements(data, SONY))
    assert_within(found.specular, specular, 1e-6)
    assert_within(found.diffuse, s0 - specular, 1e-6)


def test_polanalyser_agrees() -> None:
    """An independent library: twice its diffuse is ours (it counts one measurement), its specular is ours."""
    pa = pytest.importorskip("polanalyser")
    stokes = random_truth(2).stokes
    image = torch.stack([stokes.s0, stokes.s1, stokes.s2], dim=-1).movedim(0, 2).numpy()
    found = separate_analytic(measure(stokes, SONY))
    assert_within(found.diffuse.movedim(0, -1), 2 * pa.cvtStokesToDiffuse(image), 1e-6)
    assert_within(found.specular.movedim(0, -1), pa.cvtStokesToSpecular(image), 1e-6)


@pytest.mark.parametrize("split", METHODS)
def test_parts_sum_to_s0_and_are_not_negative(split: Split) -> None:
    """On noise alone (DoLP above 1, samples below black), diffuse + specular is s0 or 0, and neither is negative."""
    data = 0.3 * torch.randn(4, 3, 24, 24, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.2
    seen = Measurements(data, SONY)
    found = split(seen)
    assert float(dolp(fit_stokes(seen)).max()) > 1 and float(fit_stokes(seen).s0.min()) < 0
    assert_close(found.diffuse + found.specular, found.stokes.s0.clamp(min=0))
    assert_close(found.stokes.s0, fit_stokes(seen).s0)
    assert float(found.diffuse.min()) >= 0 and float(found.specular.min()) >= 0
    assert bool(found.valid.all())


@pytest.mark.parametrize("split", METHODS)
def test_black_is_black(split: Split) -> None:
    """No light gives zero diffuse and zero specular, valid and finite."""
    found = split(Measurements(torch.zeros(4, 3, 8, 8), SONY, torch.zeros(4, 3, 8, 8, dtype=torch.bool)))
    assert largest(found.diffuse) == 0 and largest(found.specular) == 0
    assert bool(found.valid.all())


@pytest.mark.parametrize("split", METHODS)
def test_unpolarized_diffuse_is_separated_exactly(split: Split) -> None:
    """Where the diffuse light is unpolarized, every method is exact, whatever the angle of the specular light."""
    truth = random_truth(4)
    phase = 2 * math.pi * smooth(torch.Generator().manual_seed(5), 1)
    stokes = Stokes(truth.stokes.s0, torch.cos(phase) * truth.specular, torch.sin(phase) * truth.specular)
    found = split(measure(stokes, SONY))
    assert_within(found.diffuse, truth.diffuse, 1e-9)
    assert_within(found.specular, truth.specular, 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_color_affine_is_exact_on_polarized_diffuse(seed: int) -> None:
    """Random colours, polarized diffuse, white specular, no noise: exact, where the analytic split errs by 25 dB."""
    truth = random_truth(seed)
    found = separate_color_affine(measured(truth))
    assert largest(found.diffuse - truth.diffuse) < 1e-9
    assert largest(found.specular - truth.specular) < 1e-9
    assert found.residual is not None and largest(found.residual) < 1e-9
    assert psnr(separate_analytic(measured(truth)).diffuse, truth.diffuse) < 30
    single = Measurements(measured(truth).data.float(), SONY)
    assert psnr(separate_color_affine(single).diffuse, truth.diffuse) > 100


def test_color_affine_returns_the_slope_of_the_diffuse() -> None:
    """The slope is the diffuse polarization itself: p = slope * diffuse + a phase of length tau_s."""
    truth = random_truth(6)
    found = separate_color_affine(measured(truth))
    assert found.diffuse_polarization is not None
    p1 = truth.stokes.s1 - found.diffuse_polarization[:1] * truth.diffuse
    p2 = truth.stokes.s2 - found.diffuse_polarization[1:] * truth.diffuse
    assert_within(torch.hypot(p1, p2), truth.specular, 1e-9)
    assert (
        float(torch.hypot(found.diffuse_polarization[0], found.diffuse_polarization[1]).max())
        <= MAX_DIFFUSE_DOLP + 1e-9
    )


def test_white_specular_is_the_positive_root() -> None:
    """b = tau (e - a) with |e| = 1 gives tau back for every |a| < 0.9 and every direction of e."""
    generator = torch.Generator().manual_seed(7)
    tau = torch.rand(1, 30, 30, generator=generator, dtype=torch.float64)
    turn, phase = 2 * math.pi * torch.rand(2, 1, 30, 30, generator=generator, dtype=torch.float64)
    size = 0.9 * torch.rand(1, 30, 30, generator=generator, dtype=torch.float64)
    a = size * torch.cat([torch.cos(turn), torch.sin(turn)])
    e = torch.cat([torch.cos(phase), torch.sin(phase)])
    assert_within(white_specular((tau * (e - a)).chunk(2), a.chunk(2)), tau, 1e-10)


def test_color_affine_is_analytic_on_grey_and_mono() -> None:
    """Without colour contrast there is no slope to see: the closed form is the paper's split."""
    grey = measured(random_truth(8, grey=True))
    found, paper = separate_color_affine(grey), separate_analytic(grey)
    assert_within(found.diffuse, paper.diffuse, 1e-4)
    assert_within(found.specular, paper.specular, 1e-4)
    mono = Measurements(grey.data[:, :1], SONY)
    assert_close(separate_color_affine(mono).specular, separate_analytic(mono).specular)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sigma", [0.003, 0.01])
def test_noise_never_costs_against_the_analytic_split(seed: int, sigma: float) -> None:
    """Grey and noisy: never more than 0.1 dB below the analytic split. Coloured and noisy: more than 3 dB above."""
    for grey, gain in ((True, -0.1), (False, 3.0)):
        truth = random_truth(seed, grey=grey)
        seen = noisy(truth, sigma)
        found, paper = separate_color_affine(seen), separate_analytic(seen)
        assert psnr(found.diffuse, truth.diffuse) > psnr(paper.diffuse, truth.diffuse) + gain
        assert psnr(found.specular, truth.specular) > psnr(paper.specular, truth.specular) + gain


def test_noise_is_measured_from_the_contradiction() -> None:
    """The reported noise is the standard deviation of a sample, within 10 %, and zero without noise."""
    for sigma in (0.002, 0.02):
        found = separate_color_affine(noisy(random_truth(1), sigma))
        assert found.noise is not None
        assert float(found.noise.mean()) == pytest.approx(sigma, rel=0.1)
    clean = separate_color_affine(measured(random_truth(1))).noise
    assert clean is not None and largest(clean) < 1e-9


def one_angle_per_color(seed: int) -> Tensor:
    """A mask ``[4, 3, h, w]``: inside a few blobs, a random one of the four samples of each colour."""
    generator = torch.Generator().manual_seed(seed)
    where = smooth(generator, 1)[0] > 0.6
    pick = torch.randint(4, (3, SIZE, SIZE), generator=generator)
    return torch.stack([(pick == k) & where for k in range(4)])


@pytest.mark.parametrize("split", [separate_analytic_unclipped, separate_color_affine])
def test_one_clipped_angle_per_color_is_recovered(split: Split) -> None:
    """Three analysers determine a Stokes vector: with one clipped per colour nothing is lost and all is valid."""
    truth = random_truth(10)
    seen = measured(truth)
    clipped = one_angle_per_color(11)
    assert clipped.any()
    found, whole = split(with_clipped(seen, clipped)), split(seen)
    assert_within(found.specular, whole.specular, 1e-5)
    assert_within(found.diffuse, whole.diffuse, 1e-5)
    assert bool(found.valid.all())


def test_analytic_takes_clipped_samples_at_face_value() -> None:
    """The paper's split ignores the clip mask but for ``valid``, which is False exactly where a sample clips."""
    seen = with_clipped(measured(random_truth(10)), one_angle_per_color(11))
    assert seen.clipped is not None
    found = separate_analytic(seen)
    assert_close(found.specular, separate_analytic(Measurements(seen.data, SONY)).specular)
    assert torch.equal(found.valid, ~seen.clipped.any(dim=0).any(dim=0))


def test_three_analysers_of_one_color_are_enough_for_the_specular() -> None:
    """White specular light is known from any unclipped colour: with up to 9 of 12 samples gone, it stays exact."""
    truth = random_truth(12)
    generator = torch.Generator().manual_seed(13)
    where = smooth(generator, 1)[0] > 0.65
    pick = torch.randint(3, (SIZE, SIZE), generator=generator)
    clipped = torch.zeros(4, 3, SIZE, SIZE, dtype=torch.bool)
    for color in range(3):  # one angle stays in every colour, and all four in the picked one
        clipped[1:, color] = where & (pick != color)
    slope = separate_color_affine(measured(truth)).diffuse_polarization
    found = separate_color_affine(with_clipped(measured(truth), clipped))
    assert slope is not None and found.diffuse_polarization is not None
    outside = ~where
    assert largest((found.specular - truth.specular)[:, outside]) < 1e-9
    # Inside, the slope comes from the windows around: the specular is exact up to what that misses of it.
    missed = torch.hypot(*(found.diffuse_polarization - slope))
    bound = 3 * missed * truth.stokes.s0.amax(dim=0) + 1e-9
    assert bool(((found.specular - truth.specular).abs().amax(dim=0) <= bound).all())
    assert bool(found.valid.all())


def test_one_blind_color_leaves_the_specular_exact() -> None:
    """Red clips behind all four analysers, green and blue nowhere: the specular is known, the diffuse flagged."""
    truth = random_truth(14, gain=(5.0, 0.7, 0.4))
    seen = saturated(measured(truth))
    assert seen.clipped is not None
    blind = seen.clipped[:, 0].all(dim=0) & ~seen.clipped[:, 1:].any(dim=0).any(dim=0)
    assert int(blind.sum()) > 50
    found = separate_color_affine(seen)
    assert not bool(found.valid[blind].any())
    assert_within(found.diffuse[1:, blind], truth.diffuse[1:, blind], 0.03)
    assert_within(found.specular[:, blind], truth.specular[:, blind], 0.03)


@pytest.mark.parametrize("split", METHODS)
def test_everything_clipped_is_finite_and_flagged(split: Split) -> None:
    """A frame at the white level: finite, nowhere valid; diffuse + specular is at least what clipping proves, 2."""
    found = split(Measurements(torch.ones(4, 3, 16, 16), SONY, torch.ones(4, 3, 16, 16, dtype=torch.bool)))
    assert_finite(found.diffuse, found.specular, found.stokes.s0, found.stokes.s1, found.stokes.s2)
    assert not bool(found.valid.any())
    assert float((found.diffuse + found.specular).min()) >= 2 - 1e-5


def highlight(peak: float) -> Truth:
    """A round highlight of one phase over smooth unpolarized colours; its core clips all twelve samples."""
    axis = torch.linspace(-1, 1, SIZE, dtype=torch.float64)
    specular = (peak * torch.exp(-6 * (axis[:, None] ** 2 + axis**2))).expand(3, -1, -1)
    diffuse = 0.1 + 0.3 * smooth(torch.Generator().manual_seed(15), 3)
    return Truth(diffuse, specular, Stokes(diffuse + specular, 0.6 * specular, 0.8 * specular))


def test_clipped_highlight_is_not_a_hole() -> None:
    """Where a highlight clips everything, the specular is at least what clipping proves, and near the truth around."""
    truth = highlight(12.0)
    seen = saturated(measured(truth))
    assert seen.clipped is not None
    core = seen.clipped.all(dim=0).all(dim=0)
    assert int(core.sum()) > 20
    found, paper = separate_color_affine(seen), separate_analytic(seen)
    assert_finite(found.diffuse, found.specular)
    assert not bool(found.valid[core].any())
    assert bool(found.valid[~seen.clipped.any(dim=0).any(dim=0)].all())
    assert largest(paper.specular[:, core]) < 1e-9  # the paper's hole
    proven = (2 - 0.4) / (1 + 0.8)  # diffuse below 0.4, the brightest analyser passes (1 + 0.8) / 2
    assert float(found.specular[:, core].min()) >= proven
    assert float(found.specular[:, core].min()) >= 0.7 * float(truth.specular[:, core].min())
    rim = seen.clipped.any(dim=0).any(dim=0) & found.valid
    assert_within(found.specular[:, rim], truth.specular[:, rim], 0.05)


@pytest.mark.parametrize("gloss", [0.0, 0.02])
@pytest.mark.parametrize("color", [(2.4, 2.4, 2.4), (2.5, 2.4, 0.4)])
def test_clipped_matte_surface_is_no_highlight(gloss: float, color: tuple[float, ...]) -> None:
    """Bright diffuse light that clips, with little specular around it, is not explained by a highlight."""
    axis = torch.linspace(-1, 1, SIZE, dtype=torch.float64)
    shading = 1 - 0.4 * (axis[:, None] ** 2 + axis**2)
    diffuse = torch.tensor(color, dtype=torch.float64).view(3, 1, 1) * shading
    specular = torch.full_like(diffuse, gloss)
    truth = Truth(diffuse, specular, Stokes(diffuse + specular, 0.03 * diffuse + gloss, 0.02 * diffuse))
    seen = saturated(measured(truth))
    assert seen.clipped is not None
    gone = seen.clipped.all(dim=0).any(dim=0)
    assert int(gone.sum()) > 20
    found = separate_color_affine(seen)
    assert not bool(found.valid[gone].any())
    taken_for_specular = math.hypot(0.03, 0.02) * max(color)  # on grey its polarization passes for specular light
    assert float(found.specular[:, gone].max()) < gloss + 1.5 * taken_for_specular
    assert float((found.diffuse - diffuse)[:, gone].abs().max()) < 0.25 * max(color)


@pytest.mark.parametrize("split", METHODS)
@pytest.mark.parametrize("scale", [0.25, 4.0])
def test_exposure_scales_the_parts(split: Split, scale: float) -> None:
    """Without noise or clipping, both parts scale with the exposure."""
    truth = random_truth(16)
    one = split(measured(truth))
    other = split(Measurements(scale * measured(truth).data, SONY))
    assert_within(other.diffuse, scale * one.diffuse, 1e-8)
    assert_within(other.specular, scale * one.specular, 1e-8)


@pytest.mark.parametrize("split", METHODS)
@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_colors_are_interchangeable(split: Split, order: tuple[int, ...]) -> None:
    """Permuted colours in, permuted colours out, with noise and clipping."""
    seen = with_clipped(noisy(random_truth(17), 0.01), one_angle_per_color(18))
    assert seen.clipped is not None
    permuted = Measurements(seen.data[:, list(order)], SONY, seen.clipped[:, list(order)])
    one, other = split(seen), split(permuted)
    assert_within(other.diffuse, one.diffuse[list(order)], 1e-8)
    assert_within(other.specular, one.specular[list(order)], 1e-8)
    assert torch.equal(other.valid, one.valid)


TURNS = [(flip_horizontal, lambda x: x.flip(-1)), (flip_vertical, lambda x: x.flip(-2)), (transpose, lambda x: x.mT)]


@pytest.mark.parametrize("split", METHODS)
@pytest.mark.parametrize(("turn_stokes", "turn"), TURNS, ids=["left-right", "top-bottom", "transposed"])
def test_mirrored_scenes_give_mirrored_parts(
    split: Split, turn_stokes: Callable[[Stokes], Stokes], turn: Callable[[Tensor], Tensor]
) -> None:
    """Flips and transposition commute with the separation: intensities turn along, with no sign."""
    stokes = fit_stokes(noisy(random_truth(19), 0.01))
    one, other = split(measure(stokes, SONY)), split(measure(turn_stokes(stokes), SONY))
    assert_within(other.diffuse, turn(one.diffuse), 1e-8)
    assert_within(other.specular, turn(one.specular), 1e-8)


@pytest.mark.parametrize("split", METHODS)
def test_frames_of_a_batch_are_independent(split: Split) -> None:
    """[2, ...] gives what each frame gives alone, clipped samples included."""
    frames = [saturated(noisy(random_truth(seed, exposure=1.6), 0.01)) for seed in (20, 21)]
    clipped = [f.clipped for f in frames if f.clipped is not None]
    assert len(clipped) == 2 and all(c.any() for c in clipped)
    together = split(Measurements(torch.stack([f.data for f in frames]), SONY, torch.stack(clipped)))
    for k, frame in enumerate(frames):
        alone = split(frame)
        assert_close(together.diffuse[k], alone.diffuse)
        assert_close(together.specular[k], alone.specular)
        assert torch.equal(together.valid[k], alone.valid)


@pytest.mark.parametrize("split", METHODS)
@pytest.mark.parametrize("light", [(1.0, 0.8, 0.5), (2.0, 1.0, 3.0)])
def test_colored_light_is_divided_out(split: Split, light: tuple[float, ...]) -> None:
    """A scene lit by colour L, separated in L, is the separation under white light times L."""
    white = measured(random_truth(22))
    color = torch.tensor(light, dtype=torch.float64).view(3, 1, 1)
    lit = under_white_light(Measurements(white.data * color, SONY), light)
    assert isinstance(lit, Measurements)
    one, other = split(white), in_light(split(lit), light)
    assert_within(other.diffuse, one.diffuse * color, 1e-6)
    assert_within(other.specular, one.specular * color, 1e-6)
    assert_close(other.diffuse + other.specular, split(lit).stokes.s0 * color)


@pytest.mark.parametrize("split", METHODS)
def test_every_angle_set_of_sony_cameras_works(split: Split) -> None:
    """Shifted by any angle, four analysers 45 degrees apart give the same parts."""
    truth = random_truth(23)
    turned = tuple(t + math.radians(17) for t in SONY)
    one, other = split(measured(truth)), split(measure(truth.stokes, turned))
    assert_within(other.diffuse, one.diffuse, 1e-8)
    assert_within(other.specular, one.specular, 1e-8)


@pytest.mark.parametrize("degrees", [0, 20, 45, 77, 90, 130, 170])
def test_light_polarizer_angle_on_a_rendered_ball(degrees: float) -> None:
    """A grey ball lit from the camera: the angle of its highlights tells the light's polarizer within 1 degree."""
    camera = PinholeCamera()
    light = PointLight(camera.position, 60.0, math.radians(degrees))
    ball_part = (Part(ball(1.2), plain((0.3, 0.3, 0.3)), roughness=0.35),)
    diffuse, specular = render(ball_part, camera, light, (64, 64))
    samples = measure(diffuse + specular, SONY)
    angle, concentration = dominant_angle(tally(separate_color_affine(samples)))
    error = math.degrees(light_polarizer_angle(angle)) - degrees
    assert abs((error + 90) % 180 - 90) < 1
    assert concentration > 0.5


def test_dominant_angle_at_special_points() -> None:
    """One angle everywhere has concentration 1; opposite ones, and no light at all, have 0."""
    shape = torch.tensor([1.0, -1.0, 0.0])
    for signs, expected in ((shape[:1], 1), (shape[:2], 0), (shape[2:], 0)):
        light = Stokes(*(k * signs.expand(1, 3, -1) for k in (2.0, math.cos(2.0), math.sin(2.0))))
        samples = measure(light, SONY)
        angle, concentration = dominant_angle(tally(separate_analytic(samples)))
        assert concentration == pytest.approx(expected, abs=1e-6)
        if expected:
            assert angle == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("tiny", [1e-300, 1e-20, 1e-17, 1e-16])
def test_angles_a_hair_below_zero_are_below_pi(tiny: float) -> None:
    """The half-open range [0, pi) holds for single angles too, where rounding would give pi itself."""
    for angle in (aolp_of(1.0, -tiny), dominant_angle(Tally(along=1.0, across=-tiny))[0], light_polarizer_angle(tiny)):
        assert 0 <= angle < math.pi


@pytest.mark.parametrize("radius", [0, 1, 3, 40])
def test_box_mean_is_the_mean_of_what_is_there(radius: int) -> None:
    """Windows shrink at the border: constants stay, and every value is the plain mean over its window."""
    x = torch.rand(2, 9, 12, generator=torch.Generator().manual_seed(24), dtype=torch.float64)
    found = box_mean(x, radius)
    for row, col in itertools.product((0, 4, 8), (0, 6, 11)):
        window = x[:, max(0, row - radius) : row + radius + 1, max(0, col - radius) : col + radius + 1]
        assert_close(found[:, row, col], window.mean(dim=(-2, -1)))


def test_gradients_are_finite_where_there_is_light() -> None:
    """The closed form can be trained through: finite gradients on noisy data."""
    seen = noisy(random_truth(25), 0.01)
    data = seen.data.clone().requires_grad_()
    found = separate_color_affine(Measurements(data, SONY))
    (found.diffuse.square().sum() + found.specular.sum()).backward()
    assert_finite(data.grad)


# ---------------------------------------------------------------------------------------------- more than one capture


def two_lobes(specular_angle: float, beta: float = 0.0, seed: int = 0) -> tuple[Stokes, torch.Tensor, torch.Tensor]:
    """Diffuse light polarized by ``beta`` along 0 and specular light at an angle [rad]; with both s0."""
    generator = torch.Generator().manual_seed(seed)
    diffuse, specular = torch.rand(2, 3, 6, 7, generator=generator, dtype=torch.float64)
    s1 = beta * diffuse + math.cos(2 * specular_angle) * specular
    return Stokes(diffuse + specular, s1, math.sin(2 * specular_angle) * specular), diffuse, specular


def test_debevec_is_exact_for_unpolarized_diffuse_light() -> None:
    stokes, diffuse, specular = two_lobes(0.4)
    found = separate_debevec2000(intensity_behind(stokes, 0.4), intensity_behind(stokes, 0.4 + math.pi / 2))
    assert_close(found.diffuse, diffuse)
    assert_close(found.specular, specular)
    assert_close(found.stokes.s0, stokes.s0)


@pytest.mark.parametrize("degrees", [5.0, 20.0])
def test_debevec_loses_the_cosine_of_twice_the_error(degrees: float) -> None:
    stokes, diffuse, specular = two_lobes(math.radians(degrees))
    found = separate_debevec2000(intensity_behind(stokes, 0.0), intensity_behind(stokes, math.pi / 2))
    assert_close(found.specular, specular * math.cos(2 * math.radians(degrees)))
    assert_close(found.diffuse, diffuse + specular * (1 - math.cos(2 * math.radians(degrees))))


@pytest.mark.parametrize("beta", [0.0, 0.2])
def test_ding_is_exact_for_polarized_diffuse_light(beta: float) -> None:
    """Light turned by 90 degrees turns the sign of the specular polarization and leaves the diffuse as it is."""
    first, diffuse, specular = two_lobes(0.3, beta)
    second, _, _ = two_lobes(0.3 + math.pi / 2, beta)
    found = separate_ding2021(measure(first, SONY), measure(second, SONY))
    assert_close(found.diffuse, diffuse)
    assert_close(found.specular, specular)


def test_extremes_are_analytic_at_the_analysers_angles() -> None:
    for angle in SONY:
        seen = measure(two_lobes(angle)[0], SONY)
        assert_close(separate_extremes(seen).specular, separate_analytic(seen).specular)
    between = measure(two_lobes(math.radians(22.5))[0], SONY)
    expected = separate_analytic(between).specular * math.cos(math.pi / 4)
    assert_close(separate_extremes(between).specular, expected)


def test_outputs_are_never_negative_and_clipping_is_flagged() -> None:
    data = torch.rand(4, 3, 6, 7, generator=torch.Generator().manual_seed(2))
    clipped = torch.zeros_like(data, dtype=torch.bool)
    clipped[1, 2, 3, 4] = True
    one, other = Measurements(data, SONY, clipped), Measurements(data.flip(0), SONY)
    for found in (separate_ding2021(one, other), separate_extremes(one), separate_debevec2000(data[0], data[2])):
        assert_finite(found.diffuse, found.specular)
        assert float(torch.minimum(found.diffuse, found.specular).min()) >= 0
    assert not bool(separate_ding2021(one, other).valid[3, 4])
    assert int((~separate_extremes(one).valid).sum()) == 1
