"""`polsep geometry`: files of six lights in, whole files out that other programs read, or one line why not."""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_cli import Run, assert_refused, contents, run_here

pytest.importorskip("scipy")
pytest.importorskip("embreex")

import trimesh
from test_geometry import SIX, cap, dielectric, slope_of

from polsep.geometry import files
from polsep.geometry.integration import integrate_bilateral
from polsep.geometry.photometric import Appearance
from polsep.geometry.surface import Surface, draw_views, relight, span_surface
from polsep.io.assets.shapes import encode_glb, encode_ply
from polsep.io.raw.frames import ReadOptions
from polsep.io.results.exr import read_exr_layers
from polsep.io.results.separation_reader import read_separated
from polsep.io.results.separation_writer import write_separation
from polsep.io.store.image_codecs import encode_png
from polsep.physics.srgb import srgb
from polsep.physics.stokes import Stokes
from polsep.sensor.camera import IDEAL, Layout, expose
from polsep.separation.report import SeparatedFrame

Cli = Callable[..., Run]
SIDE = 40


@pytest.fixture
def polsep(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Cli:
    """Run `polsep geometry ARGS` inside this process."""
    return partial(run_here, monkeypatch, capfd, "geometry")


def sphere_images() -> NDArray[np.float64]:
    """A sphere under the six named lights."""
    normals, _ = cap(SIDE, 70)
    return dielectric(normals, SIX, np.broadcast_to([0.5, 0.3, 0.2], (SIDE, SIDE, 3)))


@pytest.fixture
def separated(tmp_path: Path) -> list[Path]:
    """Six separated EXR files with their polarization, and a mask."""
    normals, mask = cap(SIDE, 70)
    slope = slope_of(normals) * mask
    paths = []
    for number, image in enumerate(sphere_images()):
        frame = SeparatedFrame(
            image.astype(np.float32),
            np.zeros((SIDE, SIDE, 3), np.float32),
            np.ones((SIDE, SIDE), np.bool_),
            np.abs(slope).astype(np.float32),
            np.mod(np.angle(slope) / 2, np.pi).astype(np.float32),
            {"light_color": [1.0, 1.0, 1.0]},
        )
        paths.append(write_separation(frame, tmp_path / "in", f"light{number}")[0])
    (tmp_path / "mask.png").write_bytes(encode_png(255 * mask.astype(np.uint8)))
    return paths


def test_separated_files_become_maps_and_a_mesh(polsep: Cli, separated: list[Path], tmp_path: Path) -> None:
    """All files appear; normals are those of the sphere, the PNG holds the same; a second run is refused."""
    out = tmp_path / "out"
    run = polsep(*separated, "-o", out, "--name", "ball", "--mask", tmp_path / "mask.png")
    names = ["ball.exr", "ball_normals.png", "ball.glb", "ball.png", "ball.json"]
    assert (run.status, run.out.split()) == (0, [str(out / name) for name in names]), run
    planes = read_exr_layers(out / "ball.exr")
    truth, mask = cap(SIDE, 70)
    found = np.stack([planes[f"normal.{axis}"] for axis in "XYZ"], axis=-1)
    inner = mask & (planes["mask.Y"] > 0)
    assert np.degrees(np.arccos(np.clip((found * truth).sum(axis=-1), -1, 1)))[inner].mean() < 2
    assert (found[planes["mask.Y"] == 0] == 0).all()
    sidecar = json.loads((out / "ball.json").read_text())
    assert sidecar["polarization"] is True and [f["name"] for f in sidecar["files"]] == names[:-1]
    before = contents(out)
    assert_refused(polsep(*separated, "-o", out, "--name", "ball"), "--overwrite")
    assert contents(out) == before
    assert polsep(*separated, "-o", out, "--name", "ball", "--mask", tmp_path / "mask.png", "--overwrite").status == 0
    assert contents(out) == before


def raw_files(folder: Path, gain: float) -> list[Path]:
    """The sphere under six lights as raw frames in NPZ files of 16 bits; a large ``gain`` clips them."""
    normals, mask = cap(2 * SIDE, 70)
    slope, paths = slope_of(normals) * mask, []
    for number, image in enumerate(dielectric(normals, SIX, np.broadcast_to([0.5, 0.3, 0.2], (*mask.shape, 3)))):
        light = gain * np.moveaxis(image, -1, 0)
        stokes = Stokes(*(torch.from_numpy(light * part).float() for part in (1, slope.real, slope.imag)))
        codes = expose(stokes, Layout(), IDEAL).data * 65535
        paths.append(folder / f"raw{number}.npz")
        np.savez(paths[-1], raw=codes.round().to(torch.int32).numpy().astype(np.uint16))
    return paths


def test_raw_frames_are_separated_and_their_warnings_kept(polsep: Cli, tmp_path: Path) -> None:
    """Of overexposed frames every file has its line, on stderr and in the sidecar; separated ones have none."""
    paths = raw_files(tmp_path, 8.0)
    run = polsep(*paths, "-o", tmp_path / "out", "--method", "analytic")
    assert run.status == 0, run
    kept = json.loads((tmp_path / "out" / "shape.json").read_text())["warnings"]
    assert run.err.splitlines() == [f"polsep: {line}" for line in kept]
    assert all(any(line.startswith(f"{path}: ") and "overexposed" in line for line in kept) for path in paths)


def test_notes_stay_with_views_that_shrink(separated: list[Path]) -> None:
    """Separated files have no notes; those of others are not lost where maps are made smaller."""
    views = files.read_views(separated, files.Source("frames", ReadOptions(), "analytic"))
    assert views.notes == ()
    small, _ = files.shrink(replace(views, notes=("a: b",)), np.ones((SIDE, SIDE), np.bool_), SIDE // 2)
    assert small.notes == ("a: b",) and small.images.shape[1:3] == (SIDE // 2, SIDE // 2)


def test_a_lamp_that_no_file_tells_is_said_to_be_taken_for_white(separated: list[Path]) -> None:
    """Of separated files without the report beside them."""
    separated[2].with_suffix(".json").unlink()
    views = files.read_views(separated, files.Source("frames", ReadOptions(), "analytic"))
    assert len(views.notes) == 1 and views.notes[0].startswith(f"{separated[2]}: the lamp's colour is neither stated")


def test_a_small_object_is_found_in_noise() -> None:
    """It may fill a hundredth of the frame or less; noise and hot pixels around it are none of it."""
    images = np.abs(np.random.default_rng(0).normal(0, 0.002, (6, 256, 306, 3)))
    images[:, 40, 50] = 1.0
    images[:, 120:140, 160:180] += 0.5
    mask = files.find_object(files.Views(images, None))
    assert mask[120:140, 160:180].all() and mask.sum() == 400


def test_the_lamps_colour_is_divided_out(separated: list[Path]) -> None:
    """Separated files of a coloured lamp, which the report beside each names, are what a white lamp shows."""
    source = files.Source("frames", ReadOptions(), "analytic")
    white, color = files.read_views(separated, source).images, (0.5, 1.0, 0.6)
    for path in separated:
        frame = read_separated(path)
        lit = [x * np.float32(color) for x in (frame.diffuse, frame.specular)]
        frame = replace(frame, diffuse=lit[0], specular=lit[1], report={"light_color": list(color)})
        write_separation(frame, path.parent, path.stem, overwrite=True)
    np.testing.assert_allclose(files.read_views(separated, source).images, white * np.mean(color), rtol=2e-3)


def test_a_turntable_is_a_film_of_the_mesh(
    polsep: Cli, separated: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It shows the object from sides that mirror each other, for a sphere nearly, and is the same film every time.

    A third of its size, for a ninth of its time.
    """
    av = pytest.importorskip("av")
    assert files.CELL == 360
    monkeypatch.setattr(files, "CELL", 120)
    runs = [polsep(*separated, "-o", tmp_path / name, "--turntable") for name in "ab"]
    assert [run.status for run in runs] == [0, 0], runs
    films = [tmp_path / name / "shape.mp4" for name in "ab"]
    assert films[0].read_bytes() == films[1].read_bytes()
    with av.open(str(films[0])) as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == 96 and pictures[0].shape == (120, 120, 3)
    shown = [(np.abs(picture.astype(int) - 40).max(axis=-1) > 20).mean() for picture in pictures]
    assert min(shown) > 0.05 and shown[24] < 0.9 * shown[0]  # from the side half of a cap is seen
    assert abs(shown[24] - shown[72]) < 0.1 * shown[0]


def test_photographs_do_too(polsep: Cli, tmp_path: Path) -> None:
    """8-bit sRGB, no mask, a field of view, a PLY mesh, maps made smaller."""
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    for path, image in zip(paths, sphere_images(), strict=True):
        path.write_bytes(encode_png(np.rint(255 * srgb(image)).astype(np.uint8)))
    run = polsep("--srgb", *paths, "-o", tmp_path / "out", "--fov", "25", "--mesh", "ply", "--size", "20")
    assert run.status == 0, run
    assert read_exr_layers(tmp_path / "out" / "shape.exr")["depth.Z"].shape == (20, 20)
    mesh: Any = trimesh.load(tmp_path / "out" / "shape.ply", force="mesh", process=False)
    assert len(mesh.faces) > 300 and mesh.visual.kind == "vertex"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (["--lights", "right left"], ["2 files", "found 6"]),
        (["--lights", "right left behind 0,0,1 1,0,1 0,1,1"], ["behind"]),
        (["--lights", "1,0,1 0,0,1 1,0,0 1,0,2 1,0,3 1,0,4"], ["one plane"]),
        (["--fov", "190"], ["--fov", "from 0 to 120"]),
        (["--mesh", "obj"], ["glb or ply"]),
        (["--integration", "rough"], ["bilateral or smooth"]),
        (["--size", "0"], ["--size"]),
        (["--name", "a/b"], ["stem"]),
        (["--name", "ball.exr"], ["--name", "expected a name without an ending, as ball, found 'ball.exr'"]),
        (["--method", "magic"], ["magic"]),
        (["--mask", "absent.png"], ["absent.png"]),
    ],
)
def test_what_cannot_be_is_said_in_a_line(
    polsep: Cli, separated: list[Path], tmp_path: Path, change: list[str], words: list[str]
) -> None:
    """Exit 2, one line, and nothing is written."""
    assert_refused(polsep(*separated, "-o", tmp_path / "out", *change), *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "given",
    [
        ("--white-level", "4095"),
        ("--black-level", "64"),
        ("--layout", "mono"),
        ("--calibration", "c.json"),
        ("--ambient", "dark.png"),
        ("--method", "analytic"),
    ],
)
def test_photographs_have_no_options_of_frames(polsep: Cli, tmp_path: Path, given: tuple[str, str]) -> None:
    """Options that would be ignored are refused by name, before files are looked for."""
    paths = [tmp_path / f"{number}.png" for number in range(6)]
    refused = polsep("--srgb", *paths, *given, "-o", tmp_path / "out")
    assert_refused(refused, f"expected {given[0]} with raw frames, found it with --srgb")


def test_files_that_do_not_fit_are_named(polsep: Cli, separated: list[Path], tmp_path: Path) -> None:
    """Another size, a damaged file, one picture twice, a mask of another size, an input in the place of an output."""
    small = tmp_path / "small.png"
    small.write_bytes(encode_png(np.full((8, 8), 255, np.uint8)))
    damaged = tmp_path / "damaged.exr"
    damaged.write_bytes(separated[0].read_bytes()[:200])
    out = ["-o", tmp_path / "out"]
    assert_refused(polsep(*separated[:5], damaged, *out), "damaged.exr")
    assert_refused(polsep(damaged, *separated[:4], damaged, *out), "expected pictures under different lights")
    again = tmp_path / "again.exr"
    again.write_bytes(separated[1].read_bytes())
    assert_refused(polsep(*separated[:5], again, *out), "again.exr", "under different lights", separated[1].name)
    assert_refused(polsep(*separated, "--mask", small, *out), "small.png", "[40, 40]")
    assert_refused(polsep(*separated, "-o", tmp_path / "in", "--name", "light0", "--overwrite"), "is an input")
    assert_refused(polsep(*out), "6 files")
    assert not (tmp_path / "out").exists()


def test_angles_that_nobody_knows_are_refused(polsep: Cli, separated: list[Path], tmp_path: Path) -> None:
    """Files of photographs at unknown angles are named, as their AoLP counts from the first photograph."""
    frame = read_separated(separated[2])
    report = {"light_color": [1.0, 1.0, 1.0], "photographs": {"frame": "the first photograph"}}
    turned = write_separation(replace(frame, report=report), tmp_path / "in", "turned")[0]
    run = polsep(*separated[:5], turned, "-o", tmp_path / "out")
    assert_refused(run, "turned.exr", "found them counted from the first photograph")
    assert not (tmp_path / "out").exists()


def ball() -> Any:
    """The surface of a sphere's cap."""
    normals, mask = cap(SIDE, 60)
    appearance = Appearance(normals, np.full((SIDE, SIDE, 3), 0.5) * mask[..., None], mask)
    return appearance, span_surface(appearance, integrate_bilateral(normals, mask))


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0, 0), (50, 0), (0, 40), (-120, 35), (20, -50)])
def test_views_come_from_where_they_say(azimuth_deg: float, elevation_deg: float) -> None:
    """A ball looks alike from all sides, and its blue spot, a little above what faces the camera, is seen there."""
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    way = np.array([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)])
    above = np.array([-np.sin(azimuth) * np.sin(elevation), np.cos(elevation), -np.cos(azimuth) * np.sin(elevation)])
    ball: Any = trimesh.creation.icosphere(4)
    normals, faces = np.asarray(ball.vertices, np.float64), np.asarray(ball.faces, np.int64)
    colors = np.ones((len(normals), 3)) - (normals @ (0.8 * way + 0.6 * above) > 0.95)[:, None] * np.array([1.0, 0, 0])
    (picture,) = draw_views(Surface(normals / 2, normals, colors, faces), 64, ((azimuth_deg, elevation_deg),))
    (front,) = draw_views(Surface(normals / 2, normals, 0 * colors + 1, faces), 64, ((0, 0),))
    assert np.abs(picture[..., 2] - front[..., 2]).mean() < 0.01 * front.mean()
    rows, cols = np.nonzero((picture[..., 2] > 0) & (picture[..., 0] < 0.1 * picture[..., 2]))
    assert rows.size > 50 and 12 < rows.mean() < 20 and abs(cols.mean() - 31.5) < 1


