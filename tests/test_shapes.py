"""Random meshes: closed solids of the right volume, whose normals point outward, the same on every machine."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
import torch

from polsep.render.shapes import (
    COUNT_WEIGHTS,
    FINE,
    LARGEST_AXIS,
    SMALLEST_AXIS,
    Floats,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    join,
    look_up,
    random_axes,
    random_heights,
    random_mesh,
)

AXES = np.array([1.0, 0.5, 1.5])
FLAT = [np.zeros((FINE, FINE))] * 6
PRIMITIVES = [(ellipsoid, 4 / 3 * math.pi, 1), (box, 8.0, 6), (cylinder, 2 * math.pi, 3)]
#: What tessellation leaves of volumes, relative, and of normals [rad].
TESSELLATION, NORMAL = 2e-3, 0.03

Build = Callable[[Floats, list[Floats]], Mesh]


def volume(mesh: Mesh) -> float:
    """By the divergence theorem; negative if triangles wind the other way."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def is_closed(mesh: Mesh) -> bool:
    """Every edge is shared by two triangles that run along it in opposite directions."""
    _, same = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    corners = same.reshape(-1)[mesh.faces]
    edges = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    count = Counter(map(tuple, edges.tolist()))
    return all(number == 1 and count[b, a] == 1 for (a, b), number in count.items())


def bumps(seed: int, largest: float = 0.15) -> list[Floats]:
    """Six height fields of which none is flat."""
    generator, found = torch.Generator().manual_seed(seed), []
    while len(found) < 6:
        heights = random_heights(largest, generator)
        if heights.any():
            found.append(heights)
    return found


@pytest.mark.parametrize(("build", "unit_volume", "slots"), PRIMITIVES)
def test_flat_primitives_are_the_solids(build: Build, unit_volume: float, slots: int) -> None:
    """Volume, slots and closed surfaces without height fields."""
    mesh = build(AXES, FLAT)
    assert volume(mesh) == pytest.approx(unit_volume * AXES.prod(), rel=TESSELLATION)
    assert mesh.slot_count == slots
    assert is_closed(mesh)


@pytest.mark.parametrize(("build", "unit_volume", "slots"), PRIMITIVES)
def test_height_fields_keep_primitives_closed(build: Build, unit_volume: float, slots: int) -> None:
    """Heights vanish at the borders of faces, over seams, poles and rims too."""
    mesh = build(AXES, bumps(1))
    assert is_closed(mesh)
    assert volume(mesh) == pytest.approx(unit_volume * AXES.prod(), rel=0.2)
    assert np.abs(mesh.vertices - build(AXES, FLAT).vertices).max() > 0.05
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-9)


def test_normals_of_an_ellipsoid_are_its_gradient() -> None:
    """Smooth normals agree with the analytic ones, at the seam and the poles too."""
    mesh = ellipsoid(AXES, FLAT)
    gradient = mesh.vertices / AXES**2
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    angles = np.arccos(np.clip((mesh.normals * gradient).sum(axis=1), -1, 1))
    assert angles.max() < NORMAL


def test_normals_of_a_box_are_sharp() -> None:
    """Every face has its own normal up to its edges."""
    mesh = box(AXES, FLAT)
    assert {tuple(normal) for normal in np.round(mesh.normals + 0.0, 6).tolist()} == {
        tuple(sign * row) for row in np.eye(3) for sign in (1.0, -1.0)
    }


def test_heights_are_bounded_and_end_at_the_border(generator: torch.Generator) -> None:
    """Zero at the border, about one in ten flat; bicubic interpolation overshoots a little."""
    fields = [random_heights(0.5, generator) for _ in range(400)]
    for heights in fields:
        edge = np.concatenate([heights[0], heights[-1], heights[:, 0], heights[:, -1]])
        assert not edge.any()
        assert np.abs(heights).max() < 0.75
    flat = sum(not heights.any() for heights in fields)
    assert abs(flat - 40) < 5 * math.sqrt(400 * 0.1 * 0.9)


def test_look_up_is_bilinear() -> None:
    """Grid points give their own heights, and u runs along rows."""
    heights = np.arange(FINE)[:, None] * 1.0 + 100 * np.arange(FINE)
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.25]])
    np.testing.assert_allclose(look_up(heights, uv), (FINE - 1) * (uv @ np.array([1.0, 100.0])), atol=1e-9)


def test_shapes_repeat_and_differ() -> None:
    """One seed is one shape; another seed is another one; all are centred and outward."""
    first, again, other = (random_mesh(torch.Generator().manual_seed(seed)) for seed in (5, 5, 6))
    for name in ("vertices", "normals", "uv", "faces", "slots"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)
    for mesh in (first, other):
        np.testing.assert_allclose(mesh.vertices.max(axis=0), -mesh.vertices.min(axis=0), atol=1e-9)
        assert volume(mesh) > 0


def test_parameters_cover_their_ranges(generator: torch.Generator) -> None:
    """Semi-axes fill their interval; the mean number of primitives is 5."""
    axes = np.stack([random_axes(generator) for _ in range(300)])
    assert SMALLEST_AXIS <= axes.min() < SMALLEST_AXIS + 0.05
    assert LARGEST_AXIS - 0.05 < axes.max() <= LARGEST_AXIS
    mean = sum(k * weight for k, weight in enumerate(COUNT_WEIGHTS, 1)) / sum(COUNT_WEIGHTS)
    assert mean == pytest.approx(5)


def test_joined_meshes_number_their_slots_on() -> None:
    """Faces keep their vertices, slots of the second mesh follow those of the first."""
    both = join(box(AXES, FLAT), cylinder(AXES, FLAT))
    assert both.slot_count == 9
    np.testing.assert_array_equal(np.unique(both.slots), np.arange(9))
    assert volume(both) == pytest.approx((8 + 2 * math.pi) * AXES.prod(), rel=TESSELLATION)
