"""Results rows and the README tables made from them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from polsep.bench.rows import Row, to_jsonl
from polsep.io.store.rows import fill_tables, markdown_table, read_rows

ROOT = Path(__file__).resolve().parents[1]


def test_readme_tables_are_the_results() -> None:
    """Every table of the README is what the committed results make of it."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert readme.count("<!-- table: ") >= 5
    assert fill_tables(readme, ROOT / "results") == readme


@pytest.mark.parametrize("path", sorted((ROOT / "results").glob("*.jsonl")), ids=lambda p: p.stem)
def test_rows_say_what_made_them(path: Path) -> None:
    """Every committed number has a command, a commit and a machine, from a tree without changes."""
    rows = read_rows(path)
    assert rows
    for row in rows:
        assert row["command"] and row["machine"]
        assert row["commit"] not in ("", "unknown") and not row["commit"].endswith("+")


def test_rows_round_trip(tmp_path: Path) -> None:
    """Rows written as JSON lines read back with six significant digits."""
    path = tmp_path / "a.jsonl"
    path.write_text(to_jsonl([Row("a", "case", "m", "PSNR", 1 / 3, "dB")], {"command": "c"}), encoding="utf-8")
    assert read_rows(path)[0]["value"] == 0.333333
    assert json.loads(path.read_text(encoding="utf-8"))["command"] == "c"


def test_tables_join_diffuse_and_specular() -> None:
    """The PSNR of both outputs shares a cell, and methods are columns."""
    made = {"command": "c", "commit": "d", "machine": "e"}
    rows = [
        {"case": "x", "method": m, "metric": f"{o} PSNR", "unit": "dB", "value": v, **made}
        for m, o, v in (("p", "diffuse", 30.0), ("p", "specular", 31.25), ("q", "diffuse", 1.0), ("q", "specular", 0.5))
    ]
    assert "| x | diffuse / specular PSNR [dB] | 30 / 31.2 | 1 / 0.5 |" in markdown_table(rows)
