"""The training loop: warm-up and cosine schedule, clipped gradients, averaged weights, checkpoints.

An interrupted training resumes from its last checkpoint and ends with the same bits as an uninterrupted one: the
checkpoint holds the whole state of a step, and the stream of examples can start at any batch.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from functools import cache
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
from polsep.networks.joint import Joint
from polsep.train.growth import grow
from polsep.train.inputs import Inputs
from polsep.train.log import Report, open_log
from polsep.train.optimizers import Optimizers
from polsep.train.stream import Examples, ExampleStream, StreamOptions
from polsep.train.tasks import Task
from polsep.train.validation import score, score_averaged, score_references, validation_batches

#: The learning rate ends at this share of its peak.
LAST_SHARE = 0.01
#: Largest norm of a network's gradient. Usual ones are 13 to 42, so only outliers are clipped.
MAX_GRADIENT = 100.0
#: A batch: a named tuple of tensors.
Batch = TypeVar("Batch", bound=tuple[Any, ...])


@dataclass(frozen=True)
class Schedule:
    """Schedule of a training: ``steps``, peak learning ``rate``, steps of ``warm_up``, decay of the moving ``average``.

    ``checkpoint_every`` and ``validate_every`` count steps. ``precision``: a name of lightning-fabric.
    """

    steps: int = 20_000
    rate: float = 1e-3
    warm_up: int = 500
    average: float = 0.999
    checkpoint_every: int = 500
    validate_every: int = 1000
    precision: str = "bf16-mixed"

    def rate_at(self, step: int) -> float:
        """Return the learning rate: linear warm-up, then half a cosine down to `LAST_SHARE` of the peak."""
        if step < self.warm_up:
            return self.rate * (step + 1) / self.warm_up
        done = (step - self.warm_up) / max(1, self.steps - self.warm_up)
        return self.rate * (LAST_SHARE + (1 - LAST_SHARE) * (1 + math.cos(math.pi * min(done, 1))) / 2)

    def is_due(self, step: int, every: int) -> bool:
        """Return True at multiples of ``every`` and at the last step."""
        return step % every == 0 or step == self.steps


@dataclass(frozen=True)
class Run:
    """One run of a training into the folder ``out``; ``workers`` render, ``devices`` train.

    ``what``: JSON of the options, compared on resuming. ``start``: files of weights whose mean replaces the random
    initial weights; a schedule of 0 steps writes and scores that mean. ``refit``: fit again, before training, what is
    fitted and not trained. ``until``: step of the schedule to stop at; a later run resumes from the last checkpoint.
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
        """The step at which this run ends."""
        return self.schedule.steps if self.until is None else min(self.until, self.schedule.steps)


class ExactInputs(MixedPrecision):
    """Mixed precision that leaves a network's inputs in float32.

    Lightning rounds them to bfloat16, whose steps at white are 16 of a 12-bit camera's.
    """

    def convert_input(self, data: Any) -> Any:
        """Return the data unchanged; autocast rounds them where a layer computes in bfloat16."""
        return data


@dataclass(frozen=True)
class Training:
    """A ``network``, its ``batches`` from a step on for process (rank, count), and their ``loss``.

    Batches are named tuples of tensors; the third argument of the loss is the completed share of the training.
    ``score``: the scores of a network in a line of the log; ``begin``: called before the first step; ``references``:
    scores in the log's first line; ``finish``: fits what is not trained to the averaged network, on validation data.
    """

    network: nn.Module
    batches: Callable[[int, tuple[int, int]], Iterator[Any]]
    loss: Callable[[nn.Module, Any, float], Tensor]
    score: Callable[[nn.Module], dict[str, float]]
    begin: Callable[[], None] = field(default=lambda: None)
    references: Callable[[], dict[str, float]] = field(default=dict)
    finish: Callable[[nn.Module], None] = field(default=lambda _: None)


