"""The networks that come with polsep: read from their weights once, applied to any frame.

Weights lie in `polsep/weights`; their metadata say which network they belong to.
"""

from __future__ import annotations

import json
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from polsep.io.store.weights import is_shipped, read_weights, shipped_weights
from polsep.networks.joint import Joint
from polsep.networks.paper import RUNGS, Refinement, Rung, separate_refined
from polsep.networks.run import combine, own_order, run_joint
from polsep.networks.unet import ResidualSize, Size
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import orient
from polsep.separation.analytic import Separation

#: Methods of the joint network.
NAMES = ("joint-large", "joint", "joint-fast")
#: Networks of a method that weighs the images of several by their expected errors.
MEMBERS = {"joint-large": ("joint-large", "joint")}
#: Weights of mono networks whose images are averaged over shifts: for stills, at four times the time.
AVERAGED = ("joint-mono",)
#: The paper's networks, trained on noisy mosaics of colour cameras, and of those without colour filters.
PAPER, PAPER_MONO = "paper-mosaic", "paper-mono"

_LOADING = threading.Lock()


def load_joint(path: Path, device: torch.device) -> Joint:
    """The network from a file of weights. Raises ValueError when the file is damaged or of another network."""
    tensors, metadata = read_weights(path)
    try:
        size = json.loads(metadata["size"])
        size = ResidualSize(size["width"], tuple(size["blocks"]), size.get("entry", 0))
        demosaicker: Any = metadata.get("demosaicker", "linear")  # what weights without a word on it were trained with
        inputs, sees_frame = (json.loads(metadata.get(name, "false")) for name in ("inputs", "sees_frame"))
        network = Joint(int(metadata["colors"]), size, tuple(inputs), demosaicker, sees_frame)
        network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"expected weights of a joint network in {path}, found {type(error).__name__}") from None
    return network.to(device, torch.float32).eval()


def shipped_joint(name: str, device: torch.device) -> Joint:
    """The joint network of a name of weights; the same object whoever asks, since engines are kept by network."""
    with _LOADING:
        return _read_joint(name, device)


@lru_cache(maxsize=8)
def _read_joint(name: str, device: torch.device) -> Joint:
    network = load_joint(shipped_weights(name), device)
    network.averages_shifts = name in AVERAGED
    return network


def find_joint(method: str, layout: Layout, path: Path | None) -> tuple[Joint, dict[str, str]]:
    """A method's network for frames of a layout, shipped or from a file of weights, and the weights' metadata.

    Raises ValueError on methods without such a network, and on weights for other frames.
    """
    if method not in NAMES:
        raise ValueError(f"expected a method of {', '.join(NAMES)}, found {method!r}")
    path = path or shipped_weights(weights_name(method, layout))
    network, metadata = load_joint(path, torch.device("cpu")), read_weights(path)[1]
    if network.colors != layout.channels:
        raise ValueError(f"expected weights for {layout.channels} colours in {path}, found {network.colors}")
    return network, metadata


def weights_name(method: str, layout: Layout) -> str:
    """The name of a method's weights for frames of a layout."""
    return f"{method}-{'mono' if layout.bayer is None else 'mosaic'}"


def member_names(method: str, layout: Layout) -> tuple[str, ...]:
    """The names of the weights of all networks of a method, for frames of a layout."""
    return tuple(weights_name(member, layout) for member in MEMBERS.get(method, (method,)))


def separate_joint(method: str, capture: Mosaic | Measurements, full: bool = False) -> Separation:
    """Separate a mosaic by a method of `NAMES` in torch, with shipped weights.

    Raises ValueError on co-sited measurements, and on layouts that are not Sony's in any orientation.
    """
    if isinstance(capture, Measurements):
        raise ValueError(f"expected a mosaic for the method {method}, found four co-sited angle images")
    networks = (shipped_joint(name, capture.data.device) for name in member_names(method, capture.layout))
    return combine([run_joint(network, capture, full) for network in networks])


def accepts_mosaic(method: str, capture: Mosaic | Measurements) -> bool:
    """True for a mosaic in an order that the method knows, with weights shipped for its colours."""
    if isinstance(capture, Measurements) or not is_shipped(weights_name(method, capture.layout)):
        return False
    try:
        orient(capture, own_order(capture.layout))
    except ValueError:
        return False
    return True


def load_refinement(path: Path, device: torch.device) -> tuple[Rung, Refinement]:
    """The rung and its networks from a file of weights.

    Raises ValueError when the file is damaged or of another network.
    """
    tensors, metadata = read_weights(path)
    try:
        rung = RUNGS[metadata["rung"]]
        network = Refinement(rung, int(metadata["colors"]), Size(**json.loads(metadata["size"])))
        network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"expected weights of a refinement in {path}, found {type(error).__name__}") from None
    return rung, network.to(device, torch.float32).eval()


@lru_cache(maxsize=4)
def _read_refinement(name: str, device: torch.device) -> tuple[Rung, Refinement]:
    return load_refinement(shipped_weights(name), device)


def separate_paper(measurements: Measurements) -> Separation:
    """The paper's method: an analytic split refined by two U-Nets. ``[..., 4, C, h, w]``, C = 3 or 1.

    Mono frames have networks of their own where those are shipped, else they go through as grey ones.
    Source: Dave et al. 2022, Sec. 4.
    """
    name = PAPER_MONO if measurements.data.shape[-3] == 1 and is_shipped(PAPER_MONO) else PAPER
    rung, network = _read_refinement(name, measurements.data.device)
    if measurements.data.shape[-3] == network.colors:
        return separate_refined(measurements, rung, network)
    data, clipped = measurements.data, measurements.clipped
    shape = (*data.shape[:-3], network.colors, *data.shape[-2:])
    copies = Measurements(data.expand(shape), measurements.angles, None if clipped is None else clipped.expand(shape))
    found = separate_refined(copies, rung, network)
    diffuse, specular = (x.mean(dim=-3, keepdim=True) for x in (found.diffuse, found.specular))
    return Separation(diffuse, specular, found.valid, found.stokes.map(lambda s: s.mean(dim=-3, keepdim=True)))
