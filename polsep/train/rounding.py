"""Layers rounded to few values so that their outputs stay: each number makes up for the errors of those before it.

Of one output y = w x of a layer, rounding w to q loses the mean of ((w - q) x)^2 = (w - q) C (w - q), where C is the
covariance of what the layer sees; the bias takes its mean. One number of w after the other is rounded, and the
error is spread over those that are not rounded yet, by the inverse of their part of C. Sources: Hassibi and Stork
1993 (optimal brain surgeon); Frantar et al. 2023 (GPTQ, arXiv:2210.17323), from where the order by Cholesky factors is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import unfold

#: Added to variances of what a layer sees, relative to their mean.
DAMPING = 0.01
#: Most places of a batch at which one looks at what a layer sees.
PLACES = 6000


def round_layers(network: nn.Module, counts: Mapping[str, int], inputs: Sequence[Tensor]) -> None:
    """Round convolutions of a network in place, in the order in which it uses them, each behind the rounded ones.

    ``counts``: values on each side of 0 by the names of layers; ``inputs``: batches that the network takes.
    """
    layers = {name: layer for name, layer in network.named_modules() if name in counts}
    order: list[str] = []
    hooks = [
        layer.register_forward_pre_hook(lambda _layer, _inputs, name=name: order.append(name))
        for name, layer in layers.items()
    ]
    with torch.no_grad():
        network(inputs[0])
        for hook in hooks:
            hook.remove()
        for name in order:
            layer = layers[name]
            assert isinstance(layer, nn.Conv2d) and layer.bias is not None
            mean, covariance = _moments(network, layer, inputs)
            before = layer.weight.flatten(1).double()
            after = round_rows(before, covariance, counts[name])
            layer.bias += ((before - after) @ mean).float()
            layer.weight.copy_(after.view_as(layer.weight))


def round_rows(rows: Tensor, covariance: Tensor, count: int) -> Tensor:
    """Return rows ``[outputs, n]`` with ``count`` values on each side of 0, evenly spaced up to each row's largest one.

    ``covariance [n, n]`` of what they are multiplied with; where that varies most, they are rounded first.
    """
    variance = covariance.diagonal()
    order = torch.argsort(variance, descending=True, stable=True)
    damped = covariance + torch.diag(torch.full_like(variance, max(DAMPING * float(variance.mean()), 1e-30)))
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(damped[order][:, order]))
    factor = torch.linalg.cholesky(inverse, upper=True)
    step = rows.abs().amax(dim=1).clamp(min=1e-12) / count
    left, rounded = rows[:, order].clone(), torch.empty_like(rows)
    for k in range(rows.shape[1]):
        rounded[:, k] = (left[:, k] / step).round().clamp(-count, count) * step
        error = (left[:, k] - rounded[:, k]) / factor[k, k]
        left[:, k + 1 :] -= torch.outer(error, factor[k, k + 1 :])
    found = torch.empty_like(rows)
    found[:, order] = rounded
    return found


def _moments(network: nn.Module, layer: nn.Conv2d, inputs: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Mean ``[n]`` and covariance ``[n, n]`` of what a layer's outputs are sums over, at random places."""
    generator, kept = torch.Generator().manual_seed(0), list[Tensor]()

    def see(_layer: nn.Module, seen: tuple[Tensor, ...]) -> None:
        kept.append(seen[0])

    hook = layer.register_forward_pre_hook(see)
    size = layer.weight[0].numel()
    total, squares, count = torch.zeros(size).double(), torch.zeros(size, size).double(), 0
    for batch in inputs:
        network(batch)
        sides = {"stride": layer.stride, "padding": layer.padding, "dilation": layer.dilation}
        places = unfold(kept.pop(), layer.kernel_size, **sides).movedim(1, -1).reshape(-1, size)  # type: ignore[arg-type]
        if len(places) > PLACES:
            places = places[torch.randint(len(places), (PLACES,), generator=generator)]
        total += places.sum(dim=0).double()
        squares += (places.T @ places).double()
        count += len(places)
    hook.remove()
    mean = total / count
    return mean, squares / count - torch.outer(mean, mean)
