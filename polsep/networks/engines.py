"""The joint network on CPUs for frames of every size and orientation, by engines kept from frame to frame.

An engine (`openvino_engine`) is for frames of one size. Twin: `run`, in torch, for batches and on other devices.
"""

from __future__ import annotations

import logging
import operator
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute import pages
from polsep.compute.arrays import to_numpy
from polsep.compute.threads import get_threads, run_over_rows
from polsep.compute.warm_up import make_ready
from polsep.demosaic.bilinear import mean_cells
from polsep.networks import combine_kernel, details_kernel, images_kernel
from polsep.networks.channels import PERIOD
from polsep.networks.combine_kernel import Rows, add_images
from polsep.networks.graphs import require_own_threads
from polsep.networks.images_kernel import Targets
from polsep.networks.joint_weights import JointWeights
from polsep.networks.openvino_engine import OpenVinoEngine, RawRows, as_images, asked_precision, modulation_of
from polsep.networks.sizes import ResidualSize
from polsep.networks.strips import cut_rows, margin_of
from polsep.physics.stokes import wrap_aolp
from polsep.sensor.camera import Layout, Mosaic
from polsep.sensor.orient import Orientation, orient, shifts_of
from polsep.separation.images import FrameImages
from polsep.separation.report import tally_again

#: Engines that are kept at least, each with the memory that its frames need.
KEPT = 2
#: Rows of an image that a thread copies at a time.
ROWS = 64


class _Job(NamedTuple):
    """A kind of work that an engine is made for; ``layers``: the precision that is asked for, if one is."""

    network: JointWeights
    full: bool
    shape: tuple[int, int]
    threads: int
    layers: str | None


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


def _make_engine(job: _Job) -> OpenVinoEngine:
    logging.getLogger("polsep").debug("compiling a network for frames of %dx%d", *job.shape)
    return OpenVinoEngine(job.network, job.shape, job.full)


def run_engine(network: JointWeights, mosaic: Mosaic, full: bool) -> FrameImages:
    """A network's images of one frame ``[H, W]`` on the CPU, in its light.

    Frames in other orientations than the network's are turned before and after, as in `run.run_joint`, and seen at
    several shifts where it averages these. Huge frames are cut into strips, all of one height, since an engine is for
    one size. Raises ValueError on layouts that are not Sony's in any orientation, and RuntimeError as
    `require_own_threads`.
    """
    require_own_threads()
    wanted = Layout.sony(mosaic.layout.channels)
    orientation = orient(mosaic, wanted)
    if not full and not orientation.keeps_cells:  # then the network's cells are not the frame's
        return _halve(run_engine(network, mosaic, full=True), mosaic.light_color)
    make_ready(images_kernel.warm_up)
    if full:
        make_ready(details_kernel.warm_up)
    shifts = shifts_of(mosaic, wanted) if network.averages_shifts else (orientation,)
    return combine_images((_run_turned(network, mosaic, shift, full) for shift in shifts), mosaic.light_color)


def _halve(images: FrameImages, light: tuple[float, ...]) -> FrameImages:
    """Means over 2x2 cells of images at full resolution, in a ``light``; a cell is valid if all of its pixels are.

    In the tally, polarization and clipping are the means over the pixels at full resolution.
    """
    assert images.dolp is not None and images.aolp is not None and images.error is not None
    colors = images.diffuse.shape[-1]
    s0 = ((images.diffuse + images.specular) / np.array(light[:colors], np.float32)).mean(axis=-1)
    polarized = _mean_cells(s0 * images.dolp * np.exp(2j * images.aolp))
    s0 = _mean_cells(s0)
    dolp = np.where(s0 > 0, np.abs(polarized) / np.where(s0 > 0, s0, 1), 0).astype(np.float32)
    diffuse, specular, error = (_mean_cells(image) for image in (images.diffuse, images.specular, images.error))
    valid = _mean_cells(images.valid.astype(np.float32)) == 1
    aolp = wrap_aolp((np.angle(polarized) / 2).astype(np.float32))
    assert images.tally is not None
    halved = FrameImages(diffuse, specular, valid, dolp, aolp, images.tally.of_pixels(valid.size), error)
    return tally_again(halved, light)


def _mean_cells(image: NDArray[Any]) -> NDArray[Any]:
    """`mean_cells` of an image ``[H, W, ...]``."""
    return np.moveaxis(mean_cells(np.moveaxis(image, (0, 1), (-2, -1))), (-2, -1), (0, 1))


