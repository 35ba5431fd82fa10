"""Photometric stereo, diffuse polarization and integration: exact where they must be, and the same from every side."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from polsep.physics.fresnel import diffuse_dolp, fresnel

pytest.importorskip("scipy")

from polsep.geometry.integration import SHARPNESS, Equations, find_slopes, integrate_bilateral, integrate_smooth
from polsep.geometry.lights import NAMED, parse_lights
from polsep.geometry.multigrid import Multigrid, solve
from polsep.geometry.photometric import fit_lambertian, fit_robust
from polsep.geometry.polarization import (
    MIN_DEVIATION,
    POLARIZATION_DEVIATION,
    Polarized,
    find_diffuse_polarization,
    normals_from_polarization,
)

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Six lights, no three in a plane, that all reach a cap of 50 degrees.
LIGHTS = parse_lights("0,0,1 0.4,0.1,1 -0.4,0.2,1 0.1,0.5,1 0.2,-0.5,1 -0.3,-0.3,1")
SIX = np.array(list(NAMED.values()))


def cap(size: int, zenith_deg: float) -> tuple[Floats, Mask]:
    """Normals of a sphere up to a zenith, and where they are; an even number of pixels per side."""
    at = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(at, -at)
    radius = np.hypot(x, y) * math.sin(math.radians(zenith_deg))
    mask = np.hypot(x, y) < 1
    z = np.sqrt(np.maximum(1 - radius**2, 0))
    scale = math.sin(math.radians(zenith_deg))
    return np.stack([x * scale, y * scale, z], axis=-1) * mask[..., None], mask


def angles(found: Floats, truth: Floats, mask: Mask) -> Floats:
    """Angles between normals [degrees]; by the sine, which is exact for small ones."""
    cross = np.linalg.norm(np.cross(found[mask], truth[mask]), axis=-1)
    return np.asarray(np.degrees(np.arctan2(cross, (found[mask] * truth[mask]).sum(axis=-1))))


def through(cosines: Floats) -> Floats:
    return np.asarray(fresnel(torch.from_numpy(np.clip(cosines, 0.05, 1))).t_plus.numpy())


def lambertian(normals: Floats, directions: Floats, albedo: Floats) -> Floats:
    """Images ``[L, H, W, C]``, no cast shadows."""
    shading = np.maximum(np.einsum("li,hwi->lhw", directions, normals), 0)
    return np.asarray(shading[..., None] * albedo)


def dielectric(normals: Floats, directions: Floats, albedo: Floats) -> Floats:
    """The same behind an interface of refractive index 1.5, unpolarized light."""
    cosines = np.einsum("li,hwi->lhw", directions, normals)
    passed = through(cosines) * through(normals[..., 2]) / through(np.ones(1)) ** 2
    return lambertian(normals, directions, albedo) * passed[..., None]


def slope_of(normals: Floats) -> NDArray[np.complex128]:
    dolp = diffuse_dolp(torch.from_numpy(normals[..., 2])).numpy()
    return np.asarray(dolp * np.exp(2j * np.arctan2(normals[..., 1], normals[..., 0])))


def test_a_lambertian_sphere_is_found_exactly() -> None:
    """Least squares: normals and albedo to rounding, whatever the colours."""
    normals, mask = cap(48, 50)
    albedo = np.random.default_rng(0).uniform(0.1, 1, (48, 48, 3))
    found = fit_lambertian(lambertian(normals, LIGHTS, albedo), LIGHTS, mask)
    assert np.abs(found.normals - normals)[mask].max() < 1e-6
    assert np.abs(found.albedo - albedo)[mask].max() < 1e-6
    assert (found.normals[~mask] == 0).all() and (found.albedo[~mask] == 0).all()


def test_a_dielectric_sphere_is_found_where_all_lights_reach() -> None:
    """Robust fit: its model includes the transmission, so it is exact where nothing is in shadow."""
    normals, mask = cap(48, 50)
    images = dielectric(normals, LIGHTS, np.full((48, 48, 1), 0.4))
    found = fit_robust(images, LIGHTS, mask)
    assert angles(found.normals, normals, mask).max() < 0.05
    assert np.abs(found.albedo / 0.4 - 1)[mask].max() < 2e-3


def test_highlights_and_shadows_are_outlived() -> None:
    """One light of six is a highlight here, none there: the robust fit is several times nearer than least squares."""
    normals, mask = cap(64, 50)
    images = dielectric(normals, LIGHTS, np.full((64, 64, 1), 0.4))
    for k in range(6):
        images[k, 10 * k : 10 * k + 5, :] += 0.3
        images[k, :, 10 * k : 10 * k + 4] = 0
    robust, plain = (angles(fit(images, LIGHTS, mask).normals, normals, mask) for fit in (fit_robust, fit_lambertian))
    assert robust.mean() < 0.35 * plain.mean()


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_normals_turn_with_the_camera(turns: int) -> None:
    """Images, lights and polarization turned by 90 degrees give normals that are turned."""
    normals, mask = cap(32, 70)
    images = dielectric(normals, SIX, np.full((32, 32, 3), 0.4))
    found = fit_robust(images, SIX, mask, normals_from_polarization(slope_of(normals)))
    turned = np.rot90(images, turns, axes=(1, 2))
    c, s = (round(f(turns * math.pi / 2)) for f in (math.cos, math.sin))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    slope = np.rot90(slope_of(normals), turns) * (-1.0) ** turns
    again = fit_robust(turned, SIX @ rotation.T, np.rot90(mask, turns), normals_from_polarization(slope))
    assert np.abs(again.normals - np.rot90(found.normals, turns) @ rotation.T).max() < 1e-3


def test_polarization_says_what_shading_leaves_open() -> None:
    """Five of the named lights lie in one plane: below, only polarization knows how far a normal is tilted."""
    normals, mask = cap(48, 75)
    images = dielectric(normals, SIX, np.full((48, 48, 1), 0.4))
    dark = mask & (normals @ SIX[5] < 0)
    alone = angles(fit_robust(images, SIX, mask).normals, normals, dark)
    helped = angles(fit_robust(images, SIX, mask, normals_from_polarization(slope_of(normals))).normals, normals, dark)
    assert helped.mean() < 2.0 and helped.mean() < 0.3 * alone.mean()


def test_a_slope_has_two_normals_half_a_turn_apart() -> None:
    """`normals_from_polarization` undoes the Fresnel curve; the other normal has the opposite azimuth."""
    normals, mask = cap(32, 80)
    cue = normals_from_polarization(slope_of(normals))
    nearer = np.minimum(angles(cue.first, normals, mask), angles(cue.second, normals, mask))
    assert nearer[nearer.size // 4 :].max() < 0.5
    assert np.allclose(cue.first[mask] * np.array([-1.0, -1.0, 1.0]), cue.second[mask])
    assert (cue.deviation[mask] > 0).all()


@pytest.mark.parametrize("zenith_deg", [35, 50, 65, 75])
def test_deviations_of_normals_are_those_that_noise_makes(zenith_deg: int) -> None:
    """Of each component of the polarization; along each of two axes, beside the least deviation."""
    zenith = math.radians(zenith_deg)
    normals, everywhere = np.tile([math.sin(zenith), 0, math.cos(zenith)], (200, 200, 1)), np.ones((200, 200), np.bool_)
    noise = np.random.default_rng(6).normal(scale=POLARIZATION_DEVIATION, size=(2, 200, 200))
    exact = slope_of(normals)
    found = normals_from_polarization(exact + noise[0] + 1j * noise[1]).first
    off = float(np.square(np.radians(angles(found, normals, everywhere))).mean())
    said = normals_from_polarization(exact).deviation.mean()
    assert said == pytest.approx(math.sqrt(off / 2 + MIN_DEVIATION**2), rel=0.15)


def test_slopes_ignore_the_frames_whose_light_is_specular() -> None:
    """The slope of the diffuse light is found although one frame of six is full of polarized specular light."""
    generator = np.random.default_rng(3)
    diffuse = generator.uniform(0.2, 0.8, (6, 24, 24))
    slope = 0.08 * np.exp(1.1j)
    specular = np.zeros_like(diffuse)
    specular[2] = 0.3
    both = slope * diffuse + specular * np.exp(0.4j)
    frames = Polarized(diffuse, specular, both.real, both.imag, np.ones_like(diffuse))
    found = find_diffuse_polarization(frames, np.ones((24, 24), np.bool_))
    assert np.abs(found - slope).max() < 1e-3


def bumps(height: int, width: int) -> tuple[Floats, Floats]:
    """Depth of a smooth surface and its normals."""
    rows, cols = np.mgrid[:height, :width].astype(np.float64)
    depth = 6 * np.sin(cols / 17) * np.cos(rows / 21)
    along_u = 6 / 17 * np.cos(cols / 17) * np.cos(rows / 21)
    along_v = -6 / 21 * np.sin(cols / 17) * np.sin(rows / 21)
    normals = np.stack([along_u, -along_v, np.ones_like(depth)], axis=-1)
    return depth, normals / np.linalg.norm(normals, axis=-1, keepdims=True)


@pytest.mark.parametrize("integrate", [integrate_bilateral, integrate_smooth])
def test_an_analytic_surface_comes_back(integrate: object) -> None:
    """Orthographic: depth to a small part of a pixel, up to its mean."""
    depth, normals = bumps(60, 72)
    mask = np.ones(depth.shape, np.bool_)
    mask[:10, :12] = False
    assert callable(integrate)
    found = integrate(normals, mask)
    assert np.isnan(found[~mask]).all()
    off = (found - depth)[mask]
    assert np.abs(off - off.mean()).max() < 0.12


def test_a_plane_before_a_pinhole_comes_back() -> None:
    """Perspective: relative depths of a slanted plane are exact, whatever the focal lengths."""
    matrix = np.array([[200.0, 0, 30], [0, 190, 22], [0, 0, 1]])
    normal = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    rows, cols = np.mgrid[:48, :64]
    rays = np.stack([(cols - 30) / 200, (22 - rows) / 190, -np.ones((48, 64))], axis=-1)
    depth = -1 / (rays @ normal)
    found = integrate_bilateral(np.broadcast_to(normal, (48, 64, 3)), np.ones((48, 64), np.bool_), matrix)
    assert np.abs(found / depth * depth.mean() - 1).max() < 2e-3


def test_a_jump_is_kept() -> None:
    """A ridge that is cut off: least squares smears the cut, bilateral weights keep most of it."""
    rows, cols = np.mgrid[:96, :120].astype(np.float64)
    down, across = rows - 48, cols - 60
    bell = np.where(across >= 0, 45 * np.exp(-((down / 19) ** 2) - (across / 38) ** 2), 0)
    normals = np.stack([bell * 2 * across / 38**2, -bell * 2 * down / 19**2, np.ones_like(bell)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    mask = np.ones(bell.shape, np.bool_)
    kept, smeared = (f(normals, mask) for f in (integrate_bilateral, integrate_smooth))
    assert kept[48, 59] - kept[48, 60] > 0.75 * 45
    assert smeared[48, 59] - smeared[48, 60] < 0.6 * 45
    assert np.std(kept + bell) < 0.4 * np.std(smeared + bell)


def residuals(image: Floats, normals: Floats, mask: Mask, axis: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Of every pixel on the mask along x (1) or down (0): (q dz)^2 and the squared residual, behind and ahead.

    NaN where there is no neighbour.
    """
    wanted = normals[..., 0] if axis == 1 else -normals[..., 1]
    padded = np.pad(np.where(mask, image, np.nan), 1, constant_values=np.nan)
    behind = image - np.roll(padded, 1, axis)[1:-1, 1:-1]
    ahead = np.roll(padded, -1, axis)[1:-1, 1:-1] - image
    sides = [normals[..., 2] * rise for rise in (behind, ahead)]
    before, after = ((side**2)[mask] for side in sides)
    return before, after, *(((side - wanted) ** 2)[mask] for side in sides)  # type: ignore[return-value]


