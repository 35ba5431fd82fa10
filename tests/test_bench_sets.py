"""Benchmarks on selection sets: one scoring path, sets that are not there, refusals before anything is measured."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from tolerances import assert_close

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes need the extra 'render'")
pytest.importorskip("flip_evaluator", reason="FLIP needs the extra 'bench'")

from evaluation import WEIGHTS, testsets
from evaluation.ablations import find_ablations, network_at_half
from evaluation.joint import (
    BINS,
    capture_full,
    capture_mono,
    enlarge,
    full_entries,
    measure_engines,
    measure_reliability,
)
from evaluation.rendering import bench_rendering
from evaluation.repeats import RECIPES, as_entry, spread_over_seeds
from evaluation.scoring import Entry, Protocol, capture_clean, capture_co_sited, capture_noisy, score_case, score_sets
from evaluation.sets import bench_sets
from evaluation.testsets import Recipe, build_case
from polsep.bench.rows import Row
from polsep.demosaic.bilinear import demosaic_bilinear_half, mean_cells
from polsep.io.store.weights import read_weights
from polsep.methods import METHODS, compose
from polsep.metrics import psnr, reliability
from polsep.physics.stokes import Measurements, Stokes
from polsep.render.sphere_tracing import Scene
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.analytic import Separation, separate_analytic
from polsep.shipped import NAMES


def make_grey(_paths: list[Path], _generator: torch.Generator) -> Scene:
    """A grey frame."""
    grey = torch.ones(3, 32, 32)
    return Scene(Stokes(grey, 0 * grey, 0 * grey), Stokes(grey, grey, 0 * grey), grey[0] > 0)


def make_step(_paths: list[Path], _generator: torch.Generator) -> Scene:
    """A grey frame of which one half is too dark to clip."""
    grey = torch.ones(3, 32, 32)
    grey[:, :, 16:] = 0.3
    return Scene(Stokes(grey, 0 * grey, 0 * grey), Stokes(grey, grey, 0 * grey), grey[0] > 0)


GREY, STEP = Recipe("grey", 1, (), make_grey), Recipe("step", 1, (), make_step)
ANALYTIC = Entry("analytic", compose(demosaic_bilinear_half, separate_analytic))
PROTOCOLS = [
    Protocol(n, s, (ANALYTIC,))
    for n, s in (("noisy", capture_noisy), ("clean", capture_clean), ("all", capture_co_sited))
]


def test_scenes_that_nobody_recorded_get_no_score(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A selection set that changed unknowingly stops the benchmark."""
    monkeypatch.setattr(testsets, "SETS", {"grey": (GREY,)})
    with pytest.raises(ValueError, match="expected a recorded test scene, found grey"):
        next(bench_sets(tmp_path))


def test_the_extra_of_scores_is_named_before_anything_is_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    with pytest.raises(ValueError, match=r"expected the extra bench .* found no flip_evaluator"):
        next(bench_sets(tmp_path))


def test_missing_extras_are_named_before_anything_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training's extra too, which only the last part needs."""
    monkeypatch.setitem(sys.modules, "lightning_fabric", None)
    monkeypatch.delitem(sys.modules, "polsep.train.loop", raising=False)
    with pytest.raises(ValueError, match="expected the extras train and mitsuba, found no lightning_fabric"):
        next(bench_rendering())


def test_every_protocol_has_every_metric_of_its_own_view() -> None:
    """The analytic split is exact on grey light with an unpolarized diffuse, but for noise and clipping."""
    scores = list(score_case(build_case(GREY), PROTOCOLS))
    metrics = {p.name: [score.metric for score in scores if score.protocol == p.name] for p in PROTOCOLS}
    assert metrics["noisy"] == metrics["clean"] == metrics["all"]
    assert {"diffuse PSNR", "specular SSIM", "specular FLIP", "chroma of highlights"} <= set(metrics["all"])
    value = {(score.protocol, score.metric): score.value for score in scores}
    assert value["clean", "diffuse PSNR"] > value["noisy", "diffuse PSNR"]


def test_scores_are_those_of_the_metrics() -> None:
    case = build_case(GREY)
    (diffuse, _, mask), found = case.half_truth(), ANALYTIC.separate(case.noisy)
    scores = {s.metric: s.value for s in score_case(case, PROTOCOLS[:1])}
    assert scores["diffuse PSNR"] == psnr(found.diffuse, diffuse, mask)


def test_an_entry_demosaicks_mosaics_alone() -> None:
    case, seen = build_case(GREY), []

    def split(measurements: Measurements) -> Separation:
        seen.append(tuple(measurements.data.shape))
        return separate_analytic(measurements)

    entry = Entry("x", compose(demosaic_bilinear_half, split))
    for capture in (case.noisy, case.co_sited):
        entry.separate(capture)
    assert seen == [(4, 3, 16, 16), (4, 3, 32, 32)]


def test_half_resolution_is_enlarged_about_the_centres_of_cells() -> None:
    """A linear field of cell means becomes the field of the pixels, but for the border."""
    y, x = torch.meshgrid(torch.arange(24.0), torch.arange(32.0), indexing="ij")
    field = (0.1 + 0.01 * y - 0.002 * x).expand(3, -1, -1)
    assert_close(enlarge(mean_cells(field))[:, 1:-1, 1:-1], field[:, 1:-1, 1:-1])


