"""Textures laid over images: flat, or along surfaces whose normals are known.

Texture coordinates are in pixels of the image, x to the right and y down, and repeat with the texture. Flat, they are
the pixels' own. Over a surface z(x, y) seen from far away, whose gradient is g, the surface between neighbouring pixels
is longer than a pixel: by the root of its metric I + g gᵀ, which is J = I + g gᵀ / (1 + 1 / n_z). Coordinates (u, v)
whose gradients are nearest to J in least squares over the image follow the shape; they solve Poisson's equation.

Normals: unit vectors ``[h, w, 3]``, x right, y UP, z to the camera; where n_z <= 0 (as zeros) they are unknown, and the
surface is taken as flat.
"""

from __future__ import annotations

from weakref import ref

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

#: Least n_z of a surface (78 degrees); steeper ones are limited to it, or a pixel would span many repeats.
STEEPEST = 0.2


def texture_of(texture: Floats, size: tuple[int, int], repeats: float, normals: Floats | None) -> Floats:
    """The texture ``[h', w', C]`` over an image of ``size``, ``[h, w, C]``; ``repeats`` of it fit into the width.

    Texels are square, and means of texels are taken where several fall on a pixel.
    """
    u, v = flat_coordinates(size) if normals is None else coordinates_on(normals)
    scale = repeats * texture.shape[1] / size[1]
    return sample(texture, (u * np.float32(scale), v * np.float32(scale)), scale)


def flat_coordinates(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """Centres of the pixels, x and y, each ``[h, w]``."""
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float32) + np.float32(0.5) for n in size), indexing="ij")
    return x, y


def coordinates_on(normals: Floats) -> tuple[Floats, Floats]:
    """`unfold`, cached while the same read-only normals are used again: in videos, and under sliders."""
    if normals.flags.writeable:
        return unfold(normals)
    kept = _Last.kept  # read once: threads share it
    if kept is not None and kept[0]() is normals:
        return kept[1]
    found = unfold(normals)
    _Last.kept = ref(normals), found
    return found


class _Last:
    """State: the normals that were unfolded last, while others hold them, and their coordinates."""

    kept: tuple[ref[Floats], tuple[Floats, Floats]] | None = None


def unfold(normals: Floats) -> tuple[Floats, Floats]:
    """Coordinates along the surface in pixels, each ``[h, w]``, that are on average those of the pixels.

    One pair for the whole image: they are continuous across a jump in depth or the outline of an object, and within
    some pixels of it stretch less than the surface.
    """
    known = normals[..., 2] > 0
    n_z = np.where(known, np.maximum(normals[..., 2], np.float32(STEEPEST)), np.float32(1))
    across = np.where(known, -normals[..., 0] / n_z, np.float32(0))
    down = np.where(known, normals[..., 1] / n_z, np.float32(0))
    steep = 1 + np.sqrt(1 + across**2 + down**2)  # 1 + 1 / n_z, also of normals that are not quite unit vectors
    mixed = across * down / steep
    # u and v at once, as real and imaginary part; the unknown is the difference to the flat ones.
    found = _integrate(across**2 / steep + 1j * mixed, mixed + 1j * down**2 / steep)
    x, y = flat_coordinates((normals.shape[0], normals.shape[1]))
    return x + found.real, y + found.imag


def _integrate(across: NDArray[np.complex64], down: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """The image, of mean 0, whose differences to the right and down are nearest to these, by least squares.

    Mirrored at the border, Poisson's equation is solved by one Fourier transform and back.
    Source: Frankot and Chellappa 1988, doi 10.1109/34.3909; the mirror: Simchony et al. 1990, doi 10.1109/34.55103.
    """
    height, width = across.shape
    flow = np.zeros_like(across)
    between = (across[:, 1:] + across[:, :-1]) / 2
    flow[:, :-1] += between
    flow[:, 1:] -= between
    between = (down[1:] + down[:-1]) / 2
    flow[:-1] += between
    flow[1:] -= between
    mirrored = np.concatenate([flow, flow[:, ::-1]], axis=1)
    waves = np.fft.fft2(np.concatenate([mirrored, mirrored[::-1]], axis=0))
    bends = [2 * np.cos(np.pi * np.arange(2 * n, dtype=np.float32) / n) - 2 for n in (height, width)]
    laplacian = bends[0][:, None] + bends[1]
    laplacian[0, 0] = 1
    waves /= laplacian
    waves[0, 0] = 0
    return np.fft.ifft2(waves)[:height, :width].astype(np.complex64, copy=False)


def sample(texture: Floats, at: tuple[Floats, Floats], texels: float) -> Floats:
    """The texture at places ``at`` (x, y) in texels, repeated, ``[h, w, C]``; ``texels`` of them fall on a pixel.

    Linear between texels, and between sizes that are halved until one texel falls on a pixel (Williams 1983, doi
    10.1145/964967.801126): continuous in everything.
    """
    level = float(np.log2(max(texels, 1.0)))
    lower, whole = int(level), texture.shape[:2]
    for _ in range(lower):
        texture = _halve(texture)
    sharp = _between_texels(texture, at, whole)
    share = np.float32(level - lower)
    if share == 0:
        return sharp
    return (1 - share) * sharp + share * _between_texels(_halve(texture), at, whole)


def _halve(texture: Floats) -> Floats:
    """Means of 2x2 texels; an odd row or column at the end is left out, a single one stays."""
    for axis in (0, 1):
        texture = np.swapaxes(texture, 0, axis)
        n = 2 * (texture.shape[0] // 2)
        if n:
            texture = (texture[:n:2] + texture[1:n:2]) * np.float32(0.5)
        texture = np.swapaxes(texture, 0, axis)
    return texture


def _between_texels(texture: Floats, at: tuple[Floats, Floats], whole: tuple[int, int]) -> Floats:
    """Linear interpolation of a repeated texture at places in texels of its ``whole`` size, centres at halves.

    Halved sizes spread over the whole period, also where odd rows or columns were left out.
    """
    height, width, colors = texture.shape
    left, right, x = _neighbours(np.float32(width / whole[1]) * at[0] - np.float32(0.5), width)
    top, bottom, y = _neighbours(np.float32(height / whole[0]) * at[1] - np.float32(0.5), height)
    planes = np.ascontiguousarray(texture.transpose(2, 0, 1)).reshape(colors, height * width)  # gathers single numbers
    top, bottom = width * top, width * bottom
    upper = _mixed(planes, (top + left, top + right), x)
    lower = _mixed(planes, (bottom + left, bottom + right), x)
    upper += y * (lower - upper)
    return np.ascontiguousarray(upper.transpose(1, 2, 0))


def _mixed(planes: Floats, two: tuple[NDArray[np.intp], NDArray[np.intp]], share: Floats) -> Floats:
    """The first of two texels, and the second by its share, ``[C, h, w]``."""
    first, second = (np.take(planes, index, axis=1) for index in two)
    first += share * (second - first)
    return first


def _neighbours(place: Floats, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """The texel before, the one behind, and how far between: 0 to 1."""
    before = np.floor(place)
    index = before.astype(np.intp) % count
    behind = index + 1
    return index, np.where(behind == count, 0, behind), place - before
