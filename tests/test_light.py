"""The light found in a frame: its colour, how sure it is, and that nothing but the light changes it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import polsep
from polsep.cli.summary import summary
from polsep.light.color import axis_of, iterate, planes_along
from polsep.light.color_kernel import iterate_fast
from polsep.light.find import (
    ANY_SHARE,
    LED_SHARE,
    RAW_LAMPS,
    RAW_SHARE,
    SURE_DEG,
    UNKNOWN_DEG,
    WARM_SHARE,
    WHITE_SHARE,
    Light,
    _spread_deg,
    _usual_lamps,
    _variance_of,
    combine,
    find_light,
    find_tiles,
    likely_lamp,
)
from polsep.light.tiles import taps, tile_measurements, tile_mosaic
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.pipeline import separate_capture
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, Sensor, expose

SIZE = 256
DAYLIGHT, TUNGSTEN, WHITE = (0.55, 1.0, 0.65), (0.9, 1.0, 0.35), (1.0, 1.0, 1.0)
#: Brightness at which nothing clips, and at which highlights do.
DIM, GLARING = 0.35, 1.2


#: Shares of the lamp's light that gold, copper and aluminium mirror.
GOLD, COPPER, ALUMINIUM = (1.0, 0.782, 0.344), (0.955, 0.638, 0.538), (0.912, 0.914, 0.92)


def scene(
    light: tuple[float, ...] = WHITE,
    exposure: float = DIM,
    gloss: float = 1.0,
    angle: float = 0.4,
    metal: tuple[float, ...] | None = None,
) -> Stokes:
    """Balls of four colours, diffuse light polarized radially, each with a highlight polarized at ``angle``.

    The last of them is of ``metal``, if any.
    """
    y, x = torch.meshgrid(torch.linspace(-1, 1, SIZE), torch.linspace(-1, 1, SIZE), indexing="ij")
    u, v = (2 * x).remainder(2) - 1, (2 * y).remainder(2) - 1
    inside = (u * u + v * v).clamp(max=0.95)
    normal = (1 - inside).sqrt()
    body = torch.tensor([[0.8, 0.2, 0.1], [0.2, 0.6, 0.2], [0.15, 0.25, 0.7], [0.7, 0.6, 0.2]])
    albedo = body[(2 * (y > 0) + (x > 0)).long()].movedim(-1, 0)
    diffuse = albedo * normal.clamp(min=0.1)
    dolp, turn = 0.15 * inside**2, 2 * torch.atan2(-v, u)
    half = (u - 0.3) ** 2 + (v + 0.2) ** 2
    shine = gloss * (2.5 * torch.exp(-half / 0.01) + 0.12 * torch.exp(-half / 0.2))
    shine = shine.expand(3, -1, -1)
    if metal is not None:
        last = (x > 0) & (y > 0)
        rough = 2.0 * torch.exp(-half / 0.6) * torch.tensor(metal).view(3, 1, 1)
        diffuse, shine = torch.where(last, 0, diffuse), torch.where(last, rough, shine)
    color = exposure * torch.tensor(light).view(3, 1, 1)
    return Stokes(
        (diffuse + shine) * color,
        (diffuse * dolp * torch.cos(turn) + shine * math.cos(2 * angle)) * color,
        (diffuse * dolp * torch.sin(turn) + shine * math.sin(2 * angle)) * color,
    )


def frame(layout: Layout | None = None, sensor: Sensor = IMX250, seed: int = 1, **look: object) -> Mosaic:
    """A noisy raw frame of the scene."""
    generator = torch.Generator().manual_seed(seed)
    return expose(scene(**look), layout or Layout(), sensor, generator)  # type: ignore[arg-type]


def angle_between(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """Degrees between two colours."""
    a, b = np.array(one), np.array(other)
    return math.degrees(math.acos(min(1.0, float(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))))


@pytest.mark.parametrize("light", [WHITE, DAYLIGHT, TUNGSTEN, (0.7, 1.0, 0.6)])
@pytest.mark.parametrize("exposure", [DIM, DIM / 10, GLARING], ids=["usual", "dark", "clipped"])
def test_color_of_the_lamp_is_found(light: tuple[float, ...], exposure: float) -> None:
    """Within 1.5 degrees, and sure, whatever the lamp, also in the dark and where highlights clip."""
    found = find_light(frame(light=light, exposure=exposure))
    assert angle_between(found.color, light) < 1.5
    assert found.sure and found.error_deg < SURE_DEG
    assert found.color[1] == 1


def test_gains_of_the_colors_shift_the_log_ratios() -> None:
    """Without noise a lamp of twice the red has a log-ratio greater by ln 2."""
    one = find_light(frame(sensor=IDEAL, light=(0.6, 1.0, 0.8), exposure=0.2))
    two = find_light(frame(sensor=IDEAL, light=(1.2, 1.0, 0.8), exposure=0.2))
    assert one.log_ratio is not None and two.log_ratio is not None
    assert two.log_ratio[0] - one.log_ratio[0] == pytest.approx(math.log(2), abs=0.01)
    assert two.log_ratio[1] - one.log_ratio[1] == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("layout", ["0,45,135,90/RGGB", "90,45,135,0/BGGR", "45,90,0,135/GBRG@1,1"])
def test_order_of_the_filters_does_not_matter(layout: str) -> None:
    """Any layout of the sensor shows the same lamp."""
    found = find_light(frame(Layout.parse(layout), light=DAYLIGHT))
    assert found.sure and angle_between(found.color, DAYLIGHT) < 1.5


@pytest.mark.parametrize("angle", [0.0, 0.8, 1.6, 2.9])
def test_angle_of_the_lamp_is_found(angle: float) -> None:
    """The AoLP of the highlights, within 3 degrees, and the colour does not depend on it."""
    found = find_light(frame(light=TUNGSTEN, angle=angle))
    assert found.aolp is not None
    off = (found.aolp - angle + math.pi / 2) % math.pi - math.pi / 2
    assert abs(math.degrees(off)) < 3
    assert angle_between(found.color, TUNGSTEN) < 1.5


@pytest.mark.parametrize("metal", [GOLD, COPPER])
@pytest.mark.parametrize("light", [WHITE, DAYLIGHT, TUNGSTEN])
def test_coloured_metal_is_not_taken_for_the_lamp(light: tuple[float, ...], metal: tuple[float, ...]) -> None:
    """The bodies beside it say the lamp's colour; how much metal there is is said, and remarked on in one line."""
    found = find_light(frame(light=light, metal=metal))
    assert angle_between(found.color, light) < 1.5
    assert 0.1 < found.metal < 0.35
    assert len(found.remarks) == 1 and "gold or copper" in found.remarks[0]
    report = separate_capture(frame(light=light, metal=metal), "analytic").report
    assert report["light"]["metal_fraction"] > 0.1 and found.remarks[0] in report["warnings"]


