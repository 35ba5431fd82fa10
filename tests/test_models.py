"""Objects from meshes: smooth but for creases, whatever the winding, and with the normals of the stretched surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

pytest.importorskip("embreex")
pytest.importorskip("skimage")

from polsep.render.materials import USUAL_SIZE
from polsep.render.models import creased, random_model
from polsep.render.shapes import Floats, Mesh


def mesh_of(solid: trimesh.Trimesh) -> Mesh:
    vertices, faces = np.array(solid.vertices, np.float64), np.array(solid.faces, np.int64)
    return Mesh(vertices, np.zeros_like(vertices), np.zeros((len(vertices), 2)), faces, np.zeros(len(faces), np.int64))


def flat_normals(mesh: Mesh) -> Floats:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    normals: Floats = np.cross(b - a, c - a)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_round_things_are_smooth_and_edges_sharp() -> None:
    """A sphere has the normals of a sphere; a box those of its faces; a drum both, with a crease at its rim."""
    sphere = creased(mesh_of(trimesh.creation.icosphere(4)))
    assert float((sphere.vertices * sphere.normals).sum(axis=1).min()) > 0.9999
    box = creased(mesh_of(trimesh.creation.box((1, 2, 3))))
    np.testing.assert_allclose(box.normals[box.faces], flat_normals(box)[:, None].repeat(3, axis=1), atol=1e-12)
    drum = creased(mesh_of(trimesh.creation.cylinder(1, 2, sections=64)))
    around = np.abs(drum.normals[:, 2]) < 0.5
    radial = drum.vertices[around, :2] / np.linalg.norm(drum.vertices[around, :2], axis=1, keepdims=True)
    # Triangles on both sides of an edge have other areas: half a section is 2.8 degrees.
    assert float((radial * drum.normals[around, :2]).sum(axis=1).min()) > np.cos(np.radians(2.9))
    np.testing.assert_allclose(np.abs(drum.normals[~around, 2]), 1, atol=1e-12)


def test_the_winding_does_not_matter() -> None:
    """Triangles wound the other way have the same normals, with the other sign; those without area are left out."""
    mesh = mesh_of(trimesh.creation.icosphere(2))
    other = np.arange(len(mesh.faces)) % 3 == 0
    faces = np.where(other[:, None], mesh.faces[:, ::-1], mesh.faces)
    first, second = creased(mesh), creased(replace(mesh, faces=faces))
    a, b = first.normals[first.faces], second.normals[second.faces]
    np.testing.assert_allclose(a, np.where(other[:, None, None], -b[:, ::-1], b), atol=1e-12)
    lines = np.concatenate([mesh.faces, mesh.faces[:5, [0, 1, 1]]])
    longer = creased(replace(mesh, faces=lines, slots=np.zeros(len(lines), np.int64)))
    np.testing.assert_array_equal(longer.normals, first.normals)


def test_a_stretched_box_has_the_normals_of_its_faces() -> None:
    """So have all stretched and tilted objects; they are centred, of the usual size, and the same for the same seed."""
    meshes = [creased(mesh_of(trimesh.creation.box((1, 2, 3)))), creased(mesh_of(trimesh.creation.icosphere(3)))]
    found = [random_model(meshes, torch.Generator().manual_seed(seed)) for seed in range(8)]
    assert {len(mesh.faces) for mesh in found} == {len(mesh.faces) for mesh in meshes}
    for seed, mesh in enumerate(found):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        np.testing.assert_allclose(low + high, 0, atol=1e-9)
        assert float((high - low).max()) == pytest.approx(USUAL_SIZE)
        cosine = (mesh.normals[mesh.faces] * flat_normals(mesh)[:, None]).sum(axis=-1)
        assert float(cosine.min()) > (1 - 1e-9 if len(mesh.faces) == 12 else 0.99)
        again = random_model(meshes, torch.Generator().manual_seed(seed))
        np.testing.assert_array_equal(mesh.vertices, again.vertices)
    assert len({mesh.slot_count for mesh in found}) > 1
