"""AoLP of light from inside lies along slopes: across them in frames that were transposed or turned by 180 degrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from numpy.typing import NDArray

import polsep
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.layout_check import check_layout
from polsep.sensor.slope_check import lies_across, slope_agreement, turned_across

CAPTURE = Path(polsep.__file__).parent / "data" / "still_life.png"
COLOR = Layout()
TRANSPOSED, TURNED = COLOR.transposed(), COLOR.flipped_horizontal(4).flipped_vertical(4)
Codes = NDArray[np.uint16]


@pytest.fixture(scope="module")
def crop() -> Codes:
    """A part of the demo capture: round coloured objects under one polarized lamp."""
    return np.asarray(imagecodecs.png_decode(CAPTURE.read_bytes()))[512:1536, 600:1800]


def read_as(codes: NDArray[np.generic], layout: Layout) -> Mosaic:
    return Mosaic(np.ascontiguousarray(codes), layout, 0.0, 4095.0)


def blocks(data: NDArray[np.float32], layout: Layout) -> tuple[float, float]:
    """Agreement over blocks of 8 pixels of samples, all usable."""
    rows, cols = (n // 8 for n in data.shape)
    means = data.reshape(rows, 2, 4, cols, 2, 4).mean((1, 4)).transpose(1, 3, 0, 2)
    return slope_agreement(means, np.ones((rows, cols), np.bool_), layout, 8)


def test_a_layout_across_is_the_transposed_one() -> None:
    """Every analyser 90 degrees on: of Sony's order what transposing makes of it; twice, the layout itself."""
    assert turned_across(COLOR) == TRANSPOSED
    for layout in (COLOR, COLOR.rolled(1, 2), Layout(((0, 45), (135, 90)), "GRBG")):
        assert turned_across(turned_across(layout)).table() == layout.table()


def test_frames_and_crops_are_silent_as_they_are(crop: Codes) -> None:
    for rows, cols in ((0, 0), (1, 0), (2, 3), (200, 400)):
        frame = read_as(crop[rows:, cols:], COLOR.rolled(-rows, -cols))
        assert check_layout(frame).warning is None
        assert slope_agreement_is_along(frame)


def slope_agreement_is_along(frame: Mosaic) -> bool:
    """True where the same frame with its analysers turned by 90 degrees is seen: it has something to show."""
    return lies_across(replace(frame, layout=turned_across(frame.layout))) and not lies_across(frame)


@pytest.mark.parametrize(
    ("turn", "own"), [(lambda x: x.T, TRANSPOSED), (lambda x: x[::-1, ::-1], TURNED)], ids=["transposed", "half turn"]
)
def test_transposed_and_turned_crops_are_seen(crop: Codes, turn: Callable[[Codes], Codes], own: Layout) -> None:
    """A colour crop read in the layout it had before: told what to say; then silent."""
    warning = check_layout(read_as(turn(crop), COLOR)).warning
    assert warning is not None and f"--layout {TRANSPOSED.spec} (transposed" in warning and own.spec in warning
    assert check_layout(read_as(turn(crop), own)).warning is None


def test_agreement_changes_its_sign(crop: Codes) -> None:
    """Exactly, when analysers turn by 90 degrees; not at all, when a frame is turned together with its layout."""
    data = crop[:, :1024].astype(np.float32) / 4095
    upright = blocks(data, COLOR)
    assert upright[0] > 0.3 and upright[1] > 10
    assert blocks(data, TRANSPOSED) == pytest.approx((-upright[0], -upright[1]), rel=1e-4)
    for turned, own in (
        (data.T, TRANSPOSED),
        (data[:, ::-1], COLOR.flipped_horizontal(4)),
        (data[::-1], COLOR.flipped_vertical(4)),
        (data[::-1, ::-1], TURNED),
    ):
        assert blocks(turned, own) == pytest.approx(upright, rel=1e-3)


def test_black_levels_are_subtracted(crop: Codes) -> None:
    """A frame above a black level that is said shows what it shows above none."""
    assert slope_agreement_is_along(Mosaic(np.ascontiguousarray(crop + np.uint16(240)), COLOR, 240.0, 4335.0))


@pytest.mark.parametrize("across", [False, True])
def test_slopes_of_shading_polarize_nothing(across: bool) -> None:
    """Steep ramps of colour with a little polarization along or across them are told apart in every direction."""
    y, x = np.mgrid[:256, :256] / 256
    table = COLOR.table()
    color = np.array([0.5, 0.3, 0.15])
    for angle in (0, 45, 90, 135, 20):
        t = np.deg2rad(angle)
        shade = 0.5 + 0.6 * ((x - 0.5) * np.cos(t) - (y - 0.5) * np.sin(t))
        seen = np.array([[[f.angle_deg, color[f.channel]] for f in row] for row in table])
        turned = np.tile(np.deg2rad(seen[..., 0]), (64, 64)) - t - across * np.pi / 2
        data = shade * np.tile(seen[..., 1], (64, 64)) * (1 + 0.002 * np.cos(2 * turned)) / 2
        agreement, _ = blocks(data.astype(np.float32), COLOR)
        assert (-1 if across else 1) * agreement > 0.5, angle


def test_nothing_is_said_without_a_lamp_behind_a_polarizer_or_colour(crop: Codes) -> None:
    """Of a transposed frame with a sixth of the polarization, in grey, in mono, or too small."""
    data = crop.T.astype(np.float32) / 4095
    assert lies_across(Mosaic(data, COLOR, 0.0, 1.0))
    cells = data.reshape(data.shape[0] // 2, 2, data.shape[1] // 2, 2)
    even = np.broadcast_to(cells.mean((1, 3), keepdims=True), cells.shape)
    weak = (even + (cells - even) / 6).reshape(data.shape).astype(np.float32)
    assert not lies_across(Mosaic(weak, COLOR, 0.0, 1.0))
    quad = data.reshape(data.shape[0] // 4, 2, 2, data.shape[1] // 4, 2, 2)
    grey = np.broadcast_to(quad.mean((1, 4), keepdims=True), quad.shape).reshape(data.shape).astype(np.float32)
    assert not lies_across(Mosaic(grey, COLOR, 0.0, 1.0))
    assert not lies_across(Mosaic(data, Layout(bayer=None), 0.0, 1.0))
    assert not lies_across(Mosaic(data[:60, :60], COLOR, 0.0, 1.0))
