"""The networks as OpenVINO models, built from their files of weights: no torch, no other files.

Twins: the torch modules `joint.Joint` (its layers), `whole_frame.WholeFrame`, `paper.Refinement` and
`shape.ShapeNetwork`.

Layers whose inputs have known ranges (`ranges`) can be rounded to 8 bits: inputs in 256 steps of one size, weights in
255 steps of one size per output, as processors multiply them (Jacob et al. 2018, arXiv:1712.05877). Blocks whose
second layer has the range (0, 0) only add its bias: training left them inactive.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from polsep.networks.channels import DETAIL_MAPS, MAX_LOG_VARIANCE, input_channels
from polsep.networks.joint_weights import Arrays, JointWeights
from polsep.networks.sizes import ResidualSize, Size
from polsep.networks.thumbnails import SIDE, WIDTHS, thumbnail_channels

#: A value in a graph.
Node = Any
#: Least and largest input of layers, by name.
Ranges = Mapping[str, tuple[float, float]]


def import_openvino() -> Any:
    """OpenVINO without its telemetry, which reports its import to Google from a forked process that may hang.

    None in the place of the telemetry's module makes OpenVINO do without.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino  # type: ignore[import-untyped]  # no stubs

    return openvino


class _Process:
    """State of the process: whether it was ``forked`` from one that had used OpenVINO."""

    forked = False


def _note_fork() -> None:
    _Process.forked = _Process.forked or core.cache_info().currsize > 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def require_own_threads() -> None:
    """Raise RuntimeError in a child that was forked after networks had run: it would wait for OpenVINO's threads."""
    if _Process.forked:
        raise RuntimeError(
            "expected networks in a process with their threads, found one that was forked after they had run: start it "
            'by multiprocessing.get_context("spawn"), or fork before'
        )


@lru_cache(maxsize=1)
def core() -> Any:
    """OpenVINO's core, one for the life of the process.

    Note: OpenVINO's CPU plugin gives the thread that loads it a signal stack, and frees that when the plugin ends, even
    in another thread or under a newer plugin. The next signal that Python catches, Ctrl-C say, then ends the process
    without a message. The plugin lives as long as its core.
    """
    return import_openvino().Core()


