"""Path tracing: with direct light alone what rays give, and inter-reflections and area lights that obey physics."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tolerances import MITSUBA, SIGMAS, assert_within
from torch import Tensor

from polsep.physics.optics import Geometry, diffuse_stokes, dot, normalize, specular_stokes
from polsep.physics.stokes import Stokes
from polsep.render.materials import Materials, random_materials
from polsep.render.shapes import FINE, Floats, Mesh, box, ellipsoid, join, moved, random_mesh
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Scene

pytest.importorskip("mitsuba")
pytest.importorskip("embreex")

from polsep.render.pathtrace import (
    FAST_VARIANT,
    SLOW_VARIANT,
    AreaLight,
    PathOptions,
    build_path_model,
    find_variant,
    path_trace,
    paths,
    trace_paths,
)
from polsep.render.raycast import MeshScene, Model, find_hits, render_scene

FLAT: list[Floats] = [np.zeros((FINE, FINE))] * 6
#: Lobes of one scene by two renderers, relative to the lobe's peak.
LOBES = 1e-4
DIRECT = PathOptions(1, 1, 1)
ROUGHNESS = 0.5


def random_model(seed: int) -> tuple[Model, PinholeCamera, PointLight]:
    """A random textured shape, seen and lit from above."""
    generator = torch.Generator().manual_seed(seed)
    scene = MeshScene(random_mesh(generator))
    materials = random_materials(scene.mesh.slot_count, generator)
    camera = PinholeCamera((0.3 * scene.size, 0.6 * scene.size, 2.4 * scene.size))
    light = PointLight((scene.size, 2 * scene.size, 2 * scene.size), 5 * scene.size**2, 1.0)
    return (scene, materials), camera, light


def plain(mesh: Mesh) -> Model:
    """One orange material, rough enough not to be smoothed anywhere."""
    slots = mesh.slot_count
    color = torch.tensor([[0.8, 0.5, 0.3]] * slots)
    return MeshScene(mesh), Materials(color, torch.full((slots,), ROUGHNESS), torch.ones(slots))


def corner() -> Model:
    """A floor, its top at y = 0, and a wall, its front at z = -1."""
    floor = moved(box(np.array([3.0, 0.1, 3.0]), FLAT), np.eye(3), np.array([0.0, -0.1, 0.0]))
    wall = moved(box(np.array([3.0, 1.5, 0.1]), FLAT), np.eye(3), np.array([0.0, 1.6, -1.1]))
    return plain(join(floor, wall))


CORNER_CAMERA, CORNER_LIGHT = PinholeCamera((1.0, 2.0, 6.0)), PointLight((1.5, 2.5, 2.0), 40.0, 0.5)


def stacked(stokes: Stokes) -> Tensor:
    return torch.stack([stokes.s0, stokes.s1, stokes.s2])


def lobes(scene: Scene) -> Tensor:
    """Both lobes ``[2, 3, 3, H, W]``."""
    return torch.stack([stacked(scene.diffuse), stacked(scene.specular)])


def assert_lobes_agree(found: Tensor, expected: Tensor, outliers: int) -> None:
    """Every component of both lobes to `LOBES` of the lobe's peak, but for so many pixels at silhouettes."""
    peak = expected[:, :1].amax(dim=(1, 2, 3, 4), keepdim=True)
    wrong = ((found - expected).abs() / peak).amax(dim=(0, 1, 2))
    assert int((wrong > LOBES).sum()) <= outliers


