"""Mosaics through the joint network: any orientation, strips like the whole, nothing but mosaics, foreign weights."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from tolerances import assert_close, assert_within

from polsep.demosaic.bilinear import mean_cells
from polsep.in_torch import load_joint, separate_joint
from polsep.io.store.weights import write_weights
from polsep.methods import METHODS, find_method
from polsep.networks import run as mosaic_network
from polsep.networks import strips
from polsep.networks.channels import INPUTS
from polsep.networks.joint import Joint
from polsep.networks.run import combine, cut_rows, margin_of, run_joint
from polsep.networks.sizes import ResidualSize
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import cell_shifts, orient, shifts_of
from polsep.separation.clipped_pattern import smooth_separation
from polsep.shipped import accepts_mosaic, weights_name

SIZE = ResidualSize(4, (0, 1, 1))
COLOR, MONO = Layout(), Layout(bayer=None)
CPU = torch.device("cpu")


def random_network(layout: Layout) -> Joint:
    """A network whose every layer matters."""
    torch.manual_seed(3)
    network = Joint(layout.channels, SIZE)
    for weight in network.parameters():
        if weight.dim() > 1:
            torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    return network.eval()


def random_mosaic(layout: Layout, height: int, width: int) -> Mosaic:
    """Light that varies slowly, with some clipped samples."""
    generator = torch.Generator().manual_seed(5)
    light = torch.rand(1, 1, 6, 6, generator=generator)
    light = torch.nn.functional.interpolate(light, (height, width), mode="bicubic")[0, 0]
    return Mosaic((light * 1.2 + 0.05 * torch.rand(height, width, generator=generator)).clamp(0, 1), layout, 0.0, 1.0)


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_half_resolution_is_the_mean_over_cells(layout: Layout) -> None:
    network, mosaic = random_network(layout), random_mosaic(layout, 48, 64)
    images = [network(*(x[None, None] for x in (mosaic.linear(), mosaic.clipped())))[0]]
    half, full = run_joint(network, mosaic), run_joint(network, mosaic, full=True)
    assert half.diffuse.shape == half.specular.shape == (layout.channels, 24, 32)
    assert full.diffuse.shape == full.specular.shape == full.stokes.s1.shape == (layout.channels, 48, 64)
    assert_close(half.diffuse, mean_cells(images[0].diffuse[0]).clamp(min=0))
    assert half.expected_error is not None and full.expected_error is not None
    assert half.expected_error.shape == (2, 24, 32) and full.expected_error.shape == (2, 48, 64)
    assert float(half.expected_error.min()) > 0
    assert half.clipped is not None and bool(half.clipped.any()) and not bool(half.clipped.all())
    assert bool((half.clipped | half.valid).all())


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_mirrored_frames_give_mirrored_images(layout: Layout) -> None:
    network, mosaic = random_network(layout), random_mosaic(layout, 48, 64)
    mirrored = Mosaic(mosaic.data.flip(-1), layout.flipped_horizontal(64), 0.0, 1.0)
    found, other = run_joint(network, mosaic), run_joint(network, mirrored)
    assert_close(other.diffuse.flip(-1), found.diffuse)
    assert_close(other.stokes.s1.flip(-1), found.stokes.s1)
    assert_close(-other.stokes.s2.flip(-1), found.stokes.s2)


@pytest.mark.parametrize(("height", "width"), [(48, 64), (50, 63), (49, 61)])
@pytest.mark.parametrize("full", [False, True])
def test_shifted_frames_are_combined(height: int, width: int, full: bool) -> None:
    """A mono frame less its first two rows or columns lies differently on the network's periods of four samples."""
    network, mosaic = random_network(MONO), random_mosaic(MONO, height, width)
    shifts = cell_shifts(orient(mosaic, MONO))
    turned = [shift.turn(mosaic.data) for shift in shifts]
    assert len(shifts) == 4 and len({frame.shape for frame in turned}) == 1
    single = [mosaic_network._run_turned(network, mosaic, shift, full) for shift in shifts]
    assert not torch.allclose(single[0].diffuse, single[1].diffuse, atol=1e-3)
    network.averages_shifts = True
    found = run_joint(network, mosaic, full)
    assert_close(found.diffuse, combine(single).diffuse)
    assert_close(found.stokes.s0, torch.stack([one.stokes.s0 for one in single]).mean(dim=0))
    assert found.expected_error is not None and found.expected_error.shape[-2:] == found.diffuse.shape[-2:]


