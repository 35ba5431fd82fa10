"""Which weights which optimizer moves, and that Muon's steps are orthogonal and of AdamW's size."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from polsep.material.network import MaterialNetwork, MaterialSize
from polsep.networks.joint import Joint
from polsep.networks.paper import Refinement
from polsep.networks.rungs import RUNGS
from polsep.networks.sizes import ResidualSize, Size
from polsep.networks.unet import ResidualUNet, UNet
from polsep.train.optimizers import WEIGHT_DECAY, Optimizers, as_matrix, hidden_weights

RATE = 1e-3
NETWORKS = {
    "joint": lambda: Joint(3, ResidualSize(16, (0, 1, 1), 16), demosaicker="linear"),
    "paper": lambda: Refinement(RUNGS["paper"], 3, Size(16, 2)),
}


def seeded(name: str) -> nn.Module:
    torch.manual_seed(3)
    return NETWORKS[name]().to(memory_format=torch.channels_last)


def drive(network: nn.Module) -> None:
    """Gradients of noise for all weights."""
    for weight in network.parameters():
        weight.grad = torch.randn_like(weight)


@pytest.mark.parametrize("name", NETWORKS)
def test_a_step_moves_every_weight_and_forgets_its_gradient(name: str) -> None:
    network = seeded(name)
    before = [weight.detach().clone() for weight in network.parameters()]
    optimizers = Optimizers(network)
    drive(network)
    optimizers.step(RATE)
    for weight, old in zip(network.parameters(), before, strict=True):
        assert weight.grad is None
        assert not torch.equal(weight, old)


def test_steps_of_convolutions_are_orthogonal_and_of_adams_size() -> None:
    """Singular values of a step lie between 0.65 and 1.3 times 0.2 sqrt(longer side), which is what five of its
    iterations leave, so its root mean square is about 0.2 of the rate."""
    network = seeded("joint")
    hidden = list(hidden_weights(network))
    before = [as_matrix(weight.detach()).clone() for weight in hidden]
    optimizers = Optimizers(network)
    drive(network)
    optimizers.step(RATE)
    for weight, old in zip(hidden, before, strict=True):
        step = (as_matrix(weight.detach()) - (1 - RATE * WEIGHT_DECAY) * old) / RATE
        size = torch.linalg.svdvals(step) / (0.2 * max(step.shape) ** 0.5)
        assert 0.6 < float(size.min()) <= float(size.max()) < 1.35


def test_features_alone_are_hidden() -> None:
    """First and inner convolutions of the networks; no biases, no heads, no linear first guess."""
    net, paper = seeded("joint"), seeded("paper")
    assert isinstance(net, Joint)
    names = {id(w): n for n, w in (*net.named_parameters(), *paper.named_parameters())}
    hidden = [names[id(w)] for network in (net, paper) for w in hidden_weights(network)]
    assert len(set(hidden)) == len(hidden)
    assert all(name.startswith(("net.", "nets.")) and name.endswith("weight") for name in hidden)
    assert not any(".last." in name for name in hidden)
    material = MaterialNetwork(6, MaterialSize(cues=("details",)))
    names = {id(w): n for n, w in material.named_parameters()}
    found = {names[id(w)] for w in hidden_weights(material)}
    assert found == {n for n, w in material.named_parameters() if w.ndim == 4 and n != "last.weight" and len(w) >= 16}
    inner = [m for m in net.net.modules() if isinstance(m, nn.Conv2d)]
    assert len([name for name in hidden if name.startswith("net.")]) == len(inner)


def test_small_matrices_are_adams() -> None:
    assert not list(hidden_weights(ResidualUNet(3, ResidualSize(4, (0, 1)))))
    drive(network := UNet(2, 1, Size(4, 1, 1)))
    Optimizers(network).step(RATE)
    assert all(bool(w.isfinite().all()) for w in network.parameters())


@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_a_matrix_is_the_weights_own_memory(memory: torch.memory_format) -> None:
    """And gradients, wherever they lie in memory, have its order of columns."""
    weight = torch.randn(6, 5, 3, 3).contiguous(memory_format=memory)
    matrix = as_matrix(weight)
    assert matrix.data_ptr() == weight.data_ptr()
    for other in (torch.contiguous_format, torch.channels_last):
        assert torch.equal(as_matrix(weight.contiguous(memory_format=other), like=weight), matrix)


def test_it_goes_on_where_it_stopped() -> None:
    """Two steps, or one, a checkpoint and another one: the same bits."""

    def run(stop: bool) -> list[Tensor]:
        network = seeded("joint")
        optimizers, generator = Optimizers(network), torch.Generator().manual_seed(1)
        for step in range(2):
            if stop and step == 1:
                states = optimizers.state_dict()
                optimizers = Optimizers(network)
                optimizers.load_state_dict(states)
            for weight in network.parameters():
                weight.grad = torch.randn(weight.shape, generator=generator)
            optimizers.step(RATE)
        return list(network.parameters())

    for whole, parts in zip(run(False), run(True), strict=True):
        assert torch.equal(whole, parts)
