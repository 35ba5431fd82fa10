"""Losses of the paper's networks, and its proxy. Source: Dave et al. 2022, Eqs. 19 to 21.

Conventions: images ``[N, C, h, w]``; norms are means over pixels and colours; gradients are forward differences.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: Weights of the gradient terms of Eqs. 19 and 21.
DIFFUSE_GRADIENT, SPECULAR_GRADIENT = 5.0, 50.0
#: Weight of SpecUNet's squared error against DiffUNet's; of no account to networks that share nothing.
SQUARED_SPECULAR = 10.0


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


def squared_loss(found: tuple[Tensor, Tensor], truth: tuple[Tensor, Tensor]) -> Tensor:
    """Mean squared errors of both networks' images, tau_d and log(1 + tau_s), for the first part of a training.

    Note: not in the paper. Specular light is sparse, so the losses of Eqs. 19 and 21, whose best constant is the
    median, hold a network that starts without a first guess at no specular light at all, for 6000 steps and more.
    """
    diffuse, specular = truth
    return (found[0] - diffuse).square().mean() + SQUARED_SPECULAR * (found[1] - torch.log1p(specular)).square().mean()


def specular_loss(logarithm: Tensor, truth: tuple[Tensor, Tensor]) -> Tensor:
    """L^s of Eq. 21: what SpecUNet minimizes, for the true diffuse and specular images, neither of them clipped.

    tau_mix is the sum of both (Eq. 10). Note: the text calls it "the input unseparated image", which is the same where
    nothing clips; clipped, it would be less than the light that tau_s is to explain.
    """
    diffuse, specular = truth
    goal = torch.log1p(specular)
    own = (logarithm - goal).abs().mean() + SPECULAR_GRADIENT * gradient_loss(logarithm, goal)
    return own + diffuse_loss(proxy_diffuse(logarithm, diffuse + specular), diffuse)
