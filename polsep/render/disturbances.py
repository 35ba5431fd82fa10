"""Light as the world has it: what real lamps, rooms, surfaces and lenses change in an ideal scene.

All functions are pure, and map a `Scene` (diffuse, specular: ``Stokes [..., C, H, W]``; mask ``[..., H, W]``) to a
scene, whole frames or batches of crops. Numbers may be floats or tensors that broadcast against ``[..., C, H, W]``:
one number per crop is ``[B, 1, 1, 1]``, a colour ``[..., C, 1, 1]`` (`as_color`).

Truth: after every function ``specular.s0`` is the light of the LAMPS mirrored at surfaces, and ``diffuse.s0`` all
other light: also room light with its reflections and unpolarized indirect light, as behind crossed polarizers. Light
inside a body that keeps the lamp's polarization counts as specular, as behind crossed polarizers too. The truth is
what lies on the sensor: a lens changes it as it changes the light.

Neutral arguments give the scene back. Conventions of angles and units are those of `physics.stokes`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from polsep.physics.gltf import GLASS
from polsep.physics.stokes import Stokes, rotate_frame
from polsep.render.sphere_tracing import Scene

Number = float | Tensor

#: Camera RGB of white paper under lamps, raw, green = 1: the inverse of usual factors of white balance, rounded.
LAMPS = {
    "white": (1.0, 1.0, 1.0),
    "daylight": (0.55, 1.0, 0.65),
    "tungsten": (0.90, 1.0, 0.35),
    "cool LED": (0.50, 1.0, 0.80),
    "warm LED": (0.75, 1.0, 0.42),
}
#: Reflectance of metals at normal incidence in linear RGB: Hoffman, in Akenine-Moeller et al. 2018, table 9.2.
METALS = {
    "gold": (1.000, 0.782, 0.344),
    "copper": (0.955, 0.638, 0.538),
    "aluminium": (0.912, 0.914, 0.920),
    "silver": (0.972, 0.960, 0.915),
    "iron": (0.562, 0.565, 0.578),
}


def as_color(rgb: Sequence[float] | Tensor) -> Tensor:
    """Return three numbers, or ``[..., 3]``, as a colour ``[..., 3, 1, 1]``."""
    return torch.as_tensor(rgb, dtype=torch.float32)[..., None, None]


def scale_light(scene: Scene, gain: Number) -> Scene:
    """Return the scene times ``gain`` (0 or more): an exposure, or the raw colour of the lamp as a `as_color`."""
    return replace(scene, diffuse=scene.diffuse * gain, specular=scene.specular * gain)


def add_scenes(first: Scene, second: Scene) -> Scene:
    """Return one set of surfaces under two lamps; both lamps' reflections are specular. Masks must agree."""
    return replace(first, diffuse=first.diffuse + second.diffuse, specular=first.specular + second.specular)


def depolarize_lamp(scene: Scene, degree: Number, crossed: Scene | None = None) -> Scene:
    """Return the scene under a lamp of a ``degree`` of polarization in [0, 1] (wire grid 1.0, film 0.98, worn 0.8).

    Exact with ``crossed``, the scene under the same lamp whose polarizer is turned by 90 degrees: a mixture of both.
    Without it s1 and s2 of the specular shrink and all else stays, which is exact at normal incidence. The whole
    reflection of the lamp stays specular.
    """
    if crossed is not None:
        return add_scenes(scale_light(scene, 0.5 + 0.5 * degree), scale_light(crossed, 0.5 - 0.5 * degree))
    light = scene.specular
    return replace(scene, specular=Stokes(light.s0, light.s1 * degree, light.s2 * degree))


def specular_angle(scene: Scene) -> Tensor:
    """Return the AoLP [rad] ``[..., 1, 1, 1]`` of all specular light: that of the lamp as cameras see it."""
    s1, s2 = (s.double().sum(dim=(-3, -2, -1), keepdim=True) for s in (scene.specular.s1, scene.specular.s2))
    return (0.5 * torch.atan2(s2, s1)).to(scene.specular.s0)


def retain_polarization(scene: Scene, share: Number, whiteness: Number = 0.0) -> Scene:
    """Return the scene whose diffuse light keeps the lamp's polarization by a ``share`` in [0, 0.15].

    That part moves from the diffuse to the specular light, fully polarized at `specular_angle`. It has the colour of
    the diffuse light; for ``whiteness`` 1 it has the same mean and no colour. Skin, wax and paint keep 2 to 10 % by
    single scattering (Ma et al. 2007). Truth: crossed polarizers count it as specular, and so does this.
    `train.variety.vary_retention` adds white light on top instead, up to 3 %.
    """
    kept = scene.diffuse.s0 * share
    kept = kept + whiteness * (kept.mean(dim=-3, keepdim=True) - kept)
    angle = 2 * specular_angle(scene)
    more = Stokes(kept, kept * torch.cos(angle), kept * torch.sin(angle))
    return replace(scene, diffuse=scene.diffuse * (1 - share), specular=scene.specular + more)


def _scaled_to(mean: Tensor, image: Tensor, inside: Tensor) -> Tensor:
    """The image times what gives it this mean over all colours of the pixels inside."""
    return image * (mean / _mean_over(image, inside).clamp(min=1e-12))


def _mean_over(image: Tensor, inside: Tensor) -> Tensor:
    """Mean ``[..., 1, 1, 1]`` over all colours of the pixels inside."""
    count = inside.sum(dim=(-3, -2, -1), keepdim=True) * image.shape[-3]
    return (image * inside).sum(dim=(-3, -2, -1), keepdim=True) / count.clamp(min=1)


