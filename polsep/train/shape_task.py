"""Training of the network for shape, on examples from a folder: turned, mirrored, cut to the object.

Frames of objects that stand are mostly mirrored across alone, so that the network learns where down is: users' objects
stand, and a flat object's normals are known but for the side to which it tips. `HELD_SHARE` of these frames and all of
solids are turned in eight ways, so that an object held at any angle still works.

Batch number n depends on the options and n alone, so that a resumed training uses the same batches.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize

from polsep.geometry.shape_maps import INPUTS, NORMAL_VARIANCE, USUAL, Seen, Surface, decode, encode
from polsep.io.store.rounding import names_to_round
from polsep.networks.shape import ShapeNetwork
from polsep.networks.sizes import ResidualSize
from polsep.train.loop import Training
from polsep.train.shape_examples import MESHES, PLANES, Examples, find_example, load_example
from polsep.train.shape_losses import gained, pictures_loss, random_lamps, shape_loss
from polsep.train.tasks import batch_generator, find

#: Inputs of trainings: those of frames, and "perfect", the input "separated" of true images.
TRAINED = (*INPUTS, "perfect")
#: Parts that are trained: all layers, or small ones alone, which make up for it that large ones were rounded before
#: (`io.store.rounding`).
PARTS = ("all", "small")
#: Share of frames whose lamp's direction is not given, and deviation of the others' [rad].
NOT_GIVEN, GIVEN_ERROR = 0.3, 0.05
#: Side of a cut over the longest side of the object, in training; and in validation.
CUTS, CUT = (1.04, 1.5), 1.1
#: Share of frames of objects that stand which are turned in eight ways, as if held at any angle: with all of the
#: solids, every second frame (a third and a quarter of two thirds).
HELD_SHARE = 0.25
#: Seed and number of validation's lamps.
LAMP_SEED, VALIDATION_LAMPS = 31, 20


@dataclass(frozen=True)
class ShapeOptions:
    """Options of a training for an ``input`` of `TRAINED`: crops of ``side`` pixels of the first ``examples``.

    ``part``: one of `PARTS`. ``meshes``: the sha256 of the files that as many examples again show, "" for none. Raises
    ValueError on unknown inputs and parts, and on counts below 1.
    """

    input: str = "separated"
    size: ResidualSize = field(default_factory=lambda: ResidualSize(32, (1, 2, 2, 2)))
    seed: int = 0
    batch: int = 8
    side: int = 96
    examples: int = 3200
    validation: int = 64
    part: str = "all"
    meshes: str = ""

    def __post_init__(self) -> None:
        find(dict.fromkeys(TRAINED), "an input", self.input)
        find(dict.fromkeys(PARTS), "a part", self.part)
        if min(self.batch, self.side, self.examples, self.validation) < 1:
            raise ValueError(f"expected a batch, side, examples and validation of at least 1, found {self}")

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits of training examples, each of which has ``examples``."""
        return ("train", MESHES) if self.meshes else ("train",)

    def network(self) -> ShapeNetwork:
        """Return the network, untrained; layers that are not part of the training take no gradients."""
        network = ShapeNetwork(INPUTS[encoding_of(self.input)], USUAL, self.size)
        arrays = {name: value.detach().numpy() for name, value in network.named_parameters()}
        for name in names_to_round(arrays, {}) if self.part == "small" else ():
            network.get_parameter(name).requires_grad_(False)
        return network


class ShapeBatch(NamedTuple):
    """Planes ``[B, COUNT, h, w]`` of examples (`shape_examples.PLANES`)."""

    planes: Tensor


def encoding_of(name: str) -> str:
    """The input of `shape_maps.encode` of a training's input."""
    return "separated" if name == "perfect" else name


def seen_of(planes: Tensor, name: str) -> Seen:
    """Images that an input sees of examples ``[B, COUNT, h, w]``."""

    def part(key: str) -> Tensor:
        return planes[:, PLANES[key]]

    mask, light = part("mask"), part("light")
    if name in ("separated", "perfect"):
        key = "found" if name == "separated" else "true"
        images = part(key)
        error = part("found_error")[:, :1] * (name == "separated")
        return Seen(images[:, :3], images[:, 3:], part(f"{key}_polarized"), error, mask, light)
    stokes = part("stokes")
    return Seen(stokes[:, :3], None, stokes[:, 3:], None, mask, light)


