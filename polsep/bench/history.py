"""The age of measured numbers: whether the code that they speak of changed since, by the repository's history."""

from __future__ import annotations

import subprocess
from collections.abc import Collection, Sequence
from functools import cache
from pathlib import Path

from polsep.io.store.rows import read_bytes

ROOT = Path(__file__).resolve().parents[2]
#: A file with lines "FROM..TO": the commits after FROM up to TO moved code, and `evaluation/golden.py` found outputs
#: equal, to the bit or, where two copies of an equation became one, within rounding.
UNCHANGED = "results/unchanged.txt"
#: Benchmarks of time and memory, which code that gives the same outputs may change.
TIMED = frozenset(("gpu", "rendering", "speed", "video", "view"))


def ask_git(*arguments: str) -> str:
    """The output of git in the folder that holds the package; "" where git or a repository of polsep is missing.

    A package that is installed inside the repository of something else has that repository around it, not its own.
    """
    if not (ROOT / ".git").exists():
        return ""
    try:
        done = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False, cwd=ROOT)
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def find_changes(
    commits: Collection[str], measured: Sequence[str], until: str = "HEAD", timed: bool = False
) -> tuple[str, ...] | None:
    """The paths of ``measured`` that changed after any of ``commits``, up to ``until``.

    Commits in the ranges of `UNCHANGED` do not count, except for what is ``timed``; files that these renamed count
    under their old names before. Pages, such as the cards of weights, which hold results, do not count either.
    None where the history does not reach back so far, as in a shallow clone.
    """
    if ask_git("rev-parse", "--is-shallow-repository") != "false":
        return None
    if not all(ask_git("rev-parse", "--quiet", "--verify", f"{commit}^{{commit}}") for commit in commits):
        return None
    moved, same = _read_unchanged()
    changed = set[str]()
    for commit in commits:
        for hash_, paths in _list_changes(commit, until):
            if timed or hash_ not in same:
                changed.update(moved.get(path, path) for path in paths if not path.endswith(".md"))
    return tuple(path for path in measured if any(x == path or x.startswith(f"{path}/") for x in changed))


@cache
def _list_changes(commit: str, until: str) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Every commit after ``commit`` up to ``until`` with the paths that it changed."""
    blocks = ask_git("log", "--no-renames", "--format=%x00%H", "--name-only", f"{commit}..{until}").split("\0")[1:]
    return tuple((lines[0], tuple(lines[2:])) for lines in (block.strip().split("\n") for block in blocks))


@cache
def _read_unchanged() -> tuple[dict[str, str], frozenset[str]]:
    """New names of the files that the ranges of `UNCHANGED` renamed, and the commits in them."""
    moved, commits = dict[str, str](), set[str]()
    path = ROOT / UNCHANGED
    for span in read_bytes(path).decode().split() if path.is_file() else ():
        found = ask_git("diff", "--name-status", "--find-renames=30%", "--diff-filter=R", *span.split(".."))
        renamed = dict(line.split("\t")[1:] for line in found.splitlines())
        moved = {old: renamed.get(new, new) for old, new in moved.items()} | renamed
        commits.update(ask_git("rev-list", span).split())
    return moved, frozenset(commits)
