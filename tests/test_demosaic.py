"""Laws of the demosaickers: exact where interpolation can be, co-registered, equivariant, honest about clipping."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from polsep.demosaic.bilinear import bilinear_variance, demosaic_bilinear, demosaic_bilinear_half, demosaic_dave2022
from polsep.physics.stokes import (
    Measurements,
    Stokes,
    fit_stokes,
    flip_horizontal,
    flip_vertical,
    measure,
    polarized_intensity,
    transpose,
)
from polsep.sensor.camera import BAYER_ORDERS, IDEAL, Layout, Mosaic, expose, sample_mosaic

SONY = ((90, 45), (135, 0))
OTHER = ((0, 45), (90, 135))
COLOR_LAYOUTS = [Layout(SONY, bayer) for bayer in BAYER_ORDERS]
ORIGINS = [Layout(SONY, "GRBG", origin) for origin in ((0, 1), (1, 0), (1, 1))]
LAYOUTS = [*COLOR_LAYOUTS, Layout(OTHER, "RGGB"), *ORIGINS, Layout(SONY, None), Layout(OTHER, None)]
DEMOSAICKERS = [demosaic_bilinear, demosaic_bilinear_half, demosaic_dave2022]
BOTH = [demosaic_bilinear, demosaic_bilinear_half]
EXACT = 1e-12  # float64, a handful of additions

Demosaicker = Callable[[Mosaic], Measurements]


def spec(layout: Layout) -> str:
    return layout.spec


def random_mosaic(layout: Layout, *shape: int, seed: int = 0) -> Mosaic:
    """Independent samples in [0, 0.9], float64: no interpolation can guess them."""
    data = 0.9 * torch.rand(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return Mosaic(data, layout, 0.0, 1.0)


def ramp(layout: Layout, height: int, width: int, polarized: float) -> Stokes:
    """Linear ramps of each component and colour at the pixel centres (row, col), in float64."""
    rows, cols = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    offsets = torch.tensor([0.5, 0.6, 0.7], dtype=torch.float64)[: layout.channels, None, None]
    slopes = torch.tensor([1.0, -0.6, 0.4], dtype=torch.float64)[: layout.channels, None, None]
    s0 = offsets + 0.004 * slopes * cols + 0.003 * rows
    s1 = polarized * (0.1 * offsets + 0.002 * cols - 0.001 * slopes * rows)
    s2 = polarized * (0.05 - 0.001 * slopes * cols + 0.002 * rows)
    return Stokes(s0, s1, s2)


def at_pixels(stokes: Stokes, layout: Layout) -> Mosaic:
    return expose(stokes, layout, IDEAL)


def cell_mean(x: Tensor) -> Tensor:
    """Mean over 2x2 pixels."""
    height, width = x.shape[-2:]
    return x.reshape(*x.shape[:-2], height // 2, 2, width // 2, 2).mean(dim=(-3, -1))


def largest(x: Tensor) -> float:
    return float(x.abs().max())


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_uniform_field_is_exact_to_the_border(layout: Layout, demosaic: Demosaicker) -> None:
    """A uniform polarized field comes out as it is at every pixel, for every layout, size, and resolution."""
    levels = torch.tensor([0.9, 0.7, 0.5], dtype=torch.float64)[: layout.channels, None, None]
    for height, width in ((6, 6), (8, 12), (13, 10)):
        field = Stokes(levels, 0.3 * levels, -0.4 * levels).map(lambda s, h=height, w=width: s.expand(-1, h, w))
        truth = measure(field, layout.angles).data[..., :1, :1]
        found = demosaic(at_pixels(field, layout))
        assert found.angles == layout.angles
        assert largest(found.data - truth) < EXACT
        assert found.clipped is None


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_half_resolution_is_the_cell_mean_of_full(layout: Layout) -> None:
    """Half resolution is the mean of the full-resolution result over each 2x2 polarizer cell."""
    mosaic = random_mosaic(layout, 3, 22, 26)
    half, full = demosaic_bilinear_half(mosaic), demosaic_bilinear(mosaic)
    assert half.data.shape[-2] == (22 - layout.origin[0]) // 2
    assert half.data.shape[-1] == (26 - layout.origin[1]) // 2
    assert largest(half.data - cell_mean(full.data)) < EXACT


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_linear_ramps_are_exact_inside(layout: Layout) -> None:
    """A field linear in position is reconstructed exactly, at the right place, away from the border."""
    stokes = ramp(layout, 28, 32, polarized=1.0)
    row, col = layout.origin
    inside = measure(stokes, layout.angles).data[..., row:, col:]
    inside = inside[..., : inside.shape[-2] // 2 * 2, : inside.shape[-1] // 2 * 2]
    full = demosaic_bilinear(at_pixels(stokes, layout)).data
    half = demosaic_bilinear_half(at_pixels(stokes, layout)).data
    assert largest((full - inside)[..., 4:-4, 4:-4]) < EXACT
    assert largest((half - cell_mean(inside))[..., 2:-2, 2:-2]) < EXACT


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_only_the_regrouping_polarizes_an_unpolarized_ramp(layout: Layout) -> None:
    """An unpolarized ramp stays unpolarized when co-registered; the paper's regrouping gives it a false DoLP."""
    mosaic = at_pixels(ramp(layout, 28, 32, polarized=0.0), layout)
    for demosaic in BOTH:
        found = polarized_intensity(fit_stokes(demosaic(mosaic)))
        assert largest(found[..., 4:-4, 4:-4]) < EXACT
    false = polarized_intensity(fit_stokes(demosaic_dave2022(mosaic)))[..., 4:-4, 4:-4]
    assert float(false.min()) > 5e-4


