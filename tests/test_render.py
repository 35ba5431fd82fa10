"""The renderer against geometry that can be computed by hand: a ball, its shadow, its polarization, its highlight."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tolerances import HIT, NORMALS, ROUNDING, SHADING, assert_close, assert_finite, assert_same_angle, assert_within
from torch import Tensor

from polsep.physics.fresnel import diffuse_dolp
from polsep.physics.optics import dot, normalize
from polsep.physics.stokes import Stokes, aolp, dolp, polarized_intensity
from polsep.render import sphere_tracing as render_module
from polsep.render.distances import (
    ball,
    bumpy,
    cells,
    checker,
    floor,
    marble,
    plain,
    random_albedo,
    random_light,
    random_parts,
    rounded_box,
    still_life,
    stripes,
    torus,
)
from polsep.render.sphere_tracing import (
    GBuffer,
    Part,
    PinholeCamera,
    PointLight,
    camera_rays,
    cast,
    render,
    rotation_matrix,
)

WHITE = plain((0.8, 0.8, 0.8))
BALL = (Part(ball(1.0), WHITE, roughness=0.3),)
#: Far away, so that the lines of sight are nearly parallel.
FAR_CAMERA = PinholeCamera((0.0, 0.0, 25.0), fov_deg=2 * math.degrees(math.atan(1.1 / 25)))
LIGHT = PointLight((6.0, 8.0, 20.0), 400.0, 0.6)


def pixel_grid(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Rows and columns of all pixel centres, flat."""
    rows, cols = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return rows.flatten(), cols.flatten()


def look(parts: tuple[Part, ...], camera: PinholeCamera, height: int, width: int) -> tuple[GBuffer, Tensor, Tensor]:
    """G-buffer of every pixel, with the rays' origin ``[3, 1, 1]`` and directions ``[3, N, 1]``."""
    rows, cols = pixel_grid(height, width)
    origin, direction = camera_rays(camera, rows, cols, (height, width))
    return cast(parts, camera, rows, cols, (height, width)), origin, direction


def ball_distance(origin: Tensor, direction: Tensor, center: tuple[float, float, float], radius: float) -> Tensor:
    """Exact distance along each ray to a ball, infinite where it is missed."""
    offset = origin.double() - torch.tensor(center, dtype=torch.float64).view(3, 1, 1)
    along = dot(offset, direction.double())
    discriminant = along**2 - dot(offset, offset) + radius**2
    return torch.where(discriminant > 0, -along - discriminant.clamp(min=0).sqrt(), math.inf)


def stacked(stokes: Stokes) -> Tensor:
    return torch.stack([stokes.s0, stokes.s1, stokes.s2])


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.4, -0.3, 0.7)])
def test_rays_meet_a_ball_where_geometry_says(center: tuple[float, float, float]) -> None:
    """Hits, misses, distances and radial normals of a ball are the analytic ones."""
    parts = (Part(ball(1.2), WHITE, center, (0.3, 0.2, 0.1)),)
    camera = PinholeCamera((1.0, 2.0, 8.0))
    buffer, origin, direction = look(parts, camera, 36, 48)
    exact = ball_distance(origin, direction, center, 1.2)
    point = origin.double() + torch.where(exact.isfinite(), exact, 0.0) * direction.double()
    normal = (point - torch.tensor(center).view(3, 1, 1)) / 1.2
    facing = -dot(normal, direction.double())
    clear = (exact.isfinite() & (facing > 0.2))[0, :, 0]
    distance = torch.sqrt(dot(buffer.position - origin, buffer.position - origin))
    assert int(clear.sum()) > 200
    assert bool(buffer.mask[0, clear].all())
    assert_within(distance[0, clear], exact[0, clear], HIT)
    # The position slides along the ray by the distance error, which turns the normal at a steep angle.
    local = normalize(buffer.position - torch.tensor(center).view(3, 1, 1))
    assert_within(buffer.normal[:, clear], local[:, clear], NORMALS)
    outside = (ball_distance(origin, direction, center, 1.2 + HIT).isinf())[0, :, 0]
    assert not bool(buffer.mask[0, outside].any())


