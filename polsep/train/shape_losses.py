"""Losses of surfaces: of normals, of logarithms of albedo, roughness and strength, and of pictures under other lamps.

Expected errors are fitted to errors that are held fixed, so that what is uncertain is not given up (Seitzer et al.
2022, arXiv:2203.09168, argue for that). Pictures are those of `shape_maps.relight`; as the albedo is relative, they
are compared after a common gain. Source of the pictures' loss: Deschaintre et al. 2018.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from polsep.geometry.shape_maps import Surface, relight

#: Weights of the losses: normals, their expected errors, albedo, roughness and strength, pictures.
NORMALS, EXPECTED, ALBEDO, GLOSS, PICTURES = 1.0, 0.05, 0.3, 0.3, 0.3
#: Number of lamps of pictures, and their largest angle from the camera.
LAMPS, LARGEST_DEG = 2, 70.0
#: Pictures are computed at every so many pixels across and down: they took most of a step.
SPARSE = 2
#: Added to pictures, relative to their mean, before their logarithm is taken; and to albedos.
FLOOR, ALBEDO_FLOOR = 0.1, 0.02


def shape_loss(found: Surface, truth: Surface, mask: Tensor, generator: torch.Generator) -> Tensor:
    """Return the sum of all losses of surfaces ``[B, C, h, w]``; every frame counts alike."""
    distance = (found.normal - truth.normal).square().sum(dim=1, keepdim=True)
    total = NORMALS * _mean((distance + 1e-4).sqrt(), mask)
    total = total + EXPECTED * _mean(_likelihood(distance.detach() / 2, found.normal_error), mask)
    first, second = (torch.log(x.albedo + ALBEDO_FLOOR) for x in (found, truth))
    total = total + ALBEDO * _mean(_centred(first - second, mask).abs().mean(dim=1, keepdim=True), mask)
    for name in ("roughness", "specular"):
        off = torch.log(getattr(found, name)) - torch.log(getattr(truth, name).clamp(min=1e-3))
        total = total + GLOSS * _mean(off.abs(), mask)
        total = total + EXPECTED * _mean(_likelihood(off.detach().square(), getattr(found, f"{name}_error")), mask)
    rows, cols = (slice(n, None, SPARSE) for n in torch.randint(SPARSE, (2,), generator=generator).tolist())
    found, truth = (Surface(*(x[..., rows, cols] for x in surface)) for surface in (found, truth))
    return total + PICTURES * pictures_loss(found, truth, mask[..., rows, cols], random_lamps(LAMPS, generator))


def _likelihood(square: Tensor, deviation: Tensor) -> Tensor:
    """Negative logarithm of the likelihood of squared errors of one axis, up to a constant."""
    return square / (2 * deviation.square()) + torch.log(deviation)


def _mean(values: Tensor, mask: Tensor) -> Tensor:
    """The mean over masks ``[B, 1, h, w]`` of each frame, then over frames."""
    return ((values * mask).sum(dim=(1, 2, 3)) / mask.sum(dim=(1, 2, 3)).clamp(min=1)).mean()


def _centred(values: Tensor, mask: Tensor) -> Tensor:
    """Values less their mean over colours and the mask of each frame."""
    count = mask.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1) * values.shape[1]
    return values - (values * mask).sum(dim=(1, 2, 3), keepdim=True) / count


def random_lamps(count: int, generator: torch.Generator) -> Tensor:
    """Directions ``[count, 3]`` toward lamps, even over a cone around the camera's."""
    place, turn = torch.rand(2, count, generator=generator)
    cosine = math.cos(math.radians(LARGEST_DEG))
    z, turn = cosine + (1 - cosine) * place, 2 * math.pi * turn
    return torch.stack([(1 - z * z).sqrt() * turn.cos(), (1 - z * z).sqrt() * turn.sin(), z], dim=-1)


def gained(surface: Surface, truth: Surface, mask: Tensor) -> Surface:
    """Return the surface with its albedo scaled to that of the truth, in the mean of logarithms."""
    off = torch.log(truth.albedo + ALBEDO_FLOOR) - torch.log(surface.albedo + ALBEDO_FLOOR)
    return surface._replace(albedo=surface.albedo * torch.exp(off - _centred(off, mask)))


def pictures_loss(found: Surface, truth: Surface, mask: Tensor, lamps: Tensor) -> Tensor:
    """Return the mean difference of the logarithms of pictures under lamps ``[K, 3]``."""
    scaled, total = gained(found, truth, mask), torch.zeros((), device=mask.device)
    for lamp in lamps.to(mask.device):
        first, second = (relight(x, lamp) for x in (scaled, truth))
        level = FLOOR * _frame_mean(second, mask)
        off = (torch.log(first + level) - torch.log(second + level)).abs().mean(dim=1, keepdim=True)
        total = total + _mean(off, mask) / len(lamps)
    return total


def _frame_mean(picture: Tensor, mask: Tensor) -> Tensor:
    count = mask.sum(dim=(1, 2, 3), keepdim=True).clamp(min=1) * picture.shape[1]
    return ((picture * mask).sum(dim=(1, 2, 3), keepdim=True) / count).clamp(min=1e-4)
