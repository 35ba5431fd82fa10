"""TensorBoard's event files: curves of a training. Needs the extra ``train``."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

EventWriter = SummaryWriter


def open_events(folder: Path, step: int) -> EventWriter:
    """A writer of a new event file in ``folder``; what older files there hold of steps after ``step`` is void."""
    return SummaryWriter(str(folder), purge_step=step + 1)


def add_events(writer: EventWriter, step: int, values: dict[str, float]) -> None:
    """A point of every named curve at ``step``."""
    for name, value in values.items():
        writer.add_scalar(name, value, step)
    writer.flush()
