"""Rendered random shapes against two independent references: Mitsuba's whole chain, and a float64 BRDF in NumPy.

Mitsuba has its own camera, intersections, interpolated normals, materials per mesh, shadow rays and Stokes frames; each
pixel is evaluated once, so there is no sampling noise.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from test_optics import reference as reference  # the fixture
from test_optics import stacked
from tolerances import MITSUBA, assert_within
from torch import Tensor

from polsep.physics.fresnel import ETA
from polsep.physics.optics import normalize
from polsep.render.materials import Materials, random_materials
from polsep.render.shapes import FINE, Mesh, ellipsoid, random_mesh
from polsep.render.sphere_tracing import GBuffer, PinholeCamera, PointLight, shade

pytest.importorskip("embreex")

from polsep.render.raycast import MeshScene, build_gbuffer, find_hits, is_lit, render_scene

VARIANT = "scalar_spectral_polarized"
SIZE = (36, 48)
#: Lobes of one scene by two renderers, relative to the lobe's peak.
LOBES = 1e-4
#: Share of an object's pixels whose shadow the two may see differently: rays start above triangles here, on them there.
SHADOWS = 0.02
Array = NDArray[np.float64]


def random_setting(seed: int) -> tuple[Mesh, PinholeCamera, PointLight]:
    """A random shape or, of every third seed, an ellipsoid; camera all around it, light on the camera's side."""
    generator = torch.Generator().manual_seed(seed)
    flat = [np.zeros((FINE, FINE))]
    mesh = random_mesh(generator) if seed % 3 else ellipsoid(np.array([1.0, 0.7, 1.3]), flat)
    size = float(np.ptp(mesh.vertices, axis=0).max())
    draw = torch.randn(2, 3, generator=generator) * torch.tensor([1.0, 0.6, 1.0])
    eye = normalize(draw[0].view(3, 1, 1)).flatten()
    side = normalize((eye + 0.6 * draw[1]).view(3, 1, 1)).flatten()
    reach, angle = (torch.rand(2, generator=generator) * torch.tensor([2.0, math.pi])).tolist()
    camera = PinholeCamera(tuple((2.4 * size * eye).tolist()), (0.1, -0.1, 0.0), 24.0)
    return mesh, camera, PointLight(tuple(((0.9 + reach) * size * side).tolist()), 5 * size**2, angle)


# ------------------------------------------------------------------------------------------------------------- Mitsuba


@pytest.fixture(scope="module")
def mi() -> Any:
    """Mitsuba in its scalar variant."""
    module = pytest.importorskip("mitsuba")
    module.set_variant(VARIANT)
    return module


def slot_shape(mi: Any, model: tuple[Mesh, Materials], slot: int) -> Any:
    """The triangles of one slot as a Mitsuba mesh with a polarized plastic of its own; the red of the albedo."""
    mesh, materials = model
    faces = mesh.faces[mesh.slots == slot]
    used, renumbered = np.unique(faces, return_inverse=True)
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(
        {
            "type": "pplastic",
            "distribution": "ggx",
            "alpha": float(materials.roughness[slot]) ** 2,
            "int_ior": ETA,
            "ext_ior": 1.0,
            "diffuse_reflectance": {"type": "uniform", "value": float(materials.albedo[slot, 0])},
            "specular_reflectance": {"type": "uniform", "value": float(materials.specular[slot])},
        }
    )
    shape = mi.Mesh(f"slot{slot}", len(used), len(faces), properties, has_vertex_normals=True)
    steps = ({"vertex_positions": mesh.vertices[used], "faces": renumbered}, {"vertex_normals": mesh.normals[used]})
    for arrays in steps:  # normals last: new positions make Mitsuba compute its own
        parameters = mi.traverse(shape)
        for name, values in arrays.items():
            flat = values.ravel().astype(np.uint32 if name == "faces" else np.float32)
            parameters[name] = type(parameters[name])(flat)
        parameters.update()
    return shape


def across(mi: Any, forward: Any) -> Any:
    """The x axis of a beam's frame whose up is world +y."""
    x = np.cross([0.0, 1.0, 0.0], np.array(forward))
    return mi.Vector3f(*(x / np.linalg.norm(x)))


def mitsuba_scene(mi: Any, model: tuple[Mesh, Materials], camera: PinholeCamera) -> Any:
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # it warns of triangles at poles, whose normals it is then given
    shapes = {f"slot{k}": slot_shape(mi, model, k) for k in range(model[0].slot_count)}
    film = {"type": "hdrfilm", "height": SIZE[0], "width": SIZE[1], "rfilter": {"type": "box"}}
    pose = mi.ScalarTransform4f().look_at(camera.position, camera.target, [0, 1, 0])
    lens = {"type": "perspective", "fov_axis": "y", "fov": camera.fov_deg, "near_clip": 1e-3, "far_clip": 1e6}
    scene = mi.load_dict({"type": "scene", "camera": {**lens, "to_world": pose, "film": film}, **shapes})
    mi.set_log_level(level)
    return scene


