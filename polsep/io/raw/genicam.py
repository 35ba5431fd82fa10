"""GenICam pixel formats: the bytes of one frame as cameras and their SDKs write them, without any header.

Conventions: `unpack_frame` returns right-justified codes, uint8 for 8-bit formats and uint16 for all others, so the
white level is ``2^bits - 1``. Pixels are in reading order without padding between rows; a frame whose last bits do
not fill a byte is padded with zero bits to a whole byte. Words are little-endian. Packings:

* ``byte``  one byte per pixel.
* ``word``  one 16-bit little-endian word per pixel, the code in the low bits.
* ``lsb``   names ending in ``p``: a little-endian bit stream; with 12 bits p0 = b0 | (b1 & 15) << 8 and
  p1 = b1 >> 4 | b2 << 4.
* ``gige``  names ending in ``Packed``: two pixels in three bytes, b0 and b2 the high 8 bits of p0 and p1, b1 the low
  bits of p0 (from bit 0) and of p1 (from bit 4).

LUCID's ``PolarizedAngles_0d_45d_90d_135d_*`` hold four samples per pixel, the analysers 0, 45, 90, 135 side by side;
their width and height are those of ONE angle image, half the sensor's. ``Bayer`` names hold the order of the first
2x2 colours (of 2x2 cells on polarization sensors); all other names are mono.

Note: imagecodecs unpacks big-endian bit streams only (`packints_decode`); these are little-endian.
Source: EMVA, GenICam Pixel Format Naming Convention 2.4 (byte, word, lsb); AIA, GigE Vision 2.0 (gige); FLIR Spinnaker
``PixelFormatEnums`` (Polarized8, BayerRGPolarized8 and on); LUCID Arena SDK, "Polarization, Angles" example and PFNC
values 0x8220000F (Mono8, 32 bits per pixel), 0x8230001F (Mono12p, 48), 0x8240002F (Mono16, 64).
"""

from __future__ import annotations

import difflib
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.store.errors import InputError

Codes = NDArray[np.uint8] | NDArray[np.uint16]

#: Pixels unpacked at a time, so that intermediate arrays stay in the cache; a multiple of every group.
BLOCK = 1 << 16


@dataclass(frozen=True)
class PixelFormat:
    """Layout of one frame's bytes: ``bits`` per code, ``packing``, ``planes`` (1, or 4 angles), ``bayer``."""

    name: str
    bits: int
    packing: str
    planes: int = 1
    bayer: str | None = None

    @property
    def stored_bits(self) -> int:
        """Bits that one pixel takes in the file."""
        return {"byte": 8, "word": 16, "gige": 12}.get(self.packing, self.bits)

    @property
    def white_level(self) -> float:
        """Largest code, 2^bits - 1."""
        return 2.0**self.bits - 1

    def frame_bytes(self, width: int, height: int) -> int:
        """Bytes of one frame, the last one padded."""
        return math.ceil(self.planes * width * height * self.stored_bits / 8)


_PACKINGS = {
    "8": (8, "byte"),
    "10": (10, "word"),
    "12": (12, "word"),
    "14": (14, "word"),
    "16": (16, "word"),
    "10p": (10, "lsb"),
    "12p": (12, "lsb"),
    "10Packed": (10, "gige"),
    "12Packed": (12, "gige"),
}
_BAYER = {"BayerRG": "RGGB", "BayerGR": "GRBG", "BayerGB": "GBRG", "BayerBG": "BGGR"}
_FAMILIES: list[tuple[str, str, int, str | None]] = [
    ("Mono", "8 10 12 14 16 10p 12p 10Packed 12Packed", 1, None),
    ("Polarized", "8 10p 12p 12Packed 16", 1, None),
    ("PolarizeMono", "8 12 12p 12Packed 16", 1, None),
    *((name, "8 10 12 16 10p 12p 10Packed 12Packed", 1, bayer) for name, bayer in _BAYER.items()),
    *((f"{name}Polarized", "8 10p 12p 16", 1, bayer) for name, bayer in _BAYER.items()),
    ("PolarizedAngles_0d_45d_90d_135d_Mono", "8 12p 16", 4, None),
    ("PolarizedAngles_0d_45d_90d_135d_BayerRG", "8 12p 16", 4, "RGGB"),
]

#: Every known pixel format by name.
PIXEL_FORMATS: dict[str, PixelFormat] = {
    prefix + suffix: PixelFormat(prefix + suffix, *_PACKINGS[suffix], planes, bayer)
    for prefix, suffixes, planes, bayer in _FAMILIES
    for suffix in suffixes.split()
}


def find_pixel_format(name: str) -> PixelFormat:
    """The format of that exact name. Raises InputError with the closest names otherwise."""
    if name in PIXEL_FORMATS:
        return PIXEL_FORMATS[name]
    folded = {known.lower(): known for known in PIXEL_FORMATS}
    close = [folded[match] for match in difflib.get_close_matches(name.lower(), folded, n=3)]
    names = ", ".join(close) if close else "a GenICam name such as BayerRG8, BayerRG12p, Mono8 or Mono12p"
    raise InputError(f"expected a known pixel format ({names}), found {name!r}")


