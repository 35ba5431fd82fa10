"""Weights of a small joint network in a larger one that gives the same images, so that training goes on from there.

A larger network has more residual blocks per level, whose last convolutions start at zero, or more channels, on which
nothing that was there depends at first. It need not learn again what the small one knows (Chen et al. 2016, Net2Net,
arXiv 1511.05641). Blocks and levels that an earlier training left inactive, all 0 in the file (`networks.ranges`),
begin again in the same way. A network for mono frames can begin as one for colour frames, of which every frame is grey.
"""

from __future__ import annotations

import re

import torch
from torch import Tensor

from polsep.networks.channels import input_channels
from polsep.networks.joint import Joint

#: Parts that a smaller network may lack: they change nothing until they are trained.
NEW_PARTS = re.compile(r"whole_frame\.|net\.(encoders|decoders)\.\d+\.\d+\.")
#: Layers that begin again where they are 0: among zeros alone a gradient stays 0. What follows them is 0, too.
RESTARTED = re.compile(r"net\.(downs|encoders|decoders)\.")


def grow(tensors: dict[str, Tensor], network: Joint) -> dict[str, Tensor]:
    """Return the state of a network with the weights of a smaller one in it.

    What the smaller one lacks, and what is 0 in it, keeps its initial values, but old outputs do not depend on new
    inputs, nor on a level that was inactive. A network of one colour takes weights of three, see `for_one_color`, and
    keeps its own linear filter. Raises ValueError on weights of a network that is not a part of this one.
    """
    state = {name: value.clone() for name, value in network.state_dict().items()}
    if network.colors == 1 and "last.bias" in tensors and len(tensors["last.bias"]) == 16:
        tensors = for_one_color(tensors, network.inputs)
        tensors |= {name: value for name, value in state.items() if name == "demosaic"}
    lacking = [name for name in state if name not in tensors and not NEW_PARTS.match(name)]
    if lacking or not tensors.keys() <= state.keys():
        raise ValueError(
            f"expected weights of the same parts, found {sorted(lacking or tensors.keys() - state.keys())}"
        )
    downs = [tensors[name].shape[0] for name in tensors if re.fullmatch(r"net\.downs\.\d+\.bias", name)]
    places = _moved((tensors["details.change.weight"].shape[1], *downs), network.size.widths)
    for name, old in tensors.items():
        if old.any() or not RESTARTED.match(name):
            state[name] = _embed(old, state[name], places.get(name))
    return state


def for_one_color(tensors: dict[str, Tensor], inputs: tuple[str, ...]) -> dict[str, Tensor]:
    """Return the weights of a network of three colours, without its linear filter, for frames of one colour.

    The images are those of a frame that is grey everywhere, the diffuse one the mean over colours: weights of equal
    inputs are added up, those of the colours' outputs averaged. ``inputs``: as of `Joint`.
    """
    changed = {name: value for name, value in tensors.items() if name != "demosaic"}
    for name, cells in (("last", 4), ("details.change", 12)):
        for part in ("weight", "bias"):
            value = changed[f"{name}.{part}"]
            grey = torch.stack(value[: 3 * cells].chunk(3)).mean(dim=0)
            changed[f"{name}.{part}"] = torch.cat([grey, value[3 * cells :]])
    first = input_channels(3, inputs).diffuse
    name = "net.enter.weight" if "net.enter.weight" in changed else "net.enter.0.weight"
    if first >= 0:
        before, own, after = changed[name].tensor_split((first, first + 12), dim=1)
        changed[name] = torch.cat([before, torch.stack(own.chunk(3, dim=1)).sum(dim=0), after], dim=1)
    name = "whole_frame.look.0.weight"
    if name in changed:
        light, after = changed[name].tensor_split((15,), dim=1)
        changed[name] = torch.cat([light[:, 0::3] + light[:, 1::3] + light[:, 2::3], after], dim=1)
    return changed


def _moved(old: tuple[int, ...], new: tuple[int, ...]) -> dict[str, tuple[int, Tensor]]:
    """Dimension and indices of old outputs and inputs that are not the first ones of a larger network."""
    starts = [2 * sum(new[:level]) for level in range(len(new))]
    parts = [
        at + torch.arange(few)
        for few, many, start in zip(old, new, starts, strict=False)
        for at in (start, start + many)
    ]
    scales = (0, torch.cat(parts))
    features = (1, torch.cat([torch.arange(old[0]), new[0] + torch.arange(12)]))
    return {"whole_frame.change.weight": scales, "whole_frame.change.bias": scales, "details.belief.0.weight": features}


def _embed(old: Tensor, new: Tensor, moved: tuple[int, Tensor] | None) -> Tensor:
    """New weights with the old ones at their first outputs and inputs, or at indices of one dimension."""
    if old.shape == new.shape:
        return old
    if (
        old.ndim != new.ndim
        or old.shape[2:] != new.shape[2:]
        or any(a > b for a, b in zip(old.shape, new.shape, strict=True))
    ):
        raise ValueError(f"expected weights of a part of {tuple(new.shape)}, found {tuple(old.shape)}")
    places = [torch.arange(n) for n in old.shape[:2]]
    if moved is not None:
        places[moved[0]] = moved[1]
    grown = new.clone()
    grown[places[0]] = 0
    grown[tuple(torch.meshgrid(*places, indexing="ij"))] = old
    return grown