def test_meshes_come_back_through_trimesh() -> None:
    """GLB and PLY keep positions, normals, triangles and colours; triangles face the way that normals do."""
    _, surface = ball()
    arrays = (surface.vertices, surface.normals, surface.colors, surface.faces)
    for encode, kind in ((encode_glb, "glb"), (encode_ply, "ply")):
        mesh: Any = trimesh.load(io.BytesIO(encode(*arrays)), file_type=kind, force="mesh", process=False)
        assert np.abs(mesh.vertices - surface.vertices).max() < 1e-6
        assert (mesh.faces == surface.faces).all()
        assert np.abs(mesh.vertex_normals - surface.normals).max() < 0.05  # trimesh makes its own
        facing = (mesh.face_normals * surface.normals[surface.faces].mean(axis=1)).sum(axis=1)
        assert facing.min() > 0.9
    with pytest.raises(ValueError, match="triangles of"):
        encode_glb(*arrays[:3], surface.faces + len(surface.vertices))
    with pytest.raises(ValueError, match="finite"):
        encode_ply(surface.vertices * np.nan, *arrays[1:])


def test_a_glb_keeps_linear_colours_exactly() -> None:
    """COLOR_0 holds float32, not 8 bits; the material is rough, no metal, and seen from both sides."""
    _, surface = ball()
    colors = np.random.default_rng(0).random(surface.colors.shape)
    data = encode_glb(surface.vertices, surface.normals, colors, surface.faces)
    (length,) = struct.unpack_from("<I", data, 12)
    document, start = json.loads(data[20 : 20 + length]), 20 + length + 8
    (primitive,) = document["meshes"][0]["primitives"]
    for name, expected in (("POSITION", surface.vertices), ("NORMAL", surface.normals), ("COLOR_0", colors)):
        accessor = document["accessors"][primitive["attributes"][name]]
        assert (accessor["componentType"], accessor["type"], accessor["count"]) == (5126, "VEC3", len(expected))
        at = start + document["bufferViews"][accessor["bufferView"]]["byteOffset"] + accessor.get("byteOffset", 0)
        stored = np.frombuffer(data, "<f4", expected.size, at).reshape(expected.shape)
        np.testing.assert_array_equal(stored, expected.astype(np.float32))
    assert sorted(primitive["attributes"]) == ["COLOR_0", "NORMAL", "POSITION"]
    shading = document["materials"][primitive["material"]]
    assert shading == {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}


