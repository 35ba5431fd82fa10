"""`polsep train material`: from options to a file of weights of the network for materials."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from polsep.io.store.weights import write_weights
from polsep.material.examples import make_examples
from polsep.material.network import MaterialSize
from polsep.networks.unet import count_parameters
from polsep.train.command import check_run, describe_start, hash_starts
from polsep.train.digest import digest_examples
from polsep.train.log import read_log
from polsep.train.loop import Run, Schedule, run_training
from polsep.train.material_task import MaterialOptions, material_training

#: Steps of warm-up, and decay of the moving average; trainings are shorter than those of separation.
WARM_UP, AVERAGE = 50, 0.99


def choose_material(asked: dict[str, Any]) -> tuple[MaterialOptions, Schedule]:
    """Return options and schedule from those of the command line; see `polsep train`."""
    cues = tuple(asked["cues"].split(",")) if asked["cues"] else ()
    size = replace(MaterialSize(), cues=cues) if asked["width"] is None else MaterialSize(asked["width"], cues=cues)
    options = MaterialOptions(asked["seen"], size, asked["seed"], examples=asked["examples"])
    due = {"checkpoint_every": 50, "validate_every": 200}
    return options, Schedule(asked["steps"], asked["rate"], WARM_UP, AVERAGE, precision=asked["precision"], **due)


def train_material(options: MaterialOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None]) -> Path:
    """Make the examples that ``folder`` lacks and train to the end, resuming a run in ``run.out``.

    Returns the file of the averaged weights, in half precision, with their scores in the metadata. Raises ValueError on
    a run that cannot be trained.
    """
    check_run(run)
    if run.refit:
        raise ValueError("expected a network with a linear filter to refit, found material")
    for split, count in (("train", options.examples), ("validation", options.validation)):
        for made in make_examples(folder, split, options.seed, count, options.views):
            if made % 100 == 0:
                report({f"{split} examples": made})
    torch.manual_seed(options.seed)
    training = material_training(options, folder)
    run = replace(run, what=json.dumps(asdict(options)))
    starts = hash_starts(run)
    average = run_training(training, run, report)
    path = run.out / f"material-{options.input}.safetensors"
    if average is None:
        return path
    halves = {name: value.cpu().half().float() for name, value in average.items()}
    training.network.cpu().load_state_dict(halves)
    counts = [options.seed, options.examples, options.views, options.validation]
    metadata = {
        "method": "material",
        "input": options.input,
        "size": json.dumps(asdict(options.size)),
        "seed": str(options.seed),
        "parameters": str(count_parameters(training.network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "options": json.dumps(asdict(options)),
        "data": digest_examples(counts, "polsep.material.examples"),
        "steps": str(run.last),
        "start": json.dumps(starts),
        "command": describe_command(options, run),
        "validation": json.dumps(training.score(training.network)),
        "curve": json.dumps([[line["step"], round(line["loss"], 5)] for line in read_log(run.out) if line["step"]]),
    }
    write_weights(path, halves, metadata)
    return path


def describe_command(options: MaterialOptions, run: Run) -> str:
    """Return the command line that repeats the training."""
    asked = {"input": options.input, "width": options.size.width, "steps": run.schedule.steps}
    asked |= {"rate": run.schedule.rate, "seed": options.seed, "examples": options.examples}
    asked |= {"devices": run.devices, "precision": run.schedule.precision, "output": run.out.name}
    asked |= {"cues": ",".join(options.size.cues)} if options.size.cues else {}
    asked |= {} if run.until is None else {"until": run.until}
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    return shlex.join(["polsep", "train", "material", *words, *describe_start(run)])
