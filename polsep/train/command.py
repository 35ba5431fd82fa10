"""`polsep train` of a rung of the ladder or of the joint network: from options to a file of weights."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from polsep.io.store.weights import read_weights, write_weights
from polsep.networks.joint import Demosaicker
from polsep.networks.rungs import RUNGS
from polsep.networks.sizes import ResidualSize, Size
from polsep.networks.unet import count_parameters
from polsep.train.constants import list_constants
from polsep.train.digest import digest_examples
from polsep.train.inputs import JointInputs, LadderInputs
from polsep.train.joint_task import ABLATIONS, DEMOSAICKERS, JOINT_VARIANTS, PARTS, SIZES, freeze_others, joint_task
from polsep.train.log import curve_of, read_log, references_of
from polsep.train.loop import Run, hash_starts, train
from polsep.train.tasks import VARIANTS, Task, find, ladder_task
from polsep.train.validation import score, score_averaged, validation_batches

#: A size that a laptop trains in an hour or two.
SMALL = Size()
#: Precisions without loss scaling, whose state checkpoints do not hold.
PRECISIONS = ("bf16-mixed", "32-true")


@dataclass(frozen=True)
class TrainOptions:
    """Options of a ``rung`` of `rungs.RUNGS` on a ``variant`` of the data. Raises ValueError on unknown names."""

    rung: str
    variant: str = "mosaic"
    size: Size = SMALL
    seed: int = 0

    def __post_init__(self) -> None:
        find(RUNGS, "a rung", self.rung)
        find(VARIANTS, "a variant", self.variant)

    def task(self) -> Task[LadderInputs]:
        """Return the rung's task."""
        return ladder_task(RUNGS[self.rung], self.variant, self.size)

    def metadata(self) -> dict[str, str]:
        """Return what is needed to load the weights."""
        return {"method": "paper", "rung": self.rung, "colors": str(VARIANTS[self.variant].colors)}

    @property
    def name(self) -> str:
        """The name of the rung."""
        return self.rung

    @property
    def crop(self) -> int:
        """Raw pixels along a crop's side."""
        return VARIANTS[self.variant].crop


@dataclass(frozen=True)
class JointOptions:
    """Options of a joint network by ``name`` of `joint_task.SIZES`; ``variant``: for colour (mosaic) or mono frames.

    ``ablation``: one of `joint_task.ABLATIONS`. ``part``: one of `joint_task.PARTS`; the others are frozen. Raises
    ValueError on unknown names.
    """

    name: str
    variant: str = "mosaic"
    size: ResidualSize | None = None
    ablation: str = "none"
    seed: int = 0
    part: str = "all"

    def __post_init__(self) -> None:
        find(SIZES, "a joint network", self.name)
        find(JOINT_VARIANTS, "a variant", self.variant)
        find(ABLATIONS, "an ablation", self.ablation)
        find(PARTS, "a part", self.part)
        if self.size is None:
            object.__setattr__(self, "size", SIZES[self.name])

    def task(self) -> Task[JointInputs]:
        """Return the task of the network and its ablation."""
        size, ablation = self.size or SIZES[self.name], ABLATIONS[self.ablation]
        task = joint_task(self.variant, size, ablation, self.demosaicker)
        freeze_others(task.network, self.part)
        return task

    @property
    def demosaicker(self) -> Demosaicker:
        """Source of the network's Stokes images."""
        return DEMOSAICKERS[self.name] if self.variant == "mosaic" else "linear"

    def metadata(self) -> dict[str, str]:
        """Return what is needed to load the weights."""
        inputs, colors = json.dumps(ABLATIONS[self.ablation].inputs), str(JOINT_VARIANTS[self.variant][1])
        named = {"method": self.name, "ablation": self.ablation, "demosaicker": self.demosaicker}
        return named | {"inputs": inputs, "colors": colors, "sees_frame": "true"}

    @property
    def crop(self) -> int:
        """Raw pixels along a crop's side."""
        return 256


Options = TrainOptions | JointOptions