def test_a_surface_is_centred_and_has_its_shape() -> None:
    """The largest extent is 1, and all vertices of a cap lie on a sphere."""
    _, surface = ball()
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    assert np.abs(low + high).max() < 1e-9 and (high - low).max() == pytest.approx(1)
    center = surface.vertices - surface.normals * (0.5 / np.sin(np.radians(60)))
    assert np.linalg.norm(center - center.mean(axis=0), axis=1).max() < 0.03


def test_the_extent_is_one_at_any_distance() -> None:
    """Also where a pinhole's depth, which is exponential, is next to 0: else the mesh is a point."""
    size, intrinsics = (6, 8), np.array([[10.0, 0, 3.5], [0, 10.0, 2.5], [0, 0, 1]])
    facing = np.broadcast_to([0.0, 0, 1], (*size, 3))
    appearance = Appearance(facing, np.ones((*size, 3)), np.ones(size, np.bool_))
    surface = span_surface(appearance, np.full(size, 1e-30), intrinsics)
    assert np.ptp(surface.vertices, axis=0).max() == pytest.approx(1)


def test_a_mesh_that_no_side_shows_has_pictures() -> None:
    """Black ones have a gain of 1."""
    corner = np.zeros((3, 3))
    surface = Surface(corner, np.broadcast_to([0.0, 0, 1], (3, 3)), np.ones((3, 3)), np.array([[0, 1, 2]]))
    assert all((panel.pixels == files.GREY).all() for panel in files.draw_mesh(surface, 8))


