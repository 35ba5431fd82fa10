"""Errors of an image from the truth: ``[C, h, w]``, linear light, 1 = the white level of one measurement.

PSNR: peak 1, both images limited to [0, 1] unless said, inside the object mask, 120 dB at most. An s0 reaches 2,
so limited scores are blind above half of that; `psnr_unlimited` is not, and highlights dominate it. `flip` needs the
extra ``bench`` and raises ValueError without it.
"""

from __future__ import annotations

import math
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor

#: Window and constants of SSIM for peak 1 (Wang et al. 2004).
SSIM_SIGMA, SSIM_RADIUS, SSIM_C1, SSIM_C2 = 1.5, 5, 0.01**2, 0.03**2
#: Pixels beyond which nothing changes FLIP at a point: its widest filter reaches 3 standard deviations of
#: sqrt(0.04 / 2) / pi degrees at 67 pixels per degree, 10 pixels, and this leaves as much again.
FLIP_REACH = 20
#: True specular light above which a pixel is in a highlight.
HIGHLIGHT = 0.2
#: Share of scenes that count as the worst.
WORST_SHARE = 0.1
#: Errors below this, a PSNR of 120 dB, count as this in ratios.
MIN_DEVIATION = 1e-6


class Reliability(NamedTuple):
    """Rms errors ``expected`` and ``found`` ``[bins]``, by rising expectation, and their difference.

    ``miss`` is the rms over bins of log2(found / expected): 0 for a calibrated expectation, 1 for one that is wrong by
    a factor of two everywhere, in either direction.
    """

    expected: Tensor
    found: Tensor
    miss: float


