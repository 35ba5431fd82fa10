"""Examples for other programs: Blender's add-on, GStreamer's element, the ROS node and Nuke's gizmo.

Blender and GStreamer run where they are installed. Of ROS there is only a stand-in, of Nuke nothing.
"""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
import sysconfig
import tomllib
import types
import warnings
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

import polsep
from polsep.io.assets.materials import metallic_maps
from polsep.io.results.exr import read_exr_layers
from polsep.io.store.samples import sample_folder
from polsep.physics.srgb import srgb

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
#: A Python with bpy, as of `pip install bpy==5.0.1` in an environment of its own.
BLENDER = os.environ.get("POLSEP_BLENDER", "")
#: Where Debian keeps PyGObject, which an environment of the same Python can use too.
DEBIAN = Path("/usr/lib/python3/dist-packages/gi")

#: Runs inside Blender: the numbers of all images after saving and loading, and what a render shows.
INSIDE = """
import bpy, importlib.util, json, sys
from pathlib import Path
import numpy as np
sys.path += map(str, Path(bpy.utils.resource_path("LOCAL")).glob("python/lib/python3*/site-packages"))
spec = importlib.util.spec_from_file_location("polsep_import", sys.argv[1])
addon = importlib.util.module_from_spec(spec); spec.loader.exec_module(addon)
bpy.ops.wm.read_factory_settings(use_empty=True)
addon.register()
found = {"bad": None}
try:
    bpy.ops.import_scene.polsep(filepath=sys.argv[3])
except RuntimeError as error:
    found["bad"] = str(error)
assert bpy.ops.import_scene.polsep(filepath=sys.argv[2]) == {"FINISHED"}
plane = bpy.context.view_layer.objects.active
found["size"] = list(plane.dimensions)
scene = bpy.context.scene
scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
scene.collection.objects.link(scene.camera)
scene.camera.location, scene.camera.rotation_euler = (0, -3, 0), (np.pi / 2, 0, 0)
scene.camera.data.type, scene.camera.data.ortho_scale = "ORTHO", plane.dimensions[0]
scene.render.resolution_x, scene.render.resolution_y = 51, 43
scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", 1, "CPU"
scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
nodes = plane.data.materials[0].node_tree.nodes
for name, gains in {"both": (1, 1), "diffuse": (1, 0), "specular": (0, 1)}.items():
    for part, gain in zip(("Diffuse", "Specular"), gains):
        nodes[f"{part} gain"].outputs[0].default_value = gain
    scene.render.filepath = str(Path(sys.argv[4]) / name)
    bpy.ops.render.render(write_still=True)
blend = str(Path(sys.argv[4]) / "saved.blend")
bpy.ops.wm.save_as_mainfile(filepath=blend)
bpy.ops.wm.open_mainfile(filepath=blend)
for image in bpy.data.images:
    if image.name.startswith("shot "):
        values = np.empty(image.size[0] * image.size[1] * 4, np.float32)
        image.pixels.foreach_get(values)
        values = values.reshape(image.size[1], image.size[0], 4)[::-1, :, :3]
        np.save(Path(sys.argv[4]) / f"{image.name[5:]}.npy", values)
addon.unregister()
print("FOUND " + json.dumps(found))
"""


def sample() -> np.ndarray:
    """The colour sample, 12 bits."""
    frame = next(polsep.read_frames(sample_folder() / "color.png", polsep.ReadOptions(white_level=4095)))
    return np.asarray(frame.data.data).astype(np.uint16)


def separated(raw: np.ndarray, method: str, layout: str = "color") -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return polsep.separate(raw, method, layout, white_level=4095, light_color="white")


def test_the_addon_says_what_blender_wants() -> None:
    """The manifest has what Blender's schema 1.0.0 requires, and polsep's version."""
    manifest = tomllib.loads((EXAMPLES / "blender" / "blender_manifest.toml").read_text(encoding="utf-8"))
    wanted = "schema_version id version name tagline maintainer type blender_version_min license"
    assert set(wanted.split()) <= set(manifest)
    assert manifest["version"] == polsep.__version__
    assert len(manifest["tagline"]) <= 64
    assert not manifest["tagline"].endswith(".")
    assert re.fullmatch(r"[a-z_]+", manifest["id"])


