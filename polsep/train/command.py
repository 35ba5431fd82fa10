"""`polsep train`: a rung of the ladder from options to a file of weights."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from polsep.io.checkpoints import read_module
from polsep.io.weights import write_weights
from polsep.networks import Size, count_parameters
from polsep.train.log import curve_of, read_log, references_of
from polsep.train.loop import Run, Schedule, train
from polsep.train.stream import StreamOptions
from polsep.train.tasks import VARIANTS, find_rung, ladder_task
from polsep.train.validation import validate, validation_batches

#: What a laptop trains in an hour or two.
SMALL = Size()
#: Those without a scale of the loss, which checkpoints would have to hold.
PRECISIONS = ("bf16-mixed", "32-true")
#: The code that examples depend on.
DATA_MODULES = (
    "camera.py",
    "kernels/patterns.py",
    "kernels/raster.py",
    "kernels/rays.py",
    "kernels/shading.py",
    "kernels/shadows.py",
    "materials.py",
    "raycast.py",
    "render.py",
    "shapes.py",
    "simulate.py",
    "textures.py",
    "train/stream.py",
    "train/variety.py",
    "views.py",
)


@dataclass(frozen=True)
class TrainOptions:
    """What is trained: a ``rung`` of `refine.RUNGS` on a ``variant`` of the data, of which size, from which seed.

    Raises ValueError on a rung or variant that there is not.
    """

    rung: str
    variant: str = "mosaic"
    size: Size = SMALL
    seed: int = 0

    def __post_init__(self) -> None:
        find_rung(self.rung)
        if self.variant not in VARIANTS:
            raise ValueError(f"expected a variant of {', '.join(VARIANTS)}, found {self.variant!r}")


def train_rung(options: TrainOptions, run: Run, report: Callable[[dict[str, Any]], None]) -> Path:
    """Train to the end, going on where a run in ``run.out`` stopped; returns the file of the averaged weights.

    The weights are in half precision; the scores in their metadata are of these on the validation views, beside the
    log's: ``curve``, a list of [step, diffuse PSNR, specular PSNR], and ``reference``, both PSNRs of methods without
    training.
    """
    torch.manual_seed(options.seed)
    data = digest_data(run.stream)
    task = ladder_task(find_rung(options.rung), options.variant, options.size)
    path = run.out / f"{options.rung}-{options.variant}.safetensors"
    average = train(task, run, report)
    if average is None:
        return path
    task.network.cpu()  # where the validation views are
    halves = {name: value.cpu().half().float() for name, value in average.items()}
    scores = validate(task, halves, [task.prepare(batch) for batch in validation_batches(run.stream)])
    lines = read_log(run.out)
    metadata = {
        "method": "paper",
        "rung": options.rung,
        "variant": options.variant,
        "size": json.dumps(asdict(options.size)),
        "colors": str(VARIANTS[options.variant].colors),
        "seed": str(options.seed),
        "parameters": str(count_parameters(task.network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "stream": json.dumps(asdict(run.stream)),
        "data": data,
        "command": describe_command(options, run),
        "validation": json.dumps(scores),
        "curve": json.dumps(curve_of(lines)),
        "reference": json.dumps(references_of(lines)),
    }
    write_weights(path, halves, metadata)
    return path


def digest_data(stream: StreamOptions) -> str:
    """sha256 of what makes the examples: the options, and the code of every module that draws, renders or exposes."""
    digest = hashlib.sha256(json.dumps(asdict(stream)).encode())
    for name in DATA_MODULES:
        digest.update(read_module(name))
    return digest.hexdigest()


def describe_command(options: TrainOptions, run: Run) -> str:
    """The command line that trains this again."""
    size, schedule = options.size, run.schedule
    asked = {
        "data": options.variant,
        "width": size.width,
        "levels": size.levels,
        "fold": size.fold,
        "steps": schedule.steps,
        "rate": schedule.rate,
        "seed": options.seed,
        "workers": run.workers,
        "devices": run.devices,
        "precision": schedule.precision,
        "output": run.out.name,
    }
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    return shlex.join(["polsep", "train", options.rung, *words])


def plan_run(out: Path, options: TrainOptions, schedule: Schedule, workers: int, devices: int) -> Run:
    """Where and how: a training of ``options`` that writes into ``out``.

    Raises ValueError on what would only fail later, or train nothing.
    """
    if out.exists() and not out.is_dir():
        raise ValueError(f"expected a directory to write into, found a file: {out}")
    if min(schedule.steps, devices, workers + 1) < 1:
        found = f"steps {schedule.steps}, devices {devices}, workers {workers}"
        raise ValueError(f"expected at least 1 step, 1 device and 0 workers, found {found}")
    if schedule.precision not in PRECISIONS:
        raise ValueError(f"expected a precision of {', '.join(PRECISIONS)}, found {schedule.precision!r}")
    stream = StreamOptions(seed=options.seed, crop=VARIANTS[options.variant].crop)
    return Run(out, json.dumps(asdict(options)), stream, schedule, workers, devices)