@pytest.mark.parametrize(("height", "width"), [(48, 64), (50, 63)])
@pytest.mark.parametrize("full", [False, True])
def test_colour_frames_are_seen_twice_by_networks_that_average(height: int, width: int, full: bool) -> None:
    """As they are, and a cell on with red and blue exchanged; so an exchange of these gives exchanged images."""
    network, mosaic = random_network(COLOR), random_mosaic(COLOR, height, width)
    single = [mosaic_network._run_turned(network, mosaic, shift, full) for shift in shifts_of(mosaic, COLOR)]
    assert len(single) == 2 and not torch.allclose(single[0].diffuse, single[1].diffuse, atol=1e-3)
    network.averages_shifts = True
    found = run_joint(network, mosaic, full)
    assert_close(found.diffuse, combine(single).diffuse)
    assert_close(found.stokes.s0, torch.stack([one.stokes.s0 for one in single]).mean(dim=0))
    other = run_joint(network, Mosaic(mosaic.data, Layout(COLOR.polarizer, "BGGR"), 0.0, 1.0), full)
    assert_close(other.diffuse.flip(0), found.diffuse)
    assert_close(other.specular.flip(0), found.specular)
    assert_close(other.stokes.s1.flip(0), found.stokes.s1)


def test_separations_are_weighed_by_their_expected_variances() -> None:
    """Errors of one and two give weights of four fifths and one fifth, in each output by itself."""
    one = run_joint(random_network(COLOR), random_mosaic(COLOR, 48, 64))
    two = replace(one, diffuse=one.diffuse + 1, specular=one.specular + 1)
    ones = torch.ones(1, *one.diffuse.shape[-2:])
    one = replace(one, expected_error=torch.cat([ones, 2 * ones]))
    two = replace(two, expected_error=torch.cat([2 * ones, ones]))
    found = combine([one, two])
    assert_close(found.diffuse, one.diffuse + 0.2)
    assert_close(found.specular, one.specular + 0.8)
    assert_close(found.stokes.s0, one.stokes.s0)
    assert found.expected_error is not None
    assert_close(found.expected_error, torch.cat([1.2 * ones, 1.2 * ones]))
    assert combine([one]) is one
    assert_close(combine([one, two], (1.0, 4.0)).diffuse, one.diffuse + 0.5)


def test_even_light_has_no_pattern_where_shifts_are_averaged() -> None:
    """Places in a period have weights of their own, so an untrained network gives even light a pattern."""
    network, light = random_network(MONO), torch.tensor([[0.3, 0.35], [0.25, 0.3]]).repeat(280, 280)
    mosaic = Mosaic(light, MONO, 0.0, 1.0)

    def contrast() -> float:
        border = margin_of(network.size) // 2
        inner = run_joint(network, mosaic).diffuse[:, border:-border, border:-border]
        return float(inner.max() - inner.min())

    assert contrast() > 0.01
    network.averages_shifts = True
    assert contrast() < 1e-5


def test_mono_cells_of_other_frames_are_their_own() -> None:
    """A mono frame cropped by a column has its cells half a cell on: half resolution follows them."""
    layout = MONO.rolled(0, 1)
    network, mosaic = random_network(MONO), random_mosaic(layout, 48, 64)
    assert not orient(mosaic, MONO).keeps_cells
    half, full = run_joint(network, mosaic), run_joint(network, mosaic, full=True)
    assert half.diffuse.shape == (1, 24, 32)
    assert_close(half.diffuse, mean_cells(full.diffuse))
    assert half.clipped is not None and half.clipped.shape == half.valid.shape == (24, 32)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("layout", [COLOR, MONO], ids=lambda layout: layout.spec)
