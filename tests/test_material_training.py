"""The training for materials: turned examples are the same materials, losses vanish at the truth, runs go on."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
import torch
from torch import Tensor

from polsep.material.examples import example_path, load_example, make_examples
from polsep.material_network import MaterialNetwork, MaterialSize
from polsep.svbrdf import plane_points, relight, unstack
from polsep.train.loop import Run, Schedule
from polsep.train.material_command import train_material
from polsep.train.material_losses import maps_loss, material_loss, random_configurations, rendering_loss
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
    turned = turn_example(MaterialBatch(picture[:, None], maps), ways, colors)
    x, y = 0.9 * (1 - 2 * ways[0]), -0.4 * (1 - 2 * ways[1])
    x, y = (-y, -x) if ways[2] else (x, y)
    again = relight(unstack(turned.maps), points, camera, place(x, y, 1.7))
    torch.testing.assert_close(turned.views[:, 0], again, rtol=1e-9, atol=1e-9)
