"""Frames in any mirrored, turned or cropped order become Sony's, sample by sample, and images come back as they lie."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from polsep.demosaic.bilinear import aligned, demosaic_bilinear, demosaic_bilinear_half, mean_cells
from polsep.physics.stokes import Stokes, fit_stokes
from polsep.sensor.camera import IDEAL, PERIOD, Layout, Mosaic, expose
from polsep.sensor.orient import Orientation, orient, shifts_of

SONY, MONO = Layout(), Layout(bayer=None)
#: An order whose transposed one no mirror and no crop gives, as they give Sony's.
OTHER = Layout(((0, 45), (90, 135)), "GRBG")
SIZES = [(16, 18), (15, 21)]
EXACT = 1e-12  # float64, a handful of additions
#: Samples from the border that depend on how a demosaicker continues a frame.
EDGE = 4


def orders(wanted: Layout, height: int, width: int) -> list[Layout]:
    """Every layout that a frame of this size may have which is the wanted one mirrored, transposed or cropped."""
    found = []
    for transposed, down, across in itertools.product((False, True), repeat=3):
        turned = wanted.transposed() if transposed else wanted
        turned = turned.flipped_vertical(height) if down else turned
        turned = turned.flipped_horizontal(width) if across else turned
        found += [turned.rolled(-row, -col) for row, col in itertools.product(range(PERIOD), repeat=2)]
    return list(dict.fromkeys(found))


CASES = [(wanted, size) for wanted in (SONY, MONO) for size in SIZES] + [(OTHER, SIZES[0])]


def case_name(value: object) -> str:
    return value.spec if isinstance(value, Layout) else str(value)


def zeros(layout: Layout, height: int, width: int) -> Mosaic:
    return Mosaic(torch.zeros(height, width, dtype=torch.float64), layout, 0.0, 1.0)


def random_mosaic(layout: Layout, height: int, width: int) -> Mosaic:
    data = 0.9 * torch.rand(2, height, width, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    return Mosaic(data, layout, 0.0, 1.0)


def uniform(layout: Layout, height: int, width: int) -> Stokes:
    """A field of which every filter of a layout lets another level through."""
    s0 = torch.tensor([1.0, 0.7, 0.4], dtype=torch.float64)[: layout.channels, None, None]
    return Stokes(s0, 0.31 * s0, -0.17 * s0).map(lambda s: s.expand(-1, height, width))


def turn_light(stokes: Stokes, how: Orientation, height: int, width: int) -> Stokes:
    """A uniform field as it looks in the turned frame: a mirror changes the sign of s2, a transposition that of s1."""
    signs = (1, -1 if how.transposed else 1, -1 if how.down != how.across else 1)
    parts = (sign * s[..., :1, :1] for sign, s in zip(signs, (stokes.s0, stokes.s1, stokes.s2), strict=True))
    return Stokes(*parts).map(lambda s: s.expand(-1, height, width))


def every_way(mosaic: Mosaic, wanted: Layout) -> tuple[Orientation, ...]:
    """`orient` and `shifts_of`, which are of one size; of colour frames, red and blue change places in the second."""
    shifts = shifts_of(mosaic, wanted)
    assert [shift.swapped for shift in shifts] == ([False] * 4 if wanted is MONO else [False, True])
    assert len({shift.turn(mosaic.data).shape for shift in shifts}) == 1
    return orient(mosaic, wanted), *shifts


def apart(a: Stokes, b: Stokes, edge: int) -> float:
    inside = (..., slice(edge, -edge), slice(edge, -edge))
    assert a.s0.shape == b.s0.shape
    return max(float((x - y)[inside].abs().max()) for x, y in ((a.s0, b.s0), (a.s1, b.s1), (a.s2, b.s2)))


def test_there_are_as_many_orders_as_symmetries_leave() -> None:
    """Turned by 180 degrees Sony's cell is transposed, so mirrors and crops do; in general transposing adds as many."""
    assert len(orders(MONO, 16, 16)) == 8
    for wanted, transposes in ((SONY, False), (OTHER, True)):
        layouts = orders(wanted, 16, 16)
        assert len(layouts) == 64 * (1 + transposes)
        assert any(orient(zeros(layout, 16, 16), wanted).transposed for layout in layouts) == transposes


@pytest.mark.parametrize(("wanted", "size"), CASES, ids=case_name)
def test_the_turned_frame_has_the_wanted_filter_at_every_place(wanted: Layout, size: tuple[int, int]) -> None:
    """A uniform polarized field, of which each filter shows its own level, is the same field in the wanted order."""
    for layout in orders(wanted, *size):
        mosaic = expose(uniform(layout, *size), layout, IDEAL)
        for how in every_way(mosaic, wanted):
            turned = how.turn(mosaic.data)
            assert turned.shape[-2] % PERIOD == turned.shape[-1] % PERIOD == 0
            light = turn_light(uniform(layout, *size), how, *turned.shape[-2:])
            light = light.map(lambda s: s.flip(-3)) if how.swapped else light
            expected = expose(light, wanted, IDEAL).data
            assert len(expected.unique()) == 4 * wanted.channels
            assert float((turned - expected).abs().max()) < EXACT


