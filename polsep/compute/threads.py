"""Threads that divide the rows of a frame between them.

Kernels run without the interpreter's lock, so Python's own threads are enough. Rows are handed out strip by strip, and
the calling thread works too. Unlike numba's parallel loops, one busy core does not delay the others, forked children
and several calling threads work, and compilation takes less time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

Result = TypeVar("Result")

#: First row and the row behind the last one.
RowRange = tuple[int, int]


def _default_threads() -> int:
    """Number of cores that this process may use, or fewer if one of two environment variables limits them."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        limit = os.environ.get(name, "").split(",")[0].strip()  # OpenMP takes a list, one number per nesting level
        if limit.isdecimal() and int(limit) > 0:
            count = min(count, int(limit))
    return count


class _State:
    """State of the module: the number of threads, and a pool of ``helpers`` beside the callers, made on first use."""

    threads: int = _default_threads()
    lock = threading.Lock()
    pool: ThreadPoolExecutor | None = None
    helpers: int = 0


class _Own(threading.local):
    """Number of ``threads`` that `own_threads` set for one thread."""

    threads: int | None = None


_OWN = _Own()


def _forget_pool() -> None:
    """Start a forked child afresh: it has none of the pool's threads, one of which may have held the lock."""
    _State.lock, _State.pool, _State.helpers = threading.Lock(), None, 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def get_threads() -> int:
    """Return the number of threads that a kernel uses, the calling one included.

    The default is the number of cores that this process may use (its affinity mask, not the machine), but no more than
    ``NUMBA_NUM_THREADS`` and ``OMP_NUM_THREADS`` where these are set when kernels are imported. Quotas of CPU time, as
    containers have them, are not taken into account.
    """
    return _OWN.threads or _State.threads


def set_threads(count: int) -> None:
    """Let every kernel called from now on use ``count`` threads, in the whole process; results do not depend on it.

    Raises ValueError below 1.
    """
    if count < 1:
        raise ValueError(f"expected at least one thread, found {count}")
    _State.threads = int(count)


@contextmanager
def own_threads(count: int) -> Iterator[None]:
    """Inside, kernels that this thread calls use ``count`` threads, whatever `set_threads` says; not nested."""
    _OWN.threads = count
    try:
        yield
    finally:
        _OWN.threads = None


def _start_helpers(work: Callable[[], None], count: int) -> list[Future[None]]:
    """Call ``work`` in ``count`` threads of the pool; a pool that is too small is replaced and ends when idle."""
    if count < 1:
        return []
    with _State.lock:
        if _State.pool is None or _State.helpers < count:
            if _State.pool is not None:
                _State.pool.shutdown(wait=False)
            _State.pool, _State.helpers = ThreadPoolExecutor(count, "polsep-kernel"), count
        return [_State.pool.submit(work) for _ in range(count)]


def run_over_rows(work: Callable[[RowRange], Result], rows: int, step: int) -> list[Result]:
    """Call ``work`` on consecutive ranges of ``range(rows)`` in `get_threads` threads; results in no fixed order.

    A range starts at a multiple of ``step``, the rows of a strip. Returns when all rows are done. Several threads may
    call this at once, and so may ``work``: a caller never waits for helpers that have not started. After an exception
    no more rows are handed out; it is raised here.
    """
    strips = -(-rows // step)
    threads = max(1, min(get_threads(), strips))
    lock, taken = threading.Lock(), 0
    results: list[Result] = []

    def take() -> RowRange:
        """Return the next strips: a part of the rest, so that calls are few and all threads end together."""
        nonlocal taken
        with lock:
            first, left = taken, strips - taken
            taken += left if threads == 1 else -(-left // (2 * threads))
            return first, taken

    def work_off() -> None:
        nonlocal taken
        try:
            while (taking := take())[0] < strips:
                results.append(work((taking[0] * step, min(taking[1] * step, rows))))
        except BaseException:
            with lock:
                taken = strips
            raise

    helpers = _start_helpers(work_off, threads - 1)
    try:
        work_off()
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        wait(begun)
    for helper in begun:
        helper.result()
    return results
