"""Rendered sets: seeds that no two splits share, views as promised, and the same bytes however the work was done.

`POLSEP_KILLS=20 pytest tests/test_dataset.py -k killed` kills twenty times instead of twice.
"""

from __future__ import annotations

import errno
import json
import math
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dying_worker import with_dying_worker

pytest.importorskip("embreex", reason="rendering needs the extra 'render'")

import polsep.io.results.dataset as files
from polsep import cli
from polsep.compute.threads import get_threads, set_threads
from polsep.datasets import rendered as dataset
from polsep.datasets.rendered import ENGINES, Job, RenderOptions, plan_jobs, render_dataset, render_job
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.raw.sequences import expand_folders, input_files
from polsep.io.results.dataset import (
    LAYERS,
    MANIFEST,
    UNFINISHED,
    find_finished,
    read_fingerprint,
    read_view,
    view_stem,
)
from polsep.io.store.atomic import OutputError
from polsep.physics.optics import dot
from polsep.render.raycast import MeshScene, find_hits
from polsep.render.simulate import Capture, filter_light
from polsep.render.views import (
    BLURS,
    FILLS,
    LARGEST_CLIPPED,
    LARGEST_ELEVATION,
    LARGEST_PHASE,
    LIGHT_DISTANCES,
    MIN_LEVEL,
    MIN_LIT,
    SPLITS,
    UNCLIPPED_SHARE,
    capture_shot,
    lit_share,
    random_camera,
    random_clip,
    random_light,
    random_shot,
    scene_seed,
    seeded_shape,
)
from polsep.sensor.camera import IMX250, Layout

KILLS = int(os.environ.get("POLSEP_KILLS", "2"))
SHAPES, VIEWS = 6, 2 * max(1, KILLS)
SMALL = RenderOptions(2, 2, 32, samples=1)
PROGRAM = (sys.executable, "-c", "from polsep.cli import main; main()")


@pytest.fixture(scope="module")
def shape() -> MeshScene:
    return seeded_shape("train", 3, 1)


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> Generator[None, None, None]:
    """The local engine without processes."""

    def run(jobs: Sequence[Job], workers: int) -> Generator[int, None, None]:
        yield from map(render_job, jobs)

    monkeypatch.setitem(ENGINES, "local", run)
    threads = torch.get_num_threads(), get_threads()
    yield
    torch.set_num_threads(threads[0])
    set_threads(threads[1])


def finish(options: RenderOptions, directory: Path) -> list[int]:
    return list(render_dataset(options, directory, 1))


def contents(directory: Path) -> dict[str, bytes]:
    """Every file below a directory, hidden ones too."""
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def begin(directory: Path, *more: str, program: Sequence[str] = PROGRAM) -> subprocess.Popen[str]:
    """`polsep render` of a small set, in a process group of its own."""
    options = {"shapes": SHAPES, "views": VIEWS, "size": 64, "seed": 4, "samples": 1, "output": directory}
    command = [*program, "render"]
    command += [text for name, value in options.items() for text in (f"--{name}", str(value))]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([*command, *more], start_new_session=True, **pipes)


def count_records(directory: Path) -> int:
    """How many views of a set are there."""
    return len(list(directory.glob("shape*.json")))


def wait_for_records(directory: Path, count: int, run: subprocess.Popen[str]) -> None:
    """Until so many views are there, or the run is over."""
    while count_records(directory) < count and run.poll() is None:
        time.sleep(0.02)


