"""Meshes rendered by filled triangles and by Embree: the same light as the same solid traced as a signed distance."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from polsep.compute.threads import get_threads, set_threads
from polsep.physics.fresnel import ETA, diffuse_dolp
from polsep.physics.optics import beam_frame, dot, normalize
from polsep.physics.stokes import Stokes
from polsep.render import raycast, shapes
from polsep.render.distances import ball, plain
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import (
    Hits,
    MeshScene,
    View,
    build_gbuffer,
    find_hits,
    find_lit,
    find_view,
    is_lit,
    render_scene,
    shade_view,
)
from polsep.render.shapes import FINE, Floats, box, ellipsoid, join, moved, random_mesh
from polsep.render.sphere_tracing import Part, PinholeCamera, PointLight, Scene, cast, render, shade

FLAT: list[Floats] = [np.zeros((FINE, FINE))] * 6
SIZE = (96, 112)
#: What a mesh of 10000 triangles leaves of a smooth ball's light (1 % in highlights), and of its rim, where it
#: covers less of a pixel and light grazes.
INSIDE, RIM = 5e-3, 2e-2
COLOR = (0.3, 0.5, 0.2)


@pytest.fixture(autouse=True)
def _same_threads() -> Iterator[None]:
    threads = get_threads()
    yield
    set_threads(threads)


def one_material(slots: int = 1, color: tuple[float, float, float] = COLOR) -> Materials:
    return Materials(torch.tensor([color] * slots), torch.full((slots,), 0.35), torch.full((slots,), 0.8))


def unit_ball() -> MeshScene:
    return MeshScene(ellipsoid(np.ones(3), FLAT))


def lobes_of(scene: Scene) -> tuple[Stokes, Stokes]:
    return scene.diffuse, scene.specular


def every_point(size: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    rows, cols = torch.meshgrid(torch.arange(size[0]) + 0.5, torch.arange(size[1]) + 0.5, indexing="ij")
    return rows.flatten(), cols.flatten()


@pytest.mark.parametrize("light", [PointLight((1.0, 2.0, 8.0), 60.0, 0.4), PointLight((-6.0, 1.0, 3.0), 60.0, 2.0)])
def test_a_ball_is_the_ball(light: PointLight) -> None:
    """Diffuse and specular Stokes images of the mesh agree with those of the signed distance."""
    camera = PinholeCamera((0.5, 1.0, 6.0))
    found = lobes_of(render_scene((unit_ball(), one_material()), camera, light, SIZE, 3))
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
        found = lobes_of(render_scene((unit_ball(), one_material()), camera, light, SIZE, 2))
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
    for lobe in lobes_of(render_scene((unit_ball(), one_material()), camera, PointLight(), SIZE)):
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
        torch.testing.assert_close(build_gbuffer(hits, materials).albedo[:, 0, 0], colors[face])
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
        diffuse, specular = lobes_of(render_scene((scene, one_material(slots)), camera, light, (64, 64)))
        assert float(diffuse.s0.max()) > 0.01
        for stokes in (diffuse, specular):
            assert all(bool(torch.isfinite(s).all()) for s in (stokes.s0, stokes.s1, stokes.s2))
            assert float(stokes.s0.min()) >= 0
        polarized = torch.hypot(diffuse.s1, diffuse.s2)
        assert bool((polarized <= 0.39 * diffuse.s0 + 1e-6).all())
        torch.testing.assert_close(torch.hypot(specular.s1, specular.s2), specular.s0, rtol=1e-3, atol=1e-5)


def textured_object(seed: int = 3) -> tuple[tuple[MeshScene, Materials], PinholeCamera, PointLight]:
    generator = torch.Generator().manual_seed(seed)
    scene = MeshScene(random_mesh(generator))
    materials = random_materials(scene.mesh.slot_count, generator, scene.size)
    camera = PinholeCamera((0.3 * scene.size, 0.6 * scene.size, 2.0 * scene.size))
    light = PointLight((scene.size, 2 * scene.size, 2 * scene.size), 5 * scene.size**2, 1.0)
    return (scene, materials), camera, light


def in_order(size: tuple[int, int], samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The samples of all pixels, those of a pixel one after the other."""
    rows, cols = (torch.arange(side * samples).view(side, samples) for side in size)
    grid = torch.broadcast_tensors(rows[:, None, :, None], cols[None, :, None, :])
    return tuple((x.flatten() + 0.5) / samples for x in grid)  # type: ignore[return-value]