@pytest.mark.parametrize("variant", [FAST_VARIANT, SLOW_VARIANT])
@pytest.mark.parametrize("textured", [True, False])
def test_direct_light_is_what_rays_give(variant: str, textured: bool) -> None:
    """With depth 1 and a point light there is no noise: the images of `render_scene`, shadows and silhouettes too."""
    if variant == FAST_VARIANT != find_variant():
        pytest.skip("no LLVM that works")
    size = (90, 120) if variant == FAST_VARIANT else (18, 24)
    for seed in (5, 8):
        (scene, materials), camera, light = random_model(seed)
        model = (scene, materials if textured else replace(materials, textures=None))
        expected = lobes(render_scene(model, camera, light, size, 2))
        found = trace_paths(build_path_model(model, variant), camera, light, size, PathOptions(2, 1, 1))
        rows, cols = torch.meshgrid(*(torch.arange(2 * n) / 2 + 0.25 for n in size), indexing="ij")
        hits = find_hits(scene, camera, (rows.flatten(), cols.flatten()), size)
        whole = (
            torch.zeros(rows.numel()).index_fill_(0, hits.ray, 1.0).view(size[0], 2, size[1], 2).amin(dim=(1, 3)) > 0
        )
        assert int(whole.sum()) > 20
        assert int((whole != found.mask).sum()) <= 1
        # One of the four rays of a pixel may pass a silhouette on its other side.
        assert_lobes_agree(lobes(found), expected, 1)


def test_variants_follow_the_same_paths() -> None:
    """Fast and slow variant draw the same random numbers: one image, up to rounding along the paths."""
    if find_variant() != FAST_VARIANT:
        pytest.skip("no LLVM that works")
    model, camera, light = random_model(5)
    plain_model = (model[0], replace(model[1], textures=None))
    area = AreaLight(light.position, (0.0, 0.0, 0.0), 2.0, light.intensity, 1.0)
    for lamp in (light, area):
        fast, slow = (
            lobes(trace_paths(build_path_model(plain_model, v), camera, lamp, (18, 24), PathOptions(1, 2, 3)))
            for v in (FAST_VARIANT, SLOW_VARIANT)
        )
        assert_lobes_agree(fast, slow, 1)


