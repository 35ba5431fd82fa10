"""Playback of sequences: one thread for all pages separates frames in advance and caches them at screen size.

The cache holds half floats, at most `MAX_BYTES` for all pages, and drops the least recently used frames: memory does
not depend on the length of sequences. A sequence that fits plays from memory from its second round on.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polsep.view.pictures import Pixels, Small

#: Bytes of all cached frames: about 90 colour frames, 70 with expected errors.
MAX_BYTES = 512 << 20
#: Number of frames separated in advance.
AHEAD = 12
#: Seconds without a request after which no more frames are separated for a page.
PATIENCE_S = 2.0

Make = Callable[[int], Small]


@dataclass(frozen=True)
class Packed:
    """A `Small` of half floats: ``images`` are diffuse, specular, dolp and aolp, then the error if there is one."""

    step: int
    gain: float
    images: tuple[NDArray[np.float16], ...]
    flags: Pixels | None

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(image.nbytes for image in self.images) + (0 if self.flags is None else self.flags.nbytes)


def pack(small: Small) -> Packed:
    """The frame in half floats, limited to their largest value."""
    images = (small.diffuse, small.specular, small.dolp, small.aolp, *(() if small.error is None else (small.error,)))
    largest = np.finfo(np.float16).max
    halves = tuple(np.minimum(image, largest).astype(np.float16) for image in images)
    return Packed(small.step, small.gain, halves, small.flags)


def unpack(packed: Packed) -> Small:
    """The frame in float32, for drawing."""
    diffuse, specular, dolp, aolp, *errors = (image.astype(np.float32) for image in packed.images)
    error = errors[0] if errors else None
    return Small(packed.step, diffuse, specular, dolp, aolp, error, packed.gain, None, packed.flags)


class Reel:
    """Key of one sequence with one set of settings; compared by identity."""


class Prefetcher:
    """State: cached frames, and the requests of sequences. Its methods may be called from several threads."""

    def __init__(self, most_bytes: int = MAX_BYTES) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[Reel, int], Packed | Exception] = OrderedDict()
        self._requests: dict[Reel, tuple[Sequence[int], Make, float]] = {}
        self._busy: set[Reel] = set()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="polsep-ahead")

    def frame(self, reel: Reel, place: int) -> Small | None:
        """The frame at a place, None if it is not ready. Raises the error of its separation."""
        with self._lock:
            found = self._kept.get((reel, place))
            if found is not None:
                self._kept.move_to_end((reel, place))
        if isinstance(found, Exception):
            raise found
        return None if found is None else unpack(found)

    def want(self, reel: Reel, places: Sequence[int], make: Make) -> None:
        """Request the frames at these places, in this order."""
        with self._lock:
            self._requests[reel] = (places, make, time.monotonic())
        self._next(reel)

    def drop(self, reel: Reel) -> None:
        """Drop a sequence and its frames."""
        with self._lock:
            self._requests.pop(reel, None)
            for key in [key for key in self._kept if key[0] is reel]:
                del self._kept[key]

    def close(self) -> None:
        """Drop all requests, and wait for the frame in progress."""
        with self._lock:
            self._requests.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __len__(self) -> int:
        """Number of cached frames."""
        return len(self._kept)

    def _next(self, reel: Reel) -> None:
        """Start the first requested frame that is missing, unless one of the same sequence is in progress."""
        with self._lock:
            places, make, when = self._requests.get(reel, ((), None, 0.0))
            place = next((p for p in places if (reel, p) not in self._kept), None)
            if make is None or place is None or reel in self._busy or time.monotonic() - when > PATIENCE_S:
                return
            self._busy.add(reel)
            self._pool.submit(self._work, reel, place, make)

    def _work(self, reel: Reel, place: int, make: Make) -> None:
        found: Packed | Exception
        try:
            found = pack(make(place))
        except Exception as error:  # raised again by `frame`
            found = error
        with self._lock:
            self._busy.discard(reel)
            if reel in self._requests:
                self._kept[reel, place] = found
                self._drop_oldest()
        self._next(reel)

    def _drop_oldest(self) -> None:
        sizes = {key: packed.size for key, packed in self._kept.items() if isinstance(packed, Packed)}
        total = sum(sizes.values())
        while total > self._most_bytes and len(self._kept) > 1:
            key, _ = self._kept.popitem(last=False)
            total -= sizes.get(key, 0)
