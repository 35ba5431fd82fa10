"""The structure of the code as rows: its size, its rooms and their imports, the way from a call to the mathematics.

A room is a subpackage: a folder or module at the top of the package; an arrow is an import from one to another,
anywhere in a file. Ranks are those of the checkout's tests/test_architecture.py; an arrow is against them unless it
goes to a lower rank. Any checkout can be measured, so numbers before and after a change come from one script.
"""

from __future__ import annotations

import ast
import dataclasses
import io
import os
import statistics
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from polsep.bench.rows import Row, provenance, to_jsonl
from polsep.io.store.atomic import replace_text
from polsep.io.store.rows import read_rows

#: Imports of the package that are timed.
IMPORTS = 5
IMPORT = "import time; start = time.perf_counter(); import polsep; print(time.perf_counter() - start)"
#: Prints how many functions of the package are on the stack when a kernel or a network's ``forward`` is called first.
PATH = """
import sys, numpy as np, polsep
raw = np.random.default_rng(0).integers(100, 3000, (64, 96)).astype(np.uint16)
separate = lambda: polsep.separate(raw, method=sys.argv[1], white_level=4095)
separate()  # loads what is loaded once
def watch(frame, event, _):
    file, name = frame.f_code.co_filename, frame.f_code.co_name
    kernel = "/polsep/" in file and (file.endswith("_kernel.py") or "/polsep/kernels/" in file)
    kernel = kernel and not file.endswith(("threads.py", "compiling.py"))
    if event == "call" and (kernel or name == "forward"):
        sys.setprofile(None)
        names = []
        while frame := frame.f_back:
            names += [frame.f_code.co_name] * ("/polsep/" in frame.f_code.co_filename)
        print(len(names), *reversed(names), name)
sys.setprofile(watch)
separate()
"""


def measure_house(repo: Path, name: str) -> Iterator[Row]:
    """Rows of a checkout."""
    package = repo / "polsep"
    lines = {path: count_lines(path) for path in sorted(package.rglob("*.py"))}
    kernels = [path for path in lines if path.stem.endswith("_kernel") or path.parent == package / "kernels"]
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in lines}
    torch = [path for path in lines if path not in kernels and any(n.startswith("torch") for n in imports(trees[path]))]
    homes = {path: path.relative_to(package).with_suffix("").parts[0] for path in lines}
    rooms = set(homes.values()) - {"__init__"}
    named = {(homes[path], name) for path, tree in trees.items() for name in imports(tree)}
    arrows = {(here, name.split(".")[1]) for here, name in named if name.startswith("polsep.")}
    arrows = {(here, there) for here, there in arrows if here != there and {here, there} <= rooms}
    ranks = read_ranks(repo / "tests" / "test_architecture.py")
    ranked = [(here, there) for here, there in arrows if here in ranks and there in ranks]
    counts = {
        "python files": len(lines),
        "lines": sum(lines.values()),
        "lines of kernels": sum(lines[path] for path in kernels),
        "lines of modules with torch": sum(lines[path] for path in torch),
        "longest file, lines": max(lines.values()),
        "lines of tests": sum(map(count_lines, (repo / "tests").glob("*.py"))),
        "lines of evaluation": sum(map(count_lines, (repo / "evaluation").rglob("*.py"))),
        "rooms": len(rooms),
        "arrows between rooms": len(arrows),
        "arrows against the ranks": sum(ranks[there] >= ranks[here] for here, there in ranked),
        "rooms without a rank": len(rooms - ranks.keys()),
    }
    for metric, count in counts.items():
        yield Row("house", "polsep", name, metric, count, "1")
    yield Row("house", "polsep", name, "wheel", measure_wheel(repo) / 1e6, "MB")
    times = [float(run(repo, sys.executable, "-c", IMPORT)) for _ in range(IMPORTS)]
    yield Row("house", "polsep", name, f"import, median of {IMPORTS}", 1000 * statistics.median(times), "ms")
    for method in ("analytic", "joint"):
        depth, *names = run(repo, sys.executable, "-c", PATH, method).splitlines()[-1].split()
        print(f"{method}: {' > '.join(names)}")
        yield Row("house", "polsep", name, f"functions from separate to the mathematics, {method}", int(depth), "1")


def imports(tree: ast.Module) -> Iterator[str]:
    """The dotted names of everything that a module imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def count_lines(path: Path) -> int:
    """Lines of a file."""
    return len(path.read_text(encoding="utf-8").splitlines())


def read_ranks(path: Path) -> dict[str, int]:
    """The dictionary RANKS of a file of tests."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if [getattr(target, "id", "") for target in targets] == ["RANKS"]:
            return dict(ast.literal_eval(node.value))  # type: ignore[attr-defined]
    raise ValueError(f"expected RANKS in {path}, found none")


def measure_wheel(repo: Path) -> int:
    """Bytes of the package's committed files, deflated in one archive as in a wheel."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in run(repo, "git", "ls-files", "polsep").splitlines():
            if (repo / name).is_file():
                archive.write(repo / name, name)
    return stream.getbuffer().nbytes


def run(repo: Path, *command: str) -> str:
    """The output of a command in a checkout, from which Python imports the package."""
    environment = os.environ | {"PYTHONPATH": str(repo.resolve())}
    return subprocess.run(command, env=environment, cwd=repo, capture_output=True, text=True, check=True).stdout


@click.command()
@click.option("--repo", type=click.Path(exists=True, path_type=Path), default=Path(), metavar="DIR", help="Checkout.")
@click.option("--case", default="after", metavar="NAME", help="Column of its rows; those of others stay.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("results"), help="Of house.jsonl.")
def house(repo: Path, case: str, output: Path) -> None:
    """Measure the structure of a checkout: size, rooms, imports, wheel, the way from a call to the mathematics."""
    rows = list(measure_house(repo, case))
    for row in rows:
        print(f"{row.method:8} {row.metric:56} {row.value:10.4g} {row.unit}")
    path, tables = output / "house.jsonl", dict[str, list[dict[str, Any]]]()
    changed = run(repo, "git", "status", "--porcelain", "--untracked-files=no", "--", "polsep", "evaluation", "tests")
    commit = run(repo, "git", "rev-parse", "--short", "HEAD").strip() + ("+" if changed else "")
    made_by = provenance(f"python -m evaluation house --case {case}") | {"commit": commit}
    for old in read_rows(path) if path.is_file() else ():
        tables.setdefault(old["method"], []).append(old)
    tables[case] = [dataclasses.asdict(row) | made_by for row in rows]
    fields = [field.name for field in dataclasses.fields(Row)]
    text = "".join(
        to_jsonl([Row(**{f: row[f] for f in fields}) for row in table], {key: table[0][key] for key in made_by})
        for _, table in sorted(tables.items(), reverse=True)  # before, after
    )
    replace_text(path, text)
