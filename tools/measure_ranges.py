"""``python -m tools.measure_ranges FILE...``: measure the ranges of the layers' inputs and write them into weights.

The frames are rendered objects of the split "validation", undisturbed and under disturbances of `datasets.reality`;
for mono networks the same objects without colours. Arrays stay as they are.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from polsep.datasets import reality
from polsep.io.store.weights import read_weights, write_weights
from polsep.networks.joint_weights import joint_weights
from polsep.networks.ranges import measure_ranges
from polsep.sensor.camera import IMX250, Layout, Mosaic, expose
from polsep.sensor.levels import as_mosaic

#: Numbers of the objects; 'polsep bench reality' draws the first 24. Pixels along their frames' sides.
STAGES, SIZE = range(100, 106), 512
DISTURBANCES = ("white lamp", "tungsten", "room light 30 %", "clipped 5 %", "a tenth of the exposure", "metals")


def frames(colors: int) -> Iterator[Mosaic]:
    """Raw frames for networks of so many colours."""
    for number in STAGES:
        stage = reality.build_stage("validation", number, SIZE)
        if colors == 1:
            scene = reality.light_stage(stage)
            light = (scene.diffuse + scene.specular).map(lambda s: s.mean(dim=-3, keepdim=True))
            mosaic = expose(light, Layout(bayer=None), IMX250, stage.draw(1))
            yield replace(mosaic, data=mosaic.data.numpy())
            continue
        for name in DISTURBANCES:
            frame = reality.DISTURBANCES[name](stage)
            color = (frame.options or {}).get("light_color", (1.0, 1.0, 1.0))
            yield replace(as_mosaic(frame.raw, white_level=frame.white_level)[0], light_color=color)


def main(paths: list[str]) -> None:
    """Measure and write."""
    for path in map(Path, paths):
        arrays, metadata = read_weights(path)
        ranges = measure_ranges(joint_weights(arrays, metadata), frames(int(metadata["colors"])))
        rounded = {name: [float(f"{bound:.4g}") for bound in bounds] for name, bounds in ranges.items()}
        del metadata["sha256"]
        write_weights(path, arrays, metadata | {"ranges": json.dumps(rounded)})
        print(path, ", ".join(f"{name} {low:g} {high:g}" for name, (low, high) in rounded.items()))


if __name__ == "__main__":
    main(sys.argv[1:])
