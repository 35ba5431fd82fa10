"""The joint network on CPUs for frames of one size: kernels make its inputs, OpenVINO runs its layers, kernels images.

The same as `run.run_joint`, in less time. Layers run in what is fastest on the processor: bfloat16 where it has matrix
tiles for it, else most of them in 8-bit integers where it multiplies those, and others in bfloat16 where its vector
units are faster with it; else in float32. The closed form and the
images are float32 always.
"""

from __future__ import annotations

import os
import threading
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.processor import cpu_flags, is_amd
from polsep.compute.threads import RowRange, get_threads, run_over_rows
from polsep.demosaic.bilinear_kernel import Pattern, read_pattern
from polsep.demosaic.cells_kernel import Source, read_grid
from polsep.networks.buffers import ChannelsLast, ClosedFormRows, Maps
from polsep.networks.channels import DETAIL_MAPS, PERIOD, input_channels
from polsep.networks.details_kernel import DetailOutputs, emit_details, find_beyond, read_smooth, write_pixels
from polsep.networks.graphs import core, import_openvino, joint_model, whole_frame_model
from polsep.networks.images_kernel import LayerOutputs, Targets, write_rows
from polsep.networks.joint_weights import JointWeights
from polsep.networks.maps_kernel import map_guided_rows, map_rows
from polsep.networks.taps import make_taps
from polsep.networks.whole_frame_kernel import thumbnail_of
from polsep.physics.stokes import stokes_inverse
from polsep.sensor.unpack_kernel import RawFrame, Samples, as_samples
from polsep.separation.images import FrameImages, Tally

Floats = NDArray[np.float32]

#: Precisions of layers, and those of layers that are not in 8 bits.
PRECISIONS = {"bf16": "bf16", "f32": "f32", "i8": "f32", "i8-bf16": "bf16"}
#: Packed rows that a thread processes at a time.
_ROWS = 16
#: Packed columns up to which layers run in float32: OpenVINO 2026.4's bfloat16 and 8-bit layers of matrix tiles (AMX)
#: read memory that nobody filled there, and made values of 1e34 of it.
_NARROW = 4


class RawRows(NamedTuple):
    """Rows ``raw [H, W]`` of a frame, with black and white ``levels`` and a ``light`` of one gain per colour.

    ``modulation``: `modulation_of` the frame that they are of; None where it is all of it.
    """

    raw: RawFrame
    levels: tuple[float, float]
    light: tuple[float, ...]
    modulation: Floats | None


