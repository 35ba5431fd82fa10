"""Times one chain, a raw frame to its images, in a process of its own; `polsep.bench.speed` starts this as a program.

    python stopwatch.py SOURCE RAW SECONDS CHAIN

``SOURCE`` is a Python file whose ``frames(chain, raw)`` returns an iterator that ends each step with one more separated
frame, and how many frames are worked on at once. Prints a line once the first frame is there, then the milliseconds
per frame as JSON, and waits until its input ends, so that its memory can be read from outside. Imports next to nothing
itself, and runs in environments without polsep.
"""

from __future__ import annotations

import json
import runpy
import sys
import time
from collections.abc import Iterator

#: Frames that are timed at most, beside the first.
MOST = 40


def time_frames(frames: Iterator[object], at_once: int, seconds: float) -> list[float]:
    """Milliseconds of every frame in about so many seconds; of several at once the mean, after the first ones."""
    times: list[float] = []
    start = time.perf_counter()
    for _ in range(at_once - 1):  # those that began with the first one
        next(frames)
        start = time.perf_counter()
    while not times or (len(times) < MOST and sum(times) < seconds):
        for _ in range(at_once):
            next(frames)
        now = time.perf_counter()
        times.append(now - start)
        start = now
    return [1000 * t for t in times] if at_once == 1 else [1000 * sum(times) / len(times) / at_once]


def main(source: str, raw: str, seconds: str, chain: str) -> None:
    """The program, as above."""
    frames, at_once = runpy.run_path(source)["frames"](chain, raw)
    next(frames)
    print("first", flush=True)
    print(json.dumps(time_frames(frames, at_once, float(seconds))), flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(*sys.argv[1:])
