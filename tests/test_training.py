"""The training loop: learns a picture by heart, goes on after a kill with the same bits and one log, and says how."""

from __future__ import annotations

import itertools
import json
import math
import re
import shlex
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tolerances import assert_finite
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, max_pool2d

pytest.importorskip("embreex")
pytest.importorskip("lightning_fabric")
pytest.importorskip("tensorboard")

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import polsep
from polsep import cli
from polsep.demosaic.bilinear import demosaic_bilinear_half
from polsep.in_torch import load_refinement
from polsep.io.store.checkpoints import read_checkpoint, read_lines, write_checkpoint, write_lines
from polsep.io.store.weights import read_weights
from polsep.methods import METHODS
from polsep.networks.rungs import RUNGS
from polsep.networks.sizes import Size
from polsep.physics.stokes import Stokes, measure
from polsep.sensor.camera import Layout, Mosaic
from polsep.train import digest
from polsep.train.command import Options, TrainOptions, choose_options, describe_command, plan_run, train_weights
from polsep.train.digest import digest_examples, find_sources
from polsep.train.inputs import LadderInputs, co_sited_inputs, demosaic_lit, mono_inputs, mosaic_inputs
from polsep.train.log import open_log, read_log
from polsep.train.loop import Run, Schedule, Training, run_training, train
from polsep.train.losses import FIRST_WEIGHT, first_specular_loss
from polsep.train.stream import Examples, StreamOptions, stream_lane
from polsep.train.tasks import FIRST_SHARE, VARIANTS, Task, ladder_task
from polsep.train.validation import score, score_averaged, score_references, validation_batches

STREAM = StreamOptions(batch=2, crop=32, size=64, pool=2, uses=1)
SCHEDULE = Schedule(steps=6, warm_up=2, checkpoint_every=3, validate_every=100, precision="32-true")


def small_task() -> Task[LadderInputs]:
    torch.manual_seed(1)
    return ladder_task(RUNGS["paper"], "mosaic", Size(4, 1, 1))


def run_in(folder: Path, schedule: Schedule = SCHEDULE) -> Run:
    return Run(folder, "a test", STREAM, schedule, workers=1)


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def die_at(step: int) -> Callable[[dict[str, Any]], None]:
    """A reporter that stops a training when it has logged ``step``."""

    def stop(line: dict[str, Any]) -> None:
        if line["step"] == step:
            raise KeyboardInterrupt

    return stop


def scores_of(line: dict[str, Any]) -> dict[str, Any]:
    """A line of the log without what depends on time."""
    return {name: value for name, value in line.items() if name != "steps_per_second"}


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, dict[str, Tensor], list[dict[str, Any]]]:
    """A training that died when it had logged step 4, of which the last checkpoint is of step 3, and a whole one."""
    schedule = replace(SCHEDULE, validate_every=2)
    lines: list[dict[str, Any]] = []
    whole = train(small_task(), run_in(tmp_path_factory.mktemp("whole"), schedule), lines.append)
    run = run_in(tmp_path_factory.mktemp("killed"), schedule)
    with pytest.raises(KeyboardInterrupt):
        train(small_task(), run, die_at(4))
    assert whole is not None
    return run, whole, lines


def test_resumed_training_ends_with_the_same_bits_and_log(
    killed: tuple[Run, dict[str, Tensor], list[dict[str, Any]]], tmp_path: Path
) -> None:
    run, whole, lines = killed
    run = replace(run, out=Path(shutil.copytree(run.out, tmp_path / "copy")))
    state = read_checkpoint(run.out / "checkpoint.pt")
    assert state is not None
    assert state["step"] == 3
    assert [line["step"] for line in read_log(run.out)] == [0, 2, 4]
    append_half_a_line(run.out)
    resumed = train(small_task(), run, lambda _: None)
    assert resumed is not None
    assert equal(whole, resumed)
    assert [line["step"] for line in lines] == [0, 2, 4, 6]
    assert [scores_of(line) for line in read_log(run.out)] == [scores_of(line) for line in lines]


