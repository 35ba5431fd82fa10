"""The training loop: learns a picture by heart, goes on after a kill with the same bits, refuses foreign files."""

from __future__ import annotations

import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

pytest.importorskip("embreex")
pytest.importorskip("lightning_fabric")

from polsep import cli
from polsep.io.checkpoints import read_checkpoint, write_checkpoint
from polsep.metrics import psnr
from polsep.networks import Size
from polsep.train.loop import Run, Schedule, train, validate
from polsep.train.stream import Examples, StreamOptions, stream_lane
from polsep.train.tasks import Task, find_rung, ladder_task, see_co_sited, see_mosaic

STREAM = StreamOptions(batch=2, crop=32, size=64, pool=2, uses=1)
SCHEDULE = Schedule(steps=6, warm_up=2, checkpoint_every=3, validate_every=100, precision="32-true")


def small_task() -> Task:
    torch.manual_seed(1)
    return ladder_task(find_rung("paper"), "mosaic", Size(4, 1, 1))


def run_in(folder: Path, schedule: Schedule = SCHEDULE) -> Run:
    return Run(folder, "a test", STREAM, schedule, workers=1)


def equal(a: dict[str, Tensor], b: dict[str, Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_resumed_training_ends_with_the_same_bits(tmp_path: Path) -> None:
    lines: list[dict[str, float]] = []
    whole = train(small_task(), run_in(tmp_path / "whole"), lines.append)
    assert [line["step"] for line in lines] == [6]

    def stop(_: object) -> None:
        raise KeyboardInterrupt

    # A training that dies at step 5 has a checkpoint of step 3.
    dying = replace(SCHEDULE, validate_every=5)
    killed = run_in(tmp_path / "killed", dying)
    with pytest.raises(KeyboardInterrupt):
        train(small_task(), killed, stop)
    state = read_checkpoint(tmp_path / "killed" / "checkpoint.pt")
    assert state is not None
    assert state["step"] == 3
    resumed = train(small_task(), killed, lines.append)
    assert whole is not None
    assert resumed is not None
    assert equal(whole, resumed)


def test_checkpoint_of_another_training_is_refused(tmp_path: Path) -> None:
    train(small_task(), run_in(tmp_path), lambda _: None)
    with pytest.raises(ValueError, match="expected the checkpoint of"):
        train(small_task(), run_in(tmp_path, replace(SCHEDULE, rate=1.0)), lambda _: None)


def test_foreign_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    assert read_checkpoint(path) is None
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="expected a checkpoint"):
        read_checkpoint(path)
    write_checkpoint(path, {"another": 1})
    with pytest.raises(ValueError, match="found something else"):
        read_checkpoint(path)


def test_rate_warms_up_and_falls_as_a_cosine() -> None:
    schedule = Schedule(steps=1000, rate=2.0, warm_up=100)
    assert schedule.rate_at(0) == pytest.approx(0.02)
    assert schedule.rate_at(99) == pytest.approx(2.0)
    assert schedule.rate_at(550) == pytest.approx(2.0 * (0.01 + 0.99 / 2))
    assert schedule.rate_at(1000) == pytest.approx(0.02)


@pytest.mark.parametrize("see", [see_mosaic, see_co_sited])
def test_a_net_learns_a_picture_by_heart(see: object) -> None:
    """One 32 x 32 example, 200 steps: both outputs gain over a zero network by 10 dB and more."""
    examples = next(itertools.islice(stream_lane(replace(STREAM, batch=1), 0, 0), 1, None))
    torch.manual_seed(0)
    task = ladder_task(find_rung("paper"), "mosaic", Size(12, 2, 1))
    seen = see(examples)  # type: ignore[operator]
    before = task.separate(seen)
    optimizer = torch.optim.Adam(task.network.parameters(), 3e-3)
    for _ in range(200):
        optimizer.zero_grad()
        task.loss(task.network, seen).backward()
        optimizer.step()
    after = task.separate(seen)
    everywhere = torch.ones_like(seen[3][0])
    for name, truth in (("diffuse", seen[1]), ("specular", seen[2])):
        start, end = (psnr(getattr(found, name)[0], truth[0], everywhere) for found in (before, after))
        assert end > start + 10
        assert end > 25


def test_validation_uses_the_average_and_gives_the_weights_back() -> None:
    task = small_task()
    own = {name: value.clone() for name, value in task.network.state_dict().items()}
    average = {name: torch.zeros_like(value) for name, value in own.items()}
    batch = next(stream_lane(STREAM, 0, 0))
    scores = validate(task, average, [Examples(*batch)])
    assert set(scores) == {"diffuse PSNR", "specular PSNR"}
    assert all(math.isfinite(score) for score in scores.values())
    assert equal(own, task.network.state_dict())


def test_unknown_rungs_are_refused() -> None:
    with pytest.raises(ValueError, match="expected a rung of paper"):
        find_rung("none")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (["none"], "expected a rung of paper"),
        (["paper", "--data", "none"], "expected a variant of mosaic"),
        (["paper", "--width", "0"], "expected a width"),
        (["paper", "--steps", "0"], "expected at least 1 step"),
        (["paper", "--workers", "-1"], "expected at least 1 step"),
        (["paper", "--devices", "0"], "expected at least 1 step"),
        (["paper", "--precision", "16-mixed"], "expected a precision of bf16-mixed"),
        (["paper", "-o", "a-file"], "expected a directory to write into, found a file"),
    ],
)
def test_bad_options_are_one_line_and_leave_nothing(
    asked: list[str],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
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
