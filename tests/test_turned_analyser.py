"""Angles and exposures found in photographs, and what a crossed pair and filters that leak light show."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polsep.physics.stokes import (
    Measurements,
    Stokes,
    analyser_matrix,
    behind_angles,
    bounded_below_white,
    complete_pair,
    contradictions,
    correct_extinction,
    fit_stokes,
    is_pair,
    measure,
)
from polsep.physics.turned_analyser import find_angles, find_pair_exposure, gram
from polsep.sensor.camera import Layout, sample_fine_mosaic
from polsep.separation.analytic import separate_analytic
from polsep.separation.color_affine import sample_variance, separate_color_affine

NOISE = 0.004
PAIR = (0.0, math.pi / 2)


def random_light(rng: np.random.Generator, spread: float, count: int = 40_000) -> NDArray[np.float64]:
    """Stokes vectors ``[3, count]`` of weak polarization, its directions spread around 35 degrees."""
    s0, dolp = rng.uniform(0.1, 1, count), rng.uniform(0, 0.4, count) * rng.uniform(0, 1, count)
    angle = rng.normal(0.6, spread, count)
    return np.stack([s0, s0 * dolp * np.cos(2 * angle), s0 * dolp * np.sin(2 * angle)])


def photographs(degrees: list[float], light: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    samples = analyser_matrix(np.deg2rad(degrees)) @ light
    return samples + rng.normal(0, NOISE, samples.shape)


@pytest.mark.parametrize(
    "degrees",
    [[0, 33, 70, 101, 128, 160], [0, 36, 72, 108, 144], [0, 150, 120, 90, 60, 30, 10], list(range(0, 340, 15))],
    ids=["six", "five even", "clockwise", "a film of nearly two turns"],
)
def test_angles_are_found_to_a_tenth_of_a_degree(degrees: list[float]) -> None:
    """From noisy photographs, up to the roll that makes the first one 0 and the mirror that turns the second one up."""
    rng = np.random.default_rng(5)
    found = find_angles(*gram(photographs(degrees, random_light(rng, 0.8), rng)))
    sense = 1 if degrees[1] < 90 else -1
    off = (np.rad2deg(found.angles) - sense * np.array(degrees) + 90) % 180 - 90
    assert found.angles[0] == 0 and np.abs(off).max() < 0.1
    assert 0 < math.degrees(found.error) < 0.1


def test_one_direction_of_polarization_shows_no_angles() -> None:
    """Of light along one direction the error is large; of four photographs nothing is found."""
    rng = np.random.default_rng(6)
    degrees = [0.0, 33, 70, 101, 128, 160]
    flat = photographs(degrees, random_light(rng, 0.0), rng)
    assert math.degrees(find_angles(*gram(flat)).error) > 2
    with pytest.raises(ValueError, match="expected at least 5 photographs"):
        find_angles(*gram(flat[:4]))


def test_a_filter_that_was_not_turned_shows_no_angles() -> None:
    """Nor do equal photographs, of which rounding was taken for turns, known without error."""
    rng = np.random.default_rng(3)
    once = photographs([0.0], random_light(rng, 0.8), rng)
    assert math.isinf(find_angles(*gram(np.repeat(once, 20, axis=0))).error)


@pytest.mark.parametrize(
    "degrees", [[0, 60, 0, 60, 0], [0, 90, 0, 90, 0], [0, 60, 120, 0, 60, 120], [0, 45, 90, 135, 0, 45, 90, 135]]
)
def test_fewer_than_five_different_angles_are_not_found(degrees: list[float]) -> None:
    """In however many photographs: of two angles others were found, known to a degree as it seemed."""
    rng = np.random.default_rng(8)
    assert math.isinf(find_angles(*gram(photographs(degrees, random_light(rng, 0.8), rng))).error)


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.6])
def test_the_ratio_of_exposures_is_recovered(ratio: float) -> None:
    """Where a third of the samples has specular light, and diffuse light is polarized a little, within 2 %."""
    rng = np.random.default_rng(7)
    half = rng.uniform(0.05, 0.5, 50_000)
    specular = rng.exponential(0.1, half.size) * (rng.uniform(size=half.size) < 0.33)
    lean = 1 + rng.normal(0, 0.03, half.size)
    parallel = ratio * (half * lean + specular) + rng.normal(0, NOISE, half.size)
    assert find_pair_exposure(parallel, half / lean) == pytest.approx(ratio, rel=0.02)
    with pytest.raises(ValueError, match="expected bright photographs"):
        find_pair_exposure(parallel * 1e-3, half)


def lobes(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Unpolarized diffuse and white specular light ``[3, 24, 24]``."""
    generator = torch.Generator().manual_seed(seed)
    diffuse = torch.rand(3, 24, 24, generator=generator, dtype=torch.float64)
    specular = 0.3 * torch.rand(1, 24, 24, generator=generator, dtype=torch.float64).expand(3, -1, -1)
    return diffuse, specular