def assert_same_scene(found: Scene, expected: Scene, tolerance: float = 0.0) -> None:
    """Both lobes to a share of their peaks, the masks exactly."""
    assert torch.equal(found.mask, expected.mask)
    for lobe, exact in ((found.diffuse, expected.diffuse), (found.specular, expected.specular)):
        peak = float(exact.s0.max())
        for name in ("s0", "s1", "s2"):
            a, b = getattr(lobe, name), getattr(exact, name)
            torch.testing.assert_close(a, b, rtol=0, atol=tolerance * peak)


def hits_of(view: View) -> Hits:
    """All hits of a view, their rays counted over all bands."""
    names, samples = ("position", "normal", "above"), view.samples**2
    parts = [torch.cat([getattr(band.hits, name) for band in view.bands], dim=1) for name in names]
    ray = torch.cat([band.hits.ray + band.pixels[0] * samples for band in view.bands])
    slot = torch.cat([band.hits.slot for band in view.bands])
    return Hits(view.size[0] * view.size[1] * samples, ray, *parts, slot)


@pytest.mark.parametrize("samples", [1, 2])
def test_scenes_are_those_of_the_torch_twin(samples: int) -> None:
    """A textured shape, shadows and all: G-buffer and shading in torch, averaged over samples; black elsewhere."""
    (scene, materials), camera, light = textured_object()
    found = render_scene((scene, materials), camera, light, SIZE, samples)
    hits = hits_of(find_view(scene, camera, SIZE, samples))
    lobes = shade(build_gbuffer(hits, materials), camera, light, is_lit(scene, hits, light))

    def average(values: torch.Tensor) -> torch.Tensor:
        every = torch.zeros(3, hits.rays)
        every[:, hits.ray] = values[..., 0]
        return every.view(3, *SIZE, samples**2).mean(dim=-1)

    hit = torch.zeros(hits.rays, dtype=torch.bool)
    hit[hits.ray] = True
    mask = hit.view(*SIZE, samples**2).all(dim=-1)
    assert 0.1 < float(mask.float().mean()) < 0.9
    assert_same_scene(found, Scene(*(lobe.map(average) for lobe in lobes), mask), 1e-5)


def test_views_serve_many_lights_and_materials() -> None:
    """One cast and two lights of two materials each: the bits of four renders."""
    (scene, first), camera, light = textured_object()
    second = random_materials(scene.mesh.slot_count, torch.Generator().manual_seed(8), scene.size)
    other = PointLight((-light.position[0], *light.position[1:]), light.intensity, 0.3)
    view = find_view(scene, camera, SIZE, 2)
    for lamp in (light, other):
        lit = find_lit(scene, view, lamp)
        for materials in (first, second):
            expected = render_scene((scene, materials), camera, lamp, SIZE, 2)
            assert_same_scene(shade_view(view, materials, lamp, lit), expected)


