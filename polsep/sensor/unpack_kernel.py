"""Rows of raw samples in any storage: 8 and 16 bits, float32, and two pixels of 12 bits in three bytes.

A kernel reads one sensor row at a time, so a packed frame never becomes a full frame of words. Packings, as GenICam
names them and `polsep.io.raw.genicam` defines them:

* ``gige``  ``Mono12Packed``, ``BayerRG12Packed``: b0 and b2 hold the high 8 bits of p0 and p1, b1 the low 4 bits of p0
  (from bit 0) and of p1 (from bit 4).
* ``lsb``   ``Mono12p``, ``BayerRG12p``: a little-endian bit stream, p0 = b0 | (b1 & 15) << 8, p1 = b1 >> 4 | b2 << 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import compiled, read_only

UINT8, UINT16, FLOAT32, GIGE, LSB = range(5)

_STORED: dict[np.dtype[Any], int] = {
    np.dtype(np.uint8): UINT8,
    np.dtype(np.uint16): UINT16,
    np.dtype(np.float32): FLOAT32,
}
_PACKED = {"gige": GIGE, "lsb": LSB}


@dataclass(frozen=True)
class PackedFrame:
    """A mosaic of 12-bit codes as a camera packs them, two pixels in three bytes; white level 4095.

    ``data``: uint8, either ``[N]``, pixels in reading order without padding between rows (as GenICam transfers them,
    N = 3 height width / 2 rounded up), or ``[height, stride]``, every row from a whole byte on and padded to the
    stride. ``packing``: "gige" (names ending in 12Packed) or "lsb" (names ending in 12p). Raises ValueError on
    another packing, dtype or shape, or when the data are too short or, without padding, too long.
    """

    data: NDArray[np.uint8]
    height: int
    width: int
    packing: str

    def __post_init__(self) -> None:
        if self.packing not in _PACKED:
            raise ValueError(f"expected a packing of {', '.join(_PACKED)}, found {self.packing!r}")
        if self.height < 1 or self.width < 1:
            raise ValueError(f"expected a positive height and width, found {self.height}x{self.width}")
        if not isinstance(self.data, np.ndarray) or self.data.dtype != np.uint8:
            found = getattr(self.data, "dtype", type(self.data).__name__)
            raise ValueError(f"expected packed samples of uint8, found {found}")
        stream, row = (-(-3 * count // 2) for count in (self.height * self.width, self.width))
        if self.data.shape == (stream,):
            return
        if self.data.ndim != 2 or self.data.shape[0] != self.height or self.data.shape[1] < row:
            raise ValueError(
                f"expected [{stream}] or [{self.height}, {row} or more] bytes for {self.height}x{self.width} pixels of "
                f"12 bits, found shape {self.data.shape}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the mosaic."""
        return self.height, self.width


RawFrame = NDArray[Any] | PackedFrame


class Samples(NamedTuple):
    """A frame as kernels read it: all its samples in the one array of their type, the other two arrays being empty.

    ``stored``: one of the constants above. Row y starts at element ``y row_size`` and, in packed frames, at the pixel
    ``y row_pixels`` from there. One type for all frames, so that kernels are compiled once.
    """

    octets: NDArray[np.uint8]
    words: NDArray[np.uint16]
    floats: NDArray[np.float32]
    stored: int
    row_size: int
    row_pixels: int


def as_samples(raw: RawFrame) -> Samples:
    """Return the samples of a raw mosaic ``[H, W]`` (uint8, uint16, float32) or packed frame.

    A view, or a copy if there are gaps between the rows or samples, or they are not aligned. Raises ValueError on
    another dtype or shape.
    """
    _check_mosaic(raw)
    if isinstance(raw, PackedFrame):
        data, stored = raw.data, _PACKED[raw.packing]
        row_size, row_pixels = (0, raw.width) if data.ndim == 1 else (data.shape[1], 0)
    else:
        data, stored = raw, _STORED[raw.dtype]
        row_size, row_pixels = data.shape[1], 0
    flat = np.require(data, requirements=["C", "A"]).reshape(-1)
    arrays: list[NDArray[Any]] = [read_only(flat if flat.dtype == kind else np.empty(0, kind)) for kind in _STORED]
    return Samples(arrays[0], arrays[1], arrays[2], stored, row_size, row_pixels)


def _check_mosaic(raw: object) -> None:
    """Raises ValueError unless ``raw`` is a mosaic or a packed frame."""
    if isinstance(raw, PackedFrame):
        return
    if not isinstance(raw, np.ndarray):
        raise ValueError(f"expected a NumPy mosaic or a PackedFrame, found {type(raw).__name__}")
    if raw.dtype not in _STORED:
        raise ValueError(f"expected samples of uint8, uint16 or float32, found {raw.dtype}")
    if raw.ndim != 2:
        raise ValueError(f"expected a mosaic [H, W], found shape {raw.shape}")


@compiled
def _read_gige(data: Any, first: int, row: Any) -> None:
    """Codes from pixel ``first`` of a gige stream; an odd one starts with the second half of its three bytes."""
    if first % 2 == 0:
        pairs = data[first // 2 * 3 :]
        for q in range(row.size // 2):
            low = pairs[3 * q + 1]
            row[2 * q] = np.float32(np.int32(pairs[3 * q]) << 4 | np.int32(low & 15))
            row[2 * q + 1] = np.float32(np.int32(pairs[3 * q + 2]) << 4 | np.int32(low >> 4))
    else:
        pairs = data[first // 2 * 3 + 1 :]
        for q in range(row.size // 2):
            row[2 * q] = np.float32(np.int32(pairs[3 * q + 1]) << 4 | np.int32(pairs[3 * q] >> 4))
            row[2 * q + 1] = np.float32(np.int32(pairs[3 * q + 2]) << 4 | np.int32(pairs[3 * q + 3] & 15))


@compiled
def _read_lsb(data: Any, first: int, row: Any) -> None:
    """Codes from pixel ``first`` of a little-endian bit stream; an odd one starts within its second byte."""
    if first % 2 == 0:
        pairs = data[first // 2 * 3 :]
        for q in range(row.size // 2):
            middle = np.int32(pairs[3 * q + 1])
            row[2 * q] = np.float32(np.int32(pairs[3 * q]) | (middle & 15) << 8)
            row[2 * q + 1] = np.float32(middle >> 4 | np.int32(pairs[3 * q + 2]) << 4)
    else:
        pairs = data[first // 2 * 3 + 1 :]
        for q in range(row.size // 2):
            row[2 * q] = np.float32(np.int32(pairs[3 * q]) >> 4 | np.int32(pairs[3 * q + 1]) << 4)
            row[2 * q + 1] = np.float32(np.int32(pairs[3 * q + 2]) | (np.int32(pairs[3 * q + 3]) & 15) << 8)


@compiled
def _convert(values: Any, row: Any) -> None:
    for x in range(row.size):
        row[x] = np.float32(values[x])


@compiled
def read_row(samples: Samples, y: int, x: int, row: Any) -> None:
    """Fill ``row``, float32 of an even size, with the codes of sensor row ``y`` from column ``x`` on."""
    start = y * samples.row_size
    if samples.stored == GIGE:
        _read_gige(samples.octets[start:], y * samples.row_pixels + x, row)
    elif samples.stored == LSB:
        _read_lsb(samples.octets[start:], y * samples.row_pixels + x, row)
    elif samples.stored == UINT8:
        _convert(samples.octets[start + x :], row)
    elif samples.stored == UINT16:
        _convert(samples.words[start + x :], row)
    else:
        _convert(samples.floats[start + x :], row)