def train(task: Task[Inputs], run: Run, report: Report) -> dict[str, Tensor] | None:
    """Train a task on streamed examples; see `run_training`."""

    @cache
    def views() -> list[Inputs]:
        """Validation views on the network's device, prepared on first use."""
        device = next(task.network.parameters()).device
        return [task.prepare(_to(device, batch)) for batch in validation_batches(run.stream)]

    def batches(step: int, process: tuple[int, int]) -> Iterator[Examples]:
        stream = ExampleStream(run.stream, step, process)
        return iter(DataLoader(stream, batch_size=None, num_workers=run.workers, worker_init_fn=use_one_thread))

    training = Training(
        task.network,
        batches,
        lambda network, batch, done: task.loss(network, task.prepare(batch), done),
        lambda _: score(task.separate, views()),
        lambda: task.begin(run.stream),
        lambda: score_references(task, views()) | (score(task.separate, views()) if run.start else {}),
    )
    return run_training(training, run, report)


def run_training(training: Training, run: Run, report: Report) -> dict[str, Tensor] | None:
    """Train to the end, from the last checkpoint if there is one, and return the averaged weights.

    ``report`` is called with every line of the log. Of several processes only the first one writes and reports; the
    others return None. Raises ValueError on a checkpoint of another training or beyond the run's last step, and on a
    loss that is not finite.
    """
    if run.schedule.precision == "bf16-mixed":
        device = "cuda" if torch.cuda.is_available() else "cpu"
        fabric = Fabric(accelerator=device, devices=run.devices, plugins=[ExactInputs("bf16-mixed", device)])
    else:
        fabric = Fabric(devices=run.devices, precision=run.schedule.precision)  # type: ignore[arg-type]
    fabric.launch()
    network = training.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    state = read_checkpoint(run.out / "checkpoint.pt")
    described = _describe(run, _starts(run, state))
    if state is None:
        load_mean(run.start, network)
        if run.refit or not run.start:
            training.begin()
    wrapped = fabric.setup_module(network)
    optimizer = Optimizers(network)
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    step = _restore(state, described, network, optimizer, average)
    _require_end(run, step)
    batches = training.batches(step, (fabric.global_rank, fabric.world_size)) if step < run.last else iter(())
    with ExitStack() as stack:
        opened = open_log(run.out, step, report, training.references, _losses(state))
        log = stack.enter_context(opened) if fabric.is_global_zero else None
        while step < run.last:
            rate = run.schedule.rate_at(step)
            loss = training.loss(wrapped, _to(fabric.device, next(batches)), step / run.schedule.steps)
            if not bool(torch.isfinite(loss)):
                raise ValueError(f"expected a finite loss, found {float(loss.detach())} at step {step}")
            fabric.backward(loss)
            for net in _parts(network):
                nn.utils.clip_grad_norm_(net.parameters(), MAX_GRADIENT)
            optimizer.step(rate)
            step += 1
            update_average(average, network, min(run.schedule.average, (1 + step) / (10 + step)))
            if log is None:
                continue
            log.note(step, float(loss.detach()), run.schedule.rate_at(step))
            if run.schedule.is_due(step, run.schedule.validate_every):
                scores = score_averaged(network, average, training.score)
                log.add_scores(step, run.schedule.rate_at(step), scores)
            if run.schedule.is_due(step, run.schedule.checkpoint_every):
                state = {"step": step, "run": described, "network": network.state_dict()}
                state |= {"optimizer": optimizer.state_dict(), "average": average, "losses": log.losses}
                write_checkpoint(run.out / "checkpoint.pt", state)
    return average if fabric.is_global_zero else None


def hash_starts(run: Run) -> list[list[str]]:
    """Name and sha256 of the tensors of every file that a training started from, as `read_weights` checks it."""
    return [[path.name, read_weights(path)[1]["sha256"]] for path in run.start]


def load_mean(paths: Sequence[Path], network: nn.Module) -> None:
    """Load the mean of files of weights, if any, into a network; those of smaller joint networks grow (`growth`).

    Raises ValueError on weights of another network.
    """
    mean: dict[str, Tensor] = {}
    initial = {name: value.clone() for name, value in network.state_dict().items()}
    for count, path in enumerate(paths, start=1):
        network.load_state_dict(initial)  # what a smaller network lacks is not to come from the file before
        tensors = {name: torch.from_numpy(array) for name, array in read_weights(path)[0].items()}
        try:
            network.load_state_dict(grow(tensors, network) if isinstance(network, Joint) else tensors)
        except (RuntimeError, ValueError):
            raise ValueError(
                f"expected weights of the network to be trained in {path}, found those of another"
            ) from None
        for name, value in network.state_dict().items():
            mean[name] = value.clone() if count == 1 else mean[name].lerp(value, 1 / count)
    if mean:
        network.load_state_dict(mean)


