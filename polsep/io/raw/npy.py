"""NPY and NPZ arrays without pickles: one mosaic, several frames, or four angle images.

A 2-D array is one frame, ``[N, H, W]`` are N frames, ``[H, W, C]`` with C of 1, 3 or 4 is one picture, and
``[N, H, W, C]`` are N of them. NumPy parses the headers, which are checked against the bytes of the file before any
array is made.
Source: NumPy, numpy.lib.format (NPY 1.0 and 2.0; 3.0 differs only for structured types, which are no images).
"""

from __future__ import annotations

import io
import math
import warnings
import zipfile
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from polsep.io.raw.page import Page
from polsep.io.store.errors import decoding
from polsep.io.store.header_checks import SAMPLES, advice, describe, limit, require_signature, require_size

MAGIC = b"\x93NUMPY"

#: Names of four angle images in an archive.
_ANGLE_KEYS = [tuple(f"{prefix}{angle}" for angle in (0, 45, 90, 135)) for prefix in ("", "i", "m")]
_MOSAIC_KEYS = ("raw", "mosaic")
#: NumPy makes no array of more.
_MOST_AXES = 32


def read_npy(path: Path, first: int = 0) -> Iterator[Page]:
    """The frames of an NPY file from ``first`` on, mapped, not loaded. Raises ValueError."""
    with path.open("rb") as stream:
        require_signature(stream, (MAGIC,), "an NPY")
        shape, dtype = _read_header(stream)
        _require_bytes(shape, dtype, path.stat().st_size - stream.tell())
    with decoding("NPY"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    yield from _split(array, first)


def read_npz(path: Path, first: int = 0) -> Iterator[Page]:
    """The frames of an NPZ archive: its only one, one named raw or mosaic, or four named by angle."""
    with path.open("rb") as stream, _open_archive(stream) as archive:
        names = [name.removesuffix(".npy") for name in archive.namelist()]
        arrays = {name: _read_member(archive, name) for name in _choose(names)}
    if len(arrays) == 1:
        yield from _split(next(iter(arrays.values())), first)
        return
    yield Page(stack_angles(arrays), angles=True)


def read_arrays(path: Path, wanted: Container[str]) -> tuple[dict[str, NDArray[Any]], list[str]]:
    """The arrays of an NPZ archive with the names ``wanted``, and the names of all arrays. Raises ValueError."""
    with path.open("rb") as stream, _open_archive(stream) as archive:
        names = list(dict.fromkeys(name.removesuffix(".npy") for name in archive.namelist()))
        return {name: _read_member(archive, name) for name in names if name in wanted}, names


def _open_archive(stream: BinaryIO) -> zipfile.ZipFile:
    require_signature(stream, (b"PK\x03\x04", b"PK\x05\x06"), "an NPZ")
    with decoding("NPZ"):
        return zipfile.ZipFile(stream)


def stack_angles(images: dict[str, NDArray[Any]], kind: str = "angle images") -> NDArray[Any]:
    """Images of one shape and dtype, stacked in their order; ValueError, with their names, when they differ."""
    kinds = {(image.shape, image.dtype.name) for image in images.values()}
    if len(kinds) != 1:
        found = ", ".join(f"{name} {'x'.join(map(str, i.shape))} {i.dtype}" for name, i in images.items())
        raise ValueError(f"expected {kind} of one size and type, found {found}")
    return np.stack(list(images.values()))


def _choose(names: list[str]) -> list[str]:
    """The names to read of an archive: one, or four in the order 0, 45, 90, 135. Raises ValueError."""
    folded = {name.lower(): name for name in names}
    for keys in _ANGLE_KEYS:
        if all(key in folded for key in keys):
            return [folded[key] for key in keys]
    for key in _MOSAIC_KEYS:
        if key in folded:
            return [folded[key]]
    if len(names) == 1:
        return names
    found = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "") or "none"
    raise ValueError(f"expected one array, or raw, or mosaic, or four named 0 45 90 135, found arrays: {found}")


def _read_member(archive: zipfile.ZipFile, name: str) -> NDArray[Any]:
    """One array of an archive; zipfile checks its CRC."""
    known = archive.namelist()
    member = f"{name}.npy" if f"{name}.npy" in known else name
    with decoding("NPZ"), archive.open(member) as stream:
        head = stream.read(1 << 14)
    if not head.startswith(MAGIC):
        raise ValueError(f"expected an NPY array in {member}, found {describe(head[:64])}")
    start = io.BytesIO(head)
    shape, dtype = _read_header(start)
    most = 4 * limit(SAMPLES)
    if math.prod(shape) * dtype.itemsize > 2 * most:
        found = math.prod(shape) * dtype.itemsize
        raise ValueError(f"expected at most {2 * most} bytes in {member}, found {found}{advice(SAMPLES)}")
    _require_bytes(shape, dtype, archive.getinfo(member).file_size - start.tell())
    with decoding("NPZ"), warnings.catch_warnings(), archive.open(member) as stream:
        warnings.simplefilter("ignore")
        array = np.asarray(npy_format.read_array(stream, allow_pickle=False))
        if stream.read(1):  # at the end zipfile checks the CRC
            raise ValueError("more bytes than the header says")
    return array


def _read_header(stream: BinaryIO) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and dtype of the array that follows; the stream is left at its first sample."""
    with decoding("NPY"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # headers written by Python 2 are fine
        version = npy_format.read_magic(stream)
        read = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}.get(version)
        header = None if read is None else read(stream)
    if header is None:
        raise ValueError(f"expected NPY version 1.0 or 2.0, found {version[0]}.{version[1]}")
    shape, _, dtype = header
    if dtype.hasobject:
        raise ValueError("expected an array of numbers, found Python objects, which need a pickle")
    if len(shape) > _MOST_AXES:
        raise ValueError(f"expected an array of at most {_MOST_AXES} axes, found {len(shape)}")
    return shape, dtype


def _require_bytes(shape: tuple[int, ...], dtype: np.dtype[Any], found: int) -> None:
    """Raise ValueError unless ``shape`` is an image of sane size and exactly its bytes follow."""
    if len(shape) < 2:
        raise ValueError(f"expected an array [H, W], found shape {shape}")
    require_size(shape if _is_picture(shape) else shape[1:])
    if min(shape) < 1:
        raise ValueError(f"expected at least one frame, found shape {shape}")
    expected = math.prod(shape) * dtype.itemsize
    if found != expected:
        raise ValueError(f"expected {expected} bytes of samples for {dtype} {shape}, found {found}")


def _is_picture(shape: tuple[int, ...]) -> bool:
    """True for one picture, False for a stack of them."""
    return len(shape) == 2 or (len(shape) == 3 and shape[-1] in (1, 3, 4))


def _split(array: NDArray[Any], first: int) -> Iterator[Page]:
    """The pictures of an array, one by one."""
    if _is_picture(array.shape):
        yield Page(array)
        return
    for index, picture in enumerate(array[first:], first):
        yield Page(picture, index, len(array))
