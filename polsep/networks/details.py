"""Full from half resolution: the details of a cell, its pixels' differences from their mean.

Both images are smooth at most places, so their details are interpolated from the cells around first. Details of the
demosaicked s0 beyond that are texture or noise, of the diffuse or of the specular light: the network says for each cell
how much of them belongs to each of the two images. Means of cells do not change.

Conventions: means and details are those of Haar, sums of the 2x2 pixels of a cell with the signs of `channels.HAAR`,
over four; "packed" as in `polsep.networks.joint`.
"""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, pad, pixel_shuffle, pixel_unshuffle

from polsep.networks.channels import HAAR, MIN_DETAIL
from polsep.networks.joint_weights import HIDDEN

#: Half the difference of the two pixels of a cell, and their mean, from the five cells around: cubic convolution (Keys
#: 1981, doi:10.1109/TASSP.1981.1163711, a = -1/2) at a quarter of a cell to either side.
_SLOPES = (-3 / 256, 38 / 256, 0.0, -38 / 256, 3 / 256)
_MEANS = (-3 / 256, 20 / 256, 222 / 256, 20 / 256, -3 / 256)


class Details(nn.Module):
    """The details of diffuse light in ``colors`` and of white specular light, from ``width`` channels of features.

    ``smooth [3, 1, 5, 5]`` interpolates details from means of cells. ``belief``: the share of further details of s0
    that is in the diffuse image, then in the specular one, for three details and four cells each. ``change``: details
    from the features alone, relative to the local brightness.
    """

    def __init__(self, colors: int, width: int) -> None:
        super().__init__()
        self.colors = colors
        self.smooth = nn.Parameter(interpolating_filter())
        self.belief = nn.Sequential(nn.Conv2d(width + 12, HIDDEN, 3, padding=1), nn.ReLU(), nn.Conv2d(HIDDEN, 24, 1))
        self.change = nn.Conv2d(width, 12 * (colors + 1), 1)
        last: nn.Conv2d = self.belief[-1]  # type: ignore[assignment]
        for layer in (last, self.change):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        assert last.bias is not None
        nn.init.ones_(last.bias[:12])  # at first all of it is diffuse

    def forward(self, half: Tensor, total: Tensor, features: Tensor, brightness: Tensor) -> Tensor:
        """Images ``[N, C + 1, H, W]`` with the means ``half [N, C + 1, H/2, W/2]``: diffuse colours, then specular.

        ``total``: s0 of the colours, packed ``[N, 16 C, h, w]``; ``features [N, width, h, w]``; ``brightness
        [N, 1, h, w]``: mean s0 around.
        """
        with torch.autocast(brightness.device.type, enabled=False):
            # One colour at a time: details of all of them at once would be half of a frame's memory.
            beyond = [self._beyond(color) for color in total.chunk(self.colors, dim=1)]
            power = reduce(torch.add, [x.square() for x in beyond]) / self.colors
            around = pixel_unshuffle(avg_pool2d(power, 3, 1, 1, count_include_pad=False), 2)
            maps = torch.log(around / brightness**2 + MIN_DETAIL)
        belief, change = self.belief(torch.cat([features, maps.to(features)], dim=1)), self.change(features)
        with torch.autocast(brightness.device.type, enabled=False):
            diffuse, specular = pixel_shuffle(belief.float(), 2).chunk(2, dim=1)
            beyond.append(reduce(torch.add, beyond) / self.colors)
            images = []
            for k, correction in enumerate(change.chunk(self.colors + 1, dim=1)):
                share = diffuse if k < self.colors else specular
                means = half[:, k : k + 1]
                more = pixel_shuffle(correction.float() * brightness, 2)
                images.append(join_cells(means, self.smooth_details(means) + share * beyond[k] + more))
            return torch.cat(images, dim=1)

    def smooth_details(self, means: Tensor) -> Tensor:
        """Details ``[N, 3, h, w]`` of a smooth image with these means of cells ``[N, 1, h, w]``."""
        return conv2d(pad(means, (2, 2, 2, 2), mode="replicate"), self.smooth)

    def _beyond(self, packed: Tensor) -> Tensor:
        """Details ``[N, 3, 2 h, 2 w]`` of a packed image ``[N, 16, h, w]``, less those of a smooth one."""
        cells = split_cells(pixel_shuffle(packed, 4))
        return cells[:, 1:] - self.smooth_details(cells[:, :1])


def interpolating_filter() -> Tensor:
    """``[3, 1, 5, 5]``: details of an image interpolated by cubic convolution from the means of cells."""
    slope, mean = torch.tensor(_SLOPES), torch.tensor(_MEANS)
    kernels = [torch.outer(mean, slope), torch.outer(slope, mean), torch.outer(slope, slope)]
    return torch.stack(kernels)[:, None]


def split_cells(image: Tensor) -> Tensor:
    """Mean and details ``[N, 4, H/2, W/2]`` of an image ``[N, 1, H, W]``."""
    return _transform(pixel_unshuffle(image, 2)) / 4


def join_cells(means: Tensor, details: Tensor) -> Tensor:
    """The twin of `split_cells`: ``[N, 1, H/2, W/2]`` and ``[N, 3, H/2, W/2]`` to ``[N, 1, H, W]``."""
    return pixel_shuffle(_transform(torch.cat([means, details], dim=1)), 2)


def _transform(cells: Tensor) -> Tensor:
    """Haar's, ``[N, 4, h, w]``; twice it is four times what was given."""
    first, second, third, fourth = cells.chunk(4, dim=1)
    return torch.cat([first * a + second * b + third * c + fourth * d for a, b, c, d in HAAR], dim=1)
