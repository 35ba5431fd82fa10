"""Benchmark rows on disk, and the README tables that are made from them."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

#: A table in a Markdown file stands between these two comments.
_TABLE = re.compile(r"(<!-- table: (?P<name>\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def write_text(path: Path, text: str) -> None:
    """Replace a text file as a whole: written beside it, then renamed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.tmp")
    beside.write_text(text, encoding="utf-8")
    os.replace(beside, path)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a results file in JSON lines."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def fill_tables(markdown: str, results: Path) -> str:
    """The Markdown text with every table between its comments made anew from ``results``/NAME.jsonl."""

    def table(match: re.Match[str]) -> str:
        rows = read_rows(results / f"{match['name']}.jsonl")
        return match[1] + markdown_table(rows) + match[3]

    return _TABLE.sub(table, markdown)


def fill_readme(readme: Path, results: Path) -> None:
    """`fill_tables` on a file, replaced as a whole."""
    write_text(readme, fill_tables(readme.read_text(encoding="utf-8"), results))


def markdown_table(rows: list[dict[str, Any]]) -> str:
    """One line per case and metric, one column per method, and what made the numbers.

    Metrics that differ in "diffuse" and "specular" alone share a line, as "diffuse / specular".
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    cells: dict[tuple[str, str], dict[str, list[str]]] = {}
    for row in rows:
        metric = re.sub(r"^(diffuse|specular) (?=PSNR)", "diffuse / specular ", row["metric"])
        line = cells.setdefault((row["case"], f"{metric} [{row['unit']}]"), {})
        line.setdefault(row["method"], []).append(_number(row["value"]))
    head = ["case", "measured", *methods]
    body = [[case, metric, *(" / ".join(line.get(m, [])) for m in methods)] for (case, metric), line in cells.items()]
    lines = ["| " + " | ".join(texts) + " |" for texts in (head, ["---"] * len(head), *body)]
    first = rows[0]
    return "\n".join(lines) + f"\n\n`{first['command']}`, commit {first['commit']}, {first['machine']}\n"


def _number(value: float) -> str:
    """One decimal from 10 on, else three significant digits; whole numbers as they are."""
    if value == int(value) or abs(value) >= 200:
        return f"{value:.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.3g}"
