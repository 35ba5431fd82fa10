"""Every method on the selection sets: noisy and clean mosaics to half resolution, and noise-free co-sited samples.

Per set the mean over its scenes of every metric of `polsep.metrics`; rows of "sets/scenes" hold the single scenes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from evaluation.scoring import (
    Protocol,
    capture_clean,
    capture_co_sited,
    capture_noisy,
    find_missing,
    own_entries,
    score_sets,
)
from polsep.bench.rows import Row
from polsep.metrics import require_flip

if TYPE_CHECKING:
    from evaluation.testsets import Recipe


def bench_sets(data: Path) -> Iterator[Row]:
    """Scores of all methods on the sets of `evaluation.testsets`.

    Raises ValueError without the extras render and bench, without the sets' files in ``data``, and on a scene that does
    not come out as recorded.
    """
    sets = load_sets(data)
    protocols = [
        Protocol(name, see, own_entries(True)) for name, see in (("noisy", capture_noisy), ("clean", capture_clean))
    ]
    protocols.append(Protocol("co-sited", capture_co_sited, own_entries(False)))
    yield from score_sets("sets", sets, data, protocols)


def load_sets(data: Path | None = None) -> dict[str, tuple[Recipe, ...]]:
    """`testsets.SETS`. Raises ValueError, before anything is measured, without what scenes and scores need.

    With ``data``, every file of the sets must be in that folder.
    """
    require_flip()
    try:
        from evaluation import testsets
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    absent = find_missing([recipe for recipes in testsets.SETS.values() for recipe in recipes], data) if data else None
    if absent is not None:
        raise ValueError(f"expected {absent} (docs/testsets.md says where to get it), found none")
    return testsets.SETS
