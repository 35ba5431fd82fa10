"""Networks of a file of weights as methods: colour and mono frames, clipped samples, files of something else."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path

import pytest
import torch
from tolerances import assert_close

from polsep import learned
from polsep.io.weights import write_weights
from polsep.learned import is_shipped, load_refinement, separate_paper
from polsep.networks import Size
from polsep.refine import RUNGS, Refinement
from polsep.stokes import Measurements

SIZE = Size(4, 1, 1)
ANGLES = tuple(math.radians(t) for t in (0.0, 45.0, 90.0, 135.0))


def write_constant(path: Path, **changed: str) -> Path:
    """Networks whose images are 0.25 everywhere."""
    network = Refinement(RUNGS["paper"], 3, SIZE)
    for net in network.nets:
        torch.nn.init.constant_(net.last.bias, 0.25)  # type: ignore[union-attr, arg-type]
    torch.nn.init.zeros_(network.linear.weight)
    torch.nn.init.zeros_(network.linear.bias)  # type: ignore[arg-type]
    metadata = {"method": "paper", "rung": "paper", "colors": "3", "size": json.dumps(asdict(SIZE))}
    write_weights(path, network.state_dict(), metadata | changed)
    return path


@pytest.mark.parametrize("colors", [1, 3])
def test_paper_separates_colour_and_mono(colors: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_constant(tmp_path / "x.safetensors")
    monkeypatch.setattr(learned, "shipped_weights", lambda _: path)
    learned._shipped_refinement.cache_clear()
    clipped = torch.zeros(4, colors, 6, 8, dtype=torch.bool)
    clipped[2, 0, 3, 4] = True
    found = separate_paper(Measurements(torch.full((4, colors, 6, 8), 0.5), ANGLES, clipped))
    learned._shipped_refinement.cache_clear()
    assert_close(found.diffuse, torch.full((colors, 6, 8), 0.25))
    assert_close(found.specular, torch.full((colors, 6, 8), math.expm1(0.25)))
    assert_close(found.stokes.s0, torch.full((colors, 6, 8), 1.0))
    assert torch.equal(~found.valid, clipped.any(dim=0).any(dim=0))


@pytest.mark.parametrize("changed", [{"rung": "none"}, {"colors": "1"}, {"size": "[]"}, {"size": "{"}])
def test_weights_of_another_network_are_refused(changed: dict[str, str], tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected weights of a refinement"):
        load_refinement(write_constant(tmp_path / "x.safetensors", **changed), torch.device("cpu"))


def test_weights_that_are_not_there_are_not_shipped() -> None:
    assert not is_shipped("no-such-network")
