"""Twin of `separation.under_highlights` in operations of tensors and two loops, for exported graphs.

Holes are sets of cells, named by the number of their first cell. Where the twin sorts by hole, this adds up by number.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad, pixel_unshuffle

from polsep.separation.under_highlights import (
    CONTRASTS,
    MAX_CLIPPED,
    MAX_HOLE,
    MAX_NOISE,
    MAX_TEXTURE,
    MIN_RING,
    RING,
    SPOILED,
    STEPS,
    SURPRISE,
    TEXTURE,
    TOLERANCE,
)

#: Frame, row and column of pixels.
_Pixels = tuple[Tensor, Tensor, Tensor]
#: Cells around a frame that are never a hole's, so that steps from a hole end in some cell.
_MARGIN = RING + 1


class _Cells(NamedTuple):
    """Cells ``[U]`` of a grid ``[N, h, w]``: frame, row and column of each, and its place in the grid with margins."""

    frame: Tensor
    row: Tensor
    col: Tensor
    place: Tensor

    def pixels(self, scale: int) -> tuple[Tensor, Tensor, Tensor]:
        """Frames, rows and columns ``[U, scale^2]`` of each cell's pixels in an image of ``scale`` pixels per cell."""
        places = [(row, col) for row in range(scale) for col in range(scale)]
        rows = torch.stack([scale * self.row + row for row, _ in places], 1)
        cols = torch.stack([scale * self.col + col for _, col in places], 1)
        return torch.stack([self.frame] * scale**2, 1), rows, cols

    def take(self, chosen: Tensor) -> _Cells:
        """Some of them."""
        return _Cells(self.frame[chosen], self.row[chosen], self.col[chosen], self.place[chosen])


def fill_holes(
    images: tuple[Tensor, Tensor], samples: Tensor, clipped: Tensor, channels: list[int], scale: int
) -> tuple[Tensor, Tensor]:
    """Diffuse images ``[N, h, w, C]`` and their expected errors ``[N, h, w]`` of frames, with holes filled.

    ``images``: both as networks guess them, at half or full resolution. ``samples [N, 1, H, W]``: the frames in white
    light, in Sony's order, with a mask of those that are ``clipped``; ``channels``: the colour of each cell of a 2x2
    block, row by row; ``scale``: pixels along the side of a cell, 1 or 2.
    """
    diffuse = images[0]
    cells, hole, ring, ring_of = _find_holes(clipped)
    count = cells.row.shape[0]

    def add(values: Tensor, of: Tensor) -> Tensor:
        """Sums ``[U, ...]`` by hole."""
        return torch.zeros(count, *values.shape[1:], dtype=values.dtype).index_add(0, of, values)

    planes, texture, usable = _fit_planes((cells.pixels(scale), hole), (ring.pixels(scale), ring_of), diffuse, add)
    seen = pixel_unshuffle(samples, 2).permute(0, 2, 3, 1)[cells.frame, cells.row, cells.col].double()
    channel = torch.tensor(channels)[2 * (cells.row % 2) + cells.col % 2]
    most, least = seen.amax(1)[:, None], seen.amin(1)[:, None]
    own_plane = torch.stack([planes[torch.arange(count), k, channel] for k in range(scale**2)], 1)
    beyond = (most + least - own_plane).clamp(min=0).sum(1)
    contrast = add(scale**2 * (most - least)[:, 0], hole) / add(beyond, hole).clamp(min=1e-9)
    sure = ((contrast - CONTRASTS[0]) / (CONTRASTS[1] - CONTRASTS[0])).clamp(0, 1) * usable

    chosen = torch.nonzero(sure[hole] > 0)[:, 0]
    cells, hole = cells.take(chosen), hole[chosen]
    frame, rows, cols = (x.reshape(-1) for x in cells.pixels(scale))
    own, deviation = (image[frame, rows, cols].double() for image in images)
    start = planes[chosen].reshape(-1, planes.shape[2])
    fill = _solve_laplace(diffuse, (frame, rows, cols), start)
    of = torch.stack([hole] * scale**2, 1).reshape(-1)
    change = fill - own
    size = add(torch.ones_like(deviation), of).clamp(min=1)
    guessed = (add((SURPRISE * deviation) ** 2, of) / size)[:, None]
    apart = (add((change**2).mean(1), of) / size)[:, None]
    off = torch.maximum((TEXTURE * texture) ** 2, apart - guessed)
    weights = (sure[:, None] * guessed / (guessed + off).clamp(min=1e-12))[of]
    filled = (own + weights * change).float()
    less = (deviation * (1 - weights.mean(1)).sqrt()).float()
    return diffuse.index_put((frame, rows, cols), filled), images[1].index_put((frame, rows, cols), less)