def test_material_is_that_of_the_part_that_was_hit() -> None:
    """Albedo, roughness and specular strength come from the nearest part, in that part's own coordinates."""
    left = Part(ball(0.5), plain((0.1, 0.2, 0.3)), (-1.0, 0.0, 0.0), roughness=0.2, specular=0.5)
    right = Part(ball(0.5), plain((0.6, 0.5, 0.4)), (1.0, 0.0, 0.0), roughness=0.4, specular=0.9)
    buffer, origin, direction = look((left, right), PinholeCamera(), 40, 60)
    for part, color in ((left, (0.1, 0.2, 0.3)), (right, (0.6, 0.5, 0.4))):
        here = ball_distance(origin, direction, part.center, 0.49).isfinite()[0, :, 0]
        assert int(here.sum()) > 20
        expected = torch.tensor(color).view(3, 1, 1).expand(3, int(here.sum()), 1)
        assert torch.equal(buffer.albedo[:, here], expected)
        assert bool((buffer.roughness[:, here] == part.roughness).all())
        assert bool((buffer.specular[:, here] == part.specular).all())


def test_camera_puts_points_where_a_pinhole_does() -> None:
    """A point to the right and up lands right of and above the centre, at the pinhole's scale; up is -row."""
    height, width, depth, fov = 60, 80, 10.0, 30.0
    camera = PinholeCamera((0.0, 0.0, depth), fov_deg=fov)
    focal = height / 2 / math.tan(math.radians(fov) / 2)
    for x, y in ((0.0, 0.0), (1.3, 0.8), (-1.5, -0.4)):
        buffer, _, _ = look((Part(ball(0.3), WHITE, (x, y, 0.0)),), camera, height, width)
        rows, cols = pixel_grid(height, width)
        hit = buffer.mask[0, :, 0]
        assert_within(rows[hit].mean(), height / 2 - focal * y / depth, 0.2)
        assert_within(cols[hit].mean(), width / 2 + focal * x / depth, 0.2)


def test_camera_rays_are_unit_and_centred() -> None:
    """Rays are unit vectors; the central one points at the target, the top edge is half the fov up."""
    camera = PinholeCamera((3.0, 1.0, 7.0), (0.5, -0.2, 0.1), 40.0)
    rows, cols = torch.tensor([10.0, 0.0]), torch.tensor([15.0, 15.0])
    origin, direction = camera_rays(camera, rows, cols, (20, 30))
    assert_close(dot(direction, direction), torch.ones(1, 2, 1))
    forward = normalize(torch.tensor(camera.target).view(3, 1, 1) - origin)
    assert_close(direction[:, :1], forward)
    cosine = dot(direction[:, 1:], forward).item()
    assert math.degrees(math.acos(cosine)) == pytest.approx(20.0, abs=0.01)
    assert direction[1, 1].item() > direction[1, 0].item()


def test_shadow_of_a_ball_on_another() -> None:
    """A point of the rear ball is dark exactly where the line to the light meets the front ball or its own back."""
    blocker, radius = (0.5, 0.6, 2.0), 0.35
    parts = (*BALL, Part(ball(radius), WHITE, blocker))
    light = PointLight((1.5, 1.8, 6.0), 100.0)
    camera = PinholeCamera((-2.0, 0.0, 8.0), fov_deg=18.0)
    size = (64, 64)
    diffuse, specular = render(parts, camera, light, size)
    buffer, origin, direction = look(parts, camera, *size)
    on_rear = ball_distance(origin, direction, (0.0, 0.0, 0.0), 0.99).isfinite()
    on_rear &= ball_distance(origin, direction, blocker, radius + 0.02).isinf()
    to_light = torch.tensor(light.position).view(3, 1, 1) - buffer.position
    unit = normalize(to_light)
    in_shadow = ball_distance(buffer.position, unit, blocker, radius - 0.02).isfinite()
    in_light = ball_distance(buffer.position, unit, blocker, radius + 0.02).isinf() & (dot(buffer.normal, unit) > 0.05)
    for mask, lit in ((on_rear & in_shadow, False), (on_rear & in_light, True)):
        pixels = mask.view(size)
        assert int(pixels.sum()) > 40
        for lobe in (diffuse, specular):
            assert torch.equal(lobe.s0[:, pixels] > 0, torch.full((3, int(pixels.sum())), lit))


def test_a_blocker_behind_the_light_casts_no_shadow() -> None:
    """Only what lies between the surface and the light darkens it."""
    behind = Part(ball(0.5), WHITE, (0.0, 0.0, 6.0))
    light = PointLight((0.0, 0.0, 4.0), 100.0)
    camera = PinholeCamera((8.0, 0.0, 6.0), fov_deg=16.0)
    alone, _ = render(BALL, camera, light, (24, 24))
    with_blocker, _ = render((*BALL, behind), camera, light, (24, 24))
    # Rays stop a little elsewhere on the same surface, because the second part shortens some steps.
    peak = alone.s0.max()
    assert_within(with_blocker.s0 / peak, alone.s0 / peak, SHADING)


