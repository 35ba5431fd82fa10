"""The forward sensor: from light on the pixels to the samples of a raw frame.

`Layout` gives the analyser and colour filter of each pixel, `Sensor` its noise, clipping and converter, and `Mosaic` is
one raw frame. `demosaic` is the inverse of this module.

Conventions: rows grow downward. A layout's polarizer angles are in DEGREES, as printed in camera manuals, because
they are data that people type; everything computed from them is in radians. Sony's IMX250MZR/MYR and relatives have

    90  45        colour sensors repeat this 2x2 cell inside        R90  R45  G90  G45
    135  0        each pixel of a 2x2 Bayer block (RGGB):           R135 R0   G135 G0
                                                                    G90  G45  B90  B45
                                                                    G135 G0   B135 B0
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Real
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from array_api_compat import device

from polsep.compute.arguments import WrongType, require_whole
from polsep.compute.arrays import Array, as_floats, constant, namespace, short_repr
from polsep.compute.resizing import repeat_pixels, resize_bilinear
from polsep.physics.stokes import Measurements, Stokes, diattenuation
from polsep.sensor.mosaic_fields import require_degree, require_gains, require_samples

if TYPE_CHECKING:
    import torch

BAYER_ORDERS = ("RGGB", "BGGR", "GRBG", "GBRG")

#: A sample within this fraction of the white level counts as clipped: 12-bit data shifted left into 16 bits stops
#: at 65520 of 65535, and 10-bit data at 65472; 8-bit data are only clipped at 255.
CLIP_MARGIN = 2.0**-10

#: Pixels after which the filters of every sensor repeat, along both axes; those of mono ones after 2 already.
PERIOD = 4

#: Analysers that are closer than this [degrees] are one: no Stokes vector follows from their difference.
MIN_APART_DEG = 0.1

Cell = tuple[tuple[float, float], tuple[float, float]]


class Filter(NamedTuple):
    """The filters on one pixel: the analyser angle [degrees] and the colour channel (0, 1, 2; 0 on mono sensors)."""

    angle_deg: float
    channel: int


@dataclass(frozen=True)
class Layout:
    """Order of the filters on a mosaic; data, never a global.

    ``polarizer``: 2x2 analyser angles in degrees, four different ones, kept in [0, 180): -45 is 135. ``bayer``: the
    colours of a 2x2 block of such cells in reading order, or None for mono sensors. ``origin``: row and column (0 or
    1) of the first whole cell, for colour frames cropped at an odd offset. Raises ValueError on anything else.
    """

    polarizer: Cell = ((90, 45), (135, 0))
    bayer: str | None = "RGGB"
    origin: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        try:
            (a, b), (c, d) = self.polarizer
            kept = [float(angle) % 180 for angle in (a, b, c, d)]
            if math.isnan(sum(kept)):  # of infinite ones, too
                raise ValueError
        except (TypeError, ValueError):
            raise ValueError(f"expected a polarizer of 2x2 angles in degrees, found {self.polarizer!r}") from None
        around = sorted(kept)
        if min(b - a for a, b in pairwise([*around, around[0] + 180])) < MIN_APART_DEG:
            raise ValueError(f"expected four different analyser angles (modulo 180 degrees), found {self.polarizer!r}")
        object.__setattr__(self, "polarizer", ((kept[0], kept[1]), (kept[2], kept[3])))
        if self.bayer is not None and not (isinstance(self.bayer, str) and self.bayer in BAYER_ORDERS):
            raise ValueError(f"expected bayer {', '.join(BAYER_ORDERS)} or None, found {self.bayer!r}")
        origin = tuple(self.origin) if isinstance(self.origin, Sequence | np.ndarray) else ()
        if origin not in ((0, 0), (0, 1), (1, 0), (1, 1)):
            raise ValueError(f"expected an origin of two numbers, each 0 or 1, found {self.origin!r}")
        object.__setattr__(self, "origin", (int(origin[0]), int(origin[1])))
        if self.bayer is None and self.origin != (0, 0):
            raise ValueError(f"expected (0, 0) as the origin of a mono layout: permute its cell, found {self.origin}")

    @classmethod
    def sony(cls, channels: int) -> Layout:
        """Sony's order for sensors of 3 colours, or 1 (mono)."""
        return cls(bayer=None if channels == 1 else "RGGB")

    @classmethod
    def parse(cls, spec: str) -> Layout:
        """A layout from ``color``, ``mono`` or ``"90,45,135,0/RGGB"``: angles in reading order, Bayer order or mono."""
        if not isinstance(spec, str):
            raise WrongType(f"expected a layout as text, found {type(spec).__name__}")
        if spec in ("color", "colour"):
            return cls()
        if spec == "mono":
            return cls(bayer=None)
        expected = f'expected "color", "mono" or angles and colours like "90,45,135,0/RGGB", found {spec!r}'
        angles, slash, colors = spec.partition("/")
        colors, at, offset = colors.partition("@")
        try:
            a, b, c, d = (float(angle) for angle in angles.split(","))
            row, col = (int(o) for o in offset.split(",")) if at else (0, 0)
        except ValueError:
            raise ValueError(expected) from None
        if not slash or not colors:
            raise ValueError(expected)
        return cls(((a, b), (c, d)), None if colors == "mono" else colors, (row, col))

    @property
    def spec(self) -> str:
        """The text that `parse` reads back."""
        angles = ",".join(repr(float(angle)).removesuffix(".0") for row in self.polarizer for angle in row)
        offset = f"@{self.origin[0]},{self.origin[1]}" if self.origin != (0, 0) else ""
        return f"{angles}/{self.bayer or 'mono'}{offset}"

    @property
    def channels(self) -> int:
        """3 for colour sensors, 1 for mono."""
        return 1 if self.bayer is None else 3

    @property
    def period(self) -> int:
        """Pixels after which the filters repeat in both directions: 4 for colour, 2 for mono."""
        return 2 if self.bayer is None else PERIOD

    @property
    def angles_deg(self) -> tuple[float, ...]:
        """The four analyser angles in degrees, sorted (0, 45, 90, 135 for Sony): the order of `Measurements`."""
        return tuple(sorted(float(angle) for row in self.polarizer for angle in row))

    @property
    def angles(self) -> tuple[float, ...]:
        """`angles_deg` in radians."""
        return tuple(math.radians(angle) for angle in self.angles_deg)

    def filter_at(self, row: int, col: int) -> Filter:
        """The filter on pixel (row, col) of the mosaic."""
        require_whole("a row or column", row, col)
        row, col = row - self.origin[0], col - self.origin[1]
        angle = float(self.polarizer[row % 2][col % 2])
        if self.bayer is None:
            return Filter(angle, 0)
        return Filter(angle, "RGB".index(self.bayer[row // 2 % 2 * 2 + col // 2 % 2]))

    def cells(self, shape: tuple[int, ...]) -> tuple[int, int]:
        """Rows and columns of the whole 2x2 polarizer cells in frames ``[..., H, W]`` of that shape."""
        height, width = ((n - start) // 2 for n, start in zip(shape[-2:], self.origin, strict=True))
        return height, width

    def table(self) -> list[list[Filter]]:
        """One 4x4 period of filters."""
        return [[self.filter_at(row, col) for col in range(PERIOD)] for row in range(PERIOD)]

    @classmethod
    def from_table(cls, table: list[list[Filter]]) -> Layout:
        """The layout whose 4x4 `table` is given; ValueError when no layout has it."""
        mono = len({f.channel for row in table for f in row}) == 1
        for origin in [(0, 0)] if mono else [(0, 0), (0, 1), (1, 0), (1, 1)]:
            at = [[table[(row + origin[0]) % 4][(col + origin[1]) % 4] for col in range(4)] for row in range(4)]
            cell = ((at[0][0].angle_deg, at[0][1].angle_deg), (at[1][0].angle_deg, at[1][1].angle_deg))
            order = "".join("RGB"[at[row][col].channel] for row in (0, 2) for col in (0, 2))
            if mono or order in BAYER_ORDERS:
                layout = cls(cell, None if mono else order, origin)
                if layout.table() == table:
                    return layout
        raise ValueError("no layout has this table of filters")

    def rolled(self, rows: int, cols: int) -> Layout:
        """The layout of a mosaic rolled by (rows, cols) pixels, or cropped by (-rows, -cols)."""
        require_whole("rows or columns", rows, cols)
        t = self.table()
        return Layout.from_table([[t[(row - rows) % 4][(col - cols) % 4] for col in range(4)] for row in range(4)])

    def flipped_horizontal(self, width: int) -> Layout:
        """The layout of the left-right mirrored frame of that width: columns reverse and angles change sign."""
        require_whole("a width", width)
        t = [[Filter(-f.angle_deg % 180, f.channel) for f in row] for row in self.table()]
        return Layout.from_table([[t[row][(width - 1 - col) % 4] for col in range(4)] for row in range(4)])

    def flipped_vertical(self, height: int) -> Layout:
        """The layout of the top-bottom mirrored frame of that height: rows reverse and angles change sign."""
        require_whole("a height", height)
        t = [[Filter(-f.angle_deg % 180, f.channel) for f in row] for row in self.table()]
        return Layout.from_table([t[(height - 1 - row) % 4] for row in range(4)])

    def transposed(self) -> Layout:
        """The layout of the transposed frame: rows and columns swap and an angle t becomes 90 degrees - t."""
        t = self.table()
        turned = [[Filter((90 - f.angle_deg) % 180, f.channel) for f in row] for row in t]
        return Layout.from_table([[turned[col][row] for col in range(4)] for row in range(4)])


def require_layout(layout: object) -> None:
    """Raise WrongType unless ``layout`` is a `Layout`."""
    if not isinstance(layout, Layout):
        raise WrongType(f"expected a Layout (Layout.parse reads text), found {layout!r:.40}")


def check_frame(shape: tuple[int, ...], layout: Layout, black_level: float, white_level: float) -> None:
    """Raise ValueError when white is not above black or a frame ``[..., H, W]`` is smaller than one period.

    Of text as layout and of levels that are no numbers, it is a `WrongType`.
    """
    require_layout(layout)
    if not (isinstance(black_level, Real) and isinstance(white_level, Real)):
        raise WrongType(f"expected levels that are numbers, found black {black_level!r:.40}, white {white_level!r:.40}")
    rows, cols = (layout.period + start for start in layout.origin)
    if len(shape) < 2 or shape[-2] < rows or shape[-1] < cols:
        raise ValueError(f"expected a mosaic [..., H, W] of at least {rows}x{cols}, found {shape}")
    if not (white_level > black_level and math.isfinite(white_level - black_level)):
        raise ValueError(f"expected a white level above the black level, found {white_level} and {black_level}")


def clip_level(black_level: float, white_level: float) -> float:
    """The least sample that counts as clipped, in the unit of the samples; see `CLIP_MARGIN`."""
    return black_level + (1 - CLIP_MARGIN) * (white_level - black_level)


@dataclass(frozen=True, eq=False, repr=False)
class Mosaic:
    """One raw frame (or a batch): linear sensor values ``data [..., H, W]`` with what is needed to read them.

    ``black_level`` and ``white_level`` are in the units of ``data``. Samples within `CLIP_MARGIN` of the white level
    count as clipped. ``light_color``: one gain per channel that `linear` divides out, so that what follows sees white
    light. ``falloff``: the smooth part of a calibrated sensor's flat frame (`falloff.falloff_image`), by which
    separated images are divided. ``less_ambient``: another frame was subtracted, and noise goes far below black.
    ``lamp_measured``: ``light_color`` is that of a calibrated lamp, also where it is white. ``lamp_dolp``: degree of
    polarization of the lamp where that is known.
    Raises ValueError when white is not above black, the frame is smaller than one period or the degree is not from
    `mosaic_fields.MIN_LAMP_DOLP` to 1; of samples that are no whole numbers or floats, it is a `WrongType`.
    """

    data: Array
    layout: Layout
    black_level: float
    white_level: float
    light_color: tuple[float, ...] = (1.0, 1.0, 1.0)
    falloff: tuple[tuple[float, ...], ...] | None = None
    less_ambient: bool = False
    lamp_measured: bool = False
    lamp_dolp: float | None = None

    __repr__ = short_repr

    def __post_init__(self) -> None:
        require_samples(self.data)
        check_frame(tuple(self.data.shape), self.layout, self.black_level, self.white_level)
        require_gains(self.light_color, self.layout.channels)
        require_degree(self.lamp_dolp)

    @property
    def clip_level(self) -> float:
        """The least sample of ``data`` that counts as clipped."""
        return clip_level(self.black_level, self.white_level)

    def linear(self) -> Array:
        """Samples with black at 0 and white at 1, under white light; float32 (float64 for float64 data)."""
        samples = self._samples()
        if all(gain == 1 for gain in self.light_color):
            return samples
        period = self.layout.period
        for row in range(period):
            for col in range(period):
                channel = self.layout.filter_at(row, col).channel
                samples[..., row::period, col::period] /= float(self.light_color[channel])
        return samples

    def _samples(self) -> Array:
        samples = as_floats(self.data) - float(self.black_level)
        samples /= float(self.white_level - self.black_level)
        return samples

    def clipped(self) -> Array:
        """Mask ``[..., H, W]`` of samples that only bound the light from below."""
        return self._samples() >= 1 - CLIP_MARGIN


#: A raw frame, or co-sited samples.
Capture = Mosaic | Measurements


def first_frame(mosaic: Mosaic) -> Array:
    """Samples ``[H, W]`` of the first frame of a batch, or of the only one."""
    return mosaic.data.reshape(-1, *mosaic.data.shape[-2:])[0]


@dataclass(frozen=True)
class Sensor:
    """Properties of a pixel. Signals are fractions of ``full_well``, which maps to the white level.

    ``full_well``: electrons at the white level (inf: no shot noise). ``read_noise``: electrons rms.
    ``bits``: depth of the converter, None for none. ``diattenuation``: D = (ER - 1) / (ER + 1) of the analysers for
    extinction ratio ER, one value or one per colour. Source of `IMX250`: docs/conventions.md, sensor constants.
    """

    full_well: float = math.inf
    read_noise: float = 0.0
    bits: int | None = None
    diattenuation: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if not (self.full_well > 0 and self.read_noise >= 0):
            raise ValueError(f"expected a positive full_well and a read_noise of at least 0, found {self}")
        if self.bits is not None and self.bits < 1:
            raise ValueError(f"expected at least 1 bit, found {self.bits}")
        if len(self.diattenuation) not in (1, 3) or not all(0 <= d <= 1 for d in self.diattenuation):
            raise ValueError(f"expected one or three diattenuations in [0, 1], found {self.diattenuation}")

    @property
    def white_level(self) -> float:
        """Largest code: 2^bits - 1, or 1.0 without a converter."""
        return 1.0 if self.bits is None else 2.0**self.bits - 1

    def noise_variance(self, signal: Array) -> Array:
        """Variance of one unclipped sample of mean ``signal`` (white = 1): shot, read and quantization noise."""
        shot = signal.clip(0.0, None) / self.full_well
        read = (self.read_noise / self.full_well) ** 2
        step = 0.0 if self.bits is None else 1 / self.white_level
        return shot + read + step**2 / 12


#: Sony IMX250MYR as published by third parties: full well 10.5 ke-, 2.4 e- read noise, 12 bits, extinction ratios of
#: about 150 (R), 300 (G) and 425 (B). No data sheet was found; see docs/conventions.md.
IMX250 = Sensor(10_500.0, 2.4, 12, tuple(map(diattenuation, (150, 300, 425))))

#: A perfect sensor that still clips at 1.
IDEAL = Sensor()


def sample_mosaic(measurements: Measurements, layout: Layout) -> Array:
    """The mosaic ``[..., H, W]`` of angle images ``[..., 4, C, H, W]``: of each pixel the sample behind its filter.

    The twin of every demosaicker. Channels beyond the layout's colours are ignored. Raises ValueError when the
    measurements lack an analyser of the layout.
    """
    data, period, numbers = measurements.data, layout.period, _analyser_numbers(measurements, layout)
    out = namespace(data).empty((*data.shape[:-4], *data.shape[-2:]), dtype=data.dtype, device=device(data))
    for row in range(period):
        for col in range(period):
            angle, channel = layout.filter_at(row, col)
            out[..., row::period, col::period] = data[..., numbers[angle], channel, row::period, col::period]
    return out


def _analyser_numbers(measurements: Measurements, layout: Layout) -> dict[float, int]:
    """The place of each analyser of a layout among those of measurements, by its angle [degrees].

    Raises ValueError when the measurements lack one.
    """
    degrees = [round(math.degrees(t), 6) for t in measurements.angles]
    if not {round(angle, 6) for angle in layout.angles_deg} <= set(degrees):
        raise ValueError(f"expected measurements at {layout.angles_deg} degrees, found {degrees}")
    return {angle: degrees.index(round(angle, 6)) for angle in layout.angles_deg}


def sample_fine_mosaic(measurements: Measurements, layout: Layout) -> Mosaic:
    """The frame ``[..., 2H, 2W]`` that a sensor of ``layout`` with pixels half as large would take of co-sited samples.

    For methods that read mosaics: their images at half resolution are those of ``[H, W]``. Light between the samples is
    interpolated linearly; pixels in clipped samples clip. Raises ValueError when the measurements lack an analyser.
    """
    xp, data, clipped = namespace(measurements.data), measurements.data, measurements.clipped
    height, width = (2 * n for n in data.shape[-2:])
    out = xp.empty((*data.shape[:-4], height, width), dtype=data.dtype, device=device(data))
    period, filters = layout.period, dict[Filter, list[tuple[int, int]]]()
    for row in range(period):
        for col in range(period):
            filters.setdefault(layout.filter_at(row, col), []).append((row, col))
    numbers = _analyser_numbers(measurements, layout)
    for (angle, channel), places in filters.items():
        k = numbers[angle]
        fine = resize_bilinear(data[..., k, channel, :, :], (height, width))
        if clipped is not None:
            mask = repeat_pixels(clipped[..., k, channel, :, :], 2)
            fine = xp.where(mask, fine.clip(1, None), fine.clip(None, 1 - 2 * CLIP_MARGIN))
        for row, col in places:
            out[..., row::period, col::period] = fine[..., row::period, col::period]
    return Mosaic(out, layout, 0.0, 1.0)


def measure_with_analysers(stokes: Stokes, angles: tuple[float, ...], diattenuation: tuple[float, ...]) -> Measurements:
    """`stokes.measure` behind real analysers: m = (s0 + D (s1 cos 2t + s2 sin 2t)) / 2 with D per colour.

    Of three values a mono image takes the middle one, the green's.
    """
    if stokes.s0.shape[-3] == 1:
        diattenuation = diattenuation[len(diattenuation) // 2 :][:1]
    d = constant(diattenuation, stokes.s0)[:, None, None]
    data = [0.5 * (stokes.s0 + d * (stokes.s1 * math.cos(2 * t) + stokes.s2 * math.sin(2 * t))) for t in angles]
    return Measurements(namespace(stokes.s0).stack(data, axis=-4), angles)


def expose(stokes: Stokes, layout: Layout, sensor: Sensor, generator: torch.Generator | None = None) -> Mosaic:
    """One raw frame of the Stokes image ``[..., C, H, W]`` that lies on the sensor, at raw resolution.

    In physical order: analyser and colour filter of each pixel, Poisson shot noise, Gaussian read noise, clipping at
    the full well (Eq. 13), quantization. Float data in [0, 1] without a converter, else integer codes as float32.
    Deterministic for a given ``generator``; none is needed for a noise-free sensor.
    """
    signal = sample_mosaic(measure_with_analysers(stokes, layout.angles, sensor.diattenuation), layout)
    return digitize(add_noise(signal, sensor, generator), layout, sensor)


def digitize(signal: Array, layout: Layout, sensor: Sensor) -> Mosaic:
    """Noisy signals ``[..., H, W]``, of which 1 fills the well, as the converter says them: clipped, in whole codes."""
    codes = signal.clip(0.0, 1.0)
    if sensor.bits is not None:
        codes = namespace(codes).round(codes * sensor.white_level)
    return Mosaic(codes, layout, 0.0, sensor.white_level)


def add_noise(signal: Array, sensor: Sensor, generator: torch.Generator | None) -> Array:
    """Shot and read noise of ``sensor`` on a signal in units of the white level; neither clipped nor quantized.

    Noise needs a tensor: torch draws it.
    """
    if math.isinf(sensor.full_well):
        return signal
    import torch

    electrons = torch.poisson(signal.clamp(min=0) * sensor.full_well, generator=generator)
    if sensor.read_noise:
        noise = torch.empty_like(electrons).normal_(generator=generator)
        electrons = electrons + sensor.read_noise * noise
    return electrons / sensor.full_well