def addon_maps(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The add-on's `principled_maps`, which needs no Blender: stand-ins for what the module imports."""
    stand_in, helper = MagicMock(), types.SimpleNamespace(ImportHelper=type("ImportHelper", (), {}))
    stand_in.types.Operator = type("Operator", (), {})
    for name, module in (("bpy", stand_in), ("bpy_extras", MagicMock()), ("bpy_extras.io_utils", helper)):
        monkeypatch.setitem(sys.modules, name, module)
    return runpy.run_path(str(EXAMPLES / "blender" / "__init__.py"))["principled_maps"]


def test_blender_gets_metal_as_the_glb_file_has_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gold is metallic with its reflectance as colour, glass is not; level times tint is the reflectance over 0.08."""
    random = np.random.default_rng(1).random((2, 5, 3), np.float32)
    specular = np.concatenate(
        [random, [[(0.04, 0.04, 0.04), (1.0, 0.7, 0.3), (0, 0, 0), (0.1, 0.15, 0.2), (0.3,) * 3]]]
    )
    layers = {"diffuse": 0.5 * specular[::-1].astype(np.float32), "specular": specular.astype(np.float32)}
    found, wanted = addon_maps(monkeypatch)(layers), metallic_maps(layers)
    np.testing.assert_allclose(found["metallic"], wanted["metallic"], atol=1e-6)
    np.testing.assert_allclose(found["base color"], wanted["diffuse"], atol=1e-6)
    np.testing.assert_allclose(0.08 * found["level"] * found["tint"], wanted["specular"], atol=1e-6)
    np.testing.assert_allclose(found["base color"][2, 1], (1, 0.7, 0.3), atol=1e-6)
    assert found["level"][2, 0] == pytest.approx(0.5) and found["metallic"][2, 0] == 0 and found["tint"][2, 2, 0] == 1


def test_blender_gets_the_strength_of_shapes_as_glass(monkeypatch: pytest.MonkeyPatch) -> None:
    """A strength of 1 is the Principled node's default level 0.5; files of `polsep geometry` have none."""
    maps, albedo = addon_maps(monkeypatch), np.ones((2, 2, 3), np.float32)
    found = maps({"albedo": albedo, "specular": np.full((2, 2, 1), 1, np.float32)})
    assert list(found) == ["level"] and (found["level"] == 0.5).all()
    assert maps({"albedo": albedo}) == {}


@pytest.mark.skipif(not BLENDER, reason="no Blender: POLSEP_BLENDER names a Python with bpy, see docs/places.md")
def test_blender_imports_shows_and_keeps_a_separation(tmp_path: Path) -> None:
    """Every sample equal, also from the saved .blend; renders of each gain are the layers; the plane has the aspect."""
    frame = separated(sample(), "analytic")
    frame.save(tmp_path / "shot.exr")
    (tmp_path / "bad.exr").write_bytes(b"none")
    addon = EXAMPLES / "blender" / "__init__.py"
    words = [BLENDER, "-c", INSIDE, addon, tmp_path / "shot.exr", tmp_path / "bad.exr", tmp_path]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=clean)
    found = json.loads(next(line for line in done.stdout.splitlines() if line.startswith("FOUND "))[6:])
    assert "bad.exr: expected an EXR file" in found["bad"]
    np.testing.assert_allclose(found["size"], (204 / 172, 0, 1), atol=1e-6)
    for name in ("diffuse", "specular"):
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy"), getattr(frame, name))
    for name in ("dolp", "aolp", "valid"):
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy")[..., 0], getattr(frame, name))
    lit = {"both": frame.diffuse + frame.specular, "diffuse": frame.diffuse, "specular": frame.specular}
    for name, image in lit.items():
        layers = read_exr_layers(tmp_path / f"{name}.exr")
        shown = np.stack([layers[color] for color in "RGB"], axis=-1)
        np.testing.assert_allclose(shown.mean((0, 1)), image.mean((0, 1)), rtol=0.05, atol=1e-3)