def test_full_resolution_is_scored_at_full_resolution() -> None:
    """Every method, the ones that give half-resolution images enlarged."""
    case = build_case(GREY)
    capture, (diffuse, _, mask) = capture_full(case)
    found = {entry.name: entry.separate(capture) for entry in full_entries()}
    assert set(found) == {"joint-large", "joint", "joint-fast", "color-affine", "analytic", "paper, enlarged"}
    assert all(images.diffuse.shape == diffuse.shape for images in found.values())
    scores = list(score_case(case, [Protocol("full", capture_full, full_entries())]))
    value = {score.method: score.value for score in scores if score.metric == "diffuse PSNR"}
    assert value["analytic"] == psnr(found["analytic"].diffuse, diffuse, mask)


def test_mono_frames_are_scored_in_one_colour() -> None:
    """The analytic split of a mono frame is exact, but for noise, and knows neither FLIP nor chroma."""
    scores = {s.metric: s.value for s in score_case(build_case(GREY), [Protocol("mono", capture_mono, (ANALYTIC,))])}
    assert {"diffuse PSNR", "specular SSIM"} <= set(scores)
    assert not [metric for metric in scores if "FLIP" in metric or "chroma" in metric]
    capture, (diffuse, specular, mask) = capture_mono(build_case(GREY))
    assert isinstance(capture, Mosaic) and capture.layout == Layout(bayer=None)
    assert diffuse.shape == specular.shape == (1, *mask.shape)
    colored = {s.metric: s.value for s in score_case(build_case(GREY), PROTOCOLS[:1])}
    assert scores["diffuse PSNR"] == pytest.approx(colored["diffuse PSNR"], abs=1)


def test_reliability_is_that_of_all_pixels_of_a_set(tmp_path: Path) -> None:
    rows = list(measure_reliability("step", (STEP,), tmp_path))
    assert {(row.method, row.metric) for row in rows if row.unit == "octaves"} == {
        (method, f"{output}, miss{where}")
        for method in NAMES
        for output in ("diffuse", "specular")
        for where in ("", " where nothing clips")
    }
    case = build_case(STEP)
    (diffuse, _, mask), found = case.half_truth(), METHODS["joint"].reference(case.noisy)
    assert found.expected_error is not None and found.clipped is not None
    curve = reliability(found.diffuse - diffuse, found.expected_error[0], mask, BINS)
    said = [row.value for row in rows if row.method == "joint" and row.metric == "diffuse error, expected"]
    assert said == pytest.approx(curve.expected.tolist())
    away = reliability(found.diffuse - diffuse, found.expected_error[0], mask & ~found.clipped, BINS)
    (miss,) = (row.value for row in rows if row.method == "joint" and row.metric == "diffuse, miss where nothing clips")
    assert miss == pytest.approx(away.miss)


def test_engines_are_compared_with_torch(tmp_path: Path) -> None:
    """Only layers are rounded."""
    rows = list(measure_engines("grey", (GREY,), tmp_path))
    assert {(row.method, row.metric) for row in rows} == {
        (method, f"{output} PSNR, {kind} resolution, {change}")
        for method in NAMES
        for output in ("diffuse", "specular")
        for kind in ("half", "full")
        for change in ("change", "largest change")
    }
    assert all(abs(row.value) < 0.5 for row in rows)


def test_sets_without_their_data_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line says so, and the others are scored all the same."""
    absent = Recipe("absent", 2, ("nowhere/a.png",), make_grey)
    with pytest.raises(ValueError, match="expected a recorded test scene, found grey"):
        list(score_sets("x", {"first": (absent,), "second": (GREY,)}, tmp_path, PROTOCOLS))
    assert capsys.readouterr().err == (
        f"polsep: the set first is left out: expected {tmp_path}/nowhere/a.png, found none\n"
    )


def test_ablations_differ_in_what_they_go_without_alone() -> None:
    """One size, one seed, one schedule, the same examples; each runs and scores something of its own."""
    joint_task = pytest.importorskip("polsep.train.joint_task", reason="training needs the extra 'train'")
    found = find_ablations()
    assert next(iter(found)) == "none" and set(found) == set(joint_task.ABLATIONS)
    records = [read_weights(path)[1] for path in found.values()]
    for key in ("method", "variant", "seed", "schedule", "stream", "data", "size"):
        assert len({record[key] for record in records}) == 1, key
    case = build_case(GREY)
    entries = tuple(network_at_half(name, path) for name, path in found.items())
    scores = list(score_case(case, [Protocol("noisy", capture_noisy, entries)]))
    psnrs = [score.value for score in scores if score.metric == "specular PSNR"]
    assert len(set(psnrs)) == len(found)


def test_spread_over_seeds_is_that_of_single_trainings() -> None:
    """Mean and standard deviation of each network's scores on each set; who is trained is who can be scored."""
    values = {"paper:1": 30.0, "paper:2": 31.0, "paper:3": 35.0, "stokes:1": 28.0, "stokes:2": 28.0, "stokes:3": 28.0}
    rows = [Row("repeats/noisy", "objects, noisy", name, "diffuse PSNR", value, "dB") for name, value in values.items()]
    assert list(spread_over_seeds(rows)) == [
        Row("repeats", "objects", "paper", "diffuse PSNR", 32.0, "dB"),
        Row("repeats", "objects", "stokes", "diffuse PSNR", 28.0, "dB"),
        Row("repeats", "objects", "paper", "diffuse PSNR, between seeds", 7**0.5, "dB"),
        Row("repeats", "objects", "stokes", "diffuse PSNR, between seeds", 0.0, "dB"),
    ]
    places = {"joint-fast": "ablations/none", "paper": "ladder/paper-mosaic"}
    for network in RECIPES:
        path = WEIGHTS / f"{places.get(network, f'ladder/{network}-mosaic')}.safetensors"
        assert as_entry(network, path, 7).name == f"{network}:7"
