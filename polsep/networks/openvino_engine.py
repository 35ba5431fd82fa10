"""The joint network on CPUs for frames of one size: kernels make its inputs, OpenVINO runs its layers, kernels images.

The same as `run.run_joint`, in less time. Layers run in bfloat16 where the processor has matrix tiles for it, else in
float32; the closed form and the images are float32 always.
"""

from __future__ import annotations

import sys
import threading
import warnings
from functools import lru_cache
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import conv2d

from polsep.compute.processor import cpu_flags
from polsep.networks.channels import DETAIL_MAPS, PERIOD, input_channels
from polsep.networks.details import HAAR
from polsep.networks.joint import Joint, pool_outputs
from polsep.networks.whole_frame import split_modulation
from polsep.physics.stokes import stokes_inverse
from polsep.sensor.camera import Layout
from polsep.separation.images import FrameImages, Tally

if TYPE_CHECKING:
    from polsep.demosaic.bilinear_kernel import Pattern
    from polsep.networks.buffers import Taps
    from polsep.sensor.unpack_kernel import RawFrame, Samples

Floats = NDArray[np.float32]

#: Packed rows that a thread processes at a time.
_ROWS = 16

#: Models that `_model_of` has read.
_MODELS: WeakKeyDictionary[nn.Module, dict[type[nn.Module], Any]] = WeakKeyDictionary()


