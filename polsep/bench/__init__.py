"""Measurements of polsep on known truth, real frames and this machine, as rows that land in results/*.jsonl.

Every row says what was measured (`bench`, `case`, `method`, `metric`, `value`, `unit`) and by what (`command`,
`commit`, `machine`). The README's tables are made from these rows by `io.results.fill_tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from polsep.bench.calibration import bench_calibration
from polsep.bench.exactness import bench_exactness
from polsep.bench.frontend import bench_frontend
from polsep.bench.real import bench_real
from polsep.bench.rendering import bench_rendering
from polsep.bench.resources import bench_resources
from polsep.bench.rows import Row, provenance, to_jsonl
from polsep.bench.separation import bench_separation
from polsep.bench.sets import bench_sets
from polsep.bench.truth import SCENE_SEEDS, SCENE_SIZE, render_scene

__all__ = ["BENCHES", "SCENE_SEEDS", "SCENE_SIZE", "Row", "provenance", "render_scene", "to_jsonl"]

BENCHES: dict[str, Callable[[Path], Iterator[Row]]] = {
    "separation": bench_separation,
    "exactness": bench_exactness,
    "real": bench_real,
    "resources": bench_resources,
    "frontend": bench_frontend,
    "rendering": bench_rendering,
    "sets": bench_sets,
    "calibration": bench_calibration,
}