@pytest.mark.parametrize(("wanted", "size"), CASES, ids=case_name)
def test_whole_cells_come_back_where_they_were(wanted: Layout, size: tuple[int, int]) -> None:
    """`demosaic.aligned` of every pixel's number at full resolution, and the means of its cells at half."""
    numbers = torch.arange(size[0] * size[1], dtype=torch.float64).view(size)
    for layout in orders(wanted, *size):
        for how in every_way(zeros(layout, *size), wanted):
            turned = how.turn(torch.stack([numbers, -numbers]))
            assert torch.equal(how.turn_back(turned, 2), aligned(torch.stack([numbers, -numbers]), layout))
            if how.keeps_cells:
                assert torch.equal(how.turn_back(mean_cells(turned), 1)[0], mean_cells(aligned(numbers, layout)))


@pytest.mark.parametrize(("wanted", "size"), CASES, ids=case_name)
def test_demosaicking_commutes_with_turning(wanted: Layout, size: tuple[int, int]) -> None:
    """Stokes images of the turned mosaic, turned back with the sign rules, are those of the mosaic, border apart."""
    for layout in orders(wanted, *size):
        mosaic = random_mosaic(layout, *size)
        how = orient(mosaic, wanted)
        turned = Mosaic(how.turn(mosaic.data), wanted, 0.0, 1.0)
        full = how.turn_back_stokes(fit_stokes(demosaic_bilinear(turned)), 2)
        assert apart(full, fit_stokes(demosaic_bilinear(mosaic)), EDGE) < EXACT
        half = how.turn_back_stokes(fit_stokes(demosaic_bilinear_half(turned)), 1)
        expected = fit_stokes(demosaic_bilinear_half(mosaic))
        assert half.s0.shape == expected.s0.shape
        if how.keeps_cells:
            assert apart(half, expected, EDGE // 2) < EXACT
        assert apart(full.map(mean_cells), expected, EDGE // 2) < EXACT


def test_cells_half_a_cell_apart_come_back_as_means_of_neighbours() -> None:
    """Exact on ramps, so nothing is moved; masks hold where one of the neighbours does."""
    rows, cols = torch.meshgrid(torch.arange(16.0).double(), torch.arange(20.0).double(), indexing="ij")
    ramp = 0.3 * rows + 0.7 * cols
    shifted = 0
    for layout in orders(MONO, 16, 20):
        how = orient(zeros(layout, 16, 20), MONO)
        found = how.turn_back(mean_cells(how.turn(ramp)), 1)
        assert float((found - mean_cells(ramp))[1:-1, 1:-1].abs().max()) < EXACT
        marked = how.turn_back(mean_cells(how.turn(ramp)) > 8, 1)
        assert marked.dtype == torch.bool
        assert not bool((~marked & (mean_cells(ramp) > 8))[1:-1, 1:-1].any())
        shifted += not how.keeps_cells
    assert shifted == 4


@pytest.mark.parametrize("size", SIZES, ids=case_name)
def test_cells_are_kept_wherever_an_orientation_keeps_them(size: tuple[int, int]) -> None:
    """Always in colour; mono frames that are only mirrored need no crop by one sample."""
    assert all(orient(zeros(layout, *size), SONY).keeps_cells for layout in orders(SONY, *size))
    for layout in (MONO, MONO.transposed(), MONO.flipped_vertical(16), MONO.flipped_horizontal(20)):
        assert orient(zeros(layout, *size), MONO).keeps_cells


@pytest.mark.parametrize("wanted", [SONY, MONO], ids=case_name)
def test_frames_in_the_wanted_order_stay_as_they_are(wanted: Layout) -> None:
    mosaic = random_mosaic(wanted, 12, 16)
    how = orient(mosaic, wanted)
    assert how == Orientation(12, 16)
    assert torch.equal(how.turn(mosaic.data), mosaic.data)
    assert torch.equal(how.turn_back(mosaic.data, 2), mosaic.data)


@pytest.mark.parametrize("wanted", [SONY, MONO], ids=case_name)
def test_continued_samples_lie_behind_their_own_filters(wanted: Layout) -> None:
    """From the smallest frames on: each added sample is one of the frame whose place differs by whole periods."""
    for count, size in itertools.product((2, 3, 4, 5, 7), (4, 7)):
        for layout in orders(wanted, count, size)[::3]:
            start = [wanted.period + o for o in layout.origin]
            if count < start[0] or size < start[1]:
                continue
            how = orient(zeros(layout, count, size), wanted)
            numbers = torch.arange(count * size).view(count, size)
            filters = torch.tensor([[place(layout, row, col) for col in range(size)] for row in range(count)])
            turned, seen = how.turn(numbers), how.turn(filters)
            assert set(turned.unique().tolist()) == set(range(count * size))
            assert torch.equal(seen, periodic(seen, wanted.period))


def place(layout: Layout, row: int, col: int) -> int:
    """A number of its own for every filter of a layout."""
    angle_deg, channel = layout.filter_at(row, col)
    return 4 * channel + layout.angles_deg.index(angle_deg)


def periodic(image: Tensor, period: int) -> Tensor:
    """The first period of an image, repeated."""
    rows, cols = image.shape
    return image[:period, :period].repeat(rows // period, cols // period)


@pytest.mark.parametrize(
    ("layout", "wanted"),
    [
        (Layout(((0, 45), (90, 135))), SONY),
        (Layout(((0, 30), (60, 90))), SONY),
        (Layout(((0, 45), (90, 135)), None), MONO),
        (MONO, SONY),
        (SONY, MONO),
    ],
    ids=case_name,
)
def test_other_orders_are_refused_in_one_line(layout: Layout, wanted: Layout) -> None:
    with pytest.raises(ValueError, match="expected filters") as refused:
        orient(zeros(layout, 8, 8), wanted)
    said = str(refused.value)
    assert wanted.spec in said and f"found {layout.spec}" in said
    assert "\n" not in said
