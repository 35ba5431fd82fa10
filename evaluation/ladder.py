"""The ladder of the paper's Tables 2 and 3 as entries: formulas, networks by their inputs, and the cost of each.

All rungs have networks of one size, trained on the same data for as many steps; their weights are
``evaluation/weights/ladder/RUNG-VARIANT``. A rung without weights is left out, which one line on stderr says.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad
from torch.utils.flop_counter import FlopCounterMode

from evaluation import WEIGHTS
from evaluation.scoring import Entry
from polsep.bench.rows import Row
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.in_torch import load_refinement
from polsep.io.store.weights import is_shipped, read_weights, shipped_weights
from polsep.methods import METHODS, compose
from polsep.networks.paper import Refinement
from polsep.networks.rungs import RUNGS, separate_refined
from polsep.networks.unet import count_parameters
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Mosaic
from polsep.separation.analytic import separate_analytic
from polsep.separation.color_affine import separate_color_affine
from polsep.separation.multi_capture import separate_extremes
from polsep.shipped import PAPER

#: What networks were trained on, as `train.tasks.VARIANTS` names it.
MOSAIC, CO_SITED = "mosaic", "co-sited"
#: The networks of the method `paper`, which are larger than a rung's.
SHIPPED = "paper, shipped"
#: Side of the image on which operations are counted, a multiple of what any network pads to.
COUNTED_SIDE = 128


@dataclass(frozen=True)
class Weights:
    """The file of a rung's weights, and the ``name`` that says what it was trained on."""

    rung: str
    name: str
    path: Path


def find_ladder(variant: str, rungs: Iterable[str]) -> Iterator[Weights]:
    """Weights of ``rungs`` for data of a ``variant``; of mosaics, and named so, where a rung has no others."""
    for rung in rungs:
        own, other = (find_weights(rung, of) for of in (variant, MOSAIC))
        if own is not None:
            yield Weights(rung, rung, own)
        elif other is not None:
            yield Weights(rung, f"{rung}, trained on mosaics", other)
        else:
            print(f"polsep: the rung {rung} is left out: no weights ladder/{rung}-{variant}", file=sys.stderr)


def find_weights(rung: str, variant: str) -> Path | None:
    """The file of a rung's weights; None when there is none."""
    path = WEIGHTS / "ladder" / f"{rung}-{variant}.safetensors"
    return path if path.is_file() else None


def demosaic_regrouped(mosaic: Mosaic) -> Measurements:
    """Four images ``[4, C, H/2, W/2]``, one per analyser, as if all had stood at one place (the paper's Sec. 4.1).

    The samples behind one analyser are a Bayer mosaic of half the size, demosaicked bilinearly alone. So the images of
    analysers lie a pixel of the sensor beside each other. Of colour mosaics without an origin.
    """
    samples, clipped = torch.as_tensor(mosaic.linear()), torch.as_tensor(mosaic.clipped())
    order = sorted((angle, (i, j)) for i, row in enumerate(mosaic.layout.polarizer) for j, angle in enumerate(row))
    parts = [(samples[i::2, j::2], clipped[i::2, j::2].float()) for _, (i, j) in order]
    colors = [_bayer_mask(mosaic.layout.bayer or "", color, parts[0][0].shape) for color in "RGB"]
    found = [torch.stack([_fill(part, mask) for mask in colors]) for part, _ in parts]
    touched = [torch.stack([_fill(part, mask) > 0 for mask in colors]) for _, part in parts]
    return Measurements(torch.stack(found), mosaic.layout.angles, torch.stack(touched))


