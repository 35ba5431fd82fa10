"""The loss of the joint network.

Its main term is the score itself, minus the mean PSNR over crops: the logarithm of each crop's mean squared error,
limited to white as in the score, at half and at full resolution. The other terms are the same error of log(1 + light),
which is not limited to white; the residual of the samples that did not clip, given the images; and the negative log
likelihood of the errors under the variances that the network predicts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from polsep.networks.joint import JointOutput, Polarization, predict_samples
from polsep.train.inputs import JointInputs
from polsep.train.losses import diffuse_loss

#: Added to mean squared errors: limits PSNR to 60 dB, which crops with hardly any specular light reach.
MIN_ERROR = 1e-6
#: Weight of pixels off the object, against 1 on it.
BACKGROUND = 0.05
#: Weights, against dB at half resolution, of dB at full resolution, of dB of log(1 + light) and of the samples'
#: residual.
FULL_WEIGHT, BEYOND_WEIGHT, DATA_WEIGHT = 0.5, 0.3, 1.0
#: Residual of a sample, in white levels, from which on Huber's loss is linear: twice the noise of a bright sample.
DATA_SCALE = 0.02
#: Squared error, in predicted variances, from which on the negative log likelihood grows as its logarithm.
SURPRISE = 50.0
#: Weight of the negative log likelihood of what is common to a frame, and the range of its log variances.
LIGHT_WEIGHT, LIGHT_LOG_VARIANCES = 0.2, (-10.0, 4.0)
#: Scales the sum, in dB, to gradients of about the size of the other networks' (`loop.MAX_GRADIENT`).
LOSS_SCALE = 0.1

#: Error of images from the truth ``[B, C, h, w]``, with weights ``[B, 1, h, w]``.
Difference = Callable[[Tensor, Tensor, Tensor], Tensor]


def mean_decibels(estimate: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return minus the mean PSNR over crops, limited to white and by `MIN_ERROR`."""
    return _mean_logarithm((estimate.clamp(max=1) - truth.clamp(max=1)) ** 2, weight)


def _mean_logarithm(squared: Tensor, weight: Tensor) -> Tensor:
    """Mean over crops of the logarithm of the weighted mean of each, in dB."""
    mean = (squared * weight).mean(dim=(1, 2, 3)) / weight.mean(dim=(1, 2, 3))
    return 10 / math.log(10) * torch.log(mean + MIN_ERROR).mean()


def paper_difference(estimate: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return L^d of Dave et al. 2022, Eq. 19, in percent of white; ``weight`` is ignored."""
    del weight
    return 100 * diffuse_loss(estimate, truth)


@dataclass(frozen=True)
class Goal:
    """The ``difference`` between images and truth, and the weight of the samples' residual (``data``)."""

    difference: Difference = mean_decibels
    data: float = DATA_WEIGHT


def joint_loss(output: tuple[JointOutput, Polarization], inputs: JointInputs, goal: Goal) -> Tensor:
    """Return the loss described above, for the network's output at full resolution."""
    images, polarization = output
    weight = inputs.weight * (1 - BACKGROUND) + BACKGROUND
    half_weight = avg_pool2d(weight, 2)
    diffuse, specular = avg_pool2d(images.diffuse, 2), avg_pool2d(images.specular, 2)
    differ = goal.difference
    half = differ(diffuse, inputs.diffuse, half_weight) + differ(specular, inputs.specular, half_weight)
    full = differ(images.diffuse, inputs.full_diffuse, weight) + differ(images.specular, inputs.full_specular, weight)
    beyond = beyond_white(diffuse, inputs.diffuse, half_weight) + beyond_white(specular, inputs.specular, half_weight)
    # Computed even with weight 0: ablations then cost the same, and every parameter has a gradient.
    loss = (
        half + FULL_WEIGHT * full + BEYOND_WEIGHT * beyond + goal.data * sample_residual(images, polarization, inputs)
    )
    errors = (diffuse - inputs.diffuse, specular - inputs.specular)
    loss = loss + variance_loss(images, errors, half_weight)
    if images.light.shape[1]:
        loss = loss + LIGHT_WEIGHT * light_loss(images.light.float(), inputs.light)
    return LOSS_SCALE * loss


def light_loss(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the negative Gaussian log likelihood of `whole_frame.LIGHT`, ``truth [B, 4]``, under ``[B, 8]``."""
    mean, log_variance = predicted.chunk(2, dim=1)
    log_variance = log_variance.clamp(*LIGHT_LOG_VARIANCES)
    return (0.5 * (log_variance + (truth - mean) ** 2 * torch.exp(-log_variance))).sum(dim=1).mean()


def beyond_white(estimate: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return `mean_decibels` of log(1 + light), not limited: it covers clipped highlights, which the score ignores."""
    squared = (torch.log1p(estimate.clamp(min=0)) - torch.log1p(truth)) ** 2
    return _mean_logarithm(squared, weight)


def sample_residual(images: JointOutput, polarization: Polarization, inputs: JointInputs) -> Tensor:
    """Return the mean Huber loss, in units of `DATA_SCALE`, of the samples that did not clip, given the images."""
    residual = (predict_samples(images, polarization, inputs.layout) - inputs.raw) / DATA_SCALE
    size = residual.abs()
    robust = torch.where(size < 1, 0.5 * residual**2, size - 0.5)
    kept = ~inputs.clipped
    return (robust * kept).sum() / kept.sum().clamp(min=1)


def variance_loss(images: JointOutput, errors: tuple[Tensor, Tensor], weight: Tensor) -> Tensor:
    """Return the negative Gaussian log likelihood of the errors, relative to the local brightness.

    Its gradient reaches ``images.log_variance`` alone.
    """
    light = interpolate(images.local_brightness, scale_factor=2.0)
    squared = [(error.detach() ** 2).mean(dim=1, keepdim=True) / light**2 for error in errors]
    # Logarithm of the squared error in variances. Beyond `SURPRISE` the loss is linear in it, so that one pixel cannot
    # outweigh a batch: one did, by a factor of 1e13.
    excess = torch.log(torch.cat(squared, dim=1) + 1e-7) - images.log_variance - math.log(SURPRISE)
    surprise = SURPRISE * (torch.exp(excess.clamp(max=0)) + excess.clamp(min=0))
    return (0.5 * (images.log_variance + surprise) * weight).mean()
