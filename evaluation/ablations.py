"""The worth of each idea of the joint network: networks of one size and one training that lack one of them.

Their weights are those of ``polsep train joint-fast --ablation NAME``, in ``evaluation/weights/ablations``: from
one seed, on the same examples, for as many steps. "none" lacks nothing.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import torch

from evaluation import WEIGHTS
from evaluation.scoring import Entry, Protocol, capture_noisy, score_sets
from evaluation.sets import load_sets
from polsep.bench.rows import Row
from polsep.in_torch import load_joint
from polsep.io.store.rows import SPREAD
from polsep.io.store.weights import read_weights
from polsep.networks.run import run_joint
from polsep.sensor.camera import Capture, Mosaic
from polsep.separation.analytic import Separation

#: Metrics of the table.
TABLED = ("diffuse PSNR", "specular PSNR", "diffuse PSNR, highlights", "specular PSNR, highlights")


def find_ablations() -> dict[str, Path]:
    """Files of weights by the idea that their network lacks; "none" first."""
    paths = sorted((WEIGHTS / "ablations").glob("*.safetensors"))
    found = {read_weights(path)[1]["ablation"]: path for path in paths}
    return {name: found[name] for name in sorted(found, key=lambda name: (name != "none", name))}


def network_at_half(name: str, path: Path) -> Entry:
    """A joint network at half resolution, called ``name``."""
    network = load_joint(path, torch.device("cpu"))

    def separate(capture: Capture) -> Separation:
        assert isinstance(capture, Mosaic)
        return run_joint(network, capture)

    return Entry(name, separate)


def bench_ablations(data: Path) -> Iterator[Row]:
    """Scores of ablated networks on the selection sets, noisy mosaics, and on the validation views of their training.

    Raises ValueError as `evaluation.sets.bench_sets` does.
    """
    sets, found = load_sets(data), find_ablations()
    for name, path in found.items():
        for metric, value in json.loads(read_weights(path)[1]["validation"]).items():
            yield Row("ablations", "validation views", name, metric, value, "dB")
    entries = tuple(network_at_half(name, path) for name, path in found.items())
    for row in score_sets("ablations", sets, data, [Protocol("noisy", capture_noisy, entries)]):
        if row.bench == "ablations/noisy" and row.metric.removesuffix(SPREAD) in TABLED:
            yield Row("ablations", row.case.partition(",")[0], row.method, row.metric, row.value, row.unit)