def train_weights(options: Options, run: Run, report: Callable[[dict[str, Any]], None]) -> Path:
    """Train to the end, resuming a run in ``run.out``, and return the file of the averaged weights.

    The weights are in half precision. Their metadata holds their scores on the validation views, the log's scores
    (``curve``, a list of [step, diffuse PSNR, specular PSNR]) and those of methods without training (``reference``).
    """
    torch.manual_seed(options.seed)
    data = digest_examples(asdict(run.stream), "polsep.train.stream")
    starts = hash_starts(run)
    path = run.out / f"{options.name}-{options.variant}.safetensors"
    task: Task[Any] = options.task()
    average = train(task, run, report)
    if average is None:  # not the first of several processes
        return path
    task.network.cpu()  # where the validation views are
    weights = {name: value.cpu().half().float() for name, value in average.items()}
    views = [task.prepare(batch) for batch in validation_batches(run.stream)]
    scores = score_averaged(task.network, weights, lambda _: score(task.separate, views))
    lines = read_log(run.out)
    metadata = options.metadata() | {
        "variant": options.variant,
        "size": json.dumps(asdict(options.size)),  # type: ignore[arg-type]
        "seed": str(options.seed),
        "parameters": str(count_parameters(task.network)),
        "schedule": json.dumps(asdict(run.schedule)),
        "stream": json.dumps(asdict(run.stream)),
        "data": data,
        "constants": json.dumps(list_constants(run.stream.constants)),
        "start": json.dumps(starts),
        "command": describe_command(options, run),
        "validation": json.dumps(scores),
        "curve": json.dumps(curve_of(lines)),
        "reference": json.dumps(references_of(lines)),
    }
    write_weights(path, weights, metadata)
    return path


def describe_command(options: Options, run: Run) -> str:
    """Return the command line that repeats the training."""
    schedule = run.schedule
    asked: dict[str, object] = {"data": options.variant, "looks": run.stream.looks}
    if isinstance(options, TrainOptions):
        asked |= {"width": options.size.width, "levels": options.size.levels, "fold": options.size.fold}
    else:
        size = options.size or SIZES[options.name]
        asked |= {"width": size.width, "blocks": ",".join(map(str, size.blocks)), "entry": size.entry}
        asked |= {"ablation": options.ablation, "part": options.part}
    asked |= {
        "steps": schedule.steps,
        "rate": schedule.rate,
        "seed": options.seed,
        "workers": run.workers,
        "devices": run.devices,
        "precision": schedule.precision,
        "output": run.out.name,
    }
    words = [word for name, value in asked.items() for word in (f"--{name}", str(value))]
    for name, values in run.stream.constants:
        words += ["--set", f"{name}={','.join(f'{value:g}' for value in values)}"]
    return shlex.join(["polsep", "train", options.name, *words, *describe_start(run)])


def describe_start(run: Run) -> list[str]:
    """Return the options ``--start`` and ``--refit`` of a run."""
    return [word for path in run.start for word in ("--start", path.name)] + ["--refit"] * run.refit


def choose_options(name: str, data: str, asked: dict[str, Any]) -> Options:
    """Return the options of a rung or a joint network from those of the command line; see `polsep train`.

    Raises ValueError on unknown names and invalid sizes.
    """
    width = asked["width"]
    if name not in SIZES:
        size = Size(SMALL.width if width is None else width, asked["levels"], asked["fold"])
        return TrainOptions(name, data, size, asked["seed"])
    usual = SIZES[name]
    try:
        blocks = usual.blocks if asked["blocks"] is None else tuple(int(n) for n in asked["blocks"].split(","))
    except ValueError:
        raise ValueError(f"expected blocks per level like 1,1,2, found {asked['blocks']!r}") from None
    entry = usual.entry if asked["entry"] is None else asked["entry"]
    larger = ResidualSize(usual.width if width is None else width, blocks, entry)
    return JointOptions(name, data, larger, asked["ablation"], asked["seed"], asked["part"])


def plan_run(run: Run, options: Options) -> Run:
    """Return the run with the description of its options and with their stream.

    Raises ValueError as `check_run`, on ``refit`` of a network without a linear filter, and on a mono network that
    starts from weights for colour frames without it: their filter is not its own.
    """
    check_run(run)
    if run.refit and not (isinstance(options, JointOptions) and options.demosaicker == "linear"):
        raise ValueError(
            f"expected a network with a linear filter to refit, found {options.name} for {options.variant}"
        )
    if isinstance(options, JointOptions) and options.variant == "mono" and not run.refit:
        for path in run.start:
            if read_weights(path)[1].get("colors") == "3":
                raise ValueError(f"expected --refit with weights for colour frames, found {path.name} without")
    stream = replace(run.stream, seed=options.seed, crop=options.crop)
    return replace(run, what=json.dumps(asdict(options)), stream=stream)


def check_run(run: Run) -> None:
    """Raise ValueError on a run that would fail later or train nothing."""
    out, schedule = run.out, run.schedule
    if out.exists() and not out.is_dir():
        raise ValueError(f"expected a directory to write into, found a file: {out}")
    if min(run.last + bool(run.start), run.devices, run.workers + 1) < 1:
        found = f"steps {run.last}, devices {run.devices}, workers {run.workers}"
        raise ValueError(f"expected at least 1 step, 1 device and 0 workers, found {found}")
    if schedule.precision not in PRECISIONS:
        raise ValueError(f"expected a precision of {', '.join(PRECISIONS)}, found {schedule.precision!r}")
