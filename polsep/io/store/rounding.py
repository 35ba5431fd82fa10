"""Weights in few values: which layers are written in 8 bits, and how many values they take there.

Of joint networks these are the layers that run in 8 bits where the processor multiplies those, and which compute the
same there from rounded weights, and those that see the whole frame. Of others, layers of `LEAST` numbers or more but
for the first and the last: small layers at high resolution cost most. The largest layers, deep in a network where
images are small, and all of smaller networks, take still fewer values, which wheels compress. docs/weights.md says
what all this costs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Fewest numbers of a layer that is rounded where no ranges are known.
LEAST = 12_000
#: Fewest numbers of layers that take fewer values, and how many on each side of 0, by method; larger ones last.
COARSE = {
    "joint-large": ((130_000, 31),),
    "paper": ((200_000, 31),),
    "material": ((0, 7), (50_000, 5)),
    "shape": ((0, 7), (500_000, 4)),
}
#: Parts of the names of first and last layers.
ENDS = ("encoders.0.0.", "last.")


def names_to_round(arrays: Mapping[str, NDArray[Any]], metadata: Mapping[str, str]) -> set[str]:
    """The names of the arrays that are written in 8 bits."""
    if "ranges" in metadata:
        whole = {name for name in arrays if name.startswith("whole_frame.") and arrays[name].ndim > 1}
        return whole | {f"{layer}.weight" for layer in json.loads(metadata["ranges"])} & arrays.keys()
    large = {name for name, array in arrays.items() if array.ndim > 1 and array.size >= LEAST}
    return {name for name in large if not any(end in name for end in ENDS)}


def steps_of(array: NDArray[Any], method: str) -> int:
    """Values on each side of 0 that a rounded array takes: 127, or as `COARSE` says."""
    return next((count for least, count in reversed(COARSE.get(method, ())) if array.size >= least), 127)


def coarsened(array: NDArray[Any], count: int) -> NDArray[Any]:
    """The array with ``count`` values on each side of 0 for each output, its first axis, up to the largest one.

    Outputs that have no more values already stay: `train.rounding` may leave the largest one out, and steps up to the
    next one would be others.
    """
    step = np.maximum(np.abs(array).max(axis=tuple(range(1, array.ndim)), keepdims=True), 1e-12) / count
    found: NDArray[Any] = (np.round(array / step) * step).astype(np.float32)
    for output, before in zip(found, array, strict=True):
        if len(np.unique(np.abs(before))) <= count + 1:
            output[...] = before
    return found
