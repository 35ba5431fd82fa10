"""The network that estimates the maps of a flat material from one or several photographs of it, in any order.

An encoder and decoder with skips processes every photograph by itself; the features are pooled by their maximum over
the photographs, so their number and order are free. Parallel to the images runs a global track, a vector that every
layer updates with the means of its channels and adds to its features, so that every pixel depends on the full image.

Conventions are those of `polsep.material.svbrdf`; images are linear, 1 = white paper under the same light, the first
three channels those that show albedo: the photograph, or its diffuse part. Source: Deschaintre et al. 2018,
doi:10.1145/3197517.3201378 (network, global track); Deschaintre et al. 2019, doi:10.1111/cgf.13765 (pooling over
views). Notes, which allow training in an hour on a CPU where the source's takes days on a GPU: widths
are a third of the source's; the decoder's convolutions are 3x3, one before and one after it enlarges, instead of two
of 4x4, its last one has the photograph as another input, and the last layers its mean and minimum over the views; there
is no instance normalization, which removes colours and is slow to learn them again; the diffuse map is a difference to
the mean photograph, and albedos are squares of outputs, as most of them are small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate, leaky_relu, pad, selu

from polsep.material.svbrdf import STACKED, Svbrdf
from polsep.networks.unet import pad_to_multiple
from polsep.physics.optics import normalize

#: Added to images before their logarithm, which is scaled to 0 to 1 for 0 to 1.
FLOOR = 0.01
#: Largest slope of normals along each axis.
LARGEST_SLOPE = 3.0
#: Slope of the rectifier below 0.
LEAK = 0.2
#: Output of an untrained network: flat, as bright as the photograph, roughness 0.4, reflectance 0.04.
USUAL = (0.0, 0.0, 0.0, 0.0, 0.0, -0.2, -0.6, -0.6, -0.6)
#: Radius of the mean of brightness in pixels; squared distance from a highlight that counts as near.
DETAIL_RADIUS, NEAR = 4, 0.05
#: Least light of a photograph under the square root, whose slope is unbounded at 0.
MIN_LIGHT = 1e-4
#: Standard deviation of the weights from the global track to the layers.
TAKEN = 0.1


@dataclass(frozen=True)
class MaterialSize:
    """``width`` channels at half resolution, multiplied as ``growth`` says at every further halving.

    ``cues``: of `CUES`, further inputs of every image. Raises ValueError on sizes that cannot be built.
    """

    width: int = 20
    growth: tuple[int, ...] = (1, 2, 4, 4, 4, 4)
    cues: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or not self.growth or min(self.growth) < 1:
            raise ValueError(f"expected a width and growth of at least 1, found {self}")
        if not set(self.cues) <= set(CUES):
            raise ValueError(f"expected cues of {', '.join(CUES)}, found {', '.join(self.cues)}")

    @property
    def widths(self) -> tuple[int, ...]:
        """Channels of every level, from half resolution down."""
        return tuple(self.width * g for g in self.growth)


class Stage(nn.Module):
    """A convolution and its layer of the global track: ``before`` numbers in, one per channel out."""

    def __init__(self, conv: nn.Conv2d, before: int) -> None:
        super().__init__()
        channels = conv.out_channels
        self.conv = conv
        self.take = nn.Linear(before, channels, bias=False)
        self.give = nn.Linear(before + channels, channels)
        nn.init.normal_(self.take.weight, std=TAKEN)
        nn.init.normal_(self.give.weight, std=math.sqrt(1 / (before + channels)))  # as SELU wants it
        nn.init.zeros_(self.give.bias)

    def forward(self, x: Tensor, track: Tensor) -> tuple[Tensor, Tensor]:
        """Features and the track after the layer."""
        x = self.conv(x)
        mean = x.mean(dim=(-2, -1))
        x = leaky_relu(x + self.take(track)[..., None, None], LEAK)
        return x, selu(self.give(torch.cat([track, mean], dim=-1)))


class MaterialNetwork(nn.Module):
    """Photographs ``[N, V, inputs, H, W]`` to maps ``[N, 9, H, W]`` of `svbrdf.Svbrdf.stack`; see `decode_maps`."""

    def __init__(self, inputs: int, size: MaterialSize) -> None:
        super().__init__()
        self.inputs, self.size = inputs, size
        widths, seen = size.widths, inputs + 2 + 2 * len(size.cues) * (inputs // 3)
        self.encoders, self.narrow, self.decoders = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        before, track = seen, size.width
        for width in widths:
            self.encoders.append(Stage(nn.Conv2d(before, width, 4, 2, 1), track))
            before = track = width
        for skip in (*reversed(widths[:-1]), seen):
            width = skip if skip != seen else size.width
            self.narrow.append(nn.Conv2d(before, width, 3, padding=1))
            self.decoders.append(Stage(nn.Conv2d(width + skip, width, 3, padding=1), track))
            before = track = width
        self.first = Stage(nn.Conv2d(before + 2 * inputs, before, 3, padding=1), track)
        self.last = nn.Conv2d(before, STACKED, 3, padding=1)
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, a=LEAK)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)
        nn.init.normal_(self.last.weight, std=0.01)
        assert self.last.bias is not None
        with torch.no_grad():
            self.last.bias.copy_(torch.tensor(USUAL).atanh())

    @property
    def multiple(self) -> int:
        """Pixels of which sides are made multiples by mirroring."""
        return 1 << len(self.encoders)

    def forward(self, views: Tensor) -> Tensor:
        """Maps of each material; V and the sides are free."""
        count, height, width = views.shape[1], *views.shape[-2:]
        images = views.flatten(0, 1)
        seen = torch.cat([encode_images(images), *(CUES[cue](images) for cue in self.size.cues)], dim=1)
        x = pad_to_multiple(seen, self.multiple).contiguous(memory_format=torch.channels_last)
        track = x.new_zeros(len(x), self.size.width)
        skips = []
        for encoder in self.encoders:
            skips.append(x)
            x, track = encoder(x, track)
        for narrow, decoder, skip in zip(self.narrow, self.decoders, reversed(skips), strict=True):
            x = interpolate(leaky_relu(narrow(x), LEAK), scale_factor=2.0)
            x, track = decoder(torch.cat([x, skip.to(x)], dim=1), track)
        x, track = (y.view(-1, count, *y.shape[1:]).amax(dim=1) for y in (x[..., :height, :width], track))
        levels = seen[:, : self.inputs].view(-1, count, self.inputs, height, width)
        x, _ = self.first(torch.cat([x, levels.mean(dim=1), levels.amin(dim=1)], dim=1), track)
        return decode_maps(torch.tanh(self.last(x).float()), views[:, :, :3].mean(dim=1))


def encode_images(images: Tensor) -> Tensor:
    """Images ``[N, C, H, W]`` on a logarithmic scale, -1 for black and 1 for white, and x and y of every pixel."""
    scaled = (torch.log(images.clamp(min=0) + FLOOR) - math.log(FLOOR)) / (math.log(1 + FLOOR) - math.log(FLOOR))
    return torch.cat([2 * scaled - 1, _places(images).expand(len(images), -1, -1, -1)], dim=1)


def _places(images: Tensor) -> Tensor:
    """x to the right and y up, -1 to 1, of every pixel of images, ``[2, H, W]``."""
    y, x = (torch.linspace(-1, 1, n).to(images) for n in images.shape[-2:])
    return torch.stack([x.expand(len(y), -1), -y[:, None].expand(-1, len(x))])


def detail_cues(images: Tensor) -> Tensor:
    """Details of each image's brightness times the direction from its highlight, ``[N, 2 C / 3, H, W]``.

    Facets that lean toward the middle between light and camera are brighter than their surroundings, on either side of
    it: so details times the direction from there are slopes to first order. The middle is where the last three channels
    are bright.
    """
    places = _places(images)
    weight = images[:, -3:].mean(dim=1, keepdim=True).clamp(0, 1) ** 2
    middle = (weight * places).mean(dim=(-2, -1)) / weight.mean(dim=(-2, -1)).clamp(min=1e-6)
    away = places - middle[..., None, None]
    away = away / ((away**2).sum(dim=1, keepdim=True) + NEAR)
    found = []
    for image in torch.split(images, 3, dim=1):
        light = torch.log(image.mean(dim=1, keepdim=True).clamp(min=0) + FLOOR)
        around = pad(light, (DETAIL_RADIUS,) * 4, mode="replicate")
        found.append(away * (light - avg_pool2d(around, 2 * DETAIL_RADIUS + 1, 1)))
    return torch.cat(found, dim=1)


#: Further inputs of the network by name: of images ``[N, C, H, W]``, two channels for every three.
CUES = {"details": detail_cues}


def decode_maps(output: Tensor, photograph: Tensor) -> Tensor:
    """Maps ``[N, 9, H, W]`` of a network's output, -1 to 1, and the mean ``photograph [N, 3, H, W]``.

    The output: slopes, difference of the diffuse map's root to the photograph's, roughness, the specular map's root.
    """
    slopes, rest = LARGEST_SLOPE * output[:, :2], (output[:, 5:] + 1) / 2
    normal = normalize(torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1))
    root = (photograph.float().clamp(MIN_LIGHT, 1).sqrt() + output[:, 2:5]).clamp(0, 1)
    return Svbrdf(normal, root**2, rest[:, :1], rest[:, 1:] ** 2).stack()