def test_threads_and_bands_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same bits from any number of threads; bands of other heights move roundings of sums at most."""
    model, camera, light = textured_object()
    set_threads(1)
    alone = render_scene(model, camera, light, SIZE, 2)
    monkeypatch.setattr(raycast, "RAYS_PER_BAND", 3000)
    bands = render_scene(model, camera, light, SIZE, 2)
    assert_same_scene(bands, alone, 1e-6)
    for threads in (2, 5):
        set_threads(threads)
        assert_same_scene(render_scene(model, camera, light, SIZE, 2), bands)


@pytest.mark.parametrize("distance", [0.0, 0.4, 1.2, 3.0])
@pytest.mark.parametrize("samples", [1, 2])
def test_filled_triangles_are_what_rays_hit(distance: float, samples: int) -> None:
    """Views and Embree find the same points and slots, but for rays on edges; from outside, near and from inside."""
    scene = MeshScene(random_mesh(torch.Generator().manual_seed(4)))
    camera = PinholeCamera((0.1, 0.2, 0.01 + distance * scene.size), (0.0, 0.3, 0.0), 50.0)
    size = (75, 133)
    expected = find_hits(scene, camera, in_order(size, samples), size)
    found = hits_of(find_view(scene, camera, size, samples))
    assert found.rays == expected.rays
    assert found.ray.numel() > 100
    both = np.intersect1d(found.ray, expected.ray, return_indices=True)
    assert len(both[0]) >= max(found.ray.numel(), expected.ray.numel()) - 3
    ours, theirs = (torch.from_numpy(index) for index in both[1:])
    same = (found.position[:, ours] - expected.position[:, theirs]).norm(dim=0)[:, 0] < 1e-4 * scene.size
    assert float(same.float().mean()) > 0.999
    assert bool((found.slot[ours] == expected.slot[theirs])[same].float().mean() > 0.999)
    for name, tolerance in (("normal", 1e-3), ("above", 2e-4 * scene.size)):
        away = (getattr(found, name)[:, ours] - getattr(expected, name)[:, theirs]).norm(dim=0)[:, 0]
        assert float((away[same] > tolerance).float().mean()) < 1e-3


def test_closed_meshes_have_no_gaps() -> None:
    """Every sample whose ray meets the unit ball well inside its outline is filled, at any size of triangles."""
    for seed in range(3):
        eye = 6 * normalize(torch.randn(3, 1, 1, generator=torch.Generator().manual_seed(seed))).flatten()
        camera = PinholeCamera(tuple(eye.tolist()), fov_deg=20.0)  # type: ignore[arg-type]
        for side in (40, 500):
            view = find_view(unit_ball(), camera, (side, side))
            filled = torch.zeros(side * side, dtype=torch.bool)
            filled[hits_of(view).ray] = True
            rows, cols = every_point((side, side))
            radius = torch.hypot(rows - side / 2, cols - side / 2) / side * 2 * math.tan(math.radians(10))
            assert bool(filled[radius < 0.99 * math.tan(math.asin(1 / 6))].all())
            assert not bool(filled[radius > 1.001 * math.tan(math.asin(1 / 6))].any())


@pytest.mark.parametrize(
    "place", [(3.0, 4.0, 5.0), (0.0, 6.0, 0.0), (-9.0, 0.1, 0.2), (0.3, 0.9, 1.1), (0.05, 0.1, 0.0)]
)
def test_shadows_are_those_of_rays(place: tuple[float, float, float]) -> None:
    """Points compared with triangles are lit as Embree says, but at edges; lights far, near and inside the shape."""
    for seed in (3, 4, 6):
        scene = MeshScene(random_mesh(torch.Generator().manual_seed(seed)))
        x, y, z = (0.5 * scene.size * side for side in place)
        camera, light = PinholeCamera((0.3 * scene.size, 0.6 * scene.size, 2.0 * scene.size)), PointLight((x, y, z))
        hits = find_hits(scene, camera, every_point(SIZE), SIZE)
        found = is_lit(scene, hits, light)[0, :, 0]
        way = torch.tensor(light.position).view(3, 1, 1) - hits.above
        distance = torch.sqrt(dot(way, way))
        origins, directions = ((v[..., 0].T.contiguous().numpy()) for v in (hits.above, way / distance))
        blocker = scene.tracer.run(origins, directions, query="OCCLUDED", dists=distance.flatten().numpy())
        toward = torch.tensor(light.position).view(3, 1, 1) - hits.position
        expected = torch.from_numpy(blocker < 0) & (dot(hits.normal, toward) > 0)[0, :, 0]
        assert int((found != expected).sum()) <= 1 + 1e-3 * found.numel()


def test_the_light_behind_a_mesh_in_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """A light among the triangles asks Embree; one before them does not."""
    scene = unit_ball()
    hits = find_hits(scene, PinholeCamera(), every_point(SIZE), SIZE)
    asked = []
    aim = raycast.rays.aim_at_light
    monkeypatch.setattr(raycast.rays, "aim_at_light", lambda *given: asked.append(True) or aim(*given))
    is_lit(scene, hits, PointLight((0.0, 0.0, 3.0)))
    assert asked == []
    is_lit(scene, hits, PointLight((0.0, 0.0, 0.5)))
    is_lit(scene, hits, PointLight((0.0, 0.0, 0.0)))
    assert asked == [True, True]


def test_threads_share_one_hierarchy() -> None:
    """Embree builds once, however many threads ask for it first."""
    scene, found = unit_ball(), []
    threads = [threading.Thread(target=lambda: found.append(scene.tracer)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 4
    assert all(tracer is scene.tracer for tracer in found)


@pytest.mark.parametrize("samples", [0, -1, 33])
def test_samples_are_checked(samples: int) -> None:
    """At least one ray per pixel, and no more than fit."""
    with pytest.raises(ValueError, match="expected 1 to 32 samples"):
        render_scene((unit_ball(), one_material()), PinholeCamera(), PointLight(), SIZE, samples)


def zenith_and_azimuth(camera: PinholeCamera) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of the unit ball's normals at the pixels: cosine to the camera, angle in the image, and where it is seen well.

    The camera is on the z axis, so that image-right is +x and image-up +y but for perspective.
    """
    part = Part(ball(1.0), plain(COLOR))
    rows, cols = every_point(SIZE)
    buffer = cast((part,), camera, rows, cols, SIZE)
    to_camera = normalize(torch.tensor(camera.position).view(3, 1, 1) - buffer.position)
    frame = beam_frame(to_camera, torch.tensor([0.0, 1.0, 0.0]).view(3, 1, 1))
    angle = torch.atan2(dot(buffer.normal, frame.y), dot(buffer.normal, frame.x))
    cosine = dot(buffer.normal, to_camera)
    steep = buffer.mask & (cosine > 0.15) & (cosine < 0.95)
    return tuple(x.view(SIZE) for x in (cosine, angle, steep))  # type: ignore[return-value]


