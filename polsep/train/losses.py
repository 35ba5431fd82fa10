"""Losses of the paper's networks, and its proxy. Source: Dave et al. 2022, Eqs. 19 to 21.

Conventions: images ``[N, C, h, w]``; norms are means over pixels and colours; gradients are forward differences.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Weights of the gradient terms of Eqs. 19 and 21.
DIFFUSE_GRADIENT, SPECULAR_GRADIENT = 5.0, 50.0
#: Scales the gradients of the squared error to about the size of those of Eq. 21.
FIRST_WEIGHT = 100.0


def gradient_loss(estimate: Tensor, truth: Tensor) -> Tensor:
    """Return the mean absolute difference of gradients, summed over both directions."""
    error = estimate - truth
    across, down = error[..., 1:] - error[..., :-1], error[..., 1:, :] - error[..., :-1, :]
    return across.abs().mean() + down.abs().mean()


def diffuse_loss(estimate: Tensor, diffuse: Tensor) -> Tensor:
    """Return L^d of Eq. 19, the loss of DiffUNet."""
    return (estimate - diffuse).abs().mean() + DIFFUSE_GRADIENT * gradient_loss(estimate, diffuse)


def proxy_diffuse(logarithm: Tensor, mixed: Tensor) -> Tensor:
    """Return the unseparated image ``mixed`` without the specular light of SpecUNet's log(1 + tau_s) (Eq. 20)."""
    return mixed - torch.expm1(logarithm)


def first_specular_loss(logarithm: Tensor, specular: Tensor) -> Tensor:
    """Return the mean squared error of log(1 + tau_s), for the start of a training without a closed form of tau_s.

    Note: not in the paper. Specular light is sparse. The best constant of Eq. 21 is the median, so Eq. 21 holds such a
    network at no specular light at all, for 6000 steps and more.
    """
    return FIRST_WEIGHT * (logarithm - torch.log1p(specular)).square().mean()


def specular_loss(logarithm: Tensor, diffuse: Tensor, specular: Tensor) -> Tensor:
    """Return L^s of Eq. 21, the loss of SpecUNet, for the true diffuse and specular images, neither of them clipped.

    tau_mix is the sum of both (Eq. 10). Note: the text calls it "the input unseparated image", which is the same where
    nothing clips; clipped, it would be less than the light that tau_s is to explain.
    """
    goal = torch.log1p(specular)
    own = (logarithm - goal).abs().mean() + SPECULAR_GRADIENT * gradient_loss(logarithm, goal)
    return own + diffuse_loss(proxy_diffuse(logarithm, diffuse + specular), diffuse)
