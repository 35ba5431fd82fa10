"""Sums over periods and blocks of a raw frame are those of NumPy."""

from __future__ import annotations

import numpy as np
import pytest

from polsep.sensor.noise import blocks_of
from polsep.sensor.periods_kernel import measure_blocks, sum_periods


def codes(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(4).integers(0, 65536, (height, width)).astype(np.float32)


@pytest.mark.parametrize(("side", "lines"), [(4, 4), (12, 4), (16, 16)])
@pytest.mark.parametrize("shape", [(64, 96), (71, 83), (400, 50)])
def test_sums_of_periods(shape: tuple[int, int], side: int, lines: int) -> None:
    x, (rows, cols) = codes(*shape), (n // side for n in shape)
    sums, largest = sum_periods(x, side, lines)
    kept = x[: rows * side, : cols * side].reshape(rows, side, cols, side)[:, :lines]
    periods = kept.reshape(rows, lines // 4, 4, cols, side // 4, 4).sum((1, 4))
    np.testing.assert_array_equal(sums, periods.transpose(1, 3, 0, 2))
    np.testing.assert_array_equal(largest, kept.max((1, 3)))


def test_statistics_of_blocks() -> None:
    """Squares to the bit: noise that a stream measures stays what it was."""
    x = codes(36, 77) * np.float32(0.0371)
    found, blocks = measure_blocks(x), blocks_of(x[:, :76])
    across = blocks[:, 1:-1] - np.float32(0.5) * (blocks[:, :-2] + blocks[:, 2:])
    np.testing.assert_allclose(found.mean, blocks.mean(-1), rtol=1e-6)
    np.testing.assert_array_equal(found.least, blocks.min(-1))
    np.testing.assert_array_equal(found.most, blocks.max(-1))
    np.testing.assert_array_equal(found.square[:, 1:-1], np.square(across).mean(-1) / np.float32(1.5))
    np.testing.assert_allclose(found.variance[:, 1:-1], across.var(-1) / np.float32(1.5), rtol=1e-4)
