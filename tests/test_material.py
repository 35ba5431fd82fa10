"""Materials from photographs: random ones, the network, files, and what is refused."""

from __future__ import annotations

import json
import re
import struct
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

from evaluation.material import novel_lights, score_failure, score_maps, score_relit
from polsep.cli.app import main
from polsep.io.assets.materials import encode_glb, encode_materialx, metallic_maps, specular_scale, texture_pixels
from polsep.io.raw.frames import ReadOptions
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.weights import write_weights
from polsep.material.estimate import load_estimator
from polsep.material.files import MaterialOptions, Photographs, find_white, flatness_notes, read_photographs
from polsep.material.network import MaterialNetwork, MaterialSize, detail_cues, encode_images
from polsep.material.procedural import halve, random_svbrdf
from polsep.material.shots import CAMERA, photograph, random_example, random_flash
from polsep.material.svbrdf import CAMERA_HEIGHT, INPUTS, Svbrdf, plane_points, relight, unstack
from polsep.physics.gltf import GLASS
from polsep.physics.srgb import srgb
from polsep.render.sphere_tracing import PointLight
from polsep.separation.report import SeparatedFrame
from polsep.train.material_losses import material_loss

SMALL = MaterialSize(4, (1, 2, 2))


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def small_network(inputs: int = 6) -> MaterialNetwork:
    torch.manual_seed(1)
    return MaterialNetwork(inputs, SMALL)


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Weights of an untrained network, in a file as `polsep train material` writes it."""
    path = tmp_path / "small.safetensors"
    size = json.dumps({"width": SMALL.width, "growth": SMALL.growth})
    write_weights(path, small_network().state_dict(), {"method": "material", "input": "separated", "size": size})
    return path


@pytest.fixture
def frame(tmp_path: Path) -> Path:
    """A raw frame of a random material, 64x64, 12 bits in 16."""
    mosaic, _, _ = photograph(random_svbrdf(64, seeded(4)), random_flash(seeded(5)), seeded(6))
    path = tmp_path / "flash.npy"
    np.save(path, mosaic.data.astype(np.uint16))
    return path


def run(arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit status of the program."""
    monkeypatch.setattr(sys, "argv", ["polsep", *arguments])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def test_random_materials_are_materials() -> None:
    """Unit normals that look up, all else within bounds, white specular maps but for metals; a seed is a material."""
    for seed in range(6):
        maps = random_svbrdf(48, seeded(seed))
        again = random_svbrdf(48, seeded(seed))
        assert torch.equal(maps.stack(), again.stack())
        torch.testing.assert_close(maps.normal.square().sum(dim=0), torch.ones(48, 48))
        assert float(maps.normal[2].min()) > 0.3
        assert float(maps.diffuse.min()) >= 0 and float(maps.diffuse.max()) <= 1
        assert float(maps.roughness.min()) >= 0.1199 and float(maps.roughness.max()) <= 1
        assert float(maps.specular.min()) > 0.005
        if float(maps.specular.max()) < 0.2:  # a dielectric
            assert float(maps.specular.max()) < 0.11
            assert bool((maps.specular == maps.specular[:1]).all())


def test_halving_keeps_what_is_even() -> None:
    """A material that is the same everywhere is the same at half resolution, and normals stay unit vectors."""
    maps = random_svbrdf(32, seeded(2))
    small = halve(maps)
    torch.testing.assert_close(small.normal.square().sum(dim=0), torch.ones(16, 16))
    torch.testing.assert_close(small.diffuse[:, 3, 5], maps.diffuse[:, 6:8, 10:12].mean(dim=(1, 2)))


