"""Meshes with materials in Mitsuba: what a ray met, and how its polarized plastic reflects there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from polsep.physics.fresnel import ETA
from polsep.render.materials import Materials, look_up
from polsep.render.pathtrace.mueller import Matrix, turn_frames, turn_to_up
from polsep.render.pathtrace.variants import in_variant, is_fast, only_errors
from polsep.render.raycast import SHADOW_OFFSET, Model
from polsep.render.rays_kernel import MIN_COSINE
from polsep.render.shapes import Mesh

#: Roughness that surfaces after the first one have at least. No path finds the small lights that glossy ones throw on
#: others but by chance, and then it is a spark in the image: Kaplanyan and Dachsbacher 2013, Path space regularization.
LATER_ROUGHNESS = 0.5


@dataclass(frozen=True)
class PathModel:
    """A mesh with materials as Mitsuba's ``scene`` of one variant; ``lift`` is in scene units."""

    variant: str
    mesh: Mesh
    materials: Materials
    scene: Any
    shape: Any
    plastic: Any
    lift: float


@dataclass(frozen=True)
class Finish:
    """Materials of points: three colours of albedo, roughness and specular strength."""

    albedo: Any
    roughness: Any
    strength: Any


@dataclass(frozen=True)
class Vertex:
    """A point of a path: Mitsuba's interaction, a point just above it where rays start, its material."""

    interaction: Any
    above: Any
    finish: Finish


def build_path_model(model: Model, variant: str) -> PathModel:
    """A model for `trace_paths`, many times: cameras and lights are no part of it."""
    scene, materials = model
    mesh = scene.mesh
    with in_variant(variant), only_errors():
        shape = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces), has_vertex_normals=True)
        # Normals come last, since with new positions Mitsuba computes its own, and warns where it cannot.
        for arrays in ({"vertex_positions": mesh.vertices, "faces": mesh.faces}, {"vertex_normals": mesh.normals}):
            parameters = mi.traverse(shape)
            for name, values in arrays.items():
                kind = np.uint32 if name == "faces" else np.float32
                parameters[name] = type(parameters[name])(values.ravel().astype(kind))
            parameters.update()
        _bake(shape, mesh, materials)
        # Linear from 0 to 1 between the centres of two pixels: `finish_vertex` writes alpha as the place.
        ramp = mi.TensorXf(np.array([0, 1], np.float32).reshape(1, 2, 1))
        white = {"type": "uniform", "value": 1.0}
        plastic = mi.load_dict(
            {
                "type": "pplastic",
                "distribution": "ggx",
                "alpha": {"type": "bitmap", "data": ramp, "raw": True, "wrap_mode": "clamp"},
                "int_ior": ETA,
                "ext_ior": 1.0,
                "diffuse_reflectance": white,
                "specular_reflectance": white,
            }
        )
        world = mi.load_dict({"type": "scene", "mesh": shape})
        return PathModel(variant, mesh, materials, world, shape, plastic, SHADOW_OFFSET * scene.size)


def _bake(shape: Any, mesh: Mesh, materials: Materials) -> None:
    """Materials as attributes of the vertices, which are interpolated: exact without textures."""
    slots = np.zeros(len(mesh.vertices), np.int64)
    slots[mesh.faces] = mesh.slots[:, None]
    points = torch.from_numpy(mesh.vertices.astype(np.float32)).T[..., None]
    finish = look_up(materials, torch.from_numpy(slots), points)
    for name, values in zip(("albedo", "roughness", "strength"), finish, strict=True):
        shape.add_attribute(f"vertex_{name}", len(values), values[..., 0].T.contiguous().numpy().ravel())


def look_up_finish(model: PathModel, ray: Any) -> Finish:
    """Exact materials, textures too, of what rays meet first: `materials.look_up`, which Mitsuba cannot compile."""
    found = model.scene.ray_intersect_preliminary(ray, True)
    hit = found.is_valid()
    here = np.flatnonzero(np.atleast_1d(np.array(hit)))
    values = np.zeros((5, np.array(hit).size), np.float32)
    if here.size:
        position = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, hit).p
        points = torch.from_numpy(np.array(position, np.float32).reshape(3, -1)[:, here, None])
        slot = torch.from_numpy(model.mesh.slots[np.atleast_1d(np.array(found.prim_index))[here]])
        values[:, here] = torch.cat(look_up(model.materials, slot, points))[..., 0].numpy()
    red, green, blue, roughness, strength = (mi.Float(x) if is_fast() else float(x[0]) for x in values)
    return Finish(mi.Color3f(red, green, blue), roughness, strength)


def read_finish(model: PathModel, vertex: Vertex, hit: Any) -> Finish:
    """Materials as the mesh's vertices have them: exact without textures."""
    point = vertex.interaction
    return Finish(
        mi.Color3f(model.shape.eval_attribute_3("vertex_albedo", point, hit)),
        model.shape.eval_attribute_1("vertex_roughness", point, hit),
        model.shape.eval_attribute_1("vertex_strength", point, hit),
    )


def smoothed(finish: Finish) -> Finish:
    """For surfaces after the first one: see `LATER_ROUGHNESS`."""
    return Finish(finish.albedo, dr.maximum(finish.roughness, LATER_ROUGHNESS), finish.strength)


