"""One way to score on the selection sets, for everything that is compared: entries under protocols, scene by scene.

A protocol says how a scene is captured: noisy and clean mosaics are separated into half-resolution images, and co-sited
samples, as the paper has them, into images of their own resolution. Scores are those of `polsep.metrics`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from polsep.bench.rows import Row, with_spread
from polsep.methods import METHODS
from polsep.metrics import chroma, flip, highlights, psnr, psnr_unlimited, ssim, worst_mean
from polsep.networks.paper import Refinement
from polsep.sensor.camera import Capture
from polsep.separation.analytic import Separation

if TYPE_CHECKING:
    from evaluation.testsets import Case, Recipe

#: Fewest pixels of a highlight that are worth a score.
MIN_HIGHLIGHT = 20

#: Ends of metrics whose means are given with their standard errors and medians over scenes.
UNCERTAIN = (" PSNR", " PSNR, unlimited")

#: True diffuse and specular ``[C, h, w]`` and mask ``[h, w]``.
Truth = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Entry:
    """A method as it is compared: what separates a capture at half resolution, and its networks if it has some.

    Co-sited measurements are separated at their own resolution.
    """

    name: str
    separate: Callable[[Capture], Separation]
    network: Refinement | None = None


@dataclass(frozen=True)
class Protocol:
    """A way to ``capture`` a case, with the truth of that capture, and the ``entries`` that are compared on it."""

    name: str
    capture: Callable[[Case], tuple[Capture, Truth]]
    entries: tuple[Entry, ...]


class Score(NamedTuple):
    """One metric of one entry on one scene."""

    protocol: str
    method: str
    metric: str
    unit: str
    value: float


def own_entries(mosaics: bool) -> tuple[Entry, ...]:
    """`methods.METHODS` as entries: all for ``mosaics``, those that take them for co-sited samples."""
    return tuple(Entry(m.name, m.reference) for m in METHODS.values() if mosaics or not m.reads_mosaic)


def capture_noisy(case: Case) -> tuple[Capture, Truth]:
    """A 12-bit mosaic with noise."""
    return case.noisy, case.half_truth()


def capture_clean(case: Case) -> tuple[Capture, Truth]:
    """A mosaic of an ideal sensor."""
    return case.clean, case.half_truth()


def capture_co_sited(case: Case) -> tuple[Capture, Truth]:
    """The paper's protocol: all analysers and colours at every pixel, clipped, no noise."""
    return case.co_sited, (case.scene.diffuse.s0, case.scene.specular.s0, case.scene.mask)


def score_sets(
    bench: str, sets: dict[str, tuple[Recipe, ...]], data: Path, protocols: Sequence[Protocol]
) -> Iterator[Row]:
    """Rows of ``bench``/scenes: the PSNR of every scene; and of ``bench``/PROTOCOL: every metric's mean over a set,
    of `UNCERTAIN` ones with standard error and median.

    Sets whose files are not in ``data`` are left out, which one line on stderr says. Raises ValueError on files other
    than recorded, and on a scene that does not come out as recorded.
    """
    from evaluation.testsets import build_cases, check_case

    for name, recipes in sets.items():
        absent = find_missing(recipes, data)
        if absent is not None:
            print(f"polsep: the set {name} is left out: expected {absent}, found none", file=sys.stderr)
            continue
        scores: dict[Score, list[float]] = {}
        for case in build_cases(recipes, data):
            check_case(case)
            for score in score_case(case, protocols):
                scores.setdefault(score._replace(value=0.0), []).append(score.value)
                if score.metric.endswith(" PSNR"):
                    title = f"{case.name}, {score.protocol}"
                    yield Row(f"{bench}/scenes", title, score.method, score.metric, score.value, score.unit)
        for (protocol, method, metric, unit, _), values in scores.items():
            table, title = f"{bench}/{protocol}", f"{name}, {protocol}"
            mean = Row(table, title, method, metric, statistics.fmean(values), unit)
            if not metric.endswith(UNCERTAIN):
                yield mean
                continue
            yield from with_spread(mean, values)
            if metric.endswith(" PSNR"):
                yield Row(table, title, method, f"{metric}, worst tenth", worst_mean(values), unit)


def find_missing(recipes: Sequence[Recipe], data: Path) -> Path | None:
    """The first missing file of a set; None when all are there."""
    paths = (data / name for recipe in recipes for name in recipe.files)
    return next((path for path in paths if not path.is_file()), None)


def score_case(case: Case, protocols: Sequence[Protocol]) -> Iterator[Score]:
    """Every metric of every entry of every protocol on one scene."""
    for protocol in protocols:
        capture, truth = protocol.capture(case)
        for entry in protocol.entries:
            for metric, unit, value in score_images(entry.separate(capture), truth):
                yield Score(protocol.name, entry.name, metric, unit, value)


def score_images(found: Separation, truth: Truth) -> Iterator[tuple[str, str, float]]:
    """Every metric of a separation against true diffuse, specular and mask: name, unit, value.

    FLIP and chroma of three colours only.
    """
    diffuse, specular, mask = truth
    colored = len(diffuse) > 1
    bright = highlights(specular, mask)
    everywhere = torch.ones_like(mask)
    for output, image, true in (("diffuse", found.diffuse, diffuse), ("specular", found.specular, specular)):
        yield f"{output} PSNR", "dB", psnr(image, true, mask)
        yield f"{output} PSNR, whole frame", "dB", psnr(image, true, everywhere)
        yield f"{output} PSNR, unlimited", "dB", psnr_unlimited(image, true, mask)
        yield f"{output} SSIM", "1", ssim(image, true, mask)
        if colored:
            yield f"{output} FLIP", "1", flip(image, true, mask)
        if int(bright.sum()) >= MIN_HIGHLIGHT:
            yield f"{output} PSNR, highlights", "dB", psnr(image, true, bright)
    if colored and int(bright.sum()) >= MIN_HIGHLIGHT:
        yield "chroma of highlights", "1", chroma(found.specular, bright)
