"""Training of the network for materials, on examples from a folder: rotated, mirrored, with one to all of their views.

Batch number n depends on the options and n alone, so that a resumed training uses the same batches.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn

from polsep.material.examples import example_path, load_example
from polsep.material.network import MaterialNetwork, MaterialSize
from polsep.material.shots import Example
from polsep.material.svbrdf import INPUTS, unstack
from polsep.train.loop import Training
from polsep.train.material_losses import maps_loss, material_loss, random_configurations, rendering_loss, slopes_loss
from polsep.train.tasks import batch_generator, find

#: Seed and numbers of validation's configurations: random ones and mirror ones.
VALIDATION_SEED, VALIDATION_PICTURES = 2026, (3, 6)


@dataclass(frozen=True)
class MaterialOptions:
    """Options of a training for materials: ``input`` of `svbrdf.INPUTS`, from the first ``examples`` of ``seed``.

    ``views``: of every example; a batch has 1 to all of them. Raises ValueError on unknown inputs and counts below 1.
    """

    input: str
    size: MaterialSize = field(default_factory=MaterialSize)
    seed: int = 0
    batch: int = 4
    examples: int = 768
    views: int = 3
    validation: int = 16

    def __post_init__(self) -> None:
        find(INPUTS, "an input", self.input)
        if min(self.batch, self.examples, self.views, self.validation) < 1:
            raise ValueError(f"expected a batch, examples, views and validation of at least 1, found {self}")


class MaterialBatch(NamedTuple):
    """Views ``[B, V, C, h, w]`` of materials and their maps ``[B, 9, h, w]``."""

    views: Tensor
    maps: Tensor


def turn_example(example: MaterialBatch, across: bool, down: bool, transposed: bool, colors: Tensor) -> MaterialBatch:
    """Return an example mirrored across, mirrored down, transposed and with permuted colours; normals turn with it.

    Images without polarization and their maps are equally likely in all these orientations.
    """
    views, maps = example
    x, y = maps[..., 0:1, :, :], maps[..., 1:2, :, :]
    x, y = (-x if across else x), (-y if down else y)
    diffuse, specular = maps[..., 2:5, :, :][..., colors, :, :], maps[..., 6:9, :, :][..., colors, :, :]
    axes = [axis for axis, wanted in ((-1, across), (-2, down)) if wanted]
    if transposed:  # rows become columns: x is minus y
        x, y = -y, -x
    maps = torch.cat([x, y, diffuse, maps[..., 5:6, :, :], specular], dim=-3).flip(axes)
    colored = views.reshape(*views.shape[:-3], -1, 3, *views.shape[-2:])[..., colors, :, :]
    views = colored.flatten(-4, -3).flip(axes)
    if transposed:
        views, maps = views.transpose(-1, -2), maps.transpose(-1, -2)
    return MaterialBatch(views, maps)


def batches(options: MaterialOptions, folder: Path, step: int, process: tuple[int, int]) -> Iterator[MaterialBatch]:
    """Yield batches from ``step`` on, for process (rank, count)."""
    while True:
        generator = batch_generator(options.seed, step, process[0])
        count = 1 + int(torch.randint(options.views, (1,), generator=generator))
        turned = []
        for number in torch.randint(options.examples, (options.batch,), generator=generator).tolist():
            example = load_example(example_path(folder, "train", options.seed, number))
            chosen = torch.randperm(options.views, generator=generator)[:count]
            views = MaterialBatch(example.views[chosen, INPUTS[options.input]], example.maps)
            across, down, transposed = (bool(way) for way in torch.randint(2, (3,), generator=generator))
            colors = torch.randperm(3, generator=generator)
            turned.append(turn_example(views, across, down, transposed, colors))
        yield MaterialBatch(*(torch.stack(x).float() for x in zip(*turned, strict=True)))
        step += 1


def score_maps(estimate: Callable[[Tensor], Tensor], examples: Sequence[Example], part: slice) -> dict[str, float]:
    """Return mean losses of estimates from one view and from all: "relit, 1 view", "maps, 3 views" and so on."""
    scores: dict[str, float] = {}
    generator = torch.Generator().manual_seed(VALIDATION_SEED)
    configurations = random_configurations(*VALIDATION_PICTURES, generator)
    for count in (1, len(examples[0].views)):
        relit, maps = [], []
        for example in examples:
            estimated = unstack(estimate(example.views[None, :count, part].float()))
            truth = unstack(example.maps[None].float())
            relit.append(float(rendering_loss(estimated, truth, configurations)))
            maps.append(float(maps_loss(estimated, truth)))
        name = f"{count} view{'s' if count > 1 else ''}"
        scores |= {f"relit, {name}": statistics.fmean(relit), f"maps, {name}": statistics.fmean(maps)}
    return scores


def material_training(options: MaterialOptions, folder: Path) -> Training:
    """Return the training of a network for one input, on examples that were made before."""
    part = INPUTS[options.input]
    network = MaterialNetwork(part.stop - part.start, options.size)

    def loss(net: nn.Module, batch: MaterialBatch, done: float) -> Tensor:
        seed = int(done * 2**31)  # from the completed share of the training: the same for every input
        stacked = net(batch.views)
        total = material_loss(stacked, batch.maps, torch.Generator().manual_seed(seed))
        return total + slopes_loss(stacked, batch.maps) if options.size.cues else total

    def score(net: nn.Module) -> dict[str, float]:
        device = next(net.parameters()).device
        paths = [example_path(folder, "validation", options.seed, n) for n in range(options.validation)]
        with torch.no_grad():
            return score_maps(lambda x: net(x.to(device)).cpu(), [load_example(path) for path in paths], part)

    return Training(network, partial(batches, options, folder), loss, score)