def random_field(size: tuple[int, ...], cells: int, contrast: float, generator: torch.Generator) -> Tensor:
    """Return smooth random fields ``size = (..., H, W)`` of mean 1 and of largest over mean of 1 + ``contrast``.

    Bicubic between ``cells`` x ``cells`` random numbers (2 to 8), so blobs are of 1 / cells of the frame.
    """
    *lead, height, width = size
    knots = torch.rand(math.prod(lead), 1, cells, cells, generator=generator)
    field = interpolate(knots, (height, width), mode="bicubic", align_corners=True)
    field = field - field.mean(dim=(-2, -1), keepdim=True)
    field = field / field.abs().amax(dim=(-2, -1), keepdim=True).clamp(min=1e-6)
    return (1 + contrast * field).view(size)


@dataclass(frozen=True)
class IndirectLight:
    """Light that reaches a surface over a coloured neighbour; a cheap stand-in for path tracing.

    ``diffuse``, ``mirrored``: mean s0 over that of the direct diffuse light, on the mask (0 to 0.4, 0 to 0.1).
    ``color``: of the neighbour. ``places [..., 1, H, W]``: where it falls (`random_field`, to a power). ``lamp``: share
    of the mirrored part that keeps the lamp's polarization after two mirrors, turned by ``turn`` [rad]; that part is
    specular and coloured, the rest unpolarized and diffuse.
    """

    diffuse: Number
    mirrored: Number
    color: Number
    places: Number = 1.0
    lamp: Number = 0.0
    turn: Number = 0.0


def add_indirect_light(scene: Scene, light: IndirectLight) -> Scene:
    """Return the scene with coloured inter-reflections: diffuse, unpolarized specular, and some polarized specular."""
    base, inside = scene.diffuse.s0, scene.mask[..., None, :, :]
    mean = _mean_over(base, inside)
    falling = torch.ones_like(base) * light.places * light.color
    body = _scaled_to(light.diffuse * mean, base * falling, inside)
    lobe = _scaled_to(light.mirrored * mean, falling * inside, inside)
    angle, kept = 2 * specular_angle(scene), lobe * light.lamp
    turned = rotate_frame(Stokes(kept, kept * torch.cos(angle), kept * torch.sin(angle)), -torch.as_tensor(light.turn))
    diffuse = replace(scene.diffuse, s0=base + body + lobe * (1 - torch.as_tensor(light.lamp)))
    return replace(scene, diffuse=diffuse, specular=scene.specular + turned)


def make_metal(scene: Scene, metal: Tensor, reflectance: Number) -> Scene:
    """Return the scene with surfaces of metal: no diffuse light, and coloured specular light.

    ``metal [..., 1, H, W]``: 1 where there is metal, 0 elsewhere. ``reflectance``: its colour (`METALS`) at normal
    incidence, in place of the dielectric's. The lobe keeps the dielectric's polarization: metals turn it a little and
    make some of it circular.
    """
    specular = scene.specular * (1 + metal * (1 / GLASS * reflectance - 1))
    return replace(scene, diffuse=scene.diffuse * (1 - metal), specular=specular)


def add_veiling_glare(scene: Scene, share: Number) -> Scene:
    """Return the scene behind a lens that spreads a ``share`` in [0, 0.1] of its light evenly over the frame.

    Diffuse and specular light spread with their polarization, and the truth with them. Good lenses: 1 to 3 % (ISO
    9358).
    """

    def veil(image: Tensor) -> Tensor:
        return image * (1 - share) + share * image.mean(dim=(-2, -1), keepdim=True)

    return replace(scene, diffuse=scene.diffuse.map(veil), specular=scene.specular.map(veil))


def shift_colors(scene: Scene, red: float, blue: float) -> Scene:
    """Return the scene behind a lens of lateral chromatic aberration: red and blue are magnified by 1 + these numbers.

    About the frame's centre, against green; within 0.002 for machine vision lenses. The truth is the lens's image.
    """
    if red == blue == 0:
        return scene

    def magnify(image: Tensor) -> Tensor:
        planes = image.unbind(dim=-3)
        return torch.stack([_magnify(p, m) for p, m in zip(planes, (red, 0.0, blue), strict=True)], dim=-3)

    # Bicubic interpolation overshoots beside highlights; light is not negative.
    diffuse, specular = scene.diffuse.map(magnify), scene.specular.map(magnify)
    diffuse, specular = (replace(light, s0=light.s0.clamp(min=0)) for light in (diffuse, specular))
    return replace(scene, diffuse=diffuse, specular=specular)


def _magnify(plane: Tensor, more: float) -> Tensor:
    """A plane ``[..., H, W]`` magnified by 1 + ``more`` about its centre, bicubic."""
    if more == 0:
        return plane
    height, width = plane.shape[-2:]
    rows, cols = ((torch.arange(n, dtype=plane.dtype) + 0.5) / n * 2 - 1 for n in (height, width))
    grid = torch.stack([cols.expand(height, width), rows[:, None].expand(height, width)], dim=-1) / (1 + more)
    flat = plane.reshape(-1, 1, height, width)
    grid = grid.to(plane.device).expand(flat.shape[0], -1, -1, -1)
    out = grid_sample(flat, grid, mode="bicubic", padding_mode="reflection", align_corners=False)
    return out.view_as(plane)
