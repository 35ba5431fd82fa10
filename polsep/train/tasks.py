"""Tasks to train: a network, its loss on a batch of examples, and the separation that it makes; the paper's ladder."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Generic, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from polsep.networks.paper import Refinement
from polsep.networks.rungs import Rung, separate_refined
from polsep.networks.sizes import Size
from polsep.physics.stokes import Measurements
from polsep.separation.analytic import Separation
from polsep.train.inputs import Inputs, LadderInputs, co_sited_inputs, mono_inputs, mosaic_inputs
from polsep.train.losses import diffuse_loss, first_specular_loss, specular_loss
from polsep.train.stream import Examples, StreamOptions

#: Share of a training for which `losses.first_specular_loss` replaces Eq. 21, on rungs without a specular closed form.
FIRST_SHARE = 1 / 8
#: A batch's seed is its step times this, plus the rank of the process.
RANKS = 1024

Item = TypeVar("Item")


@dataclass(frozen=True)
class Task(Generic[Inputs]):
    """A ``network``, its ``loss`` on the inputs that ``prepare`` makes of examples, and how it ``separate``s.

    The third argument of the loss is the completed share of the training. ``measure``: co-registered analysers of the
    same inputs, for methods without training. ``begin``: called with the stream's options before the first step.
    """

    network: nn.Module
    prepare: Callable[[Examples], Inputs]
    loss: Callable[[nn.Module, Inputs, float], Tensor]
    separate: Callable[[Inputs], Separation]
    measure: Callable[[Inputs], Measurements]
    begin: Callable[[StreamOptions], None] = field(default=lambda _: None)


class Variant(NamedTuple):
    """Inputs of a training: ``prepare``d examples, number of ``colors``, side of the crops in raw pixels."""

    prepare: Callable[[Examples], LadderInputs]
    colors: int
    crop: int


#: Crops of 256 raw pixels for mosaics, of 128 for co-sited images, which have as many in the end.
VARIANTS = {
    "mosaic": Variant(mosaic_inputs, 3, 256),
    "mono": Variant(mono_inputs, 1, 256),
    "co-sited": Variant(co_sited_inputs, 3, 128),
}


def ladder_task(rung: Rung, variant: str, size: Size) -> Task[LadderInputs]:
    """Return a rung of the paper's ladder; its two networks are trained side by side and share only the data."""
    prepare, colors, _ = VARIANTS[variant]
    network = Refinement(rung, colors, size)

    def loss(network: nn.Module, inputs: LadderInputs, done: float) -> Tensor:
        maps = rung.inputs(inputs.measurements).contiguous(memory_format=torch.channels_last)
        diffuse, logarithm = network(maps)
        first = diffuse_loss(diffuse, inputs.diffuse)
        if done < FIRST_SHARE and not any(rung.start[1]):
            return first + first_specular_loss(logarithm, inputs.specular)
        return first + specular_loss(logarithm, inputs.diffuse, inputs.specular)

    def separate(inputs: LadderInputs) -> Separation:
        with torch.no_grad():
            return separate_refined(inputs.measurements, rung, network)

    return Task(network, prepare, loss, separate, lambda inputs: inputs.measurements)


def find(known: Mapping[str, Item], kind: str, name: str) -> Item:
    """Return the item of that name. Raises ValueError, with all names, for any other."""
    if name not in known:
        raise ValueError(f"expected {kind} of {', '.join(known)}, found {name!r}")
    return known[name]


def batch_generator(seed: int, step: int, rank: int) -> torch.Generator:
    """Return the generator of batch number ``step`` of a process ``rank``, in a training of any ``seed``."""
    return torch.Generator().manual_seed(((seed << 24) ^ (step * RANKS + rank)) % 2**63)
