"""Training states on disk: written beside and renamed, so that a kill leaves the last whole one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a state of tensors, numbers and strings, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    with beside.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())
    beside.replace(path)


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """The state in ``path``, or None where there is no file. Raises ValueError on a file that is none of ours."""
    if not path.exists():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(f"expected a checkpoint of a training in {path}, found {type(error).__name__}") from None
    if not isinstance(state, dict) or "step" not in state:
        raise ValueError(f"expected a checkpoint of a training in {path}, found something else")
    return state


def append_line(path: Path, line: str) -> None:
    """Add a line to a log."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")
