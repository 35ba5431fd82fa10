"""What is trained: a network, what it minimizes on a batch of examples, and the separation that it makes of one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.networks.paper import RUNGS, Refinement, Rung, separate_refined
from polsep.networks.unet import Size
from polsep.physics.stokes import Measurements, Stokes, measure
from polsep.sensor.camera import Mosaic
from polsep.separation.analytic import Separation
from polsep.train.losses import diffuse_loss, first_specular_loss, specular_loss
from polsep.train.stream import ANGLES, MONO, Examples, StreamOptions, as_mosaic, expose_mono

#: The share of a training for which `losses.first_specular_loss` stands in for Eq. 21 on rungs without a first guess.
FIRST_SHARE = 1 / 8

#: Co-registered analysers, true diffuse and specular ``[B, C, h, w]`` and the mask ``[B, h, w]`` of a batch.
Seen = tuple[Measurements, Tensor, Tensor, Tensor]
Item = TypeVar("Item")
#: What a network sees of a batch: whatever comes first, then truth and mask as those of `Seen`.
View = TypeVar("View", bound=tuple[Any, ...])


def begin_at_random(stream: StreamOptions) -> None:
    """Networks that start from nothing but their own random weights."""
    del stream


def first_of(seen: Seen) -> Measurements:
    """What networks that see analysers see."""
    return seen[0]


@dataclass(frozen=True)
class Task(Generic[View]):
    """A ``network``, its ``loss`` on what ``prepare`` makes of examples, and how it ``separate``s.

    The loss is told which share of the training is done. ``measure``: co-registered analysers of the same views, for
    methods without training. ``begin``: called with the stream's options before the first step.
    """

    network: nn.Module
    prepare: Callable[[Examples], View]
    loss: Callable[[nn.Module, View, float], Tensor]
    separate: Callable[[View], Separation]
    measure: Callable[[View], Measurements]
    begin: Callable[[StreamOptions], None]


def see_mosaic(examples: Examples) -> Seen:
    """Noisy mosaics, demosaicked bilinearly to half resolution, and the mean truth of every cell."""
    diffuse, specular = (avg_pool2d(x.float(), 2).expand(-1, 3, -1, -1) for x in (examples.diffuse, examples.specular))
    return demosaic_bilinear_half(as_mosaic(examples.raw)), diffuse, specular, whole_cells(examples.mask)


def see_co_sited(examples: Examples) -> Seen:
    """The paper's protocol: every analyser and colour at every pixel, clipped at 1, no noise (Eqs. 12, 13)."""
    diffuse, specular, polarized = (x.float() for x in (examples.diffuse, examples.specular, examples.polarized))
    specular = specular.expand(-1, 3, -1, -1)
    light = Stokes(diffuse + specular, polarized[:, :3], polarized[:, 3:])
    exact = measure(light, ANGLES).data
    return Measurements(exact.clamp(max=1), ANGLES, exact >= 1), diffuse, specular, examples.mask


def see_mono(examples: Examples) -> Seen:
    """Noisy mosaics of a camera without colour filters, as `see_mosaic` sees those of colour."""
    view = expose_mono(examples)
    diffuse, specular = (avg_pool2d(x, 2) for x in (view.diffuse, view.specular))
    return demosaic_bilinear_half(Mosaic(view.raw, MONO, 0.0, 1.0)), diffuse, specular, whole_cells(view.mask)


def whole_cells(mask: Tensor) -> Tensor:
    """The cells of 2x2 pixels ``[B, h, w]`` of which all are in the mask ``[B, H, W]``."""
    return avg_pool2d(mask[:, None].float(), 2)[:, 0] == 1


@dataclass(frozen=True)
class Variant:
    """How a training ``see``s its examples, in how many ``colors``, from crops of so many raw pixels along a side."""

    see: Callable[[Examples], Seen]
    colors: int
    crop: int


#: Crops of 256 raw pixels for mosaics, of 128 for co-sited images, which have as many in the end.
VARIANTS = {
    "mosaic": Variant(see_mosaic, 3, 256),
    "mono": Variant(see_mono, 1, 256),
    "co-sited": Variant(see_co_sited, 3, 128),
}


def ladder_task(rung: Rung, variant: str, size: Size) -> Task[Seen]:
    """A rung of the paper's ladder; its two networks are trained side by side and share nothing but the data."""
    seen_as = VARIANTS[variant]
    network = Refinement(rung, seen_as.colors, size)

    def loss(network: nn.Module, seen: Seen, done: float) -> Tensor:
        measurements, diffuse, specular, _ = seen
        found, logarithm = network(rung.inputs(measurements).contiguous(memory_format=torch.channels_last))
        if done < FIRST_SHARE and not any(rung.start[1]):
            return diffuse_loss(found, diffuse) + first_specular_loss(logarithm, specular)
        return diffuse_loss(found, diffuse) + specular_loss(logarithm, (diffuse, specular))

    def separate(seen: Seen) -> Separation:
        return separate_refined(seen[0], rung, network)

    return Task(network, seen_as.see, loss, separate, first_of, begin_at_random)


def find_rung(name: str) -> Rung:
    """The rung of that name; ValueError, with the names there are, for any other."""
    return find(RUNGS, "a rung", name)


def find(known: Mapping[str, Item], kind: str, name: str) -> Item:
    """The item of that name; ValueError, with the names there are, for any other."""
    if name not in known:
        raise ValueError(f"expected {kind} of {', '.join(known)}, found {name!r}")
    return known[name]
