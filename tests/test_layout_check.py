"""The layout check speaks when a frame contradicts its layout, and is silent when it cannot know."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import pytest
import torch
from torch import Tensor

from polsep.physics.stokes import Stokes
from polsep.render.distances import random_light, random_parts
from polsep.render.sphere_tracing import PinholeCamera, render
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, expose
from polsep.sensor.layout_check import LayoutCheck, check_layout, crossed_pairs
from polsep.sensor.levels import as_mosaic

ORDERS = list(itertools.permutations((0, 45, 90, 135)))
SONY = ((90, 45), (135, 0))
#: Orders whose crossed pairs lie on the diagonals, as in Sony's: first and last 90 degrees apart.
LIKE_SONY = [order for order in ORDERS if abs(order[0] - order[3]) == 90]
OFFSETS = list(itertools.product(range(4), range(4)))
COLOR, MONO = Layout(), Layout(bayer=None)
RAW_FRAMES = {
    "album_quadbayer_crop": COLOR,
    "carlight_quadbayer_crop": COLOR,
    "camera_IMX250MZR": MONO,
    "carps_IMX250MZR": MONO,
    "fruits_IMX250MZR": MONO,
    "polarizer_IMX250MZR": MONO,
}


def order_layout(order: tuple[int, ...], bayer: str | None = "RGGB") -> Layout:
    return Layout((order[:2], order[2:]), bayer)  # type: ignore[arg-type]


def read_as(data: Tensor, layout: Layout, white: float = 1.0) -> LayoutCheck:
    return check_layout(Mosaic(data, layout, 0.0, white))


@pytest.fixture(scope="module")
def scene() -> Stokes:
    """Four random objects under one polarized light on black, exposed to a brightness that cameras see."""
    generator = torch.Generator().manual_seed(1)
    diffuse, specular = render(random_parts(generator, 4), PinholeCamera(), random_light(generator), (128, 128))
    return (diffuse + specular) * 3.0


@pytest.fixture(scope="module")
def color_frame(scene: Stokes) -> Tensor:
    """The scene on a noisy 12-bit colour sensor."""
    return expose(scene, COLOR, IMX250, torch.Generator().manual_seed(2)).linear()


def smooth_light(channels: int, seed: int = 3) -> Stokes:
    """Smooth polarized light at 256x256: grey for one channel, coloured for three."""
    coarse = torch.rand(1, 3 * channels, 4, 4, generator=torch.Generator().manual_seed(seed))
    fine = torch.nn.functional.interpolate(coarse, size=(256, 256), mode="bicubic", align_corners=True)[0]
    a, b, c = fine.reshape(3, channels, 256, 256)
    return Stokes(0.4 + 0.5 * a, 0.3 * (b - 0.5), 0.3 * (c - 0.5))


@pytest.fixture(scope="module")
def mono_frame() -> Tensor:
    """Smooth grey polarized light on a mono sensor."""
    return expose(smooth_light(1), MONO, IDEAL).data


def test_crossed_pairs_of_all_orders() -> None:
    """Eight orders have their crossed pairs on the diagonals, eight in rows, eight in columns; others have none."""
    found = [crossed_pairs(order_layout(order)) for order in ORDERS]
    assert [found.count(name) for name in ("diagonals", "rows", "columns")] == [8, 8, 8]
    assert [order for order, pairs in zip(ORDERS, found, strict=True) if pairs == "diagonals"] == LIKE_SONY
    assert crossed_pairs(Layout(((0, 30), (60, 90)))) is None


def test_right_layout_is_silent(color_frame: Tensor, mono_frame: Tensor) -> None:
    """Nothing is said of a frame that is read right, and its layout is among those that fit."""
    for frame, layout, color in ((color_frame, COLOR, True), (mono_frame, MONO, None)):
        check = read_as(frame, layout)
        assert check.warning is None
        assert check.pairs == "diagonals"
        assert layout in check.fits
        assert color is None or check.color is color


@pytest.mark.parametrize("order", ORDERS, ids=str)
def test_analyser_orders(color_frame: Tensor, mono_frame: Tensor, order: tuple[int, ...]) -> None:
    """Of 24 orders the identity contradicts 16: warned of, with the true order among the fits; 8 look in order."""
    for frame, truth in ((color_frame, COLOR), (mono_frame, MONO)):
        check = read_as(frame, order_layout(order, truth.bayer))
        assert check.pairs == "diagonals"
        if order in LIKE_SONY:
            assert check.warning is None
        else:
            assert check.warning is not None and "contradicts layout" in check.warning
            option = "--layout mono (" if truth is MONO else f"--layout {truth.spec} ("
            assert "\n" not in check.warning and option in check.warning
            assert truth in check.fits


@pytest.mark.parametrize("seed", [1, 2])
def test_mono_frames_with_steep_edges_are_silent(seed: int) -> None:
    """Objects on black on a mono sensor: edges are no colour pattern, so the right layout is silent."""
    generator = torch.Generator().manual_seed(seed)
    diffuse, specular = render(random_parts(generator, 4), PinholeCamera(), random_light(generator), (96, 96))
    grey = (diffuse + specular).map(lambda s: s.mean(dim=0, keepdim=True))
    assert read_as(expose(grey, MONO, IDEAL).data, MONO).warning is None


@pytest.mark.parametrize("truth", [(90, 45, 135, 0), (0, 45, 90, 135), (0, 90, 45, 135)], ids=str)
def test_pairing_is_named_from_the_data(truth: tuple[int, ...]) -> None:
    """Sensors of other orders are recognized too: the pairing found is that of the true layout."""
    layout = order_layout(truth)
    frame = expose(smooth_light(3), layout, IDEAL).data
    assert read_as(frame, layout).warning is None
    for order in ((90, 45, 135, 0), (0, 45, 90, 135), (0, 90, 45, 135)):
        check = read_as(frame, order_layout(order))
        assert check.pairs == crossed_pairs(layout)
        assert (check.warning is None) == (crossed_pairs(order_layout(order)) == crossed_pairs(layout))


@pytest.mark.parametrize(("row", "col"), OFFSETS)
def test_crops_of_color_frames(color_frame: Tensor, row: int, col: int) -> None:
    """A crop is warned of unless it keeps the greens in place (0 or 2 of both), and its own layout is silent."""
    crop, own = color_frame[row:, col:], COLOR.rolled(-row, -col)
    check = read_as(crop, COLOR)
    seen = not (row == col and row % 2 == 0)
    assert (check.warning is not None) == seen
    assert own in check.fits
    assert read_as(crop, own).warning is None
    if check.warning is not None:  # red and blue swapped fit as well: both crops are named
        assert own.spec in check.warning and own.rolled(2, 2).spec in check.warning


@pytest.mark.parametrize(("row", "col"), OFFSETS)
def test_crops_of_mono_frames_cannot_be_seen(mono_frame: Tensor, row: int, col: int) -> None:
    """Shifts of Sony's cell keep the crossed pairs on the diagonals: a mono crop is silent under both layouts."""
    for layout in (MONO, MONO.rolled(-row, -col)):
        assert read_as(mono_frame[row:, col:], layout).warning is None


