"""Ranges of the inputs of a joint network's layers, by which these can be rounded to 8 bits.

A layer's range is `MARGIN` times that of all but a share `BEYOND` of its inputs on each side, of the frame with the
widest; where some are negative it is symmetric. It is (0, 0) for the second layer of a block whose first one is below
zero everywhere, on all frames. The first layer, which sees the samples, and the last ones stay exact: rounding them
costs many times what rounding all others does (docs/experiments.md).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polsep.networks.channels import PERIOD
from polsep.networks.graphs import core, joint_model
from polsep.networks.joint_weights import JointWeights
from polsep.networks.openvino_engine import OpenVinoEngine
from polsep.sensor.camera import Mosaic

#: Layers that are rounded, by how their names begin.
ROUNDED = ("net.encoders", "net.downs", "net.ups", "net.decoders", "doubt.0")
#: Share of the inputs beyond each end of what is seen, and the range over that.
BEYOND, MARGIN = 1e-4, 1.5


def measure_ranges(network: JointWeights, frames: Iterable[Mosaic]) -> dict[str, tuple[float, float]]:
    """Least and largest input of every layer of `ROUNDED` on frames ``[H, W]``, H and W multiples of 4.

    Frames are in the network's own order of filters. Raises ValueError without frames.
    """
    bounds: dict[str, list[tuple[float, float]]] = {}
    for frame in frames:
        shape = (frame.data.shape[0], frame.data.shape[1])
        engine = OpenVinoEngine(network, shape, precision="f32")
        engine.prepare(np.asarray(frame.data), (frame.black_level, frame.white_level), frame.light_color)
        model = joint_model(network, (shape[0] // PERIOD, shape[1] // PERIOD), full=False)
        layers = {op.get_friendly_name(): op for op in model.get_ops() if op.get_type_name() == "Convolution"}
        names = [name for name in layers if name.startswith(ROUNDED)]
        model.add_outputs([layers[name].input_value(0) for name in names])
        request = core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"}).create_infer_request()
        found = list(request.infer([np.moveaxis(seen, -1, 0)[None] for seen in engine.inputs]).values())
        for name, values in zip(names, found[-len(names) :], strict=True):
            ends = np.quantile(values, [BEYOND, 1 - BEYOND]) if np.mean(values > 0) > BEYOND else values
            bounds.setdefault(name, []).append((MARGIN * float(ends.min()), MARGIN * float(ends.max())))
    if not bounds:
        raise ValueError("expected at least one frame to measure ranges on, found none")
    return {name: _widest(found) for name, found in bounds.items()}


def pruned(arrays: Mapping[str, NDArray[Any]], ranges: Mapping[str, tuple[float, float]]) -> dict[str, NDArray[Any]]:
    """A joint network's arrays with zeros for the weights of what its ``ranges`` say is inactive; its images stay.

    That is a block whose second layer has the range (0, 0), or a level, and all deeper ones, if the layer that leads
    up from it has. Wheels compress zeros, and a training that starts from them draws new weights (`train.growth`).
    """
    found = dict(arrays)
    for layer, bounds in ranges.items():
        if bounds[0] == bounds[1] == 0:
            inactive = _inactive_with(layer)
            found |= {name: np.zeros_like(array) for name, array in arrays.items() if inactive.match(name)}
    return found


def _inactive_with(layer: str) -> re.Pattern[str]:
    """Names of arrays that change nothing where a layer's input is 0; the layer's own bias is not among them."""
    part, level, *_ = layer.removeprefix("net.").split(".")
    if part != "ups":
        return re.compile(rf"{re.escape(layer.removesuffix('.second'))}\.(first\.|second\.weight)")
    below, beyond = rf"[{level}-9]", rf"[{int(level) + 1}-9]"
    return re.compile(rf"net\.(downs\.{below}|encoders\.{beyond}|(ups|decoders)\.{beyond}|ups\.{level}\.weight)(\.|$)")


def _widest(bounds: list[tuple[float, float]]) -> tuple[float, float]:
    """One range for all: from 0 where nothing is negative, else of as many steps below 0 as bytes with sign have."""
    low, high = min(low for low, _ in bounds), max(high for _, high in bounds)
    if low >= 0:
        return 0.0, high
    largest = max(-low * 127 / 128, high)
    return -largest * 128 / 127, largest
