"""Trainings on a folder of examples, of materials and of shape: to a file of weights that says how it came about."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from polsep.io.store.examples import read_makers, write_makers
from polsep.io.store.weights import write_weights
from polsep.networks.unet import count_parameters
from polsep.train.command import check_run, describe_start
from polsep.train.digest import digest_examples
from polsep.train.log import read_log
from polsep.train.loop import Run, Training, hash_starts, run_training


class Recipe(NamedTuple):
    """A training of a ``method`` with its ``options``, a dataclass with ``input``, ``size``, ``seed`` and ``examples``.

    ``make`` makes the examples that are missing, and the training; ``data`` tells the digest of the examples then;
    ``words``: options of the command line besides those that both methods have; ``facts``: further metadata.
    """

    method: str
    options: Any
    make: Callable[[], Training]
    data: Callable[[], str]
    words: dict[str, object]
    facts: dict[str, str]


def train_recipe(recipe: Recipe, run: Run, report: Callable[[dict[str, Any]], None]) -> Path:
    """Make what is missing and train to the end, resuming a run in ``run.out``.

    Returns the file of the averaged weights, in half precision, with their scores in the metadata. Raises ValueError on
    a run that cannot be trained.
    """
    check_run(run)
    options = recipe.options
    if run.refit:
        raise ValueError(f"expected a network with a linear filter to refit, found {recipe.method}")
    torch.manual_seed(options.seed)
    training = recipe.make()
    run = replace(run, what=json.dumps(asdict(options)))
    starts = hash_starts(run)
    average = run_training(training, run, report)
    path = run.out / f"{recipe.method}-{options.input}.safetensors"
    if average is None:
        return path
    network = training.network.cpu()
    network.load_state_dict(average)
    training.finish(network)
    halves = {name: value.half().float() for name, value in network.state_dict().items()}
    network.load_state_dict(halves)
    metadata = recipe.facts | {
        "method": recipe.method,
        "input": options.input,
        "size": json.dumps(asdict(options.size)),
        "seed": str(options.seed),
        "parameters": str(count_parameters(network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "options": json.dumps(asdict(options)),
        "data": recipe.data(),
        "steps": str(run.last),
        "start": json.dumps(starts),
        "command": describe_recipe(recipe, run),
        "validation": json.dumps(training.score(network)),
        "curve": json.dumps([[line["step"], round(line["loss"], 5)] for line in read_log(run.out) if line["step"]]),
    }
    write_weights(path, halves, metadata)
    return path


@dataclass(frozen=True)
class Makers:
    """Digests of the code that made a folder's examples for a ``method``, one per line of a file in the folder.

    Examples stay when the code changes; these lines say so. ``maker``: the module that makes them today.
    """

    folder: Path
    method: str
    maker: str

    def note(self, paths: Iterable[Path]) -> None:
        """Add today's code if it is to make any of the examples ``paths``; "unknown" made those that nobody noted."""
        there, said = [path.is_file() for path in paths], self._lines()
        lines = said or (["unknown"] if any(there) else [])
        if not all(there):
            lines = list(dict.fromkeys([*lines, digest_examples([], self.maker)]))
        if lines != said:
            write_makers(self.folder, self.method, lines)

    def digest(self, options: object) -> str:
        """The sha256 of ``options`` and of all code that made the examples."""
        return hashlib.sha256(json.dumps([options, self._lines()]).encode()).hexdigest()

    def _lines(self) -> list[str]:
        return read_makers(self.folder, self.method)


def describe_recipe(recipe: Recipe, run: Run) -> str:
    """Return the command line that repeats the training."""
    options, schedule = recipe.options, run.schedule
    asked = {"input": options.input, "width": options.size.width, "steps": schedule.steps, "rate": schedule.rate}
    asked |= {"seed": options.seed, "examples": options.examples, "devices": run.devices}
    asked |= {"precision": schedule.precision, "output": run.out.name} | recipe.words
    asked |= {} if run.until is None else {"until": run.until}
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    return shlex.join(["polsep", "train", recipe.method, *words, *describe_start(run)])