def psnr(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Return the PSNR in dB of images ``[C, h, w]``, limited to [0, 1], inside ``mask [h, w]``; at most 120.

    Raises ValueError where the mask is empty or the error is not a number.
    """
    return psnr_unlimited(found.clamp(0, 1), truth.clamp(0, 1), mask)


def psnr_unlimited(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Return the PSNR of the values as they are; see `psnr`."""
    squared = ((found - truth) ** 2).mean(dim=0)[mask]
    if not squared.numel():
        raise ValueError("expected a mask with pixels, found an empty one")
    _require_numbers(squared)
    return min(120.0, -10 * math.log10(max(float(squared.mean()), 1e-30)))


def ssim(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Return the mean structural similarity of images limited to [0, 1], inside ``mask``.

    Every colour by itself; Gaussian windows, of which those that reach beyond the border are left out. Source: Wang,
    Bovik, Sheikh, Simoncelli 2004, doi:10.1109/TIP.2003.819861. Raises ValueError when no window of the mask fits,
    and on values in such windows that are no numbers.
    """
    radius = SSIM_RADIUS
    kept = mask.clone()
    kept[:radius], kept[-radius:], kept[:, :radius], kept[:, -radius:] = False, False, False, False
    if not bool(kept.any()):
        raise ValueError(f"expected a mask that reaches {radius} pixels inside the frame, found none")
    around = _around(kept, radius)
    kept = kept[around][radius:-radius, radius:-radius]
    x, y = (image[..., *around].clamp(0, 1).double() for image in (found, truth))
    mean_x, mean_y, xx, yy, xy = (_window_mean(image) for image in (x, y, x * x, y * y, x * y))
    covariance, variances = xy - mean_x * mean_y, xx + yy - mean_x**2 - mean_y**2
    likeness = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    likeness = likeness / ((mean_x**2 + mean_y**2 + SSIM_C1) * (variances + SSIM_C2))
    score = likeness.mean(dim=0)[kept]
    _require_numbers(score)
    return float(score.mean())


def _require_numbers(image: Tensor) -> None:
    """Raise ValueError on an image that holds NaN."""
    if wrong := int(image.isnan().sum()):
        raise ValueError(f"expected numbers inside a mask, found NaN in {wrong} pixels")


def _around(mask: Tensor, margin: int) -> tuple[slice, slice]:
    """Rows and columns of a mask ``[h, w]`` with ``margin`` pixels around it, on which its scores depend."""
    rows, cols = (torch.nonzero(mask.any(dim=dim)).flatten() for dim in (1, 0))
    top, left = max(0, int(rows[0]) - margin), max(0, int(cols[0]) - margin)
    return slice(top, int(rows[-1]) + 1 + margin), slice(left, int(cols[-1]) + 1 + margin)


def _window_mean(image: Tensor) -> Tensor:
    """Gaussian means over the windows that fit, by adding shifted images: many times faster than a convolution here."""
    taps = [math.exp(-0.5 * (k / SSIM_SIGMA) ** 2) for k in range(-SSIM_RADIUS, SSIM_RADIUS + 1)]
    for dim in (-1, -2):
        count = image.shape[dim] - 2 * SSIM_RADIUS
        total = torch.zeros_like(image.narrow(dim, 0, count))
        for k, tap in enumerate(taps):
            total.add_(image.narrow(dim, k, count), alpha=tap / sum(taps))
        image = total
    return image


def flip(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Return the mean LDR-FLIP inside ``mask``: 0 for equal images, 1 at most.

    Images ``[3, h, w]`` or ``[1, h, w]``, limited to [0, 1] and shown in sRGB at 67 pixels per degree: the difference
    that an observer sees who flips between both frames. Source: Andersson et al. 2020, doi:10.1145/3406183, by the
    authors' own library. Raises ValueError without the extra bench, where the mask is empty, and on values that are no
    numbers near it, which the library takes for light.
    """
    evaluator = require_flip()
    if not bool(mask.any()):
        raise ValueError("expected a mask with pixels, found an empty one")
    around = _around(mask, FLIP_REACH)
    _require_numbers((found - truth)[..., *around].mean(dim=0))
    limited = (x[..., *around].clamp(0, 1).expand(3, -1, -1) for x in (truth, found))
    images = (x.permute(1, 2, 0).float().contiguous().numpy() for x in limited)
    # With inputsRGB=False the library accepts linear values.
    errors, _, _ = evaluator.evaluate(*images, "LDR", inputsRGB=False, applyMagma=False, computeMeanError=False)
    return float(torch.from_numpy(errors)[..., 0][mask[around]].double().mean())


def require_flip() -> ModuleType:
    """Return the library of `flip`. Raises ValueError where it is not installed."""
    try:
        import flip_evaluator
    except ImportError:
        raise ValueError("expected the extra bench (pip install 'polsep[bench]'), found no flip_evaluator") from None
    module: ModuleType = flip_evaluator
    return module


def highlights(specular: Tensor, mask: Tensor) -> Tensor:
    """Return the pixels of ``mask`` whose true specular light exceeds `HIGHLIGHT` in every colour."""
    return mask & (specular.amin(dim=0) > HIGHLIGHT)


def chroma(specular: Tensor, mask: Tensor) -> float:
    """Return the mean of (largest - smallest) / mean colour inside ``mask``: 0 for white light or an empty mask."""
    inside = specular[:, mask]
    mean = inside.mean(dim=0)
    return float(((inside.amax(dim=0) - inside.amin(dim=0)) / mean.clamp(min=1e-6)).mean()) if inside.numel() else 0.0


def reliability(error: Tensor, expected: Tensor, mask: Tensor, bins: int) -> Reliability:
    """Return the reliability curve of expected errors against the true ones.

    ``error [C, h, w]``: found - truth; ``expected [h, w]``: its standard deviation over all colours. The pixels of
    ``mask [h, w]`` are sorted into ``bins`` of equal count by what was expected. Means are of squares on both sides, so
    that bins may be wide. With n independent errors per bin, ``miss`` of a calibrated expectation is 1 / sqrt(n), not
    0. Raises ValueError on fewer pixels than bins, on errors that are no numbers and on deviations below 0. Source:
    Levi, Gispan, Giladi, Fetaya 2022, doi:10.3390/s22155540 (their ENCE takes differences, not logarithms).
    """
    squared, sigma = (error.double() ** 2).mean(dim=0)[mask], expected.double()[mask]
    if not 0 < bins <= sigma.numel():
        raise ValueError(f"expected at least {max(bins, 1)} pixels for {bins} bins, found {sigma.numel()}")
    wrong = int((~torch.isfinite(squared) | ~torch.isfinite(sigma) | (sigma < 0)).sum())
    if wrong:
        raise ValueError(f"expected finite errors and deviations of 0 or more, found others in {wrong} pixels")
    groups = torch.argsort(sigma, stable=True).tensor_split(bins)
    curves = (torch.stack([x[group].mean().sqrt() for group in groups]) for x in (sigma**2, squared))
    said, found = curves
    octaves = torch.log2(found.clamp(min=MIN_DEVIATION) / said.clamp(min=MIN_DEVIATION))
    return Reliability(said, found, float(octaves.square().mean().sqrt()))


def worst_mean(values: list[float]) -> float:
    """Return the mean of the smallest tenth of values, of at least one."""
    count = max(1, round(WORST_SHARE * len(values)))
    return sum(sorted(values)[:count]) / count
