"""Networks as functions: sizes, borders, batches, gradients, and that they can learn a picture by heart."""

from __future__ import annotations

import pytest
import torch
from tolerances import assert_close, assert_finite

from polsep.networks.sizes import Size
from polsep.networks.unet import UNet, count_parameters, limit_above, pad_to_multiple

SIZES = [Size(4, 2, 1), Size(4, 1, 2)]


def random_net(size: Size = SIZES[0]) -> UNet:
    """A net of 3 channels in and 2 out whose last layer is not zero, as after training."""
    torch.manual_seed(0)
    net = UNet(3, 2, size)
    torch.nn.init.normal_(net.last.weight, std=0.3)
    return net.eval()


def test_classic_unet_has_the_size_of_ronneberger() -> None:
    """31.0 million parameters, as the architecture of Fig. 1 in Ronneberger et al. 2015 has with one input channel."""
    assert 31.0e6 < count_parameters(UNet(1, 2)) < 31.1e6


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("shape", [(16, 16), (13, 18), (5, 7), (3, 3)])
def test_any_size_goes_in_and_out(size: Size, shape: tuple[int, int]) -> None:
    assert random_net(size)(torch.rand(1, 3, *shape)).shape == (1, 2, *shape)


def test_starts_at_zero() -> None:
    assert not bool(UNet(3, 2, SIZES[0])(torch.rand(1, 3, 8, 8)).any())


def test_sizes_below_one_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        Size(0, 1, 1)


def test_padding_mirrors_and_repeats() -> None:
    row = torch.arange(5.0).view(1, 1, 1, 5).expand(1, 1, 4, 5)
    assert pad_to_multiple(row, 4)[0, 0, 0].tolist() == [0, 1, 2, 3, 4, 3, 2, 1]
    assert pad_to_multiple(torch.ones(1, 1, 1, 1), 4).shape == (1, 1, 4, 4)


@pytest.mark.parametrize("size", SIZES)
def test_images_of_a_batch_are_independent(size: Size) -> None:
    net, x = random_net(size), torch.rand(3, 3, 16, 16)
    assert_close(net(x)[1:2], net(x[1:2]))


@pytest.mark.parametrize("size", SIZES)
def test_crop_and_frame_agree_away_from_the_border(size: Size) -> None:
    """No statistics of the image: beyond the reach of a level's convolutions a crop gives what the frame gives."""
    net, x = random_net(size), torch.rand(1, 3, 96, 96)
    reach = 32
    crop = net(x[..., 16:96, 16:96])[..., reach:-reach, reach:-reach]
    assert_close(crop, net(x)[..., 16 + reach : 96 - reach, 16 + reach : 96 - reach])


def test_gradients_are_finite_and_reach_every_layer() -> None:
    net = random_net()
    net(torch.rand(2, 3, 16, 16)).square().mean().backward()
    gradients = [p.grad for p in net.parameters()]
    assert all(g is not None for g in gradients)
    assert_finite(*(g for g in gradients if g is not None))
    assert all(float(g.abs().max()) > 0 for g in gradients if g is not None and g.ndim == 4)


def test_values_above_a_limit_can_be_lowered_but_not_raised() -> None:
    """An output above its limit follows a loss that is lower below it, and no other; values are the lesser of both."""
    values, largest = torch.tensor([-1.0, 3.0, 3.0]).requires_grad_(), torch.tensor(2.0)
    limited = limit_above(values, largest)
    assert torch.equal(limited.detach(), torch.minimum(values.detach(), largest))
    (limited * torch.tensor([-1.0, 1.0, -1.0])).sum().backward()
    assert values.grad is not None
    assert torch.equal(values.grad, torch.tensor([-1.0, 1.0, 0.0]))
