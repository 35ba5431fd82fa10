"""The joint network by kernels and OpenVINO: the same as in torch, for every frame that it takes."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from tolerances import assert_close, assert_same_angle, assert_within

from polsep.compute.threads import own_threads
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.kernels import get_threads, set_threads
from polsep.networks import engines, openvino_engine, strips
from polsep.networks.channels import INPUTS, PERIOD
from polsep.networks.engines import run_engine
from polsep.networks.joint import Demosaicker, Joint
from polsep.networks.joint_weights import scale_errors
from polsep.networks.openvino_engine import OpenVinoEngine
from polsep.networks.run import combine, run_joint
from polsep.networks.sizes import ResidualSize
from polsep.physics.stokes import MAX_DOLP, Stokes, aolp, dolp
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import Orientation
from polsep.sensor.unpack_kernel import as_samples
from polsep.separation.analytic import Separation
from polsep.separation.images import FrameImages, Tally
from polsep.separation.report import in_light, tally

COLOR, MONO = Layout(), Layout(bayer=None)
LAYOUTS = [COLOR, MONO]
#: Frames and where their Stokes images come from.
KINDS: list[tuple[Layout, Demosaicker]] = [(COLOR, "linear"), (COLOR, "guided"), (MONO, "linear")]
LIGHT = (1.2, 1.0, 0.8)
BLACK, WHITE = 100.0, 4000.0
#: DoLP and AoLP of pixels that are hardly polarized, and sums over a frame of these tests, in float32.
NOISE, SUMMED = 1e-4, 1e-4
#: Single pixels of guided demosaicking in float32, whose divisions the means over cells hide.
DIVIDED = 1e-4
#: What bfloat16 changes in corrections of a few percent, rms: 8 bits, a few times over.
ROUNDED = 1e-3


def random_net(layout: Layout, inputs: tuple[str, ...] = INPUTS, demosaicker: Demosaicker = "linear") -> Joint:
    """A net whose every layer does something, with corrections of a few percent, and a filter that is not bilinear."""
    torch.manual_seed(0)
    net = Joint(layout.channels, ResidualSize(16, (0, 1, 1)), inputs, demosaicker, sees_frame=True)
    for name, weight in net.named_parameters():
        if name.endswith("weight"):
            torch.nn.init.normal_(weight, std=0.5 / weight[0].numel() ** 0.5)
    for layer in (net.corrections, net.details.change):
        torch.nn.init.normal_(layer.weight, std=0.02 / 16**0.5)
    if net.demosaic is not None:
        net.demosaic += 0.002 * torch.randn(net.demosaic.shape)
    return net.eval()


#: Networks for colour and mono frames.
NETS = {layout.channels: random_net(layout) for layout in (COLOR, MONO)}
WEIGHTS = {colors: net.weights() for colors, net in NETS.items()}


def random_frame(height: int, width: int, layout: Layout, most: int = 4095) -> Mosaic:
    """12-bit samples, some clipped unless ``most`` is below `WHITE`, under a coloured light."""
    generator = np.random.default_rng(height * width)
    raw = generator.integers(int(BLACK), 3500, (height, width), np.uint16)
    raw[height // 2 :, : width // 3][generator.random((height - height // 2, width // 3)) < 0.05] = 4095
    raw[: height // 4, : width // 4] = 4095
    return Mosaic(
        torch.from_numpy(np.minimum(raw, np.uint16(most))), layout, BLACK, WHITE, light_color=LIGHT[: layout.channels]
    )


def in_torch(net: Joint, mosaic: Mosaic, full: bool = False) -> Separation:
    return in_light(run_joint(net, mosaic, full), mosaic.light_color)


def in_engine(net: Joint, mosaic: Mosaic, precision: str = "f32", full: bool = False) -> FrameImages:
    height, width = mosaic.data.shape
    engine = OpenVinoEngine(net.weights(), (height, width), full, precision)
    return engine.run(mosaic.data.numpy(), (mosaic.black_level, mosaic.white_level), mosaic.light_color)


def assert_same(found: FrameImages, expected: Separation, white: Separation, divided: float = 0.0) -> None:
    """Images in the light, and polarization and tally in white light; images within ``divided``, if that is not 0."""
    for image, wanted in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        planes = torch.from_numpy(image).movedim(-1, 0)
        assert_within(planes, wanted, divided) if divided else assert_close(planes, wanted)
    assert expected.expected_error is not None
    assert_close(torch.from_numpy(found.error).movedim(-1, 0), expected.expected_error)
    assert torch.equal(torch.from_numpy(found.valid), white.valid)
    grey = white.stokes.map(lambda s: s.mean(dim=-3))
    assert_within(torch.from_numpy(found.dolp), dolp(grey).clamp(max=MAX_DOLP), NOISE)
    polarized = dolp(grey) > 0.05
    assert_same_angle(torch.from_numpy(found.aolp)[polarized], aolp(grey)[polarized], NOISE)
    sums = tally(white)
    for field in fields(sums):
        mine, theirs = (getattr(x, field.name) for x in (found.tally, sums))
        assert mine is theirs or mine == pytest.approx(theirs, rel=SUMMED, abs=SUMMED * sums.pixels), field.name


@pytest.mark.parametrize(("layout", "demosaicker"), KINDS)
@pytest.mark.parametrize("size", [(64, 96), (4, 4), (8, 60), (60, 8), (132, 20)])
def test_it_is_what_torch_makes_of_a_frame(layout: Layout, demosaicker: Demosaicker, size: tuple[int, int]) -> None:
    net, mosaic = random_net(layout, INPUTS, demosaicker), random_frame(*size, layout)
    assert_same(in_engine(net, mosaic), in_torch(net, mosaic), run_joint(net, mosaic))


@pytest.mark.parametrize(("layout", "demosaicker"), KINDS)
@pytest.mark.parametrize("size", [(64, 96), (4, 4), (8, 60), (60, 8), (132, 20)])
def test_full_resolution_is_what_torch_makes_of_it(
    layout: Layout, demosaicker: Demosaicker, size: tuple[int, int]
) -> None:
    net, mosaic = random_net(layout, INPUTS, demosaicker), random_frame(*size, layout)
    found, expected = in_engine(net, mosaic, full=True), in_torch(net, mosaic, True)
    assert found.diffuse.shape == (*size, layout.channels)
    assert_same(found, expected, run_joint(net, mosaic, full=True), DIVIDED if demosaicker == "guided" else 0.0)


@pytest.mark.parametrize("left_out", INPUTS)
@pytest.mark.parametrize("full", [False, True])
def test_networks_that_see_less_are_shown_less(left_out: str, full: bool) -> None:
    net = random_net(COLOR, tuple(name for name in INPUTS if name != left_out))
    mosaic = random_frame(32, 48, COLOR)
    found = in_engine(net, mosaic, full=full)
    assert_same(found, in_torch(net, mosaic, full), run_joint(net, mosaic, full))


@pytest.mark.parametrize("cell", [(0, 0), (5, 6), (15, 23)])
def test_cells_around_one_that_clips_as_a_whole_are_not_valid(cell: tuple[int, int]) -> None:
    """The cells around are of other colours, and lack that of the one that clips; three samples of a cell leave one."""
    net, (row, col) = random_net(COLOR), cell
    mosaic = random_frame(32, 48, COLOR, most=900)
    data = mosaic.data.numpy()
    data[2 * row : 2 * row + 2, 2 * col : 2 * col + 2] = 4095
    wanted = np.ones((16, 24), bool)
    wanted[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2] = False
    assert np.array_equal(in_engine(net, mosaic).valid, wanted)
    data[2 * row, 2 * col] = 900
    assert in_engine(net, mosaic).valid.all()


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
def test_scaled_expected_errors_change_no_image(layout: Layout) -> None:
    weights, frame = WEIGHTS[layout.channels], random_frame(64, 96, layout)
    scaled = Joint.of(replace(weights, arrays=scale_errors(weights.arrays, (0.5, 0.8))), torch.device("cpu"))
    before, after = (in_engine(net, frame) for net in (NETS[layout.channels], scaled))
    assert np.array_equal(before.diffuse, after.diffuse)
    assert np.array_equal(before.specular, after.specular)
    assert before.error is not None
    np.testing.assert_allclose(after.error, before.error * np.float32((0.5, 0.8)), rtol=1e-5)


def test_a_frame_without_clipped_samples_is_valid_everywhere() -> None:
    net, mosaic = random_net(COLOR), random_frame(32, 48, COLOR, most=3000)
    found = in_engine(net, mosaic)
    assert found.valid.all() and found.tally.clipped == 0


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
@pytest.mark.parametrize("full", [False, True])
def test_bfloat16_rounds_corrections_only(layout: Layout, full: bool) -> None:
    net, mosaic = random_net(layout), random_frame(64, 96, layout)
    found, expected = in_engine(net, mosaic, "bf16", full), in_torch(net, mosaic, full)
    for image, wanted in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        error = torch.from_numpy(image).movedim(-1, 0) - wanted
        assert 0 < float(error.square().mean().sqrt()) < ROUNDED
    assert_within(torch.from_numpy(found.aolp), torch.from_numpy(in_engine(net, mosaic, full=full).aolp), 0.0)


def test_narrow_frames_are_not_made_of_memory_that_nobody_filled() -> None:
    """Layers in bfloat16 of up to 16 raw columns read it, and made 1e34 of it."""
    net, mosaic = random_net(COLOR), random_frame(400, 8, COLOR)
    assert_same(in_engine(net, mosaic, "bf16"), in_torch(net, mosaic), run_joint(net, mosaic))


@pytest.mark.parametrize("full", [False, True])
def test_threads_and_frames_before_change_no_bit(full: bool) -> None:
    """Buffers are used again and again; strips of rows overlap."""
    net, threads = random_net(COLOR), get_threads()
    frames = [random_frame(320, 48, COLOR, most) for most in (4095, 2000)]
    engine = OpenVinoEngine(net.weights(), (320, 48), full, "f32")
    runs = []
    try:
        for count in (1, 3):
            set_threads(count)
            for frame in (*frames, frames[0]):
                runs.append(engine.run(frame.data.numpy(), (BLACK, WHITE), LIGHT))
    finally:
        set_threads(threads)
    for first, second in ((0, 2), (0, 3), (1, 4), (2, 5)):
        for field in fields(FrameImages):
            one, other = (getattr(runs[k], field.name) for k in (first, second))
            assert one == other if field.name == "tally" else np.array_equal(one, other)
    assert not np.array_equal(runs[0].diffuse, runs[1].diffuse)


@pytest.mark.parametrize(("layout", "demosaicker"), KINDS)
def test_a_thread_writes_no_row_of_another(
    layout: Layout, demosaicker: Demosaicker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not even the same numbers: who reads them in between would see half of them."""
    height, row_range = 48, (3, 6)
    net, mosaic = random_net(layout, INPUTS, demosaicker), random_frame(height, 64, layout)
    engine = OpenVinoEngine(net.weights(), (height, 64), True, "f32")
    *planes, clipped = engine._maps.closed
    for plane in (*planes, engine._maps.details):
        plane.fill(math.nan)
    clipped.fill(12345)
    monkeypatch.setattr(openvino_engine, "run_over_rows", lambda work, rows, step: work(row_range))
    engine._fill_maps(as_samples(mosaic.data.numpy()), read_pattern((height, 64), layout, BLACK, WHITE, LIGHT))
    others = np.ones(height // PERIOD, np.bool_)
    others[slice(*row_range)] = False
    for plane in planes:
        assert np.isnan(plane[others]).all() and np.isfinite(plane[~others]).all()
    assert np.isnan(engine._maps.details[others.repeat(2)]).all()
    assert np.isfinite(engine._maps.details[~others.repeat(2)]).all()
    assert (clipped[others] == 12345).all() and (clipped[~others] != 12345).all()


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Engines compute in float32."""
    engines.ENGINES.clear()
    monkeypatch.setattr(engines, "OpenVinoEngine", partial(OpenVinoEngine, precision="f32"))
    yield
    engines.ENGINES.clear()


TURNS: dict[str, Callable[[Layout], Layout]] = {
    "as it is": lambda layout: layout,
    "mirrored": lambda layout: layout.flipped_horizontal(62),
    "upside down": lambda layout: layout.flipped_vertical(50),
    "transposed": lambda layout: layout.transposed(),
    "cropped": lambda layout: layout.rolled(2, 2),
}


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("full", [False, True])
def test_frames_of_any_orientation_and_side(layout: Layout, turn: str, full: bool, exact: None) -> None:
    """Sides that are no multiples of the period, filters mirrored, transposed or cropped."""
    mosaic = random_frame(50, 62, TURNS[turn](layout))
    found = run_engine(WEIGHTS[mosaic.layout.channels], mosaic, full)
    assert found is not None
    white = run_joint(random_net(layout), mosaic, full)
    for image, wanted in ((found.diffuse, in_light(white, mosaic.light_color).diffuse), (found.valid, white.valid)):
        turned = torch.from_numpy(image)
        assert_close((turned.movedim(-1, 0) if turned.ndim == 3 else turned).float(), wanted.float())
    grey = white.stokes.map(lambda s: s.mean(dim=-3))
    polarized = dolp(grey) > 0.05
    assert_same_angle(torch.from_numpy(found.aolp)[polarized], aolp(grey)[polarized], NOISE)
    assert_same_sums(found, white)


def assert_same_sums(found: FrameImages, white: Separation) -> None:
    """Sums over the frame's own pixels, not over those by which it was continued."""
    for name in ("pixels", "valid", "s0", "specular", "diffuse_variance", "specular_variance"):
        assert getattr(found.tally, name) == pytest.approx(getattr(tally(white), name), rel=SUMMED), name


@pytest.mark.parametrize("turned", [{"across": True}, {"down": True}, {"transposed": True}])
def test_angles_that_were_turned_back_stay_below_pi(turned: dict[str, bool]) -> None:
    """Also those that rounding takes there."""
    colors, one = np.zeros((2, 2, 3), np.float32), np.ones((2, 2), np.float32)
    for near in (0, np.pi / 2):
        aolp = np.nextafter(np.float32(near), np.float32(4)) * one
        images = FrameImages(colors, colors, one > 0, one, aolp, Tally(4), colors[..., :2])
        found = engines._turn_back(images, Orientation(4, 4, **turned), 1).aolp
        assert found.min() >= 0 and found.max() < np.pi


def test_threads_with_engines_of_their_own_find_the_same(exact: None) -> None:
    """Frames of two sizes by two threads at once, one engine each, are those of one thread after another."""
    sizes = [(32, 48), (48, 32), (32, 48), (32, 48)]
    frames = [random_frame(*size, COLOR, most) for size, most in zip(sizes, (4095, 4095, 2000, 1000), strict=True)]

    def separate(frame: Mosaic) -> FrameImages:
        with own_threads(1):
            found = run_engine(WEIGHTS[frame.layout.channels], frame, False)
        assert found is not None
        return found

    alone = [run_engine(WEIGHTS[frame.layout.channels], frame, False) for frame in frames]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(separate, frames * 3))
    for found, expected in zip(together, alone * 3, strict=True):
        for field in fields(FrameImages):
            one, other = (getattr(images, field.name) for images in (found, expected))
            assert one == other if field.name == "tally" else np.array_equal(one, other)