def append_half_a_line(folder: Path) -> None:
    """What a kill may leave of a line."""
    with (folder / "log.jsonl").open("a", encoding="utf-8") as file:
        file.write('{"step": 5, "lo')


def test_tensorboard_shows_a_resumed_training_once(
    killed: tuple[Run, dict[str, Tensor], list[dict[str, Any]]], tmp_path: Path
) -> None:
    """Every curve has the points of an uninterrupted one, whatever the killed one wrote after its checkpoint."""
    run, _, lines = killed
    run = replace(run, out=Path(shutil.copytree(run.out, tmp_path / "copy")))
    train(small_task(), run, lambda _: None)
    found = EventAccumulator(str(run.out)).Reload()
    for name in ("diffuse PSNR", "specular PSNR", "steps_per_second", "loss", "rate"):
        assert [event.step for event in found.Scalars(name)] == [2, 4, 6]
    for name in ("diffuse PSNR", "loss"):
        values = [event.value for event in found.Scalars(name)]
        assert values == pytest.approx([line[name] for line in lines[1:]])
    assert [event.step for event in found.Scalars("analytic diffuse PSNR")] == [0]


def test_a_log_begins_with_methods_without_training(
    killed: tuple[Run, dict[str, Tensor], list[dict[str, Any]]], tmp_path: Path
) -> None:
    """Also one that another version began without them; its other lines stay."""
    lines = killed[2]
    views = [mosaic_inputs(batch) for batch in validation_batches(STREAM)]
    assert lines[0] == {"step": 0} | score_references(small_task(), views)
    analytic = score(lambda seen: METHODS["analytic"].reference(seen[0]), views)
    assert {f"analytic {name}": value for name, value in analytic.items()}.items() <= lines[0].items()
    with open_log(tmp_path, 0, lambda _: None, lambda: {"x": 1.0}) as log:
        log.note(2, 0.5, 0.1)
        log.add_scores(2, 0.1, {"y": 2.0})
    write_lines(tmp_path / "log.jsonl", read_lines(tmp_path / "log.jsonl")[1:])
    seen: list[dict[str, Any]] = []
    with open_log(tmp_path, 2, seen.append, lambda: {"x": 1.0}):
        pass
    assert [scores_of(line) for line in seen] == [{"step": 0, "x": 1.0}]
    assert [line["step"] for line in read_log(tmp_path)] == [0, 2]


def test_foreign_log_is_refused(tmp_path: Path) -> None:
    for content in ("no log\n", "[]\n", '{"loss": 1}\n'):
        (tmp_path / "log.jsonl").write_text(content)
        with pytest.raises(ValueError, match="expected the log of a training"):
            read_log(tmp_path)


@pytest.mark.parametrize("variant", VARIANTS)
def test_weights_say_how_they_came_about(variant: str, tmp_path: Path) -> None:
    options = TrainOptions("paper", variant, Size(4, 1, 1))
    run = replace(run_in(tmp_path, replace(SCHEDULE, steps=2)), workers=0)
    lines: list[dict[str, Any]] = []
    path = train_weights(options, run, lines.append)
    assert path.name == f"paper-{variant}.safetensors"
    metadata = read_weights(path)[1]
    assert metadata["colors"] == ("1" if variant == "mono" else "3")
    assert metadata["data"] == digest_examples(asdict(STREAM), "polsep.train.stream")
    last = [round(lines[-1][f"{image} PSNR"], 3) for image in ("diffuse", "specular")]
    assert json.loads(metadata["curve"]) == [[2, *last]]
    halves = json.loads(metadata["validation"])
    assert [halves[f"{image} PSNR"] for image in ("diffuse", "specular")] == pytest.approx(last, abs=0.1)
    reference = json.loads(metadata["reference"])
    assert set(reference) == {"analytic", "color-affine"}
    assert reference["analytic"][0] == pytest.approx(lines[0]["analytic diffuse PSNR"], abs=1e-3)
    _, network = load_refinement(path, torch.device("cpu"))
    assert network.colors == VARIANTS[variant].colors
    # Given again, the command of a training that is done writes the same again.
    train_weights(options, run, lines.append)
    assert read_weights(path)[1] == metadata
    assert len(lines) == 2