def test_strips_are_the_whole_frame(layout: Layout, full: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    network, mosaic = random_network(layout), random_mosaic(layout, 1504, 36)
    whole = run_joint(network, mosaic, full)
    monkeypatch.setattr(strips, "MAX_PIXELS", 36 * 600 * (1 + full))
    assert len(list(cut_rows((1504, 36), network.size, full))) == 3
    parts = run_joint(network, mosaic, full)
    assert torch.equal(parts.valid, whole.valid)
    for name in ("diffuse", "specular", "expected_error"):
        assert_close(getattr(parts, name), getattr(whole, name), 4.0)


def test_strips_are_no_smaller_than_their_margins() -> None:
    """However large the frame: where more rows would be computed than are kept twice over, strips are larger."""
    for width in (2448, 20_000):
        pieces = list(cut_rows((2048, width), ResidualSize(64, (3, 3, 2)), True))
        assert pieces == [(0, 1024), (1024, 2048)]
    assert len(list(cut_rows((4096, 8192), SIZE, True))) == 4096 // (2 * margin_of(SIZE))


def test_frames_of_a_batch_are_separated_alike() -> None:
    network, mosaic = random_network(COLOR), random_mosaic(COLOR, 32, 40)
    two = Mosaic(torch.stack([mosaic.data, 0.5 * mosaic.data]), COLOR, 0.0, 1.0)
    assert_close(run_joint(network, two).diffuse[0], run_joint(network, mosaic).diffuse)


@pytest.mark.parametrize("blocks", [(0, 1, 1), (1, 1, 2), (3, 3, 2)], ids=str)
def test_reach_is_within_the_margin(blocks: tuple[int, ...]) -> None:
    """The shipped sizes, too, see no farther than strips overlap."""
    network = Joint(1, ResidualSize(2, blocks))
    for weight in network.parameters():
        torch.nn.init.normal_(weight, std=0.3)
    raw = random_mosaic(MONO, 1024, 8).data[None, None]
    other = raw.clone()
    other[..., 512, :] += 0.2
    nothing = torch.zeros_like(raw, dtype=torch.bool)
    changed = (network.half_resolution(other, nothing).diffuse - network.half_resolution(raw, nothing).diffuse).abs()
    rows = 2 * changed.amax(dim=(0, 1, 3)).nonzero()[:, 0]
    assert int(rows.min()) > 512 - margin_of(network.size)
    assert int(rows.max()) < 512 + margin_of(network.size)


def write_network(path: Path, layout: Layout, changed: dict[str, str] | None = None) -> Joint:
    network = random_network(layout)
    metadata = {"method": "joint", "colors": str(layout.channels), "inputs": json.dumps(INPUTS)}
    write_weights(path, network.state_dict(), metadata | {"size": json.dumps(asdict(SIZE))} | (changed or {}))
    return network


def test_methods_take_what_they_have_weights_for(ship: Path) -> None:
    mosaic = random_mosaic(COLOR, 32, 40)
    assert not accepts_mosaic("joint", mosaic)
    network = write_network(ship / f"{weights_name('joint', COLOR)}.safetensors", COLOR)
    assert accepts_mosaic("joint", mosaic)
    assert not accepts_mosaic("joint", random_mosaic(MONO, 32, 40))
    assert not accepts_mosaic("joint", random_mosaic(Layout(((0, 60), (120, 30))), 32, 40))
    found = separate_joint("joint", mosaic)
    expected = smooth_separation(run_joint(network, mosaic), mosaic)
    assert_within(found.diffuse, expected.diffuse, 0.01)  # weights in half precision
    data = torch.rand(4, 3, 8, 8)
    for capture, said in (
        (Measurements(data, COLOR.angles), r"Measurements of Tensor \(4, 3, 8, 8\)"),
        (Mosaic(data[0, 0].numpy(), COLOR, 0.0, 1.0), r"Mosaic of ndarray \(8, 8\)"),
    ):
        with pytest.raises(
            ValueError, match=f"expected a Mosaic of torch's Tensor for the reference of joint, found {said}"
        ):
            METHODS["joint"].reference(capture)


def test_auto_takes_the_closed_form_where_no_network_does() -> None:
    pair = Measurements(torch.rand(2, 3, 8, 8), (0.0, math.pi / 2))
    assert find_method("auto", pair) is METHODS["color-affine"]
    assert find_method("auto", Measurements(torch.rand(3, 3, 8, 8), (0.0, 1.0, 2.0))) is METHODS["joint-large"]
    with pytest.raises(ValueError, match="expected a method for two crossed photographs"):
        find_method("joint", pair)


@pytest.mark.parametrize("changed", [{"colors": "1"}, {"size": "[]"}, {"size": "{}"}, {"inputs": "3"}])
def test_weights_of_another_network_are_refused(changed: dict[str, str], tmp_path: Path) -> None:
    write_network(tmp_path / "x.safetensors", COLOR, changed)
    with pytest.raises(ValueError, match="expected weights of a joint network in"):
        load_joint(tmp_path / "x.safetensors", CPU)
