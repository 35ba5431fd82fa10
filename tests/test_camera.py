"""The forward sensor: filters sit where the layout says, exposure follows the pixel model, and noise has its law."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerances import ROUNDING, SIGMAS, assert_close, assert_same_angle
from torch import Tensor

from polsep.physics.stokes import (
    Measurements,
    Stokes,
    aolp,
    dolp,
    fit_stokes,
    flip_horizontal,
    flip_vertical,
    measure,
    rotate_quarter,
    transpose,
)
from polsep.sensor.camera import (
    BAYER_ORDERS,
    CLIP_MARGIN,
    IDEAL,
    IMX250,
    Filter,
    Layout,
    Mosaic,
    Sensor,
    add_noise,
    expose,
    measure_with_analysers,
    sample_mosaic,
)
from polsep.sensor.orient import Orientation, orient

COLOR_TABLE = """
R90  R45  G90  G45
R135 R0   G135 G0
G90  G45  B90  B45
G135 G0   B135 B0
"""
#: No two of these angles are mirror images of each other, unlike Sony's.
ODD_ANGLES = (10.0, 47.0, 95.0, 151.0)


def cell(angles: tuple[float, ...]) -> tuple[tuple[float, float], tuple[float, float]]:
    a, b, c, d = angles
    return ((a, b), (c, d))


def layouts(angles: tuple[float, ...] = ODD_ANGLES) -> st.SearchStrategy[Layout]:
    """Every layout that has these four analysers."""
    cells = st.permutations(angles).map(lambda a: cell(tuple(a)))
    origins = st.tuples(st.integers(0, 1), st.integers(0, 1))
    color = st.builds(Layout, cells, st.sampled_from(BAYER_ORDERS), origins)
    return color | st.builds(Layout, cells, st.none())


def random_stokes(height: int, width: int, channels: int = 3, seed: int = 0) -> Stokes:
    """A different state of light in every pixel and colour; no measurement reaches 1."""
    generator = torch.Generator().manual_seed(seed)
    s0, degree, angle = torch.rand(3, channels, height, width, generator=generator, dtype=torch.float64)
    s0, angle = 0.1 + 0.85 * s0, math.pi * angle
    return Stokes(s0, s0 * degree * torch.cos(2 * angle), s0 * degree * torch.sin(2 * angle))


def mosaic_of(stokes: Stokes, layout: Layout) -> Tensor:
    return sample_mosaic(measure(stokes, layout.angles), layout)


# ------------------------------------------------------------------------------------------------------------ layouts


@pytest.mark.parametrize("bayer", [*BAYER_ORDERS, None])
def test_spec_round_trip_of_every_sony_layout(bayer: str | None) -> None:
    """Every order of the four Sony angles, under every Bayer order and origin, is read back from its text."""
    origins = [(0, 0)] if bayer is None else list(itertools.product((0, 1), repeat=2))
    for angles, origin in itertools.product(itertools.permutations((0, 45, 90, 135)), origins):
        layout = Layout(cell(angles), bayer, origin)
        assert Layout.parse(layout.spec) == layout


@given(layout=layouts())
def test_spec_and_table_round_trips(layout: Layout) -> None:
    """A layout is determined by its text; its table of filters determines where each filter sits."""
    assert Layout.parse(layout.spec) == layout
    assert Layout.from_table(layout.table()).table() == layout.table()


def test_spec_round_trip_of_calibrated_angles() -> None:
    """Angles as a calibration measures them are read back exactly too."""
    layout = Layout(((90.0123456, 45.2), (134.98765432, 0.1)))
    assert Layout.parse(layout.spec) == layout


@pytest.mark.parametrize("bayer", ["RGGB", None])
def test_angles_half_a_turn_apart_are_one_layout(bayer: str | None) -> None:
    """An analyser at -45 or 315 degrees is one at 135: the same layout, so the same calibration and turn of a frame."""
    layout = Layout(bayer=bayer)
    for polarizer in (((90, 45), (-45, 0)), ((-90, 225), (135, 180)), ((450, 45), (315, -360))):
        assert Layout(polarizer, bayer) == layout and Layout(polarizer, bayer).spec == layout.spec
        assert orient(Mosaic(torch.zeros(16, 16), Layout(polarizer, bayer), 0, 1), layout) == Orientation(16, 16)


def test_named_layouts() -> None:
    """``color`` and ``mono`` are Sony's colour and monochrome sensors, and the default is colour."""
    assert Layout.parse("color") == Layout.parse("colour") == Layout() == Layout.parse("90,45,135,0/RGGB")
    assert Layout.parse("mono") == Layout(bayer=None) == Layout.parse("90,45,135,0/mono")
    assert (Layout().channels, Layout().period) == (3, 4)
    assert (Layout.parse("mono").channels, Layout.parse("mono").period) == (1, 2)


