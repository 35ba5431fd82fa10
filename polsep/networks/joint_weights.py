"""A joint network as its file of weights describes it, for whatever runs it: torch (`joint`) or OpenVINO (`graphs`)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polsep.networks.channels import DETAIL_MAPS, INPUTS, PERIOD, input_channels
from polsep.networks.sizes import ResidualSize
from polsep.networks.thumbnails import COMMON, LIGHT, WIDTHS, thumbnail_channels
from polsep.sensor.camera import Layout

Arrays = Mapping[str, NDArray[np.float32]]
#: Parts of `joint.Joint` whose parameters have other names in files of weights.
NAMES_IN_FILES = {
    "corrections": "last",
    "closed_form_gain": "trust",
    "polarization": "pose",
    "log_variance": "doubt",
}
#: Channels between features and shares of details, and between features and variances.
HIDDEN, VARIANCE_HIDDEN = 32, 16


@dataclass(frozen=True, eq=False)
class JointWeights:
    """Sizes and ``arrays`` of a joint network, by their names in files; two are equal if they are one object.

    ``colors``: 3, or 1 for mono frames. ``inputs``: the groups of `channels.GROUPS` that it sees. ``averages_shifts``:
    frames are separated at all of `orient.shifts_of` and combined: with less noise, and of mono frames no pattern of a
    period is left. ``share``: factor on its weight among networks that are combined. ``ranges``: least and largest
    input of layers that may be rounded to 8 bits, by name, see `ranges`. Raises ValueError when arrays are missing or
    of other shapes.
    """

    colors: int
    size: ResidualSize
    arrays: Arrays
    inputs: tuple[str, ...] = INPUTS
    averages_shifts: bool = False
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    share: float = 1.0

    def __post_init__(self) -> None:
        found = {name: array.shape for name, array in self.arrays.items()}
        wrong = [
            f"{name} {shape or 'none'}" for name, shape in expected_shapes(self).items() if found.get(name) != shape
        ]
        if wrong:
            raise ValueError(f"expected {len(wrong)} arrays of other shapes, the first {wrong[0]}")

    @property
    def layout(self) -> Layout:
        """The order of filters that it was trained on."""
        return Layout.sony(self.colors)

    @property
    def demosaic(self) -> NDArray[np.float32] | None:
        """The linear filter ``[24 C, 16, 3, 3]`` of `joint.bilinear_filter`; None with guided demosaicking."""
        return self.arrays.get("demosaic")

    @property
    def sees_frame(self) -> bool:
        """True for a network that sees a thumbnail of the whole frame."""
        return "whole_frame.light.bias" in self.arrays


def joint_weights(arrays: Arrays, metadata: Mapping[str, str], averages_shifts: bool = False) -> JointWeights:
    """The network of a file's arrays and metadata. Raises KeyError, TypeError or ValueError when it is of another."""
    size = json.loads(metadata["size"])
    size = ResidualSize(size["width"], tuple(size["blocks"]), size.get("entry", 0))
    ranges = {name: (float(low), float(high)) for name, (low, high) in json.loads(metadata.get("ranges", "{}")).items()}
    inputs = tuple(json.loads(metadata["inputs"]))
    return JointWeights(int(metadata["colors"]), size, arrays, inputs, averages_shifts, ranges)


def scale_errors(arrays: Arrays, factors: tuple[float, float]) -> Arrays:
    """The arrays of a network that expects ``factors`` times the errors of diffuse and of specular; images stay."""
    change = 2 * np.log(np.asarray(factors, np.float32)).repeat((PERIOD // 2) ** 2)  # of each pixel of a period
    name = f"{NAMES_IN_FILES['log_variance']}.2.bias"
    return {**arrays, name: arrays[name] + change}


def expected_shapes(weights: JointWeights) -> dict[str, tuple[int, ...]]:
    """Shapes of all arrays of a network, by name; those of a filter or of `whole_frame` where it has any of them."""
    colors, size = weights.colors, weights.size
    width = size.widths[0]
    outputs = {"last": 4 * (colors + 1), "pose": 4} | ({"trust": 4} if "split" in weights.inputs else {})
    layers = {name: (count, width, 1) for name, count in outputs.items()}
    layers |= {"doubt.0": (VARIANCE_HIDDEN, width, 3), "doubt.2": (8, VARIANCE_HIDDEN, 1)}
    layers |= {"details.belief.0": (HIDDEN, width + DETAIL_MAPS, 3), "details.belief.2": (2 * DETAIL_MAPS, HIDDEN, 1)}
    layers |= {"details.change": (DETAIL_MAPS * (colors + 1), width, 1)}
    layers |= _unet_layers(input_channels(colors, weights.inputs).total, size)
    if weights.sees_frame:
        pairs = pairwise((thumbnail_channels(colors), *WIDTHS))
        layers |= {f"whole_frame.look.{2 * k}": (outputs, inputs, 3) for k, (inputs, outputs) in enumerate(pairs)}
    shapes: dict[str, tuple[int, ...]] = {"details.smooth": (3, 1, 5, 5)}
    for name, (outgoing, incoming, kernel) in layers.items():
        shapes |= {f"{name}.weight": (outgoing, incoming, kernel, kernel), f"{name}.bias": (outgoing,)}
    if weights.sees_frame:
        linear = {"common": (COMMON, 2 * WIDTHS[-1]), "light": (2 * len(LIGHT), COMMON)}
        linear |= {"change": (2 * sum(size.widths), COMMON)}
        for name, shape in linear.items():
            shapes |= {f"whole_frame.{name}.weight": shape, f"whole_frame.{name}.bias": shape[:1]}
    if weights.demosaic is not None:
        shapes["demosaic"] = (24 * colors, PERIOD**2, 3, 3)
    return shapes


def _unet_layers(inputs: int, size: ResidualSize) -> dict[str, tuple[int, int, int]]:
    """Output and input channels and kernel of the layers of a `unet.ResidualUNet`."""
    widths = size.widths
    layers = {"net.enter": (size.width, inputs, 3)}
    if size.entry:
        layers = {"net.enter.0": (size.entry, inputs, 1), "net.enter.1": (size.width, size.entry, 3)}
    chains = [("net.out", widths[0], 1)]
    chains += [(f"net.encoders.{k}", w, n) for k, (w, n) in enumerate(zip(widths, size.blocks, strict=True))]
    chains += [(f"net.decoders.{k}", w, n) for k, (w, n) in enumerate(zip(widths[:-1], size.blocks, strict=False))]
    for name, width, count in chains:
        layers |= {f"{name}.{k}.{half}": (width, width, 3) for k in range(count) for half in ("first", "second")}
    for k, (upper, lower) in enumerate(pairwise(widths)):
        layers |= {f"net.downs.{k}": (lower, upper, 3), f"net.ups.{k}": (upper, lower, 1)}
    return layers
