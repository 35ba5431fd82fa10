"""The log of a training: ``log.jsonl``, one line per validation, and the same as curves for TensorBoard.

The first line, of step 0, holds the scores of methods without training. An interrupted training may have logged steps
after its last checkpoint; when it resumes, these lines are removed, so that no step has two lines.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from polsep.io.store.checkpoints import append_line, read_lines, write_lines
from polsep.io.store.events import EventWriter, add_events, open_events
from polsep.train.validation import REFERENCES

Line = dict[str, Any]
Report = Callable[[Line], None]

#: Steps averaged in one point of TensorBoard's curve of the loss.
PLOT_EVERY = 50


class Log:
    """An open log that writes to ``path``, to TensorBoard's ``events`` and to ``report``.

    State: the losses since the last line, the number of steps and their start time.
    """

    def __init__(self, path: Path, events: EventWriter, report: Report) -> None:
        self.path, self.events, self.report = path, events, report
        self.losses: list[float] = []
        self.steps, self.started = 0, time.monotonic()

    def note(self, step: int, loss: float, rate: float) -> None:
        """Record a step; every `PLOT_EVERY` steps make a point of TensorBoard's curves."""
        self.steps += 1
        self.losses.append(loss)
        if len(self.losses) % PLOT_EVERY == 0:
            self._plot(step, PLOT_EVERY, rate)

    def add_scores(self, step: int, rate: float, scores: dict[str, float]) -> None:
        """Write a line: mean loss since the last line, learning rate, scores and speed."""
        rest = len(self.losses) % PLOT_EVERY
        if rest:
            self._plot(step, rest, rate)
        speed = {"steps_per_second": self.steps / (time.monotonic() - self.started)}
        line = {"step": step, "loss": statistics.fmean(self.losses), "rate": rate}
        self.losses.clear()
        append_line(self.path, json.dumps(line | scores | speed))
        add_events(self.events, step, scores | speed)
        self.report(line | scores | speed)

    def _plot(self, step: int, count: int, rate: float) -> None:
        """Write a point of the rate and of the mean of the last ``count`` losses."""
        add_events(self.events, step, {"loss": statistics.fmean(self.losses[-count:]), "rate": rate})


@contextmanager
def open_log(
    folder: Path, step: int, report: Report, first: Callable[[], dict[str, float]], losses: Sequence[float] = ()
) -> Iterator[Log]:
    """Open the log in ``folder`` of a training that resumes after ``step``, 0 for a new one.

    Lines of later steps are removed. If there is no line of step 0, ``first`` returns its scores. ``losses``: of the
    steps since the last line that is left.
    """
    path = folder / "log.jsonl"
    # Without a checkpoint, lines that are there are of another run, which was stopped.
    lines = [line for line in read_log(folder) if line["step"] <= step] if step else []
    with open_events(folder, step) as events:
        if not lines or lines[0]["step"] != 0:
            scores = first()
            lines.insert(0, {"step": 0} | scores)
            add_events(events, 0, scores)
            report(lines[0])
        write_lines(path, [json.dumps(line) for line in lines])
        log = Log(path, events, report)
        log.losses += losses
        yield log


def read_log(folder: Path) -> list[Line]:
    """Return the lines of the log in a training's folder, none without a log. Raises ValueError on another file."""
    path = folder / "log.jsonl"
    try:
        lines = [json.loads(text) for text in read_lines(path)]
        valid = all(isinstance(line["step"], int) for line in lines)
    except (ValueError, TypeError, KeyError):
        valid = False
    if not valid:
        raise ValueError(f"expected the log of a training in {path}, found something else")
    return lines


def curve_of(lines: list[Line]) -> list[list[float]]:
    """Return step, diffuse and specular PSNR [dB] of every validation of a log; of step 0 only after ``--start``."""
    names = ("step", "diffuse PSNR", "specular PSNR")
    rows = [[line[name] for name in names] for line in lines if names[1] in line]
    return [[step, round(diffuse, 3), round(specular, 3)] for step, diffuse, specular in rows]


def references_of(lines: list[Line]) -> dict[str, list[float]]:
    """Return diffuse and specular PSNR [dB] of the methods without training, by name, from a log's first line."""
    first = lines[0]
    return {name: [round(first[f"{name} {image} PSNR"], 3) for image in ("diffuse", "specular")] for name in REFERENCES}
