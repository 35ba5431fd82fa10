"""U-Nets as plain modules: no files, no optimizer, no statistics of whole images, so crop and frame agree.

Conventions: images ``[N, C, H, W]``, linear light; any H and W (padded by mirror inside to what the levels need).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d, pad, pixel_shuffle, pixel_unshuffle, relu

from polsep.networks.sizes import UNET64, ResidualSize, Size


class DoubleConv(nn.Sequential):
    """Two 3x3 convolutions with ReLU, the size kept by zero padding (Ronneberger et al. 2015 crop instead)."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__(
            nn.Conv2d(inputs, outputs, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(outputs, outputs, 3, padding=1),
            nn.ReLU(inplace=True),
        )
        for layer in self:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]


class UNet(nn.Module):
    """The U-Net of Ronneberger et al. 2015 without normalization: ``[N, inputs, H, W]`` to ``[N, outputs, H, W]``.

    Max pooling down, 2x2 transposed convolutions up, skips concatenated. The last 1x1 convolution starts at zero.
    """

    def __init__(self, inputs: int, outputs: int, size: Size = UNET64) -> None:
        super().__init__()
        self.size = size
        widths = [size.width * 2**level for level in range(size.levels + 1)]
        folded = inputs * size.fold**2
        self.encoders = nn.ModuleList(DoubleConv(a, b) for a, b in zip([folded, *widths], widths, strict=False))
        self.ups = nn.ModuleList(nn.ConvTranspose2d(2 * w, w, 2, stride=2) for w in widths[:-1])
        self.decoders = nn.ModuleList(DoubleConv(2 * w, w) for w in widths[:-1])
        self.last = nn.Conv2d(size.width, outputs * size.fold**2, 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Images of any size; their padding to a multiple of fold 2^levels is cut off again."""
        height, width = x.shape[-2:]
        x = pixel_unshuffle(pad_to_multiple(x, self.size.multiple), self.size.fold)
        skips = []
        for encoder in self.encoders[:-1]:
            x = encoder(x)
            skips.append(x)
            x = max_pool2d(x, 2)
        x = self.encoders[-1](x)
        for up, decoder, skip in zip(reversed(self.ups), reversed(self.decoders), reversed(skips), strict=True):
            x = decoder(torch.cat([skip, up(x)], dim=1))
        return pixel_shuffle(self.last(x), self.size.fold)[..., :height, :width]


class Block(nn.Module):
    """Two 3x3 convolutions that add to their input; the second one starts at zero.

    State: ``inactive``, True where the second one's weights are 0 and will stay so; its bias alone is added.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.inactive = False
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.kaiming_normal_(self.first.weight, nonlinearity="relu")
        nn.init.zeros_(self.first.bias)  # type: ignore[arg-type]
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """``[N, C, h, w]`` of any size."""
        if self.inactive:
            assert self.second.bias is not None
            return x + self.second.bias.to(x)[:, None, None]
        change: Tensor = self.second(relu(self.first(x)))
        return x + change


class ResidualUNet(nn.Module):
    """Residual blocks at every level, strided convolutions down, nearest neighbours and 1x1 convolutions up.

    Skips are added. Any height and width. ``[N, inputs, h, w]`` to ``[N, width, h, w]``.
    """

    def __init__(self, inputs: int, size: ResidualSize) -> None:
        super().__init__()
        self.size, widths = size, size.widths
        self.enter = _entrance(inputs, size)
        self.encoders = nn.ModuleList(_chain(w, n) for w, n in zip(widths, size.blocks, strict=True))
        pairs = list(pairwise(widths))
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairs)
        self.ups = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        self.decoders = nn.ModuleList(_chain(w, n) for w, n in zip(widths[:-1], size.blocks, strict=False))
        self.out = _chain(widths[0], 1)

    def forward(self, x: Tensor, changes: Sequence[tuple[Tensor, Tensor]] = ()) -> Tensor:
        """Features at the input's resolution; ``changes``: scale and shift of each level's first features, or none."""
        x = modulate(self.enter(x), changes, 0)
        skips = []
        for level, (encoder, down) in enumerate(zip(self.encoders, self.downs, strict=False), start=1):
            x = encoder(x)
            skips.append(x)
            x = modulate(down(relu(x)), changes, level)
        x = self.encoders[-1](x)
        for up, decoder, skip in zip(reversed(self.ups), reversed(self.decoders), reversed(skips), strict=True):
            x = interpolate(up(relu(x)), scale_factor=2.0)  # by nearest neighbours
            x = decoder(skip + x[..., : skip.shape[-2], : skip.shape[-1]])
        return relu(self.out(x))


def modulate(x: Tensor, changes: Sequence[tuple[Tensor, Tensor]], level: int) -> Tensor:
    """Features of a level, scaled by one more than a scale and shifted; unchanged without ``changes``."""
    if not changes:
        return x
    scale, shift = changes[level]
    return x * (1 + scale.to(x)) + shift.to(x)


def _entrance(inputs: int, size: ResidualSize) -> nn.Module:
    """A 3x3 convolution, of fewer channels where the size says so."""
    if not size.entry:
        return nn.Conv2d(inputs, size.width, 3, padding=1)
    return nn.Sequential(nn.Conv2d(inputs, size.entry, 1), nn.Conv2d(size.entry, size.width, 3, padding=1))


def _chain(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(Block(width) for _ in range(count)))


def pad_to_multiple(x: Tensor, multiple: int) -> Tensor:
    """``[N, C, H, W]`` mirrored at its lower and right border to multiples; repeated where too small for that."""
    rows, cols = (-x.shape[-2]) % multiple, (-x.shape[-1]) % multiple
    if not rows and not cols:
        return x
    mirrors = rows < x.shape[-2] and cols < x.shape[-1]
    return pad(x, (0, cols, 0, rows), mode="reflect" if mirrors else "replicate")


def count_parameters(module: nn.Module) -> int:
    """Number of trained parameters."""
    return sum(p.numel() for p in module.parameters())


def limit_above(values: Tensor, largest: Tensor) -> Tensor:
    """The lesser of both; what is above ``largest`` can still be lowered by a loss, but not raised.

    With the gradient of `torch.minimum`, which is 0 there, an output that came above its limit somewhere stays.
    """
    if not values.requires_grad:
        return torch.minimum(values, largest)
    above = values > largest
    limited = torch.where(above, largest + (values - values.detach()), values)
    limited.register_hook(  # type: ignore[no-untyped-call]
        lambda gradient: gradient.masked_fill(above & (gradient < 0), 0)
    )
    return limited
