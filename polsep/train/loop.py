"""The one training loop: warm-up and cosine, clipped gradients, a moving average of the weights, checkpoints.

A training that is killed goes on from its last checkpoint and ends with the same bits as one that was not: the state
holds all that a step depends on, and the stream starts at any batch.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins import MixedPrecision
from torch import Tensor, nn
from torch.utils.data import DataLoader

from polsep.compute.threads import set_threads
from polsep.io.store.checkpoints import read_checkpoint, write_checkpoint
from polsep.io.store.weights import read_weights
from polsep.train.log import Report, open_log
from polsep.train.optimizers import Optimizers
from polsep.train.stream import Examples, ExampleStream, StreamOptions
from polsep.train.tasks import Task, View
from polsep.train.validation import score, score_averaged, score_references, validation_batches

#: The learning rate ends at this share of its peak.
LAST_SHARE = 0.01
#: Norm of a network's gradient at most. Usual ones are 13 to 42, so only outliers are cut.
MAX_GRADIENT = 100.0
#: A batch: a named tuple of tensors.
Batch = TypeVar("Batch", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Schedule:
    """How long and how: ``steps``, peak learning ``rate``, steps of ``warm_up``, decay of the moving ``average``.

    ``checkpoint_every`` and ``validate_every`` count steps. ``precision``: as lightning-fabric names it.
    """

    steps: int = 20_000
    rate: float = 1e-3
    warm_up: int = 500
    average: float = 0.999
    checkpoint_every: int = 500
    validate_every: int = 1000
    precision: str = "bf16-mixed"

    def rate_at(self, step: int) -> float:
        """Linear warm-up, then half a cosine down to `LAST_SHARE` of the peak."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        done = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (LAST_SHARE + (1 - LAST_SHARE) * (1 + math.cos(math.pi * min(done, 1))) / 2)

    def is_due(self, step: int, every: int) -> bool:
        """Whether what is done ``every`` so many steps, and after the last one, is to be done now."""
        return step % every == 0 or step == self.steps


@dataclass(frozen=True)
class Run:
    """Where a training writes, ``what`` it trains, on which data; ``workers`` render, ``devices`` train.

    ``start``: files of weights whose mean it begins with, instead of random ones; a schedule of 0 steps writes and
    scores that. ``refit``: what is fitted instead of trained is fitted anew before. ``until``: a step of the schedule
    to end at; a later run goes on from its last checkpoint.
    """

    out: Path
    what: str = ""
    stream: StreamOptions = field(default_factory=StreamOptions)
    schedule: Schedule = field(default_factory=Schedule)
    workers: int = 1
    devices: int = 1
    start: tuple[Path, ...] = ()
    refit: bool = False
    until: int | None = None

    @property
    def last(self) -> int:
        """The step after which it ends."""
        return self.schedule.steps if self.until is None else min(self.until, self.schedule.steps)


class ExactInputs(MixedPrecision):
    """Mixed precision in which what a network is given stays as it is.

    Lightning rounds it to bfloat16, whose steps at white are 16 of a 12-bit camera's.
    """

    def convert_input(self, data: Any) -> Any:
        """The data themselves; autocast rounds where a layer computes in bfloat16."""
        return data


@dataclass(frozen=True)
class Course:
    """What the loop trains: a ``network``, ``batches`` from a step on for one process of so many, and their ``loss``.

    Batches are named tuples of tensors; the loss is told which share of the training is done. ``score`` of a network
    is what a line of the log says; ``begin`` is called before the first step, ``references`` for the log's first line.
    """

    network: nn.Module
    batches: Callable[[int, tuple[int, int]], Iterator[Any]]
    loss: Callable[[nn.Module, Any, float], Tensor]
    score: Callable[[nn.Module], dict[str, float]]
    begin: Callable[[], None] = field(default=lambda: None)
    references: Callable[[], dict[str, float]] = field(default=dict)


def train(task: Task[View], run: Run, report: Report) -> dict[str, Tensor] | None:
    """Train a task on streamed examples; see `train_course`."""
    views: list[View] = []

    def look() -> list[View]:
        """Validation views, prepared where the network is when they are first asked for."""
        if not views:
            device = next(task.network.parameters()).device
            views.extend(task.prepare(_to(device, batch)) for batch in validation_batches(run.stream))
        return views

    def batches(step: int, lane: tuple[int, int]) -> Iterator[Examples]:
        stream = ExampleStream(run.stream, step, lane)
        return iter(DataLoader(stream, batch_size=None, num_workers=run.workers, worker_init_fn=take_one_core))

    course = Course(
        task.network,
        batches,
        lambda network, batch, done: task.loss(network, task.prepare(batch), done),
        lambda _: score(task.separate, look()),
        lambda: task.begin(run.stream),
        lambda: score_references(task, look()) | (score(task.separate, look()) if run.start else {}),
    )
    return train_course(course, run, report)


