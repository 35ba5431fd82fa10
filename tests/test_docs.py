"""The documentation: links lead somewhere, commands parse, the site names all pages, worked examples run."""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import sys
import warnings
from importlib import import_module
from pathlib import Path

import click
import imagecodecs
import numpy as np
import pytest

import polsep.bench
from evaluation.__main__ import app as laboratory
from polsep.cli import app
from tests.test_architecture import RANKS

ROOT = Path(__file__).resolve().parents[1]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS]

every_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())

_BLOCK = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.MULTILINE | re.DOTALL)


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page in one language; "" are commands."""
    text = page.read_text(encoding="utf-8")
    return [code for _, found, code in _BLOCK.findall(text) if found == language]


def prose(page: Path) -> str:
    """Return a page without its code."""
    return re.sub(r"`[^`\n]*`", "", _BLOCK.sub("", page.read_text(encoding="utf-8")))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and MkDocs name them."""
    text = _BLOCK.sub("", page.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ +(.+?) *$", text, re.MULTILINE)
    return {re.sub(r"[ -]+", "-", re.sub(r"[^\w\- ]", "", title.lower()).strip()) for title in titles}


@every_page
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    """Every relative link names a file, and its anchor a heading of that file."""
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize("page", DOCS, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_pages_of_the_site_stay_in_it(page: Path) -> None:
    """A page of docs links to docs only: nothing else is part of the site."""
    targets = re.findall(r"\]\(([^)\s#]+)", prose(page))
    local = [target for target in targets if not re.match(r"[a-z]+:", target)]
    outside = [target for target in local if not (page.parent / target).resolve().is_relative_to(ROOT / "docs")]
    assert not outside


def commands(page: Path) -> list[list[str]]:
    """Return the command lines in the code blocks of a page as words."""
    text = "\n".join(blocks(page, "")).replace("\\\n", " ")
    lines = [line.strip() for line in text.splitlines()]
    return [shlex.split(line, comments=True) for line in lines if re.match(r"(polsep|make|python) ", line)]


def check_command(words: list[str]) -> None:
    """Raise ClickException or AssertionError unless the line is a command with options and values that exist."""
    if words[0] == "make":
        targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        assert set(words[1:]) <= set(targets)
    elif words[:3] == ["python", "-m", "evaluation"]:
        assert words[3] in laboratory.commands
    elif words[0] == "python":
        assert words[1].startswith("-") or (ROOT / words[1]).is_file()
    else:
        command = app.get_command(click.Context(app), words[1])
        assert command is not None, f"no command {words[1]}"
        context = command.make_context(words[1], words[2:], **app.context_settings)
        if words[1] == "bench":
            assert context.params["name"] in {*polsep.bench.BENCHES, "list", "readme"}


@every_page
def test_commands_parse(page: Path) -> None:
    """Every command line shown has a command, options and values that exist."""
    for words in commands(page):
        try:
            check_command(words)
        except (click.ClickException, click.exceptions.Exit, AssertionError) as error:
            pytest.fail(f"{' '.join(words)}: {error}")


def assert_imports_exist(code: str) -> None:
    """Raise unless the code is valid Python and the names that it imports from polsep exist."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("polsep", "evaluation"):
            module = import_module(str(node.module))
            assert not [name.name for name in node.names if not hasattr(module, name.name)]


@every_page
def test_python_of_pages_imports_what_exists(page: Path) -> None:
    """Every Python block is valid Python, and the names that it imports exist."""
    for code in blocks(page, "python"):
        assert_imports_exist(code)


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.stem)
def test_examples_import_what_exists(path: Path) -> None:
    """The names that examples import from polsep exist."""
    assert_imports_exist(path.read_text(encoding="utf-8"))


@every_page
def test_named_files_exist(page: Path) -> None:
    """Every file of the repository that a page names in code is there; what git does not keep is exempt."""
    named = re.findall(
        r"`((?:polsep|tests|evaluation|examples|results)/[\w./-]+\.\w+)`", page.read_text(encoding="utf-8")
    )
    assert not [name for name in named if not (ROOT / name).is_file()]


def test_the_site_names_every_page() -> None:
    """The navigation of mkdocs.yml has every page of docs exactly once, and nothing else."""
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:\n")[2]
    named = re.findall(r"([\w/-]+\.md)$", navigation, re.MULTILINE)
    assert sorted(named) == sorted(page.relative_to(ROOT / "docs").as_posix() for page in DOCS)


def test_contributing_has_the_ranks_of_the_architecture() -> None:
    """The table of rooms in CONTRIBUTING.md is what test_architecture enforces."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| ([^|]*) \|", text, re.MULTILINE)
    assert {room: int(rank) for rank, rooms in rows for room in re.findall(r"`(\w+)`", rooms)} == RANKS


@pytest.mark.parametrize("name", ["extending", "python"])
def test_worked_examples_run(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of the page runs from top to bottom, as a reader would run it."""
    from polsep.methods import METHODS

    monkeypatch.chdir(tmp_path)
    for method in METHODS.copy():
        monkeypatch.setitem(METHODS, method, METHODS[method])  # restored when the test ends
    names: dict[str, object] = {"camera": []}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for code in blocks(ROOT / "docs" / f"{name}.md", "python"):
                exec(compile(code, f"{name}.md", "exec"), names)
    finally:
        METHODS.pop("minimum", None)
    assert len(names) > 2


def test_the_minimal_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """examples/minimal.py separates a frame that is named and says what it wrote."""
    frame = np.random.default_rng(0).integers(100, 4000, (64, 96)).astype(np.uint16)
    (tmp_path / "shot.png").write_bytes(imagecodecs.png_encode(frame))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["minimal.py", "shot.png"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runpy.run_path(str(ROOT / "examples" / "minimal.py"), run_name="__main__")
    assert "polsep-out/shot.exr" in capsys.readouterr().out
    assert (tmp_path / "polsep-out" / "shot.exr").is_file()
