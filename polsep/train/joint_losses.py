"""What the joint network minimizes.

The score that counts is the mean PSNR over scenes, so that is what is minimized: the logarithm of each crop's mean
squared error, limited to the white level as the score is, at half and at full resolution. Beside it stand the same of
light on a logarithmic scale, which goes on beyond white, the samples that the images explain against those that did not
clip, and the likelihood of the errors under the variances that the network itself predicts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from polsep.networks.joint import JointOutput, Polarization, predict_samples
from polsep.train.joint_views import JointSeen, find_clipped
from polsep.train.losses import diffuse_loss

#: Mean squared error below which a crop counts as done: 60 dB, which crops with hardly any specular light reach.
MIN_ERROR = 1e-6
#: Weight of pixels off the object, against 1 on it.
BACKGROUND = 0.05
#: Weights, against dB at half resolution, of dB at full resolution, of dB of log(1 + light) and of the samples' misfit.
FULL_WEIGHT, BEYOND_WEIGHT, DATA_WEIGHT = 0.5, 0.3, 1.0
#: Misfit of a sample, in white levels, that counts as large: twice the noise of a bright one.
DATA_SCALE = 0.02
#: Squared error, in variances expected of it, from which on the likelihood grows as a logarithm.
SURPRISE = 50.0
#: The sum, in dB, times this gives gradients of about the size of the other networks' (`loop.MAX_GRADIENT`).
LOSS_SCALE = 0.1

#: How far images are from the truth ``[B, C, h, w]``, under weights ``[B, 1, h, w]``.
Difference = Callable[[Tensor, Tensor, Tensor], Tensor]


def mean_decibels(found: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Minus the mean PSNR over crops, limited to white and by `MIN_ERROR`."""
    return _mean_logarithm((found.clamp(max=1) - truth.clamp(max=1)) ** 2, weight)


def _mean_logarithm(squared: Tensor, weight: Tensor) -> Tensor:
    """Of the mean of each crop, in dB."""
    mean = (squared * weight).mean(dim=(1, 2, 3)) / weight.mean(dim=(1, 2, 3))
    return 10 / math.log(10) * torch.log(mean + MIN_ERROR).mean()


def paper_difference(found: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Mean absolute error and five times that of the gradient, in percent of white (Dave et al. 2022, Eq. 19)."""
    del weight
    return 100 * diffuse_loss(found, truth)


@dataclass(frozen=True)
class Goal:
    """How images are compared with the truth, and the weight of the samples' misfit."""

    difference: Difference = mean_decibels
    data: float = DATA_WEIGHT


def joint_loss(found: tuple[JointOutput, Polarization], seen: JointSeen, goal: Goal) -> Tensor:
    """The loss of the module's text; ``found`` at full resolution."""
    images, polarization = found
    weight = seen.weight * (1 - BACKGROUND) + BACKGROUND
    half_weight = avg_pool2d(weight, 2)
    diffuse, specular = avg_pool2d(images.diffuse, 2), avg_pool2d(images.specular, 2)
    differ = goal.difference
    half = differ(diffuse, seen.diffuse, half_weight) + differ(specular, seen.specular, half_weight)
    full = differ(images.diffuse, seen.full_diffuse, weight) + differ(images.specular, seen.full_specular, weight)
    beyond = beyond_white(diffuse, seen.diffuse, half_weight) + beyond_white(specular, seen.specular, half_weight)
    # Also when it weighs nothing: the budget stays the same, and every parameter has a gradient.
    loss = half + FULL_WEIGHT * full + BEYOND_WEIGHT * beyond + goal.data * sample_misfit(images, polarization, seen)
    errors = (diffuse - seen.diffuse, specular - seen.specular)
    return LOSS_SCALE * (loss + variance_loss(images, errors, half_weight))


def beyond_white(found: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """`mean_decibels` of log(1 + light), not limited: where the score is blind, highlights that clip are recovered."""
    squared = (torch.log1p(found.clamp(min=0)) - torch.log1p(truth)) ** 2
    return _mean_logarithm(squared, weight)


def sample_misfit(images: JointOutput, polarization: Polarization, seen: JointSeen) -> Tensor:
    """How far the samples that images explain lie from those that did not clip: a mean of Huber's over `DATA_SCALE`."""
    misfit = (predict_samples(images, polarization, seen.layout) - seen.raw) / DATA_SCALE
    size = misfit.abs()
    robust = torch.where(size < 1, 0.5 * misfit**2, size - 0.5)
    kept = ~find_clipped(seen.raw)
    return (robust * kept).sum() / kept.sum().clamp(min=1)


def variance_loss(images: JointOutput, errors: tuple[Tensor, Tensor], weight: Tensor) -> Tensor:
    """Minus the Gaussian log likelihood of the errors, relative to the light around; moves nothing but the doubt."""
    light = interpolate(images.local_brightness, scale_factor=2.0)
    squared = [(error.detach() ** 2).mean(dim=1, keepdim=True) / light**2 for error in errors]
    # The logarithm of the squared error in variances; beyond `SURPRISE` it counts itself, so that one pixel cannot
    # outweigh a batch: it once did, by a factor of 1e13.
    excess = torch.log(torch.cat(squared, dim=1) + 1e-7) - images.log_variance - math.log(SURPRISE)
    surprise = SURPRISE * (torch.exp(excess.clamp(max=0)) + excess.clamp(min=0))
    return (0.5 * (images.log_variance + surprise) * weight).mean()