def train_course(course: Course, run: Run, report: Report) -> dict[str, Tensor] | None:
    """Train to the end, from the last checkpoint if there is one; returns the averaged weights.

    ``report`` is called with every line of the log. Of several processes only the first one writes and reports, and
    the others return None. Raises ValueError when the checkpoint is of another training.
    """
    fabric = _fabric(run)
    fabric.launch()
    network = course.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    state = read_checkpoint(run.out / "checkpoint.pt")
    if state is None:
        begin_at(run.start, network)
        if run.refit or not run.start:
            course.begin()
    wrapped = fabric.setup_module(network)
    optimizer = Optimizers(network)
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    step = _restore(state, run, (network, optimizer, average))
    batches = course.batches(step, (fabric.global_rank, fabric.world_size)) if step < run.last else iter(())
    with ExitStack() as stack:
        log = stack.enter_context(open_log(run.out, step, report, course.references)) if fabric.is_global_zero else None
        while step < run.last:
            rate = run.schedule.rate_at(step)
            loss = course.loss(wrapped, _to(fabric.device, next(batches)), step / run.schedule.steps)
            fabric.backward(loss)
            for net in _parts(network):
                nn.utils.clip_grad_norm_(net.parameters(), MAX_GRADIENT)
            optimizer.step(rate)
            step += 1
            follow(average, network, min(run.schedule.average, (1 + step) / (10 + step)))
            if log is None:
                continue
            log.note(step, float(loss.detach()), run.schedule.rate_at(step))
            if run.schedule.is_due(step, run.schedule.validate_every):
                scores = score_averaged(network, average, course.score)
                log.add_scores(step, run.schedule.rate_at(step), scores)
            if run.schedule.is_due(step, run.schedule.checkpoint_every):
                state = {"step": step, "run": _describe(run), "network": network.state_dict()}
                state |= {"optimizer": optimizer.state_dict(), "average": average}
                write_checkpoint(run.out / "checkpoint.pt", state)
    return average if fabric.is_global_zero else None


def _fabric(run: Run) -> Fabric:
    """Where it trains, and how precisely."""
    if run.schedule.precision != "bf16-mixed":
        return Fabric(devices=run.devices, precision=run.schedule.precision)  # type: ignore[arg-type]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return Fabric(accelerator=device, devices=run.devices, plugins=[ExactInputs("bf16-mixed", device)])


def begin_at(paths: Sequence[Path], network: nn.Module) -> None:
    """Fill in the mean of files of weights, where there are any. Raises ValueError on those of another network."""
    mean: dict[str, Tensor] = {}
    for count, path in enumerate(paths, start=1):
        tensors, _ = read_weights(path)
        try:
            network.load_state_dict(tensors)
        except RuntimeError:
            raise ValueError(
                f"expected weights of the network to be trained in {path}, found those of another"
            ) from None
        for name, value in network.state_dict().items():
            mean[name] = value.clone() if count == 1 else mean[name].lerp(value, 1 / count)
    if mean:
        network.load_state_dict(mean)


def _to(device: torch.device, batch: Batch) -> Batch:
    return type(batch)(*(x.to(device) for x in batch))


def _describe(run: Run) -> str:
    """What must be the same for a checkpoint to go on."""
    described: dict[str, Any] = {"what": run.what, "stream": asdict(run.stream), "schedule": asdict(run.schedule)}
    described |= {"start": [path.name for path in run.start]} if run.start else {}
    described |= {"refit": True} if run.refit else {}
    return json.dumps(described | {"workers": run.workers, "devices": run.devices})


def _restore(state: dict[str, Any] | None, run: Run, into: tuple[nn.Module, Optimizers, dict[str, Tensor]]) -> int:
    """Fill network, optimizer and average from a checkpoint; the step it was made at, 0 without one."""
    if state is None:
        return 0
    if state["run"] != _describe(run):
        raise ValueError(f"expected the checkpoint of {_describe(run)}, found one of {state['run']}")
    network, optimizer, average = into
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    for name, value in average.items():
        value.copy_(state["average"][name])
    return int(state["step"])


def _parts(network: nn.Module) -> list[nn.Module]:
    """Networks that are trained independently have their gradients clipped so."""
    nets = getattr(network, "nets", None)
    return [*nets, network.linear] if nets is not None else [network]  # type: ignore[list-item]


def take_one_core(worker: int) -> None:
    """Rendering workers are as many as there are cores to give."""
    del worker
    set_threads(1)


def follow(average: dict[str, Tensor], network: nn.Module, decay: float) -> None:
    """Move the average of the weights a step toward the network's."""
    with torch.no_grad():
        for name, value in network.state_dict().items():
            average[name].lerp_(value.detach(), 1 - decay)
