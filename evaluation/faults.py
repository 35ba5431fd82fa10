"""Killed programs and full disks: nothing is lost, every failure is one line, and the next run gives the same bytes.

``python -m evaluation faults`` (``make faults``) runs each of `WORKS` undisturbed, then

* kills it (SIGKILL) at random moments, alone or with its workers, and starts it again until it ends;
* gives it a disk of every size from 0 to what it needs, in steps of 4 KiB (`full_disk`), and then enough.

A file under a final name has the bytes of the undisturbed run, or those from before, at any time.
"""

from __future__ import annotations

import functools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from polsep.bench.rows import Row, read_commit, replace_rows
from polsep.cli.app import said_command
from polsep.io.store.rows import read_bytes, write_array

#: Files by their names below a folder.
Contents = dict[str, bytes]

#: The program, and a training of seconds, as commands.
POLSEP = (sys.executable, "-c", "from polsep.cli import main; main()")
TRAIN = (sys.executable, "-c", "from evaluation.faults import train_shortly; train_shortly()")
#: Seconds after which a program hangs.
PATIENCE = 300.0
#: Most kills of one run.
IN_A_ROW = 4
#: What is counted of kills, and which of all counts are faults.
KILL_METRICS = ("kills", "runs", "partial files", "lost files", "failed resumptions", "other bytes")
FAULTS = ("partial files", "lost files", "failed resumptions", "other bytes", "crashes", "not one line")


class Work(NamedTuple):
    """A ``command`` that writes into the folder out; ``again``: arguments that it takes from the second time on.

    ``before``: makes files in out; ``kept``: patterns of names of files that always have the final bytes.
    """

    command: tuple[str, ...]
    again: tuple[str, ...] = ()
    before: Callable[[Path], None] | None = None
    kept: tuple[str, ...] = ("*",)


class Ended(NamedTuple):
    """The end of a program: its status, minus the signal that ended it, and its lines on stderr."""

    status: int
    lines: list[str]


class Undisturbed(NamedTuple):
    """The files before and after a run without faults, its lines on stderr, and its seconds."""

    before: Contents
    after: Contents
    warnings: list[str]
    seconds: float


def make_inputs(folder: Path) -> None:
    """The inputs of all works: a film of two parts, single frames, frames of a lens cap and of white paper."""
    draw = np.random.default_rng(30)
    scene = (400 + 3000 * draw.random((60, 96))).repeat(2, 0).repeat(2, 1)
    film = np.stack([scene[k : k + 48, 2 * k : 2 * k + 64] for k in range(0, 60, 2)]).astype(np.uint16)
    write_array(folder / "film.npy", film)
    write_array(folder / "short.npy", film[:8])
    for k in range(4):
        write_array(folder / f"shot{k}.npy", scene[:96, k : k + 128].astype(np.uint16))
    pixels, noise = draw.normal(0, 4, (64, 96)), draw.normal(0, 4, (12, 64, 96))
    write_array(folder / "dark.npy", (240 + pixels + noise).round().astype(np.uint16))
    write_array(folder / "white.npy", ((2000 + noise) * (1 + pixels / 200)).round().astype(np.uint16))


def measure_dark(out: Path) -> None:
    """A calibration with one section, in the folder ``out``. Raises RuntimeError with how it `Ended` otherwise."""
    out.mkdir(exist_ok=True)
    ended = run_program(
        (*POLSEP, "calibrate", "dark", "../dark.npy", "--white-level", "4095", "-o", "out/rig.json"), out
    )
    if ended.status != 0:
        raise RuntimeError(ended)


