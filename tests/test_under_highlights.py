"""Diffuse light under clipped highlights: filled from around where bodies are even, kept where they are textured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polsep.pipeline import separate_capture
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.highlights_kernel import solve_laplace
from polsep.separation.images import FrameImages, Tally
from polsep.separation.under_highlights import SPOILED, fill_under_highlights

SIZE, WHITE = 64, 4095.0
LIGHT = (0.5, 1.0, 0.7)
#: Cells with a clipped sample: a highlight, and a single one.
CORE, SINGLE = (slice(10, 15), slice(12, 16)), (20, 25)


def mosaic(scale_cells: int = SIZE // 2) -> Mosaic:
    """A dark frame whose clipped samples lie in `CORE` and `SINGLE`."""
    data = np.full((2 * scale_cells, 2 * scale_cells), 100, np.uint16)
    data[2 * CORE[0].start : 2 * CORE[0].stop : 2, 2 * CORE[1].start : 2 * CORE[1].stop : 2] = 4095
    data[2 * SINGLE[0] + 1, 2 * SINGLE[1] + 1] = 4095
    return Mosaic(data, Layout(), 0.0, WHITE)


def slope(scale: int) -> NDArray[np.float64]:
    """A diffuse image that is a plane in each colour, under white light: what fills its holes exactly."""
    n = SIZE // 2 * scale
    rows, cols = np.mgrid[:n, :n] / n
    return np.stack([0.3 + 0.2 * rows, 0.2 + 0.1 * cols, 0.4 - 0.1 * rows - 0.2 * cols], axis=-1)


def holes(scale: int) -> NDArray[np.bool_]:
    """Pixels within `SPOILED` cells of a clipped one."""
    mask = np.zeros((SIZE // 2, SIZE // 2), np.bool_)
    for rows, cols in ((CORE[0], CORE[1]), (slice(SINGLE[0], SINGLE[0] + 1), slice(SINGLE[1], SINGLE[1] + 1))):
        mask[rows.start - SPOILED : rows.stop + SPOILED, cols.start - SPOILED : cols.stop + SPOILED] = True
    return mask.repeat(scale, 0).repeat(scale, 1)


def guessed(truth: NDArray[np.float64], scale: int, error: float = 0.1) -> FrameImages:
    """Images of a method that finds 0.1 too much in holes, and expects an error there; in `LIGHT`."""
    image = (truth + 0.1 * holes(scale)[..., None]) * LIGHT
    expected = np.where(holes(scale), error, 0.001) * np.mean(LIGHT)
    return FrameImages(
        image.astype(np.float32),
        np.zeros_like(image, np.float32),
        ~holes(scale),
        tally=Tally(diffuse_variance=float((error**2) * holes(scale).sum())),
        error=np.stack([expected, expected], axis=-1).astype(np.float32),
    )


@pytest.mark.parametrize("scale", [1, 2])
def test_even_bodies_go_on_under_their_highlights(scale: int) -> None:
    """A plane is harmonic: its holes are filled exactly, at half and full resolution, and nothing else changes."""
    truth, before = slope(scale), guessed(slope(scale), scale)
    filled, share = fill_under_highlights(guessed(truth, scale), mosaic(), LIGHT)
    np.testing.assert_allclose(filled.diffuse / np.array(LIGHT), truth, rtol=0, atol=1e-3)
    outside = ~holes(scale)
    assert np.array_equal(filled.diffuse[outside], before.diffuse[outside])
    assert filled.error is not None and before.error is not None and filled.tally is not None
    assert np.array_equal(filled.error[outside], before.error[outside])
    assert np.array_equal(filled.error[..., 1], before.error[..., 1]) and np.array_equal(filled.valid, before.valid)
    assert np.array_equal(filled.specular, before.specular)
    assert 0.95 * holes(scale).mean() < share <= holes(scale).mean()
    assert (filled.error[holes(scale)][:, 0] < 0.2 * before.error[holes(scale)][:, 0]).all()
    assert (
        filled.tally.diffuse_variance is not None and filled.tally.diffuse_variance < 0.05 * 0.01 * holes(scale).sum()
    )
    change = (filled.diffuse.astype(np.float64) - before.diffuse) / np.array(LIGHT)
    assert filled.tally.s0 == pytest.approx(change.mean(axis=-1).sum(), rel=1e-4)


@pytest.mark.parametrize("scale", [1, 2])
def test_bent_bodies_go_on_under_their_highlights(scale: int) -> None:
    """What is harmonic and no plane is filled exactly too, where a method knows nothing of its holes."""
    rows, cols = np.mgrid[: SIZE // 2 * scale, : SIZE // 2 * scale] / scale - 12.5
    truth = slope(scale) + 1e-3 * (rows**2 - cols**2 + rows * cols)[..., None] + 0.5
    filled, _ = fill_under_highlights(guessed(truth, scale, error=10.0), mosaic(), LIGHT)
    np.testing.assert_allclose(filled.diffuse / np.array(LIGHT), truth, rtol=0, atol=1e-3)


def test_who_expects_no_error_keeps_its_image() -> None:
    """A guess that is expected to be exact outweighs what is around."""
    truth = slope(1)
    filled, share = fill_under_highlights(guessed(truth, 1, error=1e-6), mosaic(), LIGHT)
    assert np.array_equal(filled.diffuse, guessed(truth, 1, error=1e-6).diffuse) and share < 1e-6


def test_strong_texture_is_kept() -> None:
    """Around a checkerboard nothing says what is in a hole."""
    board = np.where(np.indices((SIZE // 2, SIZE // 2)).sum(0)[..., None] % 2, 0.1, 0.9) * np.ones(3)
    filled, share = fill_under_highlights(guessed(board, 1), mosaic(), LIGHT)
    assert np.array_equal(filled.diffuse, guessed(board, 1).diffuse) and share == 0


def test_colors_have_their_own_texture() -> None:
    """A body that varies in red alone is filled in green and blue, and hardly in red."""
    truth = slope(1)
    truth[..., 0] += 0.1 * (np.indices((SIZE // 2, SIZE // 2)).sum(0) % 2 - 0.5)
    filled, _ = fill_under_highlights(guessed(truth, 1), mosaic(), LIGHT)
    rest = np.abs(filled.diffuse / np.array(LIGHT) - truth)[holes(1)].mean(axis=0)
    assert (rest[1:] < 0.02).all() and rest[0] > 0.03


def test_without_clipping_nothing_is_touched() -> None:
    """Frames that do not clip, methods that expect no errors, and frames that clip all over stay as they are."""
    images = guessed(slope(1), 1)
    dark = Mosaic(np.full((SIZE, SIZE), 100, np.uint16), Layout(), 0.0, WHITE)
    bright = replace(dark, data=np.full((SIZE, SIZE), 4095, np.uint16))
    for frame, seen in ((dark, images), (mosaic(), replace(images, error=None)), (bright, images)):
        found, share = fill_under_highlights(seen, frame, LIGHT)
        assert found is seen and share == 0
    assert np.array_equal(images.diffuse, guessed(slope(1), 1).diffuse)


@pytest.mark.parametrize("turn", [np.flipud, np.fliplr, np.transpose])
def test_orientation_does_not_matter(turn: object) -> None:
    """Holes at the border and elsewhere, with texture around, are filled alike in flipped or transposed frames."""
    assert callable(turn)
    texture = 0.05 * np.random.default_rng(3).random((SIZE // 2, SIZE // 2, 3))
    frame, images = mosaic(), guessed(slope(1) ** 2 + texture, 1)
    data = frame.data.copy()
    data[0, :32:2] = 4095
    turned = replace(images, **{n: np.ascontiguousarray(_turn(turn, x)) for n, x in images.arrays().items()})
    one, share = fill_under_highlights(images, replace(frame, data=data), LIGHT)
    two, other = fill_under_highlights(turned, replace(frame, data=np.ascontiguousarray(turn(data))), LIGHT)
    np.testing.assert_allclose(_turn(turn, one.diffuse), two.diffuse, rtol=0, atol=1e-3)
    assert share == pytest.approx(other, abs=1e-4) and share > 0


def _turn(turn: object, image: NDArray[np.float32]) -> NDArray[np.float32]:
    assert callable(turn)
    planes = [turn(plane) for plane in (np.moveaxis(image, -1, 0) if image.ndim == 3 else [image])]
    return np.stack(planes, axis=-1) if image.ndim == 3 else planes[0]


def test_tensors_give_the_same() -> None:
    """Images as torch tensors, as on a GPU, are filled as arrays are."""
    one, share = fill_under_highlights(guessed(slope(2), 2), mosaic(), LIGHT)
    images, frame = guessed(slope(2), 2), mosaic()
    tensors = replace(images, **{name: torch.from_numpy(image) for name, image in images.arrays().items()})
    data = torch.from_numpy(frame.data.astype(np.float32))
    two, other = fill_under_highlights(tensors, replace(frame, data=data), LIGHT)
    assert np.array_equal(one.diffuse, np.asarray(two.diffuse)) and share == other


def test_bright_bodies_are_no_highlights() -> None:
    """Where all analysers clip alike, or nearly so, nothing of a highlight is seen, and the guess stays."""
    frame = mosaic()
    data = frame.data.copy()
    rows, cols = (slice(2 * s.start, 2 * s.stop) for s in CORE)
    data[rows, cols] = 4095
    data[2 * SINGLE[0] : 2 * SINGLE[0] + 2, 2 * SINGLE[1] : 2 * SINGLE[1] + 2] = [[4000, 4050], [4020, 4095]]
    images = guessed(slope(1), 1)
    found, share = fill_under_highlights(images, replace(frame, data=data), LIGHT)
    assert np.array_equal(found.diffuse, guessed(slope(1), 1).diffuse) and share == 0


def test_reports_say_how_much_was_filled() -> None:
    """An even grey sheet with a polarized highlight: the report names the share of its image that was filled."""
    data = np.full((128, 128), 1200, np.uint16)
    rows, cols = np.mgrid[:128, :128]
    highlight = 4000 * np.exp(-((rows - 64) ** 2 + (cols - 64) ** 2) / 50)
    polarized = np.tile([[0.5, 0.15], [0.85, 0.5]], (64, 64))  # Malus' law for light at 30 degrees, about
    data = np.minimum(data + highlight * polarized, 4095).astype(np.uint16)
    out = separate_capture(Mosaic(data, Layout(bayer=None), 0.0, WHITE), "joint", "white")
    assert 0 < out.report["filled_under_highlights"] < 0.05


@pytest.mark.parametrize("method", ["joint-fast", "joint-large"])
def test_statistics_know_of_the_fill(method: str) -> None:
    """The report's rms of expected errors is that of the map, also where holes were filled; of one network or two."""
    data = np.full((128, 128), 1200, np.uint16)
    rows, cols = np.mgrid[:128, :128]
    highlight = 4000 * np.exp(-((rows - 64) ** 2 + (cols - 64) ** 2) / 50)
    data = np.minimum(data + highlight * np.tile([[0.5, 0.15], [0.85, 0.5]], (64, 64)), 4095).astype(np.uint16)
    out = separate_capture(Mosaic(data, Layout(), 0.0, WHITE), method, LIGHT)
    assert out.report["statistics"]["valid_fraction"] == pytest.approx(out.valid.mean())
    assert out.error is not None and out.report["filled_under_highlights"] > 0
    typical = float(np.sqrt(np.square(out.error[..., 0], dtype=np.float64).mean())) / np.mean(LIGHT)
    assert out.report["statistics"]["expected_diffuse_error"] == pytest.approx(typical, rel=1e-4)


@pytest.mark.parametrize("colors", [1, 3])
def test_laplace_is_solved(colors: int) -> None:
    """A square hole in a harmonic image, x^2 - y^2 plus a plane, is filled with it."""
    y, x = np.mgrid[:13, :13].astype(np.float64)
    image = ((x**2 - y**2) / 50 + 0.1 * x - 0.05 * y + 4)[..., None] * np.arange(1, colors + 1)
    inside = np.zeros((13, 13), np.bool_)
    inside[1:-1, 1:-1] = True
    rows, cols = np.nonzero(inside)
    number = np.full((13, 13), len(rows), np.uint32)
    number[inside] = np.arange(len(rows))
    steps = ((0, 1), (0, -1), (1, 0), (-1, 0))
    links = np.stack([number[rows + i, cols + j] for i, j in steps])
    known = sum(np.where(inside[..., None], 0, image)[rows + i, cols + j] for i, j in steps)
    found = solve_laplace(links, np.full(len(rows), 4.0), known, np.zeros((len(rows), colors)), (1e-10, 200))
    np.testing.assert_allclose(found, image[inside], rtol=1e-8)
