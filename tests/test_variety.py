"""What training examples have beyond the views of data sets: every draw keeps what it must and stays in its bounds."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from tolerances import SIGMAS, assert_close
from torch import Tensor

pytest.importorskip("embreex")

from polsep.physics.stokes import Stokes
from polsep.render.materials import Materials, random_materials
from polsep.render.raycast import MeshScene, View, find_lit, find_view, shade_view
from polsep.render.sphere_tracing import Scene
from polsep.render.views import MIN_LIT, Shot, lit_share, random_shot, seeded_shape
from polsep.sensor.camera import IMX250
from polsep.train.variety import (
    BITS,
    BITS_SHARES,
    BLURS,
    CLOSE_SHARE,
    DEPOLARIZED_SHARE,
    FULL_WELLS,
    GLARE_SHARE,
    GREY_SATURATION,
    GREY_SHARE,
    MAGNIFICATIONS,
    MATTE_SHARE,
    MATTE_STRENGTH,
    MAX_SHEEN,
    PLAIN_SHARE,
    RELIEF_SHARE,
    RELIEF_TILTS,
    RETAINED,
    RETAINING_SHARE,
    SHEEN_ROUGHNESS,
    SHEEN_SHARE,
    UNPOLARIZED_SHARE,
    WHITE,
    WHITE_SHARE,
    LitView,
    random_sensor,
    relight,
    render_sheen,
    vary_colors,
    vary_gloss,
    vary_normals,
    vary_polarization,
    vary_retention,
    vary_shot,
)

#: A field of view that shows one point.
NARROW_DEG = 0.01


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def expect_share(count: int, draws: int, share: float) -> None:
    """So many of the draws are within the statistics of ``share``."""
    assert abs(count - draws * share) < SIGMAS * math.sqrt(draws * share * (1 - share))


@pytest.fixture(scope="module")
def shape() -> MeshScene:
    return seeded_shape("train", 0, 0)


@pytest.fixture(scope="module")
def shots(shape: MeshScene) -> list[Shot]:
    return [random_shot(shape, seeded(k)) for k in range(12)]


@pytest.fixture(scope="module")
def varied(shape: MeshScene, shots: list[Shot]) -> list[Shot]:
    return [vary_shot(shape, shot, seeded(100 + k)) for k, shot in enumerate(shots)]


def test_shots_keep_place_light_and_exposure(shots: list[Shot], varied: list[Shot]) -> None:
    """The lens differs; camera and light stay where they are, so the light still reaches what it did."""
    for before, after in zip(shots, varied, strict=True):
        assert after.light == before.light
        assert after.clip == before.clip
        assert after.camera.position == before.camera.position
        assert BLURS[0] <= after.blur <= BLURS[1]


def normals_of(view: View) -> Tensor:
    return torch.cat([band.hits.normal[..., 0] for band in view.bands], dim=1)


def test_relief_tilts_normals_and_moves_nothing(shape: MeshScene, shots: list[Shot]) -> None:
    """Half of the views keep their very normals; in the others they stay of length 1, tilt, and still face the eye."""
    view = find_view(shape, shots[0].camera, (48, 48))
    smooth = normals_of(view).clone()
    eye = torch.tensor(view.camera.position, dtype=torch.float32)[:, None]
    rough = [vary_normals(view, seeded(k)) for k in range(40)]
    expect_share(sum(other is not view for other in rough), 40, RELIEF_SHARE)
    assert torch.equal(normals_of(view), smooth)
    for other in rough:
        found = normals_of(other)
        assert_close(found.norm(dim=0), torch.ones(found.shape[1]))
        for before, after in zip(view.bands, other.bands, strict=True):
            assert after.hits.position is before.hits.position
            assert after.hits.above is before.hits.above
        toward = eye - torch.cat([band.hits.position[..., 0] for band in other.bands], dim=1)
        turned = (found - smooth).abs().amax(dim=0) > 0
        assert bool(((found * toward).sum(dim=0) > 0)[turned].all())
        if other is not view:
            tilt = torch.tan(torch.acos((found * smooth).sum(dim=0).clamp(-1, 1)))[turned].median()
            assert RELIEF_TILTS[0] / 4 < float(tilt) < RELIEF_TILTS[1] * 2


def test_shots_keep_the_size_or_enlarge(shots: list[Shot], varied: list[Shot]) -> None:
    def extent(shot: Shot) -> float:
        return math.tan(math.radians(shot.camera.fov_deg) / 2)

    magnifications = [extent(a) / extent(b) for a, b in zip(shots, varied, strict=True)]
    assert all(MAGNIFICATIONS[0] - 1e-6 <= m <= MAGNIFICATIONS[1] + 1e-6 for m in magnifications)
    for before, after, magnification in zip(shots, varied, magnifications, strict=True):
        assert (magnification == 1) == (after.camera == before.camera)
    expect_share(sum(m > 1 for m in magnifications), len(shots), CLOSE_SHARE)


def test_close_ups_render_view_a_lit_point(shape: MeshScene, shots: list[Shot], varied: list[Shot]) -> None:
    """All that a field of view of a hundredth of a degree shows lies on the object and in the light."""
    close = [after for before, after in zip(shots, varied, strict=True) if after.camera != before.camera]
    assert close
    for shot in close:
        assert lit_share(shape, replace(shot, camera=replace(shot.camera, fov_deg=NARROW_DEG))) > 0.9


def test_new_lights_reach_much_of_the_view(shape: MeshScene, varied: list[Shot]) -> None:
    for k, shot in enumerate(varied):
        light = relight(shape, shot, seeded(k))
        assert light != shot.light
        assert lit_share(shape, replace(shot, light=light)) >= MIN_LIT


def saturation(albedo: Tensor) -> Tensor:
    return 1 - albedo.amin(dim=1) / albedo.amax(dim=1)


def albedos(materials: Materials) -> list[Tensor]:
    """Of the first materials, and of the second ones of textures."""
    return [materials.albedo] + ([materials.textures.albedo] if materials.textures is not None else [])


def test_looks_keep_what_they_must() -> None:
    """Grey ones keep brightness and at most `GREY_SATURATION` of their saturation, matte ones some specular light.

    Glaring ones have more of it. On white ground textures keep their colours.
    """
    draws, grey, white, plain, matte, glaring = 200, 0, 0, 0, 0, 0
    for seed in range(draws):
        before = random_materials(5, seeded(seed))
        generator = seeded(1000 + seed)
        after = vary_gloss(vary_colors(before, generator), generator)
        assert torch.equal(after.roughness, before.roughness)
        left = after.specular / before.specular
        matte += bool((left < 1).any())
        glaring += bool((left > 1).any())
        assert bool((left >= 1).all()) or bool((left > MATTE_STRENGTH[0]).all() and (left < 1).all())
        same = torch.equal(after.albedo, before.albedo)
        ground = bool((after.albedo.amax(dim=1) > before.albedo.amax(dim=1) + 1e-5).any())
        white += ground
        pairs = list(zip(albedos(before), albedos(after), strict=False))
        if ground:
            assert float(after.albedo.amax(dim=1).min()) >= WHITE
            assert all(torch.equal(new, old) for old, new in pairs[1:])
        for old, new in pairs[: 1 if ground else 2]:
            assert ground or torch.equal(new, old) == same
            assert same or bool((saturation(new) <= GREY_SATURATION * saturation(old) + 1e-5).all())
        if not ground:
            assert all(torch.allclose(new.amax(dim=1), old.amax(dim=1)) for old, new in pairs)
        grey += not same and not ground
        plain += before.textures is not None and after.textures is None
    expect_share(grey, draws, GREY_SHARE)
    expect_share(white, draws, WHITE_SHARE)
    expect_share(plain, draws, PLAIN_SHARE)
    expect_share(matte, draws, MATTE_SHARE)
    expect_share(glaring, draws, GLARE_SHARE)


def test_sensors_stay_in_their_bounds() -> None:
    draws = 400
    sensors = [random_sensor(seeded(k)) for k in range(draws)]
    assert all(FULL_WELLS[0] <= sensor.full_well <= FULL_WELLS[1] for sensor in sensors)
    assert all(replace(s, full_well=IMX250.full_well, bits=IMX250.bits) == IMX250 for s in sensors)
    for bits, share in zip(BITS, BITS_SHARES, strict=True):
        expect_share(sum(sensor.bits == bits for sensor in sensors), draws, share)
    middle = math.sqrt(FULL_WELLS[0] * FULL_WELLS[1])  # the median of a log-uniform law
    expect_share(sum(sensor.full_well < middle for sensor in sensors), draws, 0.5)


def test_a_seed_draws_the_same_again(shape: MeshScene, shots: list[Shot]) -> None:
    for seed, shot in enumerate(shots[:4]):
        assert vary_shot(shape, shot, seeded(seed)) == vary_shot(shape, shot, seeded(seed))
        assert relight(shape, shot, seeded(seed)) == relight(shape, shot, seeded(seed))
        assert random_sensor(seeded(seed)) == random_sensor(seeded(seed))
        materials = random_materials(3, seeded(seed))
        once, again = (vary_gloss(vary_colors(materials, seeded(seed)), seeded(seed)) for _ in range(2))
        assert all(torch.equal(a, b) for a, b in zip(albedos(once), albedos(again), strict=True))


def test_some_diffuse_light_is_less_polarized_and_nothing_else_differs() -> None:
    draws, generator = 2000, seeded(5)
    lobes = [Stokes(*(x * torch.ones(1, 1, 1) for x in values)) for values in ((1.0, 0.2, -0.1), (0.5, 0.3, 0.4))]
    scene = Scene(*lobes, torch.ones(1, 1, dtype=torch.bool))
    kept = []
    for _ in range(draws):
        found = vary_polarization(scene, generator)
        assert found.specular is scene.specular
        assert found.mask is scene.mask
        assert torch.equal(found.diffuse.s0, scene.diffuse.s0)
        kept.append(float(found.diffuse.s1 / scene.diffuse.s1))
        assert_close(found.diffuse.s2, kept[-1] * scene.diffuse.s2)
    assert min(kept) == 0
    assert max(kept) == 1
    expect_share(sum(k < 1 for k in kept), draws, DEPOLARIZED_SHARE)
    expect_share(sum(k == 0 for k in kept), draws, DEPOLARIZED_SHARE * UNPOLARIZED_SHARE)


def test_some_diffuse_light_keeps_its_polarization() -> None:
    """What is added is white, fully polarized at the angle of the highlights or of a sheen, a share of the diffuse."""
    draws, generator = 2000, seeded(6)
    diffuse = Stokes(torch.tensor([0.9, 0.6, 0.3])[:, None, None], *torch.zeros(2, 3, 1, 1))
    specular = Stokes(torch.full((3, 1, 1), 0.5), torch.full((3, 1, 1), 0.3), torch.full((3, 1, 1), 0.4))
    scene = Scene(diffuse, specular, torch.ones(1, 1, dtype=torch.bool))
    shares, rough = [], []

    def sheen(roughness: float) -> Stokes:
        rough.append(roughness)
        return Stokes(*(torch.full((1, 1, 1), value) for value in (1.0, -0.6, 0.8)))

    for _ in range(draws):
        before = len(rough)
        found = vary_retention(scene, sheen, generator)
        assert found.diffuse is diffuse
        more = found.specular.s0 - specular.s0
        shares.append(float(more[0]) / 0.6)
        assert_close(found.specular.s1 - specular.s1, (0.6 if len(rough) == before else -0.6) * more)
        assert_close(found.specular.s2 - specular.s2, 0.8 * more)
        assert_close(more, more[:1].expand(3, 1, 1))
    kept = [share for share in shares if share > 0]
    expect_share(len(kept), draws, RETAINING_SHARE)
    expect_share(len(rough), draws, RETAINING_SHARE * SHEEN_SHARE)
    assert min(kept) >= RETAINED[0] - 1e-6
    assert max(kept) <= RETAINED[1] + 1e-6
    assert SHEEN_ROUGHNESS[0] <= min(rough) <= max(rough) <= SHEEN_ROUGHNESS[1]


def test_sheens_are_polarized_light_that_knows_no_material(shape: MeshScene, shots: list[Shot]) -> None:
    """1 in the median of what is lit, at most `MAX_SHEEN`, fully polarized, and the same for every albedo."""
    view = find_view(shape, shots[0].camera, (48, 48))
    light = shots[0].light
    lit = find_lit(shape, view, light)
    looks = [LitView(view, random_materials(shape.mesh.slot_count, seeded(k)), light, lit) for k in range(2)]
    found, other = (render_sheen(look, 0.7) for look in looks)
    assert torch.equal(found.s0, other.s0)
    reached = shade_view(*looks[0]).diffuse.s0[:1] > 0
    assert float(found.s0[~reached].abs().max()) == 0
    assert abs(float(found.s0[reached].median()) - 1) < 1e-5
    assert float(found.s0.max()) <= MAX_SHEEN + 1e-5
    assert_close(torch.hypot(found.s1, found.s2), found.s0, scale=MAX_SHEEN)
