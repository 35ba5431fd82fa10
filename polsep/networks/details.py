"""From half to full resolution: what the pixels of a cell differ from their mean.

The two images are smooth at most places, so their details are guessed from the cells around first. What the demosaicked
s0 has beyond such a guess is texture or noise, and the diffuse light's or the specular's; how much of it is believed in
each of the two images is for the network to say, cell by cell. Means of cells stay as they are.

Conventions: means and details are those of Haar, sums of the 2x2 pixels of a cell with the signs of `HAAR`, over four;
"packed" as in `polsep.networks.joint`.
"""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, conv2d, pad, pixel_shuffle, pixel_unshuffle

#: Signs of the pixels of a cell, in reading order: their mean, and the three details.
HAAR = ((1.0, 1.0, 1.0, 1.0), (1.0, -1.0, 1.0, -1.0), (1.0, 1.0, -1.0, -1.0), (1.0, -1.0, -1.0, 1.0))
#: Half the difference of the two pixels of a cell, and their mean, from the five cells around: cubic convolution (Keys
#: 1981, doi:10.1109/TASSP.1981.1163711, a = -1/2) at a quarter of a cell to either side.
_SLOPES = (-3 / 256, 38 / 256, 0.0, -38 / 256, 3 / 256)
_MEANS = (-3 / 256, 20 / 256, 222 / 256, 20 / 256, -3 / 256)
#: Channels between features and beliefs.
HIDDEN = 32
#: Squared details, relative to the light around, below which they are as good as none.
MIN_DETAIL = 1e-7


class Details(nn.Module):
    """The details of diffuse light in ``colors`` and of white specular light, from ``width`` channels of features.

    ``smooth [3, 1, 5, 5]`` guesses details from means of cells. ``belief``: how much of what s0 has beyond is in the
    diffuse image, then in the specular one, of three details and four cells each. ``change``: what the features say of
    details themselves, relative to the light around.
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

    def forward(self, half: Tensor, total: Tensor, features: Tensor, light: Tensor) -> Tensor:
        """Images ``[N, C + 1, H, W]`` with the means ``half [N, C + 1, H/2, W/2]``: diffuse colours, then specular.

        ``total``: s0 of the colours, packed ``[N, 16 C, h, w]``; ``features [N, width, h, w]``; ``light
        [N, 1, h, w]``: the brightness around.
        """
        with torch.autocast(light.device.type, enabled=False):
            # One colour at a time: details of all of them at once would be half of a frame's memory.
            beyond = [self._beyond(color) for color in total.chunk(self.colors, dim=1)]
            power = reduce(torch.add, [x.square() for x in beyond]) / self.colors
            around = pixel_unshuffle(avg_pool2d(power, 3, 1, 1, count_include_pad=False), 2)
            seen = torch.log(around / light**2 + MIN_DETAIL)
        belief, change = self.belief(torch.cat([features, seen.to(features)], dim=1)), self.change(features)
        with torch.autocast(light.device.type, enabled=False):
            diffuse, specular = pixel_shuffle(belief.float(), 2).chunk(2, dim=1)
            beyond.append(reduce(torch.add, beyond) / self.colors)
            images = []
            for k, more in enumerate(change.chunk(self.colors + 1, dim=1)):
                share = diffuse if k < self.colors else specular
                means = half[:, k : k + 1]
                details = self.guess(means) + share * beyond[k] + pixel_shuffle(more.float() * light, 2)
                images.append(join_cells(means, details))
            return torch.cat(images, dim=1)

    def guess(self, means: Tensor) -> Tensor:
        """Details ``[N, 3, h, w]`` of an image of which the means of cells ``[N, 1, h, w]`` are known."""
        return conv2d(pad(means, (2, 2, 2, 2), mode="replicate"), self.smooth)

    def _beyond(self, packed: Tensor) -> Tensor:
        """Of a packed image ``[N, 16, h, w]``, what its details ``[N, 3, 2 h, 2 w]`` differ from such a guess."""
        cells = split_cells(pixel_shuffle(packed, 4))
        return cells[:, 1:] - self.guess(cells[:, :1])


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
