"""The lamp's degree of polarization, from what its mirror images leave in the diffuse image.

Methods take mirror images of the lamp for fully polarized. Behind an imperfect polarizer of degree p they find p of
them; (1 - p) / p of the specular image is left in the diffuse image, in white. In a place, the diffuse image less the
body's colour is regressed on the specular image. The median of the places counts where it is clear: more than its
standard error, and along white rather than beside it, where wrong colours of the lamp lead. Grey bodies show
nothing, nor do bodies of one hue: there a wrong colour of the lamp may look white.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

#: Side of a place in pixels at half resolution, and fewest places.
SIDE, MIN_PLACES = 8, 12
#: Least variance of the specular image in a place [white^2], and least squared share of white beside the body's colour.
MIN_VARIANCE, MIN_WHITE = 5e-4, 0.15
#: Least deviation of the places' colours, as unit vectors: skin has 0.01, bodies of two hues 0.06.
MIN_HUES = 0.03
#: Largest sample of a place: s0 of light along an analyser, half of it across.
MAX_SAMPLE = 0.9
#: Range of parts that are believed, the least one in standard errors of the median too, and the largest slope beside
#: white over it. Chosen on 16 validation stages of `datasets.reality` in 15 conditions (docs/experiments.md).
MIN_PART, MAX_PART, ERRORS, MAX_BESIDE = 0.04, 0.5, 3.0, 0.5
#: Standard error of a median over the median deviation, times the root of the count, for normal errors.
MEDIAN_ERROR = 1.4826 * 1.25


def find_unpolarized(diffuse: Tensor, specular: Tensor) -> float:
    """The part of the specular image that is left in the diffuse one, (1 - p) / p; 0 where none is proven.

    ``diffuse [3, h, w]``, ``specular [1, h, w]``: a method's images at half resolution, in white light.
    """
    if min(diffuse.shape[-2:]) < SIDE:
        return 0.0
    products = torch.cat([diffuse, specular, specular * specular, specular * diffuse])
    means = avg_pool2d(products[None], SIDE)[0].flatten(1)
    largest = max_pool2d((specular + diffuse.amax(dim=0, keepdim=True) / 2)[None], SIDE).flatten()
    color, light = means[:3], means[3]
    variance, covariance = means[4] - light**2, means[5:] - light * color
    body = color / color.norm(dim=0).clamp(min=1e-9)
    white = 1 - body * body.sum(dim=0)
    power = (white**2).sum(dim=0)
    shown = (variance > MIN_VARIANCE) & (power > MIN_WHITE) & (largest < MAX_SAMPLE)
    body, white, power, covariance = (x[..., shown] for x in (body, white, power, covariance))
    if len(power) < MIN_PLACES or not has_hues(body):
        return 0.0
    slopes = covariance / variance[shown]
    along = (slopes * white).sum(dim=0) / power
    beside = (slopes * torch.linalg.cross(body, white, dim=0)).sum(dim=0) / power
    part = float(along.median())
    error = MEDIAN_ERROR * float((along - part).abs().median()) / len(power) ** 0.5
    proven = max(MIN_PART, ERRORS * error) < part < MAX_PART and abs(float(beside.median())) < MAX_BESIDE * part
    return part if proven else 0.0


def has_hues(body: Tensor) -> bool:
    """True if colours ``[3, N]`` of two places or more, as unit vectors, are of several hues or saturations."""
    return float(body.std(dim=1).norm()) >= MIN_HUES
