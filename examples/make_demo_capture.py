"""Make the capture that `polsep demo` separates: python examples/make_demo_capture.py polsep/data/still_life.png

A 2448x2048 12-bit colour mosaic of `render.distances.still_life`, seen by the IMX250MYR model with noise and clipping,
stored right-justified in a 16-bit PNG (white level 4095). About three minutes on two cores. With a second path, the
truth (diffuse and specular at half resolution) goes there as NPZ.
"""

import sys

import imagecodecs
import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from polsep.render.distances import still_life
from polsep.render.sphere_tracing import render
from polsep.sensor.camera import IMX250, Layout, expose


def main(path: str, truth: str | None = None) -> None:
    """Render, expose with a fixed seed, write."""
    parts, camera, light = still_life()
    diffuse, specular = render(parts, camera, light, (2048, 2448), samples=2)
    mosaic = expose(diffuse + specular, Layout(), IMX250, torch.Generator().manual_seed(2022))
    codes = np.ascontiguousarray(mosaic.data.numpy().astype(np.uint16))
    with open(path, "wb") as file:
        file.write(imagecodecs.png_encode(codes, level=9))
    if truth:
        half = [avg_pool2d(lobe.s0, 2).permute(1, 2, 0).numpy().astype(np.float16) for lobe in (diffuse, specular)]
        np.savez_compressed(truth, diffuse=half[0], specular=half[1])


if __name__ == "__main__":
    main(*sys.argv[1:])
