"""Optimizers: Muon for the convolutions inside networks, AdamW for all other weights.

Muon (Jordan et al. 2024, kellerjordan.github.io/posts/muon) replaces the momentum of a layer's matrix by the nearest
orthogonal matrix, so that all directions of a layer learn at one pace, also those with rare gradients. The joint
network needs a third of the steps of AdamW (docs/experiments.md). Steps have the root mean square of AdamW's (Liu et
al. 2025, arXiv 2502.16982, Sec. 2.2), so that both share one learning rate. Closed forms, output layers and biases do
not map features to features; AdamW optimizes them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from polsep.material.network import MaterialNetwork
from polsep.networks.unet import ResidualUNet, UNet

WEIGHT_DECAY, BETAS = 1e-4, (0.9, 0.99)
#: Smallest side of a matrix for Muon; on smaller ones AdamW does as well.
MIN_SIDE = 16


class Optimizers:
    """Both optimizers, for the trainable weights of a ``network`` that is on its device already.

    State: that of both. Muon accepts matrices only, so it has twins of the convolutions that share their memory.
    """

    def __init__(self, network: nn.Module) -> None:
        hidden = [weight for weight in hidden_weights(network) if weight.requires_grad]
        taken = {id(weight) for weight in hidden}
        rest = [weight for weight in network.parameters() if weight.requires_grad and id(weight) not in taken]
        self._adam = torch.optim.AdamW(rest, lr=0.0, betas=BETAS, weight_decay=WEIGHT_DECAY)
        self._twins = [(weight, nn.Parameter(as_matrix(weight.detach()))) for weight in hidden]
        matrices = [twin for _, twin in self._twins]
        self._muon = None
        if matrices:
            self._muon = torch.optim.Muon(matrices, lr=0.0, weight_decay=WEIGHT_DECAY, adjust_lr_fn="match_rms_adamw")

    def step(self, rate: float) -> None:
        """Update all weights at a learning ``rate`` and clear their gradients."""
        for optimizer in self._both():
            for group in optimizer.param_groups:
                group["lr"] = rate
        for weight, twin in self._twins:
            twin.grad = None if weight.grad is None else as_matrix(weight.grad, like=weight)
            weight.grad = None
        for optimizer in self._both():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)

    def state_dict(self) -> list[dict[str, Any]]:
        """Return the state of both optimizers for a checkpoint."""
        return [optimizer.state_dict() for optimizer in self._both()]

    def load_state_dict(self, states: list[dict[str, Any]]) -> None:
        """The twin of `state_dict`."""
        for optimizer, state in zip(self._both(), states, strict=True):
            optimizer.load_state_dict(state)

    def _both(self) -> list[torch.optim.Optimizer]:
        return [self._adam] if self._muon is None else [self._adam, self._muon]


def hidden_weights(network: nn.Module) -> Iterator[Tensor]:
    """Yield the convolutions of a network that map features to features."""
    for module in network.modules():
        if isinstance(module, (UNet, ResidualUNet, MaterialNetwork)):
            last = set() if isinstance(module, ResidualUNet) else {id(weight) for weight in module.last.parameters()}
            for weight in module.parameters():
                if weight.ndim == 4 and id(weight) not in last and min(as_matrix(weight).shape) >= MIN_SIDE:
                    yield weight


def as_matrix(weight: Tensor, like: Tensor | None = None) -> Tensor:
    """Return weights ``[n, m, k, k]`` as a matrix ``[n, m k k]`` whose columns have the order of ``like`` in memory.

    A view, if both have the same memory layout.
    """
    last = not (weight if like is None else like).is_contiguous()
    return (weight.permute(0, 2, 3, 1) if last else weight).reshape(weight.shape[0], -1)
