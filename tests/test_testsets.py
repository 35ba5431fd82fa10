"""The selection sets: their records, what their captures promise, and the geometry and polarization behind them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes and depth maps need the extra 'render'")

from tolerances import SIGMAS, assert_close, assert_same_angle, assert_within

from evaluation.testsets import (
    OBJECTS,
    PHOTOGRAPHS,
    SETS,
    STATUES,
    Case,
    Recipe,
    build_case,
    build_cases,
    check_case,
    draw_sheet,
    fingerprint,
    version_of,
)
from evaluation.testsets.cases import LARGEST_CLIPPED, TOLERANCE
from evaluation.testsets.casting import FILLED, LARGEST_ANGLE_DEG, look_at, random_light_near
from evaluation.testsets.expected import EXPECTED
from evaluation.testsets.photographs import normals_from_depth, polarize_diffuse
from evaluation.testsets.sealed import SEALED
from evaluation.testsets.sheet import TILE
from evaluation.testsets.statues import DILIGENT_FILES, random_albedo, span_surface, unproject
from polsep.io.assets.objects import hash_files, read_depth, read_mask, read_mesh, read_normal_map, read_photograph
from polsep.physics.fresnel import diffuse_dolp
from polsep.physics.optics import Geometry, diffuse_stokes
from polsep.physics.stokes import Stokes, aolp, dolp, measure
from polsep.render.shapes import Mesh
from polsep.render.sphere_tracing import PinholeCamera, Scene
from polsep.sensor.camera import IMX250, Layout, measure_with_analysers, sample_mosaic

ROOT = Path(__file__).resolve().parents[1]
SIDE = 48
RECIPES = {recipe.name: recipe for recipes in SETS.values() for recipe in recipes}


def sphere(side: int = SIDE) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals ``[3, H, W]`` of a sphere seen from far on +z, and where it is."""
    at = (torch.arange(side, dtype=torch.float64) - (side - 1) / 2) / (0.45 * side)
    x, y = at.expand(side, side), -at[:, None].expand(side, side)
    inside = x * x + y * y < 0.98
    z = torch.sqrt((1 - x * x - y * y).clamp(min=0))
    return torch.stack([x, y, z]), inside


def make_ball(_paths: list[Path], generator: torch.Generator) -> Scene:
    """A coloured sphere with a highlight, quick to make."""
    normal, inside = sphere()
    color = 0.2 + 0.8 * torch.rand(3, 1, 1, generator=generator)
    diffuse = polarize_diffuse(color * (normal[2] * inside).float(), normal.float())
    highlight = torch.exp(-40 * (1 - normal[2])).float().expand(3, -1, -1) * inside
    return Scene(diffuse, Stokes(highlight, 0 * highlight, highlight), inside)


@pytest.fixture(scope="module")
def ball() -> Case:
    return build_case(Recipe("ball", 5, (), make_ball))


@pytest.fixture(scope="module")
def data(shared: Path) -> Path:
    folder = shared / "data"
    if not folder.is_dir():
        pytest.skip(f"no data at {folder}")
    return folder


# Records


@pytest.mark.parametrize("name", ["object-04", "statue-cow", "scan-Banana", "photo-phone"])
def test_scenes_are_the_recorded_ones(name: str, request: pytest.FixtureRequest) -> None:
    """One small scene of every kind comes out as recorded."""
    recipe = RECIPES[name]
    case = build_case(recipe, request.getfixturevalue("data") if recipe.files else None)
    check_case(case)
    assert max(abs(a - b) for a, b in zip(fingerprint(case), EXPECTED[name].outputs, strict=True)) <= TOLERANCE


def test_every_scene_has_a_record_and_a_seed_of_its_own() -> None:
    """No record is missing or left over."""
    recipes = [recipe for recipes in SETS.values() for recipe in recipes]
    names = {recipe.name for recipe in (*recipes, *SEALED)}
    assert names == set(EXPECTED) and names == set(RECIPES) | {recipe.name for recipe in SEALED}
    assert len({recipe.seed for recipe in recipes}) == len(recipes) == 46


def test_documented_versions_are_those_of_the_records() -> None:
    """docs/testsets.md states the version of every set."""
    text = (ROOT / "docs" / "testsets.md").read_text(encoding="utf-8")
    stated = dict(re.findall(r"\| `(\w+)` \|.*\| `([0-9a-f]{12})` \|", text))
    assert stated == {name: version_of(recipes)[:12] for name, recipes in (SETS | {"sealed": SEALED}).items()}