@pytest.mark.parametrize("light", [WHITE, DAYLIGHT, TUNGSTEN])
@pytest.mark.parametrize("metal", [None, ALUMINIUM])
def test_grey_metal_and_bodies_are_no_coloured_metal(light: tuple[float, ...], metal: tuple[float, ...] | None) -> None:
    """No remark; grey metal shows the lamp's colour."""
    found = find_light(frame(light=light, metal=metal))
    assert found.metal == 0 and found.remarks == ()
    assert found.sure and angle_between(found.color, light) < 1.5


def test_white_is_assumed_where_the_fit_is_led_astray() -> None:
    """Matte bodies of one colour under a white lamp: no colour of theirs is taken, and no word is said."""
    color = torch.tensor([0.7, 0.5, 0.4]).view(3, 1, 1)
    one = scene(gloss=0.0).map(lambda image: image.mean(0, keepdim=True) * color)
    found = find_light(expose(one, Layout(), IMX250, torch.Generator().manual_seed(1)))
    assert found.color == (1, 1, 1) and not found.sure and found.remarks == ()


def test_the_likely_lamp_follows_the_evidence() -> None:
    """A fit that cannot be wrong is believed, one that says nothing is not, and the frame's mean decides between."""
    tungsten, white = np.log([0.9, 0.35]), np.zeros(2)
    found, error, right = likely_lamp(tungsten, 0.5, 0.0, white)
    np.testing.assert_allclose(found, tungsten, atol=1e-9)
    assert error == pytest.approx(0.5) and right == 1
    found, error, right = likely_lamp(np.array([0.01, -0.01]), 0.5, 0.05, white)
    assert not found.any() and error < 0.5 and right > 0.95
    found, error, right = likely_lamp(np.array([0.7, 0.5]), 0.5, 1.0, white)
    assert not found.any() and error > 1 and right == 0
    body = np.array([-0.3, -1.6])
    found, error, _ = likely_lamp(body, 3.0, 1.0, tungsten)
    assert np.hypot(*(found - tungsten)) < min(np.hypot(*tungsten), np.hypot(*(body - tungsten))) and error > 5


