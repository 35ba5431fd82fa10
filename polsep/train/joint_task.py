"""The task of the joint network, its ablations, and the linear demosaicking filter that is fitted before training."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d, pad, pixel_unshuffle, unfold

from polsep.networks.channels import INPUTS
from polsep.networks.guide import guide_batch
from polsep.networks.joint import Demosaicker, Joint, bilinear_filter
from polsep.networks.sizes import ResidualSize
from polsep.physics.stokes import Measurements, Stokes
from polsep.sensor.camera import Layout
from polsep.separation.analytic import Separation
from polsep.train.inputs import JointInputs, demosaic_lit, joint_inputs, joint_mono_inputs
from polsep.train.joint_losses import Goal, joint_loss, paper_difference
from polsep.train.stream import StreamOptions, stream_lane
from polsep.train.tasks import Task

#: The joint networks: for stills, a frame in seconds; for two frames a second on two cores; for real time.
SIZES = {
    "joint-large": ResidualSize(64, (3, 3, 2)),
    "joint": ResidualSize(48, (0, 1, 1)),
    "joint-fast": ResidualSize(32, (0, 1, 1), 32),
}
#: Source of their Stokes images for colour frames; mono frames use a linear filter.
DEMOSAICKERS: dict[str, Demosaicker] = {"joint-large": "guided", "joint": "guided", "joint-fast": "linear"}
#: Cells by which the guided demosaicker extends crops.
MARGIN = 8
#: Batches for the fit of the filter, size of their scene pool, and their lane, which no worker uses.
FIT_BATCHES, FIT_POOL, FIT_LANE = 60, 24, 120
#: Local brightness below which a pixel is left out of the fit, and the constant added to it in the relative error.
MIN_FIT, FIT_FLOOR = 0.01, 0.02
#: Reach of the filter beyond a pixel or cell, in raw pixels. A larger one would improve s0 by 2 %, polarization by 1 %,
#: at more than twice the cost (docs/experiments.md).
FIT_REACH = 3
#: Ridge weight that pulls undetermined filter weights to bilinear ones, relative to the samples' mean power.
RIDGE = 1e-4


class Ablation(NamedTuple):
    """The difference to the shipped networks: input maps and loss."""

    inputs: tuple[str, ...] = INPUTS
    goal: Goal = Goal()


def _without(name: str) -> tuple[str, ...]:
    return tuple(other for other in INPUTS if other != name)


#: Ablations by name; "none" is the shipped network.
ABLATIONS = {
    "none": Ablation(),
    "no-closed-form": Ablation(("samples", "clipping")),
    "no-clip-masks": Ablation(_without("clipping")),
    "demosaicked": Ablation(_without("samples")),
    "cosine": Ablation(_without("sine")),
    "no-data-term": Ablation(goal=Goal(data=0.0)),
    "paper-loss": Ablation(goal=Goal(paper_difference)),
}
#: Parts of a network that can be trained alone, by the prefix of their parameters' names.
PARTS = {"all": "", "details": "details.", "errors": "log_variance."}
#: Inputs and number of colours by variant.
JOINT_VARIANTS = {"mosaic": (joint_inputs, 3), "mono": (joint_mono_inputs, 1)}


def joint_task(
    variant: str,
    size: ResidualSize,
    ablation: Ablation,
    demosaicker: Demosaicker = "linear",
) -> Task[JointInputs]:
    """Return the task of the joint network for colour (``mosaic``) or ``mono`` frames."""
    prepare, colors = JOINT_VARIANTS[variant]
    network = Joint(colors, size, ablation.inputs, demosaicker, sees_frame=True)
    network.margin = MARGIN
    if not torch.cuda.is_available():
        network.guide = guide_batch

    def loss(net: nn.Module, inputs: JointInputs, done: float) -> Tensor:
        del done
        return joint_loss(net(inputs.raw, inputs.clipped, seen_thumbnail(inputs)), inputs, ablation.goal)

    def separate(inputs: JointInputs) -> Separation:
        with torch.no_grad():
            images = network.half_resolution(inputs.raw, inputs.clipped, seen_thumbnail(inputs))
        diffuse, specular = images.diffuse.clamp(min=0), images.specular.clamp(min=0).expand_as(images.diffuse)
        return Separation(diffuse, specular, inputs.mask, Stokes(diffuse + specular, images.s1, images.s2))

    def measure(inputs: JointInputs) -> Measurements:
        return demosaic_lit(inputs.raw[:, 0], inputs.clipped[:, 0], inputs.layout)

    def begin(stream: StreamOptions) -> None:
        if network.demosaic is None:
            return
        batches = islice(stream_lane(replace(stream, pool=FIT_POOL), FIT_LANE, 0), FIT_BATCHES)
        network.demosaic.copy_(fit_filter(prepare(batch) for batch in batches))

    return Task(network, prepare, loss, separate, measure, begin)


def seen_thumbnail(inputs: JointInputs) -> Tensor | None:
    """Return the thumbnails of the frames that the crops are of; None where crops are whole frames."""
    return inputs.thumbnail if inputs.thumbnail.numel() else None


def freeze_others(network: nn.Module, part: str) -> None:
    """Freeze all parameters of a network but those of one of `PARTS`."""
    for name, weight in network.named_parameters():
        weight.requires_grad_(name.startswith(PARTS[part]))


def fit_filter(views: Iterable[JointInputs]) -> Tensor:
    """Return the packed filter, as `joint.bilinear_filter`, of least mean squared error on examples.

    Errors are relative to the local brightness, of pixels without clipping. It is a Wiener filter for scenes like
    these, colours and polarization included, of samples within `FIT_REACH`, constrained to reproduce even unpolarized
    light of one colour: otherwise saturated surfaces show a grid. Raises ValueError without examples, or without light
    on objects in them.
    """
    start, power, goal, even = torch.zeros(0), torch.zeros(0), torch.zeros(0), torch.zeros(0)
    for view in views:
        samples, wanted = _fit_samples(view)
        if not start.numel():
            start = bilinear_filter(view.layout).flatten(1).double().T
            power, goal = start.new_zeros(len(start), len(start)), torch.zeros_like(start)
            even = _even_light(view.layout)
        power += samples.T @ samples
        goal += samples.T @ wanted
    if not bool(power.any()):
        raise ValueError("expected examples to fit a filter to, found none")
    hold = RIDGE * power.diagonal().mean()
    weights, near = torch.zeros_like(start), reach_of_filter(start.shape[1] // 24).T
    # Outputs of the same samples share a linear system.
    for used in torch.unique(near, dim=1).unbind(dim=1):
        inputs, outputs = used.nonzero()[:, 0], (near == used[:, None]).all(dim=0).nonzero()[:, 0]
        own = torch.meshgrid(inputs, outputs, indexing="ij")
        system = power[inputs][:, inputs] + hold * torch.eye(len(inputs), dtype=torch.float64)
        # Bilinear weights reproduce even light; Lagrange multipliers make the fitted weights do the same.
        bound, kept = even[inputs], even.T @ start[:, outputs]
        nothing = bound.new_zeros(bound.shape[1], bound.shape[1])
        system = torch.cat([torch.cat([system, bound], 1), torch.cat([bound.T, nothing], 1)])
        solution = torch.linalg.solve(system, torch.cat([goal[own] + hold * start[own], kept]))
        weights[own] = solution[: len(inputs)]
    return weights.T.float().reshape(-1, 16, 3, 3)


def _even_light(layout: Layout) -> Tensor:
    """Neighbourhoods ``[144, C]`` of even, unpolarized light of one colour each."""
    channels = torch.tensor([layout.filter_at(place // 4, place % 4).channel for place in range(16)])
    lit = channels[:, None] == torch.arange(layout.channels)
    return lit.double().repeat_interleave(9, dim=0)


def reach_of_filter(colors: int) -> Tensor:
    """Return the packed samples that a packed filter uses, within `FIT_REACH` of its output: bool ``[24 C, 144]``."""
    offsets = torch.arange(-4, 8)  # raw rows, or columns, of the 3 x 3 packed pixels around
    places = []
    for count in (4, 2):  # full-resolution pixels, half-resolution cells
        first = torch.arange(count) * (4 // count)
        near = (offsets >= first[:, None] - FIT_REACH) & (offsets < first[:, None] + 4 // count + FIT_REACH)
        both = near[:, None, :, None] & near[None, :, None, :]  # row and column of output and of sample
        packed = both.view(count**2, 3, 4, 3, 4).permute(0, 2, 4, 1, 3).flatten(1)
        places.append(packed.repeat(colors if count == 4 else 2 * colors, 1))
    return torch.cat(places)


def _fit_samples(view: JointInputs) -> tuple[Tensor, Tensor]:
    """Neighbourhoods ``[M, 144]`` and their true outputs ``[M, 24 C]``, over the local brightness."""
    planes = pixel_unshuffle(view.raw, 4)
    half = [pixel_unshuffle(avg_pool2d(x, 2), 2) for x in view.polarized.chunk(2, dim=1)]
    wanted = torch.cat([pixel_unshuffle(view.full_diffuse + view.full_specular, 4), *half], dim=1)
    light = 2 * avg_pool2d(planes.mean(dim=1, keepdim=True), 3, 1, 1, count_include_pad=False)
    clipped = max_pool2d(pixel_unshuffle(view.clipped.float(), 4).amax(dim=1, keepdim=True), 3, 1, 1) > 0
    inside = pixel_unshuffle(view.weight, 4).amin(dim=1, keepdim=True) > 0
    kept = (inside & ~clipped & (light > MIN_FIT)).flatten()
    size = (light.flatten()[kept] + FIT_FLOOR)[:, None]
    around = unfold(pad(planes, (1, 1, 1, 1), mode="replicate"), 3).transpose(1, 2).flatten(0, 1)
    wanted = wanted.flatten(2).transpose(1, 2).flatten(0, 1)
    return (around[kept] / size).double(), (wanted[kept] / size).double()
