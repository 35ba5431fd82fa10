"""A sensor as it was measured, and raw frames corrected by it.

`polsep calibrate` measures, `Calibration` holds, `correct_mosaic` applies: the black pattern is subtracted, gains are
divided out, known dead pixels repaired, and the samples of real analysers mapped to those of ideal ones. The result is
a float32 mosaic with the white level of the frame, which every method reads.

* A sample that clipped before counts as clipped afterwards: below the white level, it is set to that. Where a gain is
  below 1, samples just under the white level reach it; they count as clipped too, with their right value.
* The smooth part of a flat frame (vignetting, an uneven diffuser) is not divided out of the samples, or their noise and
  clip level would differ over the frame. `Mosaic.falloff` carries it, and separated images are divided by it.
* Corrections that are not in the calibration change no bit.

Model of a sample without noise, t its analyser's angle and D = (ER - 1) / (ER + 1) for the extinction ratio ER:

    code = black + falloff gain_map gain (s0 + D (s1 cos 2t + s2 sin 2t)) / 2 (white - black_level)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from numbers import Real
from operator import index
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arguments import WrongType
from polsep.compute.arrays import of_kind, to_numpy
from polsep.physics.stokes import diattenuation
from polsep.sensor.camera import Layout, Mosaic, clip_level, require_layout
from polsep.sensor.defects import MIN_SIZE, repair
from polsep.sensor.falloff import Table
from polsep.sensor.levels import MOST_FLOAT, WHITE_LEVELS
from polsep.sensor.plausible import require_plausible

Floats = NDArray[np.float32]
#: A black level that is stated may differ from the measured one by rounding to whole codes.
ROUNDED_LEVEL = 0.51


class Analyser(NamedTuple):
    """The analyser on one place of the period; ``gain``: for unpolarized light, 1 in the mean of a colour."""

    angle_deg: float
    extinction: float
    gain: float

    @property
    def vector(self) -> tuple[float, float, float]:
        """Factors of s0, s1, s2 in a sample."""
        d, t = diattenuation(self.extinction), 2 * math.radians(self.angle_deg)
        return 0.5 * self.gain, 0.5 * self.gain * d * math.cos(t), 0.5 * self.gain * d * math.sin(t)


class LampFacts(NamedTuple):
    """Camera RGB of the lamp, green = 1, its degree of linear polarization and the angle of its polarizer or AoLP."""

    color: tuple[float, float, float]
    dolp: float | None
    aolp_deg: float | None


@dataclass(frozen=True, eq=False)
class Calibration:
    """Measured properties of a sensor and a lamp, each None where it was not measured.

    Levels are in codes of ``white_level``. ``black_map``: code without light of each pixel ``[H, W]``;
    ``black_pattern``: its mean on each place of the period, less ``black_level``. ``gain_map [H, W]``: of each pixel,
    without the ``falloff``, which is a polynomial (`falloff_image`); ``gains``: its mean on each place. ``hot``,
    ``dead``: indices of defective pixels in reading order, of dark and of flat frames. ``details``: what each
    measurement found, for people, JSON-able. Arrays are kept as copies that cannot be changed: files that were read,
    and what is prepared of maps, are remembered. Raises ValueError on what no sensor has, by which corrected frames
    would hold NaN; of wrong types it is a `WrongType`.
    """

    layout: Layout
    white_level: float
    size: tuple[int, int] | None = None
    black_level: float | None = None
    black_pattern: Table | None = None
    black_map: Floats | None = None
    read_noise: float | None = None
    gains: Table | None = None
    gain_map: Floats | None = None
    falloff: Table | None = None
    dead: NDArray[np.int32] | None = None
    analysers: tuple[tuple[Analyser, ...], ...] | None = None
    lamp: LampFacts | None = None
    details: Mapping[str, Any] = field(default_factory=dict)
    hot: NDArray[np.int32] | None = None

    def __post_init__(self) -> None:
        require_layout(self.layout)
        for name, (convert, wanted) in _KINDS.items():
            value = getattr(self, name)
            if value is not None or name == "white_level":
                try:
                    object.__setattr__(self, name, convert(value))
                except (TypeError, ValueError):
                    raise WrongType(f"expected {name} as {wanted}, found {value!r:.40}") from None
        require_plausible(self)

    @property
    def defects(self) -> NDArray[np.int32]:
        """Indices of all defective pixels."""
        known = [pixels for pixels in (self.hot, self.dead) if pixels is not None]
        return np.unique(np.concatenate(known)).astype(np.int32) if known else np.zeros(0, np.int32)

    def require_black_level(self, stated: float, name: str) -> None:
        """Raise ValueError on a stated black level that is not the measured one; ``name``: of its option."""
        if not isinstance(stated, Real):
            raise WrongType(f"expected a black level that is a number, found {stated!r:.40}")
        if stated and self.black_level is not None and abs(stated - self.black_level) > ROUNDED_LEVEL:
            measured = f"{self.black_level:.4g}, which a calibration of the dark measured"
            raise ValueError(f"expected no {name} but {measured}, found {name} {stated:g}")

    def white_level_of(self, array: NDArray[Any]) -> float | None:
        """The calibrated white level for raw frames that do not say theirs; None where their type cannot hold it.

        Nor is the white of floats that of integers.
        """
        kind = getattr(array, "dtype", np.dtype(bool))
        fits = self.white_level <= WHITE_LEVELS.get(kind.name, 0.0)
        return self.white_level if fits and (kind.kind != "u" or self.white_level > MOST_FLOAT) else None

    def black_level_of(self, array: NDArray[Any], stated: float, white_level: float | None) -> float:
        """The measured black level, above which exposures are judged, in the unit of raw frames; else ``stated``."""
        white = WHITE_LEVELS.get(array.dtype.name) if white_level is None else white_level
        return stated if self.black_level is None or white is None else self.black_level * white / self.white_level


def _number(value: Any) -> float:
    if not isinstance(value, Real):  # float() reads text
        raise TypeError
    return float(value)


def _numbers(values: Any) -> tuple[float, ...]:
    return tuple(map(_number, values))


def _rows(values: Any) -> Table:
    return tuple(map(_numbers, values))


def _analysers(values: Any) -> tuple[tuple[Analyser, ...], ...]:
    return tuple(tuple(Analyser(*_numbers(analyser)) for analyser in row) for row in values)


def _lamp(values: Any) -> LampFacts:
    (r, g, b), *facts = values
    return LampFacts((_number(r), _number(g), _number(b)), *(None if fact is None else _number(fact) for fact in facts))


def _size_of(values: Any) -> tuple[int, int]:
    rows, cols = map(index, values)
    return rows, cols


def _frozen(kinds: str, kept: type[np.generic], values: Any) -> NDArray[Any]:
    """An array of one of some ``kinds`` as a copy that cannot be changed, or itself where it cannot already."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in kinds:
        raise TypeError
    frozen: NDArray[Any] = values.astype(kept, copy=values.flags.writeable)
    frozen.flags.writeable = False
    return frozen


