"""Benchmarks for users: separation, exactness, the front end, time, memory, GPUs, real frames; rows in results/*.jsonl.

Every row says what was measured (`bench`, `case`, `method`, `metric`, `value`, `unit`) and by what (`command`,
`commit`, `machine`). The tables of README and docs are made from these rows by `io.store.rows.fill_tables`. The
paper's evaluation and the selection sets are measured by ``python -m evaluation`` in a checkout of the repository.
"""

from __future__ import annotations

from polsep.bench.exactness import bench_exactness
from polsep.bench.frontend import bench_frontend, bench_frontend_quick
from polsep.bench.gpu import bench_gpu
from polsep.bench.real import bench_real
from polsep.bench.reality import bench_reality
from polsep.bench.reality_plot import draw_reality
from polsep.bench.run import Bench
from polsep.bench.separation import bench_separation
from polsep.bench.speed import bench_speed, bench_speed_quick

#: Code that formulas consist of, and that every method does.
FORMULAS = ("polsep/physics", "polsep/sensor", "polsep/demosaic", "polsep/light", "polsep/separation")
SEPARATION = (*FORMULAS, "polsep/networks", "polsep/shipped.py", "polsep/methods.py", "polsep/weights")
#: What separates rendered scenes and scores what it separated.
SCENES = (*SEPARATION, "polsep/render", "polsep/metrics.py")

BENCHES: dict[str, Bench] = {
    "separation": Bench(bench_separation, measures=SCENES),
    "exactness": Bench(bench_exactness, measures=("polsep/physics", "polsep/separation")),
    "real": Bench(bench_real, data=("raw",), measures=("polsep/sensor", "polsep/demosaic")),
    "reality": Bench(
        bench_reality,
        bench_reality,
        draw_reality,
        measures=(*SCENES, "polsep/datasets", "polsep/calibrate", "polsep/pipeline.py"),
    ),
    "speed": Bench(bench_speed, bench_speed_quick, measures=(*SEPARATION, "polsep/compute", "polsep/pipeline.py")),
    "gpu": Bench(bench_gpu, measures=(*SEPARATION, "polsep/in_torch.py", "polsep/pipeline.py")),
    "frontend": Bench(
        bench_frontend,
        bench_frontend_quick,
        data=("four_angle",),
        measures=(*FORMULAS, "polsep/render", "polsep/metrics.py"),
    ),
}