def test_weights_say_what_they_started_from_and_with_which_constants(tmp_path: Path) -> None:
    """Name and sha256 of every file of ``--start``, all constants, and a command that sets those that differ."""
    options, schedule = TrainOptions("paper", "mosaic", Size(4, 1, 1)), replace(SCHEDULE, steps=1)
    first = train_weights(options, replace(run_in(tmp_path / "a", schedule), workers=0), lambda _: None)
    other = replace(STREAM, constants=(("variety.MATTE_STRENGTH", (0.02, 1.0)),))
    run = replace(run_in(tmp_path / "b", schedule), workers=0, start=(first, first), stream=other)
    metadata = read_weights(train_weights(options, run, lambda _: None))[1]
    assert json.loads(metadata["start"]) == 2 * [["paper-mosaic.safetensors", read_weights(first)[1]["sha256"]]]
    assert json.loads(metadata["constants"])["variety.MATTE_STRENGTH"] == [0.02, 1.0]
    assert json.loads(read_weights(first)[1]["constants"])["variety.MATTE_STRENGTH"] == [0.005, 1.0]
    assert "--set variety.MATTE_STRENGTH=0.02,1 --start paper-mosaic.safetensors" in metadata["command"]
    assert json.loads(read_weights(first)[1]["start"]) == [] and "--set" not in read_weights(first)[1]["command"]
    assert metadata["data"] != read_weights(first)[1]["data"]


def test_data_have_a_digest_of_their_options() -> None:
    streams = (STREAM, STREAM, replace(STREAM, seed=1), replace(STREAM, crop=64))
    digests = [digest_examples(asdict(stream), "polsep.train.stream") for stream in streams]
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests)
    assert digests[0] == digests[1]
    assert len(set(digests)) == 3


def test_digests_cover_every_module_that_makes_examples() -> None:
    """Optics, Stokes algebra, sensor and all of the renderer; of the package, nothing that only trains."""
    drawn, separated = find_sources("polsep.train.stream"), find_sources("polsep.material.examples")
    render = {f"polsep.render.{path.stem}" for path in Path(polsep.__file__).parent.glob("render/*.py")}
    drawn_only, for_shape = {"distances", "tracer"}, {"blobs", "models", "vessels", "waves"}
    unused = {f"polsep.render.{name}" for name in {"__init__"} | drawn_only | for_shape}
    common = {"polsep.physics.optics", "polsep.physics.stokes", "polsep.sensor.camera"}
    assert common | (render - unused) | {"polsep.train.variety", "polsep.train.reality"} <= set(drawn)
    assert common | {"polsep.material.shots", "polsep.demosaic.guided"} <= set(separated)
    shaped = find_sources("polsep.train.shape_examples")
    bodies = {f"polsep.render.{name}" for name in for_shape}
    assert common | bodies | {"polsep.train.reality", "polsep.separation.report"} <= set(shaped)
    thumbnail = {f"polsep.networks.{name}" for name in ("channels", "thumbnails", "whole_frame")}
    other = {name for name in drawn if name.startswith(("polsep.networks", "polsep.separation", "polsep.train.t"))}
    assert other == thumbnail


def test_digests_change_with_any_source(monkeypatch: pytest.MonkeyPatch) -> None:
    """A comment in `polsep.physics.optics` is enough; the names of modules do not count."""
    before = digest_examples({}, "polsep.render.simulate")
    sources = find_sources("polsep.render.simulate")
    renamed = {f"other.{name}": source for name, source in sources.items()}
    monkeypatch.setattr(digest, "find_sources", lambda _: renamed)
    assert digest_examples({}, "polsep.render.simulate") == before
    renamed["other.polsep.physics.optics"] += "# more\n"
    assert digest_examples({}, "polsep.render.simulate") != before


