"""Results rows and the README tables made from them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from polsep.bench.rows import Row, to_jsonl
from polsep.io.store.rows import fill_tables, markdown_table, read_rows

ROOT = Path(__file__).resolve().parents[1]


def test_readme_has_one_table_of_quality_and_one_of_speed() -> None:
    """The README is read in two minutes: at most 150 lines and two tables."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 150
    assert re.findall("<!-- table: (.*) -->", readme) == ["sets/noisy only PSNR", "resources"]
    assert readme.count("\n| --- |") == 2


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_tables_are_the_results(page: Path) -> None:
    """Every table of the README and of docs is what the committed results make of it, and has results."""
    text = page.read_text(encoding="utf-8")
    assert fill_tables(text, ROOT / "results") == text
    assert "Not measured yet" not in text


def test_every_result_has_a_table() -> None:
    """Every committed file of results is shown on some page, and every table has its end."""
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    shown = set(re.findall(r"<!-- table: (\w+)", text))
    assert shown >= {path.stem for path in (ROOT / "results").glob("*.jsonl")} - {"blender", "materialx"}
    assert text.count("<!-- table: ") == text.count("<!-- end -->") >= 30


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


def test_tables_of_one_metric_leave_the_others_out(tmp_path: Path) -> None:
    """``only PSNR`` selects the PSNR of each output, and no metric whose name merely contains it."""
    row = Row("a/b", "case", "m", "diffuse PSNR", 30.0, "dB")
    rows = [row, replace(row, metric="specular PSNR", value=31.0), replace(row, metric="diffuse PSNR, worst")]
    (tmp_path / "a.jsonl").write_text(to_jsonl(rows, {"command": "c", "commit": "d", "machine": "e"}), encoding="utf-8")
    filled = fill_tables("<!-- table: a/b only PSNR -->\n<!-- end -->", tmp_path)
    assert "| case | diffuse / specular PSNR [dB] | 30 / 31 |" in filled
    assert "worst" not in filled
