"""Losses of the paper's networks, and its proxy. Source: Dave et al. 2022, Eqs. 19 to 21.

Conventions: images ``[N, C, h, w]``; norms are means over pixels and colours; gradients are forward differences.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Weights of the gradient terms of Eqs. 19 and 21.
DIFFUSE_GRADIENT, SPECULAR_GRADIENT = 5.0, 50.0
#: Makes gradients of the squared error about as large as those of Eq. 21.
FIRST_WEIGHT = 100.0


def gradient_loss(found: Tensor, truth: Tensor) -> Tensor:
    """Mean absolute difference of the gradients: both directions added, each a mean over its own pixels."""
    error = found - truth
    across, down = error[..., 1:] - error[..., :-1], error[..., 1:, :] - error[..., :-1, :]
    return across.abs().mean() + down.abs().mean()


def diffuse_loss(found: Tensor, diffuse: Tensor) -> Tensor:
    """L^d of Eq. 19: what DiffUNet minimizes."""
    return (found - diffuse).abs().mean() + DIFFUSE_GRADIENT * gradient_loss(found, diffuse)


def proxy_diffuse(logarithm: Tensor, mixed: Tensor) -> Tensor:
    """The diffuse image that SpecUNet's log(1 + tau_s) leaves of the unseparated image ``mixed`` (Eq. 20)."""
    return mixed - torch.expm1(logarithm)


def first_specular_loss(logarithm: Tensor, specular: Tensor) -> Tensor:
    """Mean squared error of log(1 + tau_s), for the first part of a training that has no first guess of tau_s.

    Note: not in the paper. Specular light is sparse, so Eq. 21, whose best constant is the median, holds such a network
    at no specular light at all, for 6000 steps and more.
    """
    return FIRST_WEIGHT * (logarithm - torch.log1p(specular)).square().mean()


def specular_loss(logarithm: Tensor, truth: tuple[Tensor, Tensor]) -> Tensor:
    """L^s of Eq. 21: what SpecUNet minimizes, for the true diffuse and specular images, neither of them clipped.

    tau_mix is the sum of both (Eq. 10). Note: the text calls it "the input unseparated image", which is the same where
    nothing clips; clipped, it would be less than the light that tau_s is to explain.
    """
    diffuse, specular = truth
    goal = torch.log1p(specular)
    own = (logarithm - goal).abs().mean() + SPECULAR_GRADIENT * gradient_loss(logarithm, goal)
    return own + diffuse_loss(proxy_diffuse(logarithm, diffuse + specular), diffuse)