class _Graph:
    """Layers by the names of their arrays, ``quantized`` where their ``ranges`` are known; convolutions keep names."""

    def __init__(self, arrays: Arrays, ranges: Ranges | None = None, quantized: bool = False) -> None:
        import_openvino()
        from openvino import opset13

        self.ops, self.arrays, self.ranges, self.quantized = opset13, arrays, ranges or {}, quantized

    def convolve(self, x: Node, name: str, stride: int = 1) -> Node:
        """A convolution that keeps the size, but for its stride."""
        weight, bias = (self.arrays[f"{name}.{part}"] for part in ("weight", "bias"))
        factors = self.ops.constant(weight)
        low, high = self.ranges.get(name, (0.0, 0.0))
        if self.quantized and high > low:
            x = self.quantize(x, 256, *(np.full((1, 1, 1, 1), bound) for bound in (low, high)))
            largest = np.maximum(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), 1e-12)
            factors = self.quantize(factors, 255, -largest, largest)
        return self._add_bias(self._convolution(x, factors, weight.shape[-1], stride, name), bias)

    def quantize(self, x: Node, levels: int, low: Any, high: Any) -> Node:
        """``x`` rounded to so many levels between bounds that broadcast to it."""
        bounds = [self.ops.constant(bound.astype(np.float32)) for bound in (low, high)]
        return self.ops.fake_quantize(x, *bounds, *bounds, levels)

    def correlate(self, x: Node, weight: Any, bias: Any, name: str) -> Node:
        """A convolution with arrays ``[n, m, k, k]`` and ``[n]``."""
        return self._add_bias(self._convolution(x, self.ops.constant(weight), weight.shape[-1], 1, name), bias)

    def _convolution(self, x: Node, weight: Node, side: int, stride: int, name: str) -> Node:
        margin = [side // 2] * 2
        found = self.ops.convolution(x, weight, [stride, stride], margin, margin, [1, 1])
        found.set_friendly_name(name)
        return found

    def _add_bias(self, x: Node, bias: Any) -> Node:
        return self.ops.add(x, self.ops.constant(bias.reshape(1, -1, 1, 1)))

    def relu(self, x: Node) -> Node:
        """max(x, 0)."""
        return self.ops.relu(x)

    def block(self, x: Node, name: str) -> Node:
        """A `unet.Block`."""
        if self.ranges.get(f"{name}.second") == (0, 0):
            return self._add_bias(x, self.arrays[f"{name}.second.bias"])
        return self.ops.add(x, self.convolve(self.relu(self.convolve(x, f"{name}.first")), f"{name}.second"))

    def chain(self, x: Node, name: str, count: int) -> Node:
        """So many blocks."""
        for k in range(count):
            x = self.block(x, f"{name}.{k}")
        return x

    def two(self, x: Node, name: str) -> Node:
        """A `unet.DoubleConv`."""
        return self.relu(self.convolve(self.relu(self.convolve(x, f"{name}.0")), f"{name}.2"))

    def part(self, x: Node, first: int, last: int, axis: int = 1) -> Node:
        """``x`` from ``first`` to before ``last`` along an axis."""
        bounds = (self.ops.constant([n], np.int64) for n in (first, last, 1))
        return self.ops.slice(x, *bounds, self.ops.constant([axis], np.int64))

    def enlarge(self, x: Node, size: Sequence[int]) -> Node:
        """Nearest neighbours at twice the resolution, cut to ``size``."""
        scales, axes = self.ops.constant([2.0, 2.0], np.float32), self.ops.constant([2, 3], np.int64)
        x = self.ops.interpolate(
            x, scales, "nearest", "scales", coordinate_transformation_mode="asymmetric", nearest_mode="floor", axes=axes
        )
        for axis in (2, 3):
            if x.get_output_shape(0)[axis] != size[axis]:
                x = self.part(x, 0, size[axis], axis)
        return x

    def residual_unet(self, x: Node, size: ResidualSize, changes: Sequence[tuple[Node, Node]]) -> Node:
        """A `unet.ResidualUNet`."""
        names = ("net.enter.0", "net.enter.1") if size.entry else ("net.enter",)
        for name in names:
            x = self.convolve(x, name)
        x, skips = self.modulate(x, changes, 0), []
        for level, count in enumerate(size.blocks[:-1]):
            x = self.chain(x, f"net.encoders.{level}", count)
            skips.append(x)
            x = self.modulate(self.convolve(self.relu(x), f"net.downs.{level}", 2), changes, level + 1)
        x = self.chain(x, f"net.encoders.{len(skips)}", size.blocks[-1])
        for level in reversed(range(len(skips))):
            skip = skips[level]
            x = self.enlarge(self.convolve(self.relu(x), f"net.ups.{level}"), skip.get_output_shape(0))
            x = self.chain(self.ops.add(skip, x), f"net.decoders.{level}", size.blocks[level])
        return self.relu(self.chain(x, "net.out", 1))

    def modulate(self, x: Node, changes: Sequence[tuple[Node, Node]], level: int) -> Node:
        """The twin of `unet.modulate`."""
        if not changes:
            return x
        scale, shift = changes[level]
        return self.ops.add(self.ops.multiply(x, self.ops.add(scale, np.float32(1))), shift)

    def unet(self, x: Node, prefix: str, size: Size) -> Node:
        """A `unet.UNet` of an image whose sides are multiples of `Size.multiple`."""
        from openvino import opset1

        ops = self.ops
        if size.fold > 1:
            x = ops.space_to_depth(x, "depth_first", size.fold)
        skips = []
        for level in range(size.levels):
            x = self.two(x, f"{prefix}.encoders.{level}")
            skips.append(x)
            x = opset1.max_pool(x, [2, 2], [0, 0], [0, 0], [2, 2])
        x = self.two(x, f"{prefix}.encoders.{size.levels}")
        for level in reversed(range(size.levels)):
            weight, bias = (self.arrays[f"{prefix}.ups.{level}.{part}"] for part in ("weight", "bias"))
            x = ops.convolution_backprop_data(
                x, ops.constant(weight), [2, 2], pads_begin=[0, 0], pads_end=[0, 0], dilations=[1, 1]
            )
            x = ops.add(x, ops.constant(bias.reshape(1, -1, 1, 1)))
            x = self.two(ops.concat([skips[level], x], 1), f"{prefix}.decoders.{level}")
        x = self.convolve(x, f"{prefix}.last")
        return ops.depth_to_space(x, "depth_first", size.fold) if size.fold > 1 else x


def joint_model(weights: JointWeights, packed: tuple[int, int], full: bool, quantized: bool = False) -> Any:
    """A network's layers for ``packed`` pixels (h, w), twice the size of the mosaic's period.

    From inputs ``[1, n, h, w]``, where ``full`` also `DETAIL_MAPS` of the size of details, and for networks that see a
    whole frame what modulates their features, see `whole_frame_model`. To corrections ``[1, 4 C + 8, h, w]`` of
    diffuse, specular and the closed form's gain (`images_kernel.LayerOutputs`), relative to the local brightness and to
    the closed form; to deviations ``[1, 8, h, w]``; and where ``full`` to ``[1, 24, h, w]`` and ``[1, 12 (C + 1),
    h, w]``, see `details_kernel.DetailOutputs`. ``quantized``: layers with known ranges in 8 bits.
    """
    graph, arrays = _Graph(weights.arrays, weights.ranges, quantized), weights.arrays
    ops, widths = graph.ops, weights.size.widths
    sizes = [input_channels(weights.colors, weights.inputs).total, *[DETAIL_MAPS] * full]
    parameters = [ops.parameter([1, n, *packed], np.float32) for n in sizes]
    changes = []
    if weights.sees_frame:
        parameters.append(ops.parameter([1, 2 * sum(widths), 1, 1], np.float32))
        ends = np.cumsum([0, *(width for width in widths for _ in (0, 1))])
        parts = [graph.part(parameters[-1], int(a), int(b)) for a, b in pairwise(ends)]
        changes = list(zip(parts[::2], parts[1::2], strict=True))
    features = graph.residual_unet(parameters[0], weights.size, changes)
    weight, bias = arrays["last.weight"], arrays["last.bias"]
    gain = [arrays.get(f"trust.{part}") for part in ("weight", "bias")]
    gain = [np.zeros_like(own[:4]) if found is None else found for own, found in zip((weight, bias), gain, strict=True)]
    corrections = graph.correlate(features, np.concatenate([weight, gain[0]]), np.concatenate([bias, gain[1]]), "last")
    log_variance = graph.convolve(graph.relu(graph.convolve(features, "doubt.0")), "doubt.2")
    largest = np.repeat(np.array(MAX_LOG_VARIANCE, np.float32), 4).reshape(1, 8, 1, 1)
    deviation = ops.exp(ops.multiply(ops.minimum(log_variance, largest), np.float32(0.5)))
    outputs = [corrections, deviation]
    if full:
        seen = ops.concat([features, parameters[1]], 1)
        belief = graph.convolve(graph.relu(graph.convolve(seen, "details.belief.0")), "details.belief.2")
        outputs += [belief, graph.convolve(features, "details.change")]
    return import_openvino().Model([ops.result(output) for output in outputs], parameters)


def whole_frame_model(weights: JointWeights) -> Any:
    """`whole_frame.WholeFrame`: thumbnails ``[1, K, SIDE, SIDE]`` to scales and shifts ``[1, 2 sum(widths)]``."""
    graph = _Graph(weights.arrays)
    ops = graph.ops
    thumbnail = x = ops.parameter([1, thumbnail_channels(weights.colors), SIDE, SIDE], np.float32)
    for k in range(len(WIDTHS)):
        x = graph.relu(graph.convolve(x, f"whole_frame.look.{2 * k}", 2))
    axes = np.array([2, 3], np.int64)
    x = ops.concat([ops.reduce_mean(x, axes), ops.reduce_max(x, axes)], 1)
    for name, after in (("common", graph.relu), ("change", lambda y: y)):
        weight, bias = (weights.arrays[f"whole_frame.{name}.{part}"] for part in ("weight", "bias"))
        x = after(ops.add(ops.matmul(x, ops.constant(weight), False, True), ops.constant(bias[None])))
    return import_openvino().Model([ops.result(x)], [thumbnail])


def refinement_model(arrays: Arrays, size: Size, shape: tuple[int, int, int]) -> Any:
    """`paper.Refinement` for inputs ``[1, K, h, w]`` of that ``shape`` (K, h, w), multiples of `Size.multiple`.

    To the images of all its networks and its linear map together ``[1, 2 C, h, w]``.
    """
    graph = _Graph(arrays)
    ops = graph.ops
    inputs = ops.parameter([1, *shape], np.float32)
    count = sum(name.endswith("last.bias") for name in arrays)
    images = [graph.unet(inputs, f"nets.{k}", size) for k in range(count)]
    found = ops.add(images[0] if count == 1 else ops.concat(images, 1), graph.convolve(inputs, "linear"))
    return import_openvino().Model([ops.result(found)], [inputs])


def shape_model(arrays: Arrays, size: ResidualSize, shape: tuple[int, int, int]) -> Any:
    """`shape.ShapeNetwork` for maps ``[1, K, h, w]`` of that ``shape`` (K, h, w), sides a multiple of its fold."""
    graph = _Graph(arrays)
    inputs = graph.ops.parameter([1, *shape], np.float32)
    fold = round((arrays["net.enter.weight"].shape[1] / shape[0]) ** 0.5)
    features = graph.residual_unet(graph.ops.space_to_depth(inputs, "depth_first", fold), size, ())
    found = graph.ops.depth_to_space(graph.convolve(features, "last"), "depth_first", fold)
    return import_openvino().Model([graph.ops.result(found)], [inputs])
