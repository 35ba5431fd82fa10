"""Exposures merged by the inverse of their variance: unbiased, less noise, clipping resolved, nothing to type after."""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch
from numpy.typing import NDArray
from test_cli import Cli
from test_cli import polsep as run_polsep  # noqa: F401

import polsep
from polsep.calibrate.exposures import merge_exposures
from polsep.io.raw.corrections import with_corrections
from polsep.io.raw.frames import ReadOptions, read_frames
from polsep.io.raw.tiff import write_merged
from polsep.io.store.calibrations import write_calibration
from polsep.io.store.errors import InputError
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Layout, Mosaic

SIZE = (128, 128)
WHITE, BLACK, WELL, READ = 4095.0, 64.0, 10_500.0, 2.4


def light(seed: int = 0) -> NDArray[np.float64]:
    """A smooth scene in which the brightest part is twenty times above the darkest."""
    rng = np.random.default_rng(seed)
    rows, cols = np.meshgrid(*(np.linspace(0, 1, n) for n in SIZE), indexing="ij")
    tint = rng.uniform(0.5, 1, (4, 4))[np.ix_(*(np.arange(n) % 4 for n in SIZE))]
    return np.asarray(0.03 * 30**rows * (0.8 + 0.2 * cols) * tint)


def expose(scene: NDArray[np.float64], time: float, seed: int) -> Mosaic:
    """One frame of 12 bits."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(scene * time * WELL) + rng.normal(0, READ, SIZE)
    codes = np.clip(np.round(electrons / WELL * (WHITE - BLACK) + BLACK), 0, WHITE)
    return Mosaic(torch.from_numpy(codes.astype(np.float32)), Layout(), BLACK, WHITE)


def test_one_frame_stays_itself() -> None:
    """Merging a single frame returns its samples, in units of the white level, to the bit."""
    frame = expose(light(), 2.0, 1)
    for color in ((1.0, 1.0, 1.0), (0.5, 1.0, 0.25)):  # of a calibrated lamp, which is divided out once
        lit = replace(frame, light_color=color)
        merged = merge_exposures([lit]).mosaic
        assert torch.equal(merged.linear(), lit.linear()) and torch.equal(merged.clipped(), lit.clipped())


def test_equal_exposures_average() -> None:
    """k frames of one time have 1 / sqrt(k) of the noise of one."""
    scene = light() * 0.8
    for count in (4, 9):
        merged = merge_exposures([expose(scene, 1.0, seed) for seed in range(count)], [5.0] * count).mosaic
        single = (expose(scene, 1.0, 99).linear().numpy() - scene).std()
        assert (merged.linear().numpy() - scene).std() == pytest.approx(single / count**0.5, rel=0.05)


def test_weights_are_the_inverse_of_the_variance() -> None:
    """Of two exposures, 1 and 3, the merged noise is the least that weights can give: photons of both, as counted."""
    scene = light() * 0.3
    error = [merge_exposures([expose(scene, t, 2 * seed + t) for t in (1, 3)], [1, 3]).mosaic for seed in range(4)]
    deviation = np.std([merged.linear().numpy() - scene for merged in error])
    variance = [scene / (time * WELL) + (READ / WELL / time) ** 2 for time in (1, 3)]
    best = np.sqrt(np.mean(1 / (1 / variance[0] + 1 / variance[1])))
    assert deviation == pytest.approx(best, rel=0.03)


@pytest.mark.parametrize("times", [None, [1.0, 4.0, 16.0], [0.25, 1.0, 4.0]])
def test_exposures_extend_the_range(times: list[float] | None) -> None:
    """Three exposures, in any order: nothing is biased, dark parts lose noise as photons add up, only what clips in the
    shortest one is clipped; times are found within 1 % where none are said."""
    scene = light()
    scene[100:110, 40:60] = 1.4
    frames = [expose(scene, time, seed) for seed, time in enumerate((1.0, 4.0, 16.0))]
    found = merge_exposures(frames, times)
    again = merge_exposures(frames[::-1], None if times is None else times[::-1])
    torch.testing.assert_close(again.mosaic.data, found.mosaic.data, rtol=1e-5, atol=1e-6)
    assert found.notes == ()
    np.testing.assert_allclose(np.array(found.times) / found.times[0], [1, 4, 16], rtol=0.01)
    merged = found.mosaic.linear().numpy()
    assert np.array_equal(found.mosaic.clipped().numpy(), frames[0].clipped().numpy())
    unclipped = scene < 0.95
    error = merged / scene - 1
    dark = unclipped & (scene < 0.04)
    assert abs(error[unclipped].mean()) < 0.004
    for low in (0.05, 0.2, 0.23, 0.5, 0.8):
        some = unclipped & (scene > low) & (scene < 1.2 * low)
        assert abs(error[some].mean()) < 0.01
    shortest = (frames[0].linear().numpy() / scene - 1)[dark].std()
    assert error[dark].std() < 1.15 * shortest / (1 + 4 + 16) ** 0.5


def test_what_does_not_fit_is_said() -> None:
    """Wrong times, a scene that moved, other sizes and frames that share nothing are a line each."""
    scene = light()
    short, long = expose(scene, 1.0, 1), expose(scene, 4.0, 2)
    (note,) = merge_exposures([short, long], [1.0, 3.0]).notes
    assert note.startswith("exposure times of 1:3 were stated, the frames' brightness says 1:")
    moved = replace(long, data=torch.cat([long.data[:32].flip(0), long.data[32:]]))
    assert any("did the scene move" in note for note in merge_exposures([short, moved], [1.0, 4.0]).notes)
    for frames, times, expected in (
        ([], None, "at least one frame to merge, found none"),
        ([short, long], [1.0], "expected 2 positive exposure times"),
        ([short, long], [4.0, 1.0], "found 1 for frame 2 and 4 for frame 1, which is darker"),
        ([short, replace(long, data=long.data[:64])], None, "expected frames of one size and layout"),
        ([short, replace(long, data=torch.full(SIZE, WHITE))], None, "say --times"),
        ([expose(scene, 1e-3, 3), long], None, "say --times"),  # hardly an electron: no ratio to find
    ):
        with pytest.raises(ValueError, match=expected):
            merge_exposures(frames, times)


def test_times_are_found_in_any_order_before_a_black_background() -> None:
    """Most samples are black in every exposure: their median says nothing of the times."""
    scene = light()
    scene[:, :96] = 0
    for times in permutations((1.0, 4.0, 16.0)):
        found = merge_exposures([expose(scene, time, seed) for seed, time in enumerate(times)]).times
        np.testing.assert_allclose(np.array(found) / min(found), times, rtol=0.02)


def test_the_command_leaves_nothing_to_type(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """The merged file says its levels and layout; times are read from TIFF files; bad input is one line, exit 2."""
    scene = light()
    files = []
    for seed, time in enumerate((1, 4)):
        files.append(tmp_path / f"shot{time}.tiff")
        codes = expose(scene, time, seed).data.numpy().astype(np.uint16)
        tags = [(33434, "2I", 1, (time, 100), True)]
        tifffile.imwrite(files[-1], codes, photometric="minisblack", metadata=None, extratags=tags)
    levels = ("--white-level", WHITE, "--black-level", BLACK, "--layout", "0,45,90,135/RGGB")
    out = tmp_path / "merged.tiff"
    forgotten = run_polsep("merge", *files, "-o", out)
    assert forgotten.status == 2 and "expected a white level" in forgotten.err and not out.exists()
    done = run_polsep("merge", *files, *levels, "-o", out)
    assert done.status == 0 and "exposure times 0.01, 0.04 (of the files)" in done.out and done.out.count("\n") == 1
    (frame,) = read_frames(out, ReadOptions())
    assert isinstance(frame.data, Mosaic) and frame.notes == ()
    assert (frame.data.layout.spec, frame.data.black_level, frame.data.white_level) == ("0,45,90,135/RGGB", 0.0, 1.0)
    assert float(np.abs(frame.data.linear() - scene).mean()) < 0.01
    assert run_polsep("separate", out, "--method", "analytic", "-o", tmp_path / "out").status == 0
    for arguments, expected in (
        (("merge", *files, "-o", out), "--overwrite replaces it"),
        (("merge", *files, "-o", tmp_path / "a.png"), "expected an output that ends in .tiff"),
        (("merge", *files, "-o", tmp_path / "a.tiff", "--times", "1,x"), "expected --times T,T,..."),
        (
            ("merge", *files, *levels, "-o", tmp_path / "a.tiff", "--times", "1,2,3"),
            "expected 2 positive exposure times",
        ),
        (("merge", tmp_path / "none.tiff", "-o", tmp_path / "a.tiff"), "expected a file, found nothing"),
        (("merge", *files, files[0], "-o", tmp_path / "a.tiff"), f"of different exposures, found {files[0]} again"),
    ):
        failed = run_polsep(*arguments)
        assert failed.status == 2 and failed.err.count("\n") == 1 and expected in failed.err, failed
    assert not (tmp_path / "a.tiff").exists()


def test_frames_that_do_not_belong_together_are_noted(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """A frame of a mono sensor among colour ones, which no PNG file says, and times that only some TIFF files say."""
    samples = Path(polsep.__file__).parent / "data" / "samples"
    levels = ("--white-level", 4095, "--black-level", 0)
    mixed = run_polsep("merge", samples / "color.png", samples / "mono.png", *levels, "-o", tmp_path / "a.tiff")
    assert mixed.status == 0 and "polsep: mono: the frame shows no colour pattern" in mixed.err
    codes = [expose(light(), time, time).data.numpy().astype(np.uint16) for time in (1, 4)]
    tags = [(33434, "2I", 1, (1, 100), True)]
    files = [tmp_path / "shot1.tiff", tmp_path / "shot4.tiff"]
    tifffile.imwrite(files[0], codes[0], photometric="minisblack", metadata=None, extratags=tags)
    tifffile.imwrite(files[1], codes[1], photometric="minisblack", metadata=None)
    some = run_polsep("merge", *files, "--white-level", WHITE, "--black-level", BLACK, "-o", tmp_path / "b.tiff")
    assert some.status == 0 and "1 of 2 frames say their exposure time: all are found in the frames" in some.err


def test_a_folder_stands_for_its_frames(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """A folder merges as its files do, whatever levels are said, and is not written into as one of its own frames."""
    folder = tmp_path / "shots"
    folder.mkdir()
    for seed, time in enumerate((1, 4)):
        codes = expose(light(), time, seed).data.numpy().astype(np.uint16)
        tifffile.imwrite(folder / f"shot{time}.tiff", codes, photometric="minisblack", metadata=None)
    levels = ("--white-level", WHITE, "--black-level", BLACK)
    for out, frames in ((tmp_path / "a.tiff", [folder]), (tmp_path / "b.tiff", sorted(folder.iterdir()))):
        assert run_polsep("merge", *frames, *levels, "-o", out).status == 0
    assert (tmp_path / "a.tiff").read_bytes() == (tmp_path / "b.tiff").read_bytes()
    failed = run_polsep("merge", folder, *levels, "-o", folder / "shot4.tiff", "--overwrite")
    assert failed.status == 2 and "is an input" in failed.err


def test_four_pages_are_four_frames(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Two exposures taken twice obey m0 + m90 = m45 + m135, and are no four angles for that."""
    codes = [expose(light(), time, seed).data.numpy().astype(np.uint16) for seed, time in enumerate((1, 1, 4, 4))]
    tifffile.imwrite(tmp_path / "stack.tiff", np.stack(codes), photometric="minisblack", metadata=None)
    levels = ("--white-level", WHITE, "--black-level", BLACK, "--layout", "color")
    done = run_polsep("merge", tmp_path / "stack.tiff", *levels, "-o", tmp_path / "merged.tiff")
    assert done.status == 0 and done.out.startswith("4 frames, exposure times 1, 1")
    (frame,) = read_frames(tmp_path / "merged.tiff")
    assert frame.data.data.shape == SIZE


