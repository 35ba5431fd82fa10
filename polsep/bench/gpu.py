"""Frames per second on a GPU, and what half precision changes.

All see the demo capture, 2448x2048 colour, in its light, stated. Rates:

* "raw frame in, images out": upload, separation, report, and images as NumPy arrays; two frames at once, so that the
  host works on one while the device has the other, as in `polsep video --device cuda`;
* "on the device": without upload and download;
* "polsep.separate": one call after the other, with the checks of the frame and the light's colour found.

Layers of networks run in float16 (`networks.run.LAYERS`), in float32 for comparison, and compiled (POLSEP_COMPILE).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

import polsep
from polsep.bench.rows import Row
from polsep.bench.truth import read_demo_capture
from polsep.compute.arrays import to_numpy
from polsep.compute.workers import map_ahead
from polsep.light.find import find_light
from polsep.methods import METHODS, Method
from polsep.networks import run
from polsep.pipeline import make_frame, move_capture
from polsep.sensor.camera import Mosaic
from polsep.shipped import NAMES

#: Methods, and those of them that are measured compiled too, which takes a minute each.
MEASURED, COMPILED = ("joint-fast", "joint", "joint-large", "color-affine", "analytic"), ("joint-fast", "joint")
#: Frames that are not counted, and seconds of those that are.
FIRST, SECONDS = 4, 2.0


@dataclass(frozen=True)
class Task:
    """One frame in the computer's memory, for a ``device``, in its ``light``, at full resolution or half."""

    frame: Mosaic
    device: str
    light: tuple[float, ...]
    full: bool


def bench_gpu() -> Iterator[Row]:
    """Frames/s of methods on a GPU, half and full resolution, with and without transfers; float16 against float32.

    Some minutes. Raises ValueError where torch finds no GPU.
    """
    if not torch.cuda.is_available():
        raise ValueError(f"expected a GPU that torch {torch.__version__} can use (CUDA), found none")
    properties = torch.cuda.get_device_properties(0)
    yield Row("gpu", "device", properties.name, "memory", properties.total_memory / 2**30, "GiB")
    yield from measure("cuda", read_demo_capture())


def measure(device: str, capture: Mosaic, methods: tuple[str, ...] = MEASURED) -> Iterator[Row]:
    """Rows of methods on a device."""
    frame = replace(capture, data=to_numpy(capture.data).astype(np.uint16))
    light = find_light(frame).color
    for full in (False, True):
        task, case = Task(frame, device, light, full), f"{'full' if full else 'half'} resolution"
        for name in methods:
            method = METHODS[name]
            for metric, rate in _rates(method, task):
                yield Row("gpu", case, name, metric, rate, "frames/s")
            if name in NAMES:
                yield from _precision_rows(method, task, case)
            if name in COMPILED:
                with patch.object(run.State, "compiled", True):
                    for metric, rate in _rates(method, task):
                        if run.State.compiled:  # else that failed, which was said
                            yield Row("gpu", case, name, f"{metric}, compiled", rate, "frames/s")
            whole = partial_separate(name, task)
            yield Row("gpu", case, name, "polsep.separate", _rate((whole() for _ in repeat(None)), device), "frames/s")


def partial_separate(name: str, task: Task) -> Callable[[], Any]:
    """`polsep.separate` of the task's frame."""
    frame = task.frame
    return lambda: polsep.separate(
        frame.data, name, frame.layout, frame.black_level, frame.white_level, device=task.device, full=task.full
    )


def _rates(method: Method, task: Task) -> Iterator[tuple[str, float]]:
    here = move_capture(task.frame, task.device)

    def separate(frame: Mosaic) -> Any:
        moved = move_capture(frame, task.device)
        return make_frame(method.run(moved, task.light, task.full), method, moved, task.light, task.full)

    yield "raw frame in, images out", _rate(map_ahead(separate, repeat(task.frame), 2), task.device)
    yield "on the device", _rate((method.run(here, task.light, task.full) for _ in repeat(None)), task.device)


def _rate(frames: Iterator[Any], device: str) -> float:
    """Frames/s of frames after the first ones."""
    for _ in range(FIRST):
        next(frames)
    _wait(device)
    count, start = 0, time.perf_counter()
    while count < FIRST or time.perf_counter() - start < SECONDS:
        next(frames)
        count += 1
    _wait(device)
    return count / (time.perf_counter() - start)


def _precision_rows(method: Method, task: Task, case: str) -> Iterator[Row]:
    """Rows of layers in float32, and of what the images differ."""
    here = move_capture(task.frame, task.device)
    found = method.run(here, task.light, task.full)
    with patch.object(run, "LAYERS", {}):
        for metric, rate in _rates(method, task):
            yield Row("gpu", case, method.name, f"{metric}, float32", rate, "frames/s")
        exact = method.run(here, task.light, task.full)
    for name in ("diffuse", "specular"):
        apart = to_numpy(getattr(found, name)).astype(np.float64) - to_numpy(getattr(exact, name))
        noise = max(float(np.mean(apart**2)), 1e-30)
        yield Row("gpu", case, method.name, f"{name} PSNR of float16 layers", -10 * np.log10(noise), "dB")


def _wait(device: str) -> None:
    """Wait until a GPU has done all that it was given."""
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
