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

import torch
from torch import Tensor
from torch.nn import functional

from polsep.compute.filters import box_mean
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic


def aligned(values: Tensor, layout: Layout) -> Tensor:
    """``values [..., H, W]`` from the layout's origin on, cropped to whole 2x2 polarizer cells."""
    row, col = layout.origin
    height, width = ((n - o) // 2 * 2 for n, o in zip(values.shape[-2:], layout.origin, strict=True))
    return values[..., row : row + height, col : col + width]


def repeat_tile(tile: Tensor, image: Tensor, block: int) -> Tensor:
    """``tile [..., 2, 2]``, its places ``block`` x ``block`` pixels large, repeated over ``image [..., H, W]``."""
    rows, cols = (torch.arange(n, device=image.device) // block % 2 for n in image.shape[-2:])
    return tile[..., rows[:, None], cols]


def split_analysers(values: Tensor, layout: Layout) -> tuple[Tensor, list[tuple[int, int]]]:
    """The four analyser planes ``[..., 4, H/2, W/2]`` of a mosaic, and each one's (row, col) inside the cell."""
    values = aligned(values, layout)
    cell = {float(layout.polarizer[row][col]): (row, col) for row in (0, 1) for col in (0, 1)}
    places = [cell[angle] for angle in layout.angles_deg]
    return torch.stack([values[..., row::2, col::2] for row, col in places], dim=-3), places


def correlate(x: Tensor, taps: tuple[float, ...], dim: int) -> Tensor:
    """Correlate images ``[..., h, w]`` with an odd number of taps along -1 or -2; borders mirror, keeping phases."""
    half, n = len(taps) // 2, x.shape[dim]
    pads = (half, half, 0, 0) if dim == -1 else (0, 0, half, half)
    padded = functional.pad(x.reshape(-1, 1, *x.shape[-2:]), pads, mode="reflect")
    if torch.compiler.is_exporting():  # one node instead of dozens; three times slower in torch itself
        kernel = torch.tensor(taps, dtype=x.dtype).reshape((1, 1, 1, -1) if dim == -1 else (1, 1, -1, 1))
        return functional.conv2d(padded, kernel).reshape(x.shape)
    total = torch.zeros(1, dtype=x.dtype, device=x.device)
    for k, weight in enumerate(taps):
        if weight:
            total = total + weight * padded.narrow(dim, k, n)
    return total.reshape(x.shape)


def mean_cells(image: Tensor) -> Tensor:
    """Means over 2x2 cells, ``[..., H, W]`` to ``[..., H/2, W/2]``."""
    rows = image[..., 0::2, :] + image[..., 1::2, :]
    return 0.25 * (rows[..., 0::2] + rows[..., 1::2])


def _bayer_bilinear(planes: Tensor, bayer: str) -> Tensor:
    """RGB ``[..., 3, h, w]`` of Bayer planes ``[..., h, w]``, each colour interpolated on its own."""
    places = torch.tensor(["RGB".index(color) for color in bayer], device=planes.device).view(2, 2)
    red, green, blue = (planes * repeat_tile((places == c).to(planes.dtype), planes, 1) for c in range(3))
    red, blue = (correlate(correlate(x, (0.5, 1.0, 0.5), -1), (0.5, 1.0, 0.5), -2) for x in (red, blue))
    green = correlate(green, (0.25, 0.5, 0.25), -1) + correlate(green, (0.25, 0.5, 0.25), -2)
    return torch.stack([red, green, blue], dim=-3)


def colors_of(plane: Tensor, layout: Layout) -> Tensor:
    """An analyser's plane ``[..., h, w]`` in all the layout's colours ``[..., C, h, w]``."""
    return plane[..., None, :, :] if layout.bayer is None else _bayer_bilinear(plane, layout.bayer)


def _neighbour(x: Tensor, place: int, dim: int) -> Tensor:
    """The next sample across the cell's centre line: below/right for place 0, above/left for place 1; edges mirror."""
    n = x.shape[dim]
    if place == 0:
        return torch.cat([x.narrow(dim, 1, n - 1), x.narrow(dim, n - 1, 1)], dim)
    return torch.cat([x.narrow(dim, 0, 1), x.narrow(dim, 0, n - 1)], dim)


def to_center(x: Tensor, place: tuple[int, int]) -> Tensor:
    """Shift a plane by a quarter sample to the cell's centre: weights 3/4 and 1/4 in both directions."""
    for dim in (-2, -1):
        x = 0.75 * x + 0.25 * _neighbour(x, place[dim], dim)
    return x


def _to_full(x: Tensor, place: tuple[int, int]) -> Tensor:
    """Interpolate a plane to all pixels of the mosaic: its own samples stay, the others are means of two or four."""
    for dim in (-2, -1):
        between = 0.5 * (x + _neighbour(x, place[dim], dim))
        pair = (x, between) if place[dim] == 0 else (between, x)
        x = torch.stack(pair, dim=dim).flatten(dim - 1, dim)
    return x


def interpolate_analysers(values: Tensor, layout: Layout) -> Tensor:
    """Samples ``[..., H, W]`` as all analysers and colours at every pixel ``[..., 4, C, H, W]``, bilinearly."""
    return _interpolate(values, layout, _to_full)


def interpolate_analysers_half(values: Tensor, layout: Layout) -> Tensor:
    """Samples ``[..., H, W]`` as all analysers and colours at the cells' centres ``[..., 4, C, H/2, W/2]``."""
    return _interpolate(values, layout, to_center)


def _interpolate(values: Tensor, layout: Layout, register: Callable[[Tensor, tuple[int, int]], Tensor]) -> Tensor:
    """Bayer bilinear per analyser, then ``register`` each analyser plane."""
    planes, places = split_analysers(values, layout)
    each = [register(colors_of(planes[..., k, :, :], layout), place) for k, place in enumerate(places)]
    return torch.stack(each, dim=-4)


def _demosaic_bilinear(mosaic: Mosaic, interpolate: Callable[[Tensor, Layout], Tensor]) -> Measurements:
    """Samples and their clip mask take the same path."""
    layout, clipped = mosaic.layout, mosaic.clipped()
    mask = interpolate(clipped.float(), layout) > 0 if bool(clipped.any()) else None
    data = interpolate(mosaic.linear(), layout)
    return Measurements(data, layout.angles, mask, bilinear_variance(data))


def bilinear_variance(data: Tensor) -> Tensor:
    """Variance ``[..., 1, h, w]`` that bilinear interpolation adds to colour differences of ``data [..., 4, C, h, w]``.

    A missing colour is the mean of its neighbours, so it is off by about the second difference of the brightness: the
    local mean square of what the mean of four neighbours misses of s0.
    """
    brightness = 2 * data.mean(dim=-4).mean(dim=-3, keepdim=True)
    flat = functional.pad(brightness.reshape(-1, 1, *brightness.shape[-2:]), (1, 1, 1, 1), mode="replicate")
    across = flat[..., :-2, 1:-1] + flat[..., 2:, 1:-1] + flat[..., 1:-1, :-2] + flat[..., 1:-1, 2:]
    missed = flat[..., 1:-1, 1:-1] - 0.25 * across
    return box_mean(missed * missed, 1).reshape(brightness.shape)


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