def test_white_paper_is_white_in_a_photograph() -> None:
    """Diffuse light of albedo 1 in the middle, over the level of white, is 1 but for what polarization changes."""
    flat = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1).expand(3, 64, 64)
    paper = Svbrdf(flat, torch.full((3, 64, 64), 0.96), torch.ones(1, 64, 64), torch.full((3, 64, 64), 0.04))
    for position in ((0.0, 0.0, 2.7), (0.5, -0.8, 2.0)):
        _, scene, white = photograph(paper, PointLight(position, 1.0, 0.3), seeded(1))
        middle = float(scene.diffuse.s0[:, 30:34, 30:34].mean()) / white
        assert middle == pytest.approx(0.96, abs=0.06)


def test_the_camera_sees_the_whole_plane() -> None:
    """The plane's border is the frame's border."""
    height = CAMERA.position[2]
    assert height * np.tan(np.radians(CAMERA.fov_deg / 2)) == pytest.approx(1)


def test_examples_hold_every_input() -> None:
    """The perfect input is what the separated one estimates, and both add up to the unseparated one where unclipped."""
    example = random_example("test", 0, 1, 1)
    parts = {name: example.views[0, part] for name, part in INPUTS.items()}
    assert parts["unseparated"].shape == (3, 128, 128)
    total = {name: parts[name][:3] + parts[name][3:] for name in ("separated", "perfect")}
    for sums in total.values():
        difference = (sums - parts["unseparated"]).abs().flatten().median()
        assert float(difference) < 0.05 * float(parts["unseparated"].median())
    assert example.maps.shape == (9, 128, 128)


def test_order_of_views_does_not_matter() -> None:
    """What is pooled over views does not know which came first; how many there are does matter."""
    network = small_network().eval()
    views = torch.rand(2, 3, 6, 32, 32, generator=seeded(8))
    with torch.no_grad():
        found = network(views)
        torch.testing.assert_close(network(views[:, [2, 0, 1]]), found)
        assert not torch.allclose(network(views[:, :1]), found, atol=1e-4)


def test_the_network_takes_any_size() -> None:
    """Sides that are no multiples of its halvings."""
    found = small_network()(torch.rand(1, 2, 6, 37, 50, generator=seeded(8)))
    assert found.shape == (1, 9, 37, 50)


def test_what_the_network_says_is_a_material() -> None:
    """Normals look up, the rest is in [0, 1], even for absurd inputs, and gradients are finite."""
    network = small_network()
    views = torch.exp(12 * torch.randn(1, 2, 6, 32, 32, generator=seeded(3))).requires_grad_()
    maps = unstack(network(views).detach())
    assert float(maps.normal[:, 2].min()) > 0
    for values in (maps.diffuse, maps.roughness, maps.specular):
        assert float(values.min()) >= 0 and float(values.max()) <= 1
    material_loss(network(views), torch.rand(1, 9, 32, 32, generator=seeded(4)) * 0.5, seeded(1)).backward()
    gradients = [p.grad for p in network.parameters() if p.grad is not None] + [views.grad]
    assert all(g is not None and bool(torch.isfinite(g).all()) for g in gradients)
    assert len(gradients) > 20


def test_places_count_as_the_plane_does() -> None:
    """The last two channels that the network sees are x and y: left is -1, the top row 1."""
    seen = encode_images(torch.ones(1, 3, 4, 6))
    assert float(seen[0, 3, 0, 0]) == -1 and float(seen[0, 4, 0, 0]) == 1
    assert float(seen[0, 3, 0, -1]) == 1 and float(seen[0, 4, -1, 0]) == -1
    torch.testing.assert_close(seen[0, :3], torch.ones(3, 4, 6))