def test_a_bad_llvm_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An LLVM that does not load leaves the slow variant, and the environment as it was."""
    bad = str(tmp_path / "libLLVM-15.so")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", bad)
    find_variant.cache_clear()
    assert find_variant() == SLOW_VARIANT
    assert os.environ["DRJIT_LIBLLVM_PATH"] == bad
    find_variant.cache_clear()


def test_seeds_decide() -> None:
    """The same seed gives the same image, another one another, and bands do not show."""
    options = PathOptions(1, 2, 3, seed=4)
    first, again = (lobes(path_trace(corner(), CORNER_CAMERA, CORNER_LIGHT, (16, 20), options)) for _ in range(2))
    other = lobes(path_trace(corner(), CORNER_CAMERA, CORNER_LIGHT, (16, 20), replace(options, seed=5)))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paths, "PATHS_AT_ONCE", 100)
        assert torch.equal(first, lobes(path_trace(corner(), CORNER_CAMERA, CORNER_LIGHT, (16, 20), options)))


def test_inter_reflections_only_add() -> None:
    """More surfaces never take light away, and in a corner they bring some, in the colour of the wall."""
    direct, once, often = (
        path_trace(corner(), CORNER_CAMERA, CORNER_LIGHT, (24, 32), PathOptions(1, 8, depth)) for depth in (1, 2, 4)
    )
    for fewer, more in ((direct, once), (direct, often)):
        for a, b in ((fewer.diffuse.s0, more.diffuse.s0), (fewer.specular.s0, more.specular.s0)):
            assert float((b - a).min()) >= -1e-6 * float(a.max())
    added = (once.diffuse.s0 - direct.diffuse.s0).mean(dim=(1, 2))
    assert float(added.min()) > 0.01 * float(direct.diffuse.s0.mean())
    assert float(added[0] / added[2]) > 0.8 / 0.3
    assert float(often.diffuse.s0.mean()) > float(once.diffuse.s0.mean())
    reflected = (once.specular.s0 - direct.specular.s0).mean(dim=(1, 2))
    assert float(reflected[0]) > 1.2 * float(reflected[2]) > 0


def test_a_ball_does_not_light_itself() -> None:
    """A convex shape has no inter-reflections."""
    model = plain(ellipsoid(np.ones(3), FLAT))
    light = PointLight((3.0, 2.0, 4.0), 40.0, 0.5)
    direct, deep = (
        lobes(path_trace(model, PinholeCamera(fov_deg=18.0), light, (32, 32), PathOptions(1, 8, depth)))
        for depth in (1, 4)
    )
    assert float(direct.max()) > 0.1
    assert_within(deep / direct.max(), direct / direct.max(), 1e-3)


def test_lobes_keep_their_polarization() -> None:
    """Direct specular light is fully polarized; the diffuse leaves polarized as its exit makes it, whatever came in."""
    direct, deep = (path_trace(corner(), CORNER_CAMERA, CORNER_LIGHT, (24, 32), PathOptions(1, 4, d)) for d in (1, 4))
    specular = direct.specular
    scale = float(specular.s0.max())
    assert scale > 0
    assert_within(torch.hypot(specular.s1, specular.s2) / scale, specular.s0 / scale, MITSUBA)
    assert bool((torch.hypot(deep.specular.s1, deep.specular.s2) <= deep.specular.s0 + MITSUBA * scale).all())
    a, b = direct.diffuse, deep.diffuse
    assert float(a.s0.max()) > 0
    for first, second in ((a.s1, b.s1), (a.s2, b.s2)):
        assert_within(first * b.s0 / a.s0.max() ** 2, second * a.s0 / a.s0.max() ** 2, 1e-5)


def test_small_disks_are_points() -> None:
    """A disk of hardly any radius is a point light whose intensity falls with the cosine off its axis."""
    size, place = (40, 50), torch.tensor(CORNER_LIGHT.position)
    target = (-1.0, 0.5, -1.0)
    disk = AreaLight(CORNER_LIGHT.position, target, 1e-5, CORNER_LIGHT.intensity, CORNER_LIGHT.polarizer)
    expected = lobes(render_scene(corner(), CORNER_CAMERA, CORNER_LIGHT, size))
    rows, cols = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
    hits = find_hits(corner()[0], CORNER_CAMERA, (rows.flatten(), cols.flatten()), size)
    axis = normalize((torch.tensor(target) - place).view(3, 1, 1))
    cosine = torch.zeros(size)
    cosine.view(-1)[hits.ray] = dot(normalize(hits.position - place.view(3, 1, 1)), axis).clamp(min=0)[0, :, 0]
    assert 0.05 < float(cosine[cosine > 0].min()) < 0.9
    found = lobes(path_trace(corner(), CORNER_CAMERA, disk, size, DIRECT))
    assert_lobes_agree(found, expected * cosine, 1)


def test_disks_are_many_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """A disk gives the mean of point lights all over it, whichever way its paths are drawn."""
    size, light, camera = (24, 32), CORNER_LIGHT, CORNER_CAMERA
    disk = AreaLight(light.position, (1.5, 0.0, 1.9), 0.8, light.intensity, light.polarizer)
    model = corner()
    axis = np.subtract(disk.target, disk.position) / math.dist(disk.target, disk.position)
    right = np.cross(axis, [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, axis)
    rows, cols = torch.meshgrid(*(torch.arange(n) + 0.5 for n in size), indexing="ij")
    hits = find_hits(model[0], camera, (rows.flatten(), cols.flatten()), size)
    expected = torch.zeros(2, 3, 3, *size)
    count = 150
    for k in range(count):  # a sunflower: Vogel 1979
        radius, angle = disk.radius * math.sqrt((k + 0.5) / count), k * math.pi * (3 - math.sqrt(5))
        place = disk.position + radius * (math.cos(angle) * right + math.sin(angle) * up)
        point = PointLight(tuple(place.tolist()), light.intensity, light.polarizer)
        way = normalize(hits.position - torch.from_numpy(place).float().view(3, 1, 1))
        cosine = torch.zeros(size)
        cosine.view(-1)[hits.ray] = dot(way, torch.from_numpy(axis).float().view(3, 1, 1)).clamp(min=0)[0, :, 0]
        lit = lobes(render_scene(model, camera, point, size))
        expected += lit * cosine / count
    for share in (0.1, 0.9):
        monkeypatch.setattr(paths, "FIRST_SPECULAR", share)
        found = lobes(path_trace(model, camera, disk, size, PathOptions(1, 120, 1)))
        for lobe, exact in zip(found, expected, strict=True):
            scale = float(exact[0].mean())
            assert float((lobe - exact).abs().mean()) < 0.05 * scale
            assert_within(lobe.mean(dim=(2, 3)) / scale, exact.mean(dim=(2, 3)) / scale, 1e-2)


def reflected_once(point: Tensor, to_camera: Tensor, light: PointLight) -> tuple[Tensor, Tensor]:
    """Diffuse and specular Stokes vectors ``[3, 3]`` of what the wall of `corner` sends to the floor, by quadrature."""
    up, count = torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1).double(), 300
    steps = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    x, y = torch.meshgrid(6 * steps - 3, 0.1 + 3 * steps, indexing="ij")
    wall = torch.stack([x.flatten(), y.flatten(), torch.full((count**2,), -1.0).double()])[..., None]
    one = torch.ones(1, 1, 1).double()
    albedo, roughness = torch.tensor([0.8, 0.5, 0.3]).view(3, 1, 1).double(), ROUGHNESS * one
    to_floor, to_light = point - wall, torch.tensor(light.position).view(3, 1, 1).double() - wall
    squared = dot(to_light, to_light)
    front = torch.tensor([0.0, 0.0, 1.0]).view(3, 1, 1).double()
    first = Geometry(front, normalize(to_floor), normalize(to_light), up, up)
    nu = light.polarizer * one
    arriving = diffuse_stokes(first, nu, light.intensity / squared, albedo)
    arriving = arriving + specular_stokes(first, nu, light.intensity / squared, roughness).map(
        lambda s: s.expand(3, -1, -1)
    )
    # Radiance times solid angle; as light behind a polarizer and an unpolarized rest, which is two crossed ones.
    arriving = arriving * ((9 * 2 / count**2) * first.to_camera[2:].abs() / dot(to_floor, to_floor))
    polarized = torch.hypot(arriving.s1, arriving.s2)
    angle = 0.5 * torch.atan2(arriving.s2, arriving.s1)
    second = Geometry(up, to_camera, normalize(-to_floor), up, up)
    total = []
    for lobe, material in ((diffuse_stokes, albedo), (specular_stokes, roughness)):
        rest = (arriving.s0 - polarized) / 2
        light_out = lobe(second, angle, polarized + rest, material) + lobe(second, angle + math.pi / 2, rest, material)
        total.append(stacked(light_out).sum(dim=2)[..., 0])
    return total[0], total[1]


def test_one_inter_reflection_is_its_integral() -> None:
    """What the floor of a corner reflects of the wall's light is the integral over the wall, in all of s0, s1, s2."""
    point = torch.tensor([0.2, 0.0, -0.2]).view(3, 1, 1).double()
    camera = PinholeCamera((1.0, 2.0, 3.0), (0.2, 0.0, -0.2), 0.01)
    to_camera = normalize(torch.tensor(camera.position).view(3, 1, 1).double() - point)
    size, light = (48, 48), PointLight((1.0, 2.0, 3.0), 40.0, 0.5)
    direct, once = (lobes(path_trace(corner(), camera, light, size, PathOptions(1, 8, d))).double() for d in (1, 2))
    added = (once - direct).flatten(3)
    mean, error = added.mean(dim=3), added.std(dim=3) / math.sqrt(size[0] * size[1])
    for lobe, spread, exact in zip(mean, error, reflected_once(point, to_camera, light), strict=True):
        assert float(spread.max()) < 0.03 * float(exact[0].max())
        assert bool(((lobe - exact).abs() < SIGMAS * spread + 2e-3 * exact[0]).all()), (lobe, exact)


@pytest.mark.parametrize("wrong", [{"samples": 0}, {"depth": 0}, {"paths": 0}])
def test_wrong_options_are_refused(wrong: dict[str, int]) -> None:
    """Counts are positive."""
    with pytest.raises(ValueError, match="at least 1"):
        PathOptions(**wrong)


def test_wrong_lights_are_refused() -> None:
    """A disk has a radius and a side."""
    with pytest.raises(ValueError, match="expected an area light of a positive radius, found 0"):
        AreaLight(radius=0.0)
    with pytest.raises(ValueError, match="expected an area light away from its target, found both"):
        AreaLight(target=AreaLight().position)