def test_background_is_black_and_finite() -> None:
    """Where no part is hit all components are exactly zero, and nothing anywhere is NaN."""
    diffuse, specular = render(BALL, PinholeCamera(), LIGHT, (32, 40))
    buffer, _, _ = look(BALL, PinholeCamera(), 32, 40)
    missed = ~buffer.mask.view(32, 40)
    assert 0 < int(missed.sum()) < missed.numel()
    for lobe in (diffuse, specular):
        assert lobe.s0.shape == (3, 32, 40)
        assert_finite(stacked(lobe))
        assert bool((stacked(lobe)[..., missed] == 0).all())


def test_diffuse_of_a_ball_is_radial_and_follows_fresnel() -> None:
    """AoLP points from the ball's centre, DoLP is the Fresnel curve over the zenith angle, whatever the light."""
    size = 48
    diffuse, _ = render(BALL, FAR_CAMERA, LIGHT, (size, size))
    _, origin, direction = look(BALL, FAR_CAMERA, size, size)
    exact = ball_distance(origin, direction, (0.0, 0.0, 0.0), 1.0)
    cosine = -dot(origin + exact * direction, direction).view(size, size)
    rows, cols = (g.view(size, size) for g in pixel_grid(size, size))
    azimuth = torch.atan2(size / 2 - rows, cols - size / 2)
    lit = (diffuse.s0[0] > 0) & (cosine > 0.15)
    assert int(lit.sum()) > 600
    assert_within(dolp(diffuse)[0][lit], diffuse_dolp(cosine)[lit], SHADING)
    rim = lit & (cosine < 0.95)
    assert_same_angle(aolp(diffuse)[0][rim], azimuth[rim], SHADING)


def test_highlight_sits_at_the_half_vector() -> None:
    """The specular peak of a glossy ball is where its normal halves the directions to camera and light."""
    size = 96
    glossy = (Part(ball(1.0), WHITE, roughness=0.2),)
    _, specular = render(glossy, FAR_CAMERA, LIGHT, (size, size))
    peak = int(specular.s0[0].argmax())
    buffer, _, _ = look(glossy, FAR_CAMERA, size, size)
    to_camera = normalize(torch.tensor(FAR_CAMERA.position).view(3, 1, 1) - buffer.position)
    to_light = normalize(torch.tensor(LIGHT.position).view(3, 1, 1) - buffer.position)
    half = normalize(to_camera + to_light)
    angles = torch.acos(dot(buffer.normal, half).clamp(max=1))[0, :, 0]
    pixel = 2.2 / size  # one pixel in units of the ball's radius
    assert angles[peak].item() < 1.5 * pixel
    assert specular.s0[0].max().item() > 20 * specular.s0[0][specular.s0[0] > 0].median().item()


def test_specular_is_fully_polarized_and_colourless() -> None:
    """With one ray per pixel s1^2 + s2^2 = s0^2, in all three colours alike, times the part's specular strength."""
    half_strength = (Part(ball(1.0), plain((0.9, 0.1, 0.4)), roughness=0.3, specular=0.5),)
    _, specular = render(half_strength, PinholeCamera(), LIGHT, (48, 48))
    _, full = render(BALL, PinholeCamera(), LIGHT, (48, 48))
    assert_close(polarized_intensity(specular), specular.s0, scale=specular.s0.max().item())
    assert torch.equal(specular.s0[0], specular.s0[1]) and torch.equal(specular.s0[0], specular.s0[2])
    assert_close(stacked(specular), 0.5 * stacked(full), scale=specular.s0.max().item())


def test_averaged_light_is_partially_polarized() -> None:
    """Mixing rays never raises the degree of polarization above 1."""
    _, specular = render(BALL, PinholeCamera(), LIGHT, (24, 24), samples=3)
    excess = polarized_intensity(specular) - specular.s0
    assert excess.max().item() <= ROUNDING[torch.float32] * specular.s0.max().item()


@pytest.mark.parametrize("samples", [2, 3])
def test_samples_are_the_mean_of_a_finer_image(samples: int) -> None:
    """n x n rays per pixel give the mean over blocks of an image of n times the size."""
    parts = (*BALL, Part(ball(0.5), plain((0.2, 0.6, 0.3)), (1.0, 0.4, 1.2), roughness=0.4))
    camera, light = PinholeCamera(), LIGHT
    height, width = 8, 12
    coarse = render(parts, camera, light, (height, width), samples)
    fine = render(parts, camera, light, (height * samples, width * samples))
    for a, b in zip(coarse, fine, strict=True):
        mean = stacked(b).view(3, 3, height, samples, width, samples).mean((3, 5))
        difference = (stacked(a) - mean).abs().amax((0, 1)) / stacked(b).abs().max()
        # Rounding may turn a single ray at an edge into a miss, never more.
        assert difference.median().item() <= ROUNDING[torch.float32]
        assert int((difference > SHADING).sum()) <= 2


