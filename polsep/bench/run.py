"""Running a benchmark: rows printed as they come, then written with what made them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from polsep.bench.rows import Row, provenance, to_jsonl
from polsep.io.store.atomic import replace_text
from polsep.io.store.rows import fill_readme

Measure = Callable[[Path], Iterator[Row]]


@dataclass(frozen=True)
class Bench:
    """A benchmark: ``run`` yields rows from a data folder, ``quick`` those of a part of it, in minutes.

    ``draw`` writes pictures, from rows and the data folder into a folder, and yields their paths.
    """

    run: Measure
    quick: Measure | None = None
    draw: Callable[[list[Row], Path, Path], Iterator[Path]] | None = None


@dataclass(frozen=True)
class Folders:
    """``data``: captures and ground truth; ``output``: where NAME.jsonl goes; ``images``: pictures, None = by name."""

    data: Path
    output: Path
    images: Path | None = None


def list_benches(benches: Mapping[str, Bench]) -> Iterator[str]:
    """A line for each benchmark: its name and what it measures."""
    for name, bench in benches.items():
        yield f"{name}: {(bench.run.__doc__ or '').splitlines()[0]}"


def fill_tables_of_docs(output: Path) -> None:
    """Make the tables of README.md and docs/ from the rows in ``output``."""
    for page in (Path("README.md"), *sorted(Path("docs").rglob("*.md"))):
        fill_readme(page, output)


def run_bench(benches: Mapping[str, Bench], name: str, command: str, folders: Folders, quick: bool) -> None:
    """Measure ``name``, print its rows and write them to NAME.jsonl with the ``command`` that made them.

    Raises ValueError on a name that is not in ``benches``, and with ``quick`` where there is no quick version.
    """
    if name not in benches:
        raise ValueError(f"expected a benchmark of {', '.join(benches)}, found {name!r}")
    bench = benches[name]
    measure = bench.quick if quick else bench.run
    if measure is None:
        known = ", ".join(n for n, entry in benches.items() if entry.quick)
        raise ValueError(f"expected a benchmark with a quick version for --quick ({known}), found {name!r}")
    stem = f"{name}-quick" if quick else name
    rows = []
    for row in measure(folders.data):
        print(f"{row.case:48} {row.method:20} {row.metric:28} {row.value:10.4g} {row.unit}", flush=True)
        rows.append(row)
    made_by = provenance(f"{command} {name}{' --quick' if quick else ''}")
    replace_text(folders.output / f"{stem}.jsonl", to_jsonl(rows, made_by))
    images = folders.images or (folders.output / stem if quick else Path("docs/images") / name)
    for path in bench.draw(rows, folders.data, images) if bench.draw else ():
        print(path, flush=True)
