"""Flicker and error on the films of `testsets.dynamic`: frame by frame, temporally filtered, and steadied.

``filtered``: of frames through `temporal.filter_frame`; ``steady``: of these, images through `temporal.steady_images`.

Regions of the half-resolution images, frame by frame: ``still`` cells have the truth of the frame before, ``apart``
are the still ones `APART` cells and more from any other, which methods' windows do not reach; ``moving`` are the rest.
Flicker is the rms over frames and still cells of how much the error (found - truth) changes from frame to frame.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from polsep.bench.rows import Row
from polsep.methods import METHODS, Method
from polsep.metrics import psnr
from polsep.physics.stokes import Stokes
from polsep.render.simulate import half_resolution
from polsep.sensor.camera import IMX250, Layout, Mosaic, expose
from polsep.video.temporal import Images, TemporalState, filter_frame, steady_images

if TYPE_CHECKING:
    from evaluation.testsets.dynamic import Film

#: Methods that are compared, those of them that are installed.
COMPARED = ("color-affine", "joint-fast", "joint")
#: Frames of the quick version: around the first one in which the light moves.
QUICK = range(15, 25)
#: Cells between what is ``apart`` and any change: the reach of the closed form's largest window.
APART = 12
#: Regions and metrics whose change is shown.
SHOWN = (("still", "flicker"), ("apart", "flicker"), ("still", "PSNR"), ("moving", "PSNR"))
#: Fewest cells of a region that are worth a score.
MIN_CELLS = 100
#: Size of a frame of the camera, and how often the filter is timed on it.
SIZE, RUNS = (2048, 2448), 40
OUTPUTS = ("diffuse", "specular")

#: Diffuse and specular ``[C, h, w]``.
Pair = tuple[Tensor, Tensor]


class Tally:
    """Sums over the frames of a film: PSNR by output and region, squared flicker by output and region."""

    def __init__(self) -> None:
        self.psnr: dict[tuple[str, str], list[float]] = {}
        self.flicker: dict[tuple[str, str], list[float]] = {}
        self._error: Pair | None = None

    def add(self, found: Pair, truth: Pair, regions: dict[str, Tensor]) -> None:
        """A frame; ``regions``: masks ``[h, w]``."""
        error = (found[0] - truth[0], found[1] - truth[1])
        for k, output in enumerate(OUTPUTS):
            for region, mask in regions.items():
                if int(mask.sum()) < MIN_CELLS:
                    continue
                self.psnr.setdefault((output, region), []).append(psnr(found[k], truth[k], mask))
                if self._error is not None and region in ("still", "apart"):
                    change = ((error[k] - self._error[k]) ** 2).mean(dim=0)[mask]
                    self.flicker.setdefault((output, region), []).append(float(change.double().sum()))
                    self.flicker.setdefault((output, f"{region}, cells"), []).append(float(mask.sum()))
        self._error = error

    def scores(self) -> Iterator[tuple[str, str, str, float]]:
        """Region, metric, unit and value: means of PSNR over frames, rms flicker."""
        for (output, region), values in self.psnr.items():
            yield region, f"{output} PSNR", "dB", statistics.fmean(values)
        for (output, region), squares in self.flicker.items():
            if not region.endswith(", cells"):
                cells = sum(self.flicker[output, f"{region}, cells"])
                yield region, f"{output} flicker", "white", math.sqrt(sum(squares) / cells)


def bench_dynamic(numbers: range | None = None) -> Iterator[Row]:
    """Flicker and PSNR on the dynamic selection set with and without the temporal filter, and what a frame of it takes.

    ``numbers``: of frames of each film, all by default. Raises ValueError without the extra render, and on a frame that
    does not come out as recorded.
    """
    try:
        from evaluation.testsets import dynamic
    except ImportError as error:
        raise ValueError(f"expected the extra render, found no {error.name}") from None
    methods = [METHODS[name] for name in COMPARED if name in METHODS]
    for film in dynamic.FILMS.values():
        yield from score_film(film, numbers or range(dynamic.FRAMES), methods)
    yield from time_filter()


def score_film(film: Film, numbers: range, methods: Sequence[Method]) -> Iterator[Row]:
    """Rows of every method on some frames of a film: alone, filtered, and what the filter changes."""
    from evaluation.testsets.dynamic import check_frame, play

    alone, filtered, steady = ({method.name: Tally() for method in methods} for _ in range(3))
    state: TemporalState | None = None
    before: dict[str, Images | None] = dict.fromkeys(alone)
    for frame in play(film, numbers):
        check_frame(film, frame)
        diffuse, specular, mask = half_resolution(frame.scene)
        regions = find_regions(mask, frame.still)
        calm, state = filter_frame(frame.mosaic, state)
        for method in methods:
            truth, name = (diffuse, specular), method.name
            alone[name].add(_as_pair(separate_half(method, frame.mosaic)), truth, regions)
            found = separate_half(method, calm)
            filtered[name].add(_as_pair(found), truth, regions)
            found = before[name] = steady_images(found, before[name], state)
            steady[name].add(_as_pair(found), truth, regions)
    for name, tally in alone.items():
        variants = {"filtered": filtered[name], "steady": steady[name]}
        yield from _compare(film.name, name, tally, variants)


def _compare(film: str, method: str, alone: Tally, variants: dict[str, Tally]) -> Iterator[Row]:
    """Rows of one method, and how the variants differ from it: PSNR in dB, flicker as a ratio."""
    before = {(region, metric): (unit, value) for region, metric, unit, value in alone.scores()}
    for (region, metric), (unit, value) in before.items():
        yield Row("dynamic/films", f"{film}, {region}", method, metric, value, unit)
    for variant, tally in variants.items():
        for region, metric, unit, value in tally.scores():
            yield Row("dynamic/films", f"{film}, {region}", f"{method}, {variant}", metric, value, unit)
            old, ratio = before[region, metric][1], metric.endswith("flicker")
            change, unit = (value / old, "1") if ratio else (value - old, unit)
            if (region, metric.split()[-1]) in SHOWN:
                yield Row("dynamic/change", film, f"{method}, {variant}", f"{metric}, {region}", change, unit)


def find_regions(mask: Tensor, still: Tensor) -> dict[str, Tensor]:
    """Masks ``[h, w]`` of the regions, from the cells on objects ``[h, w]`` and the still pixels ``[2 h, 2 w]``."""
    cells = avg_pool2d(still[None].float(), 2)[0] == 1
    near = max_pool2d((~cells)[None].float(), 2 * APART + 1, 1, APART)[0] > 0
    return {"all": mask, "still": mask & cells, "apart": mask & ~near, "moving": mask & ~cells}


def separate_half(method: Method, mosaic: Mosaic) -> Images:
    """A method's diffuse and specular ``[h, w, C]`` at half resolution, by its compiled twin where there is one."""
    images = method.run(mosaic, mosaic.light_color, False)
    return images.diffuse, images.specular


