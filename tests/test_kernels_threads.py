"""Threads that share a frame: every row once, from any number of them, at once, and in forked children."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from polsep.compute.threads import RowRange, _default_threads, run_over_rows
from polsep.kernels import get_threads, separate_analytic_half, separate_color_affine_half, set_threads
from polsep.sensor.camera import Layout

#: Children of a process with threads; Python warns of that since 3.12, and any warning is an error there.
FORK = """
import os, warnings
import numpy as np
from polsep.sensor.camera import Layout
from polsep.kernels import separate_analytic_half, separate_color_affine_half, set_threads

set_threads(2)
raw = np.random.default_rng(0).integers(0, 4000, (600, 40)).astype(np.uint16)
kernels = (separate_analytic_half, separate_color_affine_half)
before = [kernel(raw, Layout(), 0, 4095).diffuse for kernel in kernels]
warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
child = os.fork()
if child == 0:
    after = [kernel(raw, Layout(), 0, 4095).diffuse for kernel in kernels]
    os._exit(0 if all(map(np.array_equal, before, after)) else 3)
raise SystemExit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    """Two threads, and afterwards as many as before."""
    before = get_threads()
    set_threads(2)
    yield
    set_threads(before)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
@pytest.mark.parametrize(("rows", "step"), [(1, 32), (32, 32), (33, 32), (1000, 32), (77, 1)])
def test_every_row_is_given_out_once(count: int, rows: int, step: int) -> None:
    """Ranges start at whole strips and cover the frame without overlap; all results come back."""
    set_threads(count)
    pieces = sorted(run_over_rows(lambda row_range: row_range, rows, step))
    assert all(first % step == 0 for first, _ in pieces)
    assert [row for first, stop in pieces for row in range(first, stop)] == list(range(rows))
    assert run_over_rows(lambda row_range: row_range, 0, step) == []


def test_threads_work_side_by_side() -> None:
    """With n threads, n ranges are in work at once, the caller's among them."""
    for count in (2, 4):
        set_threads(count)
        together = threading.Barrier(count, timeout=30)

        def work(row_range: RowRange, together: threading.Barrier = together) -> int:
            if row_range[0] < together.parties:
                together.wait()
            return threading.get_ident()

        assert threading.get_ident() in run_over_rows(work, 2 * count, 1)


@pytest.mark.parametrize("helper", [False, True], ids=["caller", "helper"])
def test_errors_reach_the_caller(helper: bool) -> None:
    """Whichever thread raises, the caller sees it, no more strips are given out, and the pool goes on working."""
    caller, together = threading.get_ident(), threading.Barrier(2, timeout=30)
    begun = []

    def work(row_range: RowRange) -> None:
        begun.append(row_range)
        if len(begun) <= 2:
            together.wait()
        if (threading.get_ident() != caller) == helper:
            raise ArithmeticError(f"rows {range}")
        time.sleep(0.1)

    with pytest.raises(ArithmeticError, match="rows"):
        run_over_rows(work, 10_000, 1)
    assert len(begun) < 10
    assert sum(stop - first for first, stop in run_over_rows(lambda row_range: row_range, 1000, 1)) == 1000


def test_work_may_share_too() -> None:
    """A helper that shares its own work needs no free thread: nothing waits for itself."""
    set_threads(3)
    inner = run_over_rows(lambda outer: sum(b - a for a, b in run_over_rows(lambda row_range: row_range, 50, 1)), 40, 1)
    assert set(inner) == {50}


def test_two_callers_at_once_are_both_right() -> None:
    """Frames that differ, both kernels, from four threads over and over."""
    rng = np.random.default_rng(1)
    frames = [rng.integers(0, 4000, (400, 60)).astype(np.uint16) for _ in range(4)]
    kernels = (separate_analytic_half, separate_color_affine_half)
    expected = [kernel(raw, Layout(), 0, 4095).specular for raw in frames for kernel in kernels]
    jobs = [(kernel, raw) for raw in frames for kernel in kernels]
    with ThreadPoolExecutor(4) as callers:
        for _ in range(5):
            found = callers.map(lambda job: job[0](job[1], Layout(), 0, 4095).specular, jobs)
            for one, other in zip(found, expected, strict=True):
                np.testing.assert_array_equal(one, other)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no fork")
def test_forked_children_separate_too() -> None:
    """A child of a process that has used the pool gives the same bits, where a dead pool would wait for ever."""
    done = subprocess.run([sys.executable, "-W", "error", "-c", FORK], check=False, timeout=300)
    assert done.returncode == 0


def test_default_is_what_the_process_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment lowers it, as it does for OpenMP and numba; what is no number counts for nothing."""
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cores = _default_threads()
    assert cores >= 1
    for value, expected in (("1", 1), ("1,4", 1), ("100000", cores), ("", cores), ("0", cores), ("all", cores)):
        monkeypatch.setenv("OMP_NUM_THREADS", value)
        assert _default_threads() == expected
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    assert _default_threads() == 1


def test_fewer_than_one_thread_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one thread, found 0"):
        set_threads(0)
    assert get_threads() == 2


def test_importing_polsep_does_not_import_numba() -> None:
    """The package, its command line and the pipeline start without the compiler."""
    code = "import sys, polsep, polsep.cli, polsep.pipeline; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
