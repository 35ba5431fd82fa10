"""The whole frame at a glance: a thumbnail of it modulates the joint network.

The joint network sees 88 raw pixels around a place. The lamp's colour and degree of polarization, room light and gloss
are common to a frame, so a small network reads a thumbnail of the frame, whatever its size, and scales and shifts the
features of the joint network (FiLM: Perez et al. 2018, arXiv 1709.07871). Strips of large frames, and crops in
training, use the thumbnail of their own frame.

The small network also predicts `thumbnails.LIGHT` with a variance; training supervises that.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d

from polsep.light.tiles import filter_weights
from polsep.networks.channels import PERIOD
from polsep.networks.thumbnails import COMMON, LIGHT, SIDE, WIDTHS, scale_thumbnail, thumbnail_channels
from polsep.sensor.camera import Layout


def analysis_weights(layout: Layout) -> Tensor:
    """Weights ``[3 C, 16, 1, 1]`` from the samples of a packed pixel to s0, s1, s2 of every colour, not demosaicked.

    s0 = half the sum of the four analysers, s1 = m0 - m90, s2 = m45 - m135; means over the cells of a colour.
    """
    weights, colors = torch.zeros(3, layout.channels, PERIOD**2), [f.channel for row in layout.table() for f in row]
    for k, part in enumerate(filter_weights(layout).values()):
        weights[:, colors[k], k] = torch.from_numpy(part[:3])
    return weights.reshape(-1, PERIOD**2, 1, 1)


def make_thumbnail(planes: Tensor, masks: Tensor, layout: Layout) -> Tensor:
    """Thumbnails ``[N, K, SIDE, SIDE]`` of whole frames; ``planes``, ``masks [N, 16, h, w]``: samples, clipped.

    Stretched to a square, relative to the frame's mean brightness, compressed by asinh.
    """
    stokes = conv2d(planes, analysis_weights(layout).to(planes))
    s0, s1, s2 = stokes.chunk(3, dim=1)
    polarized = torch.sqrt(s1 * s1 + s2 * s2)
    means = _pool(torch.cat([stokes, masks.mean(dim=1, keepdim=True)], dim=1), _mean_of_parts)
    largest = _pool(torch.cat([s0, polarized], dim=1), _largest_of_parts)
    thumbnail: Tensor = scale_thumbnail(means[:, :-1], largest, means[:, -1:])
    return thumbnail


def _pool(image: Tensor, pool: Callable[[Tensor], Tensor]) -> Tensor:
    """Images ``[N, K, h, w]`` to ``[N, K, SIDE, SIDE]``; ``pool``: the last axis to `SIDE` parts.

    As torch's adaptive pooling, which its exporter to ONNX writes for no frame of any size.
    """
    return pool(pool(image).mT).mT


def _parts(length: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """First place of each of `SIDE` parts of an axis, and the place after its last; parts meet or overlap by one."""
    number = torch.arange(SIDE, device=device)
    return number * length // SIDE, ((number + 1) * length + SIDE - 1) // SIDE


def _mean_of_parts(image: Tensor) -> Tensor:
    first, end = _parts(image.shape[-1], image.device)
    place = torch.arange(image.shape[-1], device=image.device)[:, None]
    return image @ (((place >= first) & (place < end)).to(image) / (end - first))


def _largest_of_parts(image: Tensor) -> Tensor:
    first, end = _parts(image.shape[-1], image.device)
    longest = (image.shape[-1] + SIDE - 1) // SIDE + 1
    places = torch.minimum(first[:, None] + torch.arange(longest, device=image.device), end[:, None] - 1)
    parts = image.index_select(-1, places.flatten()).reshape(*image.shape[:-1], SIDE, -1)
    return parts.amax(dim=-1)


class WholeFrame(nn.Module):
    """The thumbnail of a whole frame to scales and shifts of features.

    ``widths``: channels of the features that are modulated, level by level; see `split_modulation`.
    """

    def __init__(self, colors: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        sizes = (thumbnail_channels(colors), *WIDTHS)
        layers: list[nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            layers += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU()]
        self.look = nn.Sequential(*layers)
        self.common = nn.Linear(2 * WIDTHS[-1], COMMON)
        self.light = nn.Linear(COMMON, 2 * len(LIGHT))
        self.change = nn.Linear(COMMON, 2 * sum(widths))
        nn.init.zeros_(self.change.weight)
        nn.init.zeros_(self.change.bias)

    def forward(self, thumbnail: Tensor) -> tuple[Tensor, Tensor]:
        """Scales and shifts ``[N, 2 sum(widths), 1, 1]``, and means and log variances of `LIGHT` ``[N, 8]``."""
        seen = self.look(thumbnail)
        pooled = torch.cat([seen.mean(dim=(2, 3)), seen.amax(dim=(2, 3))], dim=1)
        common = torch.relu(self.common(pooled))
        return self.change(common)[..., None, None], self.light(common)


def split_modulation(modulation: Tensor, widths: tuple[int, ...]) -> list[tuple[Tensor, Tensor]]:
    """Scale and shift ``[N, width, 1, 1]`` of every level."""
    pairs = torch.split(modulation, [2 * width for width in widths], dim=1)
    return [(pair[:, :width], pair[:, width:]) for pair, width in zip(pairs, widths, strict=True)]
