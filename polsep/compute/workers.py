"""Background threads that prepare items in advance, in order; and the memory that streams reuse."""

from __future__ import annotations

import ctypes
import queue
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Items queued between two threads.
DEPTH = 2
#: Options of glibc's mallopt and their values; it cannot keep blocks of more than 32 MiB.
_KEEPING = ((-8, 1), (-3, 32 * 2**20), (-1, 2**31 - 1))


def keep_memory() -> None:
    """Keep the memory that large arrays free for the next ones, on Linux, so that every frame reuses it.

    Otherwise the system clears new pages for every frame, and a stream's memory varies with its queues. Programs call
    this, never the library.
    """
    if sys.platform == "linux":
        library = ctypes.CDLL(None)
        for option, value in _KEEPING if hasattr(library, "mallopt") else ():
            library.mallopt(option, value)


class _Ahead:
    """State that the two threads of `ahead` share: a queue of items, and a flag once the reader is ``gone``."""

    def __init__(self, items: Iterable[Any], depth: int) -> None:
        self.items, self.ready, self.gone = items, queue.Queue[tuple[bool, Any]](depth), threading.Event()

    def put(self, more: bool, item: Any) -> bool:
        """Queue an item when there is space; False if the reader has gone."""
        while not self.gone.is_set():
            with suppress(queue.Full):
                self.ready.put((more, item), timeout=0.1)
                return True
        return False

    def work(self) -> None:
        """Queue all items; runs in the background thread."""
        try:
            if all(self.put(True, item) for item in self.items):
                self.put(False, None)
        except BaseException as error:
            self.put(False, error)
        finally:
            close: Callable[[], None] = getattr(self.items, "close", lambda: None)
            close()


def ahead(items: Iterable[Item], depth: int = DEPTH) -> Generator[Item, None, None]:
    """Yield the items, made by a background thread up to ``depth`` in advance; its exceptions are raised here.

    Closing this generator ends the thread, and closes ``items`` where that can be closed.
    """
    shared = _Ahead(items, depth)
    thread = threading.Thread(target=shared.work, name="polsep-ahead", daemon=True)
    thread.start()
    try:
        while True:
            more, item = shared.ready.get()
            if more:
                yield item
            elif item is None:
                return
            else:
                raise item
    finally:
        shared.gone.set()
        thread.join()


def map_ahead(function: Callable[[Item], Result], items: Iterable[Item], workers: int) -> Generator[Result, None, None]:
    """Yield ``function`` of each item, in order, computed by ``workers`` threads, at most one item more in advance.

    Exceptions of the threads are raised here. Closing this generator waits for the threads' last items.
    """
    waiting: deque[Future[Result]] = deque()
    with ThreadPoolExecutor(workers, "polsep-worker") as pool:
        try:
            for item in items:
                waiting.append(pool.submit(function, item))
                del item  # it may be large, and is the worker's now
                if len(waiting) > workers:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
