"""Set (c): measured diffuse and specular light of eight objects, polarized as geometry says.

The MIT intrinsic images were photographed through crossed and through parallel polarizers. Under a linearly polarized
light every analyser passes half of the depolarized diffuse light, and only the parallel one the specular. The crossed
photograph is ``diffuse``, the parallel one ``original = diffuse + specular``: tau_d = 2 diffuse and tau_s = specular.

The diffuse gets DoLP and AoLP of Fresnel transmission at the zenith angle and azimuth of the depth map's normals; the
camera is taken for orthographic. The specular gets full polarization at one AoLP per scene. That is exact for one
distant light: the facets that mirror it to the camera all have the half vector as their normal, wherever they lie.

A pixel of the photographs, which were scaled down to 300 to 500, becomes a 2x2 cell of the sensor, by bilinear
interpolation: so they are as sharp as what a lens puts on a mosaic, and at half resolution they are about themselves.
They keep their noise and their imperfect polarizers. Pixels without a depth are black and outside the mask.

Source: Grosse et al. 2009, doi:10.1109/ICCV.2009.5459428; the depths: Barron and Malik 2015, SIRFS.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

from evaluation.testsets.cases import Recipe
from polsep.io.assets.objects import read_depth, read_mask, read_photograph
from polsep.physics.fresnel import diffuse_dolp
from polsep.physics.stokes import Stokes
from polsep.render.shapes import Floats
from polsep.render.sphere_tracing import Scene

PHOTOGRAPHED = ("apple", "box", "cup1", "cup2", "frog1", "panther", "phone", "raccoon")
FILES = ("diffuse.png", "specular.png", "mask.png", "Z.mat")
#: Black pixels of the photograph around the object, and raw pixels per pixel of it.
MARGIN, SCALE = 4, 2


def make_photograph(paths: list[Path], generator: torch.Generator) -> Scene:
    """A photographed object whose highlights have one random AoLP."""
    crossed, specular = (torch.from_numpy(read_photograph(path)) for path in paths[:2])
    normal = normals_from_depth(read_depth(paths[3]))
    seen = read_mask(paths[2]) & np.isfinite(normal).all(axis=0)
    angle = math.pi * torch.rand(1, generator=generator).item()
    mask, unit = torch.from_numpy(seen), torch.from_numpy(np.nan_to_num(normal)).float()
    diffuse = polarize_diffuse(2 * crossed * mask, unit)
    specular = specular * mask
    fixed = Stokes(specular, specular * math.cos(2 * angle), specular * math.sin(2 * angle))
    return _enlarged(_cropped(Scene(diffuse, fixed, mask)))


def normals_from_depth(height: Floats) -> Floats:
    """Unit normals ``[3, H, W]`` (x right, y up, z to the camera) of heights toward the camera in pixels.

    Central differences; NaN where a neighbour has no height.
    """
    down, right = np.gradient(height)
    normal = np.stack([-right, down, np.ones_like(height)])
    return np.asarray(normal / np.linalg.norm(normal, axis=0))


def polarize_diffuse(s0: Tensor, normal: Tensor) -> Stokes:
    """Diffuse light ``[3, H, W]`` that leaves a dielectric toward +z: AoLP is the azimuth of the unit normal.

    DoLP is `fresnel.diffuse_dolp` at its zenith angle.
    """
    x, y, z = normal
    squared = (x * x + y * y).clamp(min=1e-12)
    degree = diffuse_dolp(z)
    return Stokes(s0, s0 * degree * (x * x - y * y) / squared, s0 * degree * 2 * x * y / squared)


def _cropped(scene: Scene) -> Scene:
    """The scene around its mask with at least `MARGIN` black pixels, its sides multiples of 4."""
    rows, cols = (torch.nonzero(scene.mask.any(dim=d)).flatten() for d in (1, 0))
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1
    below, beside = (MARGIN + -(length + 2 * MARGIN) % 4 for length in (bottom - top, right - left))

    def crop(image: Tensor) -> Tensor:
        return pad(image[..., top:bottom, left:right], (MARGIN, beside, MARGIN, below))

    return Scene(scene.diffuse.map(crop), scene.specular.map(crop), crop(scene.mask))


def _enlarged(scene: Scene) -> Scene:
    """The scene with `SCALE` x `SCALE` pixels for one."""

    def enlarge(image: Tensor) -> Tensor:
        return interpolate(image[None], scale_factor=SCALE, mode="bilinear")[0]

    mask = scene.mask.repeat_interleave(SCALE, 0).repeat_interleave(SCALE, 1)
    return Scene(scene.diffuse.map(enlarge), scene.specular.map(enlarge), mask)


PHOTOGRAPHS = tuple(
    Recipe(f"photo-{name}", 2300 + k, tuple(f"crossed_polarizers/{name}/{f}" for f in FILES), make_photograph)
    for k, name in enumerate(PHOTOGRAPHED)
)
