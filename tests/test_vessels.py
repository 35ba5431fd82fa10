"""Objects that stand: closed meshes on a foot, cameras that look at them as users do, frames mirrored alone."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_shapes import is_closed, volume
from torch import Tensor
from torch.nn.functional import avg_pool2d

pytest.importorskip("scipy")
pytest.importorskip("embreex")
pytest.importorskip("skimage")

from polsep.io.store.examples import write_example
from polsep.render.blobs import random_blob
from polsep.render.materials import USUAL_SIZE, random_materials
from polsep.render.raycast import MeshScene, find_lit, find_view, shade_view
from polsep.render.shapes import Mesh
from polsep.render.sphere_tracing import PinholeCamera, PointLight
from polsep.render.vessels import random_profile, random_vessel
from polsep.render.views import Shot
from polsep.render.waves import drawn_from
from polsep.train import shape_task
from polsep.train.shape_examples import (
    COUNT,
    DOWN_DEG,
    DOWN_SHARE,
    ELEVATIONS_DEG,
    KINDS,
    MESHES,
    PLANES,
    Examples,
    find_example,
    random_upright_camera,
    surface_planes,
)
from polsep.train.shape_task import ShapeOptions, batches, turn_example


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("seed", range(12))
def test_vessels_are_closed_and_face_outward(seed: int) -> None:
    """Round, squared, fluted, with an inside, with waves, laden: all are closed; normals go with the triangles."""
    mesh = random_vessel(seeded(seed))
    assert is_closed(mesh) and volume(mesh) > 0
    corners = mesh.vertices[mesh.faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    along = (facing * mesh.normals[mesh.faces].mean(axis=1)).sum(axis=1)
    assert np.abs(facing[along <= 0]).sum() < 1e-3 * np.abs(facing).sum()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), -mesh.vertices.min(axis=0), atol=1e-9)
    assert float(np.ptp(mesh.vertices, axis=0).max()) == pytest.approx(USUAL_SIZE)


def test_profiles_join_and_insides_stay_inside() -> None:
    """Parts of a profile meet, from the axis to the axis; where there is an inside it is narrower than the wall."""
    hollow = 0
    for seed in range(100):
        parts, place = random_profile(drawn_from(seeded(seed)))
        assert parts[0][0, 0] == parts[-1][0, -1] == 0 and not parts[-1][1].any()
        for first, second in itertools.pairwise(parts):
            np.testing.assert_array_equal(first[:, -1], second[:, 0])
        assert 0 < place[0] < 1.001 and place[1] > 0
        if len(parts) < 4:
            continue
        hollow += 1
        inside, _, outside, _ = parts
        wall = np.interp(inside[1], outside[1, ::-1], outside[0, ::-1])
        assert (inside[0] < wall).all() and inside[1].min() > 0
    assert 65 < hollow < 95


def test_vessels_and_bodies_repeat() -> None:
    """One seed is one object; another seed is another one; half of the bodies are cut flat below."""
    for build in (random_vessel, random_blob):
        first, again, other = (build(seeded(seed)) for seed in (3, 3, 4))
        np.testing.assert_array_equal(first.vertices, again.vertices)
        assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)
    feet = [float((random_blob(seeded(seed)).normals[:, 1] < -0.99).mean()) for seed in range(6)]
    assert 0 < sum(share > 0.02 for share in feet) < len(feet)


def test_cameras_look_at_objects_that_stand_as_users_do() -> None:
    """Elevations are those that are said; a tenth look down."""
    vertices = random_vessel(seeded(1)).vertices
    generator, elevations = seeded(5), []
    for _ in range(1000):
        camera = random_upright_camera(vertices, generator)
        away = np.subtract(camera.position, camera.target)
        elevations.append(math.degrees(math.asin(away[1] / np.linalg.norm(away))))
    found = np.array(elevations)
    assert ELEVATIONS_DEG[0] - 0.01 < found.min() < -3 and DOWN_DEG[1] - 2 < found.max() < DOWN_DEG[1] + 0.01
    assert abs(float((found > ELEVATIONS_DEG[1]).mean()) - DOWN_SHARE) < 0.04


def planes_of(mesh: Mesh, camera: PinholeCamera, lamp: PointLight) -> Tensor:
    """Planes of an example without noise: the true s0, s1 and s2, and the surface."""
    shape, materials = MeshScene(mesh), random_materials(mesh.slot_count, seeded(8))
    materials = replace(materials, textures=None)
    view = find_view(shape, camera, (96, 96), 2)
    scene = shade_view(view, materials, lamp, find_lit(shape, view, lamp))
    total = scene.diffuse + scene.specular
    stokes = avg_pool2d(torch.cat([total.s0, total.s1, total.s2]), 2)
    planes = torch.zeros(COUNT, *stokes.shape[1:])
    planes[PLANES["stokes"]] = stokes
    planes[PLANES["mask"].start :] = surface_planes(view, materials, Shot(camera, lamp, 0.0, 0.0))
    return planes


def mirrored(x: tuple[float, float, float]) -> tuple[float, float, float]:
    return (-x[0], x[1], x[2])


def test_a_mirrored_example_is_the_example_of_the_mirrored_scene() -> None:
    """Object, camera, lamp and polarizer mirrored at the plane x = 0 give the frame that `turn_example` gives."""
    mesh, flip = random_vessel(seeded(6)), np.array([-1.0, 1.0, 1.0])
    camera = PinholeCamera((3.0, 7.0, 9.0), (0.2, 0.1, 0.0), 40.0)
    lamp = PointLight((6.0, 9.0, 7.0), 120.0, 0.5)
    other = Mesh(mesh.vertices * flip, mesh.normals * flip, mesh.uv, mesh.faces[:, ::-1], mesh.slots)
    mirror = PinholeCamera(mirrored(camera.position), mirrored(camera.target), camera.fov_deg)
    first = turn_example(planes_of(mesh, camera, lamp), True, False, False)
    second = planes_of(other, mirror, PointLight(mirrored(lamp.position), lamp.intensity, math.pi - lamp.polarizer))
    for name in ("stokes", "mask", "normal", "light"):
        a, b = first[PLANES[name]], second[PLANES[name]]
        assert a.abs().max() > 0.1
        assert float((a - b).abs().mean() / a.abs().mean()) < 2e-3, name
    assert float((first[6:9] + second[6:9]).abs().mean() / second[6:9].abs().mean()) > 1  # s2 did change its sign


def test_frames_of_things_that_stand_stay_upright(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are mirrored across alone, but for the share of held objects; those of solids turn in eight ways."""
    monkeypatch.setattr(shape_task, "HELD_SHARE", 0.0)
    planes = torch.zeros(COUNT, 24, 24)
    planes[PLANES["mask"], 4:20, 4:20] = 1
    planes[PLANES["normal"]] = torch.tensor([0.48, 0.6, 0.64])[:, None, None] * planes[PLANES["mask"]]
    signs = {}
    for number in (0, 1, 2):
        write_example(path := Examples("train", 0).path(tmp_path, number), planes)
        assert find_example(path) == (Examples("train", 0), number)
        assert Examples("train", 0).stands(number) == (number > 0) and Examples(MESHES, 0).stands(number)
        found = batches(ShapeOptions(batch=16, side=16), [path], 0, (0, 1))
        normals = torch.cat([next(found).planes[:, PLANES["normal"], 8, 8] for _ in range(3)])
        signs[number] = {tuple(round(x, 1) for x in normal) for normal in normals.tolist()}
    upright = {(0.5, 0.6, 0.6), (-0.5, 0.6, 0.6)}
    assert signs[1] == signs[2] == upright
    assert len(signs[0]) == 8 and len(KINDS) == 3


@pytest.mark.parametrize("seed", [-3, 20261128104500])
def test_a_seed_may_have_a_sign_and_be_a_date(tmp_path: Path, seed: int) -> None:
    """Batches are read from its examples, whose files say which ones they are."""
    planes = torch.zeros(COUNT, 24, 24)
    planes[PLANES["mask"], 4:20, 4:20] = 1
    write_example(path := Examples("train", seed).path(tmp_path, 7), planes)
    assert find_example(path) == (Examples("train", seed), 7)
    assert len(next(batches(ShapeOptions(seed=seed, batch=2, side=16), [path], 5, (0, 1))).planes) == 2
