"""Methods with more than one capture: exact where their assumptions hold, wrong as theory says where they do not."""

from __future__ import annotations

import math

import pytest
import torch
from tolerances import assert_close, assert_finite

from polsep.physics.stokes import Measurements, Stokes, intensity_behind, measure
from polsep.separation.analytic import separate_analytic
from polsep.separation.multi_capture import separate_debevec2000, separate_ding2021, separate_extremes

ANGLES = tuple(math.radians(t) for t in (0.0, 45.0, 90.0, 135.0))


def light(specular_angle: float, beta: float = 0.0, seed: int = 0) -> tuple[Stokes, torch.Tensor, torch.Tensor]:
    """Diffuse light polarized by ``beta`` along 0 and specular light at an angle [rad]; with both s0."""
    generator = torch.Generator().manual_seed(seed)
    diffuse, specular = torch.rand(2, 3, 6, 7, generator=generator, dtype=torch.float64)
    s1 = beta * diffuse + math.cos(2 * specular_angle) * specular
    return Stokes(diffuse + specular, s1, math.sin(2 * specular_angle) * specular), diffuse, specular


def test_debevec_is_exact_for_unpolarized_diffuse_light() -> None:
    stokes, diffuse, specular = light(0.4)
    found = separate_debevec2000(intensity_behind(stokes, 0.4), intensity_behind(stokes, 0.4 + math.pi / 2))
    assert_close(found.diffuse, diffuse)
    assert_close(found.specular, specular)
    assert_close(found.stokes.s0, stokes.s0)


@pytest.mark.parametrize("degrees", [5.0, 20.0])
def test_debevec_loses_the_cosine_of_twice_the_error(degrees: float) -> None:
    stokes, diffuse, specular = light(math.radians(degrees))
    found = separate_debevec2000(intensity_behind(stokes, 0.0), intensity_behind(stokes, math.pi / 2))
    assert_close(found.specular, specular * math.cos(2 * math.radians(degrees)))
    assert_close(found.diffuse, diffuse + specular * (1 - math.cos(2 * math.radians(degrees))))


@pytest.mark.parametrize("beta", [0.0, 0.2])
def test_ding_is_exact_for_polarized_diffuse_light(beta: float) -> None:
    """Light turned by 90 degrees turns the sign of the specular polarization and leaves the diffuse as it is."""
    first, diffuse, specular = light(0.3, beta)
    second, _, _ = light(0.3 + math.pi / 2, beta)
    found = separate_ding2021(measure(first, ANGLES), measure(second, ANGLES))
    assert_close(found.diffuse, diffuse)
    assert_close(found.specular, specular)


def test_extremes_are_analytic_at_the_analysers_angles() -> None:
    for angle in ANGLES:
        seen = measure(light(angle)[0], ANGLES)
        assert_close(separate_extremes(seen).specular, separate_analytic(seen).specular)
    between = measure(light(math.radians(22.5))[0], ANGLES)
    expected = separate_analytic(between).specular * math.cos(math.pi / 4)
    assert_close(separate_extremes(between).specular, expected)


def test_outputs_are_never_negative_and_clipping_is_flagged() -> None:
    data = torch.rand(4, 3, 6, 7, generator=torch.Generator().manual_seed(2))
    clipped = torch.zeros_like(data, dtype=torch.bool)
    clipped[1, 2, 3, 4] = True
    one, other = Measurements(data, ANGLES, clipped), Measurements(data.flip(0), ANGLES)
    for found in (separate_ding2021(one, other), separate_extremes(one), separate_debevec2000(data[0], data[2])):
        assert_finite(found.diffuse, found.specular)
        assert float(torch.minimum(found.diffuse, found.specular).min()) >= 0
    assert not bool(separate_ding2021(one, other).valid[3, 4])
    assert int((~separate_extremes(one).valid).sum()) == 1
