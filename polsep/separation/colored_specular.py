"""Specular light that does not have the lamp's colour: metals and tinted highlights.

Methods that assume white specular light leave its colour in the diffuse image. That part betrays itself: it is
polarized as mirror images are. In a window, the polarization along the lamp's is regressed on the diffuse image, both
as deviations from their mean over colours. Diffuse light of dielectrics has slopes of at most 0.3, and that only at
grazing angles; diffuse images of gold have 1 and more. There the whole polarized light becomes specular.

Evidence is taken per period of the mosaic, 4x4 pixels, whose cells show one colour each, and must fill 3x3 periods, so
that colour fringes of edges do not count, and a part of the frame. Source: this project's; that metals tint highlights
and dielectrics do not is the dichromatic model (Shafer 1985, doi:10.1002/col.5080100409).
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d, pixel_unshuffle

from polsep.demosaic.bilinear import split_analysers
from polsep.physics.stokes import Measurements, Stokes, fit_stokes
from polsep.sensor.camera import Mosaic
from polsep.separation.images import FrameImages

#: Slopes from which on, and up to which, diffuse light turns into specular light.
SLOPES = (0.4, 0.7)
#: Side of the window in periods; evidence must hold in the window and in a single period.
WINDOW = 5
#: Contrast of colours that counts as none: variance [white^2], and relative to the squared brightness.
MIN_CONTRAST, MIN_RELATIVE = 1e-4, 1e-3
#: Least share of the frame, and the largest gain of an image by its samples.
MIN_SHARE, MAX_GAIN = 0.002, 1.5


def color_specular(images: FrameImages, mosaic: Mosaic, light: tuple[float, ...]) -> tuple[FrameImages, float]:
    """The images of one colour frame ``[H, W]``, with coloured specular light where it is proven, and its share.

    ``light``: camera RGB of the lamp, which is divided out. The same object and 0 where nothing is found.
    """
    tally = images.tally
    if mosaic.layout.channels != 3 or mosaic.data.ndim != 2 or tally is None or min(mosaic.data.shape) < 8 * WINDOW:
        return images, 0.0
    length = (tally.along**2 + tally.across**2) ** 0.5
    if not length > 0:
        return images, 0.0
    gain = torch.tensor(light).view(3, 1, 1)
    white = replace(mosaic, light_color=light)
    stokes = period_stokes(white)
    diffuse, specular = (torch.from_numpy(x).movedim(-1, 0) / gain for x in (images.diffuse, images.specular))
    size = stokes.s0.shape[-2:]
    small = [interpolate(x[None], size, mode="area")[0] for x in (diffuse, specular)]
    total = small[0] + small[1]
    polarized = (stokes.s1 * tally.along + stokes.s2 * tally.across) / length
    share = find_colored(polarized, small[0], total)
    if float((share > 0.5).float().mean()) < MIN_SHARE:
        return images, 0.0
    ratio = torch.minimum(polarized.clamp(min=0), stokes.s0) / total.clamp(min=1e-4)
    share, ratio = (_enlarge(x, diffuse.shape[-2:]) for x in (share, ratio.clamp(0, MAX_GAIN)))
    mirrored = specular + share * (ratio * (diffuse + specular) - specular)
    changed = [(x * gain).movedim(0, -1).contiguous().numpy() for x in ((1 - share) * diffuse, mirrored)]
    tally = replace(tally, specular=tally.specular + float((mirrored - specular).mean(dim=0).double().sum()))
    return replace(images, diffuse=changed[0], specular=changed[1], tally=tally), float(share.mean())


def find_colored(polarized: Tensor, diffuse: Tensor, total: Tensor) -> Tensor:
    """The part ``[1, h, w]``, 0 to 1, of the ``diffuse [3, h, w]`` image that is specular, per period of the mosaic.

    ``polarized [3, h, w]``: light along the lamp's polarization; ``total``: diffuse and specular.
    """
    colors = diffuse - diffuse.mean(dim=0, keepdim=True)
    common = ((polarized - polarized.mean(dim=0, keepdim=True)) * colors).sum(dim=0, keepdim=True)
    sums = torch.cat([common, (colors * colors).sum(dim=0, keepdim=True), total.mean(dim=0, keepdim=True)])
    around = avg_pool2d(sums[None], WINDOW, 1, WINDOW // 2, count_include_pad=False)[0]
    low, high = SLOPES
    parts = []
    for product, contrast, light in (torch.split(sums, 1), torch.split(around, 1)):
        slope = product / (contrast + MIN_CONTRAST + MIN_RELATIVE * light**2)
        parts.append(((slope - low) / (high - low)).clamp(0, 1))
    part = torch.minimum(*parts)
    solid = max_pool2d(-max_pool2d(-part[None], 3, 1, 1), 3, 1, 1)[0]
    return torch.minimum(part, solid)


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


def _enlarge(image: Tensor, size: torch.Size) -> Tensor:
    """An image ``[C, h, w]`` of periods at another resolution."""
    return interpolate(image[None], list(size), mode="bilinear", align_corners=False)[0]
