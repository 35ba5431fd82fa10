"""Frames of sequences that are being played: separated ahead by one thread for all pages, kept at screen size.

What is kept is half floats, at most `MAX_BYTES` of all pages together, those that nobody saw for longest going first:
memory does not depend on how long sequences are. A sequence that fits plays from memory from its second turn on.
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

from polsep.view.pictures import Small

#: Bytes of all frames that are kept: 90 colour frames, about.
MAX_BYTES = 512 << 20
#: Frames that are made before they are shown.
AHEAD = 12
#: Seconds for which a page that asks no more is still served.
PATIENCE_S = 2.0

Make = Callable[[int], Small]


@dataclass(frozen=True)
class Packed:
    """A `Small` of half floats: ``images`` are diffuse, specular, dolp and aolp."""

    step: int
    gain: float
    images: tuple[NDArray[np.float16], ...]

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(image.nbytes for image in self.images)


def pack(small: Small) -> Packed:
    """The frame in half floats; the largest of those stands for more."""
    images = (small.diffuse, small.specular, small.dolp, small.aolp)
    largest = np.finfo(np.float16).max
    return Packed(small.step, small.gain, tuple(np.minimum(image, largest).astype(np.float16) for image in images))


def unpack(packed: Packed) -> Small:
    """The frame as pictures are drawn of it."""
    diffuse, specular, dolp, aolp = (image.astype(np.float32) for image in packed.images)
    return Small(packed.step, diffuse, specular, dolp, aolp, None, packed.gain)


class Reel:
    """One sequence under one set of settings: what `Ahead` knows it by. Only its identity counts."""


class Ahead:
    """State: frames that are kept, and who waits for which. Its methods may be called from several threads."""

    def __init__(self, most_bytes: int = MAX_BYTES) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._kept: OrderedDict[tuple[Reel, int], Packed | Exception] = OrderedDict()
        self._asked: dict[Reel, tuple[Sequence[int], Make, float]] = {}
        self._busy: set[Reel] = set()
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="polsep-ahead")

    def frame(self, reel: Reel, place: int) -> Small | None:
        """The frame at a place, None where it is not made yet. Raises what its making raised."""
        with self._lock:
            found = self._kept.get((reel, place))
            if found is not None:
                self._kept.move_to_end((reel, place))
        if isinstance(found, Exception):
            raise found
        return None if found is None else unpack(found)

    def want(self, reel: Reel, places: Sequence[int], make: Make) -> None:
        """Have the frames at these places made, the first of them first, one after the other."""
        with self._lock:
            self._asked[reel] = (places, make, time.monotonic())
        self._next(reel)

    def drop(self, reel: Reel) -> None:
        """Forget a sequence."""
        with self._lock:
            self._asked.pop(reel, None)
            for key in [key for key in self._kept if key[0] is reel]:
                del self._kept[key]

    def close(self) -> None:
        """Make nothing more, and wait for what is being made."""
        with self._lock:
            self._asked.clear()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def __len__(self) -> int:
        """How many frames are kept."""
        return len(self._kept)

    def _next(self, reel: Reel) -> None:
        """Begin the first frame that is asked for and not there, unless one of the same sequence is being made."""
        with self._lock:
            places, make, when = self._asked.get(reel, ((), None, 0.0))
            place = next((p for p in places if (reel, p) not in self._kept), None)
            if make is None or place is None or reel in self._busy or time.monotonic() - when > PATIENCE_S:
                return
            self._busy.add(reel)
            self._pool.submit(self._work, reel, place, make)

    def _work(self, reel: Reel, place: int, make: Make) -> None:
        found: Packed | Exception
        try:
            found = pack(make(place))
        except Exception as error:  # raised where it is asked for
            found = error
        with self._lock:
            self._busy.discard(reel)
            if reel in self._asked:
                self._kept[reel, place] = found
                self._drop_oldest()
        self._next(reel)

    def _drop_oldest(self) -> None:
        sizes = {key: packed.size for key, packed in self._kept.items() if isinstance(packed, Packed)}
        total = sum(sizes.values())
        while total > self._most_bytes and len(self._kept) > 1:
            key, _ = self._kept.popitem(last=False)
            total -= sizes.get(key, 0)
