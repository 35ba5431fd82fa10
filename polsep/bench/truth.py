"""Inputs that benchmarks share: rendered and exposed scenes of known truth, and the demo capture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.compute.arrays import to_numpy
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.store.samples import DEMO, DEMO_WHITE
from polsep.physics.stokes import Measurements, measure
from polsep.render.distances import random_light, random_parts
from polsep.render.sphere_tracing import PinholeCamera, Scene, render
from polsep.sensor.camera import IMX250, Capture, Layout, Mosaic, add_noise, expose

#: Seeds of the benchmark's scenes; nothing is ever tuned or trained on seeds from 2000 to 2999.
SCENE_SEEDS = tuple(range(2000, 2008))
SCENE_SIZE = (384, 384)


def read_demo_capture() -> Mosaic:
    """The 2448x2048 colour frame of 12 bits that comes with polsep."""
    frame = next(read_frames(DEMO, ReadOptions(white_level=DEMO_WHITE))).data
    assert isinstance(frame, Mosaic)
    return frame


def read_real_frames(data: Path) -> Iterator[tuple[str, Mosaic]]:
    """The frames of ``data``/raw by their stems; colour sensors have a quad-Bayer pattern."""
    for path in sorted((data / "raw").glob("*.png")):
        layout = Layout() if "quadbayer" in path.stem else Layout(bayer=None)
        mosaic = next(read_frames(path, ReadOptions(layout))).data
        assert isinstance(mosaic, Mosaic)
        yield path.stem, mosaic


def read_demo_codes() -> NDArray[np.uint16]:
    """Codes of the demo capture, as a camera gives them."""
    return to_numpy(read_demo_capture().data).astype(np.uint16)


def render_scene(seed: int, saturation: float, size: tuple[int, int] = SCENE_SIZE) -> Scene:
    """A random scene of four objects under one random polarized light; ``saturation`` 0 makes every albedo grey.

    Exposed so that 1 % of the diffuse light exceeds s0 = 1.4.
    """
    generator = torch.Generator().manual_seed(seed)
    parts = random_parts(generator, 4, saturation)
    light = random_light(generator)
    diffuse, specular = render(parts, PinholeCamera((0.0, 0.0, 8.0), (0.0, 0.0, 0.0), 24.0), light, size)
    mask = (diffuse + specular).s0.amax(dim=0) > 1e-3
    gain = 1.4 / float(torch.quantile(diffuse.s0.amax(dim=0)[mask], 0.99))
    return Scene(diffuse * gain, specular * gain, mask)


Captures = Iterator[tuple[str, Capture, Tensor, tuple[Tensor, Tensor]]]


def captures(scene: Scene, seed: int) -> Captures:
    """A scene as co-sited exact, co-sited noisy and mosaicked noisy samples, each with its mask and truth."""
    light, angles = scene.diffuse + scene.specular, Layout().angles
    exact = measure(light, angles)
    truth = (scene.diffuse.s0, scene.specular.s0)
    clipped = exact.data >= 1
    limited = Measurements(exact.data.clamp(max=1), angles, clipped)
    unclipped = scene.mask & ~clipped.any(dim=0).any(dim=0)
    yield "co-sited exact, unclipped pixels", limited, unclipped, truth
    yield "co-sited exact, with clipping", limited, scene.mask, truth
    generator = torch.Generator().manual_seed(seed)
    noisy = add_noise(exact.data, IMX250, generator).clamp(0, 1)
    yield "co-sited, sensor noise", Measurements(noisy, angles, noisy >= 1), scene.mask, truth
    mosaic = expose(light, Layout(), IMX250, generator)
    half = (avg_pool2d(truth[0], 2), avg_pool2d(truth[1], 2))
    mask = avg_pool2d(scene.mask[None].float(), 2)[0] == 1
    yield "mosaic, sensor noise", mosaic, mask, half
