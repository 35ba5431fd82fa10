"""The cost of a world unlike the ideal model: paired twins of `datasets.reality`, the same scene and noise.

Loss: PSNR of the ideal twin, whose white lamp is stated, less that of the disturbed frame, of images over its ``unit``.
Both at half resolution by `polsep.separate` with its defaults, nothing stated; "told" rows state what differs.
Thresholds are chosen on the split "validation" (``--split``); the tables are of "test".
"""

from __future__ import annotations

import importlib.util
import statistics
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polsep.bench.period import bench_period
from polsep.bench.rows import Row
from polsep.bench.run import Bench
from polsep.calibrate.analysers import measure_analysers
from polsep.calibrate.dark_flat import measure_flat
from polsep.calibrate.files import corrections_for
from polsep.io.store.image_codecs import through_jpeg
from polsep.methods import METHODS
from polsep.metrics import psnr
from polsep.pipeline import PolsepWarning, separate
from polsep.sensor.camera import Layout

if TYPE_CHECKING:
    from polsep.datasets.reality import Frame, Stage

#: Methods in the order of the tables.
ORDER = ("analytic", "color-affine", "paper", "joint-large", "joint", "joint-fast")
#: Quality of JPEG files, and the loss against `analytic` that counts as worse than it [dB].
JPEG_QUALITY, WORSE = 95, 1.0
#: Ending of the rows that state what differs.
STATED = ", told"


@dataclass(frozen=True)
class RealityOptions:
    """Measured parts: ``rows`` and ``methods`` by name, empty for all; ``scenes``: at most so many of each kind.

    ``size``: of frames; corners, which take long, have half of it. Raises ValueError on other splits.
    """

    split: str = "test"
    rows: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    scenes: int = 24
    size: int = 512

    def __post_init__(self) -> None:
        if self.split not in ("test", "validation"):
            raise ValueError(f"expected the split test or validation, found {self.split!r}")


class Kind(NamedTuple):
    """Stages of one kind: what builds one, how many there are, their ideal twin, and the disturbances they show.

    ``table``: before the names of their tables of losses.
    """

    name: str
    build: Callable[[str, int, int], Stage]
    stages: int
    ideal: Callable[[Stage], Frame]
    rows: Mapping[str, Callable[[Stage], Frame]]
    table: str = ""


class Score(NamedTuple):
    """PSNR of both images [dB], and the warnings of the frame's report."""

    diffuse: float
    specular: float
    warnings: tuple[str, ...]


class Trial(NamedTuple):
    """Scores of a method on one disturbed frame, on its ideal twin, and of the formula, all on the same pixels."""

    number: int
    ideal: Score
    found: Score
    formula: Score