def _bayer_mask(bayer: str, color: str, shape: tuple[int, ...]) -> Tensor:
    """1 where a Bayer mosaic has a colour, else 0."""
    tile = torch.tensor([float(name == color) for name in bayer]).reshape(2, 2)
    return tile.repeat(-(-shape[0] // 2), -(-shape[1] // 2))[: shape[0], : shape[1]]


def _fill(samples: Tensor, mask: Tensor) -> Tensor:
    """Samples where the mask is 1, and bilinear interpolation of them where it is 0, mirrored at the border."""
    tent = torch.tensor([1.0, 2.0, 1.0])
    total, weight = (
        conv2d(pad(image[None, None], (1, 1, 1, 1), "reflect"), torch.outer(tent, tent)[None, None])[0, 0]
        for image in (samples * mask, mask)
    )
    return torch.where(mask > 0, samples, total / weight)


@lru_cache(maxsize=3)
def ladder_entries(variant: str, rungs: tuple[str, ...] = tuple(RUNGS)) -> tuple[Entry, ...]:
    """Everything that separates one frame of a ``variant``: formulas, color-affine, ``rungs``, the method `paper`.

    All see the same bilinear data; of mosaics there are also `color-affine` itself, with its own demosaicker, and the
    analytic split of regrouped samples, the paper's preprocessing.
    """
    entries = [
        Entry("analytic", compose(demosaic_bilinear_half, separate_analytic)),
        Entry("min and max", compose(demosaic_bilinear_half, separate_extremes)),
        *(network_entry(weights) for weights in find_ladder(variant, rungs)),
    ]
    if is_shipped(PAPER):
        entries.append(network_entry(Weights("paper", SHIPPED, shipped_weights(PAPER))))
    own = METHODS["color-affine"]
    if variant == MOSAIC:
        entries.insert(1, Entry("analytic, regrouped", compose(demosaic_regrouped, separate_analytic)))
        entries.append(Entry("color-affine, bilinear", compose(demosaic_bilinear_half, separate_color_affine)))
    return (*entries, Entry(own.name, own.reference))


def rung_of(method: str) -> str:
    """The rung of an entry, whose name may go on after a comma; "" for formulas."""
    name = method.partition(",")[0]
    return name if name in RUNGS else ""


def network_entry(weights: Weights) -> Entry:
    """Networks on bilinear data, read from a file. Raises ValueError when it is damaged or of another network."""
    rung, network = load_refinement(weights.path, torch.device("cpu"))
    if rung.name != weights.rung:
        raise ValueError(f"expected weights of the rung {weights.rung} in {weights.path}, found {rung.name}")
    split = torch.no_grad()(partial(separate_refined, rung=rung, refine=network))
    return Entry(weights.name, compose(demosaic_bilinear_half, split), network)


Curve = list[tuple[float, float, float]]


def read_curves() -> dict[str, Curve]:
    """Step, diffuse and specular PSNR [dB] on the validation views while each rung was trained on mosaics.

    Rungs whose weights do not tell are left out. After them come, as flat lines, the methods without training that the
    weights name as their reference.
    """
    curves: dict[str, Curve] = {}
    references: dict[str, list[float]] = {}
    for rung in RUNGS:
        path = find_weights(rung, MOSAIC)
        metadata = read_weights(path)[1] if path is not None else {}
        points = json.loads(metadata.get("curve", "[]"))
        if points:
            curves[rung] = [(float(step), float(diffuse), float(specular)) for step, diffuse, specular in points]
            references |= json.loads(metadata.get("reference", "{}"))
    steps = [step for curve in curves.values() for step, _, _ in curve]
    flat = {name: [(step, d, s) for step in (min(steps), max(steps))] for name, (d, s) in references.items()}
    return curves | flat


def measure_costs(entries: tuple[Entry, ...], frame: Mosaic, runs: int) -> Iterator[Row]:
    """Parameters, operations per megapixel of half-resolution pixels and seconds from a raw ``frame`` to two images.

    The best of ``runs`` after a warm-up, in torch, with its threads; compiled twins are not used. The first entry is
    what the others' times are compared with.
    """
    height, width = frame.data.shape[-2:]
    case = f"{width}x{height} raw frame, {width // 2}x{height // 2} images"
    first = None
    for entry in entries:
        if entry.network is not None:
            yield Row("paper/costs", case, entry.name, "parameters", count_parameters(entry.network), "1")
            yield Row("paper/costs", case, entry.name, "operations per megapixel", count_gflop(entry.network), "GFLOP")
        seconds = time_entry(entry, frame, runs)
        first = first or seconds
        yield Row("paper/costs", case, entry.name, "time", seconds, "s")
        yield Row("paper/costs", case, entry.name, f"times as long as {entries[0].name}", seconds / first, "x")


def count_gflop(network: Refinement) -> float:
    """Operations [10^9] of a rung's networks per megapixel (10^6) that they see; a multiply-add is two.

    Counted are convolutions, as torch does. Networks are linear in the number of pixels.
    """
    inputs = torch.zeros(1, network.linear.in_channels, COUNTED_SIDE, COUNTED_SIDE)
    counter = FlopCounterMode(display=False)
    with counter, torch.no_grad():
        network(inputs)
    return counter.get_total_flops() / COUNTED_SIDE**2 / 1000


def time_entry(entry: Entry, frame: Mosaic, runs: int) -> float:
    """Seconds from a raw frame to diffuse and specular, the best of ``runs`` after one to warm up."""
    times = []
    for _ in range(runs + 1):
        start = time.perf_counter()
        entry.separate(frame)
        times.append(time.perf_counter() - start)
    return min(times[1:])
