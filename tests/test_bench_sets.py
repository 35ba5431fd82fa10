"""Benchmarks on rendered data: they refuse what they cannot measure, before they measure anything."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("trimesh", reason="meshes need the extra 'render'")

from polsep import testsets
from polsep.bench.rendering import bench_rendering
from polsep.bench.sets import bench_sets
from polsep.render import Scene
from polsep.stokes import Stokes
from polsep.testsets import Recipe


def make_grey(_paths: list[Path], _generator: torch.Generator) -> Scene:
    """A grey frame."""
    grey = torch.ones(3, 32, 32)
    return Scene(Stokes(grey, 0 * grey, 0 * grey), Stokes(grey, grey, 0 * grey), grey[0] > 0)


def test_scenes_that_nobody_recorded_get_no_score(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A test set that changed unknowingly stops the benchmark."""
    monkeypatch.setattr(testsets, "SETS", {"grey": (Recipe("grey", 1, (), make_grey),)})
    with pytest.raises(ValueError, match="expected a recorded test scene, found grey"):
        next(bench_sets(tmp_path))


def test_missing_extras_are_named_before_anything_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training's extra too, which only the last part needs."""
    monkeypatch.setitem(sys.modules, "lightning_fabric", None)
    monkeypatch.delitem(sys.modules, "polsep.train.loop", raising=False)
    with pytest.raises(ValueError, match="expected the extras train and mitsuba, found no lightning_fabric"):
        next(bench_rendering())