@pytest.mark.parametrize("light", [(1.0, 0.6, 0.05), (1.0, 0.06, 0.02), (0.1, 1.0, 0.2)])
def test_saturated_lamps_are_found(light: tuple[float, ...]) -> None:
    """Amber, red and green LEDs: a fit of clear highlights counts more than that such lamps are rare."""
    found = find_light(frame(light=light))
    assert angle_between(found.color, light) < 1.5 and found.sure and found.remarks == ()


def test_rare_lamps_are_found_with_less_certainty() -> None:
    """A bulb after a balance for daylight is off by less than is said, which is more than of a usual lamp."""
    rare = (1.6, 1.0, 0.45)
    one, other = find_light(frame(light=rare)), find_light(frame(light=TUNGSTEN))
    assert angle_between(one.color, rare) < 1.5 < one.error_deg and one.error_deg > 2 * other.error_deg


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_light_of_one_channel_has_a_color(channel: int) -> None:
    """Under one LED the other channels may be dark: its own is the strongest of a finite lamp, white at the least."""
    light = [0.0, 0.0, 0.0]
    light[channel] = 1.0
    one = frame(light=tuple(light))
    found = find_light(one)
    assert np.isfinite(found.color).all() and max(found.color) == found.color[channel] and not found.sure
    images = separate_capture(one, "analytic")
    assert np.isfinite(images.diffuse).all() and np.isfinite(images.specular).all()


def test_chances_of_lamps_add_up() -> None:
    """Over the grid, but for lamps beyond it, as most saturated ones are, the shares of lamps that are not white."""
    lamps, prior = _usual_lamps()
    usual = RAW_SHARE + WARM_SHARE + ANY_SHARE
    assert usual - 0.01 < prior.sum() < usual + LED_SHARE
    assert usual + LED_SHARE + WHITE_SHARE == pytest.approx(1, abs=1e-9)
    assert not (lamps[prior > prior.max() / 2] > RAW_LAMPS[:, 1] + 0.5).any()


def test_raw_colours_without_balance_are_remarked_on() -> None:
    """Green all over, as under an unbalanced lamp, and no highlight: the colour is asked for, in one line."""
    color = torch.tensor([0.3, 1.0, 0.3]).view(3, 1, 1)
    one = scene(gloss=0.0).map(lambda image: image.mean(0, keepdim=True) * color)
    found = find_light(expose(one, Layout(), IMX250, torch.Generator().manual_seed(1)))
    assert not found.sure and len(found.remarks) == 1 and "--light-color" in found.remarks[0]