def test_fingerprints_notice_flips_swaps_and_small_changes(ball: Case) -> None:
    """Mirroring, swapping colours, 0.1 % more light and other noise change the fingerprint beyond its tolerance."""
    found = fingerprint(ball)
    assert fingerprint(build_case(Recipe("ball", 5, (), make_ball))) == found

    def differs(scene: Scene) -> bool:
        changed = fingerprint(Case(ball.name, scene, ball.co_sited, ball.clean, ball.noisy))
        return max(abs(a - b) for a, b in zip(found, changed, strict=True)) > TOLERANCE

    diffuse, specular, mask = ball.scene.diffuse, ball.scene.specular, ball.scene.mask
    assert differs(Scene(diffuse * 1.001, specular, mask))
    assert differs(Scene(diffuse.map(lambda s: s.flip(0)), specular, mask))
    for axis in (1, 2):
        assert differs(Scene(diffuse.map(lambda s, axis=axis: s.roll(1, axis)), specular, mask))
        assert differs(Scene(diffuse.map(lambda s, axis=axis: s.flip(axis)), specular, mask))


def test_cases_that_are_not_as_recorded_are_refused(ball: Case) -> None:
    with pytest.raises(ValueError, match="expected a recorded test scene, found ball"):
        check_case(ball)
    with pytest.raises(ValueError, match="expected photo-box to have the fingerprint"):
        check_case(Case("photo-box", ball.scene, ball.co_sited, ball.clean, ball.noisy))


def test_missing_and_changed_inputs_are_refused(tmp_path: Path) -> None:
    """One line says which files are absent, or that they are not the recorded ones."""
    with pytest.raises(ValueError, match=r"expected a data folder for the test scene photo-apple, found none"):
        build_case(PHOTOGRAPHS[0])
    with pytest.raises(ValueError, match=r"expected the files of a test scene, found none at .*diffuse\.png"):
        build_case(PHOTOGRAPHS[0], tmp_path)
    for name in PHOTOGRAPHS[0].files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"other")
    with pytest.raises(ValueError, match=r"expected inputs of photo-apple with sha256 \w{16}, found \w{16}$"):
        build_case(PHOTOGRAPHS[0], tmp_path)


# Captures


def test_captures_are_of_the_scene(ball: Case) -> None:
    """The clean mosaic is a choice of the co-sited samples, which are the exact light limited at 1."""
    light, angles = ball.scene.diffuse + ball.scene.specular, Layout().angles
    exact = measure(light, angles)
    assert ball.co_sited.clipped is not None
    assert_close(ball.co_sited.data, exact.data.clamp(max=1))
    assert torch.equal(ball.co_sited.clipped, exact.data >= 1)
    assert_close(ball.clean.linear(), sample_mosaic(ball.co_sited, Layout()))


def test_share_of_clipped_samples_is_drawn_within_its_limits() -> None:
    """Between none and 5 % of the object's samples, and not the same share in every scene."""
    shares = []
    for seed in range(8):
        case = build_case(Recipe("ball", seed, (), make_ball))
        samples = sample_mosaic(measure(case.scene.diffuse + case.scene.specular, Layout().angles), Layout())
        shares.append(float((samples[case.scene.mask] > 1).float().mean()))
    assert 0 <= min(shares) < max(shares) <= LARGEST_CLIPPED
    assert max(shares) > LARGEST_CLIPPED / 2


def test_noise_of_mosaics_is_the_sensors(ball: Case) -> None:
    """Deviations from the mean of the sensor have the variance of its noise model."""
    light = ball.scene.diffuse + ball.scene.specular
    mean = sample_mosaic(measure_with_analysers(light, Layout().angles, IMX250.diattenuation), Layout())
    kept = ball.scene.mask & (mean < 0.9)
    score = ((ball.noisy.linear() - mean) / IMX250.noise_variance(mean).sqrt())[kept]
    count = score.numel()
    assert_within(score.mean(), 0.0, SIGMAS / math.sqrt(count))
    assert_within(score.var(), 1.0, SIGMAS * math.sqrt(2 / count))
    assert ball.noisy.white_level == 4095
    assert torch.equal(ball.noisy.data, ball.noisy.data.round())


