"""Progress of a command: a bar on a terminal, elsewhere a line every half minute, both on stderr."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from polsep.cli.summary import summary

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

    from polsep.video.recordings import Progress as Step

#: Seconds between lines where there is no terminal.
EVERY_S = 30.0


class Progress:
    """State of a job: what it is doing, and how many of how many steps are done; ``total`` None: unknown."""

    def __init__(self, text: str, total: int | None, bar: Bar | None) -> None:
        self._text, self._total, self._done, self._before = text, total, 0, 0
        self._start_s, self._bar = time.monotonic(), bar
        self.known = False  # whether the first state was reported
        self._task = None if bar is None else bar.add_task(text, total=total, speed="")

    def update(self, done: int, total: int | None = None, text: str | None = None) -> None:
        """Say how many steps are done; a new total or text where given."""
        self.known = True
        self._done, self._total = done, self._total if total is None else total
        self._text = self._text if text is None else text
        if self._bar is not None and self._task is not None:
            speed = self._bar.tasks[0].speed
            shown = f"{speed:.2g}/s" if speed and self._total else ""
            self._bar.update(self._task, completed=done, total=self._total, description=self._text, speed=shown)

    def resume(self, done: int) -> None:
        """Say how many steps an earlier run has done, which say nothing about the speed."""
        self._before = done
        if self._bar is not None and self._task is not None:
            self._bar.reset(self._task, total=self._total, completed=done)
        self.update(done)

    def line(self) -> str:
        """The state in words: ``separating: 120 of 1000, 30 s, 3 min left``."""
        seconds = time.monotonic() - self._start_s
        parts = [f"{seconds:.0f} s"]
        if self._total is not None and self._total > 1:
            parts.insert(0, f"{self._done} of {self._total}")
            if self._done > self._before:
                left = seconds * (self._total - self._done) / (self._done - self._before)
                parts.append(f"{left / 60:.0f} min left" if left > 90 else f"{left:.0f} s left")
        return f"{self._text}: {', '.join(parts)}"


@contextmanager
def show_progress(text: str, total: int | None = None) -> Iterator[Progress]:
    """Show the progress of the block, which says by `Progress.update` how far it is; nothing of it stays."""
    if sys.stderr.isatty():
        with _bar() as bar:
            yield Progress(text, total, bar)
        return
    progress, ended = Progress(text, total, None), threading.Event()

    def speak() -> None:
        while not ended.wait(EVERY_S):
            print(f"polsep: {progress.line()}", file=sys.stderr, flush=True)

    threading.Thread(target=speak, daemon=True).start()
    try:
        yield progress
    finally:
        ended.set()


def report_step(step: Step, progress: Progress) -> bool:
    """Show and print the progress of a sequence; True if a frame is damaged."""
    if not progress.known and step.done and not step.written:
        print(f"polsep: resuming at frame {step.done} of {step.count}", file=sys.stderr, flush=True)
        progress.resume(step.done)
    progress.update(step.done, step.count)
    if step.warning is not None:
        print(f"polsep: {step.warning}", file=sys.stderr, flush=True)
    for path in step.written:
        print(path)
    if step.report is not None:
        good = step.report["frames"]
        print(f"  {good} frame{'s' * (good != 1)}: {summary(step.report)}")
    return step.damaged


def _bar() -> Bar:
    """A bar on stderr with a field ``speed``; what is printed meanwhile stays on its own stream."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),
    )
