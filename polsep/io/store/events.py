"""Curves of a training as TensorBoard's event files. Needs the extra ``train``."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

EventWriter = SummaryWriter


def open_events(folder: Path, step: int) -> EventWriter:
    """A writer of a new event file in ``folder``, which voids the points of older files after ``step``."""
    return SummaryWriter(str(folder), purge_step=step + 1)


def add_events(writer: EventWriter, step: int, values: dict[str, float]) -> None:
    """Add a point to every named curve at ``step``."""
    for name, value in values.items():
        writer.add_scalar(name, value, step)
    writer.flush()