def test_cases_come_one_by_one() -> None:
    """Nothing is made before it is asked for."""
    made = []

    def make(paths: list[Path], generator: torch.Generator) -> Scene:
        made.append(generator.initial_seed())
        return make_ball(paths, generator)

    cases = build_cases(Recipe(f"ball {seed}", seed, (), make) for seed in (1, 2))
    assert made == []
    assert next(cases).name == "ball 1"
    assert made == [1]


def test_half_truth_is_the_mean_of_each_cell(ball: Case) -> None:
    diffuse, _, mask = ball.half_truth()
    assert_close(diffuse[:, 3, 4], ball.scene.diffuse.s0[:, 6:8, 8:10].mean(dim=(1, 2)))
    assert bool(mask[3, 4]) == bool(ball.scene.mask[6:8, 8:10].all())


def test_sheet_has_a_row_per_case(ball: Case) -> None:
    """Six tiles side by side, neither empty nor of one colour."""
    sheet = draw_sheet([ball, ball])
    assert sheet.shape == (2 * TILE, 6 * TILE, 3) and sheet.dtype == np.uint8
    assert np.array_equal(sheet[:TILE], sheet[TILE:])
    assert all(int(np.ptp(sheet[:TILE, k * TILE : (k + 1) * TILE])) > 100 for k in range(6))


# Photographs


def test_diffuse_of_a_photograph_is_polarized_as_by_optics() -> None:
    """On a sphere, DoLP and AoLP are those of `optics.diffuse_stokes`; DoLP is 0 where the surface faces the camera."""
    normal, inside = sphere()
    axes = [torch.tensor(v, dtype=torch.float64).view(3, 1, 1) for v in ((0.0, 0, 1), (0.48, 0.6, 0.64), (0.0, 1, 0))]
    to_camera, to_light, up = axes
    light = torch.tensor(0.7, dtype=torch.float64)
    albedo, irradiance = torch.ones(3, 1, 1, dtype=torch.float64), torch.ones(1, 1, 1, dtype=torch.float64)
    expected = diffuse_stokes(Geometry(normal, to_camera, to_light, up, up), light, irradiance, albedo)
    found = polarize_diffuse(expected.s0, normal)
    lit = inside & (expected.s0[0] > 0)
    assert_close(found.s1[:, lit], expected.s1[:, lit])
    assert_close(found.s2[:, lit], expected.s2[:, lit])
    facing = polarize_diffuse(torch.ones(3, 1, 1), torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1))
    assert float(dolp(facing).max()) == 0


def test_normals_of_a_height_field_are_those_of_its_plane() -> None:
    """A plane that rises to the right and toward the top leans left and down, in right and UP axes; holes are NaN."""
    rows, cols = np.mgrid[:9, :11].astype(float)
    height = 0.5 * cols - 0.25 * rows
    height[0, 0] = np.nan
    normal = normals_from_depth(height)
    expected = np.array([-0.5, -0.25, 1.0]) / math.sqrt(0.25 + 0.0625 + 1)
    assert_close(normal[:, 4, 5], expected)
    assert np.isnan(normal[:, 0, :2]).all() and np.isnan(normal[:, :2, 0]).all()
    assert np.isfinite(normal[:, 2:, 2:]).all()