@pytest.mark.parametrize(
    "asked",
    [
        ["shared", "-o", "x"],
        ["paper", "--data", "co-sited", "--rate", "0.000123456789", "--steps", "7", "-o", "x y"],
        ["stokes", "--width", "8", "--levels", "2", "--fold", "1", "--seed", "3", "--precision", "32-true", "-o", "x"],
        ["paper", "--data", "mono", "--workers", "2", "--devices", "2", "-o", "x"],
        ["joint", "--data", "mono", "-o", "x"],
        ["joint-fast", "--blocks", "0,1", "--width", "8", "--ablation", "cosine", "-o", "x"],
    ],
)
def test_commands_are_described_as_click_reads_them(asked: list[str]) -> None:
    """What is left to defaults is written out."""
    given = cli.train.train.make_context("train", list(asked), **cli.app.context_settings).params
    options, run = plan(given)
    words = shlex.split(describe_command(options, run))
    assert words[:2] == ["polsep", "train"]
    read = cli.train.train.make_context("train", words[2:], **cli.app.context_settings).params
    assert {name: value for name, value in read.items() if given[name] is not None} == {
        name: value for name, value in given.items() if value is not None
    }
    assert plan(read) == (options, run)


def plan(given: dict[str, Any]) -> tuple[Options, Run]:
    """As `polsep train` plans."""
    options = choose_options(given["rung"], given["data"], given)
    schedule = Schedule(given["steps"], given["rate"], precision=given["precision"])
    out = Path("runs") / given["output"]
    kept = {name: given[name] for name in ("workers", "devices", "start")}
    return options, plan_run(Run(out, schedule=schedule, **kept), options)


def test_mono_sees_the_green_light_behind_every_pixel() -> None:
    """Noise apart, the measurements are those of the green light; the same batch is seen alike again."""
    examples = next(stream_lane(replace(STREAM, batch=16), 0, 0))
    measurements, diffuse, specular, mask = mono_inputs(examples)
    assert measurements.data.shape == (16, 4, 1, 16, 16)
    assert diffuse.shape == specular.shape == (16, 1, 16, 16)
    assert torch.equal(mask, mosaic_inputs(examples)[3])
    assert torch.equal(diffuse, mosaic_inputs(examples)[1][:, 1:2])
    assert torch.equal(measurements.data, mono_inputs(examples)[0].data)
    light = Stokes(diffuse + specular, *(avg_pool2d(examples.polarized[:, k : k + 1].float(), 2) for k in (1, 4)))
    error = measurements.data - measure(light, measurements.angles).data
    assert measurements.clipped is not None
    # Demosaicking carries light from clipped samples, which do not count, to their neighbours.
    clipped = measurements.clipped.flatten(1, 2).any(dim=1, keepdim=True)
    away = (max_pool2d(clipped.float(), 3, 1, 1) == 0)[:, None].expand_as(error)
    assert float(away.float().mean()) > 0.5
    assert abs(float(error[away].mean())) < 2e-3
    assert float(error[away].abs().median()) < 1e-2


def test_checkpoint_of_another_training_is_refused(tmp_path: Path) -> None:
    """In one line that names what differs, and nothing else."""
    run = replace(run_in(tmp_path), what=json.dumps({"seed": 0, "size": {"width": 4}}))
    train(small_task(), run, lambda _: None)
    for other, asked, found in (
        (replace(run, schedule=replace(SCHEDULE, rate=1.0)), "schedule rate 1.0", "schedule rate 0.001"),
        (replace(run, what=json.dumps({"seed": 1, "size": {"width": 4}})), "seed 1", "seed 0"),
        (
            replace(run, what=json.dumps({"seed": 0, "size": {"width": 8}}), workers=0),
            "width 8, workers 0",
            "workers 1",
        ),
    ):
        with pytest.raises(ValueError, match=f"a training with .*{asked}, found one with .*{found}$"):
            train(small_task(), other, lambda _: None)


