"""Results rows, the tables of README and docs that are made from them, and whether these are older than the code."""

from __future__ import annotations

import json
import math
import re
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from polsep.bench import BENCHES, history
from polsep.bench.history import TIMED, ask_git, find_changes
from polsep.bench.rows import Row, accept_partial, provenance, to_jsonl, with_spread, write_rows
from polsep.cli.bench import EVALUATED, bench
from polsep.io.store.rows import fill_tables, markdown_table, read_rows

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
MADE_BY = {"command": "c", "commit": "d", "machine": "e"}


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_readme_has_one_table_of_quality_and_one_of_speed() -> None:
    """The README is read in two minutes: at most 150 lines and two tables."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(readme.splitlines()) <= 150
    assert re.findall("<!-- table: (.*) -->", readme) == ["sets/noisy only PSNR", "speed"]
    assert readme.count("\n| --- |") == 2


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_tables_are_the_results(page: Path) -> None:
    """Every table of the README and of docs is what the committed results make of it, and every picture is there."""
    text = page.read_text(encoding="utf-8")
    assert fill_tables(text, ROOT / "results") == text
    assert "Not measured yet" not in text
    shown = [name for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", text) if "//" not in name]
    assert [name for name in shown if not (page.parent / name).is_file()] == []


def test_every_result_has_a_table() -> None:
    """Every committed file of results is shown on some page, and every table has its end."""
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").rglob("*.md"))
    shown = set(re.findall(r"<!-- table: (\w+)", text))
    assert shown >= {path.stem for path in (ROOT / "results").glob("*.jsonl")} - {"blender", "materialx"}
    assert text.count("<!-- table: ") == text.count("<!-- end -->") >= 30


def test_bench_names_the_benchmarks_of_evaluation() -> None:
    """`polsep bench NAME` says of each of them, and of no other, how a checkout measures it."""
    laboratory = pytest.importorskip("evaluation.benches", reason="needs the extras render and bench").BENCHES
    assert sorted(EVALUATED.split()) == sorted(laboratory) and laboratory.keys().isdisjoint(BENCHES)
    for name in laboratory:
        refused = CliRunner().invoke(bench, [name])
        assert refused.exit_code and f"; in a checkout of polsep: python -m evaluation {name}\n" in refused.output


@pytest.mark.parametrize("page", PAGES, ids=label)
def test_tables_older_than_the_code_say_so(page: Path) -> None:
    """Of what changed before a page was last edited; `python -m evaluation readme` writes and removes these lines.

    A change of code alone never fails here: tables name it when their page is edited the next time.
    """
    measures = pytest.importorskip("evaluation.benches", reason="needs the extras render and bench").MEASURES
    edited = ask_git("log", "-1", "--format=%H", "--", label(page))
    until = "HEAD" if ask_git("status", "--porcelain", "--", label(page)) else f"{edited}^"
    if not edited or find_changes({until}, ()) is None:
        pytest.skip("the history of this clone does not reach back to the last edit of the page")
    unknown = set[str]()

    def changes(name: str, commits: set[str]) -> tuple[str, ...] | None:
        found = find_changes(commits, measures[name], until, name in TIMED)
        unknown.update(commits if found is None else ())
        return found

    text = page.read_text(encoding="utf-8")
    assert fill_tables(text, ROOT / "results", changes) == text
    assert not unknown, "expected commits of the rows in the history"


@pytest.mark.parametrize("path", sorted((ROOT / "results").glob("*.jsonl")), ids=lambda p: p.stem)
def test_rows_say_what_made_them(path: Path) -> None:
    """Every committed number has a command, a commit and a machine, from a tree without changes."""
    rows = read_rows(path)
    assert rows
    for row in rows:
        assert row["command"] and row["machine"]
        assert row["commit"] not in ("", "unknown") and not row["commit"].endswith("+")


def test_rows_round_trip(tmp_path: Path) -> None:
    """Rows written as JSON lines read back with six significant digits, and with what made them."""
    path = tmp_path / "a.jsonl"
    path.write_text(to_jsonl([Row("a", "case", "m", "PSNR", 1 / 3, "dB")], MADE_BY), encoding="utf-8")
    assert read_rows(path)[0]["value"] == 0.333333
    assert read_rows(path)[0].items() >= MADE_BY.items()
    assert json.loads(path.read_text(encoding="utf-8").splitlines()[0]) == MADE_BY


def test_single_scenes_have_a_file_of_their_own(tmp_path: Path) -> None:
    means, scene = [Row("a/real", "all", "m", "PSNR", 1, "dB")], Row("a/scenes", "first", "m", "PSNR", 1, "dB")
    write_rows(tmp_path, "a", [scene, *means], "c")
    assert [row["case"] for row in read_rows(tmp_path / "a.jsonl")] == ["all"]
    assert [row["case"] for row in read_rows(tmp_path / "scenes" / "a.jsonl")] == ["first"]
    before = (tmp_path / "a.jsonl").read_bytes()
    with pytest.raises(ValueError, match=r"expected rows of a, found none: .*a\.jsonl stays as it is"):
        write_rows(tmp_path, "a", [], "c")
    assert (tmp_path / "a.jsonl").read_bytes() == before
    assert provenance("c")["command"] == "c"
    assert provenance("c", "abc+")["commit"] == "abc+" and provenance("c", "abc")["commit"] in ("abc", "abc+")


def test_a_part_never_replaces_the_whole(tmp_path: Path) -> None:
    """Rows that lack a case or a method go to a file of their own, and one line says which; not so for quick runs."""
    rows = [Row("a/real", case, m, "PSNR", 1, "dB") for case in ("one", "two") for m in ("x", "y")]
    write_rows(tmp_path, "a", rows, "c")
    before = (tmp_path / "a.jsonl").read_bytes()
    with pytest.raises(
        ValueError, match=r"\Aexpected all that a\.jsonl has, found nothing of a/real: two, y: [^\n]+\Z"
    ):
        write_rows(tmp_path, "a", rows[:-1], "c")
    with pytest.raises(ValueError, match="found nothing of a/real: one, x and 2 more"):
        write_rows(tmp_path, "a", [replace(rows[3], metric="SSIM")], "c")
    assert (tmp_path / "a.jsonl").read_bytes() == before
    assert [row["metric"] for row in read_rows(tmp_path / "a-partial.jsonl")] == ["SSIM"]
    write_rows(tmp_path, "a", [*rows, replace(rows[0], method="new")], "c")
    assert len(read_rows(tmp_path / "a.jsonl")) == 5
    with pytest.raises(ValueError, match=r"a-partial\.jsonl, .* found none"):  # it is older than what is complete
        accept_partial(tmp_path, "a")
    for some in (rows, rows[:1]):
        write_rows(tmp_path, "a-quick", some, "c")
        assert len(read_rows(tmp_path / "a-quick.jsonl")) == len(some)


def test_cases_that_are_no_longer_measured_go_when_told(tmp_path: Path) -> None:
    rows = [Row("a/real", case, "x", "PSNR", 1, "dB") for case in ("one", "two", "three")]
    write_rows(tmp_path, "a", rows, "c")
    with pytest.raises(ValueError, match="'python -m evaluation accept a' takes that instead"):
        write_rows(tmp_path, "a", rows[:1], "d")
    assert accept_partial(tmp_path, "a") == ["a/real: two, x", "a/real: three, x"]
    assert [(row["case"], row["command"]) for row in read_rows(tmp_path / "a.jsonl")] == [("one", "d")]
    assert [path.name for path in tmp_path.iterdir()] == ["a.jsonl"]


def test_tables_join_diffuse_and_specular() -> None:
    """The PSNR of both outputs shares a cell, and methods are columns."""
    rows = [
        {"case": "x", "method": m, "metric": f"{o} PSNR", "unit": "dB", "value": v, **MADE_BY}
        for m, o, v in (("p", "diffuse", 30.0), ("p", "specular", 31.25), ("q", "diffuse", 1.0), ("q", "specular", 0.5))
    ]
    assert "| x | diffuse / specular PSNR [dB] | 30 / 31.2 | 1 / 0.5 |" in markdown_table(rows)


def test_means_are_shown_with_their_standard_errors(tmp_path: Path) -> None:
    """Of 1, 2 and 6: mean 3, standard error sqrt(7 / 3), median 2. The error stands behind the mean."""
    rows = [
        row
        for output, shift in (("diffuse", 0.0), ("specular", 10.0))
        for row in with_spread(
            Row("a/b", "c", "m", f"{output} PSNR", 3.0 + shift, "dB"), [1 + shift, 2 + shift, 6 + shift]
        )
    ]
    assert [row.value for row in rows[:3]] == pytest.approx([3, math.sqrt(7 / 3), 2])
    assert list(with_spread(rows[0], [3.0])) == rows[:1]
    (tmp_path / "a.jsonl").write_text(to_jsonl(rows, MADE_BY), encoding="utf-8")
    whole, one = (fill_tables(f"<!-- table: a/b{only} -->\n<!-- end -->", tmp_path) for only in ("", " only PSNR"))
    shown = "| c | diffuse / specular PSNR [dB] | 3 ± 1.53 / 13 ± 1.53 |\n"
    assert shown in whole and shown in one
    assert "| c | diffuse / specular PSNR, median [dB] | 2 / 12 |\n" in whole and "median" not in one
    assert "standard error" not in whole + one


def test_tables_of_one_metric_leave_the_others_out(tmp_path: Path) -> None:
    """``only PSNR`` selects the PSNR of each output, and no metric whose name merely contains it."""
    row = Row("a/b", "case", "m", "diffuse PSNR", 30.0, "dB")
    rows = [row, replace(row, metric="specular PSNR", value=31.0), replace(row, metric="diffuse PSNR, worst")]
    (tmp_path / "a.jsonl").write_text(to_jsonl(rows, {"command": "c", "commit": "d", "machine": "e"}), encoding="utf-8")
    filled = fill_tables("<!-- table: a/b only PSNR -->\n<!-- end -->", tmp_path)
    assert "| case | diffuse / specular PSNR [dB] | 30 / 31 |" in filled
    assert "worst" not in filled


def test_tables_say_that_they_are_older_than_the_code(tmp_path: Path) -> None:
    """The line comes, stays where the history is unknown, and goes when nothing changed or other rows came."""
    path, empty = tmp_path / "a.jsonl", "<!-- table: a -->\n<!-- end -->\n"
    path.write_text(to_jsonl([Row("a", "case", "m", "PSNR", 1, "dB")], MADE_BY), encoding="utf-8")
    plain = fill_tables(empty, tmp_path)
    older = fill_tables(empty, tmp_path, lambda name, commits: (f"{name}/{commits}", "b"))
    assert "commit d, e\nMeasured at commit d, before the last change of `a/{'d'}`, `b`.\n<!-- end -->" in older
    assert fill_tables(older, tmp_path) == older
    assert fill_tables(older, tmp_path, lambda *_: ()) == plain
    path.write_text(to_jsonl([Row("a", "case", "m", "PSNR", 1, "dB")], MADE_BY | {"commit": "f"}), encoding="utf-8")
    assert fill_tables(older, tmp_path) == plain.replace("commit d", "commit f")


@pytest.fixture
def repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A repository in place of this one."""
    monkeypatch.setattr(history, "ROOT", tmp_path)
    history._list_changes.cache_clear()
    history._read_unchanged.cache_clear()
    subprocess.run(["git", "init", "-q", tmp_path], check=True)
    yield tmp_path
    history._list_changes.cache_clear()
    history._read_unchanged.cache_clear()


