"""Random views of a shape: camera, light, exposure, and the frame itself.

All draws of a view come from one generator, seeded by `scene_seed` from the split of the data, the user's seed, and the
numbers of shape and view. So a view does not depend on what was rendered before it, or on which machine.

Conventions are those of `polsep.render.sphere_tracing`; shapes are centred on the origin. Source: Dave et al. 2022,
Sec. 4.4, which varies the light's "position and polarization angle for each data point" and leaves the rest open. Note:
materials are drawn per view, not per shape, because 20 times as many cost nothing.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
import torch

from polsep.render.materials import random_materials
from polsep.render.raycast import MeshScene, find_lit, find_view, render_scene
from polsep.render.shapes import Floats, random_mesh
from polsep.render.simulate import Capture, blur, capture, expose_to_clip, expose_to_level
from polsep.render.sphere_tracing import PinholeCamera, PointLight, Vector
from polsep.sensor.camera import IMX250, Layout

#: Splits of the data; the index is part of every seed.
SPLITS = ("train", "validation", "test")
#: Largest elevation of cameras, whose up vector is world +y.
LARGEST_ELEVATION = math.radians(75)
#: Vertical field of view [degrees], and the share of the frame that the object fills along its longer side.
FIELDS_OF_VIEW, FILLS = (15.0, 50.0), (0.6, 1.0)
#: Largest angle between light and camera at the object: beyond it most visible points are unlit.
LARGEST_PHASE = math.radians(60)
#: Range of the light's distance from the object's centre, and least distance of the camera, in radii of the object.
LIGHT_DISTANCES, MIN_DISTANCE = (2.0, 8.0), 1.5
#: Share of views without clipping, and the largest share of object samples that clip in the others.
UNCLIPPED_SHARE, LARGEST_CLIPPED = 1 / 3, 0.05
#: Least median of the lit samples, white = 1: exposed for a mirror-like highlight alone, a frame would be black. Where
#: it applies, more samples clip than drawn.
MIN_LEVEL = 0.02
#: Standard deviation of the lens's point spread in raw pixels: 0.42 wavelength x f-number (Zhang, Zerubia and
#: Olivo-Marin 2007, doi:10.1364/AO.46.001819) over pixels of 3.45 um is 0.3 at f/4.5 and 0.8 at f/12 for 550 nm.
BLURS = (0.3, 0.8)
#: Least share of the object's pixels that are lit in a small preview, else a view is drawn again; the preview's size;
#: most draws.
MIN_LIT, PREVIEW_SIZE, MAX_DRAWS = 0.4, (48, 48), 100


@dataclass(frozen=True)
class Shot:
    """Random properties of a view, besides its materials; ``clip``: share of object samples that clip."""

    camera: PinholeCamera
    light: PointLight
    clip: float
    blur: float


def scene_seed(split: str, seed: int, shape: int, view: int | None = None) -> int:
    """Return the seed of a view, or of the shape itself for None: a number below 2^32.

    The two highest bits are the split's, so no two splits share a seed; the others come from SHA-256 of the four
    values. Torch's CPU generator, a Mersenne twister, uses only 32 bits of a seed. Raises ValueError on a split not in
    `SPLITS`.
    """
    if split not in SPLITS:
        raise ValueError(f"expected a split of {', '.join(SPLITS)}, found {split!r}")
    label = f"{split}/{seed}/{shape}/{'shape' if view is None else view}"
    return SPLITS.index(split) << 30 | int.from_bytes(hashlib.sha256(label.encode()).digest()[:4]) >> 2


def seeded_shape(split: str, seed: int, shape: int) -> MeshScene:
    """Return random shape number ``shape`` of a split."""
    return MeshScene(random_mesh(torch.Generator().manual_seed(scene_seed(split, seed, shape))))


def random_camera(vertices: Floats, generator: torch.Generator) -> PinholeCamera:
    """Return a camera in a random direction, aimed at the middle of the projection of points ``[V, 3]``.

    At its distance the points, which surround the origin, fill a share in `FILLS` of a square frame.
    """
    azimuth = _uniform((0.0, 2 * math.pi), generator)
    limit = math.sin(LARGEST_ELEVATION)
    return random_camera_from(vertices, azimuth, _uniform((-limit, limit), generator), generator)


def random_camera_from(vertices: Floats, azimuth: float, sine: float, generator: torch.Generator) -> PinholeCamera:
    """Return `random_camera` of an azimuth [rad] and of the sine of an elevation below a right angle."""
    fov, fill = _uniform(FIELDS_OF_VIEW, generator), _uniform(FILLS, generator)
    cosine = math.sqrt(1 - sine**2)
    back = np.array([cosine * math.sin(azimuth), sine, cosine * math.cos(azimuth)])
    right = np.array([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    up = np.cross(back, right)
    x, y, nearness = (_along(vertices, axis) for axis in (right, up, back))
    middle = (x.min() + x.max()) / 2 * right + (y.min() + y.max()) / 2 * up
    reach = np.maximum(np.abs(x - _along(middle, right)), np.abs(y - _along(middle, up)))
    distance = float((reach / (fill * math.tan(math.radians(fov) / 2)) + nearness).max())
    distance = max(distance, MIN_DISTANCE * _radius(vertices))
    return PinholeCamera(_rounded(middle + distance * back), _rounded(middle), round(fov, 6))


def random_light(camera: PinholeCamera, radius: float, generator: torch.Generator) -> PointLight:
    """Return a light within `LARGEST_PHASE` of the camera, at a random distance and behind a random polarizer.

    Its irradiance at the origin is 1; `expose_to_clip` sets the exposure. ``radius``: of the object.
    """
    away = np.array(camera.position) - np.array(camera.target)
    away /= math.hypot(*away)
    cosine = _uniform((math.cos(LARGEST_PHASE), 1.0), generator)
    turn = _uniform((0.0, 2 * math.pi), generator)
    distance = radius * _uniform(LIGHT_DISTANCES, generator)
    side = np.cross([0.0, 1.0, 0.0], away)
    side /= math.hypot(*side)
    across = math.cos(turn) * side + math.sin(turn) * np.cross(away, side)
    position = distance * (cosine * away + math.sqrt(1 - cosine**2) * across)
    return PointLight(_rounded(position), round(distance**2, 6), round(_uniform((0.0, math.pi), generator), 6))


def random_clip(generator: torch.Generator) -> float:
    """Return a random share of object samples that clip: 0 for `UNCLIPPED_SHARE` of the draws."""
    some = _uniform((0.0, 1.0), generator) >= UNCLIPPED_SHARE
    share = _uniform((0.0, LARGEST_CLIPPED), generator)
    return round(share, 6) if some else 0.0


def random_shot(shape: MeshScene, generator: torch.Generator) -> Shot:
    """Return a view of a shape of which at least `MIN_LIT` is lit. Raises ValueError when none of `MAX_DRAWS` is."""
    for _ in range(MAX_DRAWS):
        camera = random_camera(shape.mesh.vertices, generator)
        light = random_light(camera, _radius(shape.mesh.vertices), generator)
        shot = Shot(camera, light, random_clip(generator), round(_uniform(BLURS, generator), 6))
        if lit_share(shape, shot) >= MIN_LIT:
            return shot
    raise ValueError(f"expected a view that shows {MIN_LIT:.0%} of the shape lit, found none in {MAX_DRAWS} draws")


def lit_share(shape: MeshScene, shot: Shot) -> float:
    """Return the share of a shape's pixels that are lit, in a preview of `PREVIEW_SIZE`."""
    view = find_view(shape, shot.camera, PREVIEW_SIZE)
    lit = torch.cat([found[0, :, 0] for found in find_lit(shape, view, shot.light)])
    return float(lit.float().mean()) if lit.numel() else 0.0