def test_the_network_learns_one_material() -> None:
    """Its loss on one example falls to less than 60 % in a few steps."""
    torch.manual_seed(0)
    network = MaterialNetwork(6, MaterialSize(8, (1, 2, 2)))
    maps = halve(random_svbrdf(64, seeded(5)))
    points, camera = plane_points(32, 32), torch.tensor([0.0, 0.0, 2.75]).view(3, 1, 1)
    lights = (torch.tensor(p).view(3, 1, 1) for p in ([0.1, 0.0, 2.7], [1.0, 0.5, 2.0]))
    dull = Svbrdf(maps.normal, maps.diffuse, maps.roughness, torch.zeros(3, 32, 32))
    views = []
    for light in lights:
        total, diffuse = (relight(m, points, camera, light) for m in (maps, dull))
        views.append(torch.cat([diffuse, (total - diffuse).clamp(min=0)]))
    seen, truth = torch.stack(views)[None], maps.stack()[None]
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    losses = []
    for _ in range(40):
        loss = material_loss(network(seen), truth, seeded(7))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.6 * losses[0]


def some_maps() -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float32]]]:
    """Maps of a random dielectric."""
    maps = random_svbrdf(16, seeded(4))
    return {name: np.ascontiguousarray(x.movedim(0, -1).numpy()) for name, x in vars(maps).items()}


def test_textures_hold_the_maps() -> None:
    """Each decodes to its map within half a step of 8 bits."""
    maps = some_maps()
    pixels, scale = texture_pixels(maps), specular_scale(maps["specular"])
    codes = {name: image.astype(np.float64) / 255 for name, image in pixels.items()}
    step = 0.501 / 255
    assert np.abs(codes["normal"] * 2 - 1 - maps["normal"]).max() < 2 * step
    assert np.abs(codes["roughness"] - maps["roughness"]).max() < step
    assert np.abs(codes["diffuse"] - srgb(maps["diffuse"])).max() < step
    assert np.abs(codes["specular"] - srgb(maps["specular"] / scale)).max() < step


def test_a_glb_is_one_textured_square() -> None:
    """Its chunks have the lengths they say, and trimesh finds two triangles with the textures on them."""
    maps = some_maps()
    data = encode_glb(maps, "stone")
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    specular = document["materials"][0]["extensions"]["KHR_materials_specular"]
    assert specular["specularColorFactor"][0] == pytest.approx(specular_scale(maps["specular"]) / GLASS)
    (shading,), (primitive,) = document["materials"], document["meshes"][0]["primitives"]
    assert sorted(primitive["attributes"]) == ["NORMAL", "POSITION", "TANGENT", "TEXCOORD_0"]
    assert set(shading) & {"occlusionTexture", "emissiveTexture"} == set()
    textures = {
        "diffuse": shading["pbrMetallicRoughness"]["baseColorTexture"],
        "roughness": shading["pbrMetallicRoughness"]["metallicRoughnessTexture"],
        "normal": shading["normalTexture"],
        "specular": specular["specularColorTexture"],
    }
    for name, texture in textures.items():
        entry = document["textures"][texture["index"]]
        view = document["bufferViews"][document["images"][entry["source"]]["bufferView"]]
        assert document["samplers"][entry["sampler"]]["wrapS"] == 33071  # clamped to the edge
        start = 20 + size + 8 + view["byteOffset"]
        pixels = imagecodecs.png_decode(data[start : start + view["byteLength"]])
        expected = texture_pixels(maps)[name] * np.array([0, 1, 0] if name == "roughness" else [1, 1, 1], np.uint8)
        np.testing.assert_array_equal(pixels, expected)
    scene = trimesh.load(BytesIO(data), file_type="glb")
    (mesh,) = scene.geometry.values()
    assert mesh.faces.shape == (2, 3) and mesh.area == pytest.approx(4)
    assert (mesh.face_normals @ np.array([0, 0, 1]) > 0.99).all()
    base = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(base, texture_pixels(maps)["diffuse"])
    # The upper left corner of the square is the upper left pixel.
    corner = int(np.argmin(np.abs(mesh.vertices - np.array([-1, 1, 0])).sum(axis=1)))
    np.testing.assert_allclose(mesh.visual.uv[corner], [0, 1])  # trimesh counts v up