_MAP, _PIXELS = partial(_frozen, "fiu", np.float32), partial(_frozen, "iu", np.int32)
#: Conversion of the fields of `Calibration`, and how messages name what they hold.
_KINDS: dict[str, tuple[Any, str]] = {
    **dict.fromkeys(("white_level", "black_level", "read_noise"), (_number, "a number")),
    **dict.fromkeys(("black_pattern", "gains", "falloff"), (_rows, "rows of numbers")),
    **dict.fromkeys(("black_map", "gain_map"), (_MAP, "an array of numbers")),
    **dict.fromkeys(("hot", "dead"), (_PIXELS, "an array of indices")),
    "size": (_size_of, "rows and columns"),
    "analysers": (_analysers, "rows of an angle, an extinction ratio and a gain"),
    "lamp": (_lamp, "a colour of three numbers, a degree and an angle of polarization"),
    "details": (dict, "a mapping"),
}


def correct_mosaic(mosaic: Mosaic, calibration: Calibration) -> Mosaic:
    """One raw frame ``[H, W]`` as a sensor without the measured errors would give it; see the module.

    Codes of another white level are those of the calibration in another unit. Raises ValueError on a frame of another
    size or layout.
    """
    _check_match(mosaic, calibration)
    raw = to_numpy(mosaic.data)
    samples, black = raw, mosaic.black_level
    if calibration.black_level is not None:
        black = float(np.float32(calibration.black_level * mosaic.white_level / calibration.white_level))
    offset, factor = _prepared(calibration, black, mosaic.white_level, raw.shape)
    if offset is not None:
        samples = raw - offset
        if factor is not None:
            samples *= factor
        samples += np.float32(black)
    dead = defects if (defects := calibration.defects).size else None
    if dead is None and calibration.analysers is None and samples is raw:
        return _with_facts(mosaic, black, calibration)
    clipped = to_numpy(mosaic.clipped())
    if dead is not None:
        clipped.flat[dead] = False  # as the prediction from its neighbours is
        samples = _keep_clipped(raw.copy() if samples is raw else samples, clipped, (black, mosaic.white_level))
        mask = np.zeros(raw.shape, np.bool_)
        mask.flat[dead] = True
        found = replace(mosaic, data=samples, black_level=black)
        samples = repair(found, mask).data if min(raw.shape) >= MIN_SIZE else samples
    if calibration.analysers is not None:
        samples = correct_analysers(samples, black, calibration)
    samples = _keep_clipped(samples, clipped, (black, mosaic.white_level))
    return _with_facts(replace(mosaic, data=of_kind(samples, mosaic.data)), black, calibration)


