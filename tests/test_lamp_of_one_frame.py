"""The lamp of one frame: found by shading, and by predictions under many lamps."""

from __future__ import annotations

import math

import numpy as np
import pytest
from test_geometry import cap

from polsep.geometry.lamp import LAMPS, lamp_by_shading, misfit, search_lamp, seen_under
from polsep.geometry.shape_maps import Seen, Surface, object_level, relight

SIDE = 64
LAMP = np.array([0.3, -0.2, 0.93], np.float32) / np.float32(math.sqrt(0.3**2 + 0.2**2 + 0.93**2))


def sphere(turned: np.ndarray | None = None) -> tuple[Surface, np.ndarray]:
    """A glossy sphere of two albedos, its normals ``turned`` by a rotation, and its mask."""
    normals, mask = cap(SIDE, 80)
    if turned is not None:
        normals = normals @ turned.T
    albedo = np.where(np.arange(SIDE) % 8 < 4, 1.9, 0.9).astype(np.float32)
    one = np.ones((1, SIDE, SIDE), np.float32)
    normal = np.moveaxis(normals, -1, 0).astype(np.float32)
    return Surface(normal, albedo * np.ones((3, SIDE, SIDE), np.float32), 0.3 * one, one, 0.1 * one, one, one), mask


def turn(degrees: float) -> np.ndarray:
    """The rotation about the vertical."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def picture(lamp: np.ndarray, apart: bool = True) -> Seen:
    """What is seen of the sphere under a lamp that is not given, at level 1; highlights ``apart`` or in it."""
    surface, mask = sphere()
    mirrored = relight(surface._replace(albedo=0 * surface.albedo), lamp)
    image = relight(surface, lamp) - mirrored * apart
    level = object_level(image, mask[None])
    specular = mirrored.mean(axis=0, keepdims=True) / level if apart else None
    light = np.zeros((3, SIDE, SIDE), np.float32)
    return Seen(image / level, specular, None, None, mask[None].astype(np.float32), light)


def relative(surface: Surface, lamp: np.ndarray, apart: bool = True) -> Surface:
    """The surface with its albedo relative to the level of that picture, as networks say it."""
    full = relight(surface._replace(specular=surface.specular * (not apart)), lamp)
    return surface._replace(albedo=surface.albedo / object_level(full, sphere()[1][None]))


def test_shading_finds_the_lamp() -> None:
    """Of a matte sphere with its true normals, whatever its albedo is."""
    surface, mask = sphere()
    image = surface.albedo * (surface.normal * LAMP[:, None, None]).sum(axis=0).clip(0, None)
    seen = Seen(image, None, None, None, mask[None], np.zeros((3, 1, 1)))
    np.testing.assert_allclose(lamp_by_shading(surface, seen), LAMP, atol=0.02)


def test_no_shading_finds_none() -> None:
    """In the dark the answer is zeros."""
    surface, mask = sphere()
    dark = Seen(0 * surface.albedo, None, None, None, mask[None], np.zeros((3, 1, 1)))
    assert not np.any(lamp_by_shading(surface, dark))


@pytest.mark.parametrize("apart", [True, False])
def test_the_true_lamp_and_surface_explain_most(apart: bool) -> None:
    """Other lamps, other surfaces and less sure ones explain less; the exposure does not matter."""
    seen, surface = picture(LAMP, apart), relative(sphere()[0], LAMP, apart)
    least = misfit(surface, seen, LAMP)
    others = [misfit(surface, seen, lamp) for lamp in LAMPS]
    others += [misfit(relative(sphere(turn(angle))[0], LAMP, apart), seen, LAMP) for angle in (-20, 20)]
    others.append(misfit(surface._replace(normal_error=2 * surface.normal_error), seen, LAMP))
    assert least < min(others) - 0.3
    brighter = seen._replace(image=3 * seen.image, specular=None if seen.specular is None else 3 * seen.specular)
    assert misfit(surface, brighter, LAMP) == pytest.approx(least, abs=0.3)


@pytest.mark.parametrize("lamp", [LAMPS[0], LAMPS[2], LAMPS[10], LAMP])
def test_predictions_under_many_lamps_find_it(lamp: np.ndarray) -> None:
    """Where the surface is drawn for the lamp that is given: turned with it, as a network that believes it would."""
    seen = picture(lamp)

    def predict(under: Seen) -> Surface:
        believed = under.light[:, 0, 0] if under.light.any() else LAMPS[0]
        about = math.degrees(math.atan2(believed[0], believed[2]) - math.atan2(lamp[0], lamp[2]))
        return relative(sphere(turn(about / 2))[0], lamp)

    assert math.degrees(math.acos(min(1, float(np.dot(search_lamp(predict, seen), lamp))))) < 8


def test_tried_lamps_are_mirror_images_of_each_other() -> None:
    """Unit vectors toward the front; mirrored across they are the same ones."""
    np.testing.assert_allclose(np.linalg.norm(LAMPS, axis=1), 1, atol=1e-6)
    assert (LAMPS[:, 2] > 0).all()
    mirrored = LAMPS * np.array([-1, 1, 1], np.float32)
    assert np.abs(LAMPS[:, None] - mirrored[None]).max(axis=-1).min(axis=0).max() < 1e-6


def test_a_lamp_is_given_everywhere() -> None:
    """The planes of the direction are filled with it."""
    seen = seen_under(picture(LAMP), LAMPS[3])
    np.testing.assert_array_equal(seen.light, np.broadcast_to(LAMPS[3][:, None, None], seen.light.shape))