@pytest.mark.parametrize("layout", LAYOUTS, ids=spec)
def test_measured_samples_stay(layout: Layout) -> None:
    """sample_mosaic(demosaic_bilinear(mosaic)) is the mosaic from its first whole cell on: no sample is changed."""
    mosaic = random_mosaic(layout, 2, 21, 25)
    found = demosaic_bilinear(mosaic)
    row, col = layout.origin
    height, width = found.data.shape[-2:]
    again = sample_mosaic(found, Layout(layout.polarizer, layout.bayer))
    assert largest(again - mosaic.data[..., row : row + height, col : col + width]) == 0


@pytest.mark.parametrize(("rows", "cols"), list(itertools.product(range(4), range(4))))
@pytest.mark.parametrize("bayer", ["RGGB", "GBRG", None])
def test_cropping_changes_the_layout_only(rows: int, cols: int, bayer: str | None) -> None:
    """A crop by any offset, read with `Layout.rolled`, gives the crop of the result; at half resolution too if the
    cells stay the same."""
    layout = Layout(SONY, bayer)
    mosaic = random_mosaic(layout, 24, 28)
    cropped = Mosaic(mosaic.data[rows:, cols:], layout.rolled(-rows, -cols), 0.0, 1.0)
    row, col = (rows + cropped.layout.origin[0], cols + cropped.layout.origin[1])
    full, part = demosaic_bilinear(mosaic).data, demosaic_bilinear(cropped).data
    height, width = part.shape[-2:]
    same = full[..., row : row + height, col : col + width]
    assert largest((part - same)[..., 4:-4, 4:-4]) < EXACT
    if row % 2 or col % 2:
        return
    full, part = demosaic_bilinear_half(mosaic).data, demosaic_bilinear_half(cropped).data
    height, width = part.shape[-2:]
    same = full[..., row // 2 : row // 2 + height, col // 2 : col // 2 + width]
    assert largest((part - same)[..., 2:-2, 2:-2]) < EXACT


@pytest.mark.parametrize(("rows", "cols"), [(2, 0), (0, 2), (2, 2), (4, 2)])
@pytest.mark.parametrize("demosaic", BOTH)
def test_rolling_by_cells_changes_the_layout_only(rows: int, cols: int, demosaic: Demosaicker) -> None:
    """Rolling the mosaic by whole cells, under the rolled layout, rolls the result (inside, away from the seam)."""
    layout = Layout(OTHER, "BGGR")
    mosaic = random_mosaic(layout, 24, 24)
    rolled = Mosaic(mosaic.data.roll((rows, cols), (0, 1)), layout.rolled(rows, cols), 0.0, 1.0)
    one, two = demosaic(mosaic).data, demosaic(rolled).data
    scale = 24 // one.shape[-1]
    moved = one.roll((rows // scale, cols // scale), (-2, -1))
    edge = 8 // scale
    assert largest((two - moved)[..., edge:-edge, edge:-edge]) < EXACT


FLIPS = [
    ("left-right", lambda x: x.flip(-1), lambda lay, h, w: lay.flipped_horizontal(w), flip_horizontal),
    ("top-bottom", lambda x: x.flip(-2), lambda lay, h, w: lay.flipped_vertical(h), flip_vertical),
    ("transposed", lambda x: x.mT, lambda lay, h, w: lay.transposed(), transpose),
]


@pytest.mark.parametrize(("turn_data", "turn_layout", "turn_stokes"), [f[1:] for f in FLIPS], ids=[f[0] for f in FLIPS])
@pytest.mark.parametrize("demosaic", BOTH)
@pytest.mark.parametrize("layout", [lay for lay in LAYOUTS if lay.origin == (0, 0)], ids=spec)
def test_mirrored_frames_give_mirrored_stokes_images(
    layout: Layout,
    demosaic: Demosaicker,
    turn_data: Callable[[Tensor], Tensor],
    turn_layout: Callable[[Layout, int, int], Layout],
    turn_stokes: Callable[[Stokes], Stokes],
) -> None:
    """Flips and transposition commute with demosaicking to the border, with the sign rules of s1 and s2."""
    mosaic = random_mosaic(layout, 18, 20)
    turned = Mosaic(turn_data(mosaic.data), turn_layout(layout, 18, 20), 0.0, 1.0)
    expected, found = turn_stokes(fit_stokes(demosaic(mosaic))), fit_stokes(demosaic(turned))
    for name in ("s0", "s1", "s2"):
        assert largest(getattr(found, name) - getattr(expected, name)) < EXACT


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
def test_demosaicking_is_linear_in_exposure_and_light(demosaic: Demosaicker) -> None:
    """Twice the exposure is twice the result, light adds, and black level and codes are only a change of unit."""
    one, two = random_mosaic(Layout(), 16, 20, seed=1), random_mosaic(Layout(), 16, 20, seed=2)
    a, b = demosaic(one).data, demosaic(two).data
    mixed = demosaic(Mosaic(0.25 * one.data + 0.5 * two.data, Layout(), 0.0, 1.0)).data
    assert largest(mixed - 0.25 * a - 0.5 * b) < EXACT
    codes = demosaic(Mosaic(64 + 4031 * one.data, Layout(), 64.0, 4095.0)).data
    assert largest(codes - a) < EXACT


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
@pytest.mark.parametrize("layout", [Layout(), Layout(SONY, "GBRG", (1, 0)), Layout(SONY, None)], ids=spec)
def test_clip_mask_marks_what_clipped_samples_contribute_to(layout: Layout, demosaic: Demosaicker) -> None:
    """The mask is True exactly where the result changes when the clipped samples change."""
    mosaic = random_mosaic(layout, 15, 18)
    for seed in range(4):
        picks = torch.rand(15, 18, generator=torch.Generator().manual_seed(seed)) < 0.02
        clipped = demosaic(Mosaic(torch.where(picks, 1.0, mosaic.data), layout, 0.0, 1.0))
        brighter = demosaic(Mosaic(torch.where(picks, 1.5, mosaic.data), layout, 0.0, 1.0))
        assert clipped.clipped is not None and clipped.clipped.any() and not clipped.clipped.all()
        assert torch.equal(clipped.clipped, (brighter.data - clipped.data).abs() > 1e-9)


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
@pytest.mark.parametrize("layout", [Layout(), Layout(SONY, None)], ids=spec)
def test_frames_of_a_batch_are_independent(layout: Layout, demosaic: Demosaicker) -> None:
    """[2, 3, H, W] gives what each of its six frames gives alone, clip mask and variance included."""
    data = random_mosaic(layout, 2, 3, 12, 14).data * 1.2
    together = demosaic(Mosaic(data, layout, 0.0, 1.0))
    assert together.clipped is not None and together.variance is not None
    for i, j in itertools.product(range(2), range(3)):
        alone = demosaic(Mosaic(data[i, j], layout, 0.0, 1.0))
        assert largest(together.data[i, j] - alone.data) < EXACT
        assert alone.clipped is not None and torch.equal(together.clipped[i, j], alone.clipped)
        assert alone.variance is not None and largest(together.variance[i, j] - alone.variance) < EXACT


@pytest.mark.parametrize(("height", "width"), [(4, 4), (4, 7), (5, 4), (6, 9), (7, 7)])
@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
def test_small_and_odd_sizes(height: int, width: int, demosaic: Demosaicker) -> None:
    """From one period on, every size works; an odd last row or column is left out, and nothing else changes."""
    scale = 1 if demosaic is demosaic_bilinear else 2
    for layout in (Layout(), Layout(SONY, None)):
        mosaic = random_mosaic(layout, height, width)
        found = demosaic(mosaic)
        assert found.data.shape == (4, layout.channels, height // 2 * 2 // scale, width // 2 * 2 // scale)
        even = demosaic(Mosaic(mosaic.data[: height // 2 * 2, : width // 2 * 2], layout, 0.0, 1.0))
        assert torch.equal(found.data, even.data)


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
def test_too_few_pixels_after_the_origin_are_refused(demosaic: Demosaicker) -> None:
    """A colour frame that holds less than one Bayer block from its origin on is refused in words."""
    with pytest.raises(ValueError, match="at least"):
        demosaic(random_mosaic(Layout(SONY, "RGGB", (1, 1)), 4, 4))


@pytest.mark.parametrize("demosaic", DEMOSAICKERS)
def test_smallest_mono_frame(demosaic: Demosaicker) -> None:
    """A 2x2 mono frame is one cell: its four samples are the four measurements."""
    layout = Layout(SONY, None)
    found = demosaic(Mosaic(torch.tensor([[0.1, 0.2], [0.3, 0.4]]), layout, 0.0, 1.0)).data
    assert found.shape[-2:] == ((2, 2) if demosaic is demosaic_bilinear else (1, 1))
    assert largest(found - torch.tensor([0.4, 0.2, 0.1, 0.3]).view(4, 1, 1, 1)) < 1e-7


def bayer_plane_by_scipy(plane: np.ndarray, bayer: str) -> np.ndarray:
    """RGB ``[h, w, 3]`` of one Bayer plane: normalized convolution by SciPy, mirrored about the outermost sample."""
    kernel = np.outer((0.5, 1, 0.5), (0.5, 1, 0.5))
    colors = np.array(list(bayer)).reshape(2, 2)
    tiled = np.tile(colors, (plane.shape[0] // 2 + 1, plane.shape[1] // 2 + 1))[: plane.shape[0], : plane.shape[1]]
    out = np.empty((*plane.shape, 3))
    for k, color in enumerate("RGB"):
        here = tiled == color
        weights = np.where(np.add.outer([1, 0, 1], [1, 0, 1]) == 2, 0, kernel) if color == "G" else kernel
        total = ndimage.convolve(np.where(here, plane, 0), weights, mode="mirror")
        out[..., k] = total / ndimage.convolve(here.astype(float), weights, mode="mirror")
    return out


def full_by_scipy(mosaic: np.ndarray, layout: Layout) -> np.ndarray:
    """``[4, 3, H, W]``: each analyser's plane by the function above, interpolated by SciPy at all pixels.

    The pixel beyond a plane's outermost sample lies on the mirror between that sample and its image: it takes its
    value.
    """
    height, width = mosaic.shape
    assert layout.bayer is not None
    images = []
    for angle in layout.angles_deg:
        places = itertools.product((0, 1), (0, 1))
        row, col = next((r, c) for r, c in places if layout.polarizer[r][c] == angle)
        colors = bayer_plane_by_scipy(mosaic[row::2, col::2], layout.bayer)
        rows = np.clip((np.arange(height) - row) / 2, 0, height // 2 - 1)
        cols = np.clip((np.arange(width) - col) / 2, 0, width // 2 - 1)
        grid = np.meshgrid(rows, cols, indexing="ij")
        images.append([ndimage.map_coordinates(colors[..., k], grid, order=1, mode="nearest") for k in range(3)])
    return np.array(images)


@pytest.mark.parametrize("layout", [*COLOR_LAYOUTS, Layout(OTHER, "RGGB")], ids=spec)
def test_agrees_with_an_independent_convolution(layout: Layout) -> None:
    """The result is that of a slow reference made of SciPy's convolution and interpolation, border included."""
    mosaic = random_mosaic(layout, 16, 22)
    expected = torch.from_numpy(full_by_scipy(mosaic.data.numpy(), layout))
    assert largest(demosaic_bilinear(mosaic).data - expected) < EXACT


def test_interpolation_variance_is_that_of_missing_detail() -> None:
    """The expected interpolation error is zero on linear ramps, scales with exposure squared, and grows with detail."""
    flat = demosaic_bilinear(at_pixels(ramp(Layout(), 32, 32, polarized=1.0), Layout())).data
    assert largest(bilinear_variance(flat)[..., 6:-6, 6:-6]) < EXACT
    rough = demosaic_bilinear(random_mosaic(Layout(), 32, 32)).data
    variance = bilinear_variance(rough)
    assert variance.shape == (1, 32, 32) and float(variance.min()) > 0
    assert largest(bilinear_variance(3 * rough) - 9 * variance) < EXACT


def test_the_paper_regrouping_takes_the_planes_as_they_are() -> None:
    """demosaic_dave2022 on mono data is the four planes of the mosaic, unshifted, sorted by angle."""
    mosaic = random_mosaic(Layout(SONY, None), 8, 10)
    planes = [mosaic.data[1::2, 1::2], mosaic.data[0::2, 1::2], mosaic.data[0::2, 0::2], mosaic.data[1::2, 0::2]]
    found = demosaic_dave2022(mosaic)
    assert torch.equal(found.data, torch.stack(planes)[:, None])
    assert [math.degrees(t) for t in found.angles] == [0, 45, 90, 135]
