"""The joint network on CPUs for frames of every size and orientation, by engines kept from frame to frame.

An engine (`openvino_engine`) is for frames of one size. Without OpenVINO, and for frames that it does not accept, torch
does the work (`run`).
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

from polsep.compute.threads import get_threads
from polsep.compute.warm_up import make_ready
from polsep.networks.channels import PERIOD
from polsep.networks.joint import Joint
from polsep.networks.openvino_engine import OpenVinoEngine, modulation_of
from polsep.networks.run import LEAST_ERROR, cut_rows, margin_of, own_order
from polsep.sensor.camera import Mosaic
from polsep.sensor.orient import Orientation, orient, shifts_of
from polsep.separation.images import FrameImages

#: Engines that are kept at least, each with the memory that its frames need.
KEPT = 2


class _Job(NamedTuple):
    """A kind of work that an engine is made for."""

    network: Joint
    full: bool
    shape: tuple[int, int]
    threads: int


class _Engines:
    """Engines, each for one frame at a time. State: idle ones, the last used at the end, and how many are busy.

    As many are kept as were ever busy at once.
    """

    def __init__(self) -> None:
        self._lock, self._idle, self._busy, self._kept = threading.Lock(), list[tuple[_Job, OpenVinoEngine]](), 0, KEPT

    @contextmanager
    def borrow(self, job: _Job) -> Iterator[OpenVinoEngine]:
        """An idle engine, or a new one."""
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
        """Forget idle engines."""
        with self._lock:
            self._idle = []


ENGINES = _Engines()
_MAKING = threading.Lock()


def _make_engine(job: _Job) -> OpenVinoEngine:
    """One at a time: torch cannot trace two modules at once."""
    with _MAKING:
        logging.getLogger("polsep").debug("compiling a network for frames of %dx%d", *job.shape)
        return OpenVinoEngine(job.network, job.shape, job.full)


def _warm_up() -> None:
    from polsep.networks import images_kernel

    images_kernel.warm_up()


def _warm_up_full() -> None:
    from polsep.networks import details_kernel

    details_kernel.warm_up()


def run_engine(network: Joint, mosaic: Mosaic, full: bool) -> FrameImages | None:
    """A network's images of one frame in its light, or None: batches, other devices, no OpenVINO.

    Frames in other orientations than the network's are turned before and after, as in `run.run_joint`. Huge frames are
    cut into strips, all of one height, since an engine is for one size.
    """
    data = mosaic.data
    if find_spec("openvino") is None or data.ndim != 2 or data.device.type != "cpu":
        return None
    orientation = orient(mosaic, own_order(mosaic.layout))
    if not orientation.keeps_cells or data.dtype not in (torch.uint8, torch.uint16, torch.float32):
        return None
    make_ready(_warm_up)
    if full:
        make_ready(_warm_up_full)
    ways = shifts_of(orientation) if network.averages_shifts else (orientation,)
    return combine_images([_run_turned(network, mosaic, way, full) for way in ways])


def combine_images(images: list[FrameImages]) -> FrameImages:
    """Images of one frame, weighed as `run.combine` does; the tally is that of all of them."""
    first = images[0]
    if len(images) == 1:
        return first
    arrays = {name: np.stack([one.arrays()[name] for one in images]) for name in first.arrays()}
    weights = np.maximum(arrays["error"], np.float32(LEAST_ERROR)) ** -2
    weights /= weights.sum(axis=0)
    polarization = (arrays["dolp"] * np.exp(2j * arrays["aolp"])).mean(axis=0).astype(np.complex64)
    return FrameImages(
        (weights[..., :1] * arrays["diffuse"]).sum(axis=0),
        (weights[..., 1:] * arrays["specular"]).sum(axis=0),
        np.asarray(arrays["valid"].all(axis=0)),
        np.abs(polarization),
        _wrap(np.angle(polarization) / 2),
        reduce(add, (one.tally for one in images if one.tally is not None)),
        (weights * arrays["error"]).sum(axis=0),
    )


def _run_turned(network: Joint, mosaic: Mosaic, orientation: Orientation, full: bool) -> FrameImages:
    """A frame's images in one orientation."""
    data = mosaic.data
    as_it_is = orientation == Orientation(*data.shape) and not any(n % PERIOD for n in data.shape)
    turned = data if as_it_is else orientation.turn(data.float()).contiguous()
    cells, parts, levels = 1 if full else 2, [], (mosaic.black_level, mosaic.white_level)
    modulation = modulation_of(network, turned.numpy(), levels, mosaic.light_color)
    for (top, bottom), kept in _strips((turned.shape[0], turned.shape[1]), network):
        job = _Job(network, full, (bottom - top, turned.shape[1]), get_threads())
        with ENGINES.borrow(job) as engine:
            rows = slice(*((row - top) // cells for row in kept))
            parts.append(engine.run(turned[top:bottom].numpy(), levels, mosaic.light_color, modulation, rows))
    images = _join(parts)
    return images if as_it_is else _turn_back(images, orientation, 2 if full else 1)


def _strips(size: tuple[int, int], network: Joint) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Raw rows that an engine sees and those that it makes images of: one strip, or several of at most two heights."""
    grid, margin = PERIOD * network.net.grid, margin_of(network)
    height, pieces = size[0], list(cut_rows(size, margin, grid))
    if len(pieces) == 1:
        yield pieces[0], pieces[0]
        return
    rows = pieces[0][1] + 2 * margin
    for first, last in pieces:
        top = max(min(first - margin, (height - rows) // grid * grid), 0)
        bottom = height if height - top - rows < grid else top + rows
        yield (top, bottom), (first, last)


def _join(parts: list[FrameImages]) -> FrameImages:
    """Strips as one frame."""
    if len(parts) == 1:
        return parts[0]
    images = {name: np.concatenate([part.arrays()[name] for part in parts]) for name in parts[0].arrays()}
    return FrameImages(**images, tally=reduce(add, (part.tally for part in parts if part.tally is not None)))


def _turn_back(images: FrameImages, orientation: Orientation, scale: int) -> FrameImages:
    """Images of a turned frame, ``scale`` pixels along a cell's side, as those of the frame itself.

    The tally is of all pixels that the network saw.
    """

    def turn(image: NDArray[Any]) -> NDArray[Any]:
        planes = torch.from_numpy(image)
        planes = planes.movedim(-1, 0) if planes.ndim == 3 else planes
        planes = orientation.turn_back(planes, scale)
        return np.ascontiguousarray((planes.movedim(0, -1) if planes.ndim == 3 else planes).numpy())

    turned, tally = {name: turn(image) for name, image in images.arrays().items()}, images.tally
    assert tally is not None
    if orientation.transposed:
        turned["aolp"], tally = _wrap(np.float32(np.pi / 2) - turned["aolp"]), replace(tally, along=-tally.along)
    if orientation.down != orientation.across:
        turned["aolp"], tally = _wrap(-turned["aolp"]), replace(tally, across=-tally.across)
    return FrameImages(**turned, tally=tally)


def _wrap(angle: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same AoLP in [0, pi); values that rounding takes to pi become 0."""
    pi = np.float32(np.pi)
    wrapped: NDArray[np.float32] = np.mod(angle, pi)
    wrapped[wrapped >= pi] = 0
    return wrapped
