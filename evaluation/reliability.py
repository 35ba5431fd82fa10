"""Readers against damaged files: every input gives finite frames or one line that says why not, and nothing else.

``python -m evaluation reliability`` (``make fuzz``) damages small files of every reader (`damage`, `damage_seeds`) and
reads each in a process of its own kind, with limits of time and memory. A fault is an exception that is no refusal, a
message of several lines or of more than 300 characters or without the file's name, a value that is not finite, anything
printed, more than 10 s or 2 GB, or the end of the process. Input K of a reader is the same in every run.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import random
import resource
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import closing, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import av
import click
import numpy as np

from evaluation.damage import damage
from evaluation.damage_seeds import READERS, Files, Reader, seeds_of
from polsep.bench.rows import Row, read_commit, replace_rows
from polsep.cli.app import said_command
from polsep.io.store.errors import MOST
from polsep.io.store.rows import read_peak_memory

#: Limits of one input: seconds, and peak of the whole process [MiB].
SECONDS, MEBIBYTES = 10.0, 2048.0
#: Address space that a process may take on top of what it has after its imports [bytes]: saves the machine.
ROOM = 6 << 30
#: What can become of an input, and what can be wrong about it.
OUTCOMES = ("refused", "accepted")
FAULTS: tuple[str, ...] = ("stray exceptions", "bad messages", "values not finite", "lines of libraries")
FAULTS += ("over time", "over memory", "crashes")
#: Inputs of each reader after which memory is measured anew from the start, as C libraries keep some.
INPUTS = 2000


class Judged(NamedTuple):
    """The fate of one input: an outcome of `OUTCOMES`, or "", its faults, and the message or what was seen."""

    outcome: str
    faults: tuple[str, ...]
    seen: str = ""


def damaged_files(name: str, index: int) -> Files:
    """Damaged files number ``index`` of a reader, the one to read first."""
    draw, seeds = random.Random(f"{name} {index}"), seeds_of(name)
    files, other = dict(draw.choice(seeds)), draw.choice(seeds)
    hurt = draw.choice(list(files))
    files[hurt] = damage(files[hurt], other.get(hurt, next(iter(other.values()))), draw)
    return READERS[name].mend(files) if draw.random() < 0.5 else files


def judge(path: Path, reader: Reader) -> Judged:
    """Read a file, and say whether that went as it should."""
    try:
        finite = all([bool(np.isfinite(array).all()) for array in reader.read(path)])
    except ValueError as error:
        faults = ("over memory",) if _is_of_memory(error) else ()
        line = str(error)
        good = line.isprintable() and len(line) <= MOST and path.name in line
        return Judged("refused", (*faults, *(() if good else ("bad messages",))), line)
    except MemoryError as error:
        return Judged("", ("over memory",), repr(error))
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return Judged("", ("stray exceptions",), f"{error!r:.200} at {Path(where.filename).name}:{where.lineno}")
    return Judged("accepted", () if finite else ("values not finite",))


def _is_of_memory(error: BaseException | None) -> bool:
    """True where running out of memory is behind an error; FFmpeg says so of what it does not even try."""
    while error is not None:
        if isinstance(error, MemoryError) and not isinstance(error, av.error.FFmpegError):
            return True
        error = error.__cause__ or error.__context__
    return False


def write_files(folder: Path, files: Files) -> Path:
    """Write files into a folder; the path of the first."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / name).write_bytes(data)
    return folder / next(iter(files))


