"""The joint network as one exportable module from raw samples to images, for engines other than torch.

It accepts a batch of raw frames ``[N, H, W]`` in Sony's order, H and W multiples of 4, with their black and white
level, and returns ``[N, h, w, ...]`` images, those of `networks.run.run_joint` for such frames. `io.store.onnx` writes
it to a file.
"""

from __future__ import annotations

from torch import Tensor, nn

from polsep.networks.joint import Joint, limit
from polsep.sensor.camera import CLIP_MARGIN

#: Names of the outputs, in order.
OUTPUT_NAMES = ("diffuse", "specular", "error")


class ExportedNetwork(nn.Module):
    """``raw [N, H, W]`` integers or floats, ``black_level [1]``, ``white_level [1]`` to images, channels last.

    ``diffuse [N, h, w, C]``, ``specular [N, h, w, 1]`` white, not negative; ``error [N, h/k, w/k, 2]``: expected
    standard deviation of the error of both at half resolution. h = H / 2, or H with ``full``.
    """

    def __init__(self, network: Joint, full: bool) -> None:
        super().__init__()
        self.network, self.full = network, full

    def forward(self, raw: Tensor, black_level: Tensor, white_level: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """See the class."""
        samples = ((raw.float() - black_level) / (white_level - black_level))[:, None]
        clipped = samples >= 1 - CLIP_MARGIN
        images = self.network(samples, clipped)[0] if self.full else self.network.half_resolution(samples, clipped)
        diffuse, specular, error = limit(images)
        return diffuse.permute(0, 2, 3, 1), specular.permute(0, 2, 3, 1), error.permute(0, 2, 3, 1)
