"""`polsep doctor`: what it says of an installation that works, and of one that does not."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from polsep import cli, doctor
from polsep.cli.app import EXTRAS
from polsep.compute import library
from polsep.methods import METHODS


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["polsep", "doctor", *words])
    monkeypatch.setattr("polsep.capture.find.list_cameras", lambda: doctor_cameras)
    cli.main()


class doctor_cameras:
    """One camera, and one library that is missing."""

    cameras = {"aravis:Fake_1": "Aravis Fake, serial 1"}  # noqa: RUF012
    missing = {"pylon": "expected the extra camera, found no pypylon"}  # noqa: RUF012


@pytest.mark.usefixtures("compiled")
def test_an_installation_that_works(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Every method is tried, every extra named, and the exit status is 0."""
    monkeypatch.setattr(doctor, "is_installed", lambda module: module != "gradio")
    run(monkeypatch, "--json")
    facts = json.loads(capsys.readouterr().out)
    assert facts["problems"] == []
    assert set(facts["tests"]) == {*METHODS, "files"}
    assert facts["extras"] == {name: ["gradio"] if name == "view" else [] for name in EXTRAS}
    assert facts["cameras"]["found"] == doctor_cameras.cameras
    assert facts["packages"]["numpy"] == np.__version__
    assert facts["extra_packages"]["numba"] == numba.__version__ and "gradio" not in facts["extra_packages"]
    assert set(doctor.MEANS) == set(METHODS)


@pytest.mark.usefixtures("compiled")
def test_problems_are_said_and_counted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Images that differ, errors and packages that are missing end in exit status 2, with a line each."""
    monkeypatch.setattr(doctor, "MEANS", {"analytic": (0.5, 0.1)})
    monkeypatch.setattr("polsep.methods.METHODS", {"analytic": METHODS["analytic"], "absent": None})
    monkeypatch.setattr(doctor, "find_packages", lambda: {"numpy": "2", "OpenEXR": None})
    monkeypatch.setattr(doctor, "is_installed", lambda module: module != "av")
    with pytest.raises(SystemExit) as stop:
        run(monkeypatch)
    said = capsys.readouterr()
    assert stop.value.code == 2
    assert "pip install 'polsep[video]'" in said.out
    assert "camera      aravis:Fake_1: Aravis Fake, serial 1" in said.out
    first, second, third = said.err.splitlines()
    assert first == "polsep: error: expected the package OpenEXR, found none"
    assert second.startswith("polsep: error: analytic: ValueError: expected means of 0.5000 diffuse")
    assert third.startswith("polsep: error: absent: AttributeError: ")


def test_what_runs_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """The library where it is for this machine; else numba, and why."""
    monkeypatch.setattr(library, "open_library", lambda: None)
    monkeypatch.delenv("POLSEP_KERNELS", raising=False)
    assert doctor._kernels() == "library"

    def refuse() -> None:
        raise library.Unusable("the processor has no avx2")

    monkeypatch.setattr(library, "open_library", refuse)
    assert doctor._kernels() == "numba: the processor has no avx2"
    assert "numba" in doctor.find_packages()


def test_files_that_come_back_different_are_noticed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The self-test of files compares what was read with what was written."""
    del tmp_path
    found = doctor.separate_crop("analytic")

    class Other:
        diffuse, specular = found.diffuse + 1, found.specular

    monkeypatch.setattr("polsep.io.results.separation_reader.read_separated", lambda _: Other)
    with pytest.raises(ValueError, match="expected to read the images that were written, found others"):
        doctor.check_files()
