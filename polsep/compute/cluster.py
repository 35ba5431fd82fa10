"""A Ray cluster (extra ``ray``): tasks in other processes, on this machine or many, retried when a worker dies.

Every node must have polsep.
"""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

#: Times that Ray repeats the task of a worker that died.
RETRIES = 5


@contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """Connect Ray to the cluster that RAY_ADDRESS names, or else to ``workers`` processes started on this machine.

    Raises the exceptions of tasks unchanged, and RuntimeError when the cluster itself fails.
    """
    import ray

    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    started = not ray.is_initialized()
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    if started and os.environ.get("RAY_ADDRESS"):
        ray.init(**quiet)
    elif started:
        ray.init(num_cpus=workers, include_dashboard=False, _node_ip_address="127.0.0.1", **quiet)
    try:
        yield ray
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None
    except ray.exceptions.RayError as error:
        raise RuntimeError(f"expected Ray to finish the work, found {type(error).__name__}") from error
    finally:
        if started:
            ray.shutdown()


def map_unordered(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int
) -> Generator[Result, None, None]:
    """Yield results in the order in which tasks end."""
    with cluster(workers) as ray:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(function)
        pending = [task.remote(item) for item in items]
        while pending:
            ready, pending = ray.wait(pending)
            yield from ray.get(ready)


def map_ordered(
    function: Callable[[Item], Result], items: Iterable[Item], workers: int, waiting: int
) -> Generator[Result, None, None]:
    """Yield results in the order of the items, at most ``waiting`` of which are queued or running at once."""
    with cluster(workers) as ray:
        task = ray.remote(num_cpus=1, max_retries=RETRIES)(function)
        pending: deque[Any] = deque()
        for item in items:
            pending.append(task.remote(item))
            if len(pending) >= waiting:
                yield ray.get(pending.popleft())
        while pending:
            yield ray.get(pending.popleft())
