"""One measured number as a row, what made it, and rows as JSON lines."""

from __future__ import annotations

import dataclasses
import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from polsep.bench.history import ask_git
from polsep.io.store.atomic import replace_text
from polsep.io.store.rows import read_rows

#: Tables of single scenes, objects and points of curves, "NAME/PART", which are too long for the repository.
SCENE_PARTS = ("scenes", "objects", "curve", "films")


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
    """The command, the commit (with "+" if the tree had changes) and the machine that made rows."""
    changed = ask_git("status", "--porcelain", "--untracked-files=no", "--", "polsep", "evaluation")
    commit = (ask_git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")
    machine = f"{torch.get_num_threads()} threads, {platform.machine()}, torch {torch.__version__}"
    return {"command": command, "commit": commit, "machine": machine}


def to_jsonl(rows: Sequence[Row], made_by: dict[str, str]) -> str:
    """A line that says what made the rows, then a line for each row; numbers with six significant digits."""
    lines = [made_by, *(asdict(row) | {"value": float(f"{row.value:.6g}")} for row in rows)]
    return "".join(json.dumps(line) + "\n" for line in lines)


def write_rows(folder: Path, name: str, rows: Sequence[Row], command: str) -> None:
    """Replace ``folder``/NAME.jsonl, and ``folder``/scenes/NAME.jsonl with the rows of `SCENE_PARTS`, not committed.

    Raises ValueError where there are no rows, so that nothing replaces what was measured before.
    """
    if not rows:
        raise ValueError(f"expected rows of {name}, found none: {folder / name}.jsonl stays as it is")
    made_by = provenance(command)
    tables: dict[Path, list[Row]] = {}
    for row in rows:
        single = row.bench.partition("/")[2] in SCENE_PARTS
        tables.setdefault((folder / "scenes" if single else folder) / f"{name}.jsonl", []).append(row)
    for path, lines in tables.items():
        replace_text(path, to_jsonl(lines, made_by))


def replace_rows(folder: Path, name: str, rows: Sequence[Row], command: str) -> None:
    """Replace the rows of these benches, or add them, in ``folder``/NAME.jsonl; all others stay with what made them.

    Raises ValueError where there are no rows.
    """
    if not rows:
        raise ValueError(f"expected rows of {name}, found none: {folder / name}.jsonl stays as it is")
    path, fields = folder / f"{name}.jsonl", [field.name for field in dataclasses.fields(Row)]
    tables: dict[str, tuple[list[Row], dict[str, str]]] = {}
    for old in read_rows(path) if path.is_file() else ():
        made_by = {key: value for key, value in old.items() if key not in fields}
        tables.setdefault(old["bench"], ([], made_by))[0].append(Row(**{key: old[key] for key in fields}))
    made_by = provenance(command)
    for bench in {row.bench: None for row in rows}:
        tables[bench] = ([row for row in rows if row.bench == bench], made_by)
    replace_text(path, "".join(to_jsonl(*table) for table in tables.values()))