def test_frames_that_show_nothing_are_not_sure() -> None:
    """Matte, black, overexposed and tiny frames say that they are not sure; colours of nothing are white."""
    matte = find_light(frame(light=DAYLIGHT, gloss=0.0))
    assert not matte.sure and matte.error_deg > 1.5
    for raw in (np.zeros((64, 64), np.uint16), np.full((64, 64), 65535, np.uint16), np.zeros((4, 4), np.uint8)):
        found = find_light(raw)
        assert not found.sure and found.color == (1, 1, 1) and found.error_deg == UNKNOWN_DEG and found.aolp is None
        assert sum("white is assumed" in remark for remark in found.remarks) == 1


def test_a_colour_that_nothing_shows_is_not_called_found() -> None:
    """The line of the command line says so of black frames, under the warning that white is assumed."""
    black, lit = (separate_capture(capture, "analytic") for capture in (frame(exposure=0.0), frame()))
    assert "colour 1.00,1.00,1.00 (assumed, colour error" in summary(black.report)
    assert "(found, colour error" in summary(lit.report)


def test_mono_has_no_color() -> None:
    """One gain, no log-ratios, and the angle all the same."""
    found = find_light(frame(Layout(bayer=None), angle=1.0))
    assert found.color == (1.0,) and found.log_ratio is None
    assert found.aolp == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("side", [2, 8, 12, 40])
def test_mono_frames_without_tiles_have_no_color(side: int) -> None:
    """However small: one gain, and nothing to be unsure of."""
    found = find_light(np.full((side, side), 90, np.uint8), layout="mono")
    assert found.color == (1.0,) and found.log_ratio is None and found.sure


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_kernel_agrees_with_its_twin(dtype: type[np.generic]) -> None:
    """Same tiles and sums to rounding, for every dtype, odd sizes and black levels included."""
    mosaic = frame(light=DAYLIGHT, exposure=GLARING)
    codes = (mosaic.data.numpy()[:181, :214] / (16 if dtype == np.uint8 else 1)).astype(dtype)
    black, white = 2.0, 255.0 if dtype == np.uint8 else 4095.0
    given = Mosaic(torch.from_numpy(codes), mosaic.layout, black, white)
    fast, slow = find_tiles(given), tile_mosaic(given)
    assert np.array_equal(fast.place, slow.place) and np.array_equal(fast.counts, slow.counts)
    scale = np.sqrt(np.einsum("tii,tjj->tij", slow.moments, slow.moments))
    assert np.abs((fast.moments - slow.moments) / scale).max() < 1e-4
    assert np.abs(fast.noise / slow.noise - 1).max() < 1e-3


@pytest.mark.parametrize("shape", [(128, 128), (1040, 64)], ids=["every point", "every second point"])
def test_votes_are_counted_as_by_the_twin(shape: tuple[int, int]) -> None:
    """The compiled fit takes the steps of the readable one; large frames use every second point in both."""
    mosaic = frame(light=TUNGSTEN)
    tall = Mosaic(mosaic.data.repeat(5, 1)[: shape[0], : shape[1]].contiguous(), mosaic.layout, 0.0, 4095.0)
    tiles, slow = find_tiles(tall), tile_mosaic(tall)
    assert np.array_equal(tiles.counts, slow.counts)
    planes = planes_along(slow, axis_of(slow))
    for one, other in zip(iterate_fast(planes), iterate(planes), strict=True):
        assert np.abs(one - other).max() < 1e-6 * max(1, np.abs(other).max())


def test_taps_have_one_center_and_one_width() -> None:
    """Whatever the place in a period: weights add up to 1, are positive, have mean 1.5 and one variance."""
    for offset in range(4):
        weights, places = np.array(taps(offset)), offset + 4 * np.array([-1, 0, 1])
        mean = float(weights @ places)
        assert float(weights.sum()) == pytest.approx(1) and float(weights.min()) > 0
        assert mean == pytest.approx(1.5) and float(weights @ (places - mean) ** 2) == pytest.approx(4)


