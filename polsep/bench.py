"""Measurements of polsep on known truth, real frames and this machine, as rows that land in results/*.jsonl.

Every row says what was measured (`bench`, `case`, `method`, `metric`, `value`, `unit`) and by what (`command`,
`commit`, `machine`). The README's tables are made from these rows by `io.results.fill_tables`.

PSNR: linear light, peak 1 = the white level of one measurement, both images limited to [0, 1], inside the object mask;
120 dB at most.
"""

from __future__ import annotations

import json
import math
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from itertools import permutations
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from polsep.camera import IMX250, Layout, Mosaic, add_noise, expose
from polsep.demosaic import demosaic_bilinear_half
from polsep.io.frames import ReadOptions, read_frames
from polsep.layout_check import check_layout, crossed_pairs
from polsep.pipeline import METHODS, demosaic
from polsep.render import PinholeCamera, render
from polsep.scenes import random_light, random_parts
from polsep.stokes import Measurements, Stokes, aolp, fit_stokes, fit_stokes_unclipped, measure

#: Seeds of the benchmark's scenes; nothing is ever tuned or trained on seeds from 2000 to 2999.
SCENE_SEEDS = tuple(range(2000, 2008))
SCENE_SIZE = (384, 384)


@dataclass(frozen=True)
class Row:
    """One measured number."""

    bench: str
    case: str
    method: str
    metric: str
    value: float
    unit: str


@dataclass(frozen=True)
class Scene:
    """A rendered scene: exact lobes and the object mask, exposed so that 1 % of the diffuse light exceeds s0 = 1.4."""

    diffuse: Stokes
    specular: Stokes
    mask: Tensor


def render_scene(seed: int, saturation: float, size: tuple[int, int] = SCENE_SIZE) -> Scene:
    """A random scene of four objects under one random polarized light; ``saturation`` 0 makes every albedo grey."""
    generator = torch.Generator().manual_seed(seed)
    parts = random_parts(generator, 4, saturation)
    light = random_light(generator)
    diffuse, specular = render(parts, PinholeCamera((0.0, 0.0, 8.0), (0.0, 0.0, 0.0), 24.0), light, size)
    mask = (diffuse + specular).s0.amax(dim=0) > 1e-3
    gain = 1.4 / float(torch.quantile(diffuse.s0.amax(dim=0)[mask], 0.99))
    return Scene(diffuse * gain, specular * gain, mask)


def psnr(found: Tensor, truth: Tensor, mask: Tensor) -> float:
    """PSNR in dB of images ``[C, h, w]`` inside ``mask [h, w]``, as the module says; at most 120."""
    error = ((found.clamp(0, 1) - truth.clamp(0, 1)) ** 2).mean(dim=0)[mask].mean()
    return min(120.0, -10 * math.log10(max(float(error), 1e-30)))


def bench_separation(_data: Path | None = None) -> Iterator[Row]:
    """PSNR of every method on co-sited, noisy and mosaicked captures of coloured and of grey scenes."""
    for case, saturation in (("colour", 1.0), ("desaturated", 0.3), ("grey", 0.0)):
        scores: dict[tuple[str, str, str], list[float]] = {}
        for seed in SCENE_SEEDS:
            scene = render_scene(seed, saturation)
            for capture, frame, mask, (diffuse, specular) in _captures(scene, seed):
                for name, method in METHODS.items():
                    found = method.split(demosaic(frame, method, full=False))
                    for output, image, truth in (
                        ("diffuse", found.diffuse, diffuse),
                        ("specular", found.specular, specular),
                    ):
                        scores.setdefault((capture, name, output), []).append(psnr(image, truth, mask))
        for (capture, name, output), values in scores.items():
            yield Row("separation", f"{case}, {capture}", name, f"{output} PSNR", statistics.fmean(values), "dB")
            if "unclipped" in capture:
                yield Row("separation", f"{case}, {capture}", name, f"{output} PSNR, worst scene", min(values), "dB")


Captures = Iterator[tuple[str, Measurements | Mosaic, Tensor, tuple[Tensor, Tensor]]]


