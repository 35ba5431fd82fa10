"""Rows measured by the scripts of this folder, printed and written to results/."""

from __future__ import annotations

from pathlib import Path

from polsep.bench.rows import Row, write_rows


def record(name: str, rows: list[Row], command: str) -> None:
    """Print rows and write them to ``results/name.jsonl``, with the command that measured them."""
    for row in rows:
        print(f"{row.case:40} {row.method:20} {row.metric:42} {row.value:.4g} {row.unit}")
    write_rows(Path("results"), name, rows, command)