MIRRORS: list[tuple[str, Callable[[Tensor], Tensor], Layout, bool]] = [
    ("left-right", lambda x: x.flip(-1), COLOR.flipped_horizontal(128), True),
    ("top-bottom", lambda x: x.flip(-2), COLOR.flipped_vertical(128), True),
    ("transposed", lambda x: x.mT, COLOR.transposed(), False),
    ("half turn", lambda x: x.flip((-1, -2)), COLOR.flipped_horizontal(128).flipped_vertical(128), False),
]


@pytest.mark.parametrize(("turn", "own", "seen"), [m[1:] for m in MIRRORS], ids=[m[0] for m in MIRRORS])
def test_mirrored_frames(
    color_frame: Tensor, mono_frame: Tensor, turn: Callable[[Tensor], Tensor], own: Layout, seen: bool
) -> None:
    """Mirrored colour frames move the greens: warned of. Half turns, transposed and all mono frames are silent."""
    check = read_as(turn(color_frame), COLOR)
    assert (check.warning is not None) == seen
    assert own in check.fits or not seen
    assert read_as(turn(color_frame), own).warning is None
    assert read_as(turn(mono_frame), MONO).warning is None


def test_whole_frames_that_stand_upright_are_seen(color_frame: Tensor, mono_frame: Tensor) -> None:
    """A sensor's whole frame, transposed or turned, is higher than wide: told what to say, then silent."""
    lying = color_frame.repeat(16, 20)[:2048, :2448]
    assert read_as(lying, COLOR).warning is None
    transposed = read_as(lying.mT, COLOR).warning
    assert transposed is not None and f"--layout {COLOR.transposed().spec} (transposed)" in transposed
    assert read_as(lying.mT, COLOR.transposed()).warning is None
    for turns, flip in ((1, COLOR.transposed().flipped_vertical(4)), (-1, COLOR.transposed().flipped_horizontal(4))):
        turned = read_as(torch.rot90(lying, turns), COLOR).warning
        assert turned is not None and flip.spec in turned and "turned to the left" in turned
        assert read_as(torch.rot90(lying, turns), flip).warning is None
    plain = mono_frame.repeat(10, 8)[:2448, :2048]
    mono = read_as(plain, MONO).warning
    assert mono is not None and f"--layout {MONO.transposed().spec} (transposed)" in mono
    assert read_as(plain[:-4], MONO).warning is None