def _find_holes(clipped: Tensor) -> tuple[_Cells, Tensor, _Cells, Tensor]:
    """The cells of holes and the hole of each; the cells of rings, once for each hole that is near, and that hole."""
    some = max_pool2d(clipped.float(), 2)
    spoiled = max_pool2d(some, 2 * SPOILED + 1, 1, SPOILED) * (some.mean((1, 2, 3), keepdim=True) <= MAX_CLIPPED)
    inside = pad(torch.ones_like(spoiled), [_MARGIN] * 4)
    spoiled = pad(spoiled, [_MARGIN] * 4)
    width = spoiled.shape[3]
    cells = _cells(spoiled)
    count = cells.place.shape[0]
    number = torch.full_like(spoiled, -1, dtype=torch.int64).reshape(-1)
    number = number.index_put((cells.place,), torch.arange(count))
    steps = torch.tensor([-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1])
    beside = number[cells.place[:, None] + steps]
    beside = torch.where(beside < 0, torch.arange(count)[:, None], beside)
    hole = _spread(beside)
    near = max_pool2d(spoiled, 2 * RING + 1, 1, RING) * inside * (1 - spoiled)
    ring = _cells(near)
    holes = torch.full_like(number, -1).index_put((cells.place,), hole)
    reach = torch.arange(-RING, RING + 1)
    around = holes[ring.place[:, None] + (width * reach[:, None] + reach).reshape(-1)].sort(1).values
    other = torch.cat([torch.ones_like(around[:, :1]), around[:, 1:] - around[:, :-1]], 1)
    which, at = torch.nonzero((other != 0) & (around >= 0)).unbind(1)
    return cells, hole, ring.take(which), around[which, at]


def _cells(mask: Tensor) -> _Cells:
    """The cells of a mask ``[N, 1, h, w]`` with margins."""
    height, width = mask.shape[2:]
    frame, row, col = torch.nonzero(mask[:, 0]).unbind(1)
    # Else an exporter writes bounds of products of sizes that no integer holds.
    torch._check(frame.shape[0] < 2**40)  # type: ignore[no-untyped-call]
    return _Cells(frame, row - _MARGIN, col - _MARGIN, (frame * height + row) * width + col)


