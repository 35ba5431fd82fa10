"""Maps of a flat material from photographs of it, by the shipped networks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from polsep.io.store.weights import read_weights, shipped_weights
from polsep.material.network import MaterialNetwork, MaterialSize
from polsep.material.svbrdf import INPUTS, Svbrdf, unstack


@dataclass(frozen=True)
class Estimator:
    """A trained ``network`` and its ``input``, of `svbrdf.INPUTS`."""

    network: MaterialNetwork
    input: str

    def estimate(self, views: Tensor) -> Svbrdf:
        """Maps ``[C, h, w]`` of views ``[V, C, h, w]``, 1 = white paper under the same light, in any order.

        Raises ValueError on another number of channels.
        """
        if views.ndim != 4 or views.shape[1] != self.network.inputs:
            raise ValueError(f"expected views [V, {self.network.inputs}, h, w], found {tuple(views.shape)}")
        with torch.no_grad():
            return unstack(self.network(views[None].float())[0])


def load_estimator(name: str = "separated", path: Path | None = None) -> Estimator:
    """The shipped network for an input, or the one in a file of `polsep train material`.

    Raises ValueError on unknown inputs, missing files and weights of another network.
    """
    if path is None and name not in INPUTS:
        raise ValueError(f"expected an input of {', '.join(INPUTS)}, found {name!r}")
    source = shipped_weights(f"material/{name}") if path is None else path
    arrays, metadata = read_weights(source)
    if metadata["method"] != "material":
        raise ValueError(f"expected weights of a network for materials in {source}, found {metadata['method']!r}")
    size = json.loads(metadata["size"])
    channels = INPUTS[metadata["input"]]
    network = MaterialNetwork(
        channels.stop - channels.start, MaterialSize(size["width"], tuple(size["growth"]), tuple(size.get("cues", ())))
    )
    network.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    return Estimator(network.eval(), metadata["input"])
