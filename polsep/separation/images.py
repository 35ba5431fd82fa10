"""One separated frame as NumPy arrays, and the sums over its pixels that its report is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.arguments import WrongType
from polsep.sensor.camera import Layout, require_layout


@dataclass(frozen=True)
class Tally:
    """Sums over the ``pixels`` of a frame or of a part of it; parts add.

    ``clipped``, ``valid``, ``above_one``: pixels with a clipped sample, without an assumption, with DoLP above 1.
    ``s0``, ``specular``: of the means over colours; s0 is diffuse + specular. ``power``, ``along``, ``across``: w |p|,
    w p1 and w p2 for the specular light's polarization p = (p1, p2). The weight w is |p| for closed forms and the
    specular image for networks: highlights count and noise does not. ``residual``, ``noise``: of `Separation`'s, None
    where it has none. ``diffuse_variance``, ``specular_variance``: squares of the expected errors, None likewise.
    """

    pixels: int = 0
    clipped: int = 0
    valid: int = 0
    above_one: int = 0
    s0: float = 0.0
    specular: float = 0.0
    power: float = 0.0
    along: float = 0.0
    across: float = 0.0
    residual: float | None = None
    noise: float | None = None
    diffuse_variance: float | None = None
    specular_variance: float | None = None

    def __add__(self, other: Tally) -> Tally:
        """Sums over the pixels of both; a sum that one of them lacks is the other's."""
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return Tally(*(theirs if mine is None else mine if theirs is None else mine + theirs for mine, theirs in pairs))

    def of_pixels(self, pixels: int) -> Tally:
        """The same means over so many pixels: of a frame seen by several networks, or with a border around it."""
        if pixels == self.pixels:
            return self
        share = pixels / self.pixels
        counts = (round(share * count) for count in (self.clipped, self.valid, self.above_one))
        sums = [*vars(self).values()][4:]
        return Tally(pixels, *counts, *(None if total is None else share * total for total in sums))


@dataclass(frozen=True, eq=False)
class FrameImages:
    """The images of a frame, channels last; streams pass one to be filled again and again.

    ``diffuse``, ``specular``: float32 ``[h, w, C]``; ``valid``: bool ``[h, w]``, as in `Separation`. Made on request,
    else None: ``dolp`` and ``aolp`` [rad], float32 ``[h, w]``, and ``tally``, all of white light and the mean over
    colours. ``error``: float32 ``[h, w, 2]``, expected standard deviation of the errors of diffuse and specular, from
    methods that expect one. What a GPU made are torch tensors there, until `report.on_host`.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    valid: NDArray[np.bool_]
    dolp: NDArray[np.float32] | None = None
    aolp: NDArray[np.float32] | None = None
    tally: Tally | None = None
    error: NDArray[np.float32] | None = None

    @classmethod
    def empty(cls, shape: tuple[int, int], layout: Layout, report: bool = False, full: bool = False) -> FrameImages:
        """Buffers for mosaics of that ``shape`` (H, W) at half or ``full`` resolution, of all whole cells.

        For a ``report`` also for DoLP and AoLP. Raises ValueError on another shape; of wrong types it is a `WrongType`.
        """
        require_layout(layout)
        if not isinstance(shape, Sequence) or not all(isinstance(n, Integral) for n in shape):
            raise WrongType(f"expected the shape (H, W) of mosaics, found {shape!r:.40}")
        if len(shape) != 2 or min(layout.cells(shape)) < 1:
            raise ValueError(f"expected the shape (H, W) of mosaics, found {shape!r:.40}")
        size = 2 if full else 1
        h, w = (size * n for n in layout.cells(shape))
        diffuse, specular = (pages.empty((h, w, layout.channels), np.float32) for _ in range(2))
        dolp, aolp = (pages.empty((h, w), np.float32) if report else None for _ in range(2))
        return cls(diffuse, specular, pages.empty((h, w), np.bool_), dolp, aolp)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The images that there are, by name."""
        return {name: image for name, image in vars(self).items() if isinstance(image, np.ndarray)}