def test_merged_frames_among_raw_ones(tmp_path: Path, run_polsep: Cli) -> None:  # noqa: F811
    """Levels and the calibration of raw frames change nothing in a merged one, and a note says so; another calibration,
    or one for a frame that was merged without, is a line."""
    files, rig, other = [], tmp_path / "rig.json", tmp_path / "other.json"
    for seed, time in enumerate((1, 4)):
        files.append(tmp_path / f"shot{time}.tiff")
        tifffile.imwrite(files[-1], expose(light(), time, seed).data.numpy().astype(np.uint16))
    gains = tuple(tuple(1 + 0.02 * ((r + c) % 2) for c in range(4)) for r in range(4))
    write_calibration(rig, Calibration(Layout(), WHITE, SIZE, BLACK, gains=gains), "0")
    write_calibration(other, Calibration(Layout(), WHITE, SIZE, BLACK), "0")
    plain, merged = tmp_path / "plain.tiff", tmp_path / "merged.tiff"
    levels = ("--white-level", WHITE, "--black-level", BLACK)
    assert run_polsep("merge", *files, *levels, "-o", plain).status == 0
    assert run_polsep("merge", *files, "--calibration", rig, "-o", merged).status == 0
    (wanted,) = read_frames(merged)
    raw = ReadOptions(black_level=BLACK, white_level=WHITE)
    for options in (raw, with_corrections(ReadOptions(), rig), with_corrections(raw, rig)):
        (frame,) = read_frames(merged, options)
        assert isinstance(frame.data, Mosaic) and isinstance(wanted.data, Mosaic)
        np.testing.assert_array_equal(frame.data.data, wanted.data.data)
        assert (frame.data.black_level, frame.data.white_level, frame.white_level) == (0, 1, 1)
        said = ["levels stated are those of raw frames"] * (options.white_level is not None)
        said += ["the merged frame is calibrated by rig.json already"] * (options.corrections is not None)
        assert [any(note.startswith(start) for note in frame.notes) for start in said] == [True] * len(frame.notes)
    for path, calibration, expected in (
        (merged, other, "expected rig.json, by which the merged frame is calibrated already, found another"),
        (plain, rig, "expected --calibration with 'polsep merge', found it with a frame that was merged without"),
    ):
        with pytest.raises(InputError, match=expected):
            next(read_frames(path, with_corrections(ReadOptions(), calibration)))


@pytest.mark.skipif(sys.platform == "win32", reason="file size limits are POSIX")
def test_a_disk_that_is_full_is_named(tmp_path: Path) -> None:
    """With the file, as of every output; "16384 requested and 3840 written" was all that was said."""
    import resource

    path, before = tmp_path / "merged.tiff", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(OSError, match=r"File too large: .*merged\.tiff"):
            write_merged(path, Mosaic(torch.rand(64, 64), Layout(), 0, 1), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
