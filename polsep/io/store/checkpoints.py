"""Files of a training: its state and its log, replaced atomically, so that a kill leaves the last complete ones."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from polsep.io.store.atomic import atomic_path, replace_text


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a state of tensors, numbers and strings atomically."""
    with atomic_path(path) as part, part.open("wb") as file:
        torch.save(state, file)
        file.flush()
        os.fsync(file.fileno())


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """The state in ``path``, or None where there is no file. Raises ValueError on any other file."""
    if not path.exists():
        return None
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise ValueError(f"expected a checkpoint of a training in {path}, found {type(error).__name__}") from None
    if not isinstance(state, dict) or not {"step", "run", "network", "optimizer", "average"} <= state.keys():
        raise ValueError(f"expected a checkpoint of a training in {path}, found something else")
    return state


def append_line(path: Path, line: str) -> None:
    """Add a line to a log."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(line + "\n")


def read_lines(path: Path) -> list[str]:
    """The lines of a log; none without a file. A last line that was cut short is left out."""
    if not path.exists():
        return []
    return path.read_bytes().decode("utf-8", errors="replace").split("\n")[:-1]


def write_lines(path: Path, lines: list[str]) -> None:
    """Replace a log atomically."""
    replace_text(path, "".join(line + "\n" for line in lines))