def _captures(scene: Scene, seed: int) -> Captures:
    """A scene as co-sited exact, co-sited noisy and mosaicked noisy samples, each with its mask and truth."""
    light, angles = scene.diffuse + scene.specular, Layout().angles
    exact = measure(light, angles)
    truth = (scene.diffuse.s0, scene.specular.s0)
    clipped = exact.data >= 1
    limited = Measurements(exact.data.clamp(max=1), angles, clipped)
    unclipped = scene.mask & ~clipped.any(dim=0).any(dim=0)
    yield "co-sited exact, unclipped pixels", limited, unclipped, truth
    yield "co-sited exact, with clipping", limited, scene.mask, truth
    generator = torch.Generator().manual_seed(seed)
    noisy = add_noise(exact.data, IMX250, generator).clamp(0, 1)
    yield "co-sited, sensor noise", Measurements(noisy, angles, noisy >= 1), scene.mask, truth
    mosaic = expose(light, Layout(), IMX250, generator)
    half = (avg_pool2d(truth[0], 2), avg_pool2d(truth[1], 2))
    mask = avg_pool2d(scene.mask[None].float(), 2)[0] == 1
    yield "mosaic, sensor noise", mosaic, mask, half


def bench_exactness(_data: Path | None = None) -> Iterator[Row]:
    """Largest errors of what must be exact: the analytic formula, and Stokes vectors with one clipped analyser."""
    generator = torch.Generator().manual_seed(2900)
    s0 = 0.4 + 1.4 * torch.rand(3, 64, 64, generator=generator)
    size, angle = (
        s0 * 0.7 * torch.rand(s0.shape, generator=generator),
        math.pi * torch.rand(s0.shape, generator=generator),
    )
    stokes = Stokes(s0, size * torch.cos(2 * angle), size * torch.sin(2 * angle))
    exact = measure(stokes, Layout().angles)
    found = METHODS["analytic"].split(exact)
    formula = torch.sqrt(stokes.s1**2 + stokes.s2**2)
    error = torch.maximum((found.specular - formula).abs().max(), (found.diffuse - (s0 - formula)).abs().max())
    yield Row("exactness", "analytic against Eqs. 16-18", "analytic", "largest error", float(error), "white")
    worst = 0.0
    for k in range(4):
        data, clipped = exact.data.clone(), torch.zeros_like(exact.data, dtype=torch.bool)
        data[k], clipped[k] = 1.0, True
        recovered, _ = fit_stokes_unclipped(Measurements(data, exact.angles, clipped))
        for name in ("s0", "s1", "s2"):
            worst = max(worst, float((getattr(recovered, name) - getattr(stokes, name)).abs().max()))
    yield Row("exactness", "one clipped analyser recovered", "clip-aware Stokes", "largest error", worst, "white")


#: The labelled polarizers of polarizer_IMX250MZR.png: label [deg], centre (row, col) and radius at half resolution.
REFERENCE_POLARIZERS = ((0, 544, 189, 88), (45, 544, 502, 88), (90, 544, 778, 88), (135, 553, 1055, 78))


def bench_real(data: Path) -> Iterator[Row]:
    """Reference polarizers and the layout check on the real frames of ``data``/raw. Raises ValueError without them."""
    frames = sorted((data / "raw").glob("*.png"))
    if not frames:
        raise ValueError(f"expected real frames in {data / 'raw'}, found none")
    mosaics = {path.stem: _read_mosaic(path) for path in frames}
    yield from _reference_angles(mosaics["polarizer_IMX250MZR"])
    right = total = 0
    for mosaic in mosaics.values():
        for verdict in _layout_verdicts(mosaic):
            right, total = right + verdict, total + 1
    yield Row("real", "layout check on real frames", "layout check", "right verdicts", right, f"of {total}")


def _read_mosaic(path: Path) -> Mosaic:
    layout = Layout() if "quadbayer" in path.stem else Layout(bayer=None)
    frame = next(read_frames(path, ReadOptions(layout)))
    assert isinstance(frame.data, Mosaic)
    return frame.data


def _reference_angles(mosaic: Mosaic) -> Iterator[Row]:
    """Median AoLP inside each polarizer; its labels count clockwise from the vertical, so label t is AoLP 90 - t."""
    stokes = fit_stokes(demosaic_bilinear_half(mosaic))
    rows, cols = torch.meshgrid(*(torch.arange(n) for n in stokes.s0.shape[-2:]), indexing="ij")
    errors = []
    for label, row, col, radius in REFERENCE_POLARIZERS:
        disc = (rows - row) ** 2 + (cols - col) ** 2 < radius**2
        found = 90 - torch.rad2deg(aolp(stokes)[0][disc])
        error = float(((found - label + 90) % 180 - 90).median())
        errors.append(error)
        yield Row("real", f"polarizer labelled {label}", "AoLP", "error", error, "deg")
    common = statistics.fmean(errors)
    worst = max(abs(error - common) for error in errors)
    yield Row("real", "polarizers, camera roll removed", "AoLP", "largest error", worst, "deg")
    yield Row("real", "polarizers, camera roll removed", "AoLP", "camera roll", common, "deg")


