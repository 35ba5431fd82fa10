"""``python -m tools.make_samples polsep/data/samples``: render the sample frames that come with polsep.

All show `render.distances.still_life` as the model of Sony's IMX250 records it: 12-bit values in 16-bit PNG files, with
noise of fixed seeds, so that the same program makes the same files. README.md there says what each of them shows. About
a minute.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import imagecodecs
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.physics.stokes import Stokes
from polsep.render.distances import still_life
from polsep.render.sphere_tracing import cast, is_lit, render_points, shade
from polsep.sensor.camera import IMX250, Layout, add_noise, expose, measure_with_analysers

#: Rows and columns of mosaics; the four angle images have half as many.
SIZE = (344, 408)
#: Places of the wrong layout: the first row and the first three columns of the sensor were cut off.
CUT = Layout().rolled(-1, -3)


def light_scene() -> tuple[Stokes, Stokes]:
    """The light on the sensor, under the lamp with its polarizer and without: as by two lamps with crossed ones."""
    parts, camera, lamp = still_life()
    crossed = replace(lamp, polarizer=lamp.polarizer + math.pi / 2)

    def shade_points(rows: Tensor, cols: Tensor) -> tuple[Stokes, Stokes]:
        buffer = cast(parts, camera, rows, cols, SIZE)
        lit = is_lit(parts, buffer, lamp)
        first, second = (
            diffuse + specular for diffuse, specular in (shade(buffer, camera, p, lit) for p in (lamp, crossed))
        )
        return first, (first + second).map(lambda s: s / 2)

    return render_points(shade_points, SIZE, 2)


def record(light: Stokes, layout: Layout, seed: int) -> Tensor:
    """Codes of a mosaic ``[H, W]``."""
    codes: Tensor = expose(light, layout, IMX250, torch.Generator().manual_seed(seed)).data
    return codes


def record_angles(light: Stokes, seed: int) -> Tensor:
    """Codes of four images ``[4, H, W, 3]`` through a polarizer at 0, 45, 90 and 135 degrees."""
    angles = tuple(math.radians(angle) for angle in (0, 45, 90, 135))
    signal: Tensor = measure_with_analysers(light, angles, IMX250.diattenuation).data
    noisy: Tensor = add_noise(signal, IMX250, torch.Generator().manual_seed(seed))
    return (noisy.clamp(0, 1) * IMX250.white_level).round().movedim(-3, -1)


def main(folder: Path) -> None:
    """Render, record and write."""
    light, unpolarized = light_scene()
    small = light.map(lambda s: avg_pool2d(s, 2))
    grey = light.map(lambda s: s.mean(dim=-3, keepdim=True))
    frames = {
        "color": record(light, Layout(), 1),
        "mono": record(grey, Layout(bayer=None), 2),
        "wrong_layout": record(light, CUT, 3),
        "unpolarized": record(unpolarized, Layout(), 4),
        "clipped": record(light.map(lambda s: 4 * s), Layout(), 5),
    }
    frames |= {f"angle_{45 * k}": image for k, image in enumerate(record_angles(small, 6))}
    folder.mkdir(parents=True, exist_ok=True)
    for name, codes in frames.items():
        pixels = np.ascontiguousarray(codes.numpy().astype(np.uint16))
        # The files that are shipped were made a twelfth smaller afterwards, by `oxipng --zopfli`.
        (folder / f"{name}.png").write_bytes(imagecodecs.png_encode(pixels, level=9))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
