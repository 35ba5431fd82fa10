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
from torch.nn.functional import avg_pool2d

from polsep import cli
from polsep.io.store import samples
from polsep.io.store.samples import DEMO
from polsep.methods import BEST, METHODS
from polsep.render.distances import still_life
from polsep.render.sphere_tracing import cast, is_lit, render, shade
from polsep.sensor.camera import IMX250, Layout, Sensor, expose
from polsep.sensor.layout_check import check_layout
from polsep.sensor.levels import as_mosaic


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("every", [False, True])
def test_demo_works_offline(
    every: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`polsep demo` needs no network, separates the capture with two methods or with every one, and prints paths.

    Every one sees its middle alone, which takes a tenth of the time.
    """

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the demo opened a socket")

    monkeypatch.setattr(socket, "socket", refuse)
    if every:
        middle = imagecodecs.png_decode(DEMO.read_bytes())[768:1280, 768:1536]
        (tmp_path / DEMO.name).write_bytes(imagecodecs.png_encode(np.ascontiguousarray(middle)))
        monkeypatch.setattr(samples, "DEMO", tmp_path / DEMO.name)
    monkeypatch.setattr(sys, "argv", ["polsep", "demo", "-o", str(tmp_path / "o"), *["--all"] * every])
    cli.main()
    said = capsys.readouterr()
    assert said.err == ""
    methods = tuple(METHODS) if every else ("analytic", BEST[0].name)
    assert {p.name for p in (tmp_path / "o").iterdir()} == set(methods)
    for method in methods:
        files = {p.name for p in (tmp_path / "o" / method).iterdir()}
        assert files == {"still_life.exr", "still_life.png", "still_life.json"}
        assert str(tmp_path / "o" / method / "still_life.png") in said.out
        match = re.search(
            rf"{method}; .*polarizer at (\d+) deg.*The lamp.s polarizer is at (\d+) deg", said.out, re.DOTALL
        )
        assert match is not None
    assert "Compare " in said.out


def test_embedded_capture_is_a_12_bit_frame() -> None:
    """The capture has the size of an IMX250, codes up to 4095 in 16-bit words, a few of them clipped, and a layout
    that its own samples confirm."""
    codes = imagecodecs.png_decode(DEMO.read_bytes())
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


@pytest.mark.parametrize("first", [300, 480, 1000, 1500])
def test_the_still_life_is_the_capture(first: int) -> None:
    """Four rows of the embedded capture, rendered anew by today's code, agree with it within the sensor's noise."""
    codes = torch.from_numpy(imagecodecs.png_decode(DEMO.read_bytes())[first : first + 4].astype(np.float32))
    parts, camera, light = still_life()
    rows, cols = first + (torch.arange(8) + 0.5) / 2, (torch.arange(2 * 2448) + 0.5) / 2
    points = [g.flatten() for g in torch.meshgrid(rows, cols, indexing="ij")]
    buffer = cast(parts, camera, *points, (2048, 2448))
    diffuse, specular = shade(buffer, camera, light, is_lit(parts, buffer, light))
    stokes = (diffuse + specular).map(lambda s: avg_pool2d(s.view(1, 3, 8, -1), 2)[0])
    expected = expose(stokes, Layout(), Sensor(diattenuation=IMX250.diattenuation)).data
    deviation = (codes / 4095 - expected) / IMX250.noise_variance(expected).sqrt()
    assert float(deviation[expected < 0.98].abs().max()) < 6
    fair = (expected > 0.01) & (expected < 0.98)  # read noise below black is cut off in darker samples
    if first > 600:
        assert float(deviation[fair].square().mean()) == pytest.approx(1, rel=0.15)
