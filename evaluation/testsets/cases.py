"""Cases of a selection set: exposed scenes with three captures each, and their records.

Records compare numbers, not bytes: ray casts and powers differ by rounding between machines, and a hash over floats,
however coarsely rounded, flips where a value lies at a rounding step. So `fingerprint` is eight weighted means per
scene, recorded as integers and compared within `TOLERANCE`; the sha256 of a set is over these records.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from evaluation.testsets.expected import EXPECTED
from polsep.io.assets.objects import hash_files
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.render.simulate import expose_to_clip, half_resolution
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import IDEAL, IMX250, Layout, Mosaic, expose

#: Largest share of an object's samples that clips; each scene draws its own share below it.
LARGEST_CLIPPED = 0.05
#: Seeds of the noise are those of the scenes plus this.
NOISE_SEED = 1_000_000
#: Unit of the recorded numbers, and how many units they may differ between machines.
UNIT, TOLERANCE = 1e-6, 50


@dataclass(frozen=True)
class Recipe:
    """Recipe of one scene: its ``seed``, input ``files`` below the data folder, and what makes a `Scene` of them.

    ``make`` takes the paths of the files and a generator of that seed; its scene needs no exposure.
    """

    name: str
    seed: int
    files: tuple[str, ...]
    make: Callable[[list[Path], torch.Generator], Scene]


@dataclass(frozen=True)
class Case:
    """One exposed scene and its captures under Sony's colour layout.

    ``scene``: exact lobes at raw resolution, 1 = the white level. ``co_sited``: ideal analysers at every pixel, no
    noise, limited at 1. ``clean``: a mosaic of an ideal sensor that clips at 1. ``noisy``: 12 bits of `camera.IMX250`.
    """

    name: str
    scene: Scene
    co_sited: Measurements
    clean: Mosaic
    noisy: Mosaic

    def half_truth(self) -> tuple[Tensor, Tensor, Tensor]:
        """Diffuse, specular ``[3, H/2, W/2]`` and mask ``[H/2, W/2]``: what the mosaics are to be separated into."""
        return half_resolution(self.scene)


def build_case(recipe: Recipe, data: Path | None = None) -> Case:
    """The case of a recipe; ``data`` is the folder that holds the input files, needed where a recipe has some.

    Raises ValueError when files are absent or other than recorded.
    """
    if recipe.files and data is None:
        raise ValueError(f"expected a data folder for the test scene {recipe.name}, found none")
    paths = [Path(data or ".") / name for name in recipe.files]
    found, recorded = digest_of(recipe, data), EXPECTED.get(recipe.name)
    if recorded is not None and found != recorded.inputs:
        raise ValueError(f"expected inputs of {recipe.name} with sha256 {recorded.inputs}, found {found}")
    generator = torch.Generator().manual_seed(recipe.seed)
    share = LARGEST_CLIPPED * torch.rand(1, generator=generator).item()
    scene = expose_to_clip(recipe.make(paths, generator), share, Layout(), IDEAL)
    light, layout = scene.diffuse + scene.specular, Layout()
    exact = measure(light, layout.angles)
    noise = torch.Generator().manual_seed(NOISE_SEED + recipe.seed)
    return Case(
        recipe.name,
        scene,
        Measurements(exact.data.clamp(max=1), exact.angles, exact.data >= 1),
        expose(light, layout, IDEAL),
        expose(light, layout, IMX250, noise),
    )


def build_cases(recipes: Iterable[Recipe], data: Path | None = None) -> Iterator[Case]:
    """The cases of recipes, made one by one as they are asked for."""
    for recipe in recipes:
        yield build_case(recipe, data)


def digest_of(recipe: Recipe, data: Path | None) -> str:
    """First 16 digits of the sha256 of a recipe's files, "" without files. Raises ValueError where one is absent."""
    if not recipe.files:
        return ""
    return hash_files([Path(data or ".") / name for name in recipe.files])[:16]


def fingerprint(case: Case) -> tuple[int, ...]:
    """Eight weighted means in units of `UNIT`: s0, s1, s2 of the diffuse and of the specular, clean and noisy samples.

    Weights differ between colours and over the image, so that no flip, shift or swap goes unnoticed.
    """
    return tuple(round(mean / UNIT) for mean in weigh_scene(case.scene, (case.clean, case.noisy)))


def weigh_scene(scene: Scene, mosaics: tuple[Mosaic, ...]) -> tuple[float, ...]:
    """The weighted means behind `fingerprint`: s0, s1, s2 of the diffuse and of the specular, then the samples."""
    lobes = [image for lobe in (scene.diffuse, scene.specular) for image in _components(lobe)]
    return tuple(_weighted_mean(image) for image in (*lobes, *(mosaic.linear()[None] for mosaic in mosaics)))


def check_case(case: Case) -> None:
    """Raise ValueError unless the case is the recorded one, within `TOLERANCE`."""
    recorded = EXPECTED.get(case.name)
    if recorded is None:
        raise ValueError(f"expected a recorded test scene, found {case.name}")
    found = fingerprint(case)
    if max(abs(a - b) for a, b in zip(found, recorded.outputs, strict=True)) > TOLERANCE:
        raise ValueError(f"expected {case.name} to have the fingerprint {recorded.outputs}, found {found}")


def version_of(recipes: Iterable[Recipe]) -> str:
    """The sha256 of the records of a set: names, inputs and outputs. Quote its first digits beside a score."""
    lines = [f"{r.name} {r.seed} {EXPECTED[r.name].inputs} {EXPECTED[r.name].outputs}\n" for r in recipes]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _components(stokes: Stokes) -> tuple[Tensor, Tensor, Tensor]:
    return stokes.s0, stokes.s1, stokes.s2


def _weighted_mean(image: Tensor) -> float:
    """Mean of ``[C, H, W]`` with smooth weights around 1 that have no symmetry."""
    channels, height, width = image.shape
    rows, cols = (torch.arange(n, dtype=torch.float64) / n for n in (height, width))
    down, right = 1 + 0.5 * torch.sin(2 * math.pi * rows + 1), 1 + 0.5 * torch.sin(2 * math.pi * cols + 2)
    weights = (1 + torch.arange(channels, dtype=torch.float64))[:, None, None] * down[:, None] * right
    return float((image.double() * weights).sum() / weights.sum())
