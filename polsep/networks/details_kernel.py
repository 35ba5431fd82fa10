"""Twin of `details.Details` around the network: what the pixels of a cell have beyond a smooth image, and full images.

Three passes over the frame, each needs rows around that the one before has finished: the details of s0 beyond what is
guessed from its means (`find_beyond`), how large they are around (`show_details`), and, after the network, the images
(`write_pixels`). Rows of cells are planar; the order of details is that of `details.HAAR`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.compiling import ONE, ZERO, compiled, entry
from polsep.compute.rows import AT_ONCE, add_product, add_up, average, copy, emit, fill, filter_rows, sum_three, weave
from polsep.compute.threads import Piece
from polsep.networks.details import MIN_DETAIL
from polsep.networks.images_kernel import SUMS, Found, Targets, add_polarization, mark_clipped, spread
from polsep.networks.joint import PERIOD
from polsep.networks.maps_kernel import Seen
from polsep.separation.polarization_kernel import polarize

Floats = NDArray[np.float32]

#: Rows and columns of cells that a guess sees, and to how many taps `rows.filter_rows` brings them.
_SIDE = 5
_TAPS = _SIDE**2 + -(_SIDE**2) % AT_ONCE
_LEAST = np.float32(MIN_DETAIL)
#: Pixels of a packed pixel in one row, times what makes a distance of the rms of its two components.
_PIXELS = PERIOD * math.sqrt(2)


class Smooth(NamedTuple):
    """What guesses details from means: ``weight [3, 30]`` of cells in ``row`` and ``place [30]`` of five rows."""

    weight: Floats
    row: NDArray[np.int64]
    place: NDArray[np.int64]


class Shares(NamedTuple):
    """What the network says of details: ``share [24 + 12 (C + 1), h, w]``, of s0's that are diffuse, then specular, and
    corrections of every image relative to the light; ``beyond [2 h, 3 C, 2 w]`` by `find_beyond`; ``smooth``.
    """

    share: Floats
    beyond: Floats
    smooth: Smooth


def read_smooth(weight: Floats) -> Smooth:
    """From ``[3, 1, 5, 5]``."""
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
    """Where the five rows around row ``y`` of ``h`` begin in a ring of as many; the border's are repeated."""
    for k in range(_SIDE):
        starts[k] = min(max(y - 2 + k, 0), h - 1) % _SIDE * size


@compiled
def _guess(smooth: Smooth, ring: Any, starts: Any, found: Any) -> None:
    """Three details ``found [3, n]`` of a row from a ring ``[5, n + 4]`` of means."""
    near = (ring.reshape(-1), starts)
    filter_rows(smooth.weight, (smooth.row, smooth.place), near, (found[0], found[1], found[2]))


