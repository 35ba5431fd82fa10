"""Memory of large images that is used again, since the system takes as long to clear new pages as a fast method does.

An array of `empty` is an array like any other. Once nobody holds it or a view of it, its memory waits for the next one
of the same size: frames of a recording go through the same pages, as long as their images are not kept.
"""

from __future__ import annotations

import math
import weakref
from collections import deque
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Kind = TypeVar("Kind", bound=np.generic)

#: Bytes of the smallest array that is worth it, and of all memory that waits.
LEAST, MOST = 2**20, 2**28

#: Memory that waits, by its size; adding and taking one are atomic.
_WAITING: dict[int, deque[NDArray[np.uint8]]] = {}


class _Lease:
    """Memory in use: the base of an array and of all views of it, by whose end NumPy's counting of references ends."""

    def __init__(self, memory: NDArray[np.uint8]) -> None:
        self.__array_interface__ = memory.__array_interface__
        weakref.finalize(self, _let_wait, memory).atexit = False


def _let_wait(memory: NDArray[np.uint8]) -> None:
    """Keep memory for later; where too much waits, give all other back to the system."""
    if memory.nbytes > MOST:
        return
    if sum(size * len(waiting) for size, waiting in tuple(_WAITING.items())) + memory.nbytes > MOST:
        _WAITING.clear()
    _WAITING.setdefault(memory.nbytes, deque()).append(memory)


def empty(shape: tuple[int, ...], dtype: type[Kind]) -> NDArray[Kind]:
    """An array as of `numpy.empty`; a large one is made of memory of its size that waits, where there is some."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size < LEAST:
        return np.empty(shape, dtype)
    try:
        memory = _WAITING[size].pop()
    except LookupError:
        memory = np.empty(size, np.uint8)
    return np.asarray(_Lease(memory)).view(dtype).reshape(shape)


def release() -> None:
    """Give the memory that waits back to the system."""
    _WAITING.clear()
