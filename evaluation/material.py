"""Materials from unseparated, separated and perfectly separated photographs: maps, relit pictures, Fig. 9's failure.

Held-out materials are procedural ones of the test split, of which some are metal, further ones that are all metal or
hold some, and, where they are, published maps below the data folder, of which only the white part of the specular map
counts, as they are of dielectrics. Relit pictures compare the maps found with the true ones under `LIGHTS` lights that
no photograph had, by one renderer; white paper shows 1.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from evaluation import WEIGHTS
from polsep.bench.rows import Row
from polsep.io.assets.materials import find_panels, read_panels
from polsep.material.estimate import Estimator, load_estimator
from polsep.material.procedural import halve, random_svbrdf
from polsep.material.shots import RAW_SIZE, Example, make_example, random_example
from polsep.material.svbrdf import CAMERA_HEIGHT, INPUTS, MAP_SIZE, Svbrdf, plane_points, relight, unstack
from polsep.metrics import flip, psnr, require_flip
from polsep.physics.gltf import metalness
from polsep.physics.optics import dot
from polsep.render.views import scene_seed

#: Held-out materials, those of the quick version, and photographs of each: one by a flash, the others by moved lights.
PROCEDURAL, QUICK, VIEWS = 12, 2, 4
#: Samples with metal are those of which it is at least this share.
METAL_SHARE = 0.2
#: Raw pixels along the side of small frames, and of those of published maps.
SMALL = 2 * MAP_SIZE
#: Published maps are every so many of the pictures in this folder.
PUBLISHED, EVERY = "svbrdf/deschaintre_subset", 5
#: Lights that relit pictures are taken under, and how they are drawn: from anywhere above, this far from the middle.
LIGHTS, LIGHT_SEED, LIGHT_DISTANCES, MIN_HEIGHT = 20, 9, (2.0, 4.0), 0.25
#: FLIP, which takes longer than all the rest, is of every so many of the lights.
FLIP_EVERY = 4
#: Added to pictures before their logarithms are compared, as in the loss of Deschaintre et al. 2018.
FLOOR = 0.1
#: Pixels around over which the mean of a normal map is taken; what differs from it is detail.
DETAIL_RADIUS = 4
#: Detail below this rms is none: materials without it say nothing of whether it is found.
MIN_DETAIL = 0.02
#: Reflectance below which colour counts as if there were this much.
MIN_SPECULAR = 0.01


def bench_material(data: Path, count: int = PROCEDURAL) -> Iterator[Row]:
    """Errors of the maps of held-out materials and of their relit pictures, by input; single and several lights.

    ``count``: of procedural and of published materials. Raises ValueError without the extra bench.
    """
    require_flip()
    estimators = load_estimators()
    sets = {"procedural": procedural_examples(count), "procedural, small frames": small_examples(count)}
    sets["procedural, metals"] = metal_examples(count)
    published = published_examples(data, count)
    if published:
        sets["published"] = published
    for name, examples in sets.items():
        for views in dict.fromkeys((1, len(examples[0].views))):
            case = f"{name}, {views} light{'s' if views > 1 else ''}"
            for method, estimator in estimators.items():
                for part, metric, unit, values in score_examples(estimator, examples, views):
                    yield Row(f"material/{part}", case, method, metric, statistics.fmean(values), unit)


def load_estimators() -> dict[str, Estimator]:
    """The network of each input; weights for the perfect one, which no camera gives, are not in the package."""
    perfect = WEIGHTS / "material" / "perfect.safetensors"
    return {name: load_estimator(name, perfect if name == "perfect" else None) for name in INPUTS}


def procedural_examples(count: int) -> list[Example]:
    """The first held-out procedural materials."""
    return [random_example("test", 0, number, VIEWS) for number in range(count)]


def small_examples(count: int) -> list[Example]:
    """The same materials in frames of as many cells as the maps have pixels."""
    generators = [torch.Generator().manual_seed(scene_seed("test", 0, number)) for number in range(count)]
    return [make_example(halve(random_svbrdf(RAW_SIZE, generator)), VIEWS, generator) for generator in generators]


def metal_examples(count: int) -> list[Example]:
    """The first held-out procedural materials of another seed that hold metal."""

    def draw() -> Iterator[Example]:
        for number in itertools.count():
            generator = torch.Generator().manual_seed(scene_seed("test", 2, number))
            maps = random_svbrdf(RAW_SIZE, generator)
            if float(metalness(maps.specular).mean()) >= METAL_SHARE:
                yield make_example(maps, VIEWS, generator)

    return list(itertools.islice(draw(), count))


def published_examples(data: Path, count: int) -> list[Example]:
    """Photographs of published maps, at most ``count``; none without the data."""
    paths = find_panels(data / PUBLISHED)[::EVERY][:count]
    found = []
    for number, path in enumerate(paths):
        generator = torch.Generator().manual_seed(scene_seed("test", 1, number))
        normal, diffuse, roughness, specular = (_middle(x) for x in read_panels(path))
        white = specular.mean(dim=0, keepdim=True).expand(3, -1, -1)
        found.append(make_example(Svbrdf(normal, diffuse, roughness, white), VIEWS, generator))
    return found


def _middle(image: Tensor) -> Tensor:
    """The middle `SMALL` pixels of a larger image."""
    top, left = ((n - SMALL) // 2 for n in image.shape[-2:])
    return image[..., top : top + SMALL, left : left + SMALL]


class Score(NamedTuple):
    """One number of one material: which table it belongs to, its name, unit and value."""

    part: str
    metric: str
    unit: str
    value: float


def score_examples(
    estimator: Estimator, examples: Sequence[Example], views: int
) -> Iterator[tuple[str, str, str, list[float]]]:
    """Table, metric, unit and its value for every example where it means something."""
    part = INPUTS[estimator.input]
    scores: dict[tuple[str, str, str], list[float]] = {}
    for example in examples:
        found = estimator.estimate(example.views[:views, part].float())
        truth = unstack(example.maps.float())
        for score in (*score_maps(found, truth), *score_failure(found, truth), *score_relit(found, truth)):
            scores.setdefault(score[:3], []).append(score.value)
    for (table, metric, unit), values in scores.items():
        yield table, metric, unit, values


def score_maps(found: Svbrdf, truth: Svbrdf) -> Iterator[Score]:
    """RMSE of every map, of normals that of x and y, and the mean angle between normals."""
    for name in ("normal", "diffuse", "roughness", "specular"):
        error = getattr(found, name) - getattr(truth, name)
        if name == "normal":
            error = error[:2]
        yield Score("maps", f"{name} RMSE", "1", float(error.square().mean().sqrt()))
    cosine = dot(found.normal, truth.normal).clamp(-1, 1)
    yield Score("maps", "normal angle", "deg", math.degrees(float(torch.acos(cosine).mean())))


def score_failure(found: Svbrdf, truth: Svbrdf) -> Iterator[Score]:
    """Fig. 9's failure in numbers: colour in the specular map of dielectrics, and normals that are too flat.

    Detail of normals is what differs from the mean around; how much of it there is, found over true, and how well it
    goes with the true one, where there is some.
    """
    spread = found.specular.amax(dim=0) - found.specular.amin(dim=0)
    chroma = spread / found.specular.mean(dim=0).clamp(min=MIN_SPECULAR)
    dielectric = metalness(truth.specular)[0] == 0
    if bool(dielectric.any()):
        yield Score("failure", "specular chroma", "1", float(chroma[dielectric].mean()))
    fine, true = detail(found.normal), detail(truth.normal)
    energy, found_energy = (float(x.square().sum(dim=0).mean()) for x in (true, fine))
    if energy > MIN_DETAIL**2:
        both = float((fine * true).sum(dim=0).mean())
        yield Score("failure", "normal detail, found / true", "1", math.sqrt(found_energy / energy))
        correlation = both / math.sqrt(max(energy * found_energy, 1e-12))
        yield Score("failure", "normal detail, correlation", "1", correlation)


def detail(normal: Tensor) -> Tensor:
    """Difference of the normals' x and y, ``[2, H, W]``, from their local mean."""
    size = 2 * DETAIL_RADIUS + 1
    padded = pad(normal[None, :2], (DETAIL_RADIUS,) * 4, mode="reflect")
    return normal[:2] - avg_pool2d(padded, size, 1)[0]


