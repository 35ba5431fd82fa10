"""Work in advance: in order, no more of it than asked, and threads end when they are to."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from polsep.compute.threads import get_threads, own_threads
from polsep.compute.workers import ahead, map_ahead

#: How long a thread is waited for.
PATIENCE_S = 30.0


def threads() -> int:
    return sum(thread.name == "polsep-ahead" for thread in threading.enumerate())


def test_items_come_in_order_and_no_more_than_asked_are_made() -> None:
    made: list[int] = []

    def make() -> Iterator[int]:
        for k in range(20):
            made.append(k)
            yield k

    items = ahead(make(), 2)
    for k, item in enumerate(items):
        assert item == k
        assert len(made) <= k + 2 + 2  # the one given, those that wait, and one in hand
    assert threads() == 0


def test_closing_ends_the_threads_behind_it() -> None:
    closed = threading.Event()

    def make() -> Iterator[int]:
        try:
            yield from range(1000)
        finally:
            closed.set()

    items = ahead(ahead(make()))
    assert next(items) == 0
    items.close()
    assert closed.wait(PATIENCE_S)
    deadline = time.monotonic() + PATIENCE_S
    while threads() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threads() == 0


def test_what_is_raised_in_a_thread_is_raised_here() -> None:
    def make() -> Iterator[int]:
        yield 1
        raise ValueError("expected")

    items = ahead(make())
    assert next(items) == 1
    with pytest.raises(ValueError, match="expected"):
        next(items)
    assert threads() == 0


def test_results_come_in_the_order_of_their_items_by_several_threads_at_once() -> None:
    together, seen = threading.Barrier(2), set[int]()

    def work(k: int) -> int:
        seen.add(threading.get_ident())
        if k < 2:
            together.wait(PATIENCE_S)  # passes only if both items are worked on at once
        time.sleep(0.002 * (5 - k % 5))
        return k * k

    assert list(map_ahead(work, range(20), 2)) == [k * k for k in range(20)]
    assert len(seen) == 2


def test_one_item_more_than_there_are_threads_is_taken_in_advance() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for k in range(20):
            taken.append(k)
            yield k

    for k, result in enumerate(map_ahead(lambda item: item, items(), 3)):
        assert result == k and len(taken) <= k + 1 + 3


def test_what_a_worker_raises_is_raised_in_its_place() -> None:
    results = map_ahead(lambda item: 1 // item, [1, 1, 0, 1], 2)
    assert next(results) == next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("polsep-worker")]


def test_closing_lets_no_further_item_begin() -> None:
    begun: list[int] = []
    results = map_ahead(begun.append, range(100), 2)
    next(results)
    results.close()
    assert len(begun) <= 4


def test_a_thread_can_have_a_number_of_threads_of_its_own() -> None:
    found: list[int] = []
    with own_threads(7):
        assert get_threads() == 7
        other = threading.Thread(target=lambda: found.append(get_threads()))
        other.start()
        other.join()
    assert found == [get_threads()] and get_threads() != 7


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_memory_that_is_kept_is_there_for_the_next_array() -> None:
    """Page faults of eight arrays of 16 MB, one after another: those of one; else of nearly all."""
    program = """
import resource, sys
import numpy as np
from polsep.compute.workers import keep_memory
if sys.argv[1] == "kept":
    keep_memory()
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def use(count):
    before = faults()
    for _ in range(count):
        some = [np.full(2**22, 1, np.float32) for _ in range(3)]
        del some
    return faults() - before
use(1)
print(use(8))
"""
    kept, given_back = (
        int(subprocess.run([sys.executable, "-c", program, how], capture_output=True, check=True, text=True).stdout)
        for how in ("kept", "not")
    )
    assert kept < 200 and kept <= given_back + 200
