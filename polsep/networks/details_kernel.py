"""Kernels of `details.Details` around the network: details of s0 beyond a smooth image, and full images.

Three passes over the frame, each on finished rows of the one before: details of s0 less those interpolated from its
means (`find_beyond`), their size around each cell (`emit_details`), and, after the network, the images
(`write_pixels`). Rows of cells are planar; the order of details is that of `channels.HAAR`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.compute.rows_kernel import (
    AT_ONCE,
    add_product,
    add_up,
    average,
    copy,
    emit,
    fill,
    filter_rows,
    sum_three,
    unweave,
    weave,
)
from polsep.compute.threads import RowRange
from polsep.networks.buffers import ChannelsLast, ClosedFormRows
from polsep.networks.channels import DETAIL_MAPS, MIN_DETAIL, PERIOD
from polsep.networks.images_kernel import LayerOutputs, Targets, mark_clipped, spread
from polsep.physics.stokes_kernel import polarize
from polsep.separation.tally_kernel import add_polarization, count_above_one

Floats = NDArray[np.float32]

#: Rows and columns of cells that a guess sees, and to how many taps `rows_kernel.filter_rows` brings them.
_SIDE = 5
_TAPS = _SIDE**2 + -(_SIDE**2) % AT_ONCE
_LEAST = np.float32(MIN_DETAIL)
#: Pixels of a packed pixel in one row, times what makes a distance of the rms of its two components.
_PIXELS = PERIOD * math.sqrt(2)


class Smooth(NamedTuple):
    """Interpolation of details from means: ``weight [3, 30]`` of cells in ``row`` and ``place [30]`` of five rows."""

    weight: Floats
    row: NDArray[np.int64]
    place: NDArray[np.int64]


class DetailOutputs(NamedTuple):
    """The layers' outputs on three details of four cells.

    ``shares [h, w, 24]``: the share of s0's further details in the diffuse image, then in the specular one; ``change
    [h, w, 12 (C + 1)]``: corrections of every image relative to the local brightness. ``beyond [2 h, 3 C, 2 w]``: by
    `find_beyond`; ``smooth``: the interpolation.
    """

    shares: ChannelsLast
    change: ChannelsLast
    beyond: Floats
    smooth: Smooth

    @classmethod
    def empty(cls, colors: int, beyond: Floats, smooth: Smooth, halves: bool) -> DetailOutputs:
        """Buffers for what the layers fill."""
        h, w = beyond.shape[0] // 2, beyond.shape[2] // 2
        shares, change = (ChannelsLast.empty((h, w, n * DETAIL_MAPS), halves) for n in (2, colors + 1))
        return cls(shares, change, beyond, smooth)


def read_smooth(weight: Floats) -> Smooth:
    """The interpolation of a filter ``[3, 1, 5, 5]``."""
    rows, places = np.divmod(np.arange(_TAPS), _SIDE)
    taps = np.zeros((3, _TAPS), np.float32)
    taps[:, : _SIDE**2] = weight.reshape(3, -1)
    inside = np.arange(_TAPS) < _SIDE**2
    return Smooth(taps, np.where(inside, rows, 0), np.where(inside, places, 0))


@compiled
def _close(row: Any) -> None:
    """Repeat the outermost of ``row [n + 4]`` in its margins."""
    n = row.size
    row[0] = row[1] = row[2]
    row[n - 1] = row[n - 2] = row[n - 3]


@compiled
def _starts(y: int, h: int, size: int, starts: Any) -> None:
    """Starts of the five rows around row ``y`` of ``h`` in a ring of as many; the border's are repeated."""
    for k in range(_SIDE):
        starts[k] = min(max(y - 2 + k, 0), h - 1) % _SIDE * size


@compiled
def _interpolate(smooth: Smooth, ring: Any, starts: Any, found: Any) -> None:
    """Three details ``found [3, n]`` of a row from a ring ``[5, n + 4]`` of means."""
    x = ring.reshape(-1)
    filter_rows(smooth.weight, smooth.row, smooth.place, x, starts, found[0], found[1], found[2])


