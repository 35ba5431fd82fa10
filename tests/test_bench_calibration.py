"""The calibration sweep sees what it says: light is linear, lights are crossed, errors turn lights and nothing else."""

from __future__ import annotations

import math
import statistics
from dataclasses import replace

import pytest
import torch
from tolerances import assert_close, assert_same_angle, assert_within

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")
pytest.importorskip("scipy", reason="meshes need the extra 'render'")

from evaluation import sensors
from evaluation.calibration import (
    DEBEVEC,
    DING,
    NOMINAL_DEG,
    Sweep,
    TurnableScene,
    capture_with_errors,
    find_aolp,
    make_turnable,
    measure_sweep,
    normal_deviates,
    score_captures,
    separate_captures,
)
from evaluation.scoring import Entry
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.methods import compose
from polsep.physics.stokes import intensity_behind
from polsep.render.materials import random_materials
from polsep.render.raycast import find_lit, find_view, shade_view
from polsep.render.views import random_shot, seeded_shape
from polsep.separation.analytic import separate_analytic

SIZE = (96, 96)
ANALYTIC = Entry("analytic", compose(demosaic_bilinear_half, separate_analytic))


@pytest.fixture(scope="module")
def scene() -> TurnableScene:
    return make_turnable(seeded_shape("test", 1, 0), SIZE, torch.Generator().manual_seed(1))


def test_a_turned_polarizer_is_a_sum_of_three(scene: TurnableScene) -> None:
    """The light is linear: rendering at another angle gives what the three terms give, up to the exposure."""
    shape, generator = seeded_shape("test", 1, 0), torch.Generator().manual_seed(1)
    shot = random_shot(shape, generator)
    view = find_view(shape, shot.camera, SIZE, 2)
    materials = random_materials(shape.mesh.slot_count, generator, shape.size)
    light = replace(shot.light, polarizer=0.4)
    rendered = shade_view(view, materials, light, find_lit(shape, view, light))
    turned = scene.under(0.4)
    gain = float(turned.diffuse.s0.sum() / rendered.diffuse.s0.sum())
    for found, expected in ((turned.diffuse, rendered.diffuse), (turned.specular, rendered.specular)):
        for name in ("s0", "s1", "s2"):
            assert_close(getattr(found, name), gain * getattr(expected, name), scale=10)


def test_lights_are_crossed_without_error(scene: TurnableScene) -> None:
    """The specular of crossed lights is polarized at right angles, summed over the picture nearly so."""
    captured = capture_with_errors(scene, 0.3, (0.0, 0.0))
    one, other = (find_aolp(found.specular) for found in captured.scenes)
    assert_same_angle(one + math.pi / 2, other, math.radians(15))


def test_photographs_are_parallel_and_crossed_to_the_highlights(scene: TurnableScene) -> None:
    """Of all analysers these two pass most and least of the nominal light's specular."""
    light = scene.under(0.3).specular
    angle = find_aolp(light)
    passed = [float(intensity_behind(light, angle + k * math.pi / 8).double().sum()) for k in range(8)]
    assert max(passed) == passed[0] and min(passed) == passed[4]


def test_errors_do_not_touch_the_exposure_the_mask_or_the_analysers(scene: TurnableScene) -> None:
    """Errors change the light and the truth, not the camera."""
    right, wrong = (capture_with_errors(scene, 0.3, (error, 0.0)) for error in (0.0, 0.2))
    assert torch.equal(right.scenes[0].mask, wrong.scenes[0].mask)
    assert_close(right.scenes[1].specular.s0, wrong.scenes[1].specular.s0)
    assert right.captures[0].angles == wrong.captures[0].angles
    ratio = float(wrong.scenes[0].diffuse.s0.sum() / right.scenes[0].diffuse.s0.sum())
    assert abs(ratio - 1) < 0.05
    clipped = right.captures[0].clipped
    assert clipped is not None
    assert bool(clipped.any())


def test_methods_are_scored_against_what_they_saw(scene: TurnableScene) -> None:
    captured = capture_with_errors(scene, 0.0, (0.1, -0.3))
    truths = {name: truth for name, _, truth in separate_captures(captured, [ANALYTIC])}
    one, other = captured.scenes
    assert_close(truths[DING][1], (one.specular.s0 + other.specular.s0) / 2)
    assert_close(truths["analytic"][0], one.diffuse.s0)
    scores = {name: value for name, output, value in score_captures(captured, [ANALYTIC]) if output == "diffuse"}
    assert scores[DING] > scores[DEBEVEC] + 5


def test_a_full_set_of_lights_does_not_change_when_it_turns(scene: TurnableScene) -> None:
    """Mean scores of a method without calibration are the same for every error; those of single lights are not."""

    def scores(error: float) -> list[float]:
        seen = (capture_with_errors(scene, math.radians(nominal), (error, 0.0)) for nominal in NOMINAL_DEG)
        return [
            v for s in seen for name, out, v in score_captures(s, [ANALYTIC]) if (name, out) == ("analytic", "diffuse")
        ]

    right, wrong = scores(0.0), scores(math.radians(13.0))
    assert abs(statistics.fmean(wrong) - statistics.fmean(right)) < 0.02
    assert max(abs(a - b) for a, b in zip(right, wrong, strict=True)) > 0.1


def test_deviates_are_normal_and_the_first_ones_stay() -> None:
    found = torch.tensor([normal_deviates(index) for index in range(200)], dtype=torch.float64)
    assert_within(found.mean(dim=0), 0.0, 0.05)
    assert_within(found.std(dim=0), 1.0, 0.05)
    assert_within(torch.corrcoef(found.T)[0, 1], 0.0, 0.1)


def test_sweeps_tell_the_change_and_the_range(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("evaluation.calibration.SIZE", (48, 48))
    rows = list(measure_sweep("x", Sweep(1, (0, 20)), [ANALYTIC]))
    value = {(row.bench, row.case, row.method, row.metric): row.value for row in rows}
    right, wrong = (value["x", f"light polarizer off by {e} degrees rms", DING, "specular PSNR"] for e in (0, 20))
    assert value["x", "largest change by an error", DING, "specular PSNR"] == pytest.approx(wrong - right)
    singles = [value["x_light", f"light polarizer at {a:g} degrees", "analytic", "diffuse PSNR"] for a in NOMINAL_DEG]
    spread = value["x_light", "range of one view, mean", "analytic", "diffuse PSNR"]
    assert spread == pytest.approx(max(singles) - min(singles))


def test_sweeps_begin_without_error() -> None:
    with pytest.raises(ValueError, match="expected errors that begin at 0 degrees"):
        Sweep(1, (5, 10))


def test_calibrations_win_what_the_sensor_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each one measured leaves less of the loss before a bad sensor, all of them nearly nothing."""
    monkeypatch.setattr(sensors, "SIDE", 192)
    monkeypatch.setattr(sensors, "METHODS", ("analytic",))
    rows = {row.case: row.value for row in sensors.bench_sensors(2) if row.metric == "diffuse loss"}
    before, dark, flat, all_of_it = (rows[f"worn sensor: {known}"] for known in sensors.KNOWN)
    assert before > 1 and dark > 1 and abs(flat) < 0.7 and abs(all_of_it) < 0.7
    assert abs(rows["daylight lamp: light"]) < 0.3
