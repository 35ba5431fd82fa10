"""From exact lobes to what a polarization camera records of them, and what a separation is to find in it.

In physical order: the lens blurs the light, the exposure scales it so that a given share of the object's samples clips,
the sensor of `camera` measures it behind its mosaic of filters. The truth goes through lens and exposure with it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d, pad

from polsep.camera import Layout, Mosaic, Sensor, expose, measure_with_analysers, sample_mosaic
from polsep.render import Scene

#: Brightest sample of an object, as a share of the white level, where none is to clip.
HEADROOM = 0.95


@dataclass(frozen=True)
class Capture:
    """One raw frame ``mosaic [H, W]`` and the exposed ``scene`` behind it, at raw resolution."""

    mosaic: Mosaic
    scene: Scene


def half_resolution(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Diffuse, specular ``[C, H/2, W/2]`` and mask ``[H/2, W/2]``: means over each 2x2 cell, whole in the mask."""
    diffuse, specular = avg_pool2d(scene.diffuse.s0, 2), avg_pool2d(scene.specular.s0, 2)
    return diffuse, specular, avg_pool2d(scene.mask[None].float(), 2)[0] == 1


def blur(scene: Scene, sigma: float) -> Scene:
    """The scene behind a lens whose point spread is a Gaussian of ``sigma`` raw pixels; the mask stays."""
    if sigma == 0:
        return scene
    radius = math.ceil(3 * sigma)
    taps = torch.exp(-0.5 * (torch.arange(-radius, radius + 1) / sigma) ** 2)
    taps = taps / taps.sum()

    def smooth(image: Tensor) -> Tensor:
        image = pad(image[:, None], (radius, radius, radius, radius), mode="reflect")
        return conv2d(conv2d(image, taps.view(1, 1, 1, -1)), taps.view(1, 1, -1, 1))[:, 0]

    return Scene(scene.diffuse.map(smooth), scene.specular.map(smooth), scene.mask)


def expose_to_clip(scene: Scene, share: float, layout: Layout, sensor: Sensor) -> Scene:
    """The scene scaled so that ``share`` of the object's samples clips; none, and `HEADROOM`, for 0.

    Raises ValueError when the mask is empty or nothing in it is lit.
    """
    light = scene.diffuse + scene.specular
    samples = sample_mosaic(measure_with_analysers(light, layout.angles, sensor.diattenuation), layout)[scene.mask]
    kept = samples.numel() - round(share * samples.numel())
    brightest = float(samples.kthvalue(max(kept, 1)).values) if samples.numel() else 0.0
    if not brightest > 0:
        raise ValueError("expected an object that light reaches, found none in the mask")
    gain = (1.0 if share else HEADROOM) / brightest
    return Scene(scene.diffuse * gain, scene.specular * gain, scene.mask)


def capture(scene: Scene, layout: Layout, sensor: Sensor, generator: torch.Generator | None = None) -> Capture:
    """One raw frame of an exposed scene; see `camera.expose`."""
    return Capture(expose(scene.diffuse + scene.specular, layout, sensor, generator), scene)