def test_sony_color_table() -> None:
    """The default layout is the published 4x4 table of the IMX250MYR, repeated over the sensor."""
    lines = [line.split() for line in COLOR_TABLE.strip().splitlines()]
    expected = [[Filter(float(name[1:]), "RGB".index(name[0])) for name in line] for line in lines]
    assert Layout().table() == expected
    for row, col in itertools.product(range(8), range(12)):
        assert Layout().filter_at(row, col) == expected[row % 4][col % 4]


def test_sony_extraction_by_strides() -> None:
    """raw[0::2, 0::2] is 90 degrees, [0::2, 1::2] 45, [1::2, 0::2] 135, [1::2, 1::2] 0, each an RGGB Bayer plane."""
    stokes = random_stokes(8, 8)
    raw, seen = mosaic_of(stokes, Layout()), measure(stokes, Layout().angles).data
    for (row, col), k in {(0, 0): 2, (0, 1): 1, (1, 0): 3, (1, 1): 0}.items():
        plane = raw[row::2, col::2]
        for (y, x), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
            assert torch.equal(plane[y::2, x::2], seen[k, channel, row::2, col::2][y::2, x::2])


@given(layout=layouts())
def test_each_filter_has_its_share(layout: Layout) -> None:
    """Each analyser covers a quarter of the pixels of every colour; green has half of them, red and blue a quarter."""
    table = [f for row in layout.table() for f in row]
    assert layout.angles_deg == tuple(sorted(ODD_ANGLES))
    assert layout.angles == tuple(math.radians(t) for t in sorted(ODD_ANGLES))
    shares = {0: 4, 1: 8, 2: 4} if layout.bayer else {0: 16}
    for angle, (channel, count) in itertools.product(ODD_ANGLES, shares.items()):
        assert table.count(Filter(angle, channel)) == count // 4


WRONG_SPECS = """
sony 90,45,135/RGGB 90,45,135,0 90,45,135,0/ 90,45,135,0,3/RGGB a,b,c,d/RGGB 90,45,135,0/RGB 90,45,135,0/rggb
90,45,135,0/RGGB@ 90,45,135,0/RGGB@1 90,45,135,0/RGGB@2,0 90,45,135,0/RGGB@a,b 90,45,135,0/mono@0,1
90,90,135,0/RGGB 0,45,135,180/RGGB /RGGB ,,,/RGGB
"""


@pytest.mark.parametrize("spec", ["", *WRONG_SPECS.split()])
def test_wrong_specs_are_refused_in_one_line(spec: str) -> None:
    """Text that is no layout raises one line of what was expected or found."""
    with pytest.raises(ValueError, match="expected") as refusal:
        Layout.parse(spec)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("spec", ["nan,45,135,0/RGGB", "90,inf,135,0/mono"])
def test_angles_that_are_no_numbers_are_refused(spec: str) -> None:
    """An analyser angle has to be a finite number."""
    with pytest.raises(ValueError, match="polarizer"):
        Layout.parse(spec)


@pytest.mark.parametrize(
    ("polarizer", "bayer", "origin", "message"),
    [
        (((90, 45),), "RGGB", (0, 0), "expected a polarizer of 2x2 angles"),
        (((90, 45), (135, 0, 30)), "RGGB", (0, 0), "expected a polarizer of 2x2 angles"),
        (((90, 45), (135, 225)), "RGGB", (0, 0), "four different analyser angles"),
        (((90, 45), (135, 0)), "RGBG", (0, 0), "expected bayer RGGB, BGGR, GRBG, GBRG or None"),
        (((90, 45), (135, 0)), ["RGGB"], (0, 0), "expected bayer"),
        (((90, 45), (135, 0)), "RGGB", (0, 2), "expected an origin"),
        (((90, 45), (135, 0)), "RGGB", np.array([0, 2]), "expected an origin"),
        (((90, 45), (135, 0)), "RGGB", 1, "expected an origin"),
        (((90, 45), (135, 0)), None, (1, 0), "origin of a mono layout"),
    ],
)
def test_wrong_layouts_are_refused(
    polarizer: tuple[tuple[float, ...], ...], bayer: str | None, origin: tuple[int, int], message: str
) -> None:
    """Each field of a layout is validated with what was found."""
    with pytest.raises(ValueError, match=message):
        Layout(polarizer, bayer, origin)  # type: ignore[arg-type]


