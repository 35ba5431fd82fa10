"""The log of a training: ``log.jsonl``, a line per validation, and the same as curves for TensorBoard.

The first line is of step 0 and says what methods without training reach. A training that was killed has logged more
than its last checkpoint knows of; when it goes on, that is taken back, so no step has two lines.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from polsep.io.store.checkpoints import append_line, read_lines, write_lines
from polsep.io.store.events import EventWriter, add_events, open_events
from polsep.train.validation import REFERENCES

Line = dict[str, Any]
Report = Callable[[Line], None]

#: Steps whose mean loss is a point of TensorBoard's curve.
PLOT_EVERY = 50


class Log:
    """An open log: its lines go to ``path``, to TensorBoard's ``events`` and to ``report``.

    It remembers the losses since the last line, and since when it counts steps.
    """

    def __init__(self, path: Path, events: EventWriter, report: Report) -> None:
        self.path, self.events, self.report = path, events, report
        self.losses: list[float] = []
        self.steps, self.started = 0, time.monotonic()

    def note(self, step: int, loss: float, rate: float) -> None:
        """A step is done; every `PLOT_EVERY` of them make a point of TensorBoard's curves."""
        self.steps += 1
        self.losses.append(loss)
        if len(self.losses) % PLOT_EVERY == 0:
            self._plot(step, PLOT_EVERY, rate)

    def add_scores(self, step: int, rate: float, scores: dict[str, float]) -> None:
        """A line of the mean loss since the last one, the learning rate, scores and speed."""
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
        """A point of loss and rate, the mean of the last ``count`` losses."""
        add_events(self.events, step, {"loss": statistics.fmean(self.losses[-count:]), "rate": rate})


@contextmanager
def open_log(folder: Path, step: int, report: Report, first: Callable[[], dict[str, float]]) -> Iterator[Log]:
    """The log in ``folder`` of a training that goes on after ``step``, 0 for a new one.

    Lines of later steps are dropped. Where there is no line of step 0, ``first`` gives its scores.
    """
    path = folder / "log.jsonl"
    lines = [line for line in read_log(folder) if line["step"] <= step]
    with open_events(folder, step) as events:
        if not lines or lines[0]["step"] != 0:
            scores = first()
            lines.insert(0, {"step": 0} | scores)
            add_events(events, 0, scores)
            report(lines[0])
        write_lines(path, [json.dumps(line) for line in lines])
        yield Log(path, events, report)


def read_log(folder: Path) -> list[Line]:
    """The lines of the log in a training's folder; none where there is no log yet.

    Raises ValueError on a file that is no log.
    """
    path = folder / "log.jsonl"
    try:
        lines = [json.loads(text) for text in read_lines(path)]
        whole = all(isinstance(line["step"], int) for line in lines)
    except (ValueError, TypeError, KeyError):
        whole = False
    if not whole:
        raise ValueError(f"expected the log of a training in {path}, found something else")
    return lines


def curve_of(lines: list[Line]) -> list[list[float]]:
    """Step, diffuse and specular PSNR [dB] of every validation of a log; step 0 is one where it began with weights."""
    names = ("step", "diffuse PSNR", "specular PSNR")
    rows = [[line[name] for name in names] for line in lines if names[1] in line]
    return [[step, round(diffuse, 3), round(specular, 3)] for step, diffuse, specular in rows]


def references_of(lines: list[Line]) -> dict[str, list[float]]:
    """Diffuse and specular PSNR [dB] of the methods without training, by name, from the first line of a log."""
    first = lines[0]
    return {name: [round(first[f"{name} {image} PSNR"], 3) for image in ("diffuse", "specular")] for name in REFERENCES}