@lru_cache(maxsize=1)
def find_kinds() -> tuple[Kind, ...]:
    """Return all kinds of stages. Raises ValueError without the extra render."""
    try:
        from polsep.datasets import corners, reality
    except ImportError as error:
        raise ValueError(f"expected the extra render (pip install 'polsep[render]'), found no {error.name}") from None

    def compress(stage: Stage) -> Frame:
        frame = reality.DISTURBANCES["8 bits"](stage)
        return replace(frame, raw=through_jpeg(frame.raw, JPEG_QUALITY))

    def calibrate(stage: Stage) -> Frame:
        flats, turned = reality.calibration_frames(stage)
        flat = measure_flat(flats)
        corrections = corrections_for("analysers", flat)
        measured = measure_analysers((corrections.apply(frame) for frame in turned), flat)
        return replace(reality.DISTURBANCES["bad sensor"](stage), options={"calibration": measured})

    def build_corner(split: str, number: int, size: int) -> Stage:
        return corners.build_corner(split, number, size // 2)

    def build_mono(split: str, number: int, size: int) -> Stage:
        return reality.build_stage(split, number, size, Layout(bayer=None))

    objects = reality.DISTURBANCES | {f"8 bits, JPEG {JPEG_QUALITY}": compress, "bad sensor": calibrate}
    corner = {"inter-reflections": corners.corner_frame} if importlib.util.find_spec("mitsuba") else {}
    return (
        Kind("objects", reality.build_stage, 24, reality.ideal_frame, objects),
        Kind("mannequins", reality.build_mannequin, 8, reality.ideal_mannequin, reality.SHEENS),
        Kind("corners", build_corner, 3, reality.ideal_frame, corner),
        Kind("mono objects", build_mono, 12, reality.ideal_frame, reality.MONO, "mono_"),
    )


def bench_reality(options: RealityOptions | None = None, data: Path | None = None) -> Iterator[Row]:
    """Loss of every method by what real lamps, rooms, surfaces and sensors differ in, stated or not.

    With ``data``, a folder with raw frames, also the mosaic's pattern in their outputs. Inter-reflections need the
    extra mitsuba. Raises ValueError without the extra render, and on names of rows or methods that there are not.
    """
    options = options or RealityOptions()
    rows = tuple(name for kind in find_kinds() for name in kind.rows)
    for what, known in (("rows", rows), ("methods", tuple(METHODS))):
        unknown = [name for name in getattr(options, what) if name not in known]
        if unknown:
            raise ValueError(f"expected {what} of {'; '.join(known)}, found {'; '.join(unknown)}")
    methods = options.methods or tuple(name for name in ORDER if name in METHODS)
    for kind in find_kinds():
        chosen = {name: make for name, make in kind.rows.items() if name in (options.rows or rows)}
        if chosen:
            yield from _bench_kind(kind._replace(rows=chosen), methods, options)
    if data is not None and (data / "raw").is_dir() and not options.rows:
        yield from bench_period(data, methods)


def select_reality(bench: Bench, options: RealityOptions, data: Path | None) -> Bench:
    """Return the benchmark with these options and the raw frames of ``data``; quickly: two scenes of each kind."""
    few = options if options.rows else replace(options, scenes=2)
    return replace(bench, run=partial(bench_reality, options, data), quick=partial(bench_reality, few))


def _bench_kind(kind: Kind, methods: Sequence[str], options: RealityOptions) -> Iterator[Row]:
    ideal: dict[str, list[Score]] = {}
    found: dict[tuple[str, str], list[Trial]] = {}
    wanted = tuple(dict.fromkeys(("analytic", *methods)))
    for number in range(min(kind.stages, options.scenes)):
        stage = kind.build(options.split, number, options.size)
        twin = kind.ideal(stage)
        for method in wanted:
            ideal.setdefault(method, []).append(score(twin, method, True))
        for name, make in kind.rows.items():
            frame = make(stage)
            if not bool(frame.mask.any()):  # one body, all of metal, has nothing beside it
                continue
            before = _ideal_on(frame.mask, twin, {method: scores[-1] for method, scores in ideal.items()})
            for stated in _calls(name, frame):
                scores = {method: score(frame, method, stated) for method in wanted}
                for method in wanted:
                    trial = Trial(number, before[method], scores[method], scores["analytic"])
                    found.setdefault((name + STATED * stated, method), []).append(trial)
    for method in methods:
        yield from _means("reality/ideal", f"{kind.name}, undisturbed", method, "PSNR", ideal[method])
    for (name, method), trials in found.items():
        if method in methods:
            yield from _summarize(kind, name, method, trials)


def _ideal_on(mask: Tensor, twin: Frame, scores: dict[str, Score]) -> dict[str, Score]:
    """Scores of methods on the pixels of the ideal twin that a row is scored on, which may be fewer and easier ones."""
    if torch.equal(mask, twin.mask):
        return scores
    return {method: score(replace(twin, mask=mask), method, True) for method in scores}


def _calls(name: str, frame: Frame) -> tuple[bool, ...]:
    """Calls of a row: with nothing stated, with all, or both. The truth of a lamp alone needs its lamp-off frame."""
    if frame.options is None or name == "white lamp":
        return (False,)
    return (True,) if "ambient" in frame.options else (False, True)


def _summarize(kind: Kind, name: str, method: str, trials: list[Trial]) -> Iterator[Row]:
    """Rows of one disturbance and method."""
    part = kind.table + ("told" if name.endswith(STATED) else "loss")
    found = [trial.found for trial in trials]
    losses = [
        Score(a.diffuse - b.diffuse, a.specular - b.specular, b.warnings)
        for a, b in ((t.ideal, t.found) for t in trials)
    ]
    yield from _means(f"reality/{part}", name, method, "loss", losses)
    yield from _means(f"reality/{part}_psnr", name, method, "PSNR", found)
    for output in ("diffuse", "specular"):
        worst = max(getattr(loss, output) for loss in losses)
        yield Row(f"reality/{part}_worst", name, method, f"{output} loss, worst scene", round(worst, 2), "dB")
    for trial, loss in zip(trials, losses, strict=True):
        for output in ("diffuse", "specular"):
            case = f"{kind.name}, {name}, scene {trial.number}"
            yield Row("reality/scenes", case, method, f"{output} loss", getattr(loss, output), "dB")
    pairs = ((trial.found, trial.formula) for trial in trials)
    behind = [min(a.diffuse - b.diffuse, a.specular - b.specular) < -WORSE for a, b in pairs]
    if method != "analytic":
        yield Row(f"reality/{part}_below", name, method, "frames below analytic", 100 * statistics.fmean(behind), "%")
    warned = [bool(one.warnings) for one in found]
    yield Row(f"reality/{part}_warned", name, method, "frames warned", 100 * statistics.fmean(warned), "%")


def _means(bench: str, case: str, method: str, metric: str, scores: list[Score]) -> Iterator[Row]:
    for output in ("diffuse", "specular"):
        mean = statistics.fmean(getattr(score, output) for score in scores)
        yield Row(bench, case, method, f"{output} {metric}", round(mean, 2), "dB")


def score(frame: Frame, method: str, stated: bool) -> Score:
    """Return the scores of a method on a frame, whose differences are ``stated`` or not."""
    options = dict(frame.options or {}) if stated else {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PolsepWarning)
        out = separate(frame.raw, method, frame.layout, white_level=frame.white_level, **options)

    def compare(image: NDArray[np.float32], truth: Tensor) -> float:
        return psnr(torch.from_numpy(image).permute(2, 0, 1) / frame.unit, truth / frame.unit, frame.mask)

    diffuse, specular = compare(out.diffuse, frame.diffuse), compare(out.specular, frame.specular)
    return Score(diffuse, specular, tuple(out.report["warnings"]))
