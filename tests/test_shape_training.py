"""The training of the network for shape: a run that was stopped goes on to the same weights, which the engine loads."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

pytest.importorskip("embreex")
pytest.importorskip("skimage")
pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

from polsep.geometry.one_frame import ShapeEstimator
from polsep.io.assets.objects import hash_files
from polsep.io.store.rounding import names_to_round, steps_of
from polsep.io.store.weights import read_weights
from polsep.networks.sizes import ResidualSize
from polsep.train.loop import Run, Schedule
from polsep.train.shape_command import train_shape
from polsep.train.shape_examples import MESHES, PLANES, Examples, find_example, load_example
from polsep.train.shape_task import ShapeOptions
from tools import round_weights

OPTIONS = ShapeOptions(size=ResidualSize(2, (1, 1)), batch=2, side=32, examples=2, validation=1)
SCHEDULE = Schedule(4, warm_up=1, checkpoint_every=2, validate_every=4, precision="32-true")


def test_a_stopped_training_goes_on(tmp_path: Path) -> None:
    """Two steps and then two are four; the file says how it came about; examples are made once."""
    folder = tmp_path / "examples"
    whole = train_shape(OPTIONS, Run(tmp_path / "whole", schedule=SCHEDULE), folder, lambda _: None)
    made = {path: path.stat().st_mtime_ns for path in folder.glob("*.npy")}
    part = Run(tmp_path / "part", schedule=SCHEDULE, until=2)
    train_shape(OPTIONS, part, folder, lambda _: None)
    resumed = train_shape(OPTIONS, replace(part, until=None), folder, lambda _: None)
    with pytest.raises(ValueError, match="at step 4 of the checkpoint or later, found 2"):
        train_shape(OPTIONS, part, folder, lambda _: None)  # its weights are of step 4 and say so
    first, second = read_weights(whole), read_weights(resumed)
    assert first[0].keys() == second[0].keys()
    for array in first[0]:
        np.testing.assert_array_equal(first[0][array], second[0][array], err_msg=array)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("*.npy")} == made and len(made) == 3
    facts = second[1]
    assert (facts["method"], facts["input"], facts["steps"], facts["side"]) == ("shape", "separated", "4", "32")
    assert facts["command"].startswith("polsep train shape --input separated --width 2 ")
    assert json.loads(facts["validation"])["normals, mean deg"] > 0
    assert ShapeEstimator(resumed).size == OPTIONS.size


def test_meshes_of_files_are_shown_too(tmp_path: Path) -> None:
    """As many examples again show them; the file says which meshes; a folder without meshes is refused.

    Other meshes have other examples, in the same folder.
    """
    folder, meshes = tmp_path / "examples", tmp_path / "meshes"
    meshes.mkdir()
    train = partial(train_shape, OPTIONS, folder=folder, report=lambda _: None)
    with pytest.raises(ValueError, match="expected meshes"):
        train(Run(tmp_path / "none", schedule=SCHEDULE), meshes=meshes)
    trimesh.creation.capsule(1, 0.4).export(meshes / "capsule.ply")
    trimesh.creation.box((1, 2, 3)).export(meshes / "box.obj")
    weights = train(Run(tmp_path / "run", schedule=SCHEDULE), meshes=meshes)
    found = hash_files([meshes / "box.obj", meshes / "capsule.ply"])
    shown = Examples(MESHES, OPTIONS.seed, shown=found)
    names = {path.name for path in folder.glob("*.npy")}
    assert {shown.path(folder, number).name for number in range(2)} < names and len(names) == 5
    planes = load_example(shown.path(folder, 0)).float()
    length = planes[PLANES["normal"]].norm(dim=0)[planes[PLANES["mask"]][0] > 0]
    assert len(length) > 500 and float((length - 1).abs().max()) < 0.01
    facts = read_weights(weights)[1]
    assert json.loads(facts["options"])["meshes"] == found and facts["command"].endswith("--meshes meshes")
    (meshes / "box.obj").unlink()
    train(Run(tmp_path / "other", schedule=SCHEDULE), meshes=meshes)
    other = Examples(MESHES, OPTIONS.seed, shown=hash_files([meshes / "capsule.ply"])).path(folder, 0)
    assert not load_example(other).equal(load_example(shown.path(folder, 0)))
    assert find_example(other) == (Examples(MESHES, OPTIONS.seed), 0)


def test_other_files_are_no_examples(tmp_path: Path) -> None:
    """An array of other planes is refused, and so is fitting a filter that there is none of."""
    path = Examples("train", 0).path(tmp_path, 0)
    np.save(path, np.zeros((3, 8, 8), np.float16))
    with pytest.raises(ValueError, match="example of 35 planes"):
        load_example(path)
    with pytest.raises(ValueError, match="to refit"):
        train_shape(OPTIONS, Run(tmp_path / "x", schedule=SCHEDULE, refit=True), tmp_path, lambda _: None)


def test_small_layers_learn_after_large_ones_were_rounded(tmp_path: Path) -> None:
    """Rounding leaves few values in large layers, which a training of the small ones does not touch."""
    options = replace(OPTIONS, size=ResidualSize(24, (1, 1)))
    train = partial(train_shape, folder=tmp_path, report=lambda _: None)
    first = train(options, Run(tmp_path / "all", schedule=SCHEDULE))
    round_weights.main([str(first), "--examples", str(tmp_path)], standalone_mode=False)
    last = train(replace(options, part="small"), Run(tmp_path / "small", schedule=SCHEDULE, start=(first,)))
    (before, _), (after, facts) = read_weights(first), read_weights(last)
    round_weights.main([str(last)], standalone_mode=False)
    again = read_weights(last)[0]
    large = names_to_round(before, {})
    assert 2 < len(large) < len(before) and "--part small" in facts["command"]
    for name in before:
        if name in large:
            count = steps_of(before[name], "shape")
            rows = before[name].reshape(len(before[name]), -1)
            assert count < 10 and max(len(np.unique(row)) for row in rows) <= 2 * count + 1
            np.testing.assert_allclose(after[name], before[name], rtol=2e-3, atol=1e-6)  # half precision
            np.testing.assert_allclose(again[name], before[name], rtol=2e-3, atol=1e-6)
    assert sum(not np.array_equal(before[name], after[name]) for name in before.keys() - large) > 2
    with pytest.raises(ValueError, match="a part"):
        replace(OPTIONS, part="errors")