@pytest.mark.parametrize("layout", [COLOR.rolled(1, 1), MONO.rolled(1, 0)], ids=lambda layout: layout.spec)
def test_cells_half_a_cell_off_are_means_of_full_resolution(layout: Layout, exact: None) -> None:
    """The network's cells are not the frame's then: images, polarization and validity of the frame's own cells."""
    mosaic = random_frame(32, 48, layout)
    found = run_engine(WEIGHTS[layout.channels], mosaic, False)
    white = run_joint(NETS[layout.channels], mosaic, False)
    lit, grey = in_light(white, mosaic.light_color), white.stokes.map(lambda s: s.mean(dim=-3))
    for image, wanted in (
        (found.diffuse, lit.diffuse),
        (found.specular, lit.specular),
        (found.error, lit.expected_error),
    ):
        assert_close(torch.from_numpy(image).movedim(-1, 0), wanted, 4.0)
    assert torch.equal(torch.from_numpy(found.valid), white.valid)
    lit = grey.s0 > 0.05
    assert_within(torch.from_numpy(found.dolp)[lit], dolp(grey)[lit], 0.02)  # of images, not of demosaicked light
    assert_same_sums(found, white)


def test_samples_of_double_precision_are_read_in_single(exact: None) -> None:
    """The kernels read no others."""
    mosaic = random_frame(32, 48, COLOR)
    double = replace(mosaic, data=mosaic.data.double())
    one, other = (run_engine(WEIGHTS[3], frame, False) for frame in (mosaic, double))
    assert np.array_equal(one.diffuse, other.diffuse) and np.array_equal(one.specular, other.specular)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.spec)
