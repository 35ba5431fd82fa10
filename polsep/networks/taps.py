"""The linear demosaicking filter of a joint network, as its kernels read it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import Array, namespace
from polsep.networks.buffers import Taps
from polsep.networks.channels import HAAR


def pool_outputs(weight: Array) -> Array:
    """Weights of packed full-resolution outputs ``[16 k, ...]``, as those of their means over cells ``[4 k, ...]``."""
    xp = namespace(weight)
    cells = xp.mean(xp.reshape(weight, (-1, 2, 2, 2, 2, *weight.shape[1:])), axis=(2, 4))
    return xp.reshape(cells, (-1, *weight.shape[1:]))


def make_taps(demosaic: NDArray[np.float32], colors: int, width: int, details: bool = False) -> Taps:
    """A filter ``[24 C, 16, 3, 3]`` at half resolution for ``width`` packed pixels, without samples nobody sees.

    ``details``: with those of s0.
    """
    from polsep.compute.rows_kernel import AT_ONCE

    s0 = 16 * colors
    whole = np.concatenate([pool_outputs(demosaic[:s0]), demosaic[s0:]])
    whole = whole.reshape(len(whole), -1)
    if details:
        pixels = demosaic[:s0].reshape(colors, 2, 2, 2, 2, -1).swapaxes(2, 3).reshape(-1, 4, 4, whole.shape[1])
        split = np.einsum("dp,cqpn->cdqn", np.array(HAAR[1:], np.float32) / 4, pixels)
        whole = np.concatenate([whole, split.reshape(-1, whole.shape[1])])
    cells = whole.reshape(-1, 4, whole.shape[1]).swapaxes(0, 1)
    most = max(int(np.count_nonzero(cell.any(axis=0))) for cell in cells)
    shape = (4, most + -most % AT_ONCE)
    weight = np.zeros((4, cells.shape[1], shape[1]), np.float32)
    rows, places = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for k, cell in enumerate(cells):
        seen = np.flatnonzero(cell.any(axis=0))  # plane, row, column
        weight[k, :, : seen.size], rows[k, : seen.size] = cell[:, seen], seen % 9 // 3
        places[k, : seen.size] = seen // 9 * (width + 2) + seen % 3
    return Taps(weight, rows, places, colors)
