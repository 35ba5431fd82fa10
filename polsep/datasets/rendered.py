"""`polsep render`: the views of a set, the workers that render them, and resuming.

A set is a list of views, each a function of its numbers alone (`polsep.render.views`). A worker renders a few views of
one shape at a time and builds the shape once; files do not depend on the number and order of workers. Complete files
are not rendered again (`polsep.io.results.dataset`).

An engine runs jobs and yields how many views are done: processes of this machine, or tasks of a Ray cluster (extra
``ray``).
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import math
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep.compute.cluster import map_unordered
from polsep.compute.threads import set_threads
from polsep.io.results.dataset import (
    FORMATS,
    begin_dataset,
    find_finished,
    finish_dataset,
    remove_unfinished,
    view_stem,
    write_view,
)
from polsep.io.results.exr import LARGEST_HALF
from polsep.render.raycast import MeshScene
from polsep.render.simulate import Capture
from polsep.render.views import SPLITS, Shot, capture_shot, random_shot, scene_seed, seeded_shape

#: Views of one shape in a job.
VIEWS_PER_JOB = 4
#: Packages whose versions may change the last bits of a set.
MAKERS = ("polsep", "torch", "numpy", "numba", "llvmlite", "embreex", "imagecodecs", "OpenEXR")


@dataclass(frozen=True)
class RenderOptions:
    """Options that determine every byte of a set. ``size``: pixels of a side; ``samples`` x ``samples`` rays per pixel.

    The paper's set is 500 shapes of 20 views at 1024 pixels. Raises ValueError on values out of range.
    """

    shapes: int
    views: int
    size: int = 1024
    seed: int = 0
    split: str = "train"
    samples: int = 2
    format: str = "exr"

    def __post_init__(self) -> None:
        for name, low, high in (("shapes", 1, 99_999), ("views", 1, 10_000), ("samples", 1, 16), ("seed", 0, 2**63)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"expected {name} from {low} to {high}, found {getattr(self, name)}")
        if not 32 <= self.size <= 16_384 or self.size % 4:
            raise ValueError(f"expected a size from 32 to 16384, a multiple of 4, found {self.size}")
        if self.split not in SPLITS:
            raise ValueError(f"expected a split of {', '.join(SPLITS)}, found {self.split!r}")
        if self.format not in FORMATS:
            raise ValueError(f"expected a format of {', '.join(FORMATS)}, found {self.format!r}")

    @property
    def stems(self) -> list[str]:
        """File stems of all views, in order."""
        return [view_stem(shape, view) for shape in range(self.shapes) for view in range(self.views)]


@dataclass(frozen=True)
class Job:
    """Some ``views`` of one ``shape``, written into ``directory``."""

    options: RenderOptions
    directory: str
    shape: int
    views: tuple[int, ...]


#: Runs jobs with a number of workers; yields the number of views of every finished job, in any order.
Engine = Callable[[Sequence[Job], int], Generator[int, None, None]]


def default_workers() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def plan_jobs(options: RenderOptions, directory: Path, finished: set[str]) -> list[Job]:
    """Return jobs for all views that are not finished, by shape."""
    jobs = []
    for shape in range(options.shapes):
        missing = [view for view in range(options.views) if view_stem(shape, view) not in finished]
        for first in range(0, len(missing), VIEWS_PER_JOB):
            jobs.append(Job(options, str(directory), shape, tuple(missing[first : first + VIEWS_PER_JOB])))
    return jobs


def render_dataset(options: RenderOptions, directory: Path, workers: int, engine: str = "local") -> Iterator[int]:
    """Render the missing views of a set; yields how many exist, first those of earlier runs.

    Raises ValueError on bad arguments or another set's directory, OSError when a file cannot be written, RuntimeError
    when a worker dies. Finished views stay, and the same call resumes.
    """
    if engine not in ENGINES:
        raise ValueError(f"expected an engine of {', '.join(ENGINES)}, found {engine!r}")
    if workers < 1:
        raise ValueError(f"expected 1 worker or more, found {workers}")
    directory = directory.resolve()
    described = {**asdict(options), "versions": {name: importlib.metadata.version(name) for name in MAKERS}}
    begin_dataset(directory, described)
    finished = find_finished(directory, options.stems)
    done = len(finished)
    yield done
    try:
        with contextlib.closing(ENGINES[engine](plan_jobs(options, directory, finished), workers)) as counts:
            for count in counts:
                done += count
                yield done
    except BaseException:
        remove_unfinished(directory)
        raise
    finish_dataset(directory, options.stems, described)


@lru_cache(maxsize=1)
def _shape(split: str, seed: int, shape: int) -> MeshScene:
    return seeded_shape(split, seed, shape)


def render_job(job: Job) -> int:
    """Render and write the views of a job; return their number."""
    torch.set_num_threads(1)  # workers share the cores already
    set_threads(1)
    options = job.options
    shape = _shape(options.split, options.seed, job.shape)
    for index in job.views:
        seed = scene_seed(options.split, options.seed, job.shape, index)
        generator = torch.Generator().manual_seed(seed)
        shot = random_shot(shape, generator)
        frame = capture_shot(shape, shot, options.size, options.samples, generator)
        record = {"split": options.split, "seed": options.seed, "shape": job.shape, "view": index, "view_seed": seed}
        record["shape_seed"] = scene_seed(options.split, options.seed, job.shape)
        record |= describe_shot(shot, frame)
        write_view(Path(job.directory), view_stem(job.shape, index), images_of(frame), record, options.format)
    return len(job.views)


def describe_shot(shot: Shot, frame: Capture) -> dict[str, Any]:
    """Return the record of a view: camera, light and exposure; angles in degrees, lengths in scene units."""
    light = asdict(shot.light)
    light["polarizer_deg"] = round(math.degrees(light.pop("polarizer")), 6)
    inside = frame.scene.mask
    return {
        "camera": asdict(shot.camera),
        "light": light,
        "blur": shot.blur,
        "clip": shot.clip,
        "clipped": round(float(frame.mosaic.clipped()[inside].double().mean()), 6),
        "covered": round(float(inside.double().mean()), 6),
        "layout": frame.mosaic.layout.spec,
        "black_level": frame.mosaic.black_level,
        "white_level": frame.mosaic.white_level,
    }


def images_of(frame: Capture) -> dict[str, NDArray[Any]]:
    """Return the arrays of a capture for `io.results.dataset.write_view`."""
    scene = frame.scene
    light = scene.diffuse + scene.specular

    def half(image: Tensor) -> NDArray[np.float16]:
        return np.asarray(image.permute(1, 2, 0).clamp(-LARGEST_HALF, LARGEST_HALF).numpy().astype(np.float16))

    return {
        "mosaic": frame.mosaic.data.numpy().astype(np.uint16),
        "diffuse": half(scene.diffuse.s0),
        "specular": half(scene.specular.s0),
        "s1": half(light.s1),
        "s2": half(light.s2),
        "mask": scene.mask.numpy(),
    }


def run_in_processes(jobs: Sequence[Job], workers: int) -> Generator[int, None, None]:
    """Run jobs in processes of this machine, which end with this one, however it ends."""
    if not jobs:
        return
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _exit_with_parent)
    with _sigint_ignored():
        futures = [pool.submit(render_job, job) for job in jobs]
    try:
        for future in as_completed(futures):
            yield future.result()
    except BrokenProcessPool as error:
        raise RuntimeError(f"expected workers to live, found one dead, as when memory runs out ({error})") from error
    except BaseException:
        # Files are renamed into place when complete, so workers can be killed at any time.
        for process in set(multiprocessing.active_children()) - before:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _sigint_ignored() -> Iterator[None]:
    """Ignore SIGINT inside, so that processes started here inherit that and leave Ctrl-C to this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _exit_with_parent() -> None:
    """Watch the parent process and end this worker when it is gone.

    A pool's workers hold both ends of the pipe on which they wait for jobs, so they would not notice a killed parent.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def run_on_ray(jobs: Sequence[Job], workers: int) -> Generator[int, None, None]:
    """Run jobs as tasks of a Ray cluster; the directory of the set must have one path on all nodes."""
    yield from map_unordered(render_job, jobs, workers)


#: Engines by their names on the command line.
ENGINES: dict[str, Engine] = {"local": run_in_processes, "ray": run_on_ray}