def gstreamer(folder: Path) -> dict[str, str]:
    """The environment in which GStreamer's Python is found; skips without."""
    paths = [str(ROOT)]
    if (DEBIAN / f"_gi{sysconfig.get_config_var('EXT_SUFFIX')}").exists():
        (folder / "paths").mkdir()
        (folder / "paths" / "gi").symlink_to(DEBIAN)
        paths.append(str(folder / "paths"))
    found = {**os.environ, "PYTHONPATH": os.pathsep.join([*paths, os.environ.get("PYTHONPATH", "")])}
    found["GST_REGISTRY"] = str(folder / "registry.bin")
    needs = "import gi; gi.require_version('GstVideo', '1.0'); from gi.repository import Gst, GstVideo; Gst.Buffer.map"
    if subprocess.run([sys.executable, "-c", needs], env=found, capture_output=True, check=False).returncode:
        pytest.skip("no GStreamer in Python: apt install python3-gst-1.0")
    return found


@pytest.mark.parametrize(
    ("caps", "bits", "image"),
    [
        ("video/x-raw,format=GRAY16_LE", 16, "specular"),
        ("video/x-raw,format=GRAY8", 8, "diffuse"),
        ("video/x-bayer,format=rggb", 8, "diffuse"),
    ],
)
def test_gstreamer_shows_what_the_method_finds(caps: str, bits: int, image: str, tmp_path: Path) -> None:
    """Two frames of a pipeline are the images of `color-affine` in sRGB, in rows padded to four bytes.

    But where the library repairs a defect or fills under a highlight, which streams do not.
    """
    environment = gstreamer(tmp_path)
    raw = np.ascontiguousarray(sample()[:344, :404])
    raw, white = (raw, 4095) if bits == 16 else ((raw >> 4).astype(np.uint8), 255)
    (tmp_path / "raw").write_bytes(raw.tobytes() * 2)
    pipeline = (
        f"filesrc location={tmp_path}/raw blocksize={raw.nbytes} ! {caps},width=404,height=344,framerate=25/1 ! "
        f"polsep image={image} white-level={white} ! filesink location={tmp_path}/out"
    )
    words = [sys.executable, str(EXAMPLES / "polsep_gst.py"), pipeline]
    subprocess.run(words, env=environment, check=True, capture_output=True)
    rows = np.fromfile(tmp_path / "out", np.uint8).reshape(2, 172, 608)
    shown = rows[:, :, : 202 * 3].reshape(2, 172, 202, 3).astype(int)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = polsep.separate(raw, "color-affine", white_level=white, light_color="white")
    wanted = np.rint(255 * srgb(getattr(expected, image)))
    assert (np.abs(shown - wanted) > 1).mean() < 0.01
    np.testing.assert_array_equal(shown[0], shown[1])


def test_gstreamer_says_what_is_wrong(tmp_path: Path) -> None:
    environment = gstreamer(tmp_path)
    words = [sys.executable, str(EXAMPLES / "polsep_gst.py"), "videotestsrc_none ! polsep"]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "polsep_gst: error: expected a pipeline" in done.stderr


