"""How far an image is from the truth.

PSNR: linear light, peak 1 = the white level of one measurement, both images limited to [0, 1], inside the object mask;
120 dB at most.
"""

from __future__ import annotations

import math

from torch import Tensor


def psnr(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """PSNR in dB of images ``[C, h, w]`` inside ``mask [h, w]``, as the module says; at most 120."""
    error = ((found.clamp(0, 1) - truth.clamp(0, 1)) ** 2).mean(dim=0)[mask].mean()
    return min(120.0, -10 * math.log10(max(float(error), 1e-30)))
