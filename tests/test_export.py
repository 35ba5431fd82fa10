"""The joint network as an ONNX file gives what it gives in torch, for any size, without polsep."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from tolerances import assert_within

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript", reason="exporting needs the extra 'export'")

import onnxruntime

from polsep import cli
from polsep.in_torch import load_joint
from polsep.io.store.weights import write_weights
from polsep.networks.channels import INPUTS
from polsep.networks.export import ExportedNetwork
from polsep.networks.joint import Joint
from polsep.networks.run import run_joint
from polsep.networks.sizes import ResidualSize
from polsep.sensor.camera import Layout, Mosaic

SIZE = ResidualSize(4, (0, 1))
#: Rounding through two dozen layers, in white levels.
ROUNDED = 1e-4


def write_random(path: Path) -> Path:
    torch.manual_seed(2)
    network = Joint(3, SIZE)
    for weight in network.parameters():
        if weight.dim() > 1:
            torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    metadata = {"method": "joint", "colors": "3", "inputs": json.dumps(INPUTS), "size": json.dumps(asdict(SIZE))}
    write_weights(path, network.state_dict(), metadata)
    return path


@pytest.mark.parametrize("resolution", ["half", "full"])
def test_exported_graphs_agree(
    resolution: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """What onnxruntime makes of frames; nothing but that it takes a while is said on the way."""
    weights, target = write_random(tmp_path / "w.safetensors"), tmp_path / "new" / "joint.onnx"
    words = ["polsep", "export", "joint", "--weights", str(weights), "-o", str(target)]
    monkeypatch.setattr(sys, "argv", words + ["--full"] * (resolution == "full"))
    cli.main()
    lines = capfd.readouterr().err.splitlines()  # on a slow machine others tell the progress
    assert lines[0] == "polsep: exporting joint, which takes a minute or a few"
    assert [path.name for path in target.parent.iterdir()] == ["joint.onnx"]
    session = onnxruntime.InferenceSession(target, providers=["CPUExecutionProvider"])
    network = load_joint(weights, torch.device("cpu"))
    generator = np.random.default_rng(4)
    for shape in ((1, 40, 64), (2, 36, 20)):
        raw = generator.integers(100, 5000, shape).clip(max=4095).astype(np.uint16)
        given = {"raw": raw, "black_level": np.float32([64]), "white_level": np.float32([4095])}
        diffuse, specular, error = session.run(["diffuse", "specular", "error"], given)
        found = run_joint(network, Mosaic(torch.from_numpy(raw), Layout(), 64.0, 4095.0), resolution == "full")
        assert found.expected_error is not None
        assert_within(torch.from_numpy(diffuse).movedim(-1, -3), found.diffuse, ROUNDED)
        assert_within(torch.from_numpy(specular).movedim(-1, -3).expand_as(found.specular), found.specular, ROUNDED)
        step = 2 if resolution == "full" else 1
        assert_within(torch.from_numpy(error).movedim(-1, -3), found.expected_error[..., ::step, ::step], ROUNDED)


def test_what_graphs_do_otherwise_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guided network's filters are written as convolutions; whole graphs of that kind take minutes to write."""
    graph = ExportedNetwork(Joint(3, SIZE, INPUTS, "guided"), full=True)
    raw = torch.randint(100, 4095, (1, 40, 56), generator=torch.Generator().manual_seed(4)).to(torch.uint16)
    levels = torch.tensor([64.0]), torch.tensor([4095.0])
    with torch.no_grad():
        expected = graph(raw, *levels)
        monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
        found = graph(raw, *levels)
    for one, other in zip(found, expected, strict=True):
        assert_within(one, other, ROUNDED)
    assert not torch.equal(found[0], expected[0])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["paper"], "expected a method of joint-large, joint, joint-fast, found 'paper'"),
        (["joint", "--weights", "nowhere"], "nowhere: expected a file, found nothing"),
        (["joint", "--weights", "w.safetensors", "--mono"], "expected weights for 1 colours"),
    ],
)
def test_bad_requests_are_one_line_and_leave_nothing(
    asked: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_random(Path("w.safetensors"))
    monkeypatch.setattr(sys, "argv", ["polsep", "export", *asked, "-o", "x.onnx"])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err
    assert not Path("x.onnx").exists()


def test_graphs_of_before_are_not_replaced_unasked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "joint.onnx"
    target.write_bytes(b"of before")
    monkeypatch.setattr(sys, "argv", ["polsep", "export", "joint", "-o", str(target)])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    assert (
        capsys.readouterr().err
        == f"polsep: error: expected no {target}, found one from before; --overwrite replaces it\n"
    )
    assert target.read_bytes() == b"of before"