@compiled
def _enter_total(closed: ClosedFormRows, y: int, colors: int, rings: Any) -> None:
    """Means of s0 of the colours in cell row ``y`` to their rings ``[C, 5, n + 4]``."""
    for c in range(colors):
        row = rings[c, y % _SIDE]
        for side in range(2):
            cell = 2 * (y % 2) + side
            diffuse, specular, out = (
                closed.diffuse[y // 2, 4 * c + cell],
                closed.specular[y // 2, cell],
                row[2 + side :],
            )
            for j in range(diffuse.size):
                out[2 * j] = diffuse[j] + specular[j]
        _close(row)


@entry
def find_beyond(closed: ClosedFormRows, smooth: Smooth, details: Floats, row_range: RowRange) -> None:
    """Subtract from the details of a range of the packed rows those of a smooth image with its means of s0."""
    h, n = details.shape[0], details.shape[2]
    colors = details.shape[1] // 3
    rings, found = np.empty((colors, _SIDE, n + 4), np.float32), np.empty((3, n), np.float32)
    starts = np.empty(_SIDE, np.int64)
    for y in range(max(2 * row_range[0] - 2, 0), min(2 * row_range[0] + 2, h)):
        _enter_total(closed, y, colors, rings)
    for y in range(2 * row_range[0], 2 * row_range[1]):
        if y + 2 < h:
            _enter_total(closed, y + 2, colors, rings)
        _starts(y, h, n + 4, starts)
        for c in range(colors):
            _interpolate(smooth, rings[c], starts, found)
            for k in range(3):
                row, guess = details[y, 3 * c + k], found[k]
                for j in range(n):
                    row[j] -= guess[j]


@compiled
def _enter_power(details: Any, y: int, ring: Any) -> None:
    """Means over colours of the squared details of row ``y``, to a ring ``[3, 3, n + 2]`` with margins of zero."""
    colors = details.shape[1] // 3
    share = np.float32(1 / colors)
    for k in range(3):
        row = ring[y % 3, k]
        fill(ZERO, row)
        inner = row[1:-1]
        for c in range(colors):
            x = details[y, 3 * c + k]
            for j in range(x.size):
                inner[j] += x[j] * x[j] * share


@entry
def emit_details(details: Floats, closed: ClosedFormRows, inputs: ChannelsLast, row_range: RowRange) -> None:
    """Size of the details around the cells of a range of the packed rows, relative to the local brightness."""
    h, n = details.shape[0], details.shape[2]
    ring, total, around = (
        np.zeros((3, 3, n + 2), np.float32),
        np.empty(n, np.float32),
        np.empty((3, n), np.float32),
    )
    row, room = np.empty(n // 2, np.float32), np.empty((12, n // 2), np.uint16)
    for y in range(max(2 * row_range[0] - 1, 0), min(2 * row_range[0] + 1, h)):
        _enter_power(details, y, ring)
    for y in range(2 * row_range[0], 2 * row_range[1]):
        if y + 1 < h:
            _enter_power(details, y + 1, ring)
        first, last, light = max(y - 1, 0), min(y + 1, h - 1), closed.brightness[y // 2]
        for k in range(3):
            fill(ZERO, around[k])
            for t in range(first, last + 1):
                power = ring[t % 3, k]
                sum_three(power, power[1:], power[2:], total)
                add_product(total, ONE, around[k])
            average(around[k], 1, np.float32(last - first + 1))
            for side in range(2):
                x = around[k, side:]
                for j in range(row.size):
                    row[j] = np.log(x[2 * j] / (light[j] * light[j]) + _LEAST)
                emit(row, inputs.floats, room, 4 * k + 2 * (y % 2) + side, y // 2)
        if inputs.halves.size and y % 2:
            weave(room, inputs.halves[y // 2])


@compiled
def _enter_images(outputs: LayerOutputs, y: int, planes: Any, rings: Any, spare: Any) -> None:
    """The images at half resolution in cell row ``y``, not limited, to their rings ``[C + 1, 5, n + 4]``.

    ``planes [4 C + 8, n / 2]``: the layers' changes in that packed row, filled at an even ``y``.
    """
    t, colors, closed = y // 2, rings.shape[0] - 1, outputs.closed
    if y % 2 == 0:
        unweave(outputs.change.floats, outputs.change.halves, t, planes)
    light = closed.brightness[t]
    for side in range(2):
        cell = 2 * (y % 2) + side
        specular, gain = closed.specular[t, cell], planes[4 * colors + 4 + cell]
        for j in range(spare.size):
            spare[j] = specular[j] * gain[j]
        for c in range(colors):
            own, change = closed.diffuse[t, 4 * c + cell], planes[4 * c + cell]
            out = rings[c, y % _SIDE, 2 + side :]
            for j in range(spare.size):
                out[2 * j] = own[j] - spare[j] + change[j] * light[j]
        change, out = planes[4 * colors + cell], rings[colors, y % _SIDE, 2 + side :]
        for j in range(spare.size):
            out[2 * j] = specular[j] + spare[j] + change[j] * light[j]
    for k in range(colors + 1):
        _close(rings[k, y % _SIDE])


@compiled
def _add_details(beyond: Any, planes: Any, y: int, image: int, light: Any, details: Any, spare: Any) -> None:
    """Add to the interpolated ``details [3, n]`` of an image in cell row ``y`` its share of s0's, and corrections.

    ``planes [24 + 12 (C + 1), n / 2]``: the layers' outputs in that row.
    """
    colors = beyond.shape[1] // 3
    shares, change, part = planes[: 2 * DETAIL_MAPS], planes[2 * DETAIL_MAPS :], np.float32(1 / colors)
    for k in range(3):
        if image < colors:
            copy(beyond[y, 3 * image + k], spare)
        else:
            fill(ZERO, spare)
            for c in range(colors):
                add_product(beyond[y, 3 * c + k], part, spare)
        for side in range(2):
            cell = 4 * k + 2 * (y % 2) + side
            share = shares[cell if image < colors else DETAIL_MAPS + cell]
            more, other, out = change[DETAIL_MAPS * image + cell], spare[side:], details[k, side:]
            for j in range(share.size):
                out[2 * j] += share[j] * other[2 * j] + more[j] * light[j]


@compiled
def _join(means: Any, found: Any, pixels: Any) -> None:
    """Means ``[n]`` and details ``[3, n]`` of cells to two rows of pixels ``[2, 2 n]``, not below 0."""
    across, down, diagonal, top, bottom = found[0], found[1], found[2], pixels[0], pixels[1]
    for j in range(across.size):
        above, below = means[j] + down[j], means[j] - down[j]
        first, second = across[j] + diagonal[j], across[j] - diagonal[j]
        a, b, c, d = above + first, above - first, below + second, below - second
        top[2 * j] = a if a > ZERO else ZERO
        top[2 * j + 1] = b if b > ZERO else ZERO
        bottom[2 * j] = c if c > ZERO else ZERO
        bottom[2 * j + 1] = d if d > ZERO else ZERO


@compiled
def _write_errors(deviations: Any, light: Any, y: int, gain: Any, targets: Targets, spare: Any) -> None:
    """Expected errors of the two rows of pixels of cell row ``y``, and the sums of their squares."""
    for kind in range(2):
        for side in range(2):
            deviation = deviations[4 * kind + 2 * (y % 2) + side]
            for j in range(spare.size):
                spare[j] = deviation[j] * light[j]
            for row in range(2):
                for pixel in range(2):
                    spread(spare, gain, 2 * (2 * side + pixel) + kind, targets.error[2 * y + row])
            for j in range(spare.size):
                spare[j] *= spare[j]
            square = add_up(spare)
            targets.sums[2 * y, 6 + kind] += 2 * square
            targets.sums[2 * y + 1, 6 + kind] += 2 * square


@compiled
def _write_polarization(closed: ClosedFormRows, y: int, s0: Any, tau: Any, targets: Targets, spare: Any) -> None:
    """DoLP, AoLP and the report's sums of two rows of s0 and specular light ``[2, m]``; ``spare [4, m]``."""
    dolp, aolp, s1, s2 = spare[0], spare[1], spare[2], spare[3]
    for side in range(2):
        cell = 2 * (y % 2) + side
        for pixel in range(2):
            spread(closed.s1[y // 2, cell], ONE, 2 * side + pixel, s1)
            spread(closed.s2[y // 2, cell], ONE, 2 * side + pixel, s2)
    for row in range(2):
        polarize(s0[row], s1, s2, dolp, aolp)
        copy(dolp, targets.dolp[2 * y + row])
        copy(aolp, targets.aolp[2 * y + row])
        sums = targets.sums[2 * y + row]
        sums[0] += add_up(s0[row])
        sums[1] += add_up(tau[row])
        sums[2] += count_above_one(dolp, aolp)
        add_polarization(tau[row], s1, s2, aolp, sums[3:6])


@compiled
def _write_image(image: int, pixels: Any, gains: Any, targets: Targets, y: int, s0: Any) -> None:
    """Two rows of one image ``[2, m]``, a colour of the diffuse light or the specular, and what they add to ``s0``."""
    colors = gains.size
    for i in range(2):
        if image < colors:
            add_product(pixels[i], np.float32(1 / colors), s0[i])
            spread(pixels[i], gains[image], image, targets.diffuse[2 * y + i])
            continue
        add_product(pixels[i], ONE, s0[i])
        for c in range(colors):
            spread(pixels[i], gains[c], c, targets.specular[2 * y + i])


@compiled
def _write_masks(closed: ClosedFormRows, y: int, targets: Targets, valid: Any, near: Any) -> None:
    """Validity of two rows, and sums of their pixels near clipped samples and of their fit residual."""
    clipped = mark_clipped(closed.clipped, y, valid, near)
    for row in range(2 * y, 2 * y + 2):
        out, sums = targets.valid[row], targets.sums[row]
        for j in range(valid.size):
            out[2 * j] = out[2 * j + 1] = valid[j]
        sums[8] = 2 * clipped
        sums[9] = _PIXELS * add_up(closed.fit_residual[y // 2])


@entry
def write_pixels(
    outputs: LayerOutputs, details: DetailOutputs, gains: Floats, targets: Targets, row_range: RowRange
) -> None:
    """Images at full resolution of a range of the packed rows; ``gains [C]``: the light's colour.

    ``targets``: as of `images_kernel.write_rows`, of 4 h rows with 4 w pixels.
    """
    h, n, colors, closed = details.beyond.shape[0], details.beyond.shape[2], gains.size, outputs.closed
    rings, own = np.empty((colors + 1, _SIDE, n + 4), np.float32), np.empty((3, n), np.float32)
    starts, spare, wide = np.empty(_SIDE, np.int64), np.empty(n // 2, np.float32), np.empty((4, 2 * n), np.float32)
    pixels, s0, row = np.empty((2, 2 * n), np.float32), np.empty((2, 2 * n), np.float32), np.empty(n, np.float32)
    valid, near = np.empty(n, np.bool_), np.zeros(n + 2, np.uint8)
    planes, mean_gain = np.empty((DETAIL_MAPS * (colors + 3), n // 2), np.float32), ZERO
    changes, deviations = np.empty((4 * colors + 8, n // 2), np.float32), np.empty((8, n // 2), np.float32)
    for c in range(colors):
        mean_gain += gains[c] / np.float32(colors)
    for y in range(max(2 * row_range[0] - 2, 0), min(2 * row_range[0] + 2, h)):
        _enter_images(outputs, y, changes, rings, spare)
    for y in range(2 * row_range[0], 2 * row_range[1]):
        if y + 2 < h:
            _enter_images(outputs, y + 2, changes, rings, spare)
        if y % 2 == 0:
            unweave(details.shares.floats, details.shares.halves, y // 2, planes[: 2 * DETAIL_MAPS])
            unweave(details.change.floats, details.change.halves, y // 2, planes[2 * DETAIL_MAPS :])
            unweave(outputs.deviation.floats, outputs.deviation.halves, y // 2, deviations)
        _starts(y, h, n + 4, starts)
        fill(ZERO, s0.reshape(-1))
        for k in range(colors + 1):
            _interpolate(details.smooth, rings[k], starts, own)
            _add_details(details.beyond, planes, y, k, closed.brightness[y // 2], own, row)
            _join(rings[k, y % _SIDE, 2:], own, pixels)
            _write_image(k, pixels, gains, targets, y, s0)
        _write_polarization(closed, y, s0, pixels, targets, wide)
        _write_errors(deviations, closed.brightness[y // 2], y, mean_gain, targets, spare)
        _write_masks(closed, y, targets, valid, near)


def warm_up() -> None:
    """Load the passes of full resolution, or compile them."""
    size = 4
    closed, beyond = ClosedFormRows.empty(3, size, size), np.zeros((2 * size, 9, 2 * size), np.float32)
    smooth = read_smooth(np.zeros((3, 1, _SIDE, _SIDE), np.float32))
    find_beyond(closed, smooth, beyond, (0, size))
    emit_details(beyond, closed, ChannelsLast.empty((size, size, DETAIL_MAPS), halves=False), (0, size))
    outputs, details = LayerOutputs.empty(closed, halves=True), DetailOutputs.empty(3, beyond, smooth, halves=True)
    for layer in (outputs.change, details.shares, details.change):
        layer.halves.fill(0)
    targets = Targets.empty((PERIOD * size, PERIOD * size), 3)
    write_pixels(outputs, details, np.ones(3, np.float32), targets, (0, size))
