"""Where the measurements of this folder go."""

from __future__ import annotations

from pathlib import Path

from polsep.bench.rows import Row, provenance, to_jsonl
from polsep.io.store.atomic import replace_text


def record(name: str, rows: list[Row], command: str) -> None:
    """Print rows and write them to ``results/name.jsonl``, with the command that measured them."""
    for row in rows:
        print(f"{row.case:40} {row.method:20} {row.metric:42} {row.value:.4g} {row.unit}")
    replace_text(Path(f"results/{name}.jsonl"), to_jsonl(rows, provenance(command)))