def capture_shot(shape: MeshScene, shot: Shot, size: int, samples: int, generator: torch.Generator) -> Capture:
    """Return a ``size`` x ``size`` frame of a shape with random materials by `camera.IMX250`, and its truth.

    Raises ValueError when no pixel that the shape covers completely is lit.
    """
    materials = random_materials(shape.mesh.slot_count, generator, shape.size)
    scene = render_scene((shape, materials), shot.camera, shot.light, (size, size), samples)
    exposed = expose_to_clip(blur(scene, shot.blur), shot.clip, Layout(), IMX250)
    return capture(expose_to_level(exposed, MIN_LEVEL, Layout(), IMX250), Layout(), IMX250, generator)


def _radius(vertices: Floats) -> float:
    """The largest distance of points ``[V, 3]`` from the origin."""
    return math.sqrt(float((vertices**2).sum(axis=1).max()))


def _along(points: Floats, axis: Floats) -> Floats:
    """Coordinates of points ``[..., 3]`` along a unit vector; a matrix product would round differently by machine."""
    along: Floats = points[..., 0] * axis[0] + points[..., 1] * axis[1] + points[..., 2] * axis[2]
    return along


def _uniform(interval: tuple[float, float], generator: torch.Generator) -> float:
    low, high = interval
    return low + (high - low) * float(torch.rand(1, generator=generator, dtype=torch.float64))


def _rounded(point: Floats) -> Vector:
    """A point rounded to six decimals, as in the record, so that the record describes exactly what was rendered."""
    x, y, z = (round(float(c), 6) for c in point)
    return (x, y, z)