def finish_vertex(vertex: Vertex, finish: Finish) -> Vertex:
    """The vertex with its material."""
    vertex.interaction.uv = mi.Point2f(0.25 + 0.5 * finish.roughness * finish.roughness, 0.5)
    return Vertex(vertex.interaction, vertex.above, finish)


def find_vertex(model: PathModel, ray: Any, found: Any, hit: Any) -> Vertex:
    """The surface that a ray met, with its normal turned to the viewer as in `raycast`, still without materials."""
    shape, viewer = model.shape, -ray.d
    point = found.compute_surface_interaction(ray, mi.RayFlags.All, hit)
    normal = point.sh_frame.n
    normal = dr.normalize(normal + dr.maximum(MIN_COSINE - dr.dot(normal, viewer), 0) * viewer)
    point.sh_frame = mi.Frame3f(normal)
    point.wi = point.to_local(viewer)
    # Out onto the smooth surface: Hanika 2021, Hacking the shadow terminator (Ray Tracing Gems II, chapter 4).
    corners, (u, v) = shape.face_indices(found.prim_index, hit), found.prim_uv
    above = point.p + model.lift * dr.select(dr.dot(point.n, viewer) < 0, -1.0, 1.0) * mi.Vector3f(point.n)
    for corner, weight in zip(corners, (1 - u - v, u, v), strict=True):
        outward = mi.Vector3f(shape.vertex_normal(corner, hit))
        below = dr.minimum(dr.dot(point.p - shape.vertex_position(corner, hit), outward), 0)
        above -= weight * below * outward
    return Vertex(point, above, Finish(mi.Color3f(0.0), mi.Float(1.0), mi.Float(0.0)))


def build_ray(origin: Any, direction: Any) -> Any:
    """A ray of the current variant."""
    ray = mi.Ray3f(origin, direction)
    if mi.is_spectral:
        ray.wavelengths = type(ray.wavelengths)(500.0)  # any, as every spectrum is constant
    return ray


def white_lobes(model: PathModel, vertex: Vertex, direction: Any) -> tuple[Matrix, Matrix]:
    """Mueller matrices of the diffuse and specular lobes of reflectance 1 for light from a direction, with its cosine.

    From and to the frames of beams that this project uses.
    """
    point = vertex.interaction
    local = point.to_local(direction)
    turns = [
        turn_to_up(point.to_world(forward), point.to_world(mi.mueller.stokes_basis(forward)))
        for forward in (-local, point.wi)
    ]
    flags = (mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection)
    matrices = (model.plastic.eval(_context(flag), point, local) for flag in flags)
    diffuse, specular = (turn_frames(_linear_part(matrix), *turns) for matrix in matrices)
    return diffuse, specular


def _linear_part(matrix: Any) -> Matrix:
    """The part of Mitsuba's matrix on s0, s1 and s2, of its first wavelength."""
    a, b, c = ((matrix[k, 0][0], matrix[k, 1][0], matrix[k, 2][0]) for k in range(3))
    return a, b, c


def reflection(model: PathModel, vertex: Vertex, direction: Any) -> Matrix:
    """Mueller matrix of both lobes in three colours."""
    diffuse, specular = white_lobes(model, vertex, direction)
    finish = vertex.finish
    a, b, c = (
        (
            finish.albedo * first[0] + finish.strength * second[0],
            finish.albedo * first[1] + finish.strength * second[1],
            finish.albedo * first[2] + finish.strength * second[2],
        )
        for first, second in zip(diffuse, specular, strict=True)
    )
    return a, b, c


def scatter(vertex: Vertex, random: Any, share: float) -> tuple[Any, Any]:
    """A random direction, by the specular lobe with probability ``share``, else by the cosine; and its density.

    The specular lobe's microfacets are those that the viewer sees (Heitz 2018). Not by ``pplastic``, whose density of
    one lobe holds a part of the other (Mitsuba 3.9.1).
    """
    point, specular = vertex.interaction, random.next_float32() < share
    numbers = mi.Point2f(random.next_float32(), random.next_float32())
    mirrored = mi.reflect(point.wi, _microfacets(vertex).sample(point.wi, numbers)[0])
    local = dr.select(specular, mirrored, mi.warp.square_to_cosine_hemisphere(numbers))
    direction = point.to_world(local)
    return direction, scatter_density(vertex, direction, share)


def scatter_density(vertex: Vertex, direction: Any, share: float) -> Any:
    """Probability per solid angle that `scatter` draws a direction; 0 below the surface."""
    point = vertex.interaction
    local = point.to_local(direction)
    half = dr.normalize(point.wi + local)
    specular = _microfacets(vertex).pdf(point.wi, half) / (4 * dr.maximum(dr.dot(local, half), MIN_COSINE))
    return dr.select(local.z > 0, share * specular + (1 - share) * local.z / math.pi, 0.0)


def _microfacets(vertex: Vertex) -> Any:
    roughness = vertex.finish.roughness
    return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, roughness * roughness, True)


def _context(flag: Any) -> Any:
    context = mi.BSDFContext()
    context.type_mask = int(flag)
    return context