def test_tables_that_are_no_layout_are_refused() -> None:
    """A table with a foreign filter, or a Bayer order that does not exist, belongs to no layout."""
    table = Layout().table()
    table[3][3] = Filter(45.0, 2)
    with pytest.raises(ValueError, match="no layout has this table"):
        Layout.from_table(table)
    quad = [[Filter(f.angle_deg, (row // 2 + col // 2) % 2 * 2) for col, f in enumerate(line)]
            for row, line in enumerate(Layout().table())]  # fmt: skip
    with pytest.raises(ValueError, match="no layout has this table"):
        Layout.from_table(quad)


# ------------------------------------------------------------------------------------------------- layouts that move


@given(layout=layouts(), rows=st.integers(-9, 9), cols=st.integers(-9, 9))
def test_rolled_layout(layout: Layout, rows: int, cols: int) -> None:
    """Rolling the scene under the rolled layout gives the rolled mosaic; rolling back gives the first table."""
    stokes = random_stokes(8, 12, layout.channels)
    shifted = stokes.map(lambda s: s.roll((rows, cols), (-2, -1)))
    moved = layout.rolled(rows, cols)
    assert torch.equal(mosaic_of(shifted, moved), mosaic_of(stokes, layout).roll((rows, cols), (-2, -1)))
    assert moved.rolled(-rows, -cols).table() == layout.table()


@given(layout=layouts(), rows=st.integers(0, 5), cols=st.integers(0, 5))
def test_cropped_layout(layout: Layout, rows: int, cols: int) -> None:
    """A mosaic cropped at any offset has the layout rolled by minus that offset."""
    stokes = random_stokes(10, 11, layout.channels)
    cropped = stokes.map(lambda s: s[..., rows:, cols:])
    assert torch.equal(mosaic_of(cropped, layout.rolled(-rows, -cols)), mosaic_of(stokes, layout)[rows:, cols:])


def to_horizontal(layout: Layout, height: int, width: int) -> Layout:
    return layout.flipped_horizontal(width)


def to_vertical(layout: Layout, height: int, width: int) -> Layout:
    return layout.flipped_vertical(height)


def to_transposed(layout: Layout, height: int, width: int) -> Layout:
    return layout.transposed()


def to_quarter(layout: Layout, height: int, width: int) -> Layout:
    return layout.transposed().flipped_vertical(width)


@pytest.mark.parametrize(
    ("on_stokes", "on_layout", "on_array"),
    [
        (flip_horizontal, to_horizontal, lambda a: a.flip(-1)),
        (flip_vertical, to_vertical, lambda a: a.flip(-2)),
        (transpose, to_transposed, lambda a: a.mT),
        (rotate_quarter, to_quarter, lambda a: torch.rot90(a, 1, (-2, -1))),
    ],
    ids=["flip_horizontal", "flip_vertical", "transpose", "rotate_quarter"],
)
@given(layout=layouts(), height=st.integers(4, 11), width=st.integers(4, 11))
def test_mirrored_and_turned_layouts(
    on_stokes: Callable[[Stokes], Stokes],
    on_layout: Callable[[Layout, int, int], Layout],
    on_array: Callable[[Tensor], Tensor],
    layout: Layout,
    height: int,
    width: int,
) -> None:
    """The mirrored or turned scene under the layout that moved along gives the moved mosaic, at any frame size."""
    stokes = random_stokes(height, width, layout.channels)
    moved = mosaic_of(on_stokes(stokes), on_layout(layout, height, width))
    assert_close(moved, on_array(mosaic_of(stokes, layout)))


@given(layout=layouts(), size=st.integers(4, 11))
def test_mirrors_of_layouts_undo_themselves(layout: Layout, size: int) -> None:
    """A layout mirrored or transposed twice has its first table again."""
    assert layout.flipped_horizontal(size).flipped_horizontal(size).table() == layout.table()
    assert layout.flipped_vertical(size).flipped_vertical(size).table() == layout.table()
    assert layout.transposed().transposed().table() == layout.table()


def test_mirrored_sony_sensor_swaps_45_and_135() -> None:
    """Mirroring a Sony colour frame left-right gives GRBG and swaps the 45 and 135 degree analysers."""
    assert Layout().flipped_horizontal(2448) == Layout(((135, 90), (0, 45)), "GRBG")
    assert Layout().transposed() == Layout(((0, 135), (45, 90)), "RGGB")


# ------------------------------------------------------------------------------------------------------------ mosaics


@pytest.mark.parametrize(
    ("shape", "layout"), [((16,), Layout()), ((3, 8), Layout()), ((8, 3), Layout()), ((1, 2), Layout(bayer=None))]
)
def test_too_small_mosaics_are_refused(shape: tuple[int, ...], layout: Layout) -> None:
    """A frame has to hold one whole period of its layout."""
    with pytest.raises(ValueError, match=f"at least {layout.period}x{layout.period}, found"):
        Mosaic(torch.zeros(shape), layout, 0, 1)


@pytest.mark.parametrize(("black", "white"), [(0, 0), (64, 63), (0, math.nan), (math.nan, 1)])
def test_white_has_to_be_above_black(black: float, white: float) -> None:
    """A white level that is not above the black level is refused."""
    with pytest.raises(ValueError, match="expected a white level above the black level"):
        Mosaic(torch.zeros(4, 4), Layout(), black, white)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.uint16, torch.int32, torch.float16, torch.float32, torch.float64])
def test_linear_maps_black_to_zero_and_white_to_one(dtype: torch.dtype) -> None:
    """Linear values run from 0 at black to 1 at white, below 0 under black, in float32 or float64."""
    data = torch.tensor([[0, 16, 135, 254]] * 4).to(dtype)
    linear = Mosaic(data, Layout(), 16, 254).linear()
    assert linear.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert_close(linear[0], [-16 / 238, 0.0, 0.5, 1.0])


@pytest.mark.parametrize(
    ("white", "first_clipped", "step"),
    [
        (255, 255, 1),  # 8 bits: only full white
        (4095, 4092, 1),  # 12 bits, right-justified: the last four codes
        (65535, 65472, 16),  # 12 bits shifted left into 16: full white is 65520
        (65535, 65472, 64),  # 10 bits shifted left into 16: full white is 65472
        (65535, 65472, 1),
    ],
)
@pytest.mark.parametrize("black", [0, 16])
def test_clip_margin_of_integer_formats(white: int, first_clipped: int, step: int, black: int) -> None:
    """Full white counts as clipped in every packing, and codes more than a 1024th below it do not."""
    codes = torch.arange(0, white + 1, step)[-64:].to(torch.int32)
    clipped = Mosaic(codes.expand(4, -1), Layout(), black, white).clipped()[0]
    assert bool(clipped[-1])
    expected = (codes - black).double() / (white - black) >= 1 - CLIP_MARGIN
    assert torch.equal(clipped, expected)
    if black == 0:
        assert codes[clipped][0].item() == first_clipped


# ----------------------------------------------------------------------------------------------------------- exposure


@pytest.mark.parametrize("sensor", [IDEAL, Sensor(diattenuation=(0.9,)), Sensor(diattenuation=(0.98, 0.95, 0.9))])
@pytest.mark.parametrize("layout", [Layout(), Layout(cell(ODD_ANGLES), "GBRG", (1, 0)), Layout(bayer=None)])
def test_noise_free_exposure_is_the_pixel_model(sensor: Sensor, layout: Layout) -> None:
    """Every pixel holds (s0 + D (s1 cos 2t + s2 sin 2t)) / 2 of its own place, colour, angle and diattenuation."""
    stokes = random_stokes(9, 11)
    mosaic = expose(stokes, layout, sensor)
    assert (mosaic.black_level, mosaic.white_level, mosaic.layout) == (0.0, 1.0, layout)
    for row, col in itertools.product(range(9), range(11)):
        angle, channel = layout.filter_at(row, col)
        d = sensor.diattenuation[channel % len(sensor.diattenuation)]
        s0, s1, s2 = (s[channel, row, col].item() for s in (stokes.s0, stokes.s1, stokes.s2))
        t = math.radians(angle)
        expected = 0.5 * (s0 + d * (s1 * math.cos(2 * t) + s2 * math.sin(2 * t)))
        assert mosaic.data[row, col].item() == pytest.approx(expected, abs=ROUNDING[torch.float64])


@pytest.mark.parametrize("sensor", [IDEAL, Sensor(bits=12), Sensor(bits=8)])
def test_exposure_scales_and_clips(sensor: Sensor) -> None:
    """A brighter exposure multiplies every sample until it clips at white; nothing exceeds white."""
    stokes = random_stokes(8, 8)
    step = 0 if sensor.bits is None else 1 / sensor.white_level
    dark = expose(stokes, Layout(), IDEAL).data
    for factor in (0.25, 1.0, 3.0, 50.0):
        mosaic = expose(stokes * factor, Layout(), sensor)
        expected = (factor * dark).clamp(max=1)
        torch.testing.assert_close(mosaic.linear(), expected, rtol=0, atol=0.5 * step + ROUNDING[torch.float64])
        assert bool(mosaic.clipped()[factor * dark >= 1].all())
        assert not bool(mosaic.clipped()[factor * dark < 1 - CLIP_MARGIN - step].any())


@pytest.mark.parametrize("bits", [1, 8, 10, 12, 16])
def test_quantization(bits: int) -> None:
    """Codes are integers from 0 to 2^bits - 1 that miss the signal by at most half a step."""
    stokes = random_stokes(40, 40)
    mosaic, exact = expose(stokes, Layout(), Sensor(bits=bits)), expose(stokes, Layout(), IDEAL)
    assert mosaic.white_level == 2**bits - 1
    assert torch.equal(mosaic.data, mosaic.data.round())
    assert mosaic.data.min().item() >= 0 and mosaic.data.max().item() <= mosaic.white_level
    error = (mosaic.data / mosaic.white_level - exact.data).abs().max().item()
    assert error <= 0.5 / mosaic.white_level + ROUNDING[torch.float64]


def flat_field(level: float, size: int = 400) -> Stokes:
    """Unpolarized light whose every measurement is ``level``."""
    zeros = torch.zeros(3, size, size)
    return Stokes(zeros + 2 * level, zeros, zeros)


#: Sensors and levels at which neither clipping nor steps wider than the noise distort the statistics.
UNDISTORTED = [
    *[(sensor, level) for sensor in (IMX250, Sensor(10_500.0, 2.4)) for level in (0.02, 0.1, 0.4, 0.9)],
    *[(Sensor(10_500.0, 0.0, 8), level) for level in (0.4, 0.9)],
    *[(Sensor(2000.0, 0.0), level) for level in (0.02, 0.1, 0.4)],
    (Sensor(500.0, 10.0, 8), 0.4),
]


@pytest.mark.parametrize(("sensor", "level"), UNDISTORTED)
def test_noise_statistics(sensor: Sensor, level: float, generator: torch.Generator) -> None:
    """Over a flat field the mean is the signal and the variance shot, read and quantization noise together."""
    variance = sensor.noise_variance(torch.tensor(level, dtype=torch.float64)).item()
    step = 0 if sensor.bits is None else 1 / sensor.white_level
    read = (sensor.read_noise / sensor.full_well) ** 2
    assert variance == pytest.approx(level / sensor.full_well + read + step**2 / 12, rel=1e-9)
    samples = expose(flat_field(level), Layout(), sensor, generator).linear().double().flatten()
    count = samples.numel()
    assert abs(samples.mean().item() - level) < SIGMAS * math.sqrt(variance / count)
    # Poisson noise has excess kurtosis 1 / electrons, which widens the spread of the sample variance.
    spread = math.sqrt((2 + 1 / (level * sensor.full_well)) / count)
    assert abs(samples.var().item() / variance - 1) < SIGMAS * spread


def test_noise_of_neighbours_is_independent(generator: torch.Generator) -> None:
    """Noise is white: neighbouring pixels are uncorrelated."""
    noise = add_noise(torch.full((400, 400), 0.3), IMX250, generator).double() - 0.3
    for a, b in ((noise[1:], noise[:-1]), (noise[:, 1:], noise[:, :-1])):
        correlation = ((a * b).mean() / noise.var()).item()
        assert abs(correlation) < SIGMAS / math.sqrt(a.numel())


def test_dark_noise_is_read_noise(generator: torch.Generator) -> None:
    """Without light read noise alone remains, unclipped before the converter and never negative after it."""
    dark = add_noise(torch.zeros(400, 400), IMX250, generator).double()
    sigma = IMX250.read_noise / IMX250.full_well
    assert abs(dark.mean().item()) < SIGMAS * sigma / 400
    assert abs(dark.var().item() / sigma**2 - 1) < SIGMAS * math.sqrt(2) / 400
    assert expose(flat_field(0.0, 16), Layout(), IMX250, generator).data.min().item() >= 0


def test_noise_is_deterministic() -> None:
    """The same seed gives the same frame, another seed another one, and a perfect sensor needs none."""
    frames = [
        expose(flat_field(0.3, 16), Layout(), IMX250, torch.Generator().manual_seed(seed)).data for seed in (1, 1, 2)
    ]
    assert torch.equal(frames[0], frames[1])
    assert not torch.equal(frames[0], frames[2])
    assert torch.equal(expose(flat_field(0.3, 16), Layout(), IDEAL).data, torch.full((16, 16), 0.3))


@pytest.mark.parametrize("diattenuation", [(1.0,), (0.5,), (0.99, 0.95, 0.9), (0.0, 0.3, 1.0)])
def test_extinction_reduces_dolp(diattenuation: tuple[float, ...]) -> None:
    """Fully polarized light is measured with DoLP D of its colour and unchanged AoLP and s0."""
    angle = torch.linspace(0, 3.1, 12, dtype=torch.float64).view(1, 3, 4).expand(3, 3, 4)
    light = Stokes(torch.ones_like(angle), torch.cos(2 * angle), torch.sin(2 * angle))
    seen = fit_stokes(measure_with_analysers(light, Layout().angles, diattenuation))
    d = torch.tensor(diattenuation, dtype=torch.float64)[:, None, None].expand(3, 3, 4)
    assert_close(dolp(seen), d)
    assert_close(seen.s0, light.s0)
    polarized = d > 0
    assert_same_angle(aolp(seen)[polarized], angle[polarized], 10 * ROUNDING[torch.float64])


def test_batches_are_exposed_frame_by_frame() -> None:
    """A batch of Stokes images gives the batch of their mosaics."""
    first, second = random_stokes(8, 8, seed=1), random_stokes(8, 8, seed=2)
    pairs = zip((first.s0, first.s1, first.s2), (second.s0, second.s1, second.s2), strict=True)
    batch = Stokes(*(torch.stack(pair) for pair in pairs))
    data = expose(batch, Layout(), IMX250_WITHOUT_NOISE).data
    for frame, stokes in zip(data, (first, second), strict=True):
        assert torch.equal(frame, expose(stokes, Layout(), IMX250_WITHOUT_NOISE).data)


IMX250_WITHOUT_NOISE = Sensor(bits=IMX250.bits, diattenuation=IMX250.diattenuation)


@given(layout=layouts())
def test_sampling_is_undone_by_looking_up_each_filter(layout: Layout) -> None:
    """Under uniform light the four samples of a colour give back its Stokes vector."""
    stokes = random_stokes(1, 1, layout.channels).map(lambda s: s.expand(-1, 8, 8))
    raw = expose(stokes, layout, IDEAL).data
    for channel in range(layout.channels):
        samples = []
        for angle in layout.angles_deg:
            places = itertools.product(range(8), range(8))
            row, col = next(p for p in places if layout.filter_at(*p) == Filter(angle, channel))
            samples.append(raw[row, col])
        fitted = fit_stokes(Measurements(torch.stack(samples).view(4, 1, 1, 1), layout.angles))
        for actual, expected in zip((fitted.s0, fitted.s1, fitted.s2), (stokes.s0, stokes.s1, stokes.s2), strict=True):
            assert_close(actual.flatten(), expected[channel, 0, :1], scale=10)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"full_well": 0.0}, "expected a positive full_well"),
        ({"full_well": math.nan}, "expected a positive full_well"),
        ({"read_noise": -1.0}, "read_noise of at least 0"),
        ({"diattenuation": (1.1,)}, "expected one or three"),
        ({"diattenuation": (0.9, -0.1, 0.9)}, "expected one or three"),
    ],
)
def test_impossible_sensors_are_refused(options: dict[str, float], message: str) -> None:
    """Sensor constants outside their range are refused."""
    with pytest.raises(ValueError, match=message):
        Sensor(**options)  # type: ignore[arg-type]


def test_imx250_constants() -> None:
    """The sensor's diattenuations are those of extinction ratios 150, 300 and 425."""
    expected = tuple((ratio - 1) / (ratio + 1) for ratio in (150, 300, 425))
    assert_close(torch.tensor(IMX250.diattenuation, dtype=torch.float64), expected)
    assert (IMX250.full_well, IMX250.read_noise, IMX250.white_level) == (10_500, 2.4, 4095)
