"""Measurements of polsep on known truth, real frames and this machine, as rows that land in results/*.jsonl.

Every row says what was measured (`bench`, `case`, `method`, `metric`, `value`, `unit`) and by what (`command`,
`commit`, `machine`). The README's tables are made from these rows by `io.results.fill_tables`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from polsep.bench.ablations import bench_ablations
from polsep.bench.appearance import bench_gallery, bench_gallery_real, draw_gallery, draw_gallery_real
from polsep.bench.calibration import bench_calibration
from polsep.bench.dynamic import bench_dynamic, bench_dynamic_quick
from polsep.bench.exactness import bench_exactness
from polsep.bench.frontend import bench_frontend
from polsep.bench.gallery import draw_paper
from polsep.bench.geometry import bench_geometry, bench_geometry_quick, draw_geometry
from polsep.bench.joint import bench_joint
from polsep.bench.material import bench_material, bench_material_quick
from polsep.bench.material_gallery import draw_material
from polsep.bench.paper import bench_paper, bench_paper_quick
from polsep.bench.real import bench_real
from polsep.bench.rendering import bench_rendering
from polsep.bench.resources import bench_resources
from polsep.bench.rows import Row, provenance, to_jsonl
from polsep.bench.separation import bench_separation
from polsep.bench.sets import bench_sets
from polsep.bench.truth import SCENE_SEEDS, SCENE_SIZE, render_scene
from polsep.bench.video import bench_video, bench_video_quick
from polsep.bench.viewing import bench_view

__all__ = ["BENCHES", "SCENE_SEEDS", "SCENE_SIZE", "Bench", "Row", "provenance", "render_scene", "to_jsonl"]

Measure = Callable[[Path], Iterator[Row]]


@dataclass(frozen=True)
class Bench:
    """What can be measured: ``run`` gives rows from a data folder, ``quick`` those of a part of it, in minutes.

    ``draw`` writes pictures, from rows and the data folder into a folder, and gives their paths. None: there are none.
    """

    run: Measure
    quick: Measure | None = None
    draw: Callable[[list[Row], Path, Path], Iterator[Path]] | None = None


BENCHES: dict[str, Bench] = {
    "separation": Bench(bench_separation),
    "exactness": Bench(bench_exactness),
    "real": Bench(bench_real),
    "resources": Bench(bench_resources),
    "frontend": Bench(bench_frontend),
    "rendering": Bench(bench_rendering),
    "sets": Bench(bench_sets),
    "joint": Bench(bench_joint),
    "ablations": Bench(bench_ablations),
    "dynamic": Bench(bench_dynamic, bench_dynamic_quick),
    "calibration": Bench(bench_calibration),
    "material": Bench(bench_material, bench_material_quick, draw_material),
    "video": Bench(bench_video, bench_video_quick),
    "geometry": Bench(bench_geometry, bench_geometry_quick, draw_geometry),
    "view": Bench(bench_view),
    "gallery": Bench(bench_gallery, draw=draw_gallery),
    "gallery_real": Bench(bench_gallery_real, draw=draw_gallery_real),
    "paper": Bench(bench_paper, bench_paper_quick, draw_paper),
}