def test_whole_frames_that_were_mirrored_are_no_crops(color_frame: Tensor) -> None:
    """A frame as large as a sensor was mirrored by the camera (ReverseX, ReverseY): told what to say, then silent."""
    whole = color_frame.repeat(16, 20)[:2048, :2448]
    left_right, top_bottom = COLOR.flipped_horizontal(2448), COLOR.flipped_vertical(2048)
    for axis, own in ((-1, left_right), (-2, top_bottom)):
        warning = read_as(whole.flip(axis), COLOR).warning
        assert warning is not None and "cropped" not in warning
        assert f"--layout {left_right.spec} (mirrored left-right; if top-bottom, {top_bottom.spec})" in warning
        assert read_as(whole.flip(axis), own).warning is None


def test_color_read_as_mono(color_frame: Tensor) -> None:
    """A colour frame under the mono layout is warned of, and the colour layout offered."""
    check = read_as(color_frame, MONO)
    assert check.warning is not None and "colour read as mono" in check.warning
    assert check.color is True and COLOR in check.fits


def test_grey_under_a_color_layout_is_said_with_reserve() -> None:
    """Without any colour pattern a sensor is mono or sees only grey: the warning says which it cannot tell."""
    grey = smooth_light(1)
    frame = expose(grey, MONO, IDEAL).data
    check = read_as(frame, COLOR)
    assert check.warning is not None and "unless all it shows is grey" in check.warning
    assert check.color is False and MONO in check.fits
    assert read_as(frame, MONO).warning is None
    on_color_sensor = expose(grey.map(lambda s: s.expand(3, -1, -1)), COLOR, IDEAL).data
    assert torch.equal(on_color_sensor, frame)


def test_unpolarized_light_says_nothing_of_analysers() -> None:
    """Unpolarized light obeys every order; its colours still tell the alignment."""
    light = smooth_light(3)
    frame = expose(Stokes(light.s0, 0 * light.s1, 0 * light.s2), COLOR, IDEAL).data
    for order in ORDERS:
        check = read_as(frame, order_layout(order))
        assert check.warning is None and check.pairs is None
    assert read_as(frame[1:], COLOR).warning is not None


SILENT = {
    "black": torch.zeros(64, 64),
    "negative": torch.full((64, 64), -0.1),
    "clipped": torch.ones(64, 64),
    "tiny": torch.rand(8, 8, generator=torch.Generator().manual_seed(4)),
    "smallest": torch.rand(4, 4, generator=torch.Generator().manual_seed(5)),
    "uniform mono": torch.full((64, 64), 0.5),
}


@pytest.mark.parametrize("name", SILENT)
def test_frames_that_show_nothing_are_silent(name: str) -> None:
    """Black, clipped and tiny frames contradict no layout."""
    layouts = [MONO] if name == "uniform mono" else [COLOR, MONO, order_layout((0, 45, 90, 135))]
    for layout in layouts:
        check = read_as(SILENT[name], layout)
        assert check.warning is None and check.pairs is None


def test_frames_below_black_are_silent() -> None:
    """Nor is there a warning of NumPy."""
    frame = Mosaic(0.1 + 0.1 * torch.rand(64, 64, generator=torch.Generator().manual_seed(6)), COLOR, 0.9, 1.0)
    assert check_layout(frame).warning is None


@pytest.mark.parametrize(("height", "width"), [(2, 2), (2, 64), (64, 3)])
def test_narrow_mono_frames_are_silent(height: int, width: int) -> None:
    """The check never raises, on no size that a `Mosaic` may have."""
    assert read_as(torch.full((height, width), 0.5), MONO).warning is None


def test_clipped_highlights_do_not_count(color_frame: Tensor) -> None:
    """Clipped samples break the identity; blocks that hold some are left out, so the right layout stays silent."""
    assert float((color_frame * 4 >= 1).float().mean()) > 0.02
    assert read_as((color_frame * 4).clamp(max=1), COLOR).warning is None


def test_gain_errors_do_not_count(color_frame: Tensor) -> None:
    """A gain error of 2 % of one analyser, as real sensors show, is no wrong layout."""
    frame = color_frame.clone()
    frame[0::2, 0::2] *= 1.02
    assert read_as(frame, COLOR).warning is None


def one_polarization(s1: float, s2: float) -> Tensor:
    """A mono frame of texture whose light is polarized alike everywhere, relative to s0."""
    s0 = smooth_light(1).s0
    return expose(Stokes(s0, s1 * s0, s2 * s0), MONO, IDEAL).data


def test_a_gain_error_beside_weak_polarization_is_no_wrong_layout() -> None:
    """90 reads 2 % too much, 0.01 of s0: rows, -s1 + s2 + 0.01, then fit exactly, and the true diagonals do not."""
    frame = one_polarization(0.1, 0.09)
    frame[0::2, 0::2] *= 1.02
    assert read_as(frame, MONO).warning is None