def test_a_round_is_what_cao_et_al_write() -> None:
    """Eqs. 12-18 in NumPy: weights and energy; and the matrix is the one of which that energy is the square form."""
    generator = np.random.default_rng(11)
    mask = generator.random((9, 12)) < 0.8
    normals = generator.normal(size=(9, 12, 3))
    normals[..., 2] = np.abs(normals[..., 2]) + 0.3
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    image = generator.normal(size=(9, 12))
    system = Equations(find_slopes(normals, mask))
    weights, energy = system.weigh(image[mask])

    def energy_of(depth: Floats) -> float:
        full, total = np.zeros_like(image), 0.0
        full[mask] = depth
        for axis, weight in ((1, weights[0]), (0, weights[1])):
            _, _, behind, ahead = residuals(full, normals, mask, axis)
            total += float((np.nan_to_num(behind) * (1 - weight) + np.nan_to_num(ahead) * weight).sum())
        return total

    for axis, weight in ((1, weights[0]), (0, weights[1])):
        behind, ahead, *_ = residuals(image, normals, mask, axis)
        both = np.isfinite(behind) & np.isfinite(ahead)
        expected = 1 / (1 + np.exp(-SHARPNESS * (behind - ahead)[both]))
        assert np.abs(weight[both] - expected).max() < 1e-12
        assert (weight[~both] == np.isfinite(ahead)[~both]).all()
    assert energy == pytest.approx(energy_of(image[mask]), rel=1e-12)
    matrix, right = system.assemble(weights)
    assert np.abs(matrix.toarray() - matrix.toarray().T).max() == 0
    for _ in range(3):
        depth = generator.normal(size=int(mask.sum()))
        form = float(depth @ (matrix @ depth) - 2 * depth @ right)
        assert energy_of(depth) - energy_of(0 * depth) == pytest.approx(form, rel=1e-9)


