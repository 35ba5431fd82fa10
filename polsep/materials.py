"""Random materials of mesh slots, as wide as what users photograph: colourful, near-grey, dark and glossy ones.

Conventions: albedo is linear RGB; roughness is GGX sqrt(alpha); ``specular`` scales the Fresnel lobe. Random draws take
a generator and are the same on every machine. Source: Dave et al. 2022, Sec. 5 (albedo and roughness random per face);
the shares are this project's.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

#: Shares of slots that are near-grey, dark, and very glossy; drawn independently of each other.
GREY_SHARE, DARK_SHARE, GLOSSY_SHARE = 0.25, 0.15, 0.1
#: Saturation of near-grey slots at most, and of all others.
GREY_SATURATION, SATURATIONS = 0.08, (0.2, 1.0)
#: Largest albedo channel of dark slots, and of all others.
DARK_VALUES, VALUES = (0.01, 0.08), (0.15, 0.95)
#: Roughness of very glossy slots, and of all others.
GLOSSY_ROUGHNESS, ROUGHNESS = (0.08, 0.15), (0.15, 0.7)
#: Strength of the Fresnel lobe.
STRENGTH = (0.5, 1.0)

Interval = tuple[float, float]


@dataclass(frozen=True)
class Materials:
    """A material per slot: linear RGB ``albedo [S, 3]``, ``roughness`` and ``specular [S]`` as in `render.Part`.

    Raises ValueError when the counts differ.
    """

    albedo: Tensor
    roughness: Tensor
    specular: Tensor

    def __post_init__(self) -> None:
        slots = self.roughness.numel()
        if self.albedo.shape != (slots, 3) or self.roughness.shape != (slots,) or self.specular.shape != (slots,):
            shapes = [tuple(x.shape) for x in (self.albedo, self.roughness, self.specular)]
            raise ValueError(f"expected albedo [S, 3], roughness [S] and specular [S], found {shapes}")


def random_materials(slots: int, generator: torch.Generator) -> Materials:
    """Independent materials for so many slots; see the constants."""
    grey, dark, glossy = (_draw(slots, (0, 1), generator) < share for share in (GREY_SHARE, DARK_SHARE, GLOSSY_SHARE))
    hue = _draw(slots, (0, 1), generator)
    saturation = _either(grey, (0, GREY_SATURATION), SATURATIONS, generator)
    value = _either(dark, DARK_VALUES, VALUES, generator)
    roughness = _either(glossy, GLOSSY_ROUGHNESS, ROUGHNESS, generator)
    return Materials(rgb_from_hsv(hue, saturation, value), roughness, _draw(slots, STRENGTH, generator))


def rgb_from_hsv(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """Colours ``[S, 3]`` of hue (in turns), saturation and value ``[S]``, all in [0, 1] (Smith 1978)."""
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
