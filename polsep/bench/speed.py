"""Time and memory of whole chains, raw frame to diffuse and specular, each in its own process with two threads.

All see the demo capture: 2448x2048, 12 bits in uint16, colour; fused ones also at half its brightness, where nothing
clips (solving clipped pixels takes time), and into the same images frame after frame, as a stream does. polsep's chains
end at half resolution in float32.

A chain must at least read the raw and write both images. ``roofline`` is that traffic at the bandwidth at which two
threads copy 512 MiB (bytes read plus bytes written), the floor for any chain that leaves the cache; its share says how
near a chain comes.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from polsep.bench.peers import run_json, time_peers
from polsep.bench.rows import Row
from polsep.bench.truth import DEMO_WHITE as WHITE_LEVEL
from polsep.bench.truth import read_demo_capture
from polsep.compute.arrays import to_numpy
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.demosaic.guided import demosaic_guided_half
from polsep.io.store.rows import read_array, read_peak_memory, write_array
from polsep.kernels import (
    AnalyticImages,
    AnalyticOptions,
    ColorAffineImages,
    ColorAffineOptions,
    separate_analytic_half,
    separate_color_affine_half,
    set_threads,
)
from polsep.physics.stokes import Measurements
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.analytic import Separation, separate_analytic
from polsep.separation.color_affine import separate_color_affine

CASE = "2448x2048 colour frame"
#: Every chain is timed in so many processes, in turns, each time so often or so long; the best time counts.
ROUNDS, MAX_RUNS, MAX_SECONDS = 2, 40, 4.0
#: Threads of every chain.
THREADS = 2

Raw = NDArray[Any]
Chain = Callable[[Raw], Any]


def _compose(demosaic: Callable[[Mosaic], Measurements], separate: Callable[[Measurements], Separation]) -> Chain:
    """The chain of a demosaicker and a split in torch."""
    return lambda raw: separate(demosaic(Mosaic(torch.from_numpy(raw), Layout(), 0.0, WHITE_LEVEL)))


def _stream(images: Any, options: Callable[..., Any], separate: Callable[..., Any]) -> Chain:
    """The chain of a function of `polsep.kernels` with its options, into the same images frame after frame."""
    buffers: dict[tuple[int, ...], Any] = {}

    def chain(raw: Raw) -> Any:
        if raw.shape not in buffers:
            buffers[raw.shape] = images.empty(raw.shape, Layout())
        return separate(raw, Layout(), 0.0, WHITE_LEVEL, options(out=buffers[raw.shape]))

    return chain


#: polsep's chains in torch, and those of `polsep.kernels`.
CHAINS: dict[str, Chain] = {
    "polsep analytic, bilinear": _compose(demosaic_bilinear_half, separate_analytic),
    "polsep analytic, guided": _compose(demosaic_guided_half, separate_analytic),
    "polsep color-affine, bilinear": _compose(demosaic_bilinear_half, separate_color_affine),
    "polsep color-affine, guided": _compose(demosaic_guided_half, separate_color_affine),
}
KERNELS: dict[str, Chain] = {
    "polsep analytic, bilinear, kernel": _stream(AnalyticImages, AnalyticOptions, separate_analytic_half),
    "polsep color-affine, bilinear, kernel": _stream(ColorAffineImages, ColorAffineOptions, separate_color_affine_half),
    "polsep color-affine, guided, kernel": _stream(
        ColorAffineImages, partial(ColorAffineOptions, guided=True), separate_color_affine_half
    ),
}


def bench_speed(peers: str | None) -> Iterator[Row]:
    """Milliseconds, frames/s, memory and share of the roofline of every chain, and ratios to the peers' of this run."""
    raw = to_numpy(read_demo_capture().data).astype(np.uint16)
    with TemporaryDirectory() as folder:
        path, unclipped = Path(folder) / "raw.npy", Path(folder) / "unclipped.npy"
        write_array(path, raw)
        write_array(unclipped, raw // 2)
        found: dict[str, dict[str, float]] = {}
        for _ in range(ROUNDS):
            for name, times in (*_time_own(path, unclipped), *(time_peers(peers, path) if peers else ())):
                found[name] = times if times["best"] < found.get(name, times)["best"] else found.get(name, times)
    bandwidth = measure_copy_bandwidth()
    least = 1000 * (raw.nbytes + 2 * 3 * 4 * raw.size // 4) / bandwidth
    yield Row("frontend/speed", CASE, "roofline", "copy bandwidth", bandwidth / 1e9, "GB/s")
    yield from _speed_rows("roofline", least)
    references = {peer: _time_of(found, peer) for peer in ("polanalyser", "eari-demosaic")}
    for name, times in found.items():
        yield from _speed_rows(name, times["best"])
        for label, milliseconds in references.items():
            if milliseconds is not None:
                yield Row("frontend/speed", CASE, name, f"times as fast as {label}", milliseconds / times["best"], "x")
        if name.startswith("polsep"):
            yield Row("frontend/speed", CASE, name, "roofline reached", 100 * least / times["best"], "%")
        yield Row("frontend/speed", CASE, name, "peak memory", times["peak"], "MiB")
        yield Row("frontend/speed", CASE, name, "of it by the chain", times["working"], "MiB")


def _speed_rows(method: str, milliseconds: float) -> Iterator[Row]:
    yield Row("frontend/speed", CASE, method, "time", milliseconds, "ms")
    yield Row("frontend/speed", CASE, method, "rate", 1000 / milliseconds, "frames/s")


def _time_of(found: dict[str, dict[str, float]], start: str) -> float | None:
    """Milliseconds of the chain whose name starts so."""
    return next((times["best"] for name, times in found.items() if name.startswith(start)), None)


def _time_own(path: Path, unclipped: Path) -> Iterator[tuple[str, dict[str, float]]]:
    """`print_time` of every chain that there is, each in its own process."""
    script = "import sys; from polsep.bench.speed import print_time; print_time(*sys.argv[1:])"
    for name in (*CHAINS, *KERNELS):
        yield name, run_json(sys.executable, "-c", script, name, str(path))
    for name in KERNELS:
        yield f"{name}, nothing clipped", run_json(sys.executable, "-c", script, name, str(unclipped))


def print_time(name: str, path: str) -> None:
    """Milliseconds of a chain, best of some runs after a warm-up, and this process's peak memory.

    Printed as JSON.
    """
    torch.set_num_threads(THREADS)
    raw, chain = read_array(Path(path)), (CHAINS | KERNELS)[name]
    set_threads(THREADS)
    before = read_peak_memory()
    chain(raw)
    times: list[float] = []
    while not times or (len(times) < MAX_RUNS and sum(times) < MAX_SECONDS):
        start = time.perf_counter()
        chain(raw)
        times.append(time.perf_counter() - start)
    peak = max(read_peak_memory(), before)  # Linux counts pages in batches, so that peaks may even fall a little
    print(json.dumps({"best": 1000 * min(times), "peak": peak, "working": peak - before}))


def measure_copy_bandwidth(mebibytes: int = 512) -> float:
    """Bytes/s, read and written, at which two threads of torch copy that much: best of 5."""
    threads = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    source = torch.ones(mebibytes * 2**18)
    target = torch.zeros_like(source)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        target.copy_(source)
        times.append(time.perf_counter() - start)
    torch.set_num_threads(threads)
    return 2 * source.nbytes / min(times)
