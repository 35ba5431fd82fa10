"""What users measure: separation, exactness, the front end, time and memory, real frames; rows in results/*.jsonl.

Every row says what was measured (`bench`, `case`, `method`, `metric`, `value`, `unit`) and by what (`command`,
`commit`, `machine`). The tables of README and docs are made from these rows by `io.store.rows.fill_tables`. The
paper's evaluation and the test sets are measured by ``python -m evaluation`` in a checkout of the repository.
"""

from __future__ import annotations

from polsep.bench.exactness import bench_exactness
from polsep.bench.frontend import bench_frontend
from polsep.bench.real import bench_real
from polsep.bench.resources import bench_resources
from polsep.bench.run import Bench
from polsep.bench.separation import bench_separation

BENCHES: dict[str, Bench] = {
    "separation": Bench(bench_separation),
    "exactness": Bench(bench_exactness),
    "real": Bench(bench_real),
    "resources": Bench(bench_resources),
    "frontend": Bench(bench_frontend),
}