def test_multigrid_solves_what_sparse_elimination_solves() -> None:
    """Conjugate gradients under multigrid agree with SciPy's direct solver, in few steps, over links of all sizes."""
    from scipy.sparse import coo_array, eye_array
    from scipy.sparse.linalg import spsolve

    generator, side = np.random.default_rng(5), 40
    number = np.arange(side * side).reshape(side, side)
    first = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    second = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    strength = 10.0 ** generator.uniform(-4, 0, first.size)
    count = side * side
    links = coo_array((strength, (first, second)), (count, count)).tocsr()
    links = links + links.T
    matrix = (coo_array((links.sum(axis=1), (range(count), range(count)))) - links + 1e-3 * eye_array(count)).tocsr()
    right = generator.normal(size=count)
    rows, cols = np.divmod(np.arange(count), side)
    found, steps = solve(matrix, right, np.zeros(count), Multigrid(matrix, rows, cols), (1e-9, 200))
    exact = spsolve(matrix.tocsc(), right)
    assert np.abs(found - exact).max() < 1e-6 * np.abs(exact).max()
    assert steps < 100


@pytest.mark.parametrize("integrate", [integrate_bilateral, integrate_smooth])
def test_specks_beside_an_object_leave_its_depth(integrate: Callable[..., Floats]) -> None:
    """Thousands of unlinked specks, as of a noisy ground, lie around the object's depth and change nothing."""
    generator, side, radius = np.random.default_rng(0), 128, 40
    v, u = (np.mgrid[:side, :side] - 63.5) / radius
    height = np.sqrt(np.maximum(1 - u**2 - v**2, 0))
    inside = u**2 + v**2 < 0.9
    random = np.array([0, 0, 1]) + generator.normal(0, 0.3, (side, side, 3))
    normals = np.where(inside[..., None], np.stack([u, -v, height], axis=-1), random)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    alone = integrate(normals, inside)
    assert np.std((alone + radius * height)[inside]) < 0.1
    mask = inside | ((u**2 + v**2 > 1) & (generator.random(inside.shape) < 0.25))
    depth = integrate(normals, mask)
    assert np.std((depth - alone)[inside]) < 0.1
    assert np.abs(depth[mask]).max() < radius


def test_lights_are_named_or_given() -> None:
    """Names and vectors become unit vectors; anything else is said in one line."""
    found = parse_lights("front 0,3,4")
    assert np.allclose(found, np.array([[0, 0, 1.0], [0, 0.6, 0.8]]))
    for text in ("behind", "1,2", "0,0,0", "1,nan,2", "0,0,-1 1,0,-0.2"):
        with pytest.raises(ValueError, match="expected"):
            parse_lights(text)


def test_lights_of_one_plane_are_refused() -> None:
    """Without a third dimension there are no normals to find."""
    images, mask = np.ones((5, 4, 4, 1)), np.ones((4, 4), np.bool_)
    for fit in (fit_lambertian, fit_robust):
        with pytest.raises(ValueError, match="not in one plane"):
            fit(images, SIX[:5], mask)
    with pytest.raises(ValueError, match="holds pixels"):
        fit_robust(np.ones((6, 4, 4, 1)), SIX, ~mask)
    with pytest.raises(ValueError, match="holds pixels"):
        integrate_bilateral(np.ones((4, 4, 3)), ~mask)
