"""The joint network on CPUs: kernels make its maps, OpenVINO runs its layers, kernels make images of what it says.

The same as `mosaic_network.run_joint` at half resolution, in less time. Layers run in bfloat16 where the
processor has it, in float32 elsewhere; the closed form and the images are float32 always. Without OpenVINO, and for
frames that it does not take, torch does the work.
"""

from __future__ import annotations

import logging
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import conv2d

from polsep.camera import Layout, Mosaic
from polsep.engine import make_ready
from polsep.joint import INPUTS, PERIOD, Joint, pool_outputs
from polsep.mosaic_network import MOST_PIXELS, find_joint, own_order
from polsep.orient import Orientation, orient
from polsep.report import Tally
from polsep.stokes import stokes_inverse

if TYPE_CHECKING:
    from polsep.kernels.bilinear import Pattern
    from polsep.kernels.joint import Taps
    from polsep.kernels.unpack import RawFrame, Samples

Floats = NDArray[np.float32]

#: Channels of the maps of each of `joint.INPUTS`, beside 4 per colour of the split.
_CHANNELS = {"samples": 16, "clipping": 17, "cosine": 4, "sine": 4, "split": 10}
#: Packed rows that a thread takes at a time.
_ROWS = 16
#: Engines that are kept at least, each with the memory that its frames need.
KEPT = 2


@dataclass(frozen=True)
class JointImages:
    """A separated frame, channels last, in its light; fields as in `report.SeparatedFrame`, and its ``tally``."""

    diffuse: Floats
    specular: Floats
    valid: NDArray[np.bool_]
    dolp: Floats
    aolp: Floats
    error: Floats
    tally: Tally


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
        """Relative to the light and to the closed form, at half resolution; see `kernels.joint_images.Found`."""
        features = self.net(maps)
        doubt = torch.minimum(self.doubt(features), self.most_doubt)
        return conv2d(features, self.weight, self.bias), torch.exp(0.5 * doubt)


