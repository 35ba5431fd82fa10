"""Kills and full disks: the short forms of `make faults` and `make soak`, and kills at every rename."""

from __future__ import annotations

import gc
import json
import os
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_outputs import contents, random_frame

from polsep.bench.rows import Row, replace_rows
from polsep.io.results import films
from polsep.io.results.separation_writer import write_separation
from polsep.io.store import atomic
from polsep.io.store.calibrations import read_calibration, write_calibration
from polsep.io.store.rows import read_rows
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Layout

av = pytest.importorskip("av", reason="needs the extra 'video'")
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")


def _may_mount() -> bool:
    """True where a process may have disks of its own."""
    own = ("unshare", "--mount", "--propagation", "private", *(() if os.geteuid() == 0 else ("--map-root-user",)))
    return shutil.which("unshare") is not None and subprocess.run([*own, "true"], check=False).returncode == 0


# Kills.


def kill_at(name: str, calls: int, work: Callable[[], object]) -> bool:
    """Do something in a child that is killed after so many calls of a function of `os`; False if it was not."""
    child = os.fork()
    if child == 0:
        gc.disable()  # garbage of other tests may hold threads, which a child has not
        real, count = getattr(os, name), [0]

        def call_or_die(*arguments: Any, **options: Any) -> Any:
            count[0] += 1
            if count[0] > calls:
                os._exit(9)
            return real(*arguments, **options)

        setattr(os, name, call_or_die)
        work()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9


@needs_fork
def test_sets_that_replace_others_have_all_their_files_whenever_the_program_is_killed(tmp_path: Path) -> None:
    one, other = random_frame(), random_frame()
    other.diffuse[0, 0] += 1
    write_separation(other, tmp_path / "new", "shot")
    new, killed = contents(tmp_path / "new"), 0
    for name in ("replace", "link", "rmdir"):
        for calls in range(4):
            folder = tmp_path / f"{name}{calls}"
            write_separation(one, folder, "shot")
            old = contents(folder)
            killed += kill_at(name, calls, lambda folder=folder: write_separation(other, folder, "shot", "exr", True))
            seen = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
            assert seen.keys() == old.keys()
            assert all(data in (old[file], new[file]) for file, data in seen.items())
            write_separation(other, folder, "shot", overwrite=True)
            assert {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()} == new
    assert killed >= 8


@needs_fork
@pytest.mark.parametrize("calls", range(3))
def test_a_calibration_is_the_old_or_the_new_one_whenever_the_program_is_killed(tmp_path: Path, calls: int) -> None:
    path, ones = tmp_path / "rig.json", tuple((1.0,) * 4 for _ in range(4))
    old, new = (
        Calibration(Layout(), 4095.0, (8, 8), gains=ones, gain_map=np.full((8, 8), gain, np.float32), falloff=((1.0,),))
        for gain in (1.0, 1.25)
    )
    write_calibration(path, old, "0")
    assert kill_at("replace", calls, lambda: write_calibration(path, new, "0"))
    assert np.array_equal(read_calibration(path).gain_map, (old, old, new)[calls].gain_map)
    write_calibration(path, new, "0")
    assert np.array_equal(read_calibration(path).gain_map, new.gain_map)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["rig.json", "rig.npz"]


def test_what_a_killed_program_left_is_removed_an_hour_later(tmp_path: Path) -> None:
    """But no file from before, and nothing of a program that writes now."""
    for name, age in (("now", 0.0), ("then", 2 * atomic.FORGOTTEN), ("kept", 2 * atomic.FORGOTTEN)):
        (tmp_path / f".polsep-{name}" / "new").mkdir(parents=True)
        (tmp_path / f".polsep-{name}" / "new" / "shot.exr").write_bytes(b"half")
        (old := tmp_path / f".polsep-{name}" / "old").mkdir()
        if name == "kept":
            (old / "shot.exr").write_bytes(b"mine")
        os.utime(old, (time.time() - age,) * 2)
    write_separation(random_frame(), tmp_path, "shot")
    left = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob(".polsep-*/*/*")}
    assert left == {".polsep-now/new/shot.exr", ".polsep-kept/old/shot.exr"}
    assert not (tmp_path / ".polsep-then").exists()


