"""A recording played in a loop for hours: memory, descriptors, threads and speed stay, and so do the bytes.

``python -m evaluation soak`` (``make soak``) sends one recording through the whole chain of ``polsep video``, again and
again in one process: reading, filtering over time, separating, writing single frames and the film to watch. What the
first passes need is taken to be needed; later ones must get along with it.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from evaluation.faults import Contents, read_contents
from polsep.bench.rows import Row, read_commit, replace_rows
from polsep.bench.truth import read_demo_codes
from polsep.compute.workers import keep_memory
from polsep.io.raw.frames import ReadOptions
from polsep.io.store.rows import read_memory, write_array
from polsep.video.recordings import Target, VideoOptions, separate_video

#: Frames of the recording, two parts of a sequence and a half, and their size.
FRAMES, SIZE = 60, (480, 640)
#: Passes before memory is measured first, and how much more later ones may take [MiB].
WARM, GROWTH = 5, 64.0
#: Share of the passes whose median is the speed or the memory at the beginning and at the end.
SHARE = 0.1


class Pass(NamedTuple):
    """One time through a recording: its frames per second, then resident MiB, open descriptors and threads."""

    speed: float
    memory: float
    descriptors: int
    threads: int


def make_recording(path: Path) -> None:
    """A pan over the example frame."""
    raw = read_demo_codes()
    views = [raw[600 + 8 * k : 600 + 8 * k + SIZE[0], 700 + 4 * k :][:, : SIZE[1]] for k in range(FRAMES)]
    write_array(path, np.stack(views))


def play(
    recording: Path, read: ReadOptions, seconds: float, folder: Path, method: str = "auto-fast"
) -> Iterator[tuple[Pass, Contents]]:
    """Play a recording for some time; yields each pass, and the files that it has written."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        start, count = time.monotonic(), 0
        target = Target(folder / "out", overwrite=True)
        for step in separate_video(recording, read, VideoOptions(method), target):
            count = step.done
        speed = count / (time.monotonic() - start)
        found = Pass(speed, read_memory(), len(os.listdir("/proc/self/fd")), threading.active_count())
        yield found, read_contents(folder / "out")


def soak_rows(case: str, passes: Sequence[Pass], others: int, seconds: float) -> Iterator[Row]:
    """Rows of all passes: how long they took, and each quantity at the beginning and at the end."""
    late = passes[min(WARM, len(passes) - 1) :]
    few = max(1, round(SHARE * len(late)))
    values = [("hours", seconds / 3600, "h"), ("passes", len(passes), ""), ("passes with other bytes", others, "")]
    for when, some in (("first", late[:few]), ("last", late[-few:])):
        values += [
            (f"speed, {when}", statistics.median(one.speed for one in some), "frames/s"),
            (f"memory, {when}", statistics.median(one.memory for one in some), "MiB"),
            (f"descriptors, {when}", statistics.median(one.descriptors for one in some), ""),
            (f"threads, {when}", statistics.median(one.threads for one in some), ""),
        ]
    values += [("memory, most", max(one.memory for one in passes), "MiB")]
    yield from (Row("reliability/soak", case, "polsep video in a loop", *value) for value in values)


def find_growth(rows: Sequence[Row]) -> list[str]:
    """Names of what has grown from the beginning to the end, or differs."""
    found = {row.metric: row.value for row in rows}
    grown = {name: found[f"{name}, last"] - found[f"{name}, first"] for name in ("memory", "descriptors", "threads")}
    limits = {"memory": GROWTH, "descriptors": 0, "threads": 0}
    return [name for name in limits if grown[name] > limits[name]] + ["bytes"] * (found["passes with other bytes"] > 0)


@click.command()
@click.option("--minutes", type=click.FloatRange(0), default=480.0, show_default=True, metavar="N", help="Of playing.")
@click.option("--recording", type=click.Path(exists=True, path_type=Path), help="[default: a pan over the example]")
@click.option("--white-level", type=float, default=4095.0, show_default=True, metavar="N", help="Of the recording.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("results"), help="Of reliability.jsonl.")
def soak(minutes: float, recording: Path | None, white_level: float, output: Path) -> None:
    """Play a recording in a loop and watch what it takes; exit status 1 where that grows, or the bytes change.

    Rows are written every ten minutes, so that a run that is stopped has some.
    """
    keep_memory()
    begun, given = read_commit(), recording

    def say(seconds: float) -> str:  # what was played, which may be less than was asked for
        played = f" --recording {given.name}" if given else ""
        levels = "" if white_level == 4095 else f" --white-level {white_level:g}"
        return f"python -m evaluation soak --minutes {seconds / 60:.0f}{played}{levels}"

    passes, others, start, written = list[Pass](), 0, time.monotonic(), 0.0
    with tempfile.TemporaryDirectory() as scratch:
        if recording is None:
            recording = Path(scratch) / "pan.npy"
            make_recording(recording)
        usual: Contents | None = None
        read = ReadOptions(white_level=white_level)
        for found, files in play(recording, read, 60 * minutes, Path(scratch)):
            usual = usual or files
            passes, others = [*passes, found], others + (files != usual)
            elapsed = time.monotonic() - start
            if elapsed - written >= 600:
                written = elapsed
                _save(list(soak_rows(recording.name, passes, others, elapsed)), say(elapsed), output, begun)
    played = time.monotonic() - start
    rows = _save(list(soak_rows(recording.name, passes, others, played)), say(played), output, begun)
    if grown := find_growth(rows):
        print(f"grown or changed: {', '.join(grown)}")
        raise SystemExit(1)


def _save(rows: list[Row], command: str, output: Path, begun: str) -> list[Row]:
    """Print and write the rows so far."""
    print("; ".join(f"{row.metric} {row.value:.4g} {row.unit}".strip() for row in rows), flush=True)
    replace_rows(output, "reliability", rows, command, begun)
    return rows