def is_group_gone(group: int) -> bool:
    """Whether no process of a group is left within half a minute."""
    for _ in range(300):
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The set of `begin`, by one worker."""
    directory = tmp_path_factory.mktemp("sets") / "undisturbed"
    out, err = (run := begin(directory, "--workers", "1")).communicate(timeout=300)
    beside = [line for line in err.splitlines() if not line.startswith("polsep: rendering")]  # progress, if slow
    assert (run.returncode, beside) == (0, [])
    assert out == f"{directory}: {SHAPES * VIEWS} views, manifest sha256 {read_fingerprint(directory)}\n"
    return directory


def test_splits_share_no_seed() -> None:
    """By construction: the two highest of the 32 bits that torch's generator takes are the split's."""
    seeds = {
        split: {
            scene_seed(split, seed, shape, view) for seed in (0, 7) for shape in range(500) for view in (None, 0, 9)
        }
        for split in SPLITS
    }
    assert len(set.union(*seeds.values())) == sum(map(len, seeds.values())) > 8990
    for place, split in enumerate(SPLITS):
        assert {seed >> 30 for seed in seeds[split]} == {place}
    with pytest.raises(ValueError, match="expected a split of train, validation, test, found 'dev'"):
        scene_seed("dev", 0, 0)


def test_cameras_frame_the_shape(shape: MeshScene) -> None:
    """All of it is inside the frame and reaches as far as `FILLS` says; cameras are on all sides, never overhead."""
    generator = torch.Generator().manual_seed(0)
    directions = []
    for _ in range(60):
        camera = random_camera(shape.mesh.vertices, generator)
        back = np.array(camera.position) - np.array(camera.target)
        back /= np.linalg.norm(back)
        right = np.cross([0, 1, 0], back)
        right /= np.linalg.norm(right)
        seen = shape.mesh.vertices - np.array(camera.position)
        half = -(seen @ back) * math.tan(math.radians(camera.fov_deg) / 2)
        reach = max(np.abs(seen @ axis / half).max() for axis in (right, np.cross(back, right)))
        assert FILLS[0] - 1e-4 < reach < FILLS[1] + 1e-4
        assert abs(back[1]) <= math.sin(LARGEST_ELEVATION) + 1e-5
        directions.append(back)
    assert np.all(np.abs(np.mean(directions, axis=0)) < 0.3)
    assert np.all(np.ptp(directions, axis=0) > 1.5)


def test_lights_are_near_the_camera(shape: MeshScene) -> None:
    """Within the cone, at the distances promised, of irradiance 1 at the origin, at polarizer angles of all kinds."""
    generator = torch.Generator().manual_seed(0)
    camera = random_camera(shape.mesh.vertices, generator)
    away = np.array(camera.position) - np.array(camera.target)
    angles = []
    for _ in range(200):
        light = random_light(camera, 2.0, generator)
        distance = np.linalg.norm(light.position)
        cosine = np.dot(light.position, away) / distance / np.linalg.norm(away)
        assert cosine >= math.cos(LARGEST_PHASE) - 1e-5
        assert 2 * LIGHT_DISTANCES[0] - 1e-4 <= distance <= 2 * LIGHT_DISTANCES[1] + 1e-4
        assert light.intensity / distance**2 == pytest.approx(1, rel=1e-5)
        angles.append(light.polarizer)
    assert abs(np.mean(np.exp(2j * np.array(angles)))) < 4 / math.sqrt(200)


def test_a_third_of_the_views_clips_nothing() -> None:
    """And the others at most a twentieth of the object."""
    generator = torch.Generator().manual_seed(0)
    shares = np.array([random_clip(generator) for _ in range(2000)])
    assert abs(np.mean(shares == 0) - UNCLIPPED_SHARE) < 4 * math.sqrt(2 / 9 / 2000)
    assert np.mean(shares[shares > 0]) == pytest.approx(LARGEST_CLIPPED / 2, rel=0.1)
    assert shares.max() <= LARGEST_CLIPPED


def take(shape: MeshScene, seed: int) -> tuple[Capture, Any]:
    generator = torch.Generator().manual_seed(seed)
    shot = random_shot(shape, generator)
    return capture_shot(shape, shot, 64, 2, generator), shot


def test_captures_do_not_depend_on_threads(shape: MeshScene) -> None:
    """Bit for bit the same with one and with three threads of torch and of the kernels."""
    before, found = (torch.get_num_threads(), get_threads()), []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        set_threads(threads)
        found.append(take(shape, 11)[0])
    torch.set_num_threads(before[0])
    set_threads(before[1])
    one, three = found
    assert torch.equal(one.mosaic.data, three.mosaic.data)
    for lobe in ("diffuse", "specular"):
        for name in ("s0", "s1", "s2"):
            assert torch.equal(getattr(getattr(one.scene, lobe), name), getattr(getattr(three.scene, lobe), name))


def test_captures_are_lit_exposed_and_framed(shape: MeshScene) -> None:
    """Enough is lit, the asked share of samples is above white before noise, and the mask is where rays hit."""
    for seed in range(4):
        found, shot = take(shape, seed)
        scene = found.scene
        assert lit_share(shape, shot) >= MIN_LIT
        assert BLURS[0] <= shot.blur <= BLURS[1]
        signal = filter_light(scene.diffuse + scene.specular, Layout(), IMX250)[scene.mask]
        assert int((signal > 1).sum()) >= shot.clip * signal.numel() - 1
        if float(signal[signal > 0].median()) > 1.01 * MIN_LEVEL:
            assert int((signal > 1).sum()) <= shot.clip * signal.numel() + 1
        rows, cols = torch.meshgrid(torch.arange(64) + 0.5, torch.arange(64) + 0.5, indexing="ij")
        hits = find_hits(shape, shot.camera, (rows.flatten(), cols.flatten()), (64, 64))
        centres = torch.zeros(64 * 64, dtype=torch.bool)
        centres[hits.ray] = True
        assert bool(centres[scene.mask.flatten()].all())
        assert int(scene.mask.sum()) > 0.5 * int(centres.sum())
        toward = torch.tensor(shot.camera.position).view(3, 1, 1) - hits.position
        assert bool((dot(hits.normal, toward) > 0).all())


@pytest.mark.parametrize("format", ["exr", "npz"])
@pytest.mark.usefixtures("inline")
def test_files_hold_the_capture(format: str, tmp_path: Path) -> None:
    """What is read is what was rendered: codes exactly, truth in half floats, numbers that make the view again."""
    options = RenderOptions(1, 2, 32, 5, "validation", 1, format)
    assert finish(options, tmp_path) == [0, 2]
    shape = seeded_shape("validation", 5, 0)
    generator = torch.Generator().manual_seed(scene_seed("validation", 5, 0, 1))
    shot = random_shot(shape, generator)
    expected = capture_shot(shape, shot, 32, 1, generator)
    found = read_view(tmp_path, view_stem(0, 1))
    assert found["mosaic"].dtype == np.uint16
    np.testing.assert_array_equal(found["mosaic"], expected.mosaic.data.numpy())
    np.testing.assert_array_equal(found["mask"], expected.scene.mask.numpy())
    light = expected.scene.diffuse + expected.scene.specular
    truth = (expected.scene.diffuse.s0, expected.scene.specular.s0, light.s1, light.s2)
    for layer, exact in zip(LAYERS, truth, strict=True):
        assert found[layer].dtype == np.float16
        np.testing.assert_allclose(found[layer], exact.permute(1, 2, 0), rtol=2**-11, atol=2**-25)
    record = json.loads((tmp_path / f"{view_stem(0, 1)}.json").read_text())
    assert record["view_seed"] == scene_seed("validation", 5, 0, 1)
    assert tuple(record["camera"]["position"]) == shot.camera.position
    assert record["light"]["polarizer_deg"] == pytest.approx(math.degrees(shot.light.polarizer), abs=1e-6)
    (frame,) = read_frames(tmp_path / f"{view_stem(0, 1)}.png", ReadOptions(white_level=record["white_level"]))
    assert np.array_equal(frame.data.linear(), expected.mosaic.linear())
    views = [str(tmp_path / f"{stem}.png") for stem in options.stems]  # no truth and no contact sheet
    assert expand_folders([str(tmp_path)]) == views == [str(path) for path in input_files(tmp_path)]


@pytest.mark.usefixtures("inline")
def test_the_manifest_lists_every_file(tmp_path: Path) -> None:
    """In order of the views, with the sizes and hashes that the files have."""
    finish(SMALL, tmp_path)
    head, *lines = map(json.loads, (tmp_path / MANIFEST).read_text().splitlines())
    assert head["options"]["size"] == 32
    assert [line["view"] for line in lines] == SMALL.stems
    listed = {entry["name"]: entry for line in lines for entry in line["files"]}
    assert sorted([*listed, MANIFEST, "options.json", "contact.png"]) == sorted(contents(tmp_path))
    for name, entry in listed.items():
        assert entry == files._entry(name, (tmp_path / name).read_bytes())


@pytest.mark.usefixtures("inline")
def test_torn_and_missing_files_are_rendered_again(tmp_path: Path) -> None:
    """Whatever is lost or cut short of a finished set comes back the same, and nothing else is touched."""
    finish(SMALL, tmp_path)
    before = contents(tmp_path)
    first, second, third, fourth = SMALL.stems
    (tmp_path / f"{first}.exr").write_bytes(before[f"{first}.exr"][:-7])
    (tmp_path / f"{second}.json").write_bytes(b"")
    (tmp_path / f"{third}.png").unlink()
    (tmp_path / MANIFEST).unlink()
    (tmp_path / UNFINISHED / "left").mkdir(parents=True)
    assert find_finished(tmp_path, SMALL.stems) == {fourth}
    kept = (tmp_path / f"{fourth}.exr").stat().st_ino
    assert finish(SMALL, tmp_path)[0] == 1
    assert contents(tmp_path) == before
    assert (tmp_path / f"{fourth}.exr").stat().st_ino == kept
    assert not (tmp_path / UNFINISHED).exists()
    assert finish(SMALL, tmp_path) == [4]


@pytest.mark.usefixtures("inline")
def test_a_full_disk_leaves_what_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error comes out as it is, no view is torn, and the run goes on once there is room."""
    finish(SMALL, tmp_path / "expected")
    write, room = files.write_checked, [8]

    def write_until_full(path: Path, data: bytes) -> None:
        room[0] -= 1
        if room[0] < 0:
            path.write_bytes(data[:100])
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, data)

    monkeypatch.setattr(files, "write_checked", write_until_full)
    with pytest.raises(OSError, match="No space left on device"):
        finish(SMALL, tmp_path / "set")
    assert len(find_finished(tmp_path / "set", SMALL.stems)) == 2
    assert len(contents(tmp_path / "set")) == 1 + 2 * 3
    room[0] = 1000
    finish(SMALL, tmp_path / "set")
    assert contents(tmp_path / "set") == contents(tmp_path / "expected")