def test_a_contradiction_that_is_the_same_everywhere_is_still_one() -> None:
    """Of light with one polarization a wrong order is told too: no gain error is as large as 0.3 of the brightness."""
    frame = one_polarization(0.3, 0.0)
    for order, silent in (((90, 45, 135, 0), True), ((0, 90, 45, 135), False), ((0, 45, 90, 135), False)):
        assert (read_as(frame, order_layout(order, None)).warning is None) == silent


def test_first_frame_of_a_batch_and_exposure(color_frame: Tensor) -> None:
    """Of a batch the first frame is judged; exposure changes nothing."""
    batch = torch.stack([color_frame, color_frame.flip(-1)])
    assert read_as(batch, COLOR).warning is None
    assert read_as(batch.flip(0), COLOR).warning is not None
    dark = read_as(0.05 * color_frame, order_layout((0, 45, 90, 135)))
    assert dark.warning == read_as(color_frame, order_layout((0, 45, 90, 135))).warning


@pytest.fixture(scope="module")
def real_frames(shared: Path) -> dict[str, Tensor]:
    """The real raw frames, black 0 and white 1."""
    frames = {}
    for name, layout in RAW_FRAMES.items():
        array = imagecodecs.png_decode((shared / "data" / "raw" / f"{name}.png").read_bytes())
        frames[name] = torch.from_numpy(as_mosaic(array, layout)[0].linear())
    return frames


def middle(frame: Tensor) -> Tensor:
    """The middle of a frame, at most 1280x1280 pixels, at an offset that keeps the layout."""
    top, left = (max(0, (n - 1280) // 8 * 4) for n in frame.shape)
    return frame[top : top + 1280, left : left + 1280]


@pytest.mark.parametrize("name", RAW_FRAMES)
def test_real_frames_are_silent_under_their_layout(real_frames: dict[str, Tensor], name: str) -> None:
    """No false alarm on any real frame, nor on its mirrored, transposed and cropped versions with their layouts."""
    layout = RAW_FRAMES[name]
    assert read_as(real_frames[name], layout).warning is None
    frame = middle(real_frames[name])
    height, width = frame.shape
    assert read_as(frame, layout).warning is None
    assert read_as(frame.flip(-1), layout.flipped_horizontal(width)).warning is None
    assert read_as(frame.flip(-2), layout.flipped_vertical(height)).warning is None
    assert read_as(frame.mT, layout.transposed()).warning is None
    for row, col in OFFSETS:
        assert read_as(frame[row:, col:], layout.rolled(-row, -col)).warning is None


def test_parts_of_a_real_mono_frame_are_silent(real_frames: dict[str, Tensor]) -> None:
    """Any 512x512 part of a real mono frame is a mono frame: silent."""
    frame = real_frames["camera_IMX250MZR"]
    parts = [frame[row : row + 512, col : col + 512] for row in range(0, 1536, 256) for col in range(0, 1936, 256)]
    assert [k for k, part in enumerate(parts) if read_as(part, MONO).warning is not None] == []


@pytest.mark.parametrize("name", RAW_FRAMES)
def test_real_frames_under_all_orders(real_frames: dict[str, Tensor], name: str) -> None:
    """On every real frame 16 of 24 orders are warned of, and the 8 that obey the identity are not."""
    frame, layout = middle(real_frames[name]), RAW_FRAMES[name]
    warned = [o for o in ORDERS if read_as(frame, order_layout(o, layout.bayer)).warning is not None]
    assert warned == [order for order in ORDERS if order not in LIKE_SONY]


@pytest.mark.parametrize("name", [name for name, layout in RAW_FRAMES.items() if layout is COLOR])
def test_real_color_frames_misread(real_frames: dict[str, Tensor], name: str) -> None:
    """Crops, mirrors and the mono layout are warned of on real colour frames wherever they can be seen."""
    frame = real_frames[name]
    for row, col in OFFSETS:
        check = read_as(frame[row:, col:], COLOR)
        assert (check.warning is None) == (row == col and row % 2 == 0)
        assert COLOR.rolled(-row, -col) in check.fits
    assert read_as(frame.flip(-1), COLOR).warning is not None
    assert read_as(frame.flip(-2), COLOR).warning is not None
    assert read_as(frame, MONO).warning is not None


@pytest.mark.parametrize("name", [name for name, layout in RAW_FRAMES.items() if layout is MONO])
def test_real_mono_frames_misread(real_frames: dict[str, Tensor], name: str) -> None:
    """Real mono frames read as colour are warned of, with the mono layout among the fits."""
    check = read_as(real_frames[name], COLOR)
    assert check.warning is not None and MONO in check.fits