def _with_facts(mosaic: Mosaic, black: float, calibration: Calibration) -> Mosaic:
    """The corrected frame with its black level, the calibrated lamp's colour and the falloff."""
    if calibration.lamp is not None:
        mosaic = replace(mosaic, light_color=calibration.lamp.color, lamp_measured=True)
    return replace(mosaic, black_level=black, falloff=calibration.falloff)


class Neighbours(NamedTuple):
    """For each row (or column): the nearest one, and the one on the other side, of the cell's other analyser.

    Both behind the same colour; ``weight`` of the nearest in linear interpolation.
    """

    near: NDArray[np.int64]
    far: NDArray[np.int64]
    weight: Floats


def correct_analysers(samples: Floats, black: float, calibration: Calibration) -> Floats:
    """Samples ``[H, W]`` as ideal analysers at the layout's angles would give them.

    Behind each pixel the Stokes vector is solved from its own sample and those of the three other analysers of its
    colour, interpolated there from both sides; the difference between the ideal and the measured analyser, times that
    vector, is added. Exact where light changes linearly.
    """
    from polsep.sensor.calibration_kernel import mix_neighbours

    return _mix(samples, black, calibration, mix_neighbours)


def correct_analysers_reference(samples: Floats, black: float, calibration: Calibration) -> Floats:
    """`correct_analysers` by the readable `mix_neighbours` instead of compiled code; the same to rounding."""
    return _mix(samples, black, calibration, mix_neighbours)


def _mix(samples: Floats, black: float, calibration: Calibration, mix: Any) -> Floats:
    layout = calibration.layout
    rows, cols = (neighbours(n, o, layout.period) for n, o in zip(samples.shape, layout.origin, strict=True))
    mixed: Floats = mix(np.ascontiguousarray(samples, np.float32), np.float32(black), rows, cols, mixing(calibration))
    return mixed


def mix_neighbours(samples: Floats, black: Any, rows: Neighbours, cols: Neighbours, weights: Floats) -> Floats:
    """Weighted sums of each sample and of those of the three other analysers of its colour, interpolated at its place.

    ``samples [H, W]``; ``weights [period, period, 4]``: own, other column, other row, both. Twin of the kernel.
    """
    x = samples - black

    def across(image: Floats) -> Floats:
        return cols.weight * image[:, cols.near] + (1 - cols.weight) * image[:, cols.far]

    vertical = rows.weight[:, None] * x[rows.near] + (1 - rows.weight[:, None]) * x[rows.far]
    w = tile(weights, samples.shape)
    mixed: Floats = w[..., 0] * x + w[..., 1] * across(x) + w[..., 2] * vertical + w[..., 3] * across(vertical) + black
    return mixed


