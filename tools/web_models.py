"""``python -m tools.web_models DIR``: write the networks of the browser page (web/) as ONNX files into a folder.

The layers are those of ``polsep export joint-fast``. The page's graphs begin after the levels, so that the page can
divide the light's colour out without moving what counts as clipped, and end with what the report is made of, too.

Note: this takes torch's older exporter, which needs seconds for a graph, the newer one minutes on a small machine.
tests/test_web.py compares what the page makes with polsep's own images.
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from polsep.io.store.atomic import atomic_path
from polsep.networks.channels import PERIOD
from polsep.networks.joint import Joint, limit
from polsep.networks.taps import pool_outputs
from polsep.networks.thumbnails import SIDE, thumbnail_channels
from polsep.sensor.camera import Layout
from polsep.separation.clipped_pattern import shares_of, smooth_planes, taps_of, weigh_clipped
from polsep.shipped import shipped_joint

#: Files by the layout of the frames that their network reads.
FILES = {"joint-fast.onnx": Layout(), "joint-fast-mono.onnx": Layout(bayer=None)}
OUTPUTS = ("diffuse", "specular", "error", "s1", "s2", "residual")
#: Set of operators; sides of the frame that is traced.
OPERATORS, SIDES = 17, (64, 96)


class PageNetwork(nn.Module):
    """``frame [1, 2, H, W]``, linear samples and 1 where they clip, in Sony's order, to images, channels first.

    ``thumbnail``: of the whole frame, for a network that sees it (`whole_frame.make_thumbnail`).

    ``diffuse``, ``s1``, ``s2 [1, C, H/2, W/2]``, ``specular [1, 1, H/2, W/2]``, ``error [1, 2, H/2, W/2]``,
    ``residual [1, 1, H/4, W/4]``; H and W are multiples of 4.
    """

    def __init__(self, network: Joint) -> None:
        super().__init__()
        assert network.demosaic is not None
        self.network, s0 = network, 16 * network.colors
        # As a constant: the exporter mistakes the strides of slices of constants.
        half = torch.cat([pool_outputs(network.demosaic[:s0]), network.demosaic[s0:]])
        pad = nn.ReplicationPad2d(half.shape[-1] // 2)

        def demosaicked(planes: Tensor, full: bool) -> tuple[Tensor, Tensor]:
            del full
            return nn.functional.conv2d(pad(planes), half), planes[:, :0]

        self.network.demosaicked = demosaicked  # type: ignore[method-assign]

    def forward(self, frame: Tensor, thumbnail: Tensor | None = None) -> tuple[Tensor, ...]:
        """See the class."""
        images = self.network.half_resolution(frame[:, :1], frame[:, 1:] > 0.5, thumbnail)
        diffuse, specular, error = limit(images)
        weight = weigh_clipped(frame[:, 1:], taps_of(PERIOD), shares_of(self.network.colors))
        diffuse, specular = (smooth_planes(image, weight, taps_of(PERIOD // 2)) for image in (diffuse, specular))
        return diffuse, specular, error, images.s1, images.s2, images.fit_residual


def write_models(folder: Path) -> None:
    """Write `FILES`, each under its name once it is whole."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, layout in FILES.items():
        network = Joint.of(shipped_joint("joint-fast", layout)[0], torch.device("cpu"))
        graph, inputs = PageNetwork(network).eval(), [torch.zeros(1, 2, *SIDES)]
        if network.whole_frame is not None:
            inputs.append(torch.zeros(1, thumbnail_channels(network.colors), SIDE, SIDE))
        with atomic_path(folder / name) as part, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the exporter is the older one, and remarks about its own parts
            torch.onnx.export(
                graph,
                tuple(inputs),
                str(part),
                dynamo=False,
                input_names=["frame", "thumbnail"][: len(inputs)],
                output_names=list(OUTPUTS),
                dynamic_axes={"frame": {2: "H", 3: "W"}},
                opset_version=OPERATORS,
            )


if __name__ == "__main__":
    write_models(Path(sys.argv[1]))