def _as_pair(images: Images) -> Pair:
    diffuse, specular = (torch.from_numpy(image).movedim(-1, 0) for image in images)
    return diffuse, specular


def time_filter() -> Iterator[Row]:
    """Milliseconds that a still noisy frame of the camera takes: best and median of `RUNS`."""
    height, width = SIZE
    coarse = np.random.default_rng(1).uniform(0.1, 1.5, (height // 32, -(-width // 32)))
    grey = torch.from_numpy(coarse.repeat(32, axis=0).repeat(32, axis=1)[:, :width]).float().expand(3, -1, -1)
    light, generator = Stokes(grey, 0 * grey, 0 * grey), torch.Generator().manual_seed(1)
    exposed = [expose(light, Layout(), IMX250, generator) for _ in range(2)]
    frames = [replace(frame, data=frame.data.to(torch.uint16)) for frame in exposed]
    blank = np.zeros((height // 2, width // 2, 3), np.float32)
    state: TemporalState | None = None
    times: dict[str, list[float]] = {"filter_frame": [], "steady_images": []}
    for k in range(RUNS + 1):
        start = time.perf_counter()
        _, state = filter_frame(frames[k % 2], state)
        middle = time.perf_counter()
        steady_images((blank, blank), (blank, blank), state)
        times["filter_frame"].append(middle - start)
        times["steady_images"].append(time.perf_counter() - middle)
    for name, found in times.items():
        for metric, value in (("time", min(found[1:])), ("time, median", statistics.median(found[1:]))):
            yield Row("dynamic/time", f"{width}x{height} colour frame", name, metric, 1000 * value, "ms")
