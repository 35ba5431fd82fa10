"""The joint network on CPUs: engines of `openvino_engine` for frames of every size and orientation.

They are kept from frame to frame. Without OpenVINO, and for frames that it does not take, torch does the work.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import reduce
from importlib.util import find_spec
from operator import add
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from polsep.networks.joint import PERIOD, Joint
from polsep.networks.openvino_engine import Floats, FullEngine, OpenVinoEngine
from polsep.networks.run import MARGIN, Resolution, cut_rows, find_joint, own_order
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import Orientation, orient
from polsep.separation.engine import make_ready
from polsep.separation.images import FrameImages

#: Engines that are kept at least, each with the memory that its frames need.
KEPT = 2


class _Job(NamedTuple):
    """What an engine is for."""

    method: str
    resolution: Resolution
    colors: int
    shape: tuple[int, int]
    threads: int


class _Engines:
    """Engines, each for one frame at a time. State: those that wait, the last used at the end, and how many are busy.

    As many are kept as were ever busy at once, and all networks that they were made of.
    """

    def __init__(self) -> None:
        self._lock, self._idle, self._busy, self._kept = threading.Lock(), list[tuple[_Job, OpenVinoEngine]](), 0, KEPT
        self._networks = dict[tuple[str, int], Joint]()

    def network(self, method: str, colors: int) -> Joint:
        """The network of a method."""
        with self._lock:
            if (method, colors) not in self._networks:
                layout = Layout() if colors == 3 else Layout(bayer=None)
                self._networks[method, colors] = find_joint(method, layout, None)[0]
            return self._networks[method, colors]

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
        """Forget those that wait, and the networks."""
        with self._lock:
            self._idle, self._networks = [], {}


ENGINES = _Engines()
_MAKING = threading.Lock()


def _make_engine(job: _Job) -> OpenVinoEngine:
    """One at a time: torch cannot trace two modules at once."""
    with _MAKING:
        network = ENGINES.network(job.method, job.colors)
        logging.getLogger("polsep").debug("compiling %s for frames of %dx%d", job.method, *job.shape)
        return (FullEngine if job.resolution == "full" else OpenVinoEngine)(network, job.shape)


def _warm_up() -> None:
    from polsep.networks import images_kernel as joint_images

    joint_images.warm_up()


def _warm_up_full() -> None:
    from polsep.networks import details_kernel as joint_details

    joint_details.warm_up()


def run_engine(method: str, resolution: Resolution, mosaic: Mosaic) -> FrameImages | None:
    """A method's images of one frame in its light, or None: batches, other devices, no OpenVINO.

    Frames in other orientations than the network's are turned before and after, as `networks.run.run_joint` does.
    """
    data = mosaic.data
    if find_spec("openvino") is None or data.ndim != 2 or data.device.type != "cpu":
        return None
    orientation = orient(mosaic, own_order(mosaic.layout))
    if not orientation.keeps_cells or data.dtype not in (torch.uint8, torch.uint16, torch.float32):
        return None
    make_ready(_warm_up)
    if resolution == "full":
        make_ready(_warm_up_full)
    as_it_is = orientation == Orientation(*data.shape) and not any(n % PERIOD for n in data.shape)
    turned = data if as_it_is else orientation.turn(data.float()).contiguous()
    frame, grid = replace(mosaic, data=turned), PERIOD * ENGINES.network(method, mosaic.layout.channels).net.grid
    strips = _strips((turned.shape[0], turned.shape[1]), grid)
    images = _join([_run_strip(method, resolution, frame, strip) for strip in strips])
    return images if as_it_is else _turn_back(images, orientation, 2 if resolution == "full" else 1)


class _Strip(NamedTuple):
    """Raw rows of a frame that an engine sees, and those of which it is to give images."""

    seen: tuple[int, int]
    kept: tuple[int, int]


def _strips(size: tuple[int, int], grid: int) -> Iterator[_Strip]:
    """A frame as one strip or, if it is huge, as several of at most two heights, since an engine is for one."""
    height, pieces = size[0], list(cut_rows(size, grid))
    if len(pieces) == 1:
        yield _Strip(pieces[0], pieces[0])
        return
    rows = pieces[0][1] + 2 * MARGIN
    for first, last in pieces:
        top = max(min(first - MARGIN, (height - rows) // grid * grid), 0)
        bottom = height if height - top - rows < grid else top + rows
        yield _Strip((top, bottom), (first, last))


def _run_strip(method: str, resolution: Resolution, mosaic: Mosaic, strip: _Strip) -> FrameImages:
    """Images of the rows that a strip keeps."""
    from polsep.kernels import get_threads

    (top, bottom), cells = strip.seen, 1 if resolution == "full" else 2
    job = _Job(method, resolution, mosaic.layout.channels, (bottom - top, mosaic.data.shape[1]), get_threads())
    kept = slice(*((row - top) // cells for row in strip.kept))
    with ENGINES.borrow(job) as engine:
        raw, levels = mosaic.data[top:bottom].numpy(), (mosaic.black_level, mosaic.white_level)
        return engine.run(raw, levels, mosaic.light_color, kept)


def _join(parts: list[FrameImages]) -> FrameImages:
    """Strips as one frame."""
    if len(parts) == 1:
        return parts[0]

    def rows(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in parts])

    diffuse, specular, valid, dolp, aolp, error = map(rows, ("diffuse", "specular", "valid", "dolp", "aolp", "error"))
    return FrameImages(
        diffuse, specular, valid, dolp, aolp, reduce(add, (part.tally for part in parts if part.tally)), error
    )


def _turn_back(images: FrameImages, orientation: Orientation, scale: int) -> FrameImages:
    """Images of a turned frame, ``scale`` pixels along a cell's side, as those of the frame itself.

    The tally is of all that was seen.
    """

    def turn(image: NDArray[Any]) -> NDArray[Any]:
        planes = torch.from_numpy(image)
        planes = planes.movedim(-1, 0) if planes.ndim == 3 else planes
        planes = orientation.turn_back(planes, scale)
        return np.ascontiguousarray((planes.movedim(0, -1) if planes.ndim == 3 else planes).numpy())

    assert images.dolp is not None and images.aolp is not None and images.error is not None and images.tally is not None
    aolp, tally, mirrored = turn(images.aolp), images.tally, orientation.down != orientation.across
    if orientation.transposed:
        aolp, tally = _wrap(np.float32(np.pi / 2) - aolp), replace(tally, along=-tally.along)
    if mirrored:
        aolp, tally = _wrap(-aolp), replace(tally, across=-tally.across)
    diffuse, specular, error = (turn(image) for image in (images.diffuse, images.specular, images.error))
    return FrameImages(diffuse, specular, turn(images.valid), turn(images.dolp), aolp, tally, error)


def _wrap(angle: Floats) -> Floats:
    """The same AoLP in [0, pi); what rounding takes to pi is 0."""
    pi = np.float32(np.pi)
    wrapped: Floats = np.mod(angle, pi)
    wrapped[wrapped >= pi] = 0
    return wrapped