@pytest.mark.usefixtures("inline")
def test_other_options_and_other_directories_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A set is never mixed with another one, one of another version, or with somebody's files."""
    finish(SMALL, tmp_path)
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=r"expected seed 0, with which the set in .* was begun, found seed 1"):
        finish(RenderOptions(2, 2, 32, 1, samples=1), tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(dataset, "MAKERS", ("torch",))
        with pytest.raises(OutputError, match="expected versions"):
            finish(SMALL, tmp_path)
    assert contents(tmp_path) == before
    (tmp_path / "options.json").unlink()
    with pytest.raises(OutputError, match=r"expected .* empty, new, or a set begun before, found 'contact.png' in it"):
        finish(SMALL, tmp_path)
    with pytest.raises(OutputError, match="expected a directory to write into, found a file"):
        finish(SMALL, tmp_path / "contact.png")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"shapes": 0}, "expected shapes from 1 to 99999, found 0"),
        ({"views": -1}, "expected views from 1"),
        ({"size": 30}, "a multiple of 4, found 30"),
        ({"size": 8}, "expected a size from 32"),
        ({"seed": -1}, "expected seed from 0"),
        ({"split": "dev"}, "expected a split of train, validation, test, found 'dev'"),
        ({"samples": 0}, "expected samples from 1"),
        ({"format": "png"}, "expected a format of exr, npz, found 'png'"),
    ],
)
def test_options_are_checked(wrong: dict[str, Any], message: str) -> None:
    """One line that says what was expected and what was found."""
    with pytest.raises(ValueError, match=message):
        RenderOptions(**{"shapes": 1, "views": 1, **wrong})