def test_the_diffuse_of_a_ball_is_radial_and_follows_fresnel() -> None:
    """DoLP over the zenith angle is the Fresnel curve and AoLP the azimuth of the normal, for any light."""
    camera = PinholeCamera((0.0, 0.0, 8.0), fov_deg=16.0)
    cosine, angle, steep = zenith_and_azimuth(camera)
    for light in (PointLight((1.0, 2.0, 8.0), 60.0, 0.4), PointLight((-6.0, 1.0, 3.0), 60.0, 2.0)):
        diffuse = render_scene((unit_ball(), one_material()), camera, light, SIZE).diffuse
        seen = steep & (diffuse.s0[1] > 1e-2)
        assert int(seen.sum()) > 500
        dolp = torch.hypot(diffuse.s1, diffuse.s2)[1, seen] / diffuse.s0[1, seen]
        torch.testing.assert_close(dolp, diffuse_dolp(cosine[seen]), rtol=0, atol=INSIDE)
        aolp = 0.5 * torch.atan2(diffuse.s2, diffuse.s1)[1, seen]
        turned = torch.sin(aolp - angle[seen])
        assert float(turned.abs().max()) < 2e-2


def test_the_specular_of_a_ball_is_fully_polarized() -> None:
    """s1² + s2² = s0² at every pixel of one ray, whatever the polarizer of the light."""
    for polarizer in (0.0, 0.7, 2.2):
        light = PointLight((-3.0, 2.0, 6.0), 60.0, polarizer)
        specular = render_scene((unit_ball(), one_material()), PinholeCamera((0.5, 1.0, 6.0)), light, SIZE).specular
        peak = float(specular.s0.max())
        assert peak > 0.1
        polarized = torch.hypot(specular.s1, specular.s2)
        torch.testing.assert_close(polarized, specular.s0, rtol=1e-4, atol=1e-5 * peak)


def test_no_highlight_at_brewsters_angle() -> None:
    """Light polarized in the plane of incidence is not reflected where it comes in at arctan(eta)."""
    brewster = math.atan(ETA)
    camera = PinholeCamera((80 * math.sin(-brewster), 0.0, 80 * math.cos(brewster)), fov_deg=2.0)
    position = (80 * math.sin(brewster), 0.0, 80 * math.cos(brewster))
    glossy = Materials(torch.tensor([COLOR]), torch.tensor([0.2]), torch.ones(1))
    peaks = []
    for polarizer in (0.0, math.pi / 2):
        light = PointLight(position, 6400.0, polarizer)
        specular = render_scene((unit_ball(), glossy), camera, light, SIZE).specular
        peaks.append(float(specular.s0.max()))
    assert peaks[0] < 2e-3 * peaks[1]
