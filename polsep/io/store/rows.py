"""Benchmark rows on disk, arrays that benchmarks hand to other programs, and the README tables made from rows."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.io.store.atomic import replace_text

#: A table in a Markdown file stands between these two comments.
_TABLE = re.compile(
    r"(<!-- table: (?P<name>\w+)(?P<part>/\w+)?( only (?P<metric>\w+))?(?P<turned> by method)? -->\n)"
    r"(?P<before>.*?)(?P<end><!-- end -->)",
    re.DOTALL,
)
#: End of the metric whose value a table shows behind that of the metric itself, as "mean ± standard error".
SPREAD = ", standard error"
#: The last line of a table whose numbers are older than the code.
_OLDER = re.compile(r"Measured at commit (?P<commit>\w+), before the last change of .*\n")
#: The paths measured by a benchmark, by its name, that changed after commits; None: unknown.
FindChanges = Callable[[str, set[str]], tuple[str, ...] | None]


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a results file in JSON lines, each with what made it: the last line above it without a measurement."""
    made_by, rows = dict[str, Any](), list[dict[str, Any]]()
    for line in path.read_text(encoding="utf-8").splitlines():
        entry = json.loads(line)
        if "bench" in entry:
            rows.append(entry | made_by)
        else:
            made_by = entry
    return rows


def move_rows(path: Path, target: Path) -> None:
    """Move a results file to another name, in the place of what is there."""
    path.replace(target)


def remove_rows(path: Path) -> None:
    """Remove a results file, if there is one."""
    path.unlink(missing_ok=True)


def append_line(path: Path, line: str) -> None:
    """Add a line to a log; its other lines stay, and it is whole at any time."""
    before = path.read_text(encoding="utf-8") if path.is_file() else ""
    replace_text(path, f"{before}{line}\n")


def write_array(path: Path, array: NDArray[Any]) -> None:
    """An NPY file that hands an array to another program; makes its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, array, allow_pickle=False)


def read_array(path: Path) -> NDArray[Any]:
    """The array of an NPY file from another program."""
    return np.asarray(np.load(path, allow_pickle=False))


def read_bytes(path: Path) -> bytes:
    """The bytes of a file."""
    return path.read_bytes()


def read_memory() -> float:
    """Resident memory of this process now [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def write_chunks(path: Path, chunks: Iterable[bytes]) -> None:
    """One file of many chunks."""
    with path.open("wb") as stream:
        for chunk in chunks:
            stream.write(chunk)


def read_peak_memory(process: int | str = "self") -> float:
    """Peak resident MiB of this program, or of a running process by its number.

    Outside Linux that of the program that started it counts too, and of other processes nothing is known: 0. Nor of
    this one on Windows.
    """
    status = Path(f"/proc/{process}/status")
    if status.is_file():
        return int(re.findall(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="utf-8"))[0]) / 1024
    if process != "self" or sys.platform == "win32":
        return 0.0
    import resource  # not on Windows

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


def read_cpu_times() -> tuple[float, float]:
    """Seconds that the cores of this process have worked, for any program, and that have passed, summed over cores.

    Both 0 where the system does not tell, outside Linux.
    """
    stat, busy, total = Path("/proc/stat"), 0.0, 0.0
    lines = stat.read_text(encoding="utf-8").splitlines() if stat.is_file() else []
    cores = {f"cpu{core}" for core in os.sched_getaffinity(0)} if lines else set()
    for words in (line.split() for line in lines):
        if words and words[0] in cores:
            ticks = [int(word) / os.sysconf("SC_CLK_TCK") for word in words[1:9]]  # idle and waiting are 3 and 4
            busy, total = busy + sum(ticks[:3]) + sum(ticks[5:]), total + sum(ticks)
    return busy, total