def _layout_verdicts(mosaic: Mosaic) -> Iterator[bool]:
    """Whether the check is right about a frame: under all 24 orders, transposed, mirrored, cropped, mono for colour.

    Right is silence under the true layout and under those that no frame can tell from it (see `layout_check`), and a
    warning whose fitting layouts hold the true one otherwise.
    """
    true, (height, width) = mosaic.layout, mosaic.data.shape[-2:]
    for a, b, c, d in permutations((0, 45, 90, 135)):
        claimed = Layout(((a, b), (c, d)), true.bayer)
        yield _right(Mosaic(mosaic.data, claimed, 0, 255), true, crossed_pairs(claimed) != crossed_pairs(true))
    other = Layout(true.polarizer, None if true.bayer else "RGGB")
    yield _right(Mosaic(mosaic.data, other, 0, 255), true, True)
    changed = (
        (mosaic.data.flip(-1), true.flipped_horizontal(width)),
        (mosaic.data.flip(-2), true.flipped_vertical(height)),
        (mosaic.data.mT, true.transposed()),
        (mosaic.data[1:, :], true.rolled(-1, 0)),
        (mosaic.data[:, 3:], true.rolled(0, -3)),
        (mosaic.data[2:, :], true.rolled(-2, 0)),
    )
    for data, layout in changed:
        seen = true.bayer is not None and (layout.origin != true.origin or _greens(layout) != _greens(true))
        yield _right(Mosaic(data, layout, 0, 255), layout, False)
        yield _right(Mosaic(data, true, 0, 255), layout, seen)


def _greens(layout: Layout) -> bool:
    return layout.bayer in ("RGGB", "BGGR")


def _right(mosaic: Mosaic, true: Layout, wrong: bool) -> bool:
    check = check_layout(mosaic)
    if not wrong:
        return check.warning is None
    return check.warning is not None and any(
        fit.bayer == true.bayer and fit.origin == true.origin and crossed_pairs(fit) == crossed_pairs(true)
        for fit in check.fits
    )


_RESOURCE_SCRIPT = """
import json, resource, sys, time, warnings
import numpy as np
warnings.simplefilter("ignore")
import polsep
from polsep.io.frames import ReadOptions, read_frames
from pathlib import Path
frame = next(read_frames(Path(polsep.__file__).parent / "data" / "still_life.png", ReadOptions(white_level=4095.0)))
raw = frame.data.data.numpy().astype(np.uint16)
times = []
for _ in range(3):
    start = time.perf_counter()
    polsep.separate(raw, method=sys.argv[1], white_level=4095)
    times.append(time.perf_counter() - start)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"first": times[0], "best": min(times), "peak": peak}))
"""


def bench_resources(_data: Path | None = None) -> Iterator[Row]:
    """Seconds and peak memory of `polsep.separate` on the 2448x2048 demo capture, each method in its own process."""
    for name in METHODS:
        command = [sys.executable, "-c", _RESOURCE_SCRIPT, name]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        yield Row("resources", "2448x2048 colour frame", name, "seconds, first call", found["first"], "s")
        yield Row("resources", "2448x2048 colour frame", name, "seconds, best of 3", found["best"], "s")
        yield Row("resources", "2448x2048 colour frame", name, "peak memory", found["peak"], "MiB")


BENCHES: dict[str, Callable[[Path], Iterator[Row]]] = {
    "separation": bench_separation,
    "exactness": bench_exactness,
    "real": bench_real,
    "resources": bench_resources,
}


def provenance(command: str) -> dict[str, str]:
    """What made the rows: command, commit (with "+" if the tree had changes) and machine."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, check=False, cwd=Path(__file__).parent
        )
        return done.stdout.strip() if done.returncode == 0 else ""

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "polsep")
    commit = (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")
    machine = f"{torch.get_num_threads()} threads, {platform.machine()}, torch {torch.__version__}"
    return {"command": command, "commit": commit, "machine": machine}


def to_jsonl(rows: list[Row], made_by: dict[str, str]) -> str:
    """Rows as JSON lines, numbers with six significant digits."""
    lines = [asdict(row) | {"value": float(f"{row.value:.6g}")} | made_by for row in rows]
    return "".join(json.dumps(line) + "\n" for line in lines)
