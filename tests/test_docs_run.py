"""What the documentation tells people to type runs as it is written: every command and every block of Python.

Commands run in a folder with the files that they name. Small frames stand for people's own, and the quickest method for
the best one: tests of methods are elsewhere. What cannot run here is listed, with the reason.
"""

from __future__ import annotations

import glob
import os
import re
import shlex
import shutil
import sys
import warnings
from pathlib import Path

import imagecodecs
import numpy as np
import pytest

import polsep
from polsep import methods
from polsep.cli import app
from polsep.io.raw.genicam import pack_frame
from polsep.sensor.camera import Layout
from tests.test_cli import frame, png
from tests.test_docs import PAGES, ROOT, blocks, commands

#: Commands that do not run here, by how they begin, and why.
LEFT_OUT = {
    "make": "sets up an environment, or tests the whole",
    "python -m evaluation": "takes minutes to hours, and data that cannot ship",
    "python -m zipfile": "packs the add-on of Blender; tests/test_places.py runs it",
    "python examples/polsep_": "need cameras, GStreamer and ROS; tests/test_places.py",
    "polsep bench": "takes minutes to hours",
    "polsep train": "takes hours",
    "polsep render": "renders for hours; tests/test_dataset.py runs it small",
    "polsep view": "serves until it is stopped; tests/test_view_server.py",
    "polsep doctor": "tries every method; tests/test_doctor.py",
    "polsep capture -o": "needs a camera; tests/test_capture_cameras.py",
    "polsep calibrate (flat|analysers|light)": "needs pictures of a rig; tests/test_calibration.py",
    "polsep geometry": "needs six lights on one object; tests/test_geometry_files.py",
    "polsep shape": "needs the extra mesh and one object in a frame; tests/test_one_frame.py",
    "polsep material": "needs the extra torch and flash frames of one sample; tests/test_material.py",
    "polsep separate --(parallel|crossed|angles)": "needs photographs through a filter; tests/test_photographs.py",
    "polsep video run.mkv": "needs the extra video; tests/test_video.py",
}
#: Commands that the documentation shows to fail, and what they say.
FAILS = {"polsep separate polsep/data/still_life.png -o out": "found that values never exceed 4095"}
#: Pages whose Python does not run here, and why. tests/test_docs.py runs those of extending and python.
NO_PYTHON = {
    "export": "needs an exported graph; tests/test_export.py",
    "extending": "tests/test_docs.py",
    "python": "tests/test_docs.py",
    "geometry": "needs six lights on one object; tests/test_geometry.py",
    "shape": "needs one object in a frame; tests/test_one_frame.py",
    "testsets": "needs data that cannot ship; tests/test_testsets.py",
}


def reason(line: str) -> str | None:
    """The reason why a command does not run here; None if it does."""
    return next((why for begin, why in LEFT_OUT.items() if re.match(begin, line)), None)


LINES = [(page, shlex.join(words)) for page in PAGES for words in commands(page)]
RUN = list(dict.fromkeys(line for _, line in LINES if reason(line) is None))
SCRIPTS = [page for page in PAGES if blocks(page, "python") and page.stem not in NO_PYTHON]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The formula is the method that is chosen where none is named."""
    for name in ("auto", "auto-fast"):
        monkeypatch.setitem(methods._CHOICES, name, (methods.METHODS["analytic"],))


def write_frames(folder: Path) -> None:
    """The files that commands of the documentation read, but for results of others."""
    codes = frame(size=64)
    eight, twelve = (codes >> 8).astype(np.uint8), (codes >> 4).astype(np.uint16)
    for name in ("shot", "crop", "mono", "lamp_off"):
        png(folder / f"{name}.png", eight // 16 if name == "lamp_off" else eight)
    (folder / "shot.tiff").write_bytes(imagecodecs.tiff_encode(twelve))
    for name, gain in (("short", 0.25), ("middle", 0.5), ("long", 1)):
        png(folder / f"{name}.png", np.minimum(eight * gain, 255).astype(np.uint8))
    for name in ("shots", "frames", "train"):
        (folder / name).mkdir()
        for k in range(2):
            png(folder / name / f"f{k}.png", twelve if name == "train" else eight)
    shutil.move(folder / "train" / "f0.png", folder / "train" / "shape00012_view03.png")
    for k, angle in enumerate((90, 45, 0, 135)):
        png(folder / f"shot_{angle}.png", np.ascontiguousarray(eight[k // 2 :: 2, k % 2 :: 2]))
    dark = np.random.default_rng(0)
    for k in range(10):
        png(folder / f"cap_{k}.png", dark.normal(64, 2, (64, 64)).round().astype(np.uint16))
    large = np.tile(twelve, (32, 39))[:2048, :2448]
    for name in ("dump", "run", "film", "lamp_off"):
        (folder / f"{name}.raw").write_bytes(pack_frame(large // 16 if name == "lamp_off" else large, "BayerRG12p"))
    png(folder / "object.png", np.full((32, 32), 255, np.uint8))
    for name in ("wood.jpg", "normals.png"):
        picture = np.random.default_rng(0).integers(0, 256, (32, 32, 3)).astype(np.uint8)
        (folder / name).write_bytes(
            (imagecodecs.jpeg_encode if name.endswith("jpg") else imagecodecs.png_encode)(picture)
        )


@pytest.fixture(scope="session")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the commands read."""
    folder = tmp_path_factory.mktemp("rig")
    write_frames(folder)
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        patch.chdir(folder)
        for line in (
            "polsep samples -o samples",
            "polsep separate shot.png -o out --method analytic",
            "polsep video frames/ -o film --method analytic",
            "polsep calibrate dark cap_*.png --white-level 4095 -o rig.json",
            "polsep merge short.png middle.png long.png -o merged.tiff",
            "polsep capture folder:frames -o take1 --method none",
            "polsep edit out/shot.exr -o edited --rougher 3 --save-recipe wood.json",
        ):
            run(line)
    return folder


