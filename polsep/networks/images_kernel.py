"""Kernels after the network of `joint.Joint.half_resolution`: corrections and closed form become images.

They run row after row of packed pixels, each of which makes two rows of images; see `maps_kernel` for those before.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.compute.rows_kernel import AT_ONCE, add_product, add_up, copy, unweave
from polsep.compute.threads import RowRange
from polsep.demosaic.bilinear_kernel import read_pattern
from polsep.demosaic.cells_kernel import Source, read_grid
from polsep.networks.buffers import ChannelsLast, ClosedFormRows, Maps, Taps
from polsep.networks.channels import PERIOD, input_channels
from polsep.networks.maps_kernel import map_guided_rows, map_rows
from polsep.physics.stokes import stokes_inverse
from polsep.physics.stokes_kernel import polarize
from polsep.sensor.camera import Layout
from polsep.sensor.unpack_kernel import as_samples
from polsep.separation.tally_kernel import add_polarization, count_above_one

Floats = NDArray[np.float32]

#: Columns of ``sums``: s0, specular, DoLP above 1, power, power along and across, expected variance of diffuse and of
#: specular, pixels near clipped ones, fit residual.
SUMS = 10
#: Bits of the samples of a packed pixel's first cell.
_CELL = 0b110011
#: Cells of a packed pixel in one row, times what makes a distance of the rms of its two components.
_CELLS = 2 * math.sqrt(2)


class LayerOutputs(NamedTuple):
    """The closed form, and what the layers add to it, of every packed pixel.

    ``change [h, w, 4 C + 8]``: corrections of 4 C diffuse and 4 specular values relative to the local brightness, then
    4 of the closed form's specular light relative to that; ``deviation [h, w, 8]``: expected standard deviations of
    the diffuse errors of four cells, then of the specular ones, relative to the local brightness.
    """

    closed: ClosedFormRows
    change: ChannelsLast
    deviation: ChannelsLast

    @classmethod
    def empty(cls, closed: ClosedFormRows, halves: bool) -> LayerOutputs:
        """Buffers for what the layers fill; deviations are of a kind of float that ``halves`` do not change."""
        h, changes, w = closed.diffuse.shape
        return cls(closed, ChannelsLast.empty((h, w, changes + 8), halves), ChannelsLast.empty((h, w, 8), False))


class Targets(NamedTuple):
    """Images to fill: colours ``[2 h, 2 w C]``, ``error [2 h, 2 w 2]``, others ``[2 h, 2 w]``; ``sums [2 h, 10]``."""

    diffuse: Floats
    specular: Floats
    error: Floats
    valid: NDArray[np.bool_]
    dolp: Floats
    aolp: Floats
    sums: NDArray[np.float64]

    @classmethod
    def empty(cls, shape: tuple[int, int], colors: int) -> Targets:
        """Buffers for images of that ``shape``, and sums of 0."""
        h, w = shape
        diffuse, specular, error = (pages.empty((h, w * n), np.float32) for n in (colors, colors, 2))
        dolp, aolp = (pages.empty((h, w), np.float32) for _ in range(2))
        return cls(diffuse, specular, error, pages.empty((h, w), np.bool_), dolp, aolp, np.zeros((h, SUMS)))


@compiled
def _correct(closed: Any, change: Any, light: Any, moved: Any, image: Any) -> None:
    """The closed form plus ``moved`` plus its correction, not below 0."""
    for j in range(image.size):
        value = closed[j] + moved[j] + change[j] * light[j]
        image[j] = value if value > ZERO else ZERO


@compiled
def spread(row: Any, gain: Any, place: int, image: Any) -> None:
    """Write a row to an image row with a stride, from ``place`` on; the stride follows from the sizes."""
    step = image.size // row.size
    for j in range(row.size):
        image[step * j + place] = gain * row[j]


@compiled
def _write_cells(
    closed: ClosedFormRows, planes: Any, t: int, cell: int, gains: Any, targets: Targets, spare: Any
) -> None:
    """One of the four cells of every packed pixel of row ``t``; ``planes [4 C + 16, w]``: change and deviation."""
    y, side, colors = 2 * t + cell // 2, cell % 2, gains.size
    corrections, gain, deviations = planes[: 4 * colors + 4], planes[4 * colors + 4 + cell], planes[4 * colors + 8 :]
    light = closed.brightness[t]
    image, tau, s0, dolp, aolp, moved = spare[0], spare[1], spare[2], spare[3], spare[4], spare[5]
    specular = closed.specular[t, cell]
    for j in range(moved.size):
        moved[j] = specular[j] * gain[j]
    _correct(specular, corrections[4 * colors + cell], light, moved, tau)
    copy(tau, s0)
    for j in range(moved.size):
        moved[j] = -moved[j]
    for c in range(colors):
        _correct(closed.diffuse[t, 4 * c + cell], corrections[4 * c + cell], light, moved, image)
        add_product(image, np.float32(1 / colors), s0)
        spread(image, gains[c], colors * side + c, targets.diffuse[y])
        spread(tau, gains[c], colors * side + c, targets.specular[y])
    s1, s2 = closed.s1[t, cell], closed.s2[t, cell]
    polarize(s0, s1, s2, dolp, aolp)
    spread(dolp, ONE, side, targets.dolp[y])
    spread(aolp, ONE, side, targets.aolp[y])
    mean_gain = ZERO
    for c in range(colors):
        mean_gain += gains[c] / np.float32(colors)
    sums = targets.sums[y]
    for kind in range(2):
        deviation = deviations[4 * kind + cell]
        for j in range(image.size):
            image[j] = deviation[j] * light[j]
        spread(image, mean_gain, 2 * side + kind, targets.error[y])
        for j in range(image.size):
            image[j] *= image[j]
        sums[6 + kind] += add_up(image)
    sums[0] += add_up(s0)
    sums[1] += add_up(tau)
    sums[2] += count_above_one(dolp, moved)
    add_polarization(tau, s1, s2, image, sums[3:6])


@compiled
def mark_clipped(clipped: Any, y: int, valid: Any, near: Any) -> int:
    """False in ``valid [2 w]`` near cells of which all clips; how many cells of the row are near a clipped sample.

    ``near [2 w + 2]``, uint8, for cells of a row and one more on both sides: 1 where a sample clips, 2 where all do.
    """
    h, w = clipped.shape
    first, last, some = max(y - 1, 0), min(y + 1, 2 * h - 1), np.uint16(0)
    for row in range(first // 2, last // 2 + 1):
        bits = clipped[row]
        for j in range(w):
            some |= bits[j]
    for x in range(2 * w):
        valid[x] = True
    if some == 0:
        return 0
    for x in range(near.size):
        near[x] = 0
    for row in range(first, last + 1):
        bits, shift = clipped[row // 2], np.uint16(8 * (row % 2))
        for j in range(w):
            own = bits[j] >> shift
            left, right = own & _CELL, own >> 2 & _CELL
            near[2 * j + 1] |= (left != 0) + 2 * (left == _CELL)
            near[2 * j + 2] |= (right != 0) + 2 * (right == _CELL)
    count = 0
    for x in range(2 * w):
        around = near[x] | near[x + 1] | near[x + 2]
        valid[x] = around < 2
        count += around != 0
    return count


@entry
def write_rows(outputs: LayerOutputs, gains: Floats, targets: Targets, row_range: RowRange) -> None:
    """Images of a range of the packed rows; ``gains [C]``: the light's colour."""
    closed = outputs.closed
    w = closed.brightness.shape[1]
    spare, near = np.zeros((6, w), np.float32), np.zeros(2 * w + 2, np.uint8)
    changes = 4 * gains.size + 8
    planes = np.empty((changes + 8, w), np.float32)
    for t in range(row_range[0], row_range[1]):
        unweave(outputs.change.floats, outputs.change.halves, t, planes[:changes])
        unweave(outputs.deviation.floats, outputs.deviation.halves, t, planes[changes:])
        for cell in range(4):
            _write_cells(closed, planes, t, cell, gains, targets, spare)
        for y in range(2 * t, 2 * t + 2):
            targets.sums[y, 8] = mark_clipped(closed.clipped, y, targets.valid[y], near)
            targets.sums[y, 9] = _CELLS * add_up(closed.fit_residual[t])


def warm_up() -> None:
    """Load both ways to the maps and what writes the images, or compile them."""
    layout, size = Layout(), 4
    samples = as_samples(np.eye(PERIOD * size, dtype=np.uint8))
    pattern = read_pattern((PERIOD * size, PERIOD * size), layout, 0, 1, (1.0, 1.0, 1.0))
    closed, channels = ClosedFormRows.empty(3, size, size), input_channels(3, ())
    inputs = ChannelsLast.empty((size, size, channels.total), halves=False)
    maps = Maps(*inputs, channels, closed, np.zeros((0, 0, 0), np.float32))
    nothing = np.zeros((4, AT_ONCE), np.int64)
    map_rows(samples, pattern, Taps(np.zeros((4, 9, AT_ONCE), np.float32), nothing, nothing, 3), maps, (0, size))
    grid = read_grid(pattern, layout.angles, stokes_inverse(layout.angles).astype(np.float32))
    map_guided_rows(Source(samples, pattern, grid), maps, (0, size))
    outputs = LayerOutputs.empty(closed, halves=True)
    outputs.change.halves.fill(0)
    write_rows(outputs, np.ones(3, np.float32), Targets.empty((2 * size, 2 * size), 3), (0, size))
