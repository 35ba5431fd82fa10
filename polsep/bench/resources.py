"""Time and memory of `polsep.separate`, each method in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_capture
from polsep.compute.arrays import to_numpy
from polsep.io.store.rows import write_array
from polsep.kernels import warm_up
from polsep.methods import METHODS

CASE = "2448x2048 colour frame"

_RESOURCE_SCRIPT = """
import json, sys, time, warnings
import numpy as np
warnings.simplefilter("ignore")
import polsep
from polsep.io.store.rows import read_peak_memory
from polsep.kernels import get_threads
from polsep.compute.threads import own_threads
from polsep.compute.workers import map_ahead
raw = np.load(sys.argv[2])
polsep.separate
full, times = sys.argv[3] == "full", []
for _ in range(4 if full else 8):
    start = time.perf_counter()
    polsep.separate(raw, method=sys.argv[1], white_level=4095, full=full)
    times.append(time.perf_counter() - start)
peak, cores, rates = read_peak_memory(), get_threads(), []
def separate_alone(frame):
    with own_threads(1):
        return polsep.separate(frame, method=sys.argv[1], white_level=4095)
for _ in range(0 if full else 4):
    start = time.perf_counter()
    for found in map_ahead(separate_alone, [raw] * (4 * cores), cores):
        pass
    rates.append(4 * cores / (time.perf_counter() - start))
print(json.dumps({"first": times[0], "best": min(times), "peak": peak, "rate": max(rates, default=0)}))
"""


def bench_resources() -> Iterator[Row]:
    """Seconds and peak memory of `polsep.separate` on the 2448x2048 demo capture, each method in processes of its own.

    The first call loads compiled kernels, and does not compile them. Memory is that of the whole process. The rate is
    that of many frames, as many at once as there are cores and each on one of them, as `polsep video` takes them; what
    runs in torch (`paper`) shares torch's own threads.
    """
    warm_up()
    raw = to_numpy(read_demo_capture().data).astype(np.uint16)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "raw.npy"
        write_array(path, raw)
        for name in METHODS:
            found, full = (_measure(name, path, resolution) for resolution in ("half", "full"))
            yield Row("resources", CASE, name, "seconds, first call", found["first"], "s")
            yield Row("resources", CASE, name, "seconds, best of 8", found["best"], "s")
            yield Row("resources", CASE, name, "peak memory", found["peak"], "MiB")
            yield Row("resources", CASE, name, "many frames, one per core", found["rate"], "frames/s")
            yield Row("resources", CASE, name, "seconds, full resolution, best of 4", full["best"], "s")
            yield Row("resources", CASE, name, "peak memory, full resolution", full["peak"], "MiB")


def _measure(method: str, path: Path, resolution: str) -> dict[str, float]:
    """Seconds, MiB and frames/s of one method, measured by a process of its own."""
    command = [sys.executable, "-c", _RESOURCE_SCRIPT, method, str(path), resolution]
    found: dict[str, float] = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return found
