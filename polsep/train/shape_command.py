"""`polsep train shape`: from options to a file of weights of the network for shape."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from polsep.io.store.weights import write_weights
from polsep.networks.unet import count_parameters
from polsep.train.command import check_run, describe_start, hash_starts
from polsep.train.digest import digest_examples
from polsep.train.log import read_log
from polsep.train.loop import Run, Schedule, run_training
from polsep.train.shape_examples import make_examples
from polsep.train.shape_task import ShapeOptions, shape_training

#: Steps of warm-up, and decay of the moving average.
WARM_UP, AVERAGE = 100, 0.995


def choose_shape(asked: dict[str, Any]) -> tuple[ShapeOptions, Schedule]:
    """Return options and schedule from those of the command line; see `polsep train`."""
    usual = ShapeOptions()
    size = usual.size if asked["width"] is None else replace(usual.size, width=asked["width"])
    options = ShapeOptions(asked["seen"], size, asked["seed"], side=asked["side"], examples=asked["examples"])
    due = {"checkpoint_every": 200, "validate_every": 500}
    return options, Schedule(asked["steps"], asked["rate"], WARM_UP, AVERAGE, precision=asked["precision"], **due)


def train_shape(options: ShapeOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None]) -> Path:
    """Make the examples that ``folder`` lacks and train to the end, resuming a run in ``run.out``.

    Returns the file of the averaged weights, in half precision, with their scores in the metadata. Raises ValueError on
    a run that cannot be trained.
    """
    check_run(run)
    if run.refit:
        raise ValueError("expected a network with a linear filter to refit, found shape")
    for split, count in (("train", options.examples), ("validation", options.validation)):
        for number in make_examples(folder, split, options.seed, range(count)):
            if number % 100 == 99:
                report({f"{split} examples": number + 1})
    torch.manual_seed(options.seed)
    training = shape_training(options, folder)
    run = replace(run, what=json.dumps(asdict(options)))
    starts = hash_starts(run)
    average = run_training(training, run, report)
    path = run.out / f"shape-{options.input}.safetensors"
    if average is None:
        return path
    halves = {name: value.cpu().half().float() for name, value in average.items()}
    training.network.cpu().load_state_dict(halves)
    metadata = {
        "method": "shape",
        "input": options.input,
        "size": json.dumps(asdict(options.size)),
        "side": str(options.side),
        "seed": str(options.seed),
        "parameters": str(count_parameters(training.network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "options": json.dumps(asdict(options)),
        "data": digest_examples([options.seed, options.examples], "polsep.train.shape_examples"),
        "steps": str(run.last),
        "start": json.dumps(starts),
        "command": describe_shape(options, run),
        "validation": json.dumps(training.score(training.network)),
        "curve": json.dumps([[line["step"], round(line["loss"], 5)] for line in read_log(run.out) if line["step"]]),
    }
    write_weights(path, halves, metadata)
    return path


def describe_shape(options: ShapeOptions, run: Run) -> str:
    """Return the command line that repeats the training."""
    asked = {"input": options.input, "width": options.size.width, "side": options.side, "steps": run.schedule.steps}
    asked |= {"rate": run.schedule.rate, "seed": options.seed, "examples": options.examples}
    asked |= {"devices": run.devices, "precision": run.schedule.precision, "output": run.out.name}
    asked |= {} if run.until is None else {"until": run.until}
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    return shlex.join(["polsep", "train", "shape", *words, *describe_start(run)])
