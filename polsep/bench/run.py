"""Running a benchmark: rows printed as they come, then written with what made them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from polsep.bench.history import TIMED, find_changes
from polsep.bench.rows import Row, read_commit, write_rows
from polsep.io.store.rows import fill_page

#: Yields rows; called with the data folder where the benchmark needs one, else without.
Measure = Callable[..., Iterator[Row]]


@dataclass(frozen=True)
class Bench:
    """A benchmark: ``run`` yields rows, ``quick`` those of a part of it, in minutes.

    ``draw`` writes pictures, from rows and the data folder into a folder, and yields their paths. ``data``: paths below
    the data folder that are needed; ``quick`` leaves out what is absent. ``measures``: paths of the repository whose
    code the numbers speak of.
    """

    run: Measure
    quick: Measure | None = None
    draw: Callable[[list[Row], Path, Path], Iterator[Path]] | None = None
    data: tuple[str, ...] = ()
    measures: tuple[str, ...] = ()


@dataclass(frozen=True)
class Folders:
    """``data``: captures and ground truth; ``output``: where NAME.jsonl goes; ``images``: pictures, None = by name."""

    data: Path | None
    output: Path
    images: Path | None = None


def list_benches(benches: Mapping[str, Bench]) -> Iterator[str]:
    """A line for each benchmark: its name and what it measures."""
    for name, bench in benches.items():
        yield f"{name}: {(bench.run.__doc__ or '').splitlines()[0]}"


def fill_tables_of_docs(output: Path, measures: Mapping[str, tuple[str, ...]]) -> None:
    """Make the tables of README.md and docs/ from the rows in ``output``.

    Tables of what ``measures`` names, paths by benchmark, say whether they are older than the code. Raises ValueError
    where there is no such folder or none of its files, before tables are replaced by none, and where README.md is not
    here.
    """
    if not output.is_dir():
        raise ValueError(f"expected a folder of measured rows, found no {output}")
    if not Path("README.md").is_file():
        raise ValueError("expected the checkout of polsep as the working directory, found no README.md in it")
    if not any(output.glob("*.jsonl")):
        raise ValueError(f"expected a folder of measured rows, found no NAME.jsonl in {output}")
    for page in (Path("README.md"), *sorted(Path("docs").rglob("*.md"))):
        fill_page(
            page,
            output,
            lambda name, commits: (
                find_changes(commits, measures[name], timed=name in TIMED) if name in measures else None
            ),
        )


def run_bench(benches: Mapping[str, Bench], name: str, command: str, folders: Folders, quick: bool) -> None:
    """Measure ``name``, print its rows and write them to NAME.jsonl with the ``command`` that makes them.

    Nothing is written unless all is measured. Raises ValueError on a name that is not in ``benches``, on data that are
    not there, and with ``quick`` where there is no quick version.
    """
    if name not in benches:
        raise ValueError(f"expected a benchmark of {', '.join(benches)}, found {name!r}")
    bench = benches[name]
    measure = bench.quick if quick else bench.run
    if measure is None:
        known = ", ".join(n for n, entry in benches.items() if entry.quick)
        raise ValueError(f"expected a benchmark with a quick version for --quick ({known}), found {name!r}")
    data = find_data(bench, folders.data, quick)
    stem = f"{name}-quick" if quick else name
    rows, begun = [], read_commit()
    for row in measure(data) if bench.data else measure():
        print(f"{row.case:48} {row.method:20} {row.metric:28} {row.value:10.4g} {row.unit}", flush=True)
        rows.append(row)
    write_rows(folders.output, stem, rows, command, begun)
    images = folders.images or (folders.output / stem if quick else Path("docs/images") / name)
    for path in bench.draw(rows, data, images) if bench.draw else ():
        print(path, flush=True)


def find_data(bench: Bench, data: Path | None, quick: bool) -> Path:
    """The data folder. Raises ValueError where what a benchmark needs is not there, and not ``quick``."""
    where = "docs/testsets.md says where to get it"
    if bench.data and data is None:
        needed = ", ".join(bench.data)
        raise ValueError(f"expected --data DIR or POLSEP_DATA, a folder with {needed} ({where}), found neither")
    folder = data or Path()
    for path in () if quick else bench.data:
        if not (folder / path).exists():
            raise ValueError(f"expected {folder / path} ({where}), found none")
    return folder