def combine_images(
    images: Iterable[FrameImages], light: tuple[float, ...], shares: Sequence[float] = ()
) -> FrameImages:
    """Images of one frame in a ``light``, weighed as `run.combine` does, in the arrays of the first.

    They are asked for one after the other, so that no more than two are in memory. The tally is of what they became,
    but for the polarization of highlights, which is the mean of theirs.
    """
    remaining = iter(images)
    first = next(remaining)
    tallies, (rows, columns) = [first.tally], first.valid.shape
    gains = np.array(light[: first.diffuse.shape[-1]], np.float32)
    weights, sums = np.empty((rows, 2 * columns), np.float32), np.zeros((rows, combine_kernel.SUMS))
    for k, other in enumerate(remaining, 1):
        make_ready(combine_kernel.warm_up)
        factors = np.array((shares[0], shares[k]) if shares else (1, 1), np.float32)
        add = partial(add_images, _as_rows(first), _as_rows(other), factors, k, weights, gains, sums)
        run_over_rows(add, rows, 1)
        tallies.append(other.tally)
    if len(tallies) == 1:
        return first
    tally = reduce(operator.add, filter(None, tallies)).of_pixels(first.valid.size)
    diffuse, specular, *variances, above_one, valid = sums.sum(axis=0).tolist()
    tally = replace(tally, valid=int(valid), above_one=int(above_one), s0=diffuse + specular, specular=specular)
    return replace(first, tally=replace(tally, diffuse_variance=variances[0], specular_variance=variances[1]))


def _as_rows(images: FrameImages) -> Rows:
    assert images.dolp is not None and images.aolp is not None and images.error is not None
    rows = len(images.valid)
    diffuse, specular = images.diffuse.reshape(rows, -1, copy=False), images.specular.reshape(rows, -1, copy=False)
    return Rows(diffuse, specular, images.error.reshape(rows, -1, copy=False), images.valid, images.dolp, images.aolp)


def _run_turned(network: JointWeights, mosaic: Mosaic, orientation: Orientation, full: bool) -> FrameImages:
    """A frame's images in one orientation."""
    data = to_numpy(mosaic.data)
    as_it_is = orientation == Orientation(*data.shape) and not any(n % PERIOD for n in data.shape)
    readable = data.dtype in (np.uint8, np.uint16, np.float32)
    samples = data if readable else data.astype(np.float32)
    turned = samples if as_it_is else np.ascontiguousarray(orientation.turn(samples))
    cells, levels = 1 if full else 2, (mosaic.black_level, mosaic.white_level)
    light = mosaic.light_color[::-1] if orientation.swapped else mosaic.light_color
    modulation = modulation_of(network, turned, levels, light)
    targets = Targets.empty((turned.shape[0] // cells, turned.shape[1] // cells), network.colors)
    for (top, bottom), kept in _strips((turned.shape[0], turned.shape[1]), network.size, full):
        seen = RawRows(turned[top:bottom], levels, light, modulation)
        own = Targets._make(image[top // cells : bottom // cells] for image in targets)
        job = _Job(network, full, seen.raw.shape, get_threads(), asked_precision())
        with ENGINES.borrow(job) as engine:
            engine.fill(seen, own, ((kept[0] - top) // PERIOD, (kept[1] - top) // PERIOD))
    images = as_images(targets)
    if as_it_is:
        return images
    found = _turn_back(images, orientation, 2 if full else 1)
    return found if found.valid.size == images.valid.size else tally_again(found, mosaic.light_color)


def _strips(
    shape: tuple[int, int], size: ResidualSize, full: bool
) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
    """Raw rows that an engine sees and those that it makes images of: one strip, or several of one height."""
    grid, margin = PERIOD * size.grid, margin_of(size)
    height, pieces = shape[0], list(cut_rows(shape, size, full))
    if len(pieces) == 1:
        yield pieces[0], pieces[0]
        return
    rows = pieces[0][1] + margin * min(len(pieces) - 1, 2)
    rows += (height - rows) % grid  # so that the last strip, too, begins at a multiple of the grid
    for first, last in pieces:
        top = max(min(first - margin, height - rows), 0)
        yield (top, top + rows), (first, last)


def _as_contiguous(image: NDArray[Any]) -> NDArray[Any]:
    """NumPy's function of that name by all threads, in memory that is used again."""
    if image.flags.c_contiguous:
        return image
    copy: NDArray[Any] = pages.empty(image.shape, image.dtype.type)
    run_over_rows(lambda rows: np.copyto(copy[slice(*rows)], image[slice(*rows)]), len(image), ROWS)
    return copy


def _turn_back(images: FrameImages, orientation: Orientation, scale: int) -> FrameImages:
    """Images of a turned frame, ``scale`` pixels along a cell's side, as those of the frame itself.

    The tally has the means over all pixels that the network saw, those of continued frames too.
    """

    def turn(image: NDArray[Any]) -> NDArray[Any]:
        planes = np.moveaxis(image, -1, 0) if image.ndim == 3 else image
        planes = planes[::-1] if orientation.swapped and len(planes) == 3 else planes
        planes = orientation.turn_back(planes, scale)
        return _as_contiguous(np.moveaxis(planes, 0, -1) if planes.ndim == 3 else planes)

    turned, tally = {name: turn(image) for name, image in images.arrays().items()}, images.tally
    assert tally is not None
    if orientation.transposed:
        turned["aolp"], tally = wrap_aolp(np.float32(np.pi / 2) - turned["aolp"]), replace(tally, along=-tally.along)
    if orientation.down != orientation.across:
        turned["aolp"], tally = wrap_aolp(-turned["aolp"]), replace(tally, across=-tally.across)
    return FrameImages(**turned, tally=tally.of_pixels(turned["valid"].size))
