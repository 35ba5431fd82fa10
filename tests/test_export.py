"""The joint networks as ONNX files give what `polsep.separate` does in float32, for any size, without polsep."""

from __future__ import annotations

import json
import os
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import numpy.testing as npt
import pytest
import torch
from test_docs import ROOT, blocks
from tolerances import assert_within

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript", reason="exporting needs the extra 'export'")

import onnxruntime

import polsep
from polsep import cli
from polsep.in_torch import load_joint
from polsep.io.store.weights import shipped_weights, write_weights
from polsep.methods import METHODS
from polsep.networks.channels import INPUTS
from polsep.networks.export import OUTPUT_NAMES, ExportedNetwork
from polsep.networks.joint import Joint
from polsep.networks.run import run_joint
from polsep.networks.sizes import ResidualSize
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.report import in_light
from polsep.shipped import find_joint

LIGHT = (0.8, 1.0, 1.3)
SIZE = ResidualSize(4, (0, 1))
#: Rounding through two dozen layers, in white levels.
ROUNDED = 1e-4
#: What graphs may differ from the command line, of the white level.
AGREED = 2e-3


def write_random(path: Path, sees_frame: bool = False) -> Path:
    torch.manual_seed(2)
    network = Joint(3, SIZE, sees_frame=sees_frame)
    for weight in network.parameters():
        if weight.dim() > 1:
            torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    metadata = {"method": "joint", "colors": "3", "inputs": json.dumps(INPUTS), "size": json.dumps(asdict(SIZE))}
    write_weights(path, network.state_dict(), metadata | {"sees_frame": json.dumps(sees_frame)})
    return path


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["polsep", *words])
    cli.main()


def images_of(graph: Path, raw: np.ndarray, levels: tuple[float, float], light: tuple[float, ...]) -> list[np.ndarray]:
    """What onnxruntime makes of frames ``[N, H, W]``."""
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    given: dict[str, Any] = {"raw": raw, "light_color": np.float32(light)}
    given |= {name: np.float32([level]) for name, level in zip(("black_level", "white_level"), levels, strict=True)}
    return session.run(list(OUTPUT_NAMES), given)


def clipped_crop() -> tuple[np.ndarray, float]:
    """Of the rendered demo capture: an eighth of its samples clip, none is a defect."""
    capture = imagecodecs.imread(Path(polsep.__file__).parent / "data" / "still_life.png")
    return np.ascontiguousarray(capture[1120:1280, 1120:1360]), 4095.0


def highlight_crop() -> tuple[np.ndarray, float]:
    """Of the same: a ball whose highlight clips, under which the diffuse light is filled."""
    capture = imagecodecs.imread(Path(polsep.__file__).parent / "data" / "still_life.png")
    return np.ascontiguousarray(capture[1440:1600, 1680:1920]), 4095.0


def real_crop() -> tuple[np.ndarray, float]:
    """Of a photograph; skips where the data of docs/testsets.md are not here."""
    path = Path(os.environ.get("POLSEP_DATA", "nowhere")) / "raw" / "carlight_quadbayer_crop.png"
    if not path.exists():
        pytest.skip("needs POLSEP_DATA")
    return np.ascontiguousarray(imagecodecs.imread(path)[:240, :320]), 255.0