def test_bands_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    """The image does not depend on how many rays are traced together."""
    whole = render(BALL, PinholeCamera(), LIGHT, (22, 18), 2)
    monkeypatch.setattr(render_module, "RAYS_AT_ONCE", 18 * 4 * 5)
    bands = render(BALL, PinholeCamera(), LIGHT, (22, 18), 2)
    for a, b in zip(whole, bands, strict=True):
        assert_close(stacked(a), stacked(b), scale=a.s0.max().item())


def test_light_is_linear_and_albedo_too() -> None:
    """Both lobes are proportional to the light's intensity; the diffuse is proportional to albedo per colour."""
    camera, size = PinholeCamera(), (24, 24)
    once = render(BALL, camera, LIGHT, size)
    twice = render(BALL, camera, PointLight(LIGHT.position, 2 * LIGHT.intensity, LIGHT.polarizer), size)
    for a, b in zip(once, twice, strict=True):
        assert_close(2 * stacked(a), stacked(b), scale=b.s0.max().item())
    colored, _ = render((Part(ball(1.0), plain((0.8, 0.4, 0.0))),), camera, LIGHT, size)
    factors = torch.tensor([1.0, 0.5, 0.0]).view(3, 1, 1)
    assert_close(stacked(colored), stacked(once[0]) * factors, scale=once[0].s0.max().item())


def test_crossed_polarizers_of_the_light_add_up() -> None:
    """The sum over two crossed light polarizers is unpolarized light: it does not depend on their common angle."""
    sums = []
    for angle in (0.2, 0.9):
        pair = [
            render(BALL, PinholeCamera(), PointLight(LIGHT.position, 400.0, angle + turn), (24, 24))
            for turn in (0, math.pi / 2)
        ]
        sums.append([stacked(pair[0][lobe]) + stacked(pair[1][lobe]) for lobe in (0, 1)])
    for a, b in zip(*sums, strict=True):
        assert_close(a, b, scale=a.abs().max().item())


def test_mirrored_scene_gives_the_mirrored_image() -> None:
    """Mirroring parts, light and polarizer left-right mirrors the image and changes the sign of s2."""
    parts = (*BALL, Part(ball(0.5), plain((0.2, 0.6, 0.3)), (1.0, 0.4, 1.2), roughness=0.4))
    mirrored = (*BALL, Part(ball(0.5), plain((0.2, 0.6, 0.3)), (-1.0, 0.4, 1.2), roughness=0.4))
    other = PointLight((-LIGHT.position[0], *LIGHT.position[1:]), LIGHT.intensity, -LIGHT.polarizer)
    camera, size = PinholeCamera(), (32, 32)
    for a, b in zip(render(parts, camera, LIGHT, size), render(mirrored, camera, other, size), strict=True):
        expected = stacked(a).flip(-1) * torch.tensor([1.0, 1.0, -1.0]).view(3, 1, 1, 1)
        difference = (stacked(b) - expected).abs().amax((0, 1)) / a.s0.max()
        assert difference.median().item() <= ROUNDING[torch.float32]
        assert int((difference > SHADING).sum()) <= 6


def test_rotation_matrix_turns_about_each_axis() -> None:
    """Positive angles turn y to z, z to x and x to y, applied about x first, and the matrix is a rotation."""
    quarter = math.pi / 2
    x, y, z = torch.eye(3)
    for angles, start, end in (((quarter, 0, 0), y, z), ((0, quarter, 0), z, x), ((0, 0, quarter), x, y)):
        assert_close(rotation_matrix(angles) @ start, end)
    assert_close(rotation_matrix((quarter, 0, quarter)) @ y, z)
    matrix = rotation_matrix((0.3, -1.2, 2.0))
    assert_close(matrix @ matrix.T, torch.eye(3))
    assert torch.linalg.det(matrix).item() == pytest.approx(1, abs=ROUNDING[torch.float32])


def test_part_turns_the_way_its_angles_say() -> None:
    """A long box turned by +30 degrees about the axis toward the viewer rises to the right in the image."""
    box = Part(rounded_box((1.0, 0.2, 0.2), 0.05), WHITE, rotation=(0.0, 0.0, math.radians(30)))
    mask = look((box,), PinholeCamera(), 49, 49)[0].mask[0, :, 0]
    rows, cols = pixel_grid(49, 49)
    x, y = (cols - 24.5)[mask], (24.5 - rows)[mask]
    principal = 0.5 * torch.atan2(2 * (x * y).mean(), (x * x).mean() - (y * y).mean())
    assert_same_angle(principal, math.radians(30), 5 * SHADING)


