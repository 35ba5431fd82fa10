"""Threads of this process that work in advance, in order, with little waiting in between; and the memory they use."""

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

#: Items that wait between two threads.
DEPTH = 2
#: Of glibc's mallopt: what is set, and to what. No block can be kept that is larger than 32 MiB.
_KEEPING = ((-8, 1), (-3, 32 * 2**20), (-1, 2**31 - 1))


def keep_memory() -> None:
    """Let this program keep what large arrays free for the next ones, on Linux: the same memory for every frame.

    Otherwise the system gives and takes pages all the time, which it clears first, and a stream's memory grows and
    shrinks by what happens to wait. It is the program's decision, so no function of the library does it.
    """
    if sys.platform == "linux":
        library = ctypes.CDLL(None)
        for option, value in _KEEPING if hasattr(library, "mallopt") else ():
            library.mallopt(option, value)


class _Ahead:
    """What `ahead` shares between its two threads. State: items that wait, and whether anyone still wants them."""

    def __init__(self, items: Iterable[Any], depth: int) -> None:
        self.items, self.ready, self.gone = items, queue.Queue[tuple[bool, Any]](depth), threading.Event()

    def put(self, more: bool, item: Any) -> bool:
        """Wait for room; False when nobody waits for the item any more."""
        while not self.gone.is_set():
            with suppress(queue.Full):
                self.ready.put((more, item), timeout=0.1)
                return True
        return False

    def work(self) -> None:
        """The making thread."""
        try:
            if all(self.put(True, item) for item in self.items):
                self.put(False, None)
        except BaseException as error:
            self.put(False, error)
        finally:
            close: Callable[[], None] = getattr(self.items, "close", lambda: None)
            close()


def ahead(items: Iterable[Item], depth: int = DEPTH) -> Generator[Item, None, None]:
    """The items, made by a thread of their own, up to ``depth`` in advance; what is raised there is raised here.

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
    """What ``function`` makes of each item, in order, by so many threads; one more item than these is in advance.

    What is raised there is raised here. Closing this generator waits for the threads' last items.
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