def assert_separated(
    found: list[np.ndarray], raw: np.ndarray, white: float, asked: dict[str, Any], filled: bool = False
) -> None:
    """The images of a graph are those of `polsep.separate` within a five-hundredth of the white level, everywhere."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", polsep.PolsepWarning)  # that an eighth clips
        expected = polsep.separate(raw, black_level=0, white_level=white, **asked)
    assert expected.error is not None
    found_around = ("defects", "colored_specular", "retained_polarization")
    assert {expected.report[name] for name in found_around} == {0} and expected.report["lamp_dolp"] == 1
    assert (expected.report["filled_under_highlights"] > 0) is filled
    step = 2 if asked.get("full") else 1
    npt.assert_allclose(found[0], expected.diffuse, rtol=0, atol=AGREED)
    npt.assert_allclose(found[1], expected.specular, rtol=0, atol=AGREED)
    npt.assert_allclose(found[2], expected.error[::step, ::step], rtol=AGREED, atol=AGREED)  # dozens where all clips
    npt.assert_array_equal(found[3], expected.valid)


def test_the_shipped_graph_is_what_the_command_line_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """`joint-fast` in onnxruntime, layers in float32 in both; and what the file says of itself."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    run(monkeypatch, "export", "joint-fast", "-o", str(tmp_path / "fast.onnx"))
    lines = capfd.readouterr().err.splitlines()  # on a slow machine others tell the progress
    assert lines[0] == "polsep: exporting joint-fast, which may take minutes"
    assert all("step" in line for line in lines[1:])
    metadata = onnxruntime.InferenceSession(tmp_path / "fast.onnx").get_modelmeta().custom_metadata_map
    assert metadata["name"] == "polsep joint-fast, colour frames, half resolution"
    assert (
        metadata["version"] == polsep.__version__
        and metadata["layout"] == Layout().spec
        and metadata["precision"] == "float32"
    )
    assert "1.0 = one measurement at the white level" in metadata["units"] and metadata["license"].startswith("MIT")
    asked = {"method": "joint-fast", "light_color": LIGHT}
    raw, white = clipped_crop()
    assert_separated([x[0] for x in images_of(tmp_path / "fast.onnx", raw[None], (0, white), LIGHT)], raw, white, asked)
    monkeypatch.chdir(tmp_path)
    np.save("shot.npy", raw)
    names: dict[str, Any] = {}
    exec(compile(blocks(ROOT / "docs" / "export.md", "python")[0], "export.md", "exec"), names)
    assert_separated([names[name][0] for name in OUTPUT_NAMES], raw, white, asked)  # the page's light is ours
    raw, white = highlight_crop()
    found = images_of(tmp_path / "fast.onnx", raw[None], (0, white), LIGHT)
    assert_separated([x[0] for x in found], raw, white, asked, filled=True)
    raw, white = real_crop()
    codes = raw[None].astype(np.uint16)
    assert_separated([x[0] for x in images_of(tmp_path / "fast.onnx", codes, (0, white), LIGHT)], raw, white, asked)