def truth_of(planes: Tensor) -> Surface:
    """The true surface of examples; normals may have been averaged."""
    normal, albedo, rough, strength = (planes[:, PLANES[k]] for k in ("normal", "albedo", "roughness", "specular"))
    none = torch.zeros_like(rough)
    return Surface(normalize(normal, dim=1), albedo, rough, strength, none, none, none)


def cut_example(planes: Tensor, wider: float, side: int, place: tuple[float, float] = (0.5, 0.5)) -> Tensor:
    """A square of ``wider`` times the longest side of the object, resized to ``side``: ``[COUNT, side, side]``.

    ``place``: of the object in it, from 0 to 1 along rows and columns. Images that shrink are means over areas.
    """
    mask = planes[PLANES["mask"]][0] > 0.5
    rows, cols = (torch.nonzero(mask.any(dim=axis))[:, 0] for axis in (1, 0))
    if not len(rows):
        rows = cols = torch.tensor([0, mask.shape[0] - 1])
    sides = [int(x[-1] - x[0]) + 1 for x in (rows, cols)]
    width = max(8, round(wider * max(sides)))
    first = [int(x[0]) - round(share * (width - n)) for x, n, share in zip((rows, cols), sides, place, strict=True)]
    cut = torch.zeros(len(planes), width, width, dtype=planes.dtype)
    low, high = [max(0, a) for a in first], [min(mask.shape[k], first[k] + width) for k in range(2)]
    inside = planes[:, low[0] : high[0], low[1] : high[1]]
    cut[:, low[0] - first[0] : high[0] - first[0], low[1] - first[1] : high[1] - first[1]] = inside
    cut[PLANES["light"]] = planes[PLANES["light"], :1, :1]
    mode = "area" if width >= side else "bilinear"
    resized = interpolate(cut[None].float(), (side, side), mode=mode)[0]
    resized[PLANES["mask"]] = (resized[PLANES["mask"]] > 0.99).float()
    return resized


#: Planes that turn: pairs of x and y, s1, and s2.
_X, _Y = (24, 32), (25, 33)
_S1, _S2 = (3, 4, 5, 13, 21), (6, 7, 8, 14, 22)


def turn_example(planes: Tensor, across: bool, down: bool, transposed: bool) -> Tensor:
    """An example mirrored across, mirrored down and transposed; normals, lamp and polarization turn with it.

    Mirroring changes the sign of s2, transposing that of s1 (`stokes.flip_horizontal`, `stokes.transpose`).
    """
    signs = torch.ones(len(planes), 1, 1)
    signs[list(_X)] *= -1 if across else 1
    signs[list(_Y)] *= -1 if down else 1
    signs[list(_S2)] *= -1 if across != down else 1
    turned = (planes * signs).flip([axis for axis, wanted in ((-1, across), (-2, down)) if wanted])
    if not transposed:  # rows become columns: x is minus y
        return turned
    turned = turned.transpose(-1, -2).clone()
    x, y = turned[list(_X)], turned[list(_Y)]
    turned[list(_X)], turned[list(_Y)] = -y, -x
    turned[list(_S1)] *= -1
    return turned


def give_light(planes: Tensor, generator: torch.Generator) -> Tensor:
    """An example whose lamp's direction is given with an error, or not at all."""
    unknown = float(torch.rand(1, generator=generator)) < NOT_GIVEN
    error = GIVEN_ERROR * torch.randn(3, 1, 1, generator=generator)
    given = planes.clone()
    given[PLANES["light"]] = 0.0 if unknown else normalize(planes[PLANES["light"]] + error, dim=0)
    return given


def batches(options: ShapeOptions, paths: Sequence[Path], step: int, process: tuple[int, int]) -> Iterator[ShapeBatch]:
    """Yield batches from ``step`` on, for process (rank, count)."""
    while True:
        generator = batch_generator(options.seed, step, process[0])
        found = []
        for number in torch.randint(len(paths), (options.batch,), generator=generator).tolist():
            draws = torch.rand(4, generator=generator).tolist()
            wider = CUTS[0] + (CUTS[1] - CUTS[0]) * draws[0]
            planes = cut_example(load_example(paths[number]), wider, options.side, (draws[1], draws[2]))
            across, *others = (bool(way) for way in torch.randint(2, (3,), generator=generator))
            examples, shown = find_example(paths[number])
            any_way = not examples.stands(shown) or draws[3] < HELD_SHARE
            down, transposed = (way and any_way for way in others)
            found.append(give_light(turn_example(planes, across, down, transposed), generator))
        yield ShapeBatch(torch.stack(found))
        step += 1


