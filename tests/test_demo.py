"""The demo: a capture that polsep rendered itself, separated offline, with the results where it says."""

from __future__ import annotations

import re
import socket
import sys
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import torch

import polsep
from polsep import cli
from polsep.camera import IMX250, Layout, expose
from polsep.layout_check import check_layout
from polsep.levels import as_mosaic
from polsep.pipeline import METHODS
from polsep.render import render
from polsep.scenes import still_life

CAPTURE = Path(polsep.__file__).parent / "data" / "still_life.png"


def test_demo_works_offline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`polsep demo` needs no network, separates the capture with every method, and prints paths that exist."""

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the demo opened a socket")

    monkeypatch.setattr(socket, "socket", refuse)
    monkeypatch.setattr(sys, "argv", ["polsep", "demo", "-o", str(tmp_path / "o")])
    cli.main()
    said = capsys.readouterr()
    assert said.err == ""
    for method in METHODS:
        files = {p.name for p in (tmp_path / "o" / method).iterdir()}
        assert files == {"still_life.exr", "still_life.png", "still_life.json"}
        assert str(tmp_path / "o" / method / "still_life.png") in said.out
        match = re.search(rf"{method}: .*light polarizer about (\d+) deg \((\d+) deg in the scene\)", said.out)
        assert match is not None
    assert "Look at" in said.out


def test_embedded_capture_is_a_12_bit_frame() -> None:
    """The capture has the size of an IMX250, codes up to 4095 in 16-bit words, a few of them clipped, and a layout
    that its own samples confirm."""
    codes = imagecodecs.png_decode(CAPTURE.read_bytes())
    assert codes.shape == (2048, 2448) and codes.dtype == np.uint16
    assert int(codes.max()) == 4095
    assert 0 < float((codes == 4095).mean()) < 0.05
    assert len(np.unique(codes)) > 2048
    assert check_layout(as_mosaic(codes, white_level=4095)[0]).warning is None


def test_rendering_the_still_life_is_deterministic() -> None:
    """The scene, its rendering and its exposure depend on fixed seeds alone: twice the same samples."""
    frames = []
    for _ in range(2):
        diffuse, specular = render(*still_life(), (64, 64))
        frames.append(expose(diffuse + specular, Layout(), IMX250, torch.Generator().manual_seed(2022)).data)
    assert torch.equal(frames[0], frames[1])
    assert float(frames[0].max()) > 0.5 * 4095


def test_the_still_life_is_the_capture() -> None:
    """Rendered small, the scene has the brightness of the embedded capture, cell by cell of a coarse grid."""
    codes = imagecodecs.png_decode(CAPTURE.read_bytes()).astype(np.float64) / 4095
    diffuse, specular = render(*still_life(), (96, 116), samples=2)
    light = expose(diffuse + specular, Layout(), IMX250, torch.Generator().manual_seed(1)).linear().double().numpy()

    def grid(image: np.ndarray) -> np.ndarray:
        rows, cols = image.shape[0] // 8 * 8, image.shape[1] // 8 * 8
        return image[:rows, :cols].reshape(8, rows // 8, 8, cols // 8).mean(axis=(1, 3))

    assert float(np.corrcoef(grid(codes).ravel(), grid(light).ravel())[0, 1]) > 0.97
    assert float(light.mean()) == pytest.approx(float(codes.mean()), rel=0.1)
