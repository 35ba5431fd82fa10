"""How well a training separates views that it never sees, and what methods that learn nothing make of the same views.

Scores are mean PSNR [dB] of diffuse and specular inside the objects' masks, as in `metrics`. The views are the first of
the validation split, the same for every training with crops of one size, and seen as the task sees its examples.
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
from polsep.train.stream import Examples, ExampleStream, StreamOptions
from polsep.train.tasks import Task, View

#: Methods without training that every log begins with, on the measurements that the networks get.
REFERENCES: dict[str, Callable[[Measurements], Separation]] = {
    "analytic": separate_analytic,
    "color-affine": separate_color_affine,
}


@lru_cache(maxsize=1)  # a training asks when it begins and when it has ended
def validation_batches(stream: StreamOptions, count: int = 8) -> tuple[Examples, ...]:
    """The first batches of the validation split, of which every example is of a scene of its own."""
    options = StreamOptions(
        "validation", 0, 8, stream.crop, stream.size, stream.samples, pool=1, uses=0, looks=stream.looks
    )
    batches = iter(ExampleStream(options))
    return tuple(next(batches) for _ in range(count))


def score(separate: Callable[[View], Separation], views: list[View]) -> dict[str, float]:
    """Scores of whatever separates ``views``: "diffuse PSNR" and "specular PSNR"."""
    scores: dict[str, list[float]] = {"diffuse": [], "specular": []}
    for seen in views:
        found = separate(seen)
        for name, images, truth in (("diffuse", found.diffuse, seen[1]), ("specular", found.specular, seen[2])):
            scores[name] += [psnr(x, t, m) for x, t, m in zip(images, truth, seen[3], strict=True) if bool(m.any())]
    return {f"{name} PSNR": statistics.fmean(values) for name, values in scores.items()}


def validate(task: Task[View], average: dict[str, Tensor], views: list[View]) -> dict[str, float]:
    """Scores of the task's network with the averaged weights; it has its own again afterwards."""
    return score_averaged(task.network, average, lambda _: score(task.separate, views))


def score_averaged(
    network: nn.Module, average: dict[str, Tensor], measure: Callable[[nn.Module], dict[str, float]]
) -> dict[str, float]:
    """Scores of a network with averaged weights; it has its own again afterwards."""
    own = {name: value.detach().clone() for name, value in network.state_dict().items()}
    network.load_state_dict(average)
    scores = measure(network)
    network.load_state_dict(own)
    return scores


def score_references(task: Task[View], views: list[View]) -> dict[str, float]:
    """Scores of `REFERENCES` under names like "analytic diffuse PSNR"."""
    found: dict[str, float] = {}
    for method, separate in REFERENCES.items():
        with torch.no_grad():
            scores = score(lambda seen, separate=separate: separate(task.measure(seen)), views)  # type: ignore[misc]
        found |= {f"{method} {name}": value for name, value in scores.items()}
    return found
