"""The training for materials: turned examples are the same materials, losses vanish at the truth, runs go on."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from polsep.io.store.weights import read_weights
from polsep.material.examples import example_path, load_example, make_examples
from polsep.material.network import MaterialNetwork, MaterialSize
from polsep.material.svbrdf import plane_points, relight, unstack
from polsep.train.loop import Run, Schedule
from polsep.train.material_command import train_material
from polsep.train.material_losses import maps_loss, random_configurations, rendering_loss
from polsep.train.material_task import MaterialBatch, MaterialOptions, batches, turn_example


def random_maps(seed: int, size: int = 12) -> Tensor:
    """Stacked maps without any structure, ``[1, 9, size, size]``."""
    maps = torch.rand(1, 9, size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    maps[:, :2] = 0.8 * (maps[:, :2] - 0.5)
    return maps


def place(x: float, y: float, z: float) -> Tensor:
    return torch.tensor([x, y, z], dtype=torch.float64)[:, None, None]


@pytest.mark.parametrize("ways", list(itertools.product((False, True), repeat=3)))
def test_a_turned_material_looks_turned(ways: tuple[bool, bool, bool]) -> None:
    """Its picture under the turned light is the turned picture."""
    maps, points = random_maps(1), plane_points(12, 12).double()
    light, camera = place(0.9, -0.4, 1.7), place(0.0, 0.0, 2.5)
    picture = relight(unstack(maps), points, camera, light)
    colors = torch.tensor([2, 0, 1])
    turned = turn_example(MaterialBatch(picture[:, None], maps), *ways, colors)
    x, y = 0.9 * (1 - 2 * ways[0]), -0.4 * (1 - 2 * ways[1])
    x, y = (-y, -x) if ways[2] else (x, y)
    again = relight(unstack(turned.maps), points, camera, place(x, y, 1.7))
    torch.testing.assert_close(turned.views[:, 0], again, rtol=1e-4, atol=1e-5)  # points are of single precision


def test_losses_vanish_at_the_truth_only() -> None:
    """Both are 0 for the true maps, and not for others; every pixel is in one of the lattices."""
    truth, other = random_maps(2, 9).float(), random_maps(3, 9).float()
    seen = random_configurations(2, 4, torch.Generator().manual_seed(1))
    offsets = list(itertools.product(range(3), repeat=2))
    maps, wrong = unstack(truth), unstack(other)
    assert all(float(rendering_loss(maps, maps, seen, at)) == 0 for at in offsets)
    assert float(maps_loss(maps, maps)) == 0
    assert all(float(rendering_loss(wrong, maps, seen, at)) > 0.01 for at in offsets)
    assert float(maps_loss(wrong, maps)) > 0.1
    changed = truth.clone()
    changed[0, 2:5, 4, 7] = 0.0  # one pixel: seen in one lattice only
    losses = [float(rendering_loss(unstack(changed), maps, seen, at)) for at in offsets]
    assert sum(loss > 0 for loss in losses) == 1 and losses[offsets.index((1, 1))] > 0


def test_mirror_configurations_are_mirrors() -> None:
    """Between camera and light, in the ratio of their heights, lies the mirror's centre; both see it alike."""
    seen = random_configurations(0, 200, torch.Generator().manual_seed(4))
    camera, light = seen.camera[..., 0, 0], seen.light[..., 0, 0]
    assert float(camera[:, 2].min()) > 0 and float(light[:, 2].min()) > 0
    share = (camera[:, 2] / (camera[:, 2] + light[:, 2]))[:, None]
    mirror = camera + share * (light - camera)
    assert float(mirror[:, :2].abs().max()) <= 1 + 1e-4
    towards, away = (
        torch.nn.functional.normalize(x - mirror * torch.tensor([1.0, 1.0, 0.0]), dim=1) for x in (camera, light)
    )
    torch.testing.assert_close(towards[:, 2], away[:, 2], rtol=1e-3, atol=1e-4)


OPTIONS = MaterialOptions("separated", MaterialSize(2, (1, 1)), batch=2, examples=1, views=2, validation=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the examples that `OPTIONS` asks for."""
    path: Path = tmp_path_factory.mktemp("examples")
    for split, count in (("train", 1), ("validation", 1)):
        assert list(make_examples(path, split, 0, count, 2)) == list(range(1, count + 1))
    return path


def test_examples_are_made_once(folder: Path) -> None:
    """A second go makes none; files hold what was made, and others are refused."""
    path = example_path(folder, "train", 0, 0)
    before = path.read_bytes()
    assert list(make_examples(folder, "train", 0, 1, 2)) == [1]
    assert path.read_bytes() == before
    example = load_example(path)
    assert example.views.shape == (2, 15, 128, 128) and example.maps.shape == (9, 128, 128)
    bad, planes = folder / "bad.npy", np.load(path)
    for damaged in (b"nothing", b"", before[:-100], b"PK\3\4nothing"):
        bad.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"expected an example of a training in .*; once deleted, it is made"):
            load_example(bad)
    planes[0, 0, 0] = np.nan
    np.save(bad, planes)
    with pytest.raises(ValueError, match="expected finite planes in"):
        load_example(bad)


def test_batches_go_on_anywhere(folder: Path) -> None:
    """Batch number 2 is the same from the beginning and from itself, and lanes differ."""
    stream = batches(OPTIONS, folder, 0, (0, 1))
    third = [next(stream) for _ in range(3)][2]
    again = next(batches(OPTIONS, folder, 2, (0, 1)))
    assert torch.equal(third.views, again.views) and torch.equal(third.maps, again.maps)
    other = next(batches(OPTIONS, folder, 2, (1, 2)))
    assert other.views.shape != again.views.shape or not torch.equal(other.views, again.views)


def test_a_training_that_stops_goes_on(folder: Path, tmp_path: Path) -> None:
    """With the same weights in the end as one without a break; its file says what it is of."""
    schedule = Schedule(4, 1e-3, 1, 0.9, checkpoint_every=2, validate_every=2, precision="32-true")
    paths = []
    for name, stops in (("whole", ()), ("broken", (2,))):
        run = Run(tmp_path / name, schedule=schedule)
        for stop in stops:
            with pytest.raises(RuntimeError, match="stopped"):
                train_material(OPTIONS, run, folder, stop_at(stop))
        paths.append(train_material(OPTIONS, run, folder, lambda line: None))
    (whole, metadata), (broken, _) = (read_weights(path) for path in paths)
    assert whole.keys() == broken.keys() and all(np.array_equal(whole[name], broken[name]) for name in whole)
    assert metadata["input"] == "separated" and "relit, 1 view" in metadata["validation"]
    assert MaterialNetwork(6, OPTIONS.size).load_state_dict({name: torch.from_numpy(x) for name, x in whole.items()})
    mean = Run(tmp_path / "mean", schedule=replace(schedule, steps=0), start=(paths[0], paths[1]))
    again, metadata = read_weights(train_material(OPTIONS, mean, folder, lambda line: None))
    assert all(np.array_equal(whole[name], again[name]) for name in whole)
    assert metadata["command"].count("--start material-separated.safetensors") == 2
    with pytest.raises(ValueError, match="expected a network with a linear filter to refit, found material"):
        train_material(OPTIONS, replace(mean, refit=True), folder, lambda line: None)


def stop_at(step: int) -> Callable[[dict[str, Any]], None]:
    """A report that ends the program after the checkpoint of a step."""
    seen: list[int] = []

    def report(line: dict[str, Any]) -> None:
        seen.append(int(line.get("step", 0)))
        if line.get("step", 0) > step:
            raise RuntimeError("stopped")

    return report
