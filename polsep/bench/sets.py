"""Every method on the fixed test sets: noisy mosaics to half resolution, and noise-free co-sited samples.

Per set the mean over its scenes of every metric of `polsep.metrics`; rows of "sets/scenes" hold the single scenes.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from polsep.bench.rows import Row
from polsep.camera import Mosaic
from polsep.metrics import chroma, highlights, psnr, psnr_unlimited, ssim, worst_mean
from polsep.pipeline import METHODS, Method, demosaic
from polsep.separation import Separation

if TYPE_CHECKING:
    from polsep.testsets import Case

#: Fewest pixels of a highlight that are worth a score.
LEAST_HIGHLIGHT = 20

Truth = tuple[Tensor, Tensor, Tensor]


def bench_sets(data: Path) -> Iterator[Row]:
    """Scores of all methods on the sets of `polsep.testsets`.

    Raises ValueError where ``data`` lacks one of them, and on a scene that does not come out as recorded.
    """
    try:
        from polsep.testsets import SETS, build_cases, check_case
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    for name, recipes in SETS.items():
        scores: dict[tuple[str, str, str, str], list[float]] = {}
        for case in build_cases(recipes, data):
            check_case(case)
            for capture, method, metric, unit, value in score_case(case):
                scores.setdefault((capture, method, metric, unit), []).append(value)
                if capture == "noisy" and metric.endswith("PSNR"):
                    yield Row("sets/scenes", case.name, method, metric, value, unit)
        for (capture, method, metric, unit), values in scores.items():
            title = f"{name}, {capture}"
            yield Row(f"sets/{capture}", title, method, metric, statistics.fmean(values), unit)
            if metric.endswith(" PSNR"):
                yield Row(f"sets/{capture}", title, method, f"{metric}, worst tenth", worst_mean(values), unit)


def score_case(case: Case) -> Iterator[tuple[str, str, str, str, float]]:
    """Capture, method, metric, unit and value of one scene."""
    diffuse, specular, mask = case.half_truth()
    whole = (case.scene.diffuse.s0, case.scene.specular.s0, case.scene.mask)
    for name, method in METHODS.items():
        for metric, unit, value in score_images(_separate(method, case.noisy), (diffuse, specular, mask)):
            yield "noisy", name, metric, unit, value
        exact = method.split(case.co_sited)
        for output, image, truth in (("diffuse", exact.diffuse, whole[0]), ("specular", exact.specular, whole[1])):
            yield "co-sited", name, f"{output} PSNR", "dB", psnr(image, truth, whole[2])


def _separate(method: Method, capture: Mosaic) -> Separation:
    return method.split(demosaic(capture, method, full=False))


def score_images(found: Separation, truth: Truth) -> Iterator[tuple[str, str, float]]:
    """Every metric of a separation against true diffuse, specular and mask: name, unit, value."""
    diffuse, specular, mask = truth
    bright = highlights(specular, mask)
    everywhere = torch.ones_like(mask)
    for output, image, true in (("diffuse", found.diffuse, diffuse), ("specular", found.specular, specular)):
        yield f"{output} PSNR", "dB", psnr(image, true, mask)
        yield f"{output} PSNR, whole frame", "dB", psnr(image, true, everywhere)
        yield f"{output} PSNR, unlimited", "dB", psnr_unlimited(image, true, mask)
        yield f"{output} SSIM", "1", ssim(image, true, mask)
        if int(bright.sum()) >= LEAST_HIGHLIGHT:
            yield f"{output} PSNR, highlights", "dB", psnr(image, true, bright)
    if int(bright.sum()) >= LEAST_HIGHLIGHT:
        yield "chroma of highlights", "1", chroma(found.specular, bright)
