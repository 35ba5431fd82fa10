"""Layers of few values: numbers that are rounded later make up for the errors of those before them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from polsep.train.rounding import round_layers, round_rows


def loss(change: Tensor, covariance: Tensor) -> float:
    """What a change of rows loses in their outputs."""
    return float(((change @ covariance) * change).sum())


def plainly_rounded(rows: Tensor, count: int) -> Tensor:
    step = rows.abs().amax(dim=1, keepdim=True) / count
    return (rows / step).round() * step


def test_rows_take_few_values_and_keep_their_outputs() -> None:
    """Of what varies together, less than half of what plain rounding loses; of independent inputs, exactly that."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn(16, 72, generator=generator).double()
    mixed = torch.randn(400, 12, generator=generator) @ torch.randn(12, 72, generator=generator)
    seen = (mixed + 0.3 * torch.randn(400, 72, generator=generator)).double()
    covariance = seen.T @ seen / len(seen)
    for count in (3, 7):
        found = round_rows(rows, covariance, count)
        step = rows.abs().amax(dim=1, keepdim=True) / count
        torch.testing.assert_close(found / step, (found / step).round(), rtol=0, atol=1e-9)
        assert float((found / step).abs().max()) <= count + 1e-9
        plain = loss(plainly_rounded(rows, count) - rows, covariance)
        assert loss(found - rows, covariance) < 0.5 * plain
        alone = round_rows(rows, torch.eye(72).double(), count)
        torch.testing.assert_close(alone, plainly_rounded(rows, count), rtol=0, atol=1e-12)


def test_layers_behind_rounded_ones_make_up_for_them() -> None:
    """A network of two rounded convolutions stays nearer to itself than one that is rounded plainly; means stay."""
    torch.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(6, 24, 3, padding=1), nn.ReLU(), nn.Conv2d(24, 6, 3, stride=2, padding=1))
    coarse = [nn.functional.interpolate(torch.randn(4, 6, 6, 6), scale_factor=4, mode="bilinear") for _ in range(3)]
    with torch.no_grad():
        before = [network(batch) for batch in coarse]
        kept = {name: value.clone() for name, value in network.state_dict().items()}
        for layer in (network[0], network[2]):
            layer.weight.copy_(plainly_rounded(layer.weight.flatten(1), 3).view_as(layer.weight))
        plain = [network(batch) - was for batch, was in zip(coarse, before, strict=True)]
        network.load_state_dict(kept)
        round_layers(network, {"0": 3, "2": 3}, coarse)
        found = [network(batch) - was for batch, was in zip(coarse, before, strict=True)]
    assert all(len(row.unique()) <= 7 for layer in (network[0], network[2]) for row in layer.weight.flatten(1))
    assert torch.stack(found).square().mean() < 0.25 * torch.stack(plain).square().mean()
    assert torch.stack(found).mean(dim=(0, 1, 3, 4)).abs().max() < 0.01
