"""The plugin of napari: its manifest, layers of files without napari, and the panel where napari and a screen are."""

from __future__ import annotations

import os
import sys
import time
import tomllib
import warnings
from dataclasses import replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polsep
from polsep.io.raw.frames import ReadOptions
from polsep.io.results.previews import aolp_wheel
from polsep.io.results.separation_reader import read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.results.sidecars import read_report
from polsep.io.store.errors import InputError
from polsep.io.store.samples import sample_folder
from polsep.view.napari.layers import FACTS, find_reader, read_demo, read_layers

ROOT = Path(__file__).resolve().parents[1]
MANIFEST = Path(polsep.__file__).parent / "view" / "napari" / "napari.yaml"

needs_npe2 = pytest.mark.skipif(find_spec("npe2") is None, reason="npe2 is not installed: make optional")
#: napari's libraries warn of their own ways.
theirs = pytest.mark.filterwarnings("ignore:::(?!polsep)")
needs_napari = pytest.mark.skipif(
    find_spec("napari") is None or not (os.environ.get("DISPLAY") or sys.platform in ("win32", "darwin")),
    reason="napari (extra napari) or a display is missing: xvfb-run pytest tests/test_napari.py",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The colour sample separated at half and at full resolution, and as NPZ."""
    found = tmp_path_factory.mktemp("separated")
    raw = next(polsep.read_frames(sample_folder() / "color.png", ReadOptions(white_level=4095))).data
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        half = polsep.separate(raw, "analytic")
        polsep.separate(raw, "analytic", full=True).save(found / "full.exr")
        polsep.separate(sample("wrong_layout"), "analytic", white_level=4095).save(found / "wrong.exr")
    for name in ("half.exr", "arrays.npz", "frame_000001.exr", "frame_000002.exr"):
        half.save(found / name)
    np.savez(found / "raw.npz", raw=sample("color"))
    return found


def sample(name: str) -> np.ndarray:
    """Samples of a sample frame, 12 bits."""
    frame = next(polsep.read_frames(sample_folder() / f"{name}.png", ReadOptions(white_level=4095)))
    return np.asarray(frame.data.data).astype(np.uint16)


@theirs
@needs_npe2
def test_the_manifest_is_valid_and_names_what_exists() -> None:
    """As npe2 reads it; each command is a function of the package."""
    manifest = import_module("npe2").PluginManifest.from_file(MANIFEST)
    assert manifest.name == "polsep"
    for command in manifest.contributions.commands:
        module, name = command.python_name.split(":")
        assert find_spec(module) is not None
        assert name == "make_panel" or callable(getattr(import_module(module), name))


def test_napari_finds_the_manifest() -> None:
    """By the package's entry point, in a file that ships."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, file = project["entry-points"]["napari.manifest"]["polsep"].split(":")
    assert ROOT / Path(*module.split(".")) / file == MANIFEST
    assert MANIFEST.is_file()


def test_layers_hold_the_images_of_the_file(folder: Path) -> None:
    """Bit for bit, named, the top one last, in one exposure; angles in degrees."""
    layers = {shown["name"]: (data, shown, kind) for data, shown, kind in read_layers(str(folder / "half.exr"))}
    frame = read_separated(folder / "half.exr")
    assert list(layers) == [f"half {name}" for name in ("not valid", "AoLP", "DoLP", "specular", "diffuse")]
    for name in ("diffuse", "specular"):
        np.testing.assert_array_equal(layers[f"half {name}"][0], getattr(frame, name))
        assert layers[f"half {name}"][1]["rgb"]
    np.testing.assert_array_equal(layers["half DoLP"][0], frame.dolp)
    np.testing.assert_array_equal(layers["half AoLP"][0], np.degrees(frame.aolp))
    np.testing.assert_array_equal(layers["half not valid"][0] == 0, frame.valid)
    limits = {layers[f"half {name}"][1]["contrast_limits"] for name in ("diffuse", "specular")}
    assert len(limits) == 1
    assert {name: kind for name, (_, _, kind) in layers.items() if kind != "image"} == {"half not valid": "labels"}


def test_colours_of_angles_are_those_of_the_preview_and_cyclic(folder: Path) -> None:
    shown = read_layers(str(folder / "half.exr"))[1][1]
    colors = shown["colormap"]["colors"]
    np.testing.assert_array_equal(colors[0], colors[-1])
    np.testing.assert_array_equal(np.rint(255 * colors[45]), aolp_wheel(np.pi / 4))
    assert shown["contrast_limits"] == (0, 180)


def test_cells_lie_on_their_samples(folder: Path) -> None:
    """A pixel of half resolution is two samples wide, its centre between theirs; one of full resolution is a sample."""
    for name, scale, start in (("half", 2, 0.5), ("full", 1, 0), ("frame_000001", 2, 0.5)):
        for data, shown, _ in read_layers(str(folder / f"{name}.exr")):
            first = np.array(shown.get("translate", (0, 0)))
            assert (first == start).all()
            assert shown.get("scale", (1, 1)) == (scale, scale)
            last = first + (np.array(data.shape[:2]) - 1) * scale
            np.testing.assert_array_equal(last + start, np.array(sample("color").shape) - 1)


def test_warnings_of_the_report_come_along(folder: Path) -> None:
    facts = read_layers(str(folder / "wrong.exr"))[0][1]["metadata"][FACTS]
    assert any("--layout" in warning for warning in facts["warnings"])
    assert facts["method"] == "analytic"


def test_a_file_without_a_report_is_read(folder: Path, tmp_path: Path) -> None:
    """Its resolution is unknown, so a pixel is one unit; damaged reports are as none."""
    path = tmp_path / "half.exr"
    path.write_bytes((folder / "half.exr").read_bytes())
    plain = read_layers(str(path))
    assert all("scale" not in shown for _, shown, _ in plain)
    for text in ("{", "[]", '{"report": 3}'):
        path.with_suffix(".json").write_text(text)
        assert read_report(path) == {}


def test_several_files_are_a_stack(folder: Path) -> None:
    """Along a new first axis, of which the others' places do not change."""
    paths = [str(folder / f"frame_00000{k}.exr") for k in (1, 2)]
    data, shown, _ = read_layers(paths)[-1]
    assert data.shape == (2, 172, 204, 3)
    assert shown["name"] == "frame diffuse"
    assert (shown["scale"], shown["translate"]) == ((1, 2, 2), (0, 0.5, 0.5))
    with pytest.raises(ValueError, match="expected images of one size to stack"):
        read_layers([paths[0], str(folder / "full.exr")])


def test_stacks_have_the_layers_that_all_frames_have(folder: Path, tmp_path: Path) -> None:
    """A black frame among them has no polarization to show."""
    frame = read_separated(folder / "frame_000001.exr")
    black = replace(frame, diffuse=0 * frame.diffuse, specular=0 * frame.specular, dolp=0 * frame.dolp, report={})
    write_separation(black, tmp_path, "black", "exr")
    both = read_layers([str(folder / "frame_000001.exr"), str(tmp_path / "black.exr")])
    assert [shown["name"].split()[-1] for _, shown, _ in both] == ["specular", "diffuse"]


def test_archives_hold_separated_or_raw_frames(folder: Path) -> None:
    np.testing.assert_array_equal(
        read_layers(str(folder / "arrays.npz"))[-1][0], read_separated(folder / "half.exr").diffuse
    )
    ((data, shown, _),) = read_layers(str(folder / "raw.npz"))
    np.testing.assert_array_equal(data, sample("color"))
    assert shown["metadata"][FACTS]["layout"] == "90,45,135,0/RGGB"


def test_other_files_are_left_to_others_or_refused(tmp_path: Path) -> None:
    assert find_reader(str(tmp_path / "shot.png")) is None
    assert find_reader([str(tmp_path / "a.exr"), str(tmp_path / "b.txt")]) is None
    (tmp_path / "a.exr").write_bytes(b"none")
    read = find_reader(str(tmp_path / "a.exr"))
    assert read is not None
    with pytest.raises(InputError, match=r"a\.exr: expected"):
        read(str(tmp_path / "a.exr"))


def test_the_sample_knows_its_levels() -> None:
    ((data, shown, kind),) = read_demo()
    assert data.shape == (2048, 2448)
    assert kind == "image"
    assert shown["metadata"][FACTS]["white"] == 4095 == shown["contrast_limits"][1]


@pytest.fixture
def viewer() -> Any:
    """A window of napari, closed when the test ends."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = import_module("napari").Viewer(show=False)
        yield found
        found.close()


def wait_for(panel: Any) -> str:
    """What the panel says when it has ended."""
    from qtpy.QtWidgets import QApplication

    end = time.monotonic() + 120
    while not panel.button.enabled and time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.01)
    return str(panel.status.value)


@theirs
@needs_napari
def test_the_panel_separates_what_is_shown(viewer: Any) -> None:
    """The second frame of a stack as `polsep.separate` does, in another thread; again, its layers are replaced."""
    from polsep.view.napari.panel import make_panel

    frames = np.stack([sample("clipped"), sample("color")])
    viewer.add_image(frames, name="shots", scale=(1, 3, 3), translate=(0, 6, 0))
    container = make_panel()
    viewer.window.add_dock_widget(container)
    viewer.dims.set_point(0, 1)
    panel = container.panel
    panel.fields["method"].value, panel.fields["white"].value = "analytic", "4095"
    for _ in range(2):
        panel.separate()
        assert not panel.button.enabled
        assert "Separated by analytic" in wait_for(panel)
        assert len(viewer.layers) == 6
    expected = polsep.separate(frames[1], "analytic", white_level=4095)
    np.testing.assert_array_equal(viewer.layers["shots specular"].data, expected.specular)
    assert tuple(viewer.layers["shots specular"].scale) == (6, 6)
    assert tuple(viewer.layers["shots specular"].translate) == (7.5, 1.5)
    assert viewer.canvas.grid.enabled


@theirs
@needs_napari
def test_the_panel_takes_levels_from_the_layer_and_says_what_is_wrong(viewer: Any, folder: Path) -> None:
    from polsep.view.napari.panel import make_panel

    panel = make_panel().panel
    viewer.window.add_dock_widget(panel.container)
    panel.separate()
    assert "Open a raw frame" in panel.status.value
    for data, shown, _ in read_demo():
        viewer.add_image(data[:344, :408], **shown)
    assert panel.fields["white"].value == "4095"
    panel.fields["method"].value = "analytic"
    for name, value, said in (
        ("white", "bright", "expected a number as white level, found 'bright'"),
        ("white", "-3", "expected a white level above the black level"),
        ("light", "blue", "expected a light colour"),
    ):
        before, panel.fields[name].value = panel.fields[name].value, value
        panel.separate()
        assert said in wait_for(panel)
        panel.fields[name].value = before
    panel.layout.value, panel.filters.value = "other", "1,2,3"
    panel.separate()
    assert "expected" in wait_for(panel)
    panel.layout.value = "color"
    viewer.layers.clear()
    for data, shown, kind in read_layers(str(folder / "half.exr")):
        viewer.add_layer(import_module("napari").layers.Layer.create(data, shown, kind))
    panel.separate()
    assert "which was separated" in panel.status.value


@theirs
@needs_napari
def test_warnings_are_shown(viewer: Any) -> None:
    """In the panel, in its words."""
    from polsep.view.napari.panel import make_panel

    viewer.add_image(sample("wrong_layout"), name="shot")
    panel = make_panel().panel
    viewer.window.add_dock_widget(panel.container)
    panel.fields["method"].value = "analytic"
    panel.separate()
    said = wait_for(panel)
    assert "say White level 4095 if so" in said
    assert "Filter layout 90,45,135,0/GBRG@1,1" in said
