"""Compiled code on disk is renewed when anything changes that it was made of, and only then."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

CONSTANTS = "FACTOR = 3\n"
CALLED = """
from __future__ import annotations
from typing import Any, NamedTuple
from polsep.compute.compiling import compiled
from tiny import constants

class Pair(NamedTuple):
    first: int
    second: int

@compiled
def scale(x: Any) -> Any:
    '''x times a factor.'''
    return constants.FACTOR * x
"""
CALLING = """
from __future__ import annotations
from typing import Any
from polsep.compute.compiling import compiled, entry
from tiny.called import Pair as Argument, scale

@compiled
def _apply(x: Any) -> Any:
    return scale(x)

@entry
def run(pair: Argument) -> Any:
    return _apply(pair.first)
"""

Load = Callable[[], tuple[int, bool]]


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Path, Load]]:
    """A package of kernels, and what calls it anew: the result, and whether it came from disk."""
    folder = tmp_path / "here" / "tiny"
    folder.mkdir(parents=True)
    for name, text in (("__init__", ""), ("constants", CONSTANTS), ("called", CALLED), ("calling", CALLING)):
        (folder / f"{name}.py").write_text(text)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def load() -> tuple[int, bool]:
        for name in [name for name in sys.modules if name.split(".")[0] == "tiny"]:
            del sys.modules[name]
        importlib.invalidate_caches()
        calling = importlib.import_module("tiny.calling")
        result = calling.run(calling.Argument(5, 7))
        return result, bool(calling.run.dispatcher.stats.cache_hits)

    monkeypatch.syspath_prepend(str(folder.parent))
    assert load() == (15, False)
    assert load() == (15, True)
    yield folder, load
    for name in [name for name in sys.modules if name.split(".")[0] == "tiny"]:
        del sys.modules[name]


def replace(path: Path, old: str, new: str) -> None:
    """Change a source."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("module", "old", "new", "result"),
    [
        ("called", "* x", "+ x", 8),
        ("constants", "3", "4", 20),
        ("calling", "return scale(x)", "return scale(x) + 1", 16),
        ("called", "first: int\n    second: int", "second: int\n    first: int", 21),
        ("called", "@compiled\n", "from numba import njit\n@njit(fastmath=True)\n", 15),
    ],
)
def test_a_change_of_what_a_kernel_calls_is_compiled(
    tiny: tuple[Path, Load], module: str, old: str, new: str, result: int
) -> None:
    folder, load = tiny
    replace(folder / f"{module}.py", old, new)
    assert load() == (result, False)
    assert load() == (result, True)


def test_a_renamed_type_of_an_argument_is_compiled(tiny: tuple[Path, Load]) -> None:
    folder, load = tiny
    replace(folder / "called.py", "class Pair", "class Numbers")
    replace(folder / "calling.py", "Pair as", "Numbers as")
    assert load() == (15, False)
    assert load() == (15, True)


def test_comments_and_moved_lines_are_not_compiled(tiny: tuple[Path, Load]) -> None:
    folder, load = tiny
    replace(folder / "called.py", "x times a factor", "A factor times x")
    replace(folder / "calling.py", "@entry", "# a comment\n\n@entry")
    assert load() == (15, True)


def test_a_copy_of_the_package_elsewhere_is_not_compiled(
    tiny: tuple[Path, Load], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, load = tiny
    elsewhere = folder.parent.parent / "elsewhere"
    shutil.copytree(folder.parent, elsewhere)  # with times of its own
    shutil.rmtree(folder.parent)
    monkeypatch.syspath_prepend(str(elsewhere))
    assert load() == (15, True)


def test_a_package_that_cannot_be_written_is_cached_in_the_users_folder(
    tiny: tuple[Path, Load], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, load = tiny
    shutil.rmtree(folder / "__pycache__")
    (folder / "__pycache__").write_text("not a folder, so nobody can write there, root included")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder.parent / "user"))
    monkeypatch.setenv("HOME", str(folder.parent))
    assert load() == (15, False)
    assert load() == (15, True)
    assert list((folder.parent / "user").rglob("calling.run*.nbi"))


def test_what_code_is_known_by_is_the_same_in_every_process() -> None:
    code = """
from polsep.compute.jit import fingerprint
from polsep.separation.strips_kernel import separate_rows
print(fingerprint(separate_rows.py_func))
"""
    found = []
    for seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        child = subprocess.run(
            [sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True
        )
        found.append(child.stdout)
    assert found[0] == found[1] != ""