def test_cosited_samples_show_the_same_lamp() -> None:
    """Four angle images, also with clipped samples marked."""
    samples = measure(scene(DAYLIGHT, GLARING), Layout().angles)
    clipped = Measurements(samples.data.clamp(max=1), samples.angles, samples.data >= 1)
    found = find_light(clipped)
    assert found.sure and angle_between(found.color, DAYLIGHT) < 1.5
    assert tile_measurements(clipped).counts.sum() < clipped.data[0, 0].numel()


def test_estimates_combine() -> None:
    """The mean of equals, in any order; outliers and unsure ones count little; none is refused."""
    lights = [Light((0.1 + d, -0.2 - d), (1e-4, 0, 1e-4), 0.5, True) for d in (-0.01, 0.0, 0.01)]
    stray = Light((1.0, 1.0), (1e-4, 0, 1e-4), 0.5, True)
    unsure = Light((0.0, 0.0), (0.1, 0, 0.1), 20.0, False)
    for given in ([*lights, stray, unsure], [unsure, stray, *lights[::-1]]):
        mean = combine(given)
        assert mean.sure and mean.error_deg == 0.5
        assert mean.log_ratio == pytest.approx((0.1, -0.2), abs=0.01)
    assert combine([unsure]) == unsure
    with pytest.raises(ValueError, match="at least one"):
        combine([])


def test_default_is_the_light_found() -> None:
    """`separate` takes the colour that `find_light` finds, and reports it; "estimate" is another word for it."""
    mosaic = frame(light=DAYLIGHT)
    found = find_light(mosaic)
    auto, again, stated = (
        separate_capture(mosaic, "analytic", *light) for light in ((), ("estimate",), (found.color,))
    )
    assert auto.report["light"] == {"source": "found", **found.describe()}
    assert auto.report["light_color"] == list(found.color) == again.report["light_color"]
    assert json.loads(json.dumps(auto.report["light"]))["sure"] is True
    page = (Path(__file__).parents[1] / "docs" / "conventions.md").read_text("utf-8")
    listed = page.partition("The entry `light`")[2].partition("##")[0]
    assert all(f"`{name}`" in listed for name in auto.report["light"])
    assert np.array_equal(auto.specular, stated.specular) and stated.report["light"]["source"] == "stated"
    assert separate_capture(mosaic, "analytic", "white").report["light_color"] == [1, 1, 1]


def test_calibrated_lamp_is_believed() -> None:
    """A colour that a calibration brought along counts as said."""
    calibrated = replace(frame(light=DAYLIGHT), light_color=(0.5, 1.0, 0.6))
    report = separate_capture(calibrated, "analytic").report
    assert report["light_color"] == [0.5, 1.0, 0.6] and report["light"]["source"] == "calibrated"


def test_finding_is_deterministic_and_public() -> None:
    """Twice the same, from an array as from a mosaic."""
    mosaic = frame(light=DAYLIGHT)
    codes = mosaic.data.numpy().astype(np.uint16)
    one, two = polsep.find_light(codes, white_level=4095), polsep.find_light(codes, white_level=4095)
    assert one == two
    assert one.color == pytest.approx(find_light(mosaic).color, abs=1e-5)


def test_errors_and_variances_are_of_one_spread() -> None:
    """Log-ratios with the variance of a mean error are off by that angle on average, near white."""
    for error in (0.5, 3.0):
        spread = _spread_deg(np.zeros(2), _variance_of(error) * np.eye(2) * np.array([[1, 0.5], [0.5, 1]]))
        assert spread == pytest.approx(error * 2 / math.sqrt(math.pi), rel=0.15)


def test_forgotten_levels_are_remarked() -> None:
    """12-bit codes in 16-bit words were taken for a dark frame without a word."""
    codes = np.random.default_rng(0).integers(64, 4000, (64, 64)).astype(np.uint16)
    assert any("looks like 12-bit right-justified data" in note for note in find_light(codes).remarks)
    assert not any("12-bit" in note for note in find_light(codes, white_level=4095).remarks)
