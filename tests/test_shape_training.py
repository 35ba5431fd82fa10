"""The training of the network for shape: a run that was stopped goes on to the same weights, which the engine loads."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex")
pytest.importorskip("skimage")
pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

import torch

from polsep.geometry.one_frame import ShapeEstimator
from polsep.geometry.shape_maps import INPUTS, USUAL
from polsep.io.store.rounding import COARSE, coarsened, names_to_round, steps_of
from polsep.io.store.weights import read_weights
from polsep.networks.shape import ShapeNetwork
from polsep.networks.sizes import ResidualSize
from polsep.train.loop import Run, Schedule
from polsep.train.shape_command import train_shape
from polsep.train.shape_examples import example_path, load_example
from polsep.train.shape_task import ShapeOptions, rounded

OPTIONS = ShapeOptions(size=ResidualSize(2, (1, 1)), batch=2, side=32, examples=2, validation=1)
SCHEDULE = Schedule(4, warm_up=1, checkpoint_every=2, validate_every=4, precision="32-true")


def test_a_stopped_training_goes_on(tmp_path: Path) -> None:
    """Two steps and then two are four; the file says how it came about; examples are made once."""
    folder = tmp_path / "examples"
    whole = train_shape(OPTIONS, Run(tmp_path / "whole", schedule=SCHEDULE), folder, lambda _: None)
    made = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    part = Run(tmp_path / "part", schedule=SCHEDULE, until=2)
    train_shape(OPTIONS, part, folder, lambda _: None)
    resumed = train_shape(OPTIONS, replace(part, until=None), folder, lambda _: None)
    first, second = read_weights(whole), read_weights(resumed)
    assert first[0].keys() == second[0].keys()
    for array in first[0]:
        np.testing.assert_array_equal(first[0][array], second[0][array], err_msg=array)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == made and len(made) == 3
    facts = second[1]
    assert (facts["method"], facts["input"], facts["steps"], facts["side"]) == ("shape", "separated", "4", "32")
    assert facts["command"].startswith("polsep train shape --input separated --width 2 ")
    assert json.loads(facts["validation"])["normals, mean deg"] > 0
    assert ShapeEstimator(resumed).size == OPTIONS.size


def test_other_files_are_no_examples(tmp_path: Path) -> None:
    """An array of other planes is refused, and so is fitting a filter that there is none of."""
    path = example_path(tmp_path, "train", 0, 0)
    np.save(path, np.zeros((3, 8, 8), np.float16))
    with pytest.raises(ValueError, match="example of 35 planes"):
        load_example(path)
    with pytest.raises(ValueError, match="to refit"):
        train_shape(OPTIONS, Run(tmp_path / "x", schedule=SCHEDULE, refit=True), tmp_path, lambda _: None)


def test_rounded_layers_are_those_of_the_file_and_still_learn() -> None:
    """A training for rounded weights sees large layers as files hold them, and every weight gets a gradient."""
    torch.manual_seed(0)
    network = ShapeNetwork(INPUTS["separated"], USUAL, ResidualSize(32, (1, 1)))
    for weight in network.parameters():  # some start at zero
        torch.nn.init.normal_(weight)
    arrays = {name: value.detach().numpy() for name, value in network.named_parameters()}
    found = rounded(network)
    assert found.keys() == names_to_round(arrays, {}) and len(found) > 2
    assert not any(name.startswith(("last.", "encoders.0.0.")) for name in found)
    for name, value in found.items():
        count = dict(COARSE["shape"])[500_000 if arrays[name].size >= 500_000 else 0]
        assert steps_of(arrays[name], "shape") == count
        assert max(len(np.unique(row)) for row in value.detach().numpy().reshape(len(value), -1)) <= 2 * count + 1
        np.testing.assert_allclose(value.detach(), coarsened(arrays[name], count), atol=1e-7)
        assert float((value.detach() - torch.from_numpy(arrays[name])).abs().max()) > 0
    sum(value.square().sum() for value in found.values()).backward()
    exact = dict(network.named_parameters())
    for name, value in found.items():
        torch.testing.assert_close(exact[name].grad, 2 * value.detach())


def test_a_training_for_rounded_weights(tmp_path: Path) -> None:
    """It trains, and says in its file how."""
    options = replace(OPTIONS, size=ResidualSize(24, (1, 1)), stored="rounded")
    path = train_shape(options, Run(tmp_path / "run", schedule=replace(SCHEDULE, steps=2)), tmp_path, lambda _: None)
    assert "--stored rounded" in read_weights(path)[1]["command"]
    with pytest.raises(ValueError, match="stored as"):
        replace(OPTIONS, stored="thirds")