class Layers(nn.Module):
    """A network's layers: inputs ``[1, n, h, w]`` to corrections ``[1, 4 C + 8, h, w]``, deviations ``[1, 8, h, w]``.

    Corrections are those of diffuse, specular, and the closed form's gain, see `images_kernel.LayerOutputs`. The last
    input of networks that see a whole frame is what modulates their features, see `WholeFrame.forward`.
    """

    def __init__(self, network: Joint) -> None:
        super().__init__()
        self.net, self.log_variance, self.max_log_variance = network.net, network.log_variance, network.max_log_variance
        self.widths = network.size.widths
        assert network.corrections.bias is not None
        weight, bias = network.corrections.weight, network.corrections.bias
        if network.closed_form_gain is None:
            gain = [torch.zeros_like(weight[:4]), torch.zeros_like(bias[:4])]
        else:
            assert network.closed_form_gain.bias is not None
            gain = [network.closed_form_gain.weight, network.closed_form_gain.bias]
        self.weight, self.bias = nn.Parameter(torch.cat([weight, gain[0]])), nn.Parameter(torch.cat([bias, gain[1]]))

    def forward(self, inputs: Tensor, *modulation: Tensor) -> tuple[Tensor, Tensor]:
        """Relative to the local brightness and to the closed form, at half resolution."""
        return self.correct(self.features(inputs, *modulation))

    def features(self, inputs: Tensor, *modulation: Tensor) -> Tensor:
        """The network's features."""
        features: Tensor = self.net(inputs, split_modulation(modulation[0], self.widths) if modulation else ())
        return features

    def correct(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The same from the network's features."""
        log_variance = torch.minimum(self.log_variance(features), self.max_log_variance)
        return conv2d(features, self.weight, self.bias), torch.exp(0.5 * log_variance)


class FullLayers(Layers):
    """The same with the layers of `details.Details`: from the inputs and `DETAIL_MAPS` of the size of details.

    A third output ``[1, 24 + 12 (C + 1), h, w]``, see `details_kernel.DetailOutputs`.
    """

    def __init__(self, network: Joint) -> None:
        super().__init__(network)
        self.belief, self.change = network.details.belief, network.details.change

    def forward(  # type: ignore[override]
        self, inputs: Tensor, details: Tensor, *modulation: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """See the class."""
        features = self.features(inputs, *modulation)
        shares = torch.cat([self.belief(torch.cat([features, details], dim=1)), self.change(features)], dim=1)
        return *self.correct(features), shares


class OpenVinoEngine:
    """A network for frames of one shape in its own order of filters, H and W multiples of 4.

    ``full``: images at full instead of half resolution. ``precision``: "bf16", "f32", or None for what suits the
    processor. State: compiled layers and buffers between raw samples and images, for one frame at a time.
    """

    def __init__(
        self, network: Joint, shape: tuple[int, int], full: bool = False, precision: str | None = None
    ) -> None:
        from polsep.networks.buffers import ClosedFormRows, LayerInput, Maps
        from polsep.networks.details_kernel import DetailOutputs, read_smooth
        from polsep.networks.images_kernel import LayerOutputs

        self._lock, self._colors, self._full = threading.Lock(), network.colors, full
        self._layout = Layout() if network.colors == 3 else Layout(bayer=None)
        h, w = shape[0] // PERIOD, shape[1] // PERIOD
        channels = input_channels(network.colors, network.inputs)
        precision = precision or _usual_precision()
        halves = precision == "bf16"
        inputs = LayerInput.empty((h, w, channels.total), halves)
        closed = ClosedFormRows.empty(network.colors, h, w)
        beyond = np.empty((2 * h, 3 * network.colors, 2 * w) if full else (0, 0, 0), np.float32)
        self._maps = Maps(inputs.floats, inputs.halves, channels, closed, beyond)
        self._taps = make_taps(network, w, full) if network.demosaic is not None else None
        change, deviation = (np.empty((n, h, w), np.float32) for n in (4 * network.colors + 8, 8))
        self._outputs = LayerOutputs.of(closed, change, deviation)
        filled, outputs = [inputs.filled], [change, deviation]
        if full:
            shares = np.empty((2 * DETAIL_MAPS + DETAIL_MAPS * (network.colors + 1), h, w), np.float32)
            smooth = read_smooth(network.details.smooth.detach().numpy())
            self._details = DetailOutputs.of(shares, beyond, smooth)
            self._detail_input = LayerInput.empty((h, w, DETAIL_MAPS), halves)
            filled, outputs = [*filled, self._detail_input.filled], [*outputs, shares]
        self._network, self._modulation = network, np.zeros((1, 1, 2 * sum(network.size.widths)), np.float32)
        if network.whole_frame is not None:
            filled = [*filled, self._modulation]
        model = _model_of(network, FullLayers if full else Layers, tuple(image.shape[2] for image in filled))
        self._request = _compile(model, filled, outputs, precision)

    def run(
        self,
        raw: RawFrame,
        levels: tuple[float, float],
        light: tuple[float, ...],
        modulation: Floats | None = None,
        kept: slice = slice(None),
    ) -> FrameImages:
        """Images of a frame ``[H, W]`` with black and white ``levels`` and a ``light`` of one gain per colour.

        ``modulation``: `modulation_of` the frame that this is a strip of; None where it is a whole one. ``kept``: rows
        of the images that are wanted; others are left out, and do not count in the tally.
        """
        from polsep.compute.threads import run_over_rows
        from polsep.demosaic.bilinear_kernel import read_pattern
        from polsep.networks.details_kernel import emit_details, find_beyond, write_pixels
        from polsep.networks.images_kernel import Targets, write_rows
        from polsep.sensor.unpack_kernel import as_samples

        samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
        pattern = read_pattern(shape, self._layout, *levels, light)
        h, w = shape if self._full else (shape[0] // 2, shape[1] // 2)
        targets, gains = Targets.empty((h, w), self._colors), np.array(light[: self._colors], np.float32)
        if modulation is None:
            modulation = modulation_of(self._network, raw, levels, light)
        with self._lock:
            if modulation is not None:
                self._modulation[0, 0] = modulation
            self._fill_inputs(samples, pattern)
            rows, closed, beyond = shape[0] // PERIOD, self._maps.closed, self._maps.details
            if self._full:
                run_over_rows(
                    lambda row_range: find_beyond(closed, self._details.smooth, beyond, row_range), rows, _ROWS
                )
                run_over_rows(
                    lambda row_range: emit_details(beyond, closed, self._detail_input, row_range), rows, _ROWS
                )
            self._request.infer()
            if self._full:
                run_over_rows(
                    lambda row_range: write_pixels(self._outputs, self._details, gains, targets, row_range), rows, _ROWS
                )
            else:
                run_over_rows(lambda row_range: write_rows(self._outputs, gains, targets, row_range), rows, _ROWS)
        targets = Targets._make(image[kept] for image in targets)
        diffuse, specular, error = (image.reshape(image.shape[0], w, -1) for image in targets[:3])
        return FrameImages(diffuse, specular, targets.valid, targets.dolp, targets.aolp, _tally(targets), error)

    def _fill_inputs(self, samples: Samples, pattern: Pattern) -> None:
        """The layers' inputs, and the closed form, of a frame."""
        from polsep.compute.threads import get_threads, run_over_rows
        from polsep.demosaic.cells_kernel import Source, read_grid
        from polsep.networks.maps_kernel import map_guided_rows, map_rows

        h, taps, maps = pattern.h // 2, self._taps, self._maps
        if taps is not None:
            run_over_rows(lambda row_range: map_rows(samples, pattern, taps, maps, row_range), h, _ROWS)
        else:
            angles = self._layout.angles
            source = Source(samples, pattern, read_grid(pattern, angles, stokes_inverse(angles).float().numpy()))
            # A strip begins with rows that the one before has too, many of them: one for each thread.
            run_over_rows(lambda row_range: map_guided_rows(source, maps, row_range), h, -(-h // get_threads()))


def modulation_of(
    network: Joint, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...]
) -> Floats | None:
    """Scales and shifts of a network's features for a whole frame ``[H, W]``; None for networks that see none."""
    from polsep.networks.whole_frame_kernel import thumbnail_of

    if network.whole_frame is None:
        return None
    with torch.no_grad():
        modulation: Tensor = network.whole_frame(thumbnail_of(raw, network.layout, levels, light))[0]
    return modulation.flatten().numpy()


def _model_of(network: Joint, layers: type[Layers], channels: tuple[int, ...]) -> Any:
    """A copy of the OpenVINO model of a network's layers, which is read once: reading takes a second and 5 MiB."""
    known = _MODELS.setdefault(network, {})
    if layers not in known:
        known[layers] = _as_model(
            layers(network).eval(),
            tuple(torch.zeros(1, n, *_example_size(n, network), dtype=torch.float32) for n in channels),
        )
    return known[layers].clone()


def _example_size(channels: int, network: Joint) -> tuple[int, int]:
    """Height and width of an input for tracing; modulation is for a whole frame."""
    return (1, 1) if channels == 2 * sum(network.size.widths) else (32, 32)


def _compile(model: Any, inputs: list[NDArray[Any]], outputs: list[Floats], precision: str) -> Any:
    """A request that reads ``inputs [h, w, n]``, float32 or bits of bfloat16, and fills ``outputs [n, h, w]``."""
    from polsep.compute.threads import get_threads

    openvino = _import_openvino()
    # Pinned threads of two engines would share a core, and wait there for whoever else works on it.
    options: dict[str, Any] = {"INFERENCE_NUM_THREADS": get_threads(), "PERFORMANCE_HINT": "LATENCY"}
    options |= {"ENABLE_CPU_PINNING": False, "INFERENCE_PRECISION_HINT": precision}
    steps = openvino.preprocess.PrePostProcessor(model)
    kinds = [openvino.Type.bf16 if seen.dtype == np.uint16 else openvino.Type.f32 for seen in inputs]
    for k, kind in enumerate(kinds):
        steps.input(k).tensor().set_element_type(kind).set_layout(openvino.Layout("NHWC"))
        steps.input(k).model().set_layout(openvino.Layout("NCHW"))
    model = steps.build()
    model.reshape({port: [1, *seen.shape] for port, seen in zip(model.inputs, inputs, strict=True)})
    request = _core().compile_model(model, "CPU", options).create_infer_request()
    for k, (seen, kind) in enumerate(zip(inputs, kinds, strict=True)):
        request.set_input_tensor(k, openvino.Tensor(seen, [1, *seen.shape], kind))
    for k, image in enumerate(outputs):
        request.set_output_tensor(k, openvino.Tensor(image[None], shared_memory=True))
    return request


def _usual_precision() -> str:
    """The faster precision on this processor: "bf16" where OpenVINO takes it and matrix tiles (AMX) multiply it.

    Vector units that know bfloat16 alone (AVX512-BF16) take 1.6 times as long with it as with float32
    (docs/experiments.md).
    """
    name: str = _core().get_property("CPU", "INFERENCE_PRECISION_HINT").get_type_name()
    return "f32" if name == "bf16" and "amx_bf16" not in cpu_flags() else name


def _import_openvino() -> Any:
    """OpenVINO without its telemetry, which reports its import to Google from a forked process that may hang.

    None in the place of the telemetry's module makes OpenVINO do without.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino  # type: ignore[import-untyped]  # no stubs

    return openvino


@lru_cache(maxsize=1)
def _core() -> Any:
    """OpenVINO's core, one for the life of the process.

    Note: OpenVINO's CPU plugin gives the thread that loads it a signal stack, and frees that when the plugin ends, even
    in another thread or under a newer plugin. The next signal that Python catches, Ctrl-C say, then ends the process
    without a message. The plugin lives as long as its core.
    """
    return _import_openvino().Core()


def _as_model(layers: nn.Module, examples: tuple[Tensor, ...]) -> Any:
    """Layers as an OpenVINO model, read as `openvino.convert_model` does, which sends telemetry."""
    from openvino.frontend import FrontEndManager  # type: ignore[import-untyped]  # no stubs
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder  # type: ignore[import-untyped]

    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of torch about tracing: sizes do not decide anything here
        reader = FrontEndManager().load_by_framework("pytorch")
        traced = TorchScriptPythonDecoder(layers, example_input=examples)  # must live until it is converted
        return reader.convert(reader.load(traced))


def make_taps(network: Joint, width: int, details: bool = False) -> Taps:
    """The linear filter at half resolution for ``width`` packed pixels, without samples that an output does not see.

    ``details``: with those of s0.
    """
    from polsep.compute.rows_kernel import AT_ONCE
    from polsep.networks.buffers import Taps

    assert network.demosaic is not None
    s0 = 16 * network.colors
    whole = torch.cat([pool_outputs(network.demosaic[:s0]), network.demosaic[s0:]]).flatten(1)
    if details:
        pixels = (
            network.demosaic[:s0]
            .reshape(network.colors, 2, 2, 2, 2, -1)
            .transpose(2, 3)
            .reshape(-1, 4, 4, whole.shape[1])
        )
        split = torch.einsum("dp,cqpn->cdqn", torch.tensor(HAAR[1:], dtype=torch.float32) / 4, pixels)
        whole = torch.cat([whole, split.reshape(-1, whole.shape[1])])
    cells = whole.numpy().reshape(-1, 4, whole.shape[1]).swapaxes(0, 1)
    most = max(int(np.count_nonzero(cell.any(axis=0))) for cell in cells)
    shape = (4, most + -most % AT_ONCE)
    weight = np.zeros((4, cells.shape[1], shape[1]), np.float32)
    rows, places = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for k, cell in enumerate(cells):
        seen = np.flatnonzero(cell.any(axis=0))  # plane, row, column
        weight[k, :, : seen.size], rows[k, : seen.size] = cell[:, seen], seen % 9 // 3
        places[k, : seen.size] = seen // 9 * (width + 2) + seen % 3
    return Taps(weight, rows, places, network.colors)


def _tally(targets: Any) -> Tally:
    """The frame's tally from its rows' sums, in one order whatever the threads."""
    *sums, clipped, misfit = (float(x) for x in targets.sums.sum(axis=0))
    s0, specular, above_one, power, along, across, *variances = sums
    residual = misfit if targets.diffuse.shape[1] > targets.dolp.shape[1] else None  # one colour fits any line
    counts = (targets.valid.size, int(clipped), int(np.count_nonzero(targets.valid)), int(above_one))
    return Tally(*counts, s0, specular, power, along, across, residual, None, variances[0], variances[1])