def _spread(beside: Tensor) -> Tensor:
    """The least number ``[U]`` of all that are connected, over the neighbours ``[U, K]`` of each.

    Each round takes the least of the neighbours' numbers, and then the number that the cell of that number has.
    """

    def goes_on(changed: Tensor, number: Tensor) -> Tensor:
        return changed.clone()

    def step(changed: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
        found = torch.minimum(number[beside].amin(1), number)
        found = found[found]
        return (found != number).sum() > 0, found  # of none, `any` in ONNX Runtime is true

    return _loop(goes_on, step, (torch.tensor(True), torch.arange(beside.shape[0])))


def _loop(goes_on: Callable[..., Tensor], step: Callable[..., tuple[Tensor, ...]], first: tuple[Tensor, ...]) -> Tensor:
    """The second of the values that ``step`` changes, from the ``first`` ones on, while they let it go on."""
    found: Tensor = torch.while_loop(goes_on, step, first)[1]  # type: ignore[no-untyped-call]
    return found


def _fit_planes(
    holes: tuple[_Pixels, Tensor],
    rings: tuple[_Pixels, Tensor],
    diffuse: Tensor,
    add: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Planes through rings at the pixels of holes ``[U, scale^2, C]``; by hole, the rings' rms from them, and use.

    ``holes``, ``rings``: pixels of cells, and the hole of each cell. A ring in one line gets a plane without a slope.
    """
    (pixels, hole), (frame, rows, cols), of = holes, *rings
    scale = round(rows.shape[1] ** 0.5)
    reach = float(RING * scale)
    places = torch.stack([rows, cols], 2).double()  # [V, scale^2, 2]
    values = diffuse[frame, rows, cols].double()
    count = add(torch.full_like(places[:, 0, 0], float(scale**2)), of)
    total = count.clamp(min=1)
    center, mean = add(places.sum(1), of) / total[:, None], add(values.sum(1), of) / total[:, None]
    offset = (places - center[of][:, None]) / reach
    y, x = offset[..., 0], offset[..., 1]
    squares = add(torch.stack([(y * y).sum(1), (y * x).sum(1), (x * x).sum(1)], 1), of)
    both = torch.stack([(y[..., None] * values).sum(1), (x[..., None] * values).sum(1)], 1)  # [V, 2, C]
    both = add(both, of)
    yy, yx, xx = squares[:, :1], squares[:, 1:2], squares[:, 2:]
    determinant = yy * xx - yx * yx
    inverse = torch.where(determinant > 1e-9 * yy * xx, 1 / determinant.clamp(min=1e-30), torch.zeros_like(yy))
    down, across = inverse * (xx * both[:, 0] - yx * both[:, 1]), inverse * (yy * both[:, 1] - yx * both[:, 0])

    def plane(offset: Tensor, of: Tensor) -> Tensor:
        return mean[of][:, None] + offset[..., :1] * down[of][:, None] + offset[..., 1:] * across[of][:, None]

    rest = values - plane(offset, of)
    texture = (add((rest**2).sum(1), of) / total[:, None]).sqrt()
    light = mean.mean(1)
    usable = ((texture**2).mean(1).sqrt() <= MAX_TEXTURE * light + MAX_NOISE) & (count >= MIN_RING * scale**2)
    usable = usable & (add(torch.ones_like(hole), hole) <= MAX_HOLE)
    own = (torch.stack(pixels[1:], 2).double() - center[hole][:, None]) / reach
    return plane(own, hole), texture, usable


def _solve_laplace(diffuse: Tensor, pixels: _Pixels, start: Tensor) -> Tensor:
    """Values ``[S, C]`` of pixels, each the mean of its four neighbours, by conjugate gradients from a ``start``."""
    frame, rows, cols = pixels
    batch, height, width, colors = diffuse.shape
    size, row = start.shape[0], width + 2
    place = (frame * (height + 2) + rows + 1) * row + cols + 1
    number = torch.full((batch * (height + 2) * row,), size).index_put((place,), torch.arange(size))
    steps = ((0, 1), (0, -1), (1, 0), (-1, 0))
    links = number[place[:, None] + torch.tensor([down * row + across for down, across in steps])]
    count, known = torch.zeros(size, dtype=torch.float64), torch.zeros_like(start)
    for k, (down, across) in enumerate(steps):
        y, x = rows + down, cols + across
        inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
        value = diffuse[frame, y.clamp(0, height - 1), x.clamp(0, width - 1)].double()
        known = known + torch.where((inside & (links[:, k] == size))[:, None], value, torch.zeros_like(value))
        count = count + inside
    # One more row, of zeros, stands for what is no pixel of a hole.
    links = torch.cat([links, torch.full((1, 4), size)])
    count = torch.cat([count, torch.zeros(1, dtype=torch.float64)])[:, None]
    start, known = (torch.cat([x, torch.zeros(1, colors, dtype=torch.float64)]) for x in (start, known))

    def apply(x: Tensor) -> Tensor:
        """``count`` times each value, less its neighbours' values."""
        return count * x - x[links].sum(1)

    def goes_on(step: Tensor, values: Tensor, rest: Tensor, toward: Tensor, power: Tensor) -> Tensor:
        return (rest.abs().max() > TOLERANCE) & (step < STEPS)

    def descend(
        step: Tensor, values: Tensor, rest: Tensor, toward: Tensor, power: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        moved = apply(toward)
        length = power / (toward * moved).sum().clamp(min=1e-30)
        values, rest = values + length * toward, rest - length * moved
        after = (rest**2).sum()
        return step + 1, values, rest, rest + after / power * toward, after

    rest = known - apply(start)
    first = (torch.tensor(0), start, rest, rest.clone(), (rest**2).sum())
    return _loop(goes_on, descend, first)[:size].clamp(min=0)
