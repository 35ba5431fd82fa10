"""A bounded buffer between one producer that must never wait and one consumer that may be late."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

Item = TypeVar("Item")


class Ring(Generic[Item]):
    """The newest ``capacity`` items in order; a full ring drops its oldest item and counts it.

    At any time put = taken + dropped + waiting. A capacity of 1 holds the newest item. Raises ValueError on less.
    """

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"expected a ring of at least 1 frame, found {capacity}")
        self._items: deque[Item] = deque()
        self._capacity, self._dropped, self._closed = capacity, 0, False
        self._changed = threading.Condition()

    def put(self, item: Item) -> None:
        """Append an item without waiting. Raises ValueError if the ring is closed."""
        with self._changed:
            if self._closed:
                raise ValueError("expected an open ring, found it closed")
            if len(self._items) == self._capacity:
                self._items.popleft()
                self._dropped += 1
            self._items.append(item)
            self._changed.notify()

    def take(self, timeout_s: float) -> Item | None:
        """Remove and return the oldest item; None if none comes in that time or the ring is `finished`."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            return self._items.popleft() if self._items else None

    def close(self) -> None:
        """Accept no more items; those in the ring can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def finished(self) -> bool:
        """True if the ring is closed and empty."""
        with self._changed:
            return self._closed and not self._items

    @property
    def waiting(self) -> int:
        """Number of items in the ring."""
        return len(self._items)

    @property
    def dropped(self) -> int:
        """Number of items dropped."""
        return self._dropped
