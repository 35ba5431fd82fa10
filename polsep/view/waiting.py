"""The line in which pages wait: one worker separates for all, in turn, and each page has one job at most."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any


class Ticket:
    """A job of a page. State: when it began, whether its result is still wanted, and whether the user cancelled it."""

    def __init__(self, line: Line, key: str, about: object = None) -> None:
        self._line, self.key, self.about = line, key, about
        self.future: Future[Any] = Future()
        self.wanted, self.by_user, self.begun_s = True, False, 0.0

    def cancel(self, by_user: bool = False) -> None:
        """Leave the line. A job that has begun runs to its end, but nobody gets its result."""
        self.by_user = self.by_user or (by_user and self.wanted)
        self.wanted = False
        self.future.cancel()

    def describe(self) -> str:
        """The state in words."""
        if self.begun_s:
            return f"Separating, {time.monotonic() - self.begun_s:.0f} s"
        before = self._line.before(self)
        return f"Waiting, {before} before this one" if before else "Waiting"


class Line:
    """State: tickets that wait or run, in order. Its methods may be called from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tickets: list[Ticket] = []
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="polsep-separate")

    def has(self, key: str, about: object) -> bool:
        """True if a page waits for a job about this."""
        with self._lock:
            return any(t.key == key and t.wanted and t.about == about for t in self._tickets)

    def join(self, key: str, work: Callable[[Ticket], Any], about: object = None) -> Ticket:
        """Wait in the line with a job; another one of the same page is cancelled."""
        self.leave(key)
        ticket = Ticket(self, key, about)
        with self._lock:
            self._tickets.append(ticket)
        self._pool.submit(self._run, ticket, work)
        return ticket

    def leave(self, key: str, by_user: bool = False) -> None:
        """Cancel the job of a page, if there is one."""
        with self._lock:
            found = [ticket for ticket in self._tickets if ticket.key == key]
        for ticket in found:
            ticket.cancel(by_user)

    def before(self, ticket: Ticket) -> int:
        """Number of jobs that come first: those that are wanted, and the one that runs."""
        with self._lock:
            places = self._tickets[: self._tickets.index(ticket)] if ticket in self._tickets else []
            return sum(other.wanted or other.begun_s > 0 for other in places)

    def close(self) -> None:
        """Cancel all jobs, and wait for the one that runs."""
        with self._lock:
            found = list(self._tickets)
        for ticket in found:
            ticket.cancel()
        self._pool.shutdown(wait=True)

    def _run(self, ticket: Ticket, work: Callable[[Ticket], Any]) -> None:
        try:
            if ticket.wanted:
                ticket.begun_s = time.monotonic()
                found = work(ticket)
                if not ticket.future.cancelled():
                    ticket.future.set_result(found)
        except BaseException as error:  # raised again by whoever waits for the result
            if not ticket.future.cancelled():
                ticket.future.set_exception(error)
        finally:
            with self._lock:
                self._tickets.remove(ticket)
