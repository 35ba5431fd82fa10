"""The network that finds a surface in maps of one frame (`geometry.shape_maps`); the twin of `graphs.shape_model`."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import pixel_shuffle, pixel_unshuffle

from polsep.networks.sizes import ResidualSize
from polsep.networks.unet import ResidualUNet

#: Pixels along a side that are folded into channels.
FOLD = 2


class ShapeNetwork(nn.Module):
    """Maps ``[N, inputs, h, w]`` to ``[N, outputs, h, w]``; sides are multiples of `FOLD`.

    It starts as ``usual``, one number for each output.
    """

    def __init__(self, inputs: int, usual: tuple[float, ...], size: ResidualSize) -> None:
        super().__init__()
        self.size = size
        self.net = ResidualUNet(inputs * FOLD**2, size)
        self.last = nn.Conv2d(size.width, len(usual) * FOLD**2, 3, padding=1)
        nn.init.normal_(self.last.weight, std=0.005)
        assert self.last.bias is not None
        with torch.no_grad():
            self.last.bias.copy_(torch.tensor(usual).repeat_interleave(FOLD**2))

    def forward(self, maps: Tensor) -> Tensor:
        """The outputs as they are; `geometry.shape_maps.decode` gives them their meaning."""
        return pixel_shuffle(self.last(self.net(pixel_unshuffle(maps, FOLD))), FOLD)
