"""From arrays of any origin to `Mosaic` and `Measurements`: accepted samples, black and white levels.

Conventions, shared by Python callers and by files:

* Samples are uint8, uint16, float32 or float64, finite, one value per pixel; they become float32, in which 8- and
  16-bit codes are exact. Signed integers, booleans and complex numbers are refused.
* A white level of None means the largest code of the dtype: 255, 65535, or 1.0 for floats. Nothing else is ever
  assumed: the likely bit depth (12 bits in 16, for example) is reported in a note, one line for the user.
* Samples above the white level are kept and count as clipped; samples below the black level are kept.
* Everything refused raises ValueError with one line: what was expected, what was found; `WrongType` where an argument
  is of another type.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.arguments import WrongType
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import CLIP_MARGIN, Capture, Layout, Mosaic, clip_level

#: Accepted samples and the white level that their type implies.
WHITE_LEVELS = {"uint8": 255.0, "uint16": 65535.0, "float32": 1.0, "float64": 1.0}

#: Distance from black to white, in units of the samples, and how many times it a sample or a level may be away. Beyond,
#: squares overflow in float32, or white and black are one number in it.
SPANS, MAX_RATIO = (1e-12, 1e12), 1e6

#: Floats up to about 1 that lie below this share of the white level look as if white were 1.
MIN_USED = 0.01

#: Share of the lit samples that clip from which on a frame is overexposed, and the level from which on samples are lit,
#: white = 1: 1 % is harmless, 5 % costs 4 to 10 dB (docs/reality.md).
MAX_CLIPPED, LIT = 0.03, 0.02
#: Of frames of so many rows one group of rows in some is counted.
LARGE, ROWS, SKIPPED = 1024, 4, 4

#: Where a sensor clips below the white level: samples that share the largest value, at least; how many times those of
#: one of the codes below they are; and these codes' range, relative to white.
PILE, PILE_RATIO, PILE_RANGE = 64, 5.0, 1 / 64

#: Order of four angle planes, as LUCID names them, in degrees.
PLANE_ANGLES_DEG = (0.0, 45.0, 90.0, 135.0)

#: Bit depths of converters that are stored in 16-bit words.
_NARROW_BITS = (8, 10, 12, 14)

#: Largest distance of float32 samples over 65535 from codes of 14 bits, in codes.
CODE_ERROR = 2e-3

#: Largest sample of light in floats of white 1, and how many times white is no light any more.
MOST_FLOAT, MANY_WHITES = 2.0, 100.0

Notes = tuple[str, ...]


class ForgottenLevel(str):
    """A note on samples whose white level nobody stated and is likely another: images would be far too dark or clipped.

    Python's callers are warned; commands that write files refuse such a frame (`io.raw.frames.refuse_forgotten`).
    """


class OtherUnit(str):
    """A note on samples that are hardly in the unit of their white level."""


class Overexposed(str):
    """A note on many clipped samples, which a merge of several exposures replaces."""


class BlackFrame(str):
    """A note on samples that all are black, which say nothing of their levels."""


def as_layout(layout: Layout | str | None) -> Layout | None:
    """A layout, of text by `Layout.parse`, or None. Raises `WrongType` on anything else."""
    layout = Layout.parse(layout) if isinstance(layout, str) else layout
    if not isinstance(layout, Layout | None):
        raise WrongType(f'expected a Layout, "color", "mono", a specification or None, found {type(layout).__name__}')
    return layout


def as_mosaic(
    array: NDArray[Any], layout: Layout | str | None = None, black_level: float = 0.0, white_level: float | None = None
) -> tuple[Mosaic, Notes]:
    """One raw frame ``[H, W]`` (or ``[H, W, 1]``) as a `Mosaic` of float32, with notes for the user.

    ``layout`` None is Sony's colour order, text is read by `Layout.parse`; levels are in the units of ``array``. An odd
    last row or column is cropped and gray stored as three equal channels is reduced to one, both with a note. Bit depth
    is not guessed. Raises ValueError on another dtype or shape, values that are not finite, or white not above black.
    """
    layout = as_layout(layout) or Layout()
    plane, notes = _one_channel(_checked(array))
    height, width = plane.shape
    odd_rows, odd_cols = ((n - start) % 2 for n, start in zip((height, width), layout.origin, strict=True))
    if odd_rows or odd_cols:
        plane = plane[: height - odd_rows, : width - odd_cols]
        size = f"{plane.shape[1] - layout.origin[1]}x{plane.shape[0] - layout.origin[0]}"
        notes += (f"size {width}x{height} cuts polarizer cells of the layout: cropped to {size}, whole cells",)
    rows, cols = (layout.period + start for start in layout.origin)
    if plane.shape[0] < rows or plane.shape[1] < cols:
        raise ValueError(f"expected a mosaic of at least {cols}x{rows} pixels, found {width}x{height}")
    white = _white_level(plane, black_level, white_level)
    mosaic = Mosaic(_as_float32(plane), layout, black_level, white)
    return mosaic, notes + level_notes(plane, black_level, white_level)


def as_measurements(
    planes: NDArray[Any],
    black_level: float = 0.0,
    white_level: float | None = None,
    angles_deg: Sequence[float] = PLANE_ANGLES_DEG,
) -> tuple[Measurements, Notes]:
    """K co-sited images behind analysers at ``angles_deg`` as `Measurements` ``[K, C, H, W]``, black 0 and white 1.

    ``planes``: ``[K, H, W]``, or ``[K, H, W, C]`` with C = 1 or 3. ``clipped`` marks samples within `CLIP_MARGIN` of
    white. Not for planes sampled from one mosaic: their pixels are not at the same points, see `interleave_planes`.
    Raises ValueError as `as_mosaic` does.
    """
    planes, count = _checked(planes), len(angles_deg)
    if planes.ndim == 3:
        planes = planes[..., None]
    if planes.ndim != 4 or planes.shape[0] != count or planes.shape[-1] not in (1, 3):
        number = "four" if count == 4 else str(count)
        raise ValueError(f"expected {number} gray or RGB images, found shape {_shape(planes)}")
    white = _white_level(planes, black_level, white_level)
    linear = (_as_float32(planes) - float(black_level)) / float(white - black_level)
    data = np.ascontiguousarray(np.moveaxis(linear, -1, 1))
    angles = tuple(math.radians(angle) for angle in angles_deg)
    return Measurements(data, angles, data >= 1 - CLIP_MARGIN), level_notes(planes, black_level, white_level)


def interleave_planes(planes: NDArray[Any], layout: Layout) -> NDArray[Any]:
    """The mosaic ``[2H, 2W]`` whose pixels behind 0, 45, 90, 135 degrees are the four ``planes`` ``[4, H, W]``.

    Undoes what cameras do that send angle images. Raises ValueError for other shapes, or a layout of other angles.
    """
    if planes.ndim != 3 or planes.shape[0] != 4:
        raise ValueError(f"expected four planes [4, H, W] of one mosaic, found shape {_shape(planes)}")
    require_plane_angles(layout)
    order = [angle % 180 for angle in PLANE_ANGLES_DEG]
    mosaic = np.empty((2 * planes.shape[1], 2 * planes.shape[2]), planes.dtype)
    for row in (0, 1):
        for col in (0, 1):
            mosaic[row::2, col::2] = planes[order.index(layout.filter_at(row, col).angle_deg % 180)]
    return mosaic


def planes_as_capture(
    planes: NDArray[Any], layout: Layout | None, black_level: float = 0.0, white_level: float | None = None
) -> tuple[Capture, Notes]:
    """Four angle planes as what they are: gray ones under a colour layout are samples of one mosaic, others co-sited.

    ``planes``: ``[4, H, W]`` or ``[4, H, W, C]`` at `PLANE_ANGLES_DEG`. Raises ValueError as `as_mosaic` does, and on a
    layout of other angles.
    """
    if planes.ndim == 3 and layout is not None and layout.bayer is not None:
        return as_mosaic(interleave_planes(planes, layout), layout, black_level, white_level)
    if layout is not None:
        require_plane_angles(layout)
    return as_measurements(planes, black_level, white_level)


def require_plane_angles(layout: Layout) -> None:
    """Raise ValueError on a layout of other angles than those of four planes."""
    if sorted(angle % 180 for angle in layout.angles_deg) != [angle % 180 for angle in PLANE_ANGLES_DEG]:
        raise ValueError(f"expected a layout of the angles 0, 45, 90, 135 for four planes, found {layout.spec}")


def has_levels_of(samples: NDArray[Any], white: float, kind: np.dtype[Any] | None) -> bool:
    """False for samples of another unit than those of a frame of that white level.

    ``kind``: the type of the frame's samples, where that says its white level; else None.
    """
    if samples.dtype.kind == "u":
        other = (
            kind is not None and kind.kind == "u" and WHITE_LEVELS[kind.name] != WHITE_LEVELS.get(samples.dtype.name)
        )
        return white > MOST_FLOAT and not other
    most = float(samples.max()) if samples.dtype.kind == "f" and samples.size else 0.0
    return not (most > MANY_WHITES * white or (white > MANY_WHITES and 0 < most <= MOST_FLOAT))


def level_notes(samples: NDArray[Any], black_level: float, white_level: float | None) -> Notes:
    """Notes on exposure and bit depth, one line each; ``white_level`` None means that the caller gave none."""
    white = WHITE_LEVELS[samples.dtype.name] if white_level is None else white_level
    low, high = float(samples.min()), float(samples.max())
    if high <= black_level:
        return (BlackFrame(f"black frame: no sample exceeds the black level {black_level:g} (largest {high:g})"),)
    notes: Notes = ()
    clip = clip_level(black_level, white)
    if low >= clip:
        notes += (f"every sample is clipped: the smallest is {low:g} of white level {white:g}",)
    elif high >= clip:
        notes += overexposure_notes(samples, black_level, white)
    elif samples.dtype.kind == "f" or white_level is not None or samples.dtype == np.uint8:
        notes += _saturation_notes(samples, black_level, white)
    if white_level is None and samples.dtype.kind == "f" and high > 2:
        note = f"float values reach {high:g}, far above the white level 1: say --white-level N if N is white"
        return (*notes, ForgottenLevel(note))
    if samples.dtype.kind == "f" and high <= 2 < white and high - black_level < MIN_USED * (white - black_level):
        found = f"float values reach {high:g} of white level {white:g}"
        notes += (OtherUnit(f"{found}: is white 1? Then leave out --white-level"),)
    if np.float32(high) > np.float32(white):
        above = int(np.count_nonzero(samples > white))
        notes += (f"{above} samples exceed the white level {white:g} (largest {high:g}): they count as clipped",)
    if samples.dtype.kind == "u" and white > WHITE_LEVELS[samples.dtype.name]:
        beyond = f"white level {white:g} is beyond {samples.dtype.name}"
        notes += (OtherUnit(f"{beyond}: no sample can count as clipped"),)
    if white_level is None and samples.dtype != np.uint8:
        notes += _float_depth_notes(samples, high) if samples.dtype.kind == "f" else _depth_notes(samples, int(high))
    return notes


def _saturation_notes(samples: NDArray[Any], black_level: float, white: float) -> Notes:
    if not saturates_early(samples, black_level, white):
        return ()
    high = f"{float(samples.max()):.6g}"
    found = f"many samples share the largest value {high}, below the white level {white:g}"
    return (f"{found}: if the sensor clips there, say --white-level {high}",)


def saturates_early(samples: NDArray[Any], black_level: float, white: float) -> bool:
    """True where samples pile up at their largest value, and that is one between black and what counts as clipped."""
    high = float(samples.max())
    if not black_level < high < clip_level(black_level, white):
        return False
    count = int(np.count_nonzero(samples == high))
    if count < PILE:
        return False
    below = samples[(samples > high - PILE_RANGE * (white - black_level)) & (samples < high)]
    return 0 < PILE_RATIO * below.size < count * np.unique(below).size


def overexposure_notes(samples: NDArray[Any], black_level: float, white: float) -> Notes:
    """A note on a frame of which too many lit samples clip, or none."""
    share = clipped_share(samples, black_level, white)
    hidden = f"overexposed: {share:.0%} of the lit samples are clipped, what they hide is estimated"
    note = Overexposed(f"{hidden}: expose less, or merge several exposures (polsep merge)")
    return (note,) if share > MAX_CLIPPED else ()


def clipped_share(samples: NDArray[Any], black_level: float, white: float) -> float:
    """Share of clipped samples among those that light reaches, of a large frame among some of its rows."""
    rows = samples.reshape(-1, samples.shape[-1])
    height = len(rows) // ROWS * ROWS
    every = SKIPPED if height >= LARGE else 1
    kept = rows[:height].reshape(-1, ROWS, rows.shape[-1])[::every] if height else rows
    lit, clip = black_level + LIT * (white - black_level), clip_level(black_level, white)
    if samples.dtype.kind == "u":  # whole numbers are compared in half of the time
        lit, clip = math.floor(lit), math.ceil(clip)
    return int(np.count_nonzero(kept >= clip)) / max(int(np.count_nonzero(kept > lit)), 1)


def _depth_notes(samples: NDArray[Any], high: int) -> Notes:
    """The likely bit depth of uint16 values of unknown white level. Left-justified codes have idle low bits."""
    used = int(np.bitwise_or.reduce(samples, axis=None))
    idle = (used & -used).bit_length() - 1
    left = next((bits for bits in _NARROW_BITS if idle >= 16 - bits), None)
    if left is not None:
        largest = (2**left - 1) << (16 - left)
        seen = f"the lowest {16 - left} bits are always zero: {left}-bit left-justified data"
        if largest >= clip_level(0, 65535):
            return (f"{seen}; white level 65535 fits",)
        return (f"{seen}; say --white-level {largest} if so",)
    right = next((bits for bits in _NARROW_BITS if high < 2**bits), None)
    if right is None:
        return ()
    top = 2**right - 1
    seen = f"values never exceed {top} of 65535: looks like {right}-bit right-justified data"
    return (ForgottenLevel(f"{seen}; say --white-level {top} if so"),)


def _float_depth_notes(samples: NDArray[Any], high: float) -> Notes:
    """The likely bit depth of floats that are right-justified codes of uint16 over 65535, of unknown white level."""
    right = next((bits for bits in _NARROW_BITS if round(65535 * high) < 2**bits), None)
    if right is None or not (_are_codes(samples[0]) and _are_codes(samples)):
        return ()
    # Codes of 8 bits over 255 are multiples of 257 / 65535; left-justified ones, of 4 and more.
    if np.gcd.reduce(np.rint(65535 * samples.astype(np.float64)).astype(np.int64), axis=None) != 1:
        return ()
    top = 2**right - 1
    seen = f"float values are multiples of 1/65535 up to {top}/65535: looks like {right}-bit right-justified data"
    return (ForgottenLevel(f"{seen}; say --white-level {np.float32(top / 65535)} if so"),)


def _are_codes(samples: NDArray[Any]) -> bool:
    """True for floats that are whole numbers over 65535."""
    codes = 65535 * samples.astype(np.float64)
    return bool((np.abs(codes - np.rint(codes)) < CODE_ERROR).all())


def _shape(array: NDArray[Any]) -> str:
    return "x".join(str(n) for n in array.shape) or "a single number"


def _checked(array: NDArray[Any]) -> NDArray[Any]:
    """``array`` in native byte order, once its type, size and values are known to be acceptable."""
    if not isinstance(array, np.ndarray) or isinstance(array, np.ma.MaskedArray):  # masked samples have no value
        raise WrongType(f"expected a NumPy array, found {type(array).__name__}{_advice(array)}")
    array = np.asarray(array)  # of a subclass, which may have operations of its own
    if array.dtype.name not in WHITE_LEVELS:
        raise ValueError(f"expected samples of uint8, uint16, float32 or float64, found {array.dtype}")
    if array.size == 0 or array.ndim < 2:
        raise ValueError(f"expected an image [H, W], found shape {_shape(array)}")
    if array.dtype.kind == "f":
        _require_finite(array)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


def _advice(found: Any) -> str:
    """Advice on a thing that is no array, where it is clear what to do."""
    if type(found).__module__.partition(".")[0] == "torch":
        return ": say raw.numpy(force=True)"
    if isinstance(getattr(found, "data", None), Capture):
        return ": say frame.data"
    if hasattr(found, "__cuda_array_interface__"):
        return ": copy it from the GPU, as cupy.asnumpy does"
    if isinstance(found, list | memoryview) or (
        hasattr(found, "__array_interface__") and not isinstance(found, np.ndarray | np.generic)
    ):
        return ": say numpy.array(raw, numpy.uint16), or the type that its samples have"
    return ": read files by polsep.read_frames" if isinstance(found, str | PathLike) else ""


def _require_finite(array: NDArray[Any]) -> None:
    """Raise ValueError when a value is not finite, or has no finite float32."""
    with np.errstate(invalid="ignore"):
        if max(-float(array.min()), float(array.max())) <= float(np.finfo(np.float32).max):
            return
    bad = ~(np.abs(array) <= np.finfo(np.float32).max)
    first = tuple(int(i) for i in np.unravel_index(int(bad.argmax()), bad.shape))
    count = np.count_nonzero(bad)
    raise ValueError(f"expected finite values, found {count} that are not, the first ({array[first]:g}) at {first}")


def _one_channel(array: NDArray[Any]) -> tuple[NDArray[Any], Notes]:
    """``[H, W]`` of an array with one channel, or with three equal ones."""
    if array.ndim == 2:
        return array, ()
    if array.ndim == 3 and array.shape[-1] == 1:
        return array[..., 0], ()
    if array.ndim == 3 and array.shape[-1] == 3:
        if bool((array == array[..., :1]).all()):
            return array[..., 0], ("gray stored as three equal channels: one is used",)
        raise ValueError("expected one channel, found 3: a demosaicked picture is not a raw mosaic")
    if array.ndim == 3 and array.shape[-1] in (2, 4):
        raise ValueError(f"expected one channel, found {array.shape[-1]}: transparency has no place in a raw mosaic")
    raise ValueError(f"expected a mosaic [H, W], found shape {_shape(array)}")


def _white_level(samples: NDArray[Any], black_level: float, white_level: float | None) -> float:
    """The given white level, or that of the dtype. Raises ValueError unless it is finite and above black."""
    white = WHITE_LEVELS[samples.dtype.name] if white_level is None else white_level
    for name, level in (("black", black_level), ("white", white)):
        if not isinstance(level, Real) or isinstance(level, bool):  # True would be a white of 1
            raise WrongType(f"expected a {name} level that is a number, found {level!r:.40}")
    if not (math.isfinite(white) and math.isfinite(black_level)):
        raise ValueError(f"expected finite black and white levels, found {black_level:g} and {white:g}")
    if samples.dtype.kind == "u" and black_level < 0:
        raise ValueError(f"expected a black level from 0 on in samples of {samples.dtype}, found {black_level:g}")
    if not white > black_level:
        raise ValueError(f"expected a white level above the black level, found white {white:g}, black {black_level:g}")
    _require_span(samples, float(black_level), float(white))
    return float(white)


def _require_span(samples: NDArray[Any], black: float, white: float) -> None:
    """Raise ValueError for levels and samples with which float32 would overflow, or lose every digit."""
    require_levels(black, white)
    span = white - black
    least, most = (samples.min(), samples.max()) if samples.dtype.kind == "f" else (0, WHITE_LEVELS[samples.dtype.name])
    farthest = max(black - float(least), float(most) - black)
    if farthest > MAX_RATIO * span:
        raise ValueError(
            f"expected samples within {MAX_RATIO:g} times the white level, found them {farthest:g} from black, "
            f"white {white:g}: say --white-level N"
        )


def require_levels(black: float, white: float) -> None:
    """Raise ValueError unless float32 tells white from black, and the squares of samples between them from infinity."""
    span = white - black
    if not (SPANS[0] <= span <= SPANS[1] and max(abs(black), abs(white)) <= MAX_RATIO * span):
        raise ValueError(f"expected a white level well above the black level, found white {white:g}, black {black:g}")


def _as_float32(samples: NDArray[Any]) -> NDArray[np.float32]:
    """A contiguous float32 copy, so that later changes of the caller's array don't reach the mosaic."""
    copy = pages.empty(samples.shape, np.float32)
    copy[...] = samples
    return copy