def test_photographs_keep_their_light_and_get_their_polarization(data: Path) -> None:
    """tau_d : tau_s is 2 diffuse : specular of the files; the specular is fully polarized, at one AoLP."""
    recipe = next(recipe for recipe in PHOTOGRAPHS if recipe.name == "photo-apple")
    case = build_case(recipe, data)
    diffuse, specular, mask = case.scene.diffuse, case.scene.specular, case.scene.mask
    files = [data / name for name in recipe.files]
    crossed, shiny = read_photograph(files[0]), read_photograph(files[1])
    at = np.unravel_index(int(np.argmax(shiny[1] * read_mask(files[2]))), shiny.shape[1:])
    peak = np.unravel_index(int(specular.s0[1].argmax()), specular.s0.shape[1:])
    around = tuple(slice(k - 3, k + 4) for k in at)
    near = tuple(slice(k - 7, k + 7) for k in peak)
    ratio = float(specular.s0[1][near].mean() / diffuse.s0[1][near].mean())
    assert ratio == pytest.approx(shiny[1][around].mean() / (2 * crossed[1][around].mean()), rel=0.1)
    bright = mask & (specular.s0[1] > 0.05)
    assert_within(dolp(specular)[1][bright], 1.0, 1e-5)
    angles = aolp(specular)[1][bright]
    assert_same_angle(angles, float(angles[0]), 1e-4)
    lit = mask & (diffuse.s0[1] > 0.05)
    assert float(dolp(diffuse)[1][lit].max()) < float(diffuse_dolp(torch.tensor(0.05)))
    # Toward the left edge the surface faces left: AoLP 0; at the top it faces up: AoLP 90 degrees.
    rows, cols = (torch.nonzero(mask.any(dim=d)).flatten() for d in (1, 0))
    middle = int((rows[0] + rows[-1]) / 2)
    left = int(torch.nonzero(mask[middle]).flatten()[0]) + 6
    assert_same_angle(aolp(diffuse)[1, middle, left], 0.0, math.radians(25))
    column = int(cols[0] + 0.3 * (cols[-1] - cols[0]))
    top = int(torch.nonzero(mask[:, column]).flatten()[0]) + 6
    assert_same_angle(aolp(diffuse)[1, top, column], math.pi / 2, math.radians(35))


# Statues and scans


def test_surfaces_of_depth_maps_project_onto_their_pixels() -> None:
    """Unprojected points lie on the rays of their pixels; triangles face the camera and lie between masked pixels."""
    depth = 10 + np.add.outer(np.linspace(0, 1, 5), np.linspace(0, 2, 6))
    intrinsics = np.array([[50.0, 0, 2.5], [0, 40.0, 2.0], [0, 0, 1]])
    points = unproject(depth, intrinsics)
    rows, cols = np.mgrid[:5, :6]
    assert_close(50 * points[..., 0] / -points[..., 2] + 2.5, cols.astype(float))
    assert_close(2.0 - 40 * points[..., 1] / -points[..., 2], rows.astype(float))
    mask = np.ones((5, 6), bool)
    mask[0, 0] = mask[4, 0] = mask[2, 3] = False
    mesh = span_surface(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape), mask)
    assert len(mesh.vertices) == 27
    # 20 cells of two triangles; six corners of cells are missing, and a cell with three corners keeps one.
    assert len(mesh.faces) == 40 - 6
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    assert bool((np.cross(b - a, c - a)[:, 2] > 0).all())


def test_normal_maps_agree_with_their_depths(data: Path) -> None:
    """In the frame that the reader states, normals and the slopes of the depth differ by a degree or so."""
    paths = [data / "diligent_normals" / "bear" / name for name in DILIGENT_FILES]
    intrinsics = np.loadtxt(paths[3])
    points = unproject(read_depth(paths[2]), intrinsics)
    across = np.cross(np.gradient(points, axis=1), -np.gradient(points, axis=0))
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    cosine = (across * read_normal_map(paths[0])).sum(axis=-1)[read_mask(paths[1])]
    assert np.degrees(np.nanmedian(np.arccos(np.clip(cosine, -1, 1)))) < 1


@pytest.mark.parametrize(("azimuth", "elevation"), [(0.0, 0.0), (70.0, 30.0), (200.0, -20.0)])
def test_cameras_see_all_of_a_mesh(azimuth: float, elevation: float, generator: torch.Generator) -> None:
    """The farthest vertex lies at the wanted share of the frame, and the camera on the wanted side."""
    vertices = torch.randn(50, 3, generator=generator, dtype=torch.float64).numpy() / 3
    mesh = Mesh(vertices, vertices, vertices[:, :2], np.zeros((1, 3), np.int64), np.zeros(1, np.int64))
    camera = look_at(mesh, azimuth, elevation)
    eye = np.array(camera.position)
    back = eye / np.linalg.norm(eye)
    assert math.degrees(math.asin(back[1])) == pytest.approx(elevation)
    assert math.degrees(math.atan2(back[0], back[2])) % 360 == pytest.approx(azimuth)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    ways = vertices - eye
    across = np.stack([ways @ right, ways @ np.cross(back, right)]) / -(ways @ back)
    assert np.abs(across).max() / math.tan(math.radians(camera.fov_deg) / 2) == pytest.approx(FILLED)


