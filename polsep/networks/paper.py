"""The paper's networks in torch: U-Nets that refine an analytic split, for every rung of the ladder (`rungs`).

Twin on CPUs, for the shipped ones: `paper_engine`. Source: Dave et al. 2022, Sec. 4.3 and Table 2.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d

from polsep.networks.rungs import Rung
from polsep.networks.sizes import UNET64, Size
from polsep.networks.unet import UNet


class Refinement(nn.Module):
    """The networks of a rung: inputs ``[N, K, h, w]`` to tau_d and log(1 + tau_s), ``[N, C, h, w]`` each.

    ``colors``: C, 3 or 1; ``size``: of each network. Note: the paper's networks write their images alone; here they add
    to a learned linear map of each pixel's inputs that starts at the rung's first guess. Without it a training of an
    hour on two cores stays behind the analytic split (docs/experiments.md).
    """

    basis: Tensor | None

    def __init__(self, rung: Rung, colors: int = 3, size: Size = UNET64) -> None:
        super().__init__()
        self.colors = colors
        inputs = rung.per_color * colors
        self.nets = nn.ModuleList(UNet(inputs, n, size) for n in ([2 * colors] if rung.share else [colors, colors]))
        self.linear = nn.Conv2d(inputs, 2 * colors, 1)
        weight = torch.zeros(2, colors, rung.per_color, colors)
        for color in range(colors):
            weight[:, color, :, color] = torch.tensor(rung.start)
        with torch.no_grad():
            self.linear.weight.copy_(weight.view(2 * colors, inputs, 1, 1))
        nn.init.zeros_(self.linear.bias)  # type: ignore[arg-type]
        basis = torch.eye(rung.per_color) if rung.basis is None else torch.tensor(rung.basis)
        basis = torch.kron(basis, torch.eye(colors))[..., None, None]
        self.register_buffer("basis", basis if rung.basis else None, persistent=False)

    def forward(self, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """DiffUNet's and SpecUNet's images."""
        with torch.autocast(inputs.device.type, enabled=False):  # half precision would round small differences away
            inputs = inputs.float()
            seen = inputs if self.basis is None else conv2d(inputs, self.basis)
        images = torch.cat([net(seen) for net in self.nets], dim=1)
        with torch.autocast(inputs.device.type, enabled=False):
            images = images.float() + self.linear(inputs)
        return images[:, : self.colors], images[:, self.colors :]