def split(mosaic: polsep.Mosaic) -> tuple[np.ndarray, np.ndarray]:
    """A method of a reader's own."""
    images = methods.METHODS["analytic"].run(mosaic, (1.0, 1.0, 1.0), False)
    return images.diffuse, images.specular


def run(line: str) -> None:
    """Run a command in this process, as a shell would."""
    words = [found for word in shlex.split(line) for found in sorted(glob.glob(word)) or [word]]
    app.main(words[1:], prog_name="polsep", standalone_mode=False)


def test_lines_that_do_not_run_are_told_apart() -> None:
    """Every entry of the list names a command of the documentation."""
    assert not [begin for begin in LEFT_OUT if not any(re.match(begin, line) for _, line in LINES)]
    assert not [name for name in NO_PYTHON if not any(page.stem == name for page in PAGES)]


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("line", RUN)
def test_commands_run(
    line: str, rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command ends without an error, and writes into its folder, where it has one."""
    for path in rig.iterdir():
        if path.is_dir():
            shutil.copytree(path, tmp_path / path.name)
        else:
            os.link(path, tmp_path / path.name)  # whoever writes replaces
    monkeypatch.chdir(tmp_path)
    if "polsep/data" in line:
        (tmp_path / "polsep").symlink_to(ROOT / "polsep")
    words = shlex.split(line)
    target = Path(words[words.index("-o") + 1]) if "-o" in words else None
    if target is not None and target.is_dir() and not any(word.startswith(f"{target}/") for word in words):
        shutil.rmtree(target)
    elif target is not None and target.is_file():
        target.unlink()
    if "--save-recipe" in words:
        (tmp_path / words[words.index("--save-recipe") + 1]).unlink()
    monkeypatch.setattr(sys, "argv", words)
    if line in FAILS:
        with pytest.raises(SystemExit):
            run(line)
        assert FAILS[line] in capsys.readouterr().err
        return
    run(line)
    assert target is None or target.exists()


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("page", SCRIPTS, ids=lambda page: page.stem)
def test_python_runs(page: Path, rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page's code runs with a frame of the reader's, and with what it says to have."""
    monkeypatch.chdir(tmp_path)
    shutil.copyfile(rig / "rig.json", tmp_path / "rig.json")
    monkeypatch.setattr("PIL.Image.Image.show", lambda *_: None)
    raw = np.tile((frame(size=64) >> 4).astype(np.uint16), (24, 24))
    mosaic = polsep.Mosaic(raw[:64, :64].astype(np.float32), Layout(), 0, 4095)
    raw = raw[:64, :64] if page.stem == "calibration" else raw  # as large as the dark frames of rig.json
    names = {"raw": raw, "lamp_off": raw // 16, "mosaic": mosaic, "frames": [mosaic] * 2}
    names |= {"wood": np.ones((8, 8, 3), np.float32) / 2, "separate": split}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for code in blocks(page, "python"):
            exec(compile(code, page.name, "exec"), names)
    assert len(names) > 6