def _to(device: torch.device, batch: Batch) -> Batch:
    return type(batch)(*(x.to(device) for x in batch))


def _starts(run: Run, state: dict[str, Any] | None) -> list[Any]:
    """`hash_starts` of a run, or what its checkpoint says where files cannot tell any more.

    So it is with those that are gone, with results of the run itself, and in checkpoints that hold names alone.
    """
    said = [] if state is None else json.loads(state["run"]).get("start", [])
    names = [entry if isinstance(entry, str) else entry[0] for entry in said]
    own = any(not path.exists() or path.resolve().parent == run.out.resolve() for path in run.start)
    if said and names == [path.name for path in run.start] and (own or isinstance(said[0], str)):
        return list(said)
    return hash_starts(run)


def _describe(run: Run, starts: list[Any]) -> str:
    """JSON of all that must be equal for a training to resume from a checkpoint."""
    described: dict[str, Any] = {"what": run.what, "stream": asdict(run.stream), "schedule": asdict(run.schedule)}
    if not run.stream.constants:
        del described["stream"]["constants"]
    described |= {"start": starts} if run.start else {}
    described |= {"refit": True} if run.refit else {}
    return json.dumps(described | {"workers": run.workers, "devices": run.devices})


def _restore(
    state: dict[str, Any] | None, described: str, network: nn.Module, optimizer: Optimizers, average: dict[str, Tensor]
) -> int:
    """Load network, optimizer and average from a checkpoint, and return its step; 0 without a checkpoint."""
    if state is None:
        return 0
    _require_same(_flat(described), _flat(state["run"]))
    network.load_state_dict(state["network"])
    optimizer.load_state_dict(state["optimizer"])
    for name, value in average.items():
        value.copy_(state["average"][name])
    return int(state["step"])


def _require_same(wanted: dict[str, Any], found: dict[str, Any]) -> None:
    """Raise ValueError on a training with other options than those of its checkpoint, which names them."""
    differ = [name for name in wanted | found if wanted.get(name) != found.get(name)]
    if differ:
        asked, said = (
            ", ".join(f"{name} {entries[name]}" if name in entries else f"no {name}" for name in differ)
            for entries in (wanted, found)
        )
        raise ValueError(f"expected the checkpoint of a training with {asked}, found one with {said}")


def _flat(entry: Any, name: str = "") -> dict[str, Any]:
    """The entries of `_describe`, by names such as "schedule rate"; those of ``what`` by theirs alone."""
    entry = json.loads(entry) if isinstance(entry, str) and entry.startswith("{") else entry
    if not isinstance(entry, dict):
        return {name: entry}
    parts = ((f"{name} {key}".strip() if key != "what" else "", value) for key, value in entry.items())
    return {part: value for key, below in parts for part, value in _flat(below, key).items()}


def _losses(state: dict[str, Any] | None) -> list[float]:
    """The losses since the log's last line of a checkpoint; none of older ones, which do not hold them."""
    return [] if state is None else state.get("losses", [])


def _require_end(run: Run, step: int) -> None:
    """Raise ValueError on a run that ends before the ``step`` of its checkpoint: its weights would be of another."""
    if step > run.last:
        raise ValueError(f"expected to end at step {step} of the checkpoint or later, found {run.last}")


def _parts(network: nn.Module) -> list[nn.Module]:
    """Independent networks of one task, whose gradients are clipped separately."""
    nets = getattr(network, "nets", None)
    return [*nets, network.linear] if nets is not None else [network]  # type: ignore[list-item]


def use_one_thread(worker: int) -> None:
    """Initialize a rendering worker: parallelism comes from the number of workers."""
    del worker
    set_threads(1)


def update_average(average: dict[str, Tensor], network: nn.Module, decay: float) -> None:
    """Move the averaged weights a step toward the network's."""
    with torch.no_grad():
        for name, value in network.state_dict().items():
            average[name].lerp_(value.detach(), 1 - decay)
