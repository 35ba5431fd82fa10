"""`polsep view` as a program of its own, for tests that talk to it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def running(folder: Path, *options: str, ending: signal.Signals = signal.SIGTERM) -> Iterator[str]:
    """The address of a viewer whose temporary files lie below ``folder``; ended as a terminal or a system ends it."""
    folder.mkdir(exist_ok=True)
    environment = {**os.environ, "TMPDIR": str(folder), "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "-c", "from polsep.cli import main; main()", "view", *options]
    with tempfile.TemporaryFile("w+") as said:
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT, text=True)
        try:
            yield _address(process, said)
        finally:
            process.send_signal(ending)
            process.wait(120)


def _address(process: subprocess.Popen[str], said) -> str:  # type: ignore[no-untyped-def]
    for _ in range(600):
        said.seek(0)
        lines = [line.strip() for line in said if line.startswith("http")]
        if lines:
            return lines[0].rstrip("/")
        if process.poll() is not None:
            break
        time.sleep(0.2)
    said.seek(0)
    raise AssertionError(f"expected an address, found {said.read()[-2000:]}")
