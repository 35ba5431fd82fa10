"""The joint network's training: the linear demosaicking filter that it starts from, its task and its ablations."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d, pad, pixel_unshuffle, unfold

from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.networks.channels import INPUTS
from polsep.networks.joint import Demosaicker, Joint, bilinear_filter
from polsep.networks.unet import ResidualSize
from polsep.physics.stokes import Measurements, Stokes
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.analytic import Separation
from polsep.train.joint_losses import Goal, joint_loss, paper_difference
from polsep.train.joint_views import JointSeen, find_clipped, see_raw, see_raw_mono
from polsep.train.stream import StreamOptions, stream_lane
from polsep.train.tasks import Task

#: The shipped networks: the best one at two frames a second on two cores, and the real-time one.
SIZES = {"joint": ResidualSize(48, (0, 1, 1)), "joint-fast": ResidualSize(16, (0, 1, 1), 16)}
#: Where their Stokes images come from, for colour frames; for mono ones, from a linear filter.
DEMOSAICKERS: dict[str, Demosaicker] = {"joint": "guided", "joint-fast": "linear"}
#: Cells by which the guide continues crops.
MARGIN = 8
#: Batches that the filter is fitted to, from a pool of so many scenes, of a lane that no worker has.
FIT_BATCHES, FIT_POOL, FIT_LANE = 60, 24, 120
#: Light around below which a pixel says nothing about the filter, and what is added to that light.
MIN_FIT, FIT_FLOOR = 0.01, 0.02
#: Raw pixels that the filter reaches beyond a pixel or cell: what lies farther would improve s0 by 2 %, polarization
#: by 1 %, at more than twice the cost (docs/experiments.md).
FIT_REACH = 3
#: How firmly weights that the examples leave open are held at bilinear ones, against the samples' own power.
RIDGE = 1e-4


class Ablation(NamedTuple):
    """What differs from the shipped networks: which maps they see, and what they minimize."""

    inputs: tuple[str, ...] = INPUTS
    goal: Goal = Goal()


def _without(name: str) -> tuple[str, ...]:
    return tuple(other for other in INPUTS if other != name)


#: By name; "none" is what is shipped.
ABLATIONS = {
    "none": Ablation(),
    "no-closed-form": Ablation(("samples", "clipping")),
    "no-clip-masks": Ablation(_without("clipping")),
    "demosaicked": Ablation(_without("samples")),
    "cosine": Ablation(_without("sine")),
    "no-data-term": Ablation(goal=Goal(data=0.0)),
    "paper-loss": Ablation(goal=Goal(paper_difference)),
}
#: What can be trained alone: which parameters of a network it is, by the beginning of their names.
PARTS = {"all": "", "details": "details.", "doubt": "log_variance."}
#: How examples are seen, and in how many colours.
VIEWS = {"mosaic": (see_raw, 3), "mono": (see_raw_mono, 1)}


def joint_task(
    variant: str, size: ResidualSize, ablation: Ablation, demosaicker: Demosaicker = "linear"
) -> Task[JointSeen]:
    """The joint network for colour (``mosaic``) or ``mono`` frames."""
    see, colors = VIEWS[variant]
    network = Joint(colors, size, ablation.inputs, demosaicker)
    network.margin = MARGIN

    def loss(net: nn.Module, seen: JointSeen, done: float) -> Tensor:
        del done
        return joint_loss(net(seen.raw, find_clipped(seen.raw)), seen, ablation.goal)

    def separate(seen: JointSeen) -> Separation:
        with torch.no_grad():
            images = network.half_resolution(seen.raw, find_clipped(seen.raw))
        diffuse, specular = images.diffuse.clamp(min=0), images.specular.clamp(min=0).expand_as(images.diffuse)
        return Separation(diffuse, specular, seen.mask, Stokes(diffuse + specular, images.s1, images.s2))

    def begin(stream: StreamOptions) -> None:
        if network.demosaic is None:
            return
        batches = islice(stream_lane(replace(stream, pool=FIT_POOL), FIT_LANE, 0), FIT_BATCHES)
        network.demosaic.copy_(fit_filter(see(batch) for batch in batches))

    return Task(network, see, loss, separate, measure_bilinearly, begin)


def hold_others(network: nn.Module, part: str) -> None:
    """Let only one of `PARTS` of a network be trained."""
    for name, weight in network.named_parameters():
        weight.requires_grad_(name.startswith(PARTS[part]))


def measure_bilinearly(seen: JointSeen) -> Measurements:
    """What methods without training are given of the same frames."""
    return demosaic_bilinear_half(Mosaic(seen.raw[:, 0], seen.layout, 0.0, 1.0))


def fit_filter(views: Iterable[JointSeen]) -> Tensor:
    """The packed filter, as `joint.bilinear_filter`, that is off least on examples in the mean square.

    Errors count relative to the light around, and only where nothing clips: it is a Wiener filter for scenes like
    these, colours and polarization included, of samples within `FIT_REACH`, that leaves unpolarized light of one colour
    as it is: else saturated surfaces get a grid. Raises ValueError without examples, or without light on objects in
    them.
    """
    start, power, goal, even = torch.zeros(0), torch.zeros(0), torch.zeros(0), torch.zeros(0)
    for view in views:
        seen, wanted = _fit_samples(view)
        if not start.numel():
            start = bilinear_filter(view.layout).flatten(1).double().T
            power, goal = start.new_zeros(len(start), len(start)), torch.zeros_like(start)
            even = _even_light(view.layout)
        power += seen.T @ seen
        goal += seen.T @ wanted
    if not bool(power.any()):
        raise ValueError("expected examples to fit a filter to, found none")
    hold = RIDGE * power.diagonal().mean()
    weights, near = torch.zeros_like(start), reach_of_filter(start.shape[1] // 24).T
    # Outputs that see the same samples share a system.
    for sees in torch.unique(near, dim=1).unbind(dim=1):
        inputs, outputs = sees.nonzero()[:, 0], (near == sees[:, None]).all(dim=0).nonzero()[:, 0]
        own = torch.meshgrid(inputs, outputs, indexing="ij")
        system = power[inputs][:, inputs] + hold * torch.eye(len(inputs), dtype=torch.float64)
        # Bilinear weights do what is demanded of even light; multipliers make the others do so, too.
        bound, kept = even[inputs], even.T @ start[:, outputs]
        nothing = bound.new_zeros(bound.shape[1], bound.shape[1])
        system = torch.cat([torch.cat([system, bound], 1), torch.cat([bound.T, nothing], 1)])
        found = torch.linalg.solve(system, torch.cat([goal[own] + hold * start[own], kept]))
        weights[own] = found[: len(inputs)]
    return weights.T.float().reshape(-1, 16, 3, 3)


def _even_light(layout: Layout) -> Tensor:
    """Neighbourhoods ``[144, C]`` of even, unpolarized light of one colour each."""
    channels = torch.tensor([layout.filter_at(place // 4, place % 4).channel for place in range(16)])
    lit = channels[:, None] == torch.arange(layout.channels)
    return lit.double().repeat_interleave(9, dim=0)


def reach_of_filter(colors: int) -> Tensor:
    """Which of the packed samples a packed filter uses: bool ``[24 C, 144]``, within `FIT_REACH` of what it makes."""
    offsets = torch.arange(-4, 8)  # raw rows, or columns, of the 3 x 3 packed pixels around
    places = []
    for count in (4, 2):  # full-resolution pixels, half-resolution cells
        first = torch.arange(count) * (4 // count)
        near = (offsets >= first[:, None] - FIT_REACH) & (offsets < first[:, None] + 4 // count + FIT_REACH)
        both = near[:, None, :, None] & near[None, :, None, :]  # row and column of output and of sample
        packed = both.view(count**2, 3, 4, 3, 4).permute(0, 2, 4, 1, 3).flatten(1)
        places.append(packed.repeat(colors if count == 4 else 2 * colors, 1))
    return torch.cat(places)


def _fit_samples(view: JointSeen) -> tuple[Tensor, Tensor]:
    """Neighbourhoods ``[M, 144]`` and what is wanted of them ``[M, 24 C]``, over the light around."""
    planes = pixel_unshuffle(view.raw, 4)
    half = [pixel_unshuffle(avg_pool2d(x, 2), 2) for x in view.polarized.chunk(2, dim=1)]
    wanted = torch.cat([pixel_unshuffle(view.full_diffuse + view.full_specular, 4), *half], dim=1)
    light = 2 * avg_pool2d(planes.mean(dim=1, keepdim=True), 3, 1, 1, count_include_pad=False)
    clipped = max_pool2d(pixel_unshuffle(find_clipped(view.raw).float(), 4).amax(dim=1, keepdim=True), 3, 1, 1) > 0
    inside = pixel_unshuffle(view.weight, 4).amin(dim=1, keepdim=True) > 0
    kept = (inside & ~clipped & (light > MIN_FIT)).flatten()
    size = (light.flatten()[kept] + FIT_FLOOR)[:, None]
    around = unfold(pad(planes, (1, 1, 1, 1), mode="replicate"), 3).transpose(1, 2).flatten(0, 1)
    wanted = wanted.flatten(2).transpose(1, 2).flatten(0, 1)
    return (around[kept] / size).double(), (wanted[kept] / size).double()