def test_distances_that_no_object_has_are_remarked_on() -> None:
    """A far side many times as far as the near one tells of wrong lights, or of a wrong field of view."""
    _, mask = cap(SIDE, 70)
    views = files.Views(np.ones((3, SIDE, SIDE, 1)) * mask[..., None], None)
    lights = np.array([[0.0, 0.0, 1.0], [0.9, 0.0, 0.44], [0.0, 0.9, 0.44]])
    notes = [
        files.find_shape(views, lights, mask, files.ShapeOptions("ply", fov, "smooth")).facts["warnings"]
        for fov in (20.0, 119.0)
    ]
    assert notes[0] == [] and "times as far as its near one" in notes[1][0]


def test_jumps_become_gaps() -> None:
    """No triangle spans a step between two planes that face the camera."""
    depth = np.zeros((8, 8))
    depth[:, 4:] = 20
    normals = np.broadcast_to([0.0, 0, 1], (8, 8, 3))
    surface = span_surface(Appearance(normals, np.ones((8, 8, 1)), np.ones((8, 8), np.bool_)), depth)
    assert len(surface.faces) == 2 * (7 * 3 + 7 * 3)
    assert np.ptp(surface.vertices[surface.faces][..., 2], axis=1).max() == 0


def test_jumps_become_gaps_before_a_pinhole_too() -> None:
    """Planes at distances of 1 and 1.6 stay apart; a plane that is steep, but one, stays whole."""
    size, focal = (24, 30), 60.0
    intrinsics = np.array([[focal, 0, 14.5], [0, focal, 11.5], [0, 0, 1]])
    facing, mask = np.broadcast_to([0.0, 0, 1], (*size, 3)), np.ones(size, np.bool_)
    depth = np.ones(size)
    whole = len(span_surface(Appearance(facing, np.ones((*size, 1)), mask), depth, intrinsics).faces)
    depth[:, 15:] = 1.6
    surface = span_surface(Appearance(facing, np.ones((*size, 1)), mask), depth, intrinsics)
    assert len(surface.faces) == whole - 2 * (size[0] - 1)
    normal = np.array([0.8, 0, 0.6])
    across = (np.arange(size[1]) - 14.5) / focal
    steep = np.broadcast_to(3 * normal[2] / (normal[2] - normal[0] * across), size).copy()
    tilted = Appearance(np.broadcast_to(normal, (*size, 3)), np.ones((*size, 1)), mask)
    assert len(span_surface(tilted, steep, intrinsics).faces) == whole


