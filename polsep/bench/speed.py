"""Time and memory of whole chains, a raw frame to diffuse and specular, each in a process of its own.

All see the demo capture, 2448x2048, 12 bits in uint16, colour, and have two cores. `chains` names polsep's, and
evaluation/peers/frontend_peers.py those of other packages. Each runs in several processes, `stopwatch`, in rounds in
which all take turns, every other one backwards, so that no chain has the machine at a better time than another; one
that took long is not started again.

* start to image: from the start of the process to its first frame, everything imported, loaded and compiled: median;
* frame, least and median: of the frames after it, in all processes; many frames are the mean of a process;
* peak memory: of the whole process, read from outside.

Ratios compare chains of one resolution, by their least times. A chain must at least read the raw frame and write both
images in float32. ``roofline`` is that traffic at the bandwidth at which two threads copy 512 MiB (bytes read plus
bytes written), the floor for any chain that leaves the cache; its share says how near a chain comes.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from polsep.bench import chains, stopwatch
from polsep.bench.history import ROOT
from polsep.bench.peers import SCRIPT, TWO_THREADS, find_peers, run_json
from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_codes
from polsep.io.store.rows import read_cpu_times, read_peak_memory, write_array
from polsep.kernels import warm_up

#: Rounds, the seconds of frames in each process, and those after which a chain is not started again.
ROUNDS, SECONDS, ENOUGH = 3, 2.0, 20.0
#: The same of ``--quick``.
QUICK_ROUNDS, QUICK_SECONDS = 1, 0.5
#: Other programs may use so much of the cores before a round; it waits up to so many seconds for that.
IDLE, PATIENCE = 0.1, 30
#: Packages that chains are compared with, by the beginning of their names.
REFERENCES = {"polanalyser": "polanalyser", "OpenCV": "OpenCV + NumPy"}
RESOLUTIONS = ("half", "full")


@dataclass
class Times:
    """Measurements of a chain: seconds to the first image, milliseconds of frames, MiB; ``spent`` seconds in all."""

    first: list[float] = field(default_factory=list)
    frames: list[float] = field(default_factory=list)
    peaks: list[float] = field(default_factory=list)
    spent: float = 0.0


@dataclass(frozen=True)
class Program:
    """A Python and the file in which `stopwatch` finds chains."""

    python: str
    source: Path


def bench_speed() -> Iterator[Row]:
    """Time and memory of every method and stream, half and full resolution, beside other packages and the roofline.

    POLSEP_PEERS names the python of the packages (evaluation/peers). Ten minutes on an idle machine of two cores.
    Raises ValueError without the peers.
    """
    peers = Program(find_peers(), SCRIPT)
    names = run_json(peers.python, str(SCRIPT), "chains")
    own = [name for resolution in RESOLUTIONS for name in chains.chain_names(resolution)]
    yield from measure(dict.fromkeys(own, _own()) | dict.fromkeys(names, peers), ROUNDS, SECONDS)


def bench_speed_quick() -> Iterator[Row]:
    """`bench_speed` of polsep alone at half resolution, in one round."""
    yield from measure(dict.fromkeys(chains.chain_names("half"), _own()), QUICK_ROUNDS, QUICK_SECONDS)


def _own() -> Program:
    return Program(sys.executable, Path(chains.__file__))


def measure(programs: dict[str, Program], rounds: int, seconds: float) -> Iterator[Row]:
    """Rows of chains by name, "RESOLUTION: TITLE"."""
    warm_up()  # compiled kernels are kept on disk, so that no process has to make them
    raw, found = read_demo_codes(), {name: Times() for name in programs}
    busy, bandwidths = [], []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "raw.npy"
        write_array(path, raw)
        for turn in range(rounds):
            busy.append(wait_until_idle())
            bandwidths.append(measure_copy_bandwidth())
            for name in list(programs)[:: -1 if turn % 2 else 1]:
                if found[name].spent < ENOUGH:
                    run_chain(programs[name], name, (path, seconds), found[name])
    yield Row("speed/machine", "before each round", "other programs", "use of the cores, most", max(busy), "%")
    yield Row(
        "speed/machine", "before each round", "two threads", "bandwidth of copying, most", max(bandwidths) / 1e9, "GB/s"
    )
    for resolution in RESOLUTIONS:
        times = {name.partition(": ")[2]: t for name, t in found.items() if name.startswith(f"{resolution}: ")}
        pixels = raw.size if resolution == "full" else raw.size // 4
        floor = 1000 * (raw.nbytes + 2 * 3 * 4 * pixels) / max(bandwidths)
        yield from (chain_rows(resolution, times, floor) if times else ())
        yield from method_rows(resolution, times)


def chain_rows(resolution: str, times: dict[str, Times], floor: float) -> Iterator[Row]:
    """Rows of all chains of a resolution; ``floor``: milliseconds that none can beat."""
    case, references = f"{resolution} resolution", _references(times)
    yield Row("speed/chains", case, "roofline", "frame, least", floor, "ms")
    yield Row("speed/chains", case, "roofline", "rate", 1000 / floor, "frames/s")
    for name, t in times.items():
        least = min(t.frames)
        yield Row("speed/chains", case, name, "frame, least", least, "ms")
        yield Row("speed/chains", case, name, "frame, median", statistics.median(t.frames), "ms")
        yield Row("speed/chains", case, name, "rate", 1000 / least, "frames/s")
        for label, reference in references.items():
            yield Row("speed/chains", case, name, f"times as fast as {label}", min(reference.frames) / least, "x")
        yield Row("speed/chains", case, name, "roofline reached", 100 * floor / least, "%")
        yield Row("speed/chains", case, name, "start to image", statistics.median(t.first), "s")
        yield Row("speed/chains", case, name, "peak memory", max(t.peaks), "MiB")


def method_rows(resolution: str, times: dict[str, Times]) -> Iterator[Row]:
    """Rows of the table in the README: every method, and the packages that it is compared with."""
    case = f"{resolution} resolution"
    one = {name.removesuffix(", one frame"): t for name, t in times.items() if name.endswith(", one frame")}
    for name, t in (one | _references(times)).items():
        yield Row("speed", case, name, "process start to first image", statistics.median(t.first), "s")
        yield Row("speed", case, name, "one frame, least", min(t.frames) / 1000, "s")
        yield Row("speed", case, name, "one frame, median", statistics.median(t.frames) / 1000, "s")
        if many := times.get(f"{name}, many frames"):
            yield Row("speed", case, name, "many frames, one per core", 1000 / min(many.frames), "frames/s")
        yield Row("speed", case, name, "peak memory, one frame", max(t.peaks), "MiB")


def _references(times: dict[str, Times]) -> dict[str, Times]:
    """The chains of `REFERENCES` among others, by their labels."""
    return {label: t for start, label in REFERENCES.items() for name, t in times.items() if name.startswith(start)}


def run_chain(program: Program, chain: str, task: tuple[Path, float], times: Times) -> None:
    """Add a process of a chain to its ``times``; ``task``: the raw file, and seconds of frames.

    Raises ValueError with the last line that it said when it fails.
    """
    paths = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))  # the polsep that is running
    environment = os.environ | TWO_THREADS | ({"PYTHONPATH": paths} if program.python == sys.executable else {})
    arguments = (stopwatch.__file__, str(program.source), *map(str, task), chain)
    start = time.perf_counter()
    with subprocess.Popen(
        (program.python, "-P", *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        first = time.perf_counter() - start
        frames = process.stdout.readline()
        peak = read_peak_memory(process.pid) if frames else 0.0
        _, said = process.communicate()
    if process.returncode:
        raise ValueError(f"{chain} failed: {(said.strip().splitlines() or ['no message'])[-1]}")
    times.first.append(first)
    times.frames.extend(json.loads(frames))
    times.peaks.append(peak)
    times.spent += time.perf_counter() - start


def wait_until_idle() -> float:
    """Percent of the cores that all programs use, once it is little, or after `PATIENCE` looks of a second each."""
    share = 1.0
    for _ in range(PATIENCE):
        before = read_cpu_times()
        time.sleep(1)
        busy, passed = (now - then for now, then in zip(read_cpu_times(), before, strict=True))
        share = busy / max(passed, 1e-9)
        if share <= IDLE:
            return 100 * share
    print(f"machine busy: other programs use {share:.0%} of the cores", file=sys.stderr, flush=True)
    return 100 * share


def measure_copy_bandwidth() -> float:
    """Bytes/s, read and written, at which two threads copy 512 MiB: best of 5."""
    source = np.ones((2, 2**26), np.float32)
    target, times = np.zeros_like(source), []
    with ThreadPoolExecutor(2) as pool:
        for _ in range(5):
            start = time.perf_counter()
            list(pool.map(np.copyto, target, source))
            times.append(time.perf_counter() - start)
    return 2 * source.nbytes / min(times)