def unpack_frame(buffer: bytes, width: int, height: int, pixel_format: str) -> Codes:
    """Codes of one frame: ``[height, width]``, or ``[4, height, width]`` (0, 45, 90, 135 degrees) for LUCID's angles.

    uint8 for 8-bit formats, else uint16, right-justified and writable. Twin of `pack_frame`. Codes of ``word``
    formats above the white level are returned as they are. Raises InputError on an unknown format, a size that is
    not positive, or a buffer that does not hold exactly one frame.
    """
    fmt = find_pixel_format(pixel_format)
    if width < 1 or height < 1:
        raise InputError(f"expected a positive width and height, found {width}x{height}")
    expected = fmt.frame_bytes(width, height)
    if len(buffer) != expected:
        raise InputError(f"expected {expected} bytes for {width}x{height} {fmt.name}, found {len(buffer)}")
    count = fmt.planes * width * height
    data = np.frombuffer(buffer, np.uint8)
    codes: Codes
    if fmt.packing == "byte":
        codes = data.copy()
    elif fmt.packing == "word":
        codes = data.view("<u2").astype(np.uint16)
    else:
        codes = _unpack_lsb(data, count, fmt.bits) if fmt.packing == "lsb" else _unpack_gige(data, count, fmt.bits)
    if fmt.planes == 1:
        return codes.reshape(height, width)
    return codes.reshape(-1, fmt.planes).T.copy().reshape(fmt.planes, height, width)


def pack_frame(codes: NDArray[Any], pixel_format: str) -> bytes:
    """Bytes of one frame of integer codes ``[H, W]`` (``[4, H, W]`` for LUCID's angles); twin of `unpack_frame`.

    Raises InputError on an unknown format, another shape or dtype, or a code outside 0 .. 2^bits - 1.
    """
    fmt = find_pixel_format(pixel_format)
    wanted = "[H, W]" if fmt.planes == 1 else f"[{fmt.planes}, H, W]"
    if codes.ndim != (2 if fmt.planes == 1 else 3) or (fmt.planes > 1 and codes.shape[0] != fmt.planes):
        raise InputError(f"expected codes {wanted} for {fmt.name}, found shape {codes.shape}")
    if codes.dtype.kind not in "ui":
        raise InputError(f"expected integer codes for {fmt.name}, found {codes.dtype}")
    if codes.size and (codes.min() < 0 or codes.max() > fmt.white_level):
        raise InputError(
            f"expected codes in 0 .. {fmt.white_level:.0f} for {fmt.name}, found {codes.min()} .. {codes.max()}"
        )
    flat = (codes if fmt.planes == 1 else np.moveaxis(codes, 0, -1)).reshape(-1)
    if fmt.packing == "byte":
        return flat.astype(np.uint8).tobytes()
    if fmt.packing == "word":
        return flat.astype("<u2").tobytes()
    words = flat.astype(np.uint16)
    packed = _pack_lsb(words, fmt.bits) if fmt.packing == "lsb" else _pack_gige(words, fmt.bits)
    return packed.tobytes()[: math.ceil(flat.size * fmt.stored_bits / 8)]


def _groups(data: NDArray[Any], size: int) -> NDArray[Any]:
    """``data`` padded with zeros to whole groups, ``[N, size]``."""
    missing = -data.size % size
    return (np.concatenate([data, np.zeros(missing, data.dtype)]) if missing else data).reshape(-1, size)


def _unpack_lsb(data: NDArray[np.uint8], count: int, bits: int) -> NDArray[np.uint16]:
    """Codes of a little-endian bit stream of 10 or 12 bits, where no code touches more than two bytes."""
    pixels, size = (4, 5) if bits == 10 else (2, 3)
    groups = _groups(data, size).reshape(-1)
    out = np.empty((groups.size // size, pixels), np.uint16)
    for k in range(pixels):
        byte, shift = divmod(k * bits, 8)
        words: NDArray[np.uint16] = np.ndarray((len(out),), "<u2", groups, byte, (size,))
        np.bitwise_and(words >> shift, 2**bits - 1, out=out[:, k])
    return out.reshape(-1)[:count]


def _pack_lsb(codes: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """Twin of `_unpack_lsb`."""
    words = codes.astype("<u2").view(np.uint8).reshape(-1, 2)
    return np.packbits(np.unpackbits(words, axis=1, count=bits, bitorder="little"), bitorder="little")


def _unpack_gige(data: NDArray[np.uint8], count: int, bits: int) -> NDArray[np.uint16]:
    """Codes of GigE Vision's Packed formats of 10 or 12 bits."""
    low = bits - 8
    groups = _groups(data, 3)
    out = np.empty((len(groups), 2), np.uint16)
    for start in range(0, len(groups), BLOCK // 2):
        block = groups[start : start + BLOCK // 2].astype(np.uint16)
        out[start : start + BLOCK // 2, 0] = (block[:, 0] << low) | (block[:, 1] & (2**low - 1))
        out[start : start + BLOCK // 2, 1] = (block[:, 2] << low) | ((block[:, 1] >> 4) & (2**low - 1))
    return out.reshape(-1)[:count]


def _pack_gige(codes: NDArray[np.uint16], bits: int) -> NDArray[np.uint8]:
    """Twin of `_unpack_gige`, padded to whole groups."""
    low = bits - 8
    first, second = _groups(codes, 2).T
    middle = (first & (2**low - 1)) | ((second & (2**low - 1)) << 4)
    return np.stack([first >> low, middle, second >> low], axis=1).astype(np.uint8)
