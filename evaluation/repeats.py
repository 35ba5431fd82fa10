"""The spread of trainings of one recipe that differ in their seed alone: in first weights and in all examples.

Smaller differences between networks trained once say nothing. Each of `RECIPES` is trained by ``polsep train`` from
nothing with each of `SEEDS`, in ``runs/repeats`` below the working folder; what the same code trained there before is
kept. The networks are smaller than most that ship and are trained for far fewer steps, so that all takes an hour of two
cores; later on, and in larger networks, trainings of two seeds may lie closer.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from evaluation.ablations import network_at_half
from evaluation.ladder import MOSAIC, Weights, network_entry
from evaluation.scoring import Entry, Protocol, capture_noisy, score_sets
from evaluation.sets import load_sets
from polsep.bench import SCENES as SEPARATION
from polsep.bench.history import ask_git
from polsep.bench.rows import Row
from polsep.networks.rungs import RUNGS

#: Options of ``polsep train`` by the network's name.
RECIPES = {
    "paper": ("--width", "16", "--rate", "1e-3"),
    "stokes": ("--width", "16", "--rate", "1e-3"),
    "no-angle": ("--width", "16", "--rate", "1e-3"),
    "joint-fast": ("--width", "16", "--entry", "16", "--rate", "2e-3"),
}
SEEDS = (1, 2, 3)
STEPS = 1000
FOLDER = Path("runs/repeats")
#: Code whose change makes other weights.
TRAINED_BY = (*SEPARATION, "polsep/train", "evaluation/repeats.py")
METRICS = ("diffuse PSNR", "specular PSNR")
#: Scenes of each selection set that are scored: the first ones.
SCENES = 12


def bench_repeats(data: Path) -> Iterator[Row]:
    """Trainings that differ in their seed alone: mean scores on the selection sets and their standard deviation.

    Raises ValueError as `evaluation.sets.bench_sets` does, and where a training fails.
    """
    sets = {name: recipes[:SCENES] for name, recipes in load_sets(data).items()}
    entries = [as_entry(network, train(network, seed), seed) for network in RECIPES for seed in SEEDS]
    rows = score_sets("repeats", sets, data, [Protocol("noisy", capture_noisy, tuple(entries))])
    yield from spread_over_seeds([row for row in rows if row.bench == "repeats/noisy" and row.metric in METRICS])


def train(network: str, seed: int) -> Path:
    """Train a network, or go on with it, and return the file of its weights; those of older recipes are left alone.

    Raises ValueError on changes that are not committed: their weights would count as the commit's.
    """
    if ask_git("status", "--porcelain", "--untracked-files=no", "--", *TRAINED_BY):
        raise ValueError("expected a commit of the code that trains, found changes that are not committed")
    folder = FOLDER / (ask_git("log", "-1", "--format=%h", "--", *TRAINED_BY) or "unknown") / f"{network}-{seed}"
    path = folder / f"{network}-{MOSAIC}.safetensors"
    if not path.is_file():
        options = ("--steps", str(STEPS), "--seed", str(seed), *RECIPES[network], "-o", str(folder))
        done = subprocess.run([sys.executable, "-m", "polsep", "train", network, *options])
        if done.returncode:
            raise ValueError(f"expected weights from 'polsep train {network}' in {folder}, found that it failed")
    return path


def as_entry(network: str, path: Path, seed: int) -> Entry:
    """A trained network at half resolution, called NETWORK:SEED."""
    found = network_entry(Weights(network, network, path)) if network in RUNGS else network_at_half(network, path)
    return replace(found, name=f"{network}:{seed}")


def spread_over_seeds(rows: Sequence[Row]) -> Iterator[Row]:
    """The mean of each score over seeds, and its standard deviation, from rows of single trainings."""
    scores: dict[Row, list[float]] = {}
    for row in rows:
        key = replace(row, bench="repeats", case=row.case.partition(",")[0], method=row.method.partition(":")[0])
        scores.setdefault(replace(key, value=0.0), []).append(row.value)
    for key, values in scores.items():
        yield replace(key, value=statistics.fmean(values))
    for key, values in scores.items():
        yield replace(key, metric=f"{key.metric}, between seeds", value=statistics.stdev(values))
