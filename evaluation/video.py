"""Frame rates of `polsep video` on recordings against those of the method alone, processor time, and growth of memory.

Rates depend on whatever else the machine does; the processor time of a frame hardly does: two cores that are never idle
make 2 / that many frames a second.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_codes
from polsep.compute.workers import keep_memory
from polsep.io.raw.frames import ReadOptions
from polsep.io.raw.genicam import pack_frame
from polsep.io.results.sequences import SequenceKind
from polsep.io.store.rows import read_memory, write_chunks
from polsep.methods import METHODS
from polsep.sensor.levels import as_mosaic
from polsep.video.recordings import Target, VideoOptions, separate_video

#: Frames of the long recording, and of those that compare formats.
LONG, SHORT = 1000, 60
#: Frames that differ, over and over: the demo capture moved by whole periods of its filters.
DISTINCT = 12
#: Frames after which memory is to stay as it is, and those that the method alone is timed on.
SETTLED, ALONE = 50, 40
#: Frames that do not count for rates: engines are made meanwhile.
BEGINNING = 10
SIZE, PIXELS = (2448, 2048), "BayerRG12p"
#: What is written, behind which filter. The first costs reading and writing alone, the second is the default.
KINDS = {
    "EXR, no filter": (SequenceKind(preview=False), "none"),
    "EXR and a film to watch, temporal filter": (SequenceKind(), "temporal"),
    "EXR with ZIP, temporal filter": (SequenceKind(compression="zip", preview=False), "temporal"),
    "FFVHuff with 16 bits, temporal filter": (SequenceKind("ffvhuff", preview=False), "temporal"),
    "FFV1 with 16 bits, temporal filter": (SequenceKind("ffv1", preview=False), "temporal"),
}
#: What the threads of `polsep video` do, by the beginning of their names. FFV1 has threads of its own besides.
DUTIES = {
    "polsep-worker": "method",
    "polsep-writer": "files",
    "polsep-ahead": "reading, filters, panels",
    "polsep-kernel": "reading, filters, panels",
    "MainThread": "reading, filters, panels",
}


def bench_video(long: int = LONG, short: int = SHORT) -> Iterator[Row]:
    """1000 frames of 2448x2048 by joint-fast, 60 by joint and in other formats: rates, processor time, memory.

    The recording is a headerless BayerRG12p stream in a folder for temporary files; 23 GB of it are needed.
    """
    keep_memory()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.raw"
        frames = _frames()
        write_chunks(path, (pack_frame(image, PIXELS) for image in islice(cycle(frames), long)))
        bare, usual, *others = KINDS
        runs = [("joint-fast", bare, short), ("joint-fast", usual, long), ("joint", bare, short)]
        runs += [("joint", usual, short), *(("joint-fast", kind, short) for kind in others)]
        for method, kind, count in runs:
            alone, own_time = _measure_alone(method, frames)
            case = f"{count} frames, {kind}"
            yield Row("video", case, method, "the method alone", alone, "frames/s")
            yield Row("video/processor", case, method, "the method alone", own_time, "ms")
            yield from _measure(path, Path(folder), (method, kind, count), alone)


def _measure(path: Path, folder: Path, run: tuple[str, str, int], alone: float) -> Iterator[Row]:
    """The rate behind the first frames, its ratio to the method's ``alone``, and memory's spread."""
    method, kind, count = run
    times, memory, used = [], [], []
    written, filter = KINDS[kind]
    options, read = (
        VideoOptions(method, "white", frames=count, filter=filter),
        ReadOptions(size=SIZE, pixel_format=PIXELS),
    )
    output = folder / "out"
    for step in separate_video(path, read, options, Target(output, written)):
        times.append(time.perf_counter())
        used.append(_processor_times())
        if step.done > SETTLED:
            memory.append(read_memory())
    shutil.rmtree(output)
    counted = count - BEGINNING
    rate = counted / (times[-2] - times[-2 - counted])
    case = f"{count} frames, {kind}"
    yield Row("video", case, method, "polsep video", rate, "frames/s")
    yield Row("video", case, method, "of the method alone", 100 * rate / alone, "%")
    # Threads end with their last frame, a few before the last one that is written.
    usual = max(counted - BEGINNING, 1)
    first, last = used[-2 - counted], used[-2 - counted + usual]
    for duty in dict.fromkeys(("polsep video", *DUTIES.values())):
        yield Row("video/processor", case, method, duty, 1000 * (last[duty] - first[duty]) / usual, "ms")
    if count > 2 * SETTLED:
        yield Row(
            "video", case, method, f"memory after frame {SETTLED}, largest - smallest", max(memory) - min(memory), "MiB"
        )


def _processor_times() -> dict[str, float]:
    """Seconds of processor time so far, of the process and of the threads of each of `DUTIES`; these on Linux only."""
    found = dict.fromkeys(DUTIES.values(), 0.0) | {"polsep video": time.process_time()}
    for thread in threading.enumerate():
        duty = next((duty for name, duty in DUTIES.items() if thread.name.startswith(name)), "")
        clock = Path(f"/proc/self/task/{thread.native_id}/schedstat")
        if duty and clock.is_file():
            found[duty] += int(clock.read_text().split()[0]) / 1e9
    return found


def _measure_alone(method: str, frames: list[NDArray[np.uint16]]) -> tuple[float, float]:
    """Frames per second of a method on frames in memory, after a few to warm up, and milliseconds of processor time."""
    mosaics = [as_mosaic(image, white_level=4095.0)[0] for image in frames]
    for mosaic in mosaics[:3]:
        METHODS[method].run(mosaic, (1.0, 1.0, 1.0), False)
    start, used = time.perf_counter(), time.process_time()
    for mosaic in islice(cycle(mosaics), ALONE):
        METHODS[method].run(mosaic, (1.0, 1.0, 1.0), False)
    return ALONE / (time.perf_counter() - start), 1000 * (time.process_time() - used) / ALONE


def _frames() -> list[NDArray[np.uint16]]:
    """The demo capture, shifted by whole periods of its filters."""
    raw = read_demo_codes()
    return [np.roll(raw, (8 * k, 16 * k), (0, 1)) for k in range(DISTINCT)]