class OpenVinoEngine:
    """A network for frames of one shape in its own order of filters, H and W multiples of 4.

    State: compiled layers and the room for everything between raw samples and images, one frame at a time.
    ``precision``: "bf16", "f32", or None for what suits the processor.
    """

    def __init__(self, network: Joint, shape: tuple[int, int], precision: str | None = None) -> None:
        from polsep.kernels import get_threads
        from polsep.kernels.joint import Maps

        openvino = _import_openvino()
        self._lock, self._colors = threading.Lock(), network.colors
        self._layout = Layout() if network.colors == 3 else Layout(bayer=None)
        h, w = shape[0] // PERIOD, shape[1] // PERIOD
        first, count = _first_channels(network)
        model = _as_model(Layers(network).eval(), torch.zeros(1, count, 32, 32))
        # Pinned threads of two engines would share a core, and wait there for whoever else works on it.
        options: dict[str, Any] = {"INFERENCE_NUM_THREADS": get_threads(), "PERFORMANCE_HINT": "LATENCY"}
        options |= {"ENABLE_CPU_PINNING": False}
        options |= {} if precision is None else {"INFERENCE_PRECISION_HINT": precision}
        core = _core()
        if precision is None:
            precision = core.get_property("CPU", "INFERENCE_PRECISION_HINT").get_type_name()
        halves = precision == "bf16"
        kind = openvino.Type.bf16 if halves else openvino.Type.f32
        steps = openvino.preprocess.PrePostProcessor(model)
        steps.input().tensor().set_element_type(kind).set_layout(openvino.Layout("NHWC"))
        steps.input().model().set_layout(openvino.Layout("NCHW"))
        model = steps.build()
        model.reshape([1, h, w, count])
        self._request = core.compile_model(model, "CPU", options).create_infer_request()
        nothing, room = (0, 0, 0), (h, w, count)
        self._maps = Maps(
            np.empty(nothing if halves else room, np.float32),
            np.empty(room if halves else nothing, np.uint16),
            first,
            np.empty((h, 4 * network.colors + 14, w), np.float32),
            np.empty((h, w), np.uint16),
        )
        self._taps = make_taps(network, w) if network.demosaic is not None else None
        self._found = [np.empty((n, h, w), np.float32) for n in (4 * network.colors + 8, 8)]
        seen = self._maps.halves if halves else self._maps.floats
        self._request.set_input_tensor(openvino.Tensor(seen, [1, *room], kind))
        for k, image in enumerate(self._found):
            self._request.set_output_tensor(k, openvino.Tensor(image[None], shared_memory=True))

    def run(self, raw: RawFrame, levels: tuple[float, float], light: tuple[float, ...]) -> JointImages:
        """Images of a frame ``[H, W]`` with black and white ``levels`` and a ``light`` of one gain per colour."""
        from polsep.kernels.bilinear import read_pattern
        from polsep.kernels.joint_images import SUMS, Found, Targets, write_rows
        from polsep.kernels.threads import share
        from polsep.kernels.unpack import as_samples

        samples, shape = as_samples(raw), (raw.shape[0], raw.shape[1])
        pattern = read_pattern(shape, self._layout, *levels, light)
        h, w = shape[0] // 2, shape[1] // 2
        images = [np.empty((h, w * n), np.float32) for n in (self._colors, self._colors, 2)]
        valid, angles = np.empty((h, w), np.bool_), [np.empty((h, w), np.float32) for _ in range(2)]
        targets = Targets(images[0], images[1], images[2], valid, angles[0], angles[1], np.zeros((h, SUMS)))
        gains = np.array(light[: self._colors], np.float32)
        with self._lock:
            self._fill_maps(samples, pattern)
            self._request.infer()
            found = Found(self._maps.base, self._maps.clipped, self._found[0], self._found[1])
            share(lambda rows: write_rows(found, gains, targets, rows), h // 2, _ROWS)
        diffuse, specular, error = (image.reshape(h, w, -1) for image in images)
        return JointImages(diffuse, specular, valid, angles[0], angles[1], error, _tally(targets))

    def _fill_maps(self, samples: Samples, pattern: Pattern) -> None:
        """What the layers see, and the closed form, of a frame."""
        from polsep.kernels import get_threads
        from polsep.kernels.cells import Source, read_grid
        from polsep.kernels.joint import map_guided_rows, map_rows
        from polsep.kernels.threads import share

        h, taps = pattern.h // 2, self._taps
        if taps is not None:
            share(lambda rows: map_rows(samples, pattern, taps, self._maps, rows), h, _ROWS)
            return
        angles = self._layout.angles
        source = Source(samples, pattern, read_grid(pattern, angles, stokes_inverse(angles).float().numpy()))
        # A strip begins with rows that the one before has too, many of them: one for each thread.
        share(lambda rows: map_guided_rows(source, self._maps, rows), h, -(-h // get_threads()))


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


def _as_model(layers: nn.Module, example: Tensor) -> Any:
    """Layers for OpenVINO: by its reader of traced modules, as its `convert_model`, which calls home, does."""
    from openvino.frontend import FrontEndManager  # type: ignore[import-untyped]  # no stubs
    from openvino.frontend.pytorch.ts_decoder import TorchScriptPythonDecoder  # type: ignore[import-untyped]

    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # of torch about tracing: sizes do not decide anything here
        reader = FrontEndManager().load_by_framework("pytorch")
        traced = TorchScriptPythonDecoder(layers, example_input=example)  # must live until it is converted
        return reader.convert(reader.load(traced))


def _first_channels(network: Joint) -> tuple[NDArray[np.int64], int]:
    """Where each of the network's maps begins, -1 for those it does not see, and how many channels there are."""
    first, count = dict.fromkeys(INPUTS, -1), 0
    for name in network.inputs:
        first[name] = count
        count += _CHANNELS[name] + (4 * network.colors if name == "split" else 0)
    return np.array([*first.values(), count], np.int64), count + 1


def make_taps(network: Joint, width: int) -> Taps:
    """The linear filter at half resolution for ``width`` packed pixels, without samples that an output does not see."""
    from polsep.kernels.joint import Taps
    from polsep.kernels.rows import AT_ONCE

    assert network.demosaic is not None
    s0 = 16 * network.colors
    whole = torch.cat([pool_outputs(network.demosaic[:s0]), network.demosaic[s0:]]).flatten(1).numpy()
    cells = whole.reshape(-1, 4, whole.shape[1]).swapaxes(0, 1)
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


class _Job(NamedTuple):
    """What an engine is for."""

    method: str
    colors: int
    shape: tuple[int, int]
    threads: int


class _Engines:
    """Engines, each for one frame at a time. State: those that wait, the last used at the end, and how many are busy.

    As many are kept as were ever busy at once.
    """

    def __init__(self) -> None:
        self._lock, self._idle, self._busy, self._kept = threading.Lock(), list[tuple[_Job, OpenVinoEngine]](), 0, KEPT

    @contextmanager
    def borrow(self, job: _Job) -> Iterator[OpenVinoEngine]:
        """An engine that waits, or a new one."""
        with self._lock:
            found = next((pair for pair in reversed(self._idle) if pair[0] == job), None)
            if found is not None:
                self._idle.remove(found)
            self._busy += 1
            self._kept = max(self._kept, self._busy)
        engine = None
        try:
            engine = found[1] if found is not None else _make_engine(job)
            yield engine
        finally:
            with self._lock:
                self._busy -= 1
                self._idle += [] if engine is None else [(job, engine)]
                del self._idle[: -self._kept]

    def clear(self) -> None:
        """Forget those that wait."""
        with self._lock:
            self._idle = []


ENGINES = _Engines()
_MAKING = threading.Lock()


def _make_engine(job: _Job) -> OpenVinoEngine:
    """One at a time: torch cannot trace two modules at once."""
    with _MAKING:
        network, _ = find_joint(job.method, Layout() if job.colors == 3 else Layout(bayer=None), None)
        logging.getLogger("polsep").debug("compiling %s for frames of %dx%d", job.method, *job.shape)
        return OpenVinoEngine(network, job.shape)


def _warm_up() -> None:
    from polsep.kernels import joint_images

    joint_images.warm_up()


def run_engine(method: str, mosaic: Mosaic) -> JointImages | None:
    """A method's images of one frame in its light, or None: batches, other devices, huge frames, no OpenVINO.

    Frames in other orientations than the network's are turned before and after, as `mosaic_network.run_joint` does.
    """
    data = mosaic.data
    if find_spec("openvino") is None or data.ndim != 2 or data.device.type != "cpu" or data.numel() > MOST_PIXELS:
        return None
    orientation = orient(mosaic, own_order(mosaic.layout))
    if not orientation.keeps_cells or data.dtype not in (torch.uint8, torch.uint16, torch.float32):
        return None
    make_ready(_warm_up)
    from polsep.kernels import get_threads

    levels, light = (mosaic.black_level, mosaic.white_level), mosaic.light_color
    as_it_is = orientation == Orientation(*data.shape) and not any(n % PERIOD for n in data.shape)
    turned = data if as_it_is else orientation.turn(data.float()).contiguous()
    job = _Job(method, mosaic.layout.channels, (turned.shape[0], turned.shape[1]), get_threads())
    with ENGINES.borrow(job) as engine:
        images = engine.run(turned.numpy(), levels, light)
    return images if as_it_is else _turn_back(images, orientation)


def _turn_back(images: JointImages, orientation: Orientation) -> JointImages:
    """Images of a turned frame as those of the frame itself; the tally is of all that was seen."""

    def turn(image: NDArray[Any]) -> NDArray[Any]:
        planes = torch.from_numpy(image)
        planes = planes.movedim(-1, 0) if planes.ndim == 3 else planes
        planes = orientation.turn_back(planes, 1)
        return np.ascontiguousarray((planes.movedim(0, -1) if planes.ndim == 3 else planes).numpy())

    aolp, tally, mirrored = turn(images.aolp), images.tally, orientation.down != orientation.across
    if orientation.transposed:
        aolp, tally = _wrap(np.float32(np.pi / 2) - aolp), replace(tally, along=-tally.along)
    if mirrored:
        aolp, tally = _wrap(-aolp), replace(tally, across=-tally.across)
    diffuse, specular, error = (turn(image) for image in (images.diffuse, images.specular, images.error))
    return JointImages(diffuse, specular, turn(images.valid), turn(images.dolp), aolp, error, tally)


def _wrap(angle: Floats) -> Floats:
    """The same AoLP in [0, pi); what rounding takes to pi is 0."""
    pi = np.float32(np.pi)
    wrapped: Floats = np.mod(angle, pi)
    wrapped[wrapped >= pi] = 0
    return wrapped