def seen(angles: tuple[float, ...]) -> Measurements:
    """`lobes` behind analysers, the specular light polarized along 0."""
    diffuse, specular = lobes()
    return measure(Stokes(diffuse + specular, specular, torch.zeros_like(specular)), angles)


@pytest.mark.parametrize("separate", [separate_analytic, separate_color_affine])
def test_a_crossed_pair_is_separated(separate: object) -> None:
    """Malus: parallel is diffuse / 2 + specular, crossed is diffuse / 2, and the methods give both lobes back."""
    pair, (diffuse, specular) = seen(PAIR), lobes()
    assert torch.allclose(pair.data[0], diffuse / 2 + specular) and torch.allclose(pair.data[1], diffuse / 2)
    if separate is separate_color_affine:  # without texture, which is noise to it
        pair = Measurements(pair.data[..., :1, :1].expand(-1, -1, 24, 24), pair.angles)
        diffuse, specular = diffuse[:, :1, :1], specular[:, :1, :1]
    found = separate(pair)  # type: ignore[operator]
    assert float((found.diffuse - diffuse).abs().max()) < 1e-6
    assert float((found.specular - specular).abs().max()) < 1e-6


def test_a_pair_is_completed_by_what_is_not_polarized_obliquely() -> None:
    """The two analysers between see s0 / 2, and clip where one of the pair does; three analysers are no pair."""
    pair = seen((0.3, 0.3 + math.pi / 2))
    whole = complete_pair(Measurements(pair.data, pair.angles, pair.data > 0.4))
    assert is_pair(pair) and whole.clipped is not None
    assert float((contradictions(whole)).abs().max()) < 1e-12
    assert bool((whole.clipped[1] == (pair.data > 0.4).any(dim=0)).all())
    assert torch.allclose(fit_stokes(whole).s0, pair.data.sum(dim=0))
    with pytest.raises(ValueError, match="need two crossed analysers"):
        complete_pair(seen((0.0, 1.0, 2.0)))


@pytest.mark.parametrize("angles", [PAIR, (0.0, 1.0, 2.0), (0.1, 0.9, 1.7, 2.5, 2.8)])
def test_extinction_is_undone(angles: tuple[float, ...]) -> None:
    """Filters that pass 1/50 of crossed light, corrected, see what ideal ones see; 1 is no filter."""
    ideal, loss = seen(angles), (50 - 1) / (50 + 1)
    half = fit_stokes(seen((0.0, 1.0, 2.0))).s0 / 2
    leaking = Measurements(half + loss * (ideal.data - half), angles)
    assert float((correct_extinction(leaking, 50).data - ideal.data).abs().max()) < 1e-12
    assert correct_extinction(leaking, math.inf) is leaking
    with pytest.raises(ValueError, match="extinction ratio above 1"):
        correct_extinction(leaking, 1.0)


def test_light_is_seen_behind_other_angles() -> None:
    """Three, five and the same analysers say what four see; what clips among them is known from the others."""
    four = seen(Layout().angles)
    assert behind_angles(four, Layout().angles) is four
    for angles in ((0.0, 1.0, 2.0), (0.1, 0.9, 1.7, 2.5, 2.8)):
        found = behind_angles(seen(angles), Layout().angles)
        assert float((found.data - four.data).abs().max()) < 1e-12
    five = seen((0.1, 0.9, 1.7, 2.5, 2.8))
    clipped = five.data > 0.5
    found = behind_angles(Measurements(five.data.clamp(max=0.5), five.angles, clipped), Layout().angles)
    assert found.clipped is not None
    known = ~found.clipped
    assert float((found.data - four.data)[known].abs().max()) < 1e-9 and 0.8 < float(known.double().mean()) < 1