def test_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    assert read_checkpoint(path) is None
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="expected a checkpoint"):
        read_checkpoint(path)
    for state in ({"another": 1}, {"step": 1, "model": {}}):
        write_checkpoint(path, state)
        with pytest.raises(ValueError, match="found something else"):
            read_checkpoint(path)


def test_networks_are_shown_samples_as_they_are(tmp_path: Path) -> None:
    """bfloat16 has 8 bits, a sample has 12: what layers round, the data must not have lost before."""
    task, shown = small_task(), list[Tensor]()
    task.network.register_forward_pre_hook(lambda _, given: shown.append(given[0].clone()))
    expected = task.prepare(next(stream_lane(STREAM, 0, 0)))
    train(task, run_in(tmp_path, replace(SCHEDULE, steps=1, precision="bf16-mixed")), lambda _: None)
    maps = RUNGS["paper"].inputs(expected[0])
    assert any(torch.equal(x, maps) for x in shown)


def test_a_training_begins_with_given_weights(tmp_path: Path) -> None:
    """Without a step's worth of learning rate, what comes out is what went in; others are refused by name."""
    options = TrainOptions("paper", "co-sited", Size(4, 1, 1), seed=5)
    run = replace(run_in(tmp_path / "first"), workers=0)
    first = train_weights(options, run, lambda _: None)
    after = replace(run, out=tmp_path / "second", start=(first,), schedule=replace(SCHEDULE, steps=1, rate=1e-12))
    second = train_weights(replace(options, seed=6), after, lambda _: None)
    before, found = read_weights(first)[0], read_weights(second)[0]
    assert all(np.allclose(before[name], found[name], rtol=1e-3, atol=1e-6) for name in before)
    assert read_weights(second)[1]["command"].endswith("--start paper-co-sited.safetensors")
    begun, ended = json.loads(read_weights(second)[1]["curve"])
    assert begun[0] == 0 and begun[1:] == pytest.approx(ended[1:], abs=0.01)
    other = replace(run, out=tmp_path / "third", start=(first,))
    with pytest.raises(ValueError, match=r"expected weights of the network .*, found those of another"):
        train_weights(replace(options, size=Size(8, 1, 1)), other, lambda _: None)


def test_a_training_of_no_steps_is_the_mean_of_what_it_begins_with(tmp_path: Path) -> None:
    """A file that is given twice counts twice; the mean is scored, and the command says what it is of."""
    options = TrainOptions("paper", "co-sited", Size(4, 1, 1), seed=5)
    run = replace(run_in(tmp_path), workers=0, schedule=replace(SCHEDULE, steps=1))
    first, second = (
        train_weights(replace(options, seed=seed), replace(run, out=tmp_path / str(seed)), lambda _: None)
        for seed in (5, 6)
    )
    mixed = replace(run, out=tmp_path / "mean", start=(first, second, first), schedule=replace(SCHEDULE, steps=0))
    lines: list[dict[str, Any]] = []
    found, metadata = read_weights(train_weights(options, mixed, lines.append))
    one, other = read_weights(first)[0], read_weights(second)[0]
    assert any(not np.array_equal(one[name], other[name]) for name in one)
    for name, value in found.items():
        np.testing.assert_allclose(value, (2 * one[name] + other[name]) / 3, rtol=1e-3, atol=1e-6)
    scores = [round(lines[0][f"{image} PSNR"], 3) for image in ("diffuse", "specular")]
    assert [line["step"] for line in lines] == [0] and json.loads(metadata["curve"]) == [[0, *scores]]
    assert metadata["command"].count("--start paper-co-sited.safetensors") == 3


