"""Frames of one size through the joint network: kernels make its maps, OpenVINO runs its layers, kernels make images.

The same as `networks.run.run_joint`, in less time. Layers run in bfloat16 where the processor has it, in float32
elsewhere; the closed form and the images are float32 always.
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

from polsep.networks.details import HAAR
from polsep.networks.joint import INPUTS, PERIOD, Joint, pool_outputs
from polsep.physics.stokes import stokes_inverse
from polsep.sensor.camera import Layout
from polsep.separation.images import FrameImages, Tally

if TYPE_CHECKING:
    from polsep.demosaic.bilinear_kernel import Pattern
    from polsep.networks.maps_kernel import Seen, Taps
    from polsep.sensor.unpack_kernel import RawFrame, Samples

Floats = NDArray[np.float32]

#: Channels of the maps of each of `joint.INPUTS`, beside 4 per colour of the split.
_CHANNELS = {"samples": 16, "clipping": 17, "cosine": 4, "sine": 4, "split": 10}
#: Packed rows that a thread takes at a time.
_ROWS = 16

#: What `_model_of` has read.
_MODELS: WeakKeyDictionary[nn.Module, dict[type[nn.Module], Any]] = WeakKeyDictionary()


class Layers(nn.Module):
    """A network's layers: maps ``[1, n, h, w]`` to corrections ``[1, 4 C + 8, h, w]``, deviations ``[1, 8, h, w]``."""

    def __init__(self, network: Joint) -> None:
        super().__init__()
        self.net, self.doubt, self.most_doubt = network.net, network.doubt, network.most_doubt
        assert network.last.bias is not None
        weight, bias = network.last.weight, network.last.bias
        if network.trust is None:
            trust = [torch.zeros_like(weight[:4]), torch.zeros_like(bias[:4])]
        else:
            assert network.trust.bias is not None
            trust = [network.trust.weight, network.trust.bias]
        self.weight, self.bias = nn.Parameter(torch.cat([weight, trust[0]])), nn.Parameter(torch.cat([bias, trust[1]]))

    def forward(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """Relative to the light and to the closed form, at half resolution; see `networks.images_kernel.Found`."""
        return self.correct(self.net(maps))

    def correct(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """The same from the network's features."""
        doubt = torch.minimum(self.doubt(features), self.most_doubt)
        return conv2d(features, self.weight, self.bias), torch.exp(0.5 * doubt)


class FullLayers(Layers):
    """The same with what `details.Details` needs: from maps and 12 more of how large details are around.

    Beside the others ``[1, 24 + 12 (C + 1), h, w]``; see `networks.details_kernel.Shares`.
    """

    def __init__(self, network: Joint) -> None:
        super().__init__(network)
        self.belief, self.change = network.details.belief, network.details.change

    def forward(self, maps: Tensor, seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # type: ignore[override]
        """See the class."""
        features = self.net(maps)
        share = torch.cat([self.belief(torch.cat([features, seen], dim=1)), self.change(features)], dim=1)
        return *self.correct(features), share


class OpenVinoEngine:
    """A network for frames of one shape in its own order of filters, H and W multiples of 4; images at half resolution.

    State: compiled layers and the room for everything between raw samples and images, one frame at a time.
    ``precision``: "bf16", "f32", or None for what suits the processor.
    """

    #: Pixels of an image along the side of a cell.
    scale = 1

    def __init__(self, network: Joint, shape: tuple[int, int], precision: str | None = None) -> None:
        from polsep.networks.maps_kernel import Maps

        self._lock, self._colors = threading.Lock(), network.colors
        self._layout = Layout() if network.colors == 3 else Layout(bayer=None)
        h, w = shape[0] // PERIOD, shape[1] // PERIOD
        first, count = _first_channels(network)
        self._halves = (precision or _usual_precision()) == "bf16"
        seen = self._make_room(h, w, count)
        base, clipped = np.empty((h, 4 * network.colors + 14, w), np.float32), np.empty((h, w), np.uint16)
        self._maps = Maps(seen.floats, seen.halves, first, base, clipped, self._details((h, w)))
        self._taps = make_taps(network, w, self.scale == 2) if network.demosaic is not None else None
        self._found = [np.empty((n, h, w), np.float32) for n in (4 * network.colors + 8, 8)]
        layers, inputs, outputs = self._open(network, (h, w))
        inputs = [seen.filled, *inputs]
        model = _model_of(network, layers, tuple(image.shape[2] for image in inputs))
        self._request = _compile(model, inputs, [*self._found, *outputs], precision)

    def run(
        self, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...], kept: slice = slice(None)
    ) -> FrameImages:
        """Images of a frame ``[H, W]`` with black and white ``levels`` and a ``light`` of one gain per colour.

        ``kept``: rows of the images that are wanted, all others are left out, and do not count in the tally.
        """
        from polsep.demosaic.bilinear_kernel import read_pattern
        from polsep.networks.images_kernel import SUMS, Found, Targets
        from polsep.sensor.unpack_kernel import as_samples

        samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
        pattern = read_pattern(shape, self._layout, *levels, light)
        h, w = (n // 2 * self.scale for n in shape)
        images = [np.empty((h, w * n), np.float32) for n in (self._colors, self._colors, 2)]
        valid, angles = np.empty((h, w), np.bool_), [np.empty((h, w), np.float32) for _ in range(2)]
        targets = Targets(images[0], images[1], images[2], valid, angles[0], angles[1], np.zeros((h, SUMS)))
        gains = np.array(light[: self._colors], np.float32)
        with self._lock:
            self._fill_maps(samples, pattern)
            self._look()
            self._request.infer()
            self._write(Found(self._maps.base, self._maps.clipped, self._found[0], self._found[1]), gains, targets)
        targets = Targets._make(image[kept] for image in targets)
        diffuse, specular, error = (image.reshape(image.shape[0], w, -1) for image in targets[:3])
        return FrameImages(diffuse, specular, targets.valid, targets.dolp, targets.aolp, _tally(targets), error)

    def _make_room(self, h: int, w: int, count: int) -> Seen:
        """For what the layers see, in their precision."""
        from polsep.networks.maps_kernel import Seen

        nothing, room = (0, 0, 0), (h, w, count)
        floats, halves = (nothing, room) if self._halves else (room, nothing)
        return Seen(np.empty(floats, np.float32), np.empty(halves, np.uint16))

    def _details(self, size: tuple[int, int]) -> Floats:
        """Room for the details of s0 of ``size`` packed pixels; none at half resolution."""
        del size
        return np.empty((0, 0, 0), np.float32)

    def _open(self, network: Joint, size: tuple[int, int]) -> tuple[type[Layers], list[NDArray[Any]], list[Floats]]:
        """The layers, and what they see and say beside maps and corrections."""
        del network, size
        return Layers, [], []

    def _look(self) -> None:
        """What the layers see beside maps: nothing."""

    def _write(self, found: Any, gains: Floats, targets: Any) -> None:
        """Images of what the layers said."""
        from polsep.compute.threads import share
        from polsep.networks.images_kernel import write_rows

        share(lambda rows: write_rows(found, gains, targets, rows), found.clipped.shape[0], _ROWS)

    def _fill_maps(self, samples: Samples, pattern: Pattern) -> None:
        """What the layers see, and the closed form, of a frame."""
        from polsep.compute.threads import share
        from polsep.demosaic.cells_kernel import Source, read_grid
        from polsep.kernels import get_threads
        from polsep.networks.maps_kernel import map_guided_rows, map_rows

        h, taps = pattern.h // 2, self._taps
        if taps is not None:
            share(lambda rows: map_rows(samples, pattern, taps, self._maps, rows), h, _ROWS)
            return
        angles = self._layout.angles
        source = Source(samples, pattern, read_grid(pattern, angles, stokes_inverse(angles).float().numpy()))
        # A strip begins with rows that the one before has too, many of them: one for each thread.
        share(lambda rows: map_guided_rows(source, self._maps, rows), h, -(-h // get_threads()))


class FullEngine(OpenVinoEngine):
    """The same with images at full resolution, as `joint.Joint.forward`."""

    scale = 2

    def _details(self, size: tuple[int, int]) -> Floats:
        return np.empty((2 * size[0], 3 * self._colors, 2 * size[1]), np.float32)

    def _open(self, network: Joint, size: tuple[int, int]) -> tuple[type[Layers], list[NDArray[Any]], list[Floats]]:
        from polsep.networks.details_kernel import Shares, read_smooth

        self._seen = self._make_room(*size, 12)
        share = np.empty((24 + 12 * (self._colors + 1), *size), np.float32)
        self._shares = Shares(share, self._maps.details, read_smooth(network.details.smooth.detach().numpy()))
        return FullLayers, [self._seen.filled], [share]

    def _look(self) -> None:
        """How large details are around."""
        from polsep.compute.threads import share
        from polsep.networks.details_kernel import find_beyond, show_details

        (base, details), h = (self._maps.base, self._maps.details), self._maps.clipped.shape[0]
        share(lambda rows: find_beyond(base, self._shares.smooth, details, rows), h, _ROWS)
        share(lambda rows: show_details(details, base, self._seen, rows), h, _ROWS)

    def _write(self, found: Any, gains: Floats, targets: Any) -> None:
        from polsep.compute.threads import share
        from polsep.networks.details_kernel import write_pixels

        share(lambda rows: write_pixels(found, self._shares, gains, targets, rows), found.clipped.shape[0], _ROWS)


def _model_of(network: Joint, layers: type[Layers], channels: tuple[int, ...]) -> Any:
    """OpenVINO's own of a network's layers, for whoever changes it; read once, as reading takes a second and 5 MiB."""
    known = _MODELS.setdefault(network, {})
    if layers not in known:
        known[layers] = _as_model(
            layers(network).eval(), tuple(torch.zeros(1, n, 32, 32, dtype=torch.float32) for n in channels)
        )
    return known[layers].clone()


def _compile(model: Any, inputs: list[NDArray[Any]], outputs: list[Floats], precision: str | None) -> Any:
    """A request that reads ``inputs [h, w, n]``, floats or bfloat16 as its bits, and fills ``outputs [n, h, w]``."""
    from polsep.kernels import get_threads

    openvino = _import_openvino()
    # Pinned threads of two engines would share a core, and wait there for whoever else works on it.
    options: dict[str, Any] = {"INFERENCE_NUM_THREADS": get_threads(), "PERFORMANCE_HINT": "LATENCY"}
    options |= {"ENABLE_CPU_PINNING": False}
    options |= {} if precision is None else {"INFERENCE_PRECISION_HINT": precision}
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
    """That in which OpenVINO computes on this processor: "bf16" or "f32"."""
    name: str = _core().get_property("CPU", "INFERENCE_PRECISION_HINT").get_type_name()
    return name


def _import_openvino() -> Any:
    """OpenVINO without its telemetry: importing it reports that to Google, from a forked process that may hang.

    It does without where its module cannot be imported, which None in its place says.
    """
    sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]
    import openvino  # type: ignore[import-untyped]  # no stubs

    return openvino


@lru_cache(maxsize=1)
def _core() -> Any:
    """The one of this program, which stays.

    Note: OpenVINO's CPU plugin gives the thread that loads it a stack for signals of its own, and takes that away with
    itself, also where another thread ends it or a newer plugin has been put on top. Then the next signal that Python
    catches, Ctrl-C say, ends the program without a word. The plugin lives as long as its core.
    """
    return _import_openvino().Core()


def _as_model(layers: nn.Module, examples: tuple[Tensor, ...]) -> Any:
    """Layers for OpenVINO: by its reader of traced modules, as its `convert_model`, which calls home, does."""
    from openvino.frontend import FrontEndManager  # type: ignore[import-untyped]  # no stubs
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder  # type: ignore[import-untyped]

    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of torch about tracing: sizes do not decide anything here
        reader = FrontEndManager().load_by_framework("pytorch")
        traced = TorchScriptPythonDecoder(layers, example_input=examples)  # must live until it is converted
        return reader.convert(reader.load(traced))


def _first_channels(network: Joint) -> tuple[NDArray[np.int64], int]:
    """Where each of the network's maps begins, -1 for those it does not see, and how many channels there are."""
    first, count = dict.fromkeys(INPUTS, -1), 0
    for name in network.inputs:
        first[name] = count
        count += _CHANNELS[name] + (4 * network.colors if name == "split" else 0)
    return np.array([*first.values(), count], np.int64), count + 1


def make_taps(network: Joint, width: int, details: bool = False) -> Taps:
    """The linear filter at half resolution for ``width`` packed pixels, without samples that an output does not see.

    ``details``: with those of s0.
    """
    from polsep.compute.rows import AT_ONCE
    from polsep.networks.maps_kernel import Taps

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