def train_shortly() -> None:
    """Train a tiny network for some steps into out, with a checkpoint at every second one and few validation views."""
    from polsep.networks.sizes import Size
    from polsep.train import command, loop, validation
    from polsep.train.stream import StreamOptions

    few = functools.cache(functools.partial(validation.validation_batches, count=1))
    for module in (command, loop):
        setattr(module, "validation_batches", few)  # noqa: B010 - not theirs to export
    options = command.TrainOptions("paper", size=Size(4, 1, 1))
    schedule = loop.Schedule(10, warm_up=2, checkpoint_every=2, validate_every=5, precision="32-true")
    run = command.plan_run(loop.Run(Path("out"), schedule=schedule, workers=0), options)
    run = replace(run, stream=StreamOptions(batch=2, crop=32, size=32, samples=1, pool=2, uses=2))
    command.train_weights(options, run, lambda line: None)


FILM = (*POLSEP, "video", "../film.npy", "-o", "out", "--white-level", "4095", "--light-color", "white")
_SHOTS = (*POLSEP, "separate", *(f"../shot{k}.npy" for k in range(4)), "-o", "out", "--white-level", "4095")
_SET = ("--shapes", "2", "--views", "3", "--size", "64", "--samples", "1")
WORKS = {
    "separate": Work((*_SHOTS, "--method", "color-affine"), ("--overwrite",)),
    "video": Work((*FILM, "--method", "joint-fast")),
    "render": Work((*POLSEP, "render", *_SET, "-o", "out", "--workers", "1")),
    "train": Work(TRAIN, kept=("*.safetensors",)),
    "calibrate": Work((*POLSEP, "calibrate", "flat", "../white.npy", "-o", "out/rig.json"), before=measure_dark),
}
#: Kills of each work in a hundred.
SHARES = {"separate": 25, "video": 30, "render": 15, "train": 15, "calibrate": 15}


