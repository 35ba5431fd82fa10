"""Samples as real sensors give them: errors of analysers and pixels, wrong levels, lossy files.

Functions are pure and work on samples ``[..., H, W]`` with black at 0 and white at 1, whole frames or batches of crops
that begin at a whole period of the layout. `record` applies all of them in physical order. Neutral arguments change
nothing. Draws take a generator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from polsep.physics.stokes import Stokes
from polsep.render.simulate import filter_light
from polsep.sensor.camera import Layout, Mosaic, Sensor, add_noise, digitize

#: Kinds of defective pixels in equal parts: dead ones (0), stuck ones (white), hot ones (a random offset in `HOT`), and
#: weak ones (a random factor in `WEAK`). Sensors in use have 1e-5 to 1e-3 of them (EMVA 1288, section 8.6).
DEFECTS = ("dead", "stuck", "hot", "weak")
HOT, WEAK = (0.1, 1.0), (0.1, 0.7)


@dataclass(frozen=True)
class SensorErrors:
    """Deviations of a sensor from the ideal one.

    ``angles_deg``: standard deviation of the analysers' angles within a period [degrees] (IMX250: below 1). ``gains``:
    standard deviation of the pixels' gains (0.01). ``period_gains``: the same of the pixels of one period, that all
    periods share (0.02 where a polarizer's transmittance differs). ``cross_talk``: share of a pixel's light that its
    four neighbours receive (0.02; Hagen et al. 2019). ``black``: sample without light, as a share of white (240
    codes of 4095: 0.059). ``defects``: share of defective pixels. ``specimen``: number of the sensor, which
    fixes its errors for all its frames.
    """

    angles_deg: float = 0.0
    gains: float = 0.0
    period_gains: float = 0.0
    cross_talk: float = 0.0
    black: float = 0.0
    defects: float = 0.0
    specimen: int = 0


def record(light: Stokes, layout: Layout, sensor: Sensor, errors: SensorErrors, seed: int) -> Mosaic:
    """Return a raw frame of ``light [..., C, H, W]`` by a sensor with errors; without any it is `camera.expose`.

    ``seed`` fixes the noise alone, so that twins with and without an error share it.
    """
    noise = torch.Generator().manual_seed(seed)
    angles, gains, defects = (torch.Generator().manual_seed(3 * errors.specimen + k) for k in range(3))
    samples = filter_light(light, layout, sensor, random_analyser_angles(layout, errors.angles_deg, angles))
    samples = cross_talk(samples, errors.cross_talk)
    samples = vary_gains(samples, layout, (errors.gains, errors.period_gains), gains)
    samples = (errors.black + (1 - errors.black) * add_noise(samples, sensor, noise)).clamp(0, 1)
    return digitize(add_defects(samples, errors.defects, defects), layout, sensor)


def random_analyser_angles(layout: Layout, deviation_deg: float, generator: torch.Generator) -> Tensor:
    """Return the errors [rad] ``[P, P]`` of the analysers' angles in one period of the layout."""
    return math.radians(deviation_deg) * torch.randn(layout.period, layout.period, generator=generator)


def cross_talk(samples: Tensor, share: float) -> Tensor:
    """Return samples of which each gives a ``share`` in [0, 0.2] to its four neighbours, in equal parts.

    Borders are mirrored, so an even field stays even. Source: Hagen, Shibata, Wang, Tkaczyk 2019,
    doi:10.1117/12.2520642.
    """
    if share == 0:
        return samples
    around = pad(samples.reshape(-1, 1, *samples.shape[-2:]), (1, 1, 1, 1), mode="reflect").view(
        *samples.shape[:-2], samples.shape[-2] + 2, samples.shape[-1] + 2
    )
    near = around[..., :-2, 1:-1] + around[..., 2:, 1:-1] + around[..., 1:-1, :-2] + around[..., 1:-1, 2:]
    return samples * (1 - share) + near * (share / 4)


def vary_gains(samples: Tensor, layout: Layout, deviations: tuple[float, float], generator: torch.Generator) -> Tensor:
    """Return samples times random gains of mean 1; standard ``deviations`` of single pixels, and within a period."""
    single, shared = deviations
    height, width = samples.shape[-2:]
    if single:
        samples = samples * (1 + single * torch.randn(height, width, generator=generator))
    if shared:
        cell = 1 + shared * torch.randn(layout.period, layout.period, generator=generator)
        rows, cols = (-(-n // layout.period) for n in (height, width))
        samples = samples * cell.repeat(rows, cols)[:height, :width]
    return samples


def add_defects(samples: Tensor, density: float, generator: torch.Generator) -> Tensor:
    """Return samples of which a share ``density`` comes from defective pixels of all kinds in `DEFECTS`."""
    if density == 0:
        return samples
    size = samples.shape[-2:]
    kind = torch.where(torch.rand(size, generator=generator) < density, 0, -1)
    kind = torch.where(kind == 0, torch.randint(len(DEFECTS), size, generator=generator), kind)
    place = torch.rand(size, generator=generator)
    hot, weak = (low + (high - low) * place for low, high in (HOT, WEAK))
    for index, values in enumerate(
        (torch.zeros_like(samples), torch.ones_like(samples), samples + hot, samples * weak)
    ):
        samples = torch.where(kind == index, values.clamp(max=1), samples)
    return samples


def encode_gamma(mosaic: Mosaic) -> Mosaic:
    """Return the frame as 8-bit sRGB codes, as cameras give whose gamma was left on. Source: IEC 61966-2-1."""
    x = mosaic.linear().clamp(0, 1)
    encoded = torch.where(x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=1e-12) ** (1 / 2.4) - 0.055)
    return Mosaic(torch.round(255 * encoded), mosaic.layout, 0.0, 255.0)