def test_killed_programs_go_on_to_the_same_bytes(tmp_path: Path) -> None:
    """The short form of the first half of `make faults`."""
    faults = pytest.importorskip("evaluation.faults")
    faults.make_inputs(tmp_path)
    counts = faults.kill(faults.WORKS["video"], 2, tmp_path, seed=3)
    assert {metric: counts[metric] for metric in faults.KILL_METRICS if metric in faults.FAULTS} == dict.fromkeys(
        ("partial files", "lost files", "failed resumptions", "other bytes"), 0
    )
    assert counts["kills"] == 2


# Full disks.


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("kind", [films.WATCHABLE, films.LOSSLESS["ffv1", 1]], ids=["mp4", "mkv"])
def test_films_on_a_full_disk_fail_and_can_be_closed_again(
    kind: films.FilmKind, capfd: pytest.CaptureFixture[str]
) -> None:
    """In silence; FFmpeg would end the process where it is asked to go on."""
    image = np.zeros((32, 48, 3), np.uint8) if kind is films.WATCHABLE else np.zeros((1, 32, 48), np.uint16)
    film = films.Film(Path("/dev/full"), kind, (32, 48), 25.0)
    film.write(image)
    for _ in range(3):
        with pytest.raises(OSError, match="No space left on device: '/dev/full'"):
            film.close()
    part = films.encode_film([np.zeros((32, 48, 3), np.uint8)] * 3, films.WATCHABLE, 25.0)
    assert capfd.readouterr() == ("", "")
    assert part


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_joining_films_on_a_full_disk_fails(tmp_path: Path) -> None:
    part = tmp_path / "part.mp4"
    part.write_bytes(films.encode_film([np.zeros((32, 48, 3), np.uint8)] * 3, films.WATCHABLE, 25.0))
    with pytest.raises(OSError, match="No space left on device"):
        films.join_films([part, part], Path("/dev/full"), films.WATCHABLE, 25.0)


@pytest.mark.skipif(not _may_mount(), reason="needs root or user namespaces to mount a disk")
def test_full_disks_end_in_one_line(tmp_path: Path) -> None:
    """The short form of the second half of `make faults`: two sizes that are too small, and one that is enough."""
    full_disk = pytest.importorskip("evaluation.full_disk")
    counts = full_disk.fill_elsewhere("video, preview alone", tmp_path / "disks", sizes=(0, 3, 500))
    assert (counts["disk sizes"], counts["refused"], counts["completed"]) == (3, 2, 1)
    assert not any(counts[metric] for metric in full_disk.DISK_METRICS[3:]), counts


# Rows, and playing in a loop.


def test_rows_of_one_command_leave_those_of_others(tmp_path: Path) -> None:
    """With what made them."""

    def row(bench: str, value: float) -> Row:
        return Row(f"reliability{bench}", "all", "faults", "kills", value, "")

    replace_rows(tmp_path, "reliability", [row("", 1)], "fuzz")
    replace_rows(tmp_path, "reliability", [row("/kills", 2), row("/disk", 3)], "faults")
    replace_rows(tmp_path, "reliability", [row("/kills", 4)], "later")
    found = [(entry["bench"], entry["value"], entry["command"]) for entry in read_rows(tmp_path / "reliability.jsonl")]
    expected = [("reliability", 1, "fuzz"), ("reliability/kills", 4, "later"), ("reliability/disk", 3, "faults")]
    assert found == expected
    with pytest.raises(ValueError, match="expected rows of reliability, found none"):
        replace_rows(tmp_path, "reliability", [], "nothing")


def test_a_recording_in_a_loop_takes_no_more_and_gives_the_same_bytes(tmp_path: Path) -> None:
    """The short form of `make soak`: three passes."""
    soak = pytest.importorskip("evaluation.soak")
    recording = tmp_path / "film.npy"
    np.save(recording, np.random.default_rng(0).integers(0, 4095, (3, 32, 48), np.uint16))
    played = soak.play(recording, soak.ReadOptions(white_level=4095.0), 600.0, tmp_path, "analytic")
    passes, files = zip(*(next(played) for _ in range(3)), strict=True)
    assert files[0] and files == (files[0],) * 3
    assert passes[0].descriptors == passes[2].descriptors and passes[0].threads == passes[2].threads
    rows = list(soak.soak_rows("film", passes, 0, 1.0))
    assert json.dumps([vars(row) for row in rows], allow_nan=False)
    assert soak.find_growth(rows) == []
    later = passes[0]._replace(memory=passes[0].memory + 1000, descriptors=passes[0].descriptors + 99)
    rows = list(soak.soak_rows("film", [passes[0]] * 20 + [later] * 20, 1, 1.0))
    assert soak.find_growth(rows) == ["memory", "descriptors", "bytes"]
