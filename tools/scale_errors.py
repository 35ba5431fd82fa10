"""``python -m tools.scale_errors METHOD...``: scale what the networks of colour methods expect of their errors.

A network learns its expected errors while its images still improve, and images of several networks are better than
each, so both expect too much. The factor is what the median over validation frames asks for: rendered objects under
disturbances of `datasets.reality` with the light stated, where nothing clips, in tenths of the pixels by their expected
errors. It is the same for all methods that are named, so networks that weigh each other's images by these errors go on
to do so in the same way. It goes into the last bias of the expected errors in ``polsep/weights/METHOD-mosaic``; images
of that network stay. (Guo et al. 2017, arXiv 1706.04599, scale a classifier's logits in the same way.)
"""

from __future__ import annotations

import json
import math
import warnings

import click
import numpy as np
import torch
from torch.nn.functional import max_pool2d

from polsep.datasets import reality
from polsep.io.store.rounding import names_to_round
from polsep.io.store.weights import read_weights, shipped_weights, write_weights
from polsep.metrics import reliability
from polsep.networks.joint_weights import scale_errors
from polsep.pipeline import PolsepWarning, separate

#: Numbers of the objects; 'polsep bench reality' draws the first 24. Pixels along their frames' sides.
STAGES, SIZE = range(100, 112), 384
#: What differs in the frames; retained polarization and two lamps, which no network can tell, are left out.
DISTURBANCES = (
    "white lamp",
    "tungsten",
    "a tenth of the exposure",
    "8 bits",
    "clipped 1 %",
    "usual rig",
    "room light 30 %",
    "polarizer 0.8",
)
#: Groups of pixels by their expected error; cells to all sides of a clipped sample that do not count.
GROUPS, NEAR = 10, 4


def log_ratios(stages: list[reality.Stage], disturbance: str, method: str) -> list[list[float]]:
    """log2(found / expected) of the tenths of the pixels of all frames together, for diffuse and for specular."""
    parts = [_errors_of(reality.DISTURBANCES[disturbance](stage), method) for stage in stages]
    error, expected = (torch.cat(x, dim=-1) for x in zip(*parts, strict=True))
    whole = torch.ones(1, error.shape[-1], dtype=torch.bool)
    found = [reliability(error[k], expected[k, None], whole, GROUPS) for k in range(2)]
    return [torch.log2(curve.found / curve.expected).tolist() for curve in found]


def _errors_of(frame: reality.Frame, method: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Errors ``[2, C, 1, n]`` of diffuse and specular, and the expected ones ``[2, n]``, where nothing clips nearby."""
    light = (frame.options or {}).get("light_color", (1.0, 1.0, 1.0))
    found = separate(frame.raw, method, white_level=frame.white_level, light_color=light)
    assert found.error is not None
    rows, columns = (n // 2 for n in frame.raw.shape)
    clips = (frame.raw >= frame.white_level - 1).reshape(rows, 2, columns, 2).any((1, 3))
    near = max_pool2d(torch.from_numpy(clips)[None].float(), 2 * NEAR + 1, stride=1, padding=NEAR)[0] > 0
    kept = frame.mask & ~near
    images = [torch.from_numpy(image).movedim(-1, 0) for image in (found.diffuse, found.specular)]
    errors = torch.stack([images[0] - frame.diffuse, images[1] - frame.specular])
    return errors[..., kept][:, :, None], torch.from_numpy(found.error).movedim(-1, 0)[:, kept]


@click.command()
@click.argument("methods", nargs=-1, required=True, metavar="METHOD...")
def main(methods: tuple[str, ...]) -> None:
    """Measure, scale and write."""
    warnings.simplefilter("ignore", PolsepWarning)
    stages, tenths = [reality.build_stage("validation", number, SIZE) for number in STAGES], []
    for disturbance in DISTURBANCES:
        for method in methods:
            tenths.append(log_ratios(stages, disturbance, method))
            print(disturbance, method, *(" ".join(f"{x:+.1f}" for x in t) for t in tenths[-1]), sep=" | ", flush=True)
    diffuse, specular = (float(f"{2.0**x:.3g}") for x in np.median(np.array(tenths), axis=(0, 2)))
    for path in (shipped_weights(f"{method}-mosaic") for method in methods):
        arrays, metadata = read_weights(path)
        before = json.loads(metadata.get("error_factors", "[1, 1]"))
        del metadata["sha256"]
        total = json.dumps([float(f"{math.prod(p):.3g}") for p in zip(before, (diffuse, specular), strict=True)])
        names = names_to_round(arrays, metadata) if "rounded_from" in metadata else ()
        write_weights(path, scale_errors(arrays, (diffuse, specular)), metadata | {"error_factors": total}, names)
        print(f"{path}: expected errors times {diffuse:g} and {specular:g}, in all {total}")


if __name__ == "__main__":
    main()