@compiled
def _enter_total(base: Any, y: int, colors: int, rings: Any) -> None:
    """Means of s0 of the colours in cell row ``y`` to their rings ``[C, 5, n + 4]``."""
    packed = base[y // 2]
    for c in range(colors):
        row = rings[c, y % _SIDE]
        for side in range(2):
            cell = 2 * (y % 2) + side
            diffuse, specular, out = packed[4 * c + cell], packed[4 * colors + cell], row[2 + side :]
            for j in range(diffuse.size):
                out[2 * j] = diffuse[j] + specular[j]
        _close(row)


@entry
def find_beyond(base: Floats, smooth: Smooth, details: Floats, piece: Piece) -> None:
    """Subtract from the details of a piece of the packed rows what is guessed from the means of s0 in ``base``."""
    h, n = details.shape[0], details.shape[2]
    colors = details.shape[1] // 3
    rings, found = np.empty((colors, _SIDE, n + 4), np.float32), np.empty((3, n), np.float32)
    starts = np.empty(_SIDE, np.int64)
    for y in range(max(2 * piece[0] - 2, 0), min(2 * piece[0] + 2, h)):
        _enter_total(base, y, colors, rings)
    for y in range(2 * piece[0], 2 * piece[1]):
        if y + 2 < h:
            _enter_total(base, y + 2, colors, rings)
        _starts(y, h, n + 4, starts)
        for c in range(colors):
            _guess(smooth, rings[c], starts, found)
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
def show_details(details: Floats, base: Floats, seen: Seen, piece: Piece) -> None:
    """How large details are around the cells of a piece of the packed rows, relative to the light."""
    h, n, colors = details.shape[0], details.shape[2], details.shape[1] // 3
    ring, total, around = (
        np.zeros((3, 3, n + 2), np.float32),
        np.empty(n, np.float32),
        np.empty((3, n), np.float32),
    )
    row, room = np.empty(n // 2, np.float32), np.empty((12, n // 2), np.uint16)
    for y in range(max(2 * piece[0] - 1, 0), min(2 * piece[0] + 1, h)):
        _enter_power(details, y, ring)
    for y in range(2 * piece[0], 2 * piece[1]):
        if y + 1 < h:
            _enter_power(details, y + 1, ring)
        first, last, light = max(y - 1, 0), min(y + 1, h - 1), base[y // 2, 4 * colors + 12]
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
                emit(row, (seen.floats, room, 4 * k + 2 * (y % 2) + side, y // 2))
        if seen.halves.size and y % 2:
            weave(room, seen.halves[y // 2])


@compiled
def _enter_images(found: Found, y: int, rings: Any, spare: Any) -> None:
    """The images at half resolution in cell row ``y``, not limited, to their rings ``[C + 1, 5, n + 4]``."""
    t, images = y // 2, rings.shape[0]
    base, change, light = found.base[t], found.change, found.base[t, 4 * images + 8]
    for side in range(2):
        cell = 2 * (y % 2) + side
        specular, trust = base[4 * images - 4 + cell], change[4 * images + cell, t]
        for j in range(spare.size):
            spare[j] = specular[j] * trust[j]
        for k in range(images):
            closed, more, out = base[4 * k + cell], change[4 * k + cell, t], rings[k, y % _SIDE, 2 + side :]
            sign = ONE if k == images - 1 else -ONE
            for j in range(spare.size):
                out[2 * j] = closed[j] + sign * spare[j] + more[j] * light[j]
    for k in range(images):
        _close(rings[k, y % _SIDE])


@compiled
def _add_details(shares: Shares, place: tuple[int, int], light: Any, room: tuple[Any, Any]) -> None:
    """To the guessed details ``found [3, n]`` of one image in a cell row, what is believed of s0's, and corrections.

    ``place``: the row, and the image. ``room``: these and one row more.
    """
    (y, image), (found, spare) = place, room
    colors, t = shares.beyond.shape[1] // 3, y // 2
    kind, part = 12 * (image // colors), np.float32(1 / colors)
    for k in range(3):
        if image < colors:
            copy(shares.beyond[y, 3 * image + k], spare)
        else:
            fill(ZERO, spare)
            for c in range(colors):
                add_product(shares.beyond[y, 3 * c + k], part, spare)
        for side in range(2):
            cell = 4 * k + 2 * (y % 2) + side
            share, more = shares.share[kind + cell, t], shares.share[24 + 12 * image + cell, t]
            beyond, out = spare[side:], found[k, side:]
            for j in range(share.size):
                out[2 * j] += share[j] * beyond[2 * j] + more[j] * light[j]


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
def _write_errors(found: Found, y: int, gain: Any, work: tuple[Targets, Any]) -> None:
    """Expected errors of the two rows of pixels of cell row ``y``, and the sums of their squares."""
    targets, spare = work
    t, light = y // 2, found.base[y // 2, found.base.shape[1] - 2]
    for kind in range(2):
        for side in range(2):
            doubt = found.doubt[4 * kind + 2 * (y % 2) + side, t]
            for j in range(spare.size):
                spare[j] = doubt[j] * light[j]
            for row in range(2):
                for pixel in range(2):
                    spread(spare, gain, 2 * (2 * side + pixel) + kind, targets.error[2 * y + row])
            for j in range(spare.size):
                spare[j] *= spare[j]
            square = add_up(spare)
            targets.sums[2 * y, 6 + kind] += 2 * square
            targets.sums[2 * y + 1, 6 + kind] += 2 * square


@compiled
def _write_polarization(found: Found, y: int, pixels: tuple[Any, Any], work: tuple[Targets, Any]) -> None:
    """DoLP, AoLP and the report's sums of two rows; ``pixels``: s0 and specular ``[2, m]``; ``work``: ``[5, m]``."""
    (s0, tau), (targets, spare), base = pixels, work, found.base[y // 2]
    first = base.shape[0] - 10
    dolp, aolp, s1, s2 = spare[0], spare[1], spare[2], spare[3]
    for side in range(2):
        cell = 2 * (y % 2) + side
        for pixel in range(2):
            spread(base[first + cell], ONE, 2 * side + pixel, s1)
            spread(base[first + 4 + cell], ONE, 2 * side + pixel, s2)
    for row in range(2):
        polarize(s0[row], s1, s2, dolp, aolp)
        copy(dolp, targets.dolp[2 * y + row])
        copy(aolp, targets.aolp[2 * y + row])
        sums = targets.sums[2 * y + row]
        sums[0] += add_up(s0[row])
        sums[1] += add_up(tau[row])
        for j in range(dolp.size):
            dolp[j] = ONE if dolp[j] > ONE else ZERO
        sums[2] += add_up(dolp)
        add_polarization((tau[row], s1, s2), aolp, sums[3:6])


@compiled
def _write_image(image: int, pixels: Any, gains: Any, work: tuple[Targets, int, Any]) -> None:
    """Two rows of one image ``[2, m]``, a colour of the diffuse light or the specular, and what they add to ``s0``."""
    targets, y, s0 = work
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
def _write_masks(found: Found, y: int, targets: Targets, room: tuple[Any, Any]) -> None:
    """Where two rows are valid, how many of their pixels are near clipped samples, and their misfit."""
    valid, near = room
    clipped = mark_clipped(found.clipped, y, valid, near)
    for row in range(2 * y, 2 * y + 2):
        out, sums = targets.valid[row], targets.sums[row]
        for j in range(valid.size):
            out[2 * j] = out[2 * j + 1] = valid[j]
        sums[8] = 2 * clipped
        sums[9] = _PIXELS * add_up(found.base[y // 2, found.base.shape[1] - 1])


@entry
def write_pixels(found: Found, shares: Shares, gains: Floats, targets: Targets, piece: Piece) -> None:
    """Images at full resolution of a piece of the packed rows; ``gains [C]``: the light's colour.

    ``targets``: as `joint_images.write_rows` has them, of 4 h rows with 4 w pixels.
    """
    h, n, colors = shares.beyond.shape[0], shares.beyond.shape[2], gains.size
    rings, guessed = np.empty((colors + 1, _SIDE, n + 4), np.float32), np.empty((3, n), np.float32)
    starts, spare, wide = np.empty(_SIDE, np.int64), np.empty(n // 2, np.float32), np.empty((4, 2 * n), np.float32)
    pixels, s0, row = np.empty((2, 2 * n), np.float32), np.empty((2, 2 * n), np.float32), np.empty(n, np.float32)
    masks = (np.empty(n, np.bool_), np.zeros(n + 2, np.uint8))
    mean_gain = ZERO
    for c in range(colors):
        mean_gain += gains[c] / np.float32(colors)
    for y in range(max(2 * piece[0] - 2, 0), min(2 * piece[0] + 2, h)):
        _enter_images(found, y, rings, spare)
    for y in range(2 * piece[0], 2 * piece[1]):
        if y + 2 < h:
            _enter_images(found, y + 2, rings, spare)
        _starts(y, h, n + 4, starts)
        fill(ZERO, s0.reshape(-1))
        for k in range(colors + 1):
            _guess(shares.smooth, rings[k], starts, guessed)
            _add_details(shares, (y, k), found.base[y // 2, 4 * colors + 12], (guessed, row))
            _join(rings[k, y % _SIDE, 2:], guessed, pixels)
            _write_image(k, pixels, gains, (targets, y, s0))
        _write_polarization(found, y, (s0, pixels), (targets, wide))
        _write_errors(found, y, mean_gain, (targets, spare))
        _write_masks(found, y, targets, masks)


def warm_up() -> None:
    """Compile the passes of full resolution, or load them from numba's cache on disk."""
    size = 4
    base, clipped = np.zeros((size, 26, size), np.float32), np.zeros((size, size), np.uint16)
    details, share = np.zeros((2 * size, 9, 2 * size), np.float32), np.zeros((72, size, size), np.float32)
    shares = Shares(share, details, read_smooth(np.zeros((3, 1, _SIDE, _SIDE), np.float32)))
    find_beyond(base, shares.smooth, details, (0, size))
    seen = Seen(np.zeros((size, size, 12), np.float32), np.zeros((0, 0, 0), np.uint16))
    show_details(details, base, seen, (0, size))
    found = Found(base, clipped, *(np.zeros((n, size, size), np.float32) for n in (20, 8)))
    side = PERIOD * size
    colors, pairs, grey = (np.zeros((side, side * n), np.float32) for n in (3, 2, 1))
    targets = Targets(colors, colors, pairs, np.zeros((side, side), np.bool_), grey, grey, np.zeros((side, SUMS)))
    write_pixels(found, shares, np.ones(3, np.float32), targets, (0, size))
