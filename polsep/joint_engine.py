"""The joint network on CPUs: engines of `openvino_engine` for frames of every size and orientation.

They are kept from frame to frame. Without OpenVINO, and for frames that it does not take, torch does the work.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from polsep.camera import Layout, Mosaic
from polsep.engine import make_ready
from polsep.joint import PERIOD
from polsep.mosaic_network import MOST_PIXELS, Resolution, find_joint, own_order
from polsep.openvino_engine import Floats, FullEngine, JointImages, OpenVinoEngine
from polsep.orient import Orientation, orient

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
        return (FullEngine if job.resolution == "full" else OpenVinoEngine)(network, job.shape)


def _warm_up() -> None:
    from polsep.kernels import joint_images

    joint_images.warm_up()


def _warm_up_full() -> None:
    from polsep.kernels import joint_details

    joint_details.warm_up()


def run_engine(method: str, resolution: Resolution, mosaic: Mosaic) -> JointImages | None:
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
    if resolution == "full":
        make_ready(_warm_up_full)
    from polsep.kernels import get_threads

    levels, light = (mosaic.black_level, mosaic.white_level), mosaic.light_color
    as_it_is = orientation == Orientation(*data.shape) and not any(n % PERIOD for n in data.shape)
    turned = data if as_it_is else orientation.turn(data.float()).contiguous()
    job = _Job(method, resolution, mosaic.layout.channels, (turned.shape[0], turned.shape[1]), get_threads())
    with ENGINES.borrow(job) as engine:
        images = engine.run(turned.numpy(), levels, light)
    return images if as_it_is else _turn_back(images, orientation, 2 if resolution == "full" else 1)


def _turn_back(images: JointImages, orientation: Orientation, scale: int) -> JointImages:
    """Images of a turned frame, ``scale`` pixels along a cell's side, as those of the frame itself.

    The tally is of all that was seen.
    """

    def turn(image: NDArray[Any]) -> NDArray[Any]:
        planes = torch.from_numpy(image)
        planes = planes.movedim(-1, 0) if planes.ndim == 3 else planes
        planes = orientation.turn_back(planes, scale)
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