def neighbours(count: int, origin: int, period: int) -> Neighbours:
    """The neighbours of each of ``count`` rows or columns, the first whole cell of which is at ``origin``.

    The nearest is in the own cell, the other as many pixels beyond the own place as fill the period: 1 and 3 of 4 on
    colour sensors, 1 and 1 of 2 on mono ones. At the border only one side counts.
    """
    place = np.arange(count)
    step = np.where((place - origin) % 2 == 0, 1, -1)
    near, far = place + step, place + step - step * period
    weight = np.full(count, (period - 1) / period, np.float32)
    weight[(far < 0) | (far >= count)] = 1
    weight[(near < 0) | (near >= count)] = 0
    return Neighbours(np.clip(near, 0, count - 1), np.clip(far, 0, count - 1), weight)


def mixing(calibration: Calibration) -> Floats:
    """Weights ``[period, period, 4]`` of `mix_neighbours` that make ideal analysers of the measured ones.

    With the analysers A ``[4, 3]`` of a cell, its Stokes vector is pinv(A) m, and an ideal sample is
    m_k + (ideal_k - A_k) pinv(A) m.
    """
    layout, table = calibration.layout, calibration.analysers
    assert table is not None
    period = layout.period
    weights = np.zeros((period, period, 4))
    for row in range(period):
        for col in range(period):
            down = 1 if (row - layout.origin[0]) % 2 == 0 else -1
            right = 1 if (col - layout.origin[1]) % 2 == 0 else -1
            places = [(row, col), (row, col + right), (row + down, col), (row + down, col + right)]
            measured = np.array([table[r % period][c % period].vector for r, c in places])
            ideal = np.array(Analyser(layout.filter_at(row, col).angle_deg, math.inf, 1.0).vector)
            weights[row, col] = (ideal - measured[0]) @ np.linalg.pinv(measured)
            weights[row, col, 0] += 1
    return weights.astype(np.float32)


def _check_match(mosaic: Mosaic, calibration: Calibration) -> None:
    """Raise ValueError unless the frame is of the calibrated sensor."""
    if mosaic.data.ndim != 2:
        raise ValueError(f"expected one raw frame [H, W] to calibrate, found shape {tuple(mosaic.data.shape)}")
    if mosaic.layout != calibration.layout:
        raise ValueError(
            f"expected frames of layout {calibration.layout.spec}, as calibrated, found {mosaic.layout.spec}"
        )
    if calibration.size is not None and tuple(mosaic.data.shape) != calibration.size:
        wanted, found = (f"{width}x{height}" for height, width in (calibration.size, mosaic.data.shape))
        raise ValueError(f"expected frames of {wanted}, as calibrated, found {found}")


@lru_cache(maxsize=4)  # frames of a stream are alike
def _prepared(
    calibration: Calibration, black: float, white: float, shape: tuple[int, int]
) -> tuple[Floats | None, Floats | None]:
    """Offset of each pixel in codes of the frame, and the factor that undoes its gain; None where nothing is known."""
    offset, factor = None, None
    if calibration.black_map is not None:
        offset = calibration.black_map * np.float32(white / calibration.white_level)
    elif calibration.black_pattern is not None:
        offset = tile(calibration.black_pattern, shape) * np.float32(white / calibration.white_level)
        offset += np.float32(black)
    gain = calibration.gain_map if calibration.gain_map is not None else tile(calibration.gains, shape)
    if gain is not None:
        factor = np.float32(1) / gain
        if offset is None:
            offset = np.full(shape, black, np.float32)
    return offset, factor


def tile(table: Any, shape: tuple[int, ...]) -> Any:
    """A table ``[period, period, ...]`` repeated over a frame, as float32; None for None."""
    if table is None:
        return None
    values = np.asarray(table, np.float32)
    rows, cols = (np.arange(n) % k for n, k in zip(shape, values.shape[:2], strict=True))
    return values[rows][:, cols]


def _keep_clipped(samples: Floats, clipped: NDArray[np.bool_], levels: tuple[float, float]) -> Floats:
    """Corrected samples; those that were clipped and fell below the clip level are set to the white level."""
    samples[clipped & (samples < np.float32(clip_level(*levels)))] = levels[1]
    return samples