def test_rate_warms_up_and_falls_as_a_cosine() -> None:
    schedule = Schedule(steps=1000, rate=2.0, warm_up=100)
    assert schedule.rate_at(0) == pytest.approx(0.02)
    assert schedule.rate_at(99) == pytest.approx(2.0)
    assert schedule.rate_at(550) == pytest.approx(2.0 * (0.01 + 0.99 / 2))
    assert schedule.rate_at(1000) == pytest.approx(0.02)


@pytest.mark.parametrize("see", [mosaic_inputs, co_sited_inputs])
def test_a_net_learns_a_picture_by_heart(see: Callable[[Examples], LadderInputs]) -> None:
    """One 32 x 32 example that hardly clips, 200 steps: both outputs reach 40 dB, from an analytic split below 30."""
    torch.manual_seed(0)
    task = ladder_task(RUNGS["paper"], "mosaic", Size(12, 2, 1))
    for examples in stream_lane(replace(STREAM, batch=1, looks="usual", seed=2), 0, 0):
        seen = see(examples)
        everywhere = [seen._replace(mask=torch.ones_like(seen.mask))]
        before = score(task.separate, everywhere)
        within = float((examples.diffuse + examples.specular).max()) < 2
        if within and min(before.values()) > 20 and max(before.values()) < 30:  # so that 40 dB are 10 to learn
            break
    optimizer = torch.optim.Adam(task.network.parameters(), 3e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 200)
    for _ in range(200):
        optimizer.zero_grad()
        task.loss(task.network, seen, 1.0).backward()
        optimizer.step()
        falling.step()
    for end in score(task.separate, everywhere).values():
        assert end > 40


@pytest.mark.parametrize("rung", RUNGS)
def test_gradients_are_finite(rung: str) -> None:
    """On black, on unpolarized and on wholly clipped frames."""
    task = ladder_task(RUNGS[rung], "co-sited", Size(4, 1, 1))
    for level in (0.0, 0.5, 3.0):
        light, nothing = torch.full((1, 3, 8, 8), level), torch.zeros(1, 1, 8, 8)
        mask = torch.ones(1, 8, 8, dtype=torch.bool)
        raw, common = torch.zeros(1, 8, 8), (torch.zeros(1, 17, 64, 64), torch.zeros(1, 4))
        seen = task.prepare(Examples(raw, raw > 0, light, nothing, torch.zeros(1, 6, 8, 8), mask, *common))
        task.network.zero_grad()
        task.loss(task.network, seen, 1.0).backward()
        assert_finite(*(p.grad for p in task.network.parameters()))


def test_validation_uses_the_average_and_gives_the_weights_back() -> None:
    task = small_task()
    own = {name: value.clone() for name, value in task.network.state_dict().items()}
    average = {name: torch.zeros_like(value) for name, value in own.items()}
    batch = next(stream_lane(STREAM, 0, 0))
    views = [task.prepare(batch)]
    scores = score_averaged(task.network, average, lambda _: score(task.separate, views))
    assert set(scores) == {"diffuse PSNR", "specular PSNR"}
    assert all(math.isfinite(score) for score in scores.values())
    assert equal(own, task.network.state_dict())


def test_a_loss_that_is_not_finite_ends_training(tmp_path: Path) -> None:
    """With the step in one line, before weights or a checkpoint are spoilt."""
    task = small_task()

    def loss(network: nn.Module, batch: Examples, done: float) -> torch.Tensor:
        return task.loss(network, task.prepare(batch), done) * (math.nan if done > 0.4 else 1.0)

    batch = next(stream_lane(STREAM, 0, 0))
    training = Training(task.network, lambda *_: itertools.repeat(batch), loss, lambda _: {})
    with pytest.raises(ValueError, match="expected a finite loss, found nan at step 3"):
        run_training(training, Run(tmp_path, "a test", STREAM, SCHEDULE, workers=0), lambda _: None)
    assert all(bool(torch.isfinite(weight).all()) for weight in task.network.parameters())


def test_unknown_rungs_are_refused() -> None:
    with pytest.raises(ValueError, match="expected a rung of paper"):
        TrainOptions("none")


