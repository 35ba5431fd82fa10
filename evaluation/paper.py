"""The paper's whole evaluation as rows: Tables 2 and 3, the costs of every method, and the sweep of Fig. 5.

Rows of "paper/baselines" and "paper/ablations" make Tables 3 and 2 of Dave et al. 2022, "paper/metrics" holds all
metrics, "paper/scenes" the single scenes. Protocols: "mosaic", noisy 12-bit frames to half resolution, and "co-sited",
the paper's own, whose tables end in "_co_sited". Pictures are made by `evaluation.gallery`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from evaluation.calibration import Sweep, measure_sweep, snapshot_entries
from evaluation.figures import require_matplotlib
from evaluation.ladder import CO_SITED, MOSAIC, ladder_entries, measure_costs, rung_of
from evaluation.scoring import Protocol, capture_co_sited, capture_noisy, score_sets
from evaluation.sets import load_sets
from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_capture
from polsep.io.store.rows import SPREAD

#: Rungs that leave something out of the paper's method (Table 2); all others are baselines (Table 3).
ABLATIONS = ("shared", "signed", "no-angle", "stokes")
#: Metrics of Tables 2 and 3, with their standard errors.
TABLED = ("diffuse PSNR", "specular PSNR")


@dataclass(frozen=True)
class Extent:
    """Extent of a measurement: the first scenes of each set (None: all), the sweep, and how often a frame is timed."""

    scenes: dict[str, int | None] = field(default_factory=dict)
    sweep: Sweep = field(default_factory=Sweep)
    runs: int = 3


#: A few minutes at most, on a part of the same scenes, views and errors.
QUICK = Extent({"objects": 2, "statues": 1, "photographs": 1}, Sweep(2, (0, 20)), 1)


def bench_paper(data: Path) -> Iterator[Row]:
    """The paper's Tables 2 and 3 and its sweep (Fig. 5), on all selection sets, with all rungs that have weights.

    Raises ValueError without the extra bench, and without the sets' files in ``data``.
    """
    load_sets(data)
    yield from measure_paper(data, Extent())


def measure_paper(data: Path, extent: Extent) -> Iterator[Row]:
    """Rows of costs, tables and sweep, in this order, to the ``extent`` asked for, of those sets that ``data`` has."""
    require_matplotlib()
    sets = {name: recipes[: extent.scenes.get(name)] for name, recipes in load_sets().items()}
    mosaic, co_sited = ladder_entries(MOSAIC), ladder_entries(CO_SITED)
    protocols = [Protocol(MOSAIC, capture_noisy, mosaic), Protocol(CO_SITED, capture_co_sited, co_sited)]
    demo = read_demo_capture()
    yield from measure_costs(mosaic, replace(demo, data=torch.as_tensor(demo.data)), extent.runs)
    for row in score_sets("paper", sets, data, protocols):
        yield from table_rows(row)
    yield from measure_sweep("paper/calibration", extent.sweep, snapshot_entries(co_sited))


def table_rows(row: Row) -> Iterator[Row]:
    """A row of `scoring.score_sets` as rows of the tables that it belongs to."""
    if row.bench == "paper/scenes":
        yield row
        return
    suffix = "_co_sited" if row.bench == f"paper/{CO_SITED}" else ""
    if row.metric.removesuffix(SPREAD) in TABLED:
        ablation = rung_of(row.method) in ABLATIONS
        if ablation or rung_of(row.method) == "paper" or row.method == "analytic":
            yield replace(row, bench=f"paper/ablations{suffix}")
        if not ablation:
            yield replace(row, bench=f"paper/baselines{suffix}")
    yield replace(row, bench=f"paper/metrics{suffix}")
