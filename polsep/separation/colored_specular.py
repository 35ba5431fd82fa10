"""Specular light that does not have the lamp's colour: metals, tinted highlights, and what bodies keep polarized.

Methods that assume white specular light leave its colour in the diffuse image. That part shows: it is
polarized as highlights are. The polarization along the lamp's is regressed on the diffuse image, both as deviations
from their mean over colours. Diffuse light of dielectrics has slopes of at most 0.3, and that only at
grazing angles; diffuse images of gold have 1 and more. There the whole polarized light becomes specular.

A little of that polarization, the same all over a frame, is of another kind: `retained_polarization`. White specular
light in the diffuse image is a lamp's that is not fully polarized: `lamp_polarization`.

Evidence is taken per period of the mosaic, 4x4 pixels, whose cells show one colour each, and must fill 3x3 periods, so
that colour fringes of edges do not count, and a part of the frame. Source: this project's; that metals tint highlights
and dielectrics do not is the dichromatic model (Shafer 1985, doi:10.1002/col.5080100409).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from array_api_compat import is_torch_array

from polsep.compute.arrays import (
    Array,
    constant,
    contiguous,
    namespace,
    to_numpy,
    to_numpy_together,
)
from polsep.compute.filters import largest_around
from polsep.compute.resizing import block_means, resize_area, resize_bilinear
from polsep.compute.warm_up import make_ready
from polsep.demosaic.bilinear import split_analysers
from polsep.physics.stokes import Measurements, Stokes, fit_stokes
from polsep.sensor.camera import PERIOD, Mosaic
from polsep.separation import places_kernel
from polsep.separation.images import FrameImages, Tally
from polsep.separation.lamp_polarization import Places, find_unpolarized, measure_places
from polsep.separation.retained_polarization import find_missing, find_retained

#: Slopes from which on, and up to which, diffuse light turns into specular light.
SLOPES = (0.4, 0.7)
#: Raw pixels along the side of the least frame, and from which on a ninth of it shows what bodies retain.
MIN_SIZE, MANY = 80, 1500
#: Contrast of colours that counts as none: variance [white^2], and relative to the squared brightness.
MIN_CONTRAST, MIN_RELATIVE = 1e-4, 1e-2
#: Least share of the frame, and the largest gain of an image by its samples.
MIN_SHARE, MAX_GAIN = 0.002, 1.5


class Periods(NamedTuple):
    """Images ``[3, h, w]`` with a pixel per period of the mosaic, in white light.

    ``s0``, ``polarized``, ``across``: of the samples, all light, that along the lamp's polarization, and at 45 degrees
    to it; ``diffuse``, ``total``: of a method, the latter with its specular light.
    """

    s0: Array
    polarized: Array
    across: Array
    diffuse: Array
    total: Array


class Colored(NamedTuple):
    """Specular light of a frame that is not white or not fully polarized.

    ``share`` of a frame whose specular light has another colour; share of its diffuse light that is ``retained``;
    ``unpolarized``: specular light that the diffuse image had, over that of the specular image.
    """

    share: float = 0.0
    retained: float = 0.0
    unpolarized: float = 0.0

    @property
    def lamp_dolp(self) -> float:
        """The lamp's degree of polarization, 1 where nothing else is proven."""
        return 1 / (1 + self.unpolarized)

    @property
    def remarks(self) -> tuple[str, ...]:
        """A line for the user where the lamp is not fully polarized."""
        if not self.unpolarized:
            return ()
        return (
            f"a fully polarized lamp was expected, found one of {self.lamp_dolp:.0%}: what its highlights leave in the "
            "diffuse image moves to the specular one, but not in films; a better polarizer before the lamp separates "
            "more",
        )


