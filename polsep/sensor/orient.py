"""Frames of any orientation and crop as a network expects them: filters in one order, sides in whole periods.

A mosaic whose filters are in another order, by a mirror, a transposition or an odd crop, is turned and continued until
they are in the wanted one; its images are turned and cropped back. Mosaics, mono ones too, are continued to multiples
of `PERIOD` by whole periods, so that every added sample lies behind its own filter. Signs of Stokes images follow
`Layout.flipped_horizontal`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from polsep.compute.arrays import Array, namespace, of_kind, window
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import PERIOD, Layout, Mosaic


@dataclass(frozen=True)
class Orientation:
    """Steps from a frame of ``height`` x ``width`` to a wanted one: transposed, mirrored, then continued.

    ``top``, ``left``: samples added there, of the turned frame; below and at the right it is continued to multiples of
    `PERIOD`. ``origin``: first whole cell of the frame as it is, as in `Layout`. ``swapped``: where the wanted order
    has red, the turned frame has blue, and the other way round.
    """

    height: int
    width: int
    transposed: bool = False
    down: bool = False
    across: bool = False
    top: int = 0
    left: int = 0
    origin: tuple[int, int] = (0, 0)
    swapped: bool = False

    @property
    def spans(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Rows and columns of the turned frame that the frame's whole cells take: the first and how many, each."""
        sides = [(self.height, self.origin[0]), (self.width, self.origin[1])]
        down, across = sides[::-1] if self.transposed else sides
        return _span(*down, self.top, self.down), _span(*across, self.left, self.across)

    @property
    def keeps_cells(self) -> bool:
        """True if cells of the turned frame are those of the frame.

        Always in colour. Mono frames cropped at an odd offset have cells of their own, half a cell apart: there
        images of half resolution are best made of full ones that were turned back.
        """
        return all(first % 2 == 0 for first, _ in self.spans)

    def turn(self, frames: Array) -> Array:
        """Frames ``[..., H, W]`` in the wanted order."""
        frames = frames.mT if self.transposed else frames
        frames = self._mirror(frames)
        rows, cols = (_continued(n, o) for n, o in zip(frames.shape[-2:], (self.top, self.left), strict=True))
        return frames[..., of_kind(rows[:, None], frames), of_kind(cols, frames)]

    def _mirror(self, images: Array) -> Array:
        axes = tuple(axis for axis, wanted in ((-2, self.down), (-1, self.across)) if wanted)
        return namespace(images).flip(images, axis=axes)

    def turn_back(self, images: Array, scale: int) -> Array:
        """Images of a turned frame as those of the frame's whole cells; ``scale``: 2 pixels per cell and side, or 1.

        One pixel per cell, where the frame has cells of its own (`keeps_cells`), is the mean of those it lies between;
        of masks, True where one of them is.
        """
        for axis, (first, count) in zip((-2, -1), self.spans, strict=True):
            start, length = first * scale // 2, count * scale // 2
            cells = window(images, start, length, axis)
            if first * scale % 2:
                others = window(images, start + 1, length, axis)
                is_mask = images.dtype == namespace(images).bool
                cells = cells | others if is_mask else 0.5 * (cells + others)
            images = cells
        images = self._mirror(images)
        return images.mT if self.transposed else images

    def turn_back_stokes(self, stokes: Stokes, scale: int) -> Stokes:
        """The same for polarization: s2 changes sign with each mirror, s1 when transposed."""
        s0, s1, s2 = (self.turn_back(s, scale) for s in (stokes.s0, stokes.s1, stokes.s2))
        return Stokes(s0, -s1 if self.transposed else s1, -s2 if self.down != self.across else s2)


def shifts_of(mosaic: Mosaic, wanted: Layout) -> tuple[Orientation, ...]:
    """The shifts by whole cells that bring a mosaic's filters into the ``wanted`` order, all of one size.

    Of colour frames two: a row and a column of cells apart, where the filters are the same but for red and blue.
    Of mono frames four (`cell_shifts`).
    """
    first = orient(mosaic, wanted)
    if wanted.bayer is None:
        return cell_shifts(first)
    shifts = {((s.top - first.top) % PERIOD, (s.left - first.left) % PERIOD): s for s in cell_shifts(first)}
    return shifts[0, 0], replace(shifts[2, 2], swapped=True)


def cell_shifts(orientation: Orientation) -> tuple[Orientation, ...]:
    """The four shifts by whole cells of a turned frame within periods of 4 samples, all of one size.

    Of mono frames, whose filters repeat every 2 samples, each is as good as the one that is given.
    """
    sides = (orientation.height, orientation.width)
    rows, cols = sides[::-1] if orientation.transposed else sides
    tops, lefts = _shifts(rows, orientation.top), _shifts(cols, orientation.left)
    return tuple(replace(orientation, top=top, left=left) for top in tops for left in lefts)


def _shifts(count: int, before: int) -> tuple[int, int]:
    """Samples before a side of ``count``, 2 apart, by which it becomes as many periods."""
    least = before % 2
    first = least if (count + least) % PERIOD in (1, 2) else least + 2
    return first, first + 2


def _span(count: int, origin: int, before: int, mirrored: bool) -> tuple[int, int]:
    """First whole cell of a side of ``count`` samples behind ``before`` more, mirrored or not, and how many samples."""
    whole = (count - origin) // 2 * 2
    return before + (count - origin - whole if mirrored else origin), whole


def _continued(count: int, before: int) -> NDArray[np.int64]:
    """Places of a side of ``count`` samples with ``before`` more, and as many behind as make a multiple of `PERIOD`."""
    places = np.arange(-before, count + (-count - before) % PERIOD)
    # Frames of less than a period are mono ones, which repeat after every cell.
    period = min(PERIOD, count // 2 * 2)
    behind = count - period + (places - count) % period
    return np.where(places < 0, places % period, np.where(places >= count, behind, places))


def orient(mosaic: Mosaic, wanted: Layout) -> Orientation:
    """The orientation that brings a mosaic's filters into the ``wanted`` order; one that keeps the cells if possible.

    Raises ValueError when none does, as for other analyser angles.
    """
    height, width = mosaic.data.shape[-2:]
    return _orient(height, width, mosaic.layout, wanted)


@lru_cache(maxsize=64)  # frames of a stream are alike, and all orientations take 20 ms
def _orient(height: int, width: int, layout: Layout, wanted: Layout) -> Orientation:
    shifted = None
    for candidate, turned in _orientations(height, width, layout):
        if turned.table() == wanted.table():
            if candidate.keeps_cells:
                return candidate
            shifted = shifted or candidate
    if shifted is None:
        raise ValueError(f"expected filters {wanted.spec}, mirrored, turned or cropped, found {layout.spec}")
    return shifted


def _orientations(height: int, width: int, layout: Layout) -> Iterator[tuple[Orientation, Layout]]:
    """Every orientation and what it makes of a layout, the simplest first."""
    for transposed in (False, True):
        rows, cols = (width, height) if transposed else (height, width)
        for down, across in ((False, False), (False, True), (True, False), (True, True)):
            turned = layout.transposed() if transposed else layout
            turned = turned.flipped_vertical(rows) if down else turned
            turned = turned.flipped_horizontal(cols) if across else turned
            for top in range(PERIOD):
                for left in range(PERIOD):
                    made = Orientation(height, width, transposed, down, across, top, left, layout.origin)
                    yield made, turned.rolled(top, left)
