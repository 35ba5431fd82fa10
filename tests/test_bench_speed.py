"""The benchmark of time and memory: what it counts, whom it compares, and that each chain runs in a process alone."""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import polsep
from polsep.bench import chains, speed, stopwatch
from polsep.bench.speed import Program, Times, chain_rows, method_rows, run_chain, wait_until_idle
from polsep.io.store.rows import read_cpu_times, read_peak_memory

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")


@pytest.fixture
def raw(tmp_path: Path) -> Path:
    """A frame of 12 bits, a few of whose samples clip."""
    path = tmp_path / "raw.npy"
    np.save(path, np.random.default_rng(0).integers(100, 4200, (64, 96)).clip(max=4095).astype(np.uint16))
    return path


def ticking(clock: list[float], steps: list[float]) -> Iterator[None]:
    """A frame whenever the clock has gone on by the next step."""
    for step in itertools.cycle(steps):
        clock[0] += step
        yield


@pytest.mark.parametrize(
    ("steps", "at_once", "expected"),
    [([0.5], 1, [500.0] * 4), ([0.25, 0.75], 1, [250.0, 750.0] * 2), ([1.0, 0.0], 2, [500.0])],
)
def test_frames_are_timed(
    steps: list[float], at_once: int, expected: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One by one where they are; of frames that end together the mean, whichever of them comes first."""
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    frames = ticking(clock, steps)
    for _ in range(at_once - 1):
        next(frames)
    assert stopwatch.time_frames(frames, at_once, 2.0) == expected


def test_frames_are_not_timed_for_ever() -> None:
    assert len(stopwatch.time_frames(itertools.repeat(None), 1, 1e6)) == stopwatch.MOST


@pytest.mark.parametrize("resolution", speed.RESOLUTIONS)
@pytest.mark.parametrize("way", ["one frame", "many frames"])
def test_chains_separate(way: str, resolution: str, raw: Path) -> None:
    """Every method of a chain's name at its resolution, many of them on cores of their own."""
    frames, at_once = chains.frames(f"{resolution}: analytic, {way}", str(raw))
    size = (64, 96) if resolution == "full" else (32, 48)
    expected = polsep.separate(np.load(raw), "analytic", white_level=4095, full=resolution == "full")
    for found in itertools.islice(frames, 3):
        assert found.valid.shape == size
        np.testing.assert_array_equal(found.diffuse, expected.diffuse)
    assert (at_once > 1) == (way == "many frames" and len(os.sched_getaffinity(0)) > 1)


@pytest.mark.parametrize("resolution", speed.RESOLUTIONS)
def test_streams_fill_the_same_images(resolution: str, raw: Path) -> None:
    names = [name for name in chains.chain_names(resolution) if name.endswith(", stream")]
    assert len(names) == len(chains.STREAMS)
    for name in names:
        frames, at_once = chains.frames(name, str(raw))
        first, second = next(frames), next(frames)
        assert first.diffuse is second.diffuse and at_once == 1
        assert np.isfinite(first.specular).all()
        assert first.valid.all() or "nothing clipped" not in name


@LINUX
def test_a_chain_runs_alone(raw: Path) -> None:
    """Its first image, its frames and its memory, without what this process holds or has imported."""
    times = Times()
    for _ in range(2):
        run_chain(speed._own(), "half: analytic, one frame", (raw, 0.01), times)
    assert len(times.first) == len(times.peaks) == 2 and len(times.frames) >= 2
    assert min(times.frames) > 0 and 0 < sum(times.first) < times.spent
    assert 20 < max(times.peaks) < read_peak_memory() - 50


def test_failing_chain_is_one_line(raw: Path, tmp_path: Path) -> None:
    source = tmp_path / "chains.py"
    source.write_text("def frames(chain, path):\n    raise OSError('no luck')\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"\Ax failed: OSError: no luck\Z"):
        run_chain(Program(sys.executable, source), "x", (raw, 1.0), Times())


def test_rows_compare_like_with_like() -> None:
    """Ratios are those of least times, to the packages of the same resolution; medians stand beside."""
    times = {
        "analytic, one frame": Times([0.3, 0.9, 0.4], [10.0, 30.0, 20.0], [100.0, 120.0]),
        "analytic, many frames": Times([0.5], [5.0], [200.0]),
        "polanalyser 3": Times([1.0], [100.0], [300.0]),
        "OpenCV 5 + NumPy by hand": Times([0.5], [40.0], [150.0]),
    }
    found = {(row.method, row.metric): row.value for row in chain_rows("half", times, 2.0)}
    own = "analytic, one frame"
    assert found[own, "times as fast as polanalyser"] == 10
    assert found[own, "times as fast as OpenCV + NumPy"] == 4
    assert (found[own, "frame, least"], found[own, "frame, median"], found[own, "rate"]) == (10, 20, 100)
    assert (found[own, "roofline reached"], found[own, "start to image"], found[own, "peak memory"]) == (20, 0.4, 120)
    assert found["polanalyser 3", "times as fast as polanalyser"] == 1
    rows = list(method_rows("half", times))
    assert list(dict.fromkeys(row.method for row in rows)) == ["analytic", "polanalyser", "OpenCV + NumPy"]
    values = {(row.method, row.metric): row.value for row in rows}
    assert values["analytic", "many frames, one per core"] == 200
    assert values["analytic", "one frame, least"] == 0.01
    assert ("polanalyser", "many frames, one per core") not in values


def test_chains_take_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every other round goes backwards, and a chain that took long is not started again."""
    started: list[str] = []

    def run(program: Program, chain: str, task: tuple[Path, float], times: Times) -> None:
        del program, task
        started.append(chain)
        times.first.append(1.0)
        times.frames.append(10.0)
        times.peaks.append(50.0)
        times.spent += speed.ENOUGH if "b," in chain else 1

    for name, value in {
        "run_chain": run,
        "wait_until_idle": lambda: 3.0,
        "measure_copy_bandwidth": lambda: 1e10,
        "warm_up": lambda: None,
        "read_demo_codes": lambda: np.ones((8, 8), np.uint16),
    }.items():
        monkeypatch.setattr(speed, name, value)
    programs = dict.fromkeys(("half: a, one frame", "half: b, one frame", "full: c, one frame"), speed._own())
    rows = list(speed.measure(programs, 3, 1.0))
    assert [name[6] for name in started] == list("abccaac")
    assert {row.case for row in rows} == {"before each round", "half resolution", "full resolution"}
    assert next(row.value for row in rows if row.unit == "%") == 3


@LINUX
def test_a_busy_machine_is_waited_for(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Until others leave the cores alone, or it has waited long enough, which it says."""
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    looks = iter([(0.0, 0.0), (1.0, 2.0), (1.0, 2.0), (1.1, 4.0)])
    monkeypatch.setattr(speed, "read_cpu_times", lambda: next(looks))
    assert wait_until_idle() == pytest.approx(5)
    counter = itertools.count()
    monkeypatch.setattr(speed, "read_cpu_times", lambda: (float(next(counter)),) * 2)
    assert wait_until_idle() == 100
    assert capsys.readouterr().err == "machine busy: other programs use 100% of the cores\n"


@LINUX
def test_cpu_times_grow() -> None:
    """Busy time is a part of the time that passes, and work shows in it."""
    before, end = read_cpu_times(), time.perf_counter() + 0.1
    while time.perf_counter() < end:
        pass
    busy, passed = (now - then for now, then in zip(read_cpu_times(), before, strict=True))
    assert 0 < busy <= passed + 0.05
