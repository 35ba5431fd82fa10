"""Specular light that does not have the lamp's colour: metals, tinted highlights, and what bodies keep polarized.

Methods that assume white specular light leave its colour in the diffuse image. That part betrays itself: it is
polarized as mirror images are. The polarization along the lamp's is regressed on the diffuse image, both as deviations
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
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pixel_unshuffle

from polsep.demosaic.bilinear import split_analysers
from polsep.physics.stokes import Measurements, Stokes, fit_stokes
from polsep.sensor.camera import Mosaic
from polsep.separation.images import FrameImages, Tally
from polsep.separation.lamp_polarization import find_unpolarized
from polsep.separation.retained_polarization import find_retained

#: Raw pixels along the side of a period.
PERIOD = 4
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

    s0: Tensor
    polarized: Tensor
    across: Tensor
    diffuse: Tensor
    total: Tensor


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


def color_specular(images: FrameImages, mosaic: Mosaic, light: tuple[float, ...]) -> tuple[FrameImages, Colored]:
    """The images of one colour frame ``[H, W]``, with coloured specular light where it is proven, and what was found.

    ``light``: camera RGB of the lamp, which is divided out. Metals are not ``valid``: samples do not determine their
    separation. The same object where nothing is found.
    """
    tally, gain = images.tally, torch.tensor(light).view(-1, 1, 1)
    if mosaic.layout.channels != 3 or mosaic.data.ndim != 2 or tally is None or min(mosaic.data.shape) < MIN_SIZE:
        return images, Colored()
    row, col = mosaic.layout.origin
    layout, data = mosaic.layout.rolled(-row, -col), mosaic.data[row:, col:].cpu()
    white = replace(mosaic, data=data, layout=layout, light_color=light, falloff=None)
    diffuse, before = (torch.from_numpy(x).movedim(-1, 0) for x in (images.diffuse, images.specular))
    side = 2 if 2 * diffuse.shape[-1] <= data.shape[-1] else PERIOD
    halves = [avg_pool2d((x / gain)[None], side // 2)[0] for x in (diffuse, before)]
    unpolarized = find_unpolarized(halves[0], halves[1].mean(dim=0, keepdim=True))
    left = torch.minimum(unpolarized * before, diffuse)
    diffuse, specular = diffuse - left, before + left
    # What fills 3x3 periods fills one in every third row and column: a ninth of the frame shows that there is nothing.
    thin = replace(white, data=_thin(data, PERIOD))
    some = _see(thin, _thin(diffuse, side) / gain, _thin(specular, side) / gain, tally)
    enough = some if min(data.shape) > MANY else _see(white, diffuse / gain, specular / gain, tally)
    retained, share = find_retained(enough.polarized, enough.across, enough.diffuse), None
    if float((_part(some) > 0.5).float().mean()) >= MIN_SHARE:
        seen = _see(white, diffuse / gain, specular / gain, tally)
        found = find_colored(seen)
        share = found if float((found > 0.5).float().mean()) >= MIN_SHARE else None
    if not retained and not unpolarized and share is None:
        return images, Colored()
    body, mirrored, valid = (1 - retained) * diffuse, specular + retained * diffuse, images.valid
    if share is not None:
        ratio = torch.minimum(seen.polarized.clamp(min=0), seen.s0) / seen.total.clamp(min=1e-4)
        share, ratio = (_resize(x, diffuse.shape[-2:], "bilinear") for x in (share, ratio.clamp(0, MAX_GAIN)))
        body, mirrored = (1 - share) * body, mirrored + share * (ratio * (diffuse + specular) - mirrored)
        valid = valid & (share[0] < 0.5).numpy()
    changed = [x.movedim(0, -1).contiguous().numpy() for x in (body, mirrored)]
    more = float(((mirrored - before) / gain).mean(dim=0).double().sum())
    tally = replace(tally, specular=tally.specular + more, valid=int(np.count_nonzero(valid)))
    images = replace(images, diffuse=changed[0], specular=changed[1], valid=valid, tally=tally)
    return images, Colored(0.0 if share is None else float(share.mean()), retained, unpolarized)


def _thin(image: Tensor, side: int) -> Tensor:
    """Every third period of ``side`` pixels of an image ``[..., H, W]``, in both directions."""
    rows, cols = (n // side for n in image.shape[-2:])
    whole, kept = image[..., : rows * side, : cols * side], (-(-n // 3) * side for n in (rows, cols))
    blocks = whole.reshape(-1, rows, side, cols, side)[:, ::3, :, ::3]
    return blocks.reshape(*image.shape[:-2], *kept)


def _see(mosaic: Mosaic, diffuse: Tensor, specular: Tensor, tally: Tally) -> Periods:
    stokes = period_stokes(mosaic)
    length = max((tally.along**2 + tally.across**2) ** 0.5, 1e-30)
    polarized = (stokes.s1 * tally.along + stokes.s2 * tally.across) / length
    across = (stokes.s2 * tally.along - stokes.s1 * tally.across) / length
    diffuse, specular = (_resize(x, stokes.s0.shape[-2:], "area") for x in (diffuse, specular))
    return Periods(stokes.s0, polarized, across, diffuse, diffuse + specular)


def find_colored(seen: Periods) -> Tensor:
    """The part ``[1, h, w]``, 0 to 1, of the diffuse image that is specular."""
    part = _part(seen)
    solid = max_pool2d(-max_pool2d(-part[None], 3, 1, 1), 3, 1, 1)[0]
    return torch.minimum(part, solid)


def _part(seen: Periods) -> Tensor:
    """0 to 1, as the slope of the colours' polarized on their diffuse light is in `SLOPES`, period by period."""
    colors = seen.diffuse - seen.diffuse.mean(dim=0, keepdim=True)
    product = ((seen.polarized - seen.polarized.mean(dim=0, keepdim=True)) * colors).sum(dim=0, keepdim=True)
    brightness = seen.total.mean(dim=0, keepdim=True)
    slope = product / ((colors * colors).sum(dim=0, keepdim=True) + MIN_CONTRAST + MIN_RELATIVE * brightness**2)
    return ((slope - SLOPES[0]) / (SLOPES[1] - SLOPES[0])).clamp(0, 1)


def period_stokes(mosaic: Mosaic) -> Stokes:
    """Stokes images ``[3, h, w]`` of the mosaic's periods of 2x2 cells, of which each shows one colour."""
    layout = mosaic.layout
    planes, _ = split_analysers(mosaic.linear().float(), layout)
    found = fit_stokes(Measurements(planes[:, None], layout.angles))
    row, col = layout.origin
    channels = [layout.filter_at(row + 2 * (k // 2), col + 2 * (k % 2)).channel for k in range(4)]

    def by_color(image: Tensor) -> Tensor:
        height, width = (n // 2 * 2 for n in image.shape[-2:])
        cells = pixel_unshuffle(image[..., :height, :width], 2)
        return torch.stack([cells[[k for k in range(4) if channels[k] == c]].mean(dim=0) for c in range(3)])

    return found.map(by_color)


def _resize(image: Tensor, size: torch.Size, mode: str) -> Tensor:
    """An image ``[C, h, w]`` at another resolution."""
    smooth = {"align_corners": False} if mode == "bilinear" else {}
    return interpolate(image[None], list(size), mode=mode, **smooth)[0]
