"""Kernels of `under_highlights`: holes, their rings, and the solution of Laplace's equation in them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import compiled, entry

Floats = NDArray[np.float64]
Places = NDArray[np.int64]

#: Products that are added up side by side.
_LANES = 8


def find_parts(flat: Places, number: NDArray[np.int32], width: int) -> tuple[Places, int]:
    """The connected part, also over corners, that each place of an image belongs to, and how many there are.

    ``flat [N]``: places, ascending, in an image of that ``width`` whose rows are joined; ``number``: their numbers from
    1 on in that image, elsewhere 0. Parts are numbered in the order of their first places.
    """
    part, waiting = np.full(flat.size, -1, np.int64), np.empty(flat.size, np.int64)
    return part, _spread_parts(flat, number, width, part, waiting)


def find_rings(edge: Places, of: Places, shape: tuple[int, int], reach: int) -> tuple[Places, Places]:
    """Pixels up to ``reach`` rows and columns from a hole, in an image of that ``shape``, and the hole of each.

    ``edge [N]``: pixels of holes with a neighbour outside, as places in the image row by row; ``of [N]``: the hole of
    each. Sorted by hole and place. Pixels of holes are among them.
    """
    order = np.argsort(of, kind="stable")
    keys = np.empty(edge.size * (2 * reach + 1) ** 2, np.int64)
    seen = np.zeros(shape[0] * shape[1], np.int32)
    count = _collect_rings(edge[order], of[order], shape, reach, seen, keys)
    found, place = np.divmod(np.sort(keys[:count]), shape[0] * shape[1])
    return place, found


def solve_laplace(
    links: NDArray[np.uint32], count: Floats, known: Floats, start: Floats, limits: tuple[float, int]
) -> Floats:
    """Values ``[N, C]`` of which ``count [N]`` times each is the sum of its neighbours and what is ``known [N, C]``.

    ``links [4, N]``: the numbers of neighbours, N for none. By conjugate gradients from a ``start``, until no residual
    exceeds the first of the ``limits``, or for so many steps.
    """
    size, colors = start.shape
    values = np.zeros((size + 1, colors))  # the last row stands for what is no pixel of a hole
    values[:size] = start
    _descend(links, count, values, known.copy(), *limits)
    return values[:size]


def warm_up() -> None:
    """Load the kernels, or compile them."""
    place = np.zeros(1, np.int64)
    find_parts(place, np.ones(1, np.int32), 1)
    find_rings(place, place, (2, 2), 1)
    for colors in (1, 3):
        solve_laplace(np.ones((4, 1), np.uint32), np.ones(1), np.ones((1, colors)), np.zeros((1, colors)), (0.0, 1))


@entry
def _spread_parts(flat: Any, number: Any, width: int, part: Any, waiting: Any) -> int:
    """Fill ``part``, which is -1, from every place on that no part has reached; return how many parts there are."""
    total, height = 0, number.size // width
    for n in range(flat.size):
        if part[n] >= 0:
            continue
        part[n], waiting[0], count = total, n, 1
        while count > 0:
            count -= 1
            row, col = flat[waiting[count]] // width, flat[waiting[count]] % width
            for i in range(max(row - 1, 0), min(row + 2, height)):
                for j in range(max(col - 1, 0), min(col + 2, width)):
                    other = number[i * width + j] - 1
                    if other >= 0 and part[other] < 0:
                        part[other], waiting[count] = total, other
                        count += 1
        total += 1
    return total


@entry
def _collect_rings(edge: Any, of: Any, shape: tuple[int, int], reach: int, seen: Any, keys: Any) -> int:
    """Write hole times the image's size plus place of every ring's pixel to ``keys``; ``of`` ascends. Their number."""
    count, (height, width) = 0, shape
    for n in range(edge.size):
        row, col = edge[n] // width, edge[n] % width
        for i in range(max(row - reach, 0), min(row + reach + 1, height)):
            for place in range(i * width + max(col - reach, 0), i * width + min(col + reach + 1, width)):
                if seen[place] != of[n] + 1:
                    seen[place] = of[n] + 1
                    keys[count] = of[n] * (height * width) + place
                    count += 1
    return count


@compiled
def _dot(a: Any, b: Any) -> float:
    """Sum of products."""
    sums, whole = np.zeros(_LANES), a.size - a.size % _LANES
    for first in range(0, whole, _LANES):
        x, y = a[first : first + _LANES], b[first : first + _LANES]
        for j in range(_LANES):
            sums[j] += x[j] * y[j]
    total = 0.0
    for j in range(_LANES):
        total += sums[j]
    for j in range(whole, a.size):
        total += a[j] * b[j]
    return total


@compiled
def _largest(a: Any) -> Any:
    """Largest value without sign."""
    most, whole = np.zeros(_LANES), a.size - a.size % _LANES
    for first in range(0, whole, _LANES):
        x = a[first : first + _LANES]
        for j in range(_LANES):
            most[j] = abs(x[j]) if abs(x[j]) > most[j] else most[j]
    for j in range(whole, a.size):
        most[0] = max(most[0], abs(a[j]))
    return most.max()


@compiled
def _apply(links: Any, count: Any, x: Any, changed: Any) -> None:
    """``count`` times each value, less its neighbours' values."""
    right, left, below, above = links[0], links[1], links[2], links[3]
    for n in range(count.size):
        for c in range(x.shape[1]):
            beside = x[right[n], c] + x[left[n], c]
            changed[n, c] = count[n] * x[n, c] - (beside + (x[below[n], c] + x[above[n], c]))


@entry
def _descend(links: Any, count: Any, values: Any, rest: Any, tolerance: float, steps: int) -> None:
    """Conjugate gradients; ``rest`` holds the right side, and is written to."""
    size, colors = rest.shape
    step, moved = np.zeros((size + 1, colors)), np.empty((size, colors))
    x, r, s, m = values.reshape(-1), rest.reshape(-1), step.reshape(-1), moved.reshape(-1)
    _apply(links, count, values, moved)
    for k in range(r.size):
        r[k] -= m[k]
        s[k] = r[k]
    power = _dot(r, r)
    for _ in range(steps):
        if _largest(r) <= tolerance:
            break
        _apply(links, count, step, moved)
        length = power / max(_dot(s[: r.size], m), 1e-30)
        for k in range(r.size):
            x[k] += length * s[k]
            r[k] -= length * m[k]
        before, power = power, _dot(r, r)
        share = power / before
        for k in range(r.size):
            s[k] = r[k] + share * s[k]
