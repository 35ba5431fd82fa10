"""Weights of networks in safetensors files: no code in them, and damaged files are refused.

Arrays are in half precision, or in 8 bits: integers from -127 to 127 with a step per output, its first axis, in an
array of that name and `STEPS`.

A file's metadata says which network it is of and how it came about; ``sha256`` there is that of the arrays' names,
shapes and bytes, so that a damaged file is told from a good one. Shipped weights lie in ``polsep/weights``.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Container, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from polsep.compute.arrays import Array, to_numpy
from polsep.io.store.atomic import replace_bytes
from polsep.io.store.errors import one_line

#: Ending of the names of arrays of steps.
STEPS = ".steps"


def digest_arrays(arrays: Mapping[str, NDArray[Any]]) -> str:
    """sha256 over names, dtypes, shapes and bytes."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} torch.{array.dtype} {array.shape}\n".encode())  # the text of the first files
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def write_weights(
    path: Path, arrays: Mapping[str, Array], metadata: dict[str, str], rounded: Container[str] = ()
) -> None:
    """Write arrays, or torch tensors, in half precision, those that ``rounded`` names in 8 bits; atomically."""
    stored: dict[str, NDArray[Any]] = {}
    for name, array in arrays.items():
        if name in rounded:
            stored[name], stored[name + STEPS] = round_array(to_numpy(array))
        else:
            stored[name] = np.ascontiguousarray(to_numpy(array), np.float16)
    data = save(stored, metadata | {"sha256": digest_arrays(stored)})
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])  # whose metadata are in random order: the same weights in other bytes
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode().ljust(size)
    replace_bytes(path, data[:8] + text + data[8 + size :])


def round_array(array: NDArray[Any]) -> tuple[NDArray[np.int8], NDArray[np.float32]]:
    """An array ``[n, ...]`` in 8 bits, and its steps ``[n, 1, ...]``: the largest value of each output is 127 of them.

    The grid is that of layers in 8 bits (`networks.graphs`), which compute the same from the rounded array.
    """
    exact = array.astype(np.float32)
    largest = np.abs(exact).max(axis=tuple(range(1, exact.ndim)), keepdims=True)
    steps = np.where(largest > 0, largest, 1).astype(np.float32) / np.float32(127)
    return np.round(exact / steps).astype(np.int8), steps


def read_weights(path: Path) -> tuple[dict[str, NDArray[np.float32]], dict[str, str]]:
    """Arrays in single precision, and the metadata. Raises ValueError on files that are damaged or not of polsep."""
    try:
        with safe_open(path, framework="np") as file:
            metadata = dict(file.metadata() or {})
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dictionary
    except (OSError, SafetensorError, TypeError, ValueError, KeyError, OverflowError, AttributeError) as error:
        found = one_line(error, 120) or type(error).__name__  # NumPy's own errors are of absurd shapes
        raise ValueError(f"expected weights in {path}, found {found}") from None
    if "method" not in metadata or "sha256" not in metadata:
        raise ValueError(f"expected weights of polsep in {path}, found a safetensors file of something else")
    if digest_arrays(arrays) != metadata["sha256"]:
        raise ValueError(
            f"expected weights with sha256 {one_line(metadata['sha256'], 64)} in {path}, found damaged ones"
        )
    try:
        return _widened(arrays), metadata
    except (KeyError, ValueError):
        raise ValueError(f"expected steps of all arrays in 8 bits in {path}, found others") from None


def _widened(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
    """Arrays in single precision, of half precision or 8 bits. Raises KeyError or ValueError where steps do not fit."""
    steps = {name + STEPS for name, array in arrays.items() if array.dtype == np.int8}
    wide = {name: array.astype(np.float32) for name, array in arrays.items() if name not in steps}
    return {name: array * arrays[name + STEPS] if name + STEPS in steps else array for name, array in wide.items()}


def shipped_weights(name: str) -> Path:
    """The file of shipped weights of that name. Raises ValueError when they are not in the package."""
    path = Path(str(files("polsep") / "weights" / f"{name}.safetensors"))
    if not path.exists():
        raise ValueError(f"expected the weights {name!r} in {path.parent}, found none of that name")
    return path


def is_shipped(name: str) -> bool:
    """Return True when weights of that name are in the package."""
    try:
        shipped_weights(name)
    except ValueError:
        return False
    return True
