"""The inverse sensor: from one mosaic to all four analysers in all colours at common points.

Every demosaicker is a function ``Mosaic -> Measurements`` with ``data [..., 4, C, h, w]`` (C = 3, or 1 on mono
sensors), its angles sorted as `Layout.angles_deg`, and a clip mask that marks every interpolated sample that a clipped
one contributed to. Values keep black at 0 and white at 1; nothing is rescaled, and results are not clamped.

Full resolution is [H, W] of the mosaic. Half resolution is [H/2, W/2]: the mean over each 2x2 polarizer cell,
co-registered on the cell's centre. The four analysers of a cell sit at different places, so taking them as one point
makes false polarization at every edge; only `demosaic_dave2022` does, because the paper did.

Borders: mosaics are continued by mirroring about the outermost sample (never repeating it), which keeps each
filter's phase, so a uniform polarized field comes out exact to the border.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from array_api_compat import device

from polsep.compute.arrays import Array, constant, is_exporting, namespace, pad_mirror, pad_repeat, window
from polsep.compute.filters import box_mean
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic


def aligned(values: Array, layout: Layout) -> Array:
    """``values [..., H, W]`` from the layout's origin on, cropped to whole 2x2 polarizer cells."""
    (row, col), (height, width) = layout.origin, layout.cells(values.shape)
    return values[..., row : row + 2 * height, col : col + 2 * width]


