"""How far an image is from the truth: ``[C, h, w]``, linear light, 1 = the white level of one measurement.

PSNR: peak 1, both images limited to [0, 1] unless said, inside the object mask, 120 dB at most. An s0 reaches 2,
so limited scores are blind above half of that; `psnr_unlimited` is not, and highlights dominate it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import conv2d

#: Window and constants of SSIM for peak 1 (Wang et al. 2004).
SSIM_SIGMA, SSIM_RADIUS, SSIM_C1, SSIM_C2 = 1.5, 5, 0.01**2, 0.03**2
#: True specular light above which a pixel is in a highlight.
HIGHLIGHT = 0.2
#: Share of scenes that count as the worst.
WORST_SHARE = 0.1


def psnr(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """PSNR in dB of images ``[C, h, w]`` inside ``mask [h, w]``, as the module says; at most 120.

    Raises ValueError where the mask is empty or the error is not a number.
    """
    return psnr_unlimited(found.clamp(0, 1), truth.clamp(0, 1), mask)


def psnr_unlimited(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """`psnr` of the values as they are."""
    error = float(((found - truth) ** 2).mean(dim=0)[mask].mean())
    if math.isnan(error):
        raise ValueError(f"expected numbers inside a mask, found NaN in {int(mask.sum())} pixels")
    return min(120.0, -10 * math.log10(max(error, 1e-30)))


def ssim(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Mean structural similarity inside ``mask`` of images limited to [0, 1], every colour by itself.

    Gaussian windows, of which those that reach beyond the border are left out. Source: Wang, Bovik, Sheikh, Simoncelli
    2004, doi:10.1109/TIP.2003.819861. Raises ValueError when no window of the mask fits.
    """
    radius = SSIM_RADIUS
    kept = mask.clone()
    kept[:radius], kept[-radius:], kept[:, :radius], kept[:, -radius:] = False, False, False, False
    if not bool(kept.any()):
        raise ValueError(f"expected a mask that reaches {radius} pixels inside the frame, found none")
    x, y = found.clamp(0, 1).double(), truth.clamp(0, 1).double()
    mean_x, mean_y, xx, yy, xy = (_window_mean(image) for image in (x, y, x * x, y * y, x * y))
    covariance, variances = xy - mean_x * mean_y, xx + yy - mean_x**2 - mean_y**2
    likeness = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    likeness = likeness / ((mean_x**2 + mean_y**2 + SSIM_C1) * (variances + SSIM_C2))
    return float(likeness.mean(dim=0)[kept[radius:-radius, radius:-radius]].mean())


def _window_mean(image: Tensor) -> Tensor:
    taps = torch.exp(-0.5 * (torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=torch.float64) / SSIM_SIGMA) ** 2)
    taps = taps / taps.sum()
    return conv2d(conv2d(image[:, None], taps.view(1, 1, 1, -1)), taps.view(1, 1, -1, 1))[:, 0]


def highlights(specular: Tensor, mask: Tensor) -> Tensor:
    """The pixels of ``mask`` whose true specular light exceeds `HIGHLIGHT` in every colour."""
    return mask & (specular.amin(dim=0) > HIGHLIGHT)


def chroma(specular: Tensor, mask: Tensor) -> float:
    """Mean of (largest - smallest) / mean colour inside ``mask``: 0 for white light; 0 where the mask is empty."""
    inside = specular[:, mask]
    mean = inside.mean(dim=0)
    return float(((inside.amax(dim=0) - inside.amin(dim=0)) / mean.clamp(min=1e-6)).mean()) if inside.numel() else 0.0


def worst_mean(values: list[float]) -> float:
    """The mean of the smallest tenth of values, at least of one."""
    count = max(1, round(WORST_SHARE * len(values)))
    return sum(sorted(values)[:count]) / count
