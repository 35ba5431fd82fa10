"""The direction toward the lamp of one frame: by the shading of a surface, and among many by which explains most.

A surface says which lamp would shade it so (`lamp_by_shading`), but a network that is not given the lamp draws surfaces
for the lamp it guesses. So it runs once more for each of `LAMPS` (`search_lamp`). Under the true one it is surest,
its surface shows the picture that was seen, and its highlights are where they were seen (`misfit`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from polsep.geometry.shape_maps import FLOOR, Seen, Surface, object_level, relight

Floats = NDArray[np.float32]
Vector = tuple[float, float, float]

#: Rings of directions around the camera's: angle from it [degrees], and their number. A picture and its mirror image
#: have the same ones.
RINGS = ((25.0, 6), (50.0, 12))
#: Deviation of the lamp found by shading [degrees], and how many of them away others are tried.
SHADING_DEG, REACH = 30.0, 2.0
#: Factor on every term of `misfit`: what it differs by, in units of the logarithm of a probability.
TRUST = 4.0
#: Mean difference of logarithms below which pictures count as equal.
LEAST_GAP = 0.01


def ring_directions() -> Floats:
    """Unit vectors ``[N, 3]`` of the camera's direction and of `RINGS` around it, every second one half a step on."""
    found = [(0.0, 0.0, 1.0)]
    for number, (zenith, count) in enumerate(RINGS):
        sine, cosine = np.sin(np.radians(zenith)), np.cos(np.radians(zenith))
        turns = 2 * np.pi * (np.arange(count) + 0.5 * (number % 2)) / count
        found += [(sine * np.sin(turn), sine * np.cos(turn), cosine) for turn in turns]
    return np.array(found, np.float32)


#: Directions that are tried.
LAMPS = ring_directions()


def lamp_by_shading(surface: Surface, seen: Seen) -> Vector:
    """The direction toward a far lamp that explains the shading: diffuse light over albedo is its product with normals.

    Least squares over places that it reaches, the surer ones first; zeros where that points away from the camera.
    """
    shading = (seen.image.mean(axis=0) / np.maximum(surface.albedo.mean(axis=0), 1e-6)) * (seen.mask[0] > 0)
    lit = shading > 0.2 * np.percentile(shading, 99)
    weight = 1 / surface.normal_error[0][lit]
    vector, *_ = np.linalg.lstsq((surface.normal[:, lit] * weight).T, shading[lit] * weight, rcond=None)
    return _unit(vector) if vector[2] > 0 else (0.0, 0.0, 0.0)


def search_lamp(predict: Callable[[Seen], Surface], seen: Seen) -> Vector:
    """The mean of `LAMPS` by how well the surface that ``predict`` finds under each explains what is seen.

    They count less the farther they are from the lamp that shades the surface found without a lamp.
    """
    shading = np.array(lamp_by_shading(predict(seen), seen), np.float32)
    away = np.degrees(np.arccos(np.clip(LAMPS @ shading, -1, 1))) / SHADING_DEG if shading.any() else 0 * LAMPS[:, 0]
    tried = away < REACH
    cost = TRUST * np.array([misfit(predict(seen_under(seen, lamp)), seen, lamp) for lamp in LAMPS[tried]])
    cost += away[tried] ** 2 / 2
    return _unit(np.exp(cost.min() - cost) @ LAMPS[tried])


def seen_under(seen: Seen, lamp: Vector | Floats) -> Seen:
    """The same images, with the direction toward the lamp given."""
    return seen._replace(light=np.array(lamp, np.float32)[:, None, None] + 0 * seen.light)


def misfit(surface: Surface, seen: Seen, lamp: Floats) -> float:
    """Measure how badly a surface under a lamp explains what is seen: the sum of three terms, less is better.

    The mean logarithm of the expected errors of its normals; the logarithm of the mean difference of its picture from
    that seen, both logarithms, at the best exposure; less the correlation of its highlights with those seen, for inputs
    that see them apart.
    """
    inside = seen.mask[0] > 0
    drawn = relight(surface if seen.specular is None else surface._replace(specular=0 * surface.specular), lamp)
    gap = _logarithm(seen.image, seen)[inside] - np.log(drawn.mean(axis=0)[inside] + FLOOR)
    terms = [np.log(surface.normal_error[0][inside]).mean(), np.log(np.abs(gap - np.median(gap)).mean() + LEAST_GAP)]
    if seen.specular is not None:
        mirrored = relight(surface._replace(albedo=0 * surface.albedo), lamp).mean(axis=0)
        terms.append(-_correlation(_logarithm(seen.specular, seen)[inside], np.log(mirrored[inside] + FLOOR)))
    return float(sum(terms))


def _logarithm(image: Floats, seen: Seen) -> Floats:
    """The logarithm of an image's mean over colours, relative to the object's level."""
    level = object_level(seen.image, seen.mask)[0]
    found: Floats = np.log(image.mean(axis=0).clip(0, None) / level + FLOOR)
    return found


def _correlation(first: Floats, second: Floats) -> float:
    first, second = first - first.mean(), second - second.mean()
    return float((first * second).sum() / max(np.sqrt((first**2).sum() * (second**2).sum()), 1e-9))


def _unit(vector: NDArray[np.floating]) -> Vector:
    x, y, z = (float(part) for part in vector / np.linalg.norm(vector))
    return (x, y, z)
