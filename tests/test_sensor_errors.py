"""Errors of sensors: none is the ideal sensor, even fields stay even, densities and deviations are as asked."""

from __future__ import annotations

import pytest
import torch

from polsep.physics.stokes import Stokes
from polsep.render.sensor_errors import SensorErrors, add_defects, cross_talk, encode_gamma, record, vary_gains
from polsep.render.simulate import filter_light
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, expose

SIZE = (64, 72)


def light(batch: tuple[int, ...] = ()) -> Stokes:
    generator = torch.Generator().manual_seed(2)
    s0 = 0.4 + 0.4 * torch.rand(*batch, 3, *SIZE, generator=generator)
    return Stokes(s0, 0.3 * s0, -0.4 * s0)


@pytest.mark.parametrize("layout", [Layout(), Layout(origin=(1, 0)), Layout(bayer=None)])
def test_without_errors_it_is_the_sensor(layout: Layout) -> None:
    """The same codes as `camera.expose` with the same noise."""
    lit = light() if layout.bayer else light().map(lambda s: s[1:2])
    expected = expose(lit, layout, IMX250, torch.Generator().manual_seed(7))
    found = record(lit, layout, IMX250, SensorErrors(), 7)
    assert float((found.data - expected.data).abs().max()) <= 1  # sums are rounded in another order
    assert float((found.data != expected.data).float().mean()) < 1e-3


def test_twins_share_their_noise() -> None:
    """Defects change the defective pixels alone, and a black level lifts the dark end of all samples."""
    clean = record(light(), Layout(), IMX250, SensorErrors(), 3).data
    defective = record(light(), Layout(), IMX250, SensorErrors(defects=0.01), 3).data
    assert 0 < float((clean != defective).float().mean()) < 0.012
    shifted = record(light(), Layout(), IMX250, SensorErrors(black=16 / 4095), 3).data
    assert float((shifted - 16 - clean * (4095 - 16) / 4095).abs().max()) <= 1
    first, second = (record(light(), Layout(), IDEAL, SensorErrors(gains=0.1), seed).data for seed in (1, 2))
    assert torch.equal(first, second)  # one sensor
    assert not torch.equal(first, record(light(), Layout(), IDEAL, SensorErrors(gains=0.1, specimen=1), 1).data)


def test_turned_analysers() -> None:
    """One angle for all is the same light in a turned frame; batches are frames by themselves."""
    turned = torch.full((4, 4), 0.2)
    exact = filter_light(light((2,)), Layout(), IDEAL)
    assert torch.equal(filter_light(light((2,)), Layout(), IDEAL, 0 * turned), exact)
    found = filter_light(light(), Layout(), IDEAL, turned)
    shifted = Layout(((90 + 11.459156, 45 + 11.459156), (135 + 11.459156, 11.459156)))
    torch.testing.assert_close(found, filter_light(light(), shifted, IDEAL), rtol=1e-5, atol=1e-6)


def test_cross_talk_keeps_even_fields_and_energy() -> None:
    """And takes from contrast what four neighbours get."""
    torch.testing.assert_close(cross_talk(torch.full(SIZE, 0.3), 0.1), torch.full(SIZE, 0.3))
    dot = torch.zeros(2, *SIZE)
    dot[:, 20, 20] = 1
    found = cross_talk(dot, 0.04)
    torch.testing.assert_close(found.sum(dim=(1, 2)), torch.ones(2))
    assert float(found[0, 20, 20]) == pytest.approx(0.96)
    assert float(found[0, 20, 21]) == pytest.approx(0.01)


def test_gains_have_their_deviation() -> None:
    """Single pixels scatter by it; gains of a period repeat."""
    generator = torch.Generator().manual_seed(1)
    found = vary_gains(torch.ones(400, 400), Layout(), (0.01, 0.0), generator)
    assert float(found.std()) == pytest.approx(0.01, rel=0.02)
    shared = vary_gains(torch.ones(10, 12), Layout(), (0.0, 0.02), generator)
    assert torch.equal(shared[:4], shared[4:8])
    assert float(shared.std()) > 0.005


def test_defects_have_their_density() -> None:
    """And all kinds are among them; other pixels stay."""
    samples = torch.full((500, 500), 0.5)
    found = add_defects(samples, 0.01, torch.Generator().manual_seed(1))
    assert float((found != samples).float().mean()) == pytest.approx(0.01, rel=0.1)
    assert float((found == 0).float().mean()) == pytest.approx(0.0025, rel=0.2)
    assert float((found == 1).float().mean()) > 0.0025
    assert bool(((found > 0) & (found < 0.5)).any())
    assert torch.equal(add_defects(samples, 0.0, torch.Generator()), samples)


def test_gamma_is_srgb() -> None:
    """Black and white stay, and a fifth of white is code 124."""
    codes = encode_gamma(Mosaic(torch.tensor([[0.0, 1.0], [0.2, 2.0]]).repeat(2, 2), Layout(), 0.0, 1.0))
    assert codes.data[:2, :2].tolist() == [[0.0, 255.0], [124.0, 255.0]]
    assert codes.white_level == 255
