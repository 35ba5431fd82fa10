"""One measured number as a row, what made it, and rows as JSON lines."""

from __future__ import annotations

import json
import platform
import subprocess
from dataclasses import asdict, dataclass
from pathlib import Path

import torch


@dataclass(frozen=True)
class Row:
    """One measured number."""

    bench: str
    case: str
    method: str
    metric: str
    value: float
    unit: str


def provenance(command: str) -> dict[str, str]:
    """What made the rows: command, commit (with "+" if the tree had changes) and machine."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, check=False, cwd=Path(__file__).parents[2]
        )
        return done.stdout.strip() if done.returncode == 0 else ""

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "polsep")
    commit = (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")
    machine = f"{torch.get_num_threads()} threads, {platform.machine()}, torch {torch.__version__}"
    return {"command": command, "commit": commit, "machine": machine}


def to_jsonl(rows: list[Row], made_by: dict[str, str]) -> str:
    """Rows as JSON lines, numbers with six significant digits."""
    lines = [asdict(row) | {"value": float(f"{row.value:.6g}")} | made_by for row in rows]
    return "".join(json.dumps(line) + "\n" for line in lines)