def test_layers_are_of_the_precision_that_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a process that has computed in another one."""
    raw, white = clipped_crop()
    mosaic, found = Mosaic(raw, Layout(), 0, white), {}
    for asked in ("f32", "i8", "f32"):
        monkeypatch.setenv("POLSEP_LAYERS", asked)
        image = METHODS["joint-fast"].run(mosaic, LIGHT, False).specular
        npt.assert_array_equal(image, found.setdefault(asked, image))
    assert not np.array_equal(found["f32"], found["i8"])
    monkeypatch.setenv("POLSEP_LAYERS", "f16")
    with pytest.raises(ValueError, match="expected POLSEP_LAYERS as bf16, f32, i8, i8-bf16, found 'f16'"):
        polsep.separate(raw, "joint-fast", white_level=white)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("method", "layout"), [("joint-large", "color"), ("joint", "color"), ("joint-large", "mono")])
@pytest.mark.parametrize("crop", [clipped_crop, highlight_crop, real_crop])
def test_graphs_are_the_whole_method(
    method: str, layout: str, full: bool, crop: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before they are written, which takes minutes: networks that are weighed, shifts that are averaged."""
    monkeypatch.setenv("POLSEP_LAYERS", "f32")
    raw, white = crop()
    if layout == "mono":
        height, width = raw.shape  # cells behind one of the two green filters of each period are a mono frame
        raw = np.ascontiguousarray(raw.reshape(height // 4, 2, 2, width // 4, 2, 2)[:, 0, :, :, 1])
        raw = raw.reshape(height // 2, width // 2)
    networks, _ = find_joint(method, Layout.parse(layout), None)
    graph = ExportedNetwork([Joint.of(network, torch.device("cpu")) for network in networks], full)
    lamp = (0.85, 1.0, 1.2)  # near enough to the frames' own that no specular colour is found
    light = [torch.tensor(lamp)] if layout == "color" else []
    with torch.no_grad():
        found = graph(torch.from_numpy(raw)[None], torch.tensor([0.0]), torch.tensor([white]), *light)
    asked = {"method": method, "layout": layout, "light_color": lamp, "full": full}
    assert_separated([image[0].numpy() for image in found], raw, white, asked, crop is highlight_crop)


def test_weights_of_users_are_those_of_the_method() -> None:
    """Others are refused by name; mono networks average shifts whether their file is named or not."""
    for method, name, said in (
        ("joint", "joint-fast-mosaic", "expected weights of joint in .*, found those of joint-fast"),
        ("joint-fast", "paper-mosaic", "expected weights of a joint network in .*, found those of paper"),
    ):
        with pytest.raises(ValueError, match=said):
            find_joint(method, Layout(), shipped_weights(name))
    for method in ("joint", "joint-fast"):
        layout = Layout.parse("mono")
        (own,), _ = find_joint(method, layout, shipped_weights(f"{method}-mono"))
        (shipped,), _ = find_joint(method, layout, None)
        assert own.averages_shifts == shipped.averages_shifts == (method == "joint")
    both, _ = find_joint("joint-large", Layout.parse("mono"), None)
    assert len(both) == 2 and all(network.averages_shifts for network in both)  # else even light has a pattern


def test_full_graphs_take_batches_of_any_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of networks that see the whole frame, in a thumbnail of one size."""
    weights, target = write_random(tmp_path / "w.safetensors", sees_frame=True), tmp_path / "new" / "joint.onnx"
    run(monkeypatch, "export", "joint", "--weights", str(weights), "-o", str(target), "--full")
    assert [path.name for path in target.parent.iterdir()] == ["joint.onnx"]
    network = load_joint(weights, torch.device("cpu"))
    generator = np.random.default_rng(4)
    for shape in ((1, 40, 64), (2, 36, 20), (1, 300, 520)):  # the last has more places than a thumbnail has cells
        # So many cells clip that no hole is filled, and so few samples that nothing is smoothed.
        raw = generator.integers(100, 4500, shape).clip(max=4095).astype(np.uint16)
        found = [torch.from_numpy(image) for image in images_of(target, raw, (64, 4095), LIGHT)]
        mosaic = Mosaic(torch.from_numpy(raw), Layout(), 64.0, 4095.0, LIGHT)
        expected = in_light(run_joint(network, mosaic, full=True), LIGHT)
        assert expected.expected_error is not None
        for image, wanted in zip(found, (expected.diffuse, expected.specular), strict=False):
            assert_within(image.movedim(-1, -3), wanted, ROUNDED)
        assert_within(found[2].movedim(-1, -3), expected.expected_error[..., ::2, ::2], ROUNDED)
        assert torch.equal(found[3], expected.valid)


def test_what_graphs_do_otherwise_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """A guided network's filters are written as convolutions; whole graphs of that kind take minutes to write."""
    graph = ExportedNetwork([Joint(3, SIZE, INPUTS, "guided")], full=True)
    raw = torch.randint(100, 4095, (1, 40, 56), generator=torch.Generator().manual_seed(4)).to(torch.uint16)
    levels = torch.tensor([64.0]), torch.tensor([4095.0]), torch.tensor(LIGHT)
    with torch.no_grad():
        expected = graph(raw, *levels)
        monkeypatch.setattr(torch.compiler, "is_exporting", lambda: True)
        found = graph(raw, *levels)
    for one, other in zip(found, expected, strict=True):
        assert_within(one.float(), other.float(), ROUNDED)
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


def test_outputs_are_onnx_files_apart_from_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before minutes of work, and so that no mistyped name costs a network."""
    weights = tmp_path / "w.safetensors"
    write_random(weights)
    linked, before = tmp_path / "w.onnx", weights.read_bytes()
    linked.symlink_to(weights)
    for target, said in ((weights, "expected an output that ends in .onnx"), (linked, "is an input")):
        asked = ["export", "joint", "--weights", str(weights), "-o", str(target), "--overwrite"]
        monkeypatch.setattr(sys, "argv", ["polsep", *asked])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        assert stopped.value.code == 2 and said in capsys.readouterr().err
    assert weights.read_bytes() == before and linked.is_symlink()


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
