"""Time and memory of `polsep.separate`, each method in its own process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from polsep.bench.rows import Row
from polsep.pipeline import METHODS

_RESOURCE_SCRIPT = """
import json, resource, sys, time, warnings
import numpy as np
warnings.simplefilter("ignore")
import polsep
from polsep.io.frames import ReadOptions, read_frames
from pathlib import Path
frame = next(read_frames(Path(polsep.__file__).parent / "data" / "still_life.png", ReadOptions(white_level=4095.0)))
raw = frame.data.data.numpy().astype(np.uint16)
times = []
for _ in range(3):
    start = time.perf_counter()
    polsep.separate(raw, method=sys.argv[1], white_level=4095)
    times.append(time.perf_counter() - start)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"first": times[0], "best": min(times), "peak": peak}))
"""


def bench_resources(_data: Path | None = None) -> Iterator[Row]:
    """Seconds and peak memory of `polsep.separate` on the 2448x2048 demo capture, each method in its own process."""
    for name in METHODS:
        command = [sys.executable, "-c", _RESOURCE_SCRIPT, name]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        yield Row("resources", "2448x2048 colour frame", name, "seconds, first call", found["first"], "s")
        yield Row("resources", "2448x2048 colour frame", name, "seconds, best of 3", found["best"], "s")
        yield Row("resources", "2448x2048 colour frame", name, "peak memory", found["peak"], "MiB")
