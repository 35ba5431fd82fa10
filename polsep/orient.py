"""Frames of any orientation and crop as a network knows them: filters in one order, sides in whole periods.

A mosaic whose filters are in another order by a mirror, a transposition or an odd crop is turned and continued until
they are in the wanted one; images made of it are turned and cropped back. Mosaics are continued by whole periods, so
that every added sample lies behind its own filter. Signs of Stokes images follow `Layout.flipped_horizontal`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from polsep.camera import Layout, Mosaic
from polsep.stokes import Stokes

#: Sides of frames are continued to multiples of the period of colour sensors, mono ones too.
PERIOD = 4


@dataclass(frozen=True)
class Orientation:
    """How a frame of ``height`` x ``width`` becomes a wanted one: transposed, mirrored, then continued.

    ``top``, ``left``: samples added there, of the turned frame; below and at the right it is continued to multiples of
    `PERIOD`.
    """

    height: int
    width: int
    transposed: bool = False
    down: bool = False
    across: bool = False
    top: int = 0
    left: int = 0

    def turn(self, frames: Tensor) -> Tensor:
        """Frames ``[..., H, W]`` in the wanted order."""
        frames = frames.mT if self.transposed else frames
        frames = frames.flip([axis for axis, wanted in ((-2, self.down), (-1, self.across)) if wanted])
        rows, cols = frames.shape[-2:]
        places = (_continued(rows, self.top), _continued(cols, self.left))
        return frames[..., places[0][:, None].to(frames.device), places[1].to(frames.device)]

    def turn_back(self, images: Tensor, scale: int) -> Tensor:
        """Images of a turned frame as those of the frame's whole cells; ``scale``: 2 pixels per cell and side, or 1."""
        rows, cols = (self.width, self.height) if self.transposed else (self.height, self.width)
        spans = [
            ((before + before % 2) // 2, (n - before % 2) // 2) for before, n in ((self.top, rows), (self.left, cols))
        ]
        for axis, (first, count) in zip((-2, -1), spans, strict=True):
            images = images.narrow(axis, scale * first, scale * count)
        images = images.flip([axis for axis, wanted in ((-2, self.down), (-1, self.across)) if wanted])
        return images.mT if self.transposed else images

    def turn_back_stokes(self, stokes: Stokes, scale: int) -> Stokes:
        """The same for polarization: s2 changes sign with each mirror, s1 when transposed."""
        s0, s1, s2 = (self.turn_back(s, scale) for s in (stokes.s0, stokes.s1, stokes.s2))
        return Stokes(s0, -s1 if self.transposed else s1, -s2 if self.down != self.across else s2)


def _continued(count: int, before: int) -> Tensor:
    """Places of a side of ``count`` samples with ``before`` more, and as many behind as make a multiple of `PERIOD`."""
    places = torch.arange(-before, count + (-count - before) % PERIOD)
    places = torch.where(places < 0, places + PERIOD, places)
    return torch.where(places >= count, places - PERIOD, places)


def orient(mosaic: Mosaic, wanted: Layout) -> Orientation:
    """The orientation that brings a mosaic's filters into the ``wanted`` order.

    Raises ValueError when none does, as for other analyser angles.
    """
    height, width = mosaic.data.shape[-2:]
    for candidate, layout in _orientations(height, width, mosaic.layout):
        if layout.table() == wanted.table():
            return candidate
    raise ValueError(f"expected filters {wanted.spec}, mirrored, turned or cropped, found {mosaic.layout.spec}")


def _orientations(height: int, width: int, layout: Layout) -> Iterator[tuple[Orientation, Layout]]:
    """Every orientation and what it makes of a layout, the simplest first; crops by even cells before odd ones."""
    for transposed in (False, True):
        rows, cols = (width, height) if transposed else (height, width)
        for down, across in ((False, False), (False, True), (True, False), (True, True)):
            turned = layout.transposed() if transposed else layout
            turned = turned.flipped_vertical(rows) if down else turned
            turned = turned.flipped_horizontal(cols) if across else turned
            for top in range(PERIOD):
                for left in range(PERIOD):
                    yield Orientation(height, width, transposed, down, across, top, left), turned.rolled(top, left)