def angles_deg(normal: Tensor, truth: Tensor) -> Tensor:
    """Angles between unit vectors ``[B, 3, h, w]`` in degrees, ``[B, h, w]``."""
    half = (normal - truth).square().sum(dim=1).sqrt() / 2
    return 2 * torch.rad2deg(torch.asin(half.clamp(max=1)))


def score_shapes(network: nn.Module, examples: Sequence[Tensor], name: str) -> dict[str, float]:
    """Return means over frames: angular error, its median over pixels, errors of roughness and albedo, relit error."""
    lamps = random_lamps(VALIDATION_LAMPS, torch.Generator().manual_seed(LAMP_SEED))
    scores: dict[str, list[float]] = {}
    with torch.no_grad():
        for planes in (example.to(next(network.parameters()).device) for example in examples):
            seen = seen_of(planes[None], name)
            mask, truth = seen.mask, truth_of(planes[None])
            found = decode(network(encode(seen, encoding_of(name))).float(), seen.image, mask)
            inside = mask[:, 0] > 0
            angles = angles_deg(found.normal, truth.normal)[inside]
            found = gained(found, truth, mask)
            rough = torch.log(found.roughness / truth.roughness.clamp(min=1e-3))[mask > 0].abs()
            albedo = (torch.log(found.albedo + 0.02) - torch.log(truth.albedo + 0.02)).abs().mean(dim=1)[inside]
            expected = torch.rad2deg(found.normal_error[:, 0][inside] * math.sqrt(2))
            values = {
                "normals, mean deg": float(angles.mean()),
                "normals, median deg": float(angles.median()),
                "expected / rms": float(expected.square().mean().sqrt() / angles.square().mean().sqrt()),
                "roughness, log": float(rough.median()),
                "albedo, log": float(albedo.mean()),
                "relit, log": float(pictures_loss(found, truth, mask, lamps)),
            }
            for key, value in values.items():
                scores.setdefault(key, []).append(value)
    return {key: statistics.fmean(values) for key, values in scores.items()}


def shape_training(options: ShapeOptions, folder: Path) -> Training:
    """Return the training of a network for one input, on examples that were made before."""
    network, name = options.network(), encoding_of(options.input)

    def paths(split: str, count: int) -> list[Path]:
        examples = Examples(split, options.seed, shown=options.meshes)
        found = [path for number in range(count) if (path := examples.path(folder, number)).is_file()]
        if not found:
            raise ValueError(f"expected examples in {folder}, found none")
        return found

    def loss(net: nn.Module, batch: ShapeBatch, done: float) -> Tensor:
        seen = seen_of(batch.planes, options.input)
        maps = encode(seen, name).contiguous(memory_format=torch.channels_last)
        found = decode(net(maps).float(), seen.image, seen.mask)
        generator = torch.Generator().manual_seed(int(done * 2**31))
        return shape_loss(found, truth_of(batch.planes), seen.mask, generator)

    def score(net: nn.Module) -> dict[str, float]:
        examples = [cut_example(load_example(p), CUT, options.side) for p in paths("validation", options.validation)]
        return score_shapes(net, examples, options.input)

    def finish(net: nn.Module) -> None:
        assert isinstance(net, ShapeNetwork)
        shift_errors(net, 1 / score(net)["expected / rms"])

    shown = [path for split in options.splits for path in paths(split, options.examples)]
    return Training(network, partial(batches, options, shown), loss, score, finish=finish)


def shift_errors(network: ShapeNetwork, factor: float) -> None:
    """Multiply the errors of normals that a network expects by a factor: a shift of their log variance, an output."""
    assert network.last.bias is not None
    with torch.no_grad():
        outputs = network.last.bias.view(len(USUAL), -1)
        outputs[NORMAL_VARIANCE] += 2 * math.log(factor)
