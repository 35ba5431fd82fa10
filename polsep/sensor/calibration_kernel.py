"""Compiled twin of `calibration.mix_neighbours`: samples of real analysers to those of ideal ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, entry, read_only
from polsep.compute.threads import RowRange, run_over_rows

Floats = NDArray[np.float32]
#: Rows of a strip.
ROWS = 16


@entry
def _mix_rows(x: Any, black: Any, rows: Any, cols: Any, weights: Any, first: int, last: int, mixed: Any) -> None:
    """Rows ``first`` to ``last`` of `mix_neighbours`."""
    period, width = weights.shape[0], x.shape[1]
    near_row, far_row, row_weight = rows
    near_col, far_col, col_weight = cols
    vertical = np.empty(width, np.float32)
    for y in range(first, last):
        w = weights[y % period]
        own, near, far, share = x[y], x[near_row[y]], x[far_row[y]], row_weight[y]
        for j in range(width):
            vertical[j] = share * (near[j] - black) + (ONE - share) * (far[j] - black)
        for j in range(width):
            a, b, u = near_col[j], far_col[j], col_weight[j]
            v = w[j % period]
            across = u * (own[a] - black) + (ONE - u) * (own[b] - black)
            both = u * vertical[a] + (ONE - u) * vertical[b]
            mixed[y, j] = v[0] * (own[j] - black) + v[1] * across + v[2] * vertical[j] + v[3] * both + black


def mix_neighbours(samples: Floats, black: Any, rows: Any, cols: Any, weights: Floats) -> Floats:
    """Return `calibration.mix_neighbours` of a frame, in threads."""
    mixed, given, places = np.empty_like(samples), read_only(samples), (tuple(rows), tuple(cols))

    def mix(band: RowRange) -> None:
        _mix_rows(given, black, *places, weights, *band, mixed)

    run_over_rows(mix, samples.shape[0], ROWS)
    return mixed