def test_photographs_of_any_unit_give_one_shape() -> None:
    """Linear light of a small unit is no shadow; the albedo is in the unit of the photographs."""
    normals, mask = cap(48, 70)
    images = 0.6 * np.maximum(np.einsum("ijk,lk->lij", normals, SIX), 0)[..., None].repeat(3, axis=-1)
    found = [
        files.find_shape(files.Views(gain * images, None), SIX, mask, files.ShapeOptions()) for gain in (1.0, 1e-3)
    ]
    np.testing.assert_allclose(found[1].normals, found[0].normals, atol=1e-6)
    np.testing.assert_allclose(found[1].albedo, 1e-3 * found[0].albedo, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("gloss", [0.0, 0.3, 3.0])
def test_photographs_whose_light_no_normal_explains_are_remarked_on(gloss: float) -> None:
    """Highlights that clip tore the mesh of flash photographs without a word; one smooth surface is whole."""
    normals, mask = cap(48, 70)
    half = SIX + np.array([0.0, 0.0, 1.0])
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    lit, mirrored = (np.maximum(np.einsum("ijk,lk->lij", normals, x), 0) for x in (SIX, half))
    images = np.minimum(0.3 * lit + gloss * (lit > 0) * mirrored**20, 1)[..., None].repeat(3, axis=-1)
    views = files.Views(images, None, ("other",))
    torn, whole = (
        files.find_shape(views, SIX, mask, files.ShapeOptions(integration=how)).facts["warnings"]
        for how in ("bilateral", "smooth")
    )
    assert torn[0] == "other" and whole == ["other"]
    assert len(torn) == (2 if gloss > 1 else 1) and all("--integration smooth" in note for note in torn[1:])


def test_pictures_show_the_side_that_is_lit() -> None:
    """Relit images and pictures of the mesh are brighter toward the light, and black where nothing is."""
    appearance, surface = ball()
    image = relight(appearance, (-1.0, 0.0, 0.4))
    assert image[:, : SIDE // 2].mean() > 2 * image[:, SIDE // 2 :].mean()
    (picture,) = draw_views(surface, 48, ((0.0, 0.0),))
    assert picture[:24, :24].sum() > 1.3 * picture[24:, 24:].sum()
    assert (picture[0, 0] == 0).all()