def score_relit(found: Svbrdf, truth: Svbrdf) -> Iterator[Score]:
    """Mean over lights: difference of logarithms, PSNR, FLIP."""
    whole = torch.ones(truth.roughness.shape[-2:], dtype=torch.bool)
    differences, ratios, flips = list[float](), list[float](), list[float]()
    for number, light in enumerate(novel_lights()):
        a, b = (photograph_under(maps, light) for maps in (found, truth))
        differences.append(float((torch.log(a + FLOOR) - torch.log(b + FLOOR)).abs().mean()))
        ratios.append(psnr(a, b, whole))
        if number % FLIP_EVERY == 0:
            flips.append(flip(a, b, whole))
    yield Score("relit", "log-L1", "1", statistics.fmean(differences))
    yield Score("relit", "PSNR", "dB", statistics.fmean(ratios))
    yield Score("relit", "FLIP", "1", statistics.fmean(flips))


def novel_lights() -> list[Tensor]:
    """Positions ``[3, 1, 1]`` of the lights of relit pictures, the same for all."""
    generator = torch.Generator().manual_seed(LIGHT_SEED)
    place, turn, far = torch.rand(3, LIGHTS, generator=generator)
    height = MIN_HEIGHT + (1 - MIN_HEIGHT) * place
    sine, turn = (1 - height**2).sqrt(), 2 * math.pi * turn
    directions = torch.stack([sine * turn.cos(), sine * turn.sin(), height], dim=-1)
    low, high = LIGHT_DISTANCES
    positions = directions * (low + (high - low) * far)[:, None]
    return [position[:, None, None] for position in positions]


def photograph_under(maps: Svbrdf, light: Tensor) -> Tensor:
    """The picture ``[3, H, W]`` of maps from the photographs' own place."""
    points = plane_points(*maps.roughness.shape[-2:])
    return relight(maps, points, torch.tensor([0.0, 0.0, CAMERA_HEIGHT])[:, None, None], light)
