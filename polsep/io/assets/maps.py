"""Textures, masks and normal maps that edits name, as files of any program.

The type of the samples decides, whatever the format. Textures of 8-bit integers are decoded from sRGB to linear light;
16-bit integers and floats are linear already. Integers are scaled so that the largest of their bits is 1. JPEG is
turned as its EXIF data say. Masks are never decoded. Normals (x right, y up, z to the camera) are 2 c - 1 for integers
c in [0, 1]; floats are the vectors themselves.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from polsep.io.raw.frames import read_pages
from polsep.io.raw.photographs import orientation_of
from polsep.io.results.exr import read_exr_layers
from polsep.io.store.errors import InputError, decoding, input_error, naming
from polsep.io.store.header_checks import require_signature, require_size
from polsep.physics.srgb import linear_from_srgb

Floats = NDArray[np.float32]

_PAGED, _PHOTOS = (".png", ".tif", ".tiff", ".npy"), (".jpg", ".jpeg")
#: Files that hold an image.
SUFFIXES = (*_PAGED, *_PHOTOS, ".exr")
#: Shortest vector that counts as a normal: 8 bits and half floats change unit vectors less.
_SHORTEST = 0.5
#: Largest component of a vector that is taken for a normal.
_LONGEST = 1e6


#: How pictures of each EXIF orientation are made upright.
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def read_map(path: Path, kind: str) -> Floats:
    """The ``texture [h, w, C]``, ``mask [h, w]`` or ``normals [h, w, 3]`` of a file, float32, read-only.

    Normals become unit vectors; vectors shorter than half of that, or pointing away from the camera, become 0. Raises
    InputError.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise input_error(path, f"expected an image ({', '.join(SUFFIXES)}), found {suffix or 'no extension'!r}")
    read, white = _read(path, suffix)
    with naming(path):
        codes = _checked(_from_planes(read) if isinstance(read, Mapping) else read)
        decode = {"texture": _as_texture, "mask": _as_mask, "normals": _as_normals}[kind]
        found = decode(codes, white)
        if not np.isfinite(found).all():
            raise InputError("expected finite values, found NaN or infinite ones")
    kept = np.ascontiguousarray(found, dtype=np.float32)
    kept.flags.writeable = False
    return kept