def test_files_say_what_is_metal() -> None:
    """In glTF's terms metal is metallic, with its reflectance as base colour, and glass is not; both render as before.

    MaterialX says it by the specular colour.
    """
    maps = some_maps()
    for kind, (diffuse, specular) in {"metal": (0.0, (0.9, 0.7, 0.4)), "glass": (0.5, (0.04, 0.04, 0.04))}.items():
        maps["diffuse"] = np.full_like(maps["diffuse"], diffuse)
        maps["specular"] = np.ones_like(maps["specular"]) * np.float32(specular)
        found = metallic_maps(maps)
        assert found["metallic"].shape == (16, 16, 1) and (found["metallic"] == (kind == "metal")).all()
        np.testing.assert_allclose(found["diffuse"], maps["specular" if kind == "metal" else "diffuse"], rtol=1e-6)
        # Appendix B of glTF: reflectance at normal incidence and diffuse colour.
        reflectance = found["specular"] + found["metallic"] * (found["diffuse"] - found["specular"])
        np.testing.assert_allclose(reflectance, maps["specular"], rtol=1e-6)
        np.testing.assert_allclose((1 - found["metallic"]) * found["diffuse"], maps["diffuse"], atol=1e-6)
        mesh = trimesh.load(BytesIO(encode_glb(maps, kind)), file_type="glb").geometry[kind]
        pixels = np.asarray(mesh.visual.material.metallicRoughnessTexture.convert("RGB"))
        assert (pixels[..., 2] == (255 if kind == "metal" else 0)).all()
        assert mesh.visual.material.metallicFactor in (None, 1.0)
    assert specular_scale(maps["specular"]) == pytest.approx(0.04)


def test_materialx_is_xml_that_names_its_files() -> None:
    """Every input refers to a node that is there, and every texture is named."""
    files = {name: f'a "b" & {name}.png' for name in ("normal", "diffuse", "roughness", "specular")}
    root = ElementTree.fromstring(encode_materialx(files, 0.08, "stone"))
    names = {node.get("name") for node in root}
    referred = {i.get("nodename") for i in root.iter("input") if i.get("nodename")}
    assert referred <= names and len(referred) == 7
    assert {i.get("value") for i in root.iter("input") if i.get("type") == "filename"} == set(files.values())


@pytest.mark.parametrize("name", ["wood", "2024-05 Tür", "shader", "normal_image", "木"])
def test_materialx_names_are_plain_and_unique(name: str) -> None:
    """Letters, digits, underscores, no digit first; no two elements of one name (MaterialX 1.38, Names)."""
    files = {kind: f"{name}_{kind}.png" for kind in ("normal", "diffuse", "roughness", "specular")}
    root = ElementTree.fromstring(encode_materialx(files, 0.1, name))
    names = [node.get("name") for node in root]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", str(name)) for name in names)
    assert any(str(name).startswith("material_") for name in names)