def commit(root: Path, files: dict[str, str | None]) -> str:
    """Write or remove files, commit, and return the commit."""
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink() if text is None else path.write_text(text, encoding="utf-8")
    who = ("-c", "user.name=a", "-c", "user.email=b")
    for arguments in (("add", "-A"), (*who, "commit", "-q", "--allow-empty", "-m", "c")):
        subprocess.run(["git", "-C", root, *arguments], check=True)
    return ask_git("rev-parse", "HEAD")


def test_pages_are_no_changes(repository: Path) -> None:
    """The card of weights changes with their scores; the weights count."""
    first = commit(repository, {"weights/a.safetensors": "1", "weights/a.md": "1"})
    commit(repository, {"weights/a.md": "2"})
    assert find_changes({first}, ("weights",)) == ()
    history._list_changes.cache_clear()
    commit(repository, {"weights/a.safetensors": "2"})
    assert find_changes({first}, ("weights",)) == ("weights",)


def test_moves_that_change_no_output_are_no_changes(repository: Path) -> None:
    """Files that moved count under their old names before, the moving commits not at all, and later changes again."""
    text = "".join(f"line {k}\n" for k in range(20))
    first = commit(repository, {"a.py": text, "b.py": text[::-1]})
    changed = commit(repository, {"a.py": text + "more\n"})
    moved = commit(repository, {"a.py": None, "b.py": None, "new/a.py": text + "more\n", "other/b.py": text[::-1]})
    assert find_changes({changed}, ("new", "other")) == ("new", "other")
    commit(repository, {history.UNCHANGED: f"{changed}..{moved}\n"})
    history._list_changes.cache_clear()
    history._read_unchanged.cache_clear()
    assert find_changes({first}, ("new", "other")) == ("new",)
    assert find_changes({changed}, ("new", "other")) == find_changes({moved}, ("new", "other")) == ()
    assert find_changes({changed}, ("new", "other"), timed=True) == ("new", "other")
    commit(repository, {"other/b.py": text})
    history._list_changes.cache_clear()
    assert find_changes({changed}, ("new", "other")) == ("other",)
    assert find_changes({changed}, ("new", "other"), moved) == ()


def test_without_history_nothing_is_known(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A commit that is not there, a shallow clone, a folder without a repository."""
    first = commit(repository, {"a.py": "a\n"})
    last = commit(repository, {"a.py": "b\n"})
    assert find_changes({"0" * 40}, ("a.py",)) is None
    assert find_changes({first}, ("a.py",)) == ("a.py",)
    for name in ("shallow", "empty"):
        folder = tmp_path_factory.mktemp(name)
        if name == "shallow":
            subprocess.run(["git", "clone", "-q", "--depth=1", f"file://{repository}", folder], check=True)
        history.ROOT = folder
        assert find_changes({last}, ("a.py",)) is None
