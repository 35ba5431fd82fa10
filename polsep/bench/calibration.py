"""What a light polarizer that is not at its nominal angle costs every method (Figs. 4 and 5 of Dave et al. 2022).

Random objects of the test split, the paper's protocol: co-sited samples, clipped at 1, no noise. The light's polarizer
is meant to be at 0 degrees, and at 90 in the second capture of Ding 2021; each time it is off by a normal deviate.
Debevec 2000 sees two photographs under one light, behind an analyser at 0 and at 90 degrees. Snapshot methods see the
first capture alone. Every method is scored against the truth of what it saw, Ding 2021 against the mean of both.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from polsep.bench.rows import Row
from polsep.camera import IDEAL, Layout
from polsep.metrics import psnr
from polsep.multi_capture import separate_debevec2000, separate_ding2021, separate_extremes
from polsep.pipeline import METHODS
from polsep.render import Scene
from polsep.separation import Separation
from polsep.simulate import expose_to_clip
from polsep.stokes import Measurements, measure

if TYPE_CHECKING:
    from polsep.raycast import MeshScene

#: Standard deviations of the polarizer's error [degrees].
ERRORS_DEG = (0, 5, 10, 15, 20)
#: Views, their size, the user's seed of their shapes, and the share of object samples that clips.
VIEWS, SIZE, SEED, CLIPPED = 24, (320, 320), 77, 0.01


@dataclass(frozen=True)
class Seen:
    """Exposed scenes and captures under the nominal light polarizer, 0, and under the crossed one."""

    scenes: tuple[Scene, Scene]
    captures: tuple[Measurements, Measurements]


def bench_calibration(_data: Path | None = None) -> Iterator[Row]:
    """PSNR of every method over the error of the light's polarizer. Needs the extra render."""
    try:
        from polsep.views import scene_seed, seeded_shape
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    scores: dict[tuple[int, str, str], list[float]] = {}
    for index in range(VIEWS):
        shape = seeded_shape("test", SEED, index)
        generator = torch.Generator().manual_seed(scene_seed("test", SEED, index, 0))
        for degrees, seen in see_with_errors(shape, generator):
            for method, (found, truth) in separate_seen(seen).items():
                for output, image, true in (
                    ("diffuse", found.diffuse, truth[0]),
                    ("specular", found.specular, truth[1]),
                ):
                    score = psnr(image, true, seen.scenes[0].mask)
                    scores.setdefault((degrees, method, f"{output} PSNR"), []).append(score)
    for (degrees, method, metric), values in scores.items():
        case = f"light polarizer off by {degrees} degrees rms"
        yield Row("calibration", case, method, metric, statistics.fmean(values), "dB")


def see_with_errors(shape: MeshScene, generator: torch.Generator) -> Iterator[tuple[int, Seen]]:
    """One view of a shape, seen once for every one of `ERRORS_DEG`, with the same deviates scaled."""
    from polsep.materials import random_materials
    from polsep.raycast import find_view, light_view, shade_view
    from polsep.views import random_shot

    shot = random_shot(shape, generator)
    view = find_view(shape, shot.camera, SIZE, 2)
    materials = random_materials(shape.mesh.slot_count, generator, shape.size)
    lit = light_view(shape, view, shot.light)
    deviates = torch.randn(2, generator=generator, dtype=torch.float64).tolist()

    def render(polarizer: float) -> Scene:
        return shade_view(view, materials, replace(shot.light, polarizer=polarizer), lit)

    nominal = render(0.0)
    brightest = expose_to_clip(nominal, CLIPPED, Layout(), IDEAL)
    gain = float(brightest.diffuse.s0.sum() / nominal.diffuse.s0.sum())
    for degrees in ERRORS_DEG:
        first, second = (render(k * math.pi / 2 + math.radians(degrees) * d) for k, d in enumerate(deviates))
        scenes = tuple(Scene(s.diffuse * gain, s.specular * gain, s.mask) for s in (first, second))
        yield degrees, Seen(scenes, tuple(_capture(scene) for scene in scenes))  # type: ignore[arg-type]


def _capture(scene: Scene) -> Measurements:
    exact = measure(scene.diffuse + scene.specular, Layout().angles)
    return Measurements(exact.data.clamp(max=1), exact.angles, exact.data >= 1)


Truth = tuple[Tensor, Tensor]


def separate_seen(seen: Seen) -> dict[str, tuple[Separation, Truth]]:
    """What every method makes of the captures, and the truth that it is scored against."""
    (one, other), (first, second) = seen.scenes, seen.captures
    truth = (one.diffuse.s0, one.specular.s0)
    mean = ((truth[0] + other.diffuse.s0) / 2, (truth[1] + other.specular.s0) / 2)
    crossed = first.angles.index(math.radians(90.0))
    found: dict[str, tuple[Separation, Truth]] = {
        "Debevec 2000, two photographs": (separate_debevec2000(first.data[0], first.data[crossed]), truth),
        "Ding 2021, two lights": (separate_ding2021(first, second), mean),
    }
    snapshot: dict[str, Callable[[Measurements], Separation]] = {"min and max": separate_extremes}
    snapshot |= {name: method.split for name, method in METHODS.items()}
    return found | {name: (split(first), truth) for name, split in snapshot.items()}
