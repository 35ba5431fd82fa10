"""Scores on the sealed set when a version is released: each time one line is added to a log, and none is ever changed.

Noisy mosaics of the lamp's white light, at half and at full resolution, by the code that `polsep separate` runs.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import torch

import polsep
from evaluation import InputFailure
from evaluation.scoring import capture_noisy, find_missing
from polsep.bench.history import ask_git
from polsep.bench.rows import provenance, standard_error
from polsep.io.store.rows import append_line
from polsep.methods import METHODS
from polsep.metrics import psnr, psnr_unlimited
from polsep.sensor.camera import Mosaic

if TYPE_CHECKING:
    from evaluation.testsets import Case, Recipe

#: By resolution, method, and output with metric: the scores of scenes in dB.
Scores = dict[str, dict[str, dict[str, list[float]]]]


def score_recipes(recipes: Sequence[Recipe], data: Path | None) -> Iterator[tuple[str, Scores]]:
    """The name of every scene as it is done, and all scores so far."""
    from evaluation.testsets import build_cases, check_case

    scores: Scores = {}
    for case in build_cases(recipes, data):
        if not case.name.startswith("practice"):
            check_case(case)
        for resolution in ("half", "full"):
            of_resolution = scores.setdefault(resolution, {})
            for method, measured in score_case(case, resolution == "full"):
                for what, value in measured.items():
                    of_resolution.setdefault(method, {}).setdefault(what, []).append(value)
        yield case.name, scores


def score_case(case: Case, full: bool) -> Iterator[tuple[str, dict[str, float]]]:
    """PSNR of every method on one scene, limited to white and not."""
    capture, truth = capture_noisy(case)
    assert isinstance(capture, Mosaic)
    if full:
        truth = (case.scene.diffuse.s0, case.scene.specular.s0, case.scene.mask)
    *outputs, mask = truth
    for name, method in METHODS.items():
        images, measured = method.run(capture, (1.0, 1.0, 1.0), full), dict[str, float]()
        for output, image, true in zip(
            ("diffuse", "specular"), (images.diffuse, images.specular), outputs, strict=True
        ):
            found = torch.from_numpy(image).movedim(-1, 0)
            measured[f"{output} PSNR"] = psnr(found, true, mask)
            measured[f"{output} PSNR, unlimited"] = psnr_unlimited(found, true, mask)
        yield name, measured


def summarize(scores: Scores) -> dict[str, Any]:
    """Mean, standard error over scenes, median and worst of every list of scores."""

    def summary(values: list[float]) -> dict[str, float]:
        numbers = (statistics.fmean(values), standard_error(values), statistics.median(values), min(values))
        return dict(zip(("mean", "standard error", "median", "worst"), (round(x, 3) for x in numbers), strict=True))

    return {
        resolution: {method: {what: summary(values) for what, values in of.items()} for method, of in methods.items()}
        for resolution, methods in scores.items()
    }


@click.command()
@click.option(
    "--data", type=click.Path(file_okay=False, path_type=Path), envvar="POLSEP_DATA", metavar="DIR",
    help="Folder of the textures' images; or POLSEP_DATA.",
)  # fmt: skip
@click.option(
    "--quick", is_flag=True, help="Two small scenes of the same make, not the sealed ones, to sealed-quick.log."
)
@click.option(
    "-o", "--output", type=click.Path(file_okay=False, path_type=Path), default=Path("results"), metavar="DIR"
)
def sealed(data: Path | None, quick: bool, output: Path) -> None:
    """Score a release on the sealed set, and add a line to DIR/sealed.log. Not for choosing anything."""
    try:
        log = score_release(data, quick, output)
    except ValueError as error:
        raise InputFailure(str(error)) from None
    print(log)


def score_release(data: Path | None, quick: bool, output: Path) -> Path:
    """Score all methods and add the line; the log. Raises ValueError without the data, and on a tree with changes."""
    from evaluation.testsets import version_of
    from evaluation.testsets.sealed import PRACTICE, SEALED

    recipes = PRACTICE if quick else SEALED
    made_by = provenance(f"python -m evaluation sealed{' --quick' if quick else ''}")
    if not quick:
        if data is None:
            raise ValueError("expected --data DIR or POLSEP_DATA (docs/testsets.md says what is in it), found neither")
        if (absent := find_missing(recipes, data)) is not None:
            raise ValueError(f"expected {absent} (docs/testsets.md says where to get it), found none")
        if made_by["commit"].endswith("+") or not ask_git("rev-parse", "HEAD"):
            raise ValueError("expected a checkout without changes, so that the commit says what was scored, found some")
    scores: Scores = {}
    for name, scores in score_recipes(recipes, data):  # noqa: B007
        print(f"{name}: {len(METHODS)} methods", flush=True)
    print_scores(summary := summarize(scores))
    line: dict[str, Any] = {"date": date.today().isoformat(), "version": polsep.__version__, **made_by}
    line |= {"set": "practice" if quick else version_of(recipes)[:12], "scenes": len(recipes), "dB": summary}
    log = output / ("sealed-quick.log" if quick else "sealed.log")
    append_line(log, json.dumps(line))
    return log


def print_scores(summary: dict[str, Any]) -> None:
    """A line for each method: mean and standard error of both outputs, and the medians."""
    for resolution, methods in summary.items():
        for method, measured in methods.items():
            parts = [measured[f"{output} PSNR"] for output in ("diffuse", "specular")]
            means = " / ".join(f"{part['mean']:.1f} ± {part['standard error']:.1f}" for part in parts)
            medians = " / ".join(f"{part['median']:.1f}" for part in parts)
            print(f"{resolution}  {method:14} {means} dB, median {medians}")
