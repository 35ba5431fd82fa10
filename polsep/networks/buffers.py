"""Arrays between raw samples and images, shared by the joint network's kernels and its layers.

Rows are planar, ``[h, n, w]``, of h x w packed pixels; inputs of the layers have channels last.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.networks.channels import InputChannels

Floats = NDArray[np.float32]


class Taps(NamedTuple):
    """The linear filter at half resolution, and its ``colors``.

    ``weight [4, 3 C, K]``: of 4 cells, s0, s1, s2 of C colours, and ``[4, 6 C, K]`` with the details of s0; ``row``,
    ``place [4, K]``: of the samples that a cell's outputs see, their packed row, 0 to 2, and their place in rows
    ``[16, w + 2]``; K is a multiple of `rows_kernel.AT_ONCE`.
    """

    weight: Floats
    row: NDArray[np.int64]
    place: NDArray[np.int64]
    colors: int


class ClosedFormRows(NamedTuple):
    """The closed form of every packed pixel, planar: ``diffuse [h, 4 C, w]``, ``specular``, ``s1``, ``s2 [h, 4, w]``.

    s1 and s2 are means over colours. ``brightness``, ``fit_residual [h, w]``: as in `joint.ClosedForm`; ``clipped
    [h, w]``: a bit per sample of a packed pixel.
    """

    diffuse: Floats
    specular: Floats
    s1: Floats
    s2: Floats
    brightness: Floats
    fit_residual: Floats
    clipped: NDArray[np.uint16]

    @classmethod
    def empty(cls, colors: int, h: int, w: int) -> ClosedFormRows:
        """Buffers for ``[h, w]`` packed pixels."""
        diffuse, specular, s1, s2 = (np.empty((h, n, w), np.float32) for n in (4 * colors, 4, 4, 4))
        brightness, residual = (np.empty((h, w), np.float32) for _ in range(2))
        return cls(diffuse, specular, s1, s2, brightness, residual, np.empty((h, w), np.uint16))


class Maps(NamedTuple):
    """The first pass's outputs. ``floats`` or ``halves [h, w, n]``: the network's input; the other is empty.

    ``halves``: bfloat16 as its bits. ``channels``: where each map lies. ``closed``: the closed form. ``details
    [2 h, 3 C, 2 w]``: of s0, three of every colour; or empty.
    """

    floats: Floats
    halves: NDArray[np.uint16]
    channels: InputChannels
    closed: ClosedFormRows
    details: Floats


class ChannelsLast(NamedTuple):
    """An input or output of the layers ``[h, w, n]``, as float32 or as bits of bfloat16; the other is empty."""

    floats: Floats
    halves: NDArray[np.uint16]

    @classmethod
    def empty(cls, shape: tuple[int, int, int], halves: bool) -> ChannelsLast:
        """A buffer in one of the two precisions."""
        nothing = (0, 0, 0)
        return cls(
            np.empty(nothing if halves else shape, np.float32), np.empty(shape if halves else nothing, np.uint16)
        )

    @property
    def filled(self) -> NDArray[Any]:
        """The array that is not empty."""
        return self.floats if self.floats.size else self.halves