def test_lights_are_near_the_camera(generator: torch.Generator) -> None:
    """Angles to the camera go up to the limit, and the sides are drawn evenly."""
    camera = PinholeCamera((1.0, 2.0, 5.0), (0.5, 0.0, 0.0))
    way = np.array(camera.position) - np.array(camera.target)
    lights = [random_light_near(camera, generator) for _ in range(200)]
    ways = np.array([light.position for light in lights]) - np.array(camera.target)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    angles = np.degrees(np.arccos(ways @ way / np.linalg.norm(way)))
    assert 0.9 * LARGEST_ANGLE_DEG < angles.max() <= LARGEST_ANGLE_DEG + 1e-4
    assert {light.polarizer < math.pi / 2 for light in lights} == {True, False}


def test_a_quarter_of_the_textures_is_near_grey() -> None:
    """Of 16 scenes in a row, four, and of all textures."""
    points = torch.rand(3, 200, 1, generator=torch.Generator().manual_seed(1)) - 0.5
    grey = []
    for scene in range(16):
        colors = random_albedo(scene, torch.Generator().manual_seed(scene))(points)
        saturation = 1 - colors.amin(dim=0) / colors.amax(dim=0)
        grey.append(bool((saturation < 0.1).all()))
    assert sum(grey) == 4
    assert {scene % 4 for scene in range(16) if grey[scene]} == {0, 1, 2, 3}


# Readers

CUBE = """\
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
v -1 -1 2
v 1 -1 2
v 1 1 2
v -1 1 2
"""
SIDES = ["4 3 2 1", "5 6 7 8", "1 2 6 5", "2 3 7 6", "3 4 8 7", "4 1 5 8"]


def test_meshes_are_centred_scaled_and_smooth(tmp_path: Path) -> None:
    """A cube away from the origin becomes one in the unit sphere with normals outward; loose fragments are left out."""
    quads = [side.split() for side in SIDES]
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in quads]
    path = tmp_path / "cube.obj"
    path.write_text(CUBE + "".join(faces))
    mesh = read_mesh(path)
    assert mesh.slot_count == 1 and len(mesh.faces) == 12 and len(mesh.vertices) == 8
    assert_close(np.linalg.norm(mesh.vertices, axis=1), np.ones(8))
    assert_close(np.linalg.norm(mesh.normals, axis=1), np.ones(8))
    assert bool(((mesh.normals * mesh.vertices).sum(axis=1) > 0.9).all())
    fine = "".join(
        f"v {math.cos(0.1 * k):.4f} {math.sin(0.1 * k):.4f} {z}\n" for k in range(62) for z in (0, 1)
    ) + "".join(f"f {2 * k + 1} {2 * k + 3} {2 * k + 4}\nf {2 * k + 1} {2 * k + 4} {2 * k + 2}\n" for k in range(61))
    path.write_text(fine + "v 0 0 0.4\nv 0.1 0 0.4\nv 0 0.1 0.4\nf 125 126 127\n")
    assert len(read_mesh(path).faces) == 122


def test_unreadable_objects_are_refused(tmp_path: Path) -> None:
    """Each reader says in one line what it expected."""
    empty = tmp_path / "empty.obj"
    empty.write_text("v 0 0 0\n")
    with pytest.raises(ValueError, match=r"expected triangles in .*empty\.obj, found none"):
        read_mesh(empty)
    dust = tmp_path / "dust.obj"
    dust.write_text(
        "".join(f"v {k} 0 0\nv {k} 1 0\nv {k} 0 1\nf {3 * k + 1} {3 * k + 2} {3 * k + 3}\n" for k in range(101))
    )
    with pytest.raises(ValueError, match=r"expected connected triangles in .*dust\.obj, found loose fragments only"):
        read_mesh(dust)
    with pytest.raises(ValueError, match="expected the files of a test scene"):
        hash_files([tmp_path / "absent.png"])
    np.savez(tmp_path / "two.npz", a=np.zeros((2, 2)), b=np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"expected one image in .*two\.npz, found 2"):
        read_depth(tmp_path / "two.npz")
    (tmp_path / "broken.mat").write_bytes(b"not a matrix")
    with pytest.raises(ValueError, match="MAT"):
        read_depth(tmp_path / "broken.mat")


def test_sets_are_as_large_as_documented() -> None:
    """16 objects, 5 statues and 17 scans, 8 photographs."""
    assert [len(recipes) for recipes in (OBJECTS, STATUES, PHOTOGRAPHS)] == [16, 22, 8]
