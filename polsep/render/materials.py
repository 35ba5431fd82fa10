"""Random materials of mesh slots: colourful, near-grey, dark, glossy and textured ones, as in users' photographs.

Conventions: albedo is linear RGB; roughness is GGX sqrt(alpha); ``specular`` scales the Fresnel lobe. Random draws take
a generator and are the same on every machine. Source: Dave et al. 2022, Sec. 5 (albedo and roughness random per face);
textures, shares and ranges are this project's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from polsep.render.textures import CHECKER, DOTS, MAX_OCTAVES, RINGS, Textures, pattern_weight

#: Shares of near-grey, dark and very glossy slots, drawn independently.
GREY_SHARE, DARK_SHARE, GLOSSY_SHARE = 0.25, 0.15, 0.1
#: Largest saturation of near-grey slots, and range for all others.
GREY_SATURATION, SATURATIONS = 0.08, (0.2, 1.0)
#: Largest albedo channel of dark slots, and of all others.
DARK_VALUES, VALUES = (0.01, 0.08), (0.15, 0.95)
#: Roughness of very glossy slots, and of all others.
GLOSSY_ROUGHNESS, ROUGHNESS = (0.08, 0.15), (0.15, 0.7)
#: Strength of the Fresnel lobe.
STRENGTH = (0.5, 1.0)
#: Probability of each pattern, in the order of `polsep.render.textures`.
PATTERN_WEIGHTS = (0.3, 0.12, 0.07, 0.09, 0.2, 0.12, 0.06, 0.04)
#: Shares of textured slots with one roughness, with one hue, and with isotropic cells.
EVEN_SHARE, SAME_HUE_SHARE, ROUND_SHARE = 0.4, 0.5, 0.6
#: Contrast between the materials of a slot, and largest difference of hues, in turns, that count as one hue.
CONTRAST, HUE_STEP = (0.15, 1.0), 0.08
#: Size of a cell relative to the object, log-uniform, and its largest stretch.
CELL_SIZES, LONGEST = (1 / 80, 1 / 2), 4.0
#: The extent of an average random shape, in scene units.
USUAL_SIZE = 5.0
#: Ranges per pattern of `Textures`: threshold, uniform, and edge, log-uniform.
THRESHOLDS = ((0, 0), (0, 0), (0.03, 0.12), (0.25, 0.5), (-0.25, 0.25), (0.3, 0.7), (0.3, 0.7), (0, 0))
EDGES = ((1, 1), (0.04, 0.3), (0.05, 0.2), (0.05, 0.3), (0.08, 1.2), (0.08, 0.9), (0.1, 0.9), (0.06, 0.2))

Interval = tuple[float, float]


@dataclass(frozen=True)
class Materials:
    """A material per slot: linear RGB ``albedo [S, 3]``, ``roughness`` and ``specular [S]``, as `sphere_tracing.Part`.

    With ``textures``, albedo and roughness vary in space toward a second material. Raises ValueError when the counts
    differ.
    """

    albedo: Tensor
    roughness: Tensor
    specular: Tensor
    textures: Textures | None = None

    def __post_init__(self) -> None:
        slots = self.roughness.numel()
        if self.albedo.shape != (slots, 3) or self.roughness.shape != (slots,) or self.specular.shape != (slots,):
            shapes = [tuple(x.shape) for x in (self.albedo, self.roughness, self.specular)]
            raise ValueError(f"expected albedo [S, 3], roughness [S] and specular [S], found {shapes}")
        if self.textures is not None and self.textures.pattern.numel() != slots:
            raise ValueError(f"expected textures of {slots} slots, found {self.textures.pattern.numel()}")


def look_up(materials: Materials, slot: Tensor, position: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return albedo ``[3, M, 1]``, roughness and specular ``[1, M, 1]`` of slots ``[M]`` at positions ``[3, M, 1]``.

    Positions are in the coordinates of the mesh. `polsep.render.shading_kernel` is the twin.
    """
    albedo, roughness, specular = _per_hit(materials.albedo, materials.roughness, materials.specular, slot=slot)
    if materials.textures is None:
        return albedo, roughness, specular
    weight = pattern_weight(materials.textures, slot, position)
    second, rough = _per_hit(materials.textures.albedo, materials.textures.roughness, slot=slot)
    return albedo + weight * (second - albedo), roughness + weight * (rough - roughness), specular


def _per_hit(*values: Tensor, slot: Tensor) -> list[Tensor]:
    """Values ``[S, C]`` or ``[S]`` at slots ``[M]``, as ``[C, M, 1]``."""
    return [value[slot].reshape(slot.numel(), -1).T[..., None] for value in values]