class _Watch:
    """Everything printed, in a file, and the peak of memory since the last look."""

    def __init__(self) -> None:
        self._caught = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        for stream in (1, 2):
            os.dup2(self._caught.fileno(), stream)

    def start(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here

    def look(self) -> tuple[str, float]:
        """The printed text, and peak memory [MiB]."""
        sys.stdout.flush()
        sys.stderr.flush()
        self._caught.seek(0)
        text = self._caught.read()
        self._caught.seek(0)
        self._caught.truncate()
        return text.decode(errors="replace"), read_peak_memory()


def _work(name: str, first: int, last: int, results: Connection) -> None:
    """Judge inputs ``first`` to ``last`` of a reader; sends (index, judged) of each. Runs in a process of its own."""
    watch, reader = _Watch(), READERS[name]
    warnings.simplefilter("always")
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    space = pages * resource.getpagesize() + ROOM
    with tempfile.TemporaryDirectory() as scratch:
        for seed in seeds_of(name):  # loads what is loaded once
            judge(write_files(Path(scratch) / "whole", seed), reader)
        resource.setrlimit(resource.RLIMIT_AS, (space, space))
        watch.look()
        results.send((first - 1, None))
        for index in range(first, last):
            path = write_files(Path(scratch) / f"{index % 2}", damaged_files(name, index))
            watch.start()
            start = time.monotonic()
            found = judge(path, reader)
            seconds = time.monotonic() - start
            said, peak = watch.look()
            faults = dict.fromkeys(found.faults)
            faults |= {"lines of libraries": None} if said else {}
            faults |= {"over time": None} if seconds > SECONDS else {}
            faults |= {"over memory": None} if peak > MEBIBYTES else {}
            seen = f"{found.seen} | {said[:200]!r}" if said else found.seen
            results.send((index, Judged(found.outcome, tuple(faults), f"{seen} ({seconds:.1f} s, {peak:.0f} MiB)")))
            for file in path.parent.iterdir():
                file.unlink()


def judge_damaged(name: str, first: int, last: int, seconds: float) -> Iterator[tuple[int, Judged]]:
    """Inputs ``first`` to ``last`` of a reader, judged one after the other, for ``seconds`` after the first start."""
    context, deadline = multiprocessing.get_context("spawn"), math.inf
    while first < last and time.monotonic() < deadline:
        ours, theirs = context.Pipe(duplex=False)
        worker: Any = context.Process(target=_work, args=(name, first, last, theirs), daemon=True)
        worker.start()
        theirs.close()
        with closing(ours):
            patience, started = 300.0, False  # imports and compiling
            while first < last and time.monotonic() < deadline:
                try:
                    ended = not ours.poll(patience)
                    index, found = ours.recv() if not ended else (first, Judged("", ("over time",), "killed"))
                except EOFError:
                    worker.join()
                    if not started:
                        raise RuntimeError(f"expected a process that reads {name}, found that it ended") from None
                    ended, index, found = True, first, Judged("", ("crashes",), f"exit code {worker.exitcode}")
                patience, started = 1.5 * SECONDS, True
                deadline = time.monotonic() + seconds if deadline == math.inf else deadline
                if found is not None:
                    first = index + 1
                    yield index, found
                if ended:
                    break
        worker.kill()
        worker.join()


def count_rows(name: str, counts: Counter[str]) -> Iterator[Row]:
    """Rows of one reader, or of all."""
    for metric in ("inputs", *OUTCOMES, *FAULTS):
        yield Row("reliability", name, "damaged files", metric, counts[metric], "")


@click.command()
@click.option(
    "--inputs", type=click.IntRange(1), default=INPUTS, show_default=True, metavar="N", help="Of each reader."
)
@click.option("--seconds", type=float, default=1200.0, show_default=True, metavar="S", help="For all readers.")
@click.option("--first", type=click.IntRange(0), default=0, show_default=True, metavar="K", help="Number of the first.")
@click.option("--only", type=click.Choice(list(READERS)), help="One reader, without rows.")
@click.option("--keep", type=click.Path(path_type=Path), metavar="DIR", help="Folder for inputs with faults.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("results"), help="Of reliability.jsonl.")
def reliability(**options: Any) -> None:
    """Read damaged files with every reader, and count what goes wrong; exit status 1 where something does."""
    names = [options["only"]] if options["only"] else list(READERS)
    rows, total, first, begun = list[Row](), Counter[str](), options["first"], read_commit()
    for name in names:
        counts: Counter[str] = Counter()
        for index, found in judge_damaged(name, first, first + options["inputs"], options["seconds"] / len(names)):
            counts.update(["inputs", *([found.outcome] if found.outcome else []), *found.faults])
            if found.faults:
                print(f"{name} {index}: {', '.join(found.faults)}: {found.seen}", flush=True)
                if options["keep"]:
                    write_files(options["keep"] / f"{name}_{index}".replace(" ", "_"), damaged_files(name, index))
        print(f"{name:16}", *(f"{counts[metric]} {metric};" for metric in ("inputs", *OUTCOMES, *FAULTS)), flush=True)
        rows += count_rows(name, counts)
        total += counts
    if not options["only"]:
        rows += count_rows("all readers", total)
        replace_rows(options["output"], "reliability", rows, said_command("python -m evaluation"), begun)
    if any(total[fault] for fault in FAULTS):
        raise SystemExit(1)
