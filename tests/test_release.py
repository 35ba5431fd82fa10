"""What a release promises: size and contents of the wheel, what it needs where, versions, cards of weights, samples."""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
import warnings
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from packaging.requirements import Requirement

import polsep
from polsep import cli
from polsep.cli.app import EXTRAS
from polsep.io.store.samples import sample_folder
from polsep.sensor.layout_check import check_layout
from polsep.sensor.levels import as_mosaic
from tests.test_docs import check_command
from tools.model_cards import write_card

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
FRAMES = {path.stem: path for path in sample_folder().glob("*.png")}
WEIGHTS = sorted((ROOT / "polsep" / "weights").rglob("*.safetensors"))


def test_the_wheel_is_small_and_without_the_laboratory() -> None:
    """Only the package is in it, and its files, compressed as in a wheel, take less than 20 MB."""
    assert PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"] == {"packages": ["polsep"]}
    shipped = [path for path in (ROOT / "polsep").rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    assert sum(len(zlib.compress(path.read_bytes(), 6)) for path in shipped) < 19.8e6


@pytest.mark.parametrize(
    ("system", "machine", "needed"),
    [
        ("linux", "x86_64", False),
        ("linux", "aarch64", True),
        ("darwin", "arm64", True),
        ("darwin", "x86_64", True),
        ("win32", "AMD64", True),
    ],
)
def test_numba_is_installed_where_no_library_of_kernels_is(system: str, machine: str, needed: bool) -> None:
    """The library that ships is for Linux on x86-64."""
    required = [Requirement(line) for line in PROJECT["project"]["dependencies"]]
    numba = next(one for one in required if one.name == "numba")
    assert numba.marker is not None
    assert numba.marker.evaluate({"sys_platform": system, "platform_machine": machine}) == needed


def test_versions_agree() -> None:
    """The package, CITATION.cff and the first section of the changelog."""
    version = polsep.__version__
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.MULTILINE) == [version]
    first = re.search(r"^## (\S+) \((unreleased|\d{4}-\d\d-\d\d)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert first is not None
    assert first[1] == version


def test_extras_are_known_by_their_modules() -> None:
    """The command line knows every extra that adds to what polsep does."""
    assert set(PROJECT["project"]["optional-dependencies"]) - {"dev", "docs"} == set(EXTRAS)


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda path: path.stem)
def test_cards_are_of_the_weights_and_results_that_ship(weights: Path) -> None:
    """`python -m tools.model_cards` would change nothing."""
    assert weights.with_suffix(".md").read_text(encoding="utf-8") == write_card(weights)


@pytest.mark.parametrize("name", [".github/workflows/wheel.yml", "Dockerfile", "polsep/data/samples/README.md"])
def test_commands_of_other_files_parse(name: str) -> None:
    """Commands of the workflow, of the image and of the samples exist, with their options."""
    lines = re.findall(
        r"(?:^ *(?:- run: )?|`)(polsep [^`\n>]*)", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE
    )
    assert lines or name == "Dockerfile"
    for line in lines:
        check_command(shlex.split(line))


def test_samples_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All frames with their README and licence; a second time only if told to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["polsep", "samples", "-o", "s"])
    cli.main()
    assert {path.name for path in (tmp_path / "s").iterdir()} == {path.name for path in sample_folder().iterdir()}
    with pytest.raises(SystemExit):
        cli.main()


def test_samples_are_frames_of_12_bits() -> None:
    """Of the sizes that their README says; "clipped" clips a lot, "color" hardly."""
    codes = {name: imagecodecs.png_decode(path.read_bytes()) for name, path in FRAMES.items()}
    angles = {f"angle_{angle}" for angle in (0, 45, 90, 135)}
    assert set(codes) == angles | {"color", "mono", "wrong_layout", "unpolarized", "clipped"}
    assert all(image.dtype == np.uint16 and image.max() <= 4095 for image in codes.values())
    assert all(image.shape == ((172, 204, 3) if name in angles else (344, 408)) for name, image in codes.items())
    shares = {name: float((image == 4095).mean()) for name, image in codes.items()}
    assert shares["color"] < 0.02 < 0.05 < shares["clipped"]
    readme = (sample_folder() / "README.md").read_text(encoding="utf-8")
    assert all(f"`{name}.png`" in readme for name in codes.keys() - {"angle_45", "angle_90"})


def test_the_wrong_layout_is_noticed_and_named() -> None:
    """The layout check names what the samples' README says, and finds nothing wrong with the others."""
    for name in ("color", "wrong_layout", "clipped"):
        mosaic = as_mosaic(imagecodecs.png_decode(FRAMES[name].read_bytes()), white_level=4095)[0]
        warning = check_layout(mosaic).warning
        assert (warning is None) == (name != "wrong_layout")
        assert warning is None or "90,45,135,0/GBRG@1,1" in warning


@pytest.mark.usefixtures("compiled")
def test_samples_show_what_they_say() -> None:
    """The lamp's polarizer in all frames that have one; no single angle without; hidden truth behind clipping."""
    found, warned = {}, {}
    for name in ("color", "unpolarized", "clipped"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", polsep.PolsepWarning)
            out = polsep.separate(imagecodecs.png_decode(FRAMES[name].read_bytes()), "color-affine", white_level=4095)
        found[name], warned[name] = out, " ".join(out.report["warnings"])
    assert found["color"].report["statistics"]["light_polarizer_deg"] == pytest.approx(25, abs=10)
    assert found["color"].specular.max() > 2 * found["unpolarized"].specular.max()
    assert found["clipped"].valid.mean() < found["color"].valid.mean()
    assert "polariz" in warned["unpolarized"]
    assert warned["color"] == ""
