"""Time of one rendered image, direct light only, beside Mitsuba's compiled polarized variant doing the same.

The same random shapes with one material per slot, the same cameras, lights and points of pixels: 1024x1024 pixels of 4
rays each, to diffuse and specular Stokes images in three colours. Both have built their scenes before and run on all
cores. Mitsuba is driven by `pathtrace` with depth 1: per sample one ray, one shadow ray and both lobes of its polarized
plastic, compiled into one kernel. They take turns and the best time of each counts; the images are compared too.

And what users wait for: a set of `polsep render` with a worker per core, files written, from which the time of the
paper's 10,000 images follows; and training examples streamed by a worker per core, none of which is trained on.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from polsep.bench.rows import Row
from polsep.physics.stokes import Stokes

CASE = "1024x1024, 4 rays per pixel, direct light"
SIZE, SAMPLES = (1024, 1024), 2
#: Seeds of the random shapes, and how often each is rendered.
SEEDS, ROUNDS = (0, 1, 2, 3), 6
OURS, THEIRS = "polsep", "Mitsuba llvm polarized"
#: The set that is rendered: shapes, views of each; and the paper's number of images.
SHAPES, VIEWS, PAPER_IMAGES = 10, 20, 10_000
#: Sides in raw pixels of streamed crops, and batches that are counted, after those that fill the pools.
CROPS, BATCHES, FIRST_BATCHES = (128, 256), 500, 20


def bench_rendering() -> Iterator[Row]:
    """Rendering beside Mitsuba 3, a whole set, and streamed crops. Needs the extras train and mitsuba, and LLVM.

    Raises ValueError, before anything is measured, where one of them is missing.
    """
    try:
        import polsep.train.loop  # noqa: F401  # needed only after minutes, missed now
        from polsep.render.pathtrace import FAST_VARIANT, find_variant
    except ImportError as error:
        raise ValueError(f"expected the extras train and mitsuba, found no {error.name}") from None
    if find_variant() != FAST_VARIANT:
        raise ValueError("expected an LLVM that Mitsuba works with (libllvm19), found none: nothing to compare with")
    yield from _bench_images()
    yield from _bench_set()
    for crop in CROPS:
        yield from _bench_stream(crop)


def _bench_set() -> Iterator[Row]:
    """Seconds per image of 1 MP, rendered, exposed and written by worker processes."""
    from polsep.datasets.rendered import RenderOptions, default_workers, render_dataset

    options, workers = RenderOptions(SHAPES, VIEWS, seed=1), default_workers()
    with TemporaryDirectory() as folder:
        start = time.perf_counter()
        count = list(render_dataset(options, Path(folder) / "set", workers))[-1]
        seconds = (time.perf_counter() - start) / count
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file()) / count
    case = f"{count} views of 1024x1024, files written, {workers} workers"
    yield Row("rendering", case, OURS, "time per image", seconds, "s")
    yield Row("rendering", case, OURS, "rate", 60 / seconds, "images/min")
    yield Row(
        "rendering", case, OURS, f"time of {PAPER_IMAGES} images, extrapolated", seconds * PAPER_IMAGES / 3600, "h"
    )
    yield Row("rendering", case, OURS, "size per image", size / 1e6, "MB")


def _bench_stream(crop: int) -> Iterator[Row]:
    """Training crops per second that worker processes render, cut, expose and hand over."""
    from torch.utils.data import DataLoader

    from polsep.datasets.rendered import default_workers
    from polsep.train.loop import use_one_thread
    from polsep.train.stream import ExampleStream, StreamOptions

    options, workers = StreamOptions(crop=crop), default_workers()
    stream = ExampleStream(options)
    batches = iter(DataLoader(stream, batch_size=None, num_workers=workers, worker_init_fn=use_one_thread))
    for _ in itertools.islice(batches, FIRST_BATCHES):
        pass
    start = time.perf_counter()
    for _ in itertools.islice(batches, BATCHES):
        pass
    rate = BATCHES * options.batch / (time.perf_counter() - start)
    yield Row("rendering", f"streamed crops of {crop}x{crop}, {workers} workers", OURS, "crops", rate, "1/s")


def _bench_images() -> Iterator[Row]:
    """Seconds per rendered image of 1 MP, and how many times as fast as Mitsuba 3."""
    totals, agreeing = {OURS: 0.0, THEIRS: 0.0}, 1.0
    for seed in SEEDS:
        renderers = _build_renderers(seed)
        images = {name: torch.stack([_stacked(lobe) for lobe in render()]) for name, render in renderers.items()}
        wrong = (images[OURS] - images[THEIRS]).abs().amax(dim=(0, 1, 2)) / images[OURS].max()
        agreeing = min(agreeing, float((wrong < 1e-3).float().mean()))
        best = dict.fromkeys(renderers, float("inf"))
        for _ in range(ROUNDS):
            for name, render in renderers.items():
                start = time.perf_counter()
                render()
                best[name] = min(best[name], time.perf_counter() - start)
        for name, seconds in best.items():
            totals[name] += seconds / len(SEEDS)
    for name, seconds in totals.items():
        yield Row("rendering", CASE, name, "time per image", seconds, "s")
        yield Row("rendering", CASE, name, "rate", 60 / seconds, "images/min")
    yield Row("rendering", CASE, OURS, f"times as fast as {THEIRS}", totals[THEIRS] / totals[OURS], "x")
    yield Row("rendering", CASE, OURS, "pixels within 0.1 % of the brightest, least", 100 * agreeing, "%")


def _stacked(stokes: Stokes) -> Tensor:
    return torch.stack([stokes.s0, stokes.s1, stokes.s2])


def _build_renderers(seed: int) -> dict[str, Callable[[], tuple[Stokes, Stokes]]]:
    """Renderers of the diffuse and specular images of a random shape, by name."""
    from polsep.render.materials import random_materials
    from polsep.render.pathtrace import FAST_VARIANT, PathOptions, build_path_model, trace_paths
    from polsep.render.raycast import MeshScene, render_scene
    from polsep.render.shapes import random_mesh
    from polsep.render.sphere_tracing import PinholeCamera, PointLight

    generator = torch.Generator().manual_seed(seed)
    scene = MeshScene(random_mesh(generator))
    materials = replace(random_materials(scene.mesh.slot_count, generator), textures=None)
    camera = PinholeCamera((0.3 * scene.size, 0.6 * scene.size, 2.4 * scene.size))
    light = PointLight((scene.size, 2 * scene.size, 2 * scene.size), 5 * scene.size**2, 1.0)
    model = build_path_model((scene, materials), FAST_VARIANT)

    def ours() -> tuple[Stokes, Stokes]:
        rendered = render_scene((scene, materials), camera, light, SIZE, SAMPLES)
        return rendered.diffuse, rendered.specular

    def theirs() -> tuple[Stokes, Stokes]:
        traced = trace_paths(model, camera, light, SIZE, PathOptions(SAMPLES, 1, 1))
        return traced.diffuse, traced.specular

    return {OURS: ours, THEIRS: theirs}
