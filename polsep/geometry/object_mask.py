"""The mask of an object before a dark ground, where none was given: where light falls."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polsep.compute.resizing import block_means
from polsep.separation.highlights_kernel import find_parts

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: The object is where light exceeds this share of a level, its 99th percentile.
OBJECT_SHARE = 0.06
#: An object may be smaller than a hundredth of the frame: the level is at least this share of the diffuse light of this
#: block, counted from the brightest one.
SMALL_SHARE, SMALL_BLOCKS = 0.5, 4
#: Side of blocks [pixels]: parts of the object are near one that is mostly bright.
BLOCK = 8
#: Least share of the object's blocks that a connected part has.
SMALLEST_PART = 0.01


def find_object_mask(light: Floats, diffuse: Floats) -> Mask:
    """The mask of an object in an image of all its ``light [h, w]``, without specks and thin lines.

    ``diffuse [h, w]``: its diffuse light. Raises ValueError on a black frame.
    """
    blocks = _cell_means(diffuse)
    level = max(np.percentile(light, 99), SMALL_SHARE * np.sort(blocks, axis=None)[-SMALL_BLOCKS:][0])
    bright: Mask = light > OBJECT_SHARE * level
    if not bright.any() or not light.any():
        raise ValueError("expected light on an object, found a black frame")
    height, width = bright.shape
    solid = _large_parts(_cell_means(bright) > 0.5)
    around = np.pad(solid, 1)
    rows = around[:-2] | around[1:-1] | around[2:]
    near = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    found: Mask = bright & near.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)[:height, :width]
    return found if found.any() else bright


def _cell_means(image: Floats | Mask) -> Floats:
    """Means over blocks of `BLOCK` pixels, the last ones with the border's values."""
    height, width = image.shape
    padded = np.pad(image.astype(np.float32), ((0, -height % BLOCK), (0, -width % BLOCK)), "edge")
    means: Floats = block_means(padded, BLOCK)
    return means


def _large_parts(solid: Mask) -> Mask:
    """The connected parts with at least `SMALLEST_PART` of all cells."""
    flat, number = np.flatnonzero(solid), np.zeros(solid.size, np.int32)
    number[flat] = np.arange(1, flat.size + 1)
    part, _ = find_parts(flat, number, solid.shape[1])
    large = np.zeros(solid.size, np.bool_)
    large[flat] = np.bincount(part)[part] >= SMALLEST_PART * flat.size if flat.size else False
    return large.reshape(solid.shape)
