"""`polsep train material`: the network for materials, from options to a file of weights."""

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
from polsep.train.command import check_run, describe_start
from polsep.train.digest import digest_examples
from polsep.train.log import read_log
from polsep.train.loop import Run, Schedule, train_course
from polsep.train.material_task import MaterialOptions, material_course

#: Steps of warm-up, and decay of the moving average: of shorter trainings than others.
WARM_UP, AVERAGE = 50, 0.99


def choose_material(asked: dict[str, Any]) -> tuple[MaterialOptions, Schedule]:
    """What is trained, and how long, from options of the command line; see `polsep train`."""
    cues = tuple(asked["cues"].split(",")) if asked["cues"] else ()
    size = replace(MaterialSize(), cues=cues) if asked["width"] is None else MaterialSize(asked["width"], cues=cues)
    options = MaterialOptions(asked["seen"], size, asked["seed"], examples=asked["examples"])
    due = {"checkpoint_every": 50, "validate_every": 200}
    return options, Schedule(asked["steps"], asked["rate"], WARM_UP, AVERAGE, precision=asked["precision"], **due)


def train_material(options: MaterialOptions, run: Run, folder: Path, report: Callable[[dict[str, Any]], None]) -> Path:
    """Make the examples that ``folder`` lacks, train to the end, go on where a run in ``run.out`` stopped.

    Returns the file of the averaged weights, in half precision; the scores in their metadata are of these. Raises
    ValueError on what cannot be trained.
    """
    check_run(run)
    if run.refit:
        raise ValueError("expected a network with a linear filter to refit, found material")
    for split, count in (("train", options.examples), ("validation", options.validation)):
        for made in make_examples(folder, split, options.seed, count, options.views):
            if made % 100 == 0:
                report({f"{split} examples": made})
    torch.manual_seed(options.seed)
    course = material_course(options, folder)
    run = replace(run, what=json.dumps(asdict(options)))
    average = train_course(course, run, report)
    path = run.out / f"material-{options.input}.safetensors"
    if average is None:
        return path
    halves = {name: value.cpu().half().float() for name, value in average.items()}
    course.network.cpu().load_state_dict(halves)
    counts = [options.seed, options.examples, options.views, options.validation]
    metadata = {
        "method": "material",
        "input": options.input,
        "size": json.dumps(asdict(options.size)),
        "seed": str(options.seed),
        "parameters": str(count_parameters(course.network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "options": json.dumps(asdict(options)),
        "data": digest_examples(counts, "polsep.material.examples"),
        "steps": str(run.last),
        "command": describe_command(options, run),
        "validation": json.dumps(course.score(course.network)),
        "curve": json.dumps([[line["step"], round(line["loss"], 5)] for line in read_log(run.out) if line["step"]]),
    }
    write_weights(path, halves, metadata)
    return path


def describe_command(options: MaterialOptions, run: Run) -> str:
    """The command line that trains this again."""
    asked = {"input": options.input, "width": options.size.width, "steps": run.schedule.steps}
    asked |= {"rate": run.schedule.rate, "seed": options.seed, "examples": options.examples}
    asked |= {"devices": run.devices, "precision": run.schedule.precision, "output": run.out.name}
    asked |= {"cues": ",".join(options.size.cues)} if options.size.cues else {}
    asked |= {} if run.until is None else {"until": run.until}
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    return shlex.join(["polsep", "train", "material", *words, *describe_start(run)])