class OpenVinoEngine:
    """A network for frames of one shape in its own order of filters, H and W multiples of 4.

    ``full``: images at full instead of half resolution. ``precision`` of layers: "bf16", "f32", "i8" (those of
    `JointWeights.ranges`, others in float32), "i8-bf16" (others in bfloat16), or None for what suits the processor;
    narrow frames have float32. State:
    compiled layers and buffers between raw samples and images, for one frame at a time. ``inputs [h, w, n]``:
    what `prepare` fills.
    """

    def __init__(
        self, network: JointWeights, shape: tuple[int, int], full: bool = False, precision: str | None = None
    ) -> None:
        self._lock, self._colors, self._full = threading.Lock(), network.colors, full
        self._layout = network.layout
        h, w = shape[0] // PERIOD, shape[1] // PERIOD
        channels = input_channels(network.colors, network.inputs)
        precision = "f32" if w <= _NARROW else precision or asked_precision() or usual_precision()
        others = PRECISIONS.get(precision, precision)
        halves = others == "bf16"
        inputs = ChannelsLast.empty((h, w, channels.total), halves)
        closed = ClosedFormRows.empty(network.colors, h, w)
        beyond = np.empty((2 * h, 3 * network.colors, 2 * w) if full else (0, 0, 0), np.float32)
        self._maps = Maps(inputs.floats, inputs.halves, channels, closed, beyond)
        self._taps = None if network.demosaic is None else make_taps(network.demosaic, network.colors, w, full)
        self._outputs = LayerOutputs.empty(closed, halves)
        self.inputs, outputs = [inputs.filled], [self._outputs.change.filled, self._outputs.deviation.filled]
        if full:
            smooth = read_smooth(network.arrays["details.smooth"])
            self._details = DetailOutputs.empty(network.colors, beyond, smooth, halves)
            self._detail_input = ChannelsLast.empty((h, w, DETAIL_MAPS), halves)
            self.inputs.append(self._detail_input.filled)
            outputs += [self._details.shares.filled, self._details.change.filled]
        self._network, self._modulation = network, np.zeros((1, 1, 2 * sum(network.size.widths)), np.float32)
        if network.sees_frame:
            self.inputs = [*self.inputs, self._modulation]
        model = joint_model(network, (h, w), full, quantized=precision.startswith("i8"))
        self._request = _compile(model, self.inputs, outputs, others)

    def run(
        self, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...], modulation: Floats | None = None
    ) -> FrameImages:
        """Images of a frame ``[H, W]``; arguments as of `RawRows`."""
        cells = 1 if self._full else 2
        targets = Targets.empty((raw.shape[0] // cells, raw.shape[1] // cells), self._colors)
        self.fill(RawRows(raw, levels, light, modulation), targets, (0, raw.shape[0] // PERIOD))
        return as_images(targets)

    def fill(self, seen: RawRows, targets: Targets, kept: RowRange) -> None:
        """Fill images of what is seen, in packed rows from ``kept[0]`` to before ``kept[1]``; leave others alone."""
        first, gains = kept[0], np.array(seen.light[: self._colors], np.float32)

        def write(rows: RowRange) -> None:
            own = (first + rows[0], first + rows[1])
            if self._full:
                write_pixels(self._outputs, self._details, gains, targets, own)
            else:
                write_rows(self._outputs, gains, targets, own)

        with self._lock:
            self.prepare(*seen)
            self._request.infer()
            run_over_rows(write, kept[1] - first, _ROWS)

    def prepare(
        self, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...], modulation: Floats | None = None
    ) -> None:
        """Fill the layers' inputs, and the closed form, of a frame; arguments as of `RawRows`."""
        if modulation is None:
            modulation = modulation_of(self._network, raw, levels, light)
        if modulation is not None:
            self._modulation[0, 0] = modulation
        samples, pattern = as_samples(raw), read_pattern((raw.shape[0], raw.shape[1]), self._layout, *levels, light)
        rows, closed, beyond = raw.shape[0] // PERIOD, self._maps.closed, self._maps.details
        self._fill_maps(samples, pattern)
        if self._full:
            run_over_rows(lambda row_range: find_beyond(closed, self._details.smooth, beyond, row_range), rows, _ROWS)
            run_over_rows(lambda row_range: emit_details(beyond, closed, self._detail_input, row_range), rows, _ROWS)

    def _fill_maps(self, samples: Samples, pattern: Pattern) -> None:
        """The first input, and the closed form."""
        h, taps, maps = pattern.h // 2, self._taps, self._maps
        if taps is not None:
            run_over_rows(lambda row_range: map_rows(samples, pattern, taps, maps, row_range), h, _ROWS)
        else:
            angles = self._layout.angles
            source = Source(samples, pattern, read_grid(pattern, angles, stokes_inverse(angles).astype(np.float32)))
            # A strip begins with rows that the one before has too, many of them: one for each thread.
            run_over_rows(lambda row_range: map_guided_rows(source, maps, row_range), h, -(-h // get_threads()))


def modulation_of(
    network: JointWeights, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...]
) -> Floats | None:
    """Scales and shifts of a network's features for a whole frame ``[H, W]``; None for networks that see none."""
    if not network.sees_frame:
        return None
    request = _whole_frame_of(network).create_infer_request()
    found: Floats = request.infer([thumbnail_of(raw, network.layout, levels, light)])[0][0]
    return found


@lru_cache(maxsize=4)
def _whole_frame_of(network: JointWeights) -> Any:
    """The compiled layers that read a thumbnail."""
    return core().compile_model(whole_frame_model(network), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})


def _compile(model: Any, inputs: list[NDArray[Any]], outputs: list[NDArray[Any]], precision: str) -> Any:
    """A request that reads ``inputs`` and fills ``outputs [h, w, n]``, float32 or bits of bfloat16.

    All have channels last, as layers have them: OpenVINO takes long to move them.
    """
    openvino = import_openvino()
    # Pinned threads of two engines would share a core, and wait there for whoever else works on it.
    options: dict[str, Any] = {"INFERENCE_NUM_THREADS": get_threads(), "PERFORMANCE_HINT": "LATENCY"}
    options |= {"ENABLE_CPU_PINNING": False, "INFERENCE_PRECISION_HINT": precision}
    steps = openvino.preprocess.PrePostProcessor(model)
    places = [(steps.input(k), seen) for k, seen in enumerate(inputs)]
    for place, array in [*places, *((steps.output(k), image) for k, image in enumerate(outputs))]:
        place.tensor().set_element_type(_type_of(array)).set_layout(openvino.Layout("NHWC"))
        place.model().set_layout(openvino.Layout("NCHW"))
    request = core().compile_model(steps.build(), "CPU", options).create_infer_request()
    for arrays, set_tensor in ((inputs, request.set_input_tensor), (outputs, request.set_output_tensor)):
        for k, array in enumerate(arrays):
            set_tensor(k, openvino.Tensor(array, [1, *array.shape], _type_of(array)))
    return request


def _type_of(array: NDArray[Any]) -> Any:
    """OpenVINO's type of an input or output: uint16 are bits of bfloat16."""
    types = import_openvino().Type
    return types.bf16 if array.dtype == np.uint16 else types.f32


def asked_precision() -> str | None:
    """Precision of layers that the environment variable POLSEP_LAYERS asks for. Raises ValueError on another word."""
    asked = os.environ.get("POLSEP_LAYERS")
    if asked not in (None, *PRECISIONS):
        raise ValueError(f"expected POLSEP_LAYERS as {', '.join(PRECISIONS)}, found {asked!r:.40}")
    return asked


def usual_precision() -> str:
    """The fastest precision on this processor: "bf16" where OpenVINO takes it and matrix tiles (AMX) multiply it.

    Vector units that know bfloat16 (AVX512-BF16) take 1.6 times as long with it as with float32 on processors of Intel,
    half as long on those of AMD; those that multiply 8-bit integers (VNNI) a third to a quarter as long with these
    (docs/experiments.md).
    """
    name: str = core().get_property("CPU", "INFERENCE_PRECISION_HINT").get_type_name()
    if name == "bf16" and "amx_bf16" not in cpu_flags() and not is_amd():
        name = "f32"
    if "amx_bf16" in cpu_flags() or not cpu_flags() & {"avx512_vnni", "avx_vnni"}:
        return name
    return {"f32": "i8", "bf16": "i8-bf16"}.get(name, name)


def as_images(targets: Targets) -> FrameImages:
    """Filled images of a frame."""
    h, w = targets.dolp.shape
    diffuse, specular, error = (image.reshape(h, w, -1) for image in targets[:3])
    return FrameImages(diffuse, specular, targets.valid, targets.dolp, targets.aolp, _tally(targets), error)


def _tally(targets: Any) -> Tally:
    """The frame's tally from its rows' sums, in one order whatever the threads."""
    *sums, clipped, misfit = (float(x) for x in targets.sums.sum(axis=0))
    s0, specular, above_one, power, along, across, *variances = sums
    residual = misfit if targets.diffuse.shape[1] > targets.dolp.shape[1] else None  # one colour fits any line
    counts = (targets.valid.size, int(clipped), int(np.count_nonzero(targets.valid)), int(above_one))
    return Tally(*counts, s0, specular, power, along, across, residual, None, variances[0], variances[1])