def random_materials(slots: int, generator: torch.Generator, size: float = USUAL_SIZE) -> Materials:
    """Return independent materials for a number of slots of an object of ``size`` scene units."""
    grey, dark, glossy = (_draw(slots, (0, 1), generator) < share for share in (GREY_SHARE, DARK_SHARE, GLOSSY_SHARE))
    hue = _draw(slots, (0, 1), generator)
    albedo = _random_albedo(hue, grey, dark, generator)
    roughness = _either(glossy, GLOSSY_ROUGHNESS, ROUGHNESS, generator)
    specular = _draw(slots, STRENGTH, generator)
    other = torch.where(_draw(slots, (0, 1), generator) < SAME_HUE_SHARE, HUE_STEP, 0.5)
    second = _random_albedo((hue + other * _draw(slots, (-1, 1), generator)) % 1, grey, dark, generator)
    second = albedo + _draw(slots, CONTRAST, generator)[:, None] * (second - albedo)
    even = _draw(slots, (0, 1), generator) < EVEN_SHARE
    rough = torch.where(even, roughness, _either(glossy, GLOSSY_ROUGHNESS, ROUGHNESS, generator))
    return Materials(albedo, roughness, specular, _random_textures(second, rough, size, generator))


def _random_albedo(hue: Tensor, grey: Tensor, dark: Tensor, generator: torch.Generator) -> Tensor:
    saturation = _either(grey, (0, GREY_SATURATION), SATURATIONS, generator)
    return rgb_from_hsv(hue, saturation, _either(dark, DARK_VALUES, VALUES, generator))


def _random_textures(albedo: Tensor, roughness: Tensor, size: float, generator: torch.Generator) -> Textures:
    """Random patterns of the second materials."""
    slots = roughness.numel()
    pattern = torch.multinomial(torch.tensor(PATTERN_WEIGHTS), slots, replacement=True, generator=generator)
    low, high = (size * share for share in CELL_SIZES)
    stretch = _log_draw(3 * slots, torch.tensor([1.0, LONGEST]), generator).view(slots, 3)
    round_cells = (_draw(slots, (0, 1), generator) < ROUND_SHARE) | (pattern == CHECKER) | (pattern == DOTS)
    stretch = torch.where(round_cells[:, None], 1.0, stretch)
    scale = 1 / (_log_draw(slots, torch.tensor([low, high]), generator)[:, None] * stretch)
    offset = _draw(3 * slots, (-64, 64), generator).view(slots, 3, 1)
    # Rings surround the origin of pattern space, which must lie inside or near the object.
    offset = torch.where((pattern == RINGS)[:, None, None], offset / 64, offset)
    rotation = _random_rotations(slots, generator)
    seed = torch.randint(2**31, (slots,), generator=generator)
    octaves = torch.randint(1, MAX_OCTAVES + 1, (slots,), generator=generator)
    warp = _draw(slots, (0, 1), generator) ** 2 * torch.where(pattern == RINGS, 0.5, 2.0)
    threshold = torch.tensor(THRESHOLDS, dtype=torch.float32)[pattern]
    return Textures(
        albedo,
        roughness,
        pattern,
        torch.cat([scale[:, :, None] * rotation, offset], dim=2),
        seed,
        octaves,
        warp,
        threshold[:, 0] + (threshold[:, 1] - threshold[:, 0]) * _draw(slots, (0, 1), generator),
        _log_draw(slots, torch.tensor(EDGES, dtype=torch.float32)[pattern].T, generator),
    )


def _random_rotations(count: int, generator: torch.Generator) -> Tensor:
    """Uniform rotations ``[N, 3, 3]`` from unit quaternions (Shoemake 1992)."""
    radius, a, b = torch.rand(3, count, generator=generator, dtype=torch.float64)
    a, b = 2 * math.pi * a, 2 * math.pi * b
    low, high = torch.sqrt(1 - radius), torch.sqrt(radius)
    x, y, z, w = low * a.sin(), low * a.cos(), high * b.sin(), high * b.cos()
    return torch.stack([torch.stack(row, dim=1) for row in rotation_rows(x, y, z, w)], dim=1).float()


def rotation_rows(x: Any, y: Any, z: Any, w: Any) -> list[list[Any]]:
    """Return the rotation matrix of a unit quaternion x i + y j + z k + w by rows, of numbers or tensors."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def rgb_from_hsv(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """Return colours ``[S, 3]`` of hue (in turns), saturation and value ``[S]``, all in [0, 1] (Smith 1978)."""
    offsets = torch.tensor([5.0, 3.0, 1.0]).to(hue)
    k = (offsets + 6 * hue[:, None]) % 6
    return value[:, None] * (1 - saturation[:, None] * torch.minimum(k, 4 - k).clamp(0, 1))


def _draw(count: int, interval: Interval, generator: torch.Generator) -> Tensor:
    low, high = interval
    return low + (high - low) * torch.rand(count, generator=generator)


def _either(special: Tensor, interval: Interval, otherwise: Interval, generator: torch.Generator) -> Tensor:
    """Uniform in the first interval where ``special``, else in the second."""
    drawn = torch.rand(special.numel(), generator=generator)
    low, high = (torch.where(special, a, b) for a, b in zip(interval, otherwise, strict=True))
    return low + (high - low) * drawn


def _log_draw(count: int, interval: Tensor, generator: torch.Generator) -> Tensor:
    """Log-uniform between the two values, or the two rows, of ``interval``.

    In double precision, like rotations: its last bits differ between machines, and rounding to float32 removes them.
    """
    low, high = interval.double().log()
    return torch.exp(low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float64)).float()