def test_a_photograph_becomes_files(
    tmp_path: Path, weights: Path, frame: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of them are there, and the EXR file holds what the network says of the separated frame."""
    out = tmp_path / "out"
    asked = ["material", str(frame), "-o", str(out), "--weights", str(weights), "--size", "32", "--white-level", "4095"]
    assert run([*asked, "--method", "analytic", "--white", "0.5"], monkeypatch) == 0
    names = {path.name for path in out.iterdir()}
    textures = {f"flash_{name}.png" for name in ("normal", "diffuse", "roughness", "specular")}
    assert names == textures | {f"flash.{kind}" for kind in ("exr", "glb", "mtlx", "png", "json")}
    planes = read_exr_layers(out / "flash.exr")
    assert planes["normal.Z"].shape == (32, 32)
    said = json.loads((out / "flash.json").read_text())
    assert said["white"] == [0.5] and said["input"] == "separated"
    assert ElementTree.parse(out / "flash.mtlx").getroot().tag == "materialx"
    assert run([*asked, "--overwrite"], monkeypatch) == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["--size", "3"], r"'--size': expected a whole number from 32 to 1024, found '3'"),
        (["--white", "a"], r"expected --white N or N,N,... above 0, at most 2, like 0.8, found 'a'"),
        (["--white", "0"], r"expected --white N or N,N,... above 0, at most 2, like 0.8, found '0'"),
        (["--white", "3200"], r"expected --white N or N,N,... above 0, at most 2, like 0.8, found '3200'"),
        (["--white", "1,1"], r"expected one level of white, or 1, one for each photograph, found 2"),
        (["--method", "magic"], r"expected a method of"),
        (["--weights", "nowhere.safetensors"], r"nowhere.safetensors: expected a file"),
        (["--layout", "magic"], r'expected "color", "mono"'),
    ],
)
def test_bad_options_are_one_line(
    change: list[str],
    said: str,
    frame: Path,
    weights: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Exit status 2, one line that says what was expected, and no files."""
    out = frame.parent / "out"
    asked = ["material", str(frame), "-o", str(out), "--weights", str(weights), "--size", "32", "--method", "analytic"]
    asked += ["--white-level", "4095"]
    assert run([*asked, *change], monkeypatch) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(lines) == 1 and re.search(said, lines[0])
    assert not out.exists()


def test_bad_files_are_one_line(
    tmp_path: Path, weights: Path, frame: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is no photograph, what is dark, and results from before."""
    black = tmp_path / "black.npy"
    np.save(black, np.zeros((64, 64), np.uint16))
    text = tmp_path / "text.png"
    text.write_text("no picture")
    out = tmp_path / "out"
    for path, said in ((black, "black one"), (text, "PNG"), (tmp_path / "none.exr", "none.exr")):
        asked = ["material", str(path), "-o", str(out), "--weights", str(weights), "--method", "analytic"]
        assert run(asked, monkeypatch) == 2
        assert said in capsys.readouterr().err.splitlines()[-1]
        assert not out.exists()
    out.mkdir()
    (out / "flash.mtlx").write_text("mine")
    assert run(["material", str(frame), "-o", str(out), "--weights", str(weights)], monkeypatch) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "flash.mtlx").read_text() == "mine" and len(list(out.iterdir())) == 1


def test_weights_say_what_they_are(weights: Path, tmp_path: Path) -> None:
    """They are read again as they were; those of something else, and inputs that there are not, are refused."""
    estimator = load_estimator(path=weights)
    assert estimator.input == "separated"
    views: Tensor = torch.rand(2, 6, 32, 32, generator=seeded(1))
    own = small_network().half().float().eval()
    with torch.no_grad():
        torch.testing.assert_close(estimator.estimate(views).stack(), unstack(own(views[None])[0]).stack())
    with pytest.raises(ValueError, match="expected views"):
        estimator.estimate(views[:, :3])
    with pytest.raises(ValueError, match="expected an input of unseparated, separated, perfect"):
        load_estimator("magic")
    other = tmp_path / "other.safetensors"
    write_weights(other, {"x": torch.ones(1)}, {"method": "joint"})
    with pytest.raises(ValueError, match="expected weights of a network for materials"):
        load_estimator(path=other)


def test_scores_of_the_truth_are_perfect() -> None:
    """No error, all of the detail, no colour in the specular map; and flat, coloured maps show as such."""
    pytest.importorskip("flip_evaluator")
    truth = halve(random_svbrdf(48, seeded(7)))
    scores = {score.metric: score.value for score in (*score_maps(truth, truth), *score_failure(truth, truth))}
    assert all(value == 0 for name, value in scores.items() if "RMSE" in name or "chroma" in name)
    assert scores["normal angle"] < 0.1
    shares = [scores[f"normal detail, {name}"] for name in ("found / true", "correlation")]
    assert shares == pytest.approx([1, 1])
    assert {score.metric: score.value for score in score_relit(truth, truth)} == {"log-L1": 0, "PSNR": 120, "FLIP": 0}
    flat = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1).expand(3, 24, 24)
    tint = torch.tensor([0.5, 1.0, 1.5]).view(3, 1, 1)
    failed = Svbrdf(flat, truth.diffuse, truth.roughness, truth.specular * tint)
    scores = {score.metric: score.value for score in score_failure(failed, truth)}
    assert scores["specular chroma"] == pytest.approx(1)
    assert scores["normal detail, found / true"] == 0
    relit = {score.metric: score.value for score in score_relit(failed, truth)}
    assert relit["log-L1"] > 0 and relit["PSNR"] < 60 and relit["FLIP"] > 0


def test_novel_lights_are_above() -> None:
    """And are always the same."""
    lights, again = novel_lights(), novel_lights()
    assert len(lights) == 20 and all(float(light[2]) > 0.4 for light in lights)
    assert all(torch.equal(a, b) for a, b in zip(lights, again, strict=True))


def test_details_are_slopes_of_a_glossy_bump() -> None:
    """The cue of a photograph with a highlight in the middle goes with the true slopes, and not with turned ones."""
    maps = halve(random_svbrdf(128, seeded(7)))
    glossy = replace(maps, diffuse=torch.full((3, 64, 64), 0.02), roughness=torch.full((1, 64, 64), 0.4))
    above = torch.tensor([0.0, 0.0, 2.75]).view(3, 1, 1)
    photograph = relight(glossy, plane_points(64, 64), above, above)
    cue, true = detail_cues(photograph[None])[0], maps.normal[:2]
    along = float((cue * true).sum()) / float(cue.norm() * true.norm())
    across = float((cue * true.flip(0)).sum()) / float(cue.norm() * true.norm())
    assert along < -0.25 and abs(across) < 0.5 * abs(along)
    with pytest.raises(ValueError, match="expected cues of details, found magic"):
        MaterialSize(cues=("magic",))
    network = MaterialNetwork(6, replace(SMALL, cues=("details",)))
    assert network(torch.rand(1, 2, 6, 40, 32, generator=seeded(1))).shape == (1, 9, 40, 32)


def test_estimates_need_the_extra_torch_alone() -> None:
    """Nothing of the renderer is loaded, whose libraries are in other extras."""
    names = "[name for name in sys.modules if name.startswith('polsep.render')]"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys, polsep.material.files; print({names})"], capture_output=True, check=True
    )
    assert done.stdout.split() == [b"[]"]


def test_samples_that_are_not_flat_are_warned_of() -> None:
    """A disc before black is no flat sample; paper in the uneven light of a flash is."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
    radius = torch.hypot(x, y)
    solid, paper = (radius < 0.6).float() * (1 - radius), 1 / (1 + radius**2 / CAMERA_HEIGHT**2) ** 2
    views = torch.stack([light.expand(6, -1, -1) for light in (solid, paper)])
    (note,) = flatness_notes(Photographs(views, ("ball.png", "paper.png"), ()))
    assert note.startswith("ball.png: ") and "flat" in note


def test_photographs_that_tell_less_are_said(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Maps of more pixels than a photograph are remarked on; one photograph twice, or maps for it, are refused."""
    path = grey_paper(tmp_path, "exr", {"light_color": [1, 1, 1]})
    assert read_photographs([path], MaterialOptions(size=40)).notes == ()
    (note,) = read_photographs([path], MaterialOptions(size=41)).notes
    assert note.startswith(f"{path}: 41 pixels or more across") and "found 40" in note
    asked = ["--weights", str(weights), "--size", "32"]
    for white, brighter in (("0.31", False), ("0.1", True)):  # the diffuse light is 0.3
        assert run(["material", path, "-o", str(tmp_path / white), "--white", white, *asked], monkeypatch) == 0
        assert ("found one 3 times as bright" in capsys.readouterr().err) == brighter
    assert run(["material", path, path, "-o", str(tmp_path / "twice"), *asked], monkeypatch) == 2
    assert "expected photographs under different lights" in capsys.readouterr().err
    assert run(["material", path, "-o", str(tmp_path / "maps"), *asked], monkeypatch) == 0
    maps = str(tmp_path / "maps" / "paper.exr")
    for words in (["material", maps, *asked], ["edit", maps, "--rougher", "1"]):
        capsys.readouterr()
        assert run([*words, "-o", str(tmp_path / "out")], monkeypatch) == 2
        assert "expected a separated frame, found maps of a material" in capsys.readouterr().err
    assert not (tmp_path / "twice").exists() and not (tmp_path / "out").exists()


def test_white_is_guessed_of_metal_too() -> None:
    """By the diffuse light of a dielectric, and by all light of what hardly has any; or as said."""
    views = torch.full((3, 6, 8, 8), 0.1)
    views[1, :3], views[2, 3:] = 0.002, 0.0
    levels = find_white(views, ())
    assert levels == pytest.approx((0.1 / 0.25, 0.102 / 0.14, 0.1 / 0.25))
    assert find_white(views, (0.7,)) == (0.7, 0.7, 0.7)


TINT = np.array([0.55, 1, 0.7], np.float32)


def grey_paper(folder: Path, format: str, report: dict[str, object]) -> str:
    """A separated file of paper whose s0 is 0.4 under a lamp of the colour `TINT`, and its report beside it."""
    diffuse, specular = (np.full((40, 40, 3), level, np.float32) * TINT / TINT.mean() for level in (0.3, 0.1))
    zero = np.zeros((40, 40), np.float32)
    frame = SeparatedFrame(diffuse, specular, zero == 0, zero, zero, {"warnings": [], **report})
    return str(write_separation(frame, folder, "paper", format)[0])


@pytest.mark.parametrize("format", ["exr", "npz"])
def test_grey_paper_is_grey_under_any_lamp(tmp_path: Path, format: str) -> None:
    """The colour stated or in the report is divided out of both lobes, stated before reported; the mean s0 stays."""
    for report, stated in (({"light_color": TINT.tolist()}, "auto"), ({"light_color": [1, 1, 1]}, (0.55, 1, 0.7))):
        path = grey_paper(tmp_path / str(stated), format, report)
        found = read_photographs([path], MaterialOptions(light_color=stated, size=32))
        assert found.notes == () and found.lights == (pytest.approx((0.55, 1, 0.7)),)
        torch.testing.assert_close(found.views[0, :3], torch.full((3, 32, 32), 0.3))
        torch.testing.assert_close(found.views[0, 3:], torch.full((3, 32, 32), 0.1))


def test_a_lamp_of_no_known_colour_is_said(tmp_path: Path) -> None:
    """Separated files without their report are taken as lit by white light."""
    path = grey_paper(tmp_path, "exr", {"light_color": TINT.tolist()})
    Path(path).with_suffix(".json").unlink()
    found = read_photographs([path], MaterialOptions(size=32))
    (note,) = found.notes
    assert note.startswith(f"{path}: the lamp's colour is neither stated nor in paper.json")
    assert found.lights == ((1, 1, 1),) and float(found.views[0, 1].mean() / found.views[0, 0].mean()) > 1.5


def test_raw_frames_lose_the_colour_that_is_stated(frame: Path) -> None:
    """A raw frame of a white lamp, stated to be tinted, is what is separated over that colour."""
    read = ReadOptions(white_level=4095)
    stated, white = (
        read_photographs([str(frame)], MaterialOptions(read, "analytic", light, size=32))
        for light in (tuple(TINT.tolist()), "white")
    )
    sums = [x.views[0, :3] + x.views[0, 3:] for x in (stated, white)]
    gains = torch.from_numpy(TINT / TINT.mean()).view(3, 1, 1)
    torch.testing.assert_close(sums[0] * gains, sums[1], rtol=0.02, atol=0.002)
