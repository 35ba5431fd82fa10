"""The same frame gives the same bytes: fresh or warm, for any number of threads, at once, and in other processes."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from polsep.compute.threads import own_threads
from polsep.methods import METHODS
from polsep.pipeline import separate_capture
from polsep.sensor.levels import as_mosaic

#: All but the largest, which is the others' networks in a row, and takes long to begin.
SEVERAL = tuple(name for name in METHODS if name != "joint-large")
ROOT = Path(__file__).resolve().parents[1]
#: Seconds in which a busy machine does anything of this.
PATIENCE = 300

Digests = dict[str, str]


def digest(name: str, full: bool) -> str:
    """Hash of everything that a method makes of one frame."""
    draw = np.random.default_rng(30)
    raw = (3000 * draw.random((4, 6)).repeat(8, 0).repeat(8, 1) + draw.normal(300, 40, (32, 48))).clip(0, 4095)
    raw[:9, :9] = 4095
    found = separate_capture(as_mosaic(raw.astype(np.uint16), white_level=4095.0)[0], name, full=full)
    arrays = [array for array in vars(found).values() if isinstance(array, np.ndarray)]
    data = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(data + repr(found.report).encode()).hexdigest()


def digests(names: tuple[str, ...] = SEVERAL) -> Digests:
    """Of several methods, at both resolutions, in this order."""
    return {f"{name} {full}": digest(name, full) for name in names for full in (False, True)}


@pytest.fixture(scope="module")
def expected() -> Digests:
    """What this process finds."""
    return digests()


def test_a_warm_process_gives_the_same_bytes(expected: Digests) -> None:
    assert digests(SEVERAL[::-1]) == expected


@pytest.mark.parametrize("threads", [1, 8])
def test_threads_give_the_same_bytes(expected: Digests, threads: int) -> None:
    with own_threads(threads):
        assert digests() == expected


def test_calls_at_once_give_the_same_bytes(expected: Digests) -> None:
    found: list[Digests] = []
    callers = [threading.Thread(target=lambda k=k: found.append(digests(SEVERAL[k:] + SEVERAL[:k]))) for k in range(3)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert found == [expected] * 3


def test_fresh_processes_give_the_same_bytes(expected: Digests) -> None:
    """Whatever ran before, also by multiprocessing's "spawn"."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply_async(digests, (SEVERAL[::-1],)).get(PATIENCE) == expected


FORKED = """
import os, signal, sys
sys.path.insert(0, sys.argv[1])
from test_same_bytes import SEVERAL, digest
def in_child(name):
    sys.stdout.flush()
    if os.fork() == 0:
        signal.alarm(int(sys.argv[2]))
        try:
            print(name, digest(name, False))
        except RuntimeError as error:
            print(name, error)
        sys.stdout.flush()
        os._exit(0)
    print("ended", os.wait()[1], flush=True)
in_child("joint-fast")
for name in SEVERAL:
    digest(name, False)
for name in SEVERAL:
    in_child(name)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_forked_children_give_the_same_bytes_or_say_how_to_start_them(expected: Digests) -> None:
    """Networks refuse at once where OpenVINO's threads have stayed in the parent; nothing ever waits for them."""
    program = [sys.executable, "-c", FORKED, str(Path(__file__).parent), str(PATIENCE)]
    done = subprocess.run(program, capture_output=True, text=True, timeout=2 * PATIENCE, cwd=ROOT, check=False)
    before, *after = done.stdout.splitlines()[::2]
    assert done.stdout.splitlines()[1::2] == ["ended 0"] * (1 + len(SEVERAL)), done.stdout + done.stderr
    assert before == f"joint-fast {expected['joint-fast False']}"
    for name, line in zip(SEVERAL, after, strict=True):
        network = METHODS[name].reads_mosaic or name == "paper"
        assert 'get_context("spawn")' in line if network else line == f"{name} {expected[f'{name} False']}"
