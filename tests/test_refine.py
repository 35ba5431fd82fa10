"""The paper's inputs and losses as printed, and its ladder."""

from __future__ import annotations

import math

import pytest
import torch
from tolerances import assert_close

from polsep.networks.paper import Refinement
from polsep.networks.rungs import RUNGS, Rung, analytic_inputs, separate_refined
from polsep.networks.sizes import Size
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.separation.analytic import separate_analytic
from polsep.train.losses import diffuse_loss, gradient_loss, proxy_diffuse, specular_loss

ANGLES = tuple(math.radians(t) for t in (0.0, 45.0, 90.0, 135.0))


def seen(size: int = 12) -> Measurements:
    """Light of 0.8, of which 0.3 is polarized along 20 degrees."""
    turn = 2 * math.radians(20)
    light = (0.8, 0.3 * math.cos(turn), 0.3 * math.sin(turn))
    return measure(Stokes(*(torch.full((1, 3, size, size), s) for s in light)), ANGLES)


def test_inputs_are_those_of_section_4_3() -> None:
    inputs = analytic_inputs(seen())
    expected = (0.5, math.log1p(0.3), math.cos(2 * math.radians(20)))
    assert_close(inputs[0, ::3, 0, 0], torch.tensor(expected))


def test_unpolarized_light_has_no_angle() -> None:
    dark = measure(Stokes(*(torch.full((1, 3, 8, 8), s) for s in (0.8, 0.0, 0.0))), ANGLES)
    assert float(analytic_inputs(dark)[:, 6:].abs().max()) < 1e-6


@pytest.mark.parametrize("rung", RUNGS.values(), ids=lambda r: r.name)
def test_every_rung_sees_and_separates(rung: Rung) -> None:
    network = Refinement(rung, 3, Size(4, 1, 1))
    assert len(network.nets) == (1 if rung.share else 2)
    assert rung.inputs(seen()).shape == (1, 3 * rung.per_color, 12, 12)
    for net in network.nets:
        torch.nn.init.constant_(net.last.bias, 0.25)  # type: ignore[union-attr, arg-type]
    torch.nn.init.zeros_(network.linear.weight)
    torch.nn.init.zeros_(network.linear.bias)  # type: ignore[arg-type]
    found = separate_refined(seen(), rung, network.requires_grad_(False))
    assert_close(found.diffuse, torch.full((1, 3, 12, 12), 0.25))
    assert_close(found.specular, torch.full((1, 3, 12, 12), math.expm1(0.25)))
    assert_close(found.stokes.s0, separate_analytic(seen()).stokes.s0)


@pytest.mark.parametrize("name", ["paper", "shared", "signed", "no-angle"])
def test_networks_that_see_the_analytic_split_start_at_it(name: str) -> None:
    rung, expected = RUNGS[name], separate_analytic(seen())
    found = separate_refined(seen(), rung, Refinement(rung, 3, Size(4, 1, 1)).requires_grad_(False))
    assert_close(found.diffuse, expected.diffuse)
    assert_close(found.specular, expected.specular)


@pytest.mark.parametrize("name", ["unpolarized", "polarized", "stokes"])
def test_other_networks_start_with_all_light_diffuse(name: str) -> None:
    found = separate_refined(seen(), RUNGS[name], Refinement(RUNGS[name], 3, Size(4, 1, 1)).requires_grad_(False))
    assert_close(found.diffuse, torch.full((1, 3, 12, 12), 0.8))
    assert float(found.specular.max()) == 0


def test_mono_has_one_colour() -> None:
    mono = Measurements(seen().data[:, :, :1], ANGLES)
    found = separate_refined(mono, RUNGS["paper"], Refinement(RUNGS["paper"], 1, Size(4, 1, 1)).requires_grad_(False))
    assert found.diffuse.shape == (1, 1, 12, 12)


def test_diffuse_loss_is_eq_19() -> None:
    """A ramp of 0.1 per pixel along x against zero: mean |0.1 x| + 5 times its gradient."""
    ramp = (0.1 * torch.arange(5.0)).expand(1, 1, 4, 5)
    assert_close(gradient_loss(ramp, torch.zeros_like(ramp)), 0.1)
    assert_close(diffuse_loss(ramp, torch.zeros_like(ramp)), 0.2 + 5 * 0.1)


def test_specular_loss_is_eq_21() -> None:
    """Off by a ramp in the logarithm; the proxy of Eq. 20 is what it leaves of the mixed light."""
    diffuse, specular = torch.full((1, 1, 4, 5), 0.6), torch.full((1, 1, 4, 5), 0.5)
    logarithm = torch.log1p(specular) + (0.1 * torch.arange(5.0)).expand(1, 1, 4, 5)
    proxy = proxy_diffuse(logarithm, diffuse + specular)
    assert_close(proxy, diffuse + specular - (torch.exp(logarithm) - 1))
    expected = 0.2 + 50 * 0.1 + float(diffuse_loss(proxy, diffuse))
    assert_close(specular_loss(logarithm, diffuse, specular), expected, scale=10)


def test_losses_vanish_at_the_truth_only() -> None:
    diffuse, specular = torch.rand(2, 1, 3, 8, 8)
    assert_close(diffuse_loss(diffuse, diffuse), 0.0)
    assert float(specular_loss(torch.log1p(specular), diffuse, specular)) < 1e-4
    assert float(specular_loss(torch.log1p(specular) + 0.1, diffuse, specular)) > 0.1


@pytest.mark.parametrize("rung", [rung for rung in RUNGS.values() if rung.basis], ids=lambda rung: rung.name)
def test_networks_see_inputs_through_an_invertible_basis(rung: Rung) -> None:
    """Nothing is lost: brightness in the first map, unpolarized light in no other, colours apart."""
    network = Refinement(rung, 3, Size(4, 1, 1))
    assert network.basis is not None
    matrix = network.basis[..., 0, 0]
    assert float(torch.linalg.cond(matrix)) < 20
    stokes = Stokes(torch.full((3, 1, 1), 0.8), torch.zeros(3, 1, 1), torch.zeros(3, 1, 1))
    seen = matrix @ rung.inputs(measure(stokes, ANGLES)).flatten()
    assert_close(seen, torch.cat([torch.full((3,), 0.4), torch.zeros(3 * rung.per_color - 3)]))
