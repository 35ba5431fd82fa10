"""Validation: scores of networks in training, and of methods without training, on the same unseen views.

Scores are mean PSNR [dB] of diffuse and specular inside the objects' masks, as in `metrics`. The views are the first of
the validation split, the same for every training with crops of one size.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor, nn

from polsep.metrics import psnr
from polsep.physics.stokes import Measurements
from polsep.separation.analytic import Separation, separate_analytic
from polsep.separation.color_affine import separate_color_affine
from polsep.train.inputs import Inputs
from polsep.train.stream import Examples, ExampleStream, StreamOptions
from polsep.train.tasks import Task

#: Methods without training, with whose scores every log begins.
REFERENCES: dict[str, Callable[[Measurements], Separation]] = {
    "analytic": separate_analytic,
    "color-affine": separate_color_affine,
}


@lru_cache(maxsize=1)  # used before the first step and after the last one
def validation_batches(stream: StreamOptions, count: int = 8) -> tuple[Examples, ...]:
    """Return the first batches of the validation split; every example is of a scene of its own."""
    options = StreamOptions(
        "validation", 0, 8, stream.crop, stream.size, stream.samples, pool=1, uses=0, looks=stream.looks
    )
    batches = iter(ExampleStream(options))
    return tuple(next(batches) for _ in range(count))


def score(separate: Callable[[Inputs], Separation], views: list[Inputs]) -> dict[str, float]:
    """Return the scores of separations of ``views``: "diffuse PSNR" and "specular PSNR"."""
    scores: dict[str, list[float]] = {"diffuse": [], "specular": []}
    for view in views:
        separation = separate(view)
        pairs = {"diffuse": (separation.diffuse, view.diffuse), "specular": (separation.specular, view.specular)}
        for name, (images, truth) in pairs.items():
            scores[name] += [psnr(x, t, m) for x, t, m in zip(images, truth, view.mask, strict=True) if bool(m.any())]
    return {f"{name} PSNR": statistics.fmean(values) for name, values in scores.items()}


def score_averaged(
    network: nn.Module, average: dict[str, Tensor], measure: Callable[[nn.Module], dict[str, float]]
) -> dict[str, float]:
    """Return the scores of a network with averaged weights; its own weights are restored afterwards."""
    own = {name: value.detach().clone() for name, value in network.state_dict().items()}
    network.load_state_dict(average)
    scores = measure(network)
    network.load_state_dict(own)
    return scores


def score_references(task: Task[Inputs], views: list[Inputs]) -> dict[str, float]:
    """Return the scores of `REFERENCES` under names like "analytic diffuse PSNR"."""
    scores: dict[str, float] = {}
    for method, separate in REFERENCES.items():
        with torch.no_grad():
            own = score(lambda view, separate=separate: separate(task.measure(view)), views)  # type: ignore[misc]
        scores |= {f"{method} {name}": value for name, value in own.items()}
    return scores
