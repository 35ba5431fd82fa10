"""One measured number as a row, what made it, and rows as JSON lines."""

from __future__ import annotations

import json
import math
import platform
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import torch

from polsep.bench.history import ask_git
from polsep.io.store.atomic import replace_text
from polsep.io.store.rows import SPREAD, move_rows, read_rows, remove_rows

#: Paths whose changes make a commit another one.
CODE = ("polsep", "evaluation", "web", "tools", "pyproject.toml", "constraints.txt")
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


def read_commit() -> str:
    """The commit of the tree, with "+" if it has changes; ask for it before a long run."""
    changed = ask_git("status", "--porcelain", "--untracked-files=no", "--", *CODE)
    return (ask_git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")


def provenance(command: str, begun: str | None = None) -> dict[str, str]:
    """The command, the commit and the machine that made rows; ``begun``: `read_commit` when the run began.

    The commit has "+" if the tree had changes then, or has some now.
    """
    now = read_commit()
    commit = now if begun is None else begun if begun.endswith("+") or not now.endswith("+") else f"{begun}+"
    machine = f"{torch.get_num_threads()} threads, {platform.machine()}, torch {torch.__version__}"
    return {"command": command, "commit": commit, "machine": machine}


def to_jsonl(rows: Sequence[Row], made_by: dict[str, str]) -> str:
    """A line that says what made the rows, then a line for each row; numbers with six significant digits."""
    lines = [made_by, *(asdict(row) | {"value": float(f"{row.value:.6g}")} for row in rows)]
    return "".join(json.dumps(line) + "\n" for line in lines)


def write_rows(folder: Path, name: str, rows: Sequence[Row], command: str, begun: str | None = None) -> None:
    """Replace ``folder``/NAME.jsonl, and ``folder``/scenes/NAME.jsonl with the rows of `SCENE_PARTS`, not committed.

    Raises ValueError where there are no rows, and where the file has results of more cases or methods: then what was
    measured goes to NAME-partial.jsonl, and nothing replaces what was measured before. Quick runs may have fewer.
    ``begun``: as of `provenance`.
    """
    if not rows:
        raise ValueError(f"expected rows of {name}, found none: {folder / name}.jsonl stays as it is")
    made_by = provenance(command, begun)
    tables: dict[bool, list[Row]] = {True: [], False: []}
    for row in rows:
        tables[row.bench.partition("/")[2] in SCENE_PARTS].append(row)
    scenes, means = tables[True], tables[False]
    path = folder / f"{name}.jsonl"
    lost = [] if name.endswith("-quick") else find_lost(path, means)
    partial = path.with_stem(f"{name}-partial")
    if scenes:
        replace_text(folder / "scenes" / (partial if lost else path).name, to_jsonl(scenes, made_by))
    if lost:
        path = partial
    else:
        for older in (partial, folder / "scenes" / partial.name):
            remove_rows(older)
    if means:
        replace_text(path, to_jsonl(means, made_by))
    if lost:
        missing = lost[0] + (f" and {len(lost) - 1} more" if len(lost) > 1 else "")
        raise ValueError(
            f"expected all that {name}.jsonl has, found nothing of {missing}: it stays as it is, see {path}; "
            f"'python -m evaluation accept {name}' takes that instead"
        )


def accept_partial(folder: Path, name: str) -> list[str]:
    """Replace NAME.jsonl by NAME-partial.jsonl, which `write_rows` has left; return the cases and methods that go.

    For benchmarks that no longer measure these. Raises ValueError where there is no such file.
    """
    path, partial = (folder / f"{stem}.jsonl" for stem in (name, f"{name}-partial"))
    if not partial.is_file():
        raise ValueError(f"expected {partial}, of a run that lacks cases, found none")
    names = [field.name for field in fields(Row)]
    lost = find_lost(path, [Row(**{key: row[key] for key in names}) for row in read_rows(partial)])
    move_rows(partial, path)
    if (scenes := folder / "scenes" / partial.name).is_file():
        move_rows(scenes, scenes.with_name(path.name))
    return lost


def standard_error(values: Sequence[float]) -> float:
    """The standard error of a mean over scenes: how far another draw of as many scenes may be off; NaN of one."""
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan


def with_spread(mean: Row, values: Sequence[float]) -> Iterator[Row]:
    """The row of a mean over ``values``, then of its standard error, which tables show behind it, and of the median."""
    yield mean
    if len(values) > 1:
        yield replace(mean, metric=f"{mean.metric}{SPREAD}", value=standard_error(values))
        yield replace(mean, metric=f"{mean.metric}, median", value=statistics.median(values))


def find_lost(path: Path, rows: Sequence[Row]) -> list[str]:
    """Cases and methods of a file of results that ``rows`` have nothing of; none where there is no such file."""
    before = read_rows(path) if path.is_file() else []
    measured = {(row.bench, row.case, row.method) for row in rows}
    kept = dict.fromkeys((row["bench"], row["case"], row["method"]) for row in before)
    return [f"{bench}: {case}, {method}" for bench, case, method in kept if (bench, case, method) not in measured]


def replace_rows(folder: Path, name: str, rows: Sequence[Row], command: str, begun: str | None = None) -> None:
    """Replace the rows of these benches, or add them, in ``folder``/NAME.jsonl; all others stay with what made them.

    Raises ValueError where there are no rows.
    """
    if not rows:
        raise ValueError(f"expected rows of {name}, found none: {folder / name}.jsonl stays as it is")
    path, names = folder / f"{name}.jsonl", [field.name for field in fields(Row)]
    tables: dict[str, tuple[list[Row], dict[str, str]]] = {}
    for old in read_rows(path) if path.is_file() else ():
        made_by = {key: value for key, value in old.items() if key not in names}
        tables.setdefault(old["bench"], ([], made_by))[0].append(Row(**{key: old[key] for key in names}))
    made_by = provenance(command, begun)
    for bench in {row.bench: None for row in rows}:
        tables[bench] = ([row for row in rows if row.bench == bench], made_by)
    replace_text(path, "".join(to_jsonl(*table) for table in tables.values()))