def test_irradiance_falls_with_the_square_of_the_distance() -> None:
    """A light straight in front of a flat face at twice the distance gives a quarter of both lobes."""
    wall = (Part(rounded_box((2.0, 2.0, 0.5), 0.1), WHITE, (0.0, 0.0, -0.5), roughness=0.8),)
    camera = PinholeCamera((2.0, 0.0, 8.0), fov_deg=10.0)
    near, far = (render(wall, camera, PointLight((0.0, 0.0, h), 100.0, 0.3), (5, 5)) for h in (3.0, 6.0))
    for a, b in zip(near, far, strict=True):
        assert_within(a.s0[:, 2, 2] / b.s0[:, 2, 2], torch.full((3,), 4.0), 4 * SHADING)


@pytest.mark.parametrize(
    ("field", "surface"),
    [
        (ball(0.7), [(0.7, 0, 0), (0, -0.7, 0)]),
        (rounded_box((0.5, 0.4, 0.3), 0.1), [(0.5, 0, 0), (0, 0.4, 0.1), (-0.2, 0.1, -0.3)]),
        (torus(0.6, 0.2), [(0.8, 0, 0), (0, 0.4, 0), (0.6, 0, 0.2)]),
        (floor(-0.3), [(2, -0.3, 1)]),
    ],
)
def test_distances_are_distances(
    field: Callable[[Tensor], Tensor], surface: list[tuple[float, float, float]], generator: torch.Generator
) -> None:
    """Signed distances vanish on the surface and change by at most the way travelled, at that rate outside."""
    assert_close(field(torch.tensor(surface).float().T[..., None]), torch.zeros(1, len(surface), 1))
    points = 3 * torch.rand(3, 500, 1, generator=generator, dtype=torch.float64) - 1.5
    points.requires_grad_()
    distance = field(points)
    (slope,) = torch.autograd.grad(distance.sum(), points)
    steepness = torch.sqrt(dot(slope, slope))
    assert steepness.max().item() <= 1 + 1e-9
    assert_close(steepness[distance > 0], torch.ones(int((distance > 0).sum()), dtype=torch.float64))


def test_bumps_stay_within_their_amplitude(generator: torch.Generator) -> None:
    """A displaced surface is at most the amplitude away from its base."""
    points = 3 * torch.rand(3, 500, 1, generator=generator) - 1.5
    difference = bumpy(ball(1.0), 0.02, 9.0)(points) - ball(1.0)(points)
    assert 0.01 < difference.abs().max().item() <= 0.02 * (1 + ROUNDING[torch.float32])


def test_albedo_stays_in_range(generator: torch.Generator) -> None:
    """Every pattern stays between its colours, and random patches without saturation are grey."""
    points = 4 * torch.rand(3, 1000, 1, generator=generator) - 2
    first, second = (0.1, 0.8, 0.3), (0.6, 0.2, 0.5)
    low, high = (torch.tensor(c).view(3, 1, 1) for c in ((0.1, 0.2, 0.3), (0.6, 0.8, 0.5)))
    patterns = [checker(first, second, 0.3), stripes(first, second, 0.3), marble(first, second, 0.5)]
    for pattern in [*patterns, cells((first, second), 0.3, generator)]:
        albedo = pattern(points)
        assert albedo.shape == points.shape
        assert bool(((albedo >= low - 1e-6) & (albedo <= high + 1e-6)).all())
        assert albedo[0].std().item() > 0.01
    grey = random_albedo(generator, 0.0)(points)
    assert_close(grey[0], grey[1])
    assert_close(grey[0], grey[2])
    colored = random_albedo(generator, 1.0)(points)
    assert colored.min().item() >= 0 and colored.max().item() <= 1


def test_scenes_are_deterministic() -> None:
    """The same seed gives the same random scene and the same image; another seed gives another."""
    images = []
    for seed in (3, 3, 4):
        generator = torch.Generator().manual_seed(seed)
        parts, light = random_parts(generator), random_light(generator)
        assert 0 <= light.polarizer < math.pi
        assert light.position[1] >= 0 and light.position[2] > 0
        images.append(stacked(render(parts, PinholeCamera(), light, (8, 8))[0]))
    assert torch.equal(images[0], images[1])
    assert not torch.equal(images[0], images[2])
    first, second = (stacked(render(*still_life(), (6, 8))[0]) for _ in range(2))
    assert torch.equal(first, second)
    assert_finite(first)