def test_huge_frames_are_separated_in_strips(
    layout: Layout, full: bool, exact: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same as whole ones, by an engine for one height; also where the height is no multiple of strips."""
    mosaic = random_frame(1932, 36, layout)
    whole = run_engine(WEIGHTS[mosaic.layout.channels], mosaic, full)
    monkeypatch.setattr(strips, "MAX_PIXELS", 36 * 984 * (1 + full))
    network = NETS[mosaic.layout.channels]
    pieces = list(engines._strips((1932, 36), network.size, full))
    heights = {bottom - top for (top, bottom), _ in pieces}
    assert len(pieces) == 4 and len(heights) == 1 and max(heights) <= 984 + PERIOD * network.size.grid
    parts = run_engine(WEIGHTS[mosaic.layout.channels], mosaic, full)
    assert whole is not None and parts is not None
    assert np.array_equal(parts.valid, whole.valid)
    for name in ("diffuse", "specular", "error", "dolp"):
        one, other = (torch.from_numpy(getattr(images, name)) for images in (parts, whole))
        assert_close(one, other, 4.0)
    for mine, theirs in zip(vars(parts.tally).values(), vars(whole.tally).values(), strict=True):
        assert mine == theirs or mine == pytest.approx(theirs, rel=SUMMED)


def test_a_network_runs_on_frames_of_several_sizes() -> None:
    """Each size has its own graph from the same weights."""
    network = random_net(COLOR)
    for width in (32, 48):
        frame = random_frame(32, width, COLOR)
        found, expected = in_engine(network, frame), run_joint(network, frame).specular[0]
        assert_close(torch.from_numpy(found.specular[..., 0]), LIGHT[0] * expected, 4.0)


INTERRUPTED = """
import gc, signal, sys, threading
sys.path.insert(0, sys.argv[1])
from test_joint_engine import COLOR, OpenVinoEngine, random_net
engines = [OpenVinoEngine(random_net(COLOR).weights(), (16, width)) for width in (16, 32)]
here, there = ([OpenVinoEngine(random_net(COLOR).weights(), (16, width))] for width in (48, 64))
def forget(several):
    del several[0]
    gc.collect()
forget(engines)
forget(engines)
other = threading.Thread(target=forget, args=(there,))
other.start()
other.join()
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_an_interrupt_comes_through_after_engines_have_gone() -> None:
    """Wherever and in whatever order: a program that no longer has a stack for signals dies without a word."""
    program = [sys.executable, "-c", INTERRUPTED, str(Path(__file__).parent)]
    run = subprocess.run(program, capture_output=True, text=True, timeout=100)
    assert run.stdout.split() == ["interrupted"], f"{run.returncode} {run.stderr}"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_images_of_several_networks_are_weighed_as_in_torch(layout: Layout) -> None:
    """Images, polarization, expected errors and sums of three networks, of which one counts less."""
    rng, shape, colors, shares = np.random.default_rng(3), (13, 18), layout.channels, (1.0, 0.4, 1.0)
    light = LIGHT if colors == 3 else LIGHT[1:2]
    several = []
    for _ in shares:
        diffuse, specular = rng.random((2, *shape, colors), np.float32)
        error = 10 ** rng.uniform(-6, 0, (*shape, 2)).astype(np.float32)
        dolp, aolp = rng.uniform(0, 1.2, shape), rng.uniform(0, math.pi, shape)
        valid = rng.random(shape) < 0.9
        images = (diffuse, specular, valid, dolp.astype(np.float32), aolp.astype(np.float32))
        several.append(FrameImages(*images, Tally(dolp.size, power=2.0, along=1.0), error))
    expected = combine([_as_separation(images) for images in several], shares)
    found = engines.combine_images(several, light, shares)
    assert_close(torch.from_numpy(np.moveaxis(found.diffuse, -1, 0)), expected.diffuse)
    assert_close(torch.from_numpy(np.moveaxis(found.specular, -1, 0)), expected.specular)
    assert np.array_equal(found.valid, expected.valid.numpy())
    assert found.error is not None and found.dolp is not None and found.aolp is not None and found.tally is not None
    assert expected.expected_error is not None
    assert_close(torch.from_numpy(np.moveaxis(found.error, -1, 0)), expected.expected_error)
    polarized = torch.complex(expected.stokes.s1[0], expected.stokes.s2[0]) / expected.stokes.s0[0]
    assert_within(torch.from_numpy(found.dolp), polarized.abs(), 1e-6)
    assert_same_angle(torch.from_numpy(found.aolp), torch.angle(polarized) / 2, 1e-5)
    gain = np.array(light, np.float32)
    tally = found.tally
    assert (tally.valid, tally.above_one) == (found.valid.sum(), (found.dolp > 1).sum())
    sums = [(x / gain).mean(axis=-1).sum() for x in (found.diffuse + found.specular, found.specular)]
    squares = ((found.error / gain.mean()) ** 2).sum(axis=(0, 1))
    sums_found = (tally.s0, tally.specular, tally.diffuse_variance, tally.specular_variance)
    assert sums_found == pytest.approx((*sums, *squares), rel=1e-5)
    assert tally.power == pytest.approx(2 * tally.along)


def _as_separation(images: FrameImages) -> Separation:
    """Polarization as Stokes images of light of s0 = 1; all else as it is."""
    assert images.dolp is not None and images.aolp is not None and images.error is not None
    polarized = torch.from_numpy(images.dolp * np.exp(2j * images.aolp)).expand(images.diffuse.shape[-1], -1, -1)
    diffuse, specular, error = (
        torch.from_numpy(np.moveaxis(x, -1, 0).copy()) for x in (images.diffuse, images.specular, images.error)
    )
    stokes = Stokes(torch.ones_like(polarized.real), polarized.real, polarized.imag)
    return Separation(diffuse, specular, torch.from_numpy(images.valid.copy()), stokes, expected_error=error)