@pytest.mark.parametrize(
    ("wrong", "said"),
    [("layout=foo", 'expected "color", "mono"'), ("white-level=-5", "expected a white level above the black level")],
)
def test_gstreamer_refuses_in_one_line(wrong: str, said: str, tmp_path: Path) -> None:
    """A traceback for every frame, and the exit status of success."""
    frames = "videotestsrc num-buffers=2 ! video/x-raw,format=GRAY8,width=64,height=48"
    words = [sys.executable, str(EXAMPLES / "polsep_gst.py"), f"{frames} ! polsep {wrong} ! fakesink"]
    done = subprocess.run(words, env=gstreamer(tmp_path), capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert f"polsep_gst: error: {said}" in done.stderr


def test_gstreamer_takes_frames_of_odd_sides(tmp_path: Path) -> None:
    """Whole cells of them, as everything else."""
    frames = "videotestsrc num-buffers=2 ! video/x-raw,format=GRAY8,width=65,height=49"
    words = [sys.executable, str(EXAMPLES / "polsep_gst.py"), f"{frames} ! polsep ! filesink location={tmp_path}/out"]
    subprocess.run(words, env=gstreamer(tmp_path), check=True, capture_output=True)
    assert (tmp_path / "out").stat().st_size == 2 * 24 * 32 * 3


class Image(types.SimpleNamespace):
    """Stands in for the message of ROS."""


class Node:
    """Stands in for the node of ROS: parameters, and what is published and logged."""

    said: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.published: dict[str, Any] = {}
        self.errors: list[str] = []

    def declare_parameter(self, name: str, value: Any) -> Any:
        return types.SimpleNamespace(value=self.said.get(name, value))

    def create_publisher(self, kind: type, name: str, profile: Any) -> Any:
        return types.SimpleNamespace(publish=lambda message: self.published.__setitem__(name, message))

    def create_subscription(self, kind: type, name: str, callback: Any, profile: Any) -> None:
        self.receive = callback

    def get_logger(self) -> Any:
        return types.SimpleNamespace(error=lambda text, **_: self.errors.append(text))


@pytest.mark.parametrize("layout", ["color", "mono"])
@pytest.mark.parametrize("big", [False, True])
def test_the_ros_node_publishes_both_images(layout: str, big: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a stand-in of ROS: images of the stream function, with the frame's header; what is wrong is logged."""
    for name, parts in {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"Image": Image},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(parts)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(Node, "said", {"layout": layout, "white_level": 4095.0})
    node = runpy.run_path(str(EXAMPLES / "polsep_ros.py"))["Separator"]()
    raw = sample()
    rows = np.zeros((344, 820), np.uint8)  # padded
    rows[:, :816] = raw.astype(">u2" if big else "<u2").view(np.uint8)
    message = Image(
        header="h", height=344, width=408, encoding="mono16", is_bigendian=big, step=820, data=rows.tobytes()
    )
    node.receive(message)
    assert node.errors == []
    frame = separated(raw, "color-affine" if layout == "color" else "analytic", layout)
    for name, sent in node.published.items():
        image = getattr(frame, name)
        assert (sent.header, sent.encoding, sent.step) == ("h", f"32FC{image.shape[2]}", 4 * 204 * image.shape[2])
        shown = np.frombuffer(sent.data, "<f4").reshape(image.shape)
        assert (np.abs(shown - image) > 1e-5).mean() < 0.01  # but for a repaired defect
    assert set(node.published) == {"diffuse", "specular"}
    node.receive(Image(**{**vars(message), "encoding": "rgb8"}))
    assert node.errors == ["expected an encoding of mono8, bayer_rggb8, mono16, bayer_rggb16, found 'rgb8'"]


def test_the_gizmo_names_layers_knobs_and_nodes_that_exist(tmp_path: Path) -> None:
    """Braces balance, every pushed variable was set, layers are those of the file, expressions name its knobs."""
    text = (EXAMPLES / "nuke" / "PolsepLayers.gizmo").read_text(encoding="utf-8")
    assert text.count("{") == text.count("}")
    assert set(re.findall(r"^push \$(\w+)", text, re.MULTILINE)) == set(re.findall(r"^set (\w+)", text, re.MULTILINE))
    knobs = set(re.findall(r"addUserKnob \{\d+ (\w+)", text))
    assert set(re.findall(r"parent\.(\w+)", text)) == knobs - {"polsep"}
    separated(sample(), "analytic").save(tmp_path / "shot.exr")
    layers = {name.partition(".")[0] for name in read_exr_layers(tmp_path / "shot.exr") if "." in name}
    assert set(re.findall(r"^  in (\w+)", text, re.MULTILINE)) <= layers
