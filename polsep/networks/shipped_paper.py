"""Methods with learned weights: the networks that come with polsep, loaded once, applied to any frame.

Weights are those of `polsep/weights`, read by `io.store.weights`; their metadata says which network they belong to.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path

import torch

from polsep.io.store.weights import is_shipped, read_weights, shipped_weights
from polsep.networks.paper import RUNGS, Refinement, Rung, separate_refined
from polsep.networks.unet import Size
from polsep.physics.stokes import Measurements
from polsep.separation.analytic import Separation

#: The paper's networks, trained on noisy mosaics of colour cameras, and of those without colour filters.
PAPER, PAPER_MONO = "paper-mosaic", "paper-mono"


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
def _shipped_refinement(name: str, device: torch.device) -> tuple[Rung, Refinement]:
    return load_refinement(shipped_weights(name), device)


def separate_paper(measurements: Measurements) -> Separation:
    """The paper's method: an analytic split refined by two U-Nets. ``[..., 4, C, h, w]``, C = 3 or 1.

    Mono frames have networks of their own where those are shipped, else they go through as grey ones.
    Source: Dave et al. 2022, Sec. 4.
    """
    name = PAPER_MONO if measurements.data.shape[-3] == 1 and is_shipped(PAPER_MONO) else PAPER
    rung, network = _shipped_refinement(name, measurements.data.device)
    if measurements.data.shape[-3] == network.colors:
        return separate_refined(measurements, rung, network)
    data, clipped = measurements.data, measurements.clipped
    shape = (*data.shape[:-3], network.colors, *data.shape[-2:])
    copies = Measurements(data.expand(shape), measurements.angles, None if clipped is None else clipped.expand(shape))
    found = separate_refined(copies, rung, network)
    diffuse, specular = (x.mean(dim=-3, keepdim=True) for x in (found.diffuse, found.specular))
    return Separation(diffuse, specular, found.valid, found.stokes.map(lambda s: s.mean(dim=-3, keepdim=True)))
