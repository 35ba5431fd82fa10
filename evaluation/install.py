"""A bare install from a checkout, as a new user has it: its size, what it takes, and the first frames in new processes.

Each checkout is installed by pip into a virtual environment of its own, with the checkout's constraints, on this
machine: `before` is the commit before torch became an extra, `now` the committed state. No compiled code is kept from
elsewhere: the caches of numba lie in a new folder.
"""

from __future__ import annotations

import io
import os
import subprocess
import sys
import tarfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from polsep.bench.rows import Row
from polsep.io.store.rows import read_peak_memory

#: Checkouts by the name of their column.
COMMITS = {"before": "b4601b5", "now": "HEAD"}
#: Methods whose first frame is timed, and how often they are started once they have run.
METHODS, AGAIN = ("analytic", "color-affine", "joint-fast", "joint", "joint-large"), 3
#: Methods that are timed at full resolution, too.
FULL = METHODS[:4]
#: How often the import and the help are timed; the fastest counts. Seconds between two looks at a program.
STARTS, LOOK = 5, 0.005
#: The frame, which comes with the package: 2448x2048 colour samples of 12 bits.
FRAME = "import polsep, pathlib; print(pathlib.Path(polsep.__file__).parent / 'data' / 'still_life.png')"


def bench_install(data: Path | None = None) -> Iterator[Row]:
    """Seconds, MiB and memory of a bare install and of its first frames, of two commits in one run."""
    del data
    for name, commit in COMMITS.items():
        with TemporaryDirectory() as folder:
            yield from _measure(name, commit, Path(folder))


def _measure(name: str, commit: str, folder: Path) -> Iterator[Row]:
    """Rows of one commit, installed and run below a folder."""
    checkout, environment = folder / "checkout", folder / "environment"
    archive = subprocess.run(["git", "archive", commit], capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as tar:
        tar.extractall(checkout, filter="data")
    seconds, _ = run_program(sys.executable, "-m", "venv", str(environment))
    python, program = str(environment / "bin" / "python"), str(environment / "bin" / "polsep")
    install = (python, "-m", "pip", "install", "--quiet", "--constraint", "constraints.txt", ".")
    seconds += run_program(*install, cwd=checkout)[0]
    yield Row("install", "bare install", name, "seconds of pip and venv", seconds, "s")
    size = sum(path.stat().st_size for path in environment.rglob("*") if path.is_file() and not path.is_symlink())
    yield Row("install", "bare install", name, "size on disk", size / 2**20, "MiB")
    settings = {"NUMBA_CACHE_DIR": str(folder / "cache")}
    starts = {"import polsep": (python, "-c", "import polsep"), "polsep --help": (program, "--help")}
    for case, command in starts.items():
        best = min(run_program(*command, settings=settings)[0] for _ in range(STARTS))
        yield Row("install", case, name, f"seconds, best of {STARTS}", best, "s")
    frame = subprocess.run([python, "-c", FRAME], capture_output=True, text=True, check=True).stdout.strip()
    for method, full in [(method, "") for method in METHODS] + [(method, " --full") for method in FULL]:
        case = f"polsep separate --method {method}{full}, 2448x2048 colour"
        words = ("separate", frame, "--white-level", "4095", "--method", method, *full.split())
        separate = (program, *words, "--overwrite", "-o")
        own = settings | {"NUMBA_CACHE_DIR": str(folder / f"cache-{method}{full.strip()}")}
        runs = [run_program(*separate, str(folder / method), settings=own) for _ in range(1 + AGAIN)]
        yield Row("install", case, name, "seconds, never run before", runs[0][0], "s")
        yield Row("install", case, name, f"seconds afterwards, best of {AGAIN}", min(s for s, _ in runs[1:]), "s")
        yield Row("install", case, name, "peak memory afterwards", max(m for _, m in runs[1:]), "MiB")


def run_program(
    *command: str, cwd: Path | None = None, settings: Mapping[str, str] | None = None
) -> tuple[float, float]:
    """Seconds and peak memory [MiB] of a command, which must succeed; as from a shell, without this checkout.

    The peak is asked for while it runs: the one that it leaves behind counts its parent's, too.
    """
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | dict(settings or {})
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=cwd or "/", env=environment, stdout=subprocess.DEVNULL)
    peak = 0.0
    while process.poll() is None:
        with suppress(OSError, IndexError):  # it has just ended
            peak = max(peak, read_peak_memory(process.pid))
        time.sleep(LOOK)
    if process.returncode:
        raise ValueError(f"expected {command[0]} to succeed, found status {process.returncode}: {' '.join(command)}")
    return time.perf_counter() - start, peak