def test_without_tensorboard_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    for name in (
        "torch.utils.tensorboard",
        "polsep.io.store.events",
        *(f"polsep.train.{x}" for x in ("log", "loop", "command")),
    ):
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "argv", ["polsep", "train", "paper", "-o", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    assert stopped.value.code == 2
    assert "expected the extra 'train' (pip install 'polsep[train]'), found no tensorboard" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["none"], "'RUNG': expected joint-large, joint"),
        (["paper", "--data", "none"], "expected a variant of mosaic"),
        (["paper", "--width", "0"], "'--width': expected a whole number"),
        (["joint", "--width", "0"], "'--width': expected a whole number"),
        (["joint", "--blocks", "1,x"], "expected blocks per level like 1,1,2, found '1,x'"),
        (["joint", "--ablation", "x"], "expected an ablation of none"),
        (["joint", "--part", "x"], "expected a part of all, details"),
        (["joint-fast", "--data", "co-sited"], "expected a variant of mosaic, mono"),
        (["paper", "--steps", "0"], "expected at least 1 step"),
        (["joint", "--refit"], "expected a network with a linear filter to refit, found joint for mosaic"),
        (["paper", "--workers", "-1"], "'--workers': expected a whole number"),
        (["paper", "--devices", "0"], "'--devices': expected a whole number"),
        (["paper", "--precision", "16-mixed"], "expected a precision of bf16-mixed"),
        (["paper", "-o", "a-file"], "expected a directory to write into, found a file"),
    ],
)
def test_bad_options_are_one_line_and_leave_nothing(
    asked: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a-file").touch()
    monkeypatch.setattr(sys, "argv", ["polsep", "train", "-o", "out", *asked])
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    line = capsys.readouterr().err
    assert stopped.value.code == 2
    assert said in line
    assert line.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a-file"]


@pytest.mark.parametrize("rung", RUNGS)
def test_rungs_without_a_first_guess_begin_with_squared_errors(rung: str) -> None:
    """For an eighth of the training, and of the specular light only; the others have the paper's losses throughout."""
    specular = torch.rand(1, 3, 4, 4)
    assert float(first_specular_loss(torch.log1p(specular), specular)) == 0
    assert float(first_specular_loss(torch.log1p(specular) - 0.2, specular)) == pytest.approx(FIRST_WEIGHT * 0.04)
    task = ladder_task(RUNGS[rung], "mosaic", Size(4, 1, 1))
    seen = task.prepare(next(stream_lane(STREAM, 0, 0)))
    with torch.no_grad():
        early, late, last = (float(task.loss(task.network, seen, done)) for done in (0.0, FIRST_SHARE, 1.0))
    assert late == last
    assert (early == late) == (rung in ("paper", "shared", "signed", "no-angle"))


def test_a_new_training_begins_its_log_anew(tmp_path: Path) -> None:
    """Lines of another run that was stopped before its first checkpoint go."""
    (tmp_path / "log.jsonl").write_text('{"step": 0, "score": 1.0}\n')
    with open_log(tmp_path, 0, lambda line: None, lambda: {"score": 2.0}):
        pass
    assert read_log(tmp_path) == [{"step": 0, "score": 2.0}]


def test_clipping_is_that_of_the_sensor_under_any_lamp() -> None:
    """Samples less the lamp's colour clip where the sensor did, at 1 over its gain."""
    channels = torch.tensor([[Layout().filter_at(row, col).channel for col in range(4)] for row in range(4)])
    gain, codes = torch.tensor([0.3, 1.0, 1.7])[channels].repeat(8, 8), torch.full((32, 32), 0.5)
    codes[8:16, 8:16] = 1
    found = demosaic_lit((codes / gain)[None], (codes == 1)[None], Layout()).clipped
    expected = demosaic_bilinear_half(Mosaic(codes[None], Layout(), 0.0, 1.0)).clipped
    assert found is not None and expected is not None and torch.equal(found, expected)
