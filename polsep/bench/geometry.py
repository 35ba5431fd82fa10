"""Shape from six lights: what separation is worth for normals, and what integration makes of true normals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from polsep.bench.rows import Row

#: Objects of the quick version.
QUICK = ("bear", "reading", "cow", "spot", "fish", "PowerDrill")


def bench_geometry(data: Path) -> Iterator[Row]:
    """Normals from six lights by input, and depth from true normals, on statues and scans. Raises ValueError."""
    yield from _measure(data, None)


def bench_geometry_quick(data: Path) -> Iterator[Row]:
    """`bench_geometry` on six objects."""
    yield from _measure(data, QUICK)


def _measure(data: Path, names: Sequence[str] | None) -> Iterator[Row]:
    try:
        from polsep.bench.shape_scores import measure_depth, measure_normals
    except ImportError as error:
        raise ValueError(f"expected the extra bench, found no {error.name}") from None
    if not (data / "diligent_normals").is_dir() or not (data / "meshes").is_dir():
        raise ValueError(f"expected diligent_normals and meshes in {data}, found none")
    yield from measure_depth(data)
    yield from measure_normals(data, names)