def ours() -> dict[str, str]:
    """The environment in which programs import what this one imports."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}


def run_program(command: Sequence[str], out: Path) -> Ended:
    """Run a command whose folder out is ``out``."""
    done = subprocess.run(
        command, cwd=out.parent, env=ours(), capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    return Ended(done.returncode, done.stderr.splitlines())


def read_contents(out: Path, patterns: Sequence[str] = ("*",)) -> Contents:
    """Files under names that do not begin with a point, of ``patterns``."""
    names = [path.relative_to(out) for pattern in patterns for path in out.rglob(pattern) if path.is_file()]
    visible = (name for name in names if not any(part[0] == "." for part in name.parts))
    return {str(name): _in_order(name, read_bytes(out / name)) for name in visible}


def _in_order(name: Path, data: bytes) -> bytes:
    """Weights with their header in alphabetical order: safetensors writes it in another one each time."""
    end = 8 + int.from_bytes(data[:8], "little")
    if name.suffix != ".safetensors" or end > len(data):
        return data
    return json.dumps(json.loads(data[8:end]), sort_keys=True).encode() + data[end:]


def run_undisturbed(work: Work, out: Path) -> Undisturbed:
    """Run a work into ``out``. Raises RuntimeError where that fails."""
    if work.before is not None:
        work.before(out)
    before, start = read_contents(out, work.kept), time.monotonic()
    ended = run_program(work.command, out)
    if ended.status != 0:
        raise RuntimeError(f"expected a run without faults, found status {ended.status}: {ended.lines[-1:]}")
    return Undisturbed(before, read_contents(out, work.kept), ended.lines, time.monotonic() - start)


def count_partial(found: Contents, usual: Undisturbed) -> int:
    """Files whose bytes are neither those from before nor those of the undisturbed run."""
    return sum(data not in (usual.before.get(name), usual.after.get(name)) for name, data in found.items())


def kill(work: Work, kills: int, folder: Path, seed: int = 0) -> Counter[str]:
    """Kill runs of a work at random moments, ``kills`` times; counts of `KILL_METRICS`."""
    draw, counts = random.Random(seed), Counter[str]()
    (folder / "undisturbed").mkdir()
    usual = run_undisturbed(work, folder / "undisturbed" / "out")
    seconds = usual.seconds
    while counts["kills"] < kills:
        counts["runs"] += 1
        out = folder / f"run{counts['runs']}" / "out"
        out.parent.mkdir()
        if work.before is not None:
            work.before(out)
        for begun in range(min(IN_A_ROW, kills - counts["kills"])):
            there = set(read_contents(out, work.kept))
            command = (*work.command, *(work.again if begun else ()))
            if not _is_killed(command, out, seconds * draw.uniform(0.2, 1), draw):
                seconds *= 0.8  # a run is shorter than thought
                break
            found = read_contents(out, work.kept)
            counts["kills"] += 1
            counts["partial files"] += count_partial(found, usual)
            counts["lost files"] += len(there - set(found))
        ended = run_program((*work.command, *work.again), out)
        finished = bool(ended.lines) and "--overwrite replaces it" in ended.lines[-1]  # killed behind the last file
        counts["failed resumptions"] += ended.status != 0 and not finished
        counts["other bytes"] += read_contents(out, work.kept) != usual.after
        if ended.status != 0 and not finished:
            print(ended, flush=True)
        shutil.rmtree(out.parent)
    return counts


def _is_killed(command: Sequence[str], out: Path, seconds: float, draw: random.Random) -> bool:
    """Start a program and kill it after some time, in half of the cases with its workers; False if it has ended."""
    null = subprocess.DEVNULL
    with subprocess.Popen(
        command, cwd=out.parent, env=ours(), start_new_session=True, stdout=null, stderr=null
    ) as program:
        try:
            program.wait(seconds)
        except subprocess.TimeoutExpired:
            draw.choice((os.kill, os.killpg))(program.pid, signal.SIGKILL)
        program.wait()
        _await_group(program.pid)
    return program.returncode == -signal.SIGKILL


def _await_group(group: int) -> None:
    """Wait until no process of a group is left. Raises RuntimeError after half a minute."""
    for _ in range(300):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    raise RuntimeError("expected workers that end with their program, found some after 30 s")


@click.command()
@click.option("--kills", type=click.IntRange(0), default=100, show_default=True, metavar="N", help="Of all works.")
@click.option("--every", type=click.IntRange(1), default=1, show_default=True, metavar="N", help="Every Nth disk size.")
@click.option("--seed", type=int, default=0, show_default=True, metavar="N", help="Of the moments of the kills.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("results"), help="Of reliability.jsonl.")
def faults(kills: int, every: int, seed: int, output: Path) -> None:
    """Kill programs and fill disks, and count what is lost; exit status 1 where something is.

    Disks are small file systems in memory; mounting them needs root or user namespaces.
    """
    from evaluation.full_disk import DISK_METRICS, DISK_WORKS, fill_elsewhere

    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(2) as pool:
        folder, rows, faulty, commit = Path(scratch), list[Row](), 0, read_commit()

        def kill_work(name: str) -> Counter[str]:
            make_inputs(folder / name)
            return kill(WORKS[name], round(kills * SHARES[name] / 100), folder / name, seed)

        def fill_disks(name: str) -> Counter[str]:
            return fill_elsewhere(name, folder / "disks" / name, every)

        for bench, works, measure, metrics in (
            ("kills", WORKS, kill_work, KILL_METRICS),
            ("disk", DISK_WORKS, fill_disks, DISK_METRICS),
        ):
            total: Counter[str] = Counter()
            for name, counts in zip(works, pool.map(measure, works), strict=True):
                print(f"{bench:6} {name:20}", *(f"{counts[metric]} {metric};" for metric in metrics), flush=True)
                rows += count_rows(bench, name, counts, metrics)
                total += counts
            rows += count_rows(bench, "all", total, metrics)
            faulty += sum(total[metric] for metric in metrics if metric in FAULTS)
    replace_rows(output, "reliability", rows, said_command("python -m evaluation"), commit)
    if faulty:
        raise SystemExit(1)


def count_rows(bench: str, case: str, counts: Counter[str], metrics: Sequence[str]) -> Iterator[Row]:
    """A row for each count."""
    for metric in metrics:
        yield Row(f"reliability/{bench}", case, "faults", metric, counts[metric], "")
