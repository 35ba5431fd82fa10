"""The networks that come with polsep as torch modules: on CUDA, in batches, for training and export.

Twins on CPUs without torch: `shipped`, `networks.engines`. Needs the extra torch.
"""

from __future__ import annotations

import json
import threading
from functools import lru_cache
from pathlib import Path

import torch

from polsep.io.store.weights import read_weights, shipped_weights
from polsep.networks.joint import Joint
from polsep.networks.joint_weights import JointWeights
from polsep.networks.paper import Refinement
from polsep.networks.run import combine, run_joint
from polsep.networks.rungs import RUNGS, Rung
from polsep.networks.sizes import Size
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Mosaic
from polsep.separation.analytic import Separation
from polsep.separation.clipped_pattern import smooth_separation
from polsep.shipped import paper_name, read_joint, separate_colors, shipped_joint

_LOADING = threading.Lock()


def load_joint(path: Path, device: torch.device) -> Joint:
    """The network in a file of weights. Raises ValueError when the file is damaged or of another network."""
    return Joint.of(read_joint(path), device)


@lru_cache(maxsize=8)
def _shipped(weights: JointWeights, device: torch.device) -> Joint:
    network = Joint.of(weights, device)
    if device.type == "cuda":  # tensor cores read channels innermost; other processors gain nothing
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def separate_joint(method: str, mosaic: Mosaic, full: bool = False) -> Separation:
    """Separate mosaics ``[..., H, W]`` by a method of `shipped.NAMES`, with shipped weights.

    Raises ValueError on layouts that are not Sony's in any orientation.
    """
    with _LOADING:
        networks = [_shipped(weights, mosaic.data.device) for weights in shipped_joint(method, mosaic.layout)]
    shares = [network.share for network in networks]
    return smooth_separation(combine([run_joint(network, mosaic, full) for network in networks], shares), mosaic)


def load_refinement(path: Path, device: torch.device) -> tuple[Rung, Refinement]:
    """The rung and its networks in a file of weights.

    Raises ValueError when the file is damaged or of another network.
    """
    arrays, metadata = read_weights(path)
    try:
        rung = RUNGS[metadata["rung"]]
        network = Refinement(rung, int(metadata["colors"]), Size(**json.loads(metadata["size"])))
        network.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"expected weights of a refinement in {path}, found {type(error).__name__}") from None
    return rung, network.to(device, torch.float32).eval()


@lru_cache(maxsize=4)
def _shipped_refinement(name: str, device: torch.device) -> tuple[Rung, Refinement]:
    return load_refinement(shipped_weights(name), device)


def separate_paper(measurements: Measurements) -> Separation:
    """`shipped.separate_paper` of tensors, on their device."""
    rung, network = _shipped_refinement(paper_name(measurements), measurements.data.device)
    with torch.no_grad():
        return separate_colors(measurements, rung, network, network.colors)