def fill_tables(markdown: str, results: Path, find_changes: FindChanges = lambda *_: None) -> str:
    """The Markdown text with every table between its comments made anew from ``results``/NAME.jsonl.

    ``table: NAME/PART`` selects the rows of bench NAME/PART, ``only PSNR`` those whose metric is PSNR, alone or of an
    output ("diffuse PSNR"), and ``by method`` turns the table. A table without results yet names the command that
    measures them. One that is older than the code says so below; where ``find_changes`` does not know, the line about
    it stays as it was.
    """

    def table(match: re.Match[str]) -> str:
        path, bench = results / f"{match['name']}.jsonl", f"{match['name']}{match['part'] or ''}"
        rows = [row for row in read_rows(path) if row["bench"] == bench] if path.is_file() else []
        if metric := match["metric"]:
            names = (metric, f"diffuse {metric}", f"specular {metric}")
            rows = [row for row in rows if row["metric"].removesuffix(SPREAD) in names]
        if not rows:
            places = "`polsep bench` or `python -m evaluation`"
            return f"{match[1]}Not measured yet: `{match['name']}` of {places}.\n{match['end']}"
        made = method_table(rows) if match["turned"] else markdown_table(rows)
        changed = find_changes(match["name"], {row["commit"] for row in rows})
        older = _OLDER.search(match["before"])
        if changed:
            paths = ", ".join(f"`{path.removeprefix('polsep/')}`" for path in changed)
            made += f"Measured at commit {rows[0]['commit']}, before the last change of {paths}.\n"
        elif changed is None and older and older["commit"] == rows[0]["commit"]:
            made += older[0]
        return match[1] + made + match["end"]

    return _TABLE.sub(table, markdown)


def fill_page(page: Path, results: Path, find_changes: FindChanges) -> None:
    """Replace a Markdown file by what `fill_tables` makes of it."""
    replace_text(page, fill_tables(page.read_text(encoding="utf-8"), results, find_changes))


def markdown_table(rows: list[dict[str, Any]]) -> str:
    """One line per case and metric, one column per method, and what made the numbers.

    Metrics that differ in "diffuse" and "specular" alone share a line, as "diffuse / specular".
    """
    cells = _cells(rows)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = dict.fromkeys((case, metric) for case, metric, _ in cells)
    body = [[case, metric, *(cells.get((case, metric, method), "") for method in methods)] for case, metric in lines]
    return _table([["case", "measured", *methods], *body], rows)


def method_table(rows: list[dict[str, Any]]) -> str:
    """`markdown_table` turned: one line per case and method, one column per metric."""
    cells = _cells(rows)
    metrics = list(dict.fromkeys(metric for _, metric, _ in cells))
    lines = dict.fromkeys((case, method) for case, _, method in cells)
    body = [[case, method, *(cells.get((case, metric, method), "") for metric in metrics)] for case, method in lines]
    return _table([["case", "method", *metrics], *body], rows)


def _cells(rows: list[dict[str, Any]]) -> dict[tuple[str, str, str], str]:
    """Numbers by case, metric with unit, and method."""
    values: dict[tuple[str, str, str], list[str]] = {}
    spreads = {(row["case"], row["method"], row["metric"]): _number(row["value"]) for row in rows}
    for row in rows:
        if row["metric"].endswith(SPREAD):
            continue
        spread = spreads.get((row["case"], row["method"], row["metric"] + SPREAD))
        metric = re.sub(r"^(diffuse|specular) (?=PSNR|flicker|loss|pattern)", "diffuse / specular ", row["metric"])
        measured = f"{metric} [{row['unit']}]" if row["unit"] else metric
        values.setdefault((row["case"], measured, row["method"]), []).append(
            _number(row["value"]) + (f" ± {spread}" if spread else "")
        )
    return {key: " / ".join(texts) for key, texts in values.items()}


def _table(cells: list[list[str]], rows: list[dict[str, Any]]) -> str:
    """Markdown of a head and its lines, and what made the rows."""
    lines = ["| " + " | ".join(texts) + " |" for texts in (cells[0], ["---"] * len(cells[0]), *cells[1:])]
    first = rows[0]
    return "\n".join(lines) + f"\n\n`{first['command']}`, commit {first['commit']}, {first['machine']}\n"


def _number(value: float) -> str:
    """One decimal from 10 on, else three significant digits; whole numbers as they are."""
    value += 0.0  # no minus before zero
    if value == int(value) or abs(value) >= 200:
        return f"{value:.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