def test_runs_are_checked(tmp_path: Path) -> None:
    """An unknown engine and no workers are refused before anything is written."""
    with pytest.raises(ValueError, match="expected an engine of local, ray, found 'fog'"):
        next(render_dataset(SMALL, tmp_path / "set", 1, "fog"))
    with pytest.raises(ValueError, match="expected 1 worker or more, found 0"):
        next(render_dataset(SMALL, tmp_path / "set", 0))
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(("package", "extra"), [("embreex", "render"), ("ray", "ray")])
def test_missing_extras_are_named(
    package: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line that says what to install."""
    monkeypatch.setitem(sys.modules, package, None)
    options = ["--shapes", "1", "--views", "1", "-o", str(tmp_path / "set"), "--engine", "ray"]
    monkeypatch.setattr(sys, "argv", ["polsep", "render", *options])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    assert stop.value.code == 2
    expected = f"polsep: error: expected the extra '{extra}' (pip install 'polsep[{extra}]'), found no {package}\n"
    assert capsys.readouterr() == ("", expected)


def test_jobs_are_what_is_missing() -> None:
    """Each view once, of one shape per job."""
    options = RenderOptions(3, 11, 32)
    jobs = plan_jobs(options, Path("set"), {view_stem(1, view) for view in range(10)})
    wanted = {(0, view) for view in range(11)} | {(1, 10)} | {(2, view) for view in range(11)}
    assert sorted((job.shape, view) for job in jobs for view in job.views) == sorted(wanted)


def test_killed_runs_go_on_to_the_same_bytes(undisturbed: Path, tmp_path: Path) -> None:
    """Kill -9 of the program, alone or with its workers, at random moments, at last over the manifest."""
    moments, directory, killed = random.Random(0), tmp_path / "set", 0
    for left in reversed(range(KILLS)):
        with begin(directory, "--workers", "2") as run:
            more = moments.randrange(8)
            wait_for_records(directory, count_records(directory) + more if left else SHAPES * VIEWS, run)
            time.sleep(moments.uniform(0, 0.3 if left else 0.05))
            kill = moments.choice((os.kill, os.killpg))
            if run.poll() is None:
                kill(run.pid, signal.SIGKILL)
                killed += 1
        assert is_group_gone(run.pid)
    assert killed > KILLS / 3
    run = begin(directory, "--workers", "2")
    said = run.communicate(timeout=300)[1]
    assert re.fullmatch(rf"(polsep: resuming: \d+ of {SHAPES * VIEWS} views are there from before\n)?", said)
    assert contents(directory) == contents(undisturbed)
    assert not (directory / UNFINISHED).exists()


def test_stopping_is_clean(undisturbed: Path, tmp_path: Path) -> None:
    """Ctrl-C ends the program and its workers at once, with one line, and leaves whole views only."""
    directory = tmp_path / "set"
    run = begin(directory, "--workers", "2")
    wait_for_records(directory, 1, run)
    os.killpg(run.pid, signal.SIGINT)
    out, err = run.communicate(timeout=60)
    assert (run.returncode, out, err.strip()) == (130, "", "polsep: stopped")
    assert is_group_gone(run.pid)
    left, expected = contents(directory), contents(undisturbed)
    assert 1 < len(left) < len(expected)
    assert all(expected[name] == data for name, data in left.items())


def test_ray_makes_the_same_bytes_with_a_worker_killed(undisturbed: Path, tmp_path: Path) -> None:
    """The cluster of one machine loses a worker in the middle of its work."""
    pytest.importorskip("ray", reason="needs the extra 'ray'")
    directory, died = tmp_path / "set", tmp_path / "died"
    run = begin(directory, "--workers", "2", "--engine", "ray", program=with_dying_worker(render_job, died))
    _, err = run.communicate(timeout=300)
    assert run.returncode == 0 and died.exists(), err
    assert contents(directory) == contents(undisturbed)
