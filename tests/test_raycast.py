"""Meshes rendered through Embree: the same light as the same solid traced as a signed distance."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from polsep import shapes
from polsep.materials import Materials
from polsep.optics import dot, normalize
from polsep.raycast import MeshScene, dress, find_hits, is_lit, render_mesh
from polsep.render import Part, PinholeCamera, PointLight, render
from polsep.scenes import ball, plain
from polsep.shapes import FINE, Floats, box, ellipsoid, join, moved, random_mesh

FLAT: list[Floats] = [np.zeros((FINE, FINE))] * 6
SIZE = (96, 112)
#: What a mesh of 10000 triangles leaves of a smooth ball's light (1 % in highlights), and of its rim, where it
#: covers less of a pixel and light grazes.
INSIDE, RIM = 5e-3, 2e-2
COLOR = (0.3, 0.5, 0.2)


def one_material(slots: int = 1, color: tuple[float, float, float] = COLOR) -> Materials:
    return Materials(torch.tensor([color] * slots), torch.full((slots,), 0.35), torch.full((slots,), 0.8))


def unit_ball() -> MeshScene:
    return MeshScene(ellipsoid(np.ones(3), FLAT))


def every_point(size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    rows, cols = torch.meshgrid(torch.arange(size[0]) + 0.5, torch.arange(size[1]) + 0.5, indexing="ij")
    return rows.flatten(), cols.flatten()


@pytest.mark.parametrize("light", [PointLight((1.0, 2.0, 8.0), 60.0, 0.4), PointLight((-6.0, 1.0, 3.0), 60.0, 2.0)])
def test_a_ball_is_the_ball(light: PointLight) -> None:
    """Diffuse and specular Stokes images of the mesh agree with those of the signed distance."""
    camera = PinholeCamera((0.5, 1.0, 6.0))
    found = render_mesh((unit_ball(), one_material()), camera, light, SIZE, 3)
    expected = render((Part(ball(1.0), plain(COLOR), roughness=0.35, specular=0.8),), camera, light, SIZE, 3)
    hits = find_hits(unit_ball(), camera, every_point(SIZE), SIZE)
    to_camera = torch.tensor(camera.position).view(3, 1, 1) - hits.position
    steep = dot(hits.normal, to_camera) / torch.sqrt(dot(to_camera, to_camera)) > 0.3
    inside = torch.zeros(SIZE, dtype=torch.bool)
    inside.view(-1)[hits.ray] = steep[0, :, 0]
    assert float(inside.float().mean()) > 0.2
    for lobe, exact in zip(found, expected, strict=True):
        for name in ("s0", "s1", "s2"):
            wrong = (getattr(lobe, name) - getattr(exact, name)).abs()
            assert float(wrong[:, inside].max()) < INSIDE
            assert float(wrong.max()) < RIM


def test_finer_meshes_come_closer(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is left of the difference to the ball is the triangles': twice as fine, less than half of it."""
    camera, light = PinholeCamera((0.5, 1.0, 6.0)), PointLight((-6.0, 1.0, 3.0), 60.0, 2.0)
    exact = render((Part(ball(1.0), plain(COLOR), roughness=0.35, specular=0.8),), camera, light, SIZE, 2)
    wrong = []
    for grid in ((25, 50), (50, 100), (100, 200)):
        monkeypatch.setattr(shapes, "ELLIPSOID_GRID", grid)
        found = render_mesh((unit_ball(), one_material()), camera, light, SIZE, 2)
        wrong.append(max(float((a.s0 - b.s0).abs().mean()) for a, b in zip(found, exact, strict=True)))
    assert wrong[1] < wrong[0] / 2
    assert wrong[2] < wrong[1] / 2