def repeat_tile(tile: Array, image: Array, block: int) -> Array:
    """``tile [..., 2, 2]``, its places ``block`` x ``block`` pixels large, repeated over ``image [..., H, W]``."""
    rows, cols = (namespace(image).arange(n, device=device(image)) // block % 2 for n in image.shape[-2:])
    return tile[..., rows[:, None], cols]


def split_analysers(values: Array, layout: Layout) -> tuple[Array, list[tuple[int, int]]]:
    """The four analyser planes ``[..., 4, H/2, W/2]`` of a mosaic, and each one's (row, col) inside the cell."""
    values = aligned(values, layout)
    cell = {float(layout.polarizer[row][col]): (row, col) for row in (0, 1) for col in (0, 1)}
    places = [cell[angle] for angle in layout.angles_deg]
    return namespace(values).stack([values[..., row::2, col::2] for row, col in places], axis=-3), places


def correlate(x: Array, taps: tuple[float, ...], axis: int) -> Array:
    """Correlate images ``[..., h, w]`` with an odd number of taps along -1 or -2; borders mirror, keeping phases."""
    if is_exporting():
        return _correlate_exported(x, taps, axis)
    padded, n = pad_mirror(x, len(taps) // 2, axis), x.shape[axis]
    parts = (weight * window(padded, k, n, axis) for k, weight in enumerate(taps) if weight)
    total = next(parts)
    for part in parts:
        total += part
    return total


def _correlate_exported(x: Array, taps: tuple[float, ...], axis: int) -> Array:
    """`correlate` as one node of a graph instead of dozens; three times slower in torch itself."""
    import torch
    from torch.nn import functional

    half = len(taps) // 2
    pads, shape = ((half, half, 0, 0), (1, 1, 1, -1)) if axis == -1 else ((0, 0, half, half), (1, 1, -1, 1))
    padded = functional.pad(x.reshape(-1, 1, *x.shape[-2:]), pads, mode="reflect")
    return functional.conv2d(padded, torch.tensor(taps, dtype=x.dtype).reshape(shape)).reshape(x.shape)


def mean_cells(image: Array) -> Array:
    """Means over 2x2 cells, ``[..., H, W]`` to ``[..., H/2, W/2]``."""
    rows = image[..., 0::2, :] + image[..., 1::2, :]
    return 0.25 * (rows[..., 0::2] + rows[..., 1::2])


def _bayer_bilinear(planes: Array, bayer: str) -> Array:
    """RGB ``[..., 3, h, w]`` of Bayer planes ``[..., h, w]``, each colour interpolated on its own."""
    places = np.array(["RGB".index(color) for color in bayer]).reshape(2, 2)
    red, green, blue = (planes * repeat_tile(constant(places == c, planes), planes, 1) for c in range(3))
    red, blue = (correlate(correlate(x, (0.5, 1.0, 0.5), -1), (0.5, 1.0, 0.5), -2) for x in (red, blue))
    green = correlate(green, (0.25, 0.5, 0.25), -1) + correlate(green, (0.25, 0.5, 0.25), -2)
    return namespace(planes).stack([red, green, blue], axis=-3)


def colors_of(plane: Array, layout: Layout) -> Array:
    """An analyser's plane ``[..., h, w]`` in all the layout's colours ``[..., C, h, w]``."""
    return plane[..., None, :, :] if layout.bayer is None else _bayer_bilinear(plane, layout.bayer)


def _neighbour(x: Array, place: int, axis: int) -> Array:
    """The next sample across the cell's centre line: below/right for place 0, above/left for place 1; edges mirror."""
    n = x.shape[axis]
    pair = ((1, n - 1), (n - 1, 1)) if place == 0 else ((0, 1), (0, n - 1))
    return namespace(x).concat([window(x, first, count, axis) for first, count in pair], axis=axis)


def to_center(x: Array, place: tuple[int, int]) -> Array:
    """Shift a plane by a quarter sample to the cell's centre: weights 3/4 and 1/4 in both directions."""
    for axis in (-2, -1):
        x = 0.75 * x + 0.25 * _neighbour(x, place[axis], axis)
    return x


def interleave(first: Array, second: Array, axis: int) -> Array:
    """Images ``[..., h, w]`` in turns along axis -1 or -2, which becomes twice as long."""
    *batch, height, width = first.shape
    shape = (*batch, height, 2 * width) if axis == -1 else (*batch, 2 * height, width)
    return namespace(first).reshape(namespace(first).stack([first, second], axis=axis), shape)


def _to_full(x: Array, place: tuple[int, int]) -> Array:
    """Interpolate a plane to all pixels of the mosaic: its own samples stay, the others are means of two or four."""
    for axis in (-2, -1):
        between = 0.5 * (x + _neighbour(x, place[axis], axis))
        x = interleave(x, between, axis) if place[axis] == 0 else interleave(between, x, axis)
    return x


def interpolate_analysers(values: Array, layout: Layout) -> Array:
    """Samples ``[..., H, W]`` as all analysers and colours at every pixel ``[..., 4, C, H, W]``, bilinearly."""
    return _interpolate(values, layout, _to_full)


def interpolate_analysers_half(values: Array, layout: Layout) -> Array:
    """Samples ``[..., H, W]`` as all analysers and colours at the cells' centres ``[..., 4, C, H/2, W/2]``."""
    return _interpolate(values, layout, to_center)


def _interpolate(values: Array, layout: Layout, register: Callable[[Array, tuple[int, int]], Array]) -> Array:
    """Bayer bilinear per analyser, then ``register`` each analyser plane."""
    planes, places = split_analysers(values, layout)
    each = [register(colors_of(planes[..., k, :, :], layout), place) for k, place in enumerate(places)]
    return namespace(values).stack(each, axis=-4)


def _demosaic_bilinear(mosaic: Mosaic, interpolate: Callable[[Array, Layout], Array]) -> Measurements:
    """Samples and their clip mask take the same path."""
    layout, clipped = mosaic.layout, mosaic.clipped()
    xp = namespace(clipped)
    mask = interpolate(xp.astype(clipped, xp.float32), layout) > 0 if bool(xp.any(clipped)) else None
    data = interpolate(mosaic.linear(), layout)
    return Measurements(data, layout.angles, mask, bilinear_variance(data))


def bilinear_variance(data: Array) -> Array:
    """Variance ``[..., 1, h, w]`` that bilinear interpolation adds to colour differences of ``data [..., 4, C, h, w]``.

    A missing colour is the mean of its neighbours, so it is off by about the second difference of the brightness: the
    local mean square of what the mean of four neighbours misses of s0.
    """
    xp = namespace(data)
    brightness = 2 * xp.mean(xp.mean(data, axis=-4), axis=-3, keepdims=True)
    tall, wide = (pad_repeat(brightness, 1, axis) for axis in (-2, -1))
    across = tall[..., :-2, :] + tall[..., 2:, :] + wide[..., :-2] + wide[..., 2:]
    missed = brightness - 0.25 * across
    return box_mean(missed * missed, 1)


def demosaic_bilinear(mosaic: Mosaic) -> Measurements:
    """Per-analyser bilinear interpolation to full resolution ``[..., 4, C, H, W]``: what common libraries do."""
    return _demosaic_bilinear(mosaic, interpolate_analysers)


def demosaic_bilinear_half(mosaic: Mosaic) -> Measurements:
    """`demosaic_bilinear` averaged over each 2x2 cell, ``[..., 4, C, H/2, W/2]``, without making the full images."""
    return _demosaic_bilinear(mosaic, interpolate_analysers_half)


def demosaic_dave2022(mosaic: Mosaic) -> Measurements:
    """The paper's regrouping (Sec. 4.1): Bayer bilinear per analyser, the four planes of a cell taken as one point.

    Note: for comparison only. The planes lie half a raw pixel from the cell's centre in four different directions.
    """
    return _demosaic_bilinear(mosaic, lambda values, layout: _interpolate(values, layout, lambda x, place: x))
