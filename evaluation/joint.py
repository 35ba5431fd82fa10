"""The joint networks on the fixed selection sets: full resolution, mono frames, expected errors, engines.

Full resolution is scored against the truth of every pixel of the noisy mosaic. Methods that give half-resolution images
only have theirs enlarged, linearly between the cells' centres.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from evaluation.scoring import Entry, Protocol, Truth, capture_noisy, score_sets
from evaluation.sets import load_sets
from polsep.bench.rows import Row
from polsep.methods import METHODS
from polsep.metrics import psnr, reliability
from polsep.sensor.camera import IMX250, Capture, Layout, Mosaic, expose
from polsep.separation.analytic import Separation
from polsep.shipped import NAMES

if TYPE_CHECKING:
    from evaluation.testsets import Case, Recipe

#: Methods whose images at full resolution would be of bilinear samples, as their networks' are at half.
ENLARGED = ("paper",)
#: Methods that separate mono frames with what the project ships, and the seed of these frames' noise.
MONO, MONO_SEED = ("joint-large", "joint", "joint-fast", "color-affine", "analytic"), 2_000_000
#: Groups of pixels in a reliability curve.
BINS = 10


def bench_joint(data: Path) -> Iterator[Row]:
    """On the selection sets: scores at full resolution and of mono frames, reliability, engines against torch.

    Raises ValueError as `evaluation.sets.bench_sets` does.
    """
    sets = load_sets(data)
    mono = tuple(Entry(name, METHODS[name].reference) for name in MONO)
    protocols = [Protocol("full", capture_full, full_entries()), Protocol("mono", capture_mono, mono)]
    yield from score_sets("joint", sets, data, protocols)
    for name, recipes in sets.items():
        yield from measure_reliability(name, recipes, data)
        yield from measure_engines(name, recipes, data)


def capture_full(case: Case) -> tuple[Capture, Truth]:
    """A 12-bit mosaic with noise, and the truth at its own resolution."""
    return case.noisy, (case.scene.diffuse.s0, case.scene.specular.s0, case.scene.mask)


def capture_mono(case: Case) -> tuple[Capture, Truth]:
    """A 12-bit mosaic with noise of a camera without colour filters on which the green light falls, in half."""
    light = (case.scene.diffuse + case.scene.specular).map(lambda s: s[1:2])
    mosaic = expose(light, Layout(bayer=None), IMX250, torch.Generator().manual_seed(MONO_SEED))
    diffuse, specular, mask = case.half_truth()
    return mosaic, (diffuse[1:2], specular[1:2], mask)


def full_entries() -> tuple[Entry, ...]:
    """Every method at full resolution; those of `ENLARGED` from half."""
    return tuple(
        Entry(f"{m.name}, enlarged", enlarged(m.reference))
        if m.name in ENLARGED
        else Entry(m.name, partial(m.reference, full=True))
        for m in METHODS.values()
    )


def enlarged(separate: Callable[[Capture], Separation]) -> Callable[[Capture], Separation]:
    """A method at half resolution, with its images enlarged to full; its masks and what else it says are not."""

    def separate_and_enlarge(capture: Capture) -> Separation:
        found = separate(capture)
        diffuse, specular = (enlarge(image) for image in (found.diffuse, found.specular))
        return replace(found, diffuse=diffuse, specular=specular)

    return separate_and_enlarge


def enlarge(image: Tensor) -> Tensor:
    """Cells ``[C, h, w]`` as pixels ``[C, 2 h, 2 w]``, linearly between their centres."""
    return interpolate(image[None], scale_factor=2.0, mode="bilinear", align_corners=False)[0]


def measure_reliability(name: str, recipes: Sequence[Recipe], data: Path) -> Iterator[Row]:
    """Reliability of both outputs of the joint networks over all pixels on objects of a set: a curve, and its error.

    The latter also of the pixels near which nothing clips: the others, a few, hold most of what can be off.
    """
    from evaluation.testsets import build_cases

    seen: dict[tuple[str, str], list[tuple[Tensor, Tensor, Tensor]]] = {}
    for case in build_cases(recipes, data):
        capture, (diffuse, specular, mask) = capture_noisy(case)
        for method in NAMES:
            found = METHODS[method].reference(capture)
            assert found.expected_error is not None and found.clipped is not None
            outputs = (("diffuse", found.diffuse - diffuse), ("specular", found.specular - specular))
            for (output, error), expected in zip(outputs, found.expected_error, strict=True):
                part = (error[:, mask], expected[mask], ~found.clipped[mask])
                seen.setdefault((method, output), []).append(part)
    for (method, output), parts in seen.items():
        errors, expected, whole = (torch.cat(x, dim=-1)[..., None, :] for x in zip(*parts, strict=True))
        curve = reliability(errors, expected, torch.ones_like(whole), BINS)
        yield Row("joint/reliability", name, method, f"{output}, miss", curve.miss, "octaves")
        away = reliability(errors, expected, whole, BINS)
        yield Row("joint/reliability", name, method, f"{output}, miss where nothing clips", away.miss, "octaves")
        for k, (said, true) in enumerate(zip(curve.expected.tolist(), curve.found.tolist(), strict=True)):
            yield Row("joint/curve", f"{name}, tenth {k + 1}", method, f"{output} error, expected", said, "white")
            yield Row("joint/curve", f"{name}, tenth {k + 1}", method, f"{output} error, found", true, "white")


def measure_engines(name: str, recipes: Sequence[Recipe], data: Path) -> Iterator[Row]:
    """Difference of an engine, in bfloat16 where that is faster, from torch: in PSNR of a set, and of a scene.

    Raises ValueError without OpenVINO, where torch would be compared with itself.
    """
    from evaluation.testsets import build_cases

    if find_spec("openvino") is None:
        raise ValueError("expected the engine of OpenVINO, found none")
    changes: dict[tuple[str, str], list[float]] = {}
    for case in build_cases(recipes, data):
        for see, full in ((capture_noisy, False), (capture_full, True)):
            mosaic, (*truth, mask) = see(case)
            assert isinstance(mosaic, Mosaic)
            for method in NAMES:
                chosen = METHODS[method]
                images = chosen.run(mosaic, (1.0,) * mosaic.layout.channels, full)
                exact = chosen.reference(mosaic, full)
                pairs = ((images.diffuse, exact.diffuse), (images.specular, exact.specular))
                for output, (found, wanted), image in zip(("diffuse", "specular"), pairs, truth, strict=True):
                    planes = torch.from_numpy(found).movedim(-1, 0)
                    change = psnr(planes, image, mask) - psnr(wanted, image, mask)
                    changes.setdefault((method, f"{output} PSNR, {'full' if full else 'half'} resolution"), []).append(
                        change
                    )
    for (method, metric), values in changes.items():
        yield Row("joint/engines", name, method, f"{metric}, change", statistics.fmean(values), "dB")
        yield Row("joint/engines", name, method, f"{metric}, largest change", max(abs(x) for x in values), "dB")
