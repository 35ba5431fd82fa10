"""Floors for the accuracy of what is shipped: every method on frames that served for no choice.

Four small rendered scenes on the IMX250's noise, half a percent of their samples clipped. A floor lies half a decibel
below the score of the weights that it was written for: rounding moves a score by hundredths, a mistake by decibels.
Better weights raise the floors; nobody chooses weights by these scenes.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
import torch
from torch import Tensor

from polsep.methods import METHODS
from polsep.metrics import psnr
from polsep.render.distances import random_light, random_parts
from polsep.render.simulate import expose_to_clip, half_resolution
from polsep.render.sphere_tracing import PinholeCamera, Scene, render
from polsep.sensor.camera import IMX250, Layout, expose

SEEDS, SIDE, CLIPPED = (41001, 41002, 41003, 41004), 128, 0.005
COLOR, MONO = Layout(), Layout(bayer=None)
#: Mean PSNR of the diffuse and of the specular image in dB, half a decibel below the score.
FLOORS = {
    ("joint-large", COLOR, False): (30.4, 29.1),
    ("joint", COLOR, False): (30.0, 28.8),
    ("joint-fast", COLOR, False): (28.7, 27.3),
    ("paper", COLOR, False): (29.3, 27.3),
    ("color-affine", COLOR, False): (28.7, 25.6),
    ("analytic", COLOR, False): (23.1, 22.0),
    ("joint-large", MONO, False): (37.8, 28.2),
    ("joint", MONO, False): (37.8, 28.4),
    ("joint-fast", MONO, False): (37.2, 28.3),
    ("joint-large", COLOR, True): (28.5, 28.9),
    ("joint", COLOR, True): (28.2, 28.6),
    ("joint-fast", COLOR, True): (27.0, 27.4),
    ("joint-large", MONO, True): (33.4, 28.1),
    ("joint", MONO, True): (33.4, 28.3),
    ("joint-fast", MONO, True): (33.0, 28.2),
}
#: Each is better than the next on these scenes, in both images.
RANKING = ("joint-large", "joint", "paper", "analytic")


@lru_cache(maxsize=1)
def scenes() -> tuple[Scene, ...]:
    """Random objects on black under one polarized light."""

    def scene(seed: int) -> Scene:
        generator = torch.Generator().manual_seed(seed)
        parts, camera = random_parts(generator, 3, 0.6), PinholeCamera((0, 0, 8), (0, 0, 0), 24)
        diffuse, specular = render(parts, camera, random_light(generator), (SIDE, SIDE), 2)
        seen = Scene(diffuse, specular, (diffuse.s0 + specular.s0).mean(dim=0) > 1e-6)
        return expose_to_clip(seen, CLIPPED, COLOR, IMX250)

    return tuple(scene(seed) for seed in SEEDS)


@lru_cache(maxsize=32)
def scores(name: str, layout: Layout, full: bool) -> tuple[float, float]:
    """Mean PSNR of both images over the scenes."""
    found = []
    for number, scene in enumerate(scenes()):
        light = scene.diffuse + scene.specular
        truth = (scene.diffuse.s0, scene.specular.s0, scene.mask) if full else half_resolution(scene)
        if layout is MONO:
            light, truth = light.map(lambda s: s[1:2]), (truth[0][1:2], truth[1][1:2], truth[2])
        mosaic = expose(light, layout, IMX250, torch.Generator().manual_seed(number))
        images = METHODS[name].run(mosaic, (1.0,) * layout.channels, full)
        pairs = zip((images.diffuse, images.specular), truth[:2], strict=True)
        found.append([psnr(planes(image), true, truth[2]) for image, true in pairs])
    diffuse, specular = np.mean(found, axis=0)
    return float(diffuse), float(specular)


def planes(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).movedim(-1, 0)


@pytest.mark.parametrize(("name", "layout", "full"), FLOORS, ids=lambda x: x.spec if isinstance(x, Layout) else str(x))
def test_no_method_falls_below_its_floor(name: str, layout: Layout, full: bool) -> None:
    diffuse, specular = scores(name, layout, full)
    floors = FLOORS[name, layout, full]
    assert diffuse > floors[0] and specular > floors[1], (diffuse, specular)
    assert diffuse < floors[0] + 1.5 and specular < floors[1] + 1.5, "better: raise the floors"


@pytest.mark.parametrize("better", range(len(RANKING) - 1))
def test_methods_keep_their_order(better: int) -> None:
    first, second = (scores(RANKING[better + k], COLOR, False) for k in (0, 1))
    assert first[0] > second[0] and first[1] > second[1]