def read_object(path: Path, size: tuple[int, ...]) -> NDArray[np.bool_]:
    """The mask ``[H, W]`` of an object, in a file of that size, or of the raw frame's, which is twice that or larger by
    what cuts cells: an odd last row or column, and with it the first one of a frame whose cells begin at the second.

    Raises InputError.
    """
    found: NDArray[np.bool_] = np.asarray(read_map(path, "mask") > 0.5)
    if tuple(n // 2 * 2 for n in found.shape) == tuple(size):
        found = found[: size[0], : size[1]]
    cut = [n - 2 * half for n, half in zip(found.shape, size, strict=True)]
    if found.shape != size and 0 <= min(cut) <= max(cut) <= 2:  # cells that are cut are not separated
        rows, cols = (slice(n // 2, n // 2 + 2 * half) for n, half in zip(cut, size, strict=True))
        found = found[rows, cols].reshape(size[0], 2, size[1], 2).min(axis=(1, 3))
    if found.shape != size:
        raise input_error(path, f"expected a mask of {list(size)}, found {list(found.shape)}")
    if not found.any():
        raise input_error(path, "expected a mask that holds pixels, found none")
    return found


def hash_map(path: Path) -> str:
    """The sha256 of a file. Raises InputError."""
    with naming(path):
        return hashlib.sha256(path.read_bytes()).hexdigest()


def _read(path: Path, suffix: str) -> tuple[NDArray[Any] | Mapping[str, NDArray[Any]], float | None]:
    """The one image of a file, or its channels by name, and its white level where it names one.

    Photographs are turned as their EXIF data say.
    """
    if suffix == ".exr":
        return read_exr_layers(path), None
    if suffix in _PHOTOS:
        with naming(path), path.open("rb") as stream:
            require_signature(stream, (b"\xff\xd8\xff",), "a JPEG")
            unwarned = warnings.catch_warnings(action="ignore")  # of large pictures, which have a limit of their own
            with decoding("JPEG"), unwarned, Image.open(stream, formats=["JPEG"]) as picture:
                require_size((picture.height, picture.width, 3))
                turn = UPRIGHT.get(orientation_of(picture))
                upright = picture if turn is None else picture.transpose(turn)
                return np.asarray(upright.convert("L" if upright.mode == "L" else "RGB")), None
    page = next(read_pages(path))
    if page.count != 1:
        raise input_error(path, f"expected one image, found {page.count}")
    return page.array, page.white_level


def _checked(codes: NDArray[Any]) -> NDArray[Any]:
    """Codes or values ``[h, w]`` or ``[h, w, 1 or 3]``."""
    if codes.ndim not in (2, 3) or (codes.ndim == 3 and codes.shape[2] not in (1, 3)):
        raise InputError(f"expected an image of 1 or 3 channels, found shape {list(codes.shape)}")
    return codes


def _from_planes(planes: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    for names in ("RGB", "XYZ", "Y"):
        if set(names) <= set(planes):
            _require_no_alpha(planes, names[0])
            return np.stack([planes[name] for name in names], axis=-1)
    raise InputError(f"expected channels R, G and B, or X, Y and Z, or Y, found {', '.join(sorted(planes)[:8])}")


def _require_no_alpha(planes: Mapping[str, NDArray[Any]], name: str) -> None:
    """Raise InputError on an alpha channel that says something: more than one number, and not what channel ``name`` is.

    A matte may lie in it, and colours may be multiplied by it. PNG files with alpha are refused, too.
    """
    alpha = planes.get("A")
    if alpha is None or (alpha == alpha[:1, :1]).all() or np.array_equal(alpha, planes[name]):
        return
    low, high = float(alpha.min()), float(alpha.max())
    raise InputError(f"expected an image without alpha, found a channel A from {low:g} to {high:g}")


def _in_unit(codes: NDArray[Any], white: float | None) -> NDArray[Any]:
    """Integers in [0, 1], 1 = the white level or else the largest of their type; other values as they are."""
    if codes.dtype.kind == "u":
        return codes / np.float32(np.iinfo(codes.dtype).max if white is None else white)
    if codes.dtype.kind in "fb":
        return codes.astype(np.float32)
    raise InputError(f"expected unsigned integers or floats, found {codes.dtype}")


def _as_texture(codes: NDArray[Any], white: float | None) -> NDArray[Any]:
    values = _in_unit(codes, white)
    values = values[..., None] if values.ndim == 2 else values
    if codes.dtype == np.uint8:
        return linear_from_srgb(values)
    if float(values.min()) < 0:
        raise InputError(f"expected reflectance of 0 or more, found {float(values.min()):g}")
    return values


def _as_mask(codes: NDArray[Any], white: float | None) -> NDArray[Any]:
    values = _in_unit(codes, white)
    if values.ndim == 3:
        if (values != values[..., :1]).any():
            raise InputError("expected a grey image as mask, found colours")
        values = values[..., 0]
    if codes.dtype.kind == "u" and codes.max() == 1:  # labels, which as grey would be next to black
        largest = np.iinfo(codes.dtype).max if white is None else white
        raise InputError(f"expected a mask of codes from 0 to {largest:g}, found none above 1")
    if not (values.min() >= 0 and values.max() <= 1):
        raise InputError(f"expected a mask in [0, 1], found {values.min():g} to {values.max():g}")
    return values


def _as_normals(codes: NDArray[Any], white: float | None) -> NDArray[Any]:
    if codes.ndim != 3 or codes.shape[2] != 3:
        raise InputError(f"expected normals of three channels, found shape {list(codes.shape)}")
    vectors = _in_unit(codes, white)
    vectors = 2 * vectors - 1 if codes.dtype.kind == "u" else vectors
    if not (largest := float(np.abs(vectors).max())) <= _LONGEST:
        raise InputError(f"expected vectors of about unit length, found components of {largest:g}")
    length = np.linalg.norm(vectors, axis=2, keepdims=True)
    known = (length >= _SHORTEST) & (vectors[..., 2:] > 0)
    return np.where(known, vectors / np.where(known, length, 1), 0)