def test_angles_are_the_same_half_a_turn_away() -> None:
    turned = seen((0.0, math.pi / 4, -math.pi / 2, 7 * math.pi / 4))
    asked = (0.0, math.pi / 4, math.pi / 2, 3 * math.pi / 4)
    found = behind_angles(turned, asked)
    assert found.angles == asked and found.data is turned.data


def test_what_clips_below_white_is_solved_or_refused() -> None:
    """Photographs of longer exposures clip at less than white: three others say what one hides, two do not."""
    four, angles = seen(Layout().angles), Layout().angles
    for number, bounded in ((1, False), (2, True)):
        clipped = (four.data > 0.3) & (torch.arange(4) < number)[:, None, None, None]
        hidden = Measurements(torch.where(clipped, 0.3, four.data), angles, clipped)
        assert bounded_below_white(hidden) == bounded
        found = behind_angles(hidden, angles)
        assert found.clipped is not None
        assert float((found.data - four.data)[~found.clipped].abs().max()) < 1e-9
        assert bool(found.clipped.any()) == bounded
    assert not bounded_below_white(four)
    whole = Measurements(four.data.clamp(max=0.3), angles, four.data > 0.3)
    assert bounded_below_white(whole)


def test_extinction_is_undone_beside_clipped_samples() -> None:
    """What one analyser hides is not taken at its word for the others' sum."""
    ideal, loss = seen(Layout().angles), (10 - 1) / (10 + 1)
    half = fit_stokes(ideal).s0 / 2
    leaking = half + loss * (ideal.data - half)
    clipped = (leaking > 0.3) & (torch.arange(4) == 1)[:, None, None, None]
    found = correct_extinction(
        Measurements(leaking.where(~clipped, torch.tensor(0.3).double()), ideal.angles, clipped), 10
    )
    assert clipped.any() and float((found.data - ideal.data)[~clipped].abs().max()) < 1e-9


@pytest.mark.parametrize("number", [2, 3, 5])
def test_noise_is_measured_without_four_analysers(number: int) -> None:
    """Of even light, the variance of a sample: by contradiction of five, by neighbours of two and three."""
    angles = PAIR if number == 2 else tuple(0.6 * k for k in range(number))
    generator = torch.Generator().manual_seed(number)
    data = 0.5 + 0.01 * torch.randn(number, 3, 64, 64, generator=generator, dtype=torch.float64)
    assert float(sample_variance(Measurements(data, angles)).mean()) == pytest.approx(1e-4, rel=0.1)


@pytest.mark.parametrize("layout", [Layout(), Layout(bayer=None)], ids=["colour", "mono"])
def test_a_finer_sensor_sees_the_same_light(layout: Layout) -> None:
    """Even light gives each pixel what its filter passes; clipped samples clip; other angles are refused."""
    light = torch.tensor([0.8, 0.6, 0.4], dtype=torch.float64)[: layout.channels, None, None].expand(-1, 6, 8)
    samples = measure(Stokes(light, 0.3 * light, -0.1 * light), layout.angles)
    mosaic = sample_fine_mosaic(samples, layout)
    assert mosaic.data.shape == (12, 16)
    for row in range(4):
        for col in range(4):
            angle, channel = layout.filter_at(row, col)
            k = layout.angles_deg.index(angle)
            expected = float(samples.data[k, channel, 0, 0])
            assert float((mosaic.data[row::4, col::4] - expected).abs().max()) < 1e-9
    clipped = torch.zeros_like(samples.data, dtype=torch.bool)
    clipped[:, :, 2, 3] = True
    marked = sample_fine_mosaic(Measurements(samples.data, samples.angles, clipped), layout).clipped()
    assert bool(marked[4:6, 6:8].all()) and int(marked.sum()) == 4
    with pytest.raises(ValueError, match="expected measurements at"):
        sample_fine_mosaic(measure(Stokes(light, light, light), (0.0, 1.0, 2.0)), layout)