def mitsuba_pixel(mi: Any, scene: Any, light: PointLight, place: tuple[float, float]) -> Array | None:
    """Diffuse and specular Stokes vectors ``[2, 3]`` at a place of the film in [0, 1]^2; None where nothing is hit."""
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(*place), mi.Point2f(0.5, 0.5))
    hit = scene.ray_intersect(ray)
    if not hit.is_valid():
        return None
    found, target = np.zeros((2, 3)), mi.Point3f(*light.position)
    if scene.ray_test(hit.spawn_ray_to(target)):
        return found
    hit.wavelengths = [500.0] * 4
    way = np.array(target - hit.p, dtype=np.float64)
    to_light, to_camera = mi.Vector3f(*(way / np.linalg.norm(way))), -ray.d
    local = hit.to_local(to_light)
    angle = 2 * light.polarizer
    incident = np.array([1.0, math.cos(angle), math.sin(angle), 0.0]) * light.intensity / (way @ way)
    basis = mi.mueller.stokes_basis
    for lobe, flag in enumerate((mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection)):
        context = mi.BSDFContext()
        context.type_mask = int(flag)
        matrix = hit.to_world_mueller(hit.bsdf().eval(context, hit, local), -local, hit.wi)
        turned = mi.mueller.rotate_mueller_basis(
            matrix,
            -to_light,
            basis(-to_light),
            across(mi, -to_light),
            to_camera,
            basis(to_camera),
            across(mi, to_camera),
        )
        found[lobe] = (np.array(turned, dtype=np.float64)[..., 0] @ incident)[:3]
    return found


@pytest.mark.parametrize("seed", range(6))
def test_rendered_shapes_agree_with_mitsuba(mi: Any, seed: int) -> None:
    """D and S, each s0, s1, s2, equal Mitsuba's in every pixel that both see lit or both see dark.

    Left out are only the pixels, `SHADOWS` of the object's at most, that one renderer sees in a shadow and the other
    does not: at terminators flat triangles shade themselves in Mitsuba, at shadow edges rays start elsewhere.
    """
    mesh, camera, light = random_setting(seed)
    materials = random_materials(mesh.slot_count, torch.Generator().manual_seed(seed))
    materials = Materials(materials.albedo, materials.roughness, materials.specular)
    scene = mitsuba_scene(mi, (mesh, materials), camera)
    expected, hit = np.zeros((2, 3, *SIZE)), np.zeros(SIZE, dtype=bool)
    for row in range(SIZE[0]):
        for col in range(SIZE[1]):
            pixel = mitsuba_pixel(mi, scene, light, ((col + 0.5) / SIZE[1], (row + 0.5) / SIZE[0]))
            if pixel is not None:
                expected[:, :, row, col], hit[row, col] = pixel, True
    rendered = render_scene((MeshScene(mesh), materials), camera, light, SIZE)
    found = [stacked(lobe)[:, 0].double().numpy() for lobe in (rendered.diffuse, rendered.specular)]
    lit = expected[0, 0] > 0
    same = lit == (found[0][0] > 0)
    assert int((lit & same).sum()) > 100
    assert int((~same).sum()) <= SHADOWS * int(hit.sum())
    for lobe, exact in zip(found, expected, strict=True):
        assert float((np.abs(lobe - exact) * same).max()) < LOBES * float(exact[0].max())


# ----------------------------------------------------------------------------------------------------- NumPy reference


def reference_lobes(reference: Any, buffer: GBuffer, camera: PinholeCamera, light: PointLight) -> Tensor:
    """Both lobes ``[2, 3, 3, M]`` by the reference, for a G-buffer, as if nothing cast shadows."""
    position, normal, albedo, roughness, strength = (
        x[..., 0].T.double().numpy()
        for x in (buffer.position, buffer.normal, buffer.albedo, buffer.roughness, buffer.specular)
    )
    to_camera, way = np.array(camera.position) - position, np.array(light.position) - position
    directions = (reference.nrm(x) for x in (normal, to_camera, way))
    up, nu = np.array([0.0, 1.0, 0.0]), np.full(len(way), light.polarizer)
    irradiance = light.intensity / (way**2).sum(-1)
    lobes = reference.shade(*directions, up, up, nu, albedo, strength, roughness**2, E=irradiance)
    return torch.stack([torch.from_numpy(lobe).permute(1, 2, 0).expand(3, 3, -1) for lobe in lobes])


@pytest.mark.parametrize("seed", range(12))
def test_rendered_shapes_agree_with_the_reference(reference: Any, seed: int) -> None:
    """D and S, each s0, s1, s2 in three colours, to 1e-5 of the lobe's peak, with textures, in every pixel."""
    mesh, camera, light = random_setting(seed)
    materials = random_materials(mesh.slot_count, torch.Generator().manual_seed(seed))
    scene = MeshScene(mesh)
    rows, cols = torch.meshgrid(*(torch.arange(n) + 0.5 for n in SIZE), indexing="ij")
    hits = find_hits(scene, camera, (rows.flatten(), cols.flatten()), SIZE)
    buffer, lit = build_gbuffer(hits, materials), is_lit(scene, hits, light)
    assert int(lit.sum()) > 100
    expected = reference_lobes(reference, buffer, camera, light) * lit[0, :, 0]
    for stokes, exact in zip(shade(buffer, camera, light, lit), expected, strict=True):
        assert_within(stacked(stokes)[..., 0] / exact[0].max(), exact / exact[0].max(), MITSUBA)