def test_triangles_do_not_shade_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    """On a coarse ball every point whose smooth normal faces the light sees it, up to the terminator."""
    monkeypatch.setattr(shapes, "ELLIPSOID_GRID", (12, 24))
    scene, light = unit_ball(), PointLight((-6.0, 1.0, 3.0))
    hits = find_hits(scene, PinholeCamera((0.5, 1.0, 6.0)), every_point(SIZE), SIZE)
    to_light = normalize(torch.tensor(light.position).view(3, 1, 1) - hits.position)
    facing = dot(hits.normal, to_light) > 0.02
    assert int(facing.sum()) > 1000
    assert bool(is_lit(scene, hits, light)[facing].all())


def test_what_misses_is_black() -> None:
    """Rays that hit nothing are left out, and their pixels are black."""
    camera = PinholeCamera((0.0, 0.0, 6.0), (0.0, 5.0, 0.0))
    hits = find_hits(unit_ball(), camera, every_point(SIZE), SIZE)
    assert hits.ray.numel() == 0
    assert hits.rays == SIZE[0] * SIZE[1]
    for lobe in render_mesh((unit_ball(), one_material()), camera, PointLight(), SIZE):
        assert float(lobe.s0.abs().max()) == 0


def test_a_wall_casts_its_shadow() -> None:
    """A box between light and ball takes the light from the ball, and from nothing that it does not hide."""
    wall = moved(box(np.array([3.0, 3.0, 0.1]), FLAT), np.eye(3), np.array([0.0, 0.0, 3.0]))
    camera, light = PinholeCamera((8.0, 0.0, 0.0)), PointLight((0.0, 0.0, 8.0), 60.0)
    alone = unit_ball()
    behind = MeshScene(join(alone.mesh, wall))
    hits = find_hits(alone, camera, every_point(SIZE), SIZE)
    lit = is_lit(alone, hits, light)
    toward_light = hits.position[2:] > 0.2
    assert bool(lit[toward_light].all())
    assert not bool(is_lit(behind, hits, light).any())
    assert not bool(lit[hits.position[2:] < -0.05].any())


def test_slots_choose_materials() -> None:
    """Every face of a box shows its own albedo, seen straight on."""
    scene = MeshScene(box(np.ones(3), FLAT))
    colors = torch.rand(6, 3, generator=torch.Generator().manual_seed(1))
    materials = Materials(colors, torch.full((6,), 0.3), torch.ones(6))
    for face, eye in ((0, (9.0, 0.0, 0.0)), (1, (-9.0, 0.0, 0.0)), (4, (0.0, 0.0, 9.0)), (5, (0.0, 0.0, -9.0))):
        hits = find_hits(scene, PinholeCamera(eye), (torch.tensor([48.0]), torch.tensor([56.0])), SIZE)
        assert int(hits.slot) == face
        torch.testing.assert_close(dress(hits, materials).albedo[:, 0, 0], colors[face])
        direction = torch.tensor(eye) / math.hypot(*eye)
        torch.testing.assert_close(hits.normal[:, 0, 0], direction, rtol=0, atol=1e-5)


def test_random_shapes_obey_physics() -> None:
    """All finite, DoLP of the diffuse below the Fresnel limit, the specular fully polarized, normals seen."""
    for seed in range(3):
        generator = torch.Generator().manual_seed(seed)
        scene = MeshScene(random_mesh(generator))
        slots = scene.mesh.slot_count
        camera = PinholeCamera((0.0, 0.6 * scene.size, 2.4 * scene.size))
        light = PointLight((scene.size, 2 * scene.size, 2 * scene.size), 5 * scene.size**2, 1.0)
        diffuse, specular = render_mesh((scene, one_material(slots)), camera, light, (64, 64))
        assert float(diffuse.s0.max()) > 0.01
        for stokes in (diffuse, specular):
            assert all(bool(torch.isfinite(s).all()) for s in (stokes.s0, stokes.s1, stokes.s2))
            assert float(stokes.s0.min()) >= 0
        polarized = torch.hypot(diffuse.s1, diffuse.s2)
        assert bool((polarized <= 0.39 * diffuse.s0 + 1e-6).all())
        torch.testing.assert_close(torch.hypot(specular.s1, specular.s2), specular.s0, rtol=1e-3, atol=1e-5)