def color_specular(images: FrameImages, mosaic: Mosaic, light: tuple[float, ...]) -> tuple[FrameImages, Colored]:
    """The images of one colour frame ``[H, W]``, with coloured specular light where it is proven, and what was found.

    ``light``: camera RGB of the lamp, which is divided out. Metals are not ``valid``: samples do not determine their
    separation. The same object where nothing is found. Images on a GPU stay there; means over places are looked at.
    """
    tally = images.tally
    if mosaic.layout.channels != 3 or mosaic.data.ndim != 2 or tally is None or min(mosaic.data.shape) < MIN_SIZE:
        return images, Colored()
    xp, gain = namespace(images.diffuse), constant([[[gain]] for gain in light], images.diffuse)
    row, col = mosaic.layout.origin
    data = mosaic.data if is_torch_array(images.diffuse) else to_numpy(mosaic.data)
    layout, data = mosaic.layout.rolled(-row, -col), data[row:, col:]
    white = replace(mosaic, data=data, layout=layout, light_color=light, falloff=None)
    diffuse, before = (xp.moveaxis(x, -1, 0) for x in (images.diffuse, images.specular))
    side = 2 if 2 * diffuse.shape[-1] <= data.shape[-1] else PERIOD
    unpolarized, specular = 0.0, before
    if mosaic.lamp_dolp is None:
        unpolarized = find_unpolarized(_measure_places(images, light, side // 2), max(light))
    if unpolarized:
        left = xp.minimum(unpolarized * before, diffuse)
        diffuse, specular = diffuse - left, before + left
    # What fills 3x3 periods fills one in every third row and column: a ninth of the frame shows that there is nothing.
    thin = replace(white, data=_thin(data, PERIOD))
    some = _measure_periods(thin, _thin(diffuse, side) / gain, _thin(specular, side) / gain, tally)
    some = Periods(*to_numpy_together(*some))
    enough = some
    if min(data.shape) <= MANY:
        enough = Periods(*to_numpy_together(*_measure_periods(white, diffuse / gain, specular / gain, tally)))
    retained, colored = find_retained(enough.polarized, enough.across, enough.diffuse), None
    degree = 1 / (1 + unpolarized) if mosaic.lamp_dolp is None else mosaic.lamp_dolp
    retained = min(retained, find_missing(enough.polarized, degree * (enough.total - enough.diffuse), enough.diffuse))
    if _share(_part(some)) >= MIN_SHARE:
        periods = _measure_periods(white, diffuse / gain, specular / gain, tally)
        found = find_colored(periods)
        colored = found if _share(found) >= MIN_SHARE else None
    if not retained and not unpolarized and colored is None:
        return images, Colored()
    body, reflected, valid = (1 - retained) * diffuse, specular + retained * diffuse, images.valid
    if colored is not None:
        ratio = xp.minimum(periods.polarized.clip(0, None), periods.s0) / periods.total.clip(1e-4, None)
        part, ratio = (resize_bilinear(x, diffuse.shape[-2:]) for x in (colored, ratio.clip(0, MAX_GAIN)))
        body, reflected = (1 - part) * body, reflected + part * (ratio * (diffuse + specular) - reflected)
        valid = valid & (part[0] < 0.5)
    changed = [contiguous(xp.moveaxis(x, 0, -1)) for x in (body, reflected)]
    more = float(xp.sum(xp.mean((reflected - before) / gain, axis=0), dtype=xp.float64))
    tally = replace(tally, specular=tally.specular + more, valid=int(xp.sum(valid)))
    if colored is not None:  # all light of metals is what their polarization says, which changes the sum
        gained = body + reflected - diffuse - specular
        tally = replace(tally, s0=tally.s0 + float(xp.sum(xp.mean(gained / gain, axis=0), dtype=xp.float64)))
    images = replace(images, diffuse=changed[0], specular=changed[1], valid=valid, tally=tally)
    return images, Colored(0.0 if colored is None else float(xp.mean(colored)), retained, unpolarized)


def _measure_places(images: FrameImages, light: tuple[float, ...], cell: int) -> Places:
    """The places of images at half resolution, or at full resolution in a ``cell`` of two pixels' side."""
    if not is_torch_array(images.diffuse):
        make_ready(places_kernel.warm_up)
        return places_kernel.measure_places_fast(images.diffuse, images.specular, np.array(light, np.float32), cell)
    xp, gain = namespace(images.diffuse), constant([[[gain]] for gain in light], images.diffuse)
    planes = (xp.moveaxis(x, -1, 0) / gain for x in (images.diffuse, images.specular))
    diffuse, specular = (x if cell == 1 else block_means(x, cell) for x in planes)
    return measure_places(diffuse, xp.mean(specular, axis=0, keepdims=True))


def _share(part: Array) -> float:
    """The share of a frame in which more than half is specular."""
    xp = namespace(part)
    return float(xp.mean(xp.astype(part > 0.5, xp.float64)))


def _thin(image: Array, side: int) -> Array:
    """Every third period of ``side`` pixels of an image ``[..., H, W]``, in both directions."""
    rows, cols = (n // side for n in image.shape[-2:])
    whole, kept = image[..., : rows * side, : cols * side], (-(-n // 3) * side for n in (rows, cols))
    blocks = whole.reshape(-1, rows, side, cols, side)[:, ::3, :, ::3]
    return blocks.reshape(*image.shape[:-2], *kept)


def _measure_periods(mosaic: Mosaic, diffuse: Array, specular: Array, tally: Tally) -> Periods:
    """`Periods` of a frame in white light and its images ``[3, h, w]``; ``tally`` has the lamp's polarization."""
    stokes = period_stokes(mosaic)
    length = max((tally.along**2 + tally.across**2) ** 0.5, 1e-30)
    polarized = (stokes.s1 * tally.along + stokes.s2 * tally.across) / length
    across = (stokes.s2 * tally.along - stokes.s1 * tally.across) / length
    rows, cols = stokes.s0.shape[-2:]
    side = round(diffuse.shape[-1] / cols)  # a last row or column that is no whole period is left out, as in `stokes`
    diffuse, specular = (resize_area(x[..., : rows * side, : cols * side], (rows, cols)) for x in (diffuse, specular))
    return Periods(stokes.s0, polarized, across, diffuse, diffuse + specular)


def find_colored(periods: Periods) -> Array:
    """The part ``[1, h, w]``, 0 to 1, of the diffuse image that is specular."""
    part = _part(periods)
    solid = largest_around(-largest_around(-part, 1), 1)
    return namespace(part).minimum(part, solid)


def _part(periods: Periods) -> Array:
    """0 to 1, as the slope of the colours' polarized on their diffuse light is in `SLOPES`, period by period."""
    xp = namespace(periods.diffuse)
    colors = periods.diffuse - xp.mean(periods.diffuse, axis=0, keepdims=True)
    across = periods.polarized - xp.mean(periods.polarized, axis=0, keepdims=True)
    product, brightness = xp.sum(across * colors, axis=0, keepdims=True), xp.mean(periods.total, axis=0, keepdims=True)
    contrast = xp.sum(colors * colors, axis=0, keepdims=True)
    slope = product / (contrast + MIN_CONTRAST + MIN_RELATIVE * brightness**2)
    return ((slope - SLOPES[0]) / (SLOPES[1] - SLOPES[0])).clip(0, 1)


def period_stokes(mosaic: Mosaic) -> Stokes:
    """Stokes images ``[3, h, w]`` of the mosaic's periods of 2x2 cells, of which each shows one colour."""
    layout = mosaic.layout
    linear = mosaic.linear()
    xp = namespace(linear)
    planes, _ = split_analysers(xp.astype(linear, xp.float32, copy=False), layout)
    found = fit_stokes(Measurements(planes[:, None], layout.angles))
    row, col = layout.origin
    channels = [layout.filter_at(row + 2 * (k // 2), col + 2 * (k % 2)).channel for k in range(4)]

    def by_color(image: Array) -> Array:
        height, width = (n // 2 * 2 for n in image.shape[-2:])
        cells = [image[0, k // 2 : height : 2, k % 2 : width : 2] for k in range(4)]
        return xp.stack([_mean([cells[k] for k in range(4) if channels[k] == c]) for c in range(3)])

    return found.map(by_color)


def _mean(images: list[Array]) -> Array:
    return sum(images) / len(images)
