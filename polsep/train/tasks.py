"""What is trained: a network, what it minimizes on a batch of examples, and the separation that it makes of one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from polsep.demosaic import demosaic_bilinear_half
from polsep.networks import Size
from polsep.refine import RUNGS, Refinement, Rung, separate_refined
from polsep.separation import Separation
from polsep.stokes import Measurements, Stokes, measure
from polsep.train.losses import diffuse_loss, specular_loss
from polsep.train.stream import ANGLES, Examples, as_mosaic

#: Co-registered analysers, true diffuse and specular ``[B, 3, h, w]`` and the mask ``[B, h, w]`` of a batch.
Seen = tuple[Measurements, Tensor, Tensor, Tensor]


@dataclass(frozen=True)
class Task:
    """A ``network``, its ``loss`` on what ``prepare`` makes of examples, and how it ``separate``s."""

    network: nn.Module
    prepare: Callable[[Examples], Seen]
    loss: Callable[[nn.Module, Seen], Tensor]
    separate: Callable[[Seen], Separation]


def see_mosaic(examples: Examples) -> Seen:
    """Noisy mosaics, demosaicked bilinearly to half resolution, and the mean truth of every cell."""
    diffuse, specular = (avg_pool2d(x.float(), 2).expand(-1, 3, -1, -1) for x in (examples.diffuse, examples.specular))
    mask = avg_pool2d(examples.mask[:, None].float(), 2)[:, 0] == 1
    return demosaic_bilinear_half(as_mosaic(examples.raw)), diffuse, specular, mask


def see_co_sited(examples: Examples) -> Seen:
    """The paper's protocol: every analyser and colour at every pixel, clipped at 1, no noise (Eqs. 12, 13)."""
    diffuse, specular, polarized = (x.float() for x in (examples.diffuse, examples.specular, examples.polarized))
    specular = specular.expand(-1, 3, -1, -1)
    light = Stokes(diffuse + specular, polarized[:, :3], polarized[:, 3:])
    exact = measure(light, ANGLES).data
    return Measurements(exact.clamp(max=1), ANGLES, exact >= 1), diffuse, specular, examples.mask


#: How a training sees its examples.
VARIANTS: dict[str, Callable[[Examples], Seen]] = {"mosaic": see_mosaic, "co-sited": see_co_sited}


def ladder_task(rung: Rung, variant: str, size: Size) -> Task:
    """A rung of the paper's ladder; its two networks are trained side by side and share nothing but the data."""
    network = Refinement(rung, 3, size)

    def loss(network: nn.Module, seen: Seen) -> Tensor:
        measurements, diffuse, specular, _ = seen
        found, logarithm = network(rung.inputs(measurements).contiguous(memory_format=torch.channels_last))
        return diffuse_loss(found, diffuse) + specular_loss(logarithm, (diffuse, specular))

    def separate(seen: Seen) -> Separation:
        return separate_refined(seen[0], rung, network)

    return Task(network, VARIANTS[variant], loss, separate)


def find_rung(name: str) -> Rung:
    """The rung of that name; ValueError, with the names there are, for any other."""
    if name not in RUNGS:
        raise ValueError(f"expected a rung of {', '.join(RUNGS)}, found {name!r}")
    return RUNGS[name]
